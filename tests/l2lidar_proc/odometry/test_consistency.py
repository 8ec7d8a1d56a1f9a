"""The innovation test: quiet where covariances are right, loud where they are not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import ERRORS, POSE, POSITION, VELOCITY, InertialState
from l2lidar_proc.odometry.consistency import InnovationTest
from tests.l2lidar_proc.motion.analytic import at

BEFORE = np.diag(np.full(ERRORS, 0.02**2))
STILL = InertialState(
    at(0.0), np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
)


def corrected(covariance: np.ndarray, measured: slice = slice(0, 9)) -> np.ndarray:
    """Return the posterior of a measurement that is as sure as the prior."""
    out = covariance.copy()
    out[measured, measured] *= 0.5
    return out


def run(
    scale: float, seconds: float = 5.0, drift: float = 0.0, measured: slice = slice(0, 9)
) -> InnovationTest:
    """Return the test after corrections ``scale`` times as large as their covariance allows.

    ``drift`` [m/s] is added to each correction of the velocity along x.
    """
    test = InnovationTest()
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
    assert found.nis == pytest.approx(1.0, abs=0.3)
    assert found.velocity_nis < tuning.NIS_CHANCE
    assert found.excess < 1.4
    assert not found.contradicts
    small = run(0.3)
    assert small.nis == pytest.approx(0.09, abs=0.04)
    assert small.excess == 1.0


def test_too_large_ones_are_suspect_and_tell_by_how_much() -> None:
    found = run(2.0)
    assert found.contradicts
    assert found.excess == pytest.approx(4.0, rel=0.3)
    assert run(100.0).excess == tuning.NIS_MOST
    assert not run(2.0, seconds=0.7).contradicts  # too few to say so


def test_small_ones_that_are_all_alike_contradict_the_accelerometer() -> None:
    # 0.1 m/s^2 for 3 s: each correction of 23 mm/s is allowed, all of them together are not
    found = run(0.3, drift=0.023)
    assert found.nis < 1.1
    assert found.velocity_nis > tuning.NIS_SUSPECT * tuning.NIS_CHANCE
    assert found.contradicts


def test_only_what_is_measured_counts() -> None:
    found = run(1.0, measured=POSITION)
    assert found.nis == pytest.approx(1.0, abs=0.4)
    test = InnovationTest()
    for number in range(10):
        prior = dataclasses.replace(STILL, stamp=at(0.23 * number))
        test.take(prior, BEFORE, prior.boxplus(np.full(ERRORS, 0.1)), BEFORE)
    assert (test.nis, test.excess) == (0.0, 1.0)


def test_it_looks_back_some_seconds_and_forgets() -> None:
    test = run(3.0)
    for number in range(20):
        prior = dataclasses.replace(STILL, stamp=at(6.0 + 0.23 * number))
        error = np.zeros(ERRORS)
        error[POSE] = 1e-3
        test.take(prior, BEFORE, prior.boxplus(error), corrected(BEFORE))
    assert test.nis < 0.1
    test = run(3.0)
    test.clear()
    assert (test.nis, test.velocity_nis, test.excess) == (0.0, 0.0, 1.0)
