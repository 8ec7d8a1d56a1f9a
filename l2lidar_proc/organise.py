"""Lays points out as an image: a row per packet, a column per slot, NaN where nothing is."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_proc.outliers import slot_time

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
    Points do not say which slot they are from; their times do. Packets are told apart by the dark
    half of the mirror's turn and follow each other at a fixed period, which is fitted; the
    earliest point within any period is taken for slot 0.
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
    dark = SLOTS * slot
    firsts = np.flatnonzero(np.diff(seconds, prepend=-np.inf) > 0.5 * dark)
    begins = seconds[firsts]
    period = _period(begins, 2.0 * dark)
    packet = np.round((begins - begins[0]) / period).astype(np.intp)
    late = begins - packet * period
    shift = np.round((late - late.min()) / slot).astype(np.intp)
    index = np.repeat(np.arange(len(firsts)), np.diff(firsts, append=len(seconds)))
    column = shift[index] + np.round((seconds - begins[index]) / slot).astype(np.intp)
    row = packet - packet[0]
    return row[index], np.clip(column, 0, SLOTS - 1)


def _period(begins: NDArray[np.float64], usual: float) -> float:
    """Return the time from packet to packet [s], which is near ``usual``."""
    steps = np.diff(begins)
    single = steps[(steps > 0.75 * usual) & (steps < 1.25 * usual)]
    if not len(single):
        return usual
    period = float(np.median(single))
    packet = np.round((begins - begins[0]) / period)
    return float(np.polyfit(packet, begins, 1)[0]) if packet[-1] > 0 else period
