"""`l2lidar calibrate`: estimates a unit's errors and writes its calibration file."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from l2lidar_node import __version__
from l2lidar_node.calibration import report
from l2lidar_node.calibration.file import CalibrationFile
from l2lidar_node.calibration.observation import Place
from l2lidar_node.calibration.result import StillResult, Verdict
from l2lidar_node.calibration.scale import by_tape
from l2lidar_node.calibration.still import DEG, CalibrationError, calibrate, problems
from l2lidar_node.cli import calibrate_files as files
from l2lidar_node.cli.calibrate_files import (
    EmulatorOption,
    KeepOption,
    OutputOption,
    PictureOption,
    SecondsOption,
)
from l2lidar_node.cli.calibrate_imu import imu
from l2lidar_node.cli.console import JsonOption, YesOption, out, print_json, say, with_network
from l2lidar_node.cli.device import Device
from l2lidar_node.command_line import CommandError, UsageError
from l2lidar_node.config import NetworkConfig
from l2lidar_node.protocol.wire import MIRROR_PERIOD_S

_POSES: Final = (
    "upright, in the middle of the room",
    "tilted by about 30 degrees, anywhere else in the room",
    "on its side",
    "on its side and turned by 90 degrees, or tilted the other way",
)
_BEFORE: Final = """\
[bold]Before you begin[/]
  - let the unit run for 10 minutes to warm up; its IMU must be on
  - use a furnished room of 4 to 10 m with a flat ceiling and bare stretches of wall, not a
    corridor, not outdoors
  - screw or clamp the sensor to something heavy: not foam, not a tripod, not your hand
  - clean the cover; nobody may walk about"""
_WITHIN: Final = (
    "within the accuracy of tape and surfaces: nothing to correct; use a better tape (--tape-mm) "
    "or a longer distance to measure more accurately"
)
_RIGHT: Final = "the block that the unit reports is right: nothing to correct"
_HELD_UP_S: Final = 10.0  # that a place may take longer than it was to be recorded

app = typer.Typer(
    help="Estimate the unit's calibration errors, and write its calibration file.",
    no_args_is_help=True,
)
app.command()(imu)


@app.command()
@with_network
def still(
    network: NetworkConfig,
    captures: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Captures of placements (l2lidar record), one each; live from the unit if "
            "omitted.",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
    again: Annotated[
        list[Path] | None,
        typer.Option(
            help="Capture made after the unit was switched off and on; may be repeated.",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
    emulator: EmulatorOption = None,
    places: Annotated[
        int, typer.Option(min=1, max=12, help="Placements to measure live, before and after.")
    ] = 4,
    seconds: SecondsOption = 10.0,
    keep: KeepOption = None,
    keep_alpha: Annotated[
        bool,
        typer.Option(
            "--keep-alpha",
            help="Store alpha after one power-up; it is right until the unit is switched off.",
        ),
    ] = False,
    output: OutputOption = None,
    figure: PictureOption = None,
    yes: YesOption = False,
    json_: JsonOption = False,
) -> None:
    """Estimate beam angles and range bias from places where the sensor stands still.

    Measure at four places for 10 s each, then switch the unit off and on and measure once more:
    alpha is stored only if it comes back. Nothing is ever written into the sensor.

    Examples
    --------
    l2lidar calibrate still -o front.yaml --picture front.png

    l2lidar calibrate still a.pcap b.pcap c.pcap --again d.pcap -o front.yaml

    l2lidar calibrate still --emulator typical -o virtual.yaml
    """
    if emulator is not None and captures:
        raise UsageError("--emulator measures by itself; omit the captures")
    known = files.prepared(output, figure)
    firmware = ""
    if emulator is not None:
        gathered = _virtual(emulator, seconds, min(places, 4), quiet=json_)
    elif captures:
        gathered, firmware = _captured(captures, again or [])
    else:
        gathered, firmware = _live(network, places, seconds, keep, _Guide(yes or json_, json_))
    if known is not None:
        for place in gathered:
            files.check_identity(place, known, output)
    say("estimating ...") if not json_ else None
    try:
        result = calibrate(gathered, keep_alpha)
    except CalibrationError as error:
        raise CommandError(str(error)) from None
    made = report.calibration_of(result, gathered, time.strftime("%Y-%m-%d"), firmware)
    if figure is not None:
        report.save(result, figure)
    if json_:
        print_json(_as_data(result, made))
    else:
        _show(result)
        if figure is not None:
            say(f"picture in {figure}")
    if result.refusals:
        raise CommandError("nothing written: " + result.refusals[0].reason)
    files.write(
        made,
        output,
        "" if result.stored else _RIGHT,
        "give it to the driver as calibration_file",
        quiet=json_,
    )


@app.command()
@with_network
def scale(
    network: NetworkConfig,
    length: Annotated[
        float,
        typer.Option(min=0.1, max=50.0, help="Distance between the two positions by tape [m]."),
    ],
    captures: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Two captures, at the start and the end; live if omitted.",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
    tape_mm: Annotated[
        float, typer.Option(min=0.1, max=100.0, help="Uncertainty of the tape [mm].")
    ] = 2.0,
    emulator: EmulatorOption = None,
    seconds: SecondsOption = 10.0,
    keep: KeepOption = None,
    output: OutputOption = None,
    yes: YesOption = False,
    json_: JsonOption = False,
) -> None:
    """Measure the scale of ranges with a tape measure: no sensor knows it by itself.

    Slide the sensor along the tape straight towards a flat wall, without turning it: 3 m are
    good, 2 mm of them are 0.07 %. A range bias cancels.

    Examples
    --------
    l2lidar calibrate scale --length 3.000 -o front.yaml

    l2lidar calibrate scale --length 3.000 start.pcap end.pcap -o front.yaml
    """
    known = files.prepared(output)
    firmware = ""
    if emulator is not None:
        from l2lidar_node.cli.virtual_places import slide

        try:
            gathered = slide(emulator, length, seconds=seconds)
        except ValueError as error:
            raise UsageError(str(error)) from None
    elif captures:
        if len(captures) != 2:
            raise UsageError(
                f"expected two captures, of start and end; the number given is {len(captures)}"
            )
        gathered, firmware = _captured(captures, [])
    else:
        gathered = []
        with ExitStack() as stack:
            folder = keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
            guide = _Guide(yes or json_, json_)
            for name in ("start", "end"):
                files.unused(folder / f"{name}.pcap")
            files.require_unit(network, quiet=json_)
            for name in ("start", "end"):
                text = f"\nThe {name} of the tape; the sensor looks along it"
                place, firmware = _measured(network, folder / name, seconds, 0, text, guide)
                gathered.append(place)
    for place in gathered:
        files.check_identity(place, known, output)
    try:
        found = by_tape(gathered[0], gathered[1], length, tape_mm / 1e3, report.beams_of(known))
    except CalibrationError as error:
        raise CommandError(str(error)) from None
    about = {
        "tool": f"l2lidar {__version__}",
        "date": time.strftime("%Y-%m-%d"),
        "firmware": firmware,
        "length_m": length,
        "measured_m": round(found.measured, 5),
        "surfaces": found.surfaces,
    }
    if json_:
        print_json({"scale": found.scale, "sd": found.sd, **about})
    else:
        say(
            f"the sensor measured {found.measured:.4f} m of {length:.4f} m, with "
            f"{found.surfaces} flat patches: ranges must be scaled by "
            f"{100 * found.scale:+.3f} +- {100 * found.sd:.3f} %"
        )
    made = CalibrationFile(
        gathered[0].block.octets,
        {"range_scale": found.scale},
        {"range_scale": found.sd},
        None,
        {"scale": about},
    )
    files.write(
        made,
        output,
        "" if found.is_significant else _WITHIN,
        "give it to the driver as calibration_file",
        quiet=json_,
    )


def _captured(first: Sequence[Path], again: Sequence[Path]) -> tuple[list[Place], str]:
    found = [files.capture_place(path, 0) for path in first]
    found += [files.capture_place(path, 1) for path in again]
    firmware = next((text for _, text in found if text), "")
    return [place for place, _ in found], firmware


def _virtual(name: str, seconds: float, places: int, *, quiet: bool) -> list[Place]:
    from l2lidar_node.cli.virtual_places import POSES_DEG, still_places
    from l2lidar_node.emulator.unit.units import unit

    poses = tuple(POSES_DEG)[:places]
    try:
        before, after = (unit(name, power_up) for power_up in (0, 1))
    except ValueError as error:
        raise UsageError(str(error)) from None
    if not quiet:
        say(f"a virtual unit, '{name}', at {len(poses)} places, twice switched on")
    first = still_places(before, seconds=seconds, poses=poses)
    second = still_places(after, seconds=seconds, poses=poses[:1], power_up=1)
    return [*first, *second]


def _live(
    network: NetworkConfig, places: int, seconds: float, keep: Path | None, guide: _Guide
) -> tuple[list[Place], str]:
    """Guide through the placements and return the measurements."""
    found: list[Place] = []
    firmware = ""
    with ExitStack() as stack:
        folder = keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        names = [f"place_{number + 1}" for number in range(places)]
        for name in (*names, "again"):
            files.unused(folder / f"{name}.pcap")
        files.require_unit(network, quiet=guide.is_quiet)
        if not guide.is_unattended:
            say(_BEFORE)
        for number, name in enumerate(names):
            pose = _POSES[min(number, len(_POSES) - 1)]
            text = f"\nPlace {number + 1} of {places}: {pose}"
            place, told = _measured(network, folder / name, seconds, 0, text, guide)
            found.append(place)
            firmware = told or firmware
        if not guide.is_unattended:
            say(
                "\nSwitch the unit off and on and wait until its head turns; alpha is stored only "
                "if it is then the same."
            )
            if files.confirmed("Measure once more?"):
                place, _ = _measured(network, folder / "again", seconds, 1, "", guide)
                found.append(place)
    return found, firmware


class _Guide(NamedTuple):
    """Whether to print and prompt, print only, or print JSON."""

    is_unattended: bool
    is_quiet: bool


def _measured(
    network: NetworkConfig, path: Path, seconds: float, power_up: int, text: str, guide: _Guide
) -> tuple[Place, str]:
    """Return a placement; report at once if it cannot be used, and offer to repeat it.

    Parameters
    ----------
    network : NetworkConfig
    path : Path
        Without its ending: a second attempt has a number behind its name.
    seconds : float
    power_up : int
    text : str
        What to do before; empty if it was said.
    guide : _Guide
    """
    for attempt in count(1):
        if text:
            files.ask(text, unattended=guide.is_unattended)
        name = path.name if attempt == 1 else f"{path.name}_{attempt}"
        troubles: list[str] = []
        try:
            place, firmware = _recorded(
                network, path.with_name(f"{name}.pcap"), seconds, power_up, quiet=guide.is_quiet
            )
        except CommandError as error:
            if guide.is_unattended:
                raise
            troubles = [str(error)]
        else:
            troubles = [f"{item.reason}: {item.advice}" for item in problems(place)]
            if guide.is_unattended or not troubles:
                if not guide.is_quiet:
                    say(f"{place.turns:.0f} turns of the head, {len(place.returns)} returns")
                return place, firmware
        for trouble in troubles:
            say(f"[yellow]{trouble}[/]")
        if not files.confirmed("Repeat this placement?"):
            raise CommandError(f"nothing written: {troubles[0]}")
    raise AssertionError("count never ends")


def _recorded(
    network: NetworkConfig, path: Path, seconds: float, power_up: int, *, quiet: bool
) -> tuple[Place, str]:
    """Record a place with a bar, and return it."""
    failures: list[str] = []
    recorder = files.recorder(path, network, failures)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    try:
        with Device(network, tap=recorder) as device:
            files.wait_for_points(device, quiet=quiet)
            with Progress(*columns, console=out, disable=quiet) as progress:
                task = progress.add_task("recording", total=seconds)
                before = device.ask(files.mirror_turns)

                def is_done(_: float) -> bool:
                    measured = MIRROR_PERIOD_S * (device.ask(files.mirror_turns) - before)
                    progress.update(task, completed=min(measured, seconds))
                    return measured >= seconds

                # What this machine or the network holds up is waited for.
                files.pass_time(seconds + _HELD_UP_S, failures, is_done)
    finally:
        recorder.close()
    if failures:
        raise CommandError(failures[0])
    return files.capture_place(path, power_up)


def _show(result: StillResult) -> None:
    """Print the result."""
    table = Table(box=None, pad_edge=False)
    for heading in ("", "reported", "correction", "", "verdict"):
        table.add_column(heading, overflow="fold")
    own = result.block.values
    for name, item in result.estimates.items():
        unit, factor = report.UNITS[name]
        scale = own["range_scale"] if name == "bias" else 1.0
        reported = f"{own[report.ENTRIES[name]] * scale * factor:.3f}"
        known = math.isfinite(item.value)
        color = {"corrected": "green", "not known": "yellow", "shown, not stored": "yellow"}
        verdict = item.verdict.value + (f": {item.reason}" if item.reason else "")
        table.add_row(
            f"{name} [{unit}]".replace("[", "\\["),
            reported,
            f"{item.value * factor:+.3f}" if known else "",
            f"+- {item.sd * factor:.3f}" if known else "",
            f"[{color.get(item.verdict.value, 'default')}]{verdict}[/]",
        )
    out.print(table)
    say(
        f"\nxi - 0.7 beta, the best determined combination: {result.side / DEG:+.3f} +- "
        f"{result.side_sd / DEG:.3f} degrees"
    )
    say(f"known worst: {result.weakest}")
    before, after = report.quality_mm(result.before), report.quality_mm(result.after)
    say(
        f"walls, median thickness: {before['thickness_median']:.1f} mm before, "
        f"{after['thickness_median']:.1f} mm after ({result.planes} flat patches)"
    )
    say(
        f"gap of the two halves of a turn, median (90th percentile): {before['gap_median']:.1f} "
        f"({before['gap_p90']:.1f}) mm before, {after['gap_median']:.1f} ({after['gap_p90']:.1f}) "
        "mm after"
    )
    say("")
    for place in result.places:
        rocks = (
            "no IMU data"
            if place.precession is None
            else f"mount rocks by {place.precession.forward / DEG:.3f} degrees"
        )
        say(
            f"{place.name}: xi {place.xi / DEG:+.3f}, beta {place.beta / DEG:+.3f}, alpha "
            f"{place.alpha / DEG:+.3f} degrees; {place.turns:.0f} turns, {place.planes} patches; "
            f"{rocks}"
        )
    for note in result.notes:
        say(f"[yellow]note[/] {note}")
    for refusal in result.refusals:
        say(f"[red]refused[/] {refusal.reason}\n        {refusal.advice}")


def _as_data(result: StillResult, made: CalibrationFile) -> dict[str, object]:
    return {
        "reported": result.block.values,
        "block": result.block.octets.hex(),
        "correction": {
            name: value for name, value in made.correction.items() if not result.refusals
        },
        "estimates": {
            name: {
                "value": item.value if item.verdict is not Verdict.UNKNOWN else None,
                "sd": item.sd if item.verdict is not Verdict.UNKNOWN else None,
                "verdict": item.verdict.value,
                "reason": item.reason,
            }
            for name, item in result.estimates.items()
        },
        "refusals": [list(refusal) for refusal in result.refusals],
        **made.about,
    }
