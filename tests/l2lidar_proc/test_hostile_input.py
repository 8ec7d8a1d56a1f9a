"""Whatever comes in, nothing that is not finite comes out, and no sweep is lost."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings, strategies as st

from l2lidar_node.settings import build
from l2lidar_node.types import IMU_SAMPLE, HostNs, Sweep
from l2lidar_proc.deskew.config import ProcConfig
from l2lidar_proc.deskew.pipeline import Pipeline
from tests.l2lidar_proc.motion.analytic import EPOCH, Motion, at, seen

MS = 1_000_000
POINTS = seen(Motion(), 0, 0.1, 0, count=50)[0]

numbers = st.floats(-50, 50) | st.sampled_from([0.0, 1e3, -1e6, 1e18, float("nan"), float("inf")])
vectors = st.tuples(numbers, numbers, numbers)
steps = st.integers(-20, 60) | st.sampled_from([0, 300, 700, -900, 2_000, -5_000, 10**7])


@st.composite
def imu_run(draw: Any) -> Any:
    """Return how a run of samples goes on: how many, how far apart, what they say."""
    return ("imu", draw(st.integers(1, 60)), draw(steps), draw(vectors), draw(vectors))


@st.composite
def sweep_event(draw: Any) -> Any:
    return ("sweep", draw(steps))


@st.composite
def velocity_event(draw: Any) -> Any:
    return ("velocity", draw(steps), draw(vectors))


@settings(max_examples=150, deadline=None)
@given(
    st.lists(imu_run() | sweep_event() | velocity_event(), max_size=30),
    st.sampled_from(["start", "middle", "end"]),
    st.booleans(),
)
def test_anything_goes(events: Any, reference: Any, use_accelerometer: Any) -> None:
    pipeline = Pipeline(
        build(ProcConfig, {"reference": reference, "use_accelerometer": use_accelerometer})
    )
    random = np.random.default_rng(1)
    now = imu = EPOCH
    sent, done = 0, []
    for event in events:
        if event[0] == "imu":
            _, count, step, rate, force = event
            samples = np.zeros(count, dtype=IMU_SAMPLE)
            samples["stamp"] = imu + np.cumsum(np.full(count, max(step, -20) * MS // 8))
            imu = HostNs(int(samples["stamp"][-1]) + (step if step < -20 else 0) * MS)
            samples["angular_velocity"] = rate + random.normal(0, 0.01, (count, 3))
            samples["linear_acceleration"] = force + random.normal(0, 0.01, (count, 3))
            pipeline.imu(samples)
        elif event[0] == "velocity":
            pipeline.velocity(HostNs(imu + event[1] * MS), event[2], "odometry")
        else:
            start = imu + event[1] * MS
            pipeline.sweep(Sweep(HostNs(start), HostNs(start + 100 * MS), POINTS, 1, 0), now)
            sent += 1
        now = HostNs(now + 10 * MS)
        done += pipeline.poll(now)
    done += pipeline.poll(now + 10**12)
    assert len(done) == sent == pipeline.counts.sweeps
    for item in done:
        for axis in "xyz":
            assert np.isfinite(item.points[axis]).all()
        assert np.isfinite(item.quality.bias).all()


def test_an_imu_without_accelerometer() -> None:
    samples = Motion(turn=1.0).imu(0, 5)
    samples["linear_acceleration"] = 0.0
    pipeline = Pipeline(ProcConfig())
    for i in range(0, len(samples), 25):
        pipeline.imu(samples[i : i + 25])
    pipeline.sweep(Sweep(at(4.5), at(4.7), POINTS, 1, 0), 0)
    (item,) = pipeline.poll(0)
    assert np.isfinite(item.points["x"]).all()
    assert item.quality.rotation_rad > 0.19
