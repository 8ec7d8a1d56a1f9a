"""The odometry bench: its plan and rows, scores, targets, page, and what it hands the referees."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import bench_odometry, odometry_methods, odometry_referee
from benchmarks.odometry_methods import OURS, PLAIN, REFEREES, SLOW, Found, Plan, Rows
from l2lidar_node import rotations
from l2lidar_node.clouds import rings
from tests.support import odometry_runs

PLAN = Plan(
    scenes=("room", "yard"),
    motions=("walk",),
    seeds=3,
    seconds=30.0,
    sweeps=odometry_runs.CUTS,
    methods=(OURS, PLAIN, *REFEREES),
    referee_seeds=2,
    slow_seeds=1,
)


def row(method: Any = OURS, ate: float = 0.001, **changes: Any) -> Any:
    found = {
        "scene": "room",
        "motion": "walk",
        "sweeps": "turn",
        "seed": 0,
        "seconds": 30.0,
        "method": method,
        "ate_m": ate,
        "max_m": 2 * ate,
        "rpe_m": ate,
        "real_time_factor": 10.0,
    }
    return {**found, **changes}


def planned(plan: Any, done: Any = ()) -> Any:
    return [
        (task.seed, task.scene, cut, name)
        for task in plan.tasks(done)
        for cut, name in task.wanted
    ]


def test_everything_that_is_wanted_is_planned_once() -> None:
    found = planned(PLAN)
    assert len(found) == len(set(found))
    # two local methods and three seeds; two quick referees and two seeds; the slow ones get full
    # turns with two seeds and the other two kinds of sweeps with one
    assert len(found) == 2 * (2 * 3 * 3 + 2 * 2 * 3 + 2 * 2 + 2 * 2)
    assert not [item for item in found if item[0] == 2 and item[3] in REFEREES]
    slow = [item for item in found if item[3] in SLOW and item[2] != "turn"]
    assert slow == found[-len(slow) :]


def test_only_what_is_missing_is_planned_again() -> None:
    done = [row(), row("ct_icp"), row(scene="yard", seconds=10.0)]
    gone = set(planned(PLAN)) - set(planned(PLAN, done))
    assert gone == {(0, "room", "turn", OURS), (0, "room", "turn", "ct_icp")}
    assert PLAN.has(done[0])
    assert not PLAN.has(done[2])
    assert not PLAN.has(row("ct_icp", seed=1, sweeps="half turn"))


def test_rows_outlive_a_run_that_is_cut(tmp_path: Path) -> None:
    rows = Rows(tmp_path / "bench" / "rows.jsonl")
    assert rows.read() == []
    some = [row(), row("ct_icp", math.inf)]
    for item in some:
        rows.append(item)
    some[0] = row(ate=0.002)
    rows.append(some[0])
    with rows.path.open("a") as file:
        file.write('{"scene": "ro')
    assert rows.read() == some
    rows.clear()
    assert rows.read() == []


def test_a_row_after_one_that_was_cut_off_counts(tmp_path: Path) -> None:
    rows = Rows(tmp_path / "rows.jsonl")
    rows.path.write_text('{"scene": "ro')
    rows.append(row())
    assert rows.read() == [row()]


@pytest.fixture(scope="module")
def run() -> Any:
    return odometry_runs.record("room", "walk", 0, 6.0)


def test_a_score_is_the_distance_from_the_truth_after_an_alignment(run: Any) -> None:
    stamps = odometry_runs.EPOCH + (np.arange(0.5, 6.0, 0.1) * 1e9).astype(np.int64)
    positions, quaternions = odometry_runs.truth(run, stamps)
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    poses[:, :3, :3] = rotations.matrices(quaternions)
    poses[:, :3, 3] = positions
    other = np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1.0]])
    exact = bench_odometry.score(run, Found(stamps, other @ poses, 1.0))
    assert max(exact) < 1e-9
    poses[1::2, 2, 3] += 0.02
    ate, largest, relative = bench_odometry.score(run, Found(stamps, other @ poses, 1.0))
    assert ate == pytest.approx(0.01, rel=0.05)
    assert largest == pytest.approx(0.01, rel=0.2)
    assert 0.005 < relative < 0.03


@pytest.mark.parametrize("answer", ["nothing", "too few", "an exception"])
def test_a_method_that_fails_is_lost(
    run: Any, monkeypatch: pytest.MonkeyPatch, answer: str
) -> None:
    stamps = odometry_runs.EPOCH + np.arange(10) * 100_000_000

    def method(*_: Any) -> Any:
        if answer == "an exception":
            raise ValueError(answer)
        if answer == "nothing":
            return None
        return Found(stamps, np.tile(np.eye(4), (10, 1, 1)), 1.0)

    monkeypatch.setattr(odometry_methods, "run_method", method)
    found = bench_odometry.measure(run, "room", "walk", 0, "turn", OURS)
    assert found["ate_m"] == math.inf
    assert found["real_time_factor"] == 0.0


def test_targets_compare_the_same_runs_only() -> None:
    rows = [
        row(ate=0.001),
        row(ate=0.04, scene="corridor", sweeps="half turn"),
        row("ct_icp", 0.005),
        row("lio_sam", 0.2),
        row("lio_sam", 0.05, seed=1),
        row("lio_sam", 0.04, seed=2),
        row("lio_sam", 0.9, sweeps="half turn"),
    ]
    found = {target.name: target for target in bench_odometry.targets(rows)}
    assert found["largest ATE of any run, m"].value == 0.04
    assert found["median ATE against 1 x ct_icp, m"].value == 0.001
    assert found["median ATE against 1 x ct_icp, m"].bound == 0.005
    (lio_sam,) = [target for name, target in found.items() if "lio_sam in the room" in name]
    assert (lio_sam.value, lio_sam.bound, lio_sam.met) == (0.05, 0.1, True)
    assert not any("genz_lio" in name or "rko_lio" in name for name in found)


def test_a_lost_run_fails_its_targets() -> None:
    found = {
        item.name: item for item in bench_odometry.targets([row(), row(ate=math.inf, seed=1)])
    }
    assert not found["runs that diverge"].met
    assert not found["largest ATE of any run, m"].met


def test_the_page_tells_of_runs_that_are_lost_and_of_targets_not_met(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, plot = tmp_path / "odometry.md", tmp_path / "odometry.png"
    page.write_text(f"before\n{bench_odometry.BEGIN}\nold\n{bench_odometry.END}\nafter\n")
    monkeypatch.setattr(bench_odometry, "PAGE", page)
    monkeypatch.setattr(bench_odometry, "PLOT", plot)
    rows = [row(), row(ate=0.201, seed=1), row("ct_icp", math.inf)]
    bench_odometry.write(rows, list(bench_odometry.targets(rows)))
    text = page.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "old" not in text
    assert "| room, turn | 101 / 201 | lost / lost |" in text
    assert "**not met**" in text
    assert 2_000 < plot.stat().st_size < 150_000


def test_lio_sam_gets_the_rings_of_the_velodyne_layout(run: Any) -> None:
    sweep = next(odometry_runs.sweeps(run, "turn"))
    points = np.stack([sweep.points[axis] for axis in "xyz"], axis=1).astype(np.float64)
    fake = SimpleNamespace(
        Point=SimpleNamespace,
        Duration=SimpleNamespace(from_nsec=int),
        Stamp=SimpleNamespace(from_nsec=int),
        LidarMeasurement=lambda stamp, made: made,
    )
    times = sweep.points["time"].astype(np.float64)
    made = odometry_referee._measurement(fake, sweep.start, points, times, 150, 1800)
    same = np.array([point.row for point in made]) == rings(sweep.points)
    assert same.mean() > 0.999  # float32 there, float64 here
    assert [point.t for point in made] == np.round(times * 1e9).astype(int).tolist()


def test_the_referees_read_what_was_written(run: Any, tmp_path: Path) -> None:
    odometry_runs.write(run, "half turn", tmp_path / "run.npz")
    recording = odometry_referee.Recording(str(tmp_path / "run.npz"))
    some = list(odometry_runs.sweeps(run, "half turn"))
    starts = [start for start, _, _, _ in recording]
    assert starts == [sweep.start for sweep in some]
    assert sum(len(points) for _, _, points, _ in recording) == sum(len(s.points) for s in some)
    first = recording.samples(-1, starts[3])
    then = recording.samples(starts[3], starts[4])
    assert first["stamp"][-1] <= starts[3] < then["stamp"][0]
