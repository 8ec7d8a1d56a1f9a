"""Moving bodies, glass, mirrors, windows of view and rain, against geometry done by hand."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.motion.motion import Motion, PoseSpline
from l2lidar_node.emulator.unit import scanner
from l2lidar_node.emulator.unit.returns import RangeNoise, particle_distances
from l2lidar_node.emulator.unit.scanner import Scanner
from l2lidar_node.emulator.world import buildings, scenes
from l2lidar_node.emulator.world.scene import box, quad
from l2lidar_node.emulator.world.world import Mover, MovingWorld, World, crowd
from l2lidar_node.types import F64

pytest.importorskip("open3d")

ROOM = World(box((-10.0, -10.0, -5.0), (10.0, 10.0, 5.0)))
AHEAD = np.array([[1.0, 0.0, 0.0]])


def upright(x: float, half: float = 2.0) -> World:
    """Return an upright square across the x axis."""
    corners = [(x, -half, -half), (x, half, -half), (x, half, half), (x, -half, half)]
    return World(quad(*(np.array(corner) for corner in corners)))


def sliding(times: F64) -> tuple[F64, F64]:
    """Return a way along x at 2 m/s, turning about z at 1 rad/s."""
    zero = np.zeros_like(times)
    turn = np.stack([np.cos(times / 2), zero, zero, np.sin(times / 2)], axis=1)
    return np.stack([3.0 + 2.0 * times, zero, zero], axis=1), turn


def test_each_ray_meets_a_body_where_it_is_at_that_instant() -> None:
    times = np.linspace(0.0, 1.5, 200)
    world = MovingWorld(ROOM, [Mover.of(World(box((-1, -1, -1), (1, 1, 1))), sliding)])
    hits = world.cast(np.zeros((200, 3)), np.repeat(AHEAD, 200, axis=0), times)
    # the face of a square of half-width 1 turned by t is met at 1 / cos(t) from its middle
    angle = np.mod(times + np.pi / 4, np.pi / 2) - np.pi / 4
    expected = 3.0 + 2.0 * times - 1.0 / np.cos(angle)
    np.testing.assert_allclose(hits["distance"], expected, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(hits["normal"], axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.abs(hits["normal"][:, 0]), np.cos(angle), atol=1e-9)


def test_rays_beside_a_body_meet_the_world_behind_it() -> None:
    world = MovingWorld(ROOM, [Mover.of(World(box((-1, -1, -1), (1, 1, 1))), sliding)])
    aside = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    np.testing.assert_allclose(world.cast(np.zeros((2, 3)), aside, np.zeros(2))["distance"], 10.0)


def test_a_mirror_shows_what_is_behind_the_sensor() -> None:
    world = MovingWorld(ROOM, mirrors=upright(4.0))
    slanted = np.array([[np.cos(0.3), np.sin(0.3), 0.0]])
    hits = world.cast(np.zeros((2, 3)), np.vstack([AHEAD, slanted]), np.zeros(2))
    # 4 m there and 14 m back to the wall at x = -10
    np.testing.assert_allclose(hits["distance"], [18.0, 18.0 / np.cos(0.3)], atol=1e-3)


def test_glass_shines_head_on_and_is_invisible_aslant() -> None:
    world = MovingWorld(ROOM, glass=upright(4.0))
    slanted = np.array([[np.cos(0.3), np.sin(0.3), 0.0]])
    hits = world.cast(np.zeros((2, 3)), np.vstack([AHEAD, slanted]), np.zeros(2))
    np.testing.assert_allclose(hits["distance"], [4.0, 10.0 / np.cos(0.3)], atol=1e-9)
    assert hits["reflectivity"][0] < hits["reflectivity"][1] < 0.5


@pytest.mark.parametrize(
    ("window", "seen"),
    [
        (scanner.View(), [True, True, True, True]),
        (scanner.View(sector=np.deg2rad(100.0)), [True, False, False, False]),
        (scanner.View(sector=np.deg2rad(100.0), towards=np.pi), [False, False, True, False]),
        (scanner.View(cone=np.deg2rad(60.0)), [False, False, False, True]),
    ],
)
def test_a_window_hides_directions(window: scanner.View, seen: list[bool]) -> None:
    ahead_left_back_up = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 1e-3], [0.1, 0, 0.99]], float)
    ahead_left_back_up[3, 1] = -0.2 if window.cone > 6.0 and window.sector < 6.0 else 0.0
    found = window.sees(ahead_left_back_up)
    assert found[:3].tolist() == seen[:3]
    if window.cone < 6.0 or window.whole:
        assert found[3] == seen[3]


def test_hidden_slots_of_the_scanner_return_nothing() -> None:
    scene = scenes.make("box")
    world = World(scene.triangles, scene.reflectivity)
    motion = trajectories.make("still", scene)
    window = scanner.View(sector=np.deg2rad(120.0), towards=0.5)
    whole = Scanner(world, motion, noise=RangeNoise.clean()).scan(0, 50)
    part = Scanner(world, motion, noise=RangeNoise.clean(), view=window).scan(0, 50)
    inside = window.sees(part.rays["direction"])  # the sensor stands level, looking along x
    assert 0.25 < inside.mean() < 0.45
    assert not part.returned[~inside].any()
    np.testing.assert_array_equal(part.packets["ranges"][inside], whole.packets["ranges"][inside])


@pytest.mark.parametrize("name", scanner.CARRIERS)
def test_a_carrier_hides_part_of_the_view_and_not_the_sensor_itself(name: str) -> None:
    body = World(scanner.carrier(name))
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance = body.distances(np.tile([0.0, 0.0, 0.0445], (4000, 1)), directions)
    assert 0.02 < np.isfinite(distance).mean() < 0.6
    assert distance.min() > 0.04


def test_an_unknown_carrier_is_named() -> None:
    with pytest.raises(ValueError, match="'cow' is not known, expected one of quadruped"):
        scanner.carrier("cow")


def test_particles_come_back_as_often_as_asked() -> None:
    found = particle_distances(np.random.default_rng(2).random(100_000), 0.05)
    # 1 - exp(-0.05 * 12) of the beams meet one within 12 m, 1 - exp(-0.05) within the first
    assert abs(np.isfinite(found).mean() - 0.4512) < 0.01
    assert abs((found < 1.0).mean() - 0.0488) < 0.004


def test_dust_shortens_ranges_and_never_lengthens_them() -> None:
    scene = scenes.make("box")
    world = World(scene.triangles, scene.reflectivity)
    motion = trajectories.make("still", scene)
    clear = Scanner(world, motion, noise=RangeNoise.clean()).scan(0, 50).rays["measured"]
    quiet = RangeNoise(
        range_noise=0.0, dropout=0.0, weak_signal=False, divergence_mrad=0.0, head_wobble=0.0,
        particles=0.1,
    )  # fmt: skip
    dusty = Scanner(world, motion, noise=quiet).scan(0, 50).rays["measured"]
    shorter = dusty < clear - 0.01
    assert 0.05 < shorter.mean() < 0.6
    assert (dusty <= clear + 1e-9).all()


def test_people_keep_away_from_the_sensor_and_fill_its_view() -> None:
    scene = buildings.hall(0)
    motion = trajectories.make("walk", scene, seed=3, mount="forward")
    people = crowd(motion, scene.ground, 24, 20.0, seed=3)
    t = np.linspace(0.0, 20.0, 300)
    sensor = motion.poses(t)[0]
    for person in people:
        place, _ = person.poses(t)
        assert np.linalg.norm((place - sensor)[:, :2], axis=1).min() > 0.7
        assert np.abs(np.diff(place, axis=0)).max() < 0.5
    world = MovingWorld(World(scene.triangles), people)
    scan = Scanner(world, motion, noise=RangeNoise.clean()).scan(2000, 50)
    alone = Scanner(world.solid, motion, noise=RangeNoise.clean()).scan(2000, 50)
    hidden = scan.rays["measured"] < alone.rays["measured"] - 0.05
    assert hidden.mean() > 0.25


MAKERS = [
    buildings.flat,
    buildings.office_corridor,
    buildings.hall,
    buildings.stairwell,
    buildings.atrium,
    scenes.wood,
    scenes.trunks,
]


@pytest.mark.parametrize("maker", MAKERS, ids=lambda maker: str(maker.__name__))
def test_scenes_from_a_seed_differ_by_it_and_leave_their_way_free(maker: object) -> None:
    assert callable(maker)
    scene, again, other = maker(4), maker(4), maker(5)
    np.testing.assert_array_equal(scene.triangles, again.triangles)
    assert scene.triangles.shape != other.triangles.shape or (
        not np.array_equal(scene.triangles, other.triangles)
    )
    world = World(scene.triangles, scene.reflectivity)
    motion = trajectories.make("walk", scene, speed=1.0)
    assert np.isfinite(motion.lap_s)
    places, _ = motion.poses(np.linspace(0.0, motion.lap_s, 300))
    assert world.clearance(places).min() > 0.15


def test_a_motion_given_by_knots_moves_a_mover_exactly() -> None:
    knots = np.linspace(0.0, 4.0, 41)
    places = np.column_stack([np.sin(knots), np.cos(knots), 0.0 * knots])
    still = np.tile([1.0, 0.0, 0.0, 0.0], (41, 1))
    motion = Motion(PoseSpline(knots, places, still), rest_s=0.0)
    mover = Mover.of(World(box((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1))), motion.poses)
    times = np.linspace(0.5, 3.5, 50)
    above = motion.poses(times)[0] + np.array([0.0, 0.0, 2.0])
    down = np.tile([0.0, 0.0, -1.0], (50, 1))
    hits = MovingWorld(ROOM, [mover]).cast(above, down, times)
    np.testing.assert_allclose(hits["distance"], 1.9, atol=1e-9)
