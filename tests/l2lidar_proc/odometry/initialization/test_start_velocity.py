"""The velocity of a start in motion, of sweeps placed with a wrong one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from l2lidar_node.types import F64, HostNs, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.initialization.start_velocity import (
    SearchPhase,
    StartVelocity,
    doubted,
    level_span,
    placed,
    with_level_gravity,
)
from l2lidar_proc.odometry.initialization.vertical_direction import Vertical
from l2lidar_proc.odometry.intrinsics.lidar_intrinsics import LidarIntrinsics
from tests.l2lidar_proc.odometry.odometry_world import recording
from tests.support.odometry_runs import sweeps
from tests.support.passing_sweeps import (
    EPOCH,
    GRAVITY,
    SPEED,
    SWEEPS,
    X,
    motion_at,
    passed_at,
    seen_from,
)


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


def test_axes_lie_in_what_is_free_as_level_as_they_can() -> None:
    """A corridor along a floor that leans against the level that the IMU believes in."""
    leaning = np.array([0.99, 0.0, 0.14]) / np.linalg.norm([0.99, 0.0, 0.14])
    for twice in (leaning[:, None], np.column_stack((leaning, leaning))):
        (axis,) = level_span(twice, GRAVITY)
        assert abs(axis @ leaning) == pytest.approx(1.0)
    # if the height is free as well, any direction of the plane may have been given
    across = np.array([-leaning[2], 0.0, leaning[0]])
    plane = np.column_stack((leaning + across, leaning - across)) / np.sqrt(2.0)
    (axis,) = level_span(plane, GRAVITY)
    assert abs(axis[0]) == pytest.approx(1.0)
    both = level_span(np.eye(3), GRAVITY)
    assert both.shape == (2, 3)
    assert both @ both.T == pytest.approx(np.eye(2))
    assert level_span(np.eye(3)[:, 2:], GRAVITY).shape == (0, 3)
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


def tilted_motion(degrees: float, sigma: float, growing_s: float = 1.1) -> SweepMotion:
    """Return a motion whose gravity is off by an angle about y, and its velocity accordingly.

    The sigma is that of gravity's level components [m/s^2].
    """
    covariance = 1e-6 * np.eye(eskf.ERRORS)
    covariance[15:17, 15:17] = sigma**2 * np.eye(2)
    motion = motion_at(SPEED, covariance)
    off = np.array([9.81 * np.sin(np.radians(degrees)), 0.0, 0.0])
    state = dataclasses.replace(
        motion.state, gravity=GRAVITY + off, velocity=SPEED + growing_s * off
    )
    return motion.with_state(state, covariance)


UP = np.array([0.0, 0.0, 1.0])
LEVEL = np.eye(3)[:2]


@pytest.mark.parametrize("degrees", [-4.0, 2.5])
def test_gravity_that_has_run_away_returns_to_the_vertical_of_the_place(degrees: float) -> None:
    """And so does the velocity that it has made meanwhile."""
    motion = tilted_motion(degrees, 0.05)
    found = with_level_gravity(motion, UP, 1.1, LEVEL)
    assert found is not motion
    gravity, sigmas = found.state.gravity, np.sqrt(np.diag(found.covariance))
    assert np.abs(gravity[:2]).max() < 0.1
    assert np.abs(gravity[:2] / sigmas[15:17]).max() < 2.0
    assert sigmas[15] == pytest.approx(tuning.START_LEVEL_SIGMA, rel=0.2)
    assert np.abs(found.state.velocity - SPEED).max() < 0.1
    assert np.abs((found.state.velocity - SPEED) / sigmas[6:9]).max() < 2.0
    assert np.linalg.eigvalsh(found.covariance)[0] > 0.0


def test_a_velocity_that_sweeps_have_fixed_is_kept_when_gravity_is_leveled() -> None:
    """It was right, and gravity had only made up for the speed that the map began without.

    By the velocity that 2.2 s of that gravity would have made, a start ran 3.7 m away.
    """
    motion = tilted_motion(2.5, 0.05, growing_s=0.0)
    fixed = with_level_gravity(motion, UP, 2.2, np.zeros((0, 3)))
    assert np.abs(fixed.state.gravity[:2]).max() < 0.1
    assert fixed.state.velocity == pytest.approx(SPEED, abs=1e-3)
    along_y = with_level_gravity(motion, UP, 2.2, LEVEL[1:])
    assert along_y.state.velocity == pytest.approx(SPEED, abs=1e-3)
    free = with_level_gravity(motion, UP, 2.2, LEVEL)
    assert abs(free.state.velocity[0] - SPEED[0]) > 0.5


def test_gravity_of_an_accelerated_start_is_put_to_the_vertical_of_the_place() -> None:
    """A carrier that set off at 1.2 m/s^2, which is within what such a start leaves open."""
    motion = tilted_motion(-7.0, 0.5, 2.2)
    found = with_level_gravity(motion, UP, 2.2, LEVEL)
    assert np.abs(found.state.gravity[:2]).max() < 0.1
    error = found.state.velocity - SPEED
    assert np.abs(error).max() < 0.5, "it was 2.6 m/s"
    assert np.abs(error / np.sqrt(np.diag(found.covariance)[6:9])).max() < 2.0


def test_gravity_within_its_sigma_is_left_alone() -> None:
    for degrees, sigma in ((0.5, 0.05), (-2.5, 0.2)):
        motion = tilted_motion(degrees, sigma)
        assert with_level_gravity(motion, UP, 1.1, LEVEL) is motion
    # down or up is the same axis
    motion = tilted_motion(4.0, 0.05)
    one, other = (with_level_gravity(motion, vertical, 1.1, LEVEL).state for vertical in (UP, -UP))
    assert other.gravity == pytest.approx(one.gravity)


def test_a_search_levels_gravity_by_a_certain_vertical(passing: list[Sweep]) -> None:
    for agreement, is_leveled in ((0.9, True), (0.7, False)):
        start = begun(passing, SPEED, known_to(0.05), np.zeros((0, 3)))
        motion = tilted_motion(4.0, 0.05)
        found = start.search(motion, np.eye(3), Vertical(UP, agreement))
        assert (found is not None) == is_leveled
        if found is not None:
            assert abs(found.state.gravity[0]) < 0.1


def begun(sweeps: list[Sweep], velocity: F64, covariance: F64, open_axes: F64) -> StartVelocity:
    """Return the search of a start whose sweeps a velocity has placed."""
    start = StartVelocity(np.zeros(3), LidarIntrinsics())
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
    found = start.search(motion_at(wrong, covariance), FREE, None)
    assert found is not None
    error = (found.state.velocity - SPEED)[0]
    sigma = np.sqrt(found.covariance[6, 6])
    assert abs(error) < 0.12
    assert abs(error) < 2.0 * sigma
    assert sigma < 0.3
    assert found.state.velocity[1:] == pytest.approx(SPEED[1:], abs=1e-6)
    assert np.linalg.eigvalsh(found.covariance)[0] > 0.0


def test_what_was_open_at_the_start_is_searched_although_it_seems_fixed(
    passing: list[Sweep],
) -> None:
    wrong, covariance = SPEED - np.array([0.7, 0.0, 0.0]), known_to(0.8)
    found = begun(passing, wrong, covariance, X).search(
        motion_at(wrong, covariance), np.eye(3), None
    )
    assert found is not None
    assert found.state.velocity == pytest.approx(SPEED, abs=0.15)


@pytest.mark.parametrize("claimed", [0.002, 0.05])
def test_a_wrong_yaw_rate_of_a_start_is_corrected_however_certain(
    passing: list[Sweep], claimed: float
) -> None:
    covariance = known_to(0.5)
    covariance[eskf.GYRO_BIAS, eskf.GYRO_BIAS] = claimed**2 * np.eye(3)
    wrong = SPEED - np.array([0.7, 0.0, 0.0])
    start = begun(passing, wrong, covariance, X)
    found = start.search(motion_at(wrong, covariance, 0.07), FREE, None)
    assert found is not None
    bias, sigma = found.state.gyro_bias[2], np.sqrt(found.covariance[11, 11])
    assert abs(bias) < 0.01
    assert abs(bias) < 3.0 * sigma
    assert sigma < 0.01
    assert found.state.velocity == pytest.approx(SPEED, abs=0.15)
    assert found.covariance[9, 9] == pytest.approx(claimed**2)
    assert np.linalg.eigvalsh(found.covariance)[0] > 0.0


def test_a_right_velocity_is_no_news(passing: list[Sweep]) -> None:
    covariance = known_to(0.05)
    found = begun(passing, SPEED, covariance, X).search(motion_at(SPEED, covariance), FREE, None)
    assert found is None


def test_where_all_is_fixed_nothing_is_searched(passing: list[Sweep]) -> None:
    covariance = known_to(0.05)
    start = begun(passing, SPEED, covariance, np.zeros((0, 3)))
    assert not start.is_open
    assert start.search(motion_at(SPEED, covariance), np.eye(3), None) is None


def test_later_a_change_that_is_too_large_misleads(passing: list[Sweep]) -> None:
    """Then the sweeps since have told more than the points."""
    covariance = known_to(0.02)
    for off, is_news in ((0.4, True), (1.1, False)):
        wrong = SPEED - np.array([off, 0.0, 0.0])
        start = begun(passing, wrong, covariance, np.zeros((0, 3)))
        start.phase = SearchPhase.FOLLOWING
        found = start.search(motion_at(wrong, covariance), FREE, None)
        assert (found is not None) == is_news


def test_searches_follow_each_other_and_end(passing: list[Sweep]) -> None:
    start = begun(passing, SPEED, known_to(1.0), X)
    end = passing[-1].end
    assert start.search(motion_at(SPEED, known_to(1.0)), FREE, None) is not None
    start.end_search(end)
    assert start.phase is SearchPhase.FOLLOWING
    assert start.is_open
    assert not start.is_due(HostNs(end + tuning.START_PAUSE_NS - 1))
    assert start.is_due(HostNs(end + tuning.START_PAUSE_NS))
    # what the next one does not need is forgotten
    assert start.since >= end + tuning.START_PAUSE_NS - tuning.START_NS
    assert start.since == start.sweeps()[0].start
    start.note_velocity((tuning.PRIOR_LEARN_SIGMA + 0.01) ** 2 * np.eye(3))
    assert start.is_open
    start.note_velocity((tuning.PRIOR_LEARN_SIGMA - 0.01) ** 2 * np.eye(3))
    start.note_velocity(np.eye(3))
    assert not start.is_open
    start.end_search(HostNs(EPOCH + tuning.START_WATCHED_NS + 1))
    assert not len(start)
    assert not start.is_due(HostNs(EPOCH + 10 * tuning.START_WATCHED_NS))


def test_a_start_that_was_interrupted_is_forgotten(passing: list[Sweep]) -> None:
    """Covered for seconds, the sensor is not where the IMU has carried it; nor is memory spent."""
    start = begun(passing, SPEED, known_to(1.0), X)
    motion = motion_at(SPEED, known_to(1.0))
    for late, count in ((2 * tuning.START_NS, SWEEPS + 1), (2 * tuning.START_NS + 1, 0)):
        end = HostNs(EPOCH + late)
        start.note(dataclasses.replace(passing[-1], end=end), motion)
        assert len(start) == len(start.sweeps()) == count
    assert not start.is_open
    assert not start.is_due(HostNs(EPOCH + tuning.START_WATCHED_NS))


def with_wrong_beginning(
    sweeps: list[Sweep], noise: float, velocity: F64 = 0.5 * SPEED, sigma: float = 0.05
) -> StartVelocity:
    """Return a start with a velocity, whose later poses are right but for noise [m]."""
    covariance = known_to(sigma)
    covariance[eskf.VELOCITY, eskf.VELOCITY] = sigma**2 * np.eye(3)
    start = begun(sweeps, velocity, covariance, np.zeros((0, 3)))
    true = motion_at(SPEED, known_to(0.05))
    rng = np.random.default_rng(3)
    motions = [true.anchored_at(one.stamp) for one in passed_at(sweeps, SPEED)]
    for number, motion in enumerate(motions):
        state, off = motion.state, noise * rng.standard_normal(3)
        if number < 2:
            off += 0.2 * X[0]
        state = dataclasses.replace(state, position=state.position + off)
        motions[number] = dataclasses.replace(motion, state=state)
    start.replace(motions)
    return start


@pytest.mark.parametrize("wrong", [0.0, 0.1])
def test_later_poses_show_how_a_start_began(passing: list[Sweep], wrong: float) -> None:
    """Also if the velocity of the end is wrong, or the acceleration since."""
    start = with_wrong_beginning(passing, 0.003)
    motion = motion_at(SPEED, known_to(0.05))
    off = wrong * np.array([1.0, -1.0, 0.5])
    state = dataclasses.replace(
        motion.state, velocity=SPEED + off, gravity=motion.state.gravity + off
    )
    fitted = start.fitted(motion.with_state(state, motion.covariance))
    assert fitted is not None
    assert fitted.state.stamp == start.reference
    assert fitted.velocity_sigma == tuning.START_FITTED_SIGMA
    assert np.abs(fitted.state.velocity - SPEED).max() < 0.1
    assert fitted.begins_again
    assert fitted.shift == pytest.approx(0.2 * X[0], abs=0.03)


@pytest.mark.parametrize(
    ("velocity", "sigma", "noise", "begins_again"),
    [
        (SPEED, 0.05, 0.003, False),
        (0.5 * SPEED, 0.05, 0.003, True),
        (0.5 * SPEED, 0.5, 0.003, False),  # that it may be so wrong was known
        (0.85 * SPEED, 0.01, 0.0, False),  # too little
        (0.5 * SPEED, 0.05, 0.1, False),  # the poses are too uncertain to tell
    ],
)
def test_a_start_began_with_another_velocity_as_far_as_either_is_known(
    passing: list[Sweep], velocity: F64, sigma: float, noise: float, begins_again: bool
) -> None:
    start = with_wrong_beginning(passing, noise, velocity, sigma)
    fitted = start.fitted(motion_at(SPEED, known_to(0.05)))
    assert fitted is not None
    assert fitted.begins_again == begins_again


@pytest.mark.parametrize(("angle", "begins_again"), [(0.0008, False), (-0.001, True)])
def test_a_start_begins_again_when_the_beams_are_known_better(
    passing: list[Sweep], angle: float, begins_again: bool
) -> None:
    """Its first sweeps are turned by what their halves are apart; its velocity was right."""
    start = with_wrong_beginning(passing, 0.003, SPEED)
    start._intrinsics.angles = np.array([0.0, angle, 0.0])
    fitted = start.fitted(motion_at(SPEED, known_to(0.05)))
    assert fitted is not None
    assert fitted.begins_again == begins_again


def test_sweeps_are_returned_as_they_are_known_to_be_now() -> None:
    reported = list(sweeps(recording("room", "walk"), "turn"))[3:6]
    motion = motion_at(SPEED, known_to(0.05))
    motions = [motion.anchored_at(one.end) for one in reported]
    intrinsics = LidarIntrinsics()
    start = StartVelocity(np.zeros(3), intrinsics)
    start.begin(reported, motions, reported[0].start, np.zeros((0, 3)))
    assert start.sweeps() == reported
    intrinsics.angles = np.array([0.005, -0.003, 0.0])
    for one, sweep in zip(start.sweeps(), reported, strict=True):
        assert one.points["x"] == pytest.approx(intrinsics.applied_to(sweep).points["x"], abs=1e-3)
        assert np.abs(one.points["x"] - sweep.points["x"]).max() > 0.005
    intrinsics.angles = np.zeros(3)
    assert start.sweeps() == reported


def test_too_few_poses_show_no_beginning(passing: list[Sweep]) -> None:
    start = with_wrong_beginning(passing[:6], 0.0)
    assert start.fitted(motion_at(SPEED, known_to(0.05))) is None


def uncertain_motion() -> SweepMotion:
    """Return a motion with a gravity known to 0.1 m/s^2 and a gyro's bias to 0.002 rad/s."""
    motion = motion_at(SPEED, known_to(0.05))
    covariance = motion.covariance.copy()
    covariance[eskf.GRAVITY, eskf.GRAVITY] = 0.1**2 * np.eye(3)
    covariance[eskf.GYRO_BIAS, eskf.GYRO_BIAS] = 0.002**2 * np.eye(3)
    return motion.with_state(motion.state, covariance)


def test_the_beginning_is_uncertain_by_what_has_accelerated_it_since(passing: list[Sweep]) -> None:
    start = begun(passing, SPEED, known_to(0.05), np.zeros((0, 3)))
    motion = uncertain_motion()
    state, found, first, way = start.beginning(motion)
    assert state.stamp == first.stamp == start.reference
    assert not way.any()
    age = 1e-9 * (motion.state.stamp - start.reference)
    assert age > 2.0
    sigmas = np.sqrt(np.diag(found)[eskf.VELOCITY])
    assert sigmas == pytest.approx([np.hypot(0.05, 0.1 * age), 0.1 * age, 0.1 * age], rel=1e-3)
    # it was slower if gravity has accelerated it more
    assert found[eskf.VELOCITY.start, eskf.GRAVITY.start] == pytest.approx(-0.01 * age)
    assert np.linalg.eigvalsh(found)[0] > 0.0


def test_a_search_that_finds_nothing_is_made_again_with_the_sweeps_since(
    passing: list[Sweep],
) -> None:
    """The map then begins again after the first pose, by what is known of the way since."""
    start = begun(passing, SPEED, known_to(1.0), X)
    assert start.is_awaited
    first, end = start.reference, passing[-1].end
    start.end_search(end)
    assert start.phase is SearchPhase.REPEATED
    assert not start.is_awaited
    assert start.since == EPOCH  # the way since the first pose is needed
    assert start.reference >= end + tuning.START_PAUSE_NS - tuning.START_NS
    state, covariance, begun_at, way = start.beginning(uncertain_motion())
    assert state.stamp == start.reference
    assert begun_at.stamp == first
    lead = 1e-9 * (start.reference - first)
    assert lead > 1.0
    assert state.position - begun_at.position == pytest.approx(lead * SPEED, abs=1e-6)
    # against what the velocity then, and the acceleration before, may have been off by
    rng = np.random.default_rng(4)
    root = np.linalg.cholesky(covariance + 1e-12 * np.eye(eskf.ERRORS))
    errors = rng.standard_normal((4000, eskf.ERRORS)) @ root.T
    moved = lead * errors[:, eskf.VELOCITY] - 0.5 * lead**2 * errors[:, eskf.GRAVITY]
    assert np.sqrt(np.diag(way)[:3]) == pytest.approx(moved.std(axis=0), rel=0.1)
    assert np.sqrt(np.diag(way)[3:]) == pytest.approx(0.002 * lead, rel=0.01)


@pytest.mark.parametrize(("late", "known"), [(True, False), (False, True)])
def test_a_first_search_is_not_awaited_for_ever(
    passing: list[Sweep], late: bool, known: bool
) -> None:
    """Nor where the velocity has become known meanwhile."""
    start = begun(passing, SPEED, known_to(1.0), X)
    start.note_velocity((tuning.PRIOR_LEARN_SIGMA + 0.01) ** 2 * np.eye(3))
    end = HostNs(EPOCH + tuning.START_AWAITED_NS + 1) if late else passing[-1].end
    start.end_search(end)
    assert start.may_begin_again != late
    if known:
        start.note_velocity((tuning.PRIOR_LEARN_SIGMA - 0.01) ** 2 * np.eye(3))
    assert start.phase is SearchPhase.FOLLOWING


def walls_with_niches(rng: np.random.Generator, along: float) -> F64:
    """Return where upright scan lines meet two walls beside a place along them, (N, 2)."""
    lines = along + rng.uniform(-6.0, 6.0, 60)
    in_niche = (np.abs(lines + 1.5) < 0.5) | (np.abs(lines - 2.5) < 0.5)
    right, left = np.where(in_niche, -1.6, -1.2), np.full(60, 1.2)
    return np.vstack((np.column_stack((lines, right)), np.column_stack((lines, left))))


@pytest.mark.parametrize("between_walls", [False, True])
def test_rates_that_were_learned_between_walls_with_a_wrong_velocity_are_open_again(
    passing: list[Sweep], between_walls: bool
) -> None:
    """Roll and pitch. Elsewhere what the sweeps have told about them stays, and the attitude."""
    speed, sweeps = SPEED, passing
    if between_walls:
        speed = SPEED * [1.0, 0.0, 0.0]
        sweeps = seen_from(np.random.default_rng(2), walls_with_niches, speed)
    covariance = known_to(0.8)
    covariance[eskf.GYRO_BIAS, eskf.GYRO_BIAS] = 0.002**2 * np.eye(3)
    wrong = speed - np.array([0.7, 0.0, 0.0])
    start = begun(sweeps, wrong, covariance, X)
    motion = motion_at(wrong, covariance, 0.01)
    found = start.search(motion, FREE, None)
    assert found is not None
    assert found.state.velocity == pytest.approx(speed, abs=0.15)
    state, after, first, _ = start.beginning(motion.with_state(found.state, found.covariance))
    sigmas = np.sqrt(np.diag(after)[eskf.GYRO_BIAS])
    opened = tuning.INITIAL_IN_MOTION.gyro_bias
    assert sigmas[:2] == pytest.approx(opened if between_walls else 0.002, rel=0.01)
    assert not after[eskf.GYRO_BIAS.start, eskf.VELOCITY].any()
    assert np.linalg.eigvalsh(after)[0] > -1e-12
    # that of the first pose, as the gyro carries it back or as the sweeps have fixed it
    carried = motion.with_state(found.state, found.covariance).state_at(start.reference)
    fixed = motion_at(wrong, covariance).anchored_at(start.reference).state
    expected = carried if between_walls else fixed
    assert not np.allclose(carried.rotation, fixed.rotation, atol=1e-3)
    for one in (first, state):
        assert one.rotation == pytest.approx(expected.rotation, abs=1e-9)
