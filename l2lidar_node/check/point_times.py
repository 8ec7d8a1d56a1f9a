"""Checks the times of the clouds' points as a consumer takes them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from l2lidar_node.check.findings import Finding, Level, not_judged, ok
from l2lidar_node.check.observation import Cloud, Observation
from l2lidar_node.check.points import reading, usual_format
from l2lidar_node.check.requirements import Consumer, Order, TimeUnit, Use
from l2lidar_node.check.timing import Timing, timing

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
            f"no time of each point ({names}): {consumer.title} cannot deskew, which is right "
            "only where that is done already",
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
            f"all points of a cloud have one time in {constant} of {len(clouds)} clouds; "
            f"{consumer.title} {consumer.constant_times}",
            f"set point_layout: {layout}; of clouds deskewed already keep_time: false",
        )
        return
    if _only_spread(consumer):
        text = f"times differ; {consumer.title} takes any unit"
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
            f"{times.refused} of {total} clouds have times that are near neither 0 nor the stamp "
            f"(first {times.least[0] * 1e3:.3f} ms); {consumer.title} refuses them",
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
            f"{times.unit}; demanded are times from 0 at the stamp",
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
    fix = "publish points in order of time, as the driver does"
    if not_last:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "time-order",
            f"the last point is not the latest in {not_last} of {total} clouds; "
            f"{consumer.title} takes its time for the sweep's end",
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
            f"the points of a cloud span {longest:.4g} s as {consumer.title} takes them; it "
            f"relies on less than {consumer.max_sweep_s:g} s",
            "set sweep_cut: turn, and point_layout as demanded if the unit is wrong",
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
            f"{text}: half, as if times ran on the L2's own clock, which is half as fast",
            "set enable_l2_time_correction: true and timeScaleNum: 2",
        )
    elif not _FITS[0] <= ratio <= _FITS[1]:
        yield Finding(
            Level.ERROR if ratio > 1.0 else Level.WARN,
            _SUBJECT,
            "time-spread",
            f"{text}: they do not fit together",
            f"set point_layout: {consumer.inputs[0].layout}; is a filter cutting out azimuths?",
        )
    else:
        yield _check_length(spread) or ok(_SUBJECT, "time-spread", text)


def _check_length(spread: float) -> Finding | None:
    """Return what there is to say about sweeps of so many seconds."""
    if spread >= _TURN_S:
        return None
    return Finding(
        Level.WARN,
        _SUBJECT,
        "sweep-short",
        f"the points of a cloud span {spread:.4f} s, less than a turn of the L2's head "
        "(0.18 to 0.23 s), too thin for most odometry",
        "set sweep_cut: turn",
    )


def _only_spread(consumer: Consumer) -> bool:
    return all(time.unit is TimeUnit.SPREAD for item in consumer.inputs for time in item.times)


def _signed(seconds: float) -> str:
    text = f"{abs(seconds):.4g} s" if abs(seconds) >= 1 else f"{abs(seconds) * 1e3:.3f} ms"
    return f"{text} {'after' if seconds >= 0 else 'before'}"
