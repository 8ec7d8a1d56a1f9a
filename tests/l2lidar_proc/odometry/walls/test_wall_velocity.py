"""Velocity along walls: its axes, and how the profile of walls and vertical lines go together."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.passed_places import correction_of_passed
from l2lidar_proc.odometry.walls.vertical_lines import LINE, Lines
from l2lidar_proc.odometry.walls.wall_profile import SPOT, WallProfile
from l2lidar_proc.odometry.walls.wall_velocity import WallVelocity, level_axes
from tests.support.passed_walls import AXES, DOORS, SPEED, passed, state_at


def test_axes_are_level() -> None:
    gravity = np.array([0.5, 0.0, -9.7])
    axes = level_axes(np.array([0.6, 0.3, 0.2]), gravity)
    assert axes @ axes.T == pytest.approx(np.eye(3))
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert axes @ gravity == pytest.approx([0.0, 0.0, -np.hypot(0.5, 9.7)], abs=1e-12)
    assert axes[0] @ np.array([0.6, 0.3, 0.2]) > 0.0


def test_lines_of_a_sweep_follow_what_the_profile_corrects() -> None:
    """Of place and velocity, which are uncertain together; else two lines would seem apart."""
    walls, state = WallVelocity(), state_at(4.0, 0.1)
    covariance = 1e-10 * np.eye(eskf.ERRORS)
    step = np.zeros(eskf.ERRORS)
    step[eskf.VELOCITY], step[eskf.POSITION] = (0.1, 0.0, 0.0), (0.3, 0.0, 0.0)
    covariance += np.outer(step, step)
    lines = np.zeros(1, LINE)
    lines["stamp"], lines["place"] = int(state.stamp) + 50_000_000, (6.0, 1.2, 1.0)
    lines["sigma"] = 0.005
    spots = passed(1, DOORS, 0.1, seconds=4.0)
    before = lines.copy(), spots.copy()
    after, covariance = walls.update(state, covariance, spots, lines, AXES)
    change = after.position[0] - state.position[0]
    assert abs(after.velocity[0] - SPEED) < 0.07
    assert change == pytest.approx(3.0 * (after.velocity[0] - state.velocity[0]))
    for kept, given in ((walls._lines._kept, before[0]), (walls._profile._kept, before[1])):
        moved = given["place"] + correction_of_passed(state, after, given["stamp"])
        assert kept["place"] == pytest.approx(moved)
    assert (lines == before[0]).all()


def line_at(seconds: float, along: float, across: float) -> Lines:
    found = np.zeros(1, LINE)
    found["stamp"] = int(state_at(seconds).stamp)
    found["place"], found["sigma"] = (along, across, 1.0), 0.003
    return found


def test_what_was_kept_follows_both_corrections() -> None:
    """Two reveals, seen three times, correct the velocity once more after the profile."""
    walls, error = WallVelocity(), 0.1
    covariance = 1e-10 * np.eye(eskf.ERRORS)
    covariance[6, 6] = 0.1**2
    for seconds in (2.5, 3.0, 3.5):
        state = state_at(seconds, error)
        moved = error * seconds
        pair = [line_at(seconds, at + moved, 1.2 + 0.03 * seconds) for at in (6.0, 8.0)]
        lines = np.concatenate(pair)
        spots = np.zeros(0, SPOT)
        if seconds == 3.5:
            spots = passed(1, DOORS, error, seconds=3.5)
            kept = walls._lines._kept.copy()
            after, covariance = walls.update(state, covariance, spots, lines, AXES)
        else:
            walls._lines.update(state, 1e-10 * np.eye(eskf.ERRORS), lines, AXES)
    profiled, _ = WallProfile().update(state, 1e-2 * np.diag(np.eye(18)[6]), spots, AXES)
    assert abs(after.velocity[0] - profiled.velocity[0]) > 0.005
    assert abs(after.velocity[0] - SPEED) < 0.01
    for now, given in ((walls._lines._kept, np.concatenate([kept, lines])),
                       (walls._profile._kept, spots)):  # fmt: skip
        moved_to = given["place"] + correction_of_passed(state, after, given["stamp"])
        assert now["place"] == pytest.approx(moved_to, abs=1e-6)


def test_a_correction_moves_both() -> None:
    walls, state = WallVelocity(), state_at(4.0)
    covariance = 1e-10 * np.eye(eskf.ERRORS)
    spots, lines = passed(1, DOORS, 0.0), line_at(4.0, 6.0, 1.2)
    walls.update(state, covariance, spots, lines, AXES)
    change = np.zeros(eskf.ERRORS)
    change[eskf.POSITION] = 0.3, 0.2, 0.1
    walls.correct(state, state.boxplus(change))
    for now, given in ((walls._lines._kept, lines), (walls._profile._kept, spots)):
        assert now["place"] == pytest.approx(given["place"] + (0.3, 0.0, 0.0))


def test_clearing_forgets_both() -> None:
    walls, state = WallVelocity(), state_at(4.0)
    lines = np.zeros(1, LINE)
    lines["stamp"] = state.stamp
    walls.update(state, np.eye(eskf.ERRORS), passed(1, DOORS, 0.0), lines, AXES)
    assert len(walls._lines._kept) == 1
    assert len(walls._profile._kept) > 100
    walls.clear()
    assert len(walls._lines._kept) == len(walls._profile._kept) == 0


def test_a_sweep_without_anything_changes_nothing() -> None:
    walls, state, covariance = WallVelocity(), state_at(4.0), np.eye(eskf.ERRORS)
    for second in range(3):
        state = state_at(4.0 + second)
        nothing = np.zeros(0, SPOT), np.zeros(0, LINE)
        after, posterior = walls.update(state, covariance, *nothing, AXES)
        assert after is state
        assert posterior is covariance
