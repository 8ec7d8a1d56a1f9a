"""Sweep trajectories against motions known in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from l2lidar_node import rotations
from l2lidar_node.types import HostNs
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.motion.preintegration import integrate, segment
from l2lidar_proc.motion.sweep_motion import SweepTrajectory, still_trajectory
from tests.l2lidar_proc.motion.analytic import T_CLOUD_IMU, G, Motion, at

WALK = Motion(turn=1.0, nod=0.15, speed=1.0)
LEVER = T_CLOUD_IMU[:3, 3]
ZERO = np.zeros(3)


def state_at(motion: Motion, t: float) -> InertialState:
    """Return the true state of the IMU."""
    here, h = np.array([t]), 1e-4
    ends = np.array([t - h, t + h])
    places = motion.position(ends) + motion.rotation(ends).apply(LEVER)
    return InertialState(
        at(t),
        motion.rotation(here).as_matrix()[0],
        (motion.position(here) + motion.rotation(here).apply(LEVER))[0],
        (places[1] - places[0]) / (2 * h),
        ZERO,
        ZERO,
        np.array([0.0, 0.0, -G]),
    )


def trajectory(motion: Motion, start: float, end: float, anchor: float) -> SweepTrajectory:
    """Return the trajectory of the cloud frame from the true state at an instant."""
    state = state_at(motion, anchor)
    imu = segment(motion.imu(0, 1), [at(start), at(anchor), at(end)], 50_000_000, ZERO)
    sums = integrate(
        imu, imu.knot(at(anchor)), gyro_bias=ZERO, accel_bias=ZERO, rest_force=state.rest_force
    )
    return SweepTrajectory.of(sums, state, LEVER)


@pytest.mark.parametrize("anchor", [0.3, 0.45, 0.6])
@pytest.mark.parametrize("motion", [WALK, Motion(turn=3.0, nod=0.2)])
def test_it_follows_the_motion_from_any_anchor(motion: Any, anchor: float) -> None:
    found = trajectory(motion, 0.3, 0.6, anchor)
    moments = np.linspace(0.3, 0.6, 400)
    q, p = found.poses(np.array([at(t) for t in moments]))
    here, there = motion.rotation(np.array([anchor])), motion.rotation(moments)
    expected = (here.inv() * there).as_matrix()
    turn = np.einsum("nij,nik->njk", expected, rotations.matrices(q))
    angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))
    place = here.inv().apply(motion.position(moments) - motion.position(np.array([anchor])))
    assert angle.max() < 1e-4
    assert np.linalg.norm(place - p, axis=1).max() < 2e-4


def test_the_lever_arm_counts_from_the_anchor() -> None:
    """A sensor that turns about its own origin stays there, its IMU does not."""
    pivot = Motion(turn=3.0)
    found = trajectory(pivot, 0.3, 0.6, 0.45)
    assert np.linalg.norm(found.positions, axis=1).max() < 1e-4
    assert 3.0 * np.linalg.norm(LEVER[:2]) * 0.15 > 5e-3


def test_between_two_instants() -> None:
    found, later = trajectory(WALK, 0.2, 0.7, 0.2), trajectory(WALK, 0.4, 0.7, 0.4)
    q, p = found.between(at(0.4), at(0.6))
    q_expected, p_expected = later.pose(at(0.6))
    np.testing.assert_allclose(q, q_expected, atol=1e-5)
    np.testing.assert_allclose(p, p_expected, atol=5e-4)


def test_rotations_alone() -> None:
    found = trajectory(WALK, 0.2, 0.7, 0.2).without_translation()
    assert not found.positions.any()
    assert found.rates.any()
    assert not found.is_still


def test_a_still_one_is_whole() -> None:
    still = still_trajectory(at(0), HostNs(at(0) + 10))
    q, p = still.pose(at(5))
    assert still.is_still
    assert q.tolist() == [1, 0, 0, 0]
    assert not p.any()
    assert len(still_trajectory(at(1), at(0)).stamps) == 2
