"""Measures the back end against the virtual L2's truth; ``make bench-slam``.

The odometry is simulated: true poses with a drift that is drawn, not the estimator's noise model,
and scans cast along them, kept in ``out/slam_scans``. So a walk of 600 m takes seconds, and a
campaign can be repeated. Drift is the error over 20 m of way in percent, root mean square. Every
row is kept in ``out/bench/slam.jsonl`` as soon as it is there: ``--resume`` goes on with it.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.results import FOLDER, Target, at_least, at_most, publish
from l2lidar_node.emulator.world import mapping_scenes as scenes
from l2lidar_node.emulator.world.mapping_scenes import MappingScene
from l2lidar_proc.slam import se3
from l2lidar_proc.slam.config import SlamConfig
from l2lidar_proc.slam.localization import Localizer
from l2lidar_proc.slam.nodes import Map, SlamState
from l2lidar_proc.slam.pose_graph import LOOP
from l2lidar_proc.slam.se3 import F64
from l2lidar_proc.slam.slam import Slam
from tests.support.mapping_runs import MappingRun, ate, drifting, scan, walk

SCANS: Final = Path("out") / "slam_scans"
ROWS: Final = FOLDER / "slam.jsonl"
STEP: Final = 0.4  # [m] between sweeps: a bit more than a turn of the head at a walk
RAYS: Final = 4000
WRONG: Final = (np.radians(3.0), 0.3)  # [rad, m] a loop farther from the truth is a lie
REVISIT_M: Final = 3.0
PLACED: Final = (np.radians(0.5), 0.05)  # [rad, m] a kidnapped start is found this well
ANNOUNCED_WRONG_M: Final = 0.5
SEARCH_M: Final = 20.0  # at a walk: 20 s

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Walk:
    """A way through a scene.

    Attributes
    ----------
    scene : str
    laps : float
    aliased : bool
        Whether places look alike by construction.
    moved : float
        Part of the furniture that moves between the laps.
    """

    scene: str
    laps: float
    aliased: bool = False
    moved: float = 0.0


WALKS: Final = {
    "street": Walk("street_block", 1.5),
    "car_park": Walk("car_park", 2.2),
    "moved_furniture": Walk("furnished_office", 2.0, moved=0.2),
    "office_ring": Walk("office_ring", 2.0, aliased=True),
    "warehouse": Walk("warehouse", 1.15, aliased=True),
    "storeys": Walk("storeys", 1.0, aliased=True),
    "garages": Walk("garages", 1.6, aliased=True),
    "bare_corridor": Walk("bare_corridor", 2.0, aliased=True),
}
ALIASED: Final = [name for name, item in WALKS.items() if item.aliased]


def recording(name: str, variant: int) -> MappingRun:
    """Return the scans of a walk; the same for all seeds of drift of one variant."""
    item = WALKS[name]
    scene = scenes.MAPPING_SCENES[item.scene]()
    truth = walk(scene, item.laps, step=STEP, seed=variant)
    if not item.moved:
        return _scanned(scene, truth, f"{name}-{variant}", variant)
    half = len(truth) // 2
    first = _scanned(scene, truth[:half], f"{name}-{variant}-before", variant)
    later = scenes.furnished_office(item.moved)
    second = _scanned(later, truth[half:], f"{name}-{variant}-after", variant)
    return MappingRun(truth, [*first.clouds, *second.clouds], STEP)


def _scanned(scene: MappingScene, truth: F64, name: str, seed: int) -> MappingRun:
    kept = SCANS / f"{name}-{len(truth)}-{STEP}-{RAYS}.npz"
    return scan(scene, truth, step=STEP, rays=RAYS, seed=seed, kept=kept)


def mapped(run: MappingRun, odometry: F64) -> tuple[Slam, float]:
    """Return the map of a walk, and the seconds of processor that it took."""
    began = time.process_time()
    slam = Slam(SlamConfig())
    for sweep in run.sweeps(odometry):
        slam.add(sweep)
    slam.finish()
    return slam, time.process_time() - began


def measure_mapping(name: str, percent: float, seed: int) -> Row:
    """Return the row of one walk with one drift."""
    run = recording(name, seed % 2)
    odometry = drifting(run.truth, percent, seed, STEP)
    slam, seconds = mapped(run, odometry)
    built = slam.map()
    true = np.stack([se3.leveled(run.true_pose(node.stamp)) for node in built.nodes])
    loops = built.edges[built.edges["kind"] == LOOP]
    way = STEP * len(run.truth)
    revisits, closed = _revisits(true, loops)
    return {
        "kind": "mapping",
        "scene": name,
        "drift_percent": percent,
        "seed": seed,
        "way_m": way,
        "odometry_ate_m": ate(odometry, run.truth),
        "ate_m": ate(built.trajectory()["pose"], run.truth),
        "loops": len(loops),
        "wrong_loops": sum(_is_wrong(true, edge) for edge in loops),
        "revisits": revisits,
        "closed": closed,
        "cores": seconds / way,  # at 1 m/s
        "mb_per_km": _megabytes(built) / way * 1000.0,
        "refused": dict(slam.counts),
    }


def _is_wrong(true: F64, edge: Any) -> bool:
    expected = se3.inverse(true[edge["first"]]) @ true[edge["second"]]
    turn, way = se3.magnitude(se3.error(expected, edge["pose"]))
    # along a corridor without detail a pair says nothing, and says so
    sigma, axes = np.linalg.eigh(edge["covariance"][3:, 3:])
    off = axes.T @ se3.error(expected, edge["pose"])[3:]
    sure = sigma < 1.0
    return bool(turn > WRONG[0] or np.linalg.norm(off[sure]) > WRONG[1] or way > 30.0)


def _revisits(true: F64, loops: Any) -> tuple[int, int]:
    """Return how many submaps came back to a place, and how many of them a loop closes."""
    closed = set(loops["second"].tolist())
    places = true[:, :3, 3]
    found = shut = 0
    for number in range(8, len(places)):
        distance = np.linalg.norm(places[: number - 7] - places[number], axis=1)
        if distance.min() < REVISIT_M:
            found += 1
            shut += number in closed
    return found, shut


def _megabytes(built: Map) -> float:
    points = sum(node.submap.nbytes for node in built.nodes if node.submap is not None)
    return float(points + sum(node.sweeps.nbytes for node in built.nodes)) / 1e6


def measure_kidnapped(name: str, outside: bool, seed: int) -> Row:
    """Return the row of one start at an unknown place of a saved map."""
    scene_name = {"street": "street_block", "office": "furnished_office", "ring": "office_ring"}
    scene = scenes.MAPPING_SCENES[scene_name[name]]()
    truth = walk(scene, 1.0, step=STEP, seed=0)
    saved = _saved(name, _scanned(scene, truth, f"map-{name}", 0))
    rng = np.random.default_rng(1000 + seed)
    other = scenes.MAPPING_SCENES["car_park"]() if outside else scene
    long = walk(other, 1.0, step=STEP, seed=50 + seed % 2, backwards=bool(seed % 2))
    sweeps = round(SEARCH_M / STEP)
    begin = int(rng.integers(0, len(long) - sweeps))
    tag = f"kidnapped-{'outside' if outside else name}-{seed % 2}"
    every = _scanned(other, long, tag, 50 + seed % 2)
    run = every.part(begin, begin + sweeps)
    odometry = drifting(run.truth, 0.5, seed, STEP)
    x, y = rng.normal(0.0, 30.0, 2).tolist()
    odometry = se3.planar(x, y, float(rng.uniform(-np.pi, np.pi))) @ odometry
    localizer = Localizer(SlamConfig(), saved)
    start = se3.inverse(se3.leveled(truth[0]))
    found_after, errors, turns = float("nan"), [], []
    began = time.process_time()
    for number, sweep in enumerate(run.sweeps(odometry)):
        localizer.add(sweep)
        if localizer.state is SlamState.LOCALIZED and localizer.T_map_odom is not None:
            true = start @ run.truth[number]
            turn, way = se3.magnitude(se3.error(true, localizer.T_map_odom @ sweep.T_odom_body))
            errors.append(way)
            turns.append(turn)
            if np.isnan(found_after):
                found_after = number * STEP
    announced = bool(errors)
    return {
        "kind": "kidnapped",
        "scene": f"outside {name}" if outside else name,
        "seed": seed,
        "announced": announced,
        "found_after_m": found_after,
        "error_m": float(np.median(errors)) if announced else float("nan"),
        "error_deg": float(np.degrees(np.median(turns))) if announced else float("nan"),
        "wrong": announced and (outside or max(errors) > ANNOUNCED_WRONG_M),
        "cores": (time.process_time() - began) / SEARCH_M,
    }


_MAPS: dict[str, Map] = {}


def _saved(name: str, run: MappingRun) -> Map:
    """Return the map of a lap without drift: what the start is measured against is the truth."""
    if name not in _MAPS:
        _MAPS[name] = mapped(run, drifting(run.truth, 0.0, 0, STEP))[0].map()
    return _MAPS[name]


def measure_hour(laps: int) -> list[Row]:
    """Return a row for each lap of a long run around the office: growth, time, size."""
    scene = scenes.MAPPING_SCENES["furnished_office"]()
    one = walk(scene, 1.0, step=STEP, seed=0)
    run = _scanned(scene, one, "hour", 0)
    truth = np.concatenate([one] * laps)
    odometry = drifting(truth, 0.2, 0, STEP)
    whole = MappingRun(truth, run.clouds * laps, STEP)
    slam, rows, began = Slam(SlamConfig()), [], time.process_time()
    for number, sweep in enumerate(whole.sweeps(odometry)):
        slam.add(sweep)
        if (number + 1) % len(one) == 0:
            built = slam.map()
            rows.append(
                {
                    "kind": "hour",
                    "lap": (number + 1) // len(one),
                    "way_m": (number + 1) * STEP,
                    "submaps": len(built.nodes),
                    "megabytes": _megabytes(built),
                    "cores": (time.process_time() - began) / (len(one) * STEP),
                }
            )
            began = time.process_time()
    return rows


def measure_kiss_slam(name: str, seed: int) -> Row | None:
    """Return the row of kiss-slam's loop closer on the same scans, None if it is not installed.

    kiss-slam is given each sweep once, deskewed, as its own pipeline wants them, without the
    odometry that ours is given: its own KISS-ICP runs.
    """
    if importlib.util.find_spec("kiss_slam") is None:
        return None
    from kiss_slam.config import load_config
    from kiss_slam.slam import KissSLAM

    run = recording(name, seed % 2)
    config = load_config(None)
    pipeline = KissSLAM(config)
    began = time.process_time()
    for cloud in run.clouds:
        pipeline.process_scan(cloud.astype(np.float64), np.zeros(len(cloud)))
    pipeline.generate_new_node()
    pipeline.local_map_graph.erase_last_local_map()
    poses, _ = pipeline.fine_grained_optimization()
    seconds = time.process_time() - began
    found = np.asarray(poses)[: len(run.truth)]
    return {
        "kind": "kiss-slam",
        "scene": name,
        "seed": seed,
        "ate_m": ate(found, run.truth[: len(found)]),
        "loops": len(pipeline.get_closures()),
        "cores": seconds / (STEP * len(run.truth)),
    }


def upper_bound(failures: int, runs: int) -> float:
    """Return the 95 % upper bound (Clopper and Pearson) of a rate."""
    from scipy.stats import beta

    return 1.0 if failures >= runs else float(beta.ppf(0.95, failures + 1, runs - failures))


def lower_bound(successes: int, runs: int) -> float:
    """Return the 95 % lower bound of a rate."""
    return 1.0 - upper_bound(runs - successes, runs)


def targets(rows: list[Row]) -> Iterator[Target]:
    """Yield the targets that these rows can tell about."""
    mapping = [row for row in rows if row["kind"] == "mapping"]
    street = [r for r in mapping if r["scene"] == "street" and r["drift_percent"] == 0.5]
    if street:
        ratio = max(row["ate_m"] / row["odometry_ate_m"] for row in street)
        yield at_most("street, 0.5 %: largest ATE by that of odometry alone", ratio, 0.25)
        yield at_most("street, 0.5 %: largest ATE, m", max(r["ate_m"] for r in street), 0.15)
        closed = sum(r["closed"] for r in street) / max(sum(r["revisits"] for r in street), 1)
        yield at_least("street, 0.5 %: revisits closed", closed, 0.8)
    small = [row for row in mapping if row["drift_percent"] == 0.1]
    if small:
        worse = max(row["ate_m"] - row["odometry_ate_m"] for row in small)
        yield at_most("0.1 %: worst loss against odometry alone, m", worse, 0.005)
    aliased = [row for row in mapping if row["scene"] in ALIASED]
    if aliased:
        lied = sum(row["wrong_loops"] > 0 for row in aliased)
        yield at_most(f"aliased runs with a wrong loop, of {len(aliased)}", float(lied), 0.0)
        bound = upper_bound(lied, len(aliased))
        yield at_most("their rate, 95 % upper bound", bound, 0.03)
        worse = max(row["ate_m"] - row["odometry_ate_m"] for row in aliased)
        yield at_most("aliased: worst loss against odometry alone, m", worse, 0.01)
    if mapping:
        wrong = float(sum(row["wrong_loops"] for row in mapping))
        loops = sum(row["loops"] for row in mapping)
        yield at_most(f"wrong loops of {loops}, all scenes", wrong, 0.0)
        yield at_most("cores, largest of any walk", max(r["cores"] for r in mapping), 0.3)
        yield at_most("map, MB per km, largest", max(r["mb_per_km"] for r in mapping), 60.0)
    starts = [r for r in rows if r["kind"] == "kidnapped"]
    inside = [r for r in starts if r["scene"] in ("street", "office")]
    if inside:
        good = sum(
            r["announced"]
            and r["error_m"] <= PLACED[1]
            and np.radians(r["error_deg"]) <= PLACED[0]
            for r in inside
        )
        yield at_least(f"kidnapped starts found, of {len(inside)}", good / len(inside), 0.9)
        yield at_least("their rate, 95 % lower bound", lower_bound(good, len(inside)), 0.8)
    if starts:
        wrong = sum(bool(row["wrong"]) for row in starts)
        yield at_most(f"wrong announcements, of {len(starts)} starts", float(wrong), 0.0)
        yield at_most("their rate, 95 % upper bound", upper_bound(wrong, len(starts)), 0.03)
    hour = [row for row in rows if row["kind"] == "hour"]
    if len(hour) > 2:
        grown = (hour[-1]["megabytes"] - hour[1]["megabytes"]) / (
            (hour[-1]["way_m"] - hour[1]["way_m"]) / 1000.0
        )
        yield at_most("growth in known ground, MB per km", grown, 3.0)


def tasks(given: argparse.Namespace) -> Iterator[tuple[str, Row]]:
    """Yield what is to be measured: a kind, and what tells the rows of it apart."""
    for seed in range(given.seeds):
        for percent in (0.5, 0.1, 1.0):
            for name in given.scenes:
                yield (
                    "mapping",
                    {"kind": "mapping", "scene": name, "drift_percent": percent, "seed": seed},
                )
    for seed in range(given.starts):
        for name in ("street", "office", "ring"):
            yield "kidnapped", {"kind": "kidnapped", "scene": name, "seed": seed}
        yield "outside", {"kind": "kidnapped", "scene": "outside street", "seed": seed}
    if given.laps:
        yield "hour", {"kind": "hour"}
    for name in ("street",):
        yield "kiss-slam", {"kind": "kiss-slam", "scene": name, "seed": 0}


def carry_out(kind: str, key: Row) -> list[Row]:
    """Return the rows of one task."""
    if kind == "mapping":
        return [measure_mapping(key["scene"], key["drift_percent"], key["seed"])]
    if kind == "kidnapped":
        return [measure_kidnapped(key["scene"], False, key["seed"])]
    if kind == "outside":
        return [measure_kidnapped("street", True, key["seed"])]
    if kind == "hour":
        return measure_hour(key.get("laps", 12))
    row = measure_kiss_slam(key["scene"], key["seed"])
    return [] if row is None else [row]


def read_rows() -> list[Row]:
    """Return the rows that are kept."""
    return [json.loads(line) for line in ROWS.read_text().splitlines()] if ROWS.exists() else []


def summary(rows: list[Row]) -> list[Row]:
    """Return one row for each scene and drift, and for each kind of start."""
    table: list[Row] = []
    mapping = [row for row in rows if row["kind"] == "mapping"]
    for scene, percent in sorted({(r["scene"], r["drift_percent"]) for r in mapping}):
        some = [r for r in mapping if (r["scene"], r["drift_percent"]) == (scene, percent)]
        table.append(
            {
                "what": f"{scene}, {percent} %",
                "runs": len(some),
                "alone_m": float(np.median([r["odometry_ate_m"] for r in some])),
                "median_m": float(np.median([r["ate_m"] for r in some])),
                "worst_m": max(r["ate_m"] for r in some),
                "found": f"{sum(r['closed'] for r in some)}/{sum(r['revisits'] for r in some)}",
                "wrong": sum(r["wrong_loops"] for r in some),
                "cores": float(np.median([r["cores"] for r in some])),
            }
        )
    starts = [row for row in rows if row["kind"] == "kidnapped"]
    for scene in sorted({r["scene"] for r in starts}):
        some = [r for r in starts if r["scene"] == scene]
        found = [r for r in some if r["announced"]]
        table.append(
            {
                "what": f"kidnapped: {scene}",
                "runs": len(some),
                "alone_m": float("nan"),
                "median_m": float(np.median([r["error_m"] for r in found] or [np.nan])),
                "worst_m": max((r["error_m"] for r in found), default=float("nan")),
                "found": f"{len(found)}/{len(some)}",
                "wrong": sum(bool(r["wrong"]) for r in some),
                "cores": float(np.median([r["cores"] for r in some])),
            }
        )
    for row in rows:
        if row["kind"] == "kiss-slam":
            table.append(
                {
                    "what": f"kiss-slam: {row['scene']}",
                    "runs": 1,
                    "alone_m": float("nan"),
                    "median_m": row["ate_m"],
                    "worst_m": row["ate_m"],
                    "found": f"{row['loops']} loops",
                    "wrong": "not judged",
                    "cores": row["cores"],
                }
            )
    return table


def main(arguments: list[str] | None = None) -> int:
    """Run from a command line; return 0 when all targets are met."""
    parser = argparse.ArgumentParser(prog="bench_slam", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two seeds, four starts, 3 laps")
    parser.add_argument("--seeds", type=int, default=10, help="drifts of each scene and rate")
    parser.add_argument("--starts", type=int, default=50, help="kidnapped starts of each scene")
    parser.add_argument("--laps", type=int, default=12, help="of the long run, 80 m each")
    parser.add_argument("--scenes", nargs="+", default=list(WALKS), choices=list(WALKS))
    parser.add_argument("--minutes", type=float, default=1e6, help="begin no run after that")
    parser.add_argument("--resume", action="store_true", help="keep the rows that there are")
    parser.add_argument(
        "--install-kiss-slam", action="store_true", help="x86_64 only; into this environment"
    )
    given = parser.parse_args(arguments)
    if given.quick:
        given.seeds, given.starts, given.laps = 2, 4, 3
    if given.install_kiss_slam:
        subprocess.run([sys.executable, "-m", "pip", "install", "kiss-slam"], check=True)
    if not given.resume:
        ROWS.unlink(missing_ok=True)
        shutil.rmtree(SCANS, ignore_errors=True)
    ROWS.parent.mkdir(parents=True, exist_ok=True)
    rows = read_rows()
    until = time.monotonic() + 60.0 * given.minutes
    left = 0
    for kind, key in tasks(given):
        if any(key.items() <= row.items() for row in rows):
            continue
        if time.monotonic() > until:
            left += 1
            continue
        new = carry_out(kind, {**key, "laps": given.laps} if kind == "hour" else key)
        rows += new
        with ROWS.open("a") as stream:
            for row in new:
                print(json.dumps(row, default=float), file=stream)
                print(
                    {name: value for name, value in row.items() if name != "refused"}, flush=True
                )
    met = list(targets(rows))
    publish("slam", "Back end on simulated odometry", summary(rows), met)
    if left:
        print(f"{left} runs were left out; go on with --resume")
    return 0 if all(target.met for target in met) else 1


if __name__ == "__main__":
    sys.exit(main())
