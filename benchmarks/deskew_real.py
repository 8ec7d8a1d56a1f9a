"""Deskews real scans of a fast-turning sensor that come with a deskewed reference.

Three scans of the Newer College data, kept outside this repository. They carry no IMU samples, so
the motion is fitted: rates and forces of an IMU, and the first velocity, that bring a few hundred
points to their reference; all points are judged.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from scipy.optimize import least_squares

from l2lidar_node.types import F64, IMU_SAMPLE, POINT, HostNs
from l2lidar_proc.deskew.deskew import deskew
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.motion.preintegration import integrate, segment
from l2lidar_proc.motion.sweep_trajectory import SweepTrajectory

FOLDER: Final = Path(__file__).resolve().parents[2] / "shared" / "data" / "newer_college"
BOUNDS_MM: Final = (31.0, 6.0, 20.0)  # what a fit with one constant rate and velocity leaves

_START: Final = HostNs(1_600_000_000_000_000_000)
_SPAN_S: Final = 0.1
_RATES: Final = 6
_FORCES: Final = 2


def newer_college(scans: tuple[int, ...] = (0, 1, 2)) -> list[tuple[str, float, float, float]]:
    """Return name, median error before and after [mm] and bound of each scan there is."""
    found = []
    for number in scans:
        if not (FOLDER / f"raw_0{number}.bin").exists():
            continue
        raw, times, expected = _scan(number)
        path = _fitted(raw, times, expected)
        points = np.zeros(len(raw), dtype=POINT)
        points["x"], points["y"], points["z"] = raw.T
        points["time"] = times
        order = np.argsort(times, kind="stable")
        moved = deskew(points[order], _START, path, _START)
        cloud = np.stack([moved[axis] for axis in "xyz"], axis=-1)
        before = 1e3 * float(np.median(np.linalg.norm(raw - expected, axis=1)))
        after = 1e3 * float(np.median(np.linalg.norm(cloud - expected[order], axis=1)))
        found.append((f"Newer College scan {number}", before, after, BOUNDS_MM[number]))
    return found


def _scan(number: int) -> tuple[F64, F64, F64]:
    """Return raw points (N, 3) in the frame of the reference, times [s] (N,), reference (N, 3)."""
    raw = np.fromfile(FOLDER / f"raw_0{number}.bin", np.float32).reshape(-1, 3)
    times = np.fromfile(FOLDER / f"times_0{number}.bin", np.float32)
    expected = np.fromfile(FOLDER / f"deskewed_0{number}.bin", np.float32).reshape(-1, 3)
    usable = np.isfinite(raw).all(axis=1) & np.isfinite(expected).all(axis=1)
    turned = raw[usable].astype(np.float64) * (-1.0, -1.0, 1.0)
    return turned, times[usable].astype(np.float64), expected[usable].astype(np.float64)


def _fitted(raw: F64, times: F64, expected: F64) -> SweepTrajectory:
    chosen = np.random.default_rng(0).choice(len(raw), 500, replace=False)
    stamps = _START + np.round(times[chosen] * 1e9).astype(np.int64)

    def residuals(motion: F64) -> F64:
        q, p = _path(motion).poses(stamps)
        w, u = q[:, :1], q[:, 1:]
        t = 2.0 * np.cross(u, raw[chosen])
        moved = raw[chosen] + w * t + np.cross(u, t) + p
        return np.asarray((moved - expected[chosen]).ravel())

    unknowns = np.zeros(3 * (_RATES + _FORCES + 1))
    fit = least_squares(residuals, unknowns, loss="soft_l1", f_scale=0.02, max_nfev=40)
    return _path(fit.x)


def _path(motion: F64) -> SweepTrajectory:
    samples = np.zeros(_RATES, dtype=IMU_SAMPLE)
    at = np.linspace(0.0, 1.0, _RATES)
    samples["stamp"] = _START + np.round(at * _SPAN_S * 1e9).astype(np.int64)
    rates, forces, (velocity,) = np.split(motion.reshape(-1, 3), (_RATES, _RATES + _FORCES))
    samples["angular_velocity"] = rates
    samples["linear_acceleration"] = forces[0] + at[:, None] * (forces[1] - forces[0])
    nothing = np.zeros(3)
    state = InertialState(_START, np.eye(3), nothing, velocity, nothing, nothing, nothing)
    end = HostNs(_START + round(_SPAN_S * 1e9))
    imu = segment(samples, [_START, end], 10**9, nothing)
    preintegrated = integrate(
        imu, 0, gyro_bias=nothing, accel_bias=nothing, rest_force=state.rest_force
    )
    return SweepTrajectory.of(preintegrated, state, nothing)
