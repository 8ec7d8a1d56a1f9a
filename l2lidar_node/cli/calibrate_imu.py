"""`l2lidar calibrate imu`: guides the user in turning the sensor, and calibrates its IMU."""

from __future__ import annotations

import math
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
import typer
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from l2lidar_node import __version__
from l2lidar_node.calibration import report
from l2lidar_node.calibration.file import CalibrationFile
from l2lidar_node.calibration.result import Verdict
from l2lidar_node.cli import calibrate_files as files
from l2lidar_node.cli.calibrate_files import (
    EmulatorOption,
    KeepOption,
    OutputOption,
    PictureOption,
)
from l2lidar_node.cli.console import JsonOption, YesOption, out, print_json, say, with_network
from l2lidar_node.cli.device import Device
from l2lidar_node.command_line import CommandError, UsageError
from l2lidar_node.config import DriverConfig, NetworkConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.recording.capture import CaptureError
from l2lidar_node.recording.packet_bag import open_packets
from l2lidar_node.recording.recording import Recording, feed
from l2lidar_node.settings import build
from l2lidar_node.types import F64, IMU_SAMPLE, ImuSample, Sweep

if TYPE_CHECKING:
    from l2lidar_proc.motion.gyro_alignment import Turns
    from l2lidar_proc.odometry.imu_calibration import ImuResult

_BEFORE: Final = """\
[bold]Before you begin[/]
  - calibrate the beams first (l2lidar calibrate still) and use the same --output here
  - use a furnished room of 4 to 10 m; hold the sensor in your hands, cable and all
  - hold it still for 5 s; then roll, pitch and yaw it, one axis after the other and all together,
    as fast as a quick look around (1 to 2 rad/s, not above 3), and shake it as well, until the
    three bars are full: about 30 s"""
_AXES: Final = ("roll about x", "pitch about y", "yaw about z")
_FIRST_SAMPLE_S: Final = 10.0  # the clock needs a second or two of packets before it gives any
_STILL_S: Final = 5.0
_SHORTEST_S: Final = 20.0  # of motion, however vivid
_VIRTUAL_S: Final = 36.0


@with_network
def imu(
    network: NetworkConfig,
    capture: Annotated[
        Path | None,
        typer.Argument(
            help="Capture of such a motion (l2lidar record); live from the unit if omitted.",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
    emulator: EmulatorOption = None,
    motion: Annotated[
        str,
        typer.Option(
            help="Motion of the virtual unit: shake is what the guide asks for; spin, walk, trot "
            "and drone show what they cannot determine."
        ),
    ] = "shake",
    seconds: Annotated[
        float,
        typer.Option(
            min=_SHORTEST_S, max=300.0, help="Longest motion to record; full bars end it earlier."
        ),
    ] = 60.0,
    keep: KeepOption = None,
    output: OutputOption = None,
    figure: PictureOption = None,
    yes: YesOption = False,
    json_: JsonOption = False,
) -> None:
    """Estimate rotation and time offset of the IMU and scale of its gyro, from turning it.

    Take the sensor into your hands: 5 s still, then turn and shake it about three axes. What the
    motion does not tell is left as in the drawing. /imu/data stays as it is: deskew and odometry
    use the result, if they are given the file as calibration_file.

    Examples
    --------
    l2lidar calibrate imu -o front.yaml

    l2lidar calibrate imu shaken.pcap -o front.yaml --picture turns.png

    l2lidar calibrate imu --emulator typical -o virtual.yaml
    """
    if emulator is not None and capture is not None:
        raise UsageError("--emulator measures by itself; omit the capture")
    known = files.prepared(output, figure)
    with ExitStack() as stack:
        folder = keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if capture is not None:
            path = capture
        elif emulator is not None:
            path = files.unused(folder / "imu.pcap")
            _virtual(path, emulator, motion, quiet=json_)
        else:
            path = files.unused(folder / "imu.pcap")
            files.require_unit(network, quiet=json_)
            _live(network, path, seconds, unattended=yes or json_, quiet=json_)
        place, firmware = files.capture_place(path)
        files.check_identity(place, known, output)
        result = _estimated(path, known, quiet=json_)
    about = _about(result, firmware, known)
    if figure is not None:
        report.save_turns(over_time(result.before), over_time(result.alignment.turns), figure)
    if json_:
        print_json(_as_data(result, about))
    else:
        _show(result, known)
        if figure is not None:
            say(f"picture in {figure}")
    if result.refusals:
        raise CommandError("nothing written: " + result.refusals[0].reason)
    made = CalibrationFile(place.block.octets, {}, {}, result.calibration(), {"imu": about})
    files.write(
        made,
        output,
        "" if result.is_corrected else "the IMU matches the drawing: nothing to correct",
        "give it to deskew_node and odometry_node as calibration_file",
        quiet=json_,
    )


def _virtual(path: Path, name: str, motion: str, *, quiet: bool) -> None:
    from l2lidar_node.cli.virtual_places import capture

    if not quiet:
        say(f"a virtual unit, '{name}', is turned and shaken ({motion}) for {_VIRTUAL_S:.0f} s")
    try:
        with _bar(quiet) as progress:
            task = progress.add_task("measuring", total=1.0)

            def told(share: float) -> None:
                progress.update(task, completed=share)

            capture(path, name, _VIRTUAL_S, motion=motion, progress=told)
    except ValueError as error:
        raise UsageError(str(error)) from None


class _Watch:
    """Collects gyro samples while the sensor is turned; called in the receive thread."""

    def __init__(self) -> None:
        self._samples: list[ImuSample] = []

    def __call__(self, event: Event) -> None:
        if isinstance(event, ImuSample):
            self._samples.append(event)

    def clear(self) -> None:
        self._samples.clear()

    @property
    def samples(self) -> np.ndarray[Any, np.dtype[np.void]]:
        return np.array([tuple(item) for item in list(self._samples)], IMU_SAMPLE)


def _live(
    network: NetworkConfig, path: Path, seconds: float, *, unattended: bool, quiet: bool
) -> None:
    """Guide through the motion and record it."""
    from l2lidar_proc.motion.gyro_alignment import excitation
    from l2lidar_proc.odometry.imu_calibration import ENOUGH

    if not unattended:
        say(_BEFORE)
        files.ask("\nHold the sensor still", unattended=False)
    failures: list[str] = []
    recorder = files.recorder(path, network, failures)
    watch = _Watch()
    try:
        with ExitStack() as stack:
            device = stack.enter_context(Device(network, watch, recorder))
            files.wait_for_points(device, quiet=quiet)
            if device.wait_for(lambda driver: driver.last_imu, _FIRST_SAMPLE_S) is None:
                raise CommandError(
                    "no IMU samples from the L2; switch its IMU on: l2lidar set work-mode -- "
                    "-imu_off"
                )
            progress = stack.enter_context(_bar(quiet))
            task = progress.add_task("still", total=_STILL_S)
            files.pass_time(
                _STILL_S, failures, lambda passed: progress.update(task, completed=passed)
            )
            watch.clear()
            bars = [progress.add_task(name, total=ENOUGH) for name in _AXES]
            clock = progress.add_task("time", total=seconds)

            def is_done(passed: float) -> bool:
                samples = watch.samples
                found = excitation(
                    samples["stamp"], samples["angular_velocity"].astype(np.float64)
                )
                for bar, value in zip(bars, found.tolist(), strict=True):
                    progress.update(bar, completed=min(value, ENOUGH))
                progress.update(clock, completed=passed)
                return bool(passed >= _SHORTEST_S and (found >= ENOUGH).all())

            files.pass_time(seconds, failures, is_done)
    finally:
        recorder.close()
    if failures:
        raise CommandError(failures[0])


def _bar(quiet: bool) -> Progress:
    columns = (
        TextColumn("{task.description:<14}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
    )
    return Progress(*columns, console=out, disable=quiet)


def _estimated(path: Path, known: CalibrationFile | None, *, quiet: bool) -> ImuResult:
    """Return the result of a capture."""
    from l2lidar_proc.motion.gyro_alignment import GyroError
    from l2lidar_proc.odometry import imu_calibration

    with _bar(quiet) as progress:
        task = progress.add_task("estimating", total=1.0)

        def told(share: float) -> None:
            progress.update(task, completed=share)

        sweeps, samples = _measured(path, known)
        try:
            return imu_calibration.calibrate(
                sweeps, samples, progress=told, beams_calibrated=_has_beams(known)
            )
        except GyroError as error:
            raise CommandError(str(error)) from None


def _has_beams(known: CalibrationFile | None) -> bool:
    return bool(report.beams_of(known).any())


def _measured(
    path: Path, known: CalibrationFile | None
) -> tuple[list[Sweep], np.ndarray[Any, np.dtype[np.void]]]:
    """Return sweeps of full turns and IMU samples as a driver makes them of a capture."""
    settings = {"imu_adjust": False, "sweep_cut": "turn"}
    driver = Driver(build(DriverConfig, settings), known)
    sweeps: list[Sweep] = []
    samples: list[ImuSample] = []
    try:
        with open_packets(path) as stream:
            events = [event for entry in Recording(stream) for event in feed(driver, entry)]
    except OSError as error:
        raise CommandError(f"{path}: {error.strerror}") from None
    except CaptureError as error:
        raise CommandError(f"{path}: {error}") from None
    for event in [*events, *driver.flush()]:
        if isinstance(event, Sweep):
            sweeps.append(event)
        elif isinstance(event, ImuSample):
            samples.append(event)
    return sweeps, np.array([tuple(item) for item in samples], IMU_SAMPLE)


def over_time(turns: Turns) -> tuple[F64, F64]:
    """Return the times (N,) [s] of rotations, and their errors (N, 3) [rad]."""
    ends = turns.ends
    return np.asarray((ends - ends[:1]) * 1e-9), turns.residual


def _about(result: ImuResult, firmware: str, known: CalibrationFile | None) -> dict[str, Any]:
    from l2lidar_proc.odometry.imu_calibration import IMU_PARAMETERS

    parameters = {}
    for (name, item), about in zip(result.estimates.items(), IMU_PARAMETERS, strict=True):
        parameters[name] = {
            "value": round(item.value * about.factor, 4),
            "sd": round(item.sd * about.factor, 4),
            "unit": about.unit,
            "verdict": item.verdict.value,
        }
    return {
        "tool": f"l2lidar {__version__}",
        "date": time.strftime("%Y-%m-%d"),
        "firmware": firmware,
        "beams": known.path if known is not None and _has_beams(known) else "as reported",
        "seconds": round(result.seconds, 1),
        "sweeps": result.sweeps,
        "aligned": result.aligned,
        "excitation_rad2_per_s": [round(float(x), 2) for x in result.alignment.excitation],
        "turns_off_deg": {
            "before": round(math.degrees(result.before.rms), 4),
            "after": round(math.degrees(result.alignment.turns.rms), 4),
        },
        "weakest": result.weakest,
        "parameters": parameters,
        "notes": list(result.notes),
    }


def _show(result: ImuResult, known: CalibrationFile | None) -> None:
    """Print the result."""
    from l2lidar_proc.odometry.imu_calibration import ENOUGH, IMU_PARAMETERS

    if not _has_beams(known):
        say(
            "[yellow]note[/] the beams are used as reported; calibrate them first (l2lidar "
            "calibrate still, same --output) for better accuracy"
        )
    table = Table(box=None, pad_edge=False)
    for heading in ("", "value", "", "verdict"):
        table.add_column(heading, overflow="fold")
    colors = {Verdict.CORRECTED: "green", Verdict.UNCHANGED: "default"}
    words = {Verdict.UNCHANGED: "as drawn", Verdict.SHOWN: "for information"}
    for (name, item), about in zip(result.estimates.items(), IMU_PARAMETERS, strict=True):
        is_known = item.verdict is not Verdict.UNKNOWN
        verdict = words.get(item.verdict, item.verdict.value)
        verdict += f": {item.reason}" if item.reason else ""
        table.add_row(
            f"{name} [{about.unit}]".replace("[", "\\["),
            f"{item.value * about.factor:+.3f}" if is_known else "",
            f"+- {item.sd * about.factor:.3f}",
            f"[{colors.get(item.verdict, 'yellow')}]{verdict}[/]",
        )
    out.print(table)
    say(f"\nknown worst: {result.weakest}")
    say(
        "turned about each axis: "
        + ", ".join(
            f"{axis} {min(100.0 * value / ENOUGH, 999.0):.0f} %"
            for axis, value in zip("xyz", result.alignment.excitation, strict=True)
        )
        + " of the required motion"
    )
    say(
        f"gyro against clouds, from sweep to sweep: {math.degrees(result.before.rms):.3f} degrees "
        f"before, {math.degrees(result.alignment.turns.rms):.3f} calibrated ({result.aligned} "
        f"of {result.sweeps} sweeps aligned)"
    )
    for note in result.notes:
        say(f"[yellow]note[/] {note}")
    for refusal in result.refusals:
        say(f"[red]refused[/] {refusal.reason}\n        {refusal.advice}")


def _as_data(result: ImuResult, about: dict[str, Any]) -> dict[str, object]:
    made = result.calibration()
    return {
        "rotation_rpy": list(made.rotation_rpy),
        "time_offset": made.time_offset,
        "gyro_scale": list(made.gyro_scale),
        "gyro_skew": list(made.gyro_skew),
        "gyro_bias": list(made.gyro_bias),
        "is_corrected": result.is_corrected,
        "refusals": [list(refusal) for refusal in result.refusals],
        **about,
    }
