"""Exact clouds: equal to decoded packets where nothing moves, consistent where something does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.physics import PhysicsConfig, assemble
from l2lidar_node.emulator.truth import into_cloud, undistorted
from l2lidar_node.emulator.unit.returns import RangeNoise
from l2lidar_node.emulator.unit.scanner import Scan, Scanner, local_rays
from l2lidar_node.emulator.world import scenes
from l2lidar_node.emulator.world.world import World
from l2lidar_node.settings import SettingError, build

pytest.importorskip("open3d")

SCENE = scenes.make("room")
WORLD = World(SCENE.triangles, SCENE.reflectivity)


def decoded(scan: Scan) -> np.ndarray:
    """Return what a driver makes of packets: points in the cloud frame of their own instants."""
    origin, direction = local_rays(scan.packets)
    distance = np.where(scan.returned, scan.rays["measured"], np.nan)
    return origin + direction * distance[..., None]


def test_a_still_sensors_cloud_is_the_decoded_one() -> None:
    motion = trajectories.make("still", SCENE, mount="tilted")
    scan = Scanner(WORLD, motion).scan(0, 30)

    np.testing.assert_allclose(
        undistorted(scan, motion, 7.0, measured=True), decoded(scan), atol=1e-9
    )


def test_a_moving_sensors_cloud_is_distorted() -> None:
    motion = trajectories.make("walk", SCENE, speed=1.2)
    scan = Scanner(WORLD, motion, noise=RangeNoise.clean()).scan(1200, 50)
    exact = undistorted(scan, motion, float(scan.times_s[0]), measured=True)

    error = np.linalg.norm(decoded(scan) - exact, axis=2)
    assert error[0].max() < 0.02
    assert 0.1 < np.sqrt(np.nanmean(error[-10:] ** 2)) < 2.0


def test_measured_and_surface_points_differ_by_the_noise() -> None:
    motion = trajectories.make("trot", SCENE)
    scan = Scanner(WORLD, motion, noise=RangeNoise(divergence_mrad=0.0)).scan(1000, 30)
    t = float(scan.times_s[10])
    difference = undistorted(scan, motion, t, measured=True) - undistorted(scan, motion, t)
    size = np.linalg.norm(difference, axis=2)[scan.returned]

    np.testing.assert_allclose(
        size, np.abs(scan.rays["measured"] - scan.rays["distance"])[scan.returned], atol=1e-9
    )
    assert 0.008 < np.sqrt(np.mean(size**2)) < 0.015


def test_the_reference_instant_moves_the_cloud_rigidly() -> None:
    motion = trajectories.make("drone", SCENE)
    scan = Scanner(WORLD, motion, noise=RangeNoise.clean()).scan(1500, 5)
    early, late = (undistorted(scan, motion, t).reshape(-1, 3) for t in (7.0, 7.2))

    def gaps(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points[1:] - points[:-1], axis=1)

    np.testing.assert_allclose(gaps(early), gaps(late), atol=1e-9)
    assert np.linalg.norm(early - late, axis=1).max() > 0.05


def test_the_origin_of_the_cloud_frame_is_where_the_motion_says() -> None:
    motion = trajectories.make("walk", SCENE)
    positions, _ = motion.poses(np.array([6.5]))

    np.testing.assert_allclose(into_cloud(positions, motion, 6.5), [[0, 0, 0]], atol=1e-12)


def test_slots_have_their_own_instants() -> None:
    motion = trajectories.make("still", SCENE)
    scan = Scanner(WORLD, motion).scan(40, 2)

    assert scan.first == 40
    np.testing.assert_allclose(scan.rays["time"][:, 0], scan.times_s)
    np.testing.assert_allclose(
        scan.rays["time"][:, 299] - scan.times_s, 299 * 0.004639 / 600, atol=1e-9
    )


def test_physics_are_assembled_from_settings() -> None:
    config = build(
        PhysicsConfig,
        {
            "world": "box",
            "motion": "spin",
            "motion_speed": 2.0,
            "unit": "fast",
            "gyro_noise": 0.0,
            "seed": 7,
        },
    )
    physics = assemble(config)

    assert physics.scanner.unit.name == "fast"
    assert physics.inertial.noise.gyro_noise == 0.0
    assert physics.scanner.seed == physics.inertial.seed == 7
    assert physics.inertial.motion is physics.scanner.motion is physics.motion
    assert physics.motion.kinematics(np.array([5.0])).angular_velocity[0, 2] == pytest.approx(2.0)


def test_a_mount_may_be_given_in_degrees() -> None:
    physics = assemble(PhysicsConfig(world="box", motion="still", mount_rpy_deg=(90.0, 0.0, 0.0)))

    force = physics.motion.kinematics(np.zeros(1)).specific_force()[0]
    np.testing.assert_allclose(force, [0, 9.80665, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"world": "kitchen"}, "kitchen"),
        ({"world": "no/such.ply"}, r"no/such\.ply"),
        ({"motion": "crawl"}, "crawl"),
        ({"motion": "no/such.tum"}, r"no/such\.tum"),
        ({"mount_rpy_deg": (1.0, 2.0)}, "mount_rpy_deg"),
    ],
)
def test_bad_settings_are_named(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        assemble(build(PhysicsConfig, {"world": "box", **values}))


def test_settings_are_checked_by_their_ranges() -> None:
    with pytest.raises(SettingError, match="range_noise"):
        build(PhysicsConfig, {"range_noise": -1.0})


def test_meshes_and_trajectories_come_from_files(tmp_path: Path) -> None:
    mesh, trajectory = tmp_path / "wall.obj", tmp_path / "path.tum"
    mesh.write_text("v 3 -9 -9\nv 3 9 -9\nv 3 0 20\nf 1 2 3\n")
    trajectory.write_text("".join(f"{t} {0.1 * t} 0 0 0 0 0 1\n" for t in range(6)))

    physics = assemble(
        PhysicsConfig(
            world=str(mesh), motion=str(trajectory), rest_s=0.0, ranges=RangeNoise.clean()
        )
    )
    scan = physics.scanner.scan(0, 50)

    met = np.isfinite(scan.rays["distance"])
    assert met.any()
    np.testing.assert_allclose(scan.hits[met][:, 0], 3.0, atol=1e-9)
