"""Attempts to begin a map, compared with each other."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from l2lidar_node.types import HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import ERRORS, POSITION
from l2lidar_proc.odometry.initialization.trial import Trial
from l2lidar_proc.odometry.registration.alignment import Alignment
from tests.support.passing_sweeps import EPOCH, SPEED, motion_at

MOTION = motion_at(SPEED, np.eye(ERRORS)).anchored_at(HostNs(EPOCH))


def trial(inliers: float | None, weakest: float = 1.0) -> Trial:
    """Return a trial whose last sweep has so many inliers; None met no other sweep.

    The weakest direction has that share of the information of the strongest.
    """
    if inliers is None:
        return Trial([MOTION, MOTION], met=False)
    information = np.zeros((ERRORS, ERRORS))
    information[POSITION, POSITION] = np.diag([1e4 * weakest, 1e4, 1e4])
    nobody = np.zeros(0, np.int64), np.zeros(0)
    covariance = 1e-6 * np.eye(ERRORS)
    last = Alignment(MOTION.state, covariance, information, np.eye(3), 500, inliers, 0.01, nobody)
    return Trial([MOTION, MOTION], True, last)


FAILED = Trial([], met=False)


@pytest.mark.parametrize(
    ("one", "other", "margin", "is_closer"),
    [
        (trial(0.9), trial(0.8), 0.0, True),
        (trial(0.8), trial(0.9), 0.0, False),
        (trial(0.905), trial(0.9), 0.01, False),
        (trial(0.92), trial(0.9), 0.01, True),
        (trial(0.5), FAILED, 0.0, True),
        (FAILED, trial(0.5), 0.0, False),
        # nothing was compared yet, as where little comes back
        (trial(0.9), trial(None), 0.0, False),
        (trial(None), trial(0.9), 0.0, False),
    ],
)
def test_more_inliers_fit_closer(one: Trial, other: Trial, margin: float, is_closer: bool) -> None:
    assert one.fits_closer(other, margin) == is_closer


def test_few_inliers_and_failures_are_doubtful() -> None:
    assert FAILED.is_doubtful
    assert trial(tuning.INITIAL_INLIERS - 0.01).is_doubtful
    assert not trial(tuning.INITIAL_INLIERS + 0.01).is_doubtful
    assert not trial(None).is_doubtful  # it is too early to tell


def test_a_weak_direction_is_left_open() -> None:
    assert trial(0.95, 0.5 * tuning.START_FIXED).leaves_open(tuning.START_FIXED)
    assert not trial(0.95, 2.0 * tuning.START_FIXED).leaves_open(tuning.START_FIXED)
    assert not trial(None).leaves_open(tuning.START_FIXED)


def test_a_trial_is_better_if_it_fits_far_closer() -> None:
    assert trial(0.93, 0.02).fits_better(trial(0.81, 0.2))
    assert not trial(0.85, 0.02).fits_better(trial(0.81, 0.2))
    assert not trial(0.81, 0.2).fits_better(trial(0.93, 0.02))
    assert not trial(0.93).fits_better(FAILED)


def test_a_trial_is_better_if_it_fixes_what_another_one_leaves_open() -> None:
    fixed, weak = trial(0.96, 0.5), trial(0.95, 0.01)
    assert fixed.fits_better(weak)
    assert not weak.fits_better(fixed)
    assert not trial(0.96, 0.015).fits_better(weak)
    assert not trial(0.94, 0.5).fits_better(weak)
    assert not trial(None).fits_better(weak)


@pytest.mark.parametrize(
    ("moving", "rest", "disproves"),
    [
        (trial(0.9), trial(0.8), True),
        (trial(0.9), trial(0.895), False),
        (trial(0.8), trial(None), True),  # no sweep at rest has met another one
        (trial(None), trial(0.8), False),
        (FAILED, trial(None), False),
    ],
)
def test_a_motion_disproves_a_rest_that_fits_less(
    moving: Trial, rest: Trial, disproves: bool
) -> None:
    assert moving.disproves(rest) == disproves


def test_a_motion_that_is_slower_than_its_error_disproves_nothing() -> None:
    slow = dataclasses.replace(
        MOTION.state, velocity=np.array([0.9 * tuning.INITIAL_REST_SPEED, 0.0, 0.0])
    )
    motion = MOTION.with_state(slow, MOTION.covariance)
    assert not trial(0.9)._replace(motions=[motion]).disproves(trial(0.8))
