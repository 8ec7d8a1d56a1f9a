"""Motion tracker of the deskew: the trajectory of any sweep and its quality."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from l2lidar_node import rotations
from l2lidar_node.types import F64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.config import MotionConfig
from l2lidar_proc.motion.imu_buffer import ImuBuffer, Samples
from l2lidar_proc.motion.preintegration import coverage
from l2lidar_proc.motion.sweep_motion import SweepTrajectory, still_trajectory
from l2lidar_proc.motion.twist_filter import TwistFilter


class Flag(Enum):
    """Problems with the motion of a sweep."""

    NO_IMU = "no IMU samples near the sweep, so it is passed on as it came"
    IMU_ENDS_EARLY = "IMU samples do not reach the end of the sweep"
    IMU_STARTS_LATE = "IMU samples begin after the start of the sweep"
    IMU_GAP = "a stretch of the sweep has no IMU samples"
    NO_VELOCITY = "no velocity is known, so only rotation is corrected"
    ACCELEROMETER_FAULT = "gravity has the wrong magnitude, as after a power-on on the side"
    CLOCK_JUMP = "the clock jumped while the sweep waited"
    UNTRUSTED_VELOCITY = "the odometry does not trust its velocity, so points may be smeared"
    PREDICTED_VELOCITY = "the odometry did not align the sweep, so its velocity is a prediction"
    FILTER_LEFT_OUT = "a filter failed on these points, so its chain was skipped"


@dataclass(frozen=True, slots=True)
class Quality:
    """How well the motion during a sweep is known.

    Attributes
    ----------
    imu_covered : float
        Share of the sweep between the first and the last IMU sample, 0 to 1.
    imu_gap_ns : int
        Longest stretch of the sweep without a sample.
    rotation_rad, translation_m : float
        Between start and end of the sweep.
    velocity_source : str
        Where the velocity came from, empty without one.
    velocity_age_ns : int
        From the newest velocity used to the end of the sweep; 0 where it reaches that far.
    velocity_sigma : float
        Standard deviation of the velocity along its least certain direction [m/s], where an
        odometry in the same process gave it. A point 0.1 s from the reference is off by a tenth
        of it [m].
    bias : tuple of float
        Of the gyro [rad/s], IMU axes.
    is_still : bool
        The sensor did not move, so no point was moved.
    is_gravity_trusted : bool
        Whether vertical and accelerometer were of use.
    flags : tuple of Flag
    """

    imu_covered: float
    imu_gap_ns: int
    rotation_rad: float
    translation_m: float
    velocity_source: str
    velocity_age_ns: int
    bias: tuple[float, float, float]
    is_still: bool
    is_gravity_trusted: bool
    flags: tuple[Flag, ...]
    velocity_sigma: float = 0.0


_LONGEST_MOTION_NS: Final = 2_000_000_000  # between two sweeps that follow each other
_SEAM_NS: Final = 10_000_000  # between two trajectories that follow each other, at most


class KnownMotion(NamedTuple):
    """Motion of a sweep, estimated by an odometry in the same process.

    Attributes
    ----------
    trajectory : SweepTrajectory
    is_aligned : bool
        The sweep itself was aligned; otherwise its motion is predicted.
    speed_sigma : float
        Standard deviation of the velocity along its least certain direction [m/s].
    is_trusted : bool
        The odometry stands by its estimate.
    """

    trajectory: SweepTrajectory
    is_aligned: bool
    speed_sigma: float = 0.0
    is_trusted: bool = True


class MotionTracker:
    """IMU buffer, static detector and error-state filter.

    Deskew without odometry is this filter with updates from twists, or with none.

    Parameters
    ----------
    config : MotionConfig
    T_cloud_imu : ndarray, shape (4, 4), optional
        IMU coordinates to cloud coordinates, in place of the configured ones.

    Attributes
    ----------
    buffer : ImuBuffer
        Samples in cloud axes.
    """

    def __init__(self, config: MotionConfig, T_cloud_imu: F64 | None = None) -> None:
        self._T_cloud_imu = np.array(config.T_cloud_imu if T_cloud_imu is None else T_cloud_imu)
        self.buffer = ImuBuffer(tuning.TRACKER_MEMORY_S)
        self.filter = TwistFilter(self.buffer, self._T_cloud_imu[:3, 3], config.max_gyro_bias)
        self.configure(config)

    def configure(self, config: MotionConfig) -> None:
        """Take new live settings."""
        self._config = config
        self.filter.uses_accelerometer = config.use_accelerometer

    def mount(self, T_cloud_imu: F64) -> bool:
        """Take the place of the IMU, shape (4, 4); return whether it is another one.

        Then what was learned is void.
        """
        if np.allclose(T_cloud_imu, self._T_cloud_imu, rtol=0.0, atol=1e-9):
            return False
        self.buffer.turn(T_cloud_imu[:3, :3] @ self._T_cloud_imu[:3, :3].T)
        self._T_cloud_imu = np.array(T_cloud_imu)
        self._learn_anew()
        return True

    def rescale(self, rates: float, forces: float) -> None:
        """Multiply all samples so far by a factor each; what was learned from them is void."""
        self.buffer.scale(rates, forces)
        self._learn_anew()

    def _learn_anew(self) -> None:
        """Begin again with the samples that are there."""
        self.filter = TwistFilter(
            self.buffer, self._T_cloud_imu[:3, 3], self._config.max_gyro_bias
        )
        self.configure(self._config)

    def reset(self) -> None:
        """Forget all motion, as after a jump of the clock."""
        self.buffer.clear()
        self.filter.reset()

    def imu(self, samples: Samples, *, is_needed: bool = True) -> bool:
        """Take IMU samples in any order and state; return whether the clock jumped with them.

        Parameters
        ----------
        samples : ndarray, shape (N,), dtype IMU_SAMPLE
        is_needed : bool
            False where an odometry knows the motion: then the filter follows every five seconds.
            It catches up when the odometry ends.
        """
        jumps = self.buffer.counts.jumps
        self.buffer.push(turned(samples, self._T_cloud_imu[:3, :3]))
        jumped = self.buffer.counts.jumps > jumps
        if jumped:
            self.filter.reset()
        if is_needed or self.filter.behind_ns >= tuning.TRACKER_IDLE_NS:
            self.filter.follow()
        return jumped

    def velocity(
        self, stamp: HostNs, velocity: ArrayLike, source: str, covariance: F64 | None = None
    ) -> bool:
        """Take a velocity; return whether it is used.

        Refused are those that are not finite, not later than the newest one, or more than a second
        ahead of the IMU samples.

        Parameters
        ----------
        stamp : HostNs
        velocity : array-like, shape (3,)
            Of the cloud frame's origin over the ground, cloud axes [m/s].
        source : str
            Where it comes from, for reports; a new source voids the velocities of the old one.
        covariance : ndarray, shape (3, 3), optional
            Of the velocity.
        """
        return self.filter.take(stamp, velocity, source, covariance)

    @property
    def bias(self) -> F64:
        """Gyro bias [rad/s], IMU axes, shape (3,); zero while nothing is known."""
        return np.asarray(self.filter.gyro_bias @ self._T_cloud_imu[:3, :3])

    def trajectory(
        self, start: HostNs, end: HostNs, known: KnownMotion | None = None
    ) -> tuple[SweepTrajectory, Quality]:
        """Return the trajectory from ``start`` (or earlier) to ``end``, and how good it is.

        A sensor at rest, or one without any IMU sample near, has a trajectory that does not move.

        Parameters
        ----------
        start, end : HostNs
        known : KnownMotion, optional
            Motion of this very sweep; it takes the place of everything known here.
        """
        if known is None:
            self.filter.follow()
        covered, gap = coverage(self.buffer.samples["stamp"], start, end)
        flags = self._flags(start, end, gap)
        if known is not None:
            return known.trajectory, self._quality_of(known, start, end, covered, gap, flags)
        if Flag.NO_IMU in flags:
            still = still_trajectory(start, end)
            return still, self._quality(covered, gap, still=False, flags=flags)
        if self._is_still(start, end):
            still = still_trajectory(start, end)
            return still, self._quality(covered, gap, still=True, flags=flags)
        newest = self.filter.newest_twist
        has_velocity = self.filter.knows_velocity(
            start, self._config.velocity_max_age_ms * 1_000_000
        )
        if not has_velocity:
            flags = (*flags, Flag.NO_VELOCITY)
        found = self.filter.trajectory(start, end, self._config.hold_ms * 1_000_000, has_velocity)
        turned_by, moved_by = found.between(start, end)
        return found, self._quality(
            covered,
            gap,
            rotation=float(np.linalg.norm(rotations.log(turned_by))),
            translation=float(np.linalg.norm(moved_by)),
            age=max(int(end - newest), 0) if has_velocity and newest is not None else None,
            flags=flags,
        )

    def up(self, stamp: HostNs) -> F64 | None:
        """Return the vertical at an instant, cloud axes, unit, shape (3,), None if not known."""
        found = self.filter.up_at(stamp)
        return found if found.any() and not self.filter.is_faulty else None

    def motion(
        self,
        source: HostNs,
        target: HostNs,
        before: KnownMotion | None = None,
        now: KnownMotion | None = None,
    ) -> F64 | None:
        """Return cloud coordinates at one instant to those at a later one, (4, 4).

        None where no IMU samples tell the rotation. Without a velocity it is a rotation alone.

        Parameters
        ----------
        source, target : HostNs
        before, now : KnownMotion, optional
            Of the sweeps with these instants. Where they meet, they take the place of everything
            known here: while an odometry knows the motion, the filter gets no velocities.
        """
        if not 0 < target - source < _LONGEST_MOTION_NS:
            return None
        if before is not None and now is not None:
            seam = HostNs(int(before.trajectory.stamps[-1]))
            if now.trajectory.stamps[0] - seam <= _SEAM_NS:
                to_seam = rotations.transform(*before.trajectory.between(seam, source))
                return rotations.transform(*now.trajectory.between(target, seam)) @ to_seam
        stamps = self.buffer.samples["stamp"]
        if not len(stamps) or stamps[0] > source:
            return None
        if self._is_still(source, target):
            return np.eye(4)
        has_velocity = self.filter.knows_velocity(
            source, self._config.velocity_max_age_ms * 1_000_000
        )
        hold_ns = self._config.hold_ms * 1_000_000
        found = self.filter.trajectory(source, target, hold_ns, has_velocity)
        return rotations.transform(*found.between(target, source))

    def _quality_of(
        self,
        known: KnownMotion,
        start: HostNs,
        end: HostNs,
        covered: float,
        gap: int,
        flags: tuple[Flag, ...],
    ) -> Quality:
        """Return the quality of a motion from an odometry, which can do without the IMU."""
        flags = tuple(Flag.IMU_GAP if flag is Flag.NO_IMU else flag for flag in flags)
        if not known.is_aligned:
            flags = (*flags, Flag.PREDICTED_VELOCITY)
        if not known.is_trusted or known.speed_sigma > tuning.DESKEW_SPEED_SIGMA:
            flags = (*flags, Flag.UNTRUSTED_VELOCITY)
        turned_by, moved_by = known.trajectory.between(start, end)
        quality = self._quality(
            covered,
            gap,
            rotation=float(np.linalg.norm(rotations.log(turned_by))),
            translation=float(np.linalg.norm(moved_by)),
            age=0,
            still=known.trajectory.is_still,
            flags=flags,
        )
        return replace(quality, velocity_source="odometry", velocity_sigma=known.speed_sigma)

    def _is_still(self, start: HostNs, end: HostNs) -> bool:
        speed = self.filter.speed_near(end, self._config.velocity_max_age_ms * 1_000_000)
        if speed is not None and speed > self._config.still_speed:
            return False
        first = HostNs(min(start, end - tuning.TRACKER_STILL_NS))
        stamps = self.buffer.samples["stamp"]
        within = slice(*np.searchsorted(stamps, [first, end]))
        return self.filter.is_still(self.buffer.samples[within])

    def _flags(self, start: HostNs, end: HostNs, gap: int) -> tuple[Flag, ...]:
        stamps = self.buffer.samples["stamp"]
        hold = self._config.hold_ms * 1_000_000
        if not len(stamps) or stamps[-1] < start - hold or stamps[0] > end + hold:
            return (Flag.NO_IMU,)
        flags = []
        if stamps[0] > start:
            flags.append(Flag.IMU_STARTS_LATE)
        if stamps[-1] < end:
            flags.append(Flag.IMU_ENDS_EARLY)
        if gap > self._config.max_gap_ms * 1_000_000:
            flags.append(Flag.IMU_GAP)
        if self.filter.is_faulty:
            flags.append(Flag.ACCELEROMETER_FAULT)
        return tuple(flags)

    def _quality(
        self,
        covered: float,
        gap: int,
        *,
        rotation: float = 0.0,
        translation: float = 0.0,
        age: int | None = None,
        still: bool = False,
        flags: tuple[Flag, ...],
    ) -> Quality:
        x, y, z = self.bias.tolist()
        return Quality(
            imu_covered=covered,
            imu_gap_ns=gap,
            rotation_rad=rotation,
            translation_m=translation,
            velocity_source=self.filter.source if age is not None else "",
            velocity_age_ns=age or 0,
            bias=(x, y, z),
            is_still=still,
            is_gravity_trusted=self.filter.is_trusted,
            flags=flags,
        )


def turned(samples: Samples, rotation: F64) -> Samples:
    """Return samples with rates and forces in axes turned by a rotation matrix (3, 3)."""
    if np.array_equal(rotation, np.eye(3)):
        return samples
    samples = samples.copy()
    for name in ("angular_velocity", "linear_acceleration"):
        samples[name] = samples[name] @ rotation.T
    return samples


def cloud_velocity(linear: ArrayLike, angular: ArrayLike, T_cloud_body: F64) -> F64:
    """Return the velocity of the cloud frame's origin in cloud axes [m/s], shape (3,).

    Parameters
    ----------
    linear, angular : array-like, shape (3,)
        Velocity [m/s] and rate [rad/s] of a body the sensor is fixed to, in the body's axes.
    T_cloud_body : ndarray, shape (4, 4)
        Body coordinates to cloud coordinates.
    """
    turn = T_cloud_body[:3, :3]
    place_of_cloud = -turn.T @ T_cloud_body[:3, 3]
    moved = np.asarray(linear, dtype=np.float64) + rotations.cross(angular, place_of_cloud)
    return np.asarray(turn @ moved)


def cloud_velocity_covariance(covariance: F64 | None, T_cloud_body: F64) -> F64 | None:
    """Return the covariance (3, 3) of a velocity that :func:`cloud_velocity` returns.

    From that of the body's velocity, in its axes; None stays None. What the body's rate is
    uncertain by is left out.
    """
    if covariance is None:
        return None
    turn = T_cloud_body[:3, :3]
    return np.asarray(turn @ covariance @ turn.T)
