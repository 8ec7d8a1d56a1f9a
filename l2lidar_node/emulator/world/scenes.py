"""Names the scenes that come with the emulator, and makes one of any world."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from l2lidar_node.emulator.world.indoors import corridor, empty_box, room
from l2lidar_node.emulator.world.mapping_scenes import MAPPING_SCENES
from l2lidar_node.emulator.world.outdoors import yard
from l2lidar_node.emulator.world.scene import Scene
from l2lidar_node.emulator.world.world import World

SCENES: Final[dict[str, Callable[[], Scene]]] = {
    "box": empty_box,
    "room": room,
    "corridor": corridor,
    "yard": yard,
}
"""Small scenes by name; all are the same at every call."""

NAMES: Final = (*SCENES, *MAPPING_SCENES)
"""Names of all built-in scenes: these, and the large ones for mapping."""

_EYE_M: Final = 1.0  # height at which of_world looks around


def make(name: str) -> Scene:
    """Return a built-in scene.

    Raises
    ------
    ValueError
        For a name that is not known.
    """
    if name in MAPPING_SCENES:
        return MAPPING_SCENES[name]().scene
    if name not in SCENES:
        raise ValueError(f"scene '{name}' is not known, expected one of {', '.join(NAMES)}")
    return SCENES[name]()


def of_world(world: World) -> Scene:
    """Return a world of unknown content as a scene: the way is a loop where there is most room.

    Room is looked for on a grid 1 m above the lowest corner: the place that is closed in all
    around and has the nearest wall farthest away. The loop takes 0.6 of that way, at most 4 m.
    """
    corners = world.triangles.reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    steps = np.linspace(0.05, 0.95, 19)
    x, y = np.meshgrid(*(low[:2, None] + (high - low)[:2, None] * steps))
    places = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, low[2] + _EYE_M)])
    angle = np.arange(16) * np.pi / 8.0
    fan = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(16)])
    around = world.distances(np.repeat(places, 16, axis=0), np.tile(fan, (len(places), 1)))
    around = around.reshape(-1, 16)
    free = np.minimum(around.min(axis=1), 10.0)
    best = int(np.argmax(free * np.isfinite(around).mean(axis=1) ** 2))
    spot, radius = places[best], np.clip(0.6 * free[best], 0.2, 4.0)
    down, up = world.distances(
        np.tile(spot, (2, 1)), np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    )
    ground = float(spot[2] - (down if down < 2.0 * _EYE_M else _EYE_M))
    return Scene(
        world.triangles,
        world.reflectivity.astype(np.float64),
        spot[:2] + radius * fan[:, :2],
        (float(spot[0]), float(spot[1])),
        lambda x, y: np.full_like(x + y, ground),
        min(float(spot[2] + up - ground), 3.0),
    )
