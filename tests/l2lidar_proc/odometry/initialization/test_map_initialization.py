"""The first map: at rest, in motion, and begun again with what has been found out since."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pytest

from l2lidar_node import rotations
from l2lidar_node.types import F64, HostNs, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import ERRORS, GRAVITY, VELOCITY, InertialState
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.initialization.map_initialization import (
    InitializedMap,
    MapInitializer,
    NotBegun,
)
from l2lidar_proc.odometry.initialization.start_velocity import Beginning, FittedStart
from l2lidar_proc.odometry.matcher import SweepMatcher
from l2lidar_proc.odometry.prediction import Predictor
from l2lidar_proc.odometry.zero_velocity import ZeroVelocityTest
from tests.l2lidar_proc.odometry.odometry_world import T_CLOUD_IMU, recording
from tests.support.odometry_runs import Run, record, sweeps, truth

LEVER = T_CLOUD_IMU[:3, 3]
FASTER = np.array([0.2, 0.0, 0.0])  # [m/s]


@lru_cache(maxsize=1)
def walk() -> Run:
    """Return a recording that begins in the middle of a walk."""
    return record("room", "walk", 1, 3.0, since=4.0)


class Start(NamedTuple):
    """A map initializer that has all samples of a recording, and the sweeps of that."""

    initializer: MapInitializer
    zero_velocity: ZeroVelocityTest
    sweeps: list[Sweep]

    @property
    def matcher(self) -> SweepMatcher:
        return self.initializer.matcher

    def add_all(self) -> InitializedMap:
        """Return the map that the first sweeps begin."""
        return next(filter(None, map(self.initializer.add, self.sweeps)))


def start_of(run: Run, first: int = 0) -> Start:
    """Return how a recording begins, from one of its sweeps on; only the first is not whole."""
    config, zero_velocity = OdometryConfig(), ZeroVelocityTest()
    predictor, matcher = Predictor(config, T_CLOUD_IMU), SweepMatcher(config, LEVER)
    predictor.imu(run.imu)
    initializer = MapInitializer(predictor, matcher, zero_velocity, config.min_points)
    return Start(initializer, zero_velocity, list(sweeps(run, "turn"))[first:])


def begun_in_motion() -> tuple[Start, list[Sweep], list[SweepMotion]]:
    """Return a start with whole sweeps only, the six of its map, and their motions."""
    start = start_of(walk(), 1)
    assert start.add_all().seed == 0
    some = start.sweeps[:6]
    motions = start.initializer.begin(some, some[0].start)
    assert not isinstance(motions, NotBegun)
    return start, some, motions


def true_states(run: Run, motions: list[SweepMotion]) -> list[tuple[F64, F64, F64]]:
    """Return where the IMU was, its velocity, and how it was turned, in the map's frame.

    As the attitude and the place of the first motion have it.
    """
    stamps = np.array([motion.state.stamp for motion in motions])
    step = 1_000_000
    places, turns = truth(run, np.concatenate((stamps - step, stamps, stamps + step)))
    matrices = rotations.matrices(turns)
    places = places + matrices @ LEVER
    before, now, after = np.split(places, 3)
    matrices = np.split(matrices, 3)[1]
    first = motions[0].state
    turn = first.rotation @ matrices[0].T
    return [
        (
            first.position + turn @ (now[k] - now[0]),
            turn @ (after[k] - before[k]) / (2e-9 * step),
            turn @ matrices[k],
        )
        for k in range(len(motions))
    ]


def true_beginning(run: Run, motions: list[SweepMotion], number: int) -> Beginning:
    """Return the true beginning of the sweeps from one of them on, of the first pose of all."""
    true = true_states(run, motions)

    def state_of(k: int) -> InertialState:
        place, velocity, turn = true[k]
        return dataclasses.replace(
            motions[0].state,
            stamp=motions[k].state.stamp,
            position=place,
            velocity=velocity,
            rotation=turn,
        )

    way = np.diag([4.0] * 3 + [1.0] * 3)
    return Beginning(state_of(number), 0.01 * np.eye(ERRORS), state_of(0), way)


def turned(state: InertialState, turn: F64) -> InertialState:
    return dataclasses.replace(
        state,
        rotation=turn @ state.rotation,
        position=turn @ state.position,
        velocity=turn @ state.velocity,
        gravity=turn @ state.gravity,
    )


def test_at_rest_all_sweeps_have_one_pose() -> None:
    start = start_of(recording("room", "still", 2.5))
    begun = start.add_all()
    assert start.initializer.moving is None
    assert start.zero_velocity.anchor is not None
    assert len(begun.motions) == len(begun.sweeps) >= 2
    first = begun.motions[0].state
    assert first.position == pytest.approx(first.rotation @ LEVER)  # the map begins at the cloud's
    for motion in begun.motions:
        assert not motion.state.velocity.any()
        assert motion.state.position == pytest.approx(first.position)
    assert not start.matcher.drift.first_pose.any()
    assert len(start.matcher.surfaces) > 100


def test_in_motion_the_later_sweeps_show_the_velocity() -> None:
    start = start_of(walk())
    begun = start.add_all()
    assert start.zero_velocity.anchor is None
    moving = start.initializer.moving
    assert moving is not None
    assert not len(moving.open_axes)  # a room fixes it
    motions = begun.motions[begun.seed :]
    for motion, (place, velocity, _) in zip(motions, true_states(walk(), motions), strict=True):
        assert np.linalg.norm(velocity) > 0.3
        assert motion.state.velocity == pytest.approx(velocity, abs=0.05)
        assert motion.state.position == pytest.approx(place, abs=0.01)
    # the velocity at the first sweep turns and moves the first pose against the map
    assert np.linalg.eigvalsh(start.matcher.drift.first_pose)[0] > 0.0


def test_sweeps_that_come_late_are_not_held_and_a_gap_ends_what_is() -> None:
    start = start_of(walk())
    first, second, *_ = start.sweeps
    initializer = start.initializer
    initializer.add(first)
    initializer.add(second)
    for late in (second, first):
        assert initializer.add(late) is None
        assert initializer.held == [first, second]
    gap = HostNs(tuning.LONG_GAP_NS)
    later = dataclasses.replace(
        second, start=HostNs(second.start + gap), end=HostNs(second.end + gap)
    )
    assert initializer.add(later) is None
    assert initializer.held == [later]


def test_sweeps_with_few_points_begin_no_map_and_do_not_pile_up() -> None:
    """Whatever their lengths: one that is not whole is held until the next one has come."""
    start = start_of(walk())
    few = OdometryConfig().min_points
    for number in range(130):
        sweep = start.sweeps[number % len(start.sweeps)]
        turns = number // len(start.sweeps)
        shift = turns * (start.sweeps[-1].end - start.sweeps[0].start)
        bare = dataclasses.replace(
            sweep,
            start=HostNs(sweep.start + shift),
            end=HostNs(sweep.end + shift),
            points=sweep.points[:few],
        )
        assert start.initializer.add(bare) is None
    held = start.initializer.held
    assert held[-1].end - held[0].start < tuning.INITIAL_MAX_NS


def test_of_long_sweeps_with_few_points_the_latest_is_held() -> None:
    start = start_of(walk())
    sweep = start.sweeps[1]
    for number in range(4):
        begin = HostNs(sweep.start + number * (tuning.LONG_GAP_NS - 1))
        bare = dataclasses.replace(
            sweep,
            start=begin,
            end=HostNs(begin + tuning.INITIAL_MAX_NS),
            points=sweep.points[:3],
        )
        assert start.initializer.add(bare) is None
    assert start.initializer.held == [bare]


@pytest.mark.parametrize("number", [0, 2])
def test_a_map_begins_again_where_the_first_pose_of_all_was(number: int) -> None:
    """From the first sweep on, or from a later one; the first pose stays where it is."""
    start, some, predicted = begun_in_motion()
    known = start.matcher.drift.first_pose.copy()
    beginning = true_beginning(walk(), predicted, number)
    motions = start.initializer.begin_with(some[number:], some[number].start, beginning)
    assert len(motions) == len(some) - number
    for motion, (place, velocity, turn) in zip(
        motions, true_states(walk(), predicted)[number:], strict=True
    ):
        assert motion.state.position == pytest.approx(place, abs=0.005)
        assert motion.state.velocity == pytest.approx(velocity, abs=0.03)
        assert motion.state.rotation == pytest.approx(turn, abs=0.005)
    # its place and turn are known as at a start, and by the way since
    more = start.matcher.drift.first_pose - beginning.way_covariance
    assert np.linalg.eigvalsh(more)[0] > 0.0
    assert np.diag(more) == pytest.approx(np.diag(known), rel=1.0)


def test_a_sweep_that_was_not_whole_keeps_its_pose_when_the_map_begins_again() -> None:
    """It was not in the map, and its pose was estimated with the velocity then."""
    start = start_of(walk(), 1)
    start.sweeps[0] = dataclasses.replace(start.sweeps[0], points=start.sweeps[0].points[:3000])
    begun = start.add_all()
    assert begun.seed == 1
    stamp = HostNs((start.sweeps[0].start + start.sweeps[0].end) // 2)
    place = begun.motions[0].state_at(stamp).position
    some, motions = begun.sweeps[1:], begun.motions[1:]
    beginning = true_beginning(walk(), motions, 0)
    state = dataclasses.replace(beginning.state, velocity=beginning.state.velocity + FASTER)
    again = start.initializer.begin_with(
        some, begun.since, beginning._replace(state=state, first=state)
    )
    assert again[0].state.position[0] - motions[0].state.position[0] > 0.02
    assert again[0].state_at(stamp).position == pytest.approx(place, abs=0.002)


def test_how_a_beginning_is_turned_does_not_matter() -> None:
    """The axes are those of the first pose, which stays; all else turns with it."""
    start, some, predicted = begun_in_motion()
    beginning = true_beginning(walk(), predicted, 2)
    turn = rotations.matrices(rotations.exp(np.array([0.1, -0.2, 0.4])))
    other = beginning._replace(
        state=turned(beginning.state, turn), first=turned(beginning.first, turn)
    )
    one, another = (
        start.initializer.begin_with(some[2:], some[2].start, given)
        for given in (beginning, other)
    )
    for a, b in zip(one, another, strict=True):
        assert a.state.position == pytest.approx(b.state.position, abs=1e-6)
        assert a.state.rotation == pytest.approx(b.state.rotation, abs=1e-6)
        assert a.state.velocity == pytest.approx(b.state.velocity, abs=1e-5)
        assert a.state.gravity == pytest.approx(b.state.gravity, abs=1e-5)


def test_the_imu_carries_a_sweep_that_fits_nowhere_when_the_map_begins_again() -> None:
    start, some, predicted = begun_in_motion()
    strange = some[3].points.copy()
    rng = np.random.default_rng(3)
    for axis in "xyz":
        strange[axis] = rng.uniform(-30.0, 30.0, len(strange))
    some[3] = dataclasses.replace(some[3], points=strange)
    beginning = true_beginning(walk(), predicted, 0)
    motions = start.initializer.begin_with(some, some[0].start, beginning)
    assert len(motions) == len(some)
    for motion, (place, *_) in zip(motions, true_states(walk(), predicted), strict=True):
        assert motion.state.position == pytest.approx(place, abs=0.02)


def fitted(motion: SweepMotion, velocity: F64, shift: F64, *, begins_again: bool) -> FittedStart:
    state = dataclasses.replace(motion.state, velocity=velocity)
    return FittedStart(state, 0.02, begins_again, shift)


def test_a_start_that_the_poses_since_confirm_keeps_its_map() -> None:
    """Its first pose may be off by what the fit has it off."""
    start = start_of(walk())
    begun = start.add_all()
    size, before = len(start.matcher.surfaces), start.matcher.drift.first_pose.copy()
    first = begun.motions[begun.seed]
    shift = np.array([0.03, 0.0, -0.01])
    found = start.initializer.begin_as_fitted(
        begun.sweeps[begun.seed :],
        begun.since,
        fitted(first, first.state.velocity, shift, begins_again=False),
        first.covariance,
    )
    assert found == []
    assert len(start.matcher.surfaces) == size
    more = start.matcher.drift.first_pose - before
    assert more[:3, :3] == pytest.approx(np.outer(shift, shift))
    assert not more[3:].any()


def test_a_start_at_another_velocity_begins_again_and_keeps_its_attitude() -> None:
    start = start_of(walk())
    begun = start.add_all()
    moving = start.initializer.moving
    assert moving is not None
    some, motions = begun.sweeps[begun.seed :], begun.motions[begun.seed :]
    attitude = moving.initial.state.rotation
    (_, velocity, _), *_ = true_states(walk(), motions)
    # as a fit may have it, which knows nothing of the attitude
    turn = rotations.matrices(rotations.exp(np.array([0.05, 0.0, 0.1])))
    given = fitted(motions[0], velocity, np.zeros(3), begins_again=True)
    given = given._replace(
        state=dataclasses.replace(given.state, rotation=turn @ given.state.rotation)
    )
    known = 0.04 * np.eye(ERRORS)
    again = start.initializer.begin_as_fitted(some, begun.since, given, known)
    assert len(again) == len(some)
    first = again[0]
    assert first.state.rotation == pytest.approx(attitude)
    assert first.state.velocity == pytest.approx(velocity)
    assert np.diag(first.covariance)[VELOCITY] == pytest.approx(np.full(3, 0.02**2), rel=0.05)
    assert np.diag(first.covariance)[GRAVITY] == pytest.approx(np.full(3, 0.04), rel=0.05)
    for motion, (place, *_) in zip(again, true_states(walk(), again), strict=True):
        assert motion.state.position == pytest.approx(place, abs=0.01)
