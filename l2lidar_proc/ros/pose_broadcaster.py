"""Publishes poses of sweeps, and poses propagated by the IMU between them.

Registering a sweep takes 50 ms, on a small computer 150. A controller wants a pose every 20 ms
all the while, so these come from the thread that takes the IMU's messages.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from l2lidar_node import records, rotations
from l2lidar_node.types import F64, HostNs
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.odometry.config import OdometryTopics
from l2lidar_proc.odometry.estimate import BaseFrame, OdometryEstimate
from l2lidar_proc.odometry.prediction import DeadReckoning
from l2lidar_proc.ros import odometry_messages as messages

_JITTER_NS: Final = 2_000_000  # a step may come half an IMU period early, or it would miss one
_TIME_JUMP_NS: Final = 1_000_000_000  # stamps older than the latest by more: time was set back
_MOST_BATCHES: Final = 250  # that are kept; 1 s needs 50
_MOST_SAMPLES: Final = 250  # of a batch, whatever their stamps are


class PoseBroadcaster:
    """Publishes transforms and the fast odometry; thread-safe.

    Parameters
    ----------
    topics : callable
        Returns the settings.
    base_name : callable
        Returns the name of the frame that moves.
    transforms : Publisher
        Of ``TFMessage``.
    fast : Publisher
        Of the ``Odometry`` at IMU samples.
    gap_ns : int
        Longest gap between samples, as of :class:`DeadReckoning`.
    is_free : callable
        Given parent and child, returns whether a transform between them may be published.
    """

    def __init__(
        self,
        topics: Callable[[], OdometryTopics],
        base_name: Callable[[], str],
        transforms: Any,
        fast: Any,
        gap_ns: int,
        is_free: Callable[[str, str], bool],
    ) -> None:
        self._topics = topics
        self._base_name = base_name
        self._transforms = transforms
        self._fast = fast
        self._lock = threading.Lock()
        self._base = BaseFrame(np.eye(4))
        self._gap_ns = gap_ns
        self._is_free = is_free
        self._reckoning = DeadReckoning(np.eye(4), gap_ns)
        self._recent: deque[Samples] = deque(maxlen=_MOST_BATCHES)
        self._pending: list[Samples] = []  # those of the recent that wait for the next step
        self._newest = HostNs(0)  # stamp of a sample
        self._reckoned_ns = self._transform_ns = 0

    def mount(self, T_cloud_imu: F64) -> None:
        """Take the place of the IMU on the sensor (4, 4); go on from the next sweep."""
        with self._lock:
            self._reckoning = DeadReckoning(T_cloud_imu, self._gap_ns)

    def reset(self) -> None:
        """Forget samples and estimate."""
        with self._lock:
            self._reckoning.reset(None)
            self._recent.clear()
            self._pending.clear()

    def take(self, samples: Samples) -> None:
        """Take IMU samples (N,), oldest first, and publish the poses that are due."""
        if not len(samples):
            return
        with self._lock:
            first = int(samples["stamp"][0])
            if abs(first - self._newest) > _TIME_JUMP_NS:
                self._recent.clear()
                self._pending.clear()
            self._newest = HostNs(int(samples["stamp"][-1]))
            self._recent.append(samples[-_MOST_SAMPLES:])
            self._pending.append(samples)
            self._carry_on()

    def catch_up(self) -> None:
        """Publish the pose at the newest sample in any case."""
        with self._lock:
            self._carry_on(at_once=True)

    def sweep(self, estimate: OdometryEstimate, base: BaseFrame) -> None:
        """Publish the transform of a sweep, unless /tf already has a later one."""
        with self._lock:
            self._base = base
            self._send(base.motion(estimate).T_odom_base, estimate.stamp)

    def go_on_from(self, estimate: OdometryEstimate | None) -> None:
        """Carry on from an estimate at some sample, or from none."""
        with self._lock:
            self._reckoning.reset(estimate)
            if estimate is None or not self._recent:
                return
            # What came while the sweep was registered moves the new estimate, too.
            samples = records.joined(self._recent)
            samples = samples[samples["stamp"] > estimate.stamp]
            is_known = samples["stamp"] <= self._reckoned_ns
            for step in self._steps(samples[is_known]):
                self._reckoning.carry(step)
            self._pending = [samples[~is_known]]
            while len(self._recent) > 1 and self._recent[0]["stamp"][-1] <= estimate.stamp:
                self._recent.popleft()

    def _steps(self, samples: Samples) -> list[Samples]:
        """Return samples (N,) in steps as long as between two poses that are published."""
        if not len(samples):
            return []
        past = (samples["stamp"] - samples["stamp"][0]) // self._step_ns
        return np.split(samples, np.flatnonzero(np.diff(past)) + 1)

    @property
    def _step_ns(self) -> int:
        return max(round(1e9 / self._topics().imu_rate) - _JITTER_NS, 1)

    def _carry_on(self, at_once: bool = False) -> None:
        """Publish poses at the samples that wait, ``imu_rate`` times a second of their time."""
        if not self._pending or self._topics().imu_rate <= 0.0:
            self._pending.clear()
            return
        samples = records.joined(self._pending)
        self._pending.clear()
        step_ns = self._step_ns
        first = 0
        for last, stamp in enumerate(samples["stamp"].tolist()):
            is_due = not 0 <= stamp - self._reckoned_ns < step_ns
            if is_due or (at_once and last == len(samples) - 1):
                self._reckon(samples[first : last + 1])
                first = last + 1
        if first < len(samples):
            self._pending.append(samples[first:][-_MOST_SAMPLES:])

    def _reckon(self, samples: Samples) -> None:
        """Publish the pose at the last of some samples (N,)."""
        self._reckoned_ns = int(samples["stamp"][-1])
        pose = self._reckoning.carry(samples)
        if pose is None:
            return
        self._send(self._base.pose(pose), self._reckoning.stamp)
        if self._fast.get_subscription_count():
            odom = self._topics().odom_frame
            estimate = self._reckoning.estimate
            motion = self._base.motion(estimate)
            message = messages.odometry(motion, estimate.stamp, odom, self._base_name())
            self._fast.publish(message)

    def _send(self, T_odom_base: F64, stamp: HostNs) -> None:
        topics = self._topics()
        # A sweep may be seconds late on a busy machine; only where the samples went back as well
        # has time itself.
        newest = max(self._newest, stamp) if self._recent else stamp
        is_late = stamp <= self._transform_ns < newest + _TIME_JUMP_NS
        if not topics.publish_tf or is_late:
            return
        frames = topics.odom_frame, self._base_name()
        if topics.invert_tf:
            T_odom_base, frames = rotations.inverse(T_odom_base), frames[::-1]
        if not self._is_free(*frames):
            return
        self._transform_ns = stamp
        made = messages.transform(T_odom_base, stamp, *frames)
        self._transforms.publish(made)
