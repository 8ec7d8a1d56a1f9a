"""Estimates the sensor's way through a recording, with the same code as the node, without ROS.

``python -m l2lidar_proc.verbs.odometry BAG OUT``: BAG is a rosbag2 folder or an MCAP file with
clouds as measured and IMU samples; the folder OUT gets ``trajectory.tum``, ``trajectory.kitti``,
``map.ply`` and ``trajectory.png``. The poses are those of the cloud frame, or of the base frame
where one is set.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReaderError

from l2lidar_node.files import whole, write_whole
from l2lidar_node.programs import interruptible
from l2lidar_node.ros.parameter_files import settings_for
from l2lidar_node.types import Sweep
from l2lidar_proc.cloud import CloudError, to_sweep
from l2lidar_proc.config import OdometryNodeConfig
from l2lidar_proc.motion.frames import FrameTree
from l2lidar_proc.odometry.base_frame import BaseFrame
from l2lidar_proc.odometry.estimate import Status
from l2lidar_proc.odometry.odometry import Odometry
from l2lidar_proc.odometry.pipeline import OdometryPipeline
from l2lidar_proc.recording import bag, map_file
from l2lidar_proc.recording.trajectory import StampedPoses, kitti, tum

_END_NS: Final = 2**62

Progress = Callable[[float], None]
"""Told the share of the recording that is done, 0 to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class OdometryRun:
    """What was found in a recording.

    Attributes
    ----------
    poses : ndarray of STAMPED_POSE, shape (N,)
        Of the base frame in the odometry frame.
    map_points : ndarray, shape (N, 3)
        Local map at the end [m], odometry frame.
    sweeps : int
    counts : Counter of Status
        Sweeps by what was remarkable about them.
    refused : Counter of str
        Clouds that could not be used, by reason.
    """

    poses: StampedPoses
    map_points: NDArray[np.float64]
    sweeps: int
    counts: Counter[Status]
    refused: Counter[str]

    @property
    def report(self) -> list[str]:
        """Lines that tell a person what was found."""
        return [
            f"{len(self.poses)} poses from {self.sweeps} sweeps",
            *(f"{count} sweeps: {status.value}" for status, count in self.counts.items()),
            *(f"{count} clouds not used: {reason}" for reason, count in self.refused.items()),
        ]


Event = tuple[int, Sweep | NDArray[np.void]]
"""Instant of arrival [ns], and a sweep or IMU samples."""


class OdometryRunner:
    """Feeds a pipeline with the sweeps and samples of any recording.

    Parameters
    ----------
    config : OdometryNodeConfig
    """

    def __init__(self, config: OdometryNodeConfig) -> None:
        topics = config.topics
        self.pipeline = OdometryPipeline(config.odometry, topics.T_cloud_imu, topics.imu_wait_ms)
        self.base = BaseFrame(np.eye(4))
        self.refused: Counter[str] = Counter()

    def take(self, event: Event) -> None:
        """Take a sweep or samples."""
        now, what = event
        if isinstance(what, Sweep):
            self.pipeline.sweep(what, now)
        else:
            self.pipeline.imu(what)
        self.pipeline.poll(now)

    def finish(self) -> OdometryRun:
        """Return what was found."""
        self.pipeline.poll(_END_NS)
        found = self.pipeline.trajectory.poses
        poses = self.base.poses(found)
        points = self.pipeline.odometry.map_points()
        if len(found):
            turn = self.base.odom_from_map(found["pose"][0])
            points = points @ turn[:3, :3].T + turn[:3, 3]
        return OdometryRun(poses, points, self.pipeline.sweeps, self.pipeline.counts, self.refused)


def run_events(events: Iterator[Event], config: OdometryNodeConfig) -> OdometryRun:
    """Return what the odometry makes of sweeps and samples in the order of their arrival."""
    runner = OdometryRunner(config)
    for event in events:
        runner.take(event)
    return runner.finish()


def run_bag(
    source: Path, config: OdometryNodeConfig, progress: Progress = lambda share: None
) -> OdometryRun:
    """Return what the odometry makes of a bag.

    Parameters
    ----------
    source : Path
        Rosbag2 folder or MCAP file.
    config : OdometryNodeConfig
        As for the node. A topic that is not in the bag is replaced by the only one of its kind.
    progress : callable
        Told how far it is.

    Raises
    ------
    RecordingError
        If the bag cannot be read, or which topic to use is not plain.
    """
    try:
        with bag.open_bag(source) as reader:
            kinds = {item.topic: item.msgtype for item in reader.connections}
            cloud = bag.chosen(kinds, config.topics.cloud_topic, bag.CLOUD, "cloud_topic")
            imu = ""
            if config.odometry.mode == "inertial":
                imu = bag.chosen(kinds, config.topics.imu_topic, bag.IMU, "imu_topic")
            listener = _Listener(OdometryRunner(config), config, cloud, imu)
            span = max(reader.end_time - reader.start_time, 1)
            for connection, now, data in bag.messages(reader):
                if connection.topic in (cloud, imu) or connection.msgtype == bag.TRANSFORMS:
                    listener.take(
                        connection.topic, reader.deserialize(data, connection.msgtype), now
                    )
                    progress(min(max((now - reader.start_time) / span, 0.0), 1.0))
            return listener.runner.finish()
    except (AnyReaderError, FileNotFoundError) as error:
        raise bag.unreadable(source, error) from None


class _Listener:
    """Turns messages into events, and takes the mounts from /tf_static."""

    def __init__(
        self, runner: OdometryRunner, config: OdometryNodeConfig, cloud: str, imu: str
    ) -> None:
        self.runner = runner
        self._config = config
        self._topics = cloud, imu
        self._frames = FrameTree()
        self._cloud_frame = ""

    def take(self, topic: str, message: Any, now: int) -> None:
        cloud, imu = self._topics
        if topic == cloud:
            self._cloud(message, now)
        elif topic == imu:
            self._mount(message.header.frame_id)
            self.runner.take((now, bag.sample_of(message)))
        elif topic.endswith("tf_static") and self._config.topics.use_tf:
            for parent, child, transform in bag.transforms_of(message):
                self._frames.add(parent, child, transform)

    def _cloud(self, message: Any, now: int) -> None:
        self._cloud_frame = message.header.frame_id
        base = self._config.topics.base_frame
        if base:
            T_cloud_base = self._frames.find(self._cloud_frame, base)
            known = self.runner.base.T_lidar_base
            if T_cloud_base is not None and not np.allclose(T_cloud_base, known):
                self.runner.base = BaseFrame(T_cloud_base)
        try:
            sweep = to_sweep(bag.points_of(message), bag.stamp_of(message))
        except (CloudError, ValueError) as error:
            self.runner.refused[str(error)] += 1
            return
        self.runner.take((now, sweep))

    def _mount(self, imu_frame: str) -> None:
        odometry = self.runner.pipeline.odometry
        if not self._cloud_frame or imu_frame == self._cloud_frame:
            return
        T_cloud_imu = self._frames.find(self._cloud_frame, imu_frame)
        if (
            T_cloud_imu is not None
            and isinstance(odometry, Odometry)
            and not np.allclose(T_cloud_imu, odometry.T_cloud_imu, atol=1e-6)
        ):
            self.runner.pipeline.mount(T_cloud_imu)


def write(run: OdometryRun, folder: Path) -> list[Path]:
    """Write trajectory, map and plot of a run into a folder; return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    names = ("trajectory.tum", "trajectory.kitti", "map.ply", "trajectory.png")
    paths = [folder / name for name in names]
    write_whole(paths[0], tum(run.poses))
    write_whole(paths[1], kitti(run.poses))
    if len(run.map_points):
        map_file.save(paths[2], run.map_points)
    _plot(run, paths[3])
    return [path for path in paths if path.exists()]


def _plot(run: OdometryRun, path: Path) -> None:
    """Draw the way from above over the map."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 8), layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    if len(run.map_points):
        shown = run.map_points[:: max(len(run.map_points) // 20_000, 1)]
        axes.scatter(shown[:, 0], shown[:, 1], s=0.5, c="0.7", linewidths=0)
    axes.plot(run.poses["pose"][:, 0, 3], run.poses["pose"][:, 1, 3], lw=1.5)
    FigureCanvasAgg(figure)
    with whole(path) as part:
        figure.savefig(part)


def main(arguments: list[str] | None = None) -> int:
    """Run from a command line; return the exit code."""
    from rich.progress import Progress as Bar

    parser = argparse.ArgumentParser(prog="l2lidar_proc.verbs.odometry", description=__doc__)
    parser.add_argument("source", type=Path, help="rosbag2 folder or MCAP file")
    parser.add_argument("target", type=Path, help="folder to write to")
    parser.add_argument("--params-file", type=Path, help="parameter file, as for the node")
    given = parser.parse_args(arguments)
    try:
        config = settings_for(given.params_file, "odometry_node", OdometryNodeConfig)
        with Bar() as bar:
            task = bar.add_task("odometry", total=1.0)
            run = run_bag(given.source, config, lambda share: bar.update(task, completed=share))
            bar.update(task, completed=1.0)
        files = write(run, given.target)
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    print(*run.report, *(f"wrote {path}" for path in files), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(interruptible(main))
