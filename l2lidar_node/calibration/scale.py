"""Range scale by tape measure: two still places on a line towards a wall."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from l2lidar_node.calibration import planes as flat
from l2lidar_node.calibration.model import NAMES, beams
from l2lidar_node.calibration.observation import Place
from l2lidar_node.calibration.planes import I8
from l2lidar_node.calibration.still import CalibrationError
from l2lidar_node.types import F64

_SAME_RAD: Final = np.deg2rad(4.0)  # by which the sensor may turn between the places
_WORST_SCALE: Final = 0.03
_STEEP: Final = 0.95  # cosine of the incidence: a range bias moves steep points alike
_NEAR_M: Final = 0.08  # between a predicted and a found surface
_NOISE_M: Final = 1.5e-3  # what a surface's place is uncertain by, whatever its points say
_FEWEST: Final = 60  # points of a surface seen from steep
_EXTENT_M: Final = 0.4  # least standard deviation of a surface's points along it
_SHORTEST_M: Final = 1.0
_ITERATIONS: Final = 3


@dataclass(frozen=True, slots=True)
class ScaleResult:
    """Range scale from a tape.

    Attributes
    ----------
    scale, sd : float
        True over reported range, minus one.
    measured : float
        Distance between the places by the reported ranges [m].
    surfaces : int
        Pairs of surfaces that were found again.
    """

    scale: float
    sd: float
    measured: float
    surfaces: int


class _Surfaces(NamedTuple):
    """Large surfaces of a place, arrays over surfaces.

    Attributes
    ----------
    normal : ndarray, shape (S, 3)
        Looks at the sensor.
    center : ndarray, shape (S, 3)
        Mean of the points that are seen from steep [m].
    distance : ndarray, shape (S,)
        From the sensor [m].
    size : ndarray, shape (S,)
        Points that are seen from steep.
    """

    normal: F64
    center: F64
    distance: F64
    size: I8


def by_tape(first: Place, second: Place, length: float, length_sd: float = 0.002) -> ScaleResult:
    """Return the range scale from two places a known way apart.

    A range bias cancels: it moves a wall alike at both places.

    Parameters
    ----------
    first, second : Place
        The sensor looks the same way at both.
    length : float
        Between them, by tape [m].
    length_sd : float
        What the tape is uncertain by [m].

    Raises
    ------
    CalibrationError
        If surfaces are not found again, or what they say is not a scale.
    """
    if length < _SHORTEST_M:
        raise CalibrationError(
            f"{length:g} m between the places is too short; slide the sensor by 3 m: 2 mm are "
            "0.07 % of that"
        )
    if first.block != second.block:
        raise CalibrationError("the places are of different units; use one unit for both")
    one, other = _surfaces(first), _surfaces(second)
    shift = _towards_wall(one, other, length)
    sd = np.inf
    pairs: list[tuple[int, int]] = []
    for _ in range(_ITERATIONS):
        pairs = _pairs(one, other, shift)
        if not pairs:
            break
        normals, nearer = _came_nearer(one, other, np.array(pairs))
        along = shift / np.linalg.norm(shift)
        # What no surface fixes stays as it is: across the way it hardly changes the length.
        weak = 1e-3 * np.eye(3)
        information = normals.T @ normals + weak
        shift = np.asarray(
            np.linalg.solve(information, -normals.T @ nearer + weak @ shift), np.float64
        )
        cover = np.linalg.inv(information)
        sd = float(_NOISE_M * np.sqrt(2.0 * along @ cover @ along))
    if not pairs:
        raise CalibrationError(
            "no surface of the first place is found again at the second; slide the sensor "
            "straight towards a flat wall, without turning it"
        )
    measured = float(np.linalg.norm(shift))
    scale = length / measured - 1.0
    if abs(scale) > _WORST_SCALE:
        raise CalibrationError(
            f"the sensor moved by {measured:.3f} m by its own ranges and {length:.3f} m by the "
            f"tape: {100 * scale:+.1f} % is not a range scale; read the tape again"
        )
    return ScaleResult(scale, float(np.hypot(sd, length_sd) / length), measured, len(pairs))


def _came_nearer(one: _Surfaces, other: _Surfaces, pairs: I8) -> tuple[F64, F64]:
    """Return normals of pairs of surfaces and by how much the second place is nearer to them [m].

    Both places share the normal, since the parts of a surface that they see best lie apart.
    """
    first, second = pairs.T
    weights = np.stack((one.size[first], other.size[second]), axis=-1)[..., None]
    normals = one.normal[first] * weights[:, 0] + other.normal[second] * weights[:, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    away = other.center[second] - one.center[first]
    return normals, np.einsum("ni,ni->n", away, normals)


def _surfaces(place: Place) -> _Surfaces:
    group = np.zeros(len(place.returns), np.int64)
    rays = beams(place.returns, place.block, np.zeros(len(NAMES)))
    points = rays.points
    far = place.returns["alpha"] > np.pi / 2
    found = flat.large(points, far, group, _EXTENT_M)
    if not len(found.first):
        raise CalibrationError(
            f"{place.name}: no large flat surfaces; use a room with a flat wall ahead"
        )
    plane = found.plane
    direction = rays.direction[found.member]
    steep = np.abs(np.einsum("ni,ni->n", direction, found.normal[plane])) > _STEEP
    normals, centers, sizes = [], [], []
    for number in range(len(found.first)):
        mine = found.member[(plane == number) & steep]
        if len(mine) < _FEWEST:
            continue
        center = points[mine].mean(axis=0)
        normal = found.normal[number]
        if normal @ center > 0:
            normal = -normal
        normals.append(normal)
        centers.append(center)
        sizes.append(len(mine))
    if not normals:
        raise CalibrationError(
            f"{place.name}: no large flat surface is seen from steep; stand before a wall"
        )
    normal, center = np.array(normals), np.array(centers)
    distance = -np.einsum("ni,ni->n", normal, center)
    return _Surfaces(normal, center, distance, np.array(sizes))


def _towards_wall(one: _Surfaces, other: _Surfaces, length: float) -> F64:
    """Return the first guess of the way: along the normal of the wall it leads to."""
    best, found = np.inf, None
    for i in range(len(one.normal)):
        same = one.normal[i] @ other.normal.T > np.cos(_SAME_RAD)
        for j in np.flatnonzero(same):
            way = abs(one.distance[i] - other.distance[j])
            off = abs(way / length - 1.0)
            # Of walls that agree the one with most points counts.
            if off < 2 * _WORST_SCALE and off - 1e-6 * one.size[i] < best:
                best = off - 1e-6 * one.size[i]
                found = -one.normal[i] * (one.distance[i] - other.distance[j])
    if found is None:
        raise CalibrationError(
            f"no wall came nearer by {length:g} m; slide the sensor straight towards a flat wall, "
            "without turning it"
        )
    return np.asarray(found)


def _pairs(one: _Surfaces, other: _Surfaces, shift: F64) -> list[tuple[int, int]]:
    """Return surfaces of both places that are the same one after a shift of the sensor."""
    found = []
    for i in range(len(one.normal)):
        predicted = one.distance[i] + one.normal[i] @ shift
        same = one.normal[i] @ other.normal.T > np.cos(_SAME_RAD)
        off = np.where(same, np.abs(other.distance - predicted), np.inf)
        j = int(np.argmin(off))
        if off[j] < _NEAR_M:
            found.append((i, j))
    return found
