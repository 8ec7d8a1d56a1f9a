"""Chooses the topics to be judged among those there are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

CLOUD: Final = "sensor_msgs/msg/PointCloud2"
IMU: Final = "sensor_msgs/msg/Imu"
TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"


class SourceError(ValueError):
    """What was asked for is not to be had from the source; the message says why."""


class Topics(NamedTuple):
    """Topics of the clouds and of the IMU samples; empty for the only one of its kind."""

    cloud: str = ""
    imu: str = ""


def choose(kinds: Mapping[str, str], asked: Topics, needs_imu: bool) -> Topics:
    """Return the topics to be judged.

    Parameters
    ----------
    kinds : mapping
        Types of all topics by name.
    asked : Topics
    needs_imu : bool
        Whether it matters which IMU topic is taken; else none is taken among several.

    Raises
    ------
    SourceError
        If a topic that was asked for is not there or of another type, if there is no cloud, or
        if several topics may be meant.
    """
    cloud = _choose(kinds, CLOUD, asked.cloud, "--cloud")
    if not cloud:
        there = ", ".join(sorted(kinds)) or "none at all"
        raise SourceError(f"there is no topic of type {CLOUD}; topics are: {there}")
    several = sum(kind == IMU for kind in kinds.values()) > 1
    if several and not asked.imu and not needs_imu:
        return Topics(cloud)
    return Topics(cloud, _choose(kinds, IMU, asked.imu, "--imu"))


def _choose(kinds: Mapping[str, str], kind: str, asked: str, option: str) -> str:
    """Return the topic of a type, empty if there is none."""
    found = sorted(topic for topic, its_kind in kinds.items() if its_kind == kind)
    if asked:
        if asked in found:
            return asked
        if asked in kinds:
            raise SourceError(f"topic '{asked}' is of type {kinds[asked]}, expected {kind}")
        there = ", ".join(found) or "none"
        raise SourceError(f"there is no topic '{asked}'; topics of type {kind} are: {there}")
    if len(found) > 1:
        raise SourceError(
            f"several topics are of type {kind}; say which by {option}: " + ", ".join(found)
        )
    return found[0] if found else ""
