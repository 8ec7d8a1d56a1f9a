"""A sensor at rest stays where it is, one that creeps does not; real clouds and virtual ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from l2lidar_node.types import IMU_SAMPLE, POINT, HostNs, Sweep
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import OdometryEstimate
from l2lidar_proc.odometry.odometry import Odometry
from tests.l2lidar_proc.odometry.odometry_world import T_CLOUD_IMU, drive
from tests.support.build import REAL_L2
from tests.support.odometry_runs import EPOCH, record, truth

PERIOD = 4.633e-3  # [s] from packet to packet
HZ = 100  # of a motion file
RESTED = 2.0  # [s] at the beginning of every recording


def way(estimates: list[OdometryEstimate]) -> NDArray[np.float64]:
    """Return how far each pose is from the first [m]."""
    places = np.array([one.T_map_lidar[:3, 3] for one in estimates])
    return np.linalg.norm(places - places[0], axis=1)


def turned(estimates: list[OdometryEstimate]) -> NDArray[np.float64]:
    """Return by how much each pose is turned against the first [rad]."""
    turns = np.array([one.T_map_lidar[:3, :3] for one in estimates])
    cosines = (np.einsum("ij,nij->n", turns[0], turns) - 1.0) / 2.0
    return np.arccos(np.clip(cosines, -1.0, 1.0))


def captured(number: int, packets: int) -> list[Sweep]:
    """Return a capture of the real unit in sweeps of so many packets."""
    xyz = np.load(REAL_L2 / f"capture_00{number}.npy")
    returned = np.isfinite(np.load(REAL_L2 / f"capture_00{number}_packets.npz")["range_m"])
    packet, slot = np.nonzero(returned)
    times = packet * PERIOD + slot * PERIOD / 600.0
    out = []
    for first in range(0, len(returned) - packets, packets):
        inside = (packet >= first) & (packet < first + packets)
        points = np.zeros(int(inside.sum()), POINT)
        points["x"], points["y"], points["z"] = xyz[: len(packet)][inside].T
        points["range"] = np.linalg.norm(xyz[: len(packet)][inside], axis=1)
        points["time"] = times[inside] - times[inside][0]
        start = EPOCH + round(times[inside][0] * 1e9)
        end = EPOCH + round((first + packets - 0.5) * PERIOD * 1e9)
        out.append(Sweep(HostNs(start), HostNs(end), points, packets, 0))
    return out


def resting(seconds: float, noise: float) -> NDArray[np.void]:
    """Return samples of a tilted IMU at rest, gyro noise in rad/s."""
    random = np.random.default_rng(0)
    samples = np.zeros(round(seconds * 250), IMU_SAMPLE)
    samples["stamp"] = EPOCH + np.arange(len(samples)) * 4_000_000
    samples["orientation_wxyz"][:, 0] = 1.0
    drawn = random.standard_normal((2, len(samples), 3))
    samples["angular_velocity"] = [0.01, -0.02, 0.015] + noise * drawn[0]
    samples["linear_acceleration"] = [0.06, -3.05, 9.43] + 2.0 * noise * drawn[1]
    return samples


@pytest.mark.skipif(not REAL_L2.exists(), reason="the recordings are not here")
@pytest.mark.parametrize(
    ("number", "packets", "noise"), [(1, 50, 0.2), (2, 50, 0.04), (2, 38, 0.04), (1, 38, 0.04)]
)
def test_a_real_unit_at_rest_stays_where_it_is(number: int, packets: int, noise: float) -> None:
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    odometry.imu(resting(6.0, noise))
    estimates = [one for sweep in captured(number, packets) for one in odometry.register(sweep)]
    assert len(estimates) >= 20
    assert way(estimates).max() < 0.005
    assert turned(estimates).max() < np.radians(0.1)


def creeping(path: Path, velocity: tuple[float, float, float], rate: float) -> str:
    """Write a motion: rest for a second, four of creeping, and rest again; return its path."""
    time = np.arange(0.0, 16.0, 1.0 / HZ)
    ramp = np.clip((time - 1.0) / 0.2, 0.0, 1.0) - np.clip((time - 5.0) / 0.2, 0.0, 1.0)
    lasted = np.cumsum(ramp) / HZ
    places = np.array([0.3, -0.2, 1.2]) + lasted[:, None] * velocity
    half = 0.5 * rate * lasted
    none = np.zeros_like(half)
    rows = np.column_stack((time, places, none, none, np.sin(half), np.cos(half)))
    np.savetxt(path, rows, fmt="%.9f")
    return str(path)


@pytest.mark.parametrize(
    ("velocity", "rate"),
    [((0.012, -0.009, 0.0), 0.0), ((0.0, 0.0, 0.01), 0.0), ((0.0, 0.0, 0.0), np.radians(1.0))],
)
def test_a_sensor_that_creeps_is_followed_and_its_rests_stay(
    tmp_path: Path, velocity: Any, rate: Any
) -> None:
    run = record("room", creeping(tmp_path / "creep.tum", velocity, rate), 1, RESTED + 10.0)
    estimates = drive(run)
    stamps = np.array([one.stamp for one in estimates])
    true, _ = truth(run, stamps)
    error = np.abs(way(estimates) - np.linalg.norm(true - true[0], axis=1))
    since = (stamps - EPOCH) * 1e-9 - RESTED
    before, after = since < 0.9, since > 8.5
    assert before.sum() > 8
    assert way(estimates)[before].max() < 1e-9
    assert error.max() < 0.025
    assert error[after].max() < 0.006
    assert np.abs(turned(estimates)[after] - 4.0 * abs(rate)).max() < np.radians(0.15)
    # at rest again, exactly
    assert np.ptp(way(estimates)[after]) < 1e-9


def test_a_shock_ends_rest_at_once() -> None:
    run = record("room", "walk", 1, RESTED + 3.0)
    estimates = drive(run)
    stamps = np.array([one.stamp for one in estimates])
    true, _ = truth(run, stamps)
    error = np.abs(way(estimates) - np.linalg.norm(true - true[0], axis=1))
    assert np.linalg.norm(true - true[0], axis=1).max() > 0.5
    assert error.max() < 0.02
