"""Settings of the motion core: IMU, mount and static detection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from l2lidar_node import rotations
from l2lidar_node.settings import SettingError, setting
from l2lidar_node.types import F64


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuConfig:
    """Mount and calibration of the IMU."""

    imu_xyz: tuple[float, ...] = setting(
        (-0.007698, -0.014655, 0.00667), "position of the IMU in the cloud frame", unit="m"
    )
    imu_rpy: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), "roll, pitch, yaw of the IMU in the cloud frame", unit="deg"
    )
    imu_time_offset_ms: float = setting(
        0.0,
        "delay of the stamps of IMU samples; subtracted before use, not from published messages",
        unit="ms",
        lo=-100.0,
        hi=100.0,
    )
    calibration_file: str = setting(
        "",
        "file of l2lidar calibrate imu for this unit: rotation of the IMU (replaces that in "
        "/tf_static), time offset, gyro scale; imu_rpy and imu_time_offset_ms win if set; a file "
        "without a section imu has no effect",
    )

    def __post_init__(self) -> None:
        """Check the number of coordinates."""
        for name in ("imu_xyz", "imu_rpy"):
            value = getattr(self, name)
            if len(value) != 3:
                raise SettingError(
                    f"parameter '{name}': {value!r} is not valid; expected three numbers"
                )

    @property
    def T_cloud_imu(self) -> F64:
        """IMU coordinates to cloud coordinates by these settings, shape (4, 4)."""
        pose = np.eye(4)
        pose[:3, :3] = rotations.from_rpy(np.deg2rad(self.imu_rpy))
        pose[:3, 3] = self.imu_xyz
        return pose


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionConfig(ImuConfig):
    """How the motion is estimated without odometry."""

    max_gyro_bias: float = setting(
        0.1,
        "largest mean angular rate at rest that is accepted as gyro bias",
        unit="rad/s",
        lo=0.001,
        hi=1.0,
    )
    use_accelerometer: bool = setting(
        True, "integrate the accelerometer to track velocity within a sweep", live=True
    )
    velocity_max_age_ms: int = setting(
        500, "maximum age of a velocity that is used", unit="ms", lo=10, hi=5000, live=True
    )
    still_speed: float = setting(
        0.05,
        "largest velocity that is consistent with an IMU at rest",
        unit="m/s",
        lo=0.0,
        hi=1.0,
        live=True,
    )
    hold_ms: int = setting(
        20,
        "how long the last angular rate is extrapolated past the last IMU sample",
        unit="ms",
        lo=0,
        hi=500,
        live=True,
    )
    max_gap_ms: int = setting(
        20,
        "gaps between IMU samples longer than this are reported",
        unit="ms",
        lo=5,
        hi=1000,
        live=True,
    )
