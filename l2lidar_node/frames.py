"""Static frame tree: transforms between rigidly mounted frames."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from l2lidar_node.rotations import inverse, normalised, transform
from l2lidar_node.types import F64

_MAX_DISTANCE_M: Final = 1000.0  # between a frame and its parent
_NORM_TOLERANCE: Final = 0.1  # of a quaternion; a driver's rounding stays far below
_MAX_FRAMES: Final = 10_000
_MAX_DEPTH: Final = 1000  # of a chain; a loop has no end


class FrameTree:
    """Frames fixed to each other, each with one parent, as in tf2."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, F64]] = {}

    def take(self, message: Any) -> list[str]:
        """Take the transforms of a TFMessage; return which could not be used, and why."""
        problems = []
        for item in message.transforms:
            parent, child = item.header.frame_id.lstrip("/"), item.child_frame_id.lstrip("/")
            q, p = item.transform.rotation, item.transform.translation
            problem = self._problem(parent, child, (q.w, q.x, q.y, q.z), (p.x, p.y, p.z))
            if problem:
                problems.append(f"transform from '{child}' to '{parent}' not used: {problem}")
            else:
                turn = normalised((q.w, q.x, q.y, q.z))
                self.add(parent, child, transform(turn, (p.x, p.y, p.z)))
        return problems

    def add(self, parent: str, child: str, T_parent_child: F64) -> None:
        """Take a transform, shape (4, 4), child coordinates to parent coordinates."""
        self._parents[child] = parent, np.array(T_parent_child, dtype=np.float64)

    def find(self, target: str, source: str) -> F64 | None:
        """Return the transform from source to target coordinates, (4, 4), None if unknown."""
        target, source = target.lstrip("/"), source.lstrip("/")
        if target == source:
            return np.eye(4)
        ups = self._ancestors(source)
        downs = self._ancestors(target)
        for frame, T_frame_target in downs.items():
            if frame in ups:
                return np.asarray(inverse(T_frame_target) @ ups[frame])
        return None

    def obstacle(self, parent: str, child: str) -> str:
        """Return in words why a child may not be put below a parent; empty if it may.

        It may have no other parent already, and must not be above the new one.
        """
        parent, child = parent.lstrip("/"), child.lstrip("/")
        known, _ = self._parents.get(child, ("", None))
        if known not in ("", parent):
            return f"'{known}' is already the parent of '{child}'"
        return f"'{child}' is already above '{parent}'" if child in self._ancestors(parent) else ""

    def root(self, frame: str) -> tuple[str, F64]:
        """Return the topmost frame above a frame, and the transform to it, (4, 4).

        The frame itself where nothing is above it.
        """
        *_, (name, T_root_frame) = self._ancestors(frame.lstrip("/")).items()
        return name, T_root_frame

    def _ancestors(self, frame: str) -> dict[str, F64]:
        """Return a frame and all above it, nearest first, each with the transform to it."""
        found = {frame: np.eye(4)}
        while frame in self._parents and len(found) < _MAX_DEPTH:
            parent, T_parent_child = self._parents[frame]
            if parent in found:  # a loop
                break
            found[parent] = T_parent_child @ found[frame]
            frame = parent
        return found

    def _problem(
        self,
        parent: str,
        child: str,
        q_wxyz: tuple[float, float, float, float],
        xyz: tuple[float, float, float],
    ) -> str:
        """Return why a transform cannot be that of a mount; empty if it can."""
        if not all(math.isfinite(value) for value in (*q_wxyz, *xyz)):
            return "it has a number that is not finite"
        norm, distance = math.hypot(*q_wxyz), math.hypot(*xyz)
        if abs(norm - 1.0) > _NORM_TOLERANCE:
            return f"its quaternion has the norm {norm:.3g}, expected 1"
        if distance > _MAX_DISTANCE_M:
            return f"it is {distance:.3g} m long, expected up to {_MAX_DISTANCE_M:g} m"
        if parent == child:
            return "a frame cannot be its own parent"
        if child not in self._parents and len(self._parents) >= _MAX_FRAMES:
            return f"there are {_MAX_FRAMES} frames already"
        return ""
