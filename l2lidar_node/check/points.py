"""Checks the clouds' fields, sizes and memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

from l2lidar_node.check.findings import Finding, Level, ok
from l2lidar_node.check.measure import TIME_FIELDS
from l2lidar_node.check.observation import Cloud, Format, Observation
from l2lidar_node.check.requirements import Consumer, Input, TimeField, Use
from l2lidar_node.clouds.fields import Field
from l2lidar_node.clouds.layouts import LAYOUTS

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


def check(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    """Yield findings on fields, sizes and memory; there is at least one cloud."""
    form = usual_format(seen)
    others = sum(cloud.format != form for cloud in seen.clouds)
    if others:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "format-changes",
            f"{others} of {len(seen.clouds)} clouds have other fields than most",
            "is there a second publisher on the topic?",
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
        demand = f"{consumer.title} reads it as {' or '.join(codes)}{when}"
        if name not in fields:
            text = f"field '{name}' is missing; {demand}"
            yield Finding(Level.ERROR, _SUBJECT, "field-missing", text, fix)
        elif fields[name].code not in codes:
            text = f"field '{name}' is {fields[name].code}; {demand}"
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
        text = f"{words} in {form.point_step} B: {consumer.title} takes its own bytes only"
        yield Finding(Level.ERROR, _SUBJECT, "layout", text, fix)
    elif consumer.contiguous and not faults and not _is_contiguous(fields):
        text = f"y and z do not follow x; {consumer.title} takes them from there"
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
            "the publisher has to be mended",
        )
    if form.is_bigendian:
        yield Finding(
            Level.ERROR,
            _SUBJECT,
            "byte-order",
            f"the clouds are big-endian; {consumer.title} takes the bytes as little-endian",
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
            f"several time fields ({', '.join(times)}): which one {consumer.title} takes depends "
            "on its version",
            f"set point_layout: {consumer.inputs[0].layout}, which has one",
        )


def _has_wrong_row_step(cloud: Cloud) -> bool:
    return cloud.row_step != cloud.width * cloud.format.point_step
