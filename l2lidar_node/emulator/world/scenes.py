"""Built-in scenes and their names: rooms, a corridor, a yard, woods.

The houses are in :mod:`~l2lidar_node.emulator.world.buildings`, what is mapped in
:mod:`~l2lidar_node.emulator.world.mapping_scenes`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.world.mapping_scenes import MAPPING_SCENES
from l2lidar_node.emulator.world.scene import (
    Builder,
    Opening,
    Scene,
    box,
    cone,
    ellipsoid,
    placed,
    quad,
    terrain,
)
from l2lidar_node.emulator.world.world import World

_PLASTER, _WOOD, _DARK_WOOD, _CLOTH, _GLASS, _METAL = 0.75, 0.45, 0.25, 0.3, 0.06, 0.55


def empty_box() -> Scene:
    """Return an empty room, 6 x 5 x 3 m, floor at z = 0: exact values are easy to compute."""
    builder = Builder()
    builder.add(0.6, box((-3.0, -2.5, 0.0), (3.0, 2.5, 3.0)))
    return builder.finish([(1.5, 0.0), (0.3, 1.2), (-1.5, 0.2), (-0.2, -1.2)], (0.4, 0.3), 3.0)


def room() -> Scene:
    """Return a furnished room, 9 x 6 x 2.8 m, without symmetry; its middle is the origin."""
    builder = Builder()
    builder.add(0.4, box((-4.5, -3.0, -0.1), (4.5, 3.0, 0.0)))
    builder.add(
        0.85, box((-4.5, -3.0, 2.8), (4.5, 3.0, 2.9)), box((1.1, -3.0, 2.58), (1.35, 3.0, 2.8))
    )
    builder.wall(
        (-4.5, -3.0), (4.5, -3.0), 2.8, _PLASTER, (Opening(0.9, 1.9, 0.0, 2.05, 0.25, _WOOD),)
    )
    builder.wall((4.5, -3.0), (4.5, 3.0), 2.8, 0.6, (Opening(1.8, 4.4, 0.9, 2.2, 0.3, _GLASS),))
    builder.wall((4.5, 3.0), (-4.5, 3.0), 2.8, _PLASTER)
    builder.wall((-4.5, 3.0), (-4.5, -3.0), 2.8, 0.65)
    _furnish(builder)
    route = [
        (-2.9, 1.2), (-1.9, 1.95), (0.0, 2.0), (1.7, 1.75), (3.4, 1.3), (3.75, -0.1),
        (3.3, -1.5), (2.0, -1.55), (0.7, -1.75), (-1.2, -1.9), (-2.7, -1.5), (-3.1, -0.1),
    ]  # fmt: skip
    return builder.finish(route, (1.5, 0.3), 2.5)


def corridor() -> Scene:
    """Return a corridor along x, 40 m long, 2.2 m wide, 2.6 m high, with doors and little else."""
    builder = Builder()
    builder.add(0.35, box((-2.0, -1.1, -0.1), (38.0, 1.1, 0.0)))
    builder.add(0.8, box((-2.0, -1.1, 2.6), (38.0, 1.1, 2.7)))
    right = (1.5, 6.0, 10.5, 16.0, 21.5, 25.0, 30.5, 35.0)
    left = (3.5, 9.0, 13.2, 18.8, 27.0, 33.5)
    builder.wall((-2.0, -1.1), (38.0, -1.1), 2.6, _PLASTER, tuple(_door(x + 2.0) for x in right))
    builder.wall(
        (38.0, -1.1), (38.0, 1.1), 2.6, _PLASTER, (Opening(0.5, 1.6, 0.0, 2.05, 0.1, _WOOD),)
    )
    builder.wall(
        (38.0, 1.1),
        (-2.0, 1.1),
        2.6,
        _PLASTER,
        tuple(_door(38.0 - x - 0.9) for x in reversed(left)),
    )
    builder.wall((-2.0, 1.1), (-2.0, -1.1), 2.6, _PLASTER)
    for x in np.arange(0.5, 37.0, 4.5):
        builder.add(0.9, box((x, -0.3, 2.52), (x + 1.2, 0.3, 2.6)))
    builder.add(_METAL, box((-2.0, 0.95, 2.3), (38.0, 1.1, 2.45)))
    builder.add(
        _METAL, cone((12.1, 0.98, 0.4), 0.08, 0.08, 0.55), box((28.9, 0.9, 0.0), (29.7, 1.1, 1.8))
    )
    builder.add(_WOOD, box((22.8, -1.1, 0.42), (24.3, -0.83, 0.47)))
    for x in (22.9, 24.1):
        builder.add(_WOOD, box((x, -1.05, 0.0), (x + 0.1, -0.87, 0.42)))
    builder.add(
        _DARK_WOOD,
        box((4.8, 1.07, 1.2), (6.0, 1.1, 1.9)),
        box((31.9, -1.1, 1.2), (32.7, -1.07, 2.0)),
    )
    ends = np.linspace(-np.pi / 2, np.pi / 2, 7)[1:-1]
    straight = np.arange(0.0, 36.1, 2.0)
    lane = 0.55 - 0.12 * np.sin(straight / 36.0 * np.pi) ** 0.5
    there = np.column_stack([straight, -lane])
    turn = 0.55 * np.column_stack([np.cos(ends), np.sin(ends)])
    back = np.column_stack([straight[::-1], lane])
    route = np.vstack([there, turn + np.array([36.0, 0.0]), back, -turn])
    return builder.finish([(x, y) for x, y in route.tolist()], (8.0, 0.1), 2.3)


def _door(start: float) -> Opening:
    return Opening(start, start + 0.9, 0.0, 2.05, 0.12, _WOOD)


def _furnish(builder: Builder) -> None:
    builder.add(_WOOD, placed(_table(1.8, 0.9), (-0.9, 0.1, 0.0), np.deg2rad(8.0)))
    chairs = (
        (-1.5, 0.85, 185.0),
        (-0.5, 0.95, 170.0),
        (-1.25, -0.65, 12.0),
        (-0.2, -0.7, -25.0),
        (0.4, 0.35, 100.0),
    )
    for x, y, yaw in chairs:
        builder.add(_DARK_WOOD, placed(_chair(), (x, y, 0.0), np.deg2rad(yaw)))
    builder.add(
        0.5, cone((-0.9, 0.1, 1.75), 0.22, 0.08, 0.2), cone((-0.9, 0.1, 1.95), 0.01, 0.01, 0.85, 6)
    )
    _shelves(builder)
    builder.add(
        _WOOD,
        box((-4.5, 0.9, 0.0), (-3.9, 2.5, 1.95)),
        box((-3.9, 1.67, 0.95), (-3.86, 1.73, 1.15)),
    )
    builder.add(
        _WOOD, box((0.4, -3.0, 0.1), (2.3, -2.55, 0.8)), box((0.5, -2.95, 0.0), (2.2, -2.6, 0.1))
    )
    builder.add(
        0.08,
        box((0.75, -2.85, 0.86), (1.95, -2.8, 1.55)),
        box((1.2, -2.9, 0.8), (1.5, -2.7, 0.86)),
    )
    builder.add(
        _CLOTH,
        box((-4.5, -1.9, 0.1), (-3.65, 0.2, 0.42)),
        box((-4.5, -1.9, 0.42), (-4.25, 0.2, 0.85)),
    )
    builder.add(
        _CLOTH,
        box((-4.25, -1.9, 0.42), (-3.65, -1.72, 0.62)),
        box((-4.25, 0.02, 0.42), (-3.65, 0.2, 0.62)),
    )
    builder.add(_PLASTER, cone((2.6, 0.1, 0.0), 0.22, 0.22, 2.8, 20))
    builder.add(
        0.5,
        box((3.75, -2.75, 0.0), (4.35, -2.15, 0.5), 0.2),
        box((3.85, -2.65, 0.5), (4.25, -2.3, 0.82), -0.4),
    )
    builder.add(0.5, box((3.1, -2.85, 0.0), (3.5, -2.5, 0.35), 0.5))
    builder.add(_METAL, box((4.38, -1.0, 0.12), (4.46, 1.2, 0.75)))
    builder.add(0.4, cone((4.05, 2.5, 0.0), 0.16, 0.2, 0.35))
    builder.add(0.5, ellipsoid((4.05, 2.5, 0.85), (0.34, 0.34, 0.5), 0.25))
    builder.add(
        0.3, box((-2.4, 2.96, 1.2), (-1.2, 3.0, 2.0)), box((-4.5, -0.9, 1.3), (-4.46, -0.2, 1.8))
    )
    builder.add(
        0.2, box((3.1, 2.96, 1.3), (3.6, 3.0, 1.9)), box((-0.9, -3.0, 1.4), (-0.1, -2.97, 1.9))
    )


def _shelves(builder: Builder) -> None:
    left, right, back, front = 0.5, 2.8, 3.0, 2.7
    uprights = [box((x - 0.02, front, 0.0), (x + 0.02, back, 2.1)) for x in (left, 1.65, right)]
    heights = (0.05, 0.45, 0.85, 1.25, 1.65, 2.08)
    boards = [box((left, front, z - 0.02), (right, back, z)) for z in heights]
    builder.add(_WOOD, *uprights, *boards)
    rng = np.random.default_rng(9)  # a fixed library
    for z in heights[:-1]:
        x = left + 0.05
        while x < right - 0.12:
            width, height, depth = rng.uniform((0.03, 0.18, 0.14), (0.07, 0.33, 0.26))
            if rng.random() < 0.8 and not 1.55 < x < 1.68:
                builder.add(
                    float(rng.uniform(0.15, 0.8)),
                    box((x, back - depth, z), (x + width, back, z + height)),
                )
            x += width + (0.15 if rng.random() < 0.1 else 0.002)


def _table(length: float, width: float) -> NDArray[np.float64]:
    x, y = length / 2, width / 2
    legs = [
        box(
            (sx * (x - 0.08) - 0.03, sy * (y - 0.08) - 0.03, 0.0),
            (sx * (x - 0.08) + 0.03, sy * (y - 0.08) + 0.03, 0.71),
        )
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    return np.concatenate([box((-x, -y, 0.71), (x, y, 0.75)), *legs])


def _chair() -> NDArray[np.float64]:
    """Return a chair that faces +y."""
    legs = [
        box((x - 0.02, y - 0.02, 0.0), (x + 0.02, y + 0.02, 0.43))
        for x in (-0.19, 0.19)
        for y in (-0.19, 0.19)
    ]
    return np.concatenate([box((-0.21, -0.21, 0.43), (0.21, 0.21, 0.47)), box((-0.21, -0.21, 0.6),
    (0.21, -0.17, 0.92)),
                           box((-0.21, -0.2, 0.47), (-0.17, -0.17, 0.6)), box((0.17, -0.2, 0.47),
                           (0.21, -0.17, 0.6)),
                           *legs])  # fmt: skip


_GRASS, _LEAVES, _BARK, _BRICK, _PAINT, _PANE = 0.35, 0.5, 0.25, 0.5, 0.6, 0.05

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
        builder.add(_PANE, box((x, y0 - 0.03, z), (x + 1.3, y0, z + 1.2)))
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
    builder.add(_PANE, box((11.96, -0.9, 1.6), (12.0, 1.1, 2.6)))
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
    builder.add(_PANE, placed(box((-1.4, -0.75, 0.85), (0.8, 0.75, 1.3)), place, yaw))
    builder.add(_PAINT, placed(box((-1.4, -0.75, 1.3), (0.8, 0.75, 1.42)), place, yaw))
    wheels = [
        box((wx - 0.3, wy - 0.1, -0.1), (wx + 0.3, wy + 0.1, 0.5))
        for wx in (-1.3, 1.3)
        for wy in (-0.78, 0.78)
    ]
    builder.add(0.06, *(placed(wheel, place, yaw) for wheel in wheels))


_SOIL = 0.3
_HALF_M = 34.0


def wood(seed: int = 0) -> Scene:
    """Return a wood on hilly ground: trunks, crowns, bushes, an oval path of 110 m."""
    rng = np.random.default_rng((seed, 6))
    phase = rng.uniform(0.0, 2.0 * np.pi, 4)

    def ground(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(
            0.5 * np.sin(x / 9.0 + phase[0]) * np.cos(y / 8.0 + phase[1])
            + 0.08 * np.sin(x / 1.9 + phase[2])
            + 0.03 * np.sin(1.7 * y + phase[3])
        )

    builder = Builder()
    builder.add(_SOIL, terrain(ground, (-_HALF_M, -_HALF_M), (_HALF_M, _HALF_M), 0.5))
    route = _path(rng)
    for x, y in _places(rng, route, 260, 1.0):
        z = float(ground(np.array(x), np.array(y)))
        tall, thick = rng.uniform((6.0, 0.1), (12.0, 0.28))
        builder.add(_BARK, cone((x, y, z - 0.3), thick, 0.6 * thick, tall, 10))
        for _ in range(4):
            dx, dy = rng.normal(0.0, 1.0, 2).tolist()
            up = float(rng.uniform(0.45, 1.0))
            size = rng.uniform(0.6, 1.3)
            place = (x + dx, y + dy, z + up * tall)
            builder.add(_LEAVES, ellipsoid(place, (size, size, 0.7 * size), 0.25, 10))
    for x, y in _places(rng, route, 90, 1.3):
        z = float(ground(np.array(x), np.array(y)))
        size = float(rng.uniform(0.3, 0.8))
        builder.add(_LEAVES, ellipsoid((x, y, z + 0.4 * size), (size, size, size), 0.3, 10))
    return builder.finish([(x, y) for x, y in route.tolist()], (1.0, 0.0), 4.0, ground)


def trunks(seed: int = 0) -> Scene:
    """Return bare trunks and nothing else: no ground in view, nothing fixes the height."""
    rng = np.random.default_rng((seed, 7))
    builder = Builder()
    route = _path(rng)
    for x, y in _places(rng, route, 240, 1.0):
        thick = float(rng.uniform(0.1, 0.3))
        builder.add(_BARK, cone((x, y, -8.0), thick, thick, 30.0, 12))
    return builder.finish([(x, y) for x, y in route.tolist()], (1.0, 0.0), 4.0)


def _path(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a closed oval way, shape (14, 2)."""
    angle = np.arange(14) * 2.0 * np.pi / 14
    size = 1.0 + 0.12 * rng.uniform(-1.0, 1.0, 14)
    return np.column_stack([20.0 * size * np.cos(angle), 15.0 * size * np.sin(angle)])


def _places(
    rng: np.random.Generator, route: NDArray[np.float64], count: int, free: float
) -> list[tuple[float, float]]:
    """Return places at least ``free`` meters from a closed way."""
    start, end = route, np.roll(route, -1, axis=0)
    way = np.concatenate([a + (b - a) * np.linspace(0.0, 1.0, 20)[:, None]
                          for a, b in zip(start, end, strict=True)])  # fmt: skip
    drawn = rng.uniform(-_HALF_M + 1.0, _HALF_M - 1.0, (count, 2))
    # the smooth way leaves the straight one by up to 0.4 m at its corners
    far = np.linalg.norm(drawn[:, None] - way, axis=2).min(axis=1) > free + 0.5
    return [(x, y) for x, y in drawn[far].tolist()]


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
