"""Judges odometries where they fail: narrow views, bare corridors, crowds; the hard benchmark.

``make bench-odometry-hard``. Every run has a scene, a way, a sensor and faults of its own, drawn
from a seed (:mod:`benchmarks.hard_scenarios`). Without options it is the short version: one run
of 30 s of each of 17 families; ``--full`` is the campaign of 200 runs of a minute. Seeds that the
estimator was not tuned on (:data:`TUNED`) tell what to expect elsewhere; they have a page of their
own. Recordings stay in ``out/recordings`` (14 GB a campaign), so a change of the estimator is
judged again without casting a ray; ``--fresh`` makes them anew. Every row is kept in
``out/bench/odometry_hard.jsonl`` as soon as it is there: ``--resume`` goes on where a campaign was
cut.
"""

from __future__ import annotations

import argparse
import multiprocessing
import shlex
import shutil
import sys
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks import hard_recordings as recordings, odometry_methods as methods
from benchmarks.hard_recordings import Recording, recording
from benchmarks.hard_scenarios import (
    DRAWN,
    FAMILIES,
    MIXED,
    SHORT,
    STARTS,
    Imperfections,
    scenario,
)
from benchmarks.hard_scores import Track, score
from benchmarks.odometry_methods import Rows
from benchmarks.results import FOLDER, Target, at_least, at_most, keep, measured_on, verdicts
from l2lidar_proc.motion.imu_buffer import replay
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.kiss import PlainOdometry
from l2lidar_proc.odometry.odometry import Odometry

OURS: Final = methods.OURS
REFEREES: Final = ("rko_lio", "genz_lio", "ct_icp")
KEY: Final = ("family", "seed", "seconds", "method")
FULL_RUNS: Final = 200
CONSISTENT: Final = (0.85, 0.99)  # share of poses within their 95 % bound
ATE_BOUNDS: Final = {"room, imperfect": 0.005, "hall, imperfect": 0.025, "wood, imperfect": 0.015}
HALL_SPEED: Final = 8.0
PAGE: Final = Path("docs") / "results" / "odometry_hard.md"
UNSEEN_PAGE: Final = PAGE.with_stem("odometry_hard_unseen")

Row = dict[str, Any]
Run = tuple[str, int]
"""Family and seed."""

ALL_OTHERS: Final = "all other families"
TUNED: Final[dict[str, tuple[range, ...]]] = {
    MIXED: (range(700, 790), range(804, 844)),
    STARTS: (range(632), range(1000, 1160), range(2000, 2140)),
    ALL_OTHERS: (
        range(66),
        range(100, 176),
        range(190, 206),
        range(222, 257),
        range(261, 310),
    ),
}
"""Seeds of each family that were looked at while the estimator was tuned; the others judge it."""


def is_tuned(family: str, seed: int) -> bool:
    """Return whether the estimator was tuned on a run."""
    return any(seed in seeds for seeds in TUNED.get(family, TUNED[ALL_OTHERS]))


def tuned_seeds() -> str:
    """Return in words which seeds the estimator was tuned on."""
    return "; ".join(
        f"{family}: {', '.join(f'{seeds[0]} to {seeds[-1]}' for seeds in spans)}"
        for family, spans in TUNED.items()
    )


def planned(families: tuple[str, ...], runs: int, first_seed: int = 0) -> list[Run]:
    """Return the runs of a campaign: every family once, then every family again, and so on."""
    return [(families[k % len(families)], first_seed + k // len(families)) for k in range(runs)]


def track_of(method: str, given: Recording) -> Track | None:
    """Return what a method makes of a recording, None where it gives up."""
    if method in REFEREES:
        found = methods.run_referee(method, given.path)
        return None if found is None else Track(found.stamps, found.poses, found.seconds)
    if method == methods.PLAIN:
        return _plain(given)
    return _ours(given)


def _ours(given: Recording) -> Track:
    odometry = Odometry(OdometryConfig(), given.T_cloud_imu)
    estimates = []
    methods.load_libraries()
    begin = time.process_time()
    for sweep, samples in replay(given.sweeps(), given.imu):
        odometry.imu(samples)
        estimates += odometry.register(sweep)
    seconds = time.process_time() - begin
    return Track(
        np.array([item.stamp for item in estimates], dtype=np.int64),
        np.array([item.T_map_lidar for item in estimates]).reshape(-1, 4, 4),
        seconds,
        np.array([item.covariance for item in estimates]),
        np.array([item.velocity for item in estimates]),
        np.array([item.twist_covariance[:3, :3] for item in estimates]),
        [tuple(status.name for status in item.status) for item in estimates],
    )


def _plain(given: Recording) -> Track:
    odometry = PlainOdometry(OdometryConfig(mode="plain"))
    methods.load_libraries()
    begin = time.process_time()
    estimates = [item for sweep in given.sweeps() for item in odometry.register(sweep)]
    seconds = time.process_time() - begin
    return Track(
        np.array([item.stamp for item in estimates], dtype=np.int64),
        np.array([item.T_map_lidar for item in estimates]).reshape(-1, 4, 4),
        seconds,
    )


def measure(run: Run, seconds: float, method: str, *, fresh: bool = False) -> Row:
    """Return the row of one method on one run."""
    family, seed = run
    given = recording(scenario(family, seed, seconds), fresh=fresh)
    try:
        track = track_of(method, given)
        figures = score(given, track)
        if track is not None and method == OURS:
            _keep_series(run, seconds, track)
    except Exception:  # counts as having given up, and must not end the campaign
        traceback.print_exc()
        figures = score(given, None)
    return {"family": family, "seed": seed, "seconds": seconds, "method": method, **figures}


def _keep_series(run: Run, seconds: float, track: Track) -> None:
    """Keep what ours said of every pose, for a look at how a run failed."""
    folder = FOLDER / "odometry_hard"
    folder.mkdir(parents=True, exist_ok=True)
    name = "".join(c if c.isalnum() else "_" for c in run[0])
    assert track.covariances is not None
    assert track.velocities is not None
    assert track.velocity_covariances is not None
    np.savez(
        folder / f"{name}-{run[1]}-{seconds:g}s.npz",
        stamps=track.stamps,
        poses=track.poses,
        covariances=track.covariances,
        velocities=track.velocities,
        velocity_covariances=track.velocity_covariances,
        status=np.array([" ".join(names) for names in track.status]),
    )


def targets(rows: list[Row]) -> Iterator[Target]:
    """Yield the targets that these rows can tell about."""
    ours = [row for row in rows if row["method"] == OURS]
    count = len(ours)
    for name, key in (
        ("end more than 1 % of the way (at least 0.3 m) off", "failed"),
        ("were LOST", "lost"),
        ("were wrong by more than 3 sigma (at least 0.1 m) without a status", "silent"),
    ):
        yield at_most(f"runs of {count} that {name}", float(sum(bool(r[key]) for r in ours)), 0.0)
    families = _families(ours)
    for key, what in (("nees_pose", "pose"), ("nees_velocity", "velocity")):
        shares = [
            _mean([row for row in ours if row["family"] == family], key) for family in families
        ]
        outside = [share for share in shares if not CONSISTENT[0] <= share <= CONSISTENT[1]]
        name = f"scenes of {len(families)} whose NEES of the {what} is in bounds outside 85-99 %"
        yield at_most(name, float(len(outside)), 0.0)
    for family, bound in ATE_BOUNDS.items():
        ates = [row["ate_m"] for row in ours if row["family"] == family]
        if ates:
            yield at_most(f"median ATE, {family}, m", float(np.median(ates)), bound)
    speeds = [row["real_time_factor"] for row in ours if row["family"].startswith("hall")]
    if speeds:
        name = "real-time factor in the large hall, median"
        yield at_least(name, float(np.median(speeds)), HALL_SPEED)
    for method in dict.fromkeys(row["method"] for row in rows if row["method"] != OURS):
        better = [name for name in families if not _ours_is_better(rows, name, method)]
        yield at_most(f"scenes where {method} is as good or better", float(len(better)), 0.0)
        failed = [row for row in rows if row["method"] == method and row["failed"]]
        yield at_least(f"runs that fail {method}", float(len(failed)), 1.0)


def _mean(rows: list[Row], key: str) -> float:
    return float(np.mean([row[key] for row in rows]))


def _ours_is_better(rows: list[Row], family: str, method: str) -> bool:
    """Return whether our median ATE over the runs that both did is the smaller one."""
    theirs = {
        row["seed"]: row["ate_m"]
        for row in rows
        if row["family"] == family and row["method"] == method
    }
    mine = [
        row["ate_m"]
        for row in rows
        if row["family"] == family and row["method"] == OURS and row["seed"] in theirs
    ]
    return not theirs or float(np.median(mine)) < float(np.median([*theirs.values()]))


def show(rows: list[Row], reached: list[Target]) -> None:
    """Print every row and every target."""
    for row in sorted(rows, key=lambda row: (row["method"], row["family"], row["seed"])):
        print(
            f"{row['method']:8} {row['family']:34} {row['seed']:2d}"
            f"  way {row['way_m']:5.1f} m  ATE {1e3 * row['ate_m']:7.0f} mm"
            f"  end {row['end_m']:7.3f} m ({100 * row['end_share']:5.2f} %)"
            f"  {'FAILED' if row['failed'] else 'ok    '}  x{row['real_time_factor']:4.1f}"
            + (
                f"  lost {row['lost']} silent {row['silent']:3d} sigmas {row['sigmas']:6.1f}"
                f"  NEES {100 * row['nees_pose']:3.0f} / {100 * row['nees_velocity']:3.0f} %"
                f"  {row['status']}"
                if row["method"] == OURS
                else ""
            )
        )
    for target in reached:
        mark = "met    " if target.met else "NOT MET"
        print(f"{mark} {target.name}: {target.value:.4g} (bound {target.bound:.4g})")


def _work(given: tuple[Run, tuple[str, ...], float, bool, Rows, float]) -> int:
    """Judge the methods on one run, in a process of its own; return how many were left out."""
    run, wanted, seconds, fresh, kept, until = given
    for number, method in enumerate(wanted):
        if time.monotonic() > until:
            return len(wanted) - number
        kept.append(measure(run, seconds, method, fresh=fresh and number == 0))
    return 0


def main(arguments: list[str] | None = None) -> int:
    """Run from a command line; return 0 when all targets are met."""
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(prog="bench_odometry_hard", description=__doc__)
    parser.add_argument("--full", action="store_true", help="200 runs of 60 s of all families")
    parser.add_argument("--runs", type=int, help="how many runs, over the families in turn")
    parser.add_argument("--seconds", type=float, help="length of a run")
    parser.add_argument(
        "--first-seed", type=int, default=0, help=f"seeds used for tuning: {tuned_seeds()}"
    )
    parser.add_argument("--families", nargs="+", help="those whose names contain one of these")
    parser.add_argument("--methods", nargs="+", default=(OURS, methods.PLAIN, *REFEREES))
    parser.add_argument(
        "--referee-runs", type=int, default=50, help="how many runs the others get as well"
    )
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time")
    parser.add_argument("--minutes", type=float, default=1e6, help="begin no run after that")
    parser.add_argument("--resume", action="store_true", help="keep the rows that there are")
    parser.add_argument("--fresh", action="store_true", help="make the recordings anew")
    parser.add_argument("--install-referees", action="store_true")
    parser.add_argument(
        "--page",
        action="store_true",
        help=f"write {PAGE}, or {UNSEEN_PAGE} of seeds that were not used for tuning",
    )
    given = parser.parse_args(arguments)
    if given.install_referees:
        methods.install_referees()
    families = tuple(FAMILIES if given.full else SHORT)
    if given.families:
        known = (*FAMILIES, *DRAWN)
        families = tuple(name for name in known if any(part in name for part in given.families))
        if not families:
            parser.error(f"--families: none of {', '.join(known)}")
    seconds = given.seconds or (60.0 if given.full else 30.0)
    runs = planned(
        families, given.runs or (FULL_RUNS if given.full else len(families)), given.first_seed
    )
    missing = recordings.missing_bytes(scenario(*run, seconds) for run in runs)
    recordings.FOLDER.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(recordings.FOLDER).free
    if free < missing:
        parser.error(
            f"the recordings of {len(runs)} runs of {seconds:g} s need {missing / 1e9:.1f} GB more"
            f" below {recordings.FOLDER}, where {free / 1e9:.1f} GB are free: remove what is there"
            " of other seeds, or ask for fewer with --runs"
        )
    kept = Rows(Path(FOLDER) / "odometry_hard.jsonl", KEY)
    if not given.resume:
        kept.clear()
    done = {tuple(row[name] for name in KEY) for row in kept.read()}
    there = [
        name
        for name in given.methods
        if name not in REFEREES or methods.referee_python() is not None
    ]
    until = time.monotonic() + 60.0 * given.minutes
    orders = []
    for ours in (True, False):  # ours first: whenever it is cut, what is there can be used
        for number, run in enumerate(runs):
            wanted = tuple(
                name
                for name in there
                if (name == OURS) == ours
                and (ours or number < given.referee_runs)
                and (*run, seconds, name) not in done
            )
            if wanted:
                orders.append((run, wanted, seconds, given.fresh and ours, kept, until))
    if given.jobs > 1:
        with multiprocessing.get_context("fork").Pool(given.jobs, maxtasksperchild=4) as pool:
            left = sum(pool.imap(_work, orders))
    else:
        left = sum(map(_work, orders))
    asked = set(runs)
    rows = [
        row
        for row in kept.read()
        if (row["family"], row["seed"]) in asked
        and row["seconds"] == seconds
        and row["method"] in given.methods
    ]
    if left:
        print(f"{left} runs were left out for lack of time", file=sys.stderr)
    reached = list(targets(rows))
    show(rows, reached)
    path = keep("odometry_hard", rows, reached)
    print(f"written to {path}")
    if given.page:
        write(rows, reached, arguments)
    return 0 if all(target.met for target in reached) else 1


_HEAD: Final = """# Hard runs of the odometry

Written by `make bench-odometry-hard BENCH_ARGS="{arguments}"`; [odometry](../odometry.md)
explains the estimator, and `benchmarks/hard_scenarios.py` the scenes. A run *failed* if its last
pose is off by more than 1 % of the distance and more than 0.3 m. It was *silent* if a pose
without any status was off by more than 3 sigma and 0.1 m. NEES is the share of poses (position
and attitude, 6) and of velocities (3) whose normalized squared error is within the bound that 95
% should keep, and its mean per dimension, which should be 1. What a unit is wrong by, as the
angles of its beams, lasts for a whole run: there the share is all or nothing, and the mean says
more. ATE is after an SE(3) alignment; ends and NEES are relative to the first pose. A unit called
*imperfect* has beam angles 0.4 degrees off, ranges 0.2 % off, an IMU rotated by 0.5 degrees and 2
ms late, vibration, lost packets and gaps in its IMU samples. A *drawn unit* is one of the virtual
L2's population, which is off in alpha, the range bias, the head's wave and the
scale of the gyro as well.
"""


def write(rows: list[Row], targets: list[Target], arguments: list[str]) -> Path:
    """Write the page, or that of the seeds that were not used for tuning; return its path.

    Parameters
    ----------
    rows : list of Row
    targets : list of Target
    arguments : list of str
        Those of the command line that made the rows.
    """
    path = UNSEEN_PAGE if _are_unseen(rows) else PAGE
    parts = [
        _HEAD.format(arguments=shlex.join(arguments)),
        _setting(rows),
        _accuracy(rows),
        _consistency(rows),
        "## Targets",
        verdicts(targets),
        _limits(rows),
        _failures(rows),
        measured_on(),
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    text = "\n\n".join(part.strip("\n") for part in parts if part)
    path.write_text(text + "\n", encoding="utf-8")
    return path


def _are_unseen(rows: list[Row]) -> bool:
    return not any(is_tuned(row["family"], row["seed"]) for row in rows)


def _setting(rows: list[Row]) -> str:
    ours = [row for row in rows if row["method"] == OURS]
    lengths = sorted({row["seconds"] for row in ours})
    spans = " and ".join(f"{length:g} s" for length in lengths)
    seeds = sorted({row["seed"] for row in ours})
    use = "which were not used for tuning" if _are_unseen(rows) else "some used for tuning"
    others = " The other methods ran on the number of recordings in their column."
    return (
        f"{len(ours)} runs of {spans}, {sum(row['way_m'] for row in ours):.0f} m in all, seeds "
        f"{seeds[0]} to {seeds[-1]}, {use}." + others * (len(ours) < len(rows))
    )


def _accuracy(rows: list[Row]) -> str:
    there = {row["method"] for row in rows}
    names = [name for name in (OURS, methods.PLAIN, *REFEREES) if name in there]
    lines = [
        "## Accuracy",
        "",
        "Median ATE [mm], and how many of the runs failed.",
        "",
        "| Scene | " + " | ".join(names) + " |",
        "|---|" + "---|" * len(names),
    ]
    for family in _families(rows):
        cells = [_cell([r for r in rows if (r["family"], r["method"]) == (family, n)])
                 for n in names]  # fmt: skip
        lines.append(f"| {family} | " + " | ".join(cells) + " |")
    totals, speeds = [], []
    for name in names:
        mine = [row for row in rows if row["method"] == name]
        totals.append(f"{sum(row['failed'] for row in mine)} of {len(mine)} failed")
        speeds.append(f"{np.median([row['real_time_factor'] for row in mine]):.0f}")
    lines.append("| **all** | " + " | ".join(totals) + " |")
    lines.append("| recording / processor time, median | " + " | ".join(speeds) + " |")
    return "\n".join(lines)


def _cell(found: list[Row]) -> str:
    if not found:
        return ""
    ate = float(np.median([row["ate_m"] for row in found]))
    words = "gave up" if not np.isfinite(ate) else f"{1e3 * ate:.0f}"
    failed = sum(bool(row["failed"]) for row in found)
    return f"{words}, {failed} of {len(found)}" if failed else words


def _consistency(rows: list[Row]) -> str:
    lines = [
        "## What ours reports",
        "",
        "| Scene | end off, median / largest [m] | lost | silent | largest error / sigma "
        "without a status | NEES pose: in bounds, mean | NEES velocity: in bounds, mean |",
        "|---|---|---|---|---|---|---|",
    ]
    for family in _families(rows):
        found = [r for r in rows if r["family"] == family and r["method"] == OURS]
        if not found:
            continue
        ends = [row["end_m"] for row in found]
        nees = [
            f"{100.0 * _mean(found, f'nees_{what}'):.0f} %, "
            f"{_mean(found, f'mean_nees_{what}'):.2f}"
            for what in ("pose", "velocity")
        ]
        lines.append(
            f"| {family} | {np.median(ends):.3f} / {max(ends):.3f}"
            f" | {sum(bool(row['lost']) for row in found)}"
            f" | {sum(bool(row['silent']) for row in found)}"
            f" | {max(row['sigmas'] for row in found):.1f}"
            f" | {' | '.join(nees)} |"
        )
    return "\n".join(lines)


def _limits(rows: list[Row]) -> str:
    """Tell what of the bounded errors is the scale of the ranges, which nothing shows."""
    parts = []
    for family in ATE_BOUNDS:
        alone = [r["scale_ate_m"] for r in rows if (r["family"], r["method"]) == (family, OURS)]
        if alone:
            parts.append(f"{1e3 * float(np.median(alone)):.1f} mm in {family.split(',')[0]}")
    if not parts:
        return ""
    share = 100.0 * Imperfections().range_scale
    return (
        f"Nothing that a unit measures shows the scale of its ranges. Off by {share:.1f} %, it "
        f"makes an ATE by itself: {', '.join(parts)}."
    )


def _failures(rows: list[Row]) -> str:
    found = [r for r in rows if r["method"] == OURS and (r["failed"] or r["lost"] or r["silent"])]
    if not found:
        return "## Runs that failed\n\nNone."
    found.sort(key=lambda row: (-row["failed"], -row["end_share"]))
    lines = [
        "## Runs that failed",
        "",
        "Ours, worst first, with the status of their sweeps in order.",
        "",
        "| Scene, seed | way [m] | end off [m] | largest [m] | silent poses | status |",
        "|---|---|---|---|---|---|",
    ]
    for row in found:
        lines.append(
            f"| {row['family']}, {row['seed']} | {row['way_m']:.0f} | {row['end_m']:.2f}"
            f" | {row['max_m']:.2f} | {row['silent']} | {row['status']} |"
        )
    return "\n".join(lines)


def _families(rows: list[Row]) -> list[str]:
    return list(dict.fromkeys(row["family"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
