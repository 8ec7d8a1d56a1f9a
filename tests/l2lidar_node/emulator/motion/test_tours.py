"""Tours through doors and up stairs: smooth, clear of walls, at the rates asked for."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.world import buildings, scenes
from l2lidar_node.emulator.world.scene import Scene
from l2lidar_node.emulator.world.world import World

pytest.importorskip("open3d")

TOURS = [
    (buildings.flat(2), "look"),
    (buildings.stairwell(2), "climb"),
    (buildings.atrium(2), "look"),
    (buildings.office_corridor(2), "drive"),
]


@pytest.mark.parametrize(("scene", "style"), TOURS)
def test_a_tour_touches_nothing_and_keeps_its_pace(scene: Scene, style: str) -> None:
    manner = trajectories.STYLES[style]
    motion = trajectories.tour(scene, manner, seconds=60.0, seed=2)
    moving = motion.kinematics(np.arange(0.0, 60.0, 0.02))
    world = World(scene.triangles)
    assert world.clearance(moving.position).min() > 0.3
    flat = np.linalg.norm(moving.velocity[:, :2], axis=1)
    assert 0.9 * manner.speed < flat.max() < 1.3 * manner.speed + 0.1
    if style != "drive":
        assert 0.9 * manner.turn_rate < np.abs(moving.angular_velocity[:, 2]).max()
    assert np.linalg.norm(moving.angular_velocity, axis=1).max() < manner.turn_rate + 1.2
    assert np.linalg.norm(moving.acceleration, axis=1).max() < 8.0


@pytest.mark.parametrize(("scene", "style"), TOURS[:2])
def test_velocities_are_the_derivatives_of_places(scene: Scene, style: str) -> None:
    motion = trajectories.tour(scene, trajectories.STYLES[style], seconds=30.0)
    t, step = np.linspace(3.0, 25.0, 400), 1e-5
    before, after = motion.poses(t - step)[0], motion.poses(t + step)[0]
    moving = motion.kinematics(t)
    np.testing.assert_allclose((after - before) / (2 * step), moving.velocity, atol=1e-5)
    slower, faster = motion.kinematics(t - step).velocity, motion.kinematics(t + step).velocity
    np.testing.assert_allclose((faster - slower) / (2 * step), moving.acceleration, atol=1e-3)


def test_blows_are_short_and_hard() -> None:
    calm = trajectories.make("still", scenes.make("room"))
    motion = trajectories.hit(calm, 10.0, [3.0, 7.0], seed=1)
    t = np.arange(0.0, 10.0, 0.004)
    moving = motion.kinematics(t)
    place, _ = calm.poses(t)
    off = np.linalg.norm(moving.position - place, axis=1)
    struck = (np.abs(t - 3.0) < 0.06) | (np.abs(t - 7.0) < 0.06)
    assert off[~struck].max() < 1e-6
    assert 0.008 < off[struck].max() < 0.011
    assert 20.0 < np.linalg.norm(moving.acceleration, axis=1).max() < 60.0
    assert 1.0 < np.linalg.norm(moving.angular_velocity, axis=1).max() < 6.0


def test_a_scene_without_a_tour_is_refused() -> None:
    with pytest.raises(ValueError, match="no tour"):
        trajectories.tour(scenes.make("room"), trajectories.STYLES["look"], seconds=10.0)
