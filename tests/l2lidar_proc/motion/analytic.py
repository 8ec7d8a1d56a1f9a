"""Motions known in closed form, what an IMU on them says and what a sensor on them sees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from l2lidar_node.types import F64, IMU_SAMPLE, POINT, HostNs

EPOCH = HostNs(1_700_000_000_000_000_000)
G = 9.80665
T_CLOUD_IMU = np.eye(4)
T_CLOUD_IMU[:3, 3] = (-0.007698, -0.014655, 0.00667)


def at(seconds: float) -> HostNs:
    """Return an instant so many seconds after the epoch of the tests."""
    return HostNs(EPOCH + round(seconds * 1e9))


@dataclass(frozen=True)
class Motion:
    """Nodding and turning about world z while moving on a curve.

    Attributes
    ----------
    turn : float
        Mean rate about z [rad/s].
    nod : float
        Amplitude of pitch and roll [rad], at 1.5 and 1.1 Hz.
    speed : float
        Mean forward speed [m/s]; a bob and a sway of a walker come on top in proportion.
    """

    turn: float = 0.0
    nod: float = 0.0
    speed: float = 0.0

    def rotation(self, t: F64) -> Rotation:
        """Return cloud to world."""
        yaw = self.turn * t
        pitch = self.nod * np.sin(2 * np.pi * 1.5 * t)
        roll = self.nod * np.sin(2 * np.pi * 1.1 * t + 1.0)
        return Rotation.from_euler("ZYX", np.stack((yaw, pitch, roll), axis=-1))

    def position(self, t: F64) -> F64:
        """Return the cloud frame's origin in the world [m], shape (N, 3)."""
        sway = 0.02 * self.speed
        return np.stack(
            (
                self.speed * t,
                sway * np.sin(2 * np.pi * 0.9 * t),
                1.0 + sway * np.sin(2 * np.pi * 1.8 * t),
            ),
            axis=-1,
        )

    def velocity(self, t: F64, h: float = 1e-4) -> F64:
        """Return the velocity of the origin in cloud axes [m/s], shape (N, 3)."""
        world = (self.position(t + h) - self.position(t - h)) / (2 * h)
        return self.rotation(t).inv().apply(world)

    def imu(
        self, start: float, end: float, bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> NDArray[np.void]:
        """Return what a noiseless IMU says at 250 Hz, dtype IMU_SAMPLE."""
        t = np.arange(round(start * 250), round(end * 250) + 1) / 250.0
        h = 1e-4
        here = self.rotation(t)
        rate = (self.rotation(t - h).inv() * self.rotation(t + h)).as_rotvec() / (2 * h)
        lever = T_CLOUD_IMU[:3, 3]
        places = [self.position(t + d) + self.rotation(t + d).apply(lever) for d in (-h, 0.0, h)]
        acceleration = (places[0] - 2 * places[1] + places[2]) / h**2
        samples = np.zeros(len(t), dtype=IMU_SAMPLE)
        samples["stamp"] = EPOCH + np.round(t * 1e9).astype(np.int64)
        samples["orientation_wxyz"] = np.roll(here.as_quat(), 1, axis=1)
        samples["angular_velocity"] = rate + bias
        samples["linear_acceleration"] = here.inv().apply(acceleration + np.array([0.0, 0.0, G]))
        return samples


def noisy(
    samples: NDArray[np.void],
    gyro: float = 0.03,
    line: float = 0.03,
    force: float = 0.06,
    seed: int = 3,
) -> NDArray[np.void]:
    """Return samples with white noise and the gyro's line at the turning head's 4.36 Hz."""
    rng = np.random.default_rng(seed)
    made = samples.copy()
    t = (made["stamp"] - EPOCH) * 1e-9
    made["angular_velocity"] += rng.normal(0.0, gyro, (len(made), 3))
    made["angular_velocity"] += line * np.sin(2 * np.pi * 4.36 * t[:, None] + np.arange(3))
    made["linear_acceleration"] += rng.normal(0.0, force, (len(made), 3))
    return made


def seen(
    motion: Motion, start: float, end: float, reference: float, count: int = 6000, seed: int = 1
) -> Any:
    """Return a sweep of random points, dtype POINT, and their true places from the reference."""
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(start, end, count).astype(np.float32).astype(np.float64))
    times[0] = start
    points = np.zeros(count, dtype=POINT)
    points["time"] = times - start
    times = start + points["time"].astype(np.float64)
    world = rng.uniform((-8, -8, -1), (8, 8, 4), (count, 3))
    local = motion.rotation(times).inv().apply(world - motion.position(times))
    points["x"], points["y"], points["z"] = local.T
    points["range"] = np.linalg.norm(local, axis=1)
    points["intensity"] = rng.integers(1, 255, count)
    moment = np.array([reference])
    truth = motion.rotation(moment).inv().apply(world - motion.position(moment))
    return points, truth


def xyz(points: NDArray[np.void]) -> F64:
    """Return the coordinates, shape (N, 3)."""
    return np.stack([points[name].astype(np.float64) for name in "xyz"], axis=-1)


def rms(difference: F64) -> float:
    """Return the root of the mean squared length of vectors of shape (N, 3)."""
    return float(np.sqrt((difference**2).sum(axis=1).mean()))
