"""Scenes for mapping: loops of tens to hundreds of meters, and look-alike places.

Each comes with a way through it in three dimensions, since a ground z(x, y) cannot hold two
storeys.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.world.scene import (
    Builder,
    Opening,
    Point,
    Scene,
    box,
    cone,
    ellipsoid,
    placed,
    quad,
)

_BRICK, _PLASTER, _WOOD, _METAL, _LEAVES, _GLASS, _FLOOR = 0.5, 0.75, 0.45, 0.55, 0.5, 0.06, 0.4
_CORRIDOR_H = 2.6
_STOREY_M: Final = 3.2
_ROUTE_STEP_M: Final = 0.8  # between corners of a route: curves through fewer swing out
_ROUND_M: Final = 2.4  # of way over which a corner is rounded


@dataclass(frozen=True, slots=True, eq=False)
class MappingScene:
    """A scene and a path through it.

    Attributes
    ----------
    scene : Scene
    way : ndarray, shape (M, 3)
        Corners of one lap [m], closed: the sensor's height above ``z`` is added by the motion.
    """

    scene: Scene
    way: NDArray[np.float64]


def street_block() -> MappingScene:
    """Return a street of 400 m around a block of houses; no two houses are alike."""
    builder = Builder()
    rng = np.random.default_rng(17)
    builder.add(_FLOOR, box((-75.0, -75.0, -0.2), (75.0, 75.0, 0.0)))
    inner, outer = 42.0, 58.0
    for turn in range(4):
        _houses(builder, rng, turn, -inner, inner, inner, faces_out=True)
        _houses(builder, rng, turn, -outer - 6.0, outer + 6.0, outer, faces_out=False)
        _street_things(builder, rng, turn, inner, outer)
    ring = 50.0
    corner = 4.0
    way = []
    for sx, sy in ((1, -1), (1, 1), (-1, 1), (-1, -1)):
        x, y = sx * ring, sy * ring
        ways = [(x, y - sy * corner, 0.0), (x - sx * corner, y, 0.0)]
        way += ways[::-1] if sx * sy < 0 else ways
    return _finished(builder, way, 6.0)


def office_ring() -> MappingScene:
    """Return a corridor around a core, 26 x 18 m, identical doors every 3 m, symmetric."""
    builder = Builder()
    _ring_corridor(builder, 0.0)
    return _finished(builder, _ring_way(0.0), 2.2)


def furnished_office(moved: float = 0.0) -> MappingScene:
    """Return the same ring with furniture along it; of which a part was moved since.

    Parameters
    ----------
    moved : float
        Part of the pieces that stand elsewhere, 0 to 1.
    """
    builder = Builder()
    _ring_corridor(builder, 0.0)
    _furniture(builder, moved)
    return _finished(builder, _ring_way(0.0), 2.2)


def warehouse() -> MappingScene:
    """Return a hall with eight identical aisles between racks, walked through in turn."""
    builder = Builder()
    builder.add(_FLOOR, box((-6.0, -3.0, -0.1), (38.0, 37.0, 0.0)))
    builder.add(_METAL, box((-6.0, -3.0, 8.0), (38.0, 37.0, 8.1)))
    for low, high in (
        ((-6.1, -3.0), (-6.0, 37.0)),
        ((38.0, -3.0), (38.1, 37.0)),
        ((-6.0, -3.1), (38.0, -3.0)),
        ((-6.0, 37.0), (38.0, 37.1)),
    ):
        builder.add(_PLASTER, box((*low, 0.0), (*high, 8.0)))
    spacing = 4.0
    for rack in range(9):
        _rack(builder, 0.0, 32.0, rack * spacing - 0.5)
    way: list[tuple[float, float, float]] = []
    for aisle in range(8):
        y = (aisle + 0.5) * spacing
        ends = (-3.0, 35.0) if aisle % 2 == 0 else (35.0, -3.0)
        way += [(ends[0], y, 0.0), (ends[1], y, 0.0)]
    way += [(-4.5, 30.0, 0.0), (-4.5, 2.0, 0.0)]
    return _finished(builder, way, 6.0)


def storeys() -> MappingScene:
    """Return two identical storeys joined by a ramp: around below, up, around above, down."""
    builder = Builder()
    for storey in range(2):
        _ring_corridor(builder, storey * _STOREY_M, gap=True)
    _ramp(builder)
    foot, head = (15.0, 8.0, 0.0), (15.0, -8.0, _STOREY_M)
    lower = _ring_way(0.0)
    upper = _ring_way(_STOREY_M)
    way = [*lower, *lower[:2], (12.0, 8.0, 0.0), foot, head, (12.0, -8.0, _STOREY_M)]
    way += [upper[0], upper[1], upper[2], upper[3], upper[0], (12.0, -8.0, _STOREY_M)]
    way += [head, foot, (12.0, 8.0, 0.0), lower[1]]
    return _finished(builder, way, 2.2)


def car_park() -> MappingScene:
    """Return one storey of a car park: a grid of equal pillars, and cars that differ."""
    builder = Builder()
    builder.add(_FLOOR, box((-25.0, -18.0, -0.1), (25.0, 18.0, 0.0)))
    builder.add(_PLASTER, box((-25.0, -18.0, 2.4), (25.0, 18.0, 2.5)))
    for low, high in (
        ((-25.1, -18.0), (-25.0, 18.0)),
        ((25.0, -18.0), (25.1, 18.0)),
        ((-25.0, -18.1), (25.0, -18.0)),
        ((-25.0, 18.0), (25.0, 18.1)),
    ):
        builder.add(_PLASTER, box((*low, 0.0), (*high, 2.4)))
    for x in np.arange(-20.0, 21.0, 8.0):
        for y in (-11.0, 0.0, 11.0):
            builder.add(_PLASTER, box((x - 0.25, y - 0.25, 0.0), (x + 0.25, y + 0.25, 2.4)))
        builder.add(_PLASTER, box((x - 0.2, -18.0, 2.1), (x + 0.2, 18.0, 2.4)))
    rng = np.random.default_rng(23)
    for x in np.arange(-18.4, 19.0, 2.6):  # the ends stay free for the way
        for y in (-15.2, -2.8, 2.8, 15.2):
            if rng.random() < 0.6:
                _car(builder, rng, float(x), y, np.pi / 2)
    way = [(-22.5, -8.5, 0.0), (22.5, -8.5, 0.0), (22.5, 8.5, 0.0), (-22.5, 8.5, 0.0)]
    return _finished(builder, way, 2.0)


def garages() -> MappingScene:
    """Return two rows of identical garages that face each other, 60 m long, open at the ends."""
    builder = Builder()
    builder.add(_FLOOR, box((-15.0, -30.0, -0.1), (75.0, 30.0, 0.0)))
    for first in (-30.0, 0.0):
        y0, y1 = first + 10.0, first + 20.0
        for number in range(20):
            x = 3.0 * number
            openings = (Opening(0.3, 2.7, 0.05, 2.1, 0.15, _METAL),)
            builder.wall((x + 3.0, y0), (x, y0), 2.6, _BRICK, openings)
            builder.wall((x, y1), (x + 3.0, y1), 2.6, _BRICK, openings)
        builder.add(_BRICK, box((0.0, y0 + 0.2, 2.6), (60.0, y1 - 0.2, 2.8)))
        builder.add(_BRICK, box((-0.1, y0, 0.0), (0.0, y1, 2.6)))
        builder.add(_BRICK, box((60.0, y0, 0.0), (60.1, y1, 2.6)))
    way = [(-3.0, -5.0, 0.0), (63.0, -5.0, 0.0), (63.0, 5.0, 0.0), (-3.0, 5.0, 0.0)]
    return _finished(builder, way, 4.0)


def bare_corridor() -> MappingScene:
    """Return a corridor of 60 m without any detail, walked to and fro."""
    builder = Builder()
    builder.add(_FLOOR, box((-2.0, -1.2, -0.1), (62.0, 1.2, 0.0)))
    builder.add(_PLASTER, box((-2.0, -1.2, 2.6), (62.0, 1.2, 2.7)))
    for start, end in (
        ((-2.0, -1.2), (62.0, -1.2)),
        ((62.0, -1.2), (62.0, 1.2)),
        ((62.0, 1.2), (-2.0, 1.2)),
        ((-2.0, 1.2), (-2.0, -1.2)),
    ):
        builder.wall(start, end, 2.6, _PLASTER)
    way = [(0.0, -0.4, 0.0), (60.0, -0.4, 0.0), (60.0, 0.4, 0.0), (0.0, 0.4, 0.0)]
    return _finished(builder, way, 2.2)


MAPPING_SCENES: Final[dict[str, Callable[[], MappingScene]]] = {
    "street_block": street_block,
    "office_ring": office_ring,
    "furnished_office": furnished_office,
    "warehouse": warehouse,
    "storeys": storeys,
    "car_park": car_park,
    "garages": garages,
    "bare_corridor": bare_corridor,
}
"""Scenes by name; all are the same at every call."""


def _finished(
    builder: Builder, way: list[tuple[float, float, float]], headroom: float
) -> MappingScene:
    corners = np.array(way, np.float64)
    places, _ = along_way(corners, 1.0, _ROUTE_STEP_M)
    route: list[Point] = [(float(x), float(y)) for x, y in places[:, :2]]
    return MappingScene(builder.finish(route, route[0], headroom), corners)


def along_way(
    way: NDArray[np.float64], laps: float, step: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return places (N, 3) [m] along a closed way, corners rounded, and headings (N,) [rad].

    Parameters
    ----------
    way : ndarray, shape (M, 3)
        Corners of one lap.
    laps : float
        How often it is gone round; may end within one.
    step : float
        Distance between places [m].
    """
    corners = np.vstack([np.tile(way, (int(np.ceil(laps)) + 1, 1))])
    edges = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    distance = np.concatenate(([0.0], np.cumsum(edges)))
    lap = float(distance[len(way)])
    fine = np.arange(-_ROUND_M, lap * laps + _ROUND_M, 0.05)
    wrapped = np.mod(fine, lap)
    places = np.stack([np.interp(wrapped, distance, corners[:, i]) for i in range(3)], axis=1)
    width = round(_ROUND_M / 0.05) | 1
    kernel = np.hanning(width + 2)[1:-1]
    kernel /= kernel.sum()
    smooth = np.stack([np.convolve(places[:, i], kernel, "valid") for i in range(3)], axis=1)
    ahead = np.gradient(smooth, axis=0)
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    chosen = np.arange(0, round(lap * laps / step)) * round(step / 0.05) + width // 2
    chosen = chosen[chosen < len(smooth)]
    return smooth[chosen], heading[chosen]


def _turned(triangles: NDArray[np.float64], turn: int) -> NDArray[np.float64]:
    return placed(triangles, (0.0, 0.0, 0.0), turn * np.pi / 2.0)


def _houses(
    builder: Builder,
    rng: np.random.Generator,
    turn: int,
    start: float,
    end: float,
    front: float,
    *,
    faces_out: bool,
) -> None:
    """Add a row of houses along one side of the street, at y = -front before the turn."""
    x = start
    while x < end - 4.0:
        width = min(float(rng.uniform(8.0, 17.0)), end - x)
        setback = float(rng.uniform(0.0, 2.2))
        height, y = float(rng.uniform(4.0, 11.0)), -front
        sign = 1.0 if faces_out else -1.0
        y += sign * setback
        builder.add(
            _BRICK,
            _turned(
                box((x, min(y, y + sign * 5.0), 0.0), (x + width, max(y, y + sign * 5.0), height)),
                turn,
            ),
        )
        for level in np.arange(0.9, height - 1.5, 2.9):
            place = x + float(rng.uniform(0.6, 1.6))
            while place < x + width - 1.4:
                wide, deep = float(rng.uniform(0.8, 1.3)), float(rng.uniform(0.15, 0.35))
                frame = box(
                    (place, min(y, y - sign * deep), level),
                    (place + wide, max(y, y - sign * deep), level + 0.12),
                )
                builder.add(_PLASTER, _turned(frame, turn))
                place += wide + float(rng.uniform(0.8, 2.4))
        if rng.random() < 0.4:  # a bay or a balcony
            place, deep = x + float(rng.uniform(1.0, width - 3.0)), float(rng.uniform(0.6, 1.2))
            low = box(
                (place, min(y, y - sign * deep), 2.6),
                (place + 2.4, max(y, y - sign * deep), 3.7),
            )
            builder.add(_PLASTER, _turned(low, turn))
        x += width + (float(rng.uniform(1.5, 4.0)) if rng.random() < 0.35 else 0.0)


def _street_things(
    builder: Builder, rng: np.random.Generator, turn: int, inner: float, outer: float
) -> None:
    for edge in (inner + 2.6, outer - 2.6):
        x = -inner
        while x < inner:
            kind, y = rng.random(), -edge
            if kind < 0.35:
                part = Builder()
                _car(part, rng, x, y, 0.0)
                whole = part.finish([(0.0, 0.0)], (0.0, 0.0), 1.0)
                builder.add(0.5, _turned(whole.triangles, turn))
            elif kind < 0.55:
                builder.add(0.3, _turned(cone((x, y, 0.0), 0.16, 0.12, 3.0, 8), turn))
                crown = ellipsoid((x, y, 4.2), (1.6, 1.5, 1.7), 0.25)
                builder.add(_LEAVES, _turned(crown, turn))
            elif kind < 0.65:
                builder.add(_METAL, _turned(cone((x, y, 0.0), 0.07, 0.05, 5.0, 8), turn))
            x += float(rng.uniform(4.0, 9.0))


def _car(builder: Builder, rng: np.random.Generator, x: float, y: float, yaw: float) -> None:
    long, high = float(rng.uniform(3.8, 4.7)), float(rng.uniform(1.4, 1.9))
    body = np.concatenate(
        [
            box((-long / 2, -0.88, 0.25), (long / 2, 0.88, 0.85)),
            box((-long / 4, -0.78, 0.85), (long / 3, 0.78, high)),
        ]
    )
    turned = placed(body, (x, y, 0.0), yaw + float(rng.normal(0.0, 0.04)))
    builder.add(float(rng.uniform(0.2, 0.8)), turned)


_RING: Final = (12.0, 8.0)  # half length and half width of the corridor's middle line [m]
_HALF: Final = 1.1  # half the corridor's width [m]


def _ring_way(z: float) -> list[tuple[float, float, float]]:
    a, b = _RING
    return [(a, -b, z), (a, b, z), (-a, b, z), (-a, -b, z)]


def _ring_corridor(builder: Builder, z: float, gap: bool = False) -> None:
    """Add a ring of corridors; with a gap the eastern wall is open where the ramp begins."""
    part = Builder()
    a, b = _RING
    far, near = _HALF, -_HALF
    x1, y1, x0, y0 = a + far, b + far, a + near, b + near
    for bottom, top, shade in ((-0.1, 0.0, _FLOOR), (_CORRIDOR_H, _CORRIDOR_H + 0.1, 0.8)):
        for low, high in (
            ((-x1, y0), (x1, y1)),
            ((-x1, -y1), (x1, -y0)),
            ((x0, -y0), (x1, y0)),
            ((-x1, -y0), (-x0, y0)),
        ):
            part.add(shade, box((*low, bottom), (*high, top)))
    corners = [(x1, -y1), (x1, y1), (-x1, y1), (-x1, -y1)]
    for number in range(4):
        start, end = corners[number], corners[(number + 1) % 4]
        if gap and number == 0:
            for y in (-8.9, 7.1):
                part.wall((x1, y + 1.8), (x1, y + 1.9), _CORRIDOR_H, _PLASTER)
            part.wall((x1, -7.0), (x1, 7.0), _CORRIDOR_H, _PLASTER, _doors(14.0))
            continue
        length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
        part.wall(start, end, _CORRIDOR_H, _PLASTER, _doors(length))
    inner = [(x0, -y0), (-x0, -y0), (-x0, y0), (x0, y0)]
    for number in range(4):
        start, end = inner[number], inner[(number + 1) % 4]
        length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
        part.wall(start, end, _CORRIDOR_H, _PLASTER, _doors(length))
    whole = part.finish([(0.0, 0.0)], (0.0, 0.0), 1.0)
    shift = np.array([0.0, 0.0, z])
    for shade in np.unique(whole.reflectivity):
        builder.add(float(shade), whole.triangles[whole.reflectivity == shade] + shift)


def _doors(length: float) -> tuple[Opening, ...]:
    """Return doors every 3 m, symmetric about the middle."""
    count = int((length - 1.5) / 3.0)
    first = length / 2.0 - 1.5 * (count - 1) - 0.45
    return tuple(
        Opening(first + 3.0 * k, first + 3.0 * k + 0.9, 0.0, 2.05, 0.12, _WOOD)
        for k in range(count)
    )


def _furniture(builder: Builder, moved: float) -> None:
    """Add cupboards, benches, bins, plants along the walls of the ring."""
    rng, other = np.random.default_rng(5), np.random.default_rng(6)
    a, b = _RING
    sides = (
        (np.array([-a, -b]), np.array([1.0, 0.0]), 2 * a),
        (np.array([a, -b]), np.array([0.0, 1.0]), 2 * b),
        (np.array([a, b]), np.array([-1.0, 0.0]), 2 * a),
        (np.array([-a, b]), np.array([0.0, -1.0]), 2 * b),
    )
    for origin, along, length in sides:
        place = 1.5
        while place < length - 1.0:
            wide, deep, high = rng.uniform((0.4, 0.25, 0.4), (1.6, 0.45, 2.0))
            side = 1.0 if rng.random() < 0.5 else -1.0
            shift = float(other.uniform(-1.0, 1.0)) if other.random() < moved else 0.0
            across = np.array([-along[1], along[0]]) * side * (_HALF - deep / 2.0 - 0.02)
            x, y = origin + (place + shift) * along + across
            yaw = float(np.arctan2(along[1], along[0]))
            piece = box((-wide / 2, -deep / 2, 0.0), (wide / 2, deep / 2, high))
            builder.add(_WOOD, placed(piece, (float(x), float(y), 0.0), yaw))
            place += float(rng.uniform(1.6, 4.2))


def _rack(builder: Builder, x0: float, x1: float, y: float) -> None:
    """Add a rack with four boards, uprights every 2 m and equal boxes."""
    for z in (0.2, 1.8, 3.4, 5.0):
        builder.add(_METAL, box((x0, y, z), (x1, y + 1.0, z + 0.08)))
    for x in np.arange(x0, x1 + 0.1, 2.0):
        for side in (0.0, 0.92):
            builder.add(_METAL, box((x - 0.05, y + side, 0.0), (x + 0.05, y + side + 0.08, 6.0)))
    for x in np.arange(x0 + 0.3, x1 - 1.0, 2.0):
        for z in (0.28, 1.88, 3.48):
            builder.add(_WOOD, box((x, y + 0.1, z), (x + 1.3, y + 0.9, z + 1.0)))


def _ramp(builder: Builder) -> None:
    """Add a ramp along the east side from the lower storey to the upper one."""
    x0, x1 = 14.0, 16.0
    low, high = (8.9, 0.0), (-8.9, _STOREY_M)
    for lift, shade in ((0.0, _FLOOR), (2.6, 0.8)):
        builder.add(
            shade,
            quad(
                np.array([x0, low[0], low[1] + lift]),
                np.array([x1, low[0], low[1] + lift]),
                np.array([x1, high[0], high[1] + lift]),
                np.array([x0, high[0], high[1] + lift]),
            ),
        )
    for x in (x0, x1):
        builder.add(
            _PLASTER,
            quad(
                np.array([x, 7.0, 0.0]),
                np.array([x, -7.0, 0.0]),
                np.array([x, -7.0, _STOREY_M + 2.6]),
                np.array([x, 7.0, 2.6]),
            ),
        )
    builder.add(_PLASTER, box((x1, -9.0, 0.0), (x1 + 0.1, 9.0, _STOREY_M + 2.6)))
