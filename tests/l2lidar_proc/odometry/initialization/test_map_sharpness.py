"""Maps of posts, walls and floors, placed with a wrong velocity or yaw rate, are not sharp."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_node.types import F64, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.odometry.initialization.map_sharpness import (
    motion_along_walls,
    velocity_log_likelihoods,
    wall_spots,
    yaw_rate_error,
)
from l2lidar_proc.odometry.initialization.posts_and_walls import upright
from l2lidar_proc.odometry.initialization.start_velocity import placed
from l2lidar_proc.odometry.walls.wall_profile import Spots
from tests.support.passed_walls import Opening, passed, state_at
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

NEAR_NICHES = (Opening(1.2, 2.0, 0.4, 0.45), Opening(4.5, 5.2, 0.4, 0.45))


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
    assert wall_spots(seen, X, GRAVITY) is None
    logs = velocity_log_likelihoods(seen, int(motion.state.stamp), X, errors, GRAVITY)
    assert errors_of(logs, errors)[0] == pytest.approx(-error, abs=0.11)


def test_both_level_directions_are_found_at_once(passing: list[Sweep]) -> None:
    wrong = SPEED + np.array([0.6, -0.4, 0.0])
    motion = motion_at(wrong, np.eye(eskf.ERRORS))
    axes = np.vstack((X, Y))
    seen = placed(passed_at(passing, wrong), motion, np.zeros(3), axes)
    errors = grid(10, 10)
    logs = velocity_log_likelihoods(seen, int(motion.state.stamp), axes, errors, GRAVITY)
    assert errors_of(logs, errors) == pytest.approx([-0.6, 0.4], abs=0.21)


def test_beside_bare_walls_nobody_can_tell() -> None:
    """There the sharpest map is that of a sensor at rest, as the rims of its view move along."""
    sweeps = seen_from(np.random.default_rng(2), bare_walls, SPEED * [1.0, 0.0, 0.0])
    wrong = np.array([0.1, 0.0, 0.0])
    motion = motion_at(wrong, np.eye(eskf.ERRORS))
    seen = placed(passed_at(sweeps, wrong), motion, np.zeros(3), X)
    walls = wall_spots(seen, X, GRAVITY)
    assert walls is not None
    prior = np.diag([0.7, 0.5]) ** 2
    assert motion_along_walls(walls, int(motion.state.stamp), np.eye(3), 1.1, prior) is None


START_S = 2.2
AGE_S = 0.5 * START_S


def sheared(seed: int, openings: tuple[Opening, ...], velocity: float, change: float) -> Spots:
    """Return spots as a sensor places them whose motion is off.

    By a velocity [m/s] in the middle of the time, and by an acceleration [m/s^2].
    """
    spots = passed(seed, openings, 0.0, seconds=START_S)
    age = 1e-9 * (int(state_at(START_S).stamp) - spots["stamp"])
    now = velocity + AGE_S * change
    spots["place"][:, 0] += now * age - 0.5 * change * age**2
    return spots


@pytest.mark.parametrize(("velocity", "change"), [(0.0, 0.0), (1.3, 1.1), (-0.4, -1.2)])
def test_walls_show_a_velocity_and_an_acceleration(velocity: float, change: float) -> None:
    """As of a carrier that speeds up while its first sweeps are taken for level."""
    now, prior = int(state_at(START_S).stamp), np.diag([0.8, 0.6]) ** 2
    squared = []
    for seed in range(6):
        walls = sheared(seed, NEAR_NICHES, velocity, change)
        found = motion_along_walls(walls, now, np.eye(3), AGE_S, prior)
        assert found is not None
        mean, covariance = found
        assert mean == pytest.approx([velocity, change], abs=0.5)
        covariance += np.diag([tuning.START_NOISE, tuning.START_ACCELERATION_NOISE]) ** 2
        error = mean - (velocity, change)
        squared.append(error @ np.linalg.solve(covariance, error))
    assert np.mean(squared) < 4.0  # 2 where the covariance is right


def test_an_acceleration_that_is_known_is_not_searched() -> None:
    now, prior = int(state_at(START_S).stamp), np.diag([0.8, 0.001]) ** 2
    found = motion_along_walls(sheared(1, NEAR_NICHES, 0.5, 0.0), now, np.eye(3), AGE_S, prior)
    assert found is not None
    assert found[0] == pytest.approx([0.5, 0.0], abs=0.12)
    assert np.sqrt(found[1][1, 1]) < 0.0011


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
