"""Global search for a place in the map, without an initial pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64
from l2lidar_proc.slam import places
from l2lidar_proc.slam.config import LoopConfig
from l2lidar_proc.slam.nodes import Node
from l2lidar_proc.slam.se3 import error, inverse, magnitude, planar
from l2lidar_proc.slam.submap import SubmapView, structure_of
from l2lidar_proc.slam.verification import Match, Window, likeness, verify

_PEAKS: Final = 6  # places of the plan that are looked at closely
_WINDOW: Final = Window(1.0, 0.8, np.radians(4.0))  # what the plan leaves open
_NEAR_M: Final = 5.0  # submaps farther from a peak do not show it
_STOREY_M: Final = 1.5  # nodes at one place in plan but this far apart are different floors
_SAME: Final = (np.radians(4.0), 0.5)  # [rad, m]
_CELL_M: Final = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A place in the map that matches a query.

    Attributes
    ----------
    node : int
    match : Match
    T_map_query : ndarray, shape (4, 4)
    """

    node: int
    match: Match
    T_map_query: F64


class PlaceSearch:
    """Finds submaps in a map by their structure alone.

    Parameters
    ----------
    view_of : callable
        Returns the view of a node by its number.

    Attributes
    ----------
    view_of : callable
    """

    def __init__(self, view_of: Callable[[int], SubmapView]) -> None:
        self.view_of = view_of
        self._structures: dict[int, F64] = {}
        self._plan: tuple[F64, NDArray[np.int64], F64] | None = None

    def find(
        self,
        query: SubmapView,
        nodes: Sequence[Node],
        poses: F64,
        eligible: NDArray[np.bool_],
        config: LoopConfig,
    ) -> Found | str:
        """Return the one place that fits, or why there is none.

        Parameters
        ----------
        query : SubmapView
        nodes : sequence of Node
        poses : ndarray, shape (N, 4, 4)
            Of the nodes in the map.
        eligible : ndarray, shape (N,)
            Nodes that belong to the map and have points.
        config : LoopConfig
        """
        among = np.flatnonzero(eligible)
        if not len(among):
            return "no map"
        found: list[Found] = []
        refused = "no fit"
        for start in self.candidates(query, nodes, poses, among, _PEAKS):
            node = nearest(start, poses, among)
            assert node is not None
            guess = inverse(poses[node]) @ start
            match = verify(query, self.view_of(node), guess, _WINDOW, config)
            if isinstance(match, str):
                refused = match
                continue
            found.append(Found(node, match, poses[node] @ match.T_target_query))
        if not found:
            return refused
        best = max(found, key=lambda item: item.match.fit.agreement)
        for other in found:
            turn, way = magnitude(error(best.T_map_query, other.T_map_query))
            alike = likeness(other.match.fit.agreement, best.match.fit.agreement)
            if (turn > _SAME[0] or way > _SAME[1]) and alike > config.max_second_best:
                return "ambiguous"
        return best

    def candidates(
        self,
        query: SubmapView,
        nodes: Sequence[Node],
        poses: F64,
        among: NDArray[np.int64],
        count: int,
    ) -> list[F64]:
        """Return where a query may be by its plan: ``T_map_query`` (4, 4), likeliest first.

        Parameters
        ----------
        query : SubmapView
        nodes : sequence of Node
        poses : ndarray, shape (N, 4, 4)
            Of the nodes in the map.
        among : ndarray of int
            Nodes that count.
        count : int
            Largest number of places of the plan; each is returned once for each storey there.
        """
        structure = self._structure(nodes, poses, among)
        seen_from = poses[among, :2, 3]
        return [
            planar(peak.x, peak.y, peak.yaw, poses[node][2, 3])
            for peak in places.anywhere(query.structure, structure, seen_from, _NEAR_M, count)
            for node in _around(peak, poses, among)
        ]

    def _structure(self, nodes: Sequence[Node], poses: F64, among: NDArray[np.int64]) -> F64:
        """Return the cells of upright structure of the whole map, shape (M, 2)."""
        known = self._plan
        if known is not None and known[0] is poses and np.array_equal(known[1], among):
            return known[2]  # a saved map stays as it is
        parts = []
        for node in among.tolist():
            submap = nodes[node].submap
            if node not in self._structures and submap is not None:
                self._structures[node] = structure_of(submap.xyz)
            cells = self._structures[node]
            parts.append(cells @ poses[node][:2, :2].T + poses[node][:2, 3])
        cells = np.unique(np.floor(np.concatenate(parts) / _CELL_M), axis=0)
        structure = np.asarray((cells + 0.5) * _CELL_M)
        self._plan = poses, among, structure
        return structure


def nearest(place: F64, poses: F64, among: NDArray[np.int64]) -> int | None:
    """Return the node that shows a place (4, 4) best; None if none is near."""
    distance = np.linalg.norm(poses[among, :3, 3] - place[:3, 3], axis=1)
    closest = int(np.argmin(distance))
    return int(among[closest]) if distance[closest] <= _NEAR_M else None


def _around(peak: places.Place, poses: F64, among: NDArray[np.int64]) -> list[int]:
    """Return the nearest node of each storey at a place."""
    distance = np.hypot(poses[among, 0, 3] - peak.x, poses[among, 1, 3] - peak.y)
    chosen: list[int] = []
    for index in np.argsort(distance):
        if distance[index] > _NEAR_M:
            break
        node = int(among[index])
        if all(abs(poses[node][2, 3] - poses[other][2, 3]) > _STOREY_M for other in chosen):
            chosen.append(node)
    return chosen
