"""Rays against geometry that can be computed by hand, mesh files, and the built-in scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.world import scenes
from l2lidar_node.emulator.world.scene import box, cone, ellipsoid, placed
from l2lidar_node.emulator.world.world import World

pytest.importorskip("open3d")

TETRAHEDRON_OBJ = """
v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
f 1 3 2
f 1 2 4
f 2 3 4
f 1 4 3
"""
TRIANGLE_STL = """solid one
facet normal 0 0 1
outer loop
vertex 0 0 2
vertex 1 0 2
vertex 0 1 2
endloop
endfacet
endsolid one
"""
TRIANGLE_PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 1
property list uchar int vertex_indices
end_header
0 0 2 51 51 51
1 0 2 51 51 51
0 1 2 51 51 51
3 0 1 2
"""


def directions(count: int, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_distance_and_incidence_in_a_box_are_exact() -> None:
    low, high = np.array([-3.0, -2.5, 0.0]), np.array([3.0, 2.5, 3.0])
    world = World(box(tuple(low), tuple(high)), 0.6)
    origin = np.array([0.7, -0.3, 1.1])
    rays = directions(2000)
    expected = np.where(rays > 0, (high - origin) / rays, (low - origin) / rays)

    hits = world.cast(np.tile(origin, (len(rays), 1)), rays)

    np.testing.assert_allclose(hits["distance"], expected.min(axis=1), rtol=0, atol=1e-12)
    axis = expected.argmin(axis=1)
    np.testing.assert_allclose(
        hits["incidence"], np.abs(rays[np.arange(len(rays)), axis]), atol=1e-12
    )
    np.testing.assert_allclose(hits["reflectivity"], 0.6, rtol=1e-6)


def test_a_world_far_from_its_origin_is_as_exact() -> None:
    offset = np.array([4.0e5, 5.6e6, 120.0])
    near, far = World(box((-2, -2, 0), (2, 2, 2))), World(box((-2, -2, 0), (2, 2, 2)) + offset)
    origins, rays = np.tile([0.3, 0.1, 0.8], (500, 1)), directions(500)

    np.testing.assert_allclose(
        far.cast(origins + offset, rays)["distance"],
        near.cast(origins, rays)["distance"],
        atol=1e-7,
    )
    np.testing.assert_allclose(
        far.clearance(origins[:1] + offset), near.clearance(origins[:1]), atol=1e-6
    )


def test_a_ray_that_meets_nothing_has_no_distance() -> None:
    world = World(box((1.0, -1.0, -1.0), (2.0, 1.0, 1.0)))

    hits = world.cast(np.zeros((2, 3)), np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))

    assert np.isinf(hits["distance"][0])
    assert hits["distance"][1] == pytest.approx(1.0)
    assert hits["reflectivity"][0] == 0


def test_both_sides_of_a_triangle_reflect() -> None:
    world = World(np.array([[[5.0, -9.0, -9.0], [5.0, 9.0, -9.0], [5.0, 0.0, 20.0]]]))

    hits = world.cast(
        np.array([[0.0, 0.0, 0.0], [8.0, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    )

    np.testing.assert_allclose(hits["distance"], [5.0, 3.0])


def test_clearance_is_the_distance_to_the_nearest_surface() -> None:
    world = World(box((-3.0, -2.0, 0.0), (3.0, 2.0, 3.0)))

    np.testing.assert_allclose(
        world.clearance(np.array([[0.0, 0.0, 1.0], [2.5, 0.0, 1.5]])), [1.0, 0.5], atol=1e-6
    )


def test_triangles_without_area_are_left_out_with_their_reflectivity() -> None:
    flat = np.zeros((1, 3, 3))
    world = World(np.concatenate([flat, box((-1, -1, -1), (1, 1, 1))]), np.arange(13) / 20)

    assert len(world.triangles) == 12
    np.testing.assert_allclose(world.reflectivity, np.arange(1, 13) / 20, rtol=1e-6)


@pytest.mark.parametrize(
    ("triangles", "message"),
    [
        (np.zeros((2, 3, 3)), "zero area"),
        (np.full((1, 3, 3), np.nan), "not finite"),
        (np.zeros((5, 3)), "shape"),
    ],
)
def test_bad_triangles_are_refused(triangles: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        World(triangles)


@pytest.mark.parametrize(
    ("name", "text", "distance", "reflectivity"),
    [
        ("t.obj", TETRAHEDRON_OBJ, 1.0, 0.5),
        ("t.stl", TRIANGLE_STL, 3.0, 0.5),
        ("t.ply", TRIANGLE_PLY, 3.0, 0.2),
    ],
)
def test_mesh_files_are_cast_against(
    tmp_path: Path, name: str, text: str, distance: float, reflectivity: float
) -> None:
    path = tmp_path / name
    path.write_text(text)

    hit = World.load(path).cast(np.array([[0.2, 0.2, -1.0]]), np.array([[0.0, 0.0, 1.0]]))

    assert hit["distance"][0] == pytest.approx(distance, abs=1e-9)
    assert hit["reflectivity"][0] == pytest.approx(reflectivity, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.ply", b""),
        ("noise.ply", bytes(range(256)) * 8),
        ("noise.stl", b"\x00" * 40),
        ("short.stl", b"\x00" * 80 + b"\xff\xff\xff\x7f" + b"\x00" * 40),
        ("text.obj", b"this is no mesh\n"),
        ("points.ply", TRIANGLE_PLY.replace("element face 1", "element face 0").encode()),
        ("index.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        ("index.ply", TRIANGLE_PLY.replace("3 0 1 2", "3 0 1 9").encode()),
        ("negative.ply", TRIANGLE_PLY.replace("3 0 1 2", "3 0 1 -9").encode()),
        ("degenerate.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 2\n"),
        ("nan.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        ("mesh.xyz", b"0 0 0\n1 0 0\n"),
    ],
)
def test_a_bad_mesh_file_is_named(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)

    with pytest.raises(ValueError, match=name):
        World.load(path)


def test_a_missing_mesh_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"gone\.ply.*no such file"):
        World.load(tmp_path / "gone.ply")


def test_shapes_have_their_size() -> None:
    turned = placed(box((-1, -2, 0), (1, 2, 3)), (5.0, 0.0, 1.0), np.pi / 2)
    np.testing.assert_allclose(turned.min(axis=(0, 1)), [3.0, -1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(turned.max(axis=(0, 1)), [7.0, 1.0, 4.0], atol=1e-12)
    ball = ellipsoid((1.0, 2.0, 3.0), (1.0, 2.0, 0.5))
    np.testing.assert_allclose(ball.min(axis=(0, 1))[2], 2.5)
    np.testing.assert_allclose(np.ptp(cone((0, 0, 1), 0.3, 0.1, 2.0)[..., 2]), 2.0)


@pytest.mark.parametrize("name", list(scenes.SCENES))
def test_scenes_are_the_same_every_time_and_reflect(name: str) -> None:
    one, two = scenes.make(name), scenes.make(name)

    np.testing.assert_array_equal(one.triangles, two.triangles)
    np.testing.assert_array_equal(one.reflectivity, two.reflectivity)
    assert one.reflectivity.min() > 0
    assert one.reflectivity.max() < 1


@pytest.mark.parametrize("name", ["box", "room", "corridor"])
def test_indoor_scenes_are_closed(name: str) -> None:
    scene = scenes.make(name)
    x, y = scene.spot

    hits = World(scene.triangles, scene.reflectivity).cast(
        np.tile([x, y, 1.0], (20_000, 1)), directions(20_000)
    )

    assert np.isfinite(hits["distance"]).all()


def test_the_yard_is_open_above_and_closed_below() -> None:
    scene = scenes.make("yard")
    x, y = scene.spot
    rays = directions(20_000)
    origin = np.array([x, y, float(scene.ground(np.array(x), np.array(y))) + 1.0])

    found = np.isfinite(
        World(scene.triangles).cast(np.tile(origin, (len(rays), 1)), rays)["distance"]
    )

    assert found[rays[:, 2] < -0.1].all()
    assert 0.2 < found[rays[:, 2] > 0.0].mean() < 0.9


def test_the_room_has_no_symmetry() -> None:
    scene = scenes.make("room")
    world = World(scene.triangles)
    rays = directions(4000)
    distances = [
        world.cast(np.tile([0.0, 0.0, 1.2], (len(rays), 1)), rays * np.array(mirror))["distance"]
        for mirror in ([1, 1, 1], [-1, 1, 1], [1, -1, 1], [-1, -1, 1])
    ]

    for other in distances[1:]:
        assert (np.abs(other - distances[0]) > 0.1).mean() > 0.25


def test_an_unknown_scene_is_refused() -> None:
    with pytest.raises(ValueError, match=r"'kitchen'.*room"):
        scenes.make("kitchen")


def test_any_world_has_a_way_where_there_is_room() -> None:
    hall = box((2.0, 0.0, -1.0), (10.0, 6.0, 2.0))
    block = box((2.0, 0.0, -1.0), (5.0, 6.0, 2.0))
    world = World(np.concatenate([hall, block]))

    scene = scenes.of_world(world)

    motion = trajectories.make("walk", scene)
    positions, _ = motion.poses(np.arange(0.0, 40.0, 0.1))
    assert world.clearance(positions).min() > 0.5
    assert (positions[:, 0] > 5.0).all()
    assert np.ptp(positions[:, 0]) > 1.0
    assert scene.ground(np.array(7.0), np.array(2.0)) == pytest.approx(-1.0)
    assert scene.headroom == pytest.approx(3.0)


def test_a_world_without_room_still_has_a_place() -> None:
    scene = scenes.of_world(
        World(np.array([[[3.0, -9.0, -9.0], [3.0, 9.0, -9.0], [3.0, 0.0, 20.0]]]))
    )

    assert np.isfinite(scene.route).all()
    assert np.isfinite(scene.headroom)
