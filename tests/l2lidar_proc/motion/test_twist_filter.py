"""The twist filter: vertical, bias and velocity through rest and motion."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from l2lidar_node import rotations
from l2lidar_proc import tuning
from l2lidar_proc.motion.imu_buffer import ImuBuffer
from l2lidar_proc.motion.static import white_noise
from l2lidar_proc.motion.twist_filter import TwistFilter
from tests.l2lidar_proc.motion.analytic import EPOCH, T_CLOUD_IMU, G, Motion, at, noisy

BIAS = (0.03, -0.02, 0.03)


def at_rest_then(motion: Motion, rest: float, end: float) -> np.ndarray:
    """Return noisy samples of a rest in the motion's first attitude, then the motion."""
    moving = motion.imu(rest, end, BIAS)
    first = motion.rotation(np.array([rest])).inv().apply([(0, 0, G)])[0]
    resting = np.zeros(round(rest * 250), dtype=moving.dtype)
    resting["stamp"] = EPOCH + np.arange(len(resting)) * 4_000_000
    resting["angular_velocity"] = BIAS
    resting["linear_acceleration"] = first
    return noisy(np.concatenate((resting, moving)))


def follow(
    samples: Any, motion: Any = None, rest: float = 0.0, every: int = 50, late_s: float = 0.0
) -> TwistFilter:
    """Return a filter that followed samples, with true velocities of a motion if given."""
    buffer = ImuBuffer(25.0)
    found = TwistFilter(buffer, T_CLOUD_IMU[:3, 3], 0.1)
    for i in range(0, len(samples), 10):
        buffer.push(samples[i : i + 10])
        found.follow()
        if motion is not None and i % every == 0:
            t = (int(samples["stamp"][i]) - EPOCH) * 1e-9 - late_s
            if t >= 0:
                found.take(at(t), motion.velocity(np.array([t]))[0] * (t >= rest), "odometry")
    return found


def tilt_error(found: TwistFilter, motion: Motion, t: float) -> float:
    """Return the angle between the true vertical and that of a state lagging behind."""
    moment = np.array([(found._state.stamp - EPOCH) * 1e-9])
    assert t - 1.0 < moment[0] < t + 1e-6
    up = motion.rotation(moment).inv().apply([(0, 0, 1)])[0]
    return float(np.arccos(np.clip(up @ found.up, -1, 1)))


def test_rest_gives_bias_gravity_and_stillness() -> None:
    found = follow(noisy(Motion(nod=0.0).imu(0, 4, BIAS)))
    assert np.abs(found.gyro_bias - BIAS).max() < 0.006
    assert 1e-4 < found.gyro_bias_sigma < 0.006
    assert found.is_trusted
    assert not found.is_faulty
    assert found.gravity == pytest.approx(G, abs=0.02)
    assert tilt_error(found, Motion(), 4.0) < 0.003
    assert found.is_still(noisy(Motion().imu(3, 3.3, BIAS), seed=9))
    assert not found.is_still(noisy(Motion(turn=0.5).imu(3, 3.3, BIAS), seed=9))


def test_stillness_shows_within_the_first_sweep_but_not_in_motion() -> None:
    assert follow(Motion().imu(0, 0.2)).is_still(noisy(Motion().imu(0, 0.23, BIAS)))
    walk = Motion(turn=0.5, nod=0.1, speed=0.7)
    assert not follow(walk.imu(0, 0.2)).is_still(noisy(walk.imu(0, 0.23, BIAS)))


def test_noise_is_a_density_and_more_than_the_usual_where_more_shows() -> None:
    """White noise of a standard deviation s in samples 4 ms apart has the density 2 s sqrt(ms)."""
    samples = Motion().imu(0, 40)
    found = TwistFilter(ImuBuffer(), np.zeros(3), 0.1)
    quiet = found._noise(samples)
    assert quiet.gyro == pytest.approx(tuning.TRACKER_GYRO_NOISE * np.sqrt(0.004))
    assert quiet.accel == pytest.approx(tuning.TRACKER_ACCEL_NOISE * np.sqrt(0.004))
    rng = np.random.default_rng(0)
    samples["angular_velocity"] += rng.normal(0.0, 0.3, (len(samples), 3))
    samples["linear_acceleration"] += rng.normal(0.0, 0.7, (len(samples), 3))
    loud = found._noise(samples)
    assert loud.gyro == pytest.approx(0.3 * np.sqrt(0.004), rel=0.05)
    assert loud.accel == pytest.approx(0.7 * np.sqrt(0.004), rel=0.05)


@pytest.mark.parametrize("hz", [100.0, 1000.0])
def test_measured_noise_has_the_rate_of_the_imu(hz: float) -> None:
    """A few samples between two velocities have the rate of those around them."""
    rng = np.random.default_rng(0)
    samples = Motion().imu(0, 8)
    samples["stamp"] = EPOCH + np.arange(len(samples)) * round(1e9 / hz)
    samples["angular_velocity"] += rng.normal(0.0, 0.5, (len(samples), 3))
    samples["linear_acceleration"] += rng.normal(0.0, 0.9, (len(samples), 3))
    found = follow(samples)
    scale = np.sqrt(1.0 / hz)
    loud = found._noise(samples)
    assert loud.gyro == pytest.approx(0.5 * scale, rel=0.05)
    assert loud.accel == pytest.approx(0.9 * scale, rel=0.05)
    few = samples[:9]
    shown = white_noise(few["angular_velocity"])
    assert found._noise(few).gyro == pytest.approx(shown * scale)
    # what is stated for 250 Hz is a density at any rate
    samples["angular_velocity"] = samples["linear_acceleration"] = 0.0
    quiet = found._noise(samples)
    assert quiet.gyro == pytest.approx(tuning.TRACKER_GYRO_NOISE * np.sqrt(0.004))
    assert quiet.accel == pytest.approx(tuning.TRACKER_ACCEL_NOISE * np.sqrt(0.004))


@pytest.mark.parametrize("with_velocity", [True, False])
def test_the_vertical_is_held_through_motion(with_velocity: bool) -> None:
    walk = Motion(turn=0.8, nod=0.2, speed=1.0)
    samples = at_rest_then(walk, 2.5, 40)
    found = follow(samples, walk if with_velocity else None, rest=2.5)
    assert tilt_error(found, walk, 40.0) < (0.012 if with_velocity else 0.03)
    assert np.abs(found.gyro_bias - BIAS).max() < 0.008
    assert not found.is_still(samples[:100])  # a rest, but one that has ended
    assert found.is_trusted


def test_bias_across_the_vertical_is_found_while_moving() -> None:
    walk = Motion(turn=0.3, nod=0.3, speed=0.7)
    found = follow(noisy(walk.imu(0, 60, (0.05, -0.04, 0.0))), walk)
    assert np.abs(found.gyro_bias - (0.05, -0.04, 0.0))[:2].max() < 0.012
    assert tilt_error(found, walk, 60.0) < 0.02


@pytest.mark.parametrize("late_s", [0.2, 1.2])
def test_a_late_source_still_serves(late_s: float) -> None:
    walk = Motion(turn=0.5, nod=0.1, speed=1.0)
    found = follow(walk.imu(0, 12), walk, late_s=late_s)
    moment = np.array([(found._state.stamp - EPOCH) * 1e-9])
    state = found._state
    body = state.rotation.T @ state.velocity
    assert np.linalg.norm(body - walk.velocity(moment)[0]) < 0.03


def test_a_source_that_jumps_is_followed() -> None:
    walk = Motion(speed=1.0)
    found = follow(walk.imu(0, 4), walk)
    for k in range(5):
        found.take(at(4.0 + 0.001 * (k + 1)), (3.0, 0.0, 0.0), "odometry")
    found._buffer.push(walk.imu(4.004, 4.3))
    found.follow()
    assert np.linalg.norm(found._state.rotation.T @ found._state.velocity) > 2.0


def moved_by(covariance: Any) -> float:
    """Return by how much of the difference a velocity with a covariance corrects the filter."""
    walk = Motion(speed=1.0)
    found = follow(walk.imu(0, 1.5), walk)
    before = (found._state.rotation.T @ found._state.velocity)[0]
    assert found.take(at(1.52), (before + 0.2, 0.0, 0.0), "odometry", covariance)
    found._buffer.push(walk.imu(1.504, 1.524))
    found.follow()
    return float((found._state.rotation.T @ found._state.velocity)[0] - before) / 0.2


def test_a_velocity_counts_by_its_covariance() -> None:
    for sigma in (None, 0.0, tuning.TWIST_SIGMA_LEAST, tuning.TWIST_SIGMA):
        covariance = None if sigma is None else (sigma**2 + 1e-12) * np.eye(3)
        assert moved_by(covariance) == pytest.approx(1.0, abs=0.01)
    assert moved_by(4.0 * np.eye(3)) == pytest.approx(0.0, abs=0.01)


def test_a_covariance_that_makes_no_sense_counts_as_ordinary() -> None:
    ordinary = moved_by(None)
    too_large = 2.0 * tuning.MAX_SPEED**2 * np.eye(3)
    not_a_number = np.full((3, 3), np.nan)
    for covariance in (np.zeros((3, 3)), -np.eye(3), not_a_number, np.eye(6), too_large):
        assert moved_by(covariance) == ordinary


def test_a_unit_started_on_its_side_is_caught_and_gravity_not_trusted() -> None:
    samples = noisy(Motion().imu(0, 3, BIAS))
    samples["linear_acceleration"] *= 2.0
    found = follow(samples)
    assert found.is_faulty
    assert not found.is_trusted
    assert np.abs(found.gyro_bias - BIAS).max() < 0.01, "the gyro is still of use"
    walk = Motion(nod=0.3, speed=1.0)
    samples = noisy(walk.imu(0, 5))
    samples["linear_acceleration"] += (0.0, 8.0, 6.0)
    assert follow(samples).is_faulty


def test_a_long_gap_forgets_the_vertical_but_not_the_bias() -> None:
    samples = noisy(Motion().imu(0, 3, BIAS))
    buffer = ImuBuffer(25.0, jump_s=5.0)
    found = TwistFilter(buffer, T_CLOUD_IMU[:3, 3], 0.1)
    buffer.push(samples)
    found.follow()
    bias = found.gyro_bias
    buffer.push(noisy(Motion(turn=1.0).imu(4, 4.3, BIAS)))
    found.follow()
    assert not found.is_trusted
    elsewhere = samples[-100:].copy()
    elsewhere["linear_acceleration"] = np.roll(elsewhere["linear_acceleration"], 1, axis=1)
    assert found.is_still(elsewhere)  # no attitude at rest is known any more
    np.testing.assert_allclose(found.gyro_bias, bias, atol=1e-9)


def test_refuses_what_goes_back_or_is_not_a_number() -> None:
    found = TwistFilter(ImuBuffer(), np.zeros(3), 0.1)
    assert found.take(at(1.0), (1.0, 0, 0), "odometry")
    assert not found.take(at(1.0), (0, 0, 0), "odometry")
    assert not found.take(at(0.5), (0, 0, 0), "odometry")
    assert not found.take(at(1.1), (np.nan, 0, 0), "odometry")
    assert not found.take(at(1.1), (1.0, 0), "odometry")
    assert found.take(at(0.9), (0.9, 0, 0), "wheels"), "another source starts afresh"
    assert found.source == "wheels"
    assert found.newest_twist == at(0.9)


def test_nothing_is_known_before_the_first_samples() -> None:
    found = TwistFilter(ImuBuffer(), np.zeros(3), 0.1)
    found.follow()
    assert not found.gyro_bias.any()
    assert found.gyro_bias_sigma == tuning.INITIAL_IN_MOTION.gyro_bias
    assert not found.up.any()
    assert not found.is_trusted
    assert not found.knows_velocity(at(0), 10**9)


def test_turned_axes_turn_the_vertical() -> None:
    turn = rotations.matrices(rotations.exp([np.pi / 2, 0, 0]))
    samples = noisy(Motion().imu(0, 3))
    for name in ("angular_velocity", "linear_acceleration"):
        samples[name] = samples[name] @ turn.T
    found = follow(samples)
    np.testing.assert_allclose(found.up, (0, -1, 0), atol=0.01)


@pytest.mark.parametrize("first", [False, True], ids=["amid", "before the samples"])
@pytest.mark.parametrize("ahead_s", [2.0, 3_600.0, 1e9])
def test_a_velocity_from_the_future_does_not_block_its_source(ahead_s: float, first: bool) -> None:
    walk = Motion(turn=0.5, speed=1.0)
    samples = noisy(walk.imu(0, 3, BIAS))
    buffer = ImuBuffer(25.0)
    found = TwistFilter(buffer, T_CLOUD_IMU[:3, 3], 0.1)
    used = []
    for i in range(0, len(samples), 10):
        t = (int(samples["stamp"][i]) - EPOCH) * 1e-9
        if i == (0 if first else 400):
            assert found.take(at(t + ahead_s), (9.0, 0.0, 0.0), "odometry") == first
        buffer.push(samples[i : i + 10])
        found.follow()
        used.append(found.take(at(t), walk.velocity(np.array([t]))[0], "odometry"))
    assert all(used)
    assert found.newest_twist == at(t)
    assert found.speed_near(at(t), 10**9) == pytest.approx(1.0, abs=0.3)
