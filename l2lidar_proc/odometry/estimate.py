"""Says what the odometry found out from one sweep."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import HostNs
from l2lidar_proc import tuning

F64 = NDArray[np.float64]


class Status(Enum):
    """What is remarkable about an estimate; the value is for people."""

    STARTING = "the map has just begun with this sweep"
    PREDICTED = "not aligned with the map: the pose is predicted"
    SPARSE = "too few points"
    UNMATCHED = "too few points meet the map"
    SKIPPED = "not aligned, to catch up: clouds come faster than they can be aligned"
    DEGENERATE = "the scene does not fix the pose in every direction"
    SUSPECT = "contradicts max_speed, the IMU or the sweeps before: the covariance is widened"
    IMU_GAP = "IMU samples are missing within the span of this estimate"
    NO_IMU = "no IMU sample at all: steady motion is assumed"
    GRAVITY_UNTRUSTED = "the accelerometer's norm is not that of gravity: it is not used"
    RESTARTED = "time jumped: the motion is unknown, pose and map were kept"
    LOST = "too long without a match: a new map begins at the predicted pose"
    RETURNED = "an earlier map was met again: the pose jumped back into it"
    REFUSED = "not later than the previous sweep: nothing was done with it"


CUTS: Final = frozenset({Status.LOST, Status.RESTARTED, Status.RETURNED})
"""What cuts a trajectory: across such an estimate the motion is not known."""

DOUBTFUL: Final = frozenset({Status.SUSPECT, Status.LOST, Status.RESTARTED})
"""With these the velocity is not to be trusted, whatever its covariance."""


@dataclass(frozen=True, slots=True)
class AlignmentQuality:
    """How well a sweep could be aligned.

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
    nis : float
        Normalized innovation squared of the alignments of the last seconds, mean for each degree
        of freedom: 1 where predictions are as good as their covariance says; 0 at rest.
    velocity_nis : float
        Likewise of the sum of what they corrected of the velocity: large where accelerometer and
        alignments contradict each other for seconds.
    excess : float
        By how much the variances of pose and velocity were raised for that, at least 1.
    """

    points: int = 0
    matched: int = 0
    inlier_ratio: float = 0.0
    residual_m: float = 0.0
    degeneracy_ratio: float = 0.0
    weakest: tuple[float, float, float] = (0.0, 0.0, 0.0)
    kiss_threshold_m: float = 0.0
    map_cells: int = 0
    nis: float = 0.0
    velocity_nis: float = 0.0
    excess: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class OdometryEstimate:
    """Where the sensor was at one instant, and how it moved.

    Attributes
    ----------
    stamp : HostNs
        The instant that pose, velocity and cloud belong to: the reference of the sweep.
    T_map_lidar : ndarray, shape (4, 4)
        Cloud coordinates to map coordinates. Where gravity is trusted z is up there.
    covariance : ndarray, shape (6, 6)
        Of x, y, z and of the turns about the axes of the odometry frame [m, rad], relative to the
        map, and from the first RESTARTED or LOST on what the map's own place is uncertain by,
        until an earlier map is met again.
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
        Odometry axes [m/s^2]; zero when not trusted.
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

    def refusing(self, points: NDArray[np.void]) -> OdometryEstimate:
        """Return the same again for a sweep with points (N,) that was refused."""
        return dataclasses.replace(self, points=points[:0], status=(Status.REFUSED,))

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


def degeneracy_ratio(information: F64) -> float:
    """Return the share of some information (3, 3) that its least observed direction has."""
    strength = np.linalg.eigvalsh(information)
    return float(strength[0] / max(float(strength.sum()), 1e-12))


def weakest_direction(information: F64) -> tuple[float, float, float]:
    """Return the direction, unit, of which some information (3, 3) says least."""
    x, y, z = np.linalg.eigh(information)[1][:, 0].tolist()
    return x, y, z


def unobserved_directions(information: F64) -> F64:
    """Return the directions (3, K), orthonormal, of which some information (3, 3) says nothing."""
    strength, directions = np.linalg.eigh(information)
    total = max(float(strength.sum()), 1e-12)
    return np.asarray(directions[:, strength < tuning.DEGENERATE_SHARE * total])
