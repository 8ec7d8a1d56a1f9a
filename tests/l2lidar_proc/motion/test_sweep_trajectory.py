"""The integrated path against motions known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_node.types import HostNs
from l2lidar_proc import rotations
from l2lidar_proc.motion.sweep_trajectory import (
    VELOCITY,
    Gravity,
    Path,
    coverage,
    integrate,
    still_path,
)
from tests.l2lidar_proc.motion.analytic import T_CLOUD_IMU, G, Motion, at

WALK = Motion(turn=1.0, nod=0.15, speed=1.0)
NO_BIAS = np.zeros(3)


def error(path: Path, motion: Motion, start: float, moments: np.ndarray) -> tuple[float, float]:
    """Return the largest rotation error [rad] and position error [m]."""
    q, p = path.poses(np.array([at(t) for t in moments]))
    here, there = motion.rotation(np.array([start])), motion.rotation(moments)
    expected = (here.inv() * there).as_matrix()
    turn = np.einsum("nij,nik->njk", expected, rotations.matrices(q))
    angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))
    place = here.inv().apply(motion.position(moments) - motion.position(np.array([start])))
    return float(angle.max()), float(np.linalg.norm(place - p, axis=1).max())


def velocity(motion: Motion, *moments: float) -> np.ndarray:
    made = np.zeros(len(moments), dtype=VELOCITY)
    made["stamp"] = [at(t) for t in moments]
    made["velocity"] = motion.velocity(np.array(moments))
    return made


def gravity(motion: Motion, moment: float) -> Gravity:
    return Gravity(at(moment), motion.rotation(np.array([moment])).inv().apply([(0, 0, G)])[0])


def test_rotation_follows_a_fast_motion_between_samples():
    spin = Motion(turn=3.0, nod=0.2)
    path = integrate(spin.imu(0, 1), at(0.3013), at(0.5307), T_cloud_imu=T_CLOUD_IMU, bias=NO_BIAS)
    angle, _ = error(path, spin, 0.3013, np.linspace(0.3013, 0.5307, 400))
    assert angle < 1e-4


def test_bias_is_taken_off_in_imu_axes_and_the_mount_is_honoured():
    spin = Motion(turn=1.0, nod=0.2)
    bias = (0.03, -0.02, 0.04)
    samples = spin.imu(0, 1, bias)
    R_cloud_imu = rotations.matrices(rotations.exp([0.4, -1.2, 2.0]))
    for name in ("angular_velocity", "linear_acceleration"):
        samples[name] = samples[name] @ R_cloud_imu
    T_turned = T_CLOUD_IMU.copy()
    T_turned[:3, :3] = R_cloud_imu
    path = integrate(
        samples, at(0.3), at(0.5), T_cloud_imu=T_turned, bias=np.array(bias) @ R_cloud_imu
    )
    angle, _ = error(path, spin, 0.3, np.linspace(0.3, 0.5, 100))
    assert angle < 1e-4


def test_accelerometer_carries_a_velocity_from_before_the_path():
    path = integrate(
        WALK.imu(0, 1), at(0.3), at(0.6), T_cloud_imu=T_CLOUD_IMU, bias=NO_BIAS,
        velocities=velocity(WALK, 0.35), gravity=gravity(WALK, 0.3221),
    )  # fmt: skip
    angle, place = error(path, WALK, 0.3, np.linspace(0.3, 0.6, 400))
    assert angle < 1e-4
    assert place < 2e-4


def test_many_velocities_need_no_gravity():
    path = integrate(
        WALK.imu(0, 1), at(0.3), at(0.6), T_cloud_imu=T_CLOUD_IMU, bias=NO_BIAS,
        velocities=velocity(WALK, *np.arange(0.25, 0.66, 0.01)),
    )  # fmt: skip
    _, place = error(path, WALK, 0.3, np.linspace(0.3, 0.6, 400))
    assert place < 2e-4


def test_one_velocity_without_gravity_turns_with_the_body():
    circle = Motion(turn=2.0)
    samples = circle.imu(0, 1)
    ahead = np.zeros(1, dtype=VELOCITY)
    ahead["stamp"], ahead["velocity"] = at(0.1), (1.0, 0.0, 0.0)
    path = integrate(
        samples, at(0.1), at(0.6), T_cloud_imu=T_CLOUD_IMU, bias=NO_BIAS, velocities=ahead
    )
    _, place = path.pose(at(0.6))
    np.testing.assert_allclose(place, (np.sin(1.0) / 2, (1 - np.cos(1.0)) / 2, 0), atol=1e-4)


def test_without_velocity_nothing_is_translated():
    path = integrate(
        WALK.imu(0, 1),
        at(0.3),
        at(0.5),
        T_cloud_imu=T_CLOUD_IMU,
        bias=NO_BIAS,
        gravity=gravity(WALK, 0.3),
    )
    assert not path.positions.any()


def test_a_gap_is_bridged_and_reported():
    spin = Motion(turn=3.0)
    samples = spin.imu(0, 1)
    t = (samples["stamp"] - at(0)) * 1e-9
    path = integrate(
        samples[(t < 0.4) | (t > 0.45)], at(0.3), at(0.5), T_cloud_imu=T_CLOUD_IMU, bias=NO_BIAS
    )
    angle, _ = error(path, spin, 0.3, np.linspace(0.3, 0.5, 100))
    assert angle < 1e-6


@pytest.mark.parametrize(("last", "turned"), [(0.452, 0.152 + 0.02), (0.2, 0.0)])
def test_beyond_the_samples_the_rate_is_held_a_little_and_then_stops(last, turned):
    spin = Motion(turn=1.0)
    path = integrate(spin.imu(0, last), at(0.3), at(0.6), T_cloud_imu=T_CLOUD_IMU, bias=NO_BIAS)
    q, _ = path.pose(at(0.6))
    assert rotations.log(q)[2] == pytest.approx(turned, abs=1e-4)


def test_before_the_samples_likewise():
    spin = Motion(turn=1.0)
    path = integrate(spin.imu(0.4, 1.0), at(0.3), at(0.6), T_cloud_imu=T_CLOUD_IMU, bias=NO_BIAS)
    q, _ = path.pose(at(0.6))
    assert rotations.log(q)[2] == pytest.approx(0.22, abs=1e-4)


def test_between_two_instants_of_the_path():
    path = integrate(
        WALK.imu(0, 1), at(0.2), at(0.7), T_cloud_imu=T_CLOUD_IMU, bias=NO_BIAS,
        velocities=velocity(WALK, 0.2), gravity=gravity(WALK, 0.2),
    )  # fmt: skip
    later = integrate(
        WALK.imu(0, 1), at(0.4), at(0.7), T_cloud_imu=T_CLOUD_IMU, bias=NO_BIAS,
        velocities=velocity(WALK, 0.4), gravity=gravity(WALK, 0.4),
    )  # fmt: skip
    q, p = path.between(at(0.4), at(0.6))
    q_expected, p_expected = later.pose(at(0.6))
    np.testing.assert_allclose(q, q_expected, atol=1e-5)
    np.testing.assert_allclose(p, p_expected, atol=5e-4)


def test_no_samples_is_the_callers_mistake():
    with pytest.raises(ValueError, match="samples"):
        integrate(WALK.imu(0, 1)[:0], at(0), at(1), T_cloud_imu=T_CLOUD_IMU, bias=NO_BIAS)


def test_a_path_of_no_length_and_a_still_one_are_whole():
    path = integrate(WALK.imu(0, 1), at(0.5), at(0.5), T_cloud_imu=T_CLOUD_IMU, bias=NO_BIAS)
    assert np.isfinite(path.rotations_wxyz).all()
    q, p = still_path(at(0), HostNs(at(0) + 10)).pose(at(5))
    assert q.tolist() == [1, 0, 0, 0]
    assert not p.any()


@pytest.mark.parametrize(
    ("stamps", "share", "gap"),
    [
        ([0, 4, 8, 12], 1.0, 4),
        ([1, 4, 8, 11], 1.0, 4),
        ([-9, 4, 8, 60], 1.0, 52),
        ([2, 4, 8, 12], 0.9, 4),
        ([-5, 5], 0.4, 10),
        ([-8, -4], 0.0, 15),
        ([30, 34], 0.0, 29),
        ([3], 0.0, 8),
        ([], 0.0, 10),
    ],
)
def test_coverage_of_a_span(stamps, share, gap):
    found = coverage(np.array(stamps, dtype=np.int64), HostNs(1), HostNs(11))
    assert found == (pytest.approx(share), gap)
