"""The vertical of built places, of woods, and of a single wall."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_node import rotations
from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.odometry.initialization.vertical_direction import Vertical, vertical_direction

UP = np.array([0.0, 0.0, 1.0])


def noisy(rng: np.random.Generator, normals: F64, noise: float = 0.02) -> F64:
    """Return normals of either sign that are off by so much [rad]."""
    normals = normals + noise * rng.standard_normal(normals.shape)
    signs = rng.choice((-1.0, 1.0), len(normals))
    return np.asarray(signs[:, None] * normals / np.linalg.norm(normals, axis=1)[:, None])


def walls(rng: np.random.Generator, count: int, *yaws: float) -> F64:
    """Return the normals of upright faces of some yaws."""
    yaw = rng.choice(yaws, count)
    return np.column_stack((np.cos(yaw), np.sin(yaw), np.zeros(count)))


def floor(count: int) -> F64:
    return np.tile(UP, (count, 1))


def tilted(degrees: float, yaw: float) -> F64:
    """Return a rotation matrix that tilts by an angle about a level axis."""
    axis = np.deg2rad(degrees) * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    return np.asarray(rotations.matrices(rotations.exp(axis)))


def degrees_between(one: F64, other: F64) -> float:
    return float(np.degrees(np.arccos(min(abs(float(one @ other)), 1.0))))


@pytest.mark.parametrize("tilt", [0.0, 3.0, 9.0])
@pytest.mark.parametrize("place", ["corridor", "hall", "walls of an Atlanta world"])
def test_a_built_place_shows_its_vertical(place: str, tilt: float) -> None:
    rng = np.random.default_rng(1)
    normals = {
        "corridor": np.vstack((walls(rng, 200, 0.3), floor(60))),
        "hall": floor(120),
        "walls of an Atlanta world": walls(rng, 150, 0.0, 0.7, 1.9),
    }[place]
    turn = tilted(tilt, 1.1)
    found = vertical_direction(noisy(rng, normals) @ turn.T, np.ones(len(normals)), UP)
    assert found is not None
    assert found.is_certain
    assert found.direction @ UP > 0.0
    assert degrees_between(found.direction, turn @ UP) < 0.4
    assert np.linalg.norm(found.direction) == pytest.approx(1.0)


def test_furniture_and_smeared_faces_do_not_tilt_it() -> None:
    rng = np.random.default_rng(2)
    loose = rng.standard_normal((50, 3))
    loose /= np.linalg.norm(loose, axis=1)[:, None]
    normals = noisy(rng, np.vstack((walls(rng, 150, 0.0, np.pi / 2), floor(80), loose)))
    turn = tilted(6.0, 2.0)
    found = vertical_direction(normals @ turn.T, np.ones(len(normals)), UP)
    assert found is not None
    assert degrees_between(found.direction, turn @ UP) < 0.4
    assert found.agreement < 0.9


def test_foliage_agrees_on_none() -> None:
    rng = np.random.default_rng(3)
    normals = rng.standard_normal((300, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    found = vertical_direction(normals, np.ones(300), UP)
    assert found is None or not found.is_certain


def test_one_wall_leaves_a_tilt_open() -> None:
    rng = np.random.default_rng(4)
    assert vertical_direction(noisy(rng, walls(rng, 200, 0.4)), np.ones(200), UP) is None


def test_areas_count_and_not_their_number() -> None:
    """A floor in few large faces outweighs a slope in many small ones."""
    rng = np.random.default_rng(5)
    slope = floor(200) @ tilted(8.0, 0.0).T
    normals = noisy(rng, np.vstack((floor(40), slope)), 0.005)
    weights = np.concatenate((np.full(40, 4.0), np.full(200, 0.1)))
    found = vertical_direction(normals, weights, UP)
    assert found is not None
    assert degrees_between(found.direction, UP) < 0.3
    assert found.agreement == pytest.approx(160.0 / 180.0, abs=0.02)


def test_a_few_surfaces_show_none() -> None:
    count = tuning.VERTICAL_SURFACES - 1
    assert vertical_direction(floor(count), np.ones(count), UP) is None
    assert vertical_direction(floor(count + 1), np.ones(count + 1), UP) is not None


def test_how_far_verticals_are_apart_does_not_depend_on_their_sense() -> None:
    degrees = np.array([4.0, 10.0])
    for tilt in degrees:
        found = Vertical(tilted(tilt, 0.7) @ UP, 0.7)
        for vertical in (UP, -UP):
            beyond = [found.is_beyond(sine, vertical) for sine in np.sin(np.radians((3.0, 7.0)))]
            assert beyond == [True, tilt > 7.0]


@pytest.mark.parametrize(
    ("agreement", "likely", "certain"),
    [(0.5, False, False), (0.6, True, False), (0.7, True, False), (0.75, True, True)],
)
def test_a_vertical_is_likely_before_it_is_certain(
    agreement: float, likely: bool, certain: bool
) -> None:
    found = Vertical(UP, agreement)
    assert (found.is_likely, found.is_certain) == (likely, certain)
