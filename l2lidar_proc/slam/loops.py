"""Loops: candidates from the pose graph, and admission of verified pairs.

What is between two nodes is the shortest way through the graph: the uncertainty of its edges, and
the odometry's way along them, over which systematic drift adds up.

One pair may be a lie however well it fits: two equal aisles do. Loops enter in batches of pairs
that agree with each other through the odometry between them, from several submaps along the way;
a batch that the optimized graph cannot hold is undone and its pairs are barred.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from l2lidar_node.types import F64
from l2lidar_proc.slam.config import LoopConfig, SlamConfig
from l2lidar_proc.slam.pose_graph import CUT, relative
from l2lidar_proc.slam.se3 import SHIFT, TURN, adjoint, error, inverse
from l2lidar_proc.slam.verification import Match, Window

_NO_WAY_M: Final = 0.01  # what a loop counts as way, so that fewer loops are better
_SLACK_M: Final = 0.5  # two passes of one place are rarely closer
_REACH_M: Final = 6.0  # submaps farther apart than this are not worth a comparison
_MOST: Final = 3  # candidates of a submap: neighbors say the same
_CHI2: Final = 22.5  # 6 degrees of freedom, 99.9 %
_LARGEST_WINDOW: Final = (6.0, 1.5, np.radians(8.0))  # [m, m, rad] that is searched
_UNKNOWN: Final = (3.0, 1000.0)  # [rad, m]
_LEAST_WINDOW: Final = (0.3, 0.1, np.radians(0.5))
_TURN_PER_M: Final = np.radians(0.05) / 10.0  # systematic drift in yaw


@dataclass(frozen=True, slots=True, eq=False)
class Relation:
    """Relation of two nodes in the graph.

    Attributes
    ----------
    T_first_second : ndarray, shape (4, 4)
    covariance : ndarray, shape (6, 6)
        Turn, translation; axes of the second.
    way : float
        Of odometry between them, through the graph [m].
    systematic : tuple of float
        Bounds of systematic drift in plan [m], height [m] and yaw [rad].
    """

    T_first_second: F64
    covariance: F64
    way: float
    systematic: tuple[float, float, float]

    @property
    def window(self) -> Window:
        """How far the truth may be: three standard deviations and the systematic drift."""
        sigma = 3.0 * np.sqrt(np.diag(self.covariance))
        half = (
            float(np.hypot(*sigma[3:5])) + self.systematic[0],
            float(sigma[5]) + self.systematic[1],
            float(sigma[2]) + self.systematic[2],
        )
        return Window(*np.clip(half, _LEAST_WINDOW, _LARGEST_WINDOW))

    def chi2(self, off: F64) -> float:
        """Return how unlikely an error (6,) of the relative pose is; drift is taken off first."""
        left = np.array(off)
        plan = float(np.hypot(*off[3:5]))
        left[3:5] *= max(plan - self.systematic[0], 0.0) / max(plan, 1e-9)
        left[5] = np.sign(off[5]) * max(abs(off[5]) - self.systematic[1], 0.0)
        left[2] = np.sign(off[2]) * max(abs(off[2]) - self.systematic[2], 0.0)
        floor = np.diag(np.repeat((np.radians(0.1) ** 2, 0.02**2), 3))
        return float(left @ np.linalg.solve(self.covariance + floor, left))

    def admits(self, off: F64) -> bool:
        """Return whether an error (6,) of the relative pose is within the drift."""
        return self.chi2(off) < _CHI2


class Graph:
    """Shortest paths from one node to all others.

    Parameters
    ----------
    poses : ndarray, shape (N, 4, 4)
    edges : ndarray, shape (M,), dtype EDGE
        Cuts are left out.
    node : int
        Where the ways begin.
    config : SlamConfig
    """

    def __init__(self, poses: F64, edges: NDArray[np.void], node: int, config: SlamConfig) -> None:
        edges = edges[edges["kind"] != CUT]
        self._poses, self._edges, self._node, self._config = poses, edges, node, config
        ways = np.maximum(edges["way"], _NO_WAY_M)
        rows = np.concatenate((edges["first"], edges["second"]))
        columns = np.concatenate((edges["second"], edges["first"]))
        count = len(poses)
        # parallel edges would be added up: the shortest counts
        order = np.lexsort((np.r_[ways, ways], columns, rows))
        rows, columns = rows[order], columns[order]
        keep = np.r_[True, (np.diff(rows) != 0) | (np.diff(columns) != 0)] if len(rows) else order
        matrix = csr_array(
            (np.r_[ways, ways][order][keep], (rows[keep], columns[keep])), shape=(count, count)
        )
        self.ways, self._before = dijkstra(matrix, indices=node, return_predecessors=True)
        self._edge_of = {
            (int(edge["first"]), int(edge["second"])): number
            for number, edge in reversed(list(enumerate(edges)))
        }

    def near(self, eligible: NDArray[np.bool_]) -> list[int]:
        """Return the nodes that may be near, nearest first.

        Parameters
        ----------
        eligible : ndarray, shape (N,)
            Nodes that have points.
        """
        config = self._config
        distance = np.linalg.norm(self._poses[:, :2, 3] - self._poses[self._node, :2, 3], axis=1)
        drift = config.drift
        percent = drift.systematic_percent + 3.0 * drift.drift_percent
        allowed = 0.01 * percent * self.ways
        reach = _REACH_M + np.minimum(allowed, _LARGEST_WINDOW[0])
        fit = eligible & np.isfinite(self.ways) & (distance < reach + _SLACK_M)
        fit &= self.ways >= config.loop.loop_min_way_m
        chosen = np.flatnonzero(fit)
        order = chosen[np.argsort(distance[chosen])]
        return [int(node) for node in order[:_MOST]]

    def relation(self, node: int) -> Relation:
        """Return the relation of another node (first) to the start node."""
        drift = self._config.drift
        covariance = np.zeros((6, 6))
        end = self._poses[self._node]
        at = node
        while at != self._node:
            # predecessors lead from any node back to where the ways begin
            after = int(self._before[at])
            covariance += self._carried(at, after, end)
            at = after
        way = float(self.ways[node])
        return Relation(
            inverse(self._poses[node]) @ end,
            covariance,
            way,
            (
                drift.systematic_percent * 0.01 * way,
                drift.systematic_height_percent * 0.01 * way,
                _TURN_PER_M * way,
            ),
        )

    def _carried(self, at: int, after: int, end: F64) -> F64:
        """Return the covariance of one edge in the axes of the last node."""
        forward = self._edge_of.get((at, after))
        number = self._edge_of[after, at] if forward is None else forward
        edge = self._edges[number]
        ad = adjoint(inverse(end) @ self._poses[edge["second"]])
        return np.asarray(ad @ edge["covariance"] @ ad.T)


def odometry_covariance(way: float, turn: float, extra: F64, config: SlamConfig) -> F64:
    """Return the covariance (6, 6) of an odometry edge.

    Parameters
    ----------
    way : float
        [m]
    turn : float
        Angle turned through on it [rad].
    extra : ndarray, shape (6, 6)
        What the odometry itself says beyond that, where it was not aligned or degenerate.
    config : SlamConfig
    """
    drift = config.drift
    shift = np.hypot(0.002, drift.drift_percent * 0.01 * way)
    angle = np.radians(np.hypot(0.02, drift.turn_drift_deg * way / 10.0)) + 0.001 * turn
    covariance = np.array(extra)
    covariance[TURN, TURN] += np.eye(3) * angle**2
    covariance[SHIFT, SHIFT] += np.eye(3) * shift**2
    return covariance


def unknown_covariance() -> F64:
    """Return a covariance (6, 6) that says nothing, as where the odometry lost its way."""
    return np.diag(np.repeat(np.square(_UNKNOWN), 3))


def between(poses: F64, first: int, second: int) -> F64:
    """Return ``T_first_second`` (4, 4)."""
    return np.asarray(relative(poses, np.array([first]), np.array([second]))[0])


LARGEST_DEVIATION: Final = 3.0
"""[sigma] An edge farther off after optimization condemns the batch that came last."""

_WAITING_WAY_M: Final = 60.0  # a pair that is not confirmed within this distance is dropped
_AGREE_CHI2: Final = 22.5  # 6 degrees of freedom, 99.9 %
_LOOSE: Final = (np.radians(0.2), 0.03)  # [rad, m] by which submaps are bent themselves


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """A verified pair.

    Attributes
    ----------
    query, target : int
        Numbers of the nodes; the query is the newer one.
    match : Match
    way : float
        Of the odometry when the query was made [m].
    """

    query: int
    target: int
    match: Match
    way: float

    @property
    def pair(self) -> tuple[int, int]:
        """The two numbers."""
        return self.query, self.target


class Admission:
    """Pending loops, accepted loops, barred pairs.

    Parameters
    ----------
    config : LoopConfig

    Attributes
    ----------
    rejected : Counter of str
        Candidates by the reason they were refused for.
    """

    def __init__(self, config: LoopConfig) -> None:
        self._config = config
        self._waiting: list[Loop] = []
        self._recent: list[Loop] = []
        self._barred: set[tuple[int, int]] = set()
        self.rejected: Counter[str] = Counter()

    @property
    def waiting(self) -> int:
        """Number of verified pairs that wait for others."""
        return len(self._waiting)

    def is_open(self, query: int, target: int) -> bool:
        """Return whether a pair may be compared."""
        return (query, target) not in self._barred

    def judge(self, relation: Relation | None, loop: Loop) -> bool:
        """Take a verified pair; return whether it is within the odometry's drift.

        Parameters
        ----------
        relation : Relation or None
            Of target and query; None where the odometry says nothing of it.
        loop : Loop
        """
        if relation is not None:
            off = error(relation.T_first_second, loop.match.T_target_query)
            if not relation.admits(off):
                self.rejected["odometry"] += 1
                return False
        self._waiting = [
            other for other in self._waiting if loop.way - other.way <= _WAITING_WAY_M
        ]
        self._recent = [other for other in self._recent if loop.way - other.way <= _WAITING_WAY_M]
        self._waiting.append(loop)
        return True

    def batch(self, poses: F64) -> list[Loop]:
        """Return loops that agree with each other and may enter together; empty if too few do.

        Parameters
        ----------
        poses : ndarray, shape (N, 4, 4)
            Of all nodes: what loops must agree through.
        """
        known = [*self._recent, *self._waiting]
        agree = {
            frozenset((one.pair, other.pair))
            for one, other in combinations(known, 2)
            if _agree(one, other, poses)
        }
        best: list[Loop] = []
        for seed in self._waiting:
            clique = [seed]
            for loop in sorted(known, key=lambda other: abs(other.way - seed.way)):
                if all(frozenset((loop.pair, other.pair)) in agree for other in clique):
                    clique.append(loop)
            if len({loop.query for loop in clique}) > len({loop.query for loop in best}):
                best = clique
        if len({loop.query for loop in best}) < self._config.loop_votes:
            return []
        return [loop for loop in best if loop in self._waiting]

    def accept(self, loops: list[Loop]) -> None:
        """Move loops from those that wait to those in force."""
        self._waiting = [loop for loop in self._waiting if loop not in loops]
        self._recent += loops

    def bar(self, loops: list[Loop]) -> None:
        """Never look at the pairs of these loops again."""
        self.rejected["optimization"] += len(loops)
        self._barred.update(loop.pair for loop in loops)
        self._waiting = [loop for loop in self._waiting if loop not in loops]


def _agree(one: Loop, other: Loop, poses: F64) -> bool:
    """Return whether two loops and the odometry between their ends close a cycle."""
    if one.query == other.query and one.target == other.target:
        return False
    queries = inverse(poses[one.query]) @ poses[other.query]
    targets = inverse(poses[one.target]) @ poses[other.target]
    through = one.match.T_target_query @ queries
    around = targets @ other.match.T_target_query
    off = error(around, through)
    reach = np.linalg.norm(queries[:3, 3]) + np.linalg.norm(targets[:3, 3])
    # drift along both stretches, and what bends a submap
    turn = _LOOSE[0] + np.radians(0.05) * reach / 10.0
    shift = _LOOSE[1] + 0.01 * reach + turn * (np.linalg.norm(queries[:3, 3]) + 1.0)
    covariance = one.match.covariance + other.match.covariance
    covariance = covariance + np.diag(np.repeat((turn**2, (shift / 3.0) ** 2), 3))
    return bool(off @ np.linalg.solve(covariance, off) < _AGREE_CHI2)
