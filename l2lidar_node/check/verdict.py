"""Composes all checks of one consumer."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.check import (
    attitude,
    frames,
    imu,
    leveled,
    overlap,
    point_times,
    point_values,
    points,
    stamps,
)
from l2lidar_node.check.findings import Finding, Level
from l2lidar_node.check.observation import Observation
from l2lidar_node.check.requirements import Consumer, Use

_OVERLONG: Final = 1.25
_LONGEST_S: Final = 20.0


def judge(seen: Observation, consumer: Consumer) -> list[Finding]:
    """Return what there is to say about an observation for a consumer, in a fixed order."""
    with np.errstate(all="ignore"):  # any number may stand in a message
        return list(_judge(seen, consumer))


def _judge(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    clouds = None
    if seen.clouds:
        yield from points.check(seen, consumer)
        yield from point_values.check(seen, consumer)
        yield from point_times.check(seen, consumer)
        yield from leveled.check(seen, consumer)
        clouds = stamps.cloud_track(seen, _lengths(seen, consumer))
        yield from stamps.check(clouds, consumer)
    else:
        text = "no clouds came"
        fix = "is the driver running, the topic's name right, and does its QoS let them through?"
        yield Finding(Level.ERROR, "cloud", "cloud-missing", text, fix)
    if not len(seen.imu):
        yield from imu.missing(consumer)
    elif consumer.imu is not Use.IGNORED:
        samples = stamps.imu_track(seen)
        yield from stamps.check(samples, consumer)
        yield from imu.check(seen, consumer)
        yield from attitude.check(seen, consumer)
        if clouds is not None:
            yield from overlap.check(clouds, samples)
    if seen.clouds:
        yield from frames.check_frames(seen, consumer)
        yield from frames.check_qos(seen, consumer)


def _lengths(seen: Observation, consumer: Consumer) -> NDArray[np.float64]:
    """Return the time from each cloud's stamp to its last point [s], NaN where it is not known.

    Times that are wrong, and said to be, say nothing about it.
    """
    lengths = np.full(len(seen.clouds), np.nan)
    found = point_times.timed(seen, consumer)
    if found is None:
        return lengths
    clouds, timing = found
    steps = np.diff(np.array([cloud.stamp for cloud in seen.clouds], np.int64)) / 1e9
    steps = steps[steps > 0]
    longest = _OVERLONG * float(np.median(steps)) if len(steps) else _LONGEST_S
    index = {id(cloud): at for at, cloud in enumerate(seen.clouds)}
    places = [index[id(cloud)] for cloud in clouds]
    is_plausible = (timing.greatest > 0.0) & (timing.greatest <= longest)
    lengths[places] = np.where(is_plausible, timing.greatest, np.nan)
    return lengths
