"""Short recordings of the virtual L2 for the tests of the odometry, made once per test run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.protocol import wire
from l2lidar_node.types import Sweep
from l2lidar_proc.motion.imu_buffer import replay
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import OdometryEstimate
from l2lidar_proc.odometry.interface import Phase
from l2lidar_proc.odometry.odometry import Odometry
from tests.support.odometry_runs import Run, record, sweeps, truth

T_CLOUD_IMU = np.eye(4)
T_CLOUD_IMU[:3, 3] = wire.IMU_POSITION_M


@lru_cache(maxsize=16)
def recording(scene: str, motion: str, seconds: float = 6.0) -> Run:
    return record(scene, motion, 1, seconds)


def feed(
    odometry: Odometry,
    run: Run,
    some: list[Sweep],
    imu: NDArray[np.void] | None = None,
    may_skip: Callable[[int], bool] = lambda number: False,
) -> list[OdometryEstimate]:
    """Give the odometry sweeps and, before each, the samples up to its end."""
    imu = run.imu if imu is None else imu
    out: list[OdometryEstimate] = []
    for number, (sweep, samples) in enumerate(replay(some, imu)):
        odometry.imu(samples)
        out += odometry.register(sweep, may_skip=may_skip(number))
        # it goes back to them when the rest ends, so they have to be of that rest
        assert odometry.phase is Phase.STATIONARY or not odometry._at_rest
    return out


def drive(
    run: Run, cut: str = "turn", config: OdometryConfig | None = None, imu: Any = None
) -> Any:
    odometry = Odometry(config or OdometryConfig(), T_CLOUD_IMU)
    return feed(odometry, run, list(sweeps(run, cut)), imu)


@lru_cache(maxsize=4)
def driven(scene: str, motion: str) -> tuple[OdometryEstimate, ...]:
    """Return the estimates of a recording with default settings and full turns."""
    return tuple(drive(recording(scene, motion)))


def errors(run: Run, estimates: Sequence[OdometryEstimate]) -> NDArray[np.float64]:
    """Return distances from the truth after a rigid alignment [m], shape (N,)."""
    found = np.array([item.T_map_lidar[:3, 3] for item in estimates])
    true, _ = truth(run, np.array([item.stamp for item in estimates]))
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return np.linalg.norm(a @ turn.T - b, axis=1)
