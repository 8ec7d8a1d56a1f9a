"""Simulates the odometry for the back end: true poses, a drift, and what the sensor sees.

Scans are cast along the true poses with the virtual L2's pattern and range noise, once for each
way and seed, and kept on disk where a folder is given. The odometry is the truth with errors that
add up: a bias in yaw, slipping ahead and sideways, and noise. None of the estimator's own noise
model is in it: the rates are drawn, then scaled to the drift that is asked for.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.unit.returns import noise_sigma
from l2lidar_node.emulator.unit.scanner import Scanner, local_rays
from l2lidar_node.emulator.world.mapping_scenes import MappingScene, along_way
from l2lidar_node.emulator.world.scenes import empty_box
from l2lidar_node.emulator.world.world import World
from l2lidar_node.types import F64, HostNs
from l2lidar_proc.slam import se3
from l2lidar_proc.slam.nodes import Health, OdometrySweep

EPOCH = 1_700_000_000_000_000_000
SPEED = 1.0  # [m/s] a walk
HEIGHT_M = 1.1
MAX_RANGE_M = 30.0
PACKETS_PER_TURN = 50
PATTERNS = 10
DRIFT_WINDOW_M = 20.0  # way over which drift is measured, in percent of it


@dataclass(frozen=True, slots=True, eq=False)
class MappingRun:
    """A way through a scene.

    Attributes
    ----------
    truth : ndarray, shape (N, 4, 4)
        Poses of the body in the world, one for each sweep.
    clouds : list of ndarray, shape (M, 3), float32
        Body frame [m].
    step : float
        Way between sweeps [m].
    """

    truth: F64
    clouds: list[NDArray[np.float32]]
    step: float

    def sweeps(self, odometry: F64, health: Health = Health.GOOD) -> Iterator[OdometrySweep]:
        """Yield the sweeps with poses (N, 4, 4) of an odometry."""
        for number, (pose, cloud) in enumerate(zip(odometry, self.clouds, strict=True)):
            yield OdometrySweep(
                self.stamp(number), pose, cloud.astype(np.float64), health, np.zeros((6, 6))
            )

    def stamp(self, number: int) -> HostNs:
        """Return the instant of a sweep."""
        return HostNs(EPOCH + round(number * self.step / SPEED * 1e9))

    def true_pose(self, stamp: int) -> F64:
        """Return the true pose (4, 4) at the instant of a sweep."""
        pose: F64 = self.truth[round((stamp - EPOCH) * 1e-9 * SPEED / self.step)]
        return pose

    def part(self, first: int, last: int) -> MappingRun:
        """Return the sweeps from one to before another; their stamps begin anew."""
        return MappingRun(self.truth[first:last], self.clouds[first:last], self.step)


def walk(
    scene: MappingScene, laps: float, *, step: float = 0.25, seed: int = 0, backwards: bool = False
) -> F64:
    """Return poses (N, 4, 4) of a walk along a scene's way; it sways and nods a little."""
    places, heading = along_way(scene.way[::-1] if backwards else scene.way, laps, step)
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0.0, 2.0 * np.pi, 4)
    s = np.arange(len(places)) * step
    aside = 0.15 * np.sin(s / 7.0 + phase[0])
    places = places + np.stack(
        (
            -aside * np.sin(heading),
            aside * np.cos(heading),
            HEIGHT_M + 0.03 * np.sin(s / 0.7 + phase[1]),
        ),
        axis=1,
    )
    angles = np.stack(
        (heading, 0.03 * np.sin(s / 1.1 + phase[2]), 0.03 * np.sin(s / 0.8 + phase[3])), axis=1
    )
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    poses[:, :3, 3] = places
    return poses


def scan(
    scene: MappingScene,
    poses: F64,
    *,
    step: float = 0.25,
    rays: int = 5000,
    seed: int = 0,
    kept: Path | None = None,
) -> MappingRun:
    """Return what the sensor sees along poses (N, 4, 4); from disk if it was cast before.

    Parameters
    ----------
    scene : MappingScene
    poses : ndarray, shape (N, 4, 4)
    step : float
        Way between the poses [m].
    rays : int
        Of each turn of the head, of the 15000 that a real one has.
    seed : int
    kept : Path, optional
        File to keep the scans in.
    """
    if kept is not None and kept.exists():
        with np.load(kept) as stored:
            points, ends = stored["points"], stored["ends"]
        return MappingRun(poses, np.split(points, ends[:-1]), step)
    world = World(scene.scene.triangles, scene.scene.reflectivity)
    rng = np.random.default_rng(seed)
    clouds = []
    for number, pose in enumerate(poses):
        origins, directions = _pattern(number % PATTERNS)
        chosen = rng.choice(len(origins), min(rays, len(origins)), replace=False)
        origins, directions = origins[chosen], directions[chosen]
        turn = pose[:3, :3].T
        hits = world.cast(origins @ turn + pose[:3, 3], directions @ turn)
        distance = hits["distance"]
        seen = (distance > 0.4) & (distance < MAX_RANGE_M) & (rng.random(len(chosen)) > 0.02)
        signal = hits["reflectivity"] * hits["incidence"] / np.maximum(distance, 0.1) ** 2
        seen &= signal > 0.0005
        distance = distance[seen] + noise_sigma(distance[seen]) * rng.standard_normal(seen.sum())
        points = origins[seen] + directions[seen] * distance[:, None]
        clouds.append(points.astype(np.float32))
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        ends = np.cumsum([len(cloud) for cloud in clouds])
        np.savez(kept, points=np.concatenate(clouds), ends=ends)
    return MappingRun(poses, clouds, step)


def drifting(truth: F64, percent: float, seed: int, step: float = 0.25) -> F64:
    """Return an odometry (N, 4, 4) that errs by so many percent over 20 m, root mean square.

    It begins at the origin, z up, as ours does.
    """
    rng = np.random.default_rng(seed)
    steps = np.linalg.inv(truth[:-1]) @ truth[1:]
    way = np.linalg.norm(steps[:, :3, 3], axis=1)
    count = len(steps)
    bias = rng.standard_normal(4)
    error = np.zeros((count, 6))
    error[:, 2] = np.radians(0.02) * (
        bias[0] * way / 10.0 + rng.standard_normal(count) * np.sqrt(way / 10.0)
    )
    error[:, 3:6] = 0.001 * rng.standard_normal((count, 3)) * np.sqrt(way)[:, None]
    error[:, 4] += 0.002 * bias[2] * way
    error[:, 5] += 0.0005 * bias[3] * way
    start = se3.inverse(se3.leveled(truth[0])) @ truth[0]

    def run(scale: float) -> F64:
        poses = [start]
        for true, off in zip(steps, se3.exp(scale * error), strict=True):
            poses.append(poses[-1] @ true @ off)
        return np.stack(poses)

    if percent == 0.0:
        return run(0.0)
    scale = 1.0
    for _ in range(3):
        scale *= percent / drift_percent(run(scale), truth, step)
    return run(scale)


def drift_percent(odometry: F64, truth: F64, step: float) -> float:
    """Return the root mean square error over 20 m of way, in percent."""
    span = max(min(round(DRIFT_WINDOW_M / step), len(truth) // 2), 1)
    true = np.linalg.inv(truth[:-span]) @ truth[span:]
    found = np.linalg.inv(odometry[:-span]) @ odometry[span:]
    off = (np.linalg.inv(true) @ found)[:, :3, 3]
    return float(np.sqrt((off**2).sum(axis=1).mean()) / (span * step) * 100.0)


def ate(estimate: F64, truth: F64) -> float:
    """Return the root mean square distance [m] after the best rigid alignment."""
    a, b = estimate[:, :3, 3], truth[:, :3, 3]
    turn, _ = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))
    off = turn.apply(a - a.mean(axis=0)) - (b - b.mean(axis=0))
    return float(np.sqrt((off**2).sum(axis=1).mean()))


@cache
def _pattern(number: int) -> tuple[F64, F64]:
    """Return origins and directions (M, 3) of one turn of the virtual L2's head."""
    scene = empty_box()
    scanner = Scanner(
        World(scene.triangles, scene.reflectivity), trajectories.make("still", scene)
    )
    packets, _ = scanner.packets(number * PACKETS_PER_TURN, PACKETS_PER_TURN)
    origins, directions = local_rays(packets)
    return origins.reshape(-1, 3), directions.reshape(-1, 3)
