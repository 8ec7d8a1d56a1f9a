"""Range bias from large flat surfaces: a bias bows them, by its size times 1 - cos(incidence)."""

from __future__ import annotations

from typing import Final

import numpy as np

from l2lidar_node.calibration import planes as flat, solver
from l2lidar_node.calibration.model import BIAS, STRETCH, beams
from l2lidar_node.calibration.planes import Planes
from l2lidar_node.calibration.result import Estimate, Verdict
from l2lidar_node.calibration.solver import FewPlanesError, Scene, Solution, Unknown
from l2lidar_node.types import F64

FEWEST_DIRECTIONS: Final = 3
_LARGE_PLANES: Final = 4
_LARGEST_BIAS_M: Final = 0.3
_LARGEST_SD_M: Final = 0.012
_MODEL_SD_M: Final = 2e-3  # what range errors that grow with the incidence may pass for
_SIGNIFICANT: Final = 3.0  # standard deviations: on most units nothing but noise asks for one
_STEEP: Final = np.cos(np.deg2rad(20.0))
_SHALLOW: Final = np.cos(np.deg2rad(65.0))
_BOWED: Final = 0.3  # difference of the cosines over a surface that shows a bias
_APART: Final = np.cos(np.deg2rad(30.0))


def range_bias(scene: Scene, angles: Solution) -> tuple[Estimate | None, str]:
    """Return the range bias, None and why where it cannot be known.

    Parameters
    ----------
    scene : Scene
    angles : Solution
        Of the beams and b, which are known from cells far better than from large surfaces.
    """
    room = "large flat walls and a ceiling, seen from steep to shallow, tell it; a room has them"
    begin = np.append(angles.values, 0.0)
    prior = np.zeros((len(begin),) * 2)
    prior[:-1, :-1] = np.linalg.inv(angles.covariance)
    unknowns = (*angles.unknowns, Unknown(BIAS))
    try:
        solution = solver.solve(scene, unknowns, begin, flat.large, prior)
    except FewPlanesError:
        return None, room
    planes, steep, facing = _bowed(scene, solution)
    if planes < _LARGE_PLANES or facing < FEWEST_DIRECTIONS or not steep:
        return None, f"{planes} large surfaces in {facing} directions; {room}"
    value = float(solution.values[-1])
    own = float(solution.sd[-1])
    wider = (*unknowns, Unknown(STRETCH))
    more = np.pad(prior, ((0, 1), (0, 1)))
    free = solver.solve(scene, wider, np.append(solution.values, 0.0), flat.large, more)
    returns = scene.returns[solution.planes.member]
    near = solver.repeated(scene, solution, returns["range"] < np.median(returns["range"]))
    sd = float(np.hypot(own, _MODEL_SD_M))
    if abs(value) > _LARGEST_BIAS_M or own > _LARGEST_SD_M:
        return None, f"uncertain by {1e3 * own:.0f} mm; {room}"
    changes = value * free.values[-2] < 0 or value * near[-1] < 0
    if abs(value) > _SIGNIFICANT * sd and changes:
        return None, f"near surfaces or another mirror step turn its sign; {room}"
    return significant(value, sd), ""


def significant(value: float, sd: float) -> Estimate:
    """Return the estimate of a length, to be corrected if it is three deviations off."""
    is_significant = abs(value) > _SIGNIFICANT * sd
    return Estimate(value, sd, Verdict.CORRECTED if is_significant else Verdict.UNCHANGED)


def _bowed(scene: Scene, solution: Solution) -> tuple[int, bool, int]:
    """Return large surfaces that show a bias, whether from steep to shallow, and directions."""
    planes = solution.planes
    members = scene.part(planes.member)
    full = members.known + solution.per_group(len(members.known))
    rays = beams(members.returns, members.block, full, members.group)
    cosine = np.abs(np.einsum("ni,ni->n", rays.direction, planes.normal[planes.plane]))
    highest = np.maximum.reduceat(cosine, planes.first)
    lowest = np.minimum.reduceat(cosine, planes.first)
    bowed = highest - lowest > _BOWED
    steep = bool((highest > _STEEP).any() and (lowest < _SHALLOW).any())
    return int(bowed.sum()), steep, directions(planes)


def directions(planes: Planes) -> int:
    """Return how many directions, 30 degrees and more apart, the normals have (at most 9)."""
    chosen: list[F64] = []
    weights = planes.counts
    for index in np.argsort(-weights):
        normal = planes.normal[index]
        if all(abs(float(normal @ other)) < _APART for other in chosen):
            chosen.append(normal)
    return len(chosen)
