"""Scan alignment: a displaced start, and what a wrong range noise costs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, strategies as st

from l2lidar_node import rotations
from l2lidar_node.types import F64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.odometry.config import SurfaceConfig
from l2lidar_proc.odometry.local_map.surfel_map import SurfelMap
from l2lidar_proc.odometry.registration.alignment import (
    Alignment,
    align,
    unobserved_directions,
)
from l2lidar_proc.odometry.registration.correspondences import (
    Source,
    correspondences,
    pose_jacobian,
    residual_jacobian,
    support_of,
)
from l2lidar_proc.odometry.registration.weak_directions import WeakAxes, WeakDirections, weak_axes
from tests.l2lidar_proc.odometry.odometry_world import drive, errors, recording

ZERO = np.zeros(3)


def box(rng: np.random.Generator, count: int) -> F64:
    """Return points on the six walls of a room."""
    points = rng.uniform((-5.0, -4.0, -1.5), (5.0, 4.0, 1.5), (count, 3))
    side, axis = rng.integers(0, 2, count), rng.integers(0, 3, count)
    half = np.array([5.0, 4.0, 1.5])
    points[np.arange(count), axis] = np.where(side, half[axis], -half[axis])
    return points + 0.011 * rng.standard_normal((count, 3))


def test_a_displaced_start_comes_back() -> None:
    rng = np.random.default_rng(7)
    surfaces = SurfelMap((0.3, 0.6, 1.5))
    for _ in range(6):
        surfaces.add(box(rng, 6000))
    state = InertialState(
        HostNs(0), np.eye(3), ZERO, ZERO, ZERO, ZERO, np.array([0.0, 0.0, -9.80665])
    )
    sigma = np.full(eskf.ERRORS, 1e-3)
    sigma[eskf.POSITION], sigma[eskf.ROTATION] = 0.1, 0.03
    off = np.zeros(eskf.ERRORS)
    off[eskf.POSITION], off[eskf.ROTATION] = (0.06, -0.05, 0.04), (0.01, -0.01, 0.02)
    points = box(rng, 2000)
    source = Source(points, rng.uniform(-0.1, 0.1, 2000), np.linalg.norm(points, axis=1))
    found = align(state.boxplus(off), np.diag(sigma**2), source, surfaces, SurfaceConfig(), 100)
    assert found is not None
    left = found.state.boxminus(state)
    assert np.abs(left[eskf.POSITION]).max() < 0.004
    assert np.abs(left[eskf.ROTATION]).max() < 0.002


def test_a_carrier_that_drives_keeps_points_beyond_the_extent_of_surfaces() -> None:
    """What is ahead of it grows with each sweep; one that is moved by hand rejects them."""
    rng = np.random.default_rng(7)
    surfaces = SurfelMap((0.6,))
    seen = rng.uniform((-3.0, -3.0, -1.0), (3.0, 3.0, -1.0), (4000, 3))  # a floor,
    front = rng.uniform((3.3, 0.0, -1.0), (3.3, 0.2, 1.0), (800, 3))  # a strip of a wall,
    more = rng.uniform((3.3, 0.35, -0.3), (3.3, 0.55, 0.3), (300, 3))  # and what is beside it
    for points in (seen, front, more):
        points += 0.01 * rng.standard_normal(points.shape)
    surfaces.add(np.concatenate((seen, front)))
    source = source_of(np.concatenate((seen[::5], more)), np.zeros(len(seen[::5]) + len(more)))
    matched = {}
    for name, driving in (("by hand", False), ("driving", True)):
        prior = 1e-6 * np.eye(eskf.ERRORS)
        found = align(still(), prior, source, surfaces, SurfaceConfig(), 100, driving=driving)
        assert found is not None
        matched[name] = found.matched
    assert matched["driving"] - matched["by hand"] > 250


def test_a_wrong_range_noise_costs_little(monkeypatch: pytest.MonkeyPatch) -> None:
    run, slope = recording("yard", "walk"), tuning.RANGE_NOISE_SLOPE
    right = errors(run, drive(run)).max()
    for factor in (0.5, 2.0):
        monkeypatch.setattr(tuning, "RANGE_NOISE_SLOPE", factor * slope)
        assert errors(run, drive(run)).max() < right + 0.001


STEP = 1e-6
SIZES = (0.15, 0.3, 0.6, 1.5)


def corridor(rng: np.random.Generator, count: int, *, posts: bool) -> F64:
    """Return points of two walls and a floor along x, with the noise of a depth camera."""
    points = rng.uniform((-4.0, -1.2, -1.0), (4.0, 1.2, 1.5), (count, 3))
    kind = rng.integers(0, 3, count)
    points[kind == 0, 1], points[kind == 1, 1], points[kind == 2, 2] = -1.2, 1.2, -1.0
    points += 0.02 * rng.standard_normal(points.shape)
    if posts:
        for x in (-2.0, 0.5, 3.0):
            post = rng.uniform((x, 0.7, -1.0), (x, 1.2, 1.5), (count // 12, 3))
            post[:, 0] += 0.02 * rng.standard_normal(len(post))
            points = np.vstack([points, post])
    return points


def source_of(points: F64, times: F64) -> Source:
    return Source(points, times, np.linalg.norm(points, axis=1))


def still(**changes: F64) -> InertialState:
    start = {"rotation": np.eye(3), "position": ZERO, "velocity": ZERO} | changes
    return InertialState(
        HostNs(0), gyro_bias=ZERO, accel_bias=ZERO, gravity=np.array([0.0, 0.0, -9.8]), **start
    )


def aligned(
    *, posts: bool, off: F64, seed: int = 5, sweeps: int = 6, posts_since: int = 0
) -> tuple[Alignment, F64]:
    """Return a sweep's alignment in a corridor from a wrong place, and the prior covariance.

    The posts are in sight from the map's sweep of that number on.
    """
    rng = np.random.default_rng(seed)
    surfaces = SurfelMap(SIZES)
    for number in range(sweeps):
        seen = posts and number >= posts_since
        surfaces.add(corridor(rng, 5000, posts=seen), number)
    sigma = np.full(eskf.ERRORS, 1e-3)
    sigma[eskf.POSITION], sigma[eskf.ROTATION], sigma[eskf.VELOCITY] = 0.1, 0.01, 0.1
    covariance = np.diag(sigma**2)
    # as after a prediction, a wrong velocity comes with a wrong place
    covariance[3:6, 6:9] = covariance[6:9, 3:6] = 0.009 * np.eye(3)
    points = corridor(rng, 2000, posts=posts)
    source = source_of(points, rng.uniform(-0.05, 0.05, len(points)))
    found = align(still(position=off), covariance, source, surfaces, SurfaceConfig(), 100)
    assert found is not None
    return found, covariance


def test_along_a_bare_corridor_nothing_is_learned() -> None:
    off = np.array([0.05, 0.03, -0.02])
    found, before = aligned(posts=False, off=off)
    free = unobserved_directions(found.information[eskf.POSITION, eskf.POSITION])
    assert free.shape == (3, 1)
    assert abs(free[0, 0]) > 0.999
    # across, the place is found; along, place, velocity and their covariance stay as they were
    np.testing.assert_allclose(found.state.position[1:], 0.0, atol=0.005)
    assert found.state.position[0] == pytest.approx(off[0], abs=0.005)
    assert abs(found.state.velocity[0]) < 0.005
    for row in (3, 6):
        assert found.covariance[row, row] > 0.95 * before[row, row]
        assert found.covariance[row + 1, row + 1] < 0.3 * before[row + 1, row + 1]


def test_door_posts_fix_the_place_along_a_corridor() -> None:
    found, before = aligned(posts=True, off=np.array([0.05, 0.03, -0.02]))
    np.testing.assert_allclose(found.state.position, 0.0, atol=0.008)
    assert found.covariance[3, 3] < 0.1 * before[3, 3]


def test_posts_that_have_just_come_into_sight_do_not_fix_it_yet() -> None:
    """What the last sweeps have put there is where a wrong velocity has put it."""
    off = np.array([0.05, 0.03, -0.02])
    found, before = aligned(posts=True, off=off, sweeps=14, posts_since=8)
    assert found.state.position[0] == pytest.approx(off[0], abs=0.01)
    assert found.covariance[3, 3] > 0.8 * before[3, 3]  # some share a cell with floor or wall
    found, before = aligned(posts=True, off=off, sweeps=14, posts_since=4)
    np.testing.assert_allclose(found.state.position, 0.0, atol=0.008)
    assert found.covariance[3, 3] < 0.1 * before[3, 3]


def test_the_sweeps_that_opened_what_fixes_the_least_fixed_direction_are_named() -> None:
    """Walls are as old as the map; along them the place is known as well as the end wall is."""
    rng = np.random.default_rng(6)
    surfaces = SurfelMap(SIZES)

    def seen(*, end: bool) -> F64:
        points = corridor(rng, 4000, posts=False)
        wall = rng.uniform((3.0, -1.2, -1.0), (3.0, 1.2, 1.5), (800 * end, 3))
        return np.vstack((points, wall + 0.01 * rng.standard_normal(wall.shape)))

    for number in range(14):
        surfaces.add(seen(end=number >= 4), number)
    points = seen(end=True)
    covariance = 1e-4 * np.eye(eskf.ERRORS)
    source = source_of(points, np.zeros(len(points)))
    found = align(still(), covariance, source, surfaces, SurfaceConfig(), 100)
    assert found is not None
    assert found.weakly is not None
    strength = np.linalg.eigvalsh(found.information[eskf.POSITION, eskf.POSITION])
    assert strength[0] > tuning.WEAK_SHARE * strength[-1]  # nothing is weak here
    direction, (sweeps, shares) = found.weakly
    assert abs(direction[0]) > 0.99
    assert shares.sum() == pytest.approx(1.0)
    assert shares[sweeps >= 4].sum() > 0.9
    sweeps, shares = found.support
    assert shares[sweeps < 4].sum() > 0.7


@given(st.lists(st.tuples(st.integers(0, 2000), st.floats(0.0, 1e6)), max_size=30))
def test_shares_of_the_support_are_those_of_the_weights(surfaces: list[tuple[int, float]]) -> None:
    expected: dict[int, float] = {}
    for sweep, weight in surfaces:
        expected[sweep] = expected.get(sweep, 0.0) + weight
    total = max(sum(expected.values()), 1e-12)
    given_sweeps = np.array([sweep for sweep, _ in surfaces], np.int64)
    sweeps, shares = support_of(given_sweeps, np.array([weight for _, weight in surfaces]))
    assert sweeps.tolist() == sorted(expected)
    np.testing.assert_allclose(shares, [expected[n] / total for n in sweeps.tolist()], atol=1e-12)


def test_all_is_kept_where_the_scene_fixes_the_pose() -> None:
    rng = np.random.default_rng(2)
    surfaces = SurfelMap(SIZES)

    def box() -> F64:
        points = rng.uniform(-2.0, 2.0, (6000, 3))
        points[np.arange(6000), rng.integers(0, 3, 6000)] = rng.choice((-2.0, 2.0), 6000)
        return points + 0.01 * rng.standard_normal(points.shape)

    for number in range(4):
        surfaces.add(box(), number)
    source = source_of(box(), np.zeros(6000))

    found = correspondences(still(), still(), source, surfaces, SurfaceConfig(), 0.15)
    assert weak_axes(still(), found, surfaces) is None


def test_reduced_derivatives_scale_information_by_the_square_of_the_share() -> None:
    rng = np.random.default_rng(1)
    scale = np.repeat((0.5, 1.0), 3)
    axes, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    weak = WeakDirections(WeakAxes(scale, axes[:, :2], SurfelMap(SIZES)), np.array([0.0, 0.5]))
    pose = rng.normal(size=(200, 6)) * 3.0
    facing = np.ones((len(pose), 2), np.bool_)
    reduced, by_gradient = weak.reduced(pose, facing)
    assert by_gradient is reduced
    before, after = (pose * scale) @ axes, (reduced * scale) @ axes
    np.testing.assert_allclose(after[:, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(after[:, 1], 0.5 * before[:, 1])
    np.testing.assert_allclose(after[:, 2:], before[:, 2:])
    # residuals that do not face a direction say nothing of it, whatever the share
    after = (weak.reduced(pose, ~facing)[0] * scale) @ axes
    np.testing.assert_allclose(after[:, :2], 0.0, atol=1e-12)


def test_an_unlikely_association_keeps_where_the_place_seems_to_be() -> None:
    """Information and gradient fall alike, so that their quotient stays."""
    rng = np.random.default_rng(1)
    axes = np.eye(6)[:, [3, 4]]
    weak = WeakDirections(
        WeakAxes(np.ones(6), axes, SurfelMap(SIZES)), np.array([0.8, 0.5]), associated=0.1
    )
    pose, off = rng.normal(size=(200, 6)), rng.normal(size=200)
    information, gradient = weak.reduced(pose, np.ones((200, 2), np.bool_))
    np.testing.assert_allclose(information[:, 3], 0.8 * 0.1 * pose[:, 3])
    before = (0.8 * pose[:, 3]) @ off / ((0.8 * pose[:, 3]) ** 2).sum()
    after = gradient[:, 3] @ off / (information[:, 3] ** 2).sum()
    assert after == pytest.approx(before)
    np.testing.assert_allclose(gradient[:, 4:], information[:, 4:])


def test_derivatives_by_all_errors_are_those_of_the_residuals() -> None:
    rng = np.random.default_rng(3)
    turn = rotations.matrices(rotations.exp((0.3, -0.2, 1.0)))
    state = still(rotation=turn, position=np.array([0.1, 0.0, 0.2]))
    surfaces = SurfelMap((1.5,))
    wall = rng.uniform((-3.0, 2.24, -3.0), (3.0, 2.26, 3.0), (20000, 3))
    surfaces.add(wall)
    points = (wall[::100] - state.position) @ turn
    source = source_of(points, rng.uniform(-0.1, 0.1, len(points)))

    def residuals(error: F64) -> F64:
        moved = state.boxplus(error)
        return correspondences(state, moved, source, surfaces, SurfaceConfig(), 1.0).distances

    base = correspondences(state, state, source, surfaces, SurfaceConfig(), 1.0)
    assert len(base.index) > 150
    h = residual_jacobian(pose_jacobian(base, turn), base.times, turn)
    for column in range(eskf.ERRORS):
        error = np.zeros(eskf.ERRORS)
        error[column] = STEP
        moved = residuals(error)
        np.testing.assert_allclose(h[:, column], (moved - base.distances) / STEP, atol=5e-5)


@pytest.mark.parametrize(
    ("better", "matched", "fixes", "refutes"),
    [
        (0.06, 260, True, True),
        (0.04, 500, True, False),
        (0.06, 240, True, False),
        (0.06, 460, False, True),
        (0.06, 440, False, False),
    ],
    ids=["fixed", "no better", "few", "nearly all", "not fixed"],
)
def test_an_alignment_refutes_another_that_fits_worse(
    better: float, matched: int, fixes: bool, refutes: bool
) -> None:
    found, _ = aligned(posts=True, off=np.array([0.01, 0.0, 0.0]))
    information = np.eye(eskf.ERRORS)
    information[3, 3] = 1.0 if fixes else 0.0
    worse = dataclasses.replace(found, inlier_ratio=0.9)
    one = dataclasses.replace(
        found, inlier_ratio=0.9 + better, matched=matched, information=information
    )
    assert one.fits_better_than(worse, 500) == refutes
    assert not worse.fits_better_than(one, 500)
    few = dataclasses.replace(one, matched=matched // 5)
    assert few.fits_better_than(worse, 100) == (refutes and fixes)
