"""Gathers what a recording holds of a pair of topics."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from l2lidar_node.check.observation import Gathering, Observation, Qos
from l2lidar_node.check.topics import CLOUD, IMU, TRANSFORMS, SourceError, Topics, choose
from l2lidar_proc.recording import bag

_KINDS: Final = (CLOUD, IMU, TRANSFORMS)


def observe(
    path: Path, asked: Topics, needs_imu: bool, seconds: float | None = None
) -> tuple[Observation, Topics]:
    """Return what a rosbag2 folder or an MCAP file holds.

    Parameters
    ----------
    path : Path
    asked : Topics
    needs_imu : bool
        Whether the consumer reads an IMU topic.
    seconds : float, optional
        How much of the recording to look at; all of it if left out.

    Raises
    ------
    SourceError
        If the file cannot be read, or which topic to use is not plain.
    """
    try:
        with bag.open_bag(path) as reader:
            return _read(reader, asked, needs_imu, seconds)
    except SourceError:
        raise
    except Exception as error:
        # Of a damaged file, any byte may lead anywhere in its readers.
        raise SourceError(str(bag.unreadable(path, error))) from None


def _read(
    reader: Any, asked: Topics, needs_imu: bool, seconds: float | None
) -> tuple[Observation, Topics]:
    connections = [item for item in reader.connections if item.msgtype in _KINDS]
    topics = choose({item.topic: item.msgtype for item in reader.connections}, asked, needs_imu)
    gathering = Gathering()
    end = None
    for connection, recorded_ns, data in bag.messages(reader):
        if connection.msgtype not in _KINDS:
            continue
        if end is None and seconds is not None:
            end = recorded_ns + round(seconds * 1e9)
        if end is not None and recorded_ns > end:
            break
        if connection.topic == topics.cloud:
            gathering.cloud(reader.deserialize(data, connection.msgtype), recorded_ns)
        elif connection.topic == topics.imu:
            gathering.imu(reader.deserialize(data, connection.msgtype), recorded_ns)
        elif connection.msgtype == TRANSFORMS:
            gathering.transforms(reader.deserialize(data, connection.msgtype))
    return (
        gathering.observation(
            cloud_qos=_offers(connections, topics.cloud), imu_qos=_offers(connections, topics.imu)
        ),
        topics,
    )


def _offers(connections: list[Any], topic: str) -> tuple[Qos, ...]:
    """Return the QoS that a topic's publishers offered when it was recorded."""
    return tuple(
        Qos(_reliability(profile.reliability.name), profile.depth)
        for connection in connections
        if connection.topic == topic
        for profile in getattr(connection.ext, "offered_qos_profiles", ())
    )


def _reliability(name: str) -> str:
    return name.lower() if name in ("RELIABLE", "BEST_EFFORT") else "unknown"
