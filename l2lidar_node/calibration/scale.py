"""Range scale by tape measure, from two positions on a line towards a wall."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from l2lidar_node.calibration import planes as flat, solver
from l2lidar_node.calibration.model import NAMES, Beams, beams
from l2lidar_node.calibration.observation import Place
from l2lidar_node.calibration.planes import Planes
from l2lidar_node.calibration.still import CalibrationError
from l2lidar_node.types import F64

_WORST_SCALE: Final = 0.03
_SHORTEST_M: Final = 1.0
_EXTENT_M: Final = 0.4  # least standard deviation of a wall's points along it
_SAME_WAY: Final = np.cos(np.deg2rad(20.0))
_REACHES_M: Final = (0.6, 0.4, 0.25, 0.15, 0.1, 0.1, 0.1)  # from a point to the other place's wall
_MOST_COARSE: Final = 8000  # returns of the second place, to begin with
_TURNED_RAD: Final = np.deg2rad(10.0)
_ASSOCIATIONS: Final = 6
_SETTLED_M: Final = 1e-4
_MOST_OF_CELL: Final = 1000  # points: all of them
_FEWEST: Final = 20  # patches that both places see
_BIAS_SD_M: Final = 0.03  # of ranges, before the places are compared
_MODEL_SD_M: Final = 0.7e-3  # what ranges that depend on incidence and surface leave in a way
_SIGNIFICANT: Final = np.sqrt(2.0)
"""Standard deviations of a scale that is worth having: from there on what is left without it,
value^2 - sd^2 at the best guess, is more than the sd^2 that is left with it."""


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
        Flat patches that both places see.
    """

    scale: float
    sd: float
    measured: float
    surfaces: int

    @property
    def is_significant(self) -> bool:
        """Whether it is worth having."""
        return bool(abs(self.scale) > _SIGNIFICANT * self.sd)


class _Way(NamedTuple):
    """Motion from the first position to the second.

    Attributes
    ----------
    turn : ndarray, shape (3, 3)
    shift : ndarray, shape (3,)
        [m]
    """

    turn: F64
    shift: F64

    def applied(self, points: F64) -> F64:
        """Return points (N, 3) of the second place in the frame of the first."""
        return np.asarray(points @ self.turn.T + self.shift)

    def moved(self, turn: F64, shift: F64) -> _Way:
        """Return the way after a small turn about the second place, (3,) [rad], and a shift."""
        from scipy.spatial.transform import Rotation

        return _Way(Rotation.from_rotvec(turn).as_matrix() @ self.turn, self.shift + shift)


def by_tape(
    first: Place,
    second: Place,
    length: float,
    length_sd: float = 0.002,
    correction: F64 | None = None,
) -> ScaleResult:
    """Return the range scale from two places a known way apart.

    Both clouds are brought together on flat patches that both places see; a wrong scale makes
    them and the way between them smaller alike. A range bias is estimated beside it.

    Parameters
    ----------
    first, second : Place
        The sensor looks the same way at both.
    length : float
        Between them, by tape [m].
    length_sd : float
        What the tape is uncertain by [m].
    correction : ndarray, shape (8,), optional
        Of the beams, in the order of :data:`model.NAMES`; as reported if left out.

    Raises
    ------
    CalibrationError
        If surfaces are not found again, or what they say is not a scale.
    """
    if length < _SHORTEST_M:
        raise CalibrationError(
            f"{length:g} m between the positions is too short; slide the sensor by 3 m, of which "
            "2 mm are 0.07 %"
        )
    if first.block != second.block:
        raise CalibrationError(
            "the positions were recorded with different units; use one unit for both"
        )
    used = np.zeros(len(NAMES)) if correction is None else correction
    one, other = (beams(place.returns, place.block, used) for place in (first, second))
    group = np.zeros(len(one.points), np.int64)
    walls = flat.large(one.points, group > 0, group, _EXTENT_M)
    if not len(walls.first):
        raise CalibrationError(
            f"{first.name}: no large flat surfaces; use a room with a flat wall ahead"
        )
    way = _together(one.points, other.points, walls, _ways(one, other, walls, length))
    found, own, patches = _refined(one, other, way)
    measured = float(np.linalg.norm(found.shift))
    scale = length / measured - 1.0
    if abs(scale) > _WORST_SCALE:
        raise CalibrationError(
            f"the sensor moved by {measured:.3f} m by its own ranges and by {length:.3f} m by the "
            f"tape; a range scale explains at most {100 * _WORST_SCALE:.0f} %: read the tape "
            "again, and slide the sensor straight towards a flat wall"
        )
    along = found.shift / measured
    sd = float(np.sqrt(along @ own @ along + _MODEL_SD_M**2 + length_sd**2)) / length
    return ScaleResult(scale, sd, measured, patches)


def _ways(one: Beams, other: Beams, walls: Planes, length: float) -> list[_Way]:
    """Return the ways that the sensor may have gone, best first: along the normals of walls."""
    from scipy.spatial import cKDTree

    directions: list[F64] = []
    for normal in walls.normal[np.argsort(-walls.counts)]:
        for direction in (normal, -normal):
            if all(direction @ known < _SAME_WAY for known in directions):
                directions.append(direction)
    tree = cKDTree(_some(one.points, 4 * _MOST_COARSE))
    some = _some(other.points, _MOST_COARSE // 4)
    ways = [_Way(np.eye(3), direction * length) for direction in directions]
    reach = _REACHES_M[0]
    costs = [
        float(
            np.minimum(tree.query(way.applied(some), distance_upper_bound=reach)[0], reach).mean()
        )
        for way in ways
    ]
    return [ways[index] for index in np.argsort(costs)]


def _some(points: F64, most: int) -> F64:
    return points[:: max(1, len(points) // most)]


def _together(one: F64, other: F64, walls: Planes, ways: list[_Way]) -> _Way:
    """Return the best of two ways after points were brought to the walls of the first place."""
    from scipy.spatial import cKDTree

    target, normals = one[walls.member], walls.normal[walls.plane]
    tree = cKDTree(target)
    points = _some(other, _MOST_COARSE)
    best: tuple[float, _Way] | None = None
    for way in ways[:2]:
        off = np.inf
        for reach in _REACHES_M:
            there = way.applied(points)
            distance, index = tree.query(there, distance_upper_bound=reach)
            near = np.isfinite(distance)
            if np.count_nonzero(near) < _FEWEST:
                break
            normal = normals[index[near]]
            height = np.einsum("ni,ni->n", there[near] - target[index[near]], normal)
            jacobian = np.concatenate((np.cross(there[near] - way.shift, normal), normal), axis=1)
            weight = 1.0 / np.maximum(np.abs(height), 0.03)  # of absolute values
            square = (jacobian * weight[:, None]).T @ jacobian + 1e-6 * np.eye(6)
            step = -np.linalg.solve(square, (jacobian * weight[:, None]).T @ height)
            way = way.moved(step[:3], step[3:])
            off = float(np.minimum(distance, reach).mean())
        if best is None or off < best[0]:
            best = off, way
    assert best is not None
    return best[1]


def _refined(one: Beams, other: Beams, way: _Way) -> tuple[_Way, F64, int]:
    """Return the way by the flat patches of both places, the covariance of its shift, and patches.

    The unknowns are turn, shift and a range bias.
    """
    is_second = np.arange(len(one.points) + len(other.points)) >= len(one.points)
    nothing = np.zeros(len(is_second), np.int64)
    begin = way.shift
    bias = 0.0
    information = np.diag([*[1e-9] * 6, _BIAS_SD_M**-2])
    for _ in range(_ASSOCIATIONS):
        rays = _joined(one, other, way, bias)
        patches = flat.cells(rays.points, is_second, nothing, _MOST_OF_CELL)
        if len(patches.first) < _FEWEST:
            raise _not_found(begin)
        chosen = patches.member
        part = Beams(rays.origin[chosen], rays.direction[chosen], rays.distance[chosen])
        own = patches.at()
        met = solver.meeting(part, own)
        normal = own.normal[own.plane]
        jacobian = np.concatenate(
            (np.cross(met.points - way.shift, normal), normal, met.cosine[:, None]), axis=1
        )
        jacobian[:, :6] *= is_second[chosen][:, None]
        before = information[6, 6] * np.array([0.0] * 6 + [bias])
        group = np.zeros(len(own.first), np.int64)
        found = solver.system(own, met, jacobian, group, information)
        step = np.linalg.solve(found.hessian, -(found.gradient + before))
        way, bias = way.moved(step[:3], step[3:6]), bias + float(step[6])
        if np.abs(step[3:]).max() < _SETTLED_M:
            break
    turned = np.arccos(np.clip((np.trace(way.turn) - 1.0) / 2.0, -1.0, 1.0))
    if turned > _TURNED_RAD:
        raise _not_found(begin)
    return way, found.covariance[3:6, 3:6], len(patches.first)


def _joined(one: Beams, other: Beams, way: _Way, bias: float) -> Beams:
    """Return the rays of both places in the frame of the first."""
    return Beams(
        np.concatenate((one.origin, way.applied(other.origin))),
        np.concatenate((one.direction, other.direction @ way.turn.T)),
        np.concatenate((one.distance, other.distance)) + bias,
    )


def _not_found(shift: F64) -> CalibrationError:
    return CalibrationError(
        f"the surfaces of the first position were not found again {np.linalg.norm(shift):.2f} m "
        "on; slide the sensor straight towards a flat wall, without turning it"
    )
