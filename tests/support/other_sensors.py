"""Models of other range sensors, for judging the odometry off line: cameras, spinning, rosette.

They share world, motion and IMU with the virtual L2, not its protocol: what they measure is
clouds with a time per point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.emulator.motion.motion import Motion
from l2lidar_node.emulator.rng import Stream, generator
from l2lidar_node.emulator.world.world import World
from l2lidar_node.types import F64

CLOUD_POINT: Final = np.dtype(
    [
        ("x", "<f4"),  # [m] sensor's frame
        ("y", "<f4"),
        ("z", "<f4"),
        ("time", "<f4"),  # [s] after the start of its sweep
        ("intensity", "<f4"),  # [1] 0 where the sensor measures none
    ]
)
"""A measured point."""

_WEAKEST: Final = 0.0004  # reflectivity * incidence / (range / longest range * 42 m)^2


@dataclass(frozen=True, slots=True)
class RangeSensor:
    """A sensor that measures ranges in directions of its own.

    Attributes
    ----------
    name : str
    sweep_s : float
        Time from one cloud to the next [s].
    beams : callable
        Times (N,) [s] after a sweep's start, ascending, and unit directions (N, 3) in the
        sensor's frame (x ahead, z up) of sweep k.
    near, far : float
        Nothing outside is returned [m].
    noise_m : float
        1-sigma range noise at 1 m and below [m].
    noise_rate : float
        What it grows by with the square of the range [1/m].
    lost : float
        Share of the beams that do not come back without a reason.
    """

    name: str
    sweep_s: float
    beams: Callable[[int], tuple[F64, F64]]
    near: float
    far: float
    noise_m: float
    noise_rate: float
    lost: float = 0.01

    def measure(
        self, world: World, motion: Motion, k: int, seed: int, particles: float = 0.0
    ) -> NDArray[np.void]:
        """Return sweep k, which starts at ``k * sweep_s``; shape (N,), dtype CLOUD_POINT.

        Parameters
        ----------
        world : World
        motion : Motion
            Moves the sensor's frame.
        k, seed : int
        particles : float
            Drops or grains that a beam meets per meter, see :func:`returns.particles`.
        """
        from l2lidar_node.emulator.unit.returns import particle_distances

        times, directions = self.beams(k)
        position, quaternion = motion.poses(k * self.sweep_s + times)
        ahead = np.einsum("nij,nj->ni", rotations.matrices(quaternion), directions)
        hits = world.cast(position, ahead, k * self.sweep_s + times)
        rng = generator(seed, Stream.RETURN, k)
        distance = hits["distance"].copy()
        strength = hits["reflectivity"] * hits["incidence"]
        if particles > 0.0:
            grain = particle_distances(rng.random(len(distance)), particles)
            strength = np.where(grain < distance, 0.3, strength)
            distance = np.minimum(distance, grain)
        back = np.isfinite(distance)
        distance = np.where(back, distance, 1.0)
        signal = strength / np.maximum(distance * 42.0 / self.far, 0.1) ** 2
        back &= signal > _WEAKEST * np.exp(0.3 * rng.standard_normal(len(distance)))
        back &= rng.random(len(distance)) >= self.lost
        sigma = self.noise_m + self.noise_rate * np.maximum(distance - 1.0, 0.0) ** 2
        distance = distance + sigma * rng.standard_normal(len(distance))
        back &= (distance >= self.near) & (distance <= self.far)
        points = np.zeros(int(back.sum()), CLOUD_POINT)
        xyz = directions[back] * distance[back, None]
        points["x"], points["y"], points["z"] = xyz.T
        points["time"] = times[back]
        return points


def _depth_camera(k: int) -> tuple[F64, F64]:
    """Six images of 50 x 30 pixels within 0.1 s, 70 x 57 degrees; all of an image at once."""
    across, up = np.tan(np.deg2rad(35.0)), np.tan(np.deg2rad(28.5))
    y, z = np.meshgrid(
        (np.arange(50) + 0.5) / 25.0 - 1.0, (np.arange(30) + 0.5) / 15.0 - 1.0, indexing="ij"
    )
    image = np.column_stack([np.ones(y.size), across * y.ravel(), up * z.ravel()])
    image /= np.linalg.norm(image, axis=1, keepdims=True)
    times = np.repeat(np.arange(6) / 60.0, len(image))
    return times, np.tile(image, (6, 1))


def spinning(rings: F64, columns: int, sweep_s: float) -> Callable[[int], tuple[F64, F64]]:
    """Return the beams of a lidar that turns once per sweep; elevations of the rings [rad]."""
    azimuth = -np.arange(columns) * 2.0 * np.pi / columns
    directions = np.stack(
        [
            np.cos(azimuth)[:, None] * np.cos(rings),
            np.sin(azimuth)[:, None] * np.cos(rings),
            np.broadcast_to(np.sin(rings), (columns, len(rings))),
        ],
        axis=-1,
    ).reshape(-1, 3)
    times = np.repeat(np.arange(columns) * sweep_s / columns, len(rings))
    return lambda k: (times, directions)


def _rosette(k: int) -> tuple[F64, F64]:
    """Return 20,000 beams of a flower within 70 degrees ahead that never repeats."""
    n = 20_000
    t = (k * n + np.arange(n)) / (10.0 * n)
    radius = np.deg2rad(35.0) * np.abs(np.cos(2.0 * np.pi * 76.23 * t))
    angle = 2.0 * np.pi * 49.117 * t
    return np.arange(n) / (10.0 * n), np.column_stack(
        [np.cos(radius), np.sin(radius) * np.cos(angle), np.sin(radius) * np.sin(angle)]
    )


SENSORS: Final[dict[str, RangeSensor]] = {
    sensor.name: sensor
    for sensor in (
        RangeSensor("depth_camera", 0.1, _depth_camera, 0.15, 5.0, 0.004, 0.0025, 0.02),
        RangeSensor(
            "spinning_16", 0.1, spinning(np.deg2rad(np.arange(-15.0, 16.0, 2.0)), 1200, 0.1),
            0.5, 100.0, 0.02, 0.0,
        ),
        RangeSensor(
            "spinning_64", 0.1, spinning(np.linspace(-0.39, 0.39, 64), 512, 0.1),
            0.5, 90.0, 0.015, 0.0,
        ),
        RangeSensor("rosette", 0.1, _rosette, 0.3, 90.0, 0.015, 0.0),
    )
}  # fmt: skip
"""``depth_camera``: 70 x 57 degrees, 5 m, six images a sweep; ``spinning_16`` and ``spinning_64``:
10 Hz, 16 rings of 2 degrees, 64 of 0.7; ``rosette``: a 70 degree cone that never repeats."""
