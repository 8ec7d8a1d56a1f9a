"""Checks of the clouds: fields, memory, values, rings, leveling."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from l2lidar_node import rotations
from l2lidar_node.check.imu import unit
from l2lidar_node.check.observation import (
    COLUMNS,
    TIME_FIELDS,
    Cloud,
    Contents,
    Format,
    Observation,
)
from l2lidar_node.check.requirements import (
    Consumer,
    Finding,
    Input,
    TimeField,
    Use,
    not_judged,
    ok,
)
from l2lidar_node.clouds import LAYOUTS, OPTICAL_CENTRE_M, RINGS, Field
from l2lidar_node.types import F64, Level

_SUBJECT = "cloud"


class Reading(NamedTuple):
    """How a consumer reads a format.

    Attributes
    ----------
    input : Input
        The one that fits best.
    time : TimeField or None
        The time field that it uses.
    code : str
        Type of that field.
    """

    input: Input
    time: TimeField | None
    code: str


def usual_format(seen: Observation) -> Format:
    """Return the format that most clouds have."""
    return Counter(cloud.format for cloud in seen.clouds).most_common(1)[0][0]


def reading(form: Format, consumer: Consumer) -> Reading:
    """Return how a consumer reads a format."""
    fields = {item.name: item for item in form.fields}
    best = min(consumer.inputs, key=lambda item: _mismatches(item, fields))
    for time in best.times:
        if time.name in fields and fields[time.name].code in time.codes:
            return Reading(best, time, fields[time.name].code)
    return Reading(best, None, "")


def check_layout(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    """Yield findings on fields, sizes and memory; there is at least one cloud."""
    form = usual_format(seen)
    others = sum(cloud.format != form for cloud in seen.clouds)
    if others:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "format-changes",
            f"{others} of {len(seen.clouds)} clouds have other fields than most",
            "check for a second publisher on the topic",
        )
    wanted = reading(form, consumer).input
    yield from _check_fields(form, wanted, consumer)
    yield from _check_memory(seen, form, consumer)


def _mismatches(item: Input, fields: dict[str, Field]) -> int:
    """Count the fields that do not fit an input."""
    wrong = sum(
        name not in fields or fields[name].code not in codes for name, codes in item.fields.items()
    )
    times = [
        time for time in item.times if time.name in fields and fields[time.name].code in time.codes
    ]
    return wrong + (not times and bool(item.times))


def _check_fields(form: Format, wanted: Input, consumer: Consumer) -> Iterator[Finding]:
    fields = {item.name: item for item in form.fields}
    fix = f"set point_layout: {wanted.layout}"
    when = f" with {wanted.when}" if wanted.when else ""
    faults = 0
    for name, codes in wanted.fields.items():
        required = f"{consumer.title} reads it as {' or '.join(codes)}{when}"
        if name not in fields:
            text = f"field '{name}' is missing; {required}"
            yield Finding(Level.ERROR, _SUBJECT, "field-missing", text, fix)
        elif fields[name].code not in codes:
            text = f"field '{name}' is {fields[name].code}; {required}"
            yield Finding(Level.ERROR, _SUBJECT, "field-type", text, fix)
        else:
            continue
        faults += 1
    for time in wanted.times:
        if time.name in fields and fields[time.name].code not in time.codes:
            faults += 1
            text = (
                f"field '{time.name}' is {fields[time.name].code}; {consumer.title} reads times "
                f"as {' or '.join(time.codes)}{when}"
            )
            yield Finding(Level.ERROR, _SUBJECT, "field-type", text, fix)
    words = " ".join(f"{item.name}:{item.code}" for item in form.fields)
    if consumer.exact and not faults and not _is_layout(form, wanted.layout):
        text = f"{words} in {form.point_step} B: {consumer.title} accepts only its own layout"
        yield Finding(Level.ERROR, _SUBJECT, "layout", text, fix)
    elif consumer.contiguous and not faults and not _is_contiguous(fields):
        text = f"y and z do not follow x; {consumer.title} expects them there"
        yield Finding(Level.ERROR, _SUBJECT, "layout", text, fix)
    elif not faults:
        yield ok(_SUBJECT, "fields", f"{words}: read{when}")


def _is_layout(form: Format, layout_name: str) -> bool:
    layout = LAYOUTS[layout_name].dtype
    places = dict(layout.fields or {})
    wanted = [(name, places[name][1], places[name][0].str[1:]) for name in layout.names or ()]
    found = [(item.name, item.offset, item.code) for item in form.fields]
    return found == wanted and form.point_step == layout.itemsize


def _is_contiguous(fields: dict[str, Field]) -> bool:
    start = fields["x"].offset
    return (fields["y"].offset, fields["z"].offset) == (start + 4, start + 8)


def _check_memory(seen: Observation, form: Format, consumer: Consumer) -> Iterator[Finding]:
    unreadable = [cloud for cloud in seen.clouds if cloud.fault]
    if unreadable:
        text = f"{len(unreadable)} of {len(seen.clouds)} clouds are malformed: "
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "malformed",
            text + unreadable[0].fault,
            "fix the publisher",
        )
    if form.is_bigendian:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "byte-order",
            f"the clouds are big-endian; {consumer.title} reads the bytes as little-endian",
            "publish little-endian",
        )
    wrong = sum(_has_wrong_row_step(cloud) for cloud in seen.clouds)
    if wrong and consumer.row_step is not Use.IGNORED:
        yield Finding(
            consumer.row_step.level,
            _SUBJECT,
            "row-step",
            f"row_step is not width x point_step in {wrong} of {len(seen.clouds)} clouds; "
            f"{consumer.title} {'asserts' if consumer.row_step is Use.NEEDED else 'assumes'} it",
            "publish row_step = width x point_step",
        )
    times = [item.name for item in form.fields if item.name in TIME_FIELDS]
    if len(times) > 1 and consumer.time is not Use.IGNORED:
        yield Finding(
            consumer.several_times,
            "times",
            "time-several",
            f"several time fields ({', '.join(times)}): which one {consumer.title} reads depends "
            "on its version",
            f"set point_layout: {consumer.inputs[0].layout}, which has one",
        )


def _has_wrong_row_step(cloud: Cloud) -> bool:
    return cloud.row_step != cloud.width * cloud.format.point_step


_FEW: Final = 100
_MUCH_AT_ORIGIN: Final = 0.01
# Of what as many rings as slots of an arc keep; half as many keep half.
_KEPT_WELL: Final = 0.8
_KEPT_AT_ALL: Final = 0.5
_FRAGMENT: Final = 0.5
_NEXT: Final = 3  # clouds that the first one is compared with


def check_values(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    """Yield findings on the points."""
    inside = [cloud.contents for cloud in seen.clouds if cloud.contents is not None]
    if not inside:
        return
    yield from _check_counts(inside, consumer)
    if consumer.imu is Use.NEEDED:
        yield _check_first(inside, consumer)
    yield from _check_finite(seen, consumer)
    if consumer.ring_count:
        yield from _check_rings(inside, consumer)


def _check_first(inside: list[Contents], consumer: Consumer) -> Finding:
    """Return whether the first cloud, with which a map begins, is whole."""
    first, *others = (item.count - item.nonfinite for item in inside[: 1 + _NEXT])
    if len(others) == _NEXT and first < _FRAGMENT * min(others):
        does = "may crash on it" if consumer.fragment is Level.ERROR else "begins its map with it"
        return Finding(
            consumer.fragment,
            _SUBJECT,
            "first",
            f"the first cloud has {first} points, the next ones {min(others)} and more: part of a "
            f"turn; {consumer.title} {does}",
            "set sweep_cut: turn; the driver then publishes only whole turns",
        )
    return ok(_SUBJECT, "first", f"the first cloud is whole: {first} points")


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
            "check for something that covers the sensor, and range_min, range_max and filters",
        )
    else:
        yield ok(_SUBJECT, "points", f"{np.median(counts):.0f} points per cloud")
    at_origin = sum(item.at_origin for item in inside) / max(int(counts.sum()), 1)
    if at_origin > _MUCH_AT_ORIGIN:
        yield Finding(
            Level.WARN,
            _SUBJECT,
            "points-origin",
            f"{at_origin:.0%} of the points are at 0, 0, 0: these are not returns",
            "drop them with range_min: 0.05",
        )


def _check_finite(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    nonfinite = sum(cloud.contents.nonfinite for cloud in seen.clouds if cloud.contents)
    lying = sum(
        cloud.is_dense and cloud.contents.nonfinite > 0
        for cloud in seen.clouds
        if cloud.contents is not None
    )
    sparse = sum(not cloud.is_dense for cloud in seen.clouds)
    fix = "set organised: false (deskew_node), or drop NaN points"
    if lying:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "dense-lie",
            f"{lying} clouds claim is_dense but have NaN or infinite points",
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
            "drops them",
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
            f"set point_layout: {layout} and ring_count: {consumer.ring_count}, or N_SCAN: "
            f"{greatest + 1}",
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
    usual = consumer.ring_count / RINGS
    if kept < _KEPT_WELL * usual:
        level = Level.WARN if kept >= _KEPT_AT_ALL * usual else Level.ERROR
        fix = f"set point_layout: {layout} and imu_adjust: false"
        yield Finding(level, _SUBJECT, "ring-cells", text, fix)
    else:
        yield ok(_SUBJECT, "ring-cells", text)


_SUBJECT_LEVELED: Final = "cloud"
_TILT_DEG: Final = 12.0
_BELOW_DEG: Final = -8.0  # the wide field of view ends at -6
_MANY: Final = 0.01
_FEW_LEVELED: Final = 0.002
_NEAREST_M: Final = 0.5
_MOST: Final = 200


def check_leveling(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    """Yield whether the clouds are leveled, where the consumer deskews by itself.

    An L2 sees nothing below its own horizon. Where it is tilted, points below the cloud's horizon
    that are above it once they are turned back by the orientation tell that they were turned.
    """
    if consumer.time is Use.IGNORED:
        return
    verdict, why = _verdict(seen)
    if verdict is None:
        yield not_judged(_SUBJECT_LEVELED, "levelled", f"unknown whether imu_adjust is on: {why}")
    elif verdict:
        yield Finding(
            Level.ERROR if consumer.imu is Use.NEEDED else Level.WARN,
            _SUBJECT_LEVELED,
            "levelled",
            f"the clouds are rotated into a level frame ({why}); {consumer.title} deskews them "
            "itself and needs them as measured",
            "set imu_adjust: false",
        )
    else:
        yield ok(_SUBJECT_LEVELED, "levelled", f"clouds are in the sensor's frame ({why})")


def _verdict(seen: Observation) -> tuple[bool | None, str]:
    if seen.is_leveled is not None:
        return seen.is_leveled, f"imu_adjust is {str(seen.is_leveled).lower()}"
    imu = seen.imu[np.isfinite(seen.imu["orientation_wxyz"]).all(axis=1)]
    imu = imu[np.argsort(imu["stamp"], kind="stable")]
    imu = imu[np.linalg.norm(imu["orientation_wxyz"], axis=1) > 0.1]
    if not len(imu):
        return None, "without orientations"
    raw, back = [], []
    for cloud in seen.clouds[:: max(len(seen.clouds) // _MOST, 1)]:
        if cloud.contents is None:
            continue
        at = min(int(np.searchsorted(imu["stamp"], cloud.stamp)), len(imu) - 1)
        q = unit(imu["orientation_wxyz"][at : at + 1].astype(np.float64))
        up = rotations.rotate(q, np.array([[0.0, 0.0, 1.0]]))[0, 2]
        points = cloud.contents.sample.astype(np.float64)
        points = points[np.linalg.norm(points, axis=1) > _NEAREST_M]
        if len(points) < 50 or np.degrees(np.arccos(np.clip(up, -1.0, 1.0))) < _TILT_DEG:
            continue
        raw.append(_below(points))
        back.append(min(_below(_turned_back(points, q, yaw)) for yaw in (False, True)))
    if not raw:
        return None, f"the sensor was not tilted by {_TILT_DEG:g} deg or more"
    below, below_back = float(np.median(raw)), float(np.median(back))
    if below > _MANY and below_back < _FEW_LEVELED:
        return True, f"{below:.0%} of the points are below the sensor's horizon, none rotated back"
    if below < _FEW_LEVELED:
        return False, "no point is below the sensor's horizon"
    return None, "points are below the sensor's horizon in both cases"


def _below(points: F64) -> float:
    """Return the share of points below an L2's field of view."""
    level = np.hypot(points[:, 0], points[:, 1])
    elevation = np.degrees(np.arctan2(points[:, 2] - OPTICAL_CENTRE_M, level))
    return float((elevation < _BELOW_DEG).mean())


def _turned_back(points: F64, q: F64, with_yaw: bool) -> F64:
    """Return points turned back by an orientation, or by all of it but the yaw."""
    w, x, y, z = q[0]
    inverse = q * [1.0, -1.0, -1.0, -1.0]
    if not with_yaw:
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        turn = np.array([[np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]])
        points = rotations.rotate(np.repeat(turn, len(points), axis=0), points)
    return rotations.rotate(np.repeat(inverse, len(points), axis=0), points)
