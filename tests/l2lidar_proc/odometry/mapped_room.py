"""A room, sweeps of it, and a matcher that maps them, for the tests of matching."""

from __future__ import annotations

import numpy as np

from l2lidar_node import rotations
from l2lidar_node.types import F64, HostNs
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.matcher import SweepMatcher
from l2lidar_proc.odometry.prediction import Predictor
from l2lidar_proc.odometry.registration.correspondences import Source
from tests.l2lidar_proc.motion.analytic import EPOCH, Motion

TIGHT, LOOSE = (0.005, 0.01), (0.01, 0.25)  # standard deviations [rad, m]
PLACE = np.array([0.4, -0.3, 0.1])


def room(rng: np.random.Generator, count: int) -> F64:
    """Return points of a room of 8 by 6 by 3 m with a box in a corner, 1 cm of noise."""
    sizes = np.array([8.0, 6.0, 3.0])
    points = rng.uniform(0.0, 1.0, (count, 3)) * sizes
    axis, side = rng.integers(0, 3, count), rng.integers(0, 2, count)
    points[np.arange(count), axis] = side * sizes[axis]
    box = rng.uniform(0.0, 1.0, (count // 8, 3)) * (1.5, 1.0, 1.2)
    axis = rng.integers(0, 3, len(box))
    box[np.arange(len(box)), axis] = np.array([1.5, 1.0, 1.2])[axis]
    points = np.vstack((points, box)) - (4.0, 3.0, 1.2)
    return np.asarray(points + rng.normal(0.0, 0.01, points.shape))


def corner(rng: np.random.Generator, strip: int = 25, floor: int = 40, wall: int = 300) -> F64:
    """Return points of one wall of the room, and of strips of the next one and of the floor."""
    return np.vstack((
        rng.uniform((0.0, 3.0, -1.2), (4.0, 3.0, 1.8), (wall, 3)),
        rng.uniform((4.0, 2.0, -1.2), (4.0, 3.0, 1.8), (strip, 3)),
        rng.uniform((0.0, 2.0, -1.2), (4.0, 3.0, -1.2), (floor, 3)),
    ))  # fmt: skip


def motion(
    known: tuple[float, float], place: F64, turn: float = 0.0, *, imu: bool = True
) -> SweepMotion:
    """Return the motion of a sensor at rest, predicted at a place, turned about z by an angle."""
    nothing = np.zeros(3)
    rotation = rotations.matrices(rotations.exp((0.0, 0.0, turn)))
    gravity = np.array([0.0, 0.0, -9.80665])
    state = InertialState(EPOCH, rotation, place, nothing, nothing, nothing, gravity)
    covariance = 1e-6 * np.eye(eskf.ERRORS)
    covariance[eskf.ROTATION, eskf.ROTATION] = known[0] ** 2 * np.eye(3)
    covariance[eskf.POSITION, eskf.POSITION] = known[1] ** 2 * np.eye(3)
    predictor = Predictor(OdometryConfig(), np.eye(4))
    if imu:
        predictor.imu(Motion().imu(-0.1, 0.4))
    return predictor.over(state, covariance, (EPOCH, HostNs(EPOCH + 200_000_000)), EPOCH)


def source(points: F64) -> Source:
    return Source(points, np.zeros(len(points)), np.linalg.norm(points, axis=1))


def extended(
    matcher: SweepMatcher,
    points: F64,
    known: tuple[float, float] = TIGHT,
    *,
    imu: bool = True,
    expected_share: float = 1.0,
) -> float:
    """Add points that are seen from the origin; return the share where there was no map."""
    cloud = np.zeros(len(points), [(axis, "<f4") for axis in "xyz"])
    cloud["x"], cloud["y"], cloud["z"] = points.T
    at = motion(known, np.zeros(3), imu=imu)
    return matcher.extend(cloud, at, at.state, expected_share)
