"""Builds the indoor scenes: an empty box, a furnished room, a long corridor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.world.scene import Builder, Opening, Scene, box, cone, ellipsoid, placed

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
