"""The test of innovations: quiet where covariances are right and loud where they are not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, strategies as st

from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import ERRORS, POSE, POSITION, VELOCITY, InertialState
from l2lidar_proc.odometry.innovations import InnovationTest, observed_scale
from tests.l2lidar_proc.motion.analytic import at

BEFORE = np.diag(np.full(ERRORS, 0.02**2))
ALONG = np.eye(3)[:, :1]
STILL = InertialState(
    at(0.0), np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
)


def corrected(covariance: np.ndarray, measured: slice = slice(0, 9)) -> np.ndarray:
    """Return the posterior of a measurement that is as sure as the prior."""
    out = covariance.copy()
    out[measured, measured] *= 0.5
    return out


def run(
    scale: float,
    seconds: float = 5.0,
    drift: float = 0.0,
    measured: slice = slice(0, 9),
    test: InnovationTest | None = None,
) -> InnovationTest:
    """Return the test after corrections ``scale`` times as large as their covariance allows.

    ``drift`` [m/s] is added to each correction of the velocity along x.
    """
    test = test or InnovationTest()
    rng = np.random.default_rng(3)
    after = corrected(BEFORE, measured)
    for number in range(round(seconds / 0.23)):
        prior = dataclasses.replace(STILL, stamp=at(0.23 * number))
        error = np.zeros(ERRORS)
        error[measured] = scale * np.sqrt(np.diag(BEFORE - after)[measured])
        error *= rng.standard_normal(ERRORS)
        error[VELOCITY.start] += drift
        test.take(prior, BEFORE, prior.boxplus(error), after)
    return test


def test_corrections_as_large_as_allowed_are_no_surprise() -> None:
    found = run(1.0)
    assert found.nis_per_dof == pytest.approx(1.0, abs=0.3)
    assert found.velocity_nis_per_dof < tuning.NIS_CHANCE
    assert found.variance_factor < 1.4
    assert not found.contradicts


def test_too_large_ones_are_suspect_and_tell_by_how_much() -> None:
    found = run(2.0)
    assert found.contradicts
    assert found.variance_factor == pytest.approx(4.0, rel=0.3)
    assert run(100.0).variance_factor == tuning.NIS_MOST
    assert not run(2.0, seconds=0.7).contradicts  # too few to say so


def test_small_ones_tell_that_variances_are_too_large() -> None:
    found = run(0.3)
    assert found.nis_per_dof == pytest.approx(0.09, abs=0.04)
    assert found.variance_factor == pytest.approx(tuning.NIS_MARGIN * found.nis_per_dof)
    assert run(0.9).variance_factor <= 1.0  # the margin raises none
    assert run(0.01).variance_factor == 1.0 / tuning.NIS_MOST
    assert run(0.3, seconds=0.7).variance_factor == 1.0  # too few to say so
    # small ones that add up: their sum decides
    alike = run(0.3, drift=0.01)
    assert alike.nis_per_dof < 0.5 * alike.velocity_nis_per_dof / tuning.NIS_CHANCE < 1.0
    expected = tuning.NIS_MARGIN * alike.velocity_nis_per_dof / tuning.NIS_CHANCE
    assert alike.variance_factor == pytest.approx(min(expected, 1.0))


def test_what_poses_add_to_the_drift_is_lowered_with_a_margin_of_its_own() -> None:
    found = run(0.3)
    assert found.expected_share == pytest.approx(tuning.NIS_DRIFT_MARGIN * found.nis_per_dof)
    found.note_unobserved(at(5.0), ALONG)
    assert found.expected_share == pytest.approx(tuning.NIS_DRIFT_MARGIN * found.nis_per_dof)
    assert run(0.9).expected_share == run(100.0).expected_share == 1.0  # never raised
    assert run(0.01).expected_share == 1.0 / tuning.NIS_MOST
    assert run(0.3, seconds=0.7).expected_share == 1.0  # too few to say so
    alike = run(0.2, drift=0.005)  # here the sum decides
    assert alike.nis_per_dof < 0.8 * alike.velocity_nis_per_dof / tuning.NIS_CHANCE
    expected = tuning.NIS_DRIFT_MARGIN * alike.velocity_nis_per_dof / tuning.NIS_CHANCE
    assert expected < 0.9
    assert alike.expected_share == pytest.approx(expected)


def test_variances_are_not_lowered_while_a_direction_was_unobserved() -> None:
    last = round(5.0 / 0.23) - 1
    for before, lowered in ((0.0, False), (2.9, False), (3.1, True)):
        found = run(0.3)
        found.note_unobserved(at(0.23 * last - before), ALONG)
        assert (found.variance_factor < 1.0) == lowered, before
        assert (found.velocity_factor < 1.0) != lowered, before
        assert (found.unobserved.size == 0) == lowered, before
    found = run(2.0)
    found.note_unobserved(at(0.23 * last), ALONG)
    assert found.variance_factor == pytest.approx(4.0, rel=0.3)  # raised all the same
    assert found.velocity_factor == 1.0
    forgotten = InnovationTest()
    forgotten.note_unobserved(at(0.23 * last), ALONG)
    forgotten.clear()
    assert run(0.3, test=forgotten).variance_factor < 1.0


def test_the_velocity_is_lowered_by_less_in_the_directions_that_were_observed() -> None:
    last = round(5.0 / 0.23) - 1
    for scale in (0.6, 0.01):
        found = run(scale)
        found.note_unobserved(at(0.23 * last), ALONG)
        expected = max(tuning.NIS_MARGIN * found.nis_per_dof, 1.0 / tuning.NIS_PARTLY_MOST)
        assert found.velocity_factor == pytest.approx(expected)
    assert run(0.01).velocity_factor == 1.0  # all were: the variance factor says it
    few = run(0.3, seconds=0.7)
    few.note_unobserved(at(0.23 * 2), ALONG)
    assert few.velocity_factor == 1.0
    found.note_unobserved(at(0.23 * last), np.eye(3))
    assert found.velocity_factor == 1.0  # none was


def test_directions_that_hardly_differ_are_one() -> None:
    last = round(5.0 / 0.23) - 1
    found = run(0.3)
    for turn in (0.0, 0.05):
        axis = np.array([[np.cos(turn)], [np.sin(turn)], [0.0]])
        found.note_unobserved(at(0.23 * last - turn), axis)
    assert found.unobserved.shape == (3, 1)
    assert abs(found.unobserved[0, 0]) > 0.999
    found.note_unobserved(at(0.23 * last), np.eye(3)[:, 1:2])
    assert found.unobserved.shape == (3, 2)
    np.testing.assert_allclose(found.unobserved[2], 0.0, atol=1e-12)


@given(seed=st.integers(0, 1000), free=st.integers(0, 3), factor=st.floats(0.01, 1.0))
def test_what_unobserved_directions_explain_is_not_scaled(
    seed: int, free: int, factor: float
) -> None:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((3, 3)) * 10.0 ** rng.uniform(-2.0, 0.0, 3)
    covariance = root @ root.T + 1e-6 * np.eye(3)
    along = np.linalg.qr(rng.standard_normal((3, 3)))[0][:, :free]
    scale = observed_scale(covariance, factor, along)
    scaled = scale @ covariance @ scale.T
    explained = np.zeros((3, 3))
    if free:
        gain = covariance @ along @ np.linalg.inv(along.T @ covariance @ along)
        explained = gain @ along.T @ covariance
    expected = explained + factor * (covariance - explained)
    tolerance = 1e-7 * float(np.trace(covariance))
    np.testing.assert_allclose(scaled, expected, atol=tolerance)
    np.testing.assert_allclose(
        along.T @ scaled @ along, along.T @ covariance @ along, atol=tolerance
    )


def test_small_ones_that_are_all_alike_contradict_the_accelerometer() -> None:
    # 0.1 m/s^2 for 3 s: each correction of 23 mm/s is allowed, all of them together are not
    found = run(0.3, drift=0.023)
    assert found.nis_per_dof < 1.1
    assert found.velocity_nis_per_dof > tuning.NIS_SUSPECT * tuning.NIS_CHANCE
    assert found.contradicts


def test_only_what_is_measured_counts() -> None:
    found = run(1.0, measured=POSITION)
    assert found.nis_per_dof == pytest.approx(1.0, abs=0.4)
    test = InnovationTest()
    for number in range(10):
        prior = dataclasses.replace(STILL, stamp=at(0.23 * number))
        test.take(prior, BEFORE, prior.boxplus(np.full(ERRORS, 0.1)), BEFORE)
    assert (test.nis_per_dof, test.variance_factor) == (0.0, 1.0)


def test_it_looks_back_some_seconds_and_forgets() -> None:
    test = run(3.0)
    for number in range(20):
        prior = dataclasses.replace(STILL, stamp=at(6.0 + 0.23 * number))
        error = np.zeros(ERRORS)
        error[POSE] = 1e-3
        test.take(prior, BEFORE, prior.boxplus(error), corrected(BEFORE))
    assert test.nis_per_dof < 0.1
    test = run(3.0)
    test.clear()
    assert (test.nis_per_dof, test.velocity_nis_per_dof, test.variance_factor) == (0.0, 0.0, 1.0)
