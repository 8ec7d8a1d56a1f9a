"""Takes the numbers of a time field for what a consumer takes them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.check.measure import Times
from l2lidar_node.check.observation import Cloud
from l2lidar_node.check.requirements import TimeField, TimeUnit

F64 = NDArray[np.float64]

_NS_FROM_SPREAD: Final = 100.0  # RKO-LIO: a greater spread is in ns
_NEAR_S: Final = 1e-3
_END_NEAR_S: Final = 1e-2


class Timing(NamedTuple):
    """Times of clouds as a consumer takes them, [s] after the stamp; shape (N,) each.

    Attributes
    ----------
    first, last, least, greatest : ndarray, float64
    raw : list of Times
        As they stand in the clouds.
    refused : int
        Clouds that it can make no sense of.
    unit : str
    """

    first: F64
    last: F64
    least: F64
    greatest: F64
    raw: list[Times]
    refused: int
    unit: str

    @property
    def spread(self) -> F64:
        """From the earliest to the latest point [s]."""
        return self.greatest - self.least


def timing(clouds: Sequence[Cloud], field: TimeField, code: str) -> Timing:
    """Return the times of clouds.

    Parameters
    ----------
    clouds : sequence of Cloud
        All with the field.
    field : TimeField
    code : str
        Type that the field has in them.
    """
    raw = [cloud.contents.times[field.name] for cloud in clouds if cloud.contents is not None]
    table = np.array([times[:4] for times in raw], np.float64).reshape(-1, 4)
    stamps = np.array([cloud.stamp for cloud in clouds], np.int64) / 1e9
    seconds, refused, unit = _READERS[field.unit](table, stamps, code)
    first, last, least, greatest = seconds.T
    return Timing(first, last, least, greatest, raw, int(refused.sum()), unit)


_Read = tuple[F64, NDArray[np.bool_], str]


def _relative(scale: float, unit: str) -> Callable[[F64, F64, str], _Read]:
    def read(table: F64, stamps: F64, code: str) -> _Read:
        return table * scale, np.zeros(len(table), np.bool_), unit

    return read


def _epoch(table: F64, stamps: F64, code: str) -> _Read:
    return table - stamps[:, None], np.zeros(len(table), np.bool_), "s since the epoch"


def _epoch_auto(table: F64, stamps: F64, code: str) -> _Read:
    scale = np.where(table[:, 0] < 1e14, 1.0, 1e-9)
    unit = "s since the epoch" if (scale == 1.0).all() else "ns since the epoch"
    return table * scale[:, None] - stamps[:, None], np.zeros(len(table), np.bool_), unit


def _spread(table: F64, stamps: F64, code: str) -> _Read:
    """Only the spread matters; the unit is guessed."""
    scale = _scale_by_spread(table)
    seconds = (table - table[:, 2:3]) * scale[:, None]
    return seconds, np.zeros(len(table), np.bool_), "any unit"


def _rko(table: F64, stamps: F64, code: str) -> _Read:
    """Absolute if an end is near the stamp, relative if an end is near 0, else nothing."""
    scale = _scale_by_spread(table)
    seconds = table * scale[:, None]
    absolute = seconds - stamps[:, None]
    is_absolute = _is_near(absolute)
    is_relative = ~is_absolute & _is_near(seconds)
    unit = "s" if (scale == 1.0).all() else "ns"
    origin = "since the epoch" if is_absolute.any() else "after the stamp"
    read = np.where(is_absolute[:, None], absolute, seconds)
    return read, ~(is_absolute | is_relative), f"{unit} {origin}"


def _is_near(seconds: F64) -> NDArray[np.bool_]:
    return np.asarray((np.abs(seconds[:, 2]) < _NEAR_S) | (np.abs(seconds[:, 3]) < _END_NEAR_S))


def _glim(table: F64, stamps: F64, code: str) -> _Read:
    """Integers are ns, numbers that stay below 1 s relative, others absolute."""
    seconds = table * (1e-9 if code == "u4" else 1.0)
    is_absolute = seconds[:, 3] >= 1.0
    scale = np.where(seconds[:, 3] > 1e16, 1e-9, 1.0)
    absolute = seconds * scale[:, None] - stamps[:, None]
    read = np.where(is_absolute[:, None], absolute, seconds)
    unit = "s since the epoch" if is_absolute.any() else "s after the stamp"
    return read, np.zeros(len(table), np.bool_), unit


def _scale_by_spread(table: F64) -> F64:
    return np.where(table[:, 3] - table[:, 2] > _NS_FROM_SPREAD, 1e-9, 1.0)


_READERS: Final[dict[TimeUnit, Callable[[F64, F64, str], _Read]]] = {
    TimeUnit.S: _relative(1.0, TimeUnit.S.value),
    TimeUnit.NS: _relative(1e-9, TimeUnit.NS.value),
    TimeUnit.EPOCH_S: _epoch,
    TimeUnit.EPOCH_AUTO: _epoch_auto,
    TimeUnit.SPREAD: _spread,
    TimeUnit.RKO: _rko,
    TimeUnit.GLIM: _glim,
}
