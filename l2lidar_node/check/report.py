"""Runs all checks for one consumer and formats the result."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.check import frames, imu, points, stamps, timing
from l2lidar_node.check.observation import Observation, Topics
from l2lidar_node.check.requirements import Consumer, Finding, Use, worst
from l2lidar_node.types import Level

_OVERLONG: Final = 1.25
_LONGEST_S: Final = 20.0


def judge(seen: Observation, consumer: Consumer) -> list[Finding]:
    """Return the findings about an observation for a consumer, in a fixed order."""
    with np.errstate(all="ignore"):  # any number may stand in a message
        return list(_judge(seen, consumer))


def _judge(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    clouds = None
    if seen.clouds:
        yield from points.check_layout(seen, consumer)
        yield from points.check_values(seen, consumer)
        yield from timing.check(seen, consumer)
        yield from points.check_leveling(seen, consumer)
        clouds = stamps.cloud_track(seen, _lengths(seen, consumer))
        yield from stamps.check(clouds, consumer)
    else:
        text = "no clouds came"
        fix = "check that the driver runs, that the topic's name is right, and its QoS"
        yield Finding(Level.ERROR, "cloud", "cloud-missing", text, fix)
    if not len(seen.imu):
        yield from imu.missing(consumer)
    elif consumer.imu is not Use.IGNORED:
        samples = stamps.imu_track(seen)
        yield from stamps.check(samples, consumer)
        yield from imu.check(seen, consumer)
        yield from imu.check_orientation(seen, consumer)
        if clouds is not None:
            yield from stamps.check_overlap(clouds, samples)
    if seen.clouds:
        yield from frames.check_frames(seen, consumer)
        yield from frames.check_qos(seen, consumer)


def _lengths(seen: Observation, consumer: Consumer) -> NDArray[np.float64]:
    """Return the time from each cloud's stamp to its last point [s], NaN where it is not known.

    Times that are wrong, and said to be, say nothing about it.
    """
    lengths = np.full(len(seen.clouds), np.nan)
    found = timing.timed(seen, consumer)
    if found is None:
        return lengths
    clouds, times = found
    steps = np.diff(np.array([cloud.stamp for cloud in seen.clouds], np.int64)) / 1e9
    steps = steps[steps > 0]
    longest = _OVERLONG * float(np.median(steps)) if len(steps) else _LONGEST_S
    index = {id(cloud): at for at, cloud in enumerate(seen.clouds)}
    places = [index[id(cloud)] for cloud in clouds]
    is_plausible = (times.greatest > 0.0) & (times.greatest <= longest)
    lengths[places] = np.where(is_plausible, times.greatest, np.nan)
    return lengths


def verdict(findings: list[Finding], consumer: Consumer) -> str:
    """Return the last line: whether the consumer can work with the topics."""
    errors = sum(item.level is Level.ERROR for item in findings)
    warnings = sum(item.level is Level.WARN for item in findings)
    skipped = sum(item.text.startswith("not judged") for item in findings)
    counts = f"{_number(errors, 'error')}, {_number(warnings, 'warning')}, {len(findings)} checks"
    if skipped:
        counts += f", {skipped} of them not judged"
    state = {
        Level.OK: "ready for",
        Level.WARN: "ready, with warnings, for",
        Level.ERROR: "not ready for",
    }[worst(findings)]
    return f"{state} {consumer.title}: {counts}"


def as_data(
    findings: list[Finding], consumer: Consumer, source: str, topics: Topics
) -> dict[str, Any]:
    """Return the result as values for JSON."""
    return {
        "consumer": consumer.name,
        "source": source,
        "topics": topics._asdict(),
        "level": worst(findings).name,
        "verdict": verdict(findings, consumer),
        "findings": [{**item._asdict(), "level": item.level.name} for item in findings],
    }


def _number(count: int, noun: str) -> str:
    return f"{count or 'no'} {noun}{'' if count == 1 else 's'}"
