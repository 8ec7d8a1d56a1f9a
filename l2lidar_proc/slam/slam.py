"""Mapping: submaps from the odometry, loops between them, one optimized pose graph."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64
from l2lidar_proc.slam import pose_graph
from l2lidar_proc.slam.config import SlamConfig
from l2lidar_proc.slam.loops import LARGEST_DEVIATION, Admission, Graph, Loop, unknown_covariance
from l2lidar_proc.slam.nodes import (
    Health,
    Keyframe,
    Map,
    Node,
    OdometrySweep,
    OpenNode,
    SlamState,
)
from l2lidar_proc.slam.place_search import PlaceSearch
from l2lidar_proc.slam.pose_graph import CUT, EDGE, LOOP, ODOMETRY, GtsamMissingError
from l2lidar_proc.slam.se3 import adjoint, error, inverse, magnitude, transformed
from l2lidar_proc.slam.submap import SubmapView, ViewCache, voxel_keys
from l2lidar_proc.slam.verification import verify

_TIE: Final = (np.radians(0.1), 0.02)  # [rad, m] by which a saved map is bent itself
_DISAGREE: Final = (np.radians(1.0), 0.15)  # [rad, m] places one query may have at once
_KNOWN: Final = 0.85  # a submap of which so much was seen before keeps no points
_KNOWN_CELL_M: Final = 0.5
_KNOWN_REACH_M: Final = 10.0  # submaps farther away do not show a place


class Slam:
    """Builds a map from odometry sweeps.

    Parameters
    ----------
    config : SlamConfig
    saved : Map, optional
        A map to extend: it stands still until the place in it is found.
    place : tuple of ndarray, optional
        ``T_map_odom`` (4, 4) in that map, and its covariance (6, 6) as in :attr:`covariance`,
        where it is known already.
    on_keyframe : callable, optional
        Told of each submap that is closed.

    Attributes
    ----------
    T_map_odom : ndarray, shape (4, 4), or None
        None while the place in a saved map is unknown. Replaced, never changed in place.
    state : SlamState
    covariance : ndarray, shape (6, 6)
        Of the newest node in the map: turn, then translation, map axes.
    loops : list of tuple of int
        Pairs of nodes in force: query, target.

    Raises
    ------
    GtsamMissingError
    """

    def __init__(
        self,
        config: SlamConfig,
        saved: Map | None = None,
        *,
        place: tuple[F64, F64] | None = None,
        on_keyframe: Callable[[Keyframe], None] | None = None,
    ) -> None:
        if config.loop.loops and not pose_graph.is_available():
            raise GtsamMissingError
        self.config = config
        self.nodes: list[Node] = list(saved.nodes) if saved else []
        self.poses = saved.poses.copy() if saved else np.zeros((0, 4, 4))
        self.edges = saved.edges.copy() if saved else np.zeros(0, EDGE)
        self.loops = [
            (int(edge["second"]), int(edge["first"]))
            for edge in self.edges[self.edges["kind"] == LOOP]
        ]
        self.state = SlamState.LOCALIZED
        self.T_map_odom: F64 | None = np.eye(4)
        self.covariance = np.zeros((6, 6))
        if place is not None:
            self.T_map_odom, self.covariance = place
        elif saved is not None:
            self.state, self.T_map_odom = SlamState.SEARCHING, None
        self.admission = Admission(config.loop)
        # a node of the part that counts: of a saved map the largest, of a new one the first
        self._root = int(np.argmax(saved.largest_part())) if saved else 0
        self._views = ViewCache()
        self._search = PlaceSearch(self.view_of)
        self._on_keyframe = on_keyframe
        self._open: OpenNode | None = None
        self._way = max((node.way for node in self.nodes), default=0.0)
        self._join_by = CUT if saved else ODOMETRY
        self._place = place
        self._pending_edge: tuple[F64, F64, float] | None = None

    # ---- input

    def add(self, sweep: OdometrySweep) -> bool:
        """Take a sweep, in order of time; return whether a submap was closed by it."""
        closed = False
        if self._open is not None and (sweep.health is Health.CUT or self._open.is_full):
            self._close(sweep)
            closed = True
        if self._open is None:
            self._open = OpenNode(sweep, self._way, self.config)
        self._open.add(sweep)
        return closed

    def finish(self) -> None:
        """Close the open submap: the recording is over."""
        if self._open is not None:
            self._append(self._open.finish(), self._open)
            self._open = None

    @property
    def counts(self) -> Counter[str]:
        """Refused candidates by reason."""
        return self.admission.rejected

    # ---- steps

    def _close(self, sweep: OdometrySweep) -> None:
        """Turn the open submap into a node and look for loops."""
        assert self._open is not None
        open_node, self._open = self._open, None
        if sweep.health is not Health.CUT:
            open_node.lead_to(sweep)
        self._append(open_node.finish(), open_node)
        following = OpenNode(sweep, self._way, self.config)
        if sweep.health is Health.CUT:
            self._join_by = CUT
            self.state, self.covariance = SlamState.LOST, unknown_covariance()
        covariance = open_node.covariance_to(following.T_odom_node)
        T_node_next = inverse(open_node.T_odom_node) @ following.T_odom_node
        self._pending_edge = T_node_next, covariance, open_node.way
        self._open = following

    def _append(self, node: Node, open_node: OpenNode) -> None:
        self._way += open_node.way
        number = len(self.nodes)
        self._tell(number, node)
        self.nodes.append(node)
        if self._pending_edge is None and not number:
            self.poses = node.T_odom_node[None].copy()
        elif self._pending_edge is not None:
            self._connect(number, *self._pending_edge)
        elif self._place is not None:  # first of a session in a saved map
            self._tie(number, *self._place)
        else:
            self._connect(
                number, inverse(self.poses[-1]) @ node.T_odom_node, unknown_covariance(), 0.0
            )
        self._pending_edge = self._place = None
        entered: list[Loop] = []
        if self.config.loop.loops and node.is_comparable:
            entered = self._look_for_loops(number)
        self._forget_known({number, *(loop.query for loop in entered)})
        self._publish()

    def _tell(self, number: int, node: Node) -> None:
        if self._on_keyframe is None:
            return
        covariance = None
        if self._pending_edge is not None and self._join_by != CUT:
            covariance = self._pending_edge[1]
        self._on_keyframe(Keyframe(number, node.stamp, node.T_odom_node, covariance, node.submap))

    def _tie(self, number: int, T_map_odom: F64, covariance: F64) -> None:
        """Join the first node of a session to the nearest one of a map it is known in."""
        T_map_node = T_map_odom @ self.nodes[number].T_odom_node
        distance = np.linalg.norm(self.poses[:, :3, 3] - T_map_node[:3, 3], axis=1)
        distance[~self.map(number).largest_part()] = np.inf
        nearest = int(np.argmin(distance))
        turned = np.eye(4)
        turned[:3, :3] = T_map_node[:3, :3]
        ad = adjoint(inverse(turned))
        edge = np.zeros(1, EDGE)
        edge["first"], edge["second"], edge["kind"] = nearest, number, LOOP
        edge["pose"] = inverse(self.poses[nearest]) @ T_map_node
        edge["covariance"] = ad @ covariance @ ad.T + np.diag(np.repeat(np.square(_TIE), 3))
        self.edges = np.concatenate((self.edges, edge))
        self.poses = np.concatenate((self.poses, T_map_node[None]))
        self.loops.append((number, nearest))
        self._join_by = ODOMETRY

    def _connect(self, number: int, pose: F64, covariance: F64, way: float) -> None:
        edge = np.zeros(1, EDGE)
        kind, self._join_by = self._join_by, ODOMETRY
        edge["first"], edge["second"], edge["kind"] = number - 1, number, kind
        edge["pose"], edge["way"] = pose, way
        edge["covariance"] = unknown_covariance() if kind == CUT else covariance
        self.edges = np.concatenate((self.edges, edge))
        self.poses = np.concatenate((self.poses, (self.poses[-1] @ pose)[None]))

    def _look_for_loops(self, number: int) -> list[Loop]:
        """Return the loops that entered the graph."""
        graph = Graph(self.poses, self.edges, number, self.config)
        verified = self._near(graph, number)
        if not np.isfinite(graph.ways[self._root]):
            verified += self._anywhere(graph, number)
        if _contradict(self.poses, verified):
            self.admission.rejected["ambiguous"] += len(verified)
            return []
        for loop in verified:
            known = np.isfinite(graph.ways[loop.target])
            self.admission.judge(graph.relation(loop.target) if known else None, loop)
        batch = self.admission.batch(self.poses)
        return batch if batch and self._enter(batch) else []

    def _near(self, graph: Graph, number: int) -> list[Loop]:
        """Return verified pairs with the nodes that may be near by the odometry."""
        eligible = np.array([node.is_comparable for node in self.nodes])
        query = self.view_of(number)
        found = []
        for target in graph.near(eligible):
            if not self.admission.is_open(number, target):
                continue
            relation = graph.relation(target)
            match = verify(
                query,
                self.view_of(target),
                relation.T_first_second,
                relation.window,
                self.config.loop,
            )
            if isinstance(match, str):
                self.admission.rejected[match] += 1
            else:
                found.append(Loop(number, target, match, self._way))
        return found

    def _anywhere(self, graph: Graph, number: int) -> list[Loop]:
        """Return a verified pair with a place in a part of the map that nothing leads to."""
        if self.config.localization.relocalize == "never":
            return []
        apart = ~np.isfinite(graph.ways)
        eligible = apart & np.array([node.is_comparable for node in self.nodes])
        found = self._search.find(
            self.view_of(number), self.nodes, self.poses, eligible, self.config.loop
        )
        if isinstance(found, str):
            self.admission.rejected[found] += 1
            return []
        if self.state is SlamState.SEARCHING:
            self.state = SlamState.TENTATIVE
        return [Loop(number, found.node, found.match, self._way)]

    def _enter(self, batch: list[Loop]) -> bool:
        """Put loops into the graph, unless the optimized graph cannot hold them."""
        edges = np.concatenate((self.edges, _edges_of(batch)))
        anchors = np.zeros(1, np.int64)
        poses = pose_graph.optimized(self.poses, edges, anchors)
        if pose_graph.deviations(poses, edges).max() > LARGEST_DEVIATION:
            self.admission.bar(batch)
            return False
        self.poses, self.edges = poses, edges
        self.admission.accept(batch)
        self.loops += [loop.pair for loop in batch]
        return True

    def _forget_known(self, numbers: Iterable[int]) -> None:
        """Drop the points of submaps that show next to nothing that was not seen before.

        Before means on an earlier pass that the graph ties to this one: so ground that is passed
        again and again takes no more memory.
        """
        least = self.config.loop.loop_min_way_m
        ways = np.array([node.way for node in self.nodes])
        for number in sorted(numbers):
            node = self.nodes[number]
            if node.submap is None:
                continue
            graph = Graph(self.poses, self.edges, number, self.config)
            distance = np.linalg.norm(self.poses[:, :3, 3] - self.poses[number, :3, 3], axis=1)
            known = (ways[number] - ways > least) & (graph.ways < 2.0 * least)
            known &= distance < _KNOWN_REACH_M
            seen = [
                voxel_keys(transformed(self.poses[other], submap.xyz), _KNOWN_CELL_M)
                for other in np.flatnonzero(known).tolist()
                if (submap := self.nodes[other].submap) is not None
            ]
            if not seen:
                continue
            own = voxel_keys(transformed(self.poses[number], node.submap.xyz), _KNOWN_CELL_M)
            if np.isin(own, np.concatenate(seen)).mean() > _KNOWN:
                node.submap = None

    def _publish(self) -> None:
        """Renew state and ``T_map_odom``."""
        graph = Graph(self.poses, self.edges, len(self.nodes) - 1, self.config)
        if np.isfinite(graph.ways[self._root]):
            self.state = SlamState.LOCALIZED
            turned = np.eye(4)
            turned[:3, :3] = self.poses[-1][:3, :3]
            ad = adjoint(turned)
            self.covariance = ad @ graph.relation(self._root).covariance @ ad.T
        if (
            self.state in (SlamState.LOCALIZED, SlamState.LOST) and self.T_map_odom is not None
        ) or self.state is SlamState.LOCALIZED:
            self.T_map_odom = self.poses[-1] @ inverse(self.nodes[-1].T_odom_node)

    # ---- results

    def view_of(self, number: int) -> SubmapView:
        """Return the registration view of a node with points."""
        submap = self.nodes[number].submap
        assert submap is not None
        return self._views.of(number, submap)

    def map(self, count: int | None = None) -> Map:
        """Return the map as it is now, or its first ``count`` nodes."""
        edges = self.edges
        if count is not None:
            edges = edges[(edges["first"] < count) & (edges["second"] < count)]
        return Map(list(self.nodes[:count]), self.poses[:count].copy(), edges.copy())


def _contradict(poses: F64, loops: list[Loop]) -> bool:
    """Return whether loops of one query put it at different places."""
    places = [poses[loop.target] @ loop.match.T_target_query for loop in loops]
    for place in places[1:]:
        turn, way = magnitude(error(places[0], place))
        if turn > _DISAGREE[0] or way > _DISAGREE[1]:
            return True
    return False


def _edges_of(loops: list[Loop]) -> NDArray[np.void]:
    edges = np.zeros(len(loops), EDGE)
    for edge, loop in zip(edges, loops, strict=True):
        edge["first"], edge["second"], edge["kind"] = loop.target, loop.query, LOOP
        edge["pose"], edge["covariance"] = loop.match.T_target_query, loop.match.covariance
    return edges
