"""KISS-ICP's parts for the odometry, and unmodified KISS-ICP; the only importer of kiss_icp.

It is imported where it is first used: its configuration takes longer than a node may to start.
kiss_icp ends the whole process, without an exception, on constant times and on clouds of one
point: nothing of that kind gets past this module.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.types import F64, HostNs, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.cloud import positions
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import AlignmentQuality, OdometryEstimate, Status
from l2lidar_proc.odometry.interface import Phase, SweepOdometry, SweepOrder, sweep_order

if TYPE_CHECKING:
    from kiss_icp.config import KISSConfig


LIBRARIES: Final = (
    "kiss_icp.config",
    "kiss_icp.mapping",
    "kiss_icp.registration",
    "kiss_icp.threshold",
    "kiss_icp.voxelization",
)
"""What is imported where it is first used."""

_BITS = 21  # of a voxel's number along an axis, so that three fit
_MASK = (1 << _BITS) - 1

LEAST_POINTS = 10  # kiss_icp aborts below 2; below this there is nothing to register


def kiss_config(config: OdometryConfig) -> KISSConfig:
    """Return KISS-ICP's configuration, the voxel size included (it stays unset by itself)."""
    from kiss_icp.config import KISSConfig

    kiss = config.kiss
    out = KISSConfig()
    out.data.max_range, out.data.min_range = config.max_range, config.min_range
    out.mapping.voxel_size = kiss.kiss_voxel_size
    out.mapping.max_points_per_voxel = kiss.kiss_max_points_per_voxel
    out.adaptive_threshold.initial_threshold = kiss.kiss_initial_threshold
    out.adaptive_threshold.min_motion_th = kiss.kiss_min_motion
    out.registration.max_num_iterations = kiss.kiss_iterations
    out.registration.convergence_criterion = kiss.kiss_convergence
    out.registration.max_num_threads = kiss.threads
    return out


class _Parts(NamedTuple):
    """The parts of KISS-ICP; kiss_icp has no types."""

    map: Any
    registration: Any
    threshold: Any


class KissMatcher:
    """Scan matching with KISS-ICP's public parts; deskew and initial guess are the caller's.

    Parameters
    ----------
    config : OdometryConfig
    """

    def __init__(self, config: OdometryConfig) -> None:
        self._config = config
        self._voxel_size = config.kiss.kiss_voxel_size
        self._made: _Parts | None = None
        self._forget_keyframes()

    def _forget_keyframes(self) -> None:
        self._keyframe: F64 | None = None  # pose of the latest
        self._since = 0  # sweeps that came after it
        self._pruned_at = np.zeros(3)

    def clear(self) -> None:
        """Forget the map and what was learnt about the predictions."""
        self._made = None
        self._forget_keyframes()

    @property
    def _parts(self) -> _Parts:
        """Return what KISS-ICP consists of, made and imported when it is first needed."""
        if self._made is None:
            from kiss_icp.mapping import get_voxel_hash_map
            from kiss_icp.registration import get_registration
            from kiss_icp.threshold import get_threshold_estimator

            config = kiss_config(self._config)
            self._made = _Parts(
                get_voxel_hash_map(config),
                get_registration(config),
                get_threshold_estimator(config),
            )
        return self._made

    @property
    def threshold(self) -> float:
        """How far predictions have lately been off [m]."""
        return float(self._parts.threshold.get_threshold())

    def register(self, points: F64, guess: F64, most: float = np.inf) -> F64 | None:
        """Return the pose (4, 4) that aligns points (N, 3) with the map.

        None where there is no map, where the points are too few, and where KISS-ICP finds no
        finite pose.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            Deskewed [m].
        guess : ndarray, shape (4, 4)
        most : float
            Largest threshold to use [m].
        """
        if self._parts.map.empty() or len(points) < LEAST_POINTS:
            return None
        sigma = min(self.threshold, most)
        source = _thinned(points, 1.5 * self._voxel_size)
        pose = self._parts.registration.align_points_to_map(
            points=source,
            voxel_map=self._parts.map,
            initial_guess=guess,
            max_correspondance_distance=3.0 * sigma,
            kernel=sigma,
        )
        return np.asarray(pose) if np.isfinite(pose).all() else None

    def update(self, points: F64, pose: F64, guess: F64, *, keyframes: bool = False) -> None:
        """Add a sweep to the map; learn how good its guess was.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            Deskewed [m].
        pose, guess : ndarray, shape (4, 4)
        keyframes : bool
            Add only keyframes: sweeps by which the sensor has moved by a voxel, or turned, since
            the one that was added last; and every fourth sweep, which fills the map at rest.
        """
        if len(points) < LEAST_POINTS:
            return
        self._parts.threshold.update_model_deviation(np.linalg.inv(guess) @ pose)
        self._since += 1
        if keyframes and self._since < tuning.KEYFRAME_SWEEPS and not self._has_moved(pose):
            return
        self._keyframe, self._since = pose, 0
        placed = (pose[:3, :3] @ _thinned(points, 0.5 * self._voxel_size).T + pose[:3, 3:]).T
        self._parts.map.add_points(np.ascontiguousarray(placed))
        # to look through the whole map takes as long as to add a third of a sweep
        place, most = pose[:3, 3], tuning.PRUNE_SHARE * self._config.max_range
        if np.linalg.norm(place - self._pruned_at) > most:
            self._parts.map.remove_far_away_points(place)
            self._pruned_at = place

    def _has_moved(self, pose: F64) -> bool:
        """Return whether a pose (4, 4) is far from the latest keyframe's."""
        if self._keyframe is None:
            return True
        moved = np.linalg.inv(self._keyframe) @ pose
        angle = float(np.linalg.norm(rotations.log(rotations.from_matrix(moved[:3, :3]))))
        way = float(np.linalg.norm(moved[:3, 3]))
        return way > self._voxel_size or angle > tuning.KEYFRAME_TURN

    def points(self) -> F64:
        """Return the map's points [m], shape (N, 3)."""
        return np.asarray(self._parts.map.point_cloud(), dtype=np.float64).reshape(-1, 3)


class PlainKiss:
    """Unmodified KISS-ICP: its own deskew and prediction, no IMU.

    Parameters
    ----------
    config : OdometryConfig
    """

    def __init__(self, config: OdometryConfig) -> None:
        self._config = kiss_config(config)
        self.clear()

    def clear(self) -> None:
        """Start again."""
        from kiss_icp.kiss_icp import KissICP

        self._kiss = KissICP(self._config)

    @property
    def pose(self) -> F64:
        """Pose (4, 4) of the latest sweep's last point."""
        return np.asarray(self._kiss.last_pose)

    def register(self, points: F64, times: F64) -> F64:
        """Return the cloud (N, 3) as KISS-ICP deskewed it to the last point.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            N >= LEAST_POINTS, finite, within the range limits [m].
        times : ndarray, shape (N,) or (0,)
            Finite and not all equal; none turns KISS-ICP's deskew off.
        """
        frame, _ = self._kiss.register_frame(points, times)
        return np.asarray(frame)

    def points(self) -> F64:
        """Return the map's points [m], shape (N, 3)."""
        return np.asarray(self._kiss.local_map.point_cloud(), dtype=np.float64).reshape(-1, 3)


def thinned_indices(points: F64, size: float) -> NDArray[np.intp]:
    """Return which points (N, 3) KISS-ICP's voxelization keeps: one in each voxel of a size [m].

    KISS-ICP returns the points themselves, not their indices: these are the first of each voxel.
    """
    if len(points) < LEAST_POINTS:
        return np.arange(len(points))
    keys = _voxels(points, size)
    # neighbors in a scan line mostly share a voxel: only the first of them can be the first
    runs = np.flatnonzero(np.diff(keys, prepend=keys[0] - 1))
    some = keys[runs]
    order = np.argsort(some)
    begins = np.flatnonzero(np.diff(some[order], prepend=some[order[0]] - 1))
    return np.sort(runs[np.minimum.reduceat(order, begins)])


def _voxels(points: F64, size: float) -> NDArray[np.int64]:
    """Return a number for the voxel of each point (N, 3), as KISS-ICP divides space."""
    x, y, z = np.floor(points.T / size).astype(np.int64) & _MASK
    return np.asarray(x << 2 * _BITS | y << _BITS | z)


def _thinned(points: F64, size: float) -> F64:
    """Return one of the points (N, 3) in each voxel of a size [m]."""
    from kiss_icp.voxelization import voxel_down_sample

    # other layouts it converts number by number, in ten times the time
    return np.asarray(voxel_down_sample(np.ascontiguousarray(points), size))


_UNKNOWN = 1.0  # KISS-ICP gives no covariance: a meter and a radian


class PlainOdometry(SweepOdometry):
    """Unmodified KISS-ICP as an odometry; it uses no IMU.

    Parameters
    ----------
    config : OdometryConfig
    """

    def __init__(self, config: OdometryConfig) -> None:
        self.config = config
        self.T_cloud_imu = np.eye(4)
        self.phase = Phase.TRACKING
        self.motion = None
        self.reset()

    def configure(self, config: OdometryConfig) -> None:
        """Take new settings: limits of the range at once, KISS-ICP's own with :meth:`reset`."""
        self.config = config

    def reset(self) -> None:
        """Start again at the origin."""
        self._kiss = PlainKiss(self.config)
        self._last: OdometryEstimate | None = None

    def imu(self, samples: Samples) -> None:
        """Take IMU samples and ignore them."""

    @property
    def newest_imu(self) -> HostNs | None:
        """None: no sample is kept."""
        return None

    def extrapolated(self, stamp: HostNs) -> OdometryEstimate | None:
        """Return None: nothing tells the motion between sweeps."""
        return None

    def register(self, sweep: Sweep, *, may_skip: bool = False) -> list[OdometryEstimate]:
        """Return the pose of the sweep's last point, as KISS-ICP registers it.

        A sweep that is late by less than a second is refused. Further back, or far ahead, the
        clock was set: the map is kept, the velocity is unknown. None is skipped.
        """
        points = sweep.points
        xyz = positions(points)
        times = points["time"].astype(np.float64)
        finite = np.isfinite(xyz).all(axis=1) & np.isfinite(times)
        points, xyz, times = points[finite], xyz[finite], times[finite]
        ranges = np.linalg.norm(xyz, axis=1)
        inside = (ranges >= self.config.min_range) & (ranges <= self.config.max_range)
        few = np.count_nonzero(inside) < LEAST_POINTS
        last = float(times.max()) if len(times) else (sweep.end - sweep.start) * 1e-9
        stamp = HostNs(sweep.start + round(last * 1e9))
        status: tuple[Status, ...] = ()
        if self._last is not None:
            order = sweep_order(stamp - self._last.stamp)
            if order is SweepOrder.LATE:
                return [self._last.refusing(points)]
            if order is SweepOrder.OTHER_TIME_LINE:
                self._last = None
                status = (Status.RESTARTED,)
        if not few:
            # KISS-ICP takes equal times of all points inside its limits for a reason to abort
            spread = np.ptp(times[inside]) > 0.0
            frame = self._kiss.register(xyz[inside], times[inside] if spread else times[:0])
            points = points[inside].copy()
            if len(frame) != len(points):
                # its deskew moved some across its range limits; it does not tell which
                points = np.zeros(len(frame), points.dtype)
            for axis, column in zip("xyz", frame.T, strict=True):
                points[axis] = column
        if few:
            status += (Status.PREDICTED, Status.SPARSE)
        self._last = self._estimate(stamp, points, status, int(inside.sum()))
        return [self._last]

    def map_points(self) -> F64:
        """Return the map's points [m], shape (N, 3)."""
        return self._kiss.points()

    def _estimate(
        self, stamp: HostNs, points: NDArray[np.void], status: tuple[Status, ...], count: int
    ) -> OdometryEstimate:
        pose = self._kiss.pose
        velocity, rate = np.zeros(3), np.zeros(3)
        if self._last is not None:
            dt = (stamp - self._last.stamp) * 1e-9
            moved = np.linalg.inv(self._last.T_map_lidar) @ pose
            velocity = moved[:3, :3].T @ moved[:3, 3] / dt
            rate = rotations.log(rotations.from_matrix(moved[:3, :3])) / dt
        return OdometryEstimate(
            stamp=stamp,
            T_map_lidar=pose.copy(),
            covariance=_UNKNOWN * np.eye(6),
            velocity=velocity,
            angular_velocity=rate,
            twist_covariance=_UNKNOWN * np.eye(6),
            points=points,
            status=status,
            quality=AlignmentQuality(points=count),
            gyro_bias=np.zeros(3),
            accel_bias=np.zeros(3),
            gravity=np.zeros(3),
        )
