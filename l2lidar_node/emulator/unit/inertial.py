"""IMU of the virtual L2: rates, specific force and the onboard orientation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.emulator.motion.motion import Motion, rpy_quaternions
from l2lidar_node.emulator.rng import Stream, generator
from l2lidar_node.emulator.unit.scanner import mean_angle
from l2lidar_node.emulator.unit.units import UNITS, Unit
from l2lidar_node.protocol import wire
from l2lidar_node.settings import setting
from l2lidar_node.types import STANDARD_GRAVITY

_LINE_SHARES: Final = np.array(
    [0.5, 1.0, 0.3]
)  # of the head's line on x, y, z: as measured, y is worst
_LINE_PHASES: Final = np.array([0.0, 1.9, 4.1])
_SECOND_HARMONIC: Final = 0.4
_BLOCK: Final = 50  # samples that share one generator


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuNoise:
    """Imperfections of the IMU; 0 switches an effect off.

    Published figures for the gyro at rest with the motors on range from 0.03 to 0.35 rad/s in all,
    with lines at the head's frequency and its double. The defaults are the lower end: about 0.04
    rad/s.
    """

    gyro_noise: float = setting(
        0.03, "white noise of each gyro axis per sample", unit="rad/s", lo=0.0, hi=10.0
    )
    gyro_bias: tuple[float, ...] = setting(
        (0.01, -0.02, 0.015), "constant gyro error, x y z", unit="rad/s"
    )
    gyro_line: float = setting(
        0.03,
        "amplitude of the gyro's line at the head's frequency on y; half of it on x, a third "
        "on z, and 0.4 of each at twice the frequency",
        unit="rad/s",
        lo=0.0,
        hi=10.0,
    )
    accel_noise: float = setting(
        0.06, "white noise of each accelerometer axis per sample", unit="m/s^2", lo=0.0, hi=50.0
    )
    accel_bias: tuple[float, ...] = setting(
        (0.06, -0.05, 0.12), "constant accelerometer error, x y z", unit="m/s^2"
    )
    tilt_error: float = setting(
        0.6, "wander of the onboard orientation's roll and pitch", unit="deg", lo=0.0, hi=90.0
    )
    yaw_drift: float = setting(
        2.0, "drift of the onboard orientation's yaw", unit="deg/min", lo=-360.0, hi=360.0
    )
    gravity: float = setting(
        STANDARD_GRAVITY, "acceleration of gravity", unit="m/s^2", lo=0.0, hi=30.0
    )
    wrong_gravity: bool = setting(
        False,
        "the known fault of units powered on away from level: the specific force of that moment "
        "is added to every sample, so |a| is near 20 m/s^2",
    )

    @classmethod
    def clean(cls) -> ImuNoise:
        """Return settings of an ideal IMU; float32 and the quaternion's norm remain."""
        return cls(
            gyro_noise=0.0,
            gyro_bias=(0.0, 0.0, 0.0),
            gyro_line=0.0,
            accel_noise=0.0,
            accel_bias=(0.0, 0.0, 0.0),
            tilt_error=0.0,
            yaw_drift=0.0,
        )


class Inertial:
    """The IMU: sample i (i >= 0) is taken at ``i * period_s`` on the motion's time line.

    A sample depends on the seed and its number alone.

    Parameters
    ----------
    motion : Motion
        Moves the cloud frame; the IMU sits at wire.IMU_POSITION_M in it, axes parallel, but for
        the unit's errors.
    noise : ImuNoise
    seed : int
        The scanner's seed, so that the gyro's line follows the same head.
    unit : Unit
    """

    period_s: Final = 1.0 / wire.IMU_RATE_HZ

    def __init__(
        self, motion: Motion, noise: ImuNoise | None = None, seed: int = 0, unit: Unit = UNITS["a"]
    ) -> None:
        self.motion = motion
        self.noise = ImuNoise() if noise is None else noise
        self.seed = seed
        self.unit = unit
        x, y, z = np.add(wire.IMU_POSITION_M, unit.errors.imu_position).tolist()
        self._position = (x, y, z)
        self._to_cloud = unit.errors.imu_quaternion()
        start = motion.kinematics(np.zeros(1))
        self._start_force = start.specific_force(self._position, self.noise.gravity)[0]
        w, x, y, z = start.quaternion_wxyz[0]
        self._start_yaw = float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))

    def samples(self, first: int, count: int) -> tuple[NDArray[np.void], NDArray[np.float64]]:
        """Return samples ``first`` to ``first + count - 1``.

        Returns
        -------
        samples : ndarray, shape (count,), dtype wire.IMU_PAYLOAD
            ``info`` holds only the payload size; sequence number and stamp are the device's
            business.
        times_s : ndarray, shape (count,)
            True instants [s] on the motion's time line.
        """
        noise = self.noise
        times = np.arange(first, first + count, dtype=np.float64) * self.period_s
        errors = self.unit.errors
        moving = self.motion.kinematics(times - errors.imu_time_offset)
        normal = self._normal(first, count)
        rate = (
            self._turned(moving.angular_velocity) @ errors.gyro_matrix().T
            + errors.gyro_drift(times)
            + np.asarray(noise.gyro_bias)
            + noise.gyro_noise * normal[:, :3]
        )
        rate += noise.gyro_line * self._line(times)
        force = self._turned(moving.specific_force(self._position, noise.gravity))
        force += np.asarray(noise.accel_bias) + noise.accel_noise * normal[:, 3:]
        if noise.wrong_gravity:
            force += self._start_force
        samples = np.zeros(count, wire.IMU_PAYLOAD)
        samples["info"]["payload_size"] = wire.IMU_PAYLOAD.itemsize
        samples["quaternion_wxyz"] = wire.QUATERNION_NORM * self._orientation(
            times, moving.quaternion_wxyz
        )
        samples["angular_velocity"] = rate
        samples["linear_acceleration"] = force
        return samples, times

    def _turned(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return vectors (N, 3) of the cloud frame in the IMU frame."""
        if not any(self.unit.errors.imu_rotation):
            return vectors
        return np.asarray(vectors @ rotations.matrices(self._to_cloud[None])[0])

    def _line(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the vibration of the spinning head in the gyro, amplitude 1, shape (N, 3).

        A unit whose mount rocks has its line at the head's frequency from that.
        """
        phase = mean_angle(times, self.unit, self.seed)[:, None] + _LINE_PHASES
        first = 0.0 if self.unit.errors.rocks else np.sin(phase)
        return np.asarray(_LINE_SHARES * (first + _SECOND_HARMONIC * np.sin(2.0 * phase)))

    def _orientation(
        self, times: NDArray[np.float64], truth: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the onboard filter's orientation: drifting yaw from 0, a slow tilt error."""
        tilt = np.deg2rad(self.noise.tilt_error)
        error = np.zeros((len(times), 3))
        error[:, 0] = tilt * np.sin(2.0 * np.pi * times / 17.0 + 1.0)
        error[:, 1] = tilt * np.sin(2.0 * np.pi * times / 23.0 + 2.0)
        error[:, 2] = np.deg2rad(self.noise.yaw_drift) / 60.0 * times - self._start_yaw
        return rotations.multiply(rpy_quaternions(error), truth)

    def _normal(self, first: int, count: int) -> NDArray[np.float64]:
        """Return six standard normal numbers per sample, shape (count, 6)."""
        block = first // _BLOCK
        last = (first + max(count, 1) - 1) // _BLOCK
        drawn = [
            generator(self.seed, Stream.IMU, k).standard_normal((_BLOCK, 6))
            for k in range(block, last + 1)
        ]
        skip = first - block * _BLOCK
        return np.concatenate(drawn)[skip : skip + count]
