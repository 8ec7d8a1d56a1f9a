"""The innovation gate: what an alignment and its prediction become where they disagree."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from l2lidar_node.types import HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import ERRORS, POSITION, VELOCITY, InertialState
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.alignment import Alignment
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.correspondences import Source
from l2lidar_proc.odometry.innovation_gate import GatedAlignment, InnovationGate, inflated_prior
from l2lidar_proc.odometry.matcher import SweepMatcher
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

    def inflated(sigmas: float) -> Any:
        error = np.zeros(ERRORS)
        error[axis] = sigmas * allowed
        return inflated_prior(STILL, BEFORE, STILL.boxplus(error), after)

    gate = float(np.sqrt(tuning.NIS_GATE))
    assert inflated(0.98 * gate) is None
    assert inflated(-0.98 * gate) is None
    for sigmas in (1.02 * gate, -30.0):
        expected = BEFORE.copy()
        expected[:9] *= abs(sigmas)
        expected[:, :9] *= abs(sigmas)
        np.testing.assert_allclose(inflated(sigmas), expected, rtol=1e-6)
    assert inflated_prior(STILL, BEFORE, STILL, BEFORE) is None  # nothing was measured


def test_what_agrees_with_its_prediction_passes_as_it_is(
    matcher: SweepMatcher, seen: Source
) -> None:
    predicted = motion(TIGHT, PLACE + 0.01)
    found = aligned(matcher, seen, predicted)
    for blurred in (False, True):
        passed = InnovationGate().passed(matcher, seen, predicted, found, blurred=blurred)
        assert passed == (predicted, found, False)


def test_a_prediction_that_was_too_sure_of_itself_gives_way(
    matcher: SweepMatcher, seen: Source
) -> None:
    predicted = motion((0.002, 0.005), PLACE + np.array([0.06, 0.0, 0.0]))
    found = aligned(matcher, seen, predicted)
    compromise = float(np.linalg.norm(found.state.position - PLACE))
    passed = InnovationGate().passed(matcher, seen, predicted, found, blurred=False)
    assert passed.is_suspect
    assert passed.alignment is not None
    assert np.linalg.norm(passed.alignment.state.position - PLACE) < 0.5 * compromise
    wide = inflated_prior(predicted.state, predicted.covariance, found.state, found.covariance)
    assert wide is not None
    np.testing.assert_allclose(passed.predicted.covariance, wide)


def test_a_blurred_sweep_that_contradicts_its_prediction_tells_nothing(
    matcher: SweepMatcher, seen: Source
) -> None:
    predicted = motion((0.002, 0.005), PLACE + np.array([0.06, 0.0, 0.0]))
    found = aligned(matcher, seen, predicted)
    passed = InnovationGate().passed(matcher, seen, predicted, found, blurred=True)
    assert (passed.alignment, passed.is_suspect) == (None, True)
    wide = inflated_prior(predicted.state, predicted.covariance, found.state, found.covariance)
    assert wide is not None
    np.testing.assert_allclose(passed.predicted.covariance, wide)
    # likewise one that fits badly, whose prediction is no less certain for that
    right = motion(TIGHT, PLACE + 0.01)
    poor = dataclasses.replace(aligned(matcher, seen, right), inlier_ratio=0.3)
    passed = InnovationGate().passed(matcher, seen, right, poor, blurred=True)
    assert (passed.alignment, passed.is_suspect) == (None, True)
    np.testing.assert_array_equal(passed.predicted.covariance, right.covariance)


def test_a_sweep_that_fits_badly_is_aligned_again_once_a_second(
    matcher: SweepMatcher, seen: Source
) -> None:
    gate = InnovationGate()
    predicted = motion(TIGHT, PLACE + 0.01)
    poor = dataclasses.replace(aligned(matcher, seen, predicted), inlier_ratio=0.3)

    def passed(seconds: float) -> GatedAlignment:
        state = dataclasses.replace(predicted.state, stamp=at(seconds))
        later = dataclasses.replace(predicted, state=state)
        return gate.passed(matcher, seen, later, poor, blurred=False)

    pause = 1e-9 * tuning.DOUBT_PAUSE_NS
    first = passed(0.0)
    assert first.is_suspect
    assert first.alignment is not None
    assert first.alignment.inlier_ratio > 0.9
    loosened = np.diag(first.predicted.covariance - predicted.covariance)
    np.testing.assert_allclose(loosened[POSITION], tuning.DOUBT_SIGMA[0] ** 2)
    np.testing.assert_allclose(loosened[VELOCITY], tuning.DOUBT_SIGMA[1] ** 2)
    again = passed(0.99 * pause)
    assert (again.alignment, again.is_suspect) == (poor, False)
    assert passed(pause).is_suspect
    assert not passed(0.5 * pause).is_suspect
    gate.restart(HostNs(at(0.5 * pause)))
    assert passed(0.5 * pause).is_suspect


def test_a_loose_prediction_does_not_replace_what_fits_as_well(
    matcher: SweepMatcher, seen: Source
) -> None:
    """A sweep of another place: it fits as badly wherever it is put."""
    rng = np.random.default_rng(5)
    strange = source(np.concatenate((seen.points, rng.uniform(-2.0, 2.0, (2500, 3)))))
    predicted = motion(LOOSE, PLACE)
    found = matcher._align(strange, predicted, predicted.state)
    assert found is not None
    assert matcher.fits_badly(found)
    passed = InnovationGate().passed(matcher, strange, predicted, found, blurred=False)
    assert passed == (predicted, found, False)
