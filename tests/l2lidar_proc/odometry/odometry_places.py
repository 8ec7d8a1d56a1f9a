"""Places without rooms for the tests of the odometry: made here, recorded once per test run."""

from __future__ import annotations

import tempfile
from functools import lru_cache
from pathlib import Path

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from l2lidar_node.emulator.motion.motion import rpy_quaternions
from l2lidar_node.emulator.world import scene, scenes
from l2lidar_node.recording import tum
from tests.support.odometry_runs import Run, record

SEED = 6


def bushes() -> NDArray[np.float64]:
    """Return the leaves of bushes and crowns about a clearing: nothing is flat."""
    source = np.random.default_rng(SEED)
    leaves = []
    for _ in range(30):
        angle, distance = source.uniform(0.0, 2.0 * np.pi), source.uniform(3.0, 9.0)
        place = distance * np.cos(angle), distance * np.sin(angle), source.uniform(0.8, 3.5)
        size = source.uniform(0.5, 1.3)
        way = source.standard_normal((350, 3))
        way *= size * source.uniform(0.4, 1.0, (350, 1)) / np.linalg.norm(way, axis=1)[:, None]
        corners = place + way
        edges = 0.08 * source.standard_normal((2, 350, 3))
        leaves.append(np.stack([corners, corners + edges[0], corners + edges[1]], axis=1))
    return np.concatenate(leaves)


def poles() -> NDArray[np.float64]:
    """Return poles and crowns far apart below an open sky: one point in twenty comes back."""
    source = np.random.default_rng(SEED)
    parts = []
    for angle in np.linspace(0.0, 2.0 * np.pi, 12)[:-1]:
        x, y = source.uniform(5.0, 9.0) * np.array([np.cos(angle), np.sin(angle)])
        parts.append(scene.cone((x, y, 0.0), 0.12, 0.1, 4.0))
        parts.append(scene.ellipsoid((x, y, 4.0), (0.9, 0.8, 1.0), 0.3))
    return np.concatenate(parts)


def ring(seconds: float, speed: float = 0.7, radius: float = 1.4) -> NDArray[np.void]:
    """Return a walk round a circle with a bob and a sway."""
    t = np.arange(0.0, seconds, 0.01)
    angle = speed / radius * t
    wave = np.sin(2.0 * np.pi * 1.7 * t)
    place = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 1.1 + 0.02 * wave])
    rpy = np.column_stack(
        [0.04 * np.sin(2.0 * t), 0.05 * np.sin(1.5 * t), angle + np.pi / 2 + 0.2 * np.sin(t)]
    )
    return tum.pose_array(np.round(t * 1e9).astype(np.int64), place, rpy_quaternions(rpy))


def shaking(seconds: float) -> NDArray[np.void]:
    """Return a sensor shaken about one spot of the room, at up to 3 rad/s."""
    t = np.arange(0.0, seconds, 0.01)
    x, y = scenes.make("room").spot
    swing = np.sin(2.0 * np.pi * 0.8 * t)
    place = np.column_stack([x + 0.1 * np.sin(2.0 * t), y + 0.02 * swing, 1.1 + 0.03 * swing])
    rpy = np.column_stack([0.15 * np.sin(7.0 * t), 0.1 * np.sin(9.0 * t), 0.6 * swing])
    return tum.pose_array(np.round(t * 1e9).astype(np.int64), place, rpy_quaternions(rpy))


@lru_cache(maxsize=2)
def shaken(seconds: float = 7.0) -> Run:
    """Return a recording of 2 s of rest and then shaking in the built-in room."""
    with tempfile.TemporaryDirectory() as folder:
        motion = Path(folder) / "motion.tum"
        motion.write_text(tum.render(shaking(seconds)), encoding="utf-8")
        return record("room", str(motion), 1, seconds)


@lru_cache(maxsize=4)
def visited(place: str, seconds: float = 6.0) -> Run:
    """Return a recording of 2 s of rest and a walk at a place made here."""
    triangles = {"bushes": bushes, "poles": poles}[place]().reshape(-1, 3)
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(triangles),
        o3d.utility.Vector3iVector(np.arange(len(triangles)).reshape(-1, 3)),
    )
    with tempfile.TemporaryDirectory() as folder:
        world, motion = Path(folder) / "world.ply", Path(folder) / "motion.tum"
        o3d.io.write_triangle_mesh(world, mesh)
        motion.write_text(tum.render(ring(seconds)), encoding="utf-8")
        return record(str(world), str(motion), 1, seconds)


def driven_round(seconds: float, speed: float) -> Run:
    """Return a recording of 2 s of rest and a fast drive round a circle in the built-in yard."""
    with tempfile.TemporaryDirectory() as folder:
        motion = Path(folder) / "motion.tum"
        motion.write_text(tum.render(ring(seconds, speed)), encoding="utf-8")
        return record("yard", str(motion), 1, seconds)
