"""The tracker puts IMU, attitude and velocities together and is honest about what it has."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2lidar_node import rotations
from l2lidar_node.protocol import wire
from l2lidar_node.settings import SettingError, build
from l2lidar_node.types import IMU_SAMPLE, HostNs
from l2lidar_proc.deskew.deskew import deskew
from l2lidar_proc.motion.config import MotionConfig
from l2lidar_proc.motion.sweep_motion import SweepTrajectory
from l2lidar_proc.motion.tracker import Flag, KnownMotion, MotionTracker, cloud_velocity
from tests.l2lidar_proc.motion.analytic import (
    EPOCH,
    T_CLOUD_IMU,
    Motion,
    at,
    noisy,
    rms,
    seen,
    xyz,
)

WALK = Motion(turn=1.0, nod=0.1, speed=1.0)
START, END = 6.0, 6.23


def tracked(samples: Any, motion: Any = None, config: Any = None) -> MotionTracker:
    """Return a tracker that followed samples, with velocities up to 0.1 s before the sweep."""
    tracker = MotionTracker(config or MotionConfig())
    for i in range(0, len(samples), 10):
        tracker.imu(samples[i : i + 10])
        t = (int(samples["stamp"][min(i + 9, len(samples) - 1)]) - EPOCH) * 1e-9
        if motion is not None and t < START - 0.1:
            tracker.velocity(at(t), motion.velocity(np.array([t]))[0], "odometry")
    return tracker


def test_a_walk_with_a_velocity_from_before_the_sweep() -> None:
    tracker = tracked(WALK.imu(0, END + 0.01), WALK)
    trajectory, quality = tracker.trajectory(at(START), at(END))
    points, truth = seen(WALK, START, END, START)
    assert rms(xyz(points) - truth) > 0.3
    assert rms(xyz(deskew(points, at(START), trajectory, at(START))) - truth) < 0.004
    assert quality.flags == ()
    assert quality.velocity_source == "odometry"
    assert quality.velocity_age_ns == pytest.approx(0.35e9, abs=0.06e9)
    assert quality.rotation_rad == pytest.approx(0.24, abs=0.05)
    assert quality.translation_m == pytest.approx(0.23, abs=0.02)
    assert quality.imu_covered == 1.0
    assert quality.imu_gap_ns == 4_000_000
    assert quality.is_gravity_trusted
    assert not quality.is_still
    for sigma, is_trusted, flags in (
        (0.03, True, ()),
        (0.3, True, (Flag.UNTRUSTED_VELOCITY,)),
        (0.03, False, (Flag.UNTRUSTED_VELOCITY,)),
    ):
        known = KnownMotion(trajectory, True, sigma, is_trusted)
        found, told = tracker.trajectory(at(START), at(END), known)
        assert found is trajectory
        assert told.flags == flags
        assert told.velocity_sigma == sigma


def known(start: float, end: float) -> KnownMotion:
    """Return the true motion of a walk as an odometry knows it, seen from the middle."""
    t = np.linspace(start, end, 60)
    middle = np.array([(start + end) / 2])
    origin, turn = WALK.position(middle), WALK.rotation(middle).inv()
    h = 1e-4
    rates = (WALK.rotation(t - h).inv() * WALK.rotation(t + h)).as_rotvec() / (2 * h)
    q = np.roll((turn * WALK.rotation(t)).as_quat(), 1, axis=1)
    stamps = EPOCH + np.round(t * 1e9).astype(np.int64)
    positions = turn.apply(WALK.position(t) - origin)
    return KnownMotion(SweepTrajectory(stamps, q, positions, rates), is_aligned=True)


@pytest.mark.parametrize(("gap_s", "is_known"), [(-0.1, True), (0.0, True), (0.1, False)])
def test_from_sweep_to_sweep_the_odometry_knows_how_far_it_is(
    gap_s: float, is_known: bool
) -> None:
    """The tracker has rotations only: while the odometry knows better it takes no velocity."""
    tracker = tracked(WALK.imu(0, END + 0.4))
    before, now = known(START, END), known(END + gap_s, END + 0.35)
    source, target = START + 0.05, END + 0.2

    alone = tracker.motion(at(source), at(target))
    found = tracker.motion(at(source), at(target), before, now)

    instants = np.array([source, target])
    places, turns = WALK.position(instants), WALK.rotation(instants)
    way = turns[1].inv().apply(places[0] - places[1])
    assert alone is not None
    assert found is not None
    assert not alone[:3, 3].any()
    np.testing.assert_allclose(found[:3, 3], way if is_known else 0.0, atol=1e-3)
    turn = (turns[1].inv() * turns[0]).as_matrix()
    np.testing.assert_allclose(found[:3, :3], turn, atol=0.01)
    assert tracker.motion(at(target), at(source), before, now) is None


def test_the_accelerometer_makes_the_difference() -> None:
    points, truth = seen(WALK, START, END, START)
    errors = []
    for use in (True, False):
        config = replace(MotionConfig(), use_accelerometer=use)
        trajectory, _ = tracked(WALK.imu(0, END + 0.01), WALK, config).trajectory(
            at(START), at(END)
        )
        errors.append(rms(xyz(deskew(points, at(START), trajectory, at(START))) - truth))
    assert errors[0] < errors[1] / 3


def test_without_velocity_rotation_only_and_it_says_so() -> None:
    trajectory, quality = tracked(WALK.imu(0, END + 0.01)).trajectory(at(START), at(END))
    assert quality.flags == (Flag.NO_VELOCITY,)
    assert quality.translation_m == 0.0
    assert quality.rotation_rad > 0.2
    assert not trajectory.positions.any()


def test_a_sensor_at_rest_has_a_path_that_does_not_move() -> None:
    samples = noisy(Motion().imu(0, END + 0.01, (0.02, -0.03, 0.01)))
    for tracker, (start, end) in (
        (tracked(samples), (START, END)),
        (tracked(samples[:60]), (0.0, 0.23)),
    ):
        trajectory, quality = tracker.trajectory(at(start), at(end))
        assert quality.is_still
        assert quality.flags == ()
        points, _ = seen(Motion(), start, end, start)
        assert deskew(points, at(start), trajectory, at(end)).tobytes() == points.tobytes()


def test_a_smooth_ride_is_not_taken_for_rest_when_a_velocity_says_otherwise() -> None:
    samples = noisy(Motion().imu(0, END + 0.01))
    _, quality = tracked(samples, Motion(speed=0.5)).trajectory(at(START), at(END))
    assert not quality.is_still
    assert quality.translation_m == pytest.approx(0.115, abs=0.02)


def creeping(speed: float, last: float, still_speed: float = 0.05) -> MotionTracker:
    """Return a tracker whose IMU says rest and whose velocities end at an instant [s]."""
    tracker = MotionTracker(replace(MotionConfig(), still_speed=still_speed))
    tracker.imu(noisy(Motion().imu(0, END + 0.3)))
    for t in np.arange(last - 1.0, last + 0.01, 0.1):
        tracker.velocity(at(t), (speed, 0.0, 0.0), "odometry")
    return tracker


@pytest.mark.parametrize(
    ("speed", "still_speed", "is_still"),
    [(0.04, 0.05, True), (0.07, 0.05, False), (0.07, 0.08, True), (0.09, 0.08, False)],
)
def test_rest_is_believed_up_to_the_velocity_that_is_configured(
    speed: float, still_speed: float, is_still: bool
) -> None:
    _, quality = creeping(speed, END, still_speed).trajectory(at(START), at(END))
    assert quality.is_still == is_still


def test_a_velocity_serves_to_its_greatest_age_and_not_beyond() -> None:
    """500 ms, counted to the end of a sweep at rest and to the start of one in motion."""
    last = at(5.0)
    for late_ms, is_still in ((0, False), (1, True)):
        end = HostNs(last + (500 + late_ms) * 1_000_000)
        _, quality = creeping(0.07, 5.0).trajectory(HostNs(end - 230_000_000), end)
        assert quality.is_still == is_still
    for late_ms, flags in ((0, ()), (1, (Flag.NO_VELOCITY,))):
        start = HostNs(last + (500 + late_ms) * 1_000_000)
        tracker = MotionTracker(MotionConfig())
        tracker.imu(WALK.imu(0, END))
        for t in np.arange(4.0, 5.01, 0.1):
            tracker.velocity(at(t), WALK.velocity(np.array([t]))[0], "odometry")
        _, quality = tracker.trajectory(start, HostNs(start + 230_000_000))
        assert quality.flags == flags
        if not flags:
            assert quality.velocity_age_ns == 730_000_000


@pytest.mark.parametrize(
    ("keep", "flags", "covered"),
    [
        (lambda t: t < 6.1, (Flag.IMU_ENDS_EARLY, Flag.IMU_GAP), 0.1 / 0.23),
        (lambda t: t > 6.1, (Flag.IMU_STARTS_LATE, Flag.IMU_GAP), 0.13 / 0.23),
        (lambda t: (t < 6.1) | (t > 6.15), (Flag.IMU_GAP,), 1.0),
        (lambda t: (t < 6.1) | (t > 6.11), (), 1.0),
        (lambda t: t < 5.9, (Flag.NO_IMU,), 0.0),
        (lambda t: t < 0, (Flag.NO_IMU,), 0.0),
    ],
)
def test_missing_samples_are_reported(keep: Any, flags: Any, covered: Any) -> None:
    samples = WALK.imu(0, END + 0.01)
    samples = samples[keep((samples["stamp"] - EPOCH) * 1e-9)]
    trajectory, quality = tracked(samples).trajectory(at(START), at(END))
    assert tuple(flag for flag in quality.flags if flag is not Flag.NO_VELOCITY) == flags
    assert quality.imu_covered == pytest.approx(covered, abs=0.03)
    assert np.isfinite(trajectory.rotations_wxyz).all()
    assert (trajectory.rates.any() or trajectory.positions.any()) == (Flag.NO_IMU not in flags)


def test_a_faulty_accelerometer_is_reported_and_left_alone() -> None:
    samples = Motion(turn=1.0, speed=1.0).imu(0, END + 0.01)
    samples["linear_acceleration"] *= 2.0
    tracker = tracked(samples, Motion(turn=1.0, speed=1.0))
    _, quality = tracker.trajectory(at(START), at(END))
    assert quality.flags == (Flag.ACCELEROMETER_FAULT,)
    assert not quality.is_gravity_trusted
    assert quality.translation_m == pytest.approx(0.23, abs=0.02)


def test_a_jump_of_the_imu_clock_forgets_what_was() -> None:
    tracker = tracked(WALK.imu(0, 3), WALK)
    assert tracker.imu(WALK.imu(10, 10.5))
    assert tracker.buffer.samples["stamp"][0] == at(10)
    assert tracker.filter.newest_twist is None
    _, quality = tracker.trajectory(at(10.1), at(10.3))
    assert quality.flags == (Flag.NO_VELOCITY,)


def test_the_mount_of_the_imu() -> None:
    assert MotionConfig().imu_xyz == wire.IMU_POSITION_M
    np.testing.assert_allclose(MotionConfig().T_cloud_imu, T_CLOUD_IMU)
    turned = build(
        MotionConfig, {"imu_rpy": [0.0, 0.0, 90.0], "imu_xyz": [1.0, 2.0, 3.0]}
    ).T_cloud_imu
    np.testing.assert_allclose(turned @ (1, 0, 0, 1), (1, 3, 3, 1), atol=1e-12)
    both = build(MotionConfig, {"imu_rpy": [90.0, 0.0, 90.0]}).T_cloud_imu[:3, :3]
    np.testing.assert_allclose(both @ (0, 1, 0), (0, 0, 1), atol=1e-12)
    np.testing.assert_allclose(rotations.from_matrix(both), (0.5, 0.5, 0.5, 0.5), atol=1e-12)
    with pytest.raises(SettingError, match="imu_xyz"):
        build(MotionConfig, {"imu_xyz": [1.0]})


def test_another_mount_turns_the_samples_so_far_and_forgets_what_was_learned() -> None:
    tracker = tracked(noisy(Motion().imu(0, END)))
    before = tracker.buffer.samples["angular_velocity"].copy()
    learned = tracker.filter
    assert not tracker.mount(T_CLOUD_IMU)
    assert tracker.filter is learned
    turn = rotations.transform([np.cos(0.5), 0, 0, np.sin(0.5)], (0, 0, 0))
    assert tracker.mount(turn @ T_CLOUD_IMU)
    assert tracker.filter is not learned
    expected = before @ turn[:3, :3].T
    np.testing.assert_allclose(tracker.buffer.samples["angular_velocity"], expected, atol=1e-12)


def test_another_scale_of_the_accelerometer_holds_for_the_samples_so_far() -> None:
    samples = noisy(Motion().imu(0, END))
    expected = tracked(samples)
    samples["linear_acceleration"] /= -2.0
    tracker = tracked(samples)
    assert tracker.filter.is_faulty
    learned = tracker.filter
    tracker.rescale(1.0, -2.0)
    assert tracker.filter is not learned
    _, quality = tracker.trajectory(at(START), at(END))
    assert quality.flags == ()
    assert quality.is_gravity_trusted
    up = expected.filter.up_at(at(END))
    np.testing.assert_allclose(tracker.filter.up_at(at(END)), up, atol=1e-3)
    np.testing.assert_allclose(tracker.bias, expected.bias, atol=2e-3)


def test_velocity_of_a_mounted_sensor() -> None:
    """A sensor one meter ahead of a body that turns left moves to the left as well."""
    mount = rotations.transform([np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)], (1.0, 0.0, 0.2))
    velocity = cloud_velocity((0.5, 0, 0), (0, 0, 2.0), rotations.inverse(mount))
    expected = Rotation.from_euler("z", -90, degrees=True).apply((0.5, 2.0, 0))
    np.testing.assert_allclose(velocity, expected, atol=1e-12)


def sampled(hz: float, seconds: float, turn: float = 0.0, first: float = 0.0) -> Any:
    """Return noisy samples of an IMU of another rate, level, with a bias of 0.02 rad/s."""
    rng = np.random.default_rng(4)
    made = np.zeros(round(seconds * hz), IMU_SAMPLE)
    made["stamp"] = EPOCH + np.round(1e9 * (first + np.arange(len(made)) / hz)).astype(np.int64)
    made["angular_velocity"] = rng.normal(0.02, 0.003, (len(made), 3))
    made["angular_velocity"][:, 2] += turn
    made["linear_acceleration"] = rng.normal((0.0, 0.0, 9.81), 0.02, (len(made), 3))
    return made


@pytest.mark.parametrize("hz", [20.0, 50.0, 90.0, 100.0, 250.0, 400.0, 1000.0])
def test_rest_is_found_at_any_rate_of_the_imu(hz: float) -> None:
    tracker = tracked(sampled(hz, 8.0))
    np.testing.assert_allclose(tracker.bias, 0.02, atol=1e-3)
    _, quality = tracker.trajectory(at(7.0), at(7.9))
    assert quality.is_still
    tracker.imu(sampled(hz, 4.0, turn=0.1, first=8.0))
    for start in (8.5, 11.7):
        trajectory, quality = tracker.trajectory(at(start), at(start + 0.2))
        assert not quality.is_still
        turned, _ = trajectory.between(at(start), at(start + 0.2))
        assert np.linalg.norm(rotations.log(turned)) == pytest.approx(0.02, rel=0.1)
    np.testing.assert_allclose(tracker.bias, 0.02, atol=2e-3)
