"""What is known of an IMU beside its place: rotation, lateness of stamps, scale of its gyro."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from l2lidar_node import rotations
from l2lidar_node.calibration.file import CalibrationFileError, load
from l2lidar_node.settings import SettingError
from l2lidar_node.types import F64
from l2lidar_proc.motion.config import ImuConfig
from l2lidar_proc.motion.gyro_alignment import unmixing
from l2lidar_proc.motion.imu_buffer import Samples, earlier


@dataclass(frozen=True, slots=True, eq=False)
class ImuExtrinsics:
    """How samples and mount of an IMU are put right before anything is computed with them.

    Attributes
    ----------
    rotation : ndarray, shape (3, 3), or None
        IMU axes to cloud axes, in place of what a mount says; None leaves that as it is.
    time_offset_ms : float
        What the stamps of samples are late by.
    unmixing : ndarray, shape (3, 3)
        Takes scale and misalignment off the gyro's rates.
    source : str
        Where it comes from, for people.
    problem : str
        What is wrong with the file; empty where it is used or none was given.
    """

    rotation: F64 | None = None
    time_offset_ms: float = 0.0
    unmixing: F64 = field(default_factory=lambda: np.eye(3))
    source: str = "drawing"
    problem: str = ""

    @classmethod
    def of(cls, config: ImuConfig) -> ImuExtrinsics:
        """Return what the settings say; those set by hand count more than the file.

        A file that has nothing about an IMU, as one of the beams alone, leaves it as drawn.

        Raises
        ------
        SettingError
            If the calibration file cannot be used.
        """
        if not config.calibration_file:
            return cls(time_offset_ms=config.imu_time_offset_ms)
        try:
            imu = load(Path(config.calibration_file)).imu
        except CalibrationFileError as error:
            raise SettingError(f"parameter 'calibration_file': {error}") from None
        if imu is None:
            problem = (
                f"{config.calibration_file} has no part 'imu', so the IMU is used as drawn; add "
                "it with l2lidar calibrate imu"
            )
            return cls(time_offset_ms=config.imu_time_offset_ms, problem=problem)
        by_hand = any(config.imu_rpy)
        turn = config.T_cloud_imu[:3, :3] if by_hand else rotations.from_rpy(imu.rotation_rpy)
        return cls(
            turn,
            config.imu_time_offset_ms or 1e3 * imu.time_offset,
            unmixing(np.array(imu.gyro_scale), np.array(imu.gyro_skew)),
            config.calibration_file,
        )

    def mounted(self, T_cloud_imu: F64) -> F64:
        """Return a mount (4, 4) with the rotation that is known."""
        mount = np.array(T_cloud_imu, dtype=np.float64)
        if self.rotation is not None:
            mount[:3, :3] = self.rotation
        return mount

    def corrected(self, samples: Samples) -> Samples:
        """Return samples (N,) as a perfect IMU in the same place would have measured them."""
        moved = earlier(samples, self.time_offset_ms)
        if np.array_equal(self.unmixing, np.eye(3)):
            return moved
        fixed = moved.copy()
        fixed["angular_velocity"] = moved["angular_velocity"] @ self.unmixing.T
        return fixed
