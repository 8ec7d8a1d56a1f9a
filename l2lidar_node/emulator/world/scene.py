"""Holds a scene: triangles with reflectivity, and where among them there is room to move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.world import shapes

Ground = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
Point = tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Triangles, and a way through them that touches none.

    Attributes
    ----------
    triangles : ndarray, shape (T, 3, 3)
        [m], world frame, z up.
    reflectivity : ndarray, shape (T,)
    route : ndarray, shape (M, 2)
        Corners of a closed way on the ground [m]; motions round them off.
    spot : tuple of float
        x, y [m] of a place to stand.
    ground : callable
        Height of the ground z(x, y) [m] along the way; takes and gives arrays.
    headroom : float
        Free height above the ground along the way [m].
    """

    triangles: NDArray[np.float64]
    reflectivity: NDArray[np.float64]
    route: NDArray[np.float64]
    spot: Point
    ground: Ground
    headroom: float


@dataclass(frozen=True, slots=True)
class Opening:
    """A door or window: a niche in a wall, between two places along it and two heights [m]."""

    start: float
    end: float
    bottom: float
    top: float
    depth: float
    reflectivity: float


class Builder:
    """Collects triangles with their reflectivity."""

    def __init__(self) -> None:
        self._triangles: list[NDArray[np.float64]] = []
        self._reflectivity: list[NDArray[np.float64]] = []

    def add(self, reflectivity: float, *parts: NDArray[np.float64]) -> None:
        """Add triangles (T, 3, 3) of one reflectivity."""
        for triangles in parts:
            self._triangles.append(triangles)
            self._reflectivity.append(np.full(len(triangles), reflectivity))

    def wall(
        self,
        start: Point,
        end: Point,
        height: float,
        reflectivity: float,
        openings: tuple[Opening, ...] = (),
    ) -> None:
        """Add an upright wall from start to end, on z = 0, with niches that recede to its right.

        Openings are given in ascending order of their place along the wall and do not overlap.
        """
        along = np.array([end[0] - start[0], end[1] - start[1], 0.0])
        length = float(np.linalg.norm(along))
        along /= length
        right = np.array([along[1], -along[0], 0.0])
        origin = np.array([*start, 0.0])

        def at(u: float, z: float, depth: float = 0.0) -> NDArray[np.float64]:
            return np.asarray(origin + u * along + depth * right + np.array([0.0, 0.0, z]))

        def panel(
            u0: float, u1: float, z0: float, z1: float, depth: float = 0.0
        ) -> NDArray[np.float64]:
            return shapes.quad(
                at(u0, z0, depth), at(u1, z0, depth), at(u1, z1, depth), at(u0, z1, depth)
            )

        edges = [0.0, *(edge for hole in openings for edge in (hole.start, hole.end)), length]
        for u0, u1 in zip(edges[::2], edges[1::2], strict=True):
            self.add(reflectivity, panel(u0, u1, 0.0, height))
        for hole in openings:
            u0, u1, z0, z1 = hole.start, hole.end, hole.bottom, hole.top
            self.add(reflectivity, panel(u0, u1, 0.0, z0), panel(u0, u1, z1, height))
            for corner, other in (
                ((u0, z0), (u1, z0)),
                ((u1, z0), (u1, z1)),
                ((u1, z1), (u0, z1)),
                ((u0, z1), (u0, z0)),
            ):
                self.add(
                    reflectivity,
                    shapes.quad(
                        at(*corner), at(*other), at(*other, hole.depth), at(*corner, hole.depth)
                    ),
                )
            self.add(hole.reflectivity, panel(u0, u1, z0, z1, hole.depth))

    def finish(
        self, route: list[Point], spot: Point, headroom: float, ground: Ground | None = None
    ) -> Scene:
        """Return the scene, see :class:`Scene`. Without ``ground`` it is level at z = 0."""
        return Scene(
            np.concatenate(self._triangles),
            np.concatenate(self._reflectivity),
            np.array(route, dtype=np.float64),
            spot,
            _level if ground is None else ground,
            headroom,
        )


def _level(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.zeros_like(x + y)
