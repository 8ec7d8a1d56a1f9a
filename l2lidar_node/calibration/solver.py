"""Plane bundle adjustment: robust Gauss-Newton over beam parameters, planes eliminated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.calibration import planes as flat
from l2lidar_node.calibration.model import (
    NAMES,
    Beams,
    Block,
    angles,
    beams,
    derivatives,
)
from l2lidar_node.calibration.planes import Planes
from l2lidar_node.types import F64, I64

# 1-sigma range noise of a real unit along smooth surfaces, over the distance
NOISE_AT_M: Final = np.array([0.0, 8.0, 12.5, 20.0, 30.0])
NOISE_M: Final = np.array([0.0115, 0.0115, 0.017, 0.027, 0.042])
_POINTING_RAD: Final = 1e-3  # jitter of a beam's direction, a quarter of its width
_FLOOR_M: Final = 4e-3  # no surface is a better plane than this
_GRAZING: Final = 0.15  # smallest cosine of the incidence
_CLUSTER_M: Final = 1.2  # planes within such a cube count as one piece of evidence
_HUBER: Final = 2.0  # standard deviations
_OUTLIER: Final = 6.0
_ASSOCIATIONS: Final = 4
_ITERATIONS: Final = 2
_CONVERGED: Final = 0.1  # step in standard deviations
_FEWEST_PLANES: Final = 3
_STEP: Final = np.array(
    [0.017, 0.017, 0.017, 0.005, 0.05, 0.005, 0.017, 0.017]
)  # largest of each parameter
_BALANCE: Final = 2.0  # a direction of normals counts at most so many times the mean of all


Finder = Callable[[F64, NDArray[np.bool_], I64], Planes]


class FewPlanesError(ValueError):
    """Too few planes for an estimate."""


class Unknown(NamedTuple):
    """One unknown: a parameter of all groups or of a single one."""

    parameter: int
    group: int | None = None


class Scene(NamedTuple):
    """Returns of several placements with one calibration block.

    Attributes
    ----------
    returns : ndarray, shape (N,), dtype RETURN
    group : ndarray, shape (N,), int
        Number of the place.
    known : ndarray, shape (G, 8)
        What is added to the parameters of each group without being estimated: the rocking of the
        mount that the gyro saw.
    block : Block
    """

    returns: NDArray[np.void]
    group: I64
    known: F64
    block: Block

    @property
    def is_far_half(self) -> NDArray[np.bool_]:
        """Whether alpha is above 90 degrees, shape (N,)."""
        return np.asarray(self.returns["alpha"] > np.pi / 2)

    def part(self, keep: NDArray[np.bool_] | I64) -> Scene:
        """Return the scene of some of the returns."""
        return self._replace(returns=self.returns[keep], group=self.group[keep])


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Estimate of the unknowns.

    Attributes
    ----------
    unknowns : tuple of Unknown
    values : ndarray, shape (P,)
        [rad], [m].
    hessian : ndarray, shape (P, P)
        Of half the sum of squared weighted residuals.
    covariance : ndarray, shape (P, P)
        Sandwich over planes: the residuals of a plane may be correlated in any way.
    cost : float
        Mean robust cost of a point.
    planes : Planes
    scale : float
        Residuals over what the noise model expects.
    """

    unknowns: tuple[Unknown, ...]
    values: F64
    hessian: F64
    covariance: F64
    cost: float
    planes: Planes
    scale: float

    def per_group(self, groups: int) -> F64:
        """Return the corrections of every group, shape (G, 8)."""
        return spread(self.unknowns, self.values, groups)

    @property
    def sd(self) -> F64:
        """Standard deviation of each unknown, shape (P,)."""
        return np.sqrt(np.diag(self.covariance))


def spread(unknowns: Sequence[Unknown], values: F64, groups: int) -> F64:
    """Return the corrections of every group, shape (G, 8), of the values of the unknowns."""
    found = np.zeros((groups, len(NAMES)))
    for unknown, value in zip(unknowns, values, strict=True):
        rows = slice(None) if unknown.group is None else unknown.group
        found[rows, unknown.parameter] += value
    return found


def points(scene: Scene, corrections: F64) -> F64:
    """Return the returns in their places' cloud frames under corrections (G, 8) [m]."""
    full = scene.known + corrections
    return beams(scene.returns, scene.block, full, scene.group).points


def solve(
    scene: Scene,
    unknowns: Sequence[Unknown],
    start: F64 | None = None,
    find: Finder = flat.cells,
    prior: F64 | None = None,
) -> Solution:
    """Estimate the unknowns.

    Planes are found anew with every better estimate, until that no longer changes.

    Parameters
    ----------
    scene : Scene
    unknowns : sequence of Unknown, length P
    start : ndarray, shape (P,), optional
        Where to begin; zero if left out.
    find : callable
        :func:`planes.cells` or :func:`planes.large`.
    prior : ndarray, shape (P, P), optional
        Information about ``start``, the inverse of its covariance.

    Raises
    ------
    FewPlanesError
        If there is too little to estimate from.
    """
    unknowns = tuple(unknowns)
    values = begin = np.zeros(len(unknowns)) if start is None else np.array(start)
    information = np.zeros((len(unknowns),) * 2) if prior is None else prior
    groups = len(scene.known)
    for _ in range(_ASSOCIATIONS):
        before = values
        found = find(
            points(scene, spread(unknowns, values, groups)), scene.is_far_half, scene.group
        )
        if len(found.first) < _FEWEST_PLANES:
            raise FewPlanesError("the scene has too few flat surfaces")
        members, own = scene.part(found.member), found.at()
        for _ in range(_ITERATIONS):
            here, own = _linearized(members, unknowns, values, own, information)
            gradient = here.gradient + information @ (values - begin)
            step = _newton(here.hessian, gradient)
            values = values + _bounded(step, unknowns)
        if np.all(np.abs(values - before) < _CONVERGED * np.sqrt(np.diag(here.covariance))):
            break
    end, own = _linearized(members, unknowns, values, own, information)
    return Solution(
        unknowns,
        values,
        end.hessian,
        end.covariance,
        end.cost,
        own._replace(member=found.member),
        end.scale,
    )


def cost_on(scene: Scene, unknowns: Sequence[Unknown], values: F64, planes: Planes) -> float:
    """Return the mean robust cost of values on planes found with others."""
    members = scene.part(planes.member)
    return _linearized(members, tuple(unknowns), values, planes.at())[0].cost


def widened(scene: Scene, solution: Solution, more: Sequence[Unknown]) -> Solution:
    """Return the solution with further unknowns, on the same planes."""
    unknowns = (*solution.unknowns, *more)
    values = np.concatenate((solution.values, np.zeros(len(more))))
    members, own = scene.part(solution.planes.member), solution.planes.at()
    for _ in range(_ITERATIONS):
        here, own = _linearized(members, unknowns, values, own)
        step = _newton(here.hessian, here.gradient)
        values = values + _bounded(step, unknowns)
    end, own = _linearized(members, unknowns, values, own)
    return Solution(
        unknowns,
        values,
        end.hessian,
        end.covariance,
        end.cost,
        own._replace(member=solution.planes.member),
        end.scale,
    )


def repeated(scene: Scene, solution: Solution, keep: NDArray[np.bool_]) -> F64:
    """Return the unknowns as some of the solution's members alone would have them.

    One Gauss-Newton step from the solution, on its planes.

    Parameters
    ----------
    scene : Scene
    solution : Solution
    keep : ndarray, shape (M,)
        Which members of the solution's planes count.
    """
    planes = solution.planes
    now = points(scene.part(planes.member), solution.per_group(len(scene.known)))
    part = flat.part(planes.at(), keep, now)
    members = scene.part(planes.member[part.member])
    here, _ = _linearized(members, solution.unknowns, solution.values, part.at())
    return np.asarray(solution.values + _newton(here.hessian, here.gradient, 1e-6))


class System(NamedTuple):
    """Normal equations of the unknowns, planes eliminated.

    Attributes
    ----------
    hessian : ndarray, shape (P, P)
        Of half the sum of squared weighted residuals, and what was known before.
    gradient : ndarray, shape (P,)
    covariance : ndarray, shape (P, P)
        Sandwich over clusters of planes.
    cost : float
        Mean robust cost of a point.
    scale : float
        Residuals over what the noise model expects.
    """

    hessian: F64
    gradient: F64
    covariance: F64
    cost: float
    scale: float


def _linearized(
    scene: Scene,
    unknowns: tuple[Unknown, ...],
    values: F64,
    planes: Planes,
    information: F64 | float = 0.0,
) -> tuple[System, Planes]:
    """Return the normal equations of the unknowns, and the planes through the points at values.

    All returns are members.
    """
    returns, group = scene.returns, scene.group
    full = scene.known + spread(unknowns, values, len(scene.known))
    at = angles(returns, scene.block, full, group)
    rays = beams(returns, scene.block, full, group, at)
    planes = flat.refitted(planes, rays.points)
    met = meeting(rays, planes)
    whole = derivatives(returns, at, planes.normal[planes.plane], met.distance)
    jacobian = np.stack(
        [
            whole[:, item.parameter] * (1.0 if item.group is None else group == item.group)
            for item in unknowns
        ],
        axis=-1,
    )
    return system(planes, met, jacobian, group[planes.first], information), planes


class Meeting(NamedTuple):
    """Intersections of rays with the planes that their points lie on.

    Attributes
    ----------
    points : ndarray, shape (N, 3)
        [m]
    distance : ndarray, shape (N,)
        On the ray [m].
    cosine : ndarray, shape (N,)
        Of the incidence.
    height : ndarray, shape (N,)
        Of the measured point above the plane [m].
    """

    points: F64
    distance: F64
    cosine: F64
    height: F64


def meeting(rays: Beams, planes: Planes) -> Meeting:
    """Return where rays meet their planes.

    Derivatives and places in a plane are taken there: at the measured point they would contain
    its noise, which tilts a small plane and pulls towards short ranges.

    Parameters
    ----------
    rays : Beams
        One for each member of the planes, in that order.
    planes : Planes
    """
    plane = planes.plane
    normal = planes.normal[plane]
    cosine = np.einsum("ni,ni->n", rays.direction, normal)
    height = np.einsum("ni,ni->n", rays.points - planes.center[plane], normal)
    distance = rays.distance - height / np.where(np.abs(cosine) > _GRAZING, cosine, 1.0)
    return Meeting(rays.origin + rays.direction * distance[:, None], distance, cosine, height)


def system(
    planes: Planes, met: Meeting, jacobian: F64, group: I64, information: F64 | float = 0.0
) -> System:
    """Return the normal equations of unknowns that move points which lie on planes.

    Parameters
    ----------
    planes : Planes
    met : Meeting
        Of the points of all planes, plane by plane.
    jacobian : ndarray, shape (N, P)
        How far each unknown moves a point along its plane's normal.
    group : ndarray, shape (K,), int
        Planes of different groups are never one piece of evidence.
    information : ndarray, shape (P, P), optional
        What is known before.
    """
    plane = planes.plane
    offset = met.points - planes.center[plane]
    distance, cosine, height = met.distance, met.cosine, met.height
    noise = np.interp(distance, NOISE_AT_M, NOISE_M)
    sigma = np.sqrt(
        (noise * cosine) ** 2 + (distance * _POINTING_RAD) ** 2 * (1.0 - cosine**2) + _FLOOR_M**2
    )
    residual = height / sigma
    usable = np.abs(cosine) > _GRAZING
    scale = max(1.4826 * float(np.median(np.abs(residual[usable]))), 0.2) if usable.any() else 1.0
    away = np.abs(residual) / scale
    robust = np.where(away <= _HUBER, 1.0, _HUBER / np.maximum(away, _HUBER))
    robust = np.where((away < _OUTLIER) & usable, robust, 0.0)
    weight = robust * _balance(planes)[plane] / (sigma * scale) ** 2
    span = np.stack(
        (
            np.ones(len(height)),
            np.einsum("ni,ni->n", offset, planes.u[plane]),
            np.einsum("ni,ni->n", offset, planes.v[plane]),
        ),
        axis=-1,
    )
    columns = np.concatenate((span, jacobian, height[:, None]), axis=1)
    products = flat.products(columns, planes.first, weight)
    own = products[:, :3, :3] + 1e-9 * np.eye(3)
    cross = products[:, :3, 3:]
    reduced = products[:, 3:, 3:] - np.swapaxes(cross, 1, 2) @ np.linalg.solve(own, cross)
    hessian = reduced[:, :-1, :-1].sum(axis=0)
    scores = _per_cluster(reduced[:, :-1, -1], planes.center, group)
    hessian += information
    inverse = np.linalg.pinv(hessian)
    count = len(scores)
    unknowns = jacobian.shape[1]
    middle = scores.T @ scores * count / max(count - unknowns, 1) + information
    loss = np.where(away <= _HUBER, away**2, 2.0 * _HUBER * away - _HUBER**2)
    loss = np.where(away < _OUTLIER, loss, 2.0 * _HUBER * _OUTLIER - _HUBER**2)
    return System(
        hessian,
        scores.sum(axis=0),
        inverse @ middle @ inverse,
        float((loss[usable] * scale**2).mean()) if usable.any() else np.inf,
        scale,
    )


def _per_cluster(scores: F64, center: F64, group: I64) -> F64:
    """Return the sums of the scores of neighboring planes, whose errors are correlated."""
    place = np.column_stack((group, np.floor(center / _CLUSTER_M).astype(np.int64)))
    cluster = np.unique(place, axis=0, return_inverse=True)[1].ravel()
    return np.stack([np.bincount(cluster, column) for column in scores.T], axis=-1)


def _balance(planes: Planes) -> F64:
    """Return a weight of each plane by which no direction of normals outvotes the others."""
    axes = np.array(
        [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], np.float64
    )[14:]
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    direction = np.argmax(np.abs(planes.normal @ axes.T), axis=1)
    share = np.bincount(direction, planes.counts, len(axes)) / planes.counts.sum()
    filled = share > 0
    most = _BALANCE / filled.sum()
    return np.asarray(np.minimum(1.0, most / np.maximum(share, 1e-12))[direction])


def _newton(hessian: F64, gradient: F64, rcond: float | None = None) -> F64:
    return np.asarray(np.linalg.lstsq(hessian, -gradient, rcond=rcond)[0], np.float64)


def _bounded(step: F64, unknowns: Sequence[Unknown]) -> F64:
    limit = _STEP[[item.parameter for item in unknowns]]
    return np.asarray(step / max(1.0, float(np.max(np.abs(step) / limit))))
