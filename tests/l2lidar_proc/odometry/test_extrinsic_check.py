"""The check of a running odometry says what is off, and nothing where nothing is."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from l2lidar_node import rotations
from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.unit.inertial import Inertial
from l2lidar_node.emulator.unit.units import unit
from l2lidar_node.emulator.world import scenes
from l2lidar_node.types import F64, IMU_SAMPLE
from l2lidar_proc.motion.config import ImuConfig
from l2lidar_proc.odometry import health
from l2lidar_proc.odometry.estimate import Status
from l2lidar_proc.odometry.extrinsic_check import ExtrinsicCheck
from tests.l2lidar_proc.odometry.bare_estimates import estimate

EPOCH = 1_700_000_000_000_000_000
DRAWN = np.eye(3)


def followed(
    name: str,
    motion: str = "shake",
    rotation: F64 = DRAWN,
    *,
    late_ms: float = 0.0,
    seconds: float = 60.0,
    status: tuple[Status, ...] = (),
) -> ExtrinsicCheck:
    """Return the check after a motion: true poses with 0.05 degrees of noise, a unit's own IMU."""
    source = np.random.default_rng(3)
    made = trajectories.make(motion, scenes.make("room"))
    raw, times = Inertial(made, unit=unit(name)).samples(0, round(seconds * 250))
    samples = np.zeros(len(raw), IMU_SAMPLE)
    samples["stamp"] = EPOCH + np.round((times + 1e-3 * late_ms) * 1e9).astype(np.int64)
    samples["angular_velocity"] = raw["angular_velocity"]
    at = np.arange(0.5, seconds, 0.23)
    _, quaternions = made.poses(at)
    noisy = rotations.multiply(
        quaternions, rotations.exp(np.deg2rad(0.05) * source.standard_normal((len(at), 3)))
    )
    check = ExtrinsicCheck(rotation)
    first = 0
    for t, q in zip(at.tolist(), noisy, strict=True):
        last = int(np.searchsorted(samples["stamp"], EPOCH + round((t + 0.13) * 1e9)))
        check.imu(samples[first:last])
        first = last
        pose = rotations.transform(q, (0.0, 0.0, 0.0))
        check.pose(estimate(EPOCH + round(t * 1e9), pose, status))
    return check


@pytest.mark.parametrize("name", ["perfect", "typical"])
@pytest.mark.parametrize("motion", ["shake", "walk", "spin", "still"])
def test_nothing_is_said_of_units_within_tolerance(name: str, motion: str) -> None:
    check = followed(name, motion)
    assert check.finding == ""
    if motion == "shake":
        assert "extrinsic rotation off, x y z [deg]" in check.values
        assert "IMU time offset off [ms]" in check.values
    if motion == "still":
        assert check.values == {}


def test_a_rotation_that_is_off_is_said_with_its_size() -> None:
    turned = rotations.matrices(rotations.exp(np.deg2rad([0.0, 0.0, 1.2])))
    check = followed("perfect", rotation=turned)
    assert "extrinsic rotation looks 1.2 degrees off (" in check.finding
    assert "-1.2 about z" in check.finding
    level, text, values = health.judged(
        estimate(EPOCH, np.eye(4)), 10, 1, Counter(), Counter(), check=check
    )
    assert level == health.WARN
    assert text == f"aligned; {check.finding}"
    told = [float(x) for x in values["extrinsic rotation off, x y z [deg]"].split()]
    np.testing.assert_allclose(told, (0.0, 0.0, -1.2), atol=0.15)


def test_turning_about_one_axis_only_is_silent_about_what_it_cannot_know() -> None:
    turned = rotations.matrices(rotations.exp(np.deg2rad([0.0, 0.0, 5.0])))
    check = followed("perfect", "spin", turned)
    assert check.finding == ""


def test_late_stamps_are_said() -> None:
    assert "stamps of IMU samples look 8.0 ms too late" in followed("perfect", late_ms=8.0).finding


def test_poses_that_are_not_aligned_tell_nothing() -> None:
    turned = rotations.matrices(rotations.exp(np.deg2rad([0.0, 0.0, 9.0])))
    for status in (Status.PREDICTED, Status.LOST, Status.RESTARTED, Status.RETURNED):
        assert followed("perfect", rotation=turned, status=(status,), seconds=40).values == {}


def test_bad_stamps_and_numbers_do_no_harm() -> None:
    check = ExtrinsicCheck(DRAWN)
    bad = np.zeros(30_000, IMU_SAMPLE)
    bad["angular_velocity"] = np.nan
    for _ in range(3):
        check.imu(bad)
    source = np.random.default_rng(0)
    for stamp in source.integers(0, 2**62, 3000).tolist():
        check.pose(estimate(stamp, np.eye(4)))
    assert check.finding == ""


def test_the_imu_is_where_the_drawing_has_it() -> None:
    np.testing.assert_array_equal(ImuConfig().T_cloud_imu[:3, :3], DRAWN)
