"""Beam angles and range bias from still placements, with their deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.calibration import planes as flat, solver
from l2lidar_node.calibration.model import (
    ALPHA,
    BETA,
    BIAS,
    NAMES,
    ROCK_COS,
    ROCK_SIN,
    STRETCH,
    XI,
    B,
    beams,
)
from l2lidar_node.calibration.observation import Place, Precession, demodulated
from l2lidar_node.calibration.planes import Planes
from l2lidar_node.calibration.result import (
    Estimate,
    PlaceReport,
    Quality,
    Refusal,
    StillResult,
    Verdict,
)
from l2lidar_node.calibration.solver import FewPlanesError, Scene, Solution, Unknown
from l2lidar_node.types import F64

DEG: Final = np.pi / 180.0

_FEWEST_TURNS: Final = 8.0
_FEWEST_PLANES: Final = 100
_LARGEST_SD: Final = 0.05 * DEG
_LARGEST_SD_TOGETHER: Final = 0.1 * DEG  # of xi and beta moved together
_LARGEST: Final = 1.0 * DEG
_LARGEST_B_M: Final = 0.005
_LEAST_GAIN: Final = 0.1  # by which the planes must become thinner
_CONTRADICTION: Final = 0.1 * DEG  # between two places
_REPEATABLE: Final = 0.05 * DEG  # alpha between places and power-ups
_PRECESSION_WORST: Final = 0.5 * DEG
_PRECESSION: Final = 0.03 * DEG  # smaller rocking is left in alpha and beta
_LARGEST_DRIFT_M: Final = 5e-3  # noise alone makes 1 to 2 mm of it
_DIRTIEST: Final = 5.0  # [%]
_MODEL_SD: Final = np.array([0.02 * DEG, 0.02 * DEG, 0.005 * DEG, 0.15e-3])
"""What the model itself may be off, beside what the recording shows: xi, beta, alpha, b."""
_SIGNIFICANT: Final = 2.0  # standard deviations of a correction that is worth having
_STARTS: Final = (0.0, -0.6 * DEG, 0.6 * DEG)  # of alpha: a slot of the mirror each way
_QUARTERS: Final = 4
_MOST_RETURNS: Final = 300_000  # of all places: beyond that the surfaces limit, not the noise
_MOST_RETURNS_WHOLE: Final = 480_000  # for b, which moves points least, and for distant walls
_MOST_OF_CELL: Final = 400  # points, for b: 80 leave 0.3 mm of noise in it, these 0.1 mm
_MOST_RETURNS_COARSE: Final = 120_000
_LEAST_RETURNS: Final = 70_000  # of a place, which fill the cells

# ---- of the range bias

FEWEST_DIRECTIONS: Final = 3
_LARGE_PLANES: Final = 4
_LARGEST_BIAS_M: Final = 0.3
_LARGEST_SD_M: Final = 0.012
_MODEL_SD_M: Final = 2e-3  # what range errors that grow with the incidence may pass for
_BIAS_SIGNIFICANT: Final = 3.0  # standard deviations: on most units nothing but noise asks for one
_STEEP: Final = np.cos(np.deg2rad(20.0))
_SHALLOW: Final = np.cos(np.deg2rad(65.0))
_BOWED: Final = 0.3  # difference of the cosines over a surface that shows a bias
_APART: Final = np.cos(np.deg2rad(30.0))


class CalibrationError(ValueError):
    """No estimate is possible; the message says why and what to do."""


def calibrate(places: Sequence[Place], keep_alpha: bool = False) -> StillResult:
    """Estimate a unit's beams from still places.

    Parameters
    ----------
    places : sequence of Place
        Of one unit in one mode.
    keep_alpha : bool
        Store alpha though it was seen after one power-up only: it is right until the next one.

    Raises
    ------
    CalibrationError
        If there is nothing to estimate from, in all places or in one of them.
    """
    refusals = [refusal for place in places for refusal in problems(place)]
    refusals += _between(places)
    precessions = [demodulated(place) for place in places]
    scene = _scene(places, [None] * len(places))
    try:
        coarse = _started(scene, len(places))
        taken, notes, refused = _precession(scene, coarse, places, precessions)
        refusals += refused
        scene = _scene(places, taken)
        solution = solver.solve(scene, _unknowns(len(places)), coarse.values)
        _check_seen(solution, places)
        whole = _scene(places, taken, _MOST_RETURNS_WHOLE)
        angles = _with_axis_distance(whole, solution)
        _check_seen(angles, places)
        bias, reason = range_bias(whole, angles)
    except FewPlanesError:
        if refusals:
            raise CalibrationError("; ".join(refusals[0])) from None
        raise CalibrationError(
            "too few flat surfaces are seen by both halves of the fan; calibrate in a furnished "
            "room of 4 to 10 m with a flat ceiling and bare stretches of wall"
        ) from None
    reports = _alone(scene, solution, places, precessions)
    sd, scatter, together = _uncertainty(scene, solution)
    corrections = solution.per_group(len(places))
    before, after = _qualities(scene, solution, corrections)
    facing = directions(solution.planes)
    refusals += _judged(solution, sd, scatter, together, facing, reports)
    refusals += _moved(scene, solution)
    xi, beta = solution.values[0], solution.values[1]
    alphas = solution.values[2:]
    is_better = after.thickness < (1.0 - _LEAST_GAIN) * before.thickness
    is_corrected = bool((np.abs(solution.values[:2]) > _SIGNIFICANT * sd[:2]).any())
    is_corrected |= bool((np.abs(alphas) > _SIGNIFICANT * sd[2:]).any())
    if is_corrected and not is_better and not refusals:
        notes.append(
            f"walls would not become {100 * _LEAST_GAIN:.0f} % thinner: the reported block is as "
            "good"
        )
        is_corrected = False
    verdict = Verdict.CORRECTED if is_corrected else Verdict.UNCHANGED
    with_b = _axis_distance(angles)
    estimates = {
        "xi": Estimate(float(xi), float(sd[0]), verdict),
        "beta": Estimate(float(beta), float(sd[1]), verdict),
        "alpha": _alpha(places, alphas, sd[2:], verdict, keep_alpha),
        "b": with_b if verdict is Verdict.CORRECTED else _unstored(with_b),
        "bias": Estimate(np.nan, np.nan, Verdict.UNKNOWN, reason) if bias is None else bias,
    }
    if any(precession is None for precession in precessions):
        notes.append(
            "no IMU data: rocking of the mount cannot be separated from alpha and beta, so the "
            "result is valid for this mount only"
        )
    mean = corrections.mean(axis=0)
    return StillResult(
        scene.block,
        estimates,
        float(xi - 0.7 * beta),
        _side_sd(scene, solution),
        _weakest(solution),
        before,
        after,
        tuple(reports),
        len(solution.planes.first),
        facing,
        tuple(refusals),
        tuple(notes),
        mean,
        scene,
        solution.planes,
    )


def problems(place: Place) -> list[Refusal]:
    """Return the problems of a placement that show before the estimation."""
    found = []
    if place.turns < _FEWEST_TURNS:
        found.append(
            Refusal(
                f"{place.name}: {place.turns:.1f} turns of the head, at least "
                f"{_FEWEST_TURNS:.0f} are needed",
                "record 10 s at each placement",
            )
        )
    if place.blocks > 1:
        found.append(
            Refusal(
                f"{place.name}: packets of {place.blocks} different calibration blocks",
                "record one unit in one mode only",
            )
        )
    if place.is_wide:
        found.append(
            Refusal(
                f"{place.name}: wide field of view, which has its own block",
                "set the standard field of view (l2lidar set work-mode -- -wide_fov) and record "
                "again",
            )
        )
    if place.dirt > _DIRTIEST:
        found.append(Refusal(f"{place.name}: dirt index {place.dirt:.1f} %", "clean the cover"))
    return found


def _between(places: Sequence[Place]) -> list[Refusal]:
    if len({place.block for place in places}) > 1:
        return [
            Refusal(
                "the placements were recorded with different calibration blocks",
                "calibrate one unit at a time",
            )
        ]
    return []


def _scene(
    places: Sequence[Place], precessions: Sequence[Precession | None], most: int = _MOST_RETURNS
) -> Scene:
    nothing = np.zeros(len(NAMES))
    share = max(most // len(places), _LEAST_RETURNS)
    returns = [_some(place.returns, share) for place in places]
    return Scene(
        np.concatenate(returns),
        np.repeat(np.arange(len(places)), [len(part) for part in returns]),
        np.stack(
            [
                nothing if precession is None else precession.correction
                for precession in precessions
            ]
        ),
        places[0].block,
    )


def _some(returns: NDArray[np.void], most: int) -> NDArray[np.void]:
    """Return the returns of every k-th packet, so that there are not many more than ``most``."""
    every = max(1, round(len(returns) / most))
    return np.asarray(returns[np.unique(returns["packet"], return_inverse=True)[1] % every == 0])


def _unknowns(places: int, *more: Unknown) -> tuple[Unknown, ...]:
    alphas = (Unknown(ALPHA, group) for group in range(places))
    return (Unknown(XI), Unknown(BETA), *alphas, *more)


def _started(scene: Scene, places: int) -> Solution:
    """Return the best of the solutions from several starts, on a part of the returns.

    There are minima a slot of the mirror away; the costs are compared on the same planes.
    """
    part = _thinned(scene)
    unknowns = _unknowns(places)
    found: list[Solution] = []
    for alpha in _STARTS:
        start = np.array([0.0, 0.0, *[alpha] * places])
        try:
            solution = solver.solve(part, unknowns, start)
        except FewPlanesError:
            continue
        if not any(np.allclose(solution.values, other.values, atol=0.02 * DEG) for other in found):
            found.append(solution)
    if not found:
        raise FewPlanesError
    costs = [
        sum(solver.cost_on(part, unknowns, item.values, other.planes) for other in found)
        for item in found
    ]
    return found[int(np.argmin(costs))]


def _thinned(scene: Scene) -> Scene:
    """Return the scene of some of the packets, enough to tell minima apart."""
    numbers = np.unique(scene.returns["packet"], return_inverse=True)[1]
    every = max(2, round(len(scene.returns) / _MOST_RETURNS_COARSE))
    return scene.part(np.asarray(numbers % every == 0))


def _precession(
    scene: Scene,
    coarse: Solution,
    places: Sequence[Place],
    precessions: Sequence[Precession | None],
) -> tuple[list[Precession | None], list[str], list[Refusal]]:
    """Return the precession to subtract for each placement, notes, and refusals.

    A gyro may show a line at the head's frequency that is not a motion. A real rocking is hardly
    ever a circle: its part against the turning of the head shows in the cloud too.
    """
    taken: list[Precession | None] = []
    notes: list[str] = []
    refusals: list[Refusal] = []
    groups = len(scene.known)
    more = [
        Unknown(parameter, group) for group in range(groups) for parameter in (ROCK_COS, ROCK_SIN)
    ]
    rocks = None
    if any(
        precession is not None and max(precession.forward, precession.backward) > _PRECESSION
        for precession in precessions
    ):
        rocks = solver.widened(_thinned(scene), coarse, more)
    for group, precession in enumerate(precessions):
        if precession is None:
            taken.append(None)
            continue
        name = places[group].name
        if not precession.is_at_rest:
            refusals.append(
                Refusal(
                    f"{name}: the sensor moved, according to the IMU", "clamp it and record again"
                )
            )
        if precession.forward > _PRECESSION_WORST or precession.backward > _PRECESSION_WORST:
            refusals.append(
                Refusal(
                    f"{name}: the mount rocks by {precession.forward / DEG:.2f} degrees with "
                    "the head",
                    "screw or clamp the sensor to something heavy",
                )
            )
        if rocks is None or max(precession.forward, precession.backward) <= _PRECESSION:
            taken.append(None)
            continue
        at = len(coarse.values) + 2 * group
        away = rocks.values[at : at + 2] - (precession.rock_cos, precession.rock_sin)
        differs = float(np.hypot(*away))
        unsure = float(np.hypot(*rocks.sd[at : at + 2]))
        is_motion = differs < max(_PRECESSION, 0.3 * precession.backward, 3.0 * unsure)
        if is_motion:
            notes.append(
                f"{name}: the mount rocks by {precession.forward / DEG:.3f} degrees with the "
                "head; this is subtracted from alpha and beta"
            )
            taken.append(precession)
            continue
        taken.append(None)
        text = (
            f"{name}: the gyro shows a rocking of {precession.backward / DEG:.2f} degrees against "
            "the head that the points do not show"
        )
        if precession.forward > _PRECESSION:
            refusals.append(
                Refusal(
                    f"{text}, so its {precession.forward / DEG:.2f} degrees with the head cannot "
                    "be trusted either",
                    "screw or clamp the sensor to something heavy, so that the gyro is quiet",
                )
            )
        else:
            notes.append(f"{text}: a spectral line of the gyro, not a motion")
    return taken, notes, refusals


def _check_seen(solution: Solution, places: Sequence[Place]) -> None:
    """Raise CalibrationError if nothing in a placement tells its alpha."""
    information = np.diag(solution.hessian)[2:]
    for place, told in zip(places, information, strict=False):  # b may follow the alphas
        if told <= 0.0:
            raise CalibrationError(
                f"{place.name}: no flat surface is seen by both halves of the fan; check that "
                "nothing covers the sensor, and record it again in a furnished room of 4 to 10 m"
            )


def _alone(
    scene: Scene,
    solution: Solution,
    places: Sequence[Place],
    precessions: Sequence[Precession | None],
) -> list[PlaceReport]:
    """Return the solution of each placement alone: one step from the common solution."""
    group = scene.group[solution.planes.member]
    owner = group[solution.planes.first]
    reports = []
    for number, (place, precession) in enumerate(zip(places, precessions, strict=True)):
        values = solution.values
        if len(places) > 1 and np.count_nonzero(owner == number) > 10:
            values = solver.repeated(scene, solution, group == number)
        reports.append(
            PlaceReport(
                place.name,
                place.power_up,
                place.turns,
                int(np.count_nonzero(owner == number)),
                float(values[0]),
                float(values[1]),
                float(values[2 + number]),
                precession,
            )
        )
    return reports


def _uncertainty(scene: Scene, solution: Solution) -> tuple[F64, F64, float]:
    """Return deviations of the unknowns, scatter of the quarters, and xi and beta together.

    A deviation is the largest of what the planes, the quarters of the recording and near against
    far surfaces say, and what the model itself may be off.
    """
    returns = scene.returns[solution.planes.member]
    packets = np.array([scene.returns["packet"][scene.group == g].max() + 1
                        for g in range(len(scene.known))])  # fmt: skip
    quarter = returns["packet"] * _QUARTERS // packets[scene.group[solution.planes.member]]
    parts = np.stack([solver.repeated(scene, solution, quarter == q) for q in range(_QUARTERS)])
    scatter = parts.std(axis=0, ddof=1)
    middle = np.median(returns["range"])
    near = solver.repeated(scene, solution, returns["range"] <= middle)
    far = solver.repeated(scene, solution, returns["range"] > middle)
    both = np.zeros(len(solution.values))
    both[:2] = 0.5
    own = float(np.sqrt(both @ solution.covariance @ both))
    together = float(max(own, abs(both @ (near - far)) / 2.0, both @ scatter / 2.0))
    model = np.full(len(solution.values), _MODEL_SD[2])
    model[:2] = _MODEL_SD[:2]
    sd = np.hypot(np.maximum(solution.sd, scatter / 2.0), model)
    sd[:2] = np.maximum(sd[:2], together)
    return sd, scatter, together


def _side_sd(scene: Scene, solution: Solution) -> float:
    side = np.zeros(len(solution.values))
    side[:2] = 1.0, -0.7
    own = float(np.sqrt(side @ solution.covariance @ side))
    return float(np.hypot(own, _MODEL_SD[0]))


def _judged(
    solution: Solution,
    sd: F64,
    scatter: F64,
    together: float,
    directions: int,
    reports: Sequence[PlaceReport],
) -> list[Refusal]:
    """Return why the angles cannot be believed."""
    found = []
    room = (
        "calibrate in a furnished room of 4 to 10 m with a flat ceiling and bare stretches of wall"
    )
    planes = len(solution.planes.first)
    if planes < _FEWEST_PLANES:
        found.append(
            Refusal(f"{planes} flat patches that both halves see, expected {_FEWEST_PLANES}", room)
        )
    if directions < FEWEST_DIRECTIONS:
        found.append(
            Refusal(
                f"the surfaces face {directions} directions, expected {FEWEST_DIRECTIONS}", room
            )
        )
    if together > _LARGEST_SD_TOGETHER:
        found.append(
            Refusal(
                f"xi and beta moved together are uncertain by {together / DEG:.2f} degrees: "
                "surfaces near the horizon and near the zenith separate them",
                f"{room}, and add a placement with the sensor tilted or on its side",
            )
        )
    side = np.array([1.0, -0.7])
    across = float(np.sqrt(side @ solution.covariance[:2, :2] @ side))
    alphas = sd[2:]
    for name, value in (("xi - 0.7 beta", across), ("alpha", float(alphas.max()))):
        if value > _LARGEST_SD:
            found.append(
                Refusal(
                    f"{name} is uncertain by {value / DEG:.2f} degrees",
                    f"record 10 s more; {room}",
                )
            )
    white = np.sqrt(np.diag(solution.covariance)) * 2.0  # a quarter has a quarter of the data
    if (scatter > 3.0 * np.hypot(white, 0.02 * DEG)).any():
        found.append(
            Refusal(
                "the quarters of the recording contradict each other: the sensor or the scene "
                "moved",
                "clamp the sensor, keep people out, and record again",
            )
        )
    if (np.abs(solution.values) > _LARGEST).any():
        found.append(
            Refusal(
                "a correction of more than 1 degree is not a calibration error",
                "check the mount and the cover, and that nothing blocks half of the view",
            )
        )
    sides = [report.xi - 0.7 * report.beta for report in reports]
    if max(sides) - min(sides) > _CONTRADICTION:
        found.append(
            Refusal(
                f"the placements contradict each other by {(max(sides) - min(sides)) / DEG:.2f} "
                "degrees in xi - 0.7 beta",
                "clamp the sensor at every placement and record again",
            )
        )
    return found


def _moved(scene: Scene, solution: Solution) -> list[Refusal]:
    """Return whether surfaces stand elsewhere in the second half of the recording."""
    members = scene.part(solution.planes.member)
    own = solution.planes.at()
    height = own.heights(solver.points(members, solution.per_group(len(scene.known))))
    last = np.array([scene.returns["packet"][scene.group == group].max()
                     for group in range(len(scene.known))])  # fmt: skip
    late = members.returns["packet"] * 2 > last[members.group]
    drift = float(np.median(_half_gaps(height, late, own)))
    if drift < _LARGEST_DRIFT_M:
        return []
    return [
        Refusal(
            f"surfaces moved by {1e3 * drift:.0f} mm between the first and the second half of the "
            "recording",
            "clamp the sensor, keep people out, and record again",
        )
    ]


def _alpha(
    places: Sequence[Place], alphas: F64, sd: F64, verdict: Verdict, keep: bool
) -> Estimate:
    """Return alpha, stored only if it repeats after switching the unit off and on."""
    value, uncertain = float(alphas.mean()), float(np.sqrt(np.mean(sd**2)))
    spread = float(alphas.max() - alphas.min())
    power_ups = {place.power_up for place in places}
    if spread > _REPEATABLE:
        where = "between power-ups" if len(power_ups) > 1 else "between placements"
        reason = (
            f"not repeatable: it differs by {spread / DEG:.2f} degrees {where}, so it is not a "
            "constant of the unit"
        )
        return Estimate(value, max(uncertain, spread / 2.0), Verdict.SHOWN, reason)
    if verdict is Verdict.CORRECTED and len(power_ups) < 2 and not keep:
        reason = "seen after only one power-up; power-cycle the unit and record once more"
        return Estimate(value, uncertain, Verdict.SHOWN, reason)
    return Estimate(value, uncertain, verdict)


def _unstored(estimate: Estimate) -> Estimate:
    if estimate.verdict is not Verdict.CORRECTED:
        return estimate
    return Estimate(
        estimate.value, estimate.sd, Verdict.SHOWN, "not stored without the beam angles"
    )


def _with_axis_distance(scene: Scene, solution: Solution) -> Solution:
    """Return the solution with b, on the cells of a scene of more returns."""
    now = solver.points(scene, solution.per_group(len(scene.known)))
    cells = flat.cells(now, scene.is_far_half, scene.group, _MOST_OF_CELL)
    return solver.widened(scene, replace(solution, planes=cells), [Unknown(B)])


def _axis_distance(angles: Solution) -> Estimate:
    """Return b."""
    value = float(angles.values[-1])
    sd = float(np.hypot(angles.sd[-1], _MODEL_SD[3]))
    if abs(value) > _LARGEST_B_M:
        return Estimate(
            value, sd, Verdict.SHOWN, "more than 5 mm, which cannot be the distance of the axes"
        )
    return significant(value, sd)


def _qualities(scene: Scene, solution: Solution, corrections: F64) -> tuple[Quality, Quality]:
    return (
        quality(scene, solution.planes, np.zeros_like(corrections)),
        quality(scene, solution.planes, corrections),
    )


def quality(scene: Scene, planes: Planes, corrections: F64) -> Quality:
    """Return how thin planes are, and how far apart the halves, under corrections (G, 8).

    The rocking of the mount is taken out in any case.
    """
    members = scene.part(planes.member)
    now = solver.points(members, corrections)
    own = flat.refitted(planes.at(), now)
    height = own.heights(now)
    far = members.is_far_half
    thickness = np.sqrt(np.add.reduceat(height**2, own.first) / own.counts)
    gap = _half_gaps(height, far, own)
    return Quality(
        float(np.median(thickness)),
        float(np.sqrt(np.mean(height**2))),
        float(np.median(gap)),
        float(np.quantile(gap, 0.9)),
    )


def _half_gaps(height: F64, far: NDArray[np.bool_], planes: Planes) -> F64:
    """Return the distance of the two halves' means on every plane [m], shape (K,)."""
    counts = np.add.reduceat(far.astype(np.float64), planes.first)
    others = planes.counts - counts
    one = np.add.reduceat(height * far, planes.first) / np.maximum(counts, 1.0)
    other = np.add.reduceat(height * ~far, planes.first) / np.maximum(others, 1.0)
    return np.asarray(np.abs(one - other)[(counts > 0) & (others > 0)])


def _weakest(solution: Solution) -> str:
    """Return in words which combination of the angles is known worst."""
    values, vectors = np.linalg.eigh(solution.covariance)
    worst = vectors[:, -1]
    sd = np.sqrt(values[-1]) / DEG
    if np.abs(worst[:2]).max() > np.abs(worst[2:]).max():
        if worst[0] * worst[1] > 0:
            return (
                f"xi and beta moved together (0.7 of each: {sd:.3f} degrees); surfaces near the "
                "horizon and near the zenith separate them"
            )
        return f"xi against beta ({sd:.3f} degrees)"
    return f"alpha ({sd:.3f} degrees)"


def range_bias(scene: Scene, angles: Solution) -> tuple[Estimate | None, str]:
    """Return the range bias, None and why where it cannot be known.

    Parameters
    ----------
    scene : Scene
    angles : Solution
        Of the beams and b, which are known from cells far better than from large surfaces.
    """
    room = "it needs large flat walls and a ceiling, seen from steep to shallow, as in a room"
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
    if abs(value) > _BIAS_SIGNIFICANT * sd and changes:
        return None, f"near surfaces or another mirror step change its sign; {room}"
    return significant(value, sd), ""


def significant(value: float, sd: float) -> Estimate:
    """Return the estimate of a length, to be corrected if it is three deviations off."""
    is_significant = abs(value) > _BIAS_SIGNIFICANT * sd
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
