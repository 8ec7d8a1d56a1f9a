"""Measures how well still places calibrate a unit, and what that is worth to the odometry.

``make bench-calibration`` prints the table and writes ``out/bench/calibration.json``;
``BENCH_ARGS="--seeds 3"`` is a short run, ``--capture FILE`` adds a capture of a real unit (pcap,
or a cloud ``.npy`` with its table of packets), ``--docs`` draws the pictures of
``docs/calibration.md``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks import odometry_methods, real_l2
from benchmarks.bench_odometry import score
from benchmarks.results import Target, at_least, at_most, keep, publish
from l2lidar_node.calibration import picture, report
from l2lidar_node.calibration.file import CalibrationFile
from l2lidar_node.calibration.observation import Place
from l2lidar_node.calibration.result import StillResult, Verdict
from l2lidar_node.calibration.still import DEG, CalibrationError, calibrate
from l2lidar_node.cli.calibrate import capture_place
from l2lidar_node.cli.virtual_places import still_places
from l2lidar_node.emulator.unit.errors import UnitErrors, drawn
from l2lidar_node.emulator.unit.inertial import ImuNoise
from l2lidar_node.emulator.unit.units import UNITS, Unit
from tests.support import odometry_runs

Row = dict[str, Any]

INJECTED: Final = UnitErrors(xi=0.4 * DEG, beta=-0.3 * DEG, alpha=0.3 * DEG, range_bias=0.05)
BOUNDS: Final = {"xi": 0.02 * DEG, "beta": 0.02 * DEG, "alpha": 0.01 * DEG, "b": 0.5e-3,
                 "bias": 8e-3}  # fmt: skip
SECONDS: Final = 4.0
RUNS: Final = (("room", "walk"), ("corridor", "walk"), ("yard", "walk"))
_RUN_S: Final = 40.0
_FACTORS: Final = {name: factor for name, (_, factor) in report.UNITS.items()}


def main() -> None:
    """Measure everything that is asked for and write it down."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20, help="units of each population")
    parser.add_argument("--capture", type=Path, action="append", default=[], metavar="FILE")
    parser.add_argument("--no-odometry", action="store_true", help="leave the odometry out")
    parser.add_argument("--docs", action="store_true", help="draw docs/calibration_*.png")
    arguments = parser.parse_args()
    rows: list[Row] = []
    targets: list[Target] = []
    for part in (
        real(arguments.capture, arguments.docs),
        injected(arguments.docs),
        refused(),
        () if arguments.no_odometry else odometry(),
        perfect(arguments.seeds),
        population(arguments.seeds),
    ):
        for item in part:
            if isinstance(item, Target):
                targets.append(item)
            else:
                rows.append(item)
                keep("calibration", rows, targets)  # what is there counts if it is interrupted
                print({name: value for name, value in item.items() if value != ""}, flush=True)
    publish("calibration", "Calibration from still places: deg, mm", rows, targets)


def perfect(seeds: int) -> Iterator[Row | Target]:
    """Yield what is found on units that report the truth: nothing must be corrected."""
    worst = dict.fromkeys(BOUNDS, 0.0)
    stored = 0
    for seed in range(seeds):
        result = calibrate(still_places("perfect", seconds=SECONDS, seed=seed), keep_alpha=True)
        yield _row("perfect", seed, result, UnitErrors())
        stored += bool(result.stored)
        for name in worst:
            worst[name] = max(worst[name], abs(result.estimates[name].value))
    yield at_most("perfect units that get a correction", stored, 0)
    for name, value in worst.items():
        yield at_most(
            f"perfect units, worst |{name}|, {report.UNITS[name][0]}",
            value * _FACTORS[name],
            BOUNDS[name] * _FACTORS[name],
        )


def injected(docs: bool) -> Iterator[Row | Target]:
    """Yield what is recovered of large errors."""
    result = calibrate(still_places(_unit(INJECTED), seconds=SECONDS), keep_alpha=True)
    yield _row("injected", 0, result, INJECTED)
    for name, bound in BOUNDS.items():
        truth = getattr(INJECTED, "range_bias" if name == "bias" else name)
        off = abs(result.estimates[name].value - truth)
        unit, factor = report.UNITS[name]
        yield at_most(f"injected errors, {name} off by, {unit}", off * factor, bound * factor)
    yield at_most("injected errors, halves apart afterwards, mm", 1e3 * result.after.gap, 2.0)
    if docs:
        picture.save(result, Path("docs") / "calibration_room.png")


def population(seeds: int) -> Iterator[Row | Target]:
    """Yield what is found on a population of units with all their errors."""
    covered = dict.fromkeys(("xi", "beta", "alpha"), 0)
    refusals = 0
    gains = []
    for seed in range(1, seeds + 1):
        errors = drawn(seed).powered_up(seed, 0)
        result = calibrate(
            still_places(_unit(errors), seconds=SECONDS, seed=seed), keep_alpha=True
        )
        yield _row("population", seed, result, errors)
        refusals += bool(result.refusals)
        gains.append(result.after.thickness / result.before.thickness)
        for name in covered:
            item = result.estimates[name]
            covered[name] += abs(item.value - getattr(errors, name)) <= 3.0 * item.sd
    for name, count in covered.items():
        yield at_least(f"units whose {name} is within 3 stated deviations", count, seeds)
    yield at_most("units of the population that are refused", refusals, 0)
    yield at_most("thickness after over before, median", float(np.median(gains)), 0.95)


def refused() -> Iterator[Row | Target]:
    """Yield what must not be believed."""
    yield from _refusal("one turn of the head", still_places("perfect", seconds=0.24))
    yield from _refusal("sensor that moved", _moved())
    strong = _unit(replace(INJECTED, whirl=(0.6 * DEG, 0.0)))
    yield from _refusal(
        "mount that rocks by 0.6 deg", still_places(strong, seconds=SECONDS, poses=("tilted",))
    )
    noisy = ImuNoise(gyro_line=0.2)
    places = still_places("perfect", seconds=SECONDS, poses=("tilted",), imu=noisy)
    yield from _refusal("gyro line that is no motion", places)
    for world in ("yard", "corridor"):
        one = still_places(_unit(INJECTED), seconds=SECONDS, world=world, poses=("upright",))
        result = calibrate(one)
        yield _row(f"{world}, one place", 0, result, INJECTED)
        is_unknown = result.estimates["bias"].verdict is Verdict.UNKNOWN
        yield at_least(f"{world}: range bias is refused", int(is_unknown), 1)
    rocking = UnitErrors(whirl=(0.3 * DEG, -0.1 * DEG), whirl_back=(0.05 * DEG, 0.0))
    result = calibrate(still_places(_unit(rocking), seconds=SECONDS), keep_alpha=True)
    yield _row("rocking 0.3 deg", 0, result, rocking)
    off = max(abs(result.estimates[name].value) for name in ("alpha", "beta")) / DEG
    yield at_most("rocking of 0.3 deg left in alpha or beta, deg", off, 0.03)


def _refusal(name: str, places: list[Place]) -> Iterator[Row | Target]:
    """Yield whether places are refused."""
    try:
        result = calibrate(places)
        yield _row(f"refuse: {name}", 0, result, None)
        is_refused = bool(result.refusals)
    except CalibrationError as error:
        yield {**_empty(f"refuse: {name}", 0), "words": str(error)}
        is_refused = True
    yield at_least(f"refused: {name}", int(is_refused), 1)


def _moved() -> list[Place]:
    """Return a place whose second half was measured 2 degrees turned."""
    made = still_places("perfect", seconds=SECONDS, poses=("tilted",))[0]
    returns = made.returns.copy()
    returns["theta"][len(returns) // 2 :] += 2.0 * DEG
    return [replace(made, returns=returns)]


def real(captures: list[Path], docs: bool) -> Iterator[Row | Target]:
    """Yield what is found in captures of real units."""
    places: list[Place] = []
    if real_l2.FOLDER.exists():
        places = [
            real_l2.place(real_l2.FOLDER / f"{name}.npy", number)
            for number, name in enumerate(real_l2.CAPTURES)
        ]
    for place, most in zip(places, (21.0, 18.0), strict=False):
        result = calibrate([place])
        yield _row(place.name, 0, result, None)
        yield at_least(f"{place.name}: xi - 0.7 beta, deg", result.side / DEG, 0.34)
        yield at_most(f"{place.name}: xi - 0.7 beta, deg", result.side / DEG, 0.42)
        yield at_most(
            f"{place.name}: thickness afterwards, mm", 1e3 * result.after.thickness, most
        )
        bias = result.estimates["bias"].verdict is Verdict.UNKNOWN
        yield at_least(f"{place.name}: range bias is refused", int(bias), 1)
        if docs:
            picture.save(result, Path("docs") / f"{place.name}_calibrated.png")
    if len(places) > 1:
        result = calibrate(places)
        yield _row("both captures", 0, result, None)
        for name in ("xi", "beta"):
            values = [getattr(item, name) / DEG for item in result.places]
            yield at_most(f"captures: {name} differs by, deg", abs(values[0] - values[1]), 0.06)
        is_shown = result.estimates["alpha"].verdict is Verdict.SHOWN
        yield at_least("captures: alpha is reported as not repeatable", int(is_shown), 1)
    for path in captures:
        place = real_l2.place(path, 0) if path.suffix == ".npy" else capture_place(path)[0]
        result = calibrate([place])
        yield _row(path.name, 0, result, None)


def odometry() -> Iterator[Row | Target]:
    """Yield what the odometry is off on a typical unit, before and after its calibration."""
    made = _calibrated("typical")
    ratios = []
    for scene, motion in RUNS:
        runs = {
            "perfect": ("perfect", None),
            "typical": ("typical", None),
            "calibrated": ("typical", made),
        }
        ates = {}
        for name, (unit, calibration) in runs.items():
            run = odometry_runs.record(
                scene, motion, 0, _RUN_S, unit=unit, calibration=calibration
            )
            found = odometry_methods.run_method(odometry_methods.OURS, run, "turn")
            assert found is not None
            ates[name] = 1e3 * score(run, found)[0]
        words = ", ".join(f"{name} {value:.1f}" for name, value in ates.items())
        yield {**_empty(f"odometry: {scene} {motion}", 0), "words": f"ATE, mm: {words}"}
        ratios.append(ates["calibrated"] / ates["perfect"])
    yield at_most("odometry: ATE calibrated over perfect, median", float(np.median(ratios)), 1.5)


def _calibrated(unit: str) -> CalibrationFile:
    places = still_places(unit, seconds=SECONDS)
    return report.calibration_of(calibrate(places, keep_alpha=True), places, "")


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
    row["side"] = round(result.side / DEG, 4)
    before, after = report.quality_mm(result.before), report.quality_mm(result.after)
    row["thickness"] = f"{before['thickness_median']} to {after['thickness_median']}"
    row["gap"] = f"{before['gap_median']} to {after['gap_median']}"
    row["words"] = result.refusals[0].reason if result.refusals else ""
    return row


def _empty(name: str, seed: int) -> Row:
    columns = [part for key in _FACTORS for part in (key, f"{key} sd")]
    return {"case": name, "seed": seed, **dict.fromkeys([*columns, "side", "thickness", "gap",
                                                         "words"], "")}  # fmt: skip


if __name__ == "__main__":
    main()
