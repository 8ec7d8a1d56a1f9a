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
from l2lidar_node.recording.capture import CaptureError
from l2lidar_node.recording.packet_bag import PacketBagWriter, open_packets
from l2lidar_node.recording.recording import Recorder, Recording, RecordingWriter, written
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
    recording: Annotated[
        Path,
        typer.Argument(help="pcap or pcapng file, or a bag with raw packets.", exists=True),
    ],
    result: Annotated[
        Path, typer.Argument(help="FILE.mcap or a folder for a bag, FILE.pcap for a capture.")
    ],
    sweep_cut: CutOption = "turn",
    point_layout: LayoutOption = "native",
    l2_ip: Annotated[
        str, typer.Option(help="Whose packets, if there are those of several units.")
    ] = "",
    packets: Annotated[
        bool,
        typer.Option("--packets", help="Bag: raw packets, as publish_packets, not clouds."),
    ] = False,
) -> None:
    """Turn raw packets into a ROS 2 bag of clouds, with the stamps the driver gives.

    With --packets, or into FILE.pcap, they stay raw: captures and bags of packets hold the same,
    to the bit. Interrupted, or stopped by an error, it leaves nothing behind.
    """
    is_capture = _is_capture(result)
    if result.exists():
        raise UsageError(f"{result} exists already; choose another name, or remove it")
    try:
        with open_packets(recording) as stream:
            read = Recording(stream, l2_ip)
            if is_capture:
                said = _write_capture(read, result)
            elif packets:
                said = _write_packets(read, result)
            else:
                said = _write_clouds(
                    read,
                    result,
                    {"imu_adjust": False, "sweep_cut": sweep_cut, "point_layout": point_layout},
                )
    except OSError as error:
        raise CommandError(f"{error.filename or result}: {error.strerror}") from None
    except (CaptureError, StampError) as error:
        raise CommandError(f"{recording}: {error}") from None
    cut = "; the capture is cut off at its end" if read.is_cut_off else ""
    say(f"{result}: {said}{cut}")


def _write_clouds(recording: Recording, result: Path, values: dict[str, Any]) -> str:
    config = build(DriverConfig, values)
    with BagWriter(result, config) as writer:
        for event in events(recording, config):
            writer.add(event)
    return f"{writer.clouds} clouds, {writer.samples} IMU samples"


def _write_capture(recording: Recording, result: Path) -> str:
    unfinished = result.with_name(f"{result.name}.unfinished")
    count = 0
    try:
        with unfinished.open("xb") as file:
            writer = RecordingWriter(file, recording.device, recording.host)
            for entry in recording:
                kind, arguments = written(entry)
                getattr(writer, kind)(*arguments)
                count += 1
        unfinished.rename(result)
    except FileExistsError:
        raise
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise
    return f"{count} packets"


def _write_packets(recording: Recording, result: Path) -> str:
    with PacketBagWriter(result, recording.device, recording.host) as writer:
        for entry in recording:
            writer.add(entry)
    return f"{writer.entries} packets in {writer.messages} messages"


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
