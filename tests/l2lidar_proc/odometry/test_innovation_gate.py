"""The innovation gate: what an alignment and its prediction become where they disagree."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np
import pytest

from l2lidar_node.types import HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import ERRORS, POSITION, VELOCITY, InertialState
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.innovation_gate import (
    GatedAlignment,
    InnovationGate,
    Prediction,
    inflated_prior,
    is_narrow,
)
from l2lidar_proc.odometry.innovations import correction
from l2lidar_proc.odometry.matcher import SweepMatcher
from l2lidar_proc.odometry.registration.alignment import Alignment
from l2lidar_proc.odometry.registration.correspondences import Source
from tests.l2lidar_proc.motion.analytic import at
from tests.l2lidar_proc.odometry.mapped_room import (
    LOOSE,
    PLACE,
    TIGHT,
    extended,
    motion,
    room,
    source,
)

BEFORE = np.diag(np.full(ERRORS, 0.02**2))
STILL = InertialState(
    at(0.0), np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
)


@pytest.fixture(scope="module")
def matcher() -> SweepMatcher:
    """Return a matcher with a map of the room."""
    rng, matcher = np.random.default_rng(11), SweepMatcher(OdometryConfig(), np.zeros(3))
    for _ in range(14):
        extended(matcher, room(rng, 4000))
    return matcher


@pytest.fixture(scope="module")
def seen() -> Source:
    """Return what is seen from PLACE."""
    return source((room(np.random.default_rng(12), 3000) - PLACE)[::2])


def inflated(predicted: SweepMotion, found: Alignment) -> Any:
    """Return the covariance that a prediction must have had."""
    before = predicted.covariance
    item = correction(predicted.state, before, found.state, found.covariance)
    return inflated_prior(before, item)


def gated(
    matcher: SweepMatcher,
    seen: Source,
    predicted: SweepMotion,
    found: Alignment | None,
    *held: SweepMotion,
    blurred: bool = False,
) -> GatedAlignment:
    """Return what passes a new gate, perhaps with other predictions to fall back on."""
    others = [partial(Prediction, motion, seen) for motion in held]
    given = Prediction(predicted, seen)
    return InnovationGate().passed(matcher, given, found, others, blurred=blurred)


def aligned(matcher: SweepMatcher, seen: Source, predicted: SweepMotion) -> Alignment:
    """Return what the matcher makes of a prediction."""
    found = matcher.match(seen, predicted).alignment
    assert found is not None
    return found


@pytest.mark.parametrize("axis", [POSITION.start, VELOCITY.start])
def test_a_single_one_beyond_the_gate_tells_how_uncertain_the_prior_was(axis: int) -> None:
    after = BEFORE.copy()
    after[axis, axis] *= 0.5
    allowed = float(np.sqrt(BEFORE[axis, axis] - after[axis, axis]))

    def beyond(sigmas: float) -> Any:
        error = np.zeros(ERRORS)
        error[axis] = sigmas * allowed
        item = correction(STILL, BEFORE, STILL.boxplus(error), after)
        return inflated_prior(BEFORE, item)

    gate = float(np.sqrt(tuning.NIS_GATE))
    assert beyond(0.98 * gate) is None
    assert beyond(-0.98 * gate) is None
    for sigmas in (1.02 * gate, -30.0):
        expected = BEFORE.copy()
        expected[:9] *= abs(sigmas)
        expected[:, :9] *= abs(sigmas)
        np.testing.assert_allclose(beyond(sigmas), expected, rtol=1e-6)
    nothing = correction(STILL, BEFORE, STILL, BEFORE)
    assert inflated_prior(BEFORE, nothing) is None  # nothing was measured


def test_what_agrees_with_its_prediction_passes_as_it_is(
    matcher: SweepMatcher, seen: Source
) -> None:
    predicted = motion(TIGHT, PLACE + 0.01)
    found = aligned(matcher, seen, predicted)
    for blurred in (False, True):
        passed = gated(matcher, seen, predicted, found, blurred=blurred)
        assert passed == (predicted, seen, found, False)


def test_a_prediction_that_was_too_sure_of_itself_gives_way(
    matcher: SweepMatcher, seen: Source
) -> None:
    predicted = motion((0.002, 0.005), PLACE + np.array([0.06, 0.0, 0.0]))
    found = aligned(matcher, seen, predicted)
    compromise = float(np.linalg.norm(found.state.position - PLACE))
    passed = gated(matcher, seen, predicted, found)
    assert passed.is_suspect
    assert passed.alignment is not None
    assert np.linalg.norm(passed.alignment.state.position - PLACE) < 0.5 * compromise
    wide = inflated(predicted, found)
    assert wide is not None
    np.testing.assert_allclose(passed.predicted.covariance, wide)


def test_a_blurred_sweep_that_contradicts_its_prediction_tells_nothing(
    matcher: SweepMatcher, seen: Source
) -> None:
    predicted = motion((0.002, 0.005), PLACE + np.array([0.06, 0.0, 0.0]))
    found = aligned(matcher, seen, predicted)
    passed = gated(matcher, seen, predicted, found, blurred=True)
    assert (passed.alignment, passed.is_suspect) == (None, True)
    wide = inflated(predicted, found)
    assert wide is not None
    np.testing.assert_allclose(passed.predicted.covariance, wide)
    # likewise one that fits badly, whose prediction is no less certain for that
    right = motion(TIGHT, PLACE + 0.01)
    poor = dataclasses.replace(aligned(matcher, seen, right), inlier_ratio=0.3)
    passed = gated(matcher, seen, right, poor, blurred=True)
    assert (passed.alignment, passed.is_suspect) == (None, True)
    np.testing.assert_array_equal(passed.predicted.covariance, right.covariance)


def test_a_sweep_that_fits_badly_is_aligned_again(matcher: SweepMatcher, seen: Source) -> None:
    predicted = motion(TIGHT, PLACE + 0.01)
    poor = dataclasses.replace(aligned(matcher, seen, predicted), inlier_ratio=0.3)
    passed = gated(matcher, seen, predicted, poor)
    assert passed.is_suspect
    assert passed.alignment is not None
    assert passed.alignment.inlier_ratio > 0.9
    loosened = np.diag(passed.predicted.covariance - predicted.covariance)
    np.testing.assert_allclose(loosened[POSITION], tuning.DOUBT_POSITION_SIGMA**2)
    np.testing.assert_allclose(loosened[VELOCITY], tuning.DOUBT_VELOCITY_SIGMA**2)


@pytest.fixture(scope="module")
def strange(seen: Source) -> Source:
    """Return a sweep of another place: it fits as badly wherever it is put."""
    rng = np.random.default_rng(5)
    return source(np.concatenate((seen.points, rng.uniform(-2.0, 2.0, (2500, 3)))))


def test_one_that_fits_badly_everywhere_is_aligned_again_once_a_second(
    matcher: SweepMatcher, seen: Source, strange: Source
) -> None:
    gate = InnovationGate()
    predicted = motion(LOOSE, PLACE)
    poor = dataclasses.replace(aligned(matcher, seen, predicted), inlier_ratio=0.3)
    bad = matcher._align(strange, predicted, predicted.state)
    assert bad is not None

    def is_found(seconds: float, points: Source, found: Alignment) -> bool:
        state = dataclasses.replace(predicted.state, stamp=at(seconds))
        later = Prediction(dataclasses.replace(predicted, state=state), points)
        return gate.passed(matcher, later, found, (), blurred=False).is_suspect

    pause = 1e-9 * tuning.DOUBT_PAUSE_NS
    assert is_found(0.0, seen, poor)
    assert is_found(0.01, seen, poor)  # what was wrong is looked at again at once
    assert not is_found(0.02, strange, bad)
    assert not is_found(0.99 * pause, seen, poor)
    assert is_found(0.02 + pause, seen, poor)
    assert not is_found(2.0 * pause, strange, bad)
    gate.restart(HostNs(at(0.5 * pause)))
    assert is_found(0.5 * pause, seen, poor)


def test_a_sweep_that_meets_nothing_is_aligned_from_a_velocity_that_was_held(
    matcher: SweepMatcher, seen: Source, strange: Source
) -> None:
    """An accelerometer that felt a blow which did not move the sensor predicts it far away."""
    predicted, held = motion(TIGHT, PLACE + 3.0), motion(TIGHT, PLACE + 0.01)
    passed = gated(matcher, seen, predicted, None, held)
    assert passed.predicted is held
    assert passed.is_suspect
    assert passed.alignment is not None
    assert np.linalg.norm(passed.alignment.state.position - PLACE) < 0.01
    unchanged = (predicted, seen, None, False)
    assert gated(matcher, seen, predicted, None) == unchanged
    assert gated(matcher, seen, predicted, None, held, blurred=True) == unchanged
    few = source(seen.points[: matcher.config.min_points - 1])
    assert gated(matcher, few, predicted, None, held) == (predicted, few, None, False)
    # nor is that believed where the sweep fits badly there, too
    assert gated(matcher, strange, predicted, None, held) == (predicted, strange, None, False)


def test_only_what_is_believed_teaches_what_is_usual(
    matcher: SweepMatcher, seen: Source, strange: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trials that failed had taught it, and a spinning lidar ended 0.3 m off for it."""
    monkeypatch.setattr(matcher, "_inliers", (0.99, 20))
    predicted = motion(LOOSE, PLACE)
    bad = matcher._align(strange, predicted, predicted.state)
    assert bad is not None
    assert not gated(matcher, strange, predicted, bad, motion(TIGHT, PLACE)).is_suspect
    assert matcher._inliers == (0.99, 20)
    poor = dataclasses.replace(aligned(matcher, seen, predicted), inlier_ratio=0.3)
    before = matcher._inliers[1]
    assert gated(matcher, seen, predicted, poor).is_suspect
    assert matcher._inliers[1] == before + 1


def test_of_two_predictions_that_fit_better_the_closer_one_is_believed(
    matcher: SweepMatcher, seen: Source
) -> None:
    predicted, held = motion(TIGHT, PLACE + 0.01), motion(TIGHT, PLACE)
    poor = dataclasses.replace(aligned(matcher, seen, predicted), inlier_ratio=0.3)
    surfaces = matcher.config.surfaces
    passed = gated(matcher, seen, predicted, poor, held)
    assert passed.alignment is not None
    loose = gated(matcher, seen, predicted, poor).alignment
    assert loose is not None
    by_held = aligned(matcher, seen, held)
    least = min(loose.misfit(surfaces), by_held.misfit(surfaces))
    assert passed.alignment.misfit(surfaces) == pytest.approx(least)


def test_a_third_prediction_is_tried_if_the_second_does_not_fit(
    matcher: SweepMatcher, seen: Source
) -> None:
    """It does without the gyro as well, and is worth its time only then."""
    far, near = motion(TIGHT, PLACE + 3.0), motion(TIGHT, PLACE + 0.01)
    passed = gated(matcher, seen, far, None, far, near)
    assert passed.predicted is near
    assert passed.is_suspect
    again = gated(matcher, seen, far, None, near, dataclasses.replace(near))
    assert again.predicted is near


def test_a_doubted_prediction_gives_way_to_what_lies_closer_to_surfaces(
    matcher: SweepMatcher, seen: Source
) -> None:
    found = aligned(matcher, seen, motion(TIGHT, PLACE + 0.01))
    surfaces = matcher.config.surfaces
    near, other = tuning.DOUBT_CLOSER
    for factor, expected in ((1.02 / near, True), (0.98 / near, False)):
        worse = dataclasses.replace(found, inlier_ratio=1.0, residual=0.02)
        better = dataclasses.replace(worse, residual=0.02 / np.sqrt(factor))
        assert better.fits_closer_than(worse, surfaces) is expected
    free = dataclasses.replace(worse, information=np.zeros_like(found.information))
    for factor, expected in ((1.02 / other, True), (0.98 / other, False)):
        better = dataclasses.replace(worse, residual=0.02 / np.sqrt(factor))
        assert better.fits_closer_than(free, surfaces) is expected
    assert not dataclasses.replace(free, residual=0.001).fits_closer_than(worse, surfaces)
    few = dataclasses.replace(worse, residual=0.001, matched=int(0.96 * worse.matched))
    assert not few.fits_closer_than(worse, surfaces)
    outliers = dataclasses.replace(worse, inlier_ratio=0.9)
    limit = tuning.INLIER_SCALES * surfaces.outlier_scale
    assert outliers.misfit(surfaces) == pytest.approx(0.9 * 0.02**2 + 0.1 * limit**2)


def test_sight_is_lost_where_a_free_place_has_more_outliers_than_of_late(
    matcher: SweepMatcher, seen: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = aligned(matcher, seen, motion(TIGHT, PLACE + 0.01))
    free = dataclasses.replace(found, information=np.zeros_like(found.information))
    usual, _ = matcher._inliers
    factor, more = tuning.DOUBT_OUTLIERS_FACTOR, tuning.DOUBT_OUTLIERS_SHARE
    limit = factor * (1.0 - usual) + more
    assert not matcher.lost_sight(dataclasses.replace(free, inlier_ratio=1.001 - limit))
    assert matcher.lost_sight(dataclasses.replace(free, inlier_ratio=0.999 - limit))
    assert not matcher.lost_sight(dataclasses.replace(found, inlier_ratio=0.999 - limit))
    monkeypatch.setattr(matcher, "driving", True)
    assert not matcher.lost_sight(dataclasses.replace(free, inlier_ratio=0.999 - limit))


def test_a_niche_does_not_fix_the_place_of_a_carrier_that_drives(
    matcher: SweepMatcher, seen: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    predicted = motion(TIGHT, PLACE + 0.01)
    found = aligned(matcher, seen, predicted)
    worse = dataclasses.replace(found, residual=0.1, inlier_ratio=0.96)
    free = dataclasses.replace(worse, information=np.zeros_like(found.information))
    better = InnovationGate()._is_better
    points = len(seen.points)
    assert better(matcher, found, worse, points)
    assert better(matcher, found, free, points)
    monkeypatch.setattr(matcher, "driving", True)
    assert better(matcher, found, worse, points)
    assert not better(matcher, found, free, points)


def test_a_loose_prediction_does_not_replace_what_fits_as_well(
    matcher: SweepMatcher, strange: Source
) -> None:
    predicted = motion(LOOSE, PLACE)
    found = matcher._align(strange, predicted, predicted.state)
    assert found is not None
    assert matcher.fits_badly(found)
    assert gated(matcher, strange, predicted, found) == (predicted, strange, found, False)


@pytest.mark.parametrize(
    ("opening_deg", "narrow"),
    [(360.0, False), (180.0, False), (100.0, True), (70.0, True)],
)
def test_a_view_is_narrow_by_its_opening_angle(opening_deg: float, narrow: bool) -> None:
    rng = np.random.default_rng(5)
    cosines = rng.uniform(np.cos(np.radians(opening_deg / 2.0)), 1.0, 4000)
    azimuths = rng.uniform(0.0, 2.0 * np.pi, len(cosines))
    sines = np.sqrt(1.0 - cosines**2)
    directions = np.column_stack((sines * np.cos(azimuths), cosines, sines * np.sin(azimuths)))
    ranges = rng.uniform(0.5, 30.0, (len(cosines), 1))
    assert is_narrow(ranges * directions) is narrow


def test_a_view_of_nothing_is_narrow() -> None:
    assert is_narrow(np.zeros((0, 3)))
    assert is_narrow(np.zeros((3, 3)))
