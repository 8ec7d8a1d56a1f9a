"""Reads recordings for the verbs: bags, and captures through a driver."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import yaml

from l2lidar_node.calibration.file import CalibrationFileError, load
from l2lidar_node.check.observation import (
    CLOUD,
    IMU,
    TRANSFORMS,
    Gathering,
    Observation,
    Qos,
    SourceError,
    Topics,
    choose,
)
from l2lidar_node.command_line import CommandError
from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.driver import Driver
from l2lidar_node.driver.health import metadata
from l2lidar_node.files import shared_file
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.recording import bag
from l2lidar_node.recording.capture import CaptureError, is_capture_file
from l2lidar_node.recording.packet_bag import open_packets
from l2lidar_node.recording.recording import Received, Recording, feed, measurements
from l2lidar_node.ros.parameter_files import parameters_for
from l2lidar_node.settings import build
from l2lidar_node.types import Stream, Sweep

_KINDS: Final = (CLOUD, IMU, TRANSFORMS)
_OFFLINE: Final = {"imu_adjust": False}
_CLOUD_DEPTH: Final = 10
_IMU_DEPTH: Final = 1000


def observe_bag(
    path: Path, asked: Topics, needs_imu: bool, seconds: float | None = None
) -> tuple[Observation, Topics]:
    """Return the observation of a rosbag2 folder or an MCAP file.

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
            return _observed(reader, asked, needs_imu, seconds)
    except SourceError:
        raise
    except Exception as error:
        # Of a damaged file, any byte may lead anywhere in its readers.
        raise SourceError(str(bag.unreadable(path, error))) from None


def observe_capture(
    path: Path, consumer: str, seconds: float | None = None
) -> tuple[Observation, Topics]:
    """Return the observation of what the driver would publish from a capture for a consumer.

    These are the ones with which ``lio_input.launch.py consumer:=NAME`` starts it, where there is
    such a profile; else its defaults with ``imu_adjust`` off.

    Raises
    ------
    SourceError
        If the file cannot be read.
    """
    profile = shared_file(f"config/consumers/{consumer}/driver.yaml")
    values: dict[str, Any] = dict(_OFFLINE)
    if profile is not None:
        values |= parameters_for(profile, "l2lidar_node", "/l2lidar_node")
    config = build(DriverConfig, values)
    messages = bag.Messages(config)
    gathering = Gathering()
    end = None
    try:
        with open_packets(path) as stream:
            recording = Recording(stream)
            gathering.transforms(messages.transforms(recording.start))
            for now, event in measurements(recording, config):
                if end is None and seconds is not None:
                    end = now + round(seconds * 1e9)
                if end is not None and now > end:
                    break
                if isinstance(event, Sweep):
                    gathering.cloud(messages.cloud(event), now)
                else:
                    gathering.imu(messages.imu(event), now)
    except (CaptureError, OSError) as error:
        words = error.strerror if isinstance(error, OSError) else error
        raise SourceError(f"{path}: {words}") from None
    topics = config.topics
    observation = gathering.observation(
        cloud_qos=(Qos(topics.qos_reliability, _CLOUD_DEPTH),),
        imu_qos=(Qos(topics.qos_reliability, _IMU_DEPTH),),
        is_leveled=config.imu.adjust,
    )
    return observation, Topics(topics.point_cloud_topic_id, topics.imu_topic_id)


def describe(path: Path, l2_ip: str = "") -> dict[str, Any]:
    """Return the content of a capture, a bag or a calibration, as values for JSON.

    Raises
    ------
    CommandError
        If it cannot be read.
    """
    try:
        if is_capture_file(path):
            return _capture(path, l2_ip)
        if path.suffix in (".yaml", ".yml") and path.is_file():
            load(path)
            return {"kind": "calibration", "content": yaml.safe_load(path.read_text())}
        return _bag(path)
    except CalibrationFileError as error:
        raise CommandError(str(error)) from None
    except (CaptureError, OSError) as error:
        words = error.strerror if isinstance(error, OSError) else str(error)
        raise CommandError(f"{path}: {words}") from None


def _capture(path: Path, l2_ip: str) -> dict[str, Any]:
    with path.open("rb") as stream:
        recording = Recording(stream, l2_ip)
        driver = Driver(build(DriverConfig, {**_OFFLINE, "sweep_cut": "turn"}))
        last = recording.start
        for entry in recording:
            feed(driver, entry)
            if isinstance(entry, Received):
                last = entry.time
        driver.flush()
        is_cut_off = recording.is_cut_off
    seconds = (last - recording.start) / 1e9
    counters, clock = driver.counters, driver.clock_status()
    return {
        "kind": "capture",
        "bytes": path.stat().st_size,
        "device": str(recording.device),
        "host": str(recording.host),
        "start": _instant(recording.start),
        "seconds": round(seconds, 3),
        "is_cut_off": is_cut_off,
        "packets": {_kind(kind): count for kind, count in sorted(counters.frames.items())},
        "lost": {stream.value: counters.sequence[stream].lost for stream in Stream},
        "damaged": counters.faults.total() + counters.rejected.total(),
        "full_turns": counters.sweeps,
        "parts_of_turns": counters.fragments,
        "points": counters.points,
        "clock": {"locked": clock.locked, "ratio": clock.ratio if clock.locked else None},
        "unit": dataclasses.asdict(metadata(driver)),
    }


def _kind(number: int) -> str:
    try:
        return PacketType(number).name.lower()
    except ValueError:
        return "unknown"


def _bag(path: Path) -> dict[str, Any]:
    try:
        with bag.open_bag(path) as reader:
            seconds = max(reader.duration, 0) / 1e9
            files = [path] if path.is_file() else list(path.rglob("*"))
            return {
                "kind": "bag",
                "bytes": sum(item.stat().st_size for item in files if item.is_file()),
                "start": _instant(reader.start_time) if reader.message_count else None,
                "seconds": round(seconds, 3),
                "messages": reader.message_count,
                "topics": [
                    {
                        "name": name,
                        "type": topic.msgtype,
                        "messages": topic.msgcount,
                        "rate": round(topic.msgcount / seconds, 2) if seconds else None,
                        "qos": [f"{qos.reliability}, {qos.depth}" for qos in _qos_of(topic)],
                    }
                    for name, topic in sorted(reader.topics.items())
                ],
            }
    except Exception as error:
        # Of a damaged file, any byte may lead anywhere in its readers.
        raise CommandError(str(bag.unreadable(path, error))) from None


def _instant(stamp: int) -> str:
    return datetime.fromtimestamp(stamp / 1e9, UTC).isoformat(timespec="milliseconds")


def _observed(
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
    cloud_qos, imu_qos = (
        tuple(_qos_of([item for item in connections if item.topic == topic]))
        for topic in (topics.cloud, topics.imu)
    )
    return gathering.observation(cloud_qos=cloud_qos, imu_qos=imu_qos), topics


def _qos_of(topic: Any) -> Iterator[Qos]:
    """Yield the QoS that a topic's publishers offered when it was recorded."""
    for connection in getattr(topic, "connections", topic):
        for profile in getattr(connection.ext, "offered_qos_profiles", ()):
            yield Qos(_reliability(profile.reliability.name), profile.depth)


def _reliability(name: str) -> str:
    return name.lower() if name in ("RELIABLE", "BEST_EFFORT") else "unknown"
