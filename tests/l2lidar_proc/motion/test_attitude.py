"""Vertical and bias are found at rest and kept in motion."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_proc import rotations
from l2lidar_proc.motion.attitude import AttitudeFilter
from l2lidar_proc.motion.velocity import VelocityHistory
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


def follow(samples, velocities=None, motion=None, rest=0.0) -> AttitudeFilter:
    attitude = AttitudeFilter(T_CLOUD_IMU)
    for i in range(0, len(samples), 10):
        if velocities is not None and i % 50 == 0:
            stamp = int(samples["stamp"][i])
            t = (stamp - EPOCH) * 1e-9
            velocities.push(stamp, motion.velocity(np.array([t]))[0] * (t >= rest))
        attitude.push(samples[i : i + 10], velocities)
    return attitude


def tilt_error(attitude: AttitudeFilter, motion: Motion) -> float:
    state = attitude.latest
    moment = np.array([(state.stamp - EPOCH) * 1e-9])
    up = motion.rotation(moment).inv().apply([(0, 0, 1)])[0]
    return float(np.arccos(np.clip(up @ state.up, -1, 1)))


def test_rest_gives_bias_gravity_and_stillness():
    attitude = follow(noisy(Motion(nod=0.0).imu(0, 4, BIAS)))
    assert np.abs(attitude.bias - BIAS).max() < 0.006
    state = attitude.latest
    assert state.is_still
    assert state.is_trusted
    assert not state.is_faulty
    assert state.gravity == pytest.approx(G, abs=0.02)
    assert tilt_error(attitude, Motion()) < 0.003
    assert attitude.is_still(noisy(Motion().imu(3, 3.3, BIAS), seed=9))
    assert not attitude.is_still(noisy(Motion(turn=0.5).imu(3, 3.3, BIAS), seed=9))


def test_stillness_shows_within_the_first_sweep_but_not_in_motion():
    assert follow(Motion().imu(0, 0.2)).is_still(noisy(Motion().imu(0, 0.23, BIAS)))
    walk = Motion(turn=0.5, nod=0.1, speed=0.7)
    assert not follow(walk.imu(0, 0.2)).is_still(noisy(walk.imu(0, 0.23, BIAS)))


@pytest.mark.parametrize("with_velocity", [True, False])
def test_the_vertical_is_held_through_motion(with_velocity):
    walk = Motion(turn=0.8, nod=0.2, speed=1.0)
    samples = at_rest_then(walk, 2.5, 40)
    velocities = VelocityHistory() if with_velocity else None
    attitude = follow(samples, velocities, walk, rest=2.5)
    assert tilt_error(attitude, walk) < (0.012 if with_velocity else 0.03)
    assert np.abs(attitude.bias - BIAS).max() < 0.008
    assert not attitude.latest.is_still
    assert attitude.latest.is_trusted


def test_bias_across_the_vertical_is_found_while_moving():
    walk = Motion(turn=0.3, nod=0.3, speed=0.7)
    attitude = follow(noisy(walk.imu(0, 60, (0.05, -0.04, 0.0))), VelocityHistory(), walk)
    assert np.abs(attitude.bias - (0.05, -0.04, 0.0))[:2].max() < 0.012
    assert tilt_error(attitude, walk) < 0.02


def test_a_unit_started_on_its_side_is_caught_and_gravity_not_trusted():
    samples = noisy(Motion().imu(0, 3, BIAS))
    samples["linear_acceleration"] *= 2.0
    state = follow(samples).latest
    assert state.is_faulty
    assert not state.is_trusted
    attitude = follow(samples)
    assert attitude.gravity_before(at(2.5)) is None
    assert np.abs(attitude.bias - BIAS).max() < 0.01, "the gyro is still of use"
    walk = Motion(nod=0.3, speed=1.0)
    samples = noisy(walk.imu(0, 5))
    samples["linear_acceleration"] += (0.0, 8.0, 6.0)
    assert follow(samples).latest.is_faulty


def test_states_are_found_by_instant():
    attitude = follow(noisy(Motion().imu(0, 3)))
    state = attitude.at(at(2.05))
    assert at(1.9) < state.stamp <= at(2.05)
    assert attitude.at(at(-1)).stamp < at(0.2)
    gravity = attitude.gravity_before(at(2.05))
    assert gravity.stamp == state.stamp
    assert np.linalg.norm(gravity.up) == pytest.approx(G, abs=0.05)


def test_gravity_is_told_in_cloud_axes():
    T_turned = T_CLOUD_IMU.copy()
    T_turned[:3, :3] = rotations.matrices(rotations.exp([np.pi / 2, 0, 0]))
    attitude = AttitudeFilter(T_turned)
    attitude.push(noisy(Motion().imu(0, 3)))
    np.testing.assert_allclose(attitude.gravity_before(at(2.5)).up, (0, -G, 0), atol=0.1)


def test_a_long_gap_forgets_the_vertical_but_not_the_bias():
    attitude = AttitudeFilter(T_CLOUD_IMU)
    attitude.push(noisy(Motion().imu(0, 3, BIAS)))
    bias = attitude.bias
    attitude.push(noisy(Motion(turn=1.0).imu(4, 4.3, BIAS)))
    assert not attitude.latest.is_trusted
    assert not attitude.latest.is_still
    np.testing.assert_allclose(attitude.bias, bias, atol=1e-9)


def test_nothing_known_before_the_first_samples():
    attitude = AttitudeFilter(T_CLOUD_IMU)
    attitude.push(Motion().imu(0, 0)[:0])
    assert attitude.latest is None
    assert attitude.at(at(0)) is None
    assert attitude.gravity_before(at(0)) is None
    assert not attitude.bias.any()
