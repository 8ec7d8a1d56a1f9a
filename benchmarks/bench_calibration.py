"""Measures how well a unit calibrates, and what that is worth to the odometry.

``make bench-calibration`` prints the table, writes ``out/bench/calibration.json`` and, with
``BENCH_ARGS="--page"``, ``docs/results/calibration.md`` and a table in ``docs/odometry.md``.
``--seeds 3`` is a short run, ``--capture FILE`` adds a capture of a real unit (pcap, or a cloud
``.npy`` with its table of packets), ``--docs`` draws the pictures of ``docs/calibration.md``.
Every case is kept in ``out/bench/calibration.jsonl`` as soon as it is there: ``--minutes 7
--resume`` goes on where a run was cut.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from PIL import Image
from scipy.linalg import polar

from benchmarks import bench_odometry, calibration_units, odometry_methods
from benchmarks.odometry_methods import Task
from benchmarks.results import (
    FOLDER,
    Target,
    at_least,
    at_most,
    keep,
    measured_on,
    publish,
    replaced,
    verdicts,
)
from l2lidar_node import rotations
from l2lidar_node.calibration import report
from l2lidar_node.calibration.observation import Place
from l2lidar_node.calibration.result import StillResult, Verdict
from l2lidar_node.calibration.still import DEG, CalibrationError, calibrate
from l2lidar_node.cli.calibrate_files import capture_place
from l2lidar_node.cli.calibrate_imu import over_time
from l2lidar_node.cli.virtual_places import still_places
from l2lidar_node.emulator.unit.inertial import ImuNoise
from l2lidar_node.emulator.unit.units import UNITS, Unit, UnitErrors, drawn
from l2lidar_proc.odometry import imu_calibration
from tests.support import odometry_runs
from tests.support.odometry_runs import CUTS

Row = dict[str, Any]

INJECTED: Final = UnitErrors(xi=0.4 * DEG, beta=-0.3 * DEG, alpha=0.3 * DEG, range_bias=0.05)
BOUNDS: Final = {"xi": 0.02 * DEG, "beta": 0.02 * DEG, "alpha": 0.01 * DEG, "b": 0.5e-3,
                 "bias": 8e-3}  # fmt: skip
SECONDS: Final = 4.0
METHODS: Final = (odometry_methods.OURS, odometry_methods.TYPICAL, odometry_methods.CALIBRATED)
RUNS: Final = (("room", "walk"), ("corridor", "walk"), ("yard", "walk"))
_RUN_S: Final = 30.0
_TURNING_S: Final = 32.0
_FACTORS: Final = {name: factor for name, (_, factor) in report.UNITS.items()}


class Case(NamedTuple):
    """One thing to measure, by name and seed, in a process of its own.

    Attributes
    ----------
    name : str
    seed : int
    """

    name: str
    seed: int = 0


class Kept:
    """What has been measured so far, one case a line; several processes may append.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path = FOLDER / "calibration.jsonl") -> None:
        self._path = path

    def clear(self) -> None:
        """Forget everything."""
        self._path.unlink(missing_ok=True)

    def append(self, case: Case, found: list[Row | Target]) -> None:
        """Keep what a case has found."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        rows = [item for item in found if not isinstance(item, Target)]
        targets = [asdict(item) for item in found if isinstance(item, Target)]
        entry = {"case": list(case), "rows": rows, "targets": targets}
        with self._path.open("a", encoding="utf-8") as file:
            # the line before may have been cut off
            file.write("\n" + json.dumps(entry, default=float) + "\n")

    def read(self) -> dict[Case, list[Row | Target]]:
        """Return what is there; a line that was cut off does not count."""
        found: dict[Case, list[Row | Target]] = {}
        if not self._path.exists():
            return found
        for line in self._path.read_text(encoding="utf-8").splitlines():
            try:
                entry = json.loads(line)
            except ValueError:
                continue
            targets = [Target(**item) for item in entry["targets"]]
            found[Case(*entry["case"])] = [*entry["rows"], *targets]
        return found


def main() -> int:
    """Measure what is asked for and write it down; return 0 when all targets are met."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20, help="units of each population")
    parser.add_argument("--capture", type=Path, action="append", default=[], metavar="FILE")
    parser.add_argument("--only", nargs="+", choices=tuple(CASES), help="leave the others out")
    parser.add_argument("--docs", action="store_true", help="draw docs/calibration_*.png")
    parser.add_argument("--page", action="store_true", help="write what was found into docs/")
    parser.add_argument("--jobs", type=int, default=1, help="cases at a time")
    parser.add_argument("--minutes", type=float, default=1e6, help="begin no case after that")
    parser.add_argument("--resume", action="store_true", help="keep the cases that there are")
    given = parser.parse_args()
    kept = Kept()
    if not given.resume:
        kept.clear()
        calibration_units.forget()
    cases = [
        Case(name, seed)
        for name in given.only or CASES
        for seed in range(min(given.seeds, POPULATIONS.get(name, 1)))
    ]
    until = time.monotonic() + 60.0 * given.minutes
    orders = [(case, kept, until) for case in cases if case not in kept.read()]
    if given.jobs > 1:
        with multiprocessing.get_context("fork").Pool(given.jobs, maxtasksperchild=4) as pool:
            left = sum(pool.imap(_work, orders))
    else:
        left = sum(map(_work, orders))
    if left:
        print(f"{left} cases were left out for lack of time", file=sys.stderr)
    done = kept.read()
    found = [item for case in cases for item in done.get(case, [])]
    for path in given.capture:
        place = (
            calibration_units.place(path, 0) if path.suffix == ".npy" else capture_place(path)[0]
        )
        found.append(_row(path.name, 0, calibrate([place]), None))
    rows = [item for item in found if not isinstance(item, Target)]
    targets = [item for item in found if isinstance(item, Target)]
    targets += [*perfect_targets(rows), *population_targets(rows), *odometry_targets(rows)]
    shown = [
        {name: row[name] for name in ("case", "seed", *_FACTORS, "corrected", "refused")}
        for row in rows
    ]
    publish("calibration", "Calibration of units: what is left [deg, mm]", shown, targets)
    keep("calibration", rows, targets)
    if given.docs:
        draw()
    if given.page:
        write(rows, targets)
        write_odometry(rows, METHODS)
    return 0 if all(target.met for target in targets) and not left else 1


def _work(given: tuple[Case, Kept, float]) -> int:
    """Measure a case; return 1 if there was no time for it."""
    case, kept, until = given
    if time.monotonic() > until:
        return 1
    begun = time.monotonic()
    try:
        found = list(CASES[case.name](case.seed))
    except Exception:  # one case must not end the measurement
        traceback.print_exc()
        found = [_failed(case)]
    kept.append(case, found)
    missed = [item.name for item in found if isinstance(item, Target) and not item.met]
    print(
        f"{case.name} {case.seed}: {time.monotonic() - begun:.0f} s"
        + "".join(f"; NOT MET: {name}" for name in missed),
        file=sys.stderr,
        flush=True,
    )
    return 0


def _failed(case: Case) -> Target:
    return at_most(f"{case.name} {case.seed} failed", 1, 0)


def perfect(seed: int) -> Iterator[Row | Target]:
    """Yield what is found on a unit that reports the truth: nothing must be corrected."""
    result = calibrate(still_places("perfect", seconds=SECONDS, seed=seed), keep_alpha=True)
    yield _row("perfect", seed, result, UnitErrors())


def perfect_targets(rows: list[Row]) -> Iterator[Target]:
    """Yield what all perfect units together say."""
    mine = [row for row in rows if row["case"] == "perfect"]
    if not mine:
        return
    corrected = sum(row["corrected"] != "" for row in mine)
    yield at_most(f"of {len(mine)} perfect units get a correction", corrected, 0)
    for name, bound in BOUNDS.items():
        known = [abs(row[name]) for row in mine if row[name] != ""]
        unit, factor = report.UNITS[name]
        yield at_most(f"perfect units, worst |{name}|, {unit}", max(known), bound * factor)


def injected(seed: int) -> Iterator[Row | Target]:
    """Yield what is recovered of large errors."""
    result = calibrate(still_places(_unit(INJECTED), seconds=SECONDS, seed=seed), keep_alpha=True)
    yield _row("injected", seed, result, INJECTED)
    for name, bound in BOUNDS.items():
        truth = getattr(INJECTED, "range_bias" if name == "bias" else name)
        off = abs(result.estimates[name].value - truth)
        unit, factor = report.UNITS[name]
        yield at_most(f"injected errors, {name} off by, {unit}", off * factor, bound * factor)
    yield at_most("injected errors, halves apart afterwards, mm", 1e3 * result.after.gap, 2.0)


def population(seed: int) -> Iterator[Row | Target]:
    """Yield what is found on a unit of a population with all its errors."""
    errors = drawn(seed + 1).powered_up(seed + 1, 0)
    places = still_places(_unit(errors), seconds=SECONDS, seed=seed + 1)
    yield _row("population", seed + 1, calibrate(places, keep_alpha=True), errors)


def population_targets(rows: list[Row]) -> Iterator[Target]:
    """Yield what all units of the population together say."""
    mine = [row for row in rows if row["case"] == "population"]
    if not mine:
        return
    for name in _FACTORS:
        known = [row for row in mine if row[name] != ""]
        covered = sum(abs(row[name]) <= 3.0 * row[f"{name} sd"] for row in known)
        yield at_least(f"units whose {name} is within 3 stated deviations", covered, len(known))
    refusals = sum(row["refused"] != "" for row in mine)
    yield at_most("units of the population that are refused", refusals, 0)
    gains = [row["thick after"] / row["thick before"] for row in mine]
    yield at_most("thickness after over before, median", float(np.median(gains)), 0.95)


def draw() -> None:
    """Draw the pictures of ``docs/calibration.md``."""
    folder = Path("docs")
    report.save(
        calibrate(still_places(_unit(INJECTED), seconds=SECONDS)), folder / "calibration_room.png"
    )
    for place in _real_places()[:1]:
        report.save(calibrate([place]), folder / f"{place.name}_calibrated.png")
    run = odometry_runs.record("room", "shake", 0, _TURNING_S, unit=calibration_units.TYPICAL)
    result = imu_calibration.calibrate(list(odometry_runs.sweeps(run, "turn")), run.imu)
    turns = folder / "calibration_turns.png"
    report.save_turns(over_time(result.before), over_time(result.alignment.turns), turns)
    for path in (*folder.glob("calibration_*.png"), *folder.glob("capture_*_calibrated.png")):
        Image.open(path).convert("RGB").quantize(64).save(path, optimize=True)


def refused(seed: int) -> Iterator[Row | Target]:
    """Yield what must not be believed."""
    yield from _refusal("one turn of the head", still_places("perfect", seconds=0.24, seed=seed))
    yield from _refusal("sensor that moved", _moved())
    strong = _unit(replace(INJECTED, precession=(0.6 * DEG, 0.0)))
    yield from _refusal(
        "mount that rocks by 0.6 deg", still_places(strong, seconds=SECONDS, poses=("tilted",))
    )
    noisy = ImuNoise(gyro_line=0.2)
    places = still_places("perfect", seconds=SECONDS, poses=("tilted",), imu=noisy)
    yield from _refusal("gyro line that is no motion", places)


def poor_places(seed: int) -> Iterator[Row | Target]:
    """Yield what is found where there is little to see."""
    for world in ("yard", "corridor"):
        one = still_places(
            _unit(INJECTED), seconds=SECONDS, world=world, poses=("upright",), seed=seed
        )
        result = calibrate(one)
        yield _row(f"{world}, one place", seed, result, INJECTED)
        is_unknown = result.estimates["bias"].verdict is Verdict.UNKNOWN
        yield at_least(f"{world}: range bias is refused", int(is_unknown), 1)


def rocking(seed: int) -> Iterator[Row | Target]:
    """Yield what a mount that rocks by 0.3 degrees leaves in alpha and beta."""
    errors = UnitErrors(precession=(0.3 * DEG, -0.1 * DEG), precession_back=(0.05 * DEG, 0.0))
    result = calibrate(still_places(_unit(errors), seconds=SECONDS, seed=seed), keep_alpha=True)
    yield _row("rocking 0.3 deg", seed, result, UnitErrors())
    off = max(abs(result.estimates[name].value) for name in ("alpha", "beta")) / DEG
    yield at_most("rocking of 0.3 deg left in alpha or beta, deg", off, 0.03)


def _refusal(name: str, places: list[Place]) -> Iterator[Row | Target]:
    """Yield whether places are refused."""
    try:
        result = calibrate(places)
        yield _row(f"refuse: {name}", 0, result, None)
        is_refused = bool(result.refusals)
    except CalibrationError as error:
        yield {**_empty(f"refuse: {name}", 0), "refused": str(error)}
        is_refused = True
    yield at_least(f"refused: {name}", int(is_refused), 1)


def _moved() -> list[Place]:
    """Return a place whose second half was measured 2 degrees turned."""
    made = still_places("perfect", seconds=SECONDS, poses=("tilted",))[0]
    returns = made.returns.copy()
    returns["theta"][len(returns) // 2 :] += 2.0 * DEG
    return [replace(made, returns=returns)]


def real(seed: int) -> Iterator[Row | Target]:
    """Yield what is found in captures of a real unit."""
    places = _real_places()
    for place, most in zip(places, (21.0, 18.0), strict=False):
        result = calibrate([place])
        yield _row(place.name, seed, result, None)
        yield at_least(f"{place.name}: xi - 0.7 beta, deg", result.side / DEG, 0.34)
        yield at_most(f"{place.name}: xi - 0.7 beta, deg", result.side / DEG, 0.42)
        yield at_most(
            f"{place.name}: thickness afterwards, mm", 1e3 * result.after.thickness, most
        )
        bias = result.estimates["bias"].verdict is Verdict.UNKNOWN
        yield at_least(f"{place.name}: range bias is refused", int(bias), 1)
        for half in (0, 1):
            part = _half(place, half)
            yield _row(part.name, seed, calibrate([part]), None)
    if len(places) > 1:
        result = calibrate(places)
        yield _row("both captures", seed, result, None)
        for name in ("xi", "beta"):
            values = [getattr(item, name) / DEG for item in result.places]
            yield at_most(f"captures: {name} differs by, deg", abs(values[0] - values[1]), 0.06)
        is_shown = result.estimates["alpha"].verdict is Verdict.SHOWN
        yield at_least("captures: alpha is reported as not repeatable", int(is_shown), 1)


def _real_places() -> list[Place]:
    """Return the captures that are at hand; none where there are none."""
    if not calibration_units.REAL_FOLDER.exists():
        return []
    return [
        calibration_units.place(calibration_units.REAL_FOLDER / f"{name}.npy", number)
        for number, name in enumerate(calibration_units.CAPTURES)
    ]


def _half(place: Place, half: int) -> Place:
    """Return the first or second half of a place: what a shorter recording would say."""
    middle = int(np.median(place.returns["packet"]))
    late = place.returns["packet"] > middle
    returns = place.returns[late if half else ~late].copy()
    returns["packet"] -= returns["packet"].min()
    name = f"{place.name}, {'second' if half else 'first'} half"
    return replace(place, name=name, returns=returns, turns=place.turns / 2, gyro=place.gyro[:0])


def odometry(seed: int) -> Iterator[Row | Target]:
    """Yield what the odometry is off on a typical unit, before and after its calibration."""
    for scene, motion in RUNS:
        wanted = tuple((CUTS[0], name) for name in METHODS)
        found = bench_odometry.carry_out(Task(scene, motion, seed, _RUN_S, wanted))
        ates = {row["method"]: 1e3 * row["ate_m"] for row in found}
        words = ", ".join(f"{name} {value:.1f}" for name, value in ates.items())
        yield {
            **_empty(f"odometry: {scene}, {motion}", seed),
            **ates,
            "corrected": f"ATE, mm: {words}",
        }


def odometry_targets(rows: list[Row]) -> Iterator[Target]:
    """Yield what all runs of the odometry together say."""
    for scene, motion in RUNS:
        mine = [row for row in rows if row["case"] == f"odometry: {scene}, {motion}"]
        if mine:
            perfect, _, calibrated = (np.median([row[name] for row in mine]) for name in METHODS)
            name = f"odometry, {scene}, {motion}: ATE calibrated over perfect, medians"
            yield at_most(name, float(calibrated / perfect), 1.5)


def imu(seed: int) -> Iterator[Row | Target]:
    """Yield what turning a unit of the population tells about its IMU, its beams calibrated."""
    errors = drawn(seed + 1)
    name = str(seed + 1)
    places = still_places(name, seconds=SECONDS, seed=seed + 1)
    beams = report.calibration_of(calibrate(places, keep_alpha=True), places, "")
    run = odometry_runs.record("room", "shake", seed, _TURNING_S, unit=name, calibration=beams)
    result = imu_calibration.calibrate(
        list(odometry_runs.sweeps(run, "turn")), run.imu, beams_calibrated=True
    )
    turn, mixing = polar(
        errors.gyro_matrix() @ rotations.matrices(errors.imu_quaternion()).T, side="left"
    )
    true = np.concatenate((
        rotations.log(rotations.from_matrix(turn.T)),
        np.diag(mixing) - 1.0,
        [mixing[0, 1], mixing[0, 2], mixing[1, 2]],
        np.zeros(3),
        [errors.imu_time_offset],
    ))  # fmt: skip
    told = []
    covered = True
    for number, (name, item) in enumerate(result.estimates.items()):
        about = imu_calibration.IMU_PARAMETERS[number]
        if name.startswith("bias") or item.verdict is Verdict.UNKNOWN:
            continue
        off = item.value - float(true[number])
        covered &= abs(off) <= 3.0 * item.sd
        told.append(
            f"{name} {off * about.factor:+.3f} +- {item.sd * about.factor:.3f} {about.unit}"
        )
    yield {
        **_empty("imu", seed + 1),
        "corrected": "; ".join(told),
        "refused": result.refusals[0].reason if result.refusals else "",
    }
    yield at_least(f"imu of unit {seed + 1}: all within 3 stated deviations", int(covered), 1)


CASES: Final[dict[str, Callable[[int], Iterator[Row | Target]]]] = {
    "real": real,
    "injected": injected,
    "refused": refused,
    "poor_places": poor_places,
    "rocking": rocking,
    "odometry": odometry,
    "imu": imu,
    "perfect": perfect,
    "population": population,
}
POPULATIONS: Final = {"perfect": 20, "population": 20, "imu": 3, "odometry": 3}
"""Cases of many units or runs, and how many of them at the most."""


def _unit(errors: UnitErrors) -> Unit:
    return replace(UNITS["a"], name="made", errors=errors)


def _row(name: str, seed: int, result: StillResult, truth: UnitErrors | None) -> Row:
    row = _empty(name, seed)
    for key, item in result.estimates.items():
        if item.verdict is Verdict.UNKNOWN:
            continue
        true = 0.0
        if truth is not None:
            true = getattr(truth, "range_bias" if key == "bias" else key)
        row[key] = round((item.value - true) * _FACTORS[key], 4)
        row[f"{key} sd"] = round(item.sd * _FACTORS[key], 4)
    before, after = report.quality_mm(result.before), report.quality_mm(result.after)
    row |= {
        "side": round(result.side / DEG, 4),
        "thick before": before["thickness_median"],
        "thick after": after["thickness_median"],
        "gap before": before["gap_median"],
        "gap after": after["gap_median"],
        "corrected": " ".join(result.stored),
        "refused": result.refusals[0].reason if result.refusals else "",
    }
    return row


def _empty(name: str, seed: int) -> Row:
    parts = [part for key in _FACTORS for part in (key, f"{key} sd")]
    others = ("side", "thick before", "thick after", "gap before", "gap after", "corrected",
              "refused")  # fmt: skip
    return {"case": name, "seed": seed, **dict.fromkeys([*parts, *others], "")}


PAGE: Final = Path("docs") / "results" / "calibration.md"
ODOMETRY: Final = Path("docs") / "odometry.md"
_HEAD: Final = """# Calibration of units

Written by `make bench-calibration BENCH_ARGS="--page"`; [calibration](../calibration.md)
explains the parameters. For virtual units the tables show the remaining error, estimate minus
truth; for real units the estimate. The figure after +- is the stated deviation. Thickness is the
median over flat patches, gap the distance of the two halves of a turn on them.
"""


def write(rows: list[Row], targets: list[Target]) -> Path:
    """Write the page; return its path."""
    parts = [
        _HEAD,
        "## Targets",
        verdicts(targets),
        "## Beams",
        table(rows),
        *_words(rows, "imu", "IMU: remaining error, and its deviation"),
        "[Odometry](../odometry.md#units-that-are-not-perfect) and "
        "[deskew](../deskew.md#what-it-achieves) show how much they gain from calibration.",
        measured_on(),
    ]
    PAGE.parent.mkdir(parents=True, exist_ok=True)
    PAGE.write_text("\n\n".join(part.strip("\n") for part in parts) + "\n", encoding="utf-8")
    return PAGE


def write_odometry(rows: Iterable[Row], methods: Sequence[str]) -> None:
    """Replace the table of units in the page of the odometry.

    Parameters
    ----------
    rows : iterable of dict
        ATE [mm] of each run by method.
    methods : sequence of str
    """
    runs: dict[str, list[Row]] = {}
    for row in rows:
        if row["case"].startswith("odometry: "):
            runs.setdefault(row["case"].removeprefix("odometry: "), []).append(row)
    if not runs:
        return
    lines = [f"| ATE, median / largest [mm] | {' | '.join(methods)} | runs |"]
    lines.append("|---|" + "---|" * (len(methods) + 1))
    for name, mine in runs.items():
        cells = [
            f"{statistics.median(row[key] for row in mine):.1f} / "
            f"{max(row[key] for row in mine):.1f}"
            for key in methods
        ]
        lines.append(f"| {name} | {' | '.join(cells)} | {len(mine)} |")
    text = ODOMETRY.read_text(encoding="utf-8")
    ODOMETRY.write_text(replaced(text, "units", "\n".join(lines)), encoding="utf-8")


def _words(rows: Iterable[Row], kind: str, title: str) -> list[str]:
    """Return a section of what is told in words."""
    lines = [
        f"- {row['case']}, seed {row['seed']}: {row['refused'] or row['corrected']}"
        for row in rows
        if row["case"].startswith(kind)
    ]
    return [f"## {title}", "\n".join(lines)] if lines else []


def table(rows: Iterable[Row]) -> str:
    """Return the table of what was found about beams."""
    lines = [
        "| Case | Seed | xi [deg] | beta [deg] | alpha [deg] | b [mm] | bias [mm] | "
        "Thickness [mm] | Gap [mm] | Corrected, or why not |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        if row["case"].startswith(("imu", "odometry")):
            continue
        figures = [_figure(row, name) for name in ("xi", "beta", "alpha", "b", "bias")]
        cells = [
            row["case"],
            str(row["seed"]),
            *figures,
            _pair(row, "thick"),
            _pair(row, "gap"),
            f"refused: {row['refused']}" if row["refused"] else row["corrected"] or "nothing",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _figure(row: Row, name: str) -> str:
    if row[name] == "":
        return "not known"
    digits = 3 if name in ("xi", "beta", "alpha") else 2 if name == "b" else 1
    return f"{row[name]:+.{digits}f} +- {row[f'{name} sd']:.{digits}f}"


def _pair(row: Row, name: str) -> str:
    if row[f"{name} before"] == "":
        return ""
    return f"{row[f'{name} before']:.1f} to {row[f'{name} after']:.1f}"


if __name__ == "__main__":
    sys.exit(main())
