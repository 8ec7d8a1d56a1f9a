"""`l2lidar record`: writes what a unit sends, raw as a capture or decoded as a bag."""

from __future__ import annotations

import math
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.live import Live
from rich.text import Text

from l2lidar_node.cli.console import out, say, with_network
from l2lidar_node.cli.device import Device, DeviceError
from l2lidar_node.config import DriverConfig, NetworkConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.recording.bag import BagWriter
from l2lidar_node.recording.pcap import CaptureError
from l2lidar_node.recording.recording import Recorder, Recording
from l2lidar_node.recording.replay import events
from l2lidar_node.settings import build
from l2lidar_node.types import Stream

CAPTURES: Final = (".pcap", ".cap")
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
    if file.exists():
        raise typer.BadParameter(f"{file} exists already", param_hint="'FILE'")
    failures: list[str] = []
    settings = {
        "enable_l2_host_sync": True,
        "enable_latency_measure": True,
        "imu_adjust": False,
        "sweep_cut": sweep_cut,
        "point_layout": point_layout,
    }
    with ExitStack() as stack:
        recorder = bag = None
        try:
            if file.suffix in CAPTURES:
                recorder = Recorder(file, network, failures.append)
            else:
                config = build(DriverConfig, settings)
                bag = stack.enter_context(BagWriter(file, config))
        except OSError as error:
            raise DeviceError(f"cannot write {file}: {error.strerror}") from None

        def keep(event: Event) -> None:
            if bag is not None:
                bag.add(event)

        device = stack.enter_context(Device(network, keep, recorder, **settings))
        _watch(device, recorder, failures, duration)
    if failures:
        raise DeviceError(failures[0])
    what = f"{bag.clouds} clouds, {bag.samples} IMU samples" if bag else _size(recorder)
    say(f"{file}: {what}")


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
    """Turn a capture into a ROS 2 bag, with the stamps the driver gives."""
    if bag.exists():
        raise typer.BadParameter(f"{bag} exists already", param_hint="'BAG'")
    values = {"imu_adjust": False, "sweep_cut": sweep_cut, "point_layout": point_layout}
    config = build(DriverConfig, values)
    try:
        with capture.open("rb") as stream:
            recording = Recording(stream, l2_ip)
            with BagWriter(bag, config) as writer:
                for event in events(recording, config):
                    writer.add(event)
    except OSError as error:
        raise DeviceError(f"{error.filename or capture}: {error.strerror}") from None
    except CaptureError as error:
        raise DeviceError(f"{capture}: {error}") from None
    cut = "; the capture is cut off at its end" if recording.is_cut_off else ""
    say(f"{bag}: {writer.clouds} clouds, {writer.samples} IMU samples{cut}")


def _watch(
    device: Device, recorder: Recorder | None, failures: list[str], duration: float
) -> None:
    begun = time.monotonic()
    try:
        if device.wait_for(_is_heard, min(_HEAR_S, duration)) is None:
            say(f"[yellow]nothing heard from the L2 yet; {device.advice()}")
        with Live(console=out, auto_refresh=False, transient=True) as live:
            while (passed := time.monotonic() - begun) < duration and not failures:
                time.sleep(min(_LOOK_S, duration - passed))
                frames, lost = device.ask(_counts)
                size = f", {_size(recorder)}" if recorder else ""
                live.update(
                    Text(f"{passed:.0f} s, {frames} packets, {lost} lost{size}"), refresh=True
                )
    except KeyboardInterrupt:
        pass
    if not device.ask(_is_heard):
        failures.append(f"nothing was heard from the L2; {device.advice()}")


def _is_heard(driver: Driver) -> bool:
    return driver.counters.frames.total() > 0


def _counts(driver: Driver) -> tuple[int, int]:
    counters = driver.counters
    return counters.frames.total(), sum(counters.sequence[stream].lost for stream in Stream)


def _size(recorder: Recorder | None) -> str:
    return f"{recorder.octets / 1e6:.1f} MB" if recorder else ""
