"""Weak directions of a carrier that drives: whose normals count, and which way is weak."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from l2lidar_node.types import F64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.odometry.config import SurfaceConfig
from l2lidar_proc.odometry.local_map.surfel_map import SurfelMap
from l2lidar_proc.odometry.local_map.surfels import YoungSurfaces
from l2lidar_proc.odometry.registration import weak_directions
from l2lidar_proc.odometry.registration.alignment import Alignment, align
from l2lidar_proc.odometry.registration.correspondences import Source, correspondences
from l2lidar_proc.odometry.registration.weak_directions import WeakAxes, weak_axes

SIZES = (0.15, 0.3, 0.6, 1.5)
REACH = 0.15


def at(*place: float) -> InertialState:
    zero = np.zeros(3)
    down = np.array([0.0, 0.0, -9.8])
    where = np.array(place) if place else zero
    return InertialState(HostNs(0), np.eye(3), where, zero, zero, zero, down)


def source(points: F64) -> Source:
    return Source(points, np.zeros(len(points)), np.linalg.norm(points, axis=1))


def walls(rng: np.random.Generator, count: int, turn: float = 0.0) -> F64:
    """Return points of two walls and a floor along x, turned about z by an angle."""
    points = rng.uniform((-4.0, -1.2, -1.0), (4.0, 1.2, 1.5), (count, 3))
    kind = rng.integers(0, 3, count)
    points[kind == 0, 1], points[kind == 1, 1], points[kind == 2, 2] = -1.2, 1.2, -1.0
    points += 0.01 * rng.standard_normal(points.shape)
    c, s = np.cos(turn), np.sin(turn)
    return points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def reveals(rng: np.random.Generator, count: int) -> F64:
    """Return points of three strips at a wall that face along x."""
    strips = [
        rng.uniform((x, 0.7, -0.9), (x, 1.15, 1.4), (count // 3, 3)) for x in (-2.02, 0.52, 2.92)
    ]
    points = np.vstack(strips)
    points[:, 0] += 0.01 * rng.standard_normal(len(points))
    return points


def mapped(rng: np.random.Generator, *, facing: int = 0, since: int = 0) -> SurfelMap:
    """Return a map of the corridor, with so many points of reveals in each sweep since one."""
    surfaces = SurfelMap(SIZES)
    for number in range(12):
        seen = reveals(rng, facing * (number >= since))
        surfaces.add(np.vstack((walls(rng, 4000), seen)), number)
    return surfaces


def off(weak: WeakAxes) -> float:
    """Return how far the weakest direction is off the corridor's [degrees]."""
    return float(np.degrees(np.arccos(min(abs(weak.axes[3, 0]), 1.0))))


def weak_in(
    surfaces: SurfelMap,
    points: F64,
    state: InertialState | None = None,
    *,
    driving: bool = True,
    before: F64 | None = None,
) -> WeakAxes:
    state = at() if state is None else state
    found = correspondences(state, state, source(points), surfaces, SurfaceConfig(), REACH)
    weak = weak_axes(state, found, surfaces, driving=driving, normal_scatter=before)
    assert weak is not None
    return weak


@pytest.mark.parametrize("count", [8, 40])
def test_tilts_are_the_errors_of_fitted_normals(count: int) -> None:
    """One point in each sweep, so that the errors are independent.

    A plane through few points takes up some of their scatter, so their tilts come out smaller.
    """
    rng, noise = np.random.default_rng(3), 1.5 * tuning.NORMAL_SCATTER
    angles, expected = [], []
    for _ in range(150):
        surfaces = SurfelMap((1.0,), thickness=0.1)
        points = rng.uniform((0.1, 0.1, 0.5), (0.9, 0.5, 0.5), (count, 3))
        points[:, 2] += noise * rng.standard_normal(count)
        for number, point in enumerate(points):
            surfaces.add(point[None], number)
        met = surfaces.match(np.array([[0.5, 0.3, 0.5]]))
        if not len(met.index):
            continue
        normal = met.normals[0] * np.sign(met.normals[0, 2])
        tilts = surfaces.tilts(met.cells, met.axis)[0]
        np.testing.assert_allclose(tilts @ met.normals[0], 0.0, atol=1e-9)
        angles.append(normal[:2])
        expected.append((tilts**2).sum(axis=0)[:2])  # towards x and y
    assert len(angles) > 100
    ratio = np.mean(np.square(angles), axis=0) / np.mean(expected, axis=0)
    assert (np.abs(np.log(ratio)) < np.log(2.0)).all(), ratio


def test_a_normal_that_is_hardly_known_faces_nothing() -> None:
    """A few points in two sweeps, 30 degrees off the wall by chance, against a reveal."""
    rng = np.random.default_rng(5)
    surfaces = mapped(rng, facing=600)
    slope = np.tan(np.radians(30.0))
    patch = rng.uniform((0.01, 0.0, 0.01), (0.13, 0.0, 0.13), (6, 3))
    patch[:, 1] = 0.14 - slope * patch[:, 0]
    patch += np.array([3.6, 0.3, 0.15])  # in one cell of the finest level
    for number in (0, 1):
        surfaces.add(patch + rng.normal(0.0, 0.001, patch.shape), number)
    surfaces.add(walls(rng, 100), 12)
    seen = np.vstack((walls(rng, 2000), reveals(rng, 90), patch))
    found = correspondences(at(), at(), source(seen), surfaces, SurfaceConfig(), REACH)
    is_chance = found.index >= len(seen) - len(patch)
    assert np.count_nonzero(is_chance) >= 3
    by_hand, driven = (
        weak_axes(at(), found, surfaces),
        weak_axes(at(), found, surfaces, driving=True),
    )
    assert by_hand is not None
    assert driven is not None
    assert by_hand.normal_scatter is None
    assert by_hand.facing(at(), found)[is_chance, 0].all()
    assert not driven.facing(at(), found)[is_chance, 0].any()
    is_reveal = (found.index >= 2000) & ~is_chance & (np.abs(found.normals[:, 0]) > 0.9)
    assert np.count_nonzero(is_reveal) > 20
    assert driven.facing(at(), found)[is_reveal, 0].mean() > 0.9


def test_a_surface_hardly_wider_than_the_noise_does_not_tell_the_way() -> None:
    """Scan lines on the leaf of a door, behind its frame, look like the reveal."""
    rng = np.random.default_rng(15)
    surfaces = mapped(rng, facing=600)

    def leaf(count: int, width: float) -> F64:
        points = rng.uniform((3.61, 0.31, -0.8), (3.61, 0.31 + width, 1.2), (count, 3))
        points[:, 0] += 0.003 * rng.standard_normal(count)
        return points

    faces = []
    for width in (0.08, 0.13):  # standard deviations of 23 and 38 mm
        for number in range(8):
            surfaces.add(leaf(200, width), number)
        surfaces.add(walls(rng, 100), 12)
        seen = np.vstack((walls(rng, 2000), reveals(rng, 90), leaf(30, width)))
        found = correspondences(at(), at(), source(seen), surfaces, SurfaceConfig(), REACH)
        driven = weak_axes(at(), found, surfaces, driving=True)
        assert driven is not None
        some = (found.index >= len(seen) - 30) & (np.abs(found.normals[:, 0]) > 0.9)
        assert np.count_nonzero(some) > 10
        faces.append(float(driven.facing(at(), found)[some, 0].mean()))
        by_hand = weak_axes(at(), found, surfaces)
        assert by_hand is not None
        assert by_hand.facing(at(), found)[some, 0].mean() > 0.9
    assert faces[0] < 0.1
    assert faces[1] > 0.9


def test_what_faces_the_direction_does_not_bend_it() -> None:
    """Oblique surfaces on one side only turn the weakest direction of all points away."""
    rng = np.random.default_rng(8)
    surfaces = SurfelMap(SIZES)
    oblique = rng.uniform((-3.0, 0.0, -0.5), (3.0, 0.0, 0.5), (1500, 3))
    oblique[:, 1] = 0.8 - np.mod(oblique[:, 0], 0.6)  # saw teeth of 45 degrees
    for number in range(12):
        surfaces.add(np.vstack((walls(rng, 4000), oblique)), number)
    seen = np.vstack((walls(rng, 2000), oblique[::10]))
    plain, steady = weak_in(surfaces, seen, driving=False), weak_in(surfaces, seen)

    assert off(plain) > 2.0
    assert off(steady) < 0.5
    # also where the way before was another, so that only this sweep counts
    assert off(weak_in(surfaces, seen, before=np.diag([1.0, 0.0, 1.0]) * 1e6)) < 1.0
    np.testing.assert_allclose(
        steady.axes.T @ steady.axes, np.eye(steady.axes.shape[1]), atol=1e-9
    )


def test_the_direction_is_steadied_until_the_way_bends() -> None:
    rng = np.random.default_rng(9)
    surfaces = mapped(rng)
    scatter, single, steadied = np.zeros((3, 3)), [], []
    for _ in range(30):
        seen = walls(rng, 150)
        single.append(weak_in(surfaces, seen).axes[4, 0])
        weak = weak_in(surfaces, seen, before=scatter)
        assert weak.normal_scatter is not None
        scatter = weak.normal_scatter
        steadied.append(weak.axes[4, 0] * np.sign(weak.axes[3, 0]))
    assert np.std(steadied[10:]) < 0.5 * np.std(np.abs(single))
    # around a corner, only what is seen now counts
    corner = SurfelMap(SIZES)
    for number in range(12):
        corner.add(walls(rng, 4000, np.pi / 2.0), number)
    weak = weak_in(corner, walls(rng, 1000, np.pi / 2.0), before=scatter)
    assert abs(weak.axes[4, 0]) > 0.999
    bend = SurfelMap(SIZES)
    for number in range(12):
        bend.add(walls(rng, 4000, 1.5 * tuning.WALL_BEND), number)
    weak = weak_in(bend, walls(rng, 1000, 1.5 * tuning.WALL_BEND), before=scatter)
    slope = np.arctan(weak.axes[4, 0] / weak.axes[3, 0])
    assert slope == pytest.approx(1.5 * tuning.WALL_BEND, abs=0.02)


def test_normals_that_are_hardly_known_do_not_bend_the_direction() -> None:
    """Cells of a few points in two sweeps, all of them 15 degrees off the wall."""
    rng = np.random.default_rng(12)
    surfaces = mapped(rng)
    patches = []
    for x in np.arange(-3.6, 3.6, 0.3):
        patch = rng.uniform((0.01, 0.0, 0.01), (0.13, 0.0, 0.13), (6, 3))
        patch[:, 1] = 0.1 - np.tan(np.radians(15.0)) * patch[:, 0]
        patches.append(patch + np.array([x, 0.3, 0.15]))
    cells = np.vstack(patches)
    for number in (0, 1):
        surfaces.add(cells + rng.normal(0.0, 0.001, cells.shape), number)
    surfaces.add(walls(rng, 100), 12)
    seen = np.vstack((walls(rng, 300), cells))
    assert off(weak_in(surfaces, seen, driving=False)) > 2.0
    assert off(weak_in(surfaces, seen)) < 0.6


def test_surfaces_count_sooner_where_the_carrier_drives() -> None:
    rng = np.random.default_rng(13)
    surfaces = mapped(rng, facing=600, since=12 - tuning.DRIVING_AGE - 2)
    seen = np.vstack((walls(rng, 2000), reveals(rng, 90)))
    found = correspondences(at(), at(), source(seen), surfaces, SurfaceConfig(), REACH)
    by_hand, driven = (
        weak_axes(at(), found, surfaces),
        weak_axes(at(), found, surfaces, driving=True),
    )
    assert by_hand is not None
    assert driven is not None
    is_reveal = (found.index >= 2000) & (np.abs(found.normals[:, 0]) > 0.9)
    assert np.count_nonzero(is_reveal) > 20
    assert not by_hand.facing(at(), found)[is_reveal, 0].any()
    assert driven.facing(at(), found)[is_reveal, 0].mean() > 0.5


@pytest.mark.parametrize(("sweeps", "counts"), [(3, False), (4, True)])
def test_what_people_have_left_behind_does_not_tell_the_way(sweeps: int, counts: bool) -> None:
    """A surface counts if enough sweeps have seen it, however long ago it was first seen."""
    rng, surfaces = np.random.default_rng(14), SurfelMap(SIZES)
    for number in range(12):
        seen = reveals(rng, 600 * (2 <= number < 2 + sweeps))
        surfaces.add(np.vstack((walls(rng, 4000), seen)), number)
    seen = np.vstack((walls(rng, 2000), reveals(rng, 90)))
    found = correspondences(at(), at(), source(seen), surfaces, SurfaceConfig(), REACH)
    driven = weak_axes(at(), found, surfaces, driving=True)
    assert driven is not None
    is_reveal = (found.index >= 2000) & (np.abs(found.normals[:, 0]) > 0.9)
    assert np.count_nonzero(is_reveal) > 20
    facing = driven.facing(at(), found)[is_reveal, 0]
    assert (facing.mean() > 0.5) == counts


def test_up_is_no_way_to_drive() -> None:
    """A shaft leaves the height open: there the carrier is as any other."""
    rng = np.random.default_rng(10)
    surfaces = SurfelMap(SIZES)

    def shaft(count: int) -> F64:
        points = rng.uniform(-1.2, 1.2, (count, 3))
        side = rng.integers(0, 2, count)
        points[np.arange(count), side] = rng.choice((-1.2, 1.2), count)
        return points + 0.01 * rng.standard_normal(points.shape)

    for number in range(12):
        surfaces.add(shaft(4000), number)
    weak = weak_in(surfaces, shaft(2000))
    assert abs(weak.axes[5, 0]) > 0.99
    assert weak.normal_scatter is None


def test_points_that_thinning_left_out_fix_the_place_if_they_face_the_way() -> None:
    rng = np.random.default_rng(4)
    surfaces = mapped(rng, facing=600)
    thin, more = source(walls(rng, 1000)), source(np.vstack((walls(rng, 1000), reveals(rng, 90))))
    thin = dataclasses.replace(thin, denser=lambda: more)
    covariance = 1e-6 * np.eye(eskf.ERRORS)
    covariance[eskf.POSITION, eskf.POSITION] = 0.02**2 * np.eye(3)

    def found(*, driving: bool) -> Alignment:
        alignment = align(
            at(0.015, 0.0, 0.0), covariance, thin, surfaces, SurfaceConfig(), 100, driving=driving
        )
        assert alignment is not None
        return alignment

    by_hand, driven = found(driving=False), found(driving=True)
    assert by_hand.normal_scatter is None
    assert by_hand.state.position[0] == pytest.approx(0.015, abs=0.005)
    assert driven.state.position[0] == pytest.approx(0.0, abs=0.006)
    assert driven.covariance[3, 3] < 0.3 * by_hand.covariance[3, 3]
    # of the others, which say nothing new, none is added
    assert len(thin.points) < driven.matched < len(thin.points) + 2 * 90


def along_way(prior: float, count: int, offset: float = 0.0) -> tuple[float, float]:
    """Return the place along a corridor and its sigma [m], with points of reveals in view.

    The carrier drives; its place along the corridor was known to the prior's sigma.
    """
    rng = np.random.default_rng(4)
    surfaces = mapped(rng, facing=600)
    seen = source(np.vstack((walls(rng, 1000), reveals(rng, count))))
    covariance = 1e-6 * np.eye(eskf.ERRORS)
    covariance[3, 3] = prior**2
    # the direction that is found differs from x by some mrad
    covariance[4, 4] = covariance[5, 5] = 1e-6 + (0.02 * prior) ** 2
    found = align(
        at(offset, 0.0, 0.0), covariance, seen, surfaces, SurfaceConfig(), 100, driving=True
    )
    assert found is not None
    return float(found.state.position[0]), float(np.sqrt(found.covariance[3, 3]))


def test_the_less_is_known_of_the_place_the_less_a_few_points_tell() -> None:
    """What is near the prediction may be another surface."""
    known, hardly, lost = (along_way(prior, 18)[1] / prior for prior in (0.03, 0.3, 2.0))
    assert known < 0.7 < 0.8 < hardly < 0.9 < lost < 1.0
    assert along_way(0.3, 39)[1] < 0.6 * 0.3  # more points are less often others


def test_what_may_be_another_surface_moves_the_place_by_as_much_less() -> None:
    shift = 0.02
    sure, hardly = (
        shift - along_way(prior, 18, shift)[0] + along_way(prior, 18)[0] for prior in (0.03, 0.3)
    )
    assert 0.4 * shift < sure < shift
    assert 0.0 < hardly < 0.3 * shift


def test_what_lies_far_from_the_prediction_is_hardly_the_surface_expected_there() -> None:
    """The innovation is that from the prediction, however well the sweep fits in the end."""
    near, far = (along_way(0.01, 18, offset)[1] / 0.01 for offset in (0.0, 0.05))
    assert near < 0.9
    assert far > 0.97


def test_a_way_that_nothing_faces_is_free_however_weak_turns_are() -> None:
    """One wall and a strip of floor: the way along the wall is weak, and so are two turns."""
    rng = np.random.default_rng(4)
    surfaces = SurfelMap(SIZES)

    def seen(count: int) -> F64:
        wall = rng.uniform((-1.0, 1.5, -0.8), (1.0, 1.5, 0.8), (count, 3))
        floor = rng.uniform((-1.0, 0.9, -0.8), (1.0, 1.5, -0.8), (count // 8, 3))
        points = np.vstack((wall, floor))
        return points + 0.01 * rng.standard_normal(points.shape)

    for number in range(12):
        surfaces.add(seen(3000), number)
    points = seen(800)
    weak = weak_in(surfaces, points, driving=False)
    np.testing.assert_allclose(weak.axes.T @ weak.axes, np.eye(weak.axes.shape[1]), atol=1e-9)
    first, others = weak.axes[:, 0], weak.axes[:, 1:]
    assert not first[:3].any()
    assert abs(first[3]) > 0.999
    np.testing.assert_allclose(others[3], 0.0, atol=0.05)
    assert others.shape[1] >= 2
    # nothing is learned of the way, though what is known of the turns is not perfect
    prior = 0.2**2 * np.eye(eskf.ERRORS)
    found = align(at(), prior, source(points), surfaces, SurfaceConfig(), 30)
    assert found is not None
    assert found.information[3, 3] < 1e-4 * found.information[4, 4]
    assert found.covariance[3, 3] > 0.19**2


@pytest.mark.parametrize("facing", [True, False])
def test_a_few_points_that_face_a_way_do_not_tell_it(facing: bool) -> None:
    rng = np.random.default_rng(6)
    surfaces = SurfelMap(SIZES)
    patch = rng.uniform((0.9, 1.05, 0.05), (0.9, 1.45, 0.4), (400, 3))
    for number in range(12):
        wall = rng.uniform((-1.0, 1.5, -0.8), (1.0, 1.5, 0.8), (3000, 3))
        surfaces.add(np.vstack((wall, patch)) + rng.normal(0.0, 0.005, (3400, 3)), number)
    wall = rng.uniform((-1.0, 1.5, -0.8), (1.0, 1.5, 0.8), (800, 3))
    count = tuning.FREE_FACING + (40 if facing else 0)
    weak = weak_in(surfaces, np.vstack((wall, patch[:count])), driving=False)
    is_free = np.abs(weak.axes[3]) > 0.999
    assert bool(is_free.any()) != facing


@pytest.mark.parametrize("young", YoungSurfaces)
def test_rims_of_a_map_that_has_only_just_begun_may_be_ignored(young: YoungSurfaces) -> None:
    """Apart, they still tell the place along the walls; ignored, they do not. All else stays."""
    rng = np.random.default_rng(8)
    surfaces = SurfelMap(SIZES)
    for number in range(4):
        surfaces.add(np.vstack((walls(rng, 4000), reveals(rng, 300))), number)
    surfaces.young = young
    points = np.vstack((walls(rng, 1500), reveals(rng, 150)))
    state = at(0.02, 0.0, 0.0)
    found = correspondences(state, state, source(points), surfaces, SurfaceConfig(), REACH)
    weak = weak_axes(state, found, surfaces)
    assert weak is not None
    facing = weak.facing(state, found)[:, 0]
    assert weak.free == (young is not YoungSurfaces.TRUSTED)
    assert facing.any() == (young is not YoungSurfaces.IGNORED)
    if young is not YoungSurfaces.TRUSTED:
        assert np.linalg.norm(weak.axes[:3, 0]) == 0.0  # nothing of a turn is mixed with it
        assert abs(weak.axes[3, 0]) > 0.99
    for number in range(4, 4 + 2 * tuning.WEAK_AGE):
        surfaces.add(walls(rng, 100), number)
    found = correspondences(state, state, source(points), surfaces, SurfaceConfig(), REACH)
    old = weak_axes(state, found, surfaces)
    assert old is not None
    assert old.facing(state, found)[:, 0].any()  # whatever was said of it when it was young
    surfaces.sweep_s = 0.05  # of a sensor that sweeps faster, its rims are as old in seconds
    found = correspondences(state, state, source(points), surfaces, SurfaceConfig(), REACH)
    fast = weak_axes(state, found, surfaces)
    assert fast is not None
    assert fast.free == (young is not YoungSurfaces.TRUSTED)
    assert fast.facing(state, found)[:, 0].any() == (young is not YoungSurfaces.IGNORED)


@pytest.mark.parametrize("lean", [0.0, 0.14])
def test_a_young_floor_tells_the_height_though_walls_say_far_more(lean: float) -> None:
    """It was left out like a rim, the velocity went up, and pitch with it: 32 m after 12 s.

    Also where the level that the IMU believes in leans against it.
    """
    rng = np.random.default_rng(8)
    surfaces = SurfelMap(SIZES)

    def seen(count: int) -> F64:
        points = walls(rng, count)
        return points[(points[:, 2] > -0.9) | (rng.random(count) < 0.15)]

    for number in range(4):
        surfaces.add(np.vstack((seen(6000), reveals(rng, 240))), number)
    surfaces.young = YoungSurfaces.IGNORED
    points = np.vstack((seen(2500), reveals(rng, 120)))
    state = dataclasses.replace(at(0.02, 0.0, 0.0), gravity=9.8 * np.array([lean, 0.0, -1.0]))
    found = correspondences(state, state, source(points), surfaces, SurfaceConfig(), REACH)
    scatter = (found.normals * found.weights[:, None]).T @ found.normals
    assert scatter[2, 2] < tuning.WEAK_SHARE * scatter[1, 1]  # what this is about
    weak = weak_axes(state, found, surfaces)
    assert weak is not None
    assert weak.free == 1
    assert abs(weak.axes[3, 0]) > 0.95
    # without any floor, the height is free as well
    bare = walls(rng, 2500)
    bare = bare[bare[:, 2] > -0.9]
    found = correspondences(state, state, source(bare), surfaces, SurfaceConfig(), REACH)
    other = weak_axes(state, found, surfaces)
    assert other is not None
    assert other.free == 2


def test_the_height_is_told_apart_from_the_way_where_both_are_as_weak() -> None:
    """Any two directions of their plane are then the eigenvectors."""
    mixed = np.array([[1.0, 0.0, 1.0], [1.0, 0.0, -1.0]]).T / np.sqrt(2.0)
    places, is_height = weak_directions._height_apart(mixed, np.array([0.5, 0.0, -9.8]))
    assert places.T @ places == pytest.approx(np.eye(2))
    assert is_height.sum() == 1
    assert abs(places[2, is_height]) > 0.99
    assert abs(places[0, ~is_height]) > 0.99
    for level, gravity in ((np.eye(3)[:, :2], [0.0, 0.0, -9.8]), (mixed, [0.0, 0.0, 0.0])):
        places, is_height = weak_directions._height_apart(level, np.array(gravity))
        assert not is_height.any()
        assert places is level


def front_and_jamb(
    rng: np.random.Generator, jamb: F64, beside: int, sweeps: int = 20
) -> tuple[SurfelMap, F64]:
    """Return a map of a wall's front and of a jamb 0.4 m deep in it, and points to match.

    Points of the front come first, then so many beside the jamb, then those of the jamb given.
    """
    surfaces = SurfelMap(SIZES)
    for number in range(sweeps):
        front = rng.uniform((-2.0, 2.0, -0.8), (0.0, 2.0, 0.8), (3000, 3))
        side = rng.uniform((0.0, 2.0, -0.8), (0.0, 2.4, 0.8), (1500, 3))
        surfaces.add(np.vstack((front, side)) + rng.normal(0.0, 0.005, (4500, 3)), number)
    front = rng.uniform((-2.0, 2.0, -0.8), (-0.3, 2.0, 0.8), (600, 3))
    near = rng.uniform((-0.02, 2.0, -0.6), (0.02, 2.01, 0.6), (beside, 3))
    return surfaces, np.vstack((front, near, jamb))


@pytest.mark.parametrize("degrees", [0.0, 130.0])
def test_points_on_the_front_of_a_wall_do_not_face_as_the_jamb_beside_them(degrees: float) -> None:
    rng = np.random.default_rng(9)
    deep = rng.uniform((0.0, 2.1, -0.6), (0.0, 2.3, 0.6), (30, 3))
    surfaces, points = front_and_jamb(rng, deep, 60)
    turn = eskf.InertialState(HostNs(0), np.eye(3), *([np.zeros(3)] * 5)).boxplus(
        np.r_[0.0, 0.0, np.deg2rad(degrees), np.zeros(eskf.ERRORS - 3)]
    )
    state = dataclasses.replace(at(), rotation=turn.rotation)
    seen = source(points @ state.rotation)
    found = correspondences(state, state, seen, surfaces, SurfaceConfig(), REACH)
    facing = np.flatnonzero(np.abs(found.normals[:, 0]) > 0.9)
    is_deep = found.index[facing] >= 660
    assert np.count_nonzero(is_deep) > 20
    assert np.count_nonzero(~is_deep) > 5
    on_others = found.on_two_surfaces(facing, state.rotation)
    assert not on_others[is_deep].any()
    assert on_others[~is_deep].all()


def test_of_many_points_that_face_a_direction_all_count() -> None:
    rng = np.random.default_rng(10)
    surfaces, points = front_and_jamb(rng, np.zeros((0, 3)), 3 * tuning.AMBIGUOUS_MOST)
    state = at()
    found = correspondences(state, state, source(points), surfaces, SurfaceConfig(), REACH)
    facing = np.flatnonzero(np.abs(found.normals[:, 0]) > 0.9)
    assert len(facing) > tuning.AMBIGUOUS_MOST
    assert not found.on_two_surfaces(facing, state.rotation).any()
    few = facing[: tuning.AMBIGUOUS_MOST]
    assert found.on_two_surfaces(few, state.rotation).all()
    surfaces.sweep_s = 0.9 * tuning.AMBIGUOUS_AGE_S / 19  # the map is too young to have drifted
    young = correspondences(state, state, source(points), surfaces, SurfaceConfig(), REACH)
    assert not young.on_two_surfaces(few, state.rotation).any()
    assert found.on_two_surfaces(few[:0], state.rotation).shape == (0,)


def test_a_front_beside_a_jamb_does_not_tell_the_way_along_the_wall() -> None:
    """A few of its points lie in the jamb's cells wherever the sensor is."""
    rng = np.random.default_rng(11)
    surfaces, points = front_and_jamb(rng, np.zeros((0, 3)), 20)
    state = at()
    seen = correspondences(state, state, source(points), surfaces, SurfaceConfig(), REACH)
    weak = weak_axes(state, seen.without_points_on_two_surfaces(state.rotation), surfaces)
    assert weak is not None
    assert np.abs(weak.axes[3, : weak.free]).max() > 0.99
    prior = 0.1**2 * np.eye(eskf.ERRORS)
    found = align(at(), prior, source(points), surfaces, SurfaceConfig(), 30)
    assert found is not None
    assert found.covariance[3, 3] > 0.099**2


def test_where_most_of_what_is_seen_is_the_front_a_jamb_beside_it_does_not_fix_it() -> None:
    """So many of its points are in the jamb's cells that by the eigenvalues, no way is weak."""
    rng = np.random.default_rng(12)
    surfaces, points = front_and_jamb(rng, np.zeros((0, 3)), 90)
    points = np.vstack((points[:120], points[600:]))
    state = at()
    seen = correspondences(state, state, source(points), surfaces, SurfaceConfig(), REACH)
    left = seen.without_points_on_two_surfaces(state.rotation)
    facing = np.abs(seen.normals[:, 0]) > 0.9
    assert (seen.weights * seen.normals[:, 0] ** 2).sum() > 0.12 * seen.weights.sum()
    assert (left.weights[facing] == 0.0).mean() > 0.95
    assert (left.weights[~facing] > 0.0).mean() > 0.8
    found = align(
        state, 0.1**2 * np.eye(eskf.ERRORS), source(points), surfaces, SurfaceConfig(), 9
    )
    assert found is not None
    assert found.covariance[3, 3] > 0.095**2
    wall = points[:120]
    alone = correspondences(state, state, source(wall), surfaces, SurfaceConfig(), REACH)
    assert alone.without_points_on_two_surfaces(state.rotation) is alone
