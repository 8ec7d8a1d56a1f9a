"""`l2lidar record`: writes what a unit sends, raw as a capture or decoded as a bag."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.live import Live
from rich.text import Text

from l2lidar_node.cli.console import out, say, with_network
from l2lidar_node.cli.device import Device
from l2lidar_node.command_line import CommandError, UsageError
from l2lidar_node.config import DriverConfig, NetworkConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.files import free_name
from l2lidar_node.recording.bag import BagWriter
from l2lidar_node.recording.pcap import CaptureError
from l2lidar_node.recording.recording import Recorder, Recording
from l2lidar_node.recording.replay import events
from l2lidar_node.settings import build
from l2lidar_node.types import StampError, Stream

_CAPTURES: Final = (".pcap", ".cap")
_LOOK_S: Final = 0.25
_HEAR_S: Final = 5.0

CutOption = Annotated[
    str,
    typer.Option(
        metavar="packets|turn|half_turn",
        help="Where a cloud ends; for bags.",
    ),
]
LayoutOption = Annotated[str, typer.Option(help="Fields of the points; for bags.")]


@with_network
def record(
    network: NetworkConfig,
    file: Annotated[
        Path,
        typer.Argument(help="FILE.pcap for raw packets; FILE.mcap or a folder for a ROS 2 bag."),
    ],
    duration: Annotated[
        float, typer.Option(min=0.0, help="Seconds to record; until Ctrl-C if left out.")
    ] = math.inf,
    sweep_cut: CutOption = "turn",
    point_layout: LayoutOption = "native",
) -> None:
    """Record a unit. A capture (.pcap) keeps every packet with its time of arrival.

    It opens in Wireshark, is written as it comes so that a crash costs a second at most, and can
    be replayed bit for bit by the driver's parameter replay_file. A bag keeps clouds, IMU samples
    and the static transform. The unit's clock is set once, as the driver does.
    """
    is_capture = _is_capture(file)
    if file.exists():
        raise UsageError(f"{file} exists already; choose another name, or remove it")
    settings = {
        "enable_l2_host_sync": True,
        "enable_latency_measure": True,
        "imu_adjust": False,
        "sweep_cut": sweep_cut,
        "point_layout": point_layout,
    }
    if is_capture:
        _record_capture(network, file, duration, settings)
    else:
        _record_bag(network, file, duration, settings)


def _record_capture(
    network: NetworkConfig, file: Path, duration: float, settings: dict[str, Any]
) -> None:
    failures: list[str] = []
    try:
        recorder = Recorder(file, network, failures.append)
    except OSError as error:
        raise CommandError(f"cannot write {file}: {error.strerror}") from None
    try:
        with Device(network, tap=recorder, **settings) as device:
            _watch(device, failures, duration, lambda: _size(recorder))
        _raise_first(failures)
    except BaseException as error:
        recorder.close()
        if not recorder.datagrams:
            file.unlink()
        elif isinstance(error, CommandError):
            left = file.rename(free_name(file.with_name(f"{file.stem}.unfinished{file.suffix}")))
            raise CommandError(f"{error}; the data received until then is in {left}") from None
        raise
    say(f"{file}: {_size(recorder)}")


def _record_bag(
    network: NetworkConfig, file: Path, duration: float, settings: dict[str, Any]
) -> None:
    failures: list[str] = []
    bag = BagWriter(file, build(DriverConfig, settings), keep_unfinished=True)

    def keep(event: Event) -> None:
        if not failures:
            try:
                bag.add(event)
            except OSError as error:
                failures.append(f"recording to {file} ended: {error.strerror}")
            except StampError as error:
                failures.append(f"recording to {file} ended: {error}; set this host's clock")

    try:
        with bag:
            with Device(network, keep, **settings) as device:
                _watch(device, failures, duration, lambda: "")
            _raise_first(failures)
    except (CommandError, OSError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        left = f"; what came until then is in {bag.unfinished}" if bag.unfinished else ""
        raise CommandError(f"{reason or error}{left}") from None
    say(f"{file}: {bag.clouds} clouds, {bag.samples} IMU samples")


def _raise_first(failures: list[str]) -> None:
    if failures:
        raise CommandError(failures[0])


def convert(
    capture: Annotated[
        Path, typer.Argument(help="pcap or pcapng file.", exists=True, dir_okay=False)
    ],
    bag: Annotated[Path, typer.Argument(help="FILE.mcap or a folder to write.")],
    sweep_cut: CutOption = "turn",
    point_layout: LayoutOption = "native",
    l2_ip: Annotated[
        str, typer.Option(help="Whose packets, if the capture holds those of several units.")
    ] = "",
) -> None:
    """Turn a capture into a ROS 2 bag, with the stamps the driver gives.

    Interrupted, or stopped by an error, it leaves nothing behind.
    """
    if _is_capture(bag):
        raise UsageError(f"'{bag}' is named like a capture; a bag is FILE.mcap, or a folder")
    if bag.exists():
        raise UsageError(f"{bag} exists already; choose another name, or remove it")
    values = {"imu_adjust": False, "sweep_cut": sweep_cut, "point_layout": point_layout}
    config = build(DriverConfig, values)
    try:
        with capture.open("rb") as stream:
            recording = Recording(stream, l2_ip)
            with BagWriter(bag, config) as writer:
                for event in events(recording, config):
                    writer.add(event)
    except OSError as error:
        raise CommandError(f"{error.filename or bag}: {error.strerror}") from None
    except (CaptureError, StampError) as error:
        raise CommandError(f"{capture}: {error}") from None
    cut = "; the capture is cut off at its end" if recording.is_cut_off else ""
    say(f"{bag}: {writer.clouds} clouds, {writer.samples} IMU samples{cut}")


def _is_capture(file: Path) -> bool:
    """Tell from a name whether it is one of a capture, rather than of a bag.

    Raises
    ------
    UsageError
        If it is neither.
    """
    if file.suffix in _CAPTURES:
        return True
    if file.suffix in ("", ".mcap"):
        return False
    raise UsageError(
        f"'{file}' ends in '{file.suffix}'; expected FILE.pcap for raw packets, FILE.mcap for a "
        "bag in one file, or a name without an ending for a rosbag2 folder"
    )


def _watch(device: Device, failures: list[str], duration: float, size: Callable[[], str]) -> None:
    """Show how it goes until the end, a failure or Ctrl-C."""
    begun = time.monotonic()
    try:
        if device.wait_for(_is_heard, min(_HEAR_S, duration)) is None:
            say(f"[yellow]nothing heard from the L2 yet; {device.advice()}")
        with Live(console=out, auto_refresh=False, transient=True) as live:
            while (passed := time.monotonic() - begun) < duration and not failures:
                time.sleep(min(_LOOK_S, duration - passed))
                frames, lost = device.ask(_counts)
                text = f"{passed:.0f} s, {frames} packets, {lost} lost, {size()}"
                live.update(Text(text.rstrip(", ")), refresh=True)
    except KeyboardInterrupt:
        pass
    if not device.ask(_is_heard):
        failures.append(f"nothing was heard from the L2; {device.advice()}")


def _is_heard(driver: Driver) -> bool:
    return driver.counters.frames.total() > 0


def _counts(driver: Driver) -> tuple[int, int]:
    counters = driver.counters
    return counters.frames.total(), sum(counters.sequence[stream].lost for stream in Stream)


def _size(recorder: Recorder) -> str:
    return f"{recorder.octets / 1e6:.1f} MB"
