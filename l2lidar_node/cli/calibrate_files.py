"""Options, files, prompts and recordings of the `l2lidar calibrate` verbs."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final

import typer

from l2lidar_node.calibration import report
from l2lidar_node.calibration.file import CalibrationFile, CalibrationFileError, load
from l2lidar_node.calibration.observation import Gathering, Place
from l2lidar_node.cli.console import say
from l2lidar_node.cli.device import Device
from l2lidar_node.command_line import CommandError, UsageError
from l2lidar_node.config import NetworkConfig
from l2lidar_node.driver.driver import Driver
from l2lidar_node.protocol.framing import Frame, Framer
from l2lidar_node.protocol.packets import DecodeError, ImuPacket, PointPacket, Version, decode
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.recording.capture import CaptureError
from l2lidar_node.recording.packet_bag import open_packets
from l2lidar_node.recording.recording import Received, Recorder, Recording

_SPIN_UP_S: Final = 60.0
_HEARD_S: Final = 6.0  # a unit that was just switched on needs 4 s for its first IMU packet
_MOMENT_S: Final = 1.5
_LOOK_S: Final = 0.1
_CALIBRATIONS: Final = (".yaml", ".yml")
_PICTURES: Final = (".png", ".jpg", ".jpeg", ".pdf", ".svg")

OutputOption = Annotated[
    Path | None,
    typer.Option(
        "--output", "-o", metavar="FILE.yaml", help="Calibration file to write or to add to."
    ),
]
EmulatorOption = Annotated[
    str | None,
    typer.Option(
        metavar="UNIT",
        help="Calibrate a virtual unit: perfect, typical, poor or a number.",
    ),
]
SecondsOption = Annotated[
    float, typer.Option(min=1.0, max=120.0, help="Seconds to record per placement.")
]
KeepOption = Annotated[
    Path | None, typer.Option(metavar="FOLDER", help="Keep the recordings in this folder.")
]
PictureOption = Annotated[
    Path | None,
    typer.Option("--picture", metavar="FILE.png", help="Picture to write, before and after."),
]


def prepared(output: Path | None, picture: Path | None = None) -> CalibrationFile | None:
    """Return the content of the file to add to; None if there is none yet.

    What cannot be written is found here, before anybody carries a sensor about.

    Raises
    ------
    UsageError
        If a file has another suffix or is a folder.
    CommandError
        If its folder cannot be written to, or the file to add to cannot be used.
    """
    expected = ((output, _CALIBRATIONS, "FILE.yaml"), (picture, _PICTURES, "FILE.png"))
    for path, suffixes, words in expected:
        if path is None:
            continue
        if path.suffix.lower() not in suffixes:
            raise UsageError(f"'{path}' ends in '{path.suffix}'; expected {words}")
        if path.is_dir():
            raise UsageError(f"'{path}' is a folder; expected {words}")
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK):
            raise CommandError(f"cannot write to the folder of '{path}'")
    return existing(output)


def existing(output: Path | None) -> CalibrationFile | None:
    """Return the content of the file to add to; None if there is none yet.

    Raises
    ------
    CommandError
        If it is there and cannot be used.
    """
    if output is None or not output.exists():
        return None
    try:
        return load(output)
    except CalibrationFileError as error:
        raise CommandError(f"{error}; choose another --output") from None


def check_identity(place: Place, known: CalibrationFile | None, output: Path | None) -> None:
    """Refuse measurements of another unit or mode than that of the file to add to.

    Raises
    ------
    CommandError
        If it was not.
    """
    if place.blocks > 1:
        raise CommandError(
            f"packets of {place.blocks} different calibration blocks: record one unit in one mode"
        )
    if known is not None and not known.matches(place.block.octets):
        raise CommandError(f"{output} belongs to another unit; choose another --output")


def unused(path: Path) -> Path:
    """Return the path of a capture that is about to be written.

    Raises
    ------
    UsageError
        If there is a file already: recordings are never replaced.
    """
    if path.exists():
        raise UsageError(f"{path} exists already; choose another folder for --keep")
    return path


def write(
    made: CalibrationFile, output: Path | None, unneeded: str, advice: str, *, quiet: bool
) -> None:
    """Write a calibration file, or say why there is none to write.

    Parameters
    ----------
    made : CalibrationFile
        Added to what the file holds of the same unit.
    output : Path or None
    unneeded : str
        Why there is nothing to write; empty if there is.
    advice : str
        What to do with the file.
    quiet : bool

    Raises
    ------
    CommandError
        If the file is there and of another unit, or cannot be written.
    """
    if unneeded:
        words = unneeded
    elif output is None:
        words = "nothing written; add --output FILE.yaml"
    else:
        old = existing(output)
        if old is not None and not old.matches(made.block):
            raise CommandError(f"{output} belongs to another unit; choose another --output")
        report.joined(made, old).save(output)
        words = f"{output}: {advice}"
    if not quiet:
        say(words)


def ask(text: str, *, unattended: bool) -> None:
    """Print what to do and wait for Enter; continue at once without a terminal."""
    if not unattended:
        say(text)
        _answer("Press Enter when it stands still (Ctrl-C ends it): ")


def confirmed(question: str) -> bool:
    """Ask a question until the answer is yes or no; Enter is yes."""
    while True:
        answer = _answer(f"{question} [Y/n]: ").strip().lower()
        if answer in ("", "y", "yes"):
            return True
        if answer in ("n", "no"):
            return False
        say(f"'{answer}' is not an answer: type y or n")


def _answer(prompt: str) -> str:
    """Return the line that is typed.

    Raises
    ------
    CommandError
        If the input has ended.
    """
    try:
        if not sys.stdin.isatty():
            return input(prompt)
        # input() misses a Ctrl-C that comes between its prompt and its reading.
        print(prompt, end="", flush=True)
        while not select.select([sys.stdin], [], [], _LOOK_S)[0]:
            pass
        return input()
    except EOFError:
        say("")
        raise CommandError(
            "no answer from a terminal; run it in one, or with --yes and the sensor in position"
        ) from None


def require_unit(network: NetworkConfig, *, quiet: bool) -> None:
    """Look for the unit before anybody carries it about.

    Raises
    ------
    CommandError
        If it is not there or does not measure.
    """
    if not quiet:
        say(f"looking for the L2 at {network.where} ...")
    with Device(network) as device:
        if device.is_measuring(_HEARD_S):
            return
        answers = device.ask(lambda driver: driver.counters.frames.total())
        if answers:
            raise CommandError("the L2 is in standby; wake it with l2lidar start")
        raise CommandError(f"no measurements from the L2; {device.advice()}")


def wait_for_points(device: Device, *, quiet: bool) -> None:
    """Wait until the head turns and points come.

    Raises
    ------
    CommandError
        If none come.
    """
    if device.wait_for(_sends_points, _MOMENT_S):
        return
    if not quiet:
        say("waiting for points: the head takes 12 to 45 s to start ...")
    if device.wait_for(_sends_points, _SPIN_UP_S) is None:
        raise CommandError(f"no points from the L2; {device.advice()}")


def recorder(path: Path, network: NetworkConfig, failures: list[str]) -> Recorder:
    """Return a writer of a new capture; it adds to ``failures`` if it cannot continue.

    Raises
    ------
    CommandError
        If the file cannot be made.
    """
    try:
        return Recorder(path, network, failures.append)
    except OSError as error:
        raise CommandError(f"cannot write {path}: {error.strerror}") from None


def pass_time(seconds: float, failures: list[str], told: Callable[[float], bool | None]) -> None:
    """Let time pass while a recorder writes, until one of them ends it.

    Parameters
    ----------
    seconds : float
    failures : list of str
        What the recorder says: nothing is worth waiting for any more.
    told : callable
        Given the seconds that have passed; returns True to end it.
    """
    begun = time.monotonic()
    while (passed := time.monotonic() - begun) < seconds and not failures:
        if told(passed):
            return
        time.sleep(_LOOK_S)
    told(seconds)


def mirror_turns(driver: Driver) -> int:
    """Return of how many turns of the mirror the points have come, a 3D packet each."""
    return driver.counters.frames[PacketType.POINTS_3D]


def _sends_points(driver: Driver) -> bool:
    return mirror_turns(driver) > 0


def capture_place(path: Path, power_up: int = 0) -> tuple[Place, str]:
    """Return the placement in a capture, and the unit's firmware if it is known.

    Raises
    ------
    CommandError
        If it cannot be read or holds no 3D packets.
    """
    gathering = Gathering(path.stem, power_up)
    framer = Framer()
    firmware = ""
    try:
        with open_packets(path) as stream:
            for entry in Recording(stream):
                if not isinstance(entry, Received):
                    continue
                for item in framer.feed(entry.data):
                    if isinstance(item, Frame):
                        firmware = _gathered(gathering, item) or firmware
        return gathering.place(), firmware
    except OSError as error:
        raise CommandError(f"{path}: {error.strerror}") from None
    except (CaptureError, ValueError) as error:
        raise CommandError(f"{path}: {error}") from None


def _gathered(gathering: Gathering, frame: Frame) -> str:
    """Add a frame to a placement; return the firmware if the frame has it."""
    packet = decode(frame)
    if isinstance(packet, PointPacket):
        if packet.packet_type == PacketType.POINTS_3D:
            gathering.points(packet.stamp / 1e9, packet.payload)
        else:
            gathering.flat()
    elif isinstance(packet, ImuPacket):
        gathering.imu(packet.stamp / 1e9, frame.payload)
    elif isinstance(packet, DecodeError):
        gathering.rejected()
    elif isinstance(packet, Version):
        return packet.firmware
    return ""
