"""Runs of the odometry through hard scenarios."""

from __future__ import annotations

from benchmarks import bench_odometry_hard
from benchmarks.hard_recordings import Recording
from benchmarks.hard_scores import Track, score


def tracked(some: Recording) -> Track:
    """Return what the odometry says of a recording."""
    track = bench_odometry_hard.track_of(bench_odometry_hard.OURS, some)
    assert track is not None
    return track


def end_of(some: Recording) -> float:
    """Return how far off the odometry ends [m]."""
    return score(some, tracked(some))["end_m"]
