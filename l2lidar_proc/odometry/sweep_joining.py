"""Joins short sweeps into longer ones, and leaves out points that are too near or too far."""

from __future__ import annotations

import dataclasses

import numpy as np

from l2lidar_node.types import Sweep


def joined(sweeps: list[Sweep], least_ns: int) -> list[Sweep]:
    """Return sweeps that last at least so long; a last one that is shorter is left out.

    Parameters
    ----------
    sweeps : list of Sweep
        Ascending, with the same fields.
    least_ns : int
    """
    out: list[Sweep] = []
    some: list[Sweep] = []
    for sweep in sweeps:
        some.append(sweep)
        if sweep.end - some[0].start >= least_ns:
            out.append(some[0] if len(some) == 1 else _one(some))
            some = []
    return out


def cropped(sweep: Sweep, nearest: float, farthest: float) -> Sweep:
    """Return the sweep without points that are not finite or out of a range [m]."""
    points = sweep.points
    squared = sum(points[axis].astype(np.float64) ** 2 for axis in "xyz")
    inside = (squared >= nearest**2) & (squared <= farthest**2) & np.isfinite(points["time"])
    return sweep if inside.all() else dataclasses.replace(sweep, points=points[inside])


def _one(sweeps: list[Sweep]) -> Sweep:
    points = np.concatenate([sweep.points for sweep in sweeps])
    shift = [(sweep.start - sweeps[0].start) * 1e-9 for sweep in sweeps]
    counts = [len(sweep.points) for sweep in sweeps]
    points["time"] += np.repeat(shift, counts).astype(points["time"].dtype)
    return Sweep(
        sweeps[0].start,
        sweeps[-1].end,
        points,
        sum(sweep.packets for sweep in sweeps),
        sum(sweep.missing for sweep in sweeps),
    )
