"""Corrections of IMU samples: unit and sign, rotation, delay of stamps, gyro scale.

:class:`ImuConvention` recognizes accelerometers that measure in g, or with the opposite sign, and
gyros that measure in degrees per second.
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
# The unit of the gyro is told by what its rates make of gravity, window by window. Observed shares
# of it that are left: 0.98 and more in rad/s, 0.1 to 0.5 (median) in degrees, on walks and drones
_WINDOW_NS: Final = 2_000_000_000
_WINDOW_LEAST_S: Final = 1.5  # of it, with samples
_WINDOW_GAP_S: Final = 0.1  # between them, at most
_WINDOW_MOST: Final = 10_000  # samples
# Share of gravity that is left. In rad/s only a fall to 6 m/s leaves so little
_TUMBLED: Final = 0.7
_STEADY: Final = 0.8  # share that is left of it in degrees
# [rad/s] median of a window, in which a carrier would turn five times: no scan could be followed.
# For carriers that turn about the vertical alone, which leaves gravity where it is
_FASTEST_TURN: Final = 15.0
_DEGREE_WINDOWS: Final = 2  # windows that show it
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
    """Converts samples to rad/s, m/s^2 and specific force (+9.8 upwards at rest, REP 145).

    The unit of the accelerometer is told from the norm of the first samples. That of the gyro is
    told by gravity, which stays where it is while the sensor turns: rates that are too large by 57
    make it tumble, or the sensor would turn faster than any carrier. The sign can only be told
    from motion: how the poses of the odometry bend says which way the sensor was accelerated.

    Attributes
    ----------
    in_g : bool
        Whether forces are multiplied by 9.80665.
    in_degrees : bool
        Whether rates are multiplied by pi / 180.
    reversed : bool
        Whether the sign of forces is changed.
    """

    def __init__(self) -> None:
        self.in_g = False
        self.in_degrees = False
        self.reversed = False
        self._norms = np.empty(0)
        self._window: list[Samples] = []
        self._window_count = 0  # samples in it, up to _WINDOW_MOST
        self._window_number = 0  # its stamps, divided by its length
        self._degree_windows = 0  # that show degrees
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
    def rate_factor(self) -> float:
        """What angular velocities are multiplied by, by the detections so far."""
        return float(np.pi / 180.0) if self.in_degrees else 1.0

    @property
    def notes(self) -> list[str]:
        """Descriptions of what was detected."""
        found = []
        if self.in_degrees:
            found.append("the gyro measures in degrees per second: multiplied by pi / 180")
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
        """Return samples (N,) in rad/s and m/s^2, as specific force, by the detections so far."""
        if not (self.in_g or self.in_degrees or self.reversed):
            return samples
        samples = samples.copy()
        samples["angular_velocity"] *= self.rate_factor
        samples["linear_acceleration"] *= self.factor
        return samples

    def adopt(self, other: ImuConvention) -> None:
        """Take over what was detected elsewhere with the same IMU."""
        self.in_g, self.in_degrees = other.in_g, other.in_degrees
        self.reversed = other.reversed

    def in_units(self, samples: Samples) -> Samples:
        """Learn the units from samples (N,); return them as :meth:`applied` does.

        This is enough where no poses come that could tell the sign.
        """
        if not self.in_degrees:
            self._note_turns(samples)
        if len(self._norms) < _DECIDED and len(samples):
            norms = np.linalg.norm(samples["linear_acceleration"], axis=1)
            norms = norms[np.isfinite(norms)]
            self._norms = np.concatenate((self._norms, norms))[:_DECIDED]
            if len(self._norms):
                self.in_g = bool(_G_NORMS[0] < np.median(self._norms) < _G_NORMS[1])
        return self.applied(samples)

    def _note_turns(self, samples: Samples) -> None:
        """Learn the unit of the gyro from samples (N,), window by window."""
        numbers = samples["stamp"] // _WINDOW_NS
        # one at a time is how a live IMU comes, up to a thousand times a second
        several = np.unique(numbers) if len(samples) > 1 else numbers
        for number in several.tolist():
            if number != self._window_number:
                whole = records.joined(self._window) if self._window else samples[:0]
                self._degree_windows += _are_in_degrees(whole)
                self.in_degrees |= self._degree_windows >= _DEGREE_WINDOWS
                self._window, self._window_count, self._window_number = [], 0, number
            some = samples[numbers == number] if len(several) > 1 else samples
            some = some[: _WINDOW_MOST - self._window_count]
            if len(some):
                self._window.append(some)
                self._window_count += len(some)

    def corrected(self, samples: Samples) -> Samples:
        """Learn from samples (N,); return them in rad/s and m/s^2, as specific force."""
        samples = self.in_units(samples)
        if len(samples) and len(self._recent):
            step = int(samples["stamp"][0]) - int(self._recent["stamp"][-1])
            if abs(step) > _KEPT_NS:
                self.forget_motion()  # the clock was set
        # as many as fit where no poses come that would let them go
        self._recent = records.joined((self._recent, samples))[-_MOST_KEPT:]
        return samples

    def watch(self, stamp: HostNs, R_map_imu: F64, position: F64) -> bool:
        """Compare a pose with the samples; return whether the sign has just been found wrong.

        Parameters
        ----------
        stamp : HostNs
            Where it is before that of the pose before, the clock was set.
        R_map_imu : ndarray, shape (3, 3)
        position : ndarray, shape (3,)
            Of the IMU in the map [m].
        """
        if self._poses and stamp < self._poses[-1][0]:
            self._poses = []
        if self._poses and stamp - self._poses[-1][0] < _SHORTEST_NS:
            return False
        pose = np.column_stack([R_map_imu, position])
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


def _are_in_degrees(samples: Samples) -> bool:
    """Return whether rates of a window (N,) must be in degrees per second.

    In rad/s they would be too fast, or gravity would tumble which stays in degrees.
    """
    samples = samples[np.argsort(samples["stamp"], kind="stable")]
    rates = samples["angular_velocity"].astype(np.float64)
    forces = samples["linear_acceleration"].astype(np.float64)
    good = np.isfinite(rates).all(axis=1) & np.isfinite(forces).all(axis=1)
    rates, forces = rates[good], forces[good]
    steps = np.diff(samples["stamp"][good]) * 1e-9
    if steps.sum() < _WINDOW_LEAST_S or steps.max() > _WINDOW_GAP_S:
        return False
    if np.linalg.norm(np.median(rates, axis=0)) > _FASTEST_TURN:
        return True
    if not np.ptp(forces, axis=0).all():
        return False  # it measures nothing

    def mean_force(factor: float) -> float:
        turns = rotations.exp(factor * rates[1:] * steps[:, None])
        q = rotations.cumulative(np.vstack(([1.0, 0.0, 0.0, 0.0], turns)))
        return float(np.linalg.norm(rotations.rotate(q, forces).mean(axis=0)))

    steady = mean_force(np.pi / 180.0)
    size = float(np.median(np.linalg.norm(forces, axis=1)))
    return steady > _STEADY * size and mean_force(1.0) < _TUMBLED * steady


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
