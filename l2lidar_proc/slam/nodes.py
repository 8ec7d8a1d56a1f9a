"""Data of the back end: sweeps, nodes, the map, states."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from l2lidar_node.types import F64, HostNs
from l2lidar_proc.cloud import positions
from l2lidar_proc.odometry.estimate import CUTS, BaseFrame, OdometryEstimate
from l2lidar_proc.recording.outputs import STAMPED_POSE, StampedPoses, Trajectory
from l2lidar_proc.slam.config import SlamConfig
from l2lidar_proc.slam.loops import odometry_covariance
from l2lidar_proc.slam.pose_graph import CUT, ODOMETRY
from l2lidar_proc.slam.se3 import (
    SHIFT,
    TURN,
    error,
    interpolated,
    inverse,
    leveled,
    magnitude,
    transformed,
)
from l2lidar_proc.slam.submap import Submap, SubmapBuilder

_TURN_ARM_M: Final = 0.5  # a turn counts like the way it makes at this distance
_HELD_M: Final = 0.5  # nearer than this the same place is seen, and the same covariance counts


class Health(Enum):
    """Status of a sweep by the odometry."""

    GOOD = "aligned"
    DEGENERATE = "aligned, but the scene does not constrain the pose in every direction"
    SKIPPED = "skipped to catch up: the IMU carries the pose"
    PREDICTED = "not aligned: the pose is predicted"
    CUT = "the motion since the previous sweep is unknown"


class SlamState(Enum):
    """Whether the pose in the map is known; the value is its description."""

    SEARCHING = "the pose in the map is unknown and is searched for"
    TENTATIVE = "a pose fits: waiting until further matches agree"
    LOCALIZED = "the pose in the map is known"
    DEAD_RECKONING = "no recent match: the odometry carries the pose"
    LOST = "the pose in the map is lost: the last known one is held"


@dataclass(frozen=True, slots=True, eq=False)
class OdometrySweep:
    """A deskewed sweep with its odometry pose.

    Attributes
    ----------
    stamp : HostNs
    T_odom_body : ndarray, shape (4, 4)
        z of the odometry frame is up.
    points : ndarray, shape (N, 3)
        Body frame [m].
    health : Health
    covariance : ndarray, shape (6, 6)
        Of x, y, z, then turns, odometry axes, as in nav_msgs/Odometry; used where the sweep is
        not GOOD.
    """

    stamp: HostNs
    T_odom_body: F64
    points: F64
    health: Health
    covariance: F64

    @classmethod
    def of(cls, estimate: OdometryEstimate, base: BaseFrame) -> OdometrySweep:
        """Return an estimate of the odometry as a sweep of the base frame."""
        motion = base.motion(estimate)
        points = positions(estimate.points)
        return cls(
            estimate.stamp,
            motion.T_odom_base,
            transformed(inverse(base.T_lidar_base), points),
            health_of(status.name for status in estimate.status),
            motion.covariance,
        )


def health_of(names: Iterable[str]) -> Health:
    """Return the health of a sweep from the status names of an estimate."""
    remarks = set(names)
    if remarks & {status.name for status in CUTS}:
        return Health.CUT
    if "SKIPPED" in remarks:
        return Health.SKIPPED
    if "PREDICTED" in remarks:
        return Health.PREDICTED
    return Health.DEGENERATE if "DEGENERATE" in remarks else Health.GOOD


@dataclass(slots=True, eq=False)
class Node:
    """A submap in the graph.

    Attributes
    ----------
    stamp : HostNs
        Of the first sweep.
    T_odom_node : ndarray, shape (4, 4)
        z up.
    submap : Submap or None
        None where another one knows the place, or the file could not be read.
    sweeps : ndarray of STAMPED_POSE
        ``T_node_body`` of each sweep.
    usable : bool
        Whether all sweeps but the skipped ones were aligned and well fixed: otherwise it closes
        no loop.
    way : float
        Of the odometry at its beginning [m].
    unread : str or None
        Name of the submap's file in the saved map, where it could not be read.
    """

    stamp: HostNs
    T_odom_node: F64
    submap: Submap | None
    sweeps: StampedPoses
    usable: bool
    way: float
    unread: str | None = None

    @property
    def is_comparable(self) -> bool:
        """Whether it may take part in loops."""
        return self.usable and self.submap is not None


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A finished submap, for other back ends.

    Attributes
    ----------
    number : int
    stamp : HostNs
        Of its first sweep.
    T_odom_node : ndarray, shape (4, 4)
        z up.
    covariance : ndarray, shape (6, 6), or None
        Of the motion since the keyframe before: turn, then translation, axes of this one. None
        where that motion is not known: at the beginning, and where the odometry lost its way.
    submap : Submap or None
        None if it has no points.
    """

    number: int
    stamp: HostNs
    T_odom_node: F64
    covariance: F64 | None
    submap: Submap | None


@dataclass(frozen=True, slots=True, eq=False)
class Map:
    """Nodes and edges, as they are saved.

    Attributes
    ----------
    nodes : list of Node
    poses : ndarray, shape (N, 4, 4)
        ``T_map_node``.
    edges : ndarray, shape (M,), dtype pose_graph.EDGE
    """

    nodes: list[Node]
    poses: F64
    edges: NDArray[np.void]

    def points(self) -> F64:
        """Return the points of all submaps [m], shape (N, 3), map frame."""
        parts = [
            transformed(pose, node.submap.xyz)
            for node, pose in zip(self.nodes, self.poses, strict=True)
            if node.submap is not None
        ]
        return np.concatenate(parts) if parts else np.zeros((0, 3))

    def largest_part(self) -> NDArray[np.bool_]:
        """Return which nodes belong to the largest part that no cut divides, shape (N,).

        Where the odometry lost its way and no loop led back, the poses of the parts to each
        other mean nothing.
        """
        count = len(self.nodes)
        edges = self.edges[self.edges["kind"] != CUT]
        joined = csr_array(
            (np.ones(len(edges)), (edges["first"], edges["second"])), shape=(count, count)
        )
        _, part = connected_components(joined, directed=False)
        has_points = [node.submap is not None for node in self.nodes]
        largest = np.bincount(part, has_points, minlength=1).argmax()
        return np.asarray(part == largest)

    def trajectory(self) -> StampedPoses:
        """Return the poses of all sweeps in the map frame.

        Between two nodes the correction of the odometry is interpolated, so that the way has no
        steps where submaps meet.
        """
        parts = []
        for number, node in enumerate(self.nodes):
            if not len(node.sweeps):
                continue
            here = self.poses[number] @ inverse(node.T_odom_node)
            there, after = here, number + 1
            joined = (self.edges["first"] == number) & (self.edges["second"] == after)
            if (self.edges["kind"][joined] == ODOMETRY).any():
                there = self.poses[after] @ inverse(self.nodes[after].T_odom_node)
            in_odom = node.T_odom_node @ node.sweeps["pose"]
            step = np.linalg.norm(np.diff(in_odom[:, :3, 3], axis=0), axis=1)
            share = np.concatenate(([0.0], np.cumsum(step)))
            share /= max(float(share[-1]), 1e-9)
            # about the place itself: otherwise a turn would swing the way about odom's origin
            at = np.eye(4)
            at[:3, 3] = in_odom[0, :3, 3]
            corrections = interpolated(here @ at, there @ at, share) @ inverse(at)
            rows = np.empty(len(in_odom), STAMPED_POSE)
            rows["stamp"], rows["pose"] = node.sweeps["stamp"], corrections @ in_odom
            parts.append(rows)
        return np.concatenate(parts) if parts else np.empty(0, STAMPED_POSE)


class CovarianceGrowth:
    """What the odometry's covariance grows by over sweeps that it could not align well.

    Its covariance is that of the whole way since its start, and goes up and down a little from
    sweep to sweep. So what counts is by how much it exceeds the largest one since the odometry
    was last sure, at another place: the ups alone would add up, at rest without end.
    """

    def __init__(self) -> None:
        self._counted: F64 | None = None  # turn, translation; odometry axes
        self._place = np.zeros(3)

    def add(self, sweep: OdometrySweep) -> F64:
        """Take the next sweep; return its share (6, 6): turn, translation; odometry axes.

        Zero for a cut and where the covariance is not finite, and the next sweep begins anew:
        what the odometry says there is not the covariance of a motion that counts.
        """
        now, grown = np.zeros((6, 6)), np.zeros((6, 6))
        now[TURN, TURN] = sweep.covariance[3:, 3:]
        now[SHIFT, SHIFT] = sweep.covariance[:3, :3]
        if sweep.health is Health.CUT or not np.isfinite(now).all():
            self._counted = None
            return grown
        place = sweep.T_odom_body[:3, 3]
        is_sure = sweep.health in (Health.GOOD, Health.SKIPPED)
        has_moved = np.linalg.norm(place - self._place) > _HELD_M
        if self._counted is None or (is_sure and has_moved):
            self._counted, self._place = now, place
        elif not is_sure:
            variance, axes = np.linalg.eigh(now - self._counted)
            grown = (axes * np.maximum(variance, 0.0)) @ axes.T
            self._counted = self._counted + grown
        return grown


class OpenNode:
    """A submap that is still growing.

    Parameters
    ----------
    first : OdometrySweep
        Where it begins.
    way : float
        Of the odometry there [m].
    config : SlamConfig
    """

    def __init__(self, first: OdometrySweep, way: float, config: SlamConfig) -> None:
        self.T_odom_node = leveled(first.T_odom_body)
        self._config = config
        self._builder = SubmapBuilder(config.submaps.map_voxel_m, config.submaps.map_range_m)
        self._stamp, self._began = first.stamp, way
        self._sweeps = Trajectory()
        self._latest = first.T_odom_body
        self._usable = True
        self._growth = CovarianceGrowth()
        self._extra = np.zeros((6, 6))
        self.way = 0.0
        self.turn = 0.0

    def add(self, sweep: OdometrySweep) -> None:
        """Add a sweep."""
        self.lead_to(sweep)
        T_node_body = inverse(self.T_odom_node) @ sweep.T_odom_body
        self._sweeps.append(sweep.stamp, T_node_body)
        if sweep.health in (Health.GOOD, Health.DEGENERATE):
            self._builder.add(T_node_body, sweep.points)
        if sweep.health not in (Health.GOOD, Health.SKIPPED):
            self._usable = False

    def lead_to(self, sweep: OdometrySweep) -> None:
        """Count the motion to a sweep, which may be the first of the next submap."""
        turn, way = magnitude(error(self._latest, sweep.T_odom_body))
        self.way, self.turn, self._latest = self.way + way, self.turn + turn, sweep.T_odom_body
        self._extra += self._growth.add(sweep)

    @property
    def is_full(self) -> bool:
        """Whether it is time for the next one."""
        return self.way + _TURN_ARM_M * self.turn >= self._config.submaps.submap_length_m

    def finish(self) -> Node:
        """Return the node."""
        submap = self._builder.finish()
        return Node(
            self._stamp,
            self.T_odom_node,
            submap if len(submap) else None,
            self._sweeps.poses.copy(),
            self._usable,
            self._began,
        )

    def covariance_to(self, following: F64) -> F64:
        """Return the covariance (6, 6) of the edge to the next node's frame (4, 4) in odom."""
        axes = self.T_odom_node[:3, :3]
        extra = np.zeros((6, 6))
        for part in (TURN, SHIFT):
            extra[part, part] = axes.T @ self._extra[part, part] @ axes
        covariance = odometry_covariance(self.way, self.turn, extra, self._config)
        turn = following[:3, :3].T @ axes
        for part in (TURN, SHIFT):
            covariance[part, part] = turn @ covariance[part, part] @ turn.T
        return covariance
