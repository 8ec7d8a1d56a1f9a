"""Names the scenes that come with the emulator, and makes one of any world."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from l2lidar_node.emulator.indoors import corridor, empty_box, room
from l2lidar_node.emulator.outdoors import yard
from l2lidar_node.emulator.scene import Scene
from l2lidar_node.emulator.world import World

SCENES: Final[dict[str, Callable[[], Scene]]] = {
    "box": empty_box,
    "room": room,
    "corridor": corridor,
    "yard": yard,
}
"""Scenes by name; all are the same at every call."""


def make(name: str) -> Scene:
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
    x, y = ((low[:2] + high[:2]) / 2.0).tolist()
    rx, ry = (high[:2] - low[:2]) / 8.0
    angle = np.arange(8) * np.pi / 4.0
    route = np.column_stack([x + rx * np.cos(angle), y + ry * np.sin(angle)])
    floor = float(low[2])
    return Scene(
        world.triangles,
        world.reflectivity.astype(np.float64),
        route,
        (x, y),
        lambda x, y: np.full_like(x + y, floor),
        min(float(high[2] - low[2]), 3.0),
    )
