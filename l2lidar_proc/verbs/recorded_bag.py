"""Odometry of bags, as the drivers of any maker record them.

What they leave out or do differently is recognized: topics, mounts, units and signs, clocks.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection

from l2lidar_node import rotations
from l2lidar_node.frames import FrameTree
from l2lidar_node.types import HostNs
from l2lidar_proc.cloud import CloudError, to_sweep
from l2lidar_proc.motion.gyro_alignment import CoarseRotation, coarse_rotation
from l2lidar_proc.motion.imu_corrections import ImuConvention
from l2lidar_proc.odometry.config import OdometryNodeConfig, OdometryTopics
from l2lidar_proc.odometry.estimate import BaseFrame, Status
from l2lidar_proc.recording import bag
from l2lidar_proc.verbs.recorded import Observer, OdometryRun, OdometryRunner, Progress

_LOOK_AHEAD_NS: Final = 2_000_000_000
_UPRIGHT: Final = 0.5  # cosine of the angle between the clouds' z and up
_SAME_CLOCK_S: Final = 1.0  # apart at most; buffers and networks delay messages by less
_ENOUGH_SAMPLES: Final = 10  # no gyro gives 0.0 about all axes in so many
_SIGN_S: Final = 20.0  # of a recording in which the accelerometer's sign is looked for
_AXES_S: Final = 30.0  # of a recording in which the IMU's axes are looked for
_DOUBTFUL_SHARE: Final = 0.2  # of the sweeps, with which they are. Right axes leave 0.0 to 0.05


def run_bag(
    source: Path,
    config: OdometryNodeConfig,
    progress: Progress = lambda share: None,
    observer: Observer | None = None,
) -> OdometryRun:
    """Return the odometry of a bag.

    Parameters
    ----------
    source : Path
        Rosbag2 folder or MCAP file.
    config : OdometryNodeConfig
        As for the node. A topic that is not in the bag is replaced by the only one of its kind;
        of several IMUs the only one in the namespace of the clouds is taken. Without any IMU the
        odometry runs on clouds alone. Livox's own messages are clouds as well.
    progress : callable
        Told how far it is.
    observer : callable, optional
        Given the estimates one by one.

    Raises
    ------
    RecordingError
        If the bag cannot be read, or which topic to use is not plain.
    """
    with bag.opened(source) as reader:
        kinds = bag.kinds_of(reader)
        cloud = bag.chosen(kinds, config.topics.cloud_topic, bag.CLOUDS, "cloud_topic")
        imu = ""
        if config.odometry.mode == "inertial":
            imu = _imu_topic(kinds, config.topics.imu_topic, cloud)

        def listener(runner: OdometryRunner) -> _Listener:
            made = _Listener(runner, config, cloud, imu)
            made.look_ahead(reader)
            return made

        final = _followed(reader, listener, config, progress, observer)
        if final.may_be_turned:
            axes = _axes_of_imu(reader, config, cloud, final)
            if axes is not None and not axes.is_clear and axes.contradicts_drawn:
                final.runner.notes.append(
                    "the gyro does not turn as the clouds do: set imu_rpy to how the IMU's axes "
                    "lie in those of the clouds; longer turns about two axes would show it"
                )
            elif axes is not None and axes.is_clear:
                # an observer has seen how the odometry failed: with one, it has to be run again
                if observer is None:
                    final = _followed(reader, listener, config, progress, None, axes.matrix)
                final.runner.notes.append(_axes_note(axes.matrix, is_used=observer is None))
        return final.finish()


def _followed(
    reader: AnyReader,
    listener: Callable[[OdometryRunner], _Listener],
    config: OdometryNodeConfig,
    progress: Progress,
    observer: Observer | None,
    rotation: NDArray[np.float64] | None = None,
) -> _Listener:
    """Return a listener that has heard all of a bag, with sign and units of the IMU as found."""
    known = ImuConvention()
    final = listener(OdometryRunner(config, observer, rotation=rotation))
    while final.may_be_opposite and not known.reversed:
        trial = listener(
            OdometryRunner(config, known=known, rotation=rotation, accelerometer=False)
        )
        if _heard(reader, trial, until_s=_SIGN_S):
            break
        known.adopt(trial.runner.pipeline.convention)
        final = listener(OdometryRunner(config, observer, known=known, rotation=rotation))
    # an observer cannot be told the same twice: for it a new map begins in between
    while not _heard(reader, final, progress, stops=observer is None):
        # it took down for up, or degrees for radians: from the beginning
        known.adopt(final.runner.pipeline.convention)
        final = listener(OdometryRunner(config, known=known, rotation=rotation))
    return final


def _axes_of_imu(
    reader: AnyReader, config: OdometryNodeConfig, cloud: str, failed: _Listener
) -> CoarseRotation | None:
    """Return how an IMU lies in the clouds' axes; None if it is as assumed, or does not show.

    The clouds alone are followed through the first seconds, and their turns compared with the
    gyro's.
    """
    poses: list[tuple[int, NDArray[np.float64]]] = []
    plain = replace(config, odometry=replace(config.odometry, mode="plain"))
    alone = OdometryRunner(plain, lambda item, _: poses.append((item.stamp, item.T_map_lidar)))
    _heard(reader, _Listener(alone, plain, cloud, ""), until_s=_AXES_S)
    samples = []
    for connection, now, data in bag.messages(reader):
        if now > reader.start_time + _AXES_S * 1e9:
            break
        if connection.topic == failed.imu:
            message = bag.message_of(reader, connection, data)
            if message is not None:
                samples.append(bag.sample_of(message))
    if not samples or not poses:
        return None
    ordered = np.concatenate(samples)
    ordered = ordered[np.argsort(ordered["stamp"], kind="stable")]
    return coarse_rotation(
        np.array([stamp for stamp, _ in poses], np.int64),
        np.array([rotations.from_matrix(pose[:3, :3]) for _, pose in poses]),
        failed.runner.pipeline.corrected(ordered),
    )


def _axes_note(rotation: NDArray[np.float64], *, is_used: bool) -> str:
    rpy = [round(angle) for angle in np.degrees(rotations.to_rpy(rotation)).tolist()]
    advice = (
        "and used; set it in the parameter file of a live node"
        if is_used
        else "but not used: set it in a parameter file (--params-file), and run again"
    )
    return (
        f"the IMU's axes are turned against those of the clouds: imu_rpy {rpy} was found by "
        f"comparing their turns, {advice}"
    )


def _heard(
    reader: AnyReader,
    listener: _Listener,
    progress: Progress = lambda share: None,
    until_s: float = np.inf,
    *,
    stops: bool = True,
) -> bool:
    """Pass a bag's messages on; return False if sign or unit of the IMU were found wrong.

    Then it stops at once, if it ``stops`` at all; else it goes on with a new map.
    """
    span = max(reader.end_time - reader.start_time, 1)
    convention = listener.runner.pipeline.convention
    known = convention.reversed, convention.in_degrees
    for connection, now, data in bag.messages(reader):
        if now > reader.start_time + until_s * 1e9:
            break
        if connection.msgtype in bag.LIVOX and connection.topic == listener.cloud:
            listener.livox(data, now, cdr=reader.is2)
        elif (
            connection.topic in (listener.cloud, listener.imu)
            or connection.msgtype == bag.TRANSFORMS
        ):
            message = listener.read(reader, connection, data)
            if message is not None:
                listener.take(connection.topic, message, now)
        else:
            continue
        if stops and (convention.reversed, convention.in_degrees) != known:
            return False
        progress(min(max((now - reader.start_time) / span, 0.0), 1.0))
    return True


def _imu_topic(kinds: dict[str, str], wanted: str, cloud: str) -> str:
    """Return the topic of the IMU that belongs to the clouds, empty where there is no IMU."""
    found = [topic for topic, its in kinds.items() if its == bag.IMU]
    if not found:
        return ""
    beside = [topic for topic in found if topic.rpartition("/")[0] == cloud.rpartition("/")[0]]
    if wanted not in found and len(beside) == 1:
        return beside[0]
    return bag.chosen(kinds, wanted, bag.IMU, "imu_topic")


class _Clock:
    """What the messages of a topic show of the clock of their stamps.

    Attributes
    ----------
    count : int
        Messages.
    first : int
        Stamp of the first one [ns].
    advances : bool
        Whether another one has another stamp.
    least_delay : int or None
        From the stamp of what was measured to its recording [ns].
    """

    def __init__(self) -> None:
        self.count = 0
        self.first = 0
        self.advances = False
        self.least_delay: int | None = None

    def note(self, stamp: int) -> None:
        if not self.count:
            self.first = stamp
        self.count += 1
        self.advances |= stamp != self.first

    def note_delay(self, delay: int) -> None:
        known = self.least_delay
        self.least_delay = delay if known is None else min(delay, known)


class _Listener:
    """Converts messages to events, and reads the mounts from /tf_static.

    Parameters
    ----------
    runner : OdometryRunner
    config : OdometryNodeConfig
    cloud, imu : str
        Topics; ``imu`` is empty where there is none.
    """

    def __init__(
        self, runner: OdometryRunner, config: OdometryNodeConfig, cloud: str, imu: str
    ) -> None:
        self.runner = runner
        self.cloud = cloud
        self.imu = imu
        self._config = config
        self._frames = FrameTree()
        self._cloud_frame = ""
        self._imu_frame = ""
        self._is_mounted = False
        self._force = np.zeros(3)
        self._samples = 0  # of those looked at in advance
        self._turns = False  # whether one of them has a rate
        self._mute = ""  # topic of an IMU without rates
        self._snapshots = 0
        self._clocks: defaultdict[str, _Clock] = defaultdict(_Clock)  # by topic
        self._damaged: Counter[str] = Counter()  # messages, by topic

    def look_ahead(self, reader: AnyReader) -> None:
        """Learn frames and mounts from the first seconds: a later mount begins a new map."""
        for connection, now, data in bag.messages(reader):
            if now > reader.start_time + _LOOK_AHEAD_NS:
                break
            if connection.topic == self.cloud and connection.msgtype in bag.LIVOX:
                with suppress(ValueError):
                    self._cloud_frame = bag.livox_points(data, cdr=reader.is2)[0]
            elif connection.topic in (self.cloud, self.imu):
                message = bag.message_of(reader, connection, data)
                if message is None:
                    continue
                if connection.topic == self.cloud:
                    self._cloud_frame = message.header.frame_id
                else:
                    self._imu_frame = message.header.frame_id
                    sample = bag.sample_of(message)
                    self._samples += 1
                    self._turns |= bool(sample["angular_velocity"].any())
                    force = sample["linear_acceleration"][0]
                    if np.isfinite(force).all():
                        self._force = self._force + force
            elif self._tells_mounts(connection.topic, connection.msgtype):
                message = bag.message_of(reader, connection, data)
                if message is not None:
                    self._frames.take(message)
            if self._cloud_frame and self._imu_frame and not self._is_mounted:
                self._mount(self._imu_frame)
        if self._samples >= _ENOUGH_SAMPLES and not self._turns:
            self.imu, self._mute = "", self.imu

    @property
    def may_be_opposite(self) -> bool:
        """Whether the clouds' z does not point up, if the accelerometer is to be believed.

        Sensors are seldom mounted like that: then their motion has to tell whether it is so.
        """
        if not self._force.any():
            return False
        T_cloud_imu = self.runner.pipeline.odometry.T_cloud_imu
        up = T_cloud_imu[:3, :3] @ self._force / np.linalg.norm(self._force)
        return bool(up[2] < _UPRIGHT)

    @property
    def may_be_turned(self) -> bool:
        """Whether the odometry failed, and nothing tells how the IMU's axes lie."""
        topics, pipeline = self._config.topics, self.runner.pipeline
        is_told = any(topics.imu_rpy) or pipeline.extrinsics.rotation is not None
        is_told |= self._is_mounted and self._imu_frame != self._cloud_frame
        if is_told or not self.imu or self._config.odometry.mode != "inertial":
            return False
        failed = max(pipeline.counts[status] for status in (Status.SUSPECT, Status.UNMATCHED))
        return failed > _DOUBTFUL_SHARE * pipeline.sweeps

    def read(self, reader: AnyReader, connection: Connection, data: bytes) -> Any:
        """Return a message, None if it is damaged; then it is counted."""
        message = bag.message_of(reader, connection, data)
        if message is None:
            self._damaged[connection.topic] += 1
        return message

    def take(self, topic: str, message: Any, now: int) -> None:
        if topic == self.cloud:
            self._sweep(
                message.header.frame_id, bag.stamp_of(message), now, lambda: bag.points_of(message)
            )
        elif topic == self.imu:
            self._mount(message.header.frame_id)
            samples = bag.sample_of(message)
            stamp = int(samples["stamp"][0])
            self._clocks[topic].note(stamp)
            self._clocks[topic].note_delay(now - stamp)
            self.runner.take((now, samples))
        elif self._tells_mounts(topic, bag.TRANSFORMS):
            self.runner.refused.update(self._frames.take(message))

    def livox(self, data: bytes, now: int, *, cdr: bool) -> None:
        """Take one of Livox's own messages."""
        try:
            frame, stamp, points = bag.livox_points(data, cdr=cdr)
        except ValueError as error:
            self.runner.refused[str(error)] += 1
            return
        self._sweep(frame, stamp, now, lambda: points)

    def finish(self) -> OdometryRun:
        """Return the result and the remarks on the recording."""
        notes = self.runner.notes
        if self._config.odometry.mode == "inertial":
            if self._mute:
                notes.append(
                    f"the IMU on '{self._mute}' measures no angular velocity (all of it is 0): it "
                    "is not used, and the motion comes from the clouds alone"
                )
            elif not self.imu:
                notes.append("no IMU in the recording: the motion comes from the clouds alone")
            elif self._imu_frame and self._imu_frame == self._cloud_frame:
                place = "its origin" if self._is_mounted else "imu_xyz"
                notes.append(
                    f"IMU and clouds have the same frame '{self._imu_frame}': the IMU is taken to "
                    f"be at {place}"
                )
            elif self._imu_frame and self._cloud_frame and not self._is_mounted:
                notes.append(
                    f"no transform from '{self._imu_frame}' to '{self._cloud_frame}' in "
                    "/tf_static: the position of the IMU is imu_xyz, and its axes are those of "
                    "the clouds; if they are not, set imu_rpy in a parameter file (--params-file)"
                )
        standing = self._standing_clocks()
        notes += standing
        is_inertial = self._config.odometry.mode == "inertial"
        if is_inertial and not standing and (problem := self._two_clocks()):
            notes.append(problem)
        if self._snapshots:
            notes.append(
                f"{self._snapshots} clouds without a time per point: each is taken as "
                "measured at its stamp"
            )
        notes += [
            f"{count} damaged messages on '{topic}' were left out"
            for topic, count in self._damaged.items()
        ]
        return self.runner.finish()

    def _standing_clocks(self) -> list[str]:
        """Return which topics have messages of one and the same stamp."""
        return [
            f"all {clock.count} messages on '{topic}' have the stamp {clock.first / 1e9:.3f} s: "
            "they cannot be used, since nothing tells when each was measured; let the driver "
            "stamp them"
            for topic, clock in self._clocks.items()
            if clock.count > 1 and not clock.advances
        ]

    def _two_clocks(self) -> str:
        """Return that the stamps of clouds and IMU are of two clocks; empty if they are not."""
        delays = (self._clocks[self.cloud].least_delay, self._clocks[self.imu].least_delay)
        if delays[0] is None or delays[1] is None:
            return ""
        apart_s = (delays[0] - delays[1]) / 1e9
        if abs(apart_s) < _SAME_CLOCK_S:
            return ""
        pipeline = self.runner.pipeline
        are_unused = 2 * pipeline.counts[Status.NO_IMU] > pipeline.sweeps
        outcome = (
            "no sample belongs to a cloud, and the motion comes from the clouds alone"
            if are_unused
            else "unless they were recorded so late, the samples are those of other instants, and "
            "the trajectory is wrong"
        )
        return (
            f"the stamps of '{self.imu}' are {abs(apart_s):.1f} s "
            f"{'ahead of' if apart_s > 0.0 else 'behind'} those of '{self.cloud}', compared with "
            f"the times of recording: {outcome}; record both with the stamps of one clock (the "
            "host's, or PTP)"
        )

    def _tells_mounts(self, topic: str, msgtype: str) -> bool:
        is_static = msgtype == bag.TRANSFORMS and topic.endswith("tf_static")
        return is_static and self._config.topics.use_tf

    def _sweep(
        self, frame: str, stamp: HostNs, now: int, points: Callable[[], NDArray[np.void]]
    ) -> None:
        self._cloud_frame = frame
        self._clocks[self.cloud].note(stamp)
        base = self._config.topics.base_frame
        if base:
            T_cloud_base = self._frames.find(self._cloud_frame, base)
            known = self.runner.base.T_lidar_base
            if T_cloud_base is not None and not np.allclose(T_cloud_base, known):
                self.runner.base = BaseFrame(T_cloud_base)
        try:
            unit = self._config.topics.time_unit
            sweep = to_sweep(points(), stamp, unit, snapshots=True)
        except (CloudError, ValueError) as error:
            self.runner.refused[str(error)] += 1
            return
        self._snapshots += sweep.start == sweep.end
        self._clocks[self.cloud].note_delay(now - sweep.end)
        self.runner.take((now, sweep))

    def _mount(self, imu_frame: str) -> None:
        self._imu_frame = imu_frame
        if not self._cloud_frame:
            return
        T_cloud_imu = self._frames.find(self._cloud_frame, imu_frame)
        if imu_frame == self._cloud_frame:
            # a place that was set by hand counts more than a frame's name
            is_set = self._config.topics.imu_xyz != OdometryTopics().imu_xyz
            T_cloud_imu = None if is_set else np.eye(4)
        if T_cloud_imu is None:
            return
        self._is_mounted = True
        if not self.runner.pipeline.is_mounted(T_cloud_imu):
            self.runner.pipeline.mount(T_cloud_imu)
