"""Estimate of one sweep: pose, quality, and the motion of the base frame."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.types import F64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import (
    GYRO_BIAS,
    POSITION,
    ROTATION,
    InertialState,
    skew,
    twist_jacobian,
)
from l2lidar_proc.motion.head_line import LineRates
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.innovations import observed_scale
from l2lidar_proc.odometry.uncertainty import FrameJump, MapDrift, MapError
from l2lidar_proc.recording.outputs import StampedPoses, leveled_start


class Status(Enum):
    """Status of an estimate; the value is its description."""

    STARTING = "the map began with this sweep"
    PREDICTED = "not aligned with the map: the pose is predicted"
    SPARSE = "too few points"
    UNMATCHED = "too few points match the map"
    SKIPPED = "skipped to catch up: clouds arrive faster than they can be aligned"
    DEGENERATE = "the scene does not constrain the pose in every direction"
    SUSPECT = "contradicts max_speed, the IMU, earlier sweeps or walls: may be worse than it says"
    IMU_GAP = "IMU samples are missing within the span of this estimate"
    NO_IMU = "no IMU samples: constant motion is assumed"
    GRAVITY_UNTRUSTED = (
        "no force of the size of gravity was measured: the accelerometer is not used"
    )
    RESTARTED = "time jumped: the motion is unknown, pose and map are kept"
    LOST = "too long without a match: a new map begins at the predicted pose"
    RETURNED = "an earlier map, or part of it, was matched again: the pose jumped back into it"
    REFUSED = "not later than the previous sweep: ignored"


CUTS: Final = frozenset({Status.LOST, Status.RESTARTED, Status.RETURNED})
"""What cuts a trajectory: across such an estimate the motion is not known."""

DOUBTFUL: Final = frozenset({Status.SUSPECT, Status.LOST, Status.RESTARTED})
"""With these the velocity is not to be trusted, whatever its covariance."""


@dataclass(frozen=True, slots=True)
class AlignmentQuality:
    """Quality of an alignment.

    Attributes
    ----------
    points : int
        Points that were to be aligned.
    matched : int
        Of these, points that met a surface of the map.
    inlier_ratio : float
        Share of the points at known surfaces that are near them, 0 to 1; low at a wrong pose.
    residual_m : float
        Root mean square of their distances to it, outliers weighed down.
    degeneracy_ratio : float
        Share of the points that speak for the least observed direction, 0 to 1/3.
    weakest : tuple of float
        The least observed direction, unit, map axes; zeros where no sweep was aligned.
    kiss_threshold_m : float
        How far predictions have lately been off, as KISS-ICP sees it.
    map_cells : int
        Cells in the map of surfaces.
    nis_per_dof : float
        Normalized innovation squared of the alignments of the last seconds, mean for each degree
        of freedom: 1 where predictions are as good as their covariance says; 0 at rest.
    velocity_nis_per_dof : float
        Likewise of the sum of what they corrected of the velocity: large where accelerometer and
        alignments contradict each other for seconds.
    variance_factor : float
        Factor on the variances of pose and velocity for that: above 1 where predictions are worse
        than their covariance says, below where they are better and every direction was observed.
    velocity_factor : float
        Further factor, at most 1, on the variances of the velocity in the directions that all
        these alignments observed.
    unobserved : tuple of tuple of float
        The other directions, orthonormal, map axes.
    beam_correction : tuple of float
        What was added to the unit's ``xi_angle``, ``beta_angle`` and ``alpha_angle_bias`` [rad].
    range_correction : float
        What was added to its ranges [m].
    attitude_variance : float
        About each axis, by what the gyro's noise bends the sweep that was aligned [rad^2].
    """

    points: int = 0
    matched: int = 0
    inlier_ratio: float = 0.0
    residual_m: float = 0.0
    degeneracy_ratio: float = 0.0
    weakest: tuple[float, float, float] = (0.0, 0.0, 0.0)
    kiss_threshold_m: float = 0.0
    map_cells: int = 0
    nis_per_dof: float = 0.0
    velocity_nis_per_dof: float = 0.0
    variance_factor: float = 1.0
    velocity_factor: float = 1.0
    unobserved: tuple[tuple[float, float, float], ...] = ()
    beam_correction: tuple[float, float, float] = (0.0, 0.0, 0.0)
    range_correction: float = 0.0
    attitude_variance: float = 0.0

    @property
    def observes_all(self) -> bool:
        """Whether points were matched, and constrain the position in every direction."""
        return self.matched > 0 and self.degeneracy_ratio >= tuning.DEGENERATE_SHARE


@dataclass(frozen=True, slots=True, eq=False)
class OdometryEstimate:
    """Pose and motion of the sensor at one instant.

    Attributes
    ----------
    stamp : HostNs
        The instant that pose, velocity and cloud belong to: the reference of the sweep.
    T_map_lidar : ndarray, shape (4, 4)
        Cloud coordinates to map coordinates. Where gravity is trusted z is up there.
    covariance : ndarray, shape (6, 6)
        Of x, y, z and of the turns about the map's axes [m, rad], relative to the map; from the
        first RESTARTED or LOST on also of the map's own place, until an earlier map is met again.
    velocity : ndarray, shape (3,)
        Of the cloud frame's origin, cloud axes [m/s].
    angular_velocity : ndarray, shape (3,)
        Cloud axes, without bias [rad/s].
    twist_covariance : ndarray, shape (6, 6)
        Of velocity and angular velocity, cloud axes.
    points : ndarray, shape (N,)
        The sweep's points within the range limits, as seen from the reference; fields of the
        sweep.
    status : tuple of Status
        Empty when all is well.
    quality : AlignmentQuality
    gyro_bias, accel_bias : ndarray, shape (3,)
        Cloud axes [rad/s, m/s^2].
    gravity : ndarray, shape (3,)
        Map axes [m/s^2]; zero when not trusted.
    gyro_bias_covariance : ndarray, shape (9, 3)
        Of the errors of ``covariance`` (6) and of the gyro bias (3), each with the gyro bias
        [rad/s], cloud axes. What else the angular velocity is uncertain by is noise of samples.
    map_error : MapError, optional
        What the map adds to ``covariance``; None where nothing is known of it.
    stamp_velocity_error : ndarray, shape (3,)
        Error of the velocity for stamps of IMU samples that are off, 1 sigma, cloud axes [m/s].
        Part of ``twist_covariance``, but it does not last: it is the velocity of another instant.
    gyro_line : LineRates, optional
        What the gyro measures too much in step with the head; None where that is not known.
    """

    stamp: HostNs
    T_map_lidar: F64
    covariance: F64
    velocity: F64
    angular_velocity: F64
    twist_covariance: F64
    points: NDArray[np.void]
    status: tuple[Status, ...]
    quality: AlignmentQuality
    gyro_bias: F64
    accel_bias: F64
    gravity: F64
    gyro_bias_covariance: F64 = field(default_factory=lambda: np.zeros((9, 3)))
    map_error: MapError | None = None
    stamp_velocity_error: F64 = field(default_factory=lambda: np.zeros(3))
    gyro_line: LineRates | None = None

    def refusing(self, points: NDArray[np.void]) -> OdometryEstimate:
        """Return the same again for a sweep with points (N,) that was refused."""
        return dataclasses.replace(self, points=points[:0], status=(Status.REFUSED,))

    def map_covariance(self, place: F64) -> F64:
        """Return what the map adds to the covariance (6, 6) at a place (3,) of the IMU [m]."""
        return np.zeros((6, 6)) if self.map_error is None else self.map_error.reported_at(place)

    @property
    def tilt(self) -> float:
        """Angle between the z axis of the map and the vertical as measured since [rad].

        It is what the map was begun with: level at rest, in motion off by some degrees. Not a
        number as long as gravity is not trusted.
        """
        size = float(np.linalg.norm(self.gravity))
        return float(np.arccos(np.clip(-self.gravity[2] / size, -1.0, 1.0))) if size else np.nan

    @property
    def speed_sigma(self) -> float:
        """Standard deviation of the velocity along its least certain direction [m/s]."""
        return float(np.sqrt(np.linalg.eigvalsh(self.twist_covariance[:3, :3])[-1]))

    @property
    def is_aligned(self) -> bool:
        """Whether the sweep was aligned with the map."""
        return not {Status.PREDICTED, Status.REFUSED} & set(self.status)


def cloud_pose(state: InertialState, lever: F64) -> F64:
    """Return the pose (4, 4) of the cloud frame, in which the IMU is at ``lever`` (3,) [m]."""
    pose = np.eye(4)
    pose[:3, :3] = state.rotation
    pose[:3, 3] = state.cloud_origin(lever)
    return pose


def gaps_in(motion: SweepMotion) -> list[Status]:
    """Return the status of the IMU samples of a motion."""
    if motion.imu.missing.all():
        return [Status.NO_IMU]
    return [Status.IMU_GAP] if motion.imu.missing.any() else []


def estimate_of(
    motion: SweepMotion,
    lever: F64,
    moved: NDArray[np.void],
    status: tuple[Status, ...],
    quality: AlignmentQuality,
    gyro_noise: float,
    gyro_line: LineRates | None,
    jump: FrameJump,
    drift: MapDrift,
) -> OdometryEstimate:
    """Return the estimate that a motion amounts to.

    Parameters
    ----------
    motion : SweepMotion
    lever : ndarray, shape (3,)
        Place of the IMU in the cloud frame [m].
    moved : ndarray, shape (N,)
        The points it deskewed.
    status : tuple of Status
        DEGENERATE is added here.
    quality : AlignmentQuality
    gyro_noise : float
        Of an angular velocity [rad/s].
    gyro_line : LineRates, optional
        As in :class:`OdometryEstimate`.
    jump : FrameJump
    drift : MapDrift
        What the map's own place, and its own error, add to the covariance.
    """
    state, p = motion.state, quality.variance_factor * motion.covariance
    if quality.matched and not quality.observes_all:
        status = (*status, Status.DEGENERATE)
    pose = np.zeros((6, 18))
    pose[:3, POSITION] = np.eye(3)
    pose[:3, ROTATION] = state.rotation @ skew(lever)  # the state is the IMU's
    pose[3:, ROTATION] = state.rotation
    twist = np.zeros((6, 18))
    unobserved = np.reshape(quality.unobserved, (-1, 3)).T
    in_map = state.rotation @ twist_jacobian(state, lever)
    scale = observed_scale(in_map @ p @ in_map.T, quality.velocity_factor, unobserved)
    twist[:3] = state.rotation.T @ scale @ in_map
    twist[3:, GYRO_BIAS] = -np.eye(3)  # the rate is what was measured less the bias
    twist_covariance = twist @ p @ twist.T
    twist_covariance[3:, 3:] += gyro_noise**2 * np.eye(3)
    stamp_velocity_error = tuning.IMU_STAMP_SIGMA * motion.acceleration
    twist_covariance[:3, :3] += np.outer(stamp_velocity_error, stamp_velocity_error)
    rate = motion.rate
    found = OdometryEstimate(
        stamp=state.stamp,
        T_map_lidar=cloud_pose(state, lever),
        covariance=pose @ p @ pose.T + jump.at(state.position),
        velocity=state.rotation.T @ state.velocity - rotations.cross(rate, lever),
        angular_velocity=rate,
        twist_covariance=twist_covariance,
        points=moved,
        status=status,
        quality=quality,
        gyro_bias=state.gyro_bias,
        accel_bias=state.accel_bias,
        gravity=state.gravity,
        gyro_bias_covariance=np.vstack((pose @ p, p[GYRO_BIAS]))[:, GYRO_BIAS],
        map_error=drift.error,
        stamp_velocity_error=stamp_velocity_error,
        gyro_line=gyro_line,
    )
    added = found.map_covariance(state.position)
    added[3:, 3:] += quality.attitude_variance * np.eye(3)
    return dataclasses.replace(found, covariance=found.covariance + added)


@dataclass(frozen=True, slots=True, eq=False)
class BaseMotion:
    """Pose and twist of the base frame.

    Attributes
    ----------
    T_odom_base : ndarray, shape (4, 4)
    covariance : ndarray, shape (6, 6)
        Of x, y, z and the turns about the odometry frame's axes [m, rad].
    velocity, angular_velocity : ndarray, shape (3,)
        Base axes [m/s, rad/s].
    twist_covariance : ndarray, shape (6, 6)
        Base axes.
    """

    T_odom_base: F64
    covariance: F64
    velocity: F64
    angular_velocity: F64
    twist_covariance: F64


class BaseFrame:
    """The base frame; the odometry frame begins at its first position, yaw 0.

    Parameters
    ----------
    T_lidar_base : ndarray, shape (4, 4)
        Base coordinates to cloud coordinates.
    """

    def __init__(self, T_lidar_base: F64) -> None:
        self.T_lidar_base = np.asarray(T_lidar_base, dtype=np.float64)
        self._T_odom_map: F64 | None = None

    def reset(self) -> None:
        """Let the odometry frame begin at the next pose."""
        self._T_odom_map = None

    def odom_from_map(self, T_map_lidar: F64) -> F64:
        """Return the transform from map to odometry frame, (4, 4).

        The first pose that is given decides.
        """
        T_odom_map = self._T_odom_map  # once: another thread may reset it
        if T_odom_map is None:
            T_odom_map = self._T_odom_map = leveled_start(T_map_lidar @ self.T_lidar_base)
        return T_odom_map

    def pose(self, T_map_lidar: F64) -> F64:
        """Return the pose (..., 4, 4) of the base frame for one of the cloud frame."""
        return np.asarray(self.odom_from_map(T_map_lidar) @ T_map_lidar @ self.T_lidar_base)

    def poses(self, of_lidar: StampedPoses) -> StampedPoses:
        """Return the poses (N,) of the base frame for those of the cloud frame, oldest first."""
        found = of_lidar.copy()
        if len(found):
            self.odom_from_map(of_lidar["pose"][0])
            found["pose"] = self.pose(of_lidar["pose"])
        return found

    def motion(self, estimate: OdometryEstimate) -> BaseMotion:
        """Return an estimate as one of the base frame."""
        pose = estimate.T_map_lidar
        turn_odom = self.odom_from_map(pose)[:3, :3]
        arm = self.T_lidar_base[:3, 3]
        swing = np.eye(6)
        swing[:3, 3:] = -skew(pose[:3, :3] @ arm)
        swing = _twice(turn_odom) @ swing
        turn_base = self.T_lidar_base[:3, :3].T
        twist = np.eye(6)
        twist[:3, 3:] = -skew(arm)
        twist = _twice(turn_base) @ twist
        velocity = estimate.velocity + rotations.cross(estimate.angular_velocity, arm)
        return BaseMotion(
            self.pose(pose),
            swing @ estimate.covariance @ swing.T,
            turn_base @ velocity,
            turn_base @ estimate.angular_velocity,
            twist @ estimate.twist_covariance @ twist.T,
        )


def _twice(turn: F64) -> F64:
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = turn
    return out
