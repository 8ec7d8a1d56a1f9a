"""Upright things among points are divided into posts and walls, and counted in cells."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.odometry.initialization.map_sharpness import velocity_log_likelihoods
from l2lidar_proc.odometry.initialization.posts_and_walls import (
    SEEN,
    Seen,
    posts_and_walls,
    upright,
)
from tests.support.passing_sweeps import EPOCH, GRAVITY, SWEEP_NS, SWEEPS, X, Y, ground

NOW = EPOCH + SWEEPS * SWEEP_NS


def seen_at(places: F64, seconds: F64 | float = 0.0, sweep: int = 0) -> Seen:
    found = np.zeros(len(places), SEEN)
    found["place"] = found["sight"] = places
    found["stamp"] = EPOCH + np.round(np.full(len(places), 1e9) * seconds).astype(np.int64)
    found["sweep"] = sweep
    return found


def column(x: float, y: float = 0.0, count: int = 8) -> F64:
    return np.column_stack((np.full(count, x), np.full(count, y), 0.25 * np.arange(count)))


def test_only_upright_things_count() -> None:
    found = upright(np.concatenate((seen_at(ground()), seen_at(column(5.0)))), GRAVITY)
    assert found["place"][:, 0] == pytest.approx(np.full(8, 5.0))


def test_what_was_not_seen_at_once_is_not_upright() -> None:
    """Floor and ceiling, or what a wrong velocity puts on top of each other."""
    slow = seen_at(column(5.0), 0.06 * np.arange(8.0))
    assert not len(upright(slow, GRAVITY))
    assert len(upright(seen_at(column(5.0), 0.001 * np.arange(8.0)), GRAVITY)) == 8


def test_a_spot_counts_once_in_each_sweep_and_far_ones_do_not() -> None:
    twice = np.concatenate((seen_at(column(5.0)), seen_at(column(5.0) + 0.001)))
    assert len(upright(twice, GRAVITY)) == 8
    again = np.concatenate((seen_at(column(5.0)), seen_at(column(5.0), 0.2, sweep=1)))
    assert len(upright(again, GRAVITY)) == 16
    assert not len(upright(seen_at(column(tuning.START_RANGE + 1.0)), GRAVITY))
    assert not len(upright(seen_at(np.zeros((0, 3))), GRAVITY))


def seen_often(plan: F64, moving: F64 | None = None) -> Seen:
    """Return columns at places of the plan (N, 2), seen in each sweep, as if they moved [m/s]."""
    parts = []
    for number in range(SWEEPS):
        seconds = 1e-9 * SWEEP_NS * (number - SWEEPS)
        places = np.concatenate([column(*place) for place in plan.tolist()])
        places[:, :2] += 0.0 if moving is None else seconds * moving
        found = seen_at(places, seconds, number)
        found["stamp"] += NOW - EPOCH
        parts.append(found)
    return np.concatenate(parts)


def wall(start: F64, direction: float, step: float = 0.6, count: int = 12) -> F64:
    """Return where scan lines meet a wall from a place of the plan in a direction, (N, 2)."""
    way = np.array([np.cos(direction), np.sin(direction)])
    return start + step * np.arange(count)[:, None] * way


LEVEL = np.eye(3)
SOME_POSTS = np.array([[-6.0, 2.0], [4.0, 4.0], [1.0, -6.0]])


@pytest.mark.parametrize("direction", [0.0, 0.7, 1.6, -0.4])
def test_posts_and_walls_are_told_apart(direction: float) -> None:
    start = 9.0 * np.array([-np.sin(direction), np.cos(direction)])
    seen = np.concatenate((seen_often(SOME_POSTS), seen_often(wall(start, direction))))
    posts, found = posts_and_walls(seen, LEVEL)
    assert not posts.is_wall
    assert found.is_wall
    assert len(posts.points) == SWEEPS * 8 * len(SOME_POSTS)
    assert len(found.points) == SWEEPS * 8 * 12
    along = np.array([np.cos(direction), np.sin(direction), 0.0])
    assert abs(found.axes[0] @ along) == pytest.approx(1.0, abs=1e-4)
    np.testing.assert_allclose(found.axes @ found.axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found.axes[2], [0.0, 0.0, 1.0], atol=1e-12)


def test_each_direction_of_walls_is_one_of_its_own() -> None:
    plan = np.concatenate((wall(np.array([-3.0, 9.0]), 0.0), wall(np.array([9.0, -3.0]), 1.57)))
    walls = [one for one in posts_and_walls(seen_often(plan), LEVEL) if one.is_wall]
    assert sorted(len(one.points) for one in walls) == [SWEEPS * 8 * 12] * 2
    assert abs(walls[0].axes[0] @ walls[1].axes[0]) < 0.01


def test_posts_in_a_row_are_no_wall() -> None:
    """They are farther apart than the columns of points on a wall at that range."""
    row = np.column_stack((np.arange(-12.0, 13.0, 6.0), np.full(5, 8.0)))
    (posts,) = posts_and_walls(seen_often(row), LEVEL)
    assert not posts.is_wall
    assert len(posts.points) == SWEEPS * 8 * 5


def test_few_points_are_no_wall_and_none_are_nothing() -> None:
    one = seen_often(wall(np.array([-3.0, 9.0]), 0.0))
    few = one[one["sweep"] == 0][: 8 * 4]
    assert len(few) < tuning.START_WALL_POINTS
    assert not any(found.is_wall for found in posts_and_walls(few, LEVEL))
    assert posts_and_walls(one[:0], LEVEL) == []


@pytest.mark.parametrize("pace", [2.0, -1.4])
def test_what_scan_lines_meet_on_a_wall_does_not_pass_for_a_post(pace: float) -> None:
    """The pattern moves along the wall, and lies on itself at a wrong velocity."""
    pattern = wall(np.array([-10.0, 20.0]), 0.0, step=2.5, count=9)
    seen = np.concatenate((seen_often(SOME_POSTS), seen_often(pattern, np.array([pace, 0.0]))))
    errors = np.linspace(-3.0, 3.0, 61)[:, None]
    logs = velocity_log_likelihoods(seen, NOW, X, errors, GRAVITY)
    assert logs is not None
    assert errors[np.argmax(logs), 0] == pytest.approx(0.0, abs=0.11)


def test_a_wall_still_shows_the_velocity_towards_it() -> None:
    seen = seen_often(wall(np.array([-8.0, 12.0]), 0.0, step=1.2, count=14))
    errors = np.linspace(-2.0, 2.0, 41)[:, None]
    logs = velocity_log_likelihoods(seen, NOW, Y, errors, GRAVITY)
    assert logs is not None
    assert errors[np.argmax(logs), 0] == pytest.approx(0.0, abs=0.11)
    logs = velocity_log_likelihoods(seen, NOW, X, errors, GRAVITY)
    assert logs is not None
    assert np.ptp(logs) < 5.0  # along it, nothing does


@pytest.mark.parametrize("rate", [0.06, -0.04])
def test_cells_are_fewest_at_the_right_yaw_rate_and_a_wall_turns_with_it(rate: float) -> None:
    seen = seen_often(np.concatenate((SOME_POSTS, wall(np.array([-3.0, 9.0]), 0.3))))
    ages = (seen["stamp"] - NOW) * 1e-9
    cosines, sines = np.cos(rate * ages), np.sin(rate * ages)
    x, y = seen["place"][:, 0].copy(), seen["place"][:, 1].copy()
    seen["place"][:, 0], seen["place"][:, 1] = cosines * x - sines * y, sines * x + cosines * y
    seen["sight"] = seen["place"]
    rates = np.linspace(-0.1, 0.1, 21)
    for one in posts_and_walls(seen, LEVEL):
        counts = [one.occupied(NOW, np.zeros((1, 3)), (0.2, 0.1), each)[0] for each in rates]
        assert rates[np.argmin(counts)] == pytest.approx(-rate, abs=0.011)


def test_fewer_points_of_the_same_things() -> None:
    posts, found = posts_and_walls(
        seen_often(np.concatenate((SOME_POSTS, wall(np.array([-3.0, 9.0]), 0.3)))), LEVEL
    )
    for one in (posts, found):
        less = one.decimated(0.25)
        assert len(less.points) == pytest.approx(0.25 * len(one.points), abs=1)
        assert (less.axes == one.axes).all()
        assert less.is_wall == one.is_wall
    assert len(posts.decimated(0.0).points) == 1
