"""After a jump of the clock, back or ahead, both pipelines go on at once with bounded work."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
from hypothesis import example, given, settings, strategies as st

from l2lidar_node.types import HostNs, Sweep
from l2lidar_proc.deskew.config import ProcConfig
from l2lidar_proc.deskew.pipeline import Pipeline
from l2lidar_proc.motion.imu_buffer import replay
from l2lidar_proc.motion.tracker import Flag
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.pipeline import OdometryPipeline
from tests.l2lidar_proc.motion.analytic import EPOCH, Motion, at, seen
from tests.l2lidar_proc.odometry.odometry_world import T_CLOUD_IMU, recording
from tests.support import memory
from tests.support.odometry_runs import sweeps

YEAR_NS = 365 * 86_400 * 1_000_000_000
MOST_BYTES = 400_000_000
WALK = Motion(turn=1.0, nod=0.1, speed=1.0)

jumps = st.one_of(
    st.integers(-60 * YEAR_NS, 60 * YEAR_NS),
    # a sign and an order of magnitude: as many of milliseconds as of years
    st.builds(lambda sign, power: sign * round(10**power), st.sampled_from([-1, 1]),
              st.floats(6.0, 18.27)),
)  # fmt: skip
who_jumps = st.sampled_from(["both", "clouds first", "imu first", "one cloud", "one sample"])


def offsets(who: str, by: int, number: int, when: int) -> tuple[int, int]:
    """Return by how much the stamps of cloud and samples of a step are off [ns]."""
    late, later, once = number >= when, number > when, number == when
    return {
        "both": (late * by, late * by),
        "clouds first": (late * by, later * by),
        "imu first": (later * by, late * by),
        "one cloud": (once * by, 0),
        "one sample": (0, once * by),
    }[who]


def shifted(samples: Any, by: int) -> Any:
    moved = samples.copy()
    moved["stamp"] += by
    return moved


def moved(sweep: Sweep, by: int) -> Sweep:
    return Sweep(HostNs(sweep.start + by), HostNs(sweep.end + by), sweep.points, 0, 0)


@cache
def walked(number: int) -> tuple[Any, Any]:
    """Return points and samples of a step of the walk."""
    start, end = 0.2 * number, 0.2 * (number + 1)
    return seen(WALK, start, end, start, count=300)[0], WALK.imu(start, end + 0.01)


class Deskewing:
    """The deskew pipeline on a walk, with velocities."""

    def __init__(self) -> None:
        self.pipeline = Pipeline(ProcConfig())
        self.out: list[Any] = []

    def step(self, number: int, cloud_by: int, imu_by: int) -> None:
        start, end = 0.2 * number, 0.2 * (number + 1)
        now = round(start * 1e9)
        self.pipeline.velocity(
            HostNs(at(start) + cloud_by), WALK.velocity(np.array([start]))[0], "odometry"
        )
        points, samples = walked(number)
        stamps = HostNs(at(start) + cloud_by), HostNs(at(end) + cloud_by)
        self.pipeline.sweep(Sweep(*stamps, points, 0, 0), now)
        self.pipeline.imu(shifted(samples, imu_by))
        self.out += self.pipeline.poll(now + 1_000_000_000)


@settings(max_examples=15)
@given(jumps, who_jumps, st.integers(2, 6))
@example(86_400_000_000_000, "both", 5)
@example(YEAR_NS, "one cloud", 5)
@example(-int(EPOCH), "both", 5)
@example(YEAR_NS, "one sample", 5)
def test_deskew_goes_on_after_any_jump(by: Any, who: Any, when: Any) -> None:
    deskewing = Deskewing()
    with memory.at_most(MOST_BYTES):
        for number in range(14):
            cloud_by, imu_by = offsets(who, by, number, when)
            deskewing.step(number, cloud_by, imu_by)
    assert len(deskewing.out) == 14  # none is lost
    for item in deskewing.out[when + 4 :]:
        assert Flag.NO_IMU not in item.quality.flags, (by, who, when)
        assert np.isfinite(item.points["x"]).all()
    assert deskewing.out[-1].quality.velocity_source, (by, who, when)


@cache
def room() -> list[Sweep]:
    """Return sweeps of a walk through the room, with half of their points."""
    found = sweeps(recording("room", "walk"), "turn")
    return [dataclasses.replace(sweep, points=sweep.points[::2]) for sweep in found][:14]


@settings(max_examples=2)
@given(jumps, who_jumps)
@example(86_400_000_000_000, "both")
@example(YEAR_NS, "both")
@example(YEAR_NS, "one cloud")
@example(-YEAR_NS, "one cloud")
@example(YEAR_NS, "one sample")
@example(-int(EPOCH), "both")
def test_odometry_goes_on_after_any_jump(by: Any, who: Any) -> None:
    when, pipeline, poses = 6, OdometryPipeline(OdometryConfig(), T_CLOUD_IMU), []
    imu = recording("room", "walk").imu
    with memory.at_most(MOST_BYTES):
        for number, (sweep, some) in enumerate(replay(room(), imu)):
            cloud_by, imu_by = offsets(who, by, number, when)
            samples = some.copy()
            if who == "one sample":
                samples["stamp"][-1:] += imu_by
            else:
                samples["stamp"] += imu_by
            pipeline.imu(samples)
            pipeline.sweep(moved(sweep, cloud_by), number * 200_000_000)
            poses += [(number, item) for item in pipeline.poll(number * 200_000_000 + 10**9)]
    assert [number for number, _ in poses][-4:] == [10, 11, 12, 13], (by, who)
    for _, item in poses:
        assert np.isfinite(item.T_map_lidar).all()
        assert np.linalg.norm(item.T_map_lidar[:3, 3]) < 20.0, (by, who)
    assert pipeline.counts.total() < 200
