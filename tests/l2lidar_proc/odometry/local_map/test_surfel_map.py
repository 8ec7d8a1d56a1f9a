"""Surfaces in cells, what is forgotten of them, and their hash table against a dictionary."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from l2lidar_node.types import HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import ERRORS, InertialState
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.local_map.cell_index import CellIndex
from l2lidar_proc.odometry.local_map.free_space import seen_through
from l2lidar_proc.odometry.local_map.principal_axes import principal_axes
from l2lidar_proc.odometry.local_map.surfel_map import SurfelMap
from l2lidar_proc.odometry.matcher import SweepMatcher
from l2lidar_proc.odometry.prediction import Predictor
from tests.l2lidar_proc.motion.analytic import EPOCH, Motion

KEYS = st.one_of(
    st.integers(0, (1 << 63) - 1),
    st.integers(0, 2000),  # neighbors
    st.integers(0, 200).map(lambda number: number << 52),  # that differ in high bits alone
)


@given(st.lists(st.lists(KEYS, max_size=400), max_size=6), st.lists(KEYS, max_size=100))
def test_it_finds_what_a_dictionary_finds(batches: list[list[int]], others: list[int]) -> None:
    index = CellIndex()
    known: dict[int, int] = {}
    for batch in batches:
        new = [key for key in dict.fromkeys(batch) if key not in known]
        rows = np.arange(len(known) + 1, len(known) + 1 + len(new))
        index.insert(np.array(new, np.int64), rows)
        known.update(zip(new, rows.tolist(), strict=True))
        assert len(index) == len(known)
        asked = np.array([*known, *others], np.int64)
        found = index.find(asked).tolist()
        assert found == [known.get(key, 0) for key in asked.tolist()]
        again = index.find_again(asked).tolist()
        assert again == found == index.find_again(asked).tolist()
        # some go, others take their places; those of the next batches come back
        gone, moved = list(known)[::3], list(known)[1::3]
        index.remove(np.array(gone, np.int64))
        index.move(np.array(moved, np.int64), 1000 + np.arange(len(moved)))
        known = {key: row for key, row in known.items() if key not in gone}
        known |= {key: 1000 + number for number, key in enumerate(moved)}
        assert len(index) == len(known)
        for found in (index.find(asked), index.find_again(asked), index.find_again(asked[::-1])):
            assert sorted(found.tolist()) == sorted(known.get(key, 0) for key in asked.tolist())
        assert index.find(asked).tolist() == [known.get(key, 0) for key in asked.tolist()]
    index.clear()
    assert len(index) == 0
    assert not index.find(np.array([*known, *others], np.int64)).any()


RNG_SEED = 4


def wall(x: float = 2.0) -> Any:
    """Return points on a wall across x, with 1 cm of noise."""
    rng = np.random.default_rng(RNG_SEED)
    points = rng.uniform((x, -1.0, 0.0), (x, 1.0, 2.0), (4000, 3))
    points[:, 0] += 0.01 * rng.standard_normal(len(points))
    return points


def test_a_wall_becomes_surfaces_and_gives_distances() -> None:
    surfaces = SurfelMap((0.25, 0.6))
    surfaces.add(wall(2.12))
    probe = np.array([[2.15, 0.1, 1.1], [2.09, -0.6, 0.4], [5.0, 5.0, 5.0]])
    found = surfaces.match(probe)
    order = np.argsort(found.index)
    assert found.index[order].tolist() == [0, 1]
    np.testing.assert_allclose(np.abs(found.normals[order]), [[1, 0, 0]] * 2, atol=0.05)
    signed = found.distances[order] * np.sign(found.normals[order, 0])
    np.testing.assert_allclose(signed, [0.03, -0.03], atol=0.006)
    assert (found.variances < 0.01**2).all()


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_surface_that_is_seen_from_behind_is_not_met(side: float) -> None:
    """A wall between two rooms is 12 cm thick, less than a first step reaches."""
    surfaces = SurfelMap((0.25, 0.6))
    surfaces.add(wall(2.12), origin=np.array([2.12 - 3.0 * side, 0.0, 1.0]))
    probe = np.array([[2.12 + 0.12 * side, 0.1, 1.1], [2.12 + 0.06 * side, -0.6, 0.4]])

    def met(*origin: float) -> int:
        return len(surfaces.match(probe, origins=np.tile(origin, (2, 1))).index)

    assert met(2.12 - 5.0 * side, 1.0, 1.0) == 2
    assert met(2.12 + 5.0 * side, 1.0, 1.0) == 0
    assert met(2.12 + 0.15 * side, 7.0, 1.0) == 2  # along the wall: normals are off by more
    unknown = SurfelMap((0.25, 0.6))
    unknown.add(wall(2.12))
    origins = np.tile([2.12 + 5.0 * side, 1.0, 1.0], (2, 1))
    assert len(unknown.match(probe, origins=origins).index) == 2


def test_a_board_is_met_from_both_sides_and_a_wall_from_its_own() -> None:
    front, back = np.array([0.0, 0.0, 1.0]), np.array([5.0, 0.0, 1.0])
    board, thick = SurfelMap((0.25, 0.6)), SurfelMap((0.25, 0.6))
    for surfaces, x in ((board, 2.12), (thick, 2.27)):
        surfaces.add(wall(2.12)[:2000], 0, origin=front)
        surfaces.add(wall(x), 1, origin=back)
        surfaces.add(wall(x)[2000:], 2, origin=back)
    probe = np.array([[2.12, 0.1, 1.1], [2.12, -0.6, 0.4]])
    for surfaces, count in ((board, 2), (thick, 0)):
        assert len(surfaces.match(probe, origins=np.tile(front, (2, 1))).index) == 2
        assert len(surfaces.match(probe, origins=np.tile(back, (2, 1))).index) == count


def test_what_is_no_surface_has_no_side() -> None:
    surfaces = SurfelMap((0.3,))
    rng = np.random.default_rng(RNG_SEED)
    for number in range(5):
        pole = rng.uniform((2.1, 0.1, 0.0), (2.1, 0.1, 2.0), (400, 3))
        pole[:, :2] += 0.01 * rng.standard_normal((400, 2))
        surfaces.add(pole, number, origin=np.zeros(3))
    probe = np.array([[2.1, 0.1, 1.0]])
    here, there = (
        surfaces.match(probe, narrow=True, origins=np.array([[x, 0.0, 1.0]])) for x in (0.0, 5.0)
    )
    assert len(here.index) == len(there.index) > 0


def test_the_front_of_a_wall_is_not_taken_for_the_jamb_at_its_corner() -> None:
    """Both lie in one cell, whose surface is the jamb, and the front is all on one side of it."""
    rng = np.random.default_rng(RNG_SEED)
    jambs = SurfelMap((0.3,))
    jamb = rng.uniform((2.2, 0.6, 0.0), (2.2, 0.7, 2.0), (2000, 3))  # 29 mm about its middle
    jamb[:, 0] += 0.004 * rng.standard_normal(len(jamb))
    jambs.add(jamb)

    def met(y: float) -> list[int]:
        """Return how many surfaces a point meets, without and with rejection."""
        probe = np.array([[2.17, y, 1.05]])
        return [len(jambs.match(probe, reject_ambiguous=how).index) for how in (False, True)]

    assert met(0.65) == met(0.76) == [1, 1]  # on it, and where more of it may be
    assert met(0.79) == met(0.85) == [1, 0]
    # what is no flat surface tells a place across the directions in which its points are few
    pole = SurfelMap((0.3,))
    for number in range(5):
        pole.add(rng.uniform((2.2, 0.62, 1.0), (2.21, 0.63, 1.1), (60, 3)), number)
    probe = np.array([[2.2, 0.62, 0.91]])  # far below its points
    both = [pole.match(probe, narrow=True, reject_ambiguous=how) for how in (False, True)]
    assert len(both[0].index) == len(both[1].index) > 0


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_columns_of_points_on_a_wall_are_no_surfaces_across_it(noise: float) -> None:
    """A depth camera sees one column in each small cell of a wall that is far away."""
    rng = np.random.default_rng(RNG_SEED)
    columns = 0.075 + 0.15 * np.arange(5)

    def seen(columns: Any) -> SurfelMap:
        surfaces = SurfelMap((0.15,))
        for number in range(5):
            points = rng.uniform((0.0, 4.725, 0.0), (0.0, 4.725, 1.5), (200 * len(columns), 3))
            points[:, 0] = np.repeat(columns, 200)
            points += rng.standard_normal(points.shape) * (0.004, noise, 0.0)
            surfaces.add(points, number)
        return surfaces

    def across(surfaces: SurfelMap, axis: int = 0, **how: Any) -> list[int]:
        """Return which of the columns are met across the wall, or along another axis."""
        probe = np.column_stack((columns, np.full(5, 4.725), np.full(5, 0.8)))
        found = surfaces.match(probe, narrow=True, **how)
        return sorted(found.index[np.abs(found.normals[:, axis]) > 0.9].tolist())

    wall = seen(columns)
    assert across(wall) == [0, 1, 2, 3, 4]
    # beyond one side of the outermost there is nothing
    assert across(wall, reject_ambiguous=True) == [0, 4]
    # where they lie on the wall is as clear as before
    assert across(wall, 1) == across(wall, 1, reject_ambiguous=True)
    assert bool(across(wall, 1)) == (noise < 0.02)  # else they are flat, across it only
    # so it is with posts and reveals, and what is beside them on one side does not matter
    for few in (columns[2:3], columns[1:3]):
        alone = seen(few)
        assert across(alone) == across(alone, reject_ambiguous=True) != []
    # nor do fewer points that lie there; its own cell has a hundred
    for count, met in ((30, [2]), (90, [])):
        alone = seen(columns[2:3])
        for x in columns[[1, 3]]:
            alone.add(np.tile((x, 4.725, 0.8), (count, 1)), 5)
        assert across(alone, reject_ambiguous=True) == met


def test_rays_pass_through_surfaces_only_where_these_are() -> None:
    surfaces, origin = SurfelMap((0.15, 0.3, 0.6)), np.array([0.0, 0.0, 1.0])
    rng = np.random.default_rng(RNG_SEED)

    def ends(x: float, y: float, count: int = 400) -> Any:
        """Return points on a wall across x, about y, a meter high."""
        return rng.uniform((x, y - 0.4, 0.5), (x, y + 0.4, 1.5), (count, 3))

    for number in range(4):
        surfaces.add(wall(2.0), number, origin=origin)
        if number < 2:
            # from too few sweeps
            assert seen_through(surfaces, origin, ends(4.0, 0.0)).share == 0.0
    through, beside = ends(4.0, 0.0), ends(4.0, 3.5)
    share, opened = seen_through(surfaces, origin, through)
    assert share > 0.5  # near the edges of cells none are counted
    assert seen_through(surfaces, origin, beside).share == 0.0
    assert len(opened) == round(share * len(through[:: len(through) // tuning.RAYS]))
    assert not opened.any()  # all by the first
    # two in three, which no step through the points meets by chance
    mixed = np.stack((through, through, beside), axis=1).reshape(-1, 3)
    both = seen_through(surfaces, origin, mixed).share
    assert both == pytest.approx(share * 2 / 3, abs=0.07)
    # at a grazing angle a ray may pass beside what a noisy normal says
    grazing = rng.uniform((2.4, 1.5, 0.8), (2.4, 1.5, 1.2), (400, 3))
    assert seen_through(surfaces, np.array([1.6, -1.5, 1.0]), grazing).share == 0.0
    # on it, in front of it, and behind it by less than such surfaces may be off
    for x in (1.0, 2.0, 2.2):
        assert seen_through(surfaces, origin, ends(x, 0.0)).share == 0.0
    assert seen_through(surfaces, origin, origin[None]).share == 0.0
    assert seen_through(surfaces, origin, np.empty((0, 3))).share == 0.0


def test_a_surface_is_known_where_its_points_are_not_in_all_of_its_cell() -> None:
    surfaces, origin = SurfelMap((0.6,)), np.array([0.0, 0.3, 0.9])
    rng = np.random.default_rng(RNG_SEED)
    for number in range(4):
        surfaces.add(rng.uniform((2.1, 0.0, 0.6), (2.1, 0.2, 1.2), (120, 3)), number)
    ends = rng.uniform((4.2, -0.1, 0.8), (4.2, 0.1, 1.0), (200, 3))  # at 0.1 to 0.2 m
    assert seen_through(surfaces, origin, ends).share > 0.9
    beside = ends + np.array((0.0, 0.5, 0.0))  # at 0.35 to 0.45 m
    assert seen_through(surfaces, origin, beside).share == 0.0


def test_points_of_one_line_are_no_surface() -> None:
    surfaces = SurfelMap((0.25,))
    line = np.linspace(0.0, 0.24, 200)[:, None] * [0.6, 0.8, 0.0]
    surfaces.add(line + 0.002 * np.random.default_rng(RNG_SEED).standard_normal((200, 3)))
    assert not len(surfaces.match(line).index)


def test_a_full_cell_changes_no_more() -> None:
    surfaces = SurfelMap((4.0,), capacity=1000)
    surfaces.add(wall())
    before = surfaces.match(np.array([[2.0, 0.5, 0.5]])).distances
    surfaces.add(wall(2.3))
    np.testing.assert_array_equal(surfaces.match(np.array([[2.0, 0.5, 0.5]])).distances, before)


@given(
    st.lists(st.sampled_from([0.0, 1e-9, 1e-5, 0.003, 0.1, 1.0, 300.0]), min_size=3, max_size=3),
    st.integers(0, 2**32 - 1),
)
def test_principal_axes_are_those_of_lapack(sigmas: list[float], seed: int) -> None:
    """Of points on a plane, a line or a spot, of a sphere and of disks, turned at random."""
    turns = np.linalg.qr(np.random.default_rng(seed).standard_normal((20, 3, 3)))[0]
    expected = np.sort(np.square(sigmas))
    covariance = np.einsum("nij,j,nkj->nik", turns, np.square(sigmas), turns)
    i, j = np.triu_indices(3)
    spread, axes = principal_axes(covariance[:, i, j].T)
    tolerance = 1e-14 * expected[-1] + 1e-70
    np.testing.assert_allclose(spread, np.tile(expected, (20, 1)), rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(spread, np.linalg.eigvalsh(covariance), atol=tolerance)
    assert (np.diff(spread, axis=1) >= 0.0).all()
    np.testing.assert_allclose(
        axes @ axes.swapaxes(1, 2), np.tile(np.eye(3), (20, 1, 1)), atol=1e-12
    )
    again = np.einsum("nji,nj,njk->nik", axes, spread, axes)
    np.testing.assert_allclose(again, covariance, rtol=0.0, atol=tolerance)


def test_a_full_coarse_cell_changes_no_more_while_fine_ones_do() -> None:
    surfaces = SurfelMap((0.25, 4.0), capacity=1000)
    surfaces.add(wall())
    (_, places, *_), (_, _, *coarse) = surfaces.flat_cells()
    surfaces.add(wall(2.3))
    (_, more, *_), (_, _, *again) = surfaces.flat_cells()
    assert len(more) > len(places) > 10
    for before, after in zip(coarse, again, strict=True):
        np.testing.assert_array_equal(after, before)


def test_every_cell_of_every_level_holds_what_lies_in_it() -> None:
    """Coarser cells sum up finer ones: that must give what their points themselves do."""
    rng = np.random.default_rng(RNG_SEED)
    points = rng.normal(0.0, 1.5, (6000, 3)) * (1.0, 1.0, 0.02)
    sizes = (0.15, 0.3, 0.6, 1.5)
    surfaces = SurfelMap(sizes, capacity=10**6, least=3, thickness=1.0)
    for part in (points[:1000], points[1000:4000], points[4000:]):
        surfaces.add(part)
    found = surfaces.flat_cells()
    assert [size for size, *_ in found] == list(sizes)
    for size, places, means, normals in found:
        assert len(places) > 10
        cell = np.floor(points / size).astype(np.int64)
        for place, mean, normal in zip(places, means, normals, strict=True):
            inside = points[(cell == place).all(axis=1)]
            assert len(inside) >= 3
            # fitted when it had grown by a fifth: the last few points may be missing
            np.testing.assert_allclose(mean, inside.mean(axis=0), atol=0.12 * size)
            if len(inside) > 30:
                assert abs(normal[2]) > 0.9
    whole = SurfelMap(sizes, capacity=10**6, least=3, thickness=1.0)
    whole.add(points)
    for size, places, means, _ in whole.flat_cells():
        assert len(places) > 10
        cell = np.floor(points / size).astype(np.int64)
        for place, mean in zip(places, means, strict=True):
            inside = points[(cell == place).all(axis=1)]
            np.testing.assert_allclose(mean, inside.mean(axis=0), atol=1e-9)


def test_far_cells_are_forgotten_and_the_rest_stays() -> None:
    surfaces = SurfelMap((0.25,))
    surfaces.add(wall(2.12))
    surfaces.add(wall(52.12))
    count = len(surfaces)
    surfaces.forget(np.zeros(3), 10.0)
    assert 0 < len(surfaces) < count
    assert len(surfaces.match(np.array([[2.12, 0.1, 1.1], [52.12, 0.1, 1.1]])).index) == 1
    surfaces.add(wall(52.12))
    assert len(surfaces) == count


def test_cells_out_of_sight_are_forgotten_and_full_ones_in_sight_stay() -> None:
    surfaces = SurfelMap((0.25,), capacity=10)
    places = np.array([[2.12, 0.1, 1.1], [5.12, 0.1, 1.1]])
    surfaces.add(np.concatenate((wall(2.12), wall(5.12))), 0)
    surfaces.add(wall(2.12), 7)  # full already: not fitted again, but seen
    surfaces.forget(np.zeros(3), 10.0, 7)
    assert surfaces.match(places).index.tolist() == [0]
    surfaces.forget(np.zeros(3), 10.0, 8)
    assert not len(surfaces)


@pytest.mark.parametrize("kept", ["first", "last", "every other", "none", "all"])
def test_what_is_left_after_forgetting_is_as_it_was_and_the_rest_begins_anew(kept: str) -> None:
    walls = [wall(2.12 + 3.0 * number) for number in range(8)]
    keeps = [
        {"first": k < 3, "last": k > 4, "every other": k % 2 == 1}.get(kept, kept == "all")
        for k in range(len(walls))
    ]
    surfaces, never = SurfelMap((0.15, 0.6)), SurfelMap((0.15, 0.6))
    for number, points in enumerate(walls):
        surfaces.add(points, number)
        if keeps[number]:
            never.add(points, number)
    for points, keep in zip(walls, keeps, strict=True):
        if keep:
            surfaces.add(points[: len(points) // 2], 20)
            never.add(points[: len(points) // 2], 20)
    # what was not seen again goes, of the walls that are kept as well
    for map_ in (surfaces, never):
        map_.forget(np.zeros(3), 1000.0, 20)
    assert len(surfaces) == len(never)

    def known(map_: SurfelMap) -> list[list[float]]:
        """Return what a map knows of all places: numbers of rows do not count."""
        found = map_.match(np.concatenate(walls))
        parts = (found.index, found.distances, found.variances, found.born, found.opened)
        return [*(part.tolist() for part in parts), found.normals.ravel().tolist()]

    assert known(surfaces) == known(never)
    for number, points in enumerate(walls):
        assert surfaces.add(points, 21 + number) == never.add(points, 21 + number)
    assert len(surfaces) == len(never)
    assert known(surfaces) == known(never)


def test_what_was_left_behind_a_long_way_ago_is_forgotten_however_near_it_is() -> None:
    """Around a block and back: the beginning of the lap has drifted away from the present."""
    matcher = SweepMatcher(OdometryConfig(), np.zeros(3))
    predictor = Predictor(OdometryConfig(), np.eye(4))
    predictor.imu(Motion().imu(0, 40))
    start = EPOCH
    state = InertialState(start, np.eye(3), *np.zeros((5, 3)))
    motion = predictor.over(state, np.eye(ERRORS) * 1e-4, (start, HostNs(EPOCH + 10**8)), start)

    def seen_from(place: float, x: float) -> None:
        """Extend the map with a wall across x, seen from a place on the x axis."""
        at = dataclasses.replace(state, position=np.array([place, 0.0, 0.0]))
        points = np.zeros(4000, [(axis, "<f4") for axis in "xyz"])
        points["x"], points["y"], points["z"] = (wall(x) - at.position).T
        matcher.extend(points, dataclasses.replace(motion, state=at), at)

    seen_from(0.0, 3.0)
    for place in np.arange(1.0, 14.0):  # there,
        seen_from(float(place), 13.0)
    for place in np.arange(12.0, -1.0, -1.0):  # and back
        seen_from(float(place), -4.0)
    probe = np.array([[3.0, 0.1, 1.1], [13.0, 0.1, 1.1]])
    assert matcher.surfaces.match(probe).index.tolist() == [0, 1]  # 26 m
    for place in np.arange(1.0, 8.0):
        seen_from(float(place), 13.0)
    assert matcher.surfaces.match(probe).index.tolist() == [1]


def test_cells_remember_the_sweep_that_opened_their_place() -> None:
    rng = np.random.default_rng(4)
    surfaces = SurfelMap((0.15, 0.3, 0.6, 1.5))

    def wall(start: float) -> np.ndarray:
        points = rng.uniform((start, 0.0, 0.0), (start + 3.0, 0.0, 3.0), (6000, 3))
        points[:, 1] = 0.07 + rng.normal(0.0, 0.003, len(points))
        return points

    assert surfaces.add(wall(0.0)[:300], 3) == 1.0  # sparse: fine cells come later
    assert surfaces.add(wall(0.0), 8) == 0.0
    assert 0.4 < surfaces.add(wall(1.5), 12) < 0.6
    found = surfaces.match(wall(0.0))
    assert len(found.index) > 5000
    assert set(found.born.tolist()) == {3}
    beyond = surfaces.match(wall(3.2)[:500])
    assert set(beyond.born.tolist()) == {12}
    assert surfaces.add(np.empty((0, 3)), 13) == 0.0


def test_a_part_of_a_map_has_the_places_that_some_sweeps_saw_first() -> None:
    surfaces = SurfelMap((0.15, 1.5))
    points = wall(2.0)
    low = points[:, 2] < 1.5  # where cells of both sizes end
    far = 50.0 + points  # apart from it
    surfaces.add(points[low], 0)
    surfaces.add(points[~low], 2)
    surfaces.add(far, 7)  # of which it is not known what it belongs to: as the last that is
    for sweeps, parts in (
        ([True, False, False], [points[low]]),
        ([False, False, True], [points[~low], far]),
        ([True, False, True], [points, far]),
    ):
        part = surfaces.part_of(np.array(sweeps))
        assert part.latest == surfaces.latest == 7
        seen = sum(len(part.match(some).index) for some in parts)
        assert seen > 0.98 * sum(len(surfaces.match(some).index) for some in parts)
        # nothing else but at the edge between them
        assert seen <= len(part.match(np.vstack((points, far))).index) < 1.02 * seen
    # each goes on by itself
    before = len(surfaces)
    assert part.add(points + 100.0, 9) == 1.0
    assert part.add(points, 9) == 0.0
    assert len(surfaces) == before
    assert surfaces.add(points + 100.0, 9) == 1.0


def test_a_place_is_no_older_for_a_sweep_that_is_not_known_to_belong_to_it() -> None:
    surfaces = SurfelMap((0.15, 1.5))
    points = wall(2.0)
    surfaces.add(points[:20], 0)
    left = points[:, 1] < 0.0
    surfaces.add(points[left], 1)
    surfaces.add(points[~left], 2, np.array([True, False]))
    for part, born in ((left, 0), (~left, 2)):
        assert np.median(surfaces.match(points[part]).born) == born


def test_near_points_take_the_place_of_far_ones_that_fill_a_cell() -> None:
    """A wall at the face of two cells, its noise larger from afar."""
    rng = np.random.default_rng(2)
    eye = np.array([-1.0, 0.15, 0.15])

    def seen(noise: float) -> Any:
        points = rng.uniform((0.3, 0.02, 0.02), (0.3, 0.28, 0.28), (100, 3))
        points[:, 0] += noise * rng.standard_normal(100)
        return points

    def off(surfaces: SurfelMap) -> float:
        met = surfaces.match(seen(0.001))
        return float(np.abs(met.distances).mean())

    found = {}
    for weighted in (False, True):
        surfaces = SurfelMap((0.3,), capacity=400)
        for number in range(12):
            far = np.array([-5.0, 0.15, 0.15])
            surfaces.add(seen(0.04), number, origin=far, weighted=weighted)
        assert off(surfaces) > 0.015
        for number in range(12, 24):
            surfaces.add(seen(0.004), number, origin=eye, weighted=weighted)
        found[weighted] = off(surfaces)
    assert found[False] > 0.015
    assert found[True] < 0.5 * found[False]


def test_weighted_points_give_the_weighted_mean_and_count_for_less() -> None:
    rng = np.random.default_rng(5)
    surfaces = SurfelMap((0.25, 4.0), capacity=10**6)
    eyes = np.array([[2.0, 2.0, 1.0], [2.0, 2.0, 9.0]])
    clouds = []
    for number, eye in enumerate(eyes):
        points = rng.uniform((0.1, 0.1, 0.1 + number), (3.9, 3.9, 0.2 + number), (3000, 3))
        clouds.append(points)
        surfaces.add(points, number, origin=eye, weighted=True)
    cell = np.floor(np.vstack(clouds) / 0.25)
    owner = np.repeat([0, 1], 3000)
    middles = (cell + 0.5) * 0.25
    ways = middles - eyes[owner]
    weights = 1.0 / (1.0 + (ways**2).sum(axis=1) / tuning.WEIGHT_RANGE**2)
    whole = surfaces._cells[1 : len(surfaces) + 1]
    coarse = whole[whole["key"] >> 57 == 1]
    assert len(coarse) == 1
    mean = (weights[:, None] * np.vstack(clouds)).sum(axis=0) / weights.sum()
    np.testing.assert_allclose(coarse["sum"][0] / coarse["weight"][0] + 2.0, mean, atol=1e-9)
    count = weights.sum() ** 2 / (weights**2).sum()
    assert coarse["count"][0] == pytest.approx(count)
    assert count < 5000


def test_cells_remember_how_their_points_were_seen() -> None:
    """From two places, the first ranges uncorrected, the second ones shortened by 2 cm."""
    rng = np.random.default_rng(4)
    points = rng.uniform((2.0, 0.0, 0.02), (2.2, 0.2, 0.04), (300, 3))
    eyes = np.array([[0.0, 0.0, 1.0], [2.1, 0.1, 3.0]])
    surfaces = SurfelMap([0.4])
    surfaces.add(points[:100], 0, origin=eyes[0], range_correction=0.0)
    surfaces.add(points[100:], 1, origin=eyes[1], range_correction=-0.02)
    ways = np.array([2.2, 0.2, 0.2]) - eyes  # to the cell's middle
    lines = ways / np.linalg.norm(ways, axis=1)[:, None]
    (sight,) = surfaces.sights(surfaces.match(points[:1]).cells)
    assert sight["weight"] == pytest.approx(300.0)
    np.testing.assert_allclose(sight["lines"], 100 * lines[0] + 200 * lines[1], rtol=1e-5)
    np.testing.assert_allclose(sight["corrected"], -0.02 * 200 * lines[1], rtol=1e-5)


def test_lines_of_sight_stay_with_their_cells() -> None:
    """Cells go, others take their rows, and a part of the map has the same."""
    rng = np.random.default_rng(5)
    points = rng.uniform((-8.0, -8.0, 0.02), (8.0, 8.0, 0.04), (40000, 3))
    eye = np.array([0.0, 0.0, 2.0])
    surfaces = SurfelMap([0.5, 1.0])
    surfaces.add(points[::2], 0, origin=eye, range_correction=0.01)
    surfaces.add(points[1::2], 1)  # nobody asked
    probes = np.column_stack((rng.uniform(-3.0, 3.0, (500, 2)), np.full(500, 0.03)))

    def seen(some: SurfelMap) -> Any:
        return some.sights(some.match(probes).cells)

    before = seen(surfaces)
    assert np.all(before["weight"] > 0.0)
    np.testing.assert_allclose(before["corrected"], 0.01 * before["lines"], rtol=1e-4)
    surfaces.forget(np.zeros(3), 6.0)
    np.testing.assert_array_equal(seen(surfaces), before)
    np.testing.assert_array_equal(seen(surfaces.part_of(np.ones(2, np.bool_))), before)
    surfaces.clear()
    surfaces.add(points, 0)
    assert not seen(surfaces)["weight"].any()


def test_a_map_follows_a_correction_of_the_ranges() -> None:
    """It is as if the ranges had had it before; what was seen without noting how stays."""
    rng = np.random.default_rng(12)
    eye, change = np.array([0.3, -0.2, 0.1]), 0.03
    points = np.column_stack((np.full(4000, 5.02), *rng.uniform(-2.0, 2.0, (2, 4000))))
    points[:, 0] += rng.normal(0.0, 0.005, 4000)
    sights = points - eye
    farther = eye + sights * (1.0 + change / np.linalg.norm(sights, axis=1))[:, None]
    moved, expected, unseen = (SurfelMap((0.4, 0.8)) for _ in range(3))
    moved.add(points, origin=eye, range_correction=0.0)
    expected.add(farther, origin=eye, range_correction=change)
    unseen.add(points, origin=eye)
    for surfaces in (moved, unseen):
        surfaces.correct_ranges(change)
    probes = eye + sights[::20] * (1.0 + 0.5 * change / 5.0)
    found, right, left = (one.match(probes) for one in (moved, expected, unseen))
    assert len(found.index) > 150
    np.testing.assert_array_equal(found.index, right.index)
    np.testing.assert_allclose(found.distances, right.distances, atol=3e-3)
    assert np.abs(left.distances - right.distances).mean() > 0.02
    # what is added later meets moved sums, not only moved planes
    for surfaces in (moved, expected):
        surfaces.add(farther[::2], 1, origin=eye, range_correction=change)
    again, best = moved.match(probes), expected.match(probes)
    np.testing.assert_allclose(again.distances, best.distances, atol=3e-3)
    ours, theirs = moved.sights(again.cells), expected.sights(best.cells)
    scale = ours["weight"][:, None]
    np.testing.assert_allclose(ours["corrected"] / scale, theirs["corrected"] / scale, atol=3e-3)
    thickness = np.sqrt(moved.planes(again.cells)["spread"][:, 0])
    assert np.median(thickness) < 0.008


def test_what_depends_on_the_place_of_the_sensor_needs_it() -> None:
    surfaces = SurfelMap((0.25,))
    points = np.zeros((3, 3))
    with pytest.raises(ValueError, match="origin"):
        surfaces.add(points, weighted=True)
    with pytest.raises(ValueError, match="origin"):
        surfaces.add(points, range_correction=0.01)
    assert not len(surfaces)
