"""Builds the outdoor scene: a sloping yard with houses, trees, a fence and cars under open sky."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.world.scene import (
    Builder,
    Scene,
    box,
    cone,
    ellipsoid,
    placed,
    quad,
    terrain,
)

_GRASS, _LEAVES, _BARK, _BRICK, _PAINT, _GLASS = 0.35, 0.5, 0.25, 0.5, 0.6, 0.05

_TREES = (  # x, y [m], height of the trunk, radius of the crown
    (-7.5, -2.8, 3.5, 2.4),
    (-1.5, 1.2, 3.7, 2.2),
    (4.2, -3.2, 3.4, 2.1),
    (-4.6, -1.0, 3.3, 1.8),
    (0.6, -2.8, 4.0, 2.3),
    (-13.5, 7.5, 3.6, 2.4),
    (-14.0, -6.5, 3.3, 2.6),
    (9.4, -10.6, 2.6, 2.2),
    (-4.0, -11.0, 3.2, 2.5),
    (3.2, -10.2, 3.3, 2.2),
    (1.5, -15.5, 3.0, 2.6),
    (-10.0, -15.0, 3.2, 2.8),
    (-18.0, 1.0, 3.2, 2.6),
    (9.6, 1.6, 3.4, 1.9),
    (14.5, 9.5, 3.4, 2.6),
)


def yard() -> Scene:
    """Return the yard, 28 x 22 m; the ground falls by 1.4 m to the west and undulates."""
    builder = Builder()
    builder.add(_GRASS, terrain(_height, (-24.0, -20.0), (24.0, 20.0), 0.5))
    _house(builder)
    _garage(builder)
    _fence(builder)
    for number, tree in enumerate(_TREES):
        _tree(builder, number, *tree)
    for x, y, yaw in ((8.6, -6.4, 1.3), (9.3, 4.6, 0.1), (-10.6, -10.4, -0.1)):
        _car(builder, x, y, yaw)
    for x, y, size in ((-8.5, 4.2, 0.7), (-11.0, 1.5, 0.6), (1.2, -8.9, 0.6), (-3.8, 6.6, 0.5)):
        builder.add(
            _LEAVES, ellipsoid((x, y, _z(x, y) + 0.5 * size), (1.3 * size, size, size), 0.2)
        )
    for x in (-16.0, -8.0, 0.0, 8.0):  # a garden wall that steps with the slope
        z = _z(x + 4.0, -13.5)
        builder.add(_BRICK, box((x, -13.7, z - 1.5), (x + 8.0, -13.4, z + 2.1)))
    z = _z(3.0, 7.0)
    builder.add(0.4, box((2.2, 6.9, z + 0.4), (3.8, 7.35, z + 0.45)))
    for x in (2.3, 3.6):
        builder.add(0.4, box((x, 6.95, z - 0.2), (x + 0.1, 7.3, z + 0.4)))
    builder.add(0.4, cone((-0.6, -5.2, _z(-0.6, -5.2) - 0.2), 0.07, 0.05, 4.4, 8))
    route = [
        (-9.5, -6.6), (-5.5, -8.0), (-2.0, -7.6), (1.5, -6.5), (5.2, -6.2), (6.9, -3.0), (7.2,
        0.6), (5.4, 3.6), (2.0, 4.2), (-1.6, 4.6), (-5.2, 4.3), (-7.8, 1.8), (-10.6, -1.2), (-11.2,
        -4.4),
    ]  # fmt: skip
    return builder.finish(route, (1.8, 1.0), 4.0, _height)


def _height(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return (
        0.05 * x
        + 0.02 * y
        + 0.2 * np.sin(x / 4.0) * np.cos(y / 5.0)
        + 0.02 * np.sin(1.3 * x + 0.9 * y)
    )


def _z(x: float, y: float) -> float:
    return float(_height(np.array(x), np.array(y)))


def _house(builder: Builder) -> None:
    x0, y0, x1, y1, eaves, ridge = -6.5, 8.5, 9.5, 15.5, 5.2, 8.0
    builder.add(_BRICK, box((x0, y0, -1.5), (x1, y1, eaves)))
    middle = (y0 + y1) / 2
    west, east = np.array([x0 - 0.4, middle, ridge]), np.array([x1 + 0.4, middle, ridge])
    for y in (y0 - 0.5, y1 + 0.5):
        low_west, low_east = (
            np.array([x0 - 0.4, y, eaves - 0.2]),
            np.array([x1 + 0.4, y, eaves - 0.2]),
        )
        builder.add(0.3, quad(low_west, low_east, east, west))
    for x in (x0, x1):
        builder.add(_BRICK, np.array([[[x, y0, eaves], [x, y1, eaves], [x, middle, ridge]]]))
    for x, z in (
        (-5.3, 1.3),
        (-2.6, 1.3),
        (5.9, 1.5),
        (-5.3, 3.6),
        (-1.8, 3.6),
        (2.2, 3.6),
        (6.4, 3.6),
    ):
        builder.add(_GLASS, box((x, y0 - 0.03, z), (x + 1.3, y0, z + 1.2)))
        builder.add(_PAINT, box((x - 0.1, y0 - 0.16, z - 0.1), (x + 1.4, y0, z)))
    builder.add(
        0.4,
        box((1.2, y0 - 0.06, -1.0), (2.3, y0, 2.5)),
        box((0.9, y0 - 0.9, -1.0), (2.6, y0, 0.4)),
    )
    builder.add(_PAINT, box((0.6, y0 - 1.1, 2.7), (2.9, y0, 2.85)))
    builder.add(0.3, box((6.3, 12.4, 6.0), (7.0, 13.1, 9.0)))


def _garage(builder: Builder) -> None:
    builder.add(
        _PAINT, box((12.0, -9.5, -1.5), (18.0, 3.5, 3.9)), box((11.7, -9.8, 3.9), (18.3, 3.8, 4.1))
    )
    for y in (-8.6, -4.9):
        builder.add(0.35, box((11.94, y, -1.0), (12.0, y + 2.9, 2.6)))
    builder.add(_GLASS, box((11.96, -0.9, 1.6), (12.0, 1.1, 2.6)))
    builder.add(0.4, box((11.5, 1.9, -0.5), (12.0, 2.6, 1.9)))


def _fence(builder: Builder) -> None:
    """Add a board fence along x = -16, whose gaps let one beam in three through."""
    for y in np.arange(-13.0, 14.0, 0.18):
        z = _z(-16.0, float(y))
        builder.add(0.45, box((-16.03, y, z - 0.1), (-16.0, y + 0.12, z + 1.9)))
    for y in np.arange(-13.0, 14.1, 2.0):
        z = _z(-16.0, float(y))
        builder.add(0.45, box((-16.13, y - 0.05, z - 0.3), (-16.03, y + 0.05, z + 2.0)))


def _tree(builder: Builder, number: int, x: float, y: float, trunk: float, crown: float) -> None:
    z = _z(x, y)
    builder.add(_BARK, cone((x, y, z - 0.3), 0.2, 0.12, trunk + 0.9, 10))
    rng = np.random.default_rng(number)  # a fixed wood
    for _ in range(12):
        dx, dy = rng.normal(0.0, 0.4 * crown, 2)
        size = crown * rng.uniform(0.3, 0.5)
        place = (x + dx, y + dy, z + trunk + size * 0.8 + crown * rng.uniform(0.0, 0.9))
        builder.add(_LEAVES, ellipsoid(place, (size, size, 0.8 * size), 0.2, 12))


def _car(builder: Builder, x: float, y: float, yaw: float) -> None:
    place = (x, y, _z(x, y))
    builder.add(_PAINT, placed(box((-2.1, -0.85, 0.25), (2.1, 0.85, 0.85)), place, yaw))
    builder.add(_GLASS, placed(box((-1.4, -0.75, 0.85), (0.8, 0.75, 1.3)), place, yaw))
    builder.add(_PAINT, placed(box((-1.4, -0.75, 1.3), (0.8, 0.75, 1.42)), place, yaw))
    wheels = [
        box((wx - 0.3, wy - 0.1, -0.1), (wx + 0.3, wy + 0.1, 0.5))
        for wx in (-1.3, 1.3)
        for wy in (-0.78, 0.78)
    ]
    builder.add(0.06, *(placed(wheel, place, yaw) for wheel in wheels))
