"""Checks the clouds' points but for their times: NaN, empty clouds, rings, levelling."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from l2lidar_node.check.findings import Finding, Level, ok
from l2lidar_node.check.measure import Contents
from l2lidar_node.check.observation import Observation
from l2lidar_node.check.projection import COLUMNS
from l2lidar_node.check.requirements import Consumer, Use

_SUBJECT = "cloud"
_FEW: Final = 100
_MUCH_AT_ORIGIN: Final = 0.01
_KEPT_WELL: Final = 0.8
_KEPT_AT_ALL: Final = 0.5


def check(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    """Yield findings on the points."""
    inside = [cloud.contents for cloud in seen.clouds if cloud.contents is not None]
    if not inside:
        return
    yield from _check_counts(inside, consumer)
    yield from _check_finite(seen, consumer)
    if consumer.ring_count:
        yield from _check_rings(inside, consumer)


def _check_counts(inside: list[Contents], consumer: Consumer) -> Iterator[Finding]:
    counts = np.array([item.count - item.nonfinite for item in inside])
    few = int((counts < _FEW).sum())
    if few:
        least = int(counts.min())
        aborts = least <= 1 and consumer.name == "kiss_icp"
        yield Finding(
            Level.ERROR if aborts or few == len(counts) else Level.WARN,
            _SUBJECT,
            "points-few",
            f"{few} of {len(counts)} clouds have fewer than {_FEW} points, one has {least}"
            + ("; KISS-ICP aborts the process on those" if aborts else ""),
            "look whether something covers the sensor, and at range_min, range_max and filters",
        )
    else:
        yield ok(_SUBJECT, "points", f"{np.median(counts):.0f} points per cloud")
    at_origin = sum(item.at_origin for item in inside) / max(int(counts.sum()), 1)
    if at_origin > _MUCH_AT_ORIGIN:
        yield Finding(
            Level.WARN,
            _SUBJECT,
            "points-origin",
            f"{at_origin:.0%} of the points are at 0, 0, 0: returns that are none",
            "leave them out: range_min: 0.05",
        )


def _check_finite(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    nonfinite = sum(cloud.contents.nonfinite for cloud in seen.clouds if cloud.contents)
    lying = sum(
        cloud.is_dense and cloud.contents.nonfinite > 0
        for cloud in seen.clouds
        if cloud.contents is not None
    )
    sparse = sum(not cloud.is_dense for cloud in seen.clouds)
    fix = "set organised: false (deskew_node), or leave NaN points out"
    if lying:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "dense-lie",
            f"{lying} clouds say is_dense and have NaN or infinite points",
            fix,
        )
    elif sparse and consumer.is_dense is Use.NEEDED:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "not-dense",
            f"{sparse} clouds are not is_dense; {consumer.title} shuts down on the first",
            fix,
        )
    elif nonfinite:
        yield Finding(
            Level.WARN,
            _SUBJECT,
            "nonfinite",
            f"{nonfinite} points are NaN or infinite; not every version of {consumer.title} "
            "leaves them out",
            fix,
        )
    else:
        yield ok(_SUBJECT, "dense", "no point is NaN or infinite")


def _check_rings(inside: list[Contents], consumer: Consumer) -> Iterator[Finding]:
    rings = [item.rings for item in inside if item.rings is not None]
    if not rings:
        return
    least = min(item.least for item in rings)
    greatest = max(item.greatest for item in rings)
    kept = float(np.median([item.kept for item in rings]))
    layout = consumer.inputs[0].layout
    if least == greatest:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "ring-constant",
            f"every point has ring {least}; {consumer.title} keeps one point for each ring and "
            "column",
            f"set point_layout: {layout}, whose rings are bands of elevation",
        )
        return
    if least < 0 or greatest >= consumer.ring_count:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "ring-range",
            f"rings are {least} to {greatest}; {consumer.title} drops points of rings not within "
            f"0 to N_SCAN - 1 (N_SCAN: {consumer.ring_count} in config/consumers)",
            f"set point_layout: {layout}, or N_SCAN: {greatest + 1}",
        )
    elif least == 1 and greatest > 1:
        yield Finding(
            Level.WARN,
            _SUBJECT,
            "ring-from-1",
            f"rings are 1 to {greatest}; {consumer.title} counts them from 0",
            f"set point_layout: {layout}",
        )
    else:
        yield ok(_SUBJECT, "ring-range", f"rings are {least} to {greatest}, counted from 0")
    text = (
        f"{consumer.title}'s projection (a point for each ring and {360 / COLUMNS:g} deg of "
        f"azimuth) keeps {kept:.0%} of the points"
    )
    if kept < _KEPT_WELL:
        level = Level.WARN if kept >= _KEPT_AT_ALL else Level.ERROR
        fix = f"set point_layout: {layout} and imu_adjust: false"
        yield Finding(level, _SUBJECT, "ring-cells", text, fix)
    else:
        yield ok(_SUBJECT, "ring-cells", text)
