"""Sweeps that a sensor sees as it passes posts or walls, and motions of it that may be wrong."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from l2lidar_node import rotations
from l2lidar_node.types import F64, IMU_SAMPLE, POINT, HostNs, Sweep
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.motion.sweep_motion import SweepMotion, predict_sweep
from l2lidar_proc.odometry.initialization.start_velocity import Passed

EPOCH = 1_700_000_000_000_000_000  # [ns]
GRAVITY = np.array([0.0, 0.0, -9.81])
SWEEP_NS = 220_000_000
SWEEPS = 10
X, Y = np.eye(3)[:1], np.eye(3)[1:2]
SPEED = np.array([0.9, 0.2, 0.0])  # [m/s]


def posts(rng: np.random.Generator, _: float) -> F64:
    """Return where posts stand all over the plan, (N, 2)."""
    plan = np.random.default_rng(7).uniform(-12.0, 12.0, (16, 2))
    return plan[np.linalg.norm(plan, axis=1) > 3.0]


def bare_walls(rng: np.random.Generator, along: float) -> F64:
    """Return where upright scan lines meet two bare walls beside a place along them, (N, 2)."""
    lines = along + rng.uniform(-6.0, 6.0, (30, 1))
    return np.vstack((np.insert(lines, 1, -1.2, axis=1), np.insert(lines, 1, 1.2, axis=1)))


def ground() -> F64:
    along, across = np.meshgrid(np.arange(-10.0, 10.0, 0.25), np.arange(-10.0, 10.0, 0.25))
    return np.column_stack((along.ravel(), across.ravel(), np.full(along.size, -1.0)))


def motion_at(velocity: F64, covariance: F64, yaw_rate: float = 0.0) -> SweepMotion:
    """Return the motion of a level sensor at constant speed, over all sweeps; it ends at zero.

    The gyro measures no turn; a bias of it makes the yaw rate [rad/s].
    """
    end = EPOCH + SWEEPS * SWEEP_NS
    samples = np.zeros(SWEEPS * 55 + 3, IMU_SAMPLE)
    samples["stamp"] = EPOCH - 4_000_000 + 4_000_000 * np.arange(len(samples))
    samples["linear_acceleration"] = -GRAVITY
    zero = np.zeros(3)
    heading = rotations.matrices(rotations.exp(np.array([0.0, 0.0, -2.2 * yaw_rate])))
    bias = np.array([0.0, 0.0, -yaw_rate])
    state = InertialState(HostNs(EPOCH), heading, -2.2 * velocity, velocity, bias, zero, GRAVITY)
    found = predict_sweep(
        state,
        covariance,
        samples,
        (HostNs(EPOCH), HostNs(end)),
        HostNs(end),
        noise=eskf.Noise(0.0, 0.0, 0.0, 0.0),
        gap_ns=20_000_000,
        steady_rate=zero,
        use_forces=True,
    )
    return dataclasses.replace(found, covariance=covariance)


def seen_from(
    rng: np.random.Generator, columns: Callable[[np.random.Generator, float], F64], speed: F64
) -> list[Sweep]:
    """Return what a sensor that passes the origin at the end sees, in its own axes.

    Each sweep has a line of points up each column, and the ground.
    """
    found = []
    heights = np.arange(-1.0, 2.0, 0.15)
    for number in range(SWEEPS):
        start = EPOCH + number * SWEEP_NS
        left = 1e-9 * (EPOCH + SWEEPS * SWEEP_NS - start)
        plan = columns(rng, -left * speed[0])
        upright_ones = np.column_stack((
            np.repeat(plan, len(heights), axis=0), np.tile(heights, len(plan))
        ))  # fmt: skip
        turned = np.repeat(rng.uniform(0.0, 0.21, len(plan)), len(heights))
        floor = ground()[rng.integers(0, len(ground()), 400)]
        times = np.concatenate((turned + rng.uniform(0.0, 0.005, len(turned)),
                                rng.uniform(0.0, 0.22, 400)))  # fmt: skip
        some = np.vstack((upright_ones, floor)) + (left - times)[:, None] * speed
        some += 0.01 * rng.standard_normal(some.shape)
        order = np.argsort(times)
        points = np.zeros(len(order), POINT)
        points["x"], points["y"], points["z"] = some[order].T
        points["time"] = times[order]
        found.append(Sweep(HostNs(start), HostNs(start + SWEEP_NS), points, 0, 0))
    return found


def passed_at(sweeps: list[Sweep], velocity: F64) -> list[Passed]:
    """Return sweeps with the places that a velocity gives them, zero at the end."""
    end = EPOCH + SWEEPS * SWEEP_NS
    middles = [HostNs((one.start + one.end) // 2) for one in sweeps]
    return [
        Passed(one, middle, -1e-9 * (end - middle) * velocity)
        for one, middle in zip(sweeps, middles, strict=True)
    ]
