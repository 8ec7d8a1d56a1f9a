"""`l2lidar record`, `convert` and `replay`: captures and bags of a unit's data."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.live import Live
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from l2lidar_node.cli.console import out, say, with_network
from l2lidar_node.cli.device import Device, DeviceError
from l2lidar_node.command_line import CommandError, UsageError
from l2lidar_node.config import DriverConfig, NetworkConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.files import free_name
from l2lidar_node.protocol import wire
from l2lidar_node.recording.bag import BagWriter
from l2lidar_node.recording.capture import CaptureError
from l2lidar_node.recording.pacing import TimeLine
from l2lidar_node.recording.packet_bag import PacketBag, PacketBagWriter, open_packets
from l2lidar_node.recording.recording import (
    Received,
    Recorder,
    Recording,
    RecordingWriter,
    events,
    timed,
    written,
)
from l2lidar_node.settings import build
from l2lidar_node.types import StampError, Stream

_CAPTURES: Final = (".pcap", ".cap")
_LOOK_S: Final = 0.25
_HEAR_S: Final = 5.0
_UNSWEPT: Final = 64  # commands of the driver that are thrown away between two looks
_SHOW_S: Final = 0.1

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
        float, typer.Option(min=0.0, help="Seconds to record; until Ctrl-C if omitted.")
    ] = math.inf,
    sweep_cut: CutOption = "turn",
    point_layout: LayoutOption = "native",
) -> None:
    """Record a unit. A capture (.pcap) keeps every packet with its time of arrival.

    It opens in Wireshark, is written continuously, so a crash costs a second at most, and can
    be replayed bit for bit by the driver's parameter replay_file. A bag keeps clouds, IMU samples
    and the static transform. The unit's clock is set once, as the driver does.
    """
    is_capture = _is_capture(file)
    if file.exists():
        raise UsageError(f"{file} exists already; choose another name or remove it")
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
            raise CommandError(f"{error}; the data received until then are in {left}") from None
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
        left = f"; the data received until then are in {bag.unfinished}" if bag.unfinished else ""
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
        str, typer.Option(help="Unit whose packets to use, if there are several.")
    ] = "",
    packets: Annotated[
        bool,
        typer.Option(
            "--packets", help="For a bag: write raw packets, as publish_packets does, not clouds."
        ),
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
            read = Recording(stream, l2_ip, is_selected=True)
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
        "bag in one file, or a name without a suffix for a rosbag2 folder"
    )


def _watch(device: Device, failures: list[str], duration: float, size: Callable[[], str]) -> None:
    """Show how it goes until the end, a failure or Ctrl-C."""
    begun = time.monotonic()
    try:
        if device.wait_for(_is_heard, min(_HEAR_S, duration)) is None:
            say(f"[yellow]no data from the L2 yet; {device.advice()}")
        with Live(console=out, auto_refresh=False, transient=True) as live:
            while (passed := time.monotonic() - begun) < duration and not failures:
                time.sleep(min(_LOOK_S, duration - passed))
                frames, lost = device.ask(_counts)
                text = f"{passed:.0f} s, {frames} packets, {lost} lost, {size()}"
                live.update(Text(text.rstrip(", ")), refresh=True)
    except KeyboardInterrupt:
        pass
    if not device.ask(_is_heard):
        failures.append(f"no data came from the L2; {device.advice()}")


def _is_heard(driver: Driver) -> bool:
    return driver.counters.frames.total() > 0


def _counts(driver: Driver) -> tuple[int, int]:
    counters = driver.counters
    return counters.frames.total(), sum(counters.sequence[stream].lost for stream in Stream)


def _size(recorder: Recorder) -> str:
    return f"{recorder.octets / 1e6:.1f} MB"


def replay(
    file: Annotated[
        Path, typer.Argument(help="pcap or pcapng file, or a bag with raw packets.", exists=True)
    ],
    to: Annotated[
        str, typer.Option(metavar="ADDRESS:PORT", help="Address on which the driver listens.")
    ] = f"127.0.0.1:{wire.HOST_PORT}",
    source: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="ADDRESS:PORT",
            help="Address to send from; by default the recorded one if this machine has it.",
        ),
    ] = None,
    l2_ip: Annotated[
        str, typer.Option(help="Unit whose packets to use, if there are several.")
    ] = "",
    rate: Annotated[
        float, typer.Option(min=0.0, max=1000.0, help="Speed; 0 for as fast as possible.")
    ] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="Start over at the end.")] = False,
    start: Annotated[float, typer.Option(min=0.0, help="Seconds to skip.")] = 0.0,
    duration: Annotated[
        float | None, typer.Option(min=0.0, help="Seconds to play; to the end if omitted.")
    ] = None,
) -> None:
    """Send the datagrams of a capture or bag to a driver, at the pace they were captured.

    The driver stamps them as they arrive now. For the stamps of the recording, bit for bit, let
    the driver read the file itself: its parameter replay_file.
    """
    destination = _end(to)
    try:
        stream = open_packets(file)
        recording = Recording(stream, l2_ip, is_selected=True)
    except (OSError, CaptureError) as error:
        raise DeviceError(f"{file}: {error}") from None
    with stream, _bound(recording, source) as sender, _progress() as progress:
        address = sender.getsockname()
        say(
            f"{file}: the L2 at {recording.device}; sending from {address[0]}:{address[1]} to {to}"
        )
        size = None if isinstance(stream, PacketBag) else file.stat().st_size
        task = progress.add_task("", total=size, seconds=0.0, lap=1)
        sent = lap = 0
        try:
            while lap == 0 or loop:
                lap += 1
                shown = 0.0
                progress.update(task, lap=lap)
                for data, seconds in _paced(recording, rate, start, duration):
                    sent += _sent(sender, data, destination)
                    if time.monotonic() > shown + _SHOW_S:
                        shown = time.monotonic()
                        progress.update(task, completed=recording.position, seconds=seconds)
                if not sent:
                    raise DeviceError(f"{file} has no data from {start:g} s on")
                progress.update(task, completed=recording.position)
        except CaptureError as error:
            raise DeviceError(f"{file}: {error}") from None
        except KeyboardInterrupt:
            pass
    cut = "; the file is cut off at its end" if recording.is_cut_off else ""
    say(f"{sent} datagrams sent{cut}")


def _paced(
    recording: Recording, rate: float, start: float, duration: float | None
) -> Iterator[tuple[bytes, float]]:
    """Yield datagrams with their time into the recording [s], each when it is due."""
    begun = time.monotonic()
    for entry, due_ns in timed(recording, TimeLine(recording.start)):
        if not isinstance(entry, Received):
            continue
        seconds = due_ns / 1e9
        if seconds < start:
            begun = time.monotonic()
            continue
        if duration is not None and seconds > start + duration:
            return
        if rate:
            time.sleep(max(begun + (seconds - start) / rate - time.monotonic(), 0.0))
        yield entry.data, seconds


def _sent(sender: socket.socket, data: bytes, destination: tuple[str, int]) -> bool:
    """Send, and discard the driver's commands: a recording cannot obey."""
    try:
        for _ in range(_UNSWEPT):
            sender.recv(65_536)
    except OSError:
        pass
    try:
        sender.sendto(data, destination)
    except OSError:  # no listener (yet)
        return False
    return True


def _bound(recording: Recording, source: str | None) -> socket.socket:
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.setblocking(False)
    try:
        sender.bind(_end(source) if source else tuple(recording.device))
    except OSError as error:
        if source:
            sender.close()
            raise DeviceError(f"cannot send from {source}: {error.strerror}") from None
        sender.bind(("0.0.0.0", 0))
        say(
            f"[yellow]this machine cannot send from {recording.device} ({error.strerror}): set "
            "the driver's l2_ip to the address that is used"
        )
    return sender


def _end(text: str) -> tuple[str, int]:
    ip, _, port = text.rpartition(":")
    try:
        socket.inet_aton(ip)
        number = int(port)
        if not 0 < number < 65536:
            raise ValueError
    except (OSError, ValueError):
        raise typer.BadParameter(f"'{text}' is not ADDRESS:PORT such as 127.0.0.1:6201") from None
    return ip, number


def _progress() -> Progress:
    return Progress(
        TextColumn("lap {task.fields[lap]}"),
        BarColumn(),
        DownloadColumn(),
        TextColumn("{task.fields[seconds]:.1f} s"),
        TimeRemainingColumn(),
        console=out,
    )
