"""Buildings that are hard for odometry: flat, bare corridor, hall, stairwell, atrium.

Each is drawn anew from a seed; the same seed gives the same building.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.world.scene import (
    Builder,
    Opening,
    Scene,
    Triangles,
    box,
    cone,
    ellipsoid,
    placed,
    quad,
)

_PLASTER, _WOOD, _DARK, _CLOTH, _METAL, _STONE = 0.75, 0.45, 0.25, 0.3, 0.55, 0.4
_THICK: Final = 0.12  # of inner walls [m]
_DOOR: Final = (0.9, 2.05)  # clear width and height [m]

Gap = tuple[float, float, float, float]
"""A hole in a wall: from and to along it, bottom and top [m]."""


def pierced(
    builder: Builder,
    start: tuple[float, float],
    length: float,
    along: str,
    height: float,
    reflectivity: float,
    gaps: tuple[Gap, ...] = (),
) -> None:
    """Add a wall of some thickness along x or y, centered on its line, with holes through it.

    Parameters
    ----------
    builder : Builder
    start : tuple of float
        x, y of the lower end [m].
    length : float
        [m]
    along : str
        ``x`` or ``y``.
    height, reflectivity : float
    gaps : tuple of Gap
        In ascending order, without overlap.
    """
    half = _THICK / 2.0

    def block(u0: float, u1: float, z0: float, z1: float) -> Triangles:
        x, y = start
        if along == "x":
            return box((x + u0, y - half, z0), (x + u1, y + half, z1))
        return box((x - half, y + u0, z0), (x + half, y + u1, z1))

    at = 0.0
    for u0, u1, z0, z1 in gaps:
        if u0 > at:
            builder.add(reflectivity, block(at, u0, 0.0, height))
        if z0 > 0.0:
            builder.add(reflectivity, block(u0, u1, 0.0, z0))
        if z1 < height:
            builder.add(reflectivity, block(u0, u1, z1, height))
        at = u1
    if at < length:
        builder.add(reflectivity, block(at, length, 0.0, height))


def flat(seed: int = 0) -> Scene:
    """Return six furnished rooms on both sides of a hallway; the tour looks into each of them.

    It stops in every door, turns into the room, walks up to a bare wall until that fills a
    narrow view, and turns back. A window of glass and a mirror hang in two of the rooms.
    """
    rng = np.random.default_rng((seed, 1))
    builder = Builder()
    height, hall = 2.6, 1.5
    widths = rng.uniform(3.3, 4.8, 3)
    edges = np.concatenate(([0.0], np.cumsum(widths)))
    depths = rng.uniform(3.2, 4.2, 2)  # of the rooms below and above the hallway
    low, top, end = -depths[0], hall + depths[1], float(edges[-1])
    builder.add(0.4, box((0.0, low, -0.1), (end, top, 0.0)))
    builder.add(0.85, box((0.0, low, height), (end, top, height + 0.1)))
    window = (0.8, 2.2, 0.9, 2.1)
    pierced(builder, (0.0, low), end, "x", height, _PLASTER)
    pierced(builder, (0.0, top), end, "x", height, _PLASTER)
    pierced(builder, (0.0, low), top - low, "y", height, 0.65)
    pierced(builder, (end, low), top - low, "y", height, 0.65, (window,))
    glass = quad(*_upright((end, low + window[0]), (end, low + window[1]), *window[2:]))
    for edge in edges[1:-1]:
        pierced(builder, (float(edge), low), -low, "y", height, _PLASTER)
        pierced(builder, (float(edge), hall), top - hall, "y", height, _PLASTER)
    doors = np.array([[_door_at(rng, edges[k], edges[k + 1]) for k in range(3)] for _ in range(2)])
    for row, y in enumerate((0.0, hall)):
        gaps = tuple((float(x), float(x) + _DOOR[0], 0.0, _DOOR[1]) for x in doors[row])
        pierced(builder, (0.0, y), end, "x", height, _PLASTER, gaps)
    for row in range(2):
        for k in range(3):
            span = (low, 0.0) if row == 0 else (hall, top)
            _furnish(builder, rng, (edges[k], edges[k + 1]), span, doors[row, k] + 0.45, row)
    mirror = _upright((1.0, top - 0.08), (1.8, top - 0.08), 0.6, 1.9)
    middle = hall / 2.0
    stops = [[doors[0, 0] + 0.45, middle]]
    for k in range(3):
        for row in (0, 1) if rng.random() < 0.5 else (1, 0):
            x = doors[row, k] + 0.45
            inside, wall = ((-1.3, low + 0.75), (hall + 1.3, top - 0.75))[row]
            stops += [[x, middle], [x, inside], [x, wall], [x, inside], [x, middle]]
    lanes = np.arange(1.0, end - 0.9, 1.0)
    route = [(x, middle - 0.25) for x in lanes] + [(x, middle + 0.25) for x in lanes[::-1]]
    scene = builder.finish(route, (end / 2.0, middle), 2.2)
    tour = np.column_stack([np.array(stops), np.zeros(len(stops))])
    return replace(scene, tour=tour, glass=glass, mirrors=quad(*mirror))


def office_corridor(seed: int = 0, length: float = 96.0) -> Scene:
    """Return a corridor along x, 2.4 m wide, 2.7 high: one side bare, doors and niches opposite.

    The doors are set back by 2 to 12 cm, the niches by 0.3 to 0.8 m, 3 to 9 m apart; there is
    nothing else but its two ends.
    """
    rng = np.random.default_rng((seed, 2))
    builder = Builder()
    half, height = 1.2, 2.7
    builder.add(0.35, box((0.0, -half, -0.1), (length, half, 0.0)))
    builder.add(0.8, box((0.0, -half, height), (length, half, height + 0.1)))
    holes: list[Opening] = []
    at = float(rng.uniform(2.0, 5.0))
    while at < length - 3.0:
        if rng.random() < 0.7:
            hole = Opening(at, at + 0.95, 0.0, 2.05, float(rng.uniform(0.02, 0.12)), _WOOD)
        else:
            wide = float(rng.uniform(0.8, 1.6))
            hole = Opening(at, at + wide, 0.0, 2.2, float(rng.uniform(0.3, 0.8)), _PLASTER)
        holes.append(hole)
        at = hole.end + float(rng.uniform(3.0, 9.0))
    builder.wall((0.0, -half), (length, -half), height, _PLASTER, tuple(holes))
    builder.wall((length, -half), (length, half), height, _PLASTER)
    builder.wall((length, half), (0.0, half), height, _PLASTER)
    builder.wall((0.0, half), (0.0, -half), height, _PLASTER)
    straight = np.arange(1.5, length - 1.4, 3.0)
    route = [(x, -0.4) for x in straight] + [(x, 0.4) for x in straight[::-1]]
    scene = builder.finish(route, (8.0, 0.1), 2.3)
    return replace(scene, tour=np.array([[1.8, 0.0, 0.0], [length - 1.8, 0.0, 0.0]]))


def hall(seed: int = 0) -> Scene:
    """Return a factory hall, 64 x 40 x 9 m, with columns, beams, machines and pallets."""
    rng = np.random.default_rng((seed, 3))
    builder = Builder()
    x1, y1, height = 32.0, 20.0, 9.0
    builder.add(0.35, box((-x1, -y1, -0.1), (x1, y1, 0.0)))
    builder.add(0.6, box((-x1, -y1, height), (x1, y1, height + 0.1)))
    gates = (Opening(9.0, 13.5, 0.0, 4.5, 0.25, _METAL),)
    for start, stop in (
        ((-x1, -y1), (x1, -y1)),
        ((x1, -y1), (x1, y1)),
        ((x1, y1), (-x1, y1)),
        ((-x1, y1), (-x1, -y1)),
    ):
        builder.wall(start, stop, height, 0.5, gates)
    for x in np.arange(-24.0, 25.0, 8.0):
        builder.add(_METAL, box((x - 0.15, -y1, 8.2), (x + 0.15, y1, 8.6)))
        for y in (-9.0, 9.0):
            builder.add(_METAL, box((x - 0.15, y - 0.15, 0.0), (x + 0.15, y + 0.15, 8.2)))
    route = _loop(13, (17.0, 6.5), rng, 0.1)
    for _ in range(46):
        x, y = rng.uniform((-30.0, -18.0), (30.0, 18.0))
        size = rng.uniform((0.6, 0.6, 0.5), (3.0, 1.6, 2.6))
        if _distance_to(route, (x, y)) < 1.2 + np.hypot(size[0], size[1]) / 2.0:
            continue
        body = box((-size[0] / 2, -size[1] / 2, 0.0), (size[0] / 2, size[1] / 2, size[2]))
        builder.add(
            float(rng.uniform(0.2, 0.7)), placed(body, (x, y, 0.0), rng.uniform(0.0, np.pi))
        )
    return builder.finish([(x, y) for x, y in route.tolist()], (1.0, 0.5), 6.0)


def stairwell(seed: int = 0) -> Scene:
    """Return a stairwell of four storeys with a lobby; the tour climbs it."""
    rng = np.random.default_rng((seed, 4))
    builder = Builder()
    steps, rise, tread, wide = 9, float(rng.uniform(0.165, 0.18)), 0.28, 1.25
    run, storeys = steps * tread, 4
    x0, x1 = -1.5, run + 1.5  # landings at both ends
    top = storeys * 2 * steps * rise + 2.6
    builder.add(_STONE, box((x0 - 4.0, -2.8, -0.1), (x1, 1.4, 0.0)))
    for y0, y1 in ((-1.40, -1.35), (1.35, 1.40)):
        begin = x0 - 4.0 if y0 > 0 else x0
        builder.add(_PLASTER, box((begin, y0, 0.0), (x1, y1, top)))
    builder.add(_PLASTER, box((x1, -1.4, 0.0), (x1 + 0.1, 1.4, top)))
    builder.add(_PLASTER, box((x0 - 0.1, -1.4, 2.4), (x0, 1.4, top)))
    builder.add(_PLASTER, box((x0, -1.4, top), (x1, 1.4, top + 0.1)))
    builder.add(0.7, box((x0 - 4.1, -2.8, 0.0), (x0 - 4.0, 1.4, 2.4)))
    builder.add(0.7, box((x0 - 4.0, -2.9, 0.0), (x0, -2.8, 2.4)))
    builder.add(0.7, box((x0, -2.8, 0.0), (x0 + 0.1, -1.4, 2.4)))
    builder.add(0.8, box((x0 - 4.0, -2.8, 2.4), (x0, 1.4, 2.5)))
    builder.add(_WOOD, box((x0 - 3.9, -2.7, 0.0), (x0 - 2.9, -2.3, 1.1)))
    tour = [[x0 - 2.5, -0.7, 0.0], [x0 + 0.6, -0.7, 0.0]]
    for storey in range(storeys):
        base = storey * 2 * steps * rise
        half = base + steps * rise
        for k in range(steps):
            for y, z, x in (
                (-1.35, base, k * tread),
                (0.1, half, run - (k + 1) * tread),
            ):
                low = max(z + (k + 1) * rise - 0.3, z)
                builder.add(_STONE, box((x, y, low), (x + tread, y + wide, z + (k + 1) * rise)))
        builder.add(_STONE, box((run, -1.35, half - 0.2), (x1, 1.35, half)))
        builder.add(_STONE, box((x0, -1.35, base + 2 * steps * rise - 0.2), (0.0, 1.35,
            base + 2 * steps * rise)))  # fmt: skip
        for k in range(steps + 1):
            z = base + k * rise
            builder.add(_METAL, cone((min(k * tread + 0.1, run), -0.07, z), 0.012, 0.012, 0.95, 6))
        tour += [
            [-0.3, -0.7, base],
            [run + 0.3, -0.7, half],
            [run + 0.8, 0.7, half],
            [run + 0.3, 0.7, half],
            [-0.3, 0.7, base + 2 * steps * rise],
            [x0 + 0.7, -0.7, base + 2 * steps * rise],
        ]
    lobby = [(x0 - 3.0, -1.6), (x0 - 1.2, -1.6), (x0 - 1.0, 0.2), (x0 - 2.8, 0.5)]
    return replace(builder.finish(lobby, (x0 - 2.0, -0.7), 2.2), tour=np.array(tour))


LIFT_AT: Final = (0.0, 0.0)  # middle of the atrium's platform, x y [m]
LIFT_RISE_M: Final = 7.2


def atrium(seed: int = 0) -> Scene:
    """Return an atrium with galleries at 3.6 and 7.2 m; the tour takes its open lift up.

    The platform itself is :func:`platform`; it must move with its passenger.
    """
    rng = np.random.default_rng((seed, 5))
    builder = Builder()
    builder.add(0.4, box((-9.0, -7.0, -0.1), (9.0, 7.0, 0.0)))
    builder.add(0.7, box((-9.0, -7.0, 11.0), (9.0, 7.0, 11.1)))
    for start, stop in (
        ((-9.0, -7.0), (9.0, -7.0)),
        ((9.0, -7.0), (9.0, 7.0)),
        ((9.0, 7.0), (-9.0, 7.0)),
        ((-9.0, 7.0), (-9.0, -7.0)),
    ):
        openings = tuple(
            Opening(at, at + 1.0, 0.0, 2.1, 0.15, _WOOD)
            for at in (1.5 + float(rng.uniform(0.0, 2.0)), 7.0 + float(rng.uniform(0.0, 3.0)))
        )
        builder.wall(start, stop, 11.0, _PLASTER, openings)
    for z in (3.6, LIFT_RISE_M):
        builder.add(_STONE, box((0.95, -7.0, z - 0.3), (9.0, 7.0, z)))
        builder.add(_STONE, box((-9.0, 4.6, z - 0.3), (0.95, 7.0, z)))
        for y in np.arange(-6.8, 6.9, 0.8):
            if abs(y) > 1.0:
                builder.add(_METAL, box((0.97, y - 0.02, z), (1.01, y + 0.02, z + 1.0)))
        for _ in range(6):
            x, y = rng.uniform((5.0, -6.0), (8.5, 6.0))
            builder.add(0.5, box((x - 0.3, y - 0.25, z), (x + 0.3, y + 0.25, z + 1.2)))
    for x, y in ((-8.0, -4.0), (-5.0, 3.0), (-7.5, 5.0)):
        builder.add(_STONE, cone((x, y, 0.0), 0.3, 0.3, 11.0, 20))
        builder.add(_CLOTH, ellipsoid((x + 1.2, y, 0.8), (0.5, 0.5, 0.8), 0.2))
    tour = [
        [-5.0, -2.0, 0.0],
        [0.0, 0.0, 0.0],
        [0.0, 0.0, LIFT_RISE_M],
        [2.5, 0.0, LIFT_RISE_M],
        [3.5, 4.0, LIFT_RISE_M],
        [3.5, -5.0, LIFT_RISE_M],
        [3.5, 0.0, LIFT_RISE_M],
    ]
    angle = np.arange(8) * np.pi / 4.0
    route = [(-4.5 + 2.0 * np.cos(a), -2.0 + 2.0 * np.sin(a)) for a in angle.tolist()]
    return replace(builder.finish(route, (-4.0, -1.0), 3.0), tour=np.array(tour))


def platform() -> Triangles:
    """Return the lift of :func:`atrium`: a floor plate with rails, its top at z = 0."""
    parts = [box((-0.9, -0.9, -0.15), (0.9, 0.9, 0.0))]
    for y in (-0.88, 0.88):
        parts.append(box((-0.9, y - 0.02, 0.95), (0.9, y + 0.02, 1.0)))
        parts += [
            box((x - 0.02, y - 0.02, 0.0), (x + 0.02, y + 0.02, 1.0)) for x in (-0.85, 0.0, 0.85)
        ]
    return np.concatenate(parts)


def _upright(
    start: tuple[float, float], end: tuple[float, float], bottom: float, top: float
) -> tuple[NDArray[np.float64], ...]:
    """Return the four corners of an upright rectangle."""
    corners = [(*start, bottom), (*end, bottom), (*end, top), (*start, top)]
    return tuple(np.array(corner, np.float64) for corner in corners)


def _door_at(rng: np.random.Generator, left: float, right: float) -> float:
    """Return where a door begins between two cross walls."""
    return float(rng.uniform(left + 0.6, right - 0.6 - _DOOR[0]))


def _furnish(
    builder: Builder,
    rng: np.random.Generator,
    x: tuple[float, float],
    y: tuple[float, float],
    lane: float,
    row: int,
) -> None:
    """Put furniture along the side walls of a room, none into the lane behind its door."""
    for _ in range(5):
        size = rng.uniform((0.35, 0.35, 0.4), (0.9, 0.6, 1.9))
        left = rng.random() < 0.5
        depth = float(rng.uniform(y[0] + 0.2, y[1] - 1.2))
        begin = x[0] + 0.1 if left else x[1] - 0.1 - size[0]
        if begin < lane + 0.75 and begin + size[0] > lane - 0.75:
            continue
        builder.add(
            float(rng.uniform(0.15, 0.7)),
            box((begin, depth, 0.0), (begin + size[0], depth + size[1], size[2])),
        )
    if rng.random() < 0.6:
        at = y[0] + 0.6 if row == 0 else y[1] - 0.6
        side = x[0] + 0.5 if lane > (x[0] + x[1]) / 2.0 else x[1] - 0.5
        builder.add(_CLOTH, ellipsoid((side, at, 0.5), (0.3, 0.3, 0.5), 0.2))


def _loop(
    corners: int, half: tuple[float, float], rng: np.random.Generator, wander: float
) -> NDArray[np.float64]:
    """Return a closed oval way (N, 2) that wanders by a share of its size."""
    angle = np.arange(corners) * 2.0 * np.pi / corners
    size = 1.0 + wander * rng.uniform(-1.0, 1.0, corners)
    return np.column_stack([half[0] * size * np.cos(angle), half[1] * size * np.sin(angle)])


def _distance_to(route: NDArray[np.float64], place: tuple[float, float]) -> float:
    """Return how far a place is from a closed way of straight pieces [m]."""
    start, end = route, np.roll(route, -1, axis=0)
    along = end - start
    share = np.einsum("ni,ni->n", np.asarray(place) - start, along)
    share = np.clip(share / np.einsum("ni,ni->n", along, along), 0.0, 1.0)
    return float(np.linalg.norm(start + share[:, None] * along - place, axis=1).min())
