"""What the odometry bench has to run, in which order, and the file that keeps what it found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from benchmarks.odometry_methods import REFEREES
from benchmarks.results import KeptRows
from tests.support.odometry_runs import CUTS

SLOW = ("ct_icp", "lio_sam")
KEY = ("scene", "motion", "seed", "seconds", "sweeps", "method")

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Task:
    """What is run over one recording.

    Attributes
    ----------
    scene, motion : str
    seed : int
    seconds : float
    wanted : tuple of (str, str)
        Kind of sweeps and method of each run.
    """

    scene: str
    motion: str
    seed: int
    seconds: float
    wanted: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Plan:
    """Which runs there are.

    Attributes
    ----------
    scenes, motions : tuple of str
    seeds : int
    seconds : float
        Length of a recording.
    sweeps, methods : tuple of str
    referee_seeds : int
        Seeds that the referees get.
    slow_seeds : int
        Seeds that those of :data:`SLOW` get with other sweeps than full turns.
    """

    scenes: tuple[str, ...]
    motions: tuple[str, ...]
    seeds: int
    seconds: float
    sweeps: tuple[str, ...]
    methods: tuple[str, ...]
    referee_seeds: int
    slow_seeds: int

    def tasks(self, done: Sequence[Row] = ()) -> list[Task]:
        """Return what is to be done, without what is.

        First the first seed, then the other seeds without referees, then with them, slow ones
        last: whenever it is cut, what is there can be compared.
        """
        known = {tuple(row[name] for name in KEY) for row in done}
        found = []
        orders = [
            *((rank, 0) for rank in (0, 1)),
            *((rank, seed) for rank in (0, 1) for seed in range(1, self.seeds)),
            *((2, seed) for seed in range(self.seeds)),
        ]
        for (rank, seed), scene, motion in product(orders, self.scenes, self.motions):
            wanted = tuple(
                (cut, name)
                for cut, name in product(self.sweeps, self.methods)
                if self._rank(seed, cut, name) == rank
                and (scene, motion, seed, self.seconds, cut, name) not in known
            )
            if wanted:
                found.append(Task(scene, motion, seed, self.seconds, wanted))
        return found

    def has(self, row: Row) -> bool:
        """Return whether a row is of this plan."""
        return (
            row["scene"] in self.scenes
            and row["motion"] in self.motions
            and row["seconds"] == self.seconds
            and row["seed"] < self.seeds
            and row["sweeps"] in self.sweeps
            and row["method"] in self.methods
            and self._rank(row["seed"], row["sweeps"], row["method"]) is not None
        )

    def _rank(self, seed: int, cut: str, name: str) -> int | None:
        """Return when a run's turn is: 0 first, None never."""
        if name not in REFEREES:
            return 0
        if seed >= self.referee_seeds:
            return None
        if name not in SLOW or cut == CUTS[0]:
            return 1
        return 2 if seed < self.slow_seeds else None


@dataclass(frozen=True, slots=True)
class Rows(KeptRows):
    """The rows of the odometry's runs."""

    path: Path = Path("out") / "bench" / "odometry.jsonl"
    key: tuple[str, ...] = KEY

    def describe(self, row: Row) -> str:
        """Return what is printed of a row."""
        words = ", ".join(str(row[name]) for name in self.key)
        return f"{words}: {1e3 * row['ate_m']:.1f} mm, {row['real_time_factor']:.1f} x real time"
