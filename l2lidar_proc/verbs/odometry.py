"""`l2lidar odometry`: the trajectory of a recording, by the same code as the node."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import Progress as Bar
from rosbags.highlevel import AnyReaderError

from l2lidar_node.command_line import CommandError, UsageError
from l2lidar_node.config import DriverConfig
from l2lidar_node.files import whole, write_whole
from l2lidar_node.recording.pcap import CaptureError, is_capture_file
from l2lidar_node.recording.recording import Recording
from l2lidar_node.recording.replay import measurements
from l2lidar_node.ros.parameter_files import settings_for
from l2lidar_node.settings import build
from l2lidar_node.types import IMU_SAMPLE, Sweep
from l2lidar_proc.cloud import CloudError, to_sweep
from l2lidar_proc.config import OdometryNodeConfig
from l2lidar_proc.motion.frames import FrameTree
from l2lidar_proc.odometry.base_frame import BaseFrame
from l2lidar_proc.odometry.estimate import OdometryEstimate, Status
from l2lidar_proc.odometry.odometry import Odometry
from l2lidar_proc.odometry.pipeline import OdometryPipeline
from l2lidar_proc.recording import bag, map_file
from l2lidar_proc.recording.bag import RecordingError
from l2lidar_proc.recording.trajectory import StampedPoses, kitti, tum

_END_NS: Final = 2**62
_FILES: Final = ("trajectory.tum", "trajectory.kitti", "map.ply", "trajectory.png")
_CAPTURE: Final = {"imu_adjust": False, "sweep_cut": "turn"}

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


Observer = Callable[[OdometryEstimate, BaseFrame], None]
"""Given every estimate, and the frame that is meant by its pose."""

Event = tuple[int, Sweep | NDArray[np.void]]
"""Instant of arrival [ns], and a sweep or IMU samples."""


class OdometryRunner:
    """Feeds a pipeline with the sweeps and samples of any recording.

    Parameters
    ----------
    config : OdometryNodeConfig
    observer : callable, optional
        Given the estimates one by one.
    """

    def __init__(self, config: OdometryNodeConfig, observer: Observer | None = None) -> None:
        self._observer = observer
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
        self._poll(now)

    def _poll(self, now: int) -> None:
        for estimate in self.pipeline.poll(now):
            if self._observer is not None:
                self._observer(estimate, self.base)

    def finish(self) -> OdometryRun:
        """Return what was found."""
        self._poll(_END_NS)
        found = self.pipeline.trajectory.poses
        poses = self.base.poses(found)
        points = self.pipeline.odometry.map_points()
        if len(found):
            turn = self.base.odom_from_map(found["pose"][0])
            points = points @ turn[:3, :3].T + turn[:3, 3]
        return OdometryRun(poses, points, self.pipeline.sweeps, self.pipeline.counts, self.refused)


def run_events(
    events: Iterator[Event], config: OdometryNodeConfig, observer: Observer | None = None
) -> OdometryRun:
    """Return what the odometry makes of sweeps and samples in the order of their arrival."""
    runner = OdometryRunner(config, observer)
    for event in events:
        runner.take(event)
    return runner.finish()


def run_capture(
    source: Path,
    config: OdometryNodeConfig,
    progress: Progress = lambda share: None,
    l2_ip: str = "",
    observer: Observer | None = None,
) -> OdometryRun:
    """Return what the odometry makes of a capture, cut into sweeps of a full turn.

    Parameters
    ----------
    source : Path
        pcap or pcapng file.
    config : OdometryNodeConfig
    progress : callable
        Told how far it is.
    l2_ip : str
        Whose packets; empty if the capture holds those of one unit.
    observer : callable, optional
        Given the estimates one by one.

    Raises
    ------
    CaptureError
        If the capture cannot be read.
    """
    size = max(source.stat().st_size, 1)
    with source.open("rb") as stream:
        recording = Recording(stream, l2_ip)

        def taken() -> Iterator[Event]:
            for now, event in measurements(recording, build(DriverConfig, _CAPTURE)):
                if isinstance(event, Sweep):
                    progress(recording.position / size)
                    yield now, event
                else:
                    yield now, np.array([tuple(event)], IMU_SAMPLE)

        return run_events(taken(), config, observer)


def run_bag(
    source: Path,
    config: OdometryNodeConfig,
    progress: Progress = lambda share: None,
    observer: Observer | None = None,
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
    observer : callable, optional
        Given the estimates one by one.

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
            listener = _Listener(OdometryRunner(config, observer), config, cloud, imu)
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
            self.runner.refused.update(self._frames.take(message))

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
    paths = [folder / name for name in _FILES]
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


def odometry(
    source: Annotated[
        Path,
        typer.Argument(help="rosbag2 folder, MCAP file, or capture (pcap).", exists=True),
    ],
    folder: Annotated[
        Path, typer.Argument(help="Folder for trajectory (TUM and KITTI), map and plot.")
    ] = Path("out/odometry"),
    params_file: Annotated[
        Path | None, typer.Option(help="Parameter file, as for odometry_node.", exists=True)
    ] = None,
    l2_ip: Annotated[
        str, typer.Option(help="Whose packets, if a capture holds those of several units.")
    ] = "",
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace what an earlier run left in the folder.")
    ] = False,
) -> None:
    """Estimate the trajectory of the sensor through a recording, as odometry_node does live.

    The trajectory in TUM format is what evo reads. The poses are those of the cloud frame, or of
    the base frame where one is set. A capture is cut into sweeps of a full turn.
    """
    taken = [folder / name for name in _FILES if (folder / name).exists()]
    if taken and not overwrite:
        raise UsageError(
            f"{taken[0]} is there already, of an earlier run; name another folder or add "
            "--overwrite"
        )
    try:
        config = settings_for(params_file, "odometry_node", OdometryNodeConfig)
    except ValueError as error:
        raise UsageError(str(error)) from None
    try:
        folder.mkdir(parents=True, exist_ok=True)  # or a long run would end with nowhere to write
        with Bar() as bar:
            task = bar.add_task("odometry", total=1.0)

            def progress(share: float) -> None:
                bar.update(task, completed=share)

            if is_capture_file(source):
                run = run_capture(source, config, progress, l2_ip)
            else:
                run = run_bag(source, config, progress)
            progress(1.0)
        files = write(run, folder)
    except RecordingError as error:
        raise CommandError(str(error)) from None
    except CaptureError as error:
        raise CommandError(f"{source}: {error}") from None
    except OSError as error:
        raise CommandError(f"{error.filename or source}: {error.strerror}") from None
    for line in [*run.report, *(f"wrote {path}" for path in files)]:
        typer.echo(line)
    if not len(run.poses):
        raise CommandError("no pose was found: are there clouds with times, and IMU samples?")
