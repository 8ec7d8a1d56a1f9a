"""Builds woods from a seed: one with ground, foliage and bushes, one of bare trunks alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.world.scene import Builder, Scene, cone, ellipsoid, terrain

_SOIL, _LEAVES, _BARK = 0.3, 0.5, 0.25
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
    """Return places at least ``free`` metres from a closed way."""
    start, end = route, np.roll(route, -1, axis=0)
    way = np.concatenate([a + (b - a) * np.linspace(0.0, 1.0, 20)[:, None]
                          for a, b in zip(start, end, strict=True)])  # fmt: skip
    drawn = rng.uniform(-_HALF_M + 1.0, _HALF_M - 1.0, (count, 2))
    # the smooth way leaves the straight one by up to 0.4 m at its corners
    far = np.linalg.norm(drawn[:, None] - way, axis=2).min(axis=1) > free + 0.5
    return [(x, y) for x, y in drawn[far].tolist()]
