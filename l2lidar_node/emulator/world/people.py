"""People who walk along with the sensor or across its way."""

from __future__ import annotations

from typing import Final

import numpy as np

from l2lidar_node.emulator.motion.motion import Motion
from l2lidar_node.emulator.world.moving import Mover, Poses
from l2lidar_node.emulator.world.scene import Ground, Triangles, box, cone, ellipsoid
from l2lidar_node.emulator.world.world import World
from l2lidar_node.types import F64

_KNOTS_PER_S: Final = 5.0
_NEAREST_M: Final = 0.75  # nobody comes closer to the sensor
_CLOTHES: Final = (0.2, 0.6)  # reflectivity


def person(height: float = 1.75) -> Triangles:
    """Return a standing person, feet at z = 0, facing +x."""
    s = height / 1.75
    parts = [
        cone((0.06 * s, 0.1 * s, 0.0), 0.06 * s, 0.085 * s, 0.85 * s, 8),
        cone((-0.06 * s, -0.1 * s, 0.0), 0.06 * s, 0.085 * s, 0.85 * s, 8),
        ellipsoid((0.0, 0.0, 1.14 * s), (0.14 * s, 0.21 * s, 0.36 * s), 0.05, 12),
        ellipsoid((0.02 * s, 0.0, 1.62 * s), (0.1 * s, 0.085 * s, 0.13 * s), 0.0, 10),
        box((-0.08 * s, 0.22 * s, 0.75 * s), (0.06 * s, 0.3 * s, 1.4 * s)),
        box((-0.04 * s, -0.3 * s, 0.75 * s), (0.1 * s, -0.22 * s, 1.4 * s)),
    ]
    return np.concatenate(parts)


def crowd(
    motion: Motion, ground: Ground, count: int, seconds: float, seed: int = 0
) -> list[Mover]:
    """Return people around a sensor: two of three go with it, the others cross its way.

    Those who go along keep 0.8 to 2.5 m away and drift around the sensor; those who cross come
    from 12 m away, pass it at some 1 to 3 m and walk on, again and again.

    Parameters
    ----------
    motion : Motion
        The sensor's.
    ground : callable
        Height of the ground, see :class:`Scene`.
    count : int
        How many people.
    seconds : float
        Until when; afterwards they stand.
    seed : int
    """
    rng = np.random.default_rng((seed, 12))
    t = np.arange(0.0, seconds + 1.0, 1.0 / _KNOTS_PER_S)
    sensor = motion.poses(t)[0][:, :2]
    width = round(2.0 * _KNOTS_PER_S)  # people do not follow every sway of the sensor
    window = np.ones(2 * width + 1) / (2 * width + 1)
    padded = np.pad(sensor, ((width, width), (0, 0)), mode="edge")
    way = np.stack([np.convolve(padded[:, k], window, "valid") for k in range(2)], axis=1)
    movers = []
    for number in range(count):
        if number % 3 < 2:
            radius = rng.uniform(1.0, 2.4) + 0.3 * np.sin(rng.uniform(0.1, 0.4) * t)
            angle = rng.uniform(0.0, 2.0 * np.pi) + rng.uniform(-0.15, 0.15) * t
            angle = angle + 0.4 * np.sin(rng.uniform(0.1, 0.5) * t)
            place = way + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        else:
            place = _crossing(way, t, rng)
        place = _apart(place, sensor)
        body = World(person(float(rng.uniform(1.6, 1.9))), float(rng.uniform(*_CLOTHES)))
        movers.append(Mover.of(body, _on_foot(t, place, ground)))
    return movers


def _crossing(way: F64, t: F64, rng: np.random.Generator) -> F64:
    """Return the places of someone who walks across the sensor's way, there and back."""
    speed, half = rng.uniform(0.8, 1.5), 12.0
    travelled = np.abs(np.mod(rng.uniform(0.0, 4 * half) + speed * t, 4 * half) - 2 * half) - half
    side = rng.uniform(-3.0, 3.0) + np.sin(rng.uniform(0.05, 0.2) * t)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    ahead = np.array([np.cos(angle), np.sin(angle)])
    left = np.array([-ahead[1], ahead[0]])
    return np.asarray(way + travelled[:, None] * ahead + side[:, None] * left)


def _apart(place: F64, sensor: F64) -> F64:
    """Return places pushed away from the sensor to the nearest distance allowed."""
    to = place - sensor
    far = np.maximum(np.linalg.norm(to, axis=1, keepdims=True), 1e-3)
    return np.asarray(sensor + to * np.maximum(1.0, _NEAREST_M / far))


def _on_foot(t: F64, place: F64, ground: Ground) -> Poses:
    """Return the poses of someone who looks where he goes, between places at instants."""
    step = np.gradient(place, t, axis=0)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    z = ground(place[:, 0], place[:, 1])

    def poses(when: F64) -> tuple[F64, F64]:
        x, y, up, yaw = (
            np.interp(when, t, values) for values in (place[:, 0], place[:, 1], z, heading)
        )
        zero = np.zeros_like(yaw)
        quaternion = np.stack([np.cos(yaw / 2.0), zero, zero, np.sin(yaw / 2.0)], axis=1)
        return np.stack([x, y, up], axis=1), quaternion

    return poses
