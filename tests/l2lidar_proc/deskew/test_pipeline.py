"""Sweeps, samples and velocities in, clouds out: nothing lost, finite, with stamps that fit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from l2lidar_node.settings import build
from l2lidar_node.types import POINT, STANDARD_GRAVITY, HostNs, Sweep
from l2lidar_proc.deskew.config import ProcConfig
from l2lidar_proc.deskew.pipeline import Pipeline
from l2lidar_proc.motion.imu_corrections import ImuConvention
from l2lidar_proc.motion.sweep_motion import still_trajectory
from l2lidar_proc.motion.tracker import Flag, KnownMotion
from tests.l2lidar_proc.motion.analytic import EPOCH, Motion, at, noisy, rms, seen, xyz

WALK = Motion(turn=1.0, nod=0.1, speed=1.0)
STILL = Motion()
MS = 1_000_000
LENGTH = 0.23


def sweep_at(motion: Motion, start: float, length: float = LENGTH) -> Sweep:
    points, _ = seen(motion, start, start + length, start, count=3000)
    points.flags.writeable = False
    return Sweep(at(start), at(start + length), points, 50, 0)


def run(
    motion: Motion,
    seconds: float,
    values: Any = None,
    samples: Any = None,
    velocity: bool = True,
    odometry: Callable[[Sweep], KnownMotion | None] | None = None,
) -> Any:
    """Return what comes out of a recording of ``seconds``, fed in order of time."""
    pipeline = Pipeline(build(ProcConfig, values or {}))
    pipeline.odometry_motion = odometry
    samples = noisy(motion.imu(0, seconds), 0, 0, 0) if samples is None else samples
    done = []
    starts = np.arange(0.0, seconds - LENGTH, LENGTH)
    pending = [(at(s + LENGTH), s) for s in starts]
    for i in range(0, len(samples), 5):
        now = int(samples["stamp"][min(i + 4, len(samples) - 1)])
        pipeline.imu(samples[i : i + 5])
        while pending and pending[0][0] <= now:
            _, s = pending.pop(0)
            if velocity:
                pipeline.velocity(at(s), motion.velocity(np.array([s]))[0], "odometry")
            pipeline.sweep(sweep_at(motion, s), now)
        done.extend(pipeline.poll(now))
    done.extend(pipeline.poll(at(seconds + 10)))
    assert len(done) == len(starts) - len(pending)
    for item in done:
        assert all(np.isfinite(item.points[axis]).all() for axis in "xyz")
    return pipeline, done


@pytest.mark.parametrize("reference", ["start", "middle", "end"])
def test_a_walk_is_deskewed_at_each_reference(reference: str) -> None:
    pipeline, done = run(WALK, 6.0, {"reference": reference})
    counts = pipeline.counts
    assert counts.deskewed == counts.sweeps - counts.still >= len(done) - 12
    for item in done[12:]:
        start = (item.sweep.start - EPOCH) * 1e-9
        share = {"start": 0.0, "middle": 0.5, "end": 1.0}[reference]
        assert abs(item.stamp - item.sweep.start - round(share * LENGTH * 1e9)) <= 1
        _, truth = seen(WALK, start, start + LENGTH, start + share * LENGTH, count=3000)
        assert rms(xyz(item.points) - truth) < 0.01
        assert "time" not in (item.points.dtype.names or ())
        assert item.waited_ns <= 20 * MS


def test_the_filter_takes_over_where_the_odometry_ends() -> None:
    """Until then it follows once a second and takes no velocity: the odometry knows better."""
    ends, known = 3.0, []

    def odometry(sweep: Sweep) -> KnownMotion | None:
        if sweep.start >= at(ends):
            return None
        known.append(sweep)
        return KnownMotion(still_trajectory(sweep.start, sweep.end), True)

    _, done = run(WALK, 6.0, odometry=odometry)
    assert len(known) == 14
    for item in done[:14]:
        assert (xyz(item.points) == xyz(item.sweep.points)).all()
    sources = [item.quality.velocity_source for item in done[14:]]
    assert set(sources[1:]) == {"odometry"}
    for item in done[17:]:
        start = (item.sweep.start - EPOCH) * 1e-9
        _, truth = seen(WALK, start, start + LENGTH, start, count=3000)
        assert rms(xyz(item.points) - truth) < 0.015


def test_a_still_sensor_comes_out_bit_for_bit() -> None:
    noise = noisy(STILL.imu(0, 4, (0.02, 0.01, -0.03)))
    pipeline, done = run(STILL, 4.0, {"keep_time": True}, noise, velocity=False)
    for item in done:
        assert item.quality.is_still
        assert item.points.tobytes() == item.sweep.points.tobytes()
        assert item.stamp == item.sweep.start
    assert pipeline.counts.still == pipeline.counts.sweeps == len(done)
    _, done = run(STILL, 1.0, None, noise[:250], velocity=False)
    assert all((item.points["x"] == item.sweep.points["x"]).all() for item in done)


def test_keep_time_counts_from_the_stamp() -> None:
    _, done = run(WALK, 1.0, {"keep_time": True, "reference": "end"})
    for item in done:
        expected = item.sweep.points["time"] - np.float32(LENGTH)
        np.testing.assert_allclose(item.points["time"], expected, atol=3e-8)


@pytest.mark.parametrize("chain", ["filters_before", "filters_after"])
def test_after_filtering_the_first_point_has_time_0_and_the_stamp(chain: str) -> None:
    values = {chain: ["range", "voxel"], "range_max": 10.0, "voxel_size": 1.0, "keep_time": True}
    _, done = run(WALK, 6.0, {"filters_before": [], **values})
    for item in done[12:]:
        assert 0 < len(item.points) < 2500
        assert item.points["time"][0] == 0.0
        assert (np.diff(item.points["time"]) >= 0).all()
        start = (item.sweep.start - EPOCH) * 1e-9
        _, truth = seen(WALK, start, start + LENGTH, (item.stamp - EPOCH) * 1e-9, count=3000)
        index = np.flatnonzero(np.isin(item.sweep.points["range"], item.points["range"]))
        assert rms(xyz(item.points) - truth[index]) < 0.01
    assert any(item.stamp > item.sweep.start for item in done)


def test_a_constant_time_is_never_kept() -> None:
    points, _ = seen(STILL, 1.0, 1.2, 1.0, count=3)
    points["range"] = points["x"] = points["y"] = points["z"] = (1.0, 5.0, 5.0)
    pipeline = Pipeline(build(ProcConfig, {"keep_time": True, "range_max": 3.0}))
    pipeline.imu(STILL.imu(0, 2))
    pipeline.sweep(Sweep(at(1.0), at(1.2), points, 1, 0), 0)
    (item,) = pipeline.poll(0)
    assert len(item.points) == 1
    assert "time" not in (item.points.dtype.names or ())


def test_everything_filtered_away_is_an_empty_cloud_not_a_lost_one() -> None:
    _, done = run(WALK, 1.0, {"range_min": 500.0})
    assert done
    assert all(len(item.points) == 0 for item in done)


def test_without_imu_sweeps_pass_through_and_say_so() -> None:
    pipeline = Pipeline(build(ProcConfig, {"imu_wait_ms": 30, "reference": "end"}))
    sweep = sweep_at(WALK, 1.0)
    pipeline.sweep(sweep, 0)
    assert pipeline.due_ns == 30 * MS
    assert pipeline.poll(29 * MS) == []
    (item,) = pipeline.poll(30 * MS)
    assert item.points.tobytes() == sweep.points.tobytes()
    assert item.stamp == sweep.start
    assert Flag.NO_IMU in item.quality.flags
    assert pipeline.counts.passed_on == pipeline.counts.uncovered == 1
    assert pipeline.counts.deskewed == pipeline.counts.still == 0
    assert item.waited_ns == 30 * MS


def test_imu_that_stops_within_a_sweep_deskews_as_far_as_it_goes() -> None:
    samples = WALK.imu(0, 1.1)
    pipeline = Pipeline(ProcConfig())
    pipeline.imu(samples)
    pipeline.sweep(sweep_at(WALK, 1.0), 0)
    assert pipeline.poll(1) == []
    (item,) = pipeline.poll(50 * MS)
    assert Flag.IMU_ENDS_EARLY in item.quality.flags
    assert pipeline.counts.uncovered == 1
    assert not np.array_equal(item.points["x"], item.sweep.points["x"])


def test_disorder_in_the_samples_changes_nothing() -> None:
    samples = WALK.imu(0, 3)
    _, expected = run(WALK, 3.0, samples=samples)
    shuffled = samples.copy()
    for i in range(100, 700, 5):
        shuffled[i], shuffled[i + 1] = samples[i + 1], samples[i]
    shuffled[300] = shuffled[299]
    shuffled["angular_velocity"][400] = np.nan
    pipeline, done = run(WALK, 3.0, samples=shuffled)
    counts = pipeline.tracker.buffer.counts
    assert counts.reordered > 100
    assert (counts.duplicate, counts.invalid) == (1, 1)
    for a, b in zip(expected, done, strict=True):
        assert rms(xyz(a.points) - xyz(b.points)) < 0.003


def test_a_clock_that_jumps_back_loses_no_sweep() -> None:
    pipeline = Pipeline(ProcConfig())
    pipeline.imu(WALK.imu(10, 10.2))
    pipeline.sweep(sweep_at(WALK, 10.0), 0)
    pipeline.sweep(sweep_at(WALK, 2.0), 1)
    (old,) = pipeline.poll(2)
    assert Flag.CLOCK_JUMP in old.quality.flags
    assert len(pipeline.tracker.buffer) == 0
    pipeline.imu(WALK.imu(1.9, 2.3))
    (new,) = pipeline.poll(3)
    assert new.quality.flags == (Flag.NO_VELOCITY,)
    assert pipeline.counts.jumps == 1
    pipeline.sweep(sweep_at(WALK, 2.23), 4)
    pipeline.imu(WALK.imu(0.5, 0.6))
    (waiting,) = pipeline.poll(5)
    assert Flag.CLOCK_JUMP in waiting.quality.flags
    assert pipeline.counts.sweeps == 3


def test_a_filter_that_cannot_work_costs_no_sweep() -> None:
    pipeline = Pipeline(build(ProcConfig, {"filters_before": ["intensity"]}))
    bare = np.zeros(5, dtype=[(n, "<f4") for n in ("x", "y", "z", "time")])
    bare["time"] = np.arange(5) * 0.01
    pipeline.imu(WALK.imu(0, 1))
    pipeline.sweep(Sweep(at(0.2), at(0.24), bare, 0, 0), 0)
    (item,) = pipeline.poll(0)
    assert Flag.FILTER_LEFT_OUT in item.quality.flags
    assert "intensity" in pipeline.problems
    assert len(item.points) == 5


def test_organised_output_and_live_settings() -> None:
    pipeline = Pipeline(ProcConfig())
    pipeline.configure(build(ProcConfig, {"organised": True, "imu_wait_ms": 0}))
    points = np.zeros(600, dtype=POINT)
    slot = np.arange(300)
    points["time"] = np.concatenate((slot * 7.73e-6, 4.639e-3 + slot * 7.73e-6))
    points["x"] = 1.0
    kept = np.delete(points, [5, 400])
    pipeline.sweep(Sweep(at(0), at(0.007), kept, 2, 0), 0)
    (item,) = pipeline.poll(0)
    assert item.points.shape == (2, 300)
    assert np.argwhere(np.isnan(item.points["x"])).tolist() == [[0, 5], [1, 100]]


def test_an_empty_sweep_goes_through() -> None:
    pipeline = Pipeline(ProcConfig())
    pipeline.imu(WALK.imu(0, 1))
    pipeline.sweep(Sweep(at(0.2), HostNs(at(0.4)), np.zeros(0, POINT), 0, 50), 0)
    (item,) = pipeline.poll(0)
    assert len(item.points) == 0
    assert item.stamp == at(0.2)


def test_stamps_of_the_imu_that_are_late_are_put_right() -> None:
    samples = noisy(WALK.imu(0, 3.0), 0, 0, 0)
    late = samples.copy()
    late["stamp"] += 4 * MS
    right = run(WALK, 3.0, samples=samples)
    put_right = run(WALK, 3.0, {"imu_time_offset_ms": 4.0}, samples=late)
    wrong = run(WALK, 3.0, samples=late)
    last = [xyz(done[-1].points) for _, done in (right, put_right, wrong)]
    np.testing.assert_allclose(last[1], last[0], atol=1e-6)
    assert rms(last[2] - last[0]) > 1e-3


def test_an_accelerometer_in_g_is_as_good_as_any() -> None:
    samples = WALK.imu(0, 4.0)
    in_g = samples.copy()
    in_g["linear_acceleration"] /= STANDARD_GRAVITY
    _, expected = run(WALK, 4.0, samples=samples)
    pipeline, done = run(WALK, 4.0, samples=in_g)
    for a, b in zip(expected, done, strict=True):
        assert a.quality.flags == b.quality.flags
        assert b.quality.is_gravity_trusted == a.quality.is_gravity_trusted
        np.testing.assert_allclose(xyz(b.points), xyz(a.points), atol=1e-5)
    assert done[-1].quality.is_gravity_trusted
    assert pipeline.convention.in_g
    assert in_g["linear_acceleration"][0, 2] < 2.0  # what came in was not changed


def test_a_gyro_in_degrees_is_as_good_as_any_once_it_is_known() -> None:
    samples = WALK.imu(0, 8.0)
    in_degrees = samples.copy()
    in_degrees["angular_velocity"] = np.rad2deg(in_degrees["angular_velocity"])
    _, expected = run(WALK, 8.0, samples=samples)
    pipeline, done = run(WALK, 8.0, samples=in_degrees)
    assert pipeline.convention.in_degrees
    assert "the gyro measures in degrees" in pipeline.convention.notes[0]
    np.testing.assert_allclose(xyz(done[-1].points), xyz(expected[-1].points), atol=0.02)


def upright(pipeline: Pipeline, t: float) -> float:
    """Return how much of the vertical is along the cloud's z axis."""
    up = pipeline.tracker.up(at(t))
    return float(up[2]) if up is not None else 0.0


@pytest.mark.parametrize("size", [1.0, 1.0 / STANDARD_GRAVITY])
def test_unit_and_sign_that_an_odometry_finds_hold_for_what_came_before(size: float) -> None:
    """And after the odometry has gone."""
    samples = noisy(Motion().imu(0, 6.0))
    samples["linear_acceleration"] *= -size
    found: ImuConvention | None = ImuConvention()
    pipeline = Pipeline(ProcConfig())
    pipeline.odometry_convention = lambda: found
    for i in range(0, 1000, 10):
        found.corrected(samples[i : i + 10])
        pipeline.imu(samples[i : i + 10])
    assert upright(pipeline, 3.9) < -0.99
    pipeline.sweep(sweep_at(STILL, 3.95), 0)
    found.reversed = True
    pipeline.imu(samples[1000:1200])
    (item,) = pipeline.poll(0)
    assert item.quality.flags == ()
    assert item.quality.is_still
    assert item.quality.is_gravity_trusted
    for t in (2.0, 4.5):
        assert upright(pipeline, t) > 0.99
    found = None
    pipeline.imu(samples[1200:])
    assert upright(pipeline, 5.9) > 0.99


def test_an_odometry_without_samples_does_not_know_the_unit() -> None:
    samples = noisy(Motion().imu(0, 2.0), force=0.0)
    samples["linear_acceleration"] /= STANDARD_GRAVITY
    pipeline = Pipeline(ProcConfig())
    paused = ImuConvention()
    pipeline.odometry_convention = lambda: paused
    pipeline.imu(samples)
    assert upright(pipeline, 1.9) > 0.99
