"""The motion of a sweep against one that is known: states, uncertainty, trajectory, rest."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.filter import InertialState, Noise
from l2lidar_proc.motion.sweep_motion import SweepMotion, predict_sweep
from tests.l2lidar_proc.motion.analytic import T_CLOUD_IMU, G, Motion, at

LEVER = T_CLOUD_IMU[:3, 3]
WALK = Motion(turn=0.8, nod=0.2, speed=1.0)
NOISE = Noise(1e-3, 1e-2, 1e-6, 1e-5)
BEGIN, START, REFERENCE, END = 1.0, 1.1, 1.25, 1.4


def true_state(seconds: float) -> InertialState:
    """Return the IMU's state on the walk."""
    t = np.array([seconds])
    h = 1e-4

    def place(moment: F64) -> F64:
        return WALK.position(moment) + WALK.rotation(moment).apply(LEVER)

    velocity = (place(t + h) - place(t - h))[0] / (2 * h)
    gravity = np.array([0.0, 0.0, -G])
    turn = WALK.rotation(t).as_matrix()[0]
    nothing = np.zeros(3)
    return InertialState(at(seconds), turn, place(t)[0], velocity, nothing, nothing, gravity)


def predicted(*, use_forces: bool = True, sigma: float = 1e-3) -> SweepMotion:
    return predict_sweep(
        true_state(BEGIN),
        sigma**2 * np.eye(eskf.ERRORS),
        WALK.imu(0.9, 1.5),
        (at(START), at(END)),
        at(REFERENCE),
        noise=NOISE,
        gap_ns=50_000_000,
        steady_rate=np.zeros(3),
        use_forces=use_forces,
    )


def assert_is(state: InertialState, seconds: float) -> None:
    true = true_state(seconds)
    assert state.stamp == true.stamp
    np.testing.assert_allclose(state.boxminus(true), 0.0, atol=1e-3)


def test_the_state_is_carried_to_the_reference_and_from_there_to_any_instant() -> None:
    motion = predicted()
    assert_is(motion.state, REFERENCE)
    for seconds in (START, REFERENCE, 1.352, END):
        assert_is(motion.state_at(at(seconds)), seconds)
    moved = motion.anchored_at(at(END))
    assert_is(moved.state, END)
    assert_is(moved.state_at(at(START)), START)
    assert moved.preintegrated.stamps[moved.preintegrated.anchor] == at(END)


def test_the_rate_is_the_mean_about_the_reference() -> None:
    near = WALK.imu(REFERENCE - 0.02, REFERENCE + 0.02)["angular_velocity"].mean(axis=0)
    np.testing.assert_allclose(predicted().rate, near, atol=0.03)


def test_the_acceleration_is_the_mean_about_the_reference() -> None:
    before, after = true_state(REFERENCE - 0.02), true_state(REFERENCE + 0.02)
    expected = (after.velocity - before.velocity) / 0.04 @ true_state(REFERENCE).rotation
    assert np.linalg.norm(expected) > 0.5
    np.testing.assert_allclose(predicted().acceleration, expected, atol=0.03)
    still = predicted().at_rest(predicted().state, np.eye(eskf.ERRORS))
    np.testing.assert_allclose(still.acceleration, 0.0, atol=1e-9)


def test_the_cloud_frame_is_seen_from_where_it_was_at_the_reference() -> None:
    trajectory = predicted().trajectory(LEVER)
    here = WALK.rotation(np.array([REFERENCE])).inv()
    origin = WALK.position(np.array([REFERENCE]))[0]
    for seconds in (START, 1.2, 1.33, END):
        turn, place = trajectory.pose(at(seconds))
        there = WALK.rotation(np.array([seconds]))
        expected = here.apply(WALK.position(np.array([seconds]))[0] - origin)[0]
        np.testing.assert_allclose(place, expected, atol=1e-3)
        np.testing.assert_allclose(
            np.abs(np.roll((here * there).as_quat()[0], 1) @ turn), 1.0, atol=1e-6
        )


def test_the_speed_is_as_uncertain_as_the_forces_that_were_used() -> None:
    """White noise adds up by the root of the time; unused forces may be anything."""
    seconds = REFERENCE - BEGIN
    used = predicted(sigma=1e-5)
    sigma = np.sqrt(np.diag(used.covariance)[eskf.VELOCITY])
    np.testing.assert_allclose(sigma, NOISE.accel * np.sqrt(seconds), rtol=0.05)
    turned = np.sqrt(np.diag(used.covariance)[eskf.ROTATION])
    np.testing.assert_allclose(turned, NOISE.gyro * np.sqrt(seconds), rtol=0.05)

    unused = predicted(use_forces=False, sigma=1e-5)
    sigma = np.sqrt(np.diag(unused.covariance)[eskf.VELOCITY])
    np.testing.assert_allclose(sigma, tuning.BLIND_ACCEL * np.sqrt(seconds), rtol=0.05)
    np.testing.assert_allclose(unused.state.velocity, true_state(BEGIN).velocity, atol=1e-9)
    for cause in (eskf.ROTATION, eskf.GYRO_BIAS, eskf.ACCEL_BIAS, eskf.GRAVITY):
        assert not unused.covariance[eskf.VELOCITY, cause].any()  # they do not move it
        assert not unused.covariance[eskf.POSITION, cause].any()
    again = unused.with_state(true_state(REFERENCE), unused.covariance)
    at_end = again.state_at(at(END))
    np.testing.assert_allclose(at_end.velocity, true_state(REFERENCE).velocity, atol=1e-9)


def test_another_state_at_the_reference_moves_the_whole_sweep() -> None:
    motion = predicted()
    error = np.zeros(eskf.ERRORS)
    error[eskf.VELOCITY] = (0.3, -0.2, 0.1)
    error[eskf.GYRO_BIAS] = (0.0, 0.0, 0.2)
    state = motion.state.boxplus(error)
    other = motion.with_state(state, 2.0 * motion.covariance)
    np.testing.assert_array_equal(other.covariance, 2.0 * motion.covariance)
    apart = other.state_at(at(END)).boxminus(motion.state_at(at(END)))
    seconds = END - REFERENCE
    np.testing.assert_allclose(apart[eskf.POSITION], seconds * error[eskf.VELOCITY], atol=0.03)
    np.testing.assert_allclose(apart[eskf.ROTATION], (0.0, 0.0, -0.2 * seconds), atol=6e-3)


def test_at_rest_nothing_moves_whatever_the_imu_has_measured() -> None:
    begun = true_state(BEGIN)
    motion = predicted().at_rest(begun, np.eye(eskf.ERRORS))
    assert motion.state.stamp == at(REFERENCE)
    for seconds in (START, REFERENCE, END):
        state = motion.state_at(at(seconds))
        np.testing.assert_allclose(state.position, begun.position, atol=1e-12)
        np.testing.assert_allclose(state.rotation, begun.rotation, atol=1e-12)
        np.testing.assert_allclose(state.velocity, 0.0, atol=1e-12)
        np.testing.assert_allclose(motion.trajectory(LEVER).pose(at(seconds))[1], 0.0, atol=1e-12)
    np.testing.assert_allclose(motion.rate, 0.0, atol=1e-12)


@pytest.mark.parametrize("reference", [BEGIN, START, END, 1.45])
def test_the_reference_may_be_outside_of_the_sweep(reference: float) -> None:
    motion = predict_sweep(
        true_state(BEGIN),
        np.eye(eskf.ERRORS),
        WALK.imu(0.9, 1.5),
        (at(START), at(END)),
        at(reference),
        noise=NOISE,
        gap_ns=50_000_000,
        steady_rate=np.zeros(3),
        use_forces=True,
    )
    assert_is(motion.state, reference)
    assert motion.imu.stamps[0] <= at(BEGIN)
    assert motion.imu.stamps[-1] >= at(max(reference, END))
    assert not motion.imu.missing.any()
