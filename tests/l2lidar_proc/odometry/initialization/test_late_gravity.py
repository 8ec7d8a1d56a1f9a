"""Gravity for a map that began before the first IMU sample came."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.types import F64, IMU_SAMPLE, STANDARD_GRAVITY, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import ACCEL_BIAS, ERRORS, GRAVITY, VELOCITY, InertialState
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import OdometryEstimate, Status
from l2lidar_proc.odometry.initialization.late_gravity import LateGravity, with_gravity
from l2lidar_proc.odometry.odometry import Odometry
from l2lidar_proc.odometry.prediction import Predictor
from tests.l2lidar_proc.odometry.odometry_world import T_CLOUD_IMU, errors, recording
from tests.support.odometry_runs import Run, sweeps, truth

SECOND = 1_000_000_000


def followed(run: Run, samples: NDArray[np.void]) -> tuple[Odometry, list[OdometryEstimate]]:
    """Return an odometry after a recording, each sample given to it before it ends only."""
    odometry, estimates, first = Odometry(OdometryConfig(), T_CLOUD_IMU), [], 0
    for sweep in sweeps(run, "turn"):
        last = int(np.searchsorted(samples["stamp"], sweep.end))
        if last > first:
            odometry.imu(samples[first:last])
        first = last
        estimates += odometry.register(sweep)
    return odometry, estimates


def without_first(run: Run, seconds: float) -> NDArray[np.void]:
    return run.imu[run.imu["stamp"] >= run.imu["stamp"][0] + seconds * 1e9]


def up_by_truth(run: Run, estimate: OdometryEstimate) -> F64:
    """Return the true vertical in map axes, as the estimate has the sensor turned, (3,)."""
    _, turn = truth(run, np.array([estimate.stamp]))
    up: F64 = estimate.T_map_lidar[:3, :3] @ rotations.matrices(turn)[0].T @ [0.0, 0.0, 1.0]
    return up


@pytest.mark.parametrize(("motion", "late_s"), [("walk", 0.8), ("walk", 5.0), ("still", 2.5)])
def test_gravity_is_known_within_two_seconds_of_the_first_sample(
    motion: str, late_s: float
) -> None:
    run = recording("room", motion, 11.5)
    samples = without_first(run, late_s)
    odometry, estimates = followed(run, samples)
    untrusted = [item.stamp for item in estimates if Status.GRAVITY_UNTRUSTED in item.status]
    assert untrusted
    assert untrusted[-1] < samples["stamp"][0] + 2 * SECOND
    assert errors(run, estimates).max() < 0.01
    state, covariance = odometry._posterior
    off = state.gravity + STANDARD_GRAVITY * up_by_truth(run, estimates[-1])
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[GRAVITY, GRAVITY])[-1]))
    assert np.linalg.norm(off) < 3.0 * sigma
    assert sigma <= 0.16  # by the accelerometer's bias at rest, by less in motion


@pytest.mark.parametrize(("before_s", "counts"), [(0.9, True), (1.1, False)])
def test_how_the_sensor_lay_a_second_before_does_not_show_the_vertical(
    before_s: float, counts: bool
) -> None:
    """A silent IMU whose latest samples are older than the held sweeps reach back."""
    run = recording("room", "walk")
    odometry, samples = Odometry(OdometryConfig(), T_CLOUD_IMU), run.imu[:40].copy()
    some = list(sweeps(run, "turn"))[:5]
    end = int(some[0].start) - tuning.INITIAL_NS - round(before_s * SECOND)
    samples["stamp"] += end - samples["stamp"][-1]
    odometry.imu(samples)
    estimates = [item for sweep in some for item in odometry.register(sweep)]
    assert odometry._predictor.trusts_gravity == counts
    assert (Status.GRAVITY_UNTRUSTED in estimates[0].status) != counts


def test_in_a_corridor_the_imu_then_carries_the_way_along_it() -> None:
    run = recording("corridor", "walk", 11.5)
    _, estimates = followed(run, without_first(run, 0.8))
    assert errors(run, estimates).max() < 0.15  # 2.2 m without gravity


@pytest.mark.parametrize("size", [0.0, 2.0])
def test_what_is_not_gravity_is_not_taken_for_it(size: float) -> None:
    """The fault of a unit that was started on its side doubles its forces."""
    run = recording("room", "walk")
    samples = without_first(run, 0.8)
    samples["linear_acceleration"] *= size
    odometry, estimates = followed(run, samples)
    assert not odometry._predictor.trusts_gravity
    assert Status.GRAVITY_UNTRUSTED in estimates[-1].status
    assert errors(run, estimates).max() < 0.02


def test_with_gaps_in_the_samples_it_waits() -> None:
    run = recording("room", "walk")
    samples = without_first(run, 0.8)
    is_kept = samples["stamp"] % SECOND > 80_000_000
    odometry, _ = followed(run, samples[is_kept])
    assert not odometry._predictor.trusts_gravity


def test_what_accelerates_the_sensor_is_not_gravity() -> None:
    """At 2 m/s^2, of which the velocities tell."""
    predictor = Predictor(OdometryConfig(), np.eye(4))
    samples = np.zeros(500, IMU_SAMPLE)
    samples["stamp"] = SECOND + 4_000_000 * np.arange(len(samples))
    samples["linear_acceleration"] = 2.0, 0.0, STANDARD_GRAVITY
    predictor.imu(samples)
    late, nothing = LateGravity(predictor), np.zeros(3)
    for seconds in np.arange(1.1, 2.5, 0.23):
        stamp = HostNs(round(seconds * SECOND))
        speed = np.array([2.0 * seconds, 0.0, 0.0])
        state = InertialState(stamp, np.eye(3), nothing, speed, nothing, nothing, nothing)
        motion = predictor.over(
            state, 1e-4 * np.eye(ERRORS), (stamp, HostNs(stamp + 100_000_000)), stamp
        )
        found = late.estimated(motion)
        assert predictor.trusts_gravity == (seconds > 2.1)
        if predictor.trusts_gravity:
            break
        assert found is motion
    np.testing.assert_allclose(found.state.gravity, [0.0, 0.0, -STANDARD_GRAVITY], atol=1e-3)
    assert late.estimated(found) is found


def test_the_covariance_is_that_of_the_errors() -> None:
    """Normalized squared errors of gravity and bias, 6, over simulated accelerometers."""
    rng = np.random.default_rng(5)
    down = np.array([0.0, 0.0, -STANDARD_GRAVITY])
    nothing = np.zeros(3)
    squares = []
    for _ in range(400):
        rotation = rotations.matrices(rotations.exp(rng.normal(0.0, 1.0, 3)))
        state = InertialState(HostNs(0), rotation, nothing, nothing, nothing, nothing, nothing)
        bias = rng.normal(0.0, tuning.ACCEL_BIAS_SIGMA, 3)
        noise = np.diag([0.03, 0.05, 0.1]) ** 2
        measured = down - rotation @ bias + rng.multivariate_normal(nothing, noise)
        found, covariance = with_gravity(state, np.eye(ERRORS), measured, noise)
        error = np.concatenate((found.gravity - down, found.accel_bias - bias))
        errors_of = np.r_[GRAVITY, ACCEL_BIAS]
        squares.append(error @ np.linalg.solve(covariance[np.ix_(errors_of, errors_of)], error))
        assert covariance[VELOCITY, VELOCITY].tolist() == np.eye(3).tolist()
        assert not covariance[VELOCITY, GRAVITY].any()
        assert not found.boxminus(state)[: GRAVITY.start].any()
    assert 5.5 < np.mean(squares) < 6.5
