"""`l2lidar deskew`: deskews the clouds of a recording with the node's code."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rosbags.highlevel import AnyReaderError

from l2lidar_node.command_line import CommandError, UsageError
from l2lidar_node.frames import FrameTree
from l2lidar_node.recording.packet_bag import is_of_packets
from l2lidar_node.ros.parameter_files import settings_for
from l2lidar_node.types import is_ros_time
from l2lidar_proc.cloud import CloudError, position_problem, to_sweep, without_time
from l2lidar_proc.deskew.config import DeskewNodeConfig
from l2lidar_proc.deskew.pipeline import Deskewed, Pipeline, PipelineCounts
from l2lidar_proc.motion.tracker import cloud_velocity, cloud_velocity_covariance
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.pipeline import OdometryPipeline
from l2lidar_proc.recording import bag
from l2lidar_proc.recording.bag import RecordingError

_END_NS: Final = 2**62


@dataclass(frozen=True, slots=True)
class Topics:
    """Topics to read.

    Attributes
    ----------
    cloud, imu : str
    velocity : str
        Empty where there is none: then this package's odometry estimates it.
    """

    cloud: str
    imu: str
    velocity: str


@dataclass(frozen=True, slots=True)
class DeskewRun:
    """Result of the deskewing of a recording.

    Attributes
    ----------
    counts : PipelineCounts
    refused : Counter of str
        Clouds that could not be deskewed, by reason.
    damaged : Counter of str
        Messages that could not be read, by topic.
    """

    counts: PipelineCounts
    refused: Counter[str]
    damaged: Counter[str]

    @property
    def report(self) -> list[str]:
        """Lines of a report for people."""
        counts = self.counts
        return [
            f"{counts.sweeps} clouds: {counts.deskewed} deskewed, {counts.still} at rest, "
            f"{counts.passed_on} passed on because IMU samples are missing",
            *(f"{count} not deskewed: {reason}" for reason, count in self.refused.items()),
            *(
                f"{count} damaged messages on '{topic}' were not used"
                for topic, count in self.damaged.items()
            ),
        ]


class _Deskewer:
    """Feeds the pipeline with the messages of a recording and writes its output."""

    def __init__(self, config: DeskewNodeConfig, topics: Topics, writer: bag.BagFile) -> None:
        self.pipeline = Pipeline(config.proc)
        self.refused: Counter[str] = Counter()
        self.damaged: Counter[str] = Counter()  # messages, by topic
        self._unit = config.proc.deskew.time_unit
        self._uses_tf = config.topics.use_tf
        # A bag names topics in full; relative to the node they are below the root here.
        self._output = "/" + config.topics.output_topic.lstrip("/")
        self._topics = topics
        self._writer = writer
        self._odometry: OdometryPipeline | None = None
        if not topics.velocity and config.topics.velocity_type == "odometry":
            odometry = self._odometry = OdometryPipeline(
                OdometryConfig(),
                config.proc.motion.T_cloud_imu,
                config.proc.deskew.imu_wait_ms,
                self.pipeline.extrinsics,
            )
            self.pipeline.odometry_motion = odometry.motion_of
            self.pipeline.odometry_convention = lambda: odometry.convention
        self._frames = FrameTree()
        self._cloud_frame = ""

    def take(self, topic: str, kind: str, message: Any, now: int) -> None:
        """Take a message that was recorded at ``now`` [ns]."""
        if topic == self._topics.cloud:
            self._cloud(message, now)
        elif topic == self._topics.imu:
            self._mount(message.header.frame_id)
            sample = bag.sample_of(message)
            # The odometry first: it tells in which unit they are.
            if self._odometry is not None:
                self._odometry.imu(sample)
            self.pipeline.imu(sample)
        elif topic == self._topics.velocity:
            self._velocity(message)
        elif kind == bag.TRANSFORMS and topic.endswith("tf_static") and self._uses_tf:
            for problem in self._frames.take(message):
                self._refuse(problem)
        self.finish(now)

    def _mount(self, imu_frame: str) -> None:
        T_cloud_imu = self._frames.find(self._cloud_frame, imu_frame)
        if T_cloud_imu is None or self._cloud_frame == imu_frame:
            return
        if self.pipeline.mount(T_cloud_imu) and self._odometry is not None:
            self._odometry.mount(T_cloud_imu)

    def finish(self, now: int) -> None:
        """Write the sweeps finished by ``now`` [ns]."""
        # The odometry first, as in the companion: a sweep is deskewed with its own motion.
        if self._odometry is not None:
            for estimate in self._odometry.poll(now):
                self.pipeline.velocity(
                    estimate.stamp,
                    estimate.velocity,
                    "own odometry",
                    estimate.twist_covariance[:3, :3],
                )
        for item in self.pipeline.poll(now):
            self._write(item, min(now, int(item.sweep.end) + item.waited_ns))

    def _write(self, item: Deskewed, now: int) -> None:
        self._writer.cloud(self._output, now, item.points, item.stamp, self._cloud_frame)

    def _cloud(self, message: Any, now: int) -> None:
        self._cloud_frame = message.header.frame_id
        stamp = bag.stamp_of(message)
        try:
            points = bag.points_of(message)
            sweep = to_sweep(points, stamp, self._unit)
        except CloudError as error:
            self._refuse(str(error))
            if not position_problem(points.dtype) and is_ros_time(stamp):
                cloud = without_time(points)
                self._writer.cloud(self._output, now, cloud, stamp, self._cloud_frame)
        except ValueError as error:
            self._refuse(str(error))
        else:
            if self._odometry is not None:
                self._odometry.sweep(sweep, now)
            self.pipeline.sweep(sweep, now)

    def _refuse(self, reason: str) -> None:
        self.refused[reason] += 1

    def _velocity(self, message: Any) -> None:
        twist = bag.twist_of(message)
        T_cloud_body = self._frames.find(self._cloud_frame, twist.frame)
        if T_cloud_body is not None:
            self.pipeline.velocity(
                bag.stamp_of(message),
                cloud_velocity(twist.linear, twist.angular, T_cloud_body),
                self._topics.velocity,
                cloud_velocity_covariance(twist.covariance, T_cloud_body),
            )


def deskew_recording(source: Path, target: Path, config: DeskewNodeConfig) -> DeskewRun:
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
    DeskewRun

    Raises
    ------
    RecordingError
        If the recording cannot be read, or which topic to use is not plain.
    FileExistsError
        If the target exists.
    """
    try:
        with bag.opened(source) as reader:
            topics = _topics(config, bag.kinds_of(reader))
            with bag.BagFile(target, store=reader.typestore) as writer:
                deskewer = _Deskewer(config, topics, writer)
                for connection, recorded_ns, data in bag.messages(reader):
                    writer.copy(connection, recorded_ns, data)
                    if connection.topic in (topics.cloud, topics.imu, topics.velocity) or (
                        connection.msgtype == bag.TRANSFORMS
                    ):
                        message = bag.message_of(reader, connection, data)
                        if message is None:
                            deskewer.damaged[connection.topic] += 1
                            continue
                        deskewer.take(connection.topic, connection.msgtype, message, recorded_ns)
                deskewer.finish(_END_NS)
                return DeskewRun(deskewer.pipeline.counts, deskewer.refused, deskewer.damaged)
    except AnyReaderError as error:
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


def deskew(
    source: Annotated[Path, typer.Argument(help="rosbag2 folder or MCAP file.")],
    target: Annotated[Path, typer.Argument(help="FILE.mcap or a folder to write.")],
    params_file: Annotated[
        Path | None, typer.Option(help="Parameter file, as for deskew_node.")
    ] = None,
) -> None:
    """Deskew and filter the clouds of a recording, as deskew_node does live.

    Everything of the recording is in the new one too. Where it has no velocity, this package's
    odometry estimates one on the way.
    """
    if target.suffix not in ("", ".mcap"):
        raise UsageError(
            f"'{target}' ends in '{target.suffix}'; expected FILE.mcap, or a name without a "
            "suffix for a rosbag2 folder"
        )
    if target.exists():
        raise UsageError(f"{target} exists already; choose another name, or remove it")
    if is_of_packets(source):
        raise UsageError(
            f"{source} holds raw packets; make clouds of them first: l2lidar convert {source} "
            "FILE.mcap"
        )
    try:
        config = settings_for(params_file, "deskew_node", DeskewNodeConfig)
        run = deskew_recording(source, target, config)
    except OSError as error:
        raise CommandError(f"{error.filename or target}: {error.strerror}") from None
    except RecordingError as error:
        raise CommandError(str(error)) from None
    except ValueError as error:
        raise UsageError(str(error)) from None
    for line in (f"{target}: {run.report[0]}", *run.report[1:]):
        typer.echo(line)
