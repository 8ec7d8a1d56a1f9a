"""Checks of the stamps of both topics: order, rate, gaps, clock speed, overlap."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from l2lidar_node.check.observation import Observation
from l2lidar_node.check.requirements import Consumer, Finding, Use, not_judged, ok
from l2lidar_node.types import F64, I64, Level

_RATIO_MIN_S: Final = 1.0
_RATIO_TOLERANCE: Final = 0.05
_HALF: Final = (0.45, 0.55)
_MUCH_LOST: Final = 0.2
_OLD_S: Final = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The stamps of one topic.

    Attributes
    ----------
    subject : str
        cloud or imu.
    stamps, arrivals : ndarray, shape (N,), int64
        [ns], in the order they came.
    lengths_s : ndarray, shape (N,), float64
        From the stamp to the end of what was measured [s], NaN where that is not known.
    jitter : float
        Share of the period that intervals may deviate from it.
    """

    subject: str
    stamps: I64
    arrivals: I64
    lengths_s: F64
    jitter: float

    @property
    def has_arrivals(self) -> bool:
        """Whether arrivals say anything: some recordings are written with the stamps instead."""
        return bool((self.arrivals != self.stamps).any())

    @property
    def latency_s(self) -> float:
        """Usual time from the end of a measurement to its arrival [s]; or from its stamp.

        Exceeded by nine of ten messages, so that single ones that were held up do not count.
        """
        lengths = self.lengths_s if self.has_lengths else np.zeros(len(self.stamps))
        return float(np.nanpercentile((self.arrivals - self.stamps) / 1e9 - lengths, 10))

    @property
    def has_lengths(self) -> bool:
        """Whether any length is known."""
        return bool(np.isfinite(self.lengths_s).any())


def cloud_track(seen: Observation, lengths_s: F64) -> Track:
    """Return the stamps of the clouds."""
    stamps = np.array([cloud.stamp for cloud in seen.clouds], np.int64)
    arrivals = np.array([cloud.arrival for cloud in seen.clouds], np.int64)
    return Track("cloud", stamps, arrivals, lengths_s, 0.2)


def imu_track(seen: Observation) -> Track:
    """Return the stamps of the IMU samples."""
    imu = seen.imu
    # Units send pairs of samples 2.6 to 4.7 ms apart.
    return Track("imu", imu["stamp"], imu["arrival"], np.zeros(len(imu)), 0.6)


def check(track: Track, consumer: Consumer) -> Iterator[Finding]:
    """Yield findings on the stamps of a topic."""
    if len(track.stamps) < 3:
        yield Finding(
            Level.WARN,
            track.subject,
            "few",
            f"{len(track.stamps)} messages are too few to judge the rate",
            "observe longer with --seconds",
        )
        return
    intervals = np.diff(track.stamps) / 1e9
    yield from _check_order(track, intervals, consumer)
    forward = intervals[intervals > 0]
    if not len(forward):
        return
    period = float(np.median(forward))
    yield from _check_rate(track, period, forward, consumer)
    yield from _check_gaps(track, period, forward)
    yield from _check_pace(track)


def _check_order(track: Track, intervals: F64, consumer: Consumer) -> Iterator[Finding]:
    backward, equal = int((intervals < 0).sum()), int((intervals == 0).sum())
    level = Level.WARN if consumer.time is Use.IGNORED else Level.ERROR
    if backward:
        text = f"{backward} stamps are earlier than the one before, by up to "
        yield Finding(
            level,
            track.subject,
            "stamps-backward",
            f"{text}{-intervals.min():.4g} s; consumers reorder or clear their buffers",
            "check for a second publisher or a recording that restarted",
        )
    if equal:
        yield Finding(
            level,
            track.subject,
            "stamps-equal",
            f"{equal} stamps equal the one before; integration divides by the difference",
            "check for a second publisher",
        )
    if not backward and not equal:
        yield ok(track.subject, "stamps", "stamps ascend")


def _check_rate(
    track: Track, period: float, forward: F64, consumer: Consumer
) -> Iterator[Finding]:
    rate = 1.0 / period
    # But one: the first sweep of a recording may be a part of one.
    near = np.sort(np.abs(forward[forward < 1.5 * period] - period))[:-1]
    deviation = float(np.percentile(near, 95)) if len(near) else 0.0
    text = f"{rate:.4g} Hz by stamp, intervals within {deviation * 1e3:.3g} ms for 95 %"
    if track.subject == "imu" and rate < consumer.imu_rate_hz:
        yield Finding(
            consumer.imu.level,
            "imu",
            "rate",
            f"{text}; {consumer.title} needs {consumer.imu_rate_hz:g} Hz or more",
            "the L2 sends 250 Hz; if samples are lost, set qos_reliability: reliable",
        )
    elif deviation > track.jitter * period:
        yield Finding(
            Level.WARN,
            track.subject,
            "jitter",
            f"{text}: that is {deviation / period:.0%} of the period, typical of arrival times "
            f"used as stamps",
            "set UseSystemTimeTS: false",
        )
    else:
        yield ok(track.subject, "rate", text)


def _check_gaps(track: Track, period: float, forward: F64) -> Iterator[Finding]:
    missing = np.round(forward / period) - 1
    wide = missing >= (1 if track.subject == "cloud" else 3)
    lost = int(missing[wide].sum())
    if not lost:
        yield ok(track.subject, "gaps", "no gaps")
        return
    share = lost / (len(forward) + lost)
    yield Finding(
        Level.ERROR if share > _MUCH_LOST else Level.WARN,
        track.subject,
        "gaps",
        f"{int(wide.sum())} gaps of up to {forward.max():.4g} s, {lost} messages missing "
        f"({share:.1%})",
        "set qos_reliability: reliable, or check the driver's diagnostics for lost packets",
    )


def _pace(track: Track) -> float:
    """Return how fast stamps advance [s/s], by the medians of the first and the last third.

    So single messages that were held up do not count.
    """
    third = -(-len(track.stamps) // 3)
    stamps = np.median(track.stamps[-third:]) - np.median(track.stamps[:third])
    arrivals = np.median(track.arrivals[-third:]) - np.median(track.arrivals[:third])
    return float(stamps / arrivals) if arrivals else float("nan")


def _check_pace(track: Track) -> Iterator[Finding]:
    """Check how fast stamps advance and how old they are when they come."""
    passed = (track.arrivals[-1] - track.arrivals[0]) / 1e9
    if not track.has_arrivals or passed < _RATIO_MIN_S:
        why = "no arrival times" if not track.has_arrivals else f"only {passed:.2g} s"
        yield not_judged(track.subject, "clock", f"rate of the stamps: {why}")
        return
    ratio = _pace(track)
    latency = track.latency_s
    text = f"stamps advance {ratio:.4g} s per s"
    if _HALF[0] <= ratio <= _HALF[1]:
        yield Finding(
            Level.ERROR,
            track.subject,
            "clock-half",
            f"{text}: this is the L2's own clock, which runs at half speed",
            "set enable_l2_time_correction: true and timeScaleNum: 2",
        )
    elif abs(ratio - 1.0) > _RATIO_TOLERANCE:
        yield Finding(
            Level.WARN,
            track.subject,
            "clock-pace",
            f"{text}: replayed at another speed, or the clock steps",
            "record at speed 1; check the clock in the driver's diagnostics",
        )
    elif latency < -1e-3:
        yield Finding(
            Level.WARN,
            track.subject,
            "clock-ahead",
            f"messages come {-latency:.4g} s before their stamp: it marks the end of the "
            "measurement, or the clock is ahead",
            "stamp clouds at their first point, as the driver does",
        )
    elif latency > _OLD_S:
        yield Finding(
            Level.WARN,
            track.subject,
            "clock-behind",
            f"messages come {latency:.4g} s after their stamp",
            "set use_sim_time: true in the consumer for a replay; else enable_l2_host_sync: true",
        )
    else:
        yield ok(track.subject, "clock", f"{text}, messages come {latency * 1e3:.3g} ms later")


_SUBJECT: Final = "imu"
_ENDS: Final = 2  # clouds at either end of a recording that may lack samples
_APART_S: Final = 0.05


def check_overlap(clouds: Track, imu: Track) -> Iterator[Finding]:
    """Yield findings on how the two topics fit together; neither is empty."""
    starts = clouds.stamps
    ends = starts + np.round(np.nan_to_num(clouds.lengths_s) * 1e9).astype(np.int64)
    samples = np.sort(imu.stamps)
    offset = float(np.median(starts) - np.median(samples)) / 1e9
    if samples[-1] < starts.min() or samples[0] > ends.max():
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "clocks-apart",
            f"clouds and IMU samples do not overlap in time, clouds are {offset:+.6g} s away "
            "from the samples: two clocks",
            "let the driver stamp both, with the same UseSystemTimeTS",
        )
        return
    covered = (starts >= samples[0]) & (ends <= samples[-1])
    bare = int((~covered).sum())
    inner = int((~covered[_ENDS:-_ENDS]).sum())
    if inner:
        yield Finding(
            Level.WARN if inner < 0.2 * len(starts) else Level.ERROR,
            _SUBJECT,
            "uncovered",
            f"{bare} of {len(starts)} clouds are not covered by IMU samples from their first to "
            "their last point",
            "check for gaps in the IMU topic; set qos_reliability: reliable",
        )
    else:
        yield ok(
            _SUBJECT, "covered", f"samples cover {len(starts) - bare} of {len(starts)} clouds"
        )
    if not (clouds.has_lengths and clouds.has_arrivals and imu.has_arrivals):
        return
    apart = clouds.latency_s - imu.latency_s
    if abs(apart) > _APART_S:
        yield Finding(
            Level.WARN if abs(apart) < 0.5 else Level.ERROR,
            _SUBJECT,
            "offset",
            f"a cloud comes {clouds.latency_s * 1e3:.4g} ms after its last point, a sample "
            f"{imu.latency_s * 1e3:.4g} ms after its stamp: their stamps differ by about "
            f"{apart:+.3g} s",
            "let the driver stamp both",
        )
    else:
        yield ok(_SUBJECT, "offset", f"clouds and samples come within {abs(apart) * 1e3:.3g} ms")
