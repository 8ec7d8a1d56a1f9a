"""Corrections of IMU samples: unit and sign, rotation, delay of stamps, gyro scale.

:class:`ImuConvention` recognizes accelerometers that measure in g, or with the opposite sign.
:class:`ImuExtrinsics` is what a calibration file and the settings say of an IMU beside its place.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from l2lidar_node import records, rotations
from l2lidar_node.calibration.file import CalibrationFileError, load
from l2lidar_node.settings import SettingError
from l2lidar_node.types import F64, IMU_SAMPLE, STANDARD_GRAVITY, HostNs
from l2lidar_proc.motion.config import ImuConfig
from l2lidar_proc.motion.gyro_alignment import unmixing
from l2lidar_proc.motion.imu_buffer import Samples, earlier

_G_NORMS: Final = (0.7, 1.4)  # median |a| of an accelerometer that measures in g
_DECIDED: Final = 100  # samples after which the unit stays as it is
_KEPT_NS: Final = 2_000_000_000
_MOST_KEPT: Final = 10_000  # samples
# The sign is decided by comparing the changes of the velocity: 20 of them are 4 to 5 s, and
# walking gives 0.1 to 0.3 m/s; noise of 2 mm in poses 0.2 s apart makes 0.025 m/s.
_LEAST_CHANGES: Final = 20
_MOST_CHANGES: Final = 200
_LEAST_CHANGE: Final = 0.05  # [m/s] root mean square
_OPPOSITE: Final = -0.7  # correlation of what was measured with what the poses say
_LONGEST_S: Final = 0.5  # between poses that are compared
_SHORTEST_NS: Final = 190_000_000


class ImuConvention:
    """Converts samples to m/s^2 and specific force (+9.8 upwards at rest, REP 145).

    The unit is told from the norm of the first samples. The sign can only be told from motion:
    how the poses of the odometry bend says which way the sensor was accelerated.

    Attributes
    ----------
    in_g : bool
        Whether samples are multiplied by 9.80665.
    reversed : bool
        Whether the sign of samples is changed.
    """

    def __init__(self) -> None:
        self.in_g = False
        self.reversed = False
        self._norms = np.empty(0)
        self.forget_motion()

    @property
    def knows_unit(self) -> bool:
        """Whether samples have come that show the unit."""
        return len(self._norms) > 0

    @property
    def factor(self) -> float:
        """What forces are multiplied by, by the detections so far."""
        size = STANDARD_GRAVITY if self.in_g else 1.0
        return -size if self.reversed else size

    @property
    def notes(self) -> list[str]:
        """Descriptions of what was detected."""
        found = []
        if self.in_g:
            found.append("the accelerometer measures in g: multiplied by 9.80665")
        if self.reversed:
            found.append(
                "the accelerometer has the opposite sign (gravity instead of specific force): "
                "it is inverted"
            )
        return found

    def forget_motion(self) -> None:
        """Forget poses and samples, as after a restart; keep what was detected."""
        self._recent: Samples = np.empty(0, IMU_SAMPLE)
        self._poses: list[tuple[HostNs, F64]] = []
        self._changes: list[tuple[F64, F64]] = []

    def applied(self, samples: Samples) -> Samples:
        """Return samples (N,) in m/s^2, as specific force, by the detections so far."""
        if not self.in_g and not self.reversed:
            return samples
        samples = samples.copy()
        samples["linear_acceleration"] *= self.factor
        return samples

    def adopt(self, other: ImuConvention) -> None:
        """Take over what was detected with the poses of an odometry."""
        self.in_g, self.reversed = other.in_g, other.reversed

    def in_unit(self, samples: Samples) -> Samples:
        """Learn the unit from samples (N,); return them as :meth:`applied` does.

        This is enough where no poses come that could tell the sign.
        """
        if len(self._norms) < _DECIDED and len(samples):
            norms = np.linalg.norm(samples["linear_acceleration"], axis=1)
            norms = norms[np.isfinite(norms)]
            self._norms = np.concatenate((self._norms, norms))[:_DECIDED]
            if len(self._norms):
                self.in_g = bool(_G_NORMS[0] < np.median(self._norms) < _G_NORMS[1])
        return self.applied(samples)

    def corrected(self, samples: Samples) -> Samples:
        """Learn from samples (N,); return them in m/s^2, as specific force."""
        samples = self.in_unit(samples)
        if len(samples) and len(self._recent):
            step = int(samples["stamp"][0]) - int(self._recent["stamp"][-1])
            if abs(step) > _KEPT_NS:
                self.forget_motion()  # the clock was set
        # as many as fit where no poses come that would let them go
        self._recent = records.joined((self._recent, samples))[-_MOST_KEPT:]
        return samples

    def watch(self, stamp: HostNs, R_odom_imu: F64, position: F64) -> bool:
        """Compare a pose with the samples; return whether the sign has just been found wrong.

        Parameters
        ----------
        stamp : HostNs
            Where it is before that of the pose before, the clock was set.
        R_odom_imu : ndarray, shape (3, 3)
        position : ndarray, shape (3,)
            Of the IMU in the odometry frame [m].
        """
        if self._poses and stamp < self._poses[-1][0]:
            self._poses = []
        if self._poses and stamp - self._poses[-1][0] < _SHORTEST_NS:
            return False
        pose = np.column_stack([R_odom_imu, position])
        self._poses = [*self._poses[-2:], (stamp, pose)]
        if not self.reversed and len(self._poses) == 3:
            change = self._velocity_change()
            if change is not None:
                self._changes = [*self._changes[1 - _MOST_CHANGES :], change]
        self._drop(self._poses[0][0] - _KEPT_NS)
        if self.reversed or len(self._changes) < _LEAST_CHANGES:
            return False
        self.reversed = self._opposite()
        return self.reversed

    def _drop(self, before: int) -> None:
        """Forget samples that no pose will ask for again."""
        self._recent = self._recent[np.searchsorted(self._recent["stamp"], before) :]

    def _velocity_change(self) -> tuple[F64, F64] | None:
        """Return the change of velocity between three poses, by the poses and by the samples.

        The difference of the mean velocities before and after the middle pose is the integral of
        the acceleration, weighted by a triangle over the three instants.
        """
        instants = np.array([stamp for stamp, _ in self._poses], dtype=np.int64)
        t = (instants - instants[1]) * 1e-9
        stamps = self._recent["stamp"]
        if (np.diff(t) <= 0.0).any() or np.diff(t).max() > _LONGEST_S or not len(stamps):
            return None
        within = (stamps > instants[0]) & (stamps < instants[2])
        if np.count_nonzero(within) < 8:
            return None
        p = np.array([pose[:, 3] for _, pose in self._poses])
        by_poses = (p[2] - p[1]) / (t[2] - t[1]) - (p[1] - p[0]) / (t[1] - t[0])
        when = (stamps[within] - instants[1]) * 1e-9
        weight = np.interp(when, t, [0.0, 1.0, 0.0])
        force = self._recent["linear_acceleration"][within]
        turns = np.array([pose[:, :3] for _, pose in self._poses])
        near = np.clip(np.searchsorted((t[:-1] + t[1:]) / 2.0, when), 0, 2)
        turned = np.einsum("nij,nj->ni", turns[near], force)
        # a mean by weights times half the span: samples may be missing
        by_samples = weight @ turned / weight.sum() * (t[2] - t[0]) / 2.0
        return by_poses, by_samples

    def _opposite(self) -> bool:
        """Return whether samples and poses clearly show opposite changes of the velocity."""
        by_poses = np.array([change[0] for change in self._changes])
        by_samples = np.array([change[1] for change in self._changes])
        by_poses = by_poses - by_poses.mean(axis=0)
        by_samples = by_samples - by_samples.mean(axis=0)  # gravity is the same in all of them
        energy = np.sqrt((by_poses**2).sum() * (by_samples**2).sum())
        strong = np.sqrt((by_poses**2).sum(axis=1).mean()) > _LEAST_CHANGE
        return bool(strong and (by_poses * by_samples).sum() < _OPPOSITE * energy)


@dataclass(frozen=True, slots=True, eq=False)
class ImuExtrinsics:
    """Corrections of an IMU's samples and mount.

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
        """Return the corrections from the settings; those set by hand win over the file.

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
                f"{config.calibration_file} has no section 'imu', so the IMU is used as in the "
                "drawing; add it with l2lidar calibrate imu"
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
