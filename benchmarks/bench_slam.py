"""Measures the back end against the virtual L2's truth; ``make bench-slam``.

The odometry is simulated: true poses with a drift that is drawn, not the estimator's noise model,
and scans cast along them, kept in ``out/slam_scans``. So a walk of 600 m takes seconds, and a
campaign can be repeated. Drift is the error over 20 m of way in percent, root mean square. Every
row is kept in ``out/bench/slam.jsonl`` as soon as it is there: ``--resume`` goes on with it, and
runs that are not there are named as missing. kiss-slam (``--install-kiss-slam``, x86_64) runs in a
Python of its own on the same scans.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks import slam_pages
from benchmarks.results import FOLDER, publish, show
from benchmarks.slam_pages import Row, targets
from benchmarks.slam_referee import STYLES
from l2lidar_node.emulator.world import mapping_scenes as scenes
from l2lidar_node.emulator.world.mapping_scenes import MappingScene
from l2lidar_node.types import F64
from l2lidar_proc.slam import pose_graph, se3
from l2lidar_proc.slam.config import SlamConfig
from l2lidar_proc.slam.localization import Localizer
from l2lidar_proc.slam.loops import Graph
from l2lidar_proc.slam.nodes import Map, SlamState
from l2lidar_proc.slam.pose_graph import LOOP
from l2lidar_proc.slam.slam import Slam
from tests.support.mapping_runs import MappingRun, ate, drifting, scan, walk

SCANS: Final = Path("out") / "slam_scans"
ROWS: Final = FOLDER / "slam.jsonl"
STEP: Final = 0.4  # [m] between sweeps: a bit more than a turn of the head at a walk
RAYS: Final = 4000
WRONG: Final = (np.radians(3.0), 0.3)  # [rad, m] a loop farther from the truth is a lie
KISS_WRONG: Final = (np.radians(10.0), 1.0)  # [rad, m] its local maps are up to 100 m long
REVISIT_M: Final = 3.0
PLACED: Final = (np.radians(0.5), 0.05)  # [rad, m] a kidnapped start is found this well
ANNOUNCED_WRONG_M: Final = 0.5
SEARCH_M: Final = 20.0  # at a walk: 20 s
TIED_M: Final = 20.0  # way through the graph to the place that was passed before
KISS_SLAM: Final = Path("out") / "referees" / "kiss_slam"
_REFEREE: Final = Path("benchmarks") / "slam_referee.py"
_LIMIT_S: Final = 900
DRIFTS: Final = (0.5, 0.1, 1.0)  # [%]


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
    "furnished": Walk("furnished_office", 2.0),
    "moved_furniture": Walk("furnished_office", 2.0, moved=0.2),
    "office_ring": Walk("office_ring", 2.0, aliased=True),
    "warehouse": Walk("warehouse", 1.15),
    "aisles": Walk("warehouse", 0.5, aliased=True),
    "storeys": Walk("storeys", 1.0, aliased=True),
    "garages": Walk("garages", 1.2, aliased=True),
    "bare_corridor": Walk("bare_corridor", 1.3, aliased=True),
}
KIDNAPPED: Final = {
    "street": "street_block",
    "office": "furnished_office",
    "ring": "office_ring",
}
STARTS_A_ROUND: Final = 5


@cache
def scene_of(name: str) -> MappingScene:
    """Return a scene, which is built once."""
    return scenes.MAPPING_SCENES[name]()


@lru_cache(maxsize=6)
def recording(name: str, variant: int) -> MappingRun:
    """Return the scans of a walk; the same for all seeds of drift of one variant."""
    item = WALKS[name]
    scene = scene_of(item.scene)
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


def mapped(run: MappingRun, odometry: F64) -> tuple[Slam, float, float]:
    """Return the map of a walk, and the seconds of processor: all, and the longest of a sweep."""
    slam, seconds, longest = Slam(SlamConfig()), 0.0, 0.0
    for sweep in run.sweeps(odometry):
        began = time.process_time()
        slam.add(sweep)
        took = time.process_time() - began
        seconds, longest = seconds + took, max(longest, took)
    slam.finish()
    return slam, seconds, longest


def measure_mapping(name: str, percent: float, seed: int) -> Row:
    """Return the row of one walk with one drift."""
    run = recording(name, seed % 2)
    odometry = drifting(run.truth, percent, seed, STEP)
    slam, seconds, longest = mapped(run, odometry)
    built = slam.map()
    true = np.stack([se3.leveled(run.true_pose(node.stamp)) for node in built.nodes])
    loops = built.edges[built.edges["kind"] == LOOP]
    way = STEP * len(run.truth)
    revisits, tied = _revisits(true, built)
    return {
        "kind": "mapping",
        "scene": name,
        "aliased": WALKS[name].aliased,
        "drift_percent": percent,
        "seed": seed,
        "way_m": way,
        "odometry_ate_m": ate(odometry, run.truth),
        "ate_m": ate(built.trajectory()["pose"], run.truth),
        "loops": len(loops),
        "wrong_loops": sum(_is_wrong(true, edge) for edge in loops),
        "revisits": revisits,
        "tied": tied,
        "cores": seconds / way,  # at 1 m/s
        "longest_s": longest,
        "solve_s": _solve_s(built),
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


def _revisits(true: F64, built: Map) -> tuple[int, int]:
    """Return how many submaps came back to a place, and how many of them loops tie to it.

    A submap is tied to a place if the way to it through the graph is short: where a loop did that
    a moment ago, no further one is looked for.
    """
    places, config = true[:, :3, 3], SlamConfig()
    found = tied = 0
    for number in range(8, len(places)):
        distance = np.linalg.norm(places[: number - 7] - places[number], axis=1)
        if distance.min() < REVISIT_M:
            found += 1
            ways = Graph(built.poses, built.edges, number, config).ways
            tied += bool((ways[: number - 7][distance < REVISIT_M] < TIED_M).any())
    return found, tied


def _solve_s(built: Map) -> float:
    """Return the seconds of processor that the whole graph takes to be optimized once."""
    began = time.process_time()
    pose_graph.optimized(built.poses, built.edges, np.zeros(1, np.int64))
    return time.process_time() - began


def _megabytes(built: Map) -> float:
    points = sum(node.submap.nbytes for node in built.nodes if node.submap is not None)
    return float(points + sum(node.sweeps.nbytes for node in built.nodes)) / 1e6


def measure_kidnapped(name: str, outside: bool, seed: int) -> Row:
    """Return the row of one start at an unknown place of a saved map."""
    scene = scene_of(KIDNAPPED[name])
    truth = walk(scene, 1.0, step=STEP, seed=0)
    saved = _saved(name, _scanned(scene, truth, f"map-{name}", 0))
    rng = np.random.default_rng(1000 + seed)
    other = scene_of("car_park") if outside else scene
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
    scene = scene_of("furnished_office")
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
                    "laps": laps,
                    "lap": (number + 1) // len(one),
                    "way_m": (number + 1) * STEP,
                    "submaps": len(built.nodes),
                    "megabytes": _megabytes(built),
                    "rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
                    "cores": (time.process_time() - began) / (len(one) * STEP),
                    "solve_s": _solve_s(built),
                }
            )
            began = time.process_time()
    return rows


def measure_kiss_slam(name: str, seed: int, odometry: str, style: str) -> Row | None:
    """Return the row of kiss-slam on the same scans, None if it is not installed.

    Parameters
    ----------
    name : str
        Of :data:`WALKS`.
    seed : int
    odometry : str
        ``own`` for its KISS-ICP, ``ours`` for the drifting one that our back end is given.
    style : str
        One of ``slam_referee.STYLES``.
    """
    python = KISS_SLAM / "bin" / "python"
    if not python.exists():
        return None
    run = recording(name, seed % 2)
    given = drifting(run.truth, 0.5, seed, STEP)
    with tempfile.TemporaryDirectory() as folder:
        scans, poses, out = (Path(folder) / part for part in ("scans.npz", "poses.npz", "out.npz"))
        ends = np.cumsum([len(cloud) for cloud in run.clouds])
        np.savez(scans, points=np.concatenate(run.clouds), ends=ends)
        np.savez(poses, poses=given)
        source = str(poses) if odometry == "ours" else "own"
        command = [str(python), str(_REFEREE), str(scans), source, style, str(out)]
        done = subprocess.run(command, capture_output=True, timeout=_LIMIT_S, check=False)
        row = {
            "kind": "kiss-slam",
            "scene": name,
            "seed": seed,
            "odometry": odometry,
            "style": style,
            "alone_m": ate(given, run.truth),
            "failed": "",
        }
        if done.returncode or not out.exists():
            said = done.stderr.decode(errors="replace").strip().splitlines() or ["no word"]
            return {**row, "failed": said[-1]}
        with np.load(out) as found:
            found = dict(found)
    wrong = 0
    for (first, second), pose in zip(found["loops"], found["constraints"], strict=True):
        expected = se3.inverse(run.truth[second]) @ run.truth[first]
        turn, way = se3.magnitude(se3.error(expected, pose))
        wrong += bool(turn > KISS_WRONG[0] or way > KISS_WRONG[1])
    return {
        **row,
        "ate_m": ate(found["poses"][: len(run.truth)], run.truth[: len(found["poses"])]),
        "loops": len(found["loops"]),
        "wrong_loops": wrong,
        "cores": float(found["seconds"]) / (STEP * len(run.truth)),
    }


def install_kiss_slam() -> None:
    """Make a virtual environment with kiss-slam: a benchmark of this measurement only."""
    subprocess.run(["python3", "-m", "venv", str(KISS_SLAM)], check=True)
    pip = [str(KISS_SLAM / "bin" / "pip"), "install", "--quiet", "--only-binary", ":all:"]
    subprocess.run([*pip, "kiss-slam"], check=True)


def tasks(given: argparse.Namespace) -> Iterator[Row]:
    """Yield what tells apart the rows to be measured; each round has some of each kind."""
    rounds = max(given.aliased, given.seeds, -(-given.starts // STARTS_A_ROUND))
    for number in range(rounds):
        for percent in DRIFTS:
            for name in given.scenes:
                if number < (given.aliased if WALKS[name].aliased else given.seeds):
                    yield {
                        "kind": "mapping",
                        "scene": name,
                        "drift_percent": percent,
                        "seed": number,
                    }
        first = number * STARTS_A_ROUND
        for seed in range(first, min(first + STARTS_A_ROUND, given.starts)):
            for name in (*KIDNAPPED, "outside street"):
                yield {"kind": "kidnapped", "scene": name, "seed": seed}
        if number == 0 and given.laps:
            yield {"kind": "hour", "laps": given.laps}
        if number == 0:
            for name in ("street", "furnished", "office_ring", "warehouse"):
                if name in given.scenes:
                    for odometry in ("own", "ours"):
                        for style in STYLES:
                            yield {
                                "kind": "kiss-slam",
                                "scene": name,
                                "seed": 0,
                                "odometry": odometry,
                                "style": style,
                            }


def carry_out(key: Row) -> list[Row]:
    """Return the rows of one task; none if it needs what is not installed."""
    if key["kind"] == "mapping":
        return [measure_mapping(key["scene"], key["drift_percent"], key["seed"])]
    if key["kind"] == "kidnapped":
        name = key["scene"]
        outside = name.startswith("outside ")
        return [measure_kidnapped(name.removeprefix("outside "), outside, key["seed"])]
    if key["kind"] == "hour":
        return measure_hour(key["laps"])
    row = measure_kiss_slam(key["scene"], key["seed"], key["odometry"], key["style"])
    return [] if row is None else [row]


def read_rows() -> list[Row]:
    """Return the rows that are kept."""
    return [json.loads(line) for line in ROWS.read_text().splitlines()] if ROWS.exists() else []


def main(arguments: list[str] | None = None) -> int:
    """Run from a command line; return 0 when all targets are met."""
    parser = argparse.ArgumentParser(prog="bench_slam", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one seed, four starts, 3 laps")
    parser.add_argument("--seeds", type=int, default=3, help="drifts of each scene and rate")
    parser.add_argument("--aliased", type=int, default=7, help="the same of look-alike scenes")
    parser.add_argument("--starts", type=int, default=25, help="kidnapped starts of each scene")
    parser.add_argument("--laps", type=int, default=45, help="of the long run, 80 m each")
    parser.add_argument("--scenes", nargs="+", default=list(WALKS), choices=list(WALKS))
    parser.add_argument("--minutes", type=float, default=1e6, help="begin no run after that")
    parser.add_argument("--resume", action="store_true", help="keep the rows that there are")
    parser.add_argument("--install-kiss-slam", action="store_true", help="x86_64 only")
    parser.add_argument("--page", action="store_true", help="write docs/results/slam.md")
    given = parser.parse_args(arguments)
    if given.quick:
        given.seeds, given.aliased, given.starts, given.laps = 1, 1, 4, 3
    if given.install_kiss_slam:
        install_kiss_slam()
    if not given.resume:
        ROWS.unlink(missing_ok=True)
        shutil.rmtree(SCANS, ignore_errors=True)
    ROWS.parent.mkdir(parents=True, exist_ok=True)
    rows = read_rows()
    until = time.monotonic() + 60.0 * given.minutes
    missing: list[Row] = []
    for key in tasks(given):
        if any(key.items() <= row.items() for row in rows):
            continue
        new = carry_out(key) if time.monotonic() < until else []
        if not new:
            missing.append(key)
        rows += new
        with ROWS.open("a") as stream:
            for row in new:
                print(json.dumps(row, default=float), file=stream)
                print(
                    {name: value for name, value in row.items() if name != "refused"}, flush=True
                )
    met = list(targets(rows))
    show("Kidnapped starts", slam_pages.start_table(rows))
    show("Round after round", slam_pages.lap_table(rows))
    show("kiss-slam on the same scans", slam_pages.kiss_table(rows))
    publish("slam", "Back end on simulated odometry", slam_pages.mapping_table(rows), met)
    if missing:
        print(f"not run: {slam_pages.counted(missing)}; go on with --resume")
    if given.page:
        print(f"written to {slam_pages.write(rows, met, missing)}")
    return 0 if all(target.met for target in met) else 1


if __name__ == "__main__":
    sys.exit(main())
