"""Odometry of sweeps and samples in the order of their arrival, and of captures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.config import DriverConfig
from l2lidar_node.recording.packet_bag import open_packets
from l2lidar_node.recording.recording import Recording, measurements
from l2lidar_node.settings import build
from l2lidar_node.types import IMU_SAMPLE, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion.imu_corrections import ImuConvention, ImuExtrinsics
from l2lidar_proc.odometry.config import OdometryNodeConfig
from l2lidar_proc.odometry.estimate import BaseFrame, OdometryEstimate, Status
from l2lidar_proc.odometry.pipeline import OdometryPipeline
from l2lidar_proc.recording.outputs import StampedPoses

_END_NS: Final = 2**62
_CAPTURE: Final = {"imu_adjust": False, "sweep_cut": "turn"}

Progress = Callable[[float], None]
"""Told the share of the recording that is done, 0 to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class OdometryRun:
    """Result of the odometry of a recording.

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
    notes : tuple of str
        What was recognized about the recording.
    """

    poses: StampedPoses
    map_points: NDArray[np.float64]
    sweeps: int
    counts: Counter[Status]
    refused: Counter[str]
    notes: tuple[str, ...] = ()

    @property
    def report(self) -> list[str]:
        """Lines of a report for people."""
        return [
            f"{len(self.poses)} poses from {self.sweeps} sweeps",
            *self.notes,
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
    known : ImuConvention, optional
        What is known of the IMU's units and sign.
    rotation : ndarray, shape (3, 3), optional
        IMU axes to cloud axes, in place of what mounts and settings say.
    accelerometer : bool
        False: the accelerometer is watched, for its sign, but not used.

    Attributes
    ----------
    pipeline : OdometryPipeline
    base : BaseFrame
    refused : Counter of str
        Clouds that could not be used, by reason.
    notes : list of str
        What was recognized about the recording.
    """

    def __init__(
        self,
        config: OdometryNodeConfig,
        observer: Observer | None = None,
        *,
        known: ImuConvention | None = None,
        rotation: NDArray[np.float64] | None = None,
        accelerometer: bool = True,
    ) -> None:
        self._observer = observer
        topics = config.topics
        extrinsics = ImuExtrinsics.of(topics)
        if rotation is not None:
            extrinsics = replace(extrinsics, rotation=rotation)
        self.pipeline = OdometryPipeline(
            config.odometry,
            topics.T_cloud_imu,
            topics.imu_wait_ms,
            extrinsics,
            accelerometer=accelerometer,
        )
        if known is not None:
            self.pipeline.convention.adopt(known)
        problem = self.pipeline.extrinsics.problem
        self.notes: list[str] = [problem] if problem else []
        self.base = BaseFrame(np.eye(4))
        self.refused: Counter[str] = Counter()
        self._beams = 0.0, 0.0, 0.0  # correction of xi, beta and alpha [rad]
        self._ranges = 0.0  # correction of the ranges [m]

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
            self._beams = estimate.quality.beam_correction
            self._ranges = estimate.quality.range_correction
            if self._observer is not None:
                self._observer(estimate, self.base)

    def finish(self) -> OdometryRun:
        """Return the result."""
        self._poll(_END_NS)
        found = self.pipeline.trajectory.poses
        poses = self.base.poses(found)
        points = self.pipeline.odometry.map_points()
        if len(found):
            turn = self.base.odom_from_map(found["pose"][0])
            points = points @ turn[:3, :3].T + turn[:3, 3]
        return OdometryRun(
            poses,
            points,
            self.pipeline.sweeps,
            self.pipeline.counts,
            self.refused,
            (*self.notes, *self.pipeline.convention.notes, *self._finding()),
        )

    def _finding(self) -> list[str]:
        """Return what is wrong with IMU, beams and ranges, and what to do."""
        finding = self.pipeline.check.finding
        found = [f"{finding}: l2lidar calibrate imu measures it"] if finding else []
        if any(self._beams):
            xi, beta, alpha = np.degrees(self._beams)
            found.append(
                f"the unit's beams were corrected by {xi:+.2f} degrees (xi), {beta:+.2f} degrees "
                f"(beta) and {alpha:+.2f} degrees (alpha), estimated from the clouds: l2lidar "
                "calibrate still measures them"
            )
        if abs(self._ranges) > tuning.RANGE_BIAS_FLOOR:  # less is no news of a unit
            found.append(
                f"the unit's ranges were corrected by {1e3 * self._ranges:+.0f} mm, estimated "
                "from walls in the clouds: l2lidar calibrate still measures that as well"
            )
        return found


def run_events(
    events: Iterator[Event], config: OdometryNodeConfig, observer: Observer | None = None
) -> OdometryRun:
    """Return the odometry of sweeps and samples in arrival order."""
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
    """Return the odometry of a capture, cut into sweeps of a full turn.

    Parameters
    ----------
    source : Path
        pcap or pcapng file, or a bag of raw packets.
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
    size = max(sum(file.stat().st_size for file in (source, *source.rglob("*"))), 1)
    with open_packets(source) as stream:
        recording = Recording(stream, l2_ip, is_selected=True)

        def taken() -> Iterator[Event]:
            for now, event in measurements(recording, build(DriverConfig, _CAPTURE)):
                if isinstance(event, Sweep):
                    progress(min(recording.position / size, 1.0))
                    yield now, event
                else:
                    yield now, np.array([tuple(event)], IMU_SAMPLE)

        return run_events(taken(), config, observer)
