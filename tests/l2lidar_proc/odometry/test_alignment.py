"""Scan alignment: a displaced start, and what a wrong range noise costs."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_node.types import F64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.odometry.alignment import align
from l2lidar_proc.odometry.config import SurfaceConfig
from l2lidar_proc.odometry.correspondences import Source
from l2lidar_proc.odometry.surfel_map import SurfelMap
from tests.l2lidar_proc.odometry.odometry_world import drive, errors, recording

ZERO = np.zeros(3)


def box(rng: np.random.Generator, count: int) -> F64:
    """Return points on the six walls of a room."""
    points = rng.uniform((-5.0, -4.0, -1.5), (5.0, 4.0, 1.5), (count, 3))
    side, axis = rng.integers(0, 2, count), rng.integers(0, 3, count)
    half = np.array([5.0, 4.0, 1.5])
    points[np.arange(count), axis] = np.where(side, half[axis], -half[axis])
    return points + 0.011 * rng.standard_normal((count, 3))


def test_a_displaced_start_comes_back() -> None:
    rng = np.random.default_rng(7)
    surfaces = SurfelMap((0.3, 0.6, 1.5))
    for _ in range(6):
        surfaces.add(box(rng, 6000))
    state = InertialState(
        HostNs(0), np.eye(3), ZERO, ZERO, ZERO, ZERO, np.array([0.0, 0.0, -9.80665])
    )
    sigma = np.full(eskf.ERRORS, 1e-3)
    sigma[eskf.POSITION], sigma[eskf.ROTATION] = 0.1, 0.03
    off = np.zeros(eskf.ERRORS)
    off[eskf.POSITION], off[eskf.ROTATION] = (0.06, -0.05, 0.04), (0.01, -0.01, 0.02)
    points = box(rng, 2000)
    source = Source(points, rng.uniform(-0.1, 0.1, 2000), np.linalg.norm(points, axis=1))
    found = align(state.boxplus(off), np.diag(sigma**2), source, surfaces, SurfaceConfig(), 100)
    assert found is not None
    left = found.state.boxminus(state)
    assert np.abs(left[eskf.POSITION]).max() < 0.004
    assert np.abs(left[eskf.ROTATION]).max() < 0.002


def test_a_wrong_range_noise_costs_little(monkeypatch: pytest.MonkeyPatch) -> None:
    run, slope = recording("yard", "walk"), tuning.RANGE_NOISE_SLOPE
    right = errors(run, drive(run)).max()
    for factor in (0.5, 2.0):
        monkeypatch.setattr(tuning, "RANGE_NOISE_SLOPE", factor * slope)
        assert errors(run, drive(run)).max() < right + 0.001
