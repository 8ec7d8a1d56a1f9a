"""A bias of the ranges is found from the planes of clouds, and none where there is none."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.odometry.intrinsics.lidar_intrinsics import LidarIntrinsics
from l2lidar_proc.odometry.intrinsics.range_bias import (
    RangeBias,
    SeenAgain,
    bend_of_map,
    bend_of_planes,
)
from tests.l2lidar_proc.odometry.intrinsics.test_lidar_intrinsics import CLOUD, turn

BOX = np.array([4.2, 3.3, 2.7])  # [m] half the edges
SEEDS = range(24)


def box(bias: float, seed: int, *, rough: float = 0.0, edges: F64 = BOX) -> NDArray[np.void]:
    """Return points of a box, whose ranges are too long by a bias [m], seen from near its middle.

    Parameters
    ----------
    rough : float
        1 sigma of how far each patch of a wall, 0.7 m wide, is off its plane [m].
    """
    rng = np.random.default_rng(seed)
    sights = rng.normal(size=(20000, 3))
    sights /= np.linalg.norm(sights, axis=1)[:, None]
    place = rng.uniform(-0.3, 0.3, 3)
    reach = (np.sign(sights) * edges - place) / sights
    wall = reach.argmin(axis=1)
    ranges = reach.min(axis=1)
    at = place + ranges[:, None] * sights
    patch = np.floor(at / 0.7).astype(np.int64) @ (1, 100, 10000)
    _, number = np.unique(patch, return_inverse=True)
    off = rough * rng.normal(size=number.max() + 1)[number]
    ranges = ranges + off / np.abs(sights[np.arange(len(wall)), wall])
    ranges += bias + 0.012 * rng.normal(size=len(ranges))
    cloud = np.zeros(len(ranges), CLOUD)
    for name, line in zip("xyz", (ranges[:, None] * sights).T, strict=True):
        cloud[name] = line
    return cloud


@pytest.mark.parametrize("bias", [0.03, 0.0, -0.02])
def test_the_bias_of_a_box_is_found_from_one_sweep(bias: float) -> None:
    information, gradient = bend_of_planes(box(bias, 0))
    assert information > 1.0 / 0.005**2
    assert gradient / information == pytest.approx(-bias, abs=0.005)


def test_a_bias_is_known_as_well_as_it_says() -> None:
    """Rough walls bend as well; NEES over boxes of which a sweep each was seen."""
    rng = np.random.default_rng(7)
    nees = []
    for seed in SEEDS:
        bias = tuning.RANGE_BIAS_SIGMA * rng.normal()
        ranges = RangeBias()
        ranges.learn(box(bias, seed, rough=0.012, edges=rng.uniform(2.5, 6.0, 3)))
        nees.append(((ranges._estimate + bias) ** 2) / ranges._variance)
    assert np.mean(nees) < 1.5
    assert max(nees) < 10.8  # 99.9 % of one degree of freedom


def test_points_move_along_their_rays() -> None:
    ranges = RangeBias()
    points = box(0.03, 1)
    ranges.learn(points)
    assert ranges.correction == pytest.approx(-0.03, abs=0.003)
    moved = points.copy()
    ranges.correct(moved)
    before, after = (np.stack([some[name] for name in "xyz"], axis=1) for some in (points, moved))
    lengths = np.linalg.norm(before, axis=1)
    np.testing.assert_allclose(
        np.linalg.norm(after, axis=1) - lengths, ranges.correction, atol=1e-5
    )
    np.testing.assert_allclose(np.cross(before, after) / lengths[:, None], 0.0, atol=1e-5)


def test_what_was_corrected_is_not_corrected_again() -> None:
    ranges = RangeBias()
    for seed in range(20):
        points = box(0.03, seed)
        used = ranges.correction
        ranges.correct(points)
        ranges.learn(points, used=used)
    assert ranges.correction == pytest.approx(-0.03, abs=0.002)
    assert tuning.RANGE_BIAS_FLOOR <= ranges.sigma_with(ranges.correction) < 0.005


def test_without_planes_nothing_is_known() -> None:
    rng = np.random.default_rng(0)
    cloud = np.zeros(20000, CLOUD)
    for name in "xyz":
        cloud[name] = rng.uniform(-6.0, 6.0, len(cloud))
    assert bend_of_planes(cloud)[0] < 1.0 / tuning.RANGE_BIAS_SIGMA**2
    for some in (cloud[:0], cloud[:5]):
        assert bend_of_planes(some) == (0.0, 0.0)
    ranges = RangeBias()
    ranges.learn(cloud[:0])
    assert ranges.correction == 0.0
    assert ranges.sigma_with(ranges.correction) == pytest.approx(tuning.RANGE_BIAS_SIGMA, rel=0.02)


def test_what_is_very_near_tells_nothing() -> None:
    """Ranges are not linear there, which bends what is near as a bias does."""
    near = box(0.0, 0, edges=np.full(3, 0.8))
    assert bend_of_planes(near) == (0.0, 0.0)


def test_a_small_bias_is_left_until_planes_show_it_surely() -> None:
    """4 mm bend a corridor of 70 m by 3 mrad; a few planes may show as much where none is."""
    ranges = RangeBias()
    ranges.learn(box(0.004, 3)[::2])
    assert not ranges.needs_map
    assert ranges.correction == 0.0
    left = ranges.sigma_with(ranges.correction)
    assert tuning.RANGE_BIAS_SURE < left < tuning.RANGE_BIAS_KNOWN
    for seed in range(4, 10):
        ranges.learn(box(0.004, seed))
    assert ranges.correction == pytest.approx(-0.004, abs=0.002)
    assert ranges.sigma_with(ranges.correction) < tuning.RANGE_BIAS_SURE


UP = np.array([0.0, 0.0, 9.8])  # [m/s^2] specific force of a sensor at rest, upright


def ground(
    curvature: tuple[float, float],
    *,
    bias: float = 0.0,
    rough: float = 0.0,
    height: float = -1.8,
) -> NDArray[np.void]:
    """Return points of a surface below or above a sensor that looks ahead, out to 6 m.

    Parameters
    ----------
    curvature : tuple of float
        Along x and y [1/m].
    bias : float
        By which ranges are too long [m].
    rough : float
        Amplitude of waves of 2 m [m].
    height : float
        [m]
    """
    rng = np.random.default_rng(2)
    sights = rng.normal(size=(30000, 3))
    sights /= np.linalg.norm(sights, axis=1)[:, None]
    sights = sights[(sights[:, 2] * np.sign(height) > 0.25) & (sights[:, 0] > -0.1)]
    ranges = height / sights[:, 2]
    for _ in range(20):
        at = ranges[:, None] * sights[:, :2]
        waves = rough * (np.sin(np.pi * at[:, 0]) + np.cos(np.pi * at[:, 1]))
        ranges = (height + at**2 @ (0.5 * np.array(curvature)) + waves) / sights[:, 2]
    near = np.linalg.norm(ranges[:, None] * sights[:, :2], axis=1) < 6.0
    ranges = ranges[near] + bias + 0.012 * rng.normal(size=np.count_nonzero(near))
    cloud = np.zeros(len(ranges), CLOUD)
    for name, line in zip("xyz", (ranges[:, None] * sights[near]).T, strict=True):
        cloud[name] = line
    return cloud


@pytest.mark.parametrize("bias", [0.0, 0.03])
def test_a_level_floor_shows_the_bias(bias: float) -> None:
    information, gradient = bend_of_planes(ground((0.0, 0.0), bias=bias), UP)
    assert information > 1.0 / 0.012**2
    assert gradient / information == pytest.approx(-bias, abs=0.004)


@pytest.mark.parametrize(
    "curvature", [(0.0, -0.001), (0.0, -0.004), (0.004, 0.004), (-0.002, 0.002)]
)
def test_ground_that_is_curved_shows_no_bias(curvature: tuple[float, float]) -> None:
    """A road that falls to its sides; what rises passes for ranges too short, up to 0.1 m."""
    curved = ground(curvature)
    for force in (UP, None, np.zeros(3)):
        assert bend_of_planes(curved, force) == (0.0, 0.0)
    information, gradient = bend_of_planes(curved, -UP)  # a ceiling
    assert information > 0.0
    assert abs(gradient / information) > 0.01


def test_ground_as_uneven_as_a_lawn_shows_no_bias() -> None:
    assert bend_of_planes(ground((0.0, 0.0), rough=0.02), UP) == (0.0, 0.0)
    flat = bend_of_planes(ground((0.0, 0.0), rough=0.0005), UP)
    assert flat[0] > 0.0


def test_walls_count_beside_uneven_ground() -> None:
    walls = box(0.03, 4, edges=np.array([4.2, 3.3, 2.5]))
    walls = walls[walls["z"] > -1.4]
    both = np.concatenate((walls, ground((0.0, 0.0), rough=0.02, bias=0.03)))
    information, gradient = bend_of_planes(both, UP)
    assert information > 1.0 / 0.01**2
    assert gradient / information == pytest.approx(-0.03, abs=0.006)


def test_a_bias_larger_than_that_of_any_unit_has_another_cause() -> None:
    ranges = RangeBias()
    for _ in range(20):
        ranges.learn(ground((0.0, -0.008)), rest_force=-UP)
    assert not ranges.needs_map
    assert ranges._estimate > tuning.RANGE_BIAS_MOST
    assert ranges.correction == 0.0
    assert ranges.sigma_with(0.0) > tuning.RANGE_BIAS_MOST


def test_clouds_of_another_sensor_are_left_as_they_are() -> None:
    intrinsics = LidarIntrinsics()
    for seed in range(25):
        sweep, _ = turn((0.0, 0.0, 0.0), seed)
        other = dataclasses.replace(sweep, points=box(0.03, seed))
        assert intrinsics.corrected(other) is other
        intrinsics.learn(other, other.points, at_rest=False)
    assert intrinsics.errors.ranges == 0.0
    assert intrinsics.ranges.correction == 0.0


def test_a_rest_shows_the_bias_and_ends_with_what_it_taught() -> None:
    intrinsics = LidarIntrinsics()
    sweeps = []
    for number in range(12):
        sweep, _ = turn((0.0, 0.0, 0.0), number)
        at = np.stack([sweep.points[name] for name in "xyz"], axis=1)
        longer = at * (1.0 + 0.03 / np.linalg.norm(at, axis=1))[:, None]
        for name, line in zip("xyz", longer.T, strict=True):
            sweep.points[name] = line
        sweeps.append(sweep)
        intrinsics.head(sweep)
    intrinsics.learn_at_rest(sweeps)
    assert intrinsics.ranges.correction == pytest.approx(-0.03, abs=0.004)
    corrected = intrinsics.applied_to(sweeps[0]).points
    information, gradient = bend_of_planes(corrected)
    assert abs(gradient / information) < 0.004
    intrinsics.forget()
    assert intrinsics.ranges.correction == 0.0


NOISE = 0.01  # [m] of a point beside a surface, in these maps


def seen_again(
    bias: float, seed: int, *, used: float = 0.0, mapped_with: float = 0.0, pose: F64 | None = None
) -> SeenAgain:
    """Return rough ground seen from 1.2 m above it, by a sensor that has come 2 m nearer to it.

    Parameters
    ----------
    bias : float
        By which ranges are too long [m].
    used, mapped_with : float
        Corrections of the sweep's ranges and of the map's [m].
    pose : ndarray, shape (6,), optional
        A shift [m] and a turn [rad] that the sweep is off by.
    """
    rng = np.random.default_rng(seed)
    places = np.column_stack((rng.uniform(-8.0, 8.0, (1500, 2)), np.full(1500, -1.2)))
    places = places[np.linalg.norm(places, axis=1) > tuning.RANGE_BIAS_NEAREST]
    normals = np.array([0.0, 0.0, 1.0]) + 0.2 * rng.normal(size=places.shape)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    mapped = places + np.array([2.0, 0.0, 0.0])
    lines = mapped / np.linalg.norm(mapped, axis=1)[:, None]
    sights = places / np.linalg.norm(places, axis=1)[:, None]
    moved = (bias + used) * sights - (bias + mapped_with) * lines
    if pose is not None:
        moved += pose[:3] + np.cross(pose[3:], places)
    distances = (moved * normals).sum(axis=1) + NOISE * rng.normal(size=len(places))
    return SeenAgain(places, normals, distances, lines, mapped_with * lines, used)


@pytest.mark.parametrize(("used", "mapped_with"), [(0.0, 0.0), (-0.02, 0.0), (-0.02, -0.01)])
@pytest.mark.parametrize("bias", [0.03, 0.0, -0.02])
def test_the_bias_shows_in_a_map_that_was_seen_from_elsewhere(
    bias: float, used: float, mapped_with: float
) -> None:
    pose = np.array([0.02, -0.01, 0.03, 0.002, -0.003, 0.001])
    found = [
        bend_of_map(seen_again(bias, seed, used=used, mapped_with=mapped_with, pose=pose))
        for seed in SEEDS
    ]
    information, gradient = np.sum(found, axis=0)
    assert information > 1.0 / 0.005**2
    assert gradient / information == pytest.approx(-bias, abs=0.003)


def test_a_map_is_known_as_well_as_it_says() -> None:
    """NEES over biases, each shown by some sweeps whose points err alike in part."""
    rng = np.random.default_rng(8)
    nees: list[float] = []
    for bias in tuning.RANGE_BIAS_SIGMA * rng.normal(size=24):
        ranges = RangeBias()
        for number in range(40):
            seed = 1000 * len(nees) + number // 3  # each three sweeps have the same errors
            ranges.learn_from_map(seen_again(bias, seed, used=ranges.correction))
        nees.append((ranges._estimate + bias) ** 2 / ranges._variance)
    assert np.mean(nees) < 1.5
    assert max(nees) < 10.8  # 99.9 % of one degree of freedom


def test_a_map_that_was_seen_from_the_same_places_tells_nothing() -> None:
    seen = seen_again(0.03, 0)
    same = seen.places / np.linalg.norm(seen.places, axis=1)[:, None]
    assert bend_of_map(seen._replace(lines=same))[0] == pytest.approx(0.0, abs=1e-6)
    few = seen._replace(places=seen.places[:40], normals=seen.normals[:40])
    few = few._replace(distances=seen.distances[:40], lines=seen.lines[:40])
    few = few._replace(corrected=seen.corrected[:40])
    assert bend_of_map(few) == (0.0, 0.0)
    wall = seen._replace(normals=np.tile([1.0, 0.0, 0.0], (len(same), 1)))
    assert np.isfinite(bend_of_map(wall)).all()


def test_the_map_corrects_slowly_what_planes_do_not_show() -> None:
    ranges = RangeBias()
    corrections = [0.0]
    for seed in range(60):
        ranges.learn_from_map(seen_again(0.03, seed, used=ranges.correction))
        corrections.append(ranges.correction)
    steps = np.abs(np.diff(corrections))
    assert steps.max() == pytest.approx(tuning.RANGE_BIAS_STEP)
    assert ranges.correction == pytest.approx(-0.03, abs=0.004)
    assert tuning.RANGE_BIAS_MAP_FLOOR <= ranges.sigma_with(ranges.correction) < 0.01
    ranges.forget()
    assert ranges.correction == 0.0
    assert ranges.sigma_with(ranges.correction) > 0.02


def test_a_correction_by_the_map_does_not_come_and_go() -> None:
    """Once in use, it follows the estimate, however near to zero that is."""
    ranges = RangeBias()
    for seed in range(60):
        ranges.learn_from_map(seen_again(0.03, seed, used=ranges.correction))
    for seed in range(400):
        ranges.learn_from_map(seen_again(-0.002, seed, used=ranges.correction))
    assert ranges.correction == pytest.approx(0.002, abs=0.002)
    assert ranges.correction != 0.0
    unbiased = RangeBias()
    for seed in range(60):
        unbiased.learn_from_map(seen_again(0.002, seed))
    assert unbiased.correction == 0.0


def test_few_planes_correct_nothing_before_the_map_does() -> None:
    """A cone of 70 degrees saw one plane, at rest, that seemed to show 28 mm; 12 mm of sigma."""
    ranges = RangeBias()
    ranges._information += 1.0 / 0.014**2
    ranges._weighted -= 0.04 / 0.014**2
    assert ranges.needs_map
    assert abs(ranges._estimate) > 2.0 * ranges._variance**0.5
    ranges.learn_from_map(seen_again(0.03, 0)._replace(distances=np.zeros(0)))
    assert ranges.correction == 0.0


def test_planes_that_come_into_sight_do_not_undo_what_the_map_has_shown() -> None:
    """They are as wrong as furniture bends them: together they know it best."""
    ranges = RangeBias()
    for seed in range(60):
        ranges.learn_from_map(seen_again(0.03, seed, used=ranges.correction))
    before, sigma = ranges.correction, ranges.sigma_with(ranges.correction)
    ranges.learn(box(0.012, 1), used=0.0)
    assert not ranges.needs_map
    assert before < ranges.correction < -0.012
    assert ranges.sigma_with(ranges.correction) < sigma


def test_planes_count_alone_where_they_show_the_bias() -> None:
    ranges = RangeBias()
    ranges.learn(box(0.03, 1))
    assert not ranges.needs_map
    known = ranges.correction, ranges.sigma_with(0.0)
    for seed in range(20):
        ranges.learn_from_map(seen_again(-0.05, seed, used=ranges.correction))
    assert (ranges.correction, ranges.sigma_with(0.0)) == known


def test_the_map_says_nothing_while_the_beams_are_unknown() -> None:
    """Halves of the fan that are apart bend it too: a wood seemed to show 50 mm."""
    unknown, known = LidarIntrinsics(), LidarIntrinsics()
    known.learn_at_rest([turn((0.0, 0.0, 0.0), number)[0] for number in range(12)])
    known.ranges.forget()  # what the planes of that room have shown
    for intrinsics in (unknown, known):
        for seed in range(40):
            intrinsics.learn_from_map(seen_again(0.03, seed))
    assert unknown.ranges.correction == 0.0
    assert unknown.errors.ranges > tuning.RANGE_BIAS_SIGMA
    assert known.ranges.correction == pytest.approx(-0.03, abs=0.006)
