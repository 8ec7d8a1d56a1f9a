"""Lays points out as an image: a row per packet, a column per slot, NaN where nothing is."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_proc.deskew.filters import slot_time

SLOTS: Final = 300  # of a packet


def organise(points: NDArray[np.void], times: NDArray[np.float32]) -> NDArray[np.void]:
    """Return points in rows and columns.

    Parameters
    ----------
    points : ndarray, shape (N,)
        Structured, in order of time.
    times : ndarray, shape (N,), float32
        Of the points [s].

    Returns
    -------
    ndarray, shape (P, 300)
        Same dtype. P counts packets from the first to the last that has a point, lost ones
        included. Floating-point fields of empty places are NaN, others 0.

    Notes
    -----
    Points do not say which slot they are from; their times do. A packet is one half of the
    mirror's turn, the other half is dark, and slots are equally long: modulo the period, times
    fill one half only, and within a packet and from packet to packet they differ by whole slots.
    The earliest point within any period is taken for slot 0.
    """
    empty = np.zeros(1, dtype=points.dtype)
    for name in points.dtype.names or ():
        if points.dtype[name].kind == "f":
            empty[name] = np.nan
    if not len(points):
        return np.repeat(empty, 0).reshape(0, SLOTS)
    rows, columns = places(times)
    image = np.repeat(empty, (int(rows[-1]) + 1) * SLOTS).reshape(-1, SLOTS)
    image[rows, columns] = points
    return image


def places(times: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the row and the column of each point by its time [s], shape (N,) each; N >= 1."""
    seconds = times.astype(np.float64)
    slot = slot_time(times)
    period = 2 * SLOTS * slot
    turn = np.floor((seconds - _dark(seconds, period)) / period).astype(np.intp)
    firsts = np.flatnonzero(np.diff(turn, prepend=turn[0] - 1))
    begins, turns = seconds[firsts], turn[firsts] - turn[0]
    late = begins - turns * _period(begins, turns, slot)
    shift = np.round((late - late.min()) / slot).astype(np.intp)
    index = np.repeat(np.arange(len(firsts)), np.diff(firsts, append=len(seconds)))
    column = shift[index] + np.round((seconds - begins[index]) / slot).astype(np.intp)
    return turns[index], np.clip(column, 0, SLOTS - 1)


def _dark(seconds: NDArray[np.float64], period: float) -> float:
    """Return an instant in the middle of the mirror's dark half [s], which no point is in."""
    phase = np.sort(seconds % period)
    gaps = np.diff(phase, append=phase[0] + period)
    widest = int(np.argmax(gaps))
    return float(phase[widest] + 0.5 * gaps[widest])


def _period(begins: NDArray[np.float64], turns: NDArray[np.intp], slot: float) -> float:
    """Return the time from packet to packet [s] from the packets' first points.

    Those are from different slots, so the steps between them differ by whole slots: the usual
    whole number is the median, and what is left over is averaged.
    """
    usual = 2 * SLOTS * slot
    if len(begins) < 2:
        return usual
    whole = np.diff(turns)
    steps = np.diff(begins)[whole == 1] if (whole == 1).any() else np.diff(begins) / whole
    slots = (steps - usual) / slot
    middle = float(np.median(slots))
    left = slots - middle - np.round(slots - middle)
    return usual + slot * (middle + float(left.mean()))
