"""What a calibration file does to samples and mounts."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from l2lidar_node import rotations
from l2lidar_node.calibration.file import CalibrationFile, ImuCalibration
from l2lidar_node.settings import SettingError, build
from l2lidar_node.types import IMU_SAMPLE
from l2lidar_proc.motion.config import ImuConfig, MotionConfig
from l2lidar_proc.motion.imu_corrections import ImuExtrinsics
from l2lidar_proc.odometry.config import OdometryTopics

IMU = ImuCalibration(
    (0.01, -0.02, 0.03), 0.002, (0.1, 0.0, 0.0), (0.01, 0.0, -0.01), (0.0, 0.002, 0.0)
)


@pytest.fixture
def path(tmp_path: Path) -> str:
    path = tmp_path / "unit.yaml"
    CalibrationFile(bytes(32), {}, {}, IMU).save(path)
    return str(path)


def samples() -> np.ndarray[tuple[int], np.dtype[np.void]]:
    made = np.zeros(3, IMU_SAMPLE)
    made["stamp"] = 10**18 + np.arange(3) * 4_000_000
    made["angular_velocity"] = [(1.0, 2.0, 3.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
    made["linear_acceleration"] = (0.0, 0.0, 9.8)
    return made


@pytest.mark.parametrize("group", [ImuConfig, MotionConfig, OdometryTopics])
def test_a_file_says_what_is_known(group: type[ImuConfig], path: str) -> None:
    known = ImuExtrinsics.of(build(group, {"calibration_file": path}))
    mount = np.eye(4)
    mount[:3, 3] = (1.0, 2.0, 3.0)
    used = known.mounted(mount)
    np.testing.assert_allclose(rotations.to_rpy(used[:3, :3]), IMU.rotation_rpy, atol=1e-12)
    np.testing.assert_array_equal(used[:3, 3], (1.0, 2.0, 3.0))
    given = samples()
    fixed = known.corrected(given)
    assert (given["stamp"] - fixed["stamp"] == 2_000_000).all()
    mixing = np.array([[1.01, 0.0, 0.002], [0.0, 1.0, 0.0], [0.002, 0.0, 0.99]])
    np.testing.assert_allclose(
        fixed["angular_velocity"] @ mixing.T, given["angular_velocity"], atol=1e-9
    )
    np.testing.assert_array_equal(fixed["linear_acceleration"], given["linear_acceleration"])
    assert known.source == path


def test_what_is_set_by_hand_counts_more(path: str) -> None:
    known = ImuExtrinsics.of(
        build(
            ImuConfig,
            {"calibration_file": path, "imu_rpy": (0.0, 0.0, 90.0), "imu_time_offset_ms": 7.0},
        )
    )
    assert known.time_offset_ms == 7.0
    np.testing.assert_allclose(known.mounted(np.eye(4))[:3, 0], (0.0, 1.0, 0.0), atol=1e-12)


def test_without_a_file_nothing_changes() -> None:
    known = ImuExtrinsics.of(ImuConfig())
    given = samples()
    assert known.corrected(given) is given
    mount = rotations.transform(rotations.exp((0.1, 0.2, 0.3)), (1.0, 0.0, 0.0))
    np.testing.assert_array_equal(known.mounted(mount), mount)


def test_a_file_of_the_beams_alone_leaves_the_imu_as_drawn(tmp_path: Path) -> None:
    """One launch argument gives a file to driver, deskew and odometry."""
    beams = tmp_path / "beams.yaml"
    CalibrationFile(bytes(32), {"xi_angle": 0.001}).save(beams)
    settings = {"calibration_file": str(beams), "imu_time_offset_ms": 3.0}
    known = ImuExtrinsics.of(build(ImuConfig, settings))
    assert known.source == "drawing"
    assert re.search(r"beams.yaml has no section 'imu'.*l2lidar calibrate imu", known.problem)
    assert known.rotation is None
    np.testing.assert_array_equal(known.unmixing, np.eye(3))
    assert known.time_offset_ms == 3.0


def test_a_file_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"calibration_file.*No such file"):
        ImuExtrinsics.of(build(ImuConfig, {"calibration_file": str(tmp_path / "none.yaml")}))
