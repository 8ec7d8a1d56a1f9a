"""Scenes: triangles with reflectivity, building blocks, and free paths.

Every function returns an array of shape (T, 3, 3): T triangles, three corners each, x y z [m].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Triangles = NDArray[np.float64]

_CUBE_FACES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]


def quad(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], d: NDArray[np.float64]
) -> Triangles:
    """Return the two triangles of a quadrilateral with corners in order, each of shape (3,)."""
    return np.array([[a, b, c], [a, c, d]], dtype=np.float64)


def box(
    low: tuple[float, float, float], high: tuple[float, float, float], yaw: float = 0.0
) -> Triangles:
    """Return a box by opposite corners, turned by ``yaw`` [rad] about its own vertical axis."""
    corners = np.array(
        [
            [x, y, z]
            for z in (low[2], high[2])
            for y in (low[1], high[1])
            for x in (low[0], high[0])
        ]
    )
    if yaw:
        center = corners.mean(axis=0)
        c, s = np.cos(yaw), np.sin(yaw)
        corners = (corners - center) @ np.array(
            [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]
        ) + center
    return np.concatenate([quad(*corners[list(face)]) for face in _CUBE_FACES])


def grid(points: NDArray[np.float64]) -> Triangles:
    """Return the triangles of a mesh of points, shape (M, N, 3)."""
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    return np.stack([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)], axis=2).reshape(
        -1, 3, 3
    )


def terrain(
    height: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]],
    low: tuple[float, float],
    high: tuple[float, float],
    step: float,
) -> Triangles:
    """Return the ground of height z(x, y) over a rectangle, sampled every ``step`` [m]."""
    x = np.linspace(low[0], high[0], round((high[0] - low[0]) / step) + 1)
    y = np.linspace(low[1], high[1], round((high[1] - low[1]) / step) + 1)
    xx, yy = np.meshgrid(x, y, indexing="ij")
    return grid(np.stack([xx, yy, height(xx, yy)], axis=-1))


def cone(
    base: tuple[float, float, float],
    radius: float,
    top_radius: float,
    height: float,
    sides: int = 16,
) -> Triangles:
    """Return the side of an upright cylinder or truncated cone standing on the point ``base``."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    lower, upper = ring * radius + base, ring * top_radius + base
    upper[:, 2] += height
    return grid(np.stack([lower, upper], axis=1))


def ellipsoid(
    center: tuple[float, float, float],
    radii: tuple[float, float, float],
    roughness: float = 0.0,
    sides: int = 14,
) -> Triangles:
    """Return an ellipsoid whose radius varies by the fraction ``roughness`` in a fixed pattern."""
    longitude = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    latitude = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
    lon, lat = np.meshgrid(longitude, latitude, indexing="ij")
    ripple = 1.0 + roughness * np.sin(3.0 * lon + center[0]) * np.cos(lat) * np.sin(
        4.0 * lat + center[1]
    )
    unit = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    return grid(unit * ripple[..., None] * np.asarray(radii) + np.asarray(center))


def placed(triangles: Triangles, position: tuple[float, float, float], yaw: float) -> Triangles:
    """Return triangles turned by ``yaw`` [rad] about the vertical axis, then moved."""
    c, s = np.cos(yaw), np.sin(yaw)
    moved: Triangles = triangles @ np.array(
        [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]
    ) + np.asarray(position)
    return moved


Ground = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
Point = tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Triangles, and a collision-free path through them.

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
    tour : ndarray, shape (M, 3)
        Stops of a way on the ground [m] that goes through doors and up stairs; may be empty.
    glass, mirrors : ndarray, shape (T, 3, 3)
        Triangles of panes and of mirrors; may be empty.
    """

    triangles: NDArray[np.float64]
    reflectivity: NDArray[np.float64]
    route: NDArray[np.float64]
    spot: Point
    ground: Ground
    headroom: float
    tour: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    glass: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3, 3)))
    mirrors: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3, 3)))


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
            return quad(at(u0, z0, depth), at(u1, z0, depth), at(u1, z1, depth), at(u0, z1, depth))

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
                    quad(at(*corner), at(*other), at(*other, hole.depth), at(*corner, hole.depth)),
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
