"""Knows how the sensor moved lately, and says so for any sweep, with how well it is known."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from l2lidar_node.types import HostNs
from l2lidar_proc import rotations
from l2lidar_proc.config import MotionConfig
from l2lidar_proc.motion.attitude import AttitudeFilter
from l2lidar_proc.motion.imu_buffer import ImuWindow, Samples
from l2lidar_proc.motion.sweep_trajectory import Path, coverage, integrate, still_path
from l2lidar_proc.motion.velocity import VelocityHistory

_STILL_NS: Final = 500_000_000  # stillness is judged over two head turns at least
_MEMORY_S: Final = 25.0  # the longest sweep that can be had, and more


class Flag(Enum):
    """What was short of ideal about a sweep."""

    NO_IMU = "no IMU samples near the sweep, so it is passed on as it came"
    IMU_ENDS_EARLY = "the IMU samples do not reach the end of the sweep"
    IMU_STARTS_LATE = "the IMU samples begin after the start of the sweep"
    IMU_GAP = "a stretch of the sweep has no IMU samples"
    NO_VELOCITY = "no velocity is known, so rotation only"
    ACCELEROMETER_FAULT = "the size of gravity is wrong, as after a start on the side"
    CLOCK_JUMP = "the clock jumped while the sweep waited"
    FILTER_LEFT_OUT = "a filter could not work on these points, so its chain was left out"


@dataclass(frozen=True, slots=True)
class Quality:
    """How well the motion during a sweep is known.

    Attributes
    ----------
    imu_covered : float
        Share of the sweep between the first and the last IMU sample, 0 to 1.
    imu_gap_ns : int
        Longest stretch of the sweep without a sample.
    rotation_rad, translation_m : float
        Between start and end of the sweep.
    velocity_source : str
        Where the velocity came from, empty without one.
    velocity_age_ns : int
        From the newest velocity used to the end of the sweep; 0 where it reaches that far.
    bias : tuple of float
        Of the gyro [rad/s], IMU axes.
    is_still : bool
        The sensor did not move, so no point was moved.
    is_gravity_trusted : bool
        Whether vertical and accelerometer were of use.
    flags : tuple of Flag
    """

    imu_covered: float
    imu_gap_ns: int
    rotation_rad: float
    translation_m: float
    velocity_source: str
    velocity_age_ns: int
    bias: tuple[float, float, float]
    is_still: bool
    is_gravity_trusted: bool
    flags: tuple[Flag, ...]


class MotionTracker:
    """IMU window, attitude filter and velocities, asked together.

    Parameters
    ----------
    config : MotionConfig
    T_cloud_imu : ndarray, shape (4, 4), optional
        IMU coordinates to cloud coordinates, in place of the configured ones.

    Attributes
    ----------
    window : ImuWindow
    attitude : AttitudeFilter
    velocities : VelocityHistory
    """

    def __init__(self, config: MotionConfig, T_cloud_imu: rotations.F64 | None = None) -> None:
        self._T_cloud_imu = config.T_cloud_imu if T_cloud_imu is None else T_cloud_imu
        self.window = ImuWindow(_MEMORY_S)
        self.attitude = AttitudeFilter(self._T_cloud_imu, config.max_gyro_bias)
        self.velocities = VelocityHistory()
        self.configure(config)

    def configure(self, config: MotionConfig) -> None:
        """Take new live settings."""
        self._config = config
        self.velocities.max_age_ns = config.velocity_max_age_ms * 1_000_000

    def mount(self, T_cloud_imu: rotations.F64) -> bool:
        """Take the place of the IMU, shape (4, 4); return whether it is another one.

        Then what was learned is void.
        """
        if np.allclose(T_cloud_imu, self._T_cloud_imu, rtol=0.0, atol=1e-9):
            return False
        self._T_cloud_imu = T_cloud_imu
        self.attitude = AttitudeFilter(T_cloud_imu, self._config.max_gyro_bias)
        return True

    def reset(self) -> None:
        """Forget all motion, as after a jump of the clock."""
        self.window.clear()
        self.attitude.reset()
        self.velocities.clear()

    def imu(self, samples: Samples) -> bool:
        """Take IMU samples in any order and state; return whether the clock jumped with them."""
        jumps = self.window.counts.jumps
        fresh = self.window.push(samples)
        jumped = self.window.counts.jumps > jumps
        if jumped:
            self.attitude.reset()
            self.velocities.clear()
            fresh = self.window.samples.copy()
        self.attitude.push(fresh, self.velocities)
        return jumped

    def velocity(self, stamp: HostNs, velocity: ArrayLike, source: str) -> bool:
        """Take a velocity, see :meth:`VelocityHistory.push`."""
        return self.velocities.push(stamp, velocity, source)

    def path(self, start: HostNs, end: HostNs) -> tuple[Path, Quality]:
        """Return the path from ``start`` (or a little earlier) to ``end``, and how good it is.

        A sensor at rest, or one without any IMU sample near, has a path that does not move.
        """
        covered, gap = coverage(self.window.samples["stamp"], start, end)
        flags = self._flags(start, end, gap)
        if Flag.NO_IMU in flags:
            return still_path(start, end), self._quality(covered, gap, still=False, flags=flags)
        if self._is_still(start, end):
            return still_path(start, end), self._quality(covered, gap, still=True, flags=flags)
        velocities = self.velocities.around(start, end)
        if not len(velocities):
            flags = (*flags, Flag.NO_VELOCITY)
        gravity = self.attitude.gravity_before(start) if self._config.use_accelerometer else None
        if gravity is not None and gravity.stamp > end:
            gravity = None
        anchors = [gravity.stamp] if gravity is not None else []
        anchors.extend(velocities["stamp"][:1].tolist())
        origin = min([start, *anchors])
        last = max([end, *velocities["stamp"][-1:].tolist()])
        path = integrate(
            self.window.between(origin, last),
            origin,
            last,
            T_cloud_imu=self._T_cloud_imu,
            bias=self.attitude.bias,
            velocities=velocities,
            gravity=gravity,
            hold_ns=self._config.hold_ms * 1_000_000,
        )
        turned, moved = path.between(start, end)
        return path, self._quality(
            covered,
            gap,
            rotation=float(np.linalg.norm(rotations.log(turned))),
            translation=float(np.linalg.norm(moved)),
            age=max(int(end - velocities["stamp"][-1]), 0) if len(velocities) else None,
            flags=flags,
        )

    def _is_still(self, start: HostNs, end: HostNs) -> bool:
        velocity = self.velocities.at(end)
        if velocity is not None and np.linalg.norm(velocity) > self._config.still_speed:
            return False
        first = HostNs(min(start, end - _STILL_NS))
        stamps = self.window.samples["stamp"]
        within = slice(*np.searchsorted(stamps, [first, end]))
        return self.attitude.is_still(self.window.samples[within])

    def _flags(self, start: HostNs, end: HostNs, gap: int) -> tuple[Flag, ...]:
        stamps = self.window.samples["stamp"]
        hold = self._config.hold_ms * 1_000_000
        if not len(stamps) or stamps[-1] < start - hold or stamps[0] > end + hold:
            return (Flag.NO_IMU,)
        flags = []
        if stamps[0] > start:
            flags.append(Flag.IMU_STARTS_LATE)
        if stamps[-1] < end:
            flags.append(Flag.IMU_ENDS_EARLY)
        if gap > self._config.max_gap_ms * 1_000_000:
            flags.append(Flag.IMU_GAP)
        state = self.attitude.latest
        if state is not None and state.is_faulty:
            flags.append(Flag.ACCELEROMETER_FAULT)
        return tuple(flags)

    def _quality(
        self,
        covered: float,
        gap: int,
        *,
        rotation: float = 0.0,
        translation: float = 0.0,
        age: int | None = None,
        still: bool = False,
        flags: tuple[Flag, ...],
    ) -> Quality:
        state = self.attitude.latest
        x, y, z = self.attitude.bias.tolist()
        return Quality(
            imu_covered=covered,
            imu_gap_ns=gap,
            rotation_rad=rotation,
            translation_m=translation,
            velocity_source=self.velocities.source if age is not None else "",
            velocity_age_ns=age or 0,
            bias=(x, y, z),
            is_still=still,
            is_gravity_trusted=state is not None and state.is_trusted,
            flags=flags,
        )
