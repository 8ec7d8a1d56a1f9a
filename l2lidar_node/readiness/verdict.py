"""Composes all checks of one consumer."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.readiness import (
    attitude,
    fields,
    imu,
    levelled,
    overlap,
    points,
    stamps,
    surroundings,
    times,
)
from l2lidar_node.readiness.demands import Consumer, Use
from l2lidar_node.readiness.findings import Finding, Level
from l2lidar_node.readiness.observation import Observation


def judge(seen: Observation, consumer: Consumer) -> list[Finding]:
    """Return what there is to say about an observation for a consumer, in a fixed order."""
    return list(_judge(seen, consumer))


def _judge(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    clouds = None
    if seen.clouds:
        yield from fields.check(seen, consumer)
        yield from points.check(seen, consumer)
        yield from times.check(seen, consumer)
        yield from levelled.check(seen, consumer)
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
        yield from surroundings.check_frames(seen, consumer)
        yield from surroundings.check_qos(seen, consumer)


def _lengths(seen: Observation, consumer: Consumer) -> NDArray[np.float64]:
    """Return the time from each cloud's stamp to its last point [s], 0 where it is not known."""
    found = times.timed(seen, consumer)
    lengths = np.zeros(len(seen.clouds))
    if found is None:
        return lengths
    clouds, timing = found
    index = {id(cloud): at for at, cloud in enumerate(seen.clouds)}
    places = [index[id(cloud)] for cloud in clouds]
    with np.errstate(all="ignore"):
        plausible = (timing.greatest >= 0.0) & (timing.greatest < 20.0)
        lengths[places] = np.where(plausible, timing.greatest, 0.0)
    return lengths
