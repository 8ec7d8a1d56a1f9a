"""Admission of loops: a verified pair waits until others agree with it, or is refused.

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

from l2lidar_proc.slam.candidates import Relation
from l2lidar_proc.slam.config import LoopConfig
from l2lidar_proc.slam.se3 import error, inverse
from l2lidar_proc.slam.verification import Match

F64 = NDArray[np.float64]

LARGEST_DEVIATION: Final = 3.0
"""[sigma] An edge farther off after optimization condemns the batch that came last."""

_WAITING_WAY_M: Final = 60.0  # a pair that nobody confirms within this way is forgotten
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
    """Loops that wait, loops in force, pairs that are barred.

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
        """Take a verified pair; return whether it is within what the odometry's drift explains.

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
