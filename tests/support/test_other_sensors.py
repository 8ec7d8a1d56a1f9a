"""Other range sensors: windows, times and noise as their description says."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_node import rotations
from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.world import scenes
from l2lidar_node.emulator.world.world import World
from tests.support.other_sensors import SENSORS

pytest.importorskip("open3d")


@pytest.mark.parametrize("name", SENSORS)
def test_points_lie_on_the_world_where_the_sensor_was_at_their_time(name: str) -> None:
    sensor = SENSORS[name]
    scene = scenes.make("box")
    world = World(scene.triangles, scene.reflectivity)
    motion = trajectories.make("walk", scene, rest_s=0.0, seed=1)
    cloud = sensor.measure(world, motion, 7, seed=1)
    times = cloud["time"].astype(np.float64)
    assert (np.diff(times) >= 0.0).all()
    assert times[0] >= 0.0
    assert 0.5 * sensor.sweep_s < times[-1] < sensor.sweep_s
    assert len(cloud) > 3000
    points = np.stack([cloud[axis] for axis in "xyz"], axis=1).astype(np.float64)
    position, quaternion = motion.poses(7 * sensor.sweep_s + times)
    placed = position + np.einsum("nij,nj->ni", rotations.matrices(quaternion), points)
    # range noise along the beam: no more across the surface
    off = world.clearance(placed)
    assert np.sqrt(np.mean(off**2)) < 1.2 * (sensor.noise_m + 9.0 * sensor.noise_rate)
    ranges = np.linalg.norm(points, axis=1)
    assert sensor.near <= ranges.min() + 1e-6
    assert ranges.max() <= sensor.far + 1e-6


def test_the_depth_camera_looks_ahead_in_six_images() -> None:
    times, directions = SENSORS["depth_camera"].beams(0)
    assert len(np.unique(times)) == 6
    assert len(times) == 9000
    across = np.rad2deg(np.arctan2(directions[:, 1], directions[:, 0]))
    up = np.rad2deg(np.arctan2(directions[:, 2], directions[:, 0]))
    assert 68.0 < np.ptp(across) < 70.0
    assert 54.0 < np.ptp(up) < 57.0


def test_the_rosette_does_not_repeat() -> None:
    first, second = (SENSORS["rosette"].beams(k)[1] for k in (0, 1))
    assert np.abs(first - second).max() > 0.1
    off = np.rad2deg(np.arccos(np.clip(first[:, 0], -1.0, 1.0)))
    assert 34.0 < off.max() <= 35.0
