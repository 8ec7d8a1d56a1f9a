"""Maps of posts, walls and floors, placed with a wrong velocity or yaw rate, are not sharp."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_node.types import F64, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.odometry.map_sharpness import (
    velocity_log_likelihoods,
    wall_spots,
    yaw_rate_error,
)
from l2lidar_proc.odometry.posts_and_walls import upright
from l2lidar_proc.odometry.start_velocity import placed
from tests.support.passing_sweeps import (
    GRAVITY,
    SPEED,
    X,
    Y,
    bare_walls,
    motion_at,
    passed_at,
    seen_from,
)


def errors_of(logs: F64 | None, errors: F64) -> F64:
    """Return the most likely error (K,)."""
    assert logs is not None
    return np.asarray(errors[int(np.argmax(logs))])


def grid(*axes: int) -> F64:
    """Return errors on a grid: for each axis, 2 m/s either way in so many steps."""
    lines = [np.linspace(-2.0, 2.0, 2 * count + 1) for count in axes]
    return np.array(np.meshgrid(*lines, indexing="ij")).reshape(len(axes), -1).T


@pytest.mark.parametrize("error", [-1.2, -0.4, 0.0, 0.8])
def test_posts_are_sharpest_at_the_true_velocity(passing: list[Sweep], error: float) -> None:
    wrong = SPEED + np.array([error, 0.0, 0.0])
    motion = motion_at(wrong, np.eye(eskf.ERRORS))
    seen = placed(passed_at(passing, wrong), motion, np.zeros(3), X)
    errors = grid(20)
    logs = velocity_log_likelihoods(
        seen, int(motion.state.stamp), X, errors, GRAVITY, wall_spots(seen, X, GRAVITY)
    )
    assert errors_of(logs, errors)[0] == pytest.approx(-error, abs=0.11)


def test_both_level_directions_are_found_at_once(passing: list[Sweep]) -> None:
    wrong = SPEED + np.array([0.6, -0.4, 0.0])
    motion = motion_at(wrong, np.eye(eskf.ERRORS))
    axes = np.vstack((X, Y))
    seen = placed(passed_at(passing, wrong), motion, np.zeros(3), axes)
    errors = grid(10, 10)
    logs = velocity_log_likelihoods(
        seen, int(motion.state.stamp), axes, errors, GRAVITY, wall_spots(seen, axes, GRAVITY)
    )
    assert errors_of(logs, errors) == pytest.approx([-0.6, 0.4], abs=0.21)


def test_beside_bare_walls_nobody_can_tell() -> None:
    """There the sharpest map is that of a sensor at rest, as the rims of its view move along."""
    sweeps = seen_from(np.random.default_rng(2), bare_walls, SPEED * [1.0, 0.0, 0.0])
    wrong = np.array([0.1, 0.0, 0.0])
    motion = motion_at(wrong, np.eye(eskf.ERRORS))
    seen = placed(passed_at(sweeps, wrong), motion, np.zeros(3), X)
    now = int(motion.state.stamp)
    assert (
        velocity_log_likelihoods(seen, now, X, grid(10), GRAVITY, wall_spots(seen, X, GRAVITY))
        is None
    )


@pytest.mark.parametrize("axes", [X, np.vstack((X, Y))], ids=["along", "both ways"])
@pytest.mark.parametrize("yaw_rate", [0.07, -0.03, 0.014, 0.0])
def test_posts_are_sharpest_at_the_true_yaw_rate(
    passing: list[Sweep], yaw_rate: float, axes: F64
) -> None:
    """Whatever the velocity."""
    for off in (-0.5, 0.7):
        wrong = SPEED + np.array([off, 0.0, 0.0])
        motion = motion_at(wrong, np.eye(eskf.ERRORS), yaw_rate)
        seen = placed(passed_at(passing, wrong), motion, np.zeros(3), axes)
        found = yaw_rate_error(seen, int(motion.state.stamp), axes, GRAVITY, wrong)
        if yaw_rate == 0.0:
            assert found is None
            continue
        assert found is not None
        error, sigma = found
        assert error == pytest.approx(-yaw_rate, abs=0.01)
        assert error == pytest.approx(-yaw_rate, rel=0.5)
        assert abs(error + yaw_rate) < 3.0 * sigma
        assert sigma < 0.01


def test_walls_and_few_points_show_no_yaw_rate(passing: list[Sweep]) -> None:
    turning = motion_at(SPEED, np.eye(eskf.ERRORS), 0.07)
    now = int(turning.state.stamp)
    seen = placed(passed_at(passing, SPEED), turning, np.zeros(3), X)
    assert yaw_rate_error(seen, now, X, GRAVITY, SPEED) is not None
    some = upright(seen, GRAVITY)[:: len(upright(seen, GRAVITY)) // tuning.START_POSTS + 1]
    assert yaw_rate_error(some, now, X, GRAVITY, SPEED) is None
    speed = SPEED * [1.0, 0.0, 0.0]
    walls = seen_from(np.random.default_rng(2), bare_walls, speed)
    beside = placed(passed_at(walls, speed), motion_at(speed, np.eye(eskf.ERRORS)), np.zeros(3), X)
    assert yaw_rate_error(beside, now, X, GRAVITY, SPEED) is None
