"""`l2lidar replay`: sends what a capture holds of an L2, as if it were there."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

from l2lidar_node.cli.console import out, say
from l2lidar_node.cli.device import DeviceError
from l2lidar_node.protocol import wire
from l2lidar_node.recording.capture import CaptureError
from l2lidar_node.recording.packet_bag import PacketBag, open_packets
from l2lidar_node.recording.recording import Received, Recording

_UNSWEPT: Final = 64  # commands of the driver that are thrown away between two looks
_SHOW_S: Final = 0.1


def replay(
    file: Annotated[
        Path, typer.Argument(help="pcap or pcapng file, or a bag with raw packets.", exists=True)
    ],
    to: Annotated[
        str, typer.Option(metavar="ADDRESS:PORT", help="Where the driver listens.")
    ] = f"127.0.0.1:{wire.HOST_PORT}",
    source: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="ADDRESS:PORT",
            help="Where to send from; as recorded if this machine has that address.",
        ),
    ] = None,
    l2_ip: Annotated[
        str, typer.Option(help="Whose packets, if the capture holds those of several units.")
    ] = "",
    rate: Annotated[
        float, typer.Option(min=0.0, max=1000.0, help="Speed; 0 for as fast as possible.")
    ] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end.")] = False,
    start: Annotated[float, typer.Option(min=0.0, help="Seconds to skip.")] = 0.0,
    duration: Annotated[
        float | None, typer.Option(min=0.0, help="Seconds to play; to the end if left out.")
    ] = None,
) -> None:
    """Send the datagrams of a capture or bag to a driver, at the pace they were captured.

    The driver stamps them as they arrive now. For the stamps of the recording, bit for bit, let
    the driver read the file itself: its parameter replay_file.
    """
    destination = _end(to)
    try:
        stream = open_packets(file)
        recording = Recording(stream, l2_ip)
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
                    raise DeviceError(f"nothing in {file} from {start:g} s on")
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
    for entry in recording:
        if not isinstance(entry, Received):
            continue
        seconds = (entry.time - recording.start) / 1e9
        if seconds < start:
            begun = time.monotonic()
            continue
        if duration is not None and seconds > start + duration:
            return
        if rate:
            time.sleep(max(begun + (seconds - start) / rate - time.monotonic(), 0.0))
        yield entry.data, seconds


def _sent(sender: socket.socket, data: bytes, destination: tuple[str, int]) -> bool:
    """Send, and throw away what the driver says: a recording does not obey."""
    try:
        for _ in range(_UNSWEPT):
            sender.recv(65_536)
    except OSError:
        pass
    try:
        sender.sendto(data, destination)
    except OSError:  # nobody listens (yet)
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
            f"[yellow]this machine cannot send from {recording.device} ({error.strerror}): tell "
            "the driver the address that is sent from (l2_ip)"
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
