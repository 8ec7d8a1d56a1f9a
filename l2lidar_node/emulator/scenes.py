"""Builds the scenes that come with the emulator, and says where in them there is room to move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator import shapes
from l2lidar_node.emulator.world import World

Ground = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


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
    spot: tuple[float, float]
    ground: Ground
    headroom: float


class Builder:
    """Collects triangles with their reflectivity."""

    def __init__(self) -> None:
        self._triangles: list[NDArray[np.float64]] = []
        self._reflectivity: list[NDArray[np.float64]] = []

    def add(self, triangles: NDArray[np.float64], reflectivity: float) -> None:
        """Add triangles (T, 3, 3) of one reflectivity."""
        self._triangles.append(triangles)
        self._reflectivity.append(np.full(len(triangles), reflectivity))

    def finish(
        self,
        route: list[tuple[float, float]],
        spot: tuple[float, float],
        headroom: float,
        ground: Ground | None = None,
    ) -> Scene:
        """Return the scene; see :class:`Scene`. Without ``ground`` it is level at z = 0."""
        return Scene(
            np.concatenate(self._triangles),
            np.concatenate(self._reflectivity),
            np.array(route, dtype=np.float64),
            spot,
            flat if ground is None else ground,
            headroom,
        )


def flat(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return level ground."""
    return np.zeros_like(x + y)


def box() -> Scene:
    """Return an empty rectangular room, 6 x 5 x 3 m, floor at z = 0: exact values are easy to compute."""
    builder = Builder()
    builder.add(shapes.box((-3.0, -2.5, 0.0), (3.0, 2.5, 3.0)), 0.6)
    return builder.finish([(1.5, 0.0), (0.3, 1.2), (-1.5, 0.2), (-0.2, -1.2)], (0.4, 0.3), 3.0)


SCENES: dict[str, Callable[[], Scene]] = {"box": box}
"""Scenes by name."""


def scene(name: str) -> Scene:
    """Return a built-in scene.

    Raises
    ------
    ValueError
        For a name that is not known.
    """
    if name not in SCENES:
        raise ValueError(f"scene '{name}' is not known, expected one of {', '.join(SCENES)}")
    return SCENES[name]()


def of_world(world: World) -> Scene:
    """Return a world of unknown content as a scene: the way is a small loop about its middle."""
    corners = world.triangles.reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    x, y = (low[:2] + high[:2]) / 2.0
    rx, ry = (high[:2] - low[:2]) / 8.0
    angle = np.arange(8) * np.pi / 4.0
    route = np.column_stack([x + rx * np.cos(angle), y + ry * np.sin(angle)])
    floor = float(low[2])
    return Scene(
        world.triangles,
        world.reflectivity.astype(np.float64),
        route,
        (float(x), float(y)),
        lambda x, y: np.full_like(x + y, floor),
        min(float(high[2] - low[2]), 3.0),
    )
