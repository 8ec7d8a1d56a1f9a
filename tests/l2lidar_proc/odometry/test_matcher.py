"""Matching with the map from predictions that are good, loose, and without any measured turn."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from l2lidar_node.types import F64, HostNs, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.intrinsics.corrections import Corrections
from l2lidar_proc.odometry.matcher import Match, MatchStatus, SweepMatcher, is_far
from l2lidar_proc.odometry.registration.alignment import Alignment
from l2lidar_proc.odometry.registration.correspondences import Source
from l2lidar_proc.odometry.registration.pose_hypotheses import level_basis, level_grid
from tests.l2lidar_proc.motion.analytic import EPOCH
from tests.l2lidar_proc.odometry.mapped_room import (
    LOOSE,
    PLACE,
    TIGHT,
    corner,
    extended,
    motion,
    room,
    source,
)


@pytest.fixture(scope="module")
def grown() -> SweepMatcher:
    """Return a matcher with a map of the room."""
    rng, matcher = np.random.default_rng(11), SweepMatcher(OdometryConfig(), np.zeros(3))
    fresh = [extended(matcher, room(rng, 4000)) for _ in range(14)]
    assert fresh[0] == 1.0
    assert fresh[-1] < 0.05
    return matcher


@pytest.fixture(scope="module")
def seen() -> Source:
    """Return what is seen from PLACE."""
    return source((room(np.random.default_rng(12), 3000) - PLACE)[::2])


def off(match: Match) -> float:
    """Return how far the place that was found is from PLACE [m]."""
    assert match.alignment is not None
    return float(np.linalg.norm(match.alignment.state.position - PLACE))


def test_a_good_prediction_is_corrected(grown: SweepMatcher, seen: Source) -> None:
    found = grown.match(seen, motion(TIGHT, PLACE + 0.015))
    assert off(found) < 0.005
    assert found.status is MatchStatus.ALIGNED
    assert found.alignment is not None
    quality = grown.quality(len(seen.points), found.alignment)
    assert (quality.points, quality.matched) == (len(seen.points), found.alignment.matched)
    assert quality.inlier_ratio > 0.98
    assert quality.matched > 0.9 * quality.points
    assert 0.2 < quality.degeneracy_ratio <= 1 / 3
    assert quality.map_cells == len(grown.surfaces) > 5000
    assert grown.quality(7, None).matched == 0


@pytest.mark.parametrize("initial", [False, True])
@pytest.mark.parametrize(
    ("error", "turn"),
    [((0.3, -0.2, 0.0), 0.0), ((0.8, -0.6, 0.2), 0.2), ((1.0, 0.5, 0.0), 0.0)],
    ids=["half way to a wrong place", "turned", "far"],
)
def test_a_loose_prediction_is_not_the_only_place_to_begin_from(
    grown: SweepMatcher, seen: Source, error: F64, turn: float, initial: bool
) -> None:
    """From the first of these the alignment ends a surface off, with four of five inliers."""
    assert off(grown.match(seen, motion(LOOSE, PLACE + error, turn), initial=initial)) < 0.015


@pytest.mark.parametrize("count", [5, 8, 20])
def test_a_few_points_do_not_move_a_loose_prediction_far(grown: SweepMatcher, count: int) -> None:
    """A floor fits everywhere along itself, and a few points find a wall somewhere."""
    rng = np.random.default_rng(18)
    floor = rng.uniform((-1.5, -1.0, -1.2), (1.5, 2.0, -1.2), (90, 3))
    wall = rng.uniform((4.0, -1.0, 0.0), (4.0, 2.0, 1.0), (count, 3))
    cloud = source(np.vstack((floor, wall)) - PLACE)
    found = grown.match(cloud, motion(LOOSE, PLACE - (0.2, 0.0, 0.0))).alignment
    place = None if found is None else float(found.state.position[0] - PLACE[0])
    if count > tuning.FAR_POINTS:
        assert place == pytest.approx(0.0, abs=0.01)
    else:
        assert place is None or place == pytest.approx(-0.2, abs=0.01)


def test_the_other_side_of_a_wall_does_not_pull() -> None:
    """A wall of 12 cm, of which one side is mapped and the other comes into sight."""
    rng, matcher = np.random.default_rng(22), SweepMatcher(OdometryConfig(), np.zeros(3))

    def side(x: float, count: int, low: float, high: float) -> F64:
        return np.asarray(rng.uniform((x, low, -1.0), (x, high, 1.0), (count, 3)))

    def ground(count: int) -> F64:
        return np.asarray(rng.uniform((0.0, -3.0, -1.2), (4.0, 3.0, -1.2), (count, 3)))

    for _ in range(tuning.YOUNG_SWEEPS + 1):
        points = np.vstack((ground(3000), side(2.0, 3000, -2.0, 2.0)))
        extended(matcher, points + rng.normal(0.0, 0.005, points.shape))
    place = np.array([4.0, 0.0, 0.0])  # in the other room
    beyond = ground(100) * (0.4, 1.0, 1.0) + np.array((2.2, 0.0, 0.0))
    seen = np.vstack((beyond, side(2.12, 300, -1.5, 1.5))) - place
    found = matcher.match(source(seen), motion((0.005, 0.05), place)).alignment
    assert found is not None
    assert found.matched < 150
    np.testing.assert_allclose(found.state.position, place, atol=0.01)


def test_a_room_that_comes_into_sight_does_not_contradict_what_is_known_beside_it() -> None:
    """The coarse cells of a wall reach into the room behind its door."""
    rng, matcher = np.random.default_rng(20), SweepMatcher(OdometryConfig(), np.zeros(3))

    def known(count: int) -> F64:
        points = rng.uniform((0.0, -2.0, -1.2), (2.0, 1.0, 1.0), (count, 3))
        side = rng.integers(0, 3, count)
        points[side == 0, 0], points[side == 1, 1], points[side == 2, 2] = 2.0, 1.0, -1.2
        return np.asarray(points + rng.normal(0.0, 0.005, points.shape))

    for _ in range(tuning.YOUNG_SWEEPS + 1):
        extended(matcher, known(3000))
    behind = rng.uniform((2.15, -1.5, -0.9), (2.5, 1.0, 0.9), (200, 3))
    cloud = source(np.vstack((known(300), behind)))
    found = matcher.match(cloud, motion(LOOSE, np.array([0.0, 0.03, 0.0]))).alignment
    assert found is not None
    assert found.inlier_ratio < tuning.INLIER_RATIO.loose < found.fine_ratio
    assert np.abs(found.state.position).max() < 0.01


@pytest.mark.parametrize("error", [0.03, 0.3])
def test_forty_points_confirm_a_loose_prediction_but_do_not_move_it_far(
    grown: SweepMatcher, seen: Source, error: float
) -> None:
    cloud = seen.some(np.linspace(0, len(seen.points) - 1, 40).astype(int))
    match = grown.match(cloud, motion(LOOSE, PLACE + np.array((error, 0.0, 0.0))))
    assert match.alignment is None if error > tuning.FAR_MOVE else off(match) < 0.015


@pytest.mark.parametrize(("plates", "believed"), [((2.0, 2.8), False), ((2.0,), True)])
def test_a_place_far_from_the_prediction_is_the_only_one_that_fits(
    plates: tuple[float, ...], believed: bool
) -> None:
    """Of a new room a floor and a wall are seen at first: two walls of an old one are like it."""
    rng, matcher = np.random.default_rng(19), SweepMatcher(OdometryConfig(), np.zeros(3))

    def plate(x: float, count: int) -> F64:
        return np.asarray(rng.uniform((x, -1.5, -1.2), (x, 1.5, 1.0), (count, 3)))

    def floor(count: int) -> F64:
        return np.asarray(rng.uniform((-1.0, -2.0, -1.2), (4.0, 2.0, -1.2), (count, 3)))

    for _ in range(tuning.YOUNG_SWEEPS + 1):
        points = np.vstack((floor(3000), *(plate(x, 1500) for x in plates)))
        extended(matcher, points + rng.normal(0.0, 0.005, points.shape))
    cloud = source(np.vstack((floor(90) * (0.4, 1.0, 1.0), plate(2.0, 90))))
    match = matcher.match(cloud, motion(LOOSE, np.array([0.4, 0.0, 0.0])))
    assert (match.alignment is not None) == believed
    if match.alignment is not None:
        assert match.alignment.state.position[0] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("is_in_the_way", [False, True])
def test_a_place_from_which_a_known_wall_is_seen_through_is_not_believed(
    is_in_the_way: bool,
) -> None:
    """A floor and a wall fit 0.4 m from the prediction, where a narrow wall stands in between."""
    rng, matcher = np.random.default_rng(21), SweepMatcher(OdometryConfig(), np.zeros(3))

    def plate(x: float, half: float, count: int) -> F64:
        return np.asarray(rng.uniform((x, -half, -1.2), (x, half, 1.0), (count, 3)))

    def floor(count: int) -> F64:
        return np.asarray(rng.uniform((-1.0, -2.0, -1.2), (4.0, 2.0, -1.2), (count, 3)))

    walls = ((2.8, 1.5), (1.6, 0.4)) if is_in_the_way else ((2.8, 1.5),)
    for _ in range(tuning.YOUNG_SWEEPS + 1):
        points = np.vstack((floor(3000), *(plate(x, half, 2000) for x, half in walls)))
        extended(matcher, points + rng.normal(0.0, 0.005, points.shape))
    cloud = source(np.vstack((floor(90) * (0.4, 1.0, 1.0), plate(2.0, 1.5, 110))))
    found = matcher.match(cloud, motion(LOOSE, np.array([0.4, 0.0, 0.0]))).alignment
    if is_in_the_way:  # the floor alone may place the sweep where it was predicted
        assert found is None or abs(found.state.position[0] - 0.4) < 0.01
    else:
        assert found is not None
        assert found.state.position[0] == pytest.approx(0.8, abs=0.01)


def test_what_an_alignment_leaves_free_does_not_make_its_place_far(
    grown: SweepMatcher, seen: Source
) -> None:
    at = motion(LOOSE, PLACE)
    found = grown.match(seen, at).alignment
    assert found is not None
    corridor = found.information.copy()
    corridor[eskf.POSITION, eskf.POSITION] = np.diag((0.0, 1e5, 1e5))
    for axis, is_known, far in ((0, True, True), (0, False, False), (1, False, True)):
        place = at.state.position + 2.0 * tuning.FAR_MOVE * np.eye(3)[axis]
        moved = dataclasses.replace(
            found,
            state=dataclasses.replace(at.state, position=place),
            information=found.information if is_known else corridor,
        )
        assert is_far(moved, at) == far


def test_what_fits_nowhere_is_not_believed(grown: SweepMatcher) -> None:
    rng = np.random.default_rng(13)
    cloud = source(rng.uniform((-3.5, -2.5, -1.0), (3.5, 2.5, 1.5), (1500, 3)))
    for known in (TIGHT, LOOSE):
        assert grown.match(cloud, motion(known, PLACE)) == (None, MatchStatus.REJECTED)
    few = cloud.some(np.arange(OdometryConfig().min_points - 1))
    assert grown.match(few, motion(TIGHT, PLACE)) == (None, MatchStatus.REJECTED)


def test_a_map_that_has_only_just_begun_has_no_surface_elsewhere(seen: Source) -> None:
    matcher = SweepMatcher(OdometryConfig(), np.zeros(3))
    without_map = matcher.match(seen, motion(TIGHT, PLACE))
    assert without_map == (None, MatchStatus.REJECTED)
    extended(matcher, room(np.random.default_rng(14), 4000))
    assert matcher.is_young
    far = motion(TIGHT, PLACE + 50.0)
    assert matcher.match(seen, far) == (None, MatchStatus.NEW_MAP)
    loose = matcher.match(seen, motion((0.0, 0.5), far.state.position))
    assert loose.status is MatchStatus.ALIGNED  # where KISS-ICP puts it
    matcher.clear()
    assert not len(matcher.surfaces)


@pytest.mark.parametrize(
    ("count", "share_known", "known", "status"),
    [
        (1500, 0.15, LOOSE, MatchStatus.UNMAPPED),
        (1500, 0.4, LOOSE, MatchStatus.REJECTED),  # it may be the same place, off by some surfaces
        (1500, 0.15, TIGHT, MatchStatus.REJECTED),  # as after somebody has rearranged the place
        (tuning.UNMAPPED_POINTS - 1, 0.15, LOOSE, MatchStatus.REJECTED),
    ],
)
def test_a_rich_view_from_a_loose_place_is_unmapped_where_the_map_is_empty(
    grown: SweepMatcher,
    count: int,
    share_known: float,
    known: tuple[float, float],
    status: MatchStatus,
) -> None:
    rng = np.random.default_rng(17)
    within = rng.uniform((-3.9, -2.9, -1.1), (-3.4, -2.4, 1.6), (round(share_known * count), 3))
    beyond = rng.uniform((10.0, -5.0, -1.0), (20.0, 5.0, 2.0), (count - len(within), 3))
    assert np.mean(grown.surfaces.are_known(within)) > 0.9
    assert not grown.surfaces.are_known(beyond).any()
    cloud = source(np.vstack((within, beyond)))
    assert grown.match(cloud, motion(known, np.zeros(3))) == (None, status)


def bushes(rng: np.random.Generator, count: int) -> F64:
    """Return points of leaves that sway by 10 cm: the same each time, no surface anywhere."""
    leaves = np.random.default_rng(15).uniform((-6.0, -6.0, -1.0), (6.0, 6.0, 2.0), (count, 3))
    return np.asarray(leaves + rng.normal(0.0, 0.1, leaves.shape))


def test_where_nobody_measured_the_turn_and_nothing_is_flat_kiss_icp_is_not_lost() -> None:
    rng, matcher = np.random.default_rng(16), SweepMatcher(OdometryConfig(), np.zeros(3))
    for _ in range(tuning.YOUNG_SWEEPS + 1):
        extended(matcher, bushes(rng, 3000))
    leaves = source(bushes(rng, 3000) - PLACE)
    guess = PLACE + 0.1
    assert matcher.match(leaves, motion(LOOSE, guess)).alignment is None
    found = matcher.match(leaves, motion(LOOSE, guess, imu=False))
    assert off(found) < 0.1
    assert found.alignment is not None
    sigma = np.sqrt(np.diag(found.alignment.covariance)[eskf.POSITION])
    np.testing.assert_allclose(sigma, 1.0 / np.hypot(1.0 / 0.15, 1.0 / LOOSE[1]), rtol=0.05)


def test_a_scene_with_strays_lowers_what_is_needed_after_a_loose_prediction() -> None:
    """A fifth of the points off every surface is usual: so many are believed, not many more."""
    rng, matcher = np.random.default_rng(17), SweepMatcher(OdometryConfig(), np.zeros(3))
    for _ in range(tuning.YOUNG_SWEEPS + 1):
        extended(matcher, room(rng, 4000))

    def rainy(share: float) -> Source:
        points = room(rng, 3000)[::2]
        near = rng.random(len(points)) < share
        points[near] *= rng.uniform(0.85, 0.95, (len(points), 1))[near]
        return source(points - PLACE)

    # too far off for the finest cells to confirm it
    loose = motion(LOOSE, PLACE + 1.5 * tuning.FAR_MOVE)
    assert matcher.match(rainy(0.2), loose).alignment is None
    for _ in range(30):
        assert off(matcher.match(rainy(0.2), motion(TIGHT, PLACE))) < 0.02
    usual, sweeps = matcher._inliers
    assert sweeps == 30
    assert 0.75 < usual < tuning.INLIER_RATIO.loose
    assert off(matcher.match(rainy(0.2), loose)) < 0.02
    assert matcher.match(rainy(0.7), loose).alignment is None


def corridor(rng: np.random.Generator, count: int) -> F64:
    """Return points of two walls and a floor along x."""
    points = rng.uniform((-4.0, -1.2, -1.0), (4.0, 1.2, 1.0), (count, 3))
    side = rng.integers(0, 3, count)
    points[side == 0, 1], points[side == 1, 1], points[side == 2, 2] = -1.2, 1.2, -1.0
    return np.asarray(points + rng.normal(0.0, 0.01, points.shape))


def driven_along(rng: np.random.Generator) -> SweepMatcher:
    """Return a matcher with a map of the corridor, along which the carrier drives."""
    matcher = SweepMatcher(OdometryConfig(), np.zeros(3))
    for _ in range(tuning.YOUNG_SWEEPS + 1):
        extended(matcher, corridor(rng, 4000))
    matcher.driving = True
    for _ in range(2):  # the first shows that the way is weak
        found = matcher.match(source(corridor(rng, 2000)), motion(TIGHT, np.zeros(3))).alignment
        assert found is not None
        matcher.meet(found, 0.2)
    return matcher


def uncertain_along(direction: F64, sigma: float, place: F64) -> SweepMotion:
    """Return a motion whose place is uncertain along a direction, else to 3 mm."""
    moved = motion(TIGHT, place)
    covariance = moved.covariance.copy()
    covariance[eskf.POSITION, eskf.POSITION] = 0.003**2 * np.eye(3) + sigma**2 * np.outer(
        direction, direction
    )
    return dataclasses.replace(moved, covariance=covariance)


def test_millimeters_across_the_way_are_not_meters_along_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The place became uncertain along walls that ran by 5 mrad another way."""
    rng = np.random.default_rng(24)
    matcher = driven_along(rng)
    before = np.array([np.cos(0.005), np.sin(0.005), 0.0])
    across = np.array([0.0, 0.004, 0.0])  # by which the prediction is off
    seen = source(corridor(rng, 2000))

    def found() -> Alignment:
        alignment = matcher.match(seen, uncertain_along(before, 1.5, across)).alignment
        assert alignment is not None
        return alignment

    state, covariance = found().state, found().covariance
    assert abs(state.position[1]) < 0.002
    assert abs(state.position[0]) < 0.1
    assert np.sqrt(covariance[3, 3]) > 1.3
    # else the walls as they are tell the way along those that were
    monkeypatch.setattr(tuning, "WAY_TURN", 0.0)
    assert np.sqrt(found().covariance[3, 3]) < 0.7


def test_millimeters_across_a_loose_direction_are_not_centimeters_along_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nobody drives, so each sweep sees the direction that it leaves free a few degrees off."""
    rng, matcher = np.random.default_rng(26), SweepMatcher(OdometryConfig(), np.zeros(3))
    for _ in range(tuning.YOUNG_SWEEPS + 1):
        extended(matcher, corridor(rng, 4000))
    before = np.array([np.cos(0.05), np.sin(0.05), 0.0])
    predicted = motion(TIGHT, np.array([0.0, 0.002, 0.0]))
    covariance = predicted.covariance.copy()
    for errors, along in ((eskf.POSITION, 0.05), (eskf.VELOCITY, 0.5)):
        covariance[errors, errors] = 3e-4**2 * np.eye(3) + along**2 * np.outer(before, before)
    predicted = dataclasses.replace(predicted, covariance=covariance)
    seen = source(corridor(rng, 2000))

    def found() -> Alignment:
        alignment = matcher.match(seen, predicted).alignment
        assert alignment is not None
        return alignment

    assert abs(found().state.position[0]) < 0.02
    assert np.sqrt(found().covariance[3, 3]) > 0.04
    monkeypatch.setattr(tuning, "LOOSE_AXIS_TURN", 0.0)
    assert np.sqrt(found().covariance[3, 3]) < 0.03


def test_a_place_that_is_uncertain_along_bare_walls_is_not_loose() -> None:
    """Where some of the walls have moved, a sweep fits badly, and no other place fits better."""
    rng = np.random.default_rng(25)
    matcher = driven_along(rng)
    points = corridor(rng, 2000)
    strays = rng.random(len(points)) < 0.3
    points[strays] += rng.choice((-0.13, 0.13), (np.count_nonzero(strays), 3))
    seen, (along, across, _) = source(points), np.eye(3)

    def is_found(direction: F64) -> bool:
        moved = uncertain_along(direction, 0.3, np.zeros(3))
        return matcher.match(seen, moved).alignment is not None

    assert is_found(along)
    assert not is_found(across)
    matcher.driving = False
    assert not is_found(along)


def test_a_sparse_sweep_of_a_drive_along_walls_keeps_more_points() -> None:
    """What faces the way along a corridor is small; of it, thinning must leave something."""
    rng, matcher = np.random.default_rng(21), SweepMatcher(OdometryConfig(), np.zeros(3))

    def sweep(points: F64) -> Sweep:
        cloud = np.zeros(len(points), [(axis, "<f4") for axis in ("x", "y", "z", "time")])
        cloud["x"], cloud["y"], cloud["z"] = points.T
        return Sweep(EPOCH, HostNs(EPOCH + 200_000_000), cloud, 1, 0)

    for _ in range(tuning.YOUNG_SWEEPS + 1):
        extended(matcher, corridor(rng, 4000))
    at = motion(TIGHT, np.zeros(3))
    sparse, dense = sweep(corridor(rng, 2000)), sweep(corridor(rng, 30_000))

    def kept(some: Sweep) -> int:
        found = matcher.source(some, at)
        alignment = matcher.match(found, at).alignment
        assert alignment is not None
        matcher.meet(alignment, 0.2)
        scatter = alignment.normal_scatter
        scatters.append(0.0 if scatter is None else float(scatter.trace()))
        return len(found.points)

    scatters: list[float] = []
    first = [kept(one) for one in (sparse, sparse, dense)]
    assert first[0] == first[1] < tuning.DRIVING_POINTS < first[2]
    matcher.driving = True
    assert not any(scatters)
    driven = [kept(one) for one in (sparse, sparse, dense, sparse)]
    assert np.diff(scatters[3:]).min() > 0.0  # of all sweeps so far
    assert scatters[-1] > 1.5 * scatters[-3]
    assert driven[0] == first[0]  # nothing has been seen to be weak yet
    assert driven[1] > 1.2 * first[1]
    assert driven[2] == first[2]
    # thinning leaves nothing out twice
    found = matcher.source(sparse, at)
    assert found.denser is not None
    both = np.vstack((found.points, found.denser().points))
    assert len(np.unique(both, axis=0)) == len(both) > len(found.points)


@pytest.mark.parametrize(
    ("free", "speed", "sigma", "driving", "found"),
    [
        ((0,), 0.2, 0.3, True, True),
        ((0,), 0.2, 0.3, False, False),  # a sensor that is moved by hand
        ((0,), -1.3, 0.3, False, True),  # too fast for that
        ((0,), -1.3, 0.7, False, False),  # perhaps
        ((), 1.3, 0.1, True, False),
        ((0, 1), 1.3, 0.1, True, False),
        ((2,), 1.3, 0.1, True, False),  # up
    ],
)
def test_a_drive_along_one_free_level_direction(
    free: tuple[int, ...], speed: float, sigma: float, driving: bool, found: bool
) -> None:
    """About the axes of a corridor that rises by 10 degrees."""
    slope = np.deg2rad(10.0)
    axes = np.array(
        [
            [np.cos(slope), 0.0, -np.sin(slope)],
            [0.0, 1.0, 0.0],
            [np.sin(slope), 0.0, np.cos(slope)],
        ]
    )
    still = motion(TIGHT, np.zeros(3)).state
    state = dataclasses.replace(still, velocity=speed * axes[:, 0])
    covariance, information = np.zeros((2, eskf.ERRORS, eskf.ERRORS))
    covariance[eskf.VELOCITY, eskf.VELOCITY] = sigma**2 * np.eye(3)
    known = np.diag([0.0 if axis in free else 1e6 for axis in range(3)])
    information[eskf.POSITION, eskf.POSITION] = axes @ known @ axes.T
    nobody = np.empty(0, np.int64), np.empty(0)
    aligned = Alignment(state, covariance, information, np.eye(3), 100, 1.0, 0.0, nobody)
    matcher = SweepMatcher(OdometryConfig(), np.zeros(3))
    matcher.driving = driving
    direction = matcher.driving_direction(aligned)
    assert (direction is not None) == found
    if direction is not None:
        assert abs(float(direction @ axes[:, 0])) == pytest.approx(1.0)
    unknown = dataclasses.replace(state, gravity=np.zeros(3))  # which way is level
    assert matcher.driving_direction(dataclasses.replace(aligned, state=unknown)) is None


def test_a_height_that_was_not_fixed_for_long_is_not_observed() -> None:
    """Walls without a floor or a ceiling; a floor in one sweep of five is enough."""
    rng, matcher = np.random.default_rng(22), SweepMatcher(OdometryConfig(), np.zeros(3))

    def walls(count: int, *, floor: bool) -> F64:
        points = rng.uniform((-4.0, -3.0, -1.0), (4.0, 3.0, 1.0), (count, 3))
        side = rng.integers(0, 4 if floor else 2, count)
        points[side == 0, 0], points[side == 1, 1], points[side >= 2, 2] = 4.0, 3.0, -1.0
        return np.asarray(points + rng.normal(0.0, 0.01, points.shape))

    for _ in range(tuning.YOUNG_SWEEPS + 1):
        extended(matcher, walls(4000, floor=True))
    at = motion(TIGHT, np.zeros(3))
    bare, full = (
        matcher.match(source(walls(2000, floor=floor)), at).alignment for floor in (False, True)
    )
    assert bare is not None
    assert full is not None

    def seen(seconds: float, share: float) -> bool:
        floors = round(5 * share)
        for number in range(int(5 * seconds)):
            matcher.meet(full if number % 5 < floors else bare, 0.2)
        return matcher.observes_height

    assert matcher.observes_height  # nothing is known yet
    assert seen(10.0, 1.0)
    assert seen(5.0, 0.0)
    assert not seen(60.0, 0.0)
    assert seen(20.0, 0.2)
    assert not seen(60.0, 0.0)
    assert seen(5.0, 1.0)


@pytest.mark.parametrize("driving", [False, True])
def test_points_count_by_their_range_unless_the_carrier_drives(driving: bool) -> None:
    matcher = SweepMatcher(OdometryConfig(), np.zeros(3))
    matcher.driving = driving
    points = room(np.random.default_rng(13), 4000)
    extended(matcher, points)
    cells = matcher.surfaces._cells[1 : len(matcher.surfaces) + 1]
    assert (cells["weight"].sum() < 0.9 * cells["count"].sum()) != driving


@pytest.mark.parametrize("imu", [False, True])
def test_without_an_imu_every_sweep_is_a_keyframe(imu: bool) -> None:
    """There a pose may be KISS-ICP's alone, for which its map has to be complete."""
    rng, matcher = np.random.default_rng(5), SweepMatcher(OdometryConfig(), np.zeros(3))
    extended(matcher, room(rng, 300), imu=imu)
    begun = len(matcher.kiss.points())
    extended(matcher, room(rng, 300), imu=imu)
    assert (len(matcher.kiss.points()) > begun) is not imu


DRIFTED = np.array([0.55, 0.0, 0.0])  # along the wall that fills the view
DRIFT_SIGMA = np.array([0.5, 0.05, 0.2])


def level_fit(
    matcher: SweepMatcher,
    points: F64,
    drift: F64 = DRIFTED,
    sigma: F64 = DRIFT_SIGMA,
    gravity: float = 1.0,
) -> Alignment | None:
    """Return how points fit on the level of a place that has drifted, allowing for a sigma [m]."""
    at = motion(TIGHT, PLACE + drift)
    places = np.diag(sigma**2)
    covariance = at.covariance.copy()
    covariance[eskf.POSITION, eskf.POSITION] = places
    state = dataclasses.replace(at.state, gravity=gravity * at.state.gravity)
    loose = dataclasses.replace(at, covariance=covariance, state=state)
    return matcher.relocalize(source(points - PLACE), loose, places)


def relocalized(
    matcher: SweepMatcher, points: F64, drift: F64 = DRIFTED, sigma: F64 = DRIFT_SIGMA
) -> F64 | None:
    """Return the drift that remains when points are relocalized, None where they are not."""
    found = level_fit(matcher, points, drift, sigma)
    return None if found is None else found.state.position - PLACE


@pytest.mark.parametrize("along", [0.55, -0.55, 0.2, 0.95])
def test_a_strip_of_a_wall_that_comes_into_sight_again_shows_how_far_the_place_has_drifted(
    grown: SweepMatcher, along: float
) -> None:
    points = corner(np.random.default_rng(31))
    left = relocalized(grown, points, np.array([along, 0.0, 0.0]))
    assert left is not None
    np.testing.assert_allclose(left, 0.0, atol=0.02)
    # all but the strip fits where it was predicted
    match = grown.match(source(points - PLACE), motion(TIGHT, PLACE + np.array((along, 0.0, 0.0))))
    assert match.alignment is None or off(match) > 0.1


def test_a_place_that_drifted_in_both_level_directions_is_found(grown: SweepMatcher) -> None:
    drift, sigma = np.array([0.4, -0.3, 0.0]), np.array([0.5, 0.4, 0.1])
    left = relocalized(grown, corner(np.random.default_rng(32)), drift, sigma)
    assert left is not None
    np.testing.assert_allclose(left, 0.0, atol=0.02)


@pytest.mark.parametrize(
    ("drift", "sigma"),
    [
        ((0.08, 0.0, 0.0), (0.5, 0.05, 0.2)),  # it has hardly drifted
        ((0.55, 0.0, 0.2), (0.5, 0.05, 0.2)),  # a step of a stair
        ((0.55, 0.0, 0.0), (0.25, 0.05, 0.2)),  # more than two sigma away
        ((0.2, 0.35, 0.0), (0.5, 0.1, 0.2)),
    ],
)
def test_only_places_that_drift_explains_are_found(
    grown: SweepMatcher, drift: tuple[float, ...], sigma: tuple[float, ...]
) -> None:
    points = corner(np.random.default_rng(33))
    assert relocalized(grown, points, np.array(drift), np.array(sigma)) is None


def test_where_nothing_holds_the_height_it_stays_the_predicted_one(grown: SweepMatcher) -> None:
    drift = DRIFTED + np.array([0.0, 0.0, 0.07])
    found = level_fit(grown, corner(np.random.default_rng(34), floor=0), drift)
    assert found is not None
    left = found.state.position - PLACE
    np.testing.assert_allclose(left[:2], 0.0, atol=0.02)
    assert left[2] == pytest.approx(0.07, abs=0.01)
    # and as uncertain as it was
    sigma = np.sqrt(found.covariance[eskf.POSITION, eskf.POSITION][2, 2])
    assert sigma > 0.9 * DRIFT_SIGMA[2]


def test_what_leaves_the_way_free_as_well_fits_at_no_place(grown: SweepMatcher) -> None:
    assert level_fit(grown, corner(np.random.default_rng(34), floor=0, strip=0)) is None


def unknown(rng: np.random.Generator, count: int) -> F64:
    """Return points beyond the wall that fills the view, where there is no map."""
    return rng.uniform((-4.0, 7.0, -1.0), (4.0, 12.0, 2.0), (count, 3))


def before(rng: np.random.Generator, count: int, gap: tuple[float, float]) -> F64:
    """Return points so far before that wall, where it does not hide its floor or corner."""
    return rng.uniform((0.5, 3.0 - gap[1], 0.0), (3.5, 3.0 - gap[0], 1.5), (count, 3))


@pytest.mark.parametrize(
    "points",
    [
        lambda rng: corner(rng, strip=4),  # a few points fit in many places
        lambda rng: corner(rng, strip=0),
        lambda rng: corner(rng, 25, 10, 8),  # fewer than fifty points
        lambda rng: np.vstack((corner(rng, 25, 30, 60), unknown(rng, 1200))),
        lambda rng: np.vstack((corner(rng), before(rng, 500, (0.15, 0.45)))),
        lambda rng: np.vstack((corner(rng), before(rng, 140, (0.13, 0.2)))),
    ],
)
def test_what_fits_like_a_wrong_place_is_not_found(
    grown: SweepMatcher, points: Callable[[np.random.Generator], F64]
) -> None:
    assert relocalized(grown, points(np.random.default_rng(34))) is None


def test_places_on_one_level_are_searched_where_gravity_tells_which_that_is(
    grown: SweepMatcher,
) -> None:
    points = corner(np.random.default_rng(35))
    assert level_fit(grown, points, gravity=0.0) is None
    few = np.vstack((points[:20], points[300:325], points[325:329]))  # of wall, strip and floor
    assert len(few) == tuning.FAR_MATCHED - 1
    assert relocalized(grown, few) is None


def plate(rng: np.random.Generator, x: float, half: float, count: int) -> F64:
    """Return points of an upright plate across the x axis, so wide to both sides."""
    return rng.uniform((x, -half, -1.2), (x, half, 1.0), (count, 3))


def alley(rng: np.random.Generator, count: int, length: float = 7.0) -> F64:
    """Return points of a floor and of a wall along the x axis."""
    end = -3.0 + length
    floor = rng.uniform((-3.0, -2.0, -1.2), (end, 1.5, -1.2), (count, 3))
    wall = rng.uniform((-3.0, 1.5, -1.2), (end, 1.5, 1.0), (count, 3))
    return np.vstack((floor, wall))


def alley_with(rng: np.random.Generator, *plates: tuple[float, float]) -> SweepMatcher:
    """Return a map of the alley with plates at x, so wide to both sides."""
    matcher = SweepMatcher(OdometryConfig(), np.zeros(3))
    for _ in range(tuning.YOUNG_SWEEPS + 1):
        some = [plate(rng, x, half, 1500) for x, half in plates]
        points = np.vstack((alley(rng, 3000), *some))
        extended(matcher, points + rng.normal(0.0, 0.005, points.shape))
    return matcher


@pytest.mark.parametrize(("plates", "found"), [((2.0,), True), ((2.0, 2.32), False)])
def test_the_place_found_is_the_only_one_that_fits(plates: tuple[float, ...], found: bool) -> None:
    rng = np.random.default_rng(36)
    matcher = alley_with(rng, *((x, 1.5) for x in plates))
    cloud = np.vstack((alley(rng, 150, 4.0), plate(rng, 2.0, 1.5, 40)))
    at = np.array([0.6, 0.0, 0.0])
    assert (relocalized(matcher, cloud + PLACE, at - PLACE) is not None) == found


@pytest.mark.parametrize(("plates", "found"), [((2.32,), True), ((2.0, 2.32), False)])
def test_two_places_that_fit_are_none_even_if_one_is_far_less_likely(
    plates: tuple[float, ...], found: bool
) -> None:
    """They are 0.28 and 0.6 m away, 0.6 and 1.2 sigma."""
    rng = np.random.default_rng(36)
    matcher = alley_with(rng, *((x, 1.5) for x in plates))
    cloud = np.vstack((alley(rng, 150, 4.0), plate(rng, 2.0, 1.5, 40)))
    left = relocalized(matcher, cloud + PLACE, np.array([0.6, 0.0, 0.0]) - PLACE)
    assert (left is not None) == found


@pytest.mark.parametrize("is_in_the_way", [False, True])
def test_no_place_is_found_from_which_a_known_wall_is_seen_through(is_in_the_way: bool) -> None:
    rng = np.random.default_rng(38)
    plates = [(3.0, 1.5), (1.2, 0.5)][: 1 + is_in_the_way]
    matcher = alley_with(rng, *plates)
    # the far plate 0.6 m nearer than it is
    cloud = np.vstack((alley(rng, 80, 4.0), plate(rng, 2.4, 0.5, 120)))
    assert (relocalized(matcher, cloud + PLACE, -PLACE) is None) == is_in_the_way


def test_however_uncertain_a_place_is_no_more_others_are_tried() -> None:
    rng = np.random.default_rng(37)
    basis = level_basis(np.array([0.1, -0.2, -9.8]))
    for sigma in (0.01, 0.4, 3.0, 1e6):
        root = rng.normal(0.0, sigma, (3, 3))
        shifts = level_grid(root @ root.T, basis)
        np.testing.assert_array_equal(shifts[0], 0.0)
        assert 1 <= len(shifts) <= 1.3 * tuning.RELOCALIZE_PLACES
        np.testing.assert_allclose(shifts @ [0.1, -0.2, -9.8], 0.0, atol=1e-9)
        assert np.linalg.norm(shifts, axis=1).max() <= tuning.SEARCH_RADIUS_M[1] + 1e-9
        apart = np.linalg.norm(shifts[:, None] - shifts[None, :], axis=2)
        assert len(shifts) == 1 or apart[apart > 0.0].min() >= tuning.RELOCALIZE_STEP_M - 1e-9


def test_another_map_of_the_same_sweeps_is_begun_with_the_same_corrections() -> None:
    matcher = SweepMatcher(OdometryConfig(), np.zeros(3))
    matcher.drift.corrections = Corrections(np.array([0.001, 0.002, 0.003]), 0.02)
    matcher.notes_sights = False
    other = matcher.for_another_map()
    assert len(other.surfaces) == 0
    assert other.drift.corrections is matcher.drift.corrections
    assert other.drift.began is matcher.drift.corrections
    assert not other.notes_sights


def test_the_map_follows_a_correction_of_the_ranges() -> None:
    def seen(ranges: float) -> Corrections:
        return Corrections(np.zeros(3), ranges)

    matcher = SweepMatcher(OdometryConfig(), np.zeros(3))
    matcher.correct(seen(0.02))  # before there is a map, nothing has to follow
    points = room(np.random.default_rng(5), 6000)
    extended(matcher, points)
    probes = points[::10]
    before = matcher.surfaces.match(probes)
    assert np.abs(before.distances).mean() < 0.02

    def moved() -> float:
        """Return by how much the map has moved away from the sensor, in the mean [m]."""
        found = matcher.surfaces.match(probes)
        outward = np.sign(np.einsum("ni,ni->n", found.normals, probes[found.index]))
        return -float(np.median(outward * found.distances))

    still = moved()
    matcher.correct(seen(0.02 + 0.9 * tuning.RANGE_BIAS_MOVED))
    assert moved() == still
    matcher.correct(seen(0.045))
    assert matcher.drift.corrections.ranges == 0.045
    assert 0.01 < moved() - still < 0.026
    matcher.correct(seen(0.02))
    assert moved() == pytest.approx(still, abs=1e-3)
    matcher.clear()
    matcher.correct(seen(0.05))
    extended(matcher, points)
    assert moved() == pytest.approx(still, abs=1e-3)
