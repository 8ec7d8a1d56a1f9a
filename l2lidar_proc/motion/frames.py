"""Knows rigid transforms between frames and finds the one between any two that are connected."""

from __future__ import annotations

from collections import deque

import numpy as np

from l2lidar_proc.rotations import F64, inverse


class FrameTree:
    """Frames that do not move against each other."""

    def __init__(self) -> None:
        self._neighbours: dict[str, dict[str, F64]] = {}

    def add(self, parent: str, child: str, T_parent_child: F64) -> None:
        """Take a transform, shape (4, 4), child coordinates to parent coordinates."""
        T_parent_child = np.array(T_parent_child, dtype=np.float64)
        self._neighbours.setdefault(parent, {})[child] = T_parent_child
        self._neighbours.setdefault(child, {})[parent] = inverse(T_parent_child)

    def find(self, target: str, source: str) -> F64 | None:
        """Return what takes source coordinates to target coordinates, (4, 4), None if unknown."""
        if target == source:
            return np.eye(4)
        reached = {target: np.eye(4)}
        waiting = deque([target])
        while waiting:
            frame = waiting.popleft()
            for neighbour, transform in self._neighbours.get(frame, {}).items():
                if neighbour in reached:
                    continue
                reached[neighbour] = reached[frame] @ transform
                if neighbour == source:
                    return reached[neighbour]
                waiting.append(neighbour)
        return None
