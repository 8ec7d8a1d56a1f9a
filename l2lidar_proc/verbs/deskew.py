"""Deskews and filters the clouds of a recording with the same code as the node, without ROS.

``python -m l2lidar_proc.verbs.deskew IN OUT``: IN and OUT are rosbag2 folders or MCAP files.
Everything that is in IN is in OUT, and the deskewed clouds besides. Where IN has no velocity, this
package's odometry estimates it on the way.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rosbags.highlevel import AnyReaderError

from l2lidar_node.programs import interruptible
from l2lidar_node.ros.parameter_files import settings_for
from l2lidar_node.settings import SettingError
from l2lidar_proc.cloud import CloudError, to_sweep, without_time
from l2lidar_proc.config import DeskewNodeConfig, OdometryConfig
from l2lidar_proc.deskew.pipeline import Deskewed, Pipeline, PipelineCounts
from l2lidar_proc.motion.frames import FrameTree
from l2lidar_proc.motion.velocity import carried_over
from l2lidar_proc.odometry.odometry import Odometry
from l2lidar_proc.recording import bag
from l2lidar_proc.recording.bag import RecordingError

_END_NS: Final = 2**62


@dataclass(frozen=True, slots=True)
class Topics:
    """What to read.

    Attributes
    ----------
    cloud, imu : str
    velocity : str
        Empty where there is none: then this package's odometry estimates it.
    """

    cloud: str
    imu: str
    velocity: str


class _Deskewer:
    """Feeds the pipeline with the messages of a recording and writes what comes out."""

    def __init__(self, config: DeskewNodeConfig, topics: Topics, writer: bag.BagWriter) -> None:
        self.pipeline = Pipeline(config.proc)
        self.refused: dict[str, int] = {}
        self._unit = config.proc.deskew.time_unit
        self._uses_tf = config.topics.use_tf
        self._output = config.topics.output_topic
        self._topics = topics
        self._writer = writer
        self._odometry: Odometry | None = None
        if not topics.velocity and config.topics.velocity_type == "odometry":
            self._odometry = Odometry(OdometryConfig(), config.proc.motion.T_cloud_imu)
        self._frames = FrameTree()
        self._cloud_frame = ""

    def take(self, topic: str, kind: str, message: Any, now: int) -> None:
        """Take a message that was recorded at ``now`` [ns]."""
        if topic == self._topics.cloud:
            self._cloud(message, now)
        elif topic == self._topics.imu:
            self._mount(message.header.frame_id)
            sample = bag.sample_of(message)
            self.pipeline.imu(sample)
            if self._odometry is not None:
                self._odometry.imu(sample)
        elif topic == self._topics.velocity:
            self._velocity(message)
        elif kind == bag.TRANSFORMS and topic.endswith("tf_static") and self._uses_tf:
            for parent, child, transform in bag.transforms_of(message):
                self._frames.add(parent, child, transform)
        self.finish(now)

    def _mount(self, imu_frame: str) -> None:
        T_cloud_imu = self._frames.find(self._cloud_frame, imu_frame)
        if T_cloud_imu is None or self._cloud_frame == imu_frame:
            return
        if self.pipeline.tracker.mount(T_cloud_imu) and self._odometry is not None:
            self._odometry = Odometry(OdometryConfig(), T_cloud_imu)

    def finish(self, now: int) -> None:
        """Write what is finished by ``now`` [ns]."""
        for item in self.pipeline.poll(now):
            self._write(item, min(now, int(item.sweep.end) + item.waited_ns))
            if self._odometry is not None:
                for estimate in self._odometry.register(item.sweep):
                    self.pipeline.velocity(estimate.stamp, estimate.velocity, "own odometry")

    def _write(self, item: Deskewed, now: int) -> None:
        self._writer.cloud(self._output, now, item.points, item.stamp, self._cloud_frame)

    def _cloud(self, message: Any, now: int) -> None:
        self._cloud_frame = message.header.frame_id
        stamp = bag.stamp_of(message)
        try:
            points = bag.points_of(message)
        except ValueError as error:
            self.refused[str(error)] = self.refused.get(str(error), 0) + 1
            return
        try:
            self.pipeline.sweep(to_sweep(points, stamp, self._unit), now)
        except CloudError as error:
            self.refused[str(error)] = self.refused.get(str(error), 0) + 1
            self._writer.cloud(self._output, now, without_time(points), stamp, self._cloud_frame)

    def _velocity(self, message: Any) -> None:
        frame, linear, angular = bag.twist_of(message)
        T_cloud_body = self._frames.find(self._cloud_frame, frame)
        if T_cloud_body is not None:
            velocity = carried_over(linear, angular, T_cloud_body)
            self.pipeline.velocity(bag.stamp_of(message), velocity, self._topics.velocity)


def deskew_recording(
    source: Path, target: Path, config: DeskewNodeConfig
) -> tuple[PipelineCounts, dict[str, int]]:
    """Deskew the clouds of a recording into another one.

    Parameters
    ----------
    source, target : Path
        Rosbag2 folder or MCAP file; the target must not exist.
    config : DeskewNodeConfig
        As for the node. A topic that is not in the recording is replaced by the only one of its
        kind.

    Returns
    -------
    PipelineCounts
    dict of int
        Clouds that could not be deskewed, by reason.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or which topic to use is not plain.
    FileExistsError
        If the target exists.
    """
    try:
        with bag.open_bag(source) as reader:
            kinds = {item.topic: item.msgtype for item in reader.connections}
            topics = _topics(config, kinds)
            with bag.BagWriter(target, reader.typestore) as writer:
                deskewer = _Deskewer(config, topics, writer)
                for connection, recorded_ns, data in bag.messages(reader):
                    writer.copy(connection, recorded_ns, data)
                    if connection.topic in (topics.cloud, topics.imu, topics.velocity) or (
                        connection.msgtype == bag.TRANSFORMS
                    ):
                        message = reader.deserialize(data, connection.msgtype)
                        deskewer.take(connection.topic, connection.msgtype, message, recorded_ns)
                deskewer.finish(_END_NS)
                return deskewer.pipeline.counts, deskewer.refused
    except (AnyReaderError, FileNotFoundError) as error:
        raise bag.unreadable(source, error) from None


def _topics(config: DeskewNodeConfig, kinds: dict[str, str]) -> Topics:
    wanted = config.topics
    velocity = ""
    if wanted.velocity_type != "none":
        kind = bag.ODOMETRY if wanted.velocity_type == "odometry" else bag.TWIST
        found = [topic for topic, its in kinds.items() if its == kind]
        named = [
            topic for topic in found if topic.lstrip("/") == wanted.velocity_topic.lstrip("/")
        ]
        velocity = named[0] if named else found[0] if len(found) == 1 else ""
    return Topics(
        bag.chosen(kinds, wanted.cloud_topic, bag.CLOUD, "cloud_topic"),
        bag.chosen(kinds, wanted.imu_topic, bag.IMU, "imu_topic"),
        velocity,
    )


def main(arguments: list[str] | None = None) -> int:
    """Run from a command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="l2lidar_proc.verbs.deskew", description=__doc__)
    parser.add_argument("source", type=Path, help="rosbag2 folder or MCAP file")
    parser.add_argument("target", type=Path, help="what to write; MCAP file or rosbag2 folder")
    parser.add_argument("--params-file", type=Path, help="parameter file, as for the node")
    given = parser.parse_args(arguments)
    try:
        config = settings_for(given.params_file, "deskew_node", DeskewNodeConfig)
        counts, refused = deskew_recording(given.source, given.target, config)
    except (SettingError, RecordingError, FileExistsError, ValueError) as error:
        print(error, file=sys.stderr)
        return 2
    except OSError as error:
        print(f"{error.filename or given.target}: {error.strerror}", file=sys.stderr)
        return 2
    print(
        f"{counts.sweeps} clouds: {counts.deskewed} deskewed, {counts.still} at rest, "
        f"{counts.passed_on} passed on for want of IMU samples"
    )
    for reason, count in refused.items():
        print(f"{count} not deskewed: {reason}")
    return 0


if __name__ == "__main__":
    sys.exit(interruptible(main))
