"""Checks of the times of points, as the consumer reads them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.check.observation import Cloud, Observation, Times
from l2lidar_node.check.points import reading, usual_format
from l2lidar_node.check.requirements import (
    Consumer,
    Finding,
    Order,
    TimeField,
    TimeUnit,
    Use,
    not_judged,
    ok,
)
from l2lidar_node.types import F64, Level

_NS_FROM_SPREAD: Final = 100.0  # RKO-LIO: a greater spread is in ns
_NEAR_S: Final = 1e-3
_END_NEAR_S: Final = 1e-2


class Timing(NamedTuple):
    """Times of clouds as a consumer reads them, [s] after the stamp; shape (N,) each.

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


_SUBJECT = "times"
_FIRST_S: Final = 1e-3
_TURN_S: Final = 0.15  # the head turns in 0.18 to 0.23 s
_HALF: Final = (0.45, 0.55)
_FITS: Final = (0.75, 1.15)
_RESOLUTION_S: Final = 1e-6  # doubles of seconds since the epoch are a quarter of that


def timed(seen: Observation, consumer: Consumer) -> tuple[list[Cloud], Timing] | None:
    """Return the clouds that have points with times, and those times; None if there are none."""
    form = usual_format(seen)
    way = reading(form, consumer)
    if way.time is None:
        return None
    clouds = [
        cloud
        for cloud in seen.clouds
        if cloud.format == form and cloud.contents and way.time.name in cloud.contents.times
    ]
    return (clouds, timing(clouds, way.time, way.code)) if clouds else None


def check(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    """Yield findings on the times of points."""
    if consumer.time is Use.IGNORED:
        return
    layout = consumer.inputs[0].layout
    found = timed(seen, consumer)
    if found is None:
        names = ", ".join(dict.fromkeys(t.name for item in consumer.inputs for t in item.times))
        yield Finding(
            consumer.time.level,
            _SUBJECT,
            "time-missing",
            f"no time per point ({names}): {consumer.title} cannot deskew, which is "
            "right only for deskewed clouds",
            f"set point_layout: {layout}, or keep_time: true (deskew_node)",
        )
        return
    clouds, times = found
    invalid = sum(item.invalid for item in times.raw)
    if invalid:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "time-invalid",
            f"{invalid} points have a time that is NaN or infinite",
            f"set point_layout: {layout}",
        )
    constant = sum(
        item.greatest == item.least and cloud.width * cloud.height > 1
        for cloud, item in zip(clouds, times.raw, strict=True)
    )
    if constant:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "time-constant",
            f"all points of a cloud have the same time in {constant} of {len(clouds)} clouds; "
            f"{consumer.title} {consumer.constant_times}",
            f"set point_layout: {layout}, or keep_time: false for deskewed clouds",
        )
        return
    if _only_spread(consumer):
        text = f"times differ; {consumer.title} accepts any unit"
        short = _check_length(float(np.median(times.spread)))
        yield short or ok(_SUBJECT, "time-spread", text)
        return
    yield from _check_origin(times, consumer)
    yield from _check_order(times, consumer)
    yield from _check_spread(clouds, times, consumer)


def _check_origin(times: Timing, consumer: Consumer) -> Iterator[Finding]:
    total = len(times.raw)
    if times.refused:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "time-origin",
            f"{times.refused} of {total} clouds have times that are neither near 0 nor near the "
            f"stamp (first {times.least[0] * 1e3:.3f} ms); {consumer.title} refuses them",
            "stamp the cloud at its first point, as the filters of deskew_node do",
        )
        return
    first = times.least
    late = int((np.abs(first) >= _FIRST_S).sum())
    if late:
        worst = float(first[np.argmax(np.abs(first))])
        yield Finding(
            consumer.late_first if abs(worst) < 10 else Level.ERROR,
            _SUBJECT,
            "time-origin",
            f"the first point is {_signed(worst)} the stamp in {late} of {total} clouds, read as "
            f"{times.unit}; times from 0 at the stamp are required",
            "stamp the cloud at its first point, as the filters of deskew_node do",
        )
    else:
        yield ok(_SUBJECT, "time-origin", f"read as {times.unit}, the first point at the stamp")


def _check_order(times: Timing, consumer: Consumer) -> Iterator[Finding]:
    if consumer.order is Order.ANY:
        return
    descents = sum(item.descents > 0 for item in times.raw)
    not_last = int((times.last < times.greatest - _RESOLUTION_S).sum())
    total = len(times.raw)
    fix = "publish the points in time order, as the driver does"
    if not_last:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "time-order",
            f"the last point is not the latest in {not_last} of {total} clouds; "
            f"{consumer.title} uses its time as the sweep's end",
            fix,
        )
    elif descents:
        yield Finding(
            Level.ERROR if consumer.order is Order.ASCENDING else Level.WARN,
            _SUBJECT,
            "time-order",
            f"times do not ascend in {descents} of {total} clouds; {consumer.title} "
            f"{'relies on it' if consumer.order is Order.ASCENDING else 'relies on the last one'}",
            fix,
        )
    else:
        yield ok(_SUBJECT, "time-order", "times ascend, the last point is the latest")


def _check_spread(clouds: Sequence[Cloud], times: Timing, consumer: Consumer) -> Iterator[Finding]:
    spread = float(np.median(times.spread))
    longest = float(times.spread.max())
    if longest >= consumer.max_sweep_s:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "sweep-long",
            f"the points of a cloud span {longest:.4g} s as {consumer.title} reads them; "
            f"it needs less than {consumer.max_sweep_s:g} s",
            "set sweep_cut: turn, and point_layout as required if the unit is wrong",
        )
        return
    stamps = np.array([cloud.stamp for cloud in clouds], np.int64)
    steps = np.diff(stamps) / 1e9
    steps = steps[steps > 0]
    if not len(steps):
        yield not_judged(_SUBJECT, "time-spread", f"one cloud of {spread:.4f} s")
        return
    period = float(np.median(steps))
    ratio = spread / period
    text = f"the points of a cloud span {spread:.4f} s, clouds are {period:.4f} s apart"
    if _HALF[0] <= ratio <= _HALF[1]:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "time-half",
            f"{text}: half, as if the times were those of the L2's own clock, which runs at half "
            f"speed",
            "set enable_l2_time_correction: true and timeScaleNum: 2",
        )
    elif not _FITS[0] <= ratio <= _FITS[1]:
        yield Finding(
            Level.ERROR if ratio > 1.0 else Level.WARN,
            _SUBJECT,
            "time-spread",
            f"{text}: these do not match",
            f"set point_layout: {consumer.inputs[0].layout}; check for a filter that removes "
            f"azimuths",
        )
    else:
        yield _check_length(spread) or ok(_SUBJECT, "time-spread", text)


def _check_length(spread: float) -> Finding | None:
    """Return the finding about sweeps of this duration [s]."""
    if spread >= _TURN_S:
        return None
    return Finding(
        Level.WARN,
        _SUBJECT,
        "sweep-short",
        f"the points of a cloud span {spread:.4f} s, less than a turn of the L2's head "
        "(0.18 to 0.23 s), too few points for most odometry",
        "set sweep_cut: turn",
    )


def _only_spread(consumer: Consumer) -> bool:
    return all(time.unit is TimeUnit.SPREAD for item in consumer.inputs for time in item.times)


def _signed(seconds: float) -> str:
    text = f"{abs(seconds):.4g} s" if abs(seconds) >= 1 else f"{abs(seconds) * 1e3:.3f} ms"
    return f"{text} {'after' if seconds >= 0 else 'before'}"
