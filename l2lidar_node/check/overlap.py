"""Checks that IMU samples cover the clouds, on the same clock."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from l2lidar_node.check.findings import Finding, Level, ok
from l2lidar_node.check.stamps import Track

_SUBJECT: Final = "imu"
_ENDS: Final = 2  # clouds at either end of a recording that may lack samples
_APART_S: Final = 0.05


def check(clouds: Track, imu: Track) -> Iterator[Finding]:
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
            f"clouds and IMU samples have no instant in common, clouds are {offset:+.6g} s from "
            "the samples: two clocks",
            "stamp both by the driver, or the same UseSystemTimeTS for both",
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
            "look for gaps of the IMU topic; set qos_reliability: reliable",
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
            f"{imu.latency_s * 1e3:.4g} ms after its stamp: an offset of about {apart:+.3g} s",
            "stamp both by the driver",
        )
    else:
        yield ok(_SUBJECT, "offset", f"clouds and samples come within {abs(apart) * 1e3:.3g} ms")
