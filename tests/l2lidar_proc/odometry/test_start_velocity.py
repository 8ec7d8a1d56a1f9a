"""The velocity of a start in motion, of posts, walls and floors placed with a wrong one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from l2lidar_node import rotations
from l2lidar_node.types import F64, IMU_SAMPLE, POINT, HostNs, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.motion.sweep_motion import SweepMotion, predict_sweep
from l2lidar_proc.odometry.start_velocity import (
    SEEN,
    Passed,
    Seen,
    StartVelocity,
    doubted,
    level_span,
    log_likelihoods,
    placed,
    upright,
    yaw_rate_error,
)

EPOCH = 1_700_000_000_000_000_000  # [ns]
GRAVITY = np.array([0.0, 0.0, -9.81])
SWEEP_NS = 220_000_000
SWEEPS = 10
X, Y = np.eye(3)[:1], np.eye(3)[1:2]


def posts(rng: np.random.Generator, _: float) -> F64:
    """Return where posts stand all over the plan, (N, 2)."""
    plan = np.random.default_rng(7).uniform(-12.0, 12.0, (16, 2))
    return plan[np.linalg.norm(plan, axis=1) > 3.0]


def bare_walls(rng: np.random.Generator, along: float) -> F64:
    """Return where upright scan lines meet two bare walls beside a place along them, (N, 2)."""
    lines = along + rng.uniform(-6.0, 6.0, (30, 1))
    return np.vstack((np.insert(lines, 1, -1.2, axis=1), np.insert(lines, 1, 1.2, axis=1)))


def ground() -> F64:
    along, across = np.meshgrid(np.arange(-10.0, 10.0, 0.25), np.arange(-10.0, 10.0, 0.25))
    return np.column_stack((along.ravel(), across.ravel(), np.full(along.size, -1.0)))


def motion_at(velocity: F64, covariance: F64, yaw_rate: float = 0.0) -> SweepMotion:
    """Return the motion of a level sensor at constant speed, over all sweeps; it ends at zero.

    The gyro measures no turn; a bias of it makes the yaw rate [rad/s].
    """
    end = EPOCH + SWEEPS * SWEEP_NS
    samples = np.zeros(SWEEPS * 55 + 3, IMU_SAMPLE)
    samples["stamp"] = EPOCH - 4_000_000 + 4_000_000 * np.arange(len(samples))
    samples["linear_acceleration"] = -GRAVITY
    zero = np.zeros(3)
    heading = rotations.matrices(rotations.exp(np.array([0.0, 0.0, -2.2 * yaw_rate])))
    bias = np.array([0.0, 0.0, -yaw_rate])
    state = InertialState(HostNs(EPOCH), heading, -2.2 * velocity, velocity, bias, zero, GRAVITY)
    found = predict_sweep(
        state,
        covariance,
        samples,
        (HostNs(EPOCH), HostNs(end)),
        HostNs(end),
        noise=eskf.Noise(0.0, 0.0, 0.0, 0.0),
        gap_ns=20_000_000,
        steady_rate=zero,
        use_forces=True,
    )
    return dataclasses.replace(found, covariance=covariance)


def seen_from(
    rng: np.random.Generator, columns: Callable[[np.random.Generator, float], F64], speed: F64
) -> list[Sweep]:
    """Return what a sensor that passes the origin at the end sees, in its own axes.

    Each sweep has a line of points up each column, and the ground.
    """
    found = []
    heights = np.arange(-1.0, 2.0, 0.15)
    for number in range(SWEEPS):
        start = EPOCH + number * SWEEP_NS
        left = 1e-9 * (EPOCH + SWEEPS * SWEEP_NS - start)
        plan = columns(rng, -left * speed[0])
        upright_ones = np.column_stack((
            np.repeat(plan, len(heights), axis=0), np.tile(heights, len(plan))
        ))  # fmt: skip
        turned = np.repeat(rng.uniform(0.0, 0.21, len(plan)), len(heights))
        floor = ground()[rng.integers(0, len(ground()), 400)]
        times = np.concatenate((turned + rng.uniform(0.0, 0.005, len(turned)),
                                rng.uniform(0.0, 0.22, 400)))  # fmt: skip
        some = np.vstack((upright_ones, floor)) + (left - times)[:, None] * speed
        some += 0.01 * rng.standard_normal(some.shape)
        order = np.argsort(times)
        points = np.zeros(len(order), POINT)
        points["x"], points["y"], points["z"] = some[order].T
        points["time"] = times[order]
        found.append(Sweep(HostNs(start), HostNs(start + SWEEP_NS), points, 0, 0))
    return found


def passed_at(sweeps: list[Sweep], velocity: F64) -> list[Passed]:
    """Return sweeps with the places that a velocity gives them, zero at the end."""
    end = EPOCH + SWEEPS * SWEEP_NS
    middles = [HostNs((one.start + one.end) // 2) for one in sweeps]
    return [
        Passed(one, middle, -1e-9 * (end - middle) * velocity)
        for one, middle in zip(sweeps, middles, strict=True)
    ]


def errors_of(logs: F64 | None, errors: F64) -> F64:
    """Return the most likely error (K,)."""
    assert logs is not None
    return np.asarray(errors[int(np.argmax(logs))])


def grid(*axes: int) -> F64:
    """Return errors on a grid: for each axis, 2 m/s either way in so many steps."""
    lines = [np.linspace(-2.0, 2.0, 2 * count + 1) for count in axes]
    return np.array(np.meshgrid(*lines, indexing="ij")).reshape(len(axes), -1).T


SPEED = np.array([0.9, 0.2, 0.0])


@pytest.fixture(scope="module")
def passing() -> list[Sweep]:
    """Return sweeps among posts on a ground."""
    return seen_from(np.random.default_rng(1), posts, SPEED)


@pytest.mark.parametrize("error", [-1.2, -0.4, 0.0, 0.8])
def test_posts_are_sharpest_at_the_true_velocity(passing: list[Sweep], error: float) -> None:
    wrong = SPEED + np.array([error, 0.0, 0.0])
    motion = motion_at(wrong, np.eye(eskf.ERRORS))
    seen = placed(passed_at(passing, wrong), motion, np.zeros(3), X)
    errors = grid(20)
    logs = log_likelihoods(seen, int(motion.state.stamp), X, errors, GRAVITY)
    assert errors_of(logs, errors)[0] == pytest.approx(-error, abs=0.11)


def test_both_level_directions_are_found_at_once(passing: list[Sweep]) -> None:
    wrong = SPEED + np.array([0.6, -0.4, 0.0])
    motion = motion_at(wrong, np.eye(eskf.ERRORS))
    axes = np.vstack((X, Y))
    seen = placed(passed_at(passing, wrong), motion, np.zeros(3), axes)
    errors = grid(10, 10)
    logs = log_likelihoods(seen, int(motion.state.stamp), axes, errors, GRAVITY)
    assert errors_of(logs, errors) == pytest.approx([-0.6, 0.4], abs=0.21)


def test_what_sweeps_measured_across_counts(passing: list[Sweep]) -> None:
    """The IMU is wrong along and across; along the axis it counts, across it the sweeps do."""
    wrong = SPEED + np.array([0.5, 0.3, 0.0])
    motion = motion_at(wrong, np.eye(eskf.ERRORS))
    across_known = passed_at(passing, SPEED + np.array([0.5, 0.0, 0.0]))
    seen = placed(across_known, motion, np.zeros(3), X)
    age = 1e-9 * (int(motion.state.stamp) - seen["stamp"])
    true = np.vstack([
        np.column_stack([one.sweep.points[k].astype(float) for k in "xyz"]) for one in across_known
    ]) - age[:, None] * SPEED  # fmt: skip
    off = seen["place"] - true
    assert off[:, 0] == pytest.approx(-0.5 * age, abs=1e-4)
    middle = (age > 0.2) & (age < 2.0)  # beyond the references nothing was measured
    assert np.abs(off[middle, 1]).max() < 1e-4


def test_beside_bare_walls_nobody_can_tell() -> None:
    """There the sharpest map is that of a sensor at rest, as the rims of its view move along."""
    sweeps = seen_from(np.random.default_rng(2), bare_walls, SPEED * [1.0, 0.0, 0.0])
    wrong = np.array([0.1, 0.0, 0.0])
    motion = motion_at(wrong, np.eye(eskf.ERRORS))
    seen = placed(passed_at(sweeps, wrong), motion, np.zeros(3), X)
    now = int(motion.state.stamp)
    assert log_likelihoods(seen, now, X, grid(10), GRAVITY) is None


@pytest.mark.parametrize("axes", [X, np.vstack((X, Y))], ids=["along", "both ways"])
@pytest.mark.parametrize("yaw_rate", [0.07, -0.03, 0.0])
def test_posts_are_sharpest_at_the_true_yaw_rate(
    passing: list[Sweep], yaw_rate: float, axes: F64
) -> None:
    """Whatever the velocity."""
    for off in (-0.5, 0.7):
        wrong = SPEED + np.array([off, 0.0, 0.0])
        motion = motion_at(wrong, np.eye(eskf.ERRORS), yaw_rate)
        seen = placed(passed_at(passing, wrong), motion, np.zeros(3), axes)
        found = yaw_rate_error(seen, int(motion.state.stamp), axes, GRAVITY)
        if yaw_rate == 0.0:
            assert found is None
            continue
        assert found is not None
        error, sigma = found
        assert error == pytest.approx(-yaw_rate, abs=0.01)
        assert abs(error + yaw_rate) < 3.0 * sigma
        assert sigma < 0.01


def test_walls_and_few_points_show_no_yaw_rate(passing: list[Sweep]) -> None:
    turning = motion_at(SPEED, np.eye(eskf.ERRORS), 0.07)
    now = int(turning.state.stamp)
    seen = placed(passed_at(passing, SPEED), turning, np.zeros(3), X)
    assert yaw_rate_error(seen, now, X, GRAVITY) is not None
    some = upright(seen, GRAVITY)[:: len(upright(seen, GRAVITY)) // tuning.START_POSTS + 1]
    assert yaw_rate_error(some, now, X, GRAVITY) is None
    speed = SPEED * [1.0, 0.0, 0.0]
    walls = seen_from(np.random.default_rng(2), bare_walls, speed)
    beside = placed(passed_at(walls, speed), motion_at(speed, np.eye(eskf.ERRORS)), np.zeros(3), X)
    assert yaw_rate_error(beside, now, X, GRAVITY) is None


def seen_at(places: F64, seconds: F64 | float = 0.0, sweep: int = 0) -> Seen:
    found = np.zeros(len(places), SEEN)
    found["place"] = found["sight"] = places
    found["stamp"] = EPOCH + np.round(np.full(len(places), 1e9) * seconds).astype(np.int64)
    found["sweep"] = sweep
    return found


def column(x: float, count: int = 8) -> F64:
    return np.column_stack((np.full(count, x), np.zeros(count), 0.25 * np.arange(count)))


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


def test_axes_are_level_and_orthonormal() -> None:
    leaning = np.array([[0.9, 0.1, 0.3], [0.0, 0.05, 1.0]]).T
    axes = level_span(leaning, GRAVITY)
    assert axes @ axes.T == pytest.approx(np.eye(1))
    assert abs(axes[0, 2]) < 1e-12
    assert abs(axes[0] @ np.array([0.9, 0.1, 0.0])) == pytest.approx(np.hypot(0.9, 0.1))
    assert level_span(np.eye(3), GRAVITY).shape == (2, 3)
    assert level_span(np.zeros((3, 0)), GRAVITY).shape == (0, 3)


def test_doubt_leaves_what_is_fixed_as_it_is() -> None:
    known = 1e-6 * np.eye(eskf.ERRORS)
    for first, least in ((True, tuning.START_PRIOR), (False, tuning.START_LATER)):
        found = doubted(known, X, 1.1, first=first)
        assert np.sqrt(found[eskf.VELOCITY, eskf.VELOCITY][0, 0]) == pytest.approx(least, rel=0.01)
        assert found[7:9, 7:9] == pytest.approx(known[7:9, 7:9])
        assert np.linalg.eigvalsh(found)[0] > 0.0
        # the velocity and the place are off by what the acceleration was
        gravity = eskf.GRAVITY.start
        acceleration = tuning.START_ACCELERATION**2
        assert found[gravity, eskf.VELOCITY.start] == pytest.approx(1.1 * acceleration)
        assert found[gravity, eskf.POSITION.start] == pytest.approx(0.605 * acceleration)


def begun(sweeps: list[Sweep], velocity: F64, covariance: F64, open_axes: F64) -> StartVelocity:
    """Return the search of a start whose sweeps a velocity has placed."""
    start = StartVelocity(np.zeros(3))
    motion = motion_at(velocity, covariance)
    motions = [motion.anchored_at(one.stamp) for one in passed_at(sweeps, velocity)]
    start.begin(sweeps, motions, HostNs(EPOCH), open_axes)
    return start


def known_to(sigma: float) -> F64:
    """Return a covariance with a velocity along x that is known to so much [m/s]."""
    covariance = 1e-8 * np.eye(eskf.ERRORS)
    covariance[6, 6] = sigma**2
    return covariance


FREE = np.diag([1e-3, 1.0, 1.0])
"""Information about the place that leaves x free."""


@pytest.mark.parametrize("claimed", [0.01, 0.8])
def test_a_wrong_velocity_of_a_start_is_corrected_however_certain(
    passing: list[Sweep], claimed: float
) -> None:
    wrong, covariance = SPEED - np.array([0.7, 0.0, 0.0]), known_to(claimed)
    start = begun(passing, wrong, covariance, X)
    end = passing[-1].end
    assert start.is_awaited
    assert not start.is_due(HostNs(end - 1))
    assert start.is_due(end)
    found = start.search(motion_at(wrong, covariance), FREE)
    assert found is not None
    assert found.is_news
    error = (found.state.velocity - SPEED)[0]
    sigma = np.sqrt(found.covariance[6, 6])
    assert abs(error) < 0.12
    assert abs(error) < 2.0 * sigma
    assert sigma < 0.3
    assert found.state.velocity[1:] == pytest.approx(SPEED[1:], abs=1e-6)
    assert np.linalg.eigvalsh(found.covariance)[0] > 0.0


@pytest.mark.parametrize("claimed", [0.002, 0.05])
def test_a_wrong_yaw_rate_of_a_start_is_corrected_however_certain(
    passing: list[Sweep], claimed: float
) -> None:
    covariance = known_to(0.5)
    covariance[eskf.GYRO_BIAS, eskf.GYRO_BIAS] = claimed**2 * np.eye(3)
    wrong = SPEED - np.array([0.7, 0.0, 0.0])
    start = begun(passing, wrong, covariance, X)
    found = start.search(motion_at(wrong, covariance, 0.07), FREE)
    assert found is not None
    assert found.is_news
    bias, sigma = found.state.gyro_bias[2], np.sqrt(found.covariance[11, 11])
    assert abs(bias) < 0.01
    assert abs(bias) < 3.0 * sigma
    assert sigma < 0.01
    assert found.state.velocity == pytest.approx(SPEED, abs=0.15)
    assert found.covariance[9, 9] == pytest.approx(claimed**2)
    assert np.linalg.eigvalsh(found.covariance)[0] > 0.0


def test_a_right_velocity_is_no_news(passing: list[Sweep]) -> None:
    covariance = known_to(0.05)
    found = begun(passing, SPEED, covariance, X).search(motion_at(SPEED, covariance), FREE)
    assert found is not None
    assert not found.is_news


def test_where_all_is_fixed_nothing_is_searched(passing: list[Sweep]) -> None:
    covariance = known_to(0.05)
    start = begun(passing, SPEED, covariance, np.zeros((0, 3)))
    assert not start.is_open
    assert start.search(motion_at(SPEED, covariance), np.eye(3)) is None


def test_later_a_change_that_is_too_large_misleads(passing: list[Sweep]) -> None:
    """Then the sweeps since have told more than the points."""
    covariance = known_to(0.02)
    for off, is_news in ((0.4, True), (1.1, False)):
        wrong = SPEED - np.array([off, 0.0, 0.0])
        start = begun(passing, wrong, covariance, np.zeros((0, 3)))
        start.is_first = False
        found = start.search(motion_at(wrong, covariance), FREE)
        assert found is None or found.is_news == is_news
        assert found is not None or not is_news


def test_searches_follow_each_other_and_end(passing: list[Sweep]) -> None:
    start = begun(passing, SPEED, known_to(1.0), X)
    end = passing[-1].end
    start.end_search(end)
    assert not start.is_first
    assert start.is_open
    assert not start.is_due(HostNs(end + tuning.START_PAUSE_NS - 1))
    assert start.is_due(HostNs(end + tuning.START_PAUSE_NS))
    # what the next one does not need is forgotten
    assert start.since >= end + tuning.START_PAUSE_NS - tuning.START_NS
    assert start.since == start.sweeps[0].start
    start.note_velocity(tuning.PRIOR_LEARN_SIGMA + 0.01)
    assert start.is_open
    start.note_velocity(tuning.PRIOR_LEARN_SIGMA - 0.01)
    start.note_velocity(1.0)
    assert not start.is_open
    start.end_search(HostNs(EPOCH + tuning.START_WATCHED_NS + 1))
    assert not start.sweeps
    assert not start.is_due(HostNs(EPOCH + 10 * tuning.START_WATCHED_NS))


def test_a_start_that_was_interrupted_is_forgotten(passing: list[Sweep]) -> None:
    """Covered for seconds, the sensor is not where the IMU has carried it; nor is memory spent."""
    start = begun(passing, SPEED, known_to(1.0), X)
    motion = motion_at(SPEED, known_to(1.0))
    for late, count in ((2 * tuning.START_NS, SWEEPS + 1), (2 * tuning.START_NS + 1, 0)):
        end = HostNs(EPOCH + late)
        start.note(dataclasses.replace(passing[-1], end=end), motion)
        assert len(start.sweeps) == count
    assert not start.is_open
    assert not start.is_due(HostNs(EPOCH + tuning.START_WATCHED_NS))
