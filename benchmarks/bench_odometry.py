"""Measures odometries against the virtual L2's truth: ATE, RPE and speed; ``make bench-odometry``.

The referees (RKO-LIO, GenZ-LIO, CT-ICP, LIO-SAM) run where ``--install-referees`` has put them
into an environment of their own below ``out/``; without it they are left out. Every row is kept
in ``out/bench/odometry.jsonl`` as soon as it is there: ``--resume`` goes on where a run was cut.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import calibration_units, odometry_methods as methods
from benchmarks.odometry_methods import Plan, Rows, Task
from benchmarks.results import Target, at_least, at_most, measured_on, publish, verdicts
from tests.support.odometry_runs import CUTS, Run, count, record, truth

SCENES = ("room", "yard", "corridor", "box")
MOTIONS = ("walk", "trot", "drone")
LOCAL = (
    methods.OURS,
    methods.TYPICAL,
    methods.CALIBRATED,
    methods.PLAIN,
    methods.DESKEWED,
)
DIVERGED_M = 1.0
RPE_M = 1.0
FEWEST = 0.7  # poses for each sweep: with fewer it is lost

Row = dict[str, Any]


def score(run: Run, found: methods.Found) -> tuple[float, float, float]:
    """Return ATE after an SE(3) alignment, the largest error, RPE over a meter, all [m]."""
    from evo.core.metrics import APE, RPE, PoseRelation, Unit
    from evo.core.trajectory import PoseTrajectory3D

    positions, quaternions = truth(run, found.stamps)
    seconds = (found.stamps - found.stamps[0]) * 1e-9
    reference = PoseTrajectory3D(positions, quaternions, seconds)
    estimate = PoseTrajectory3D(poses_se3=list(found.poses), timestamps=seconds)
    estimate.align(reference)
    ape = APE(PoseRelation.translation_part)
    ape.process_data((reference, estimate))
    rpe = RPE(PoseRelation.translation_part, RPE_M, Unit.meters, all_pairs=True)
    try:
        rpe.process_data((reference, estimate))
        relative = float(np.sqrt(np.mean(rpe.error**2)))
    except Exception:  # evo has an exception of its own for a way under a meter
        relative = float("nan")
    return float(np.sqrt(np.mean(ape.error**2))), float(ape.error.max()), relative


def measure(run: Run, scene: str, motion: str, seed: int, cut: str, name: str) -> Row:
    """Return the row of one run."""
    row: Row = {
        "scene": scene,
        "motion": motion,
        "sweeps": cut,
        "seed": seed,
        "seconds": run.seconds,
        "method": name,
    }
    try:
        found = methods.run_method(name, run, cut)
    except Exception:  # counts as lost, and must not end the measurement
        traceback.print_exc()
        found = None
    if found is None or len(found.stamps) < FEWEST * count(run, cut):
        lost = float("inf")
        return {**row, "ate_m": lost, "max_m": lost, "rpe_m": lost, "real_time_factor": 0.0}
    ate, largest, relative = score(run, found)
    return {
        **row,
        "ate_m": ate,
        "max_m": largest,
        "rpe_m": relative,
        "real_time_factor": run.seconds / found.seconds,
    }


def ates(rows: list[Row], method: str, **only: str) -> NDArray[np.float64]:
    """Return the ATEs of a method's runs [m]."""
    return np.array(
        [
            row["ate_m"]
            for row in rows
            if row["method"] == method and all(row[key] == value for key, value in only.items())
        ]
    )


def targets(rows: list[Row]) -> Iterator[Target]:
    """Yield the targets that these rows can tell about."""
    ours = ates(rows, methods.OURS)
    for scene in ("room", "yard"):
        here = ates(rows, methods.OURS, scene=scene)
        if len(here):
            yield at_most(f"median ATE in the {scene}, m", float(np.median(here)), 0.015)
    yield at_most("largest ATE of any run, m", float(ours.max()), 0.05)
    yield at_most("runs that diverge", float((ours > DIVERGED_M).sum()), 0.0)
    for name, share in (("genz_lio", 1.0), ("ct_icp", 1.0), ("rko_lio", 0.5)):
        theirs = ates(rows, name)
        if len(theirs):
            pairs = [r for r in rows if r["method"] == name]
            same = [
                row["ate_m"]
                for row in rows
                if row["method"] == methods.OURS and any(_same(row, other) for other in pairs)
            ]
            bound = share * float(np.median(theirs))
            yield at_most(
                f"median ATE against {share:g} x {name}, m", float(np.median(same)), bound
            )
    for scene in SCENES:
        here = ates(rows, "lio_sam", scene=scene, sweeps=CUTS[0])
        if len(here):
            name = f"median ATE of lio_sam in the {scene}, velodyne profile, full turns, m"
            yield at_most(name, float(np.median(here)), 0.1)
    for scene in SCENES:
        calibrated = ates(rows, methods.CALIBRATED, scene=scene)
        perfect = ates(rows, methods.OURS, scene=scene)
        if len(calibrated) and len(perfect):
            value = float(np.median(calibrated) / np.median(perfect))
            yield at_most(f"{scene}: calibrated unit over perfect one, median ATE", value, 1.5)
    turns = [
        row["real_time_factor"]
        for row in rows
        if row["method"] == methods.OURS and row["sweeps"] == CUTS[0]
    ]
    if turns:
        yield at_least("real-time factor, full turns, median", float(np.median(turns)), 5.0)


def _same(row: Row, other: Row) -> bool:
    return all(row[key] == other[key] for key in ("scene", "motion", "sweeps", "seed"))


def carry_out(task: Task) -> Iterator[Row]:
    """Yield the rows of one task: one recording, several methods."""
    recorded: dict[str, Run] = {}
    for cut, name in task.wanted:
        kind = name if name in (methods.TYPICAL, methods.CALIBRATED) else methods.OURS
        if kind not in recorded:
            recorded[kind] = _recorded(task, kind)
        yield measure(recorded[kind], task.scene, task.motion, task.seed, cut, name)


def _recorded(task: Task, kind: str) -> Run:
    """Return what a perfect unit measures, or a typical one before and after its calibration."""
    if kind == methods.OURS:
        return record(task.scene, task.motion, task.seed, task.seconds)
    file = calibration_units.calibrated() if kind == methods.CALIBRATED else None
    return calibration_units.recorded(
        task.scene, task.motion, task.seed, task.seconds, calibration_units.TYPICAL, file
    )


def _work(given: tuple[Task, Rows, float]) -> int:
    """Carry a task out, in a process of its own; return the number of runs left out."""
    task, rows, until = given
    left = len(task.wanted)
    if time.monotonic() < until:
        for row in carry_out(task):
            rows.append(row)
            left -= 1
            if time.monotonic() > until:
                break
    return left


def main(arguments: list[str] | None = None) -> int:
    """Run from a command line; return 0 when all targets are met."""
    parser = argparse.ArgumentParser(prog="bench_odometry", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="full turns, one seed, 20 s")
    parser.add_argument("--seconds", type=float, default=30.0, help="length of a recording")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    parser.add_argument("--motions", nargs="+", default=MOTIONS)
    parser.add_argument("--sweeps", nargs="+", default=CUTS, choices=CUTS)
    parser.add_argument("--methods", nargs="+", default=(*LOCAL, *methods.REFEREES))
    parser.add_argument("--referee-seeds", type=int, default=5, help="seeds that referees get")
    parser.add_argument(
        "--slow-seeds",
        type=int,
        default=1,
        help="seeds that CT-ICP and LIO-SAM get with other sweeps than turns",
    )
    parser.add_argument("--jobs", type=int, default=1, help="recordings at a time")
    parser.add_argument("--minutes", type=float, default=1e6, help="begin no run after that")
    parser.add_argument("--resume", action="store_true", help="keep the rows that there are")
    parser.add_argument("--install-referees", action="store_true")
    parser.add_argument("--page", action="store_true", help="write table and plot into docs/")
    given = parser.parse_args(arguments)
    if given.quick:
        given.seconds, given.seeds, given.sweeps = 20.0, 1, CUTS[:1]
    if given.install_referees:
        methods.install_referees()
    plan = Plan(
        scenes=tuple(given.scenes),
        motions=tuple(given.motions),
        seeds=given.seeds,
        seconds=given.seconds,
        sweeps=tuple(given.sweeps),
        methods=tuple(given.methods),
        referee_seeds=given.referee_seeds if methods.referee_python() is not None else 0,
        slow_seeds=given.slow_seeds,
    )
    kept = Rows()
    if not given.resume:
        kept.clear()
    tasks = plan.tasks(kept.read())
    until = time.monotonic() + 60.0 * given.minutes
    orders = [(task, kept, until) for task in tasks]
    if given.jobs > 1:
        with multiprocessing.get_context("fork").Pool(given.jobs, maxtasksperchild=4) as pool:
            left = sum(pool.imap(_work, orders))
    else:
        left = sum(map(_work, orders))
    rows = [row for row in kept.read() if plan.has(row)]
    if left:
        print(f"{left} runs were left out for lack of time", file=sys.stderr)
    reached = list(targets(rows))
    publish("odometry", "Odometry against the virtual L2's truth", rows, reached)
    if given.page:
        write(rows, reached)
    return 0 if all(target.met for target in reached) else 1


PAGE = Path("docs") / "odometry.md"
PLOT = Path("docs") / "odometry.png"
BEGIN, END = "<!-- measured -->", "<!-- end of measured -->"


def write(rows: list[Row], targets: list[Target]) -> None:
    """Replace the measured part of the page and draw the plot."""
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    body = "\n\n".join((_table(rows), verdicts(targets), measured_on()))
    PAGE.write_text(f"{before}{BEGIN}\n{body}\n{END}{after}", encoding="utf-8")
    _draw(rows)


def _names(rows: list[Row]) -> list[str]:
    return list(dict.fromkeys(row["method"] for row in rows))


def _table(rows: list[Row]) -> str:
    scenes = list(dict.fromkeys((row["scene"], row["sweeps"]) for row in rows))
    names = _names(rows)
    lines = [
        "| ATE, median / largest of the runs [mm] | " + " | ".join(names) + " |",
        "|---|" + "---|" * len(names),
    ]
    for scene, sweeps in scenes:
        cells = []
        for name in names:
            found = [
                row["ate_m"]
                for row in rows
                if (row["scene"], row["sweeps"], row["method"]) == (scene, sweeps, name)
            ]
            cells.append(f"{_mm(np.median(found))} / {_mm(max(found))}" if found else "")
        lines.append(f"| {scene}, {sweeps} | " + " | ".join(cells) + " |")
    speed, drift, count = [], [], []
    for name in names:
        mine = [row for row in rows if row["method"] == name]
        speed.append(f"{np.median([row['real_time_factor'] for row in mine]):.0f}")
        drift.append(_mm(np.nanmedian([row["rpe_m"] for row in mine])))
        count.append(str(len(mine)))
    lines.append("| RPE over 1 m, median [mm] | " + " | ".join(drift) + " |")
    lines.append("| recording / processor time, median | " + " | ".join(speed) + " |")
    lines.append("| runs | " + " | ".join(count) + " |")
    return "\n".join(lines)


def _mm(meters: float) -> str:
    if not np.isfinite(meters):
        return "lost"
    return f"{1e3 * meters:.1f}" if meters < 0.1 else f"{1e3 * meters:.0f}"


def _draw(rows: list[Row]) -> None:
    """Draw the ATE of every run by method, on a logarithmic scale."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = _names(rows)
    figure = Figure(figsize=(7.0, 3.2), layout="constrained", dpi=90)
    axes = figure.add_subplot(yscale="log", ylabel="ATE [mm]")
    source = np.random.default_rng(0)
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    for scene in scenes:
        x, y = [], []
        for row in rows:
            if row["scene"] == scene and np.isfinite(row["ate_m"]):
                x.append(names.index(row["method"]) + source.uniform(-0.2, 0.2))
                y.append(1e3 * row["ate_m"])
        axes.scatter(x, y, s=12, label=scene)
    axes.axhline(15.0, color="0.6", lw=0.8, ls="--")
    axes.set_xticks(range(len(names)), names, rotation=15)
    axes.legend(fontsize=8)
    FigureCanvasAgg(figure)
    figure.savefig(PLOT)


if __name__ == "__main__":
    sys.exit(main())
