"""Vertical lines: which points are one, which lines are a reveal, and what velocity they tell."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from l2lidar_node.types import F64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.odometry.local_map.surfel_map import SurfelMap
from l2lidar_proc.odometry.walls.vertical_lines import (
    LINE,
    Lines,
    VerticalLines,
    extract_lines,
)
from l2lidar_proc.odometry.walls.wall_velocity import level_axes

DOWN = np.array([0.0, 0.0, -9.8])
AXES = np.eye(3)
NOISE = 0.005  # [m] of the place of a line


def at(seconds: float, place: F64 | None = None, velocity: F64 | None = None) -> InertialState:
    zero = np.zeros(3)
    return InertialState(
        HostNs(round(seconds * 1e9)),
        np.eye(3),
        zero if place is None else place,
        zero if velocity is None else velocity,
        zero,
        zero,
        DOWN,
    )


def known(speed: float) -> F64:
    """Return a covariance of which the velocity along x is known to a standard deviation."""
    covariance = 1e-8 * np.eye(eskf.ERRORS)
    covariance[6, 6] = speed**2
    return covariance


def line(seconds: float, along: float, across: float) -> Lines:
    found = np.zeros(1, LINE)
    found["stamp"] = round(seconds * 1e9)
    found["place"] = along, across, 1.0
    found["sigma"] = NOISE
    return found


def seen(
    rng: np.random.Generator,
    times: F64,
    error: float,
    *,
    relief: float = 0.05,
    sigma: float = 0.3,
    wrong: int | None = None,
) -> tuple[InertialState, F64]:
    """Return what is known of the velocity after a reveal at x = 3 was seen at some times.

    The velocity is wrong by ``error`` from the beginning, so the reveal seems to move with it.
    The line of number ``wrong`` is 6 cm off.
    """
    lines, state, covariance = VerticalLines(), at(0.0), known(sigma)
    state = dataclasses.replace(state, velocity=np.array([error, 0.0, 0.0]))
    for number, time in enumerate(times.tolist()):
        passed = time - int(state.stamp) * 1e-9
        state = dataclasses.replace(
            state,
            stamp=HostNs(round(time * 1e9)),
            position=state.position + passed * state.velocity,
        )
        step = np.eye(eskf.ERRORS)
        step[eskf.POSITION, eskf.VELOCITY] = passed * np.eye(3)
        covariance = step @ covariance @ step.T
        depth = 1.0 + relief * (number % 3) / 2.0
        off = NOISE * rng.standard_normal() + 0.06 * (number == wrong)
        found = line(time, 3.0 + state.position[0] + off, depth)
        state, covariance = lines.update(state, covariance, found, AXES)
    return state, covariance


TIMES = 0.23 * np.arange(5.0)


# ---- extraction


def face(
    rng: np.random.Generator, x: float, y: tuple[float, float], count: int, height: float = 1.2
) -> F64:
    """Return points of a narrow face across x, 5 mm of noise."""
    points = rng.uniform((x, y[0], 0.3), (x, y[1], 0.3 + height), (count, 3))
    points[:, 0] += 0.005 * rng.standard_normal(count)
    return points


def extracted(points: F64, is_wall: NDArray[np.bool_] | None = None, axes: F64 = AXES) -> Lines:
    stamps = np.arange(len(points)) * 1000
    flags = np.zeros(len(points), np.bool_) if is_wall is None else is_wall
    return extract_lines(points, stamps, flags, axes)


def test_a_reveal_is_one_line_at_its_place() -> None:
    rng = np.random.default_rng(1)
    points = face(rng, 3.0, (1.0, 1.03), 40)
    found = extracted(points)
    assert len(found) == 1
    assert abs(found["place"][0, 0] - 3.0) < 3.0 * found["sigma"][0]
    assert found["place"][0] == pytest.approx(points.mean(axis=0), abs=0.01)
    assert abs(found["stamp"][0] - 19_500) < 2000
    assert tuning.LINE_NOISE[1] < found["sigma"][0] < 0.006


def test_its_sigma_is_that_of_the_place() -> None:
    rng = np.random.default_rng(2)
    off = []
    for _ in range(300):
        points = face(rng, 3.0, (1.0, 1.02), 25)
        points[:, 0] += 0.003 * rng.standard_normal(len(points)) + 0.004 * rng.standard_normal()
        found = extracted(points)
        off.append((found["place"][0, 0] - 3.0) / found["sigma"][0])
    assert 0.75 < np.std(off) < 1.2


@pytest.mark.parametrize(
    ("count", "height", "spread", "lines"),
    [
        (11, 1.2, 0.005, 0),  # too few points
        (12, 1.2, 0.005, 1),
        (40, 0.8, 0.005, 0),  # too short
        (40, 1.0, 0.005, 1),
        (40, 1.2, 0.0125, 1),
        (40, 1.2, 0.0148, 0),  # too wide
    ],
)
def test_a_line_is_long_and_narrow(count: int, height: float, spread: float, lines: int) -> None:
    points = np.zeros((count, 3))
    points[:, 0] = spread / np.sqrt(2.0) * np.resize([-2.0, -1.0, 0.0, 1.0, 2.0], count)
    points[:, 2] = np.linspace(0.0, height, count)
    assert len(extracted(points)) == lines


def test_a_line_is_where_most_of_its_points_are() -> None:
    """Not around the point from which all are within reach, which would be too wide."""
    points = np.zeros((38, 3))
    points[:, 0] = np.repeat([0.0, 0.025, 0.05], (20, 9, 9))
    points[:, 2] = np.resize(np.linspace(0.0, 1.0, 7), 38)
    found = extracted(points)
    assert found["place"][0, 0] == pytest.approx(0.025 * 9 / 29)


def test_two_reveals_and_a_turned_corridor() -> None:
    rng = np.random.default_rng(3)
    axes = level_axes(np.array([1.0, 1.0, 0.1]), DOWN)
    points = np.vstack((face(rng, 3.0, (1.0, 1.03), 40), face(rng, 4.0, (-1.0, -0.97), 30)))
    found = extracted(points @ axes, axes=axes)
    assert len(found) == 2
    assert found["place"] @ axes[0] == pytest.approx([3.0, 4.0], abs=0.005)


def test_points_of_walls_are_left_out_and_doubted_beside() -> None:
    rng = np.random.default_rng(4)
    reveal, wall = face(rng, 3.0, (1.0, 1.02), 20), face(rng, 3.0, (0.995, 1.0), 21)
    points = np.vstack((reveal, wall))
    on_wall = np.arange(len(points)) >= len(reveal)
    assert not len(extracted(points, on_wall))
    found = extracted(points[:-2], on_wall[:-2])
    assert found["place"] == pytest.approx(reveal.mean(axis=0)[None])
    assert not len(extracted(points, np.ones(len(points), np.bool_)))
    assert not len(extracted(points[:0]))


def test_the_number_of_lines_is_bounded() -> None:
    rng = np.random.default_rng(5)
    many = [face(rng, 0.2 * k, (1.0, 1.02), 13 + k % 2) for k in range(80)]
    assert len(extracted(np.vstack(many))) == tuning.LINE_MOST


def test_walls_are_thin_surfaces_along_a_direction() -> None:
    rng = np.random.default_rng(6)

    def wall(noise: float, y: float) -> F64:
        points = rng.uniform((-2.0, y, 0.0), (2.0, y, 2.0), (6000, 3))
        return np.asarray(points + (0.0, noise, 0.0) * rng.standard_normal(points.shape))

    across = rng.uniform((5.0, -1.0, 0.0), (5.0, 1.0, 2.0), (3000, 3))
    surfaces = SurfelMap((0.15, 0.3, 0.6))
    surfaces.add(np.vstack((wall(0.008, 1.02), wall(0.022, -1.02), across)))
    probes = np.array(
        [
            [0.2, 1.03, 1.0],  # on the wall
            [0.2, 1.07, 1.0],  # behind it
            [0.2, -1.02, 1.0],  # on one that is too thick
            [5.0, 0.2, 1.0],  # on one across
            [0.2, 3.0, 1.0],  # where nothing is known
        ]
    )
    along = surfaces.are_along(probes, np.array([1.0, 0.0, 0.0]))
    assert along.tolist() == [True, False, False, False, False]


# ---- comparison


def test_several_sweeps_that_see_a_reveal_measure_the_velocity() -> None:
    state, covariance = seen(np.random.default_rng(7), TIMES, 0.1)
    assert abs(state.velocity[0]) < 0.03
    assert 0.002 < np.sqrt(covariance[6, 6]) < 0.02
    # the place was wrong by what the velocity has moved it
    assert abs(state.position[0]) < 0.03
    assert np.abs(state.velocity[1:]).max() < 1e-3


def test_the_covariance_tells_the_error() -> None:
    rng = np.random.default_rng(8)
    squares = []
    for _ in range(300):
        state, covariance = seen(rng, TIMES, 0.05 * rng.standard_normal(), sigma=0.05)
        squares.append(state.velocity[0] ** 2 / covariance[6, 6])
    # lines are used with each that follows, and the wander that is allowed for is not in these
    assert 0.7 < np.mean(squares) < 1.35


def test_half_a_second_tells_less_than_one() -> None:
    rng = np.random.default_rng(9)
    long, short = (seen(rng, TIMES[:4] * scale, 0.0, sigma=0.05)[1] for scale in (1.0, 0.5))
    assert short[6, 6] > 1.5 * long[6, 6]


def test_three_sweeps_are_needed() -> None:
    rng = np.random.default_rng(10)
    for sigma in (0.05, 0.3):
        assert seen(rng, TIMES[:2], 0.0, sigma=sigma)[1][6, 6] == pytest.approx(sigma**2)
        assert seen(rng, TIMES[:3], 0.0, sigma=sigma)[1][6, 6] < 0.2 * sigma**2


def test_lines_at_one_depth_tell_nothing() -> None:
    state, _ = seen(np.random.default_rng(11), TIMES, 0.1, relief=0.01)
    assert state.velocity[0] == pytest.approx(0.1)


def taken(*sweeps: Lines, sigma: float = 0.1) -> F64:
    """Return the velocity that is known after sweeps with some lines each."""
    lines, state, covariance = VerticalLines(), at(0.0), known(sigma)
    for found in sweeps:
        state = at(float(found["stamp"].max()) * 1e-9, velocity=state.velocity)
        state, covariance = lines.update(state, covariance, found, AXES)
    return state.velocity


def both(*some: Lines) -> Lines:
    return np.concatenate(some)


FIRST, SECOND, THIRD = line(1.0, 3.0, 1.0), line(1.3, 3.01, 1.03), line(1.6, 3.02, 1.05)


def test_three_lines_of_a_reveal_move_the_velocity() -> None:
    assert taken(FIRST, SECOND, THIRD)[0] == pytest.approx(-0.03, abs=0.01)


@pytest.mark.parametrize(
    "third",
    [
        line(1.6, 3.2, 1.05),  # farther along than the velocity allows
        line(1.6, 3.02, 1.2),  # deeper than a reveal
        line(7.2, 3.2, 1.05),  # after the first is forgotten
    ],
)
def test_lines_that_are_not_one_reveal_are_not_compared(third: Lines) -> None:
    assert not taken(FIRST, SECOND, third).any()


@pytest.mark.parametrize(
    "other", [line(0.9, 3.3, 1.06), line(0.9, 3.7, 1.005), line(0.9, 3.0, 1.005)]
)
def test_other_lines_do_no_harm(other: Lines) -> None:
    assert taken(other, FIRST, SECOND, THIRD)[0] < -0.01


def test_lines_of_one_turn_are_not_compared() -> None:
    soon = line(1.38, 3.01 + 0.08 / 30.0, 1.05)
    assert not taken(FIRST, SECOND, soon, sigma=0.3).any()


def test_two_reveals_have_two_votes_two_lines_of_one_have_one() -> None:
    away = np.array([1.0, 0.0, 0.0])
    doors = []
    for one in (FIRST, SECOND):
        other = one.copy()
        other["place"] += away
        doors.append(both(one, other))
    assert taken(*doors)[0] == pytest.approx(-1.0 / 30.0, abs=0.006)
    beside = SECOND.copy()
    beside["place"] += 0.002 * away + (0.0, 0.02, 0.0)
    assert not taken(FIRST, both(SECOND, beside)).any()
    earlier = FIRST.copy()
    earlier["place"] += 0.002 * away
    assert not taken(both(FIRST, earlier), SECOND).any()


def test_two_velocities_with_as_many_votes_leave_it_open() -> None:
    """A reveal that came nearer, or another one that went away."""
    nearer = [line(1.0, 3.0, 1.0), line(1.23, 3.023, 1.03)]
    away = [line(1.0, 3.092, 1.05), line(1.23, 3.069, 1.08)]
    now = line(1.46, 3.046, 1.1)
    assert taken(*nearer, now, sigma=0.3)[0] < -0.07
    assert taken(*away, now, sigma=0.3)[0] > 0.07
    undecided = [both(*pair) for pair in zip(nearer, away, strict=True)]
    assert not taken(*undecided, now, sigma=0.3).any()


@pytest.mark.parametrize("sigma", [0.02, 0.1, 0.3])
def test_lines_at_random_move_the_velocity_in_few_sweeps(sigma: float) -> None:
    rng = np.random.default_rng(17)
    moved = 0
    for _ in range(100):
        lines = VerticalLines()
        for number in range(8):
            before = at(0.23 * (number + 1))
            places = rng.uniform((0.0, 1.0), (8.0, 1.1), (3, 2)).tolist()
            found = both(*(line(0.23 * (number + 1), *place) for place in places))
            moved += lines.update(before, known(sigma), found, AXES)[0] is not before
    assert moved < 0.06 * 800


def test_a_few_votes_are_believed_by_how_often_they_are_right() -> None:
    """Two lines that agree with a third by chance say as much as those of a reveal."""
    shares, sigmas = [], (0.1, 0.3, 1.0)
    for sigma in sigmas:
        lines, state, covariance = VerticalLines(), at(0.0), known(sigma)
        for found in (FIRST, SECOND, THIRD):
            now = at(float(found["stamp"].max()) * 1e-9, velocity=state.velocity)
            state, covariance = lines.update(now, covariance, found, AXES)
        shares.append(np.sqrt(covariance[6, 6]) / sigma)
        # the mean of both cases: it is the reveal, or it is not
        right = eskf.association_probability(-1.0 / 30.0, sigma**2, tuning.LINE_TRUE)
        assert state.velocity[0] == pytest.approx(-right / 30.0, abs=0.012)
        assert covariance[6, 6] > 0.9 * (1.0 - right) * sigma**2
    assert shares[2] > shares[1] > 0.25
    # with more of them, chance is ruled out
    _, sure = seen(np.random.default_rng(7), TIMES, 0.05, sigma=0.3)
    assert np.sqrt(sure[6, 6]) < 0.1 * 0.3


def test_a_line_is_compared_once() -> None:
    lines, state, covariance = VerticalLines(), at(0.0), known(0.05)
    for one in (FIRST, SECOND, THIRD):
        now = at(float(one["stamp"][0]) * 1e-9)
        state, covariance = lines.update(now, covariance, one, AXES)
    again, same = lines.update(state, covariance, np.zeros(0, LINE), AXES)
    assert again is state
    assert same is covariance
    far = line(1.9, 9.0, 1.0)  # another one does not bring it back either
    assert lines.update(state, covariance, far, AXES)[0] is state


def test_an_outlier_is_left_out() -> None:
    for wrong in range(5):
        times = 0.23 * np.arange(6.0)
        state, covariance = seen(np.random.default_rng(18), times, 0.1, sigma=0.1, wrong=wrong)
        assert abs(state.velocity[0]) < 0.03
        assert covariance[6, 6] < 0.03**2


def test_the_error_of_the_velocity_wanders_meanwhile() -> None:
    lines, covariance = VerticalLines(), known(0.05)
    for seconds in (1.0, 4.6, 5.0):
        lines.update(at(seconds), covariance, line(seconds, 3.0, 1.0), AXES)
    state = at(5.0)
    short, long = (lines._comparison(2, np.array([k]), state, AXES[0])[2] for k in (1, 0))
    assert short == pytest.approx(2.0 * NOISE**2, rel=0.1)
    # a velocity with white noise of its derivative: density^2 t^3 / 3
    assert long - 2.0 * NOISE**2 == pytest.approx(tuning.LINE_WANDER**2 * 4.0**3 / 3.0)


def test_only_the_difference_of_two_lines_counts() -> None:
    """So the derivative by the place is none, and those by all else are those of the places."""
    lines, covariance = VerticalLines(), known(0.05)
    for one in (FIRST, SECOND):
        lines.update(at(1.3), covariance, one, AXES)
    rng = np.random.default_rng(13)
    state, along = at(2.0), np.array([0.8, 0.6, 0.0])
    lines.along = along
    residual, h, _ = lines._comparison(1, np.array([0]), state, along)
    assert not h[eskf.POSITION].any()
    for block in (eskf.POSITION, eskf.VELOCITY, eskf.ACCEL_BIAS, eskf.GRAVITY):
        error = np.zeros(eskf.ERRORS)
        error[block] = 1e-3 * rng.standard_normal(3)
        moved = state.boxplus(error)
        lines.correct(state, moved)
        changed = lines._comparison(1, np.array([0]), moved, along)[0]
        lines.correct(moved, state)
        assert changed - residual == pytest.approx(float(h @ error), abs=1e-12)
    assert np.abs(h[eskf.GRAVITY]).max() > 0.1


def test_lines_follow_what_the_state_has_passed() -> None:
    """Against the motion itself: where the state says it was when the line was seen, along x."""
    rng = np.random.default_rng(14)
    lines = VerticalLines()
    lines.update(at(1.0), known(0.05), line(1.0, 3.0, 1.0), AXES)
    before = at(1.8, velocity=np.array([1.0, 0.2, 0.0]))
    error = np.zeros(eskf.ERRORS)
    for block in (eskf.POSITION, eskf.VELOCITY, eskf.ACCEL_BIAS, eskf.GRAVITY):
        error[block] = 0.01 * rng.standard_normal(3)
    after = before.boxplus(error)

    def place_at_line(state: InertialState) -> F64:
        tau = 0.8
        force = state.gravity - state.rotation @ state.accel_bias
        return np.asarray(state.position - tau * state.velocity + 0.5 * tau * tau * force)

    moved = place_at_line(after) - place_at_line(before)
    lines.correct(before, after)
    assert lines._kept["place"][0] == pytest.approx([3.0 + moved[0], 1.0, 1.0])


def test_lines_of_an_hour_take_no_memory() -> None:
    lines = VerticalLines()
    for number in range(60):
        many = np.concatenate([line(0.1 * number, 0.7 * k, 1.0) for k in range(40)])
        lines.update(at(0.1 * number), known(0.01), many, AXES)
    assert len(lines._kept) <= tuning.LINE_KEPT + 40
    lines.update(at(100.0), known(0.01), np.zeros(0, LINE), AXES)
    assert len(lines._kept) == 0
    lines.update(at(100.0), known(0.01), FIRST, AXES)
    lines.clear()
    assert len(lines._kept) == 0


def test_a_colonnade_has_hundreds_of_votes() -> None:
    """Ten columns at eight turns a second, as a spinning lidar sees them."""
    rng = np.random.default_rng(23)
    lines = VerticalLines()
    for number in range(60):
        depths = 1.0 + 0.02 * rng.random(10)
        many = np.concatenate(
            [line(0.12 * number, 3.0 + k, depth) for k, depth in enumerate(depths.tolist())]
        )
        state, covariance = lines.update(at(0.12 * number), known(0.1), many, AXES)
        assert np.isfinite(covariance).all()
    assert abs(state.velocity[0]) < 0.01
    assert np.sqrt(covariance[6, 6]) < 0.01


def test_crowded_lines_take_bounded_memory() -> None:
    """Every pair has a row and a column."""
    rng = np.random.default_rng(22)
    lines = VerticalLines()
    for number in range(10):
        places = rng.uniform((3.0, 1.0), (3.2, 1.1), (tuning.LINE_MOST, 2)).tolist()
        many = np.concatenate([line(0.1 * number, *place) for place in places])
        lines.update(at(0.1 * number), known(1.0), many, AXES)
    pairs = lines._pairs(len(lines._kept) - tuning.LINE_MOST, at(0.9), 1.0, AXES)
    assert tuning.LINE_PAIRS / 2 < len(pairs) <= tuning.LINE_PAIRS
