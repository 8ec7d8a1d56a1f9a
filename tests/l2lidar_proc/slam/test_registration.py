"""Submaps, their poses, the place search and the verdict on pairs."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_node.types import F64
from l2lidar_proc.odometry.local_map.surfel_map import SurfelMap
from l2lidar_proc.slam import places, se3
from l2lidar_proc.slam.config import LoopConfig
from l2lidar_proc.slam.places import Place
from l2lidar_proc.slam.se3 import SHIFT
from l2lidar_proc.slam.submap import STEP_M, Submap, SubmapBuilder, SubmapView, SurfaceGrid
from l2lidar_proc.slam.verification import (
    REASONS,
    Match,
    Window,
    likeness,
    obstructions,
    verify,
)
from tests.support.mapping_runs import MappingRun

NARROW = Window(0.6, 0.3, np.radians(3.0))


def submap_of(run: MappingRun, first: int, last: int) -> tuple[F64, Submap]:
    """Return the true frame and the submap of some sweeps."""
    frame = se3.leveled(run.truth[first])
    builder = SubmapBuilder(0.1, 30.0)
    for pose, cloud in zip(run.truth[first:last], run.clouds[first:last], strict=True):
        builder.add(se3.inverse(frame) @ pose, cloud.astype(np.float64))
    return frame, builder.finish()


def test_errors_are_what_exp_adds() -> None:
    rng = np.random.default_rng(0)
    poses = se3.exp(rng.normal(0.0, 1.0, (20, 6)))
    errors = rng.normal(0.0, 1e-3, (20, 6))

    np.testing.assert_allclose(se3.error(poses, poses @ se3.exp(errors)), errors, atol=1e-12)
    np.testing.assert_allclose(
        se3.inverse(poses) @ poses, np.tile(np.eye(4), (20, 1, 1)), atol=1e-9
    )


def test_the_adjoint_moves_small_errors_between_frames() -> None:
    rng = np.random.default_rng(1)
    pose, off = se3.exp(rng.normal(0.0, 1.0, 6)), rng.normal(0.0, 1e-6, 6)

    moved = pose @ se3.exp(off) @ se3.inverse(pose)

    np.testing.assert_allclose(se3.error(np.eye(4), moved), se3.adjoint(pose) @ off, atol=1e-11)


def test_a_submap_keeps_points_to_a_step_and_their_viewpoints(office: MappingRun) -> None:
    _, submap = submap_of(office, 0, 10)
    cloud = office.clouds[0].astype(np.float64)
    builder = SubmapBuilder(0.001, 30.0)
    builder.add(np.eye(4), cloud)

    kept = builder.finish()

    assert np.abs(np.sort(kept.xyz, axis=0) - np.sort(cloud, axis=0)).max() <= STEP_M
    assert submap.points["view"].max() < len(submap.views)
    assert submap.nbytes < 8 * len(submap) + 200


def test_a_sensor_that_stands_still_does_not_make_its_submap_grow(office: MappingRun) -> None:
    builder = SubmapBuilder(0.1, 30.0)
    for _ in range(40):
        builder.add(np.eye(4), office.clouds[0].astype(np.float64))

    assert len(builder._parts) <= 4


def test_space_that_rays_passed_is_free_and_walls_are_not(office: MappingRun) -> None:
    frame, submap = submap_of(office, 0, 10)
    view = SubmapView(submap)
    ahead = se3.inverse(frame) @ office.truth[:12]

    assert view.is_free(ahead[2:, :3, 3]).mean() > 0.8
    assert view.is_free(view.points).mean() < 0.01


def test_the_grid_gives_the_surfaces_that_the_map_gives(office: MappingRun) -> None:
    _, submap = submap_of(office, 0, 10)
    grown = SurfelMap((0.3, 0.6, 1.2), thickness=0.035, least=6)
    grown.add(submap.xyz)
    rng = np.random.default_rng(3)
    low, high = submap.xyz.min(axis=0) - 1.0, submap.xyz.max(axis=0) + 1.0
    points = np.concatenate((submap.xyz, rng.uniform(low, high, (5000, 3))))

    index, normals, distances = SurfaceGrid(grown).match(points)

    expected = grown.match(points)
    order = np.argsort(expected.index)
    np.testing.assert_array_equal(index, expected.index[order])
    np.testing.assert_array_equal(normals, expected.normals[order])
    np.testing.assert_allclose(distances, expected.distances[order], atol=1e-9)


def test_a_cupboard_that_was_not_there_obstructs_and_one_place_seen_twice_does_not(
    office: MappingRun,
) -> None:
    lap = round(len(office.truth) / 1.35)
    first, target = submap_of(office, 10, 20)
    second, query = submap_of(office, lap + 11, lap + 21)
    pose = se3.inverse(first) @ second
    x, z = (axis.ravel() for axis in np.meshgrid(np.arange(-1, 1, 0.1), np.arange(-0.8, 0.8, 0.1)))
    front = np.column_stack((x, np.full(len(x), 0.7), z))  # the wall is 1.1 m beside the way
    placed = se3.transformed(se3.inverse(second) @ office.truth[lap + 16], front)
    cupboard = np.zeros(len(placed), query.points.dtype)
    cupboard["xyz"] = np.rint(placed / STEP_M)
    changed = Submap(np.concatenate((query.points, cupboard)), query.views)
    before, after, old = SubmapView(query), SubmapView(changed), SubmapView(target)

    assert obstructions(before, old, pose, 3000) == 0.0
    assert obstructions(after, old, pose, 3000) > 10 / len(after.source)
    assert obstructions(old, after, se3.inverse(pose), 3000) == 0.0


@pytest.mark.parametrize(("x", "y", "yaw"), [(0.9, -0.4, 0.1), (-1.4, 1.2, -0.05)])
def test_a_turned_and_shifted_plan_is_found_again(
    office: MappingRun, x: float, y: float, yaw: float
) -> None:
    _, submap = submap_of(office, 0, 10)
    target = SubmapView(submap).structure
    back = se3.inverse(se3.planar(x, y, yaw))
    query = se3.transformed(back, np.column_stack((target, np.zeros(len(target)))))[:, :2]

    near = places.near(query, target, Place(0.0, 0.0, 0.0, 0.0), 2.0, 0.2, 4)[0]
    anywhere = places.anywhere(query, target, np.zeros((1, 2)), 5.0, 4)[0]

    for found, reach in ((near, 0.3), (anywhere, 0.6)):
        assert np.hypot(found.x - x, found.y - y) < reach
        assert abs(se3.yaw_of(se3.planar(0, 0, found.yaw - yaw))) < 0.06
        assert found.score > 0.7


def test_two_walks_past_one_place_match_to_a_centimeter(office: MappingRun) -> None:
    lap = round(len(office.truth) / 1.35)
    first, target = submap_of(office, 10, 20)
    second, query = submap_of(office, lap + 11, lap + 21)
    true = se3.inverse(first) @ second

    found = verify(
        SubmapView(query),
        SubmapView(target),
        true @ se3.exp((0.0, 0.0, 0.02, 0.35, -0.3, 0.1)),
        NARROW,
        LoopConfig(),
    )

    assert isinstance(found, Match)
    turn, way = se3.magnitude(se3.error(true, found.T_target_query))
    assert way < 0.015
    assert np.degrees(turn) < 0.15
    assert np.sqrt(np.diag(found.covariance)[SHIFT]).max() < 0.05


@pytest.mark.parametrize("other", [30, 45, 60])
def test_other_places_do_not_match(office: MappingRun, other: int) -> None:
    first, target = submap_of(office, 4, 14)
    second, query = submap_of(office, other, other + 10)
    same_heading = se3.planar(0.0, 0.0, se3.yaw_of(se3.inverse(first) @ second))

    found = verify(SubmapView(query), SubmapView(target), same_heading, NARROW, LoopConfig())

    assert found in REASONS


def test_likeness_compares_what_contradicts() -> None:
    assert likeness(0.5, 0.99) < 0.1
    assert likeness(0.99, 0.99) == 1.0
    assert likeness(0.95, 0.98) == pytest.approx(0.04 / 0.07)
