"""Input monitor: reports problems with the messages on a node's input topics."""

from __future__ import annotations

import gc
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from importlib import import_module
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.timer import Timer

from l2lidar_node.types import FIRST_STAMP, LAST_STAMP, Check, HostNs, Level, Sweep
from l2lidar_proc.motion.imu_buffer import Samples

_MAX_REASONS: Final = 20  # senders choose field names and numbers, so reasons have no end
_OTHER: Final = "other reasons"
_FRAME_TIMEOUT_S: Final = 0.5  # without a message in its frame a node follows the next frame
_BACK_NS: Final = 5_000_000  # sweeps of a driver that cuts between packets overlap by less
_CLOCK_APART_S: Final = 10.0  # between stamps and the node's clock; /tf keeps 10 s
_SECTORS: Final = 36  # of azimuth
_FLAT_RAD: Final = np.radians(3.0)

T = TypeVar("T")


class FollowedFrame:
    """The frame in which a node accepts the messages of a topic.

    Messages of two sensors on one topic cannot be told apart but by their frames. The node stays
    with the first frame until that one has been silent for half a second.
    """

    def __init__(self) -> None:
        self.name: str | None = None
        self.refused = ""
        self._last_s = 0.0

    def takes(self, frame: str) -> bool:
        """Return whether to use a message in this frame."""
        now = time.monotonic()
        if self.name not in (None, frame) and now - self._last_s < _FRAME_TIMEOUT_S:
            self.refused = frame
            return False
        self.name, self._last_s = frame, now
        return True


class InputMonitor:
    """Checks the input between two diagnostics.

    Parameters
    ----------
    node : Node
    topics : tuple of str
        Input topics, each of which should have one publisher.

    Attributes
    ----------
    clouds, imu : FollowedFrame
    refused : Counter of str
        Messages that could not be used since the start, by reason; at most 20 reasons.
    """

    def __init__(self, node: Node, topics: tuple[str, ...]) -> None:
        self.clouds = FollowedFrame()
        self.imu = FollowedFrame()
        self.refused: Counter[str] = Counter()
        self._node = node
        self._topics = topics
        self._newest: Sweep | None = None  # since the last judgement
        self._latest_end: HostNs | None = None
        self._overlaps = 0
        self._largest_step_ns = 0
        self._failure = ""

    def refuse(self, reason: str) -> None:
        """Count a message that cannot be used."""
        is_known = reason in self.refused or len(self.refused) < _MAX_REASONS
        self.refused[reason if is_known else _OTHER] += 1

    def usable(self, samples: Samples, frame: str) -> Samples:
        """Return the IMU samples (N,) of a frame that are to be used."""
        fits = in_range(samples)
        for _ in range(int(np.count_nonzero(~fits))):
            self.refuse("IMU sample with a stamp that is out of range")
        samples = samples[fits]
        return samples if len(samples) and self.imu.takes(frame) else samples[:0]

    def sweep(self, sweep: Sweep) -> None:
        """Note a sweep that is used, in the order of arrival."""
        self._newest = sweep
        before, self._latest_end = self._latest_end, sweep.end
        if before is not None and sweep.start < before - _BACK_NS:
            self._overlaps += 1
            self._largest_step_ns = max(self._largest_step_ns, before - sweep.start)

    def guarded(
        self, callback: Callable[..., None], recover: Callable[[], None]
    ) -> Callable[..., None]:
        """Return a callback that survives its own errors.

        An unexpected error is logged with its traceback and reported as ERROR in the
        diagnostics; ``recover`` then has the node begin again. The node stays alive.
        """

        @wraps(callback)
        def run(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Exception as error:
                if not self._node.context.ok():
                    raise
                self.failed(error)
                recover()

        return run

    def failed(self, error: Exception) -> None:
        """Report an unexpected error."""
        self._failure = f"internal error, restarted: {type(error).__name__}: {error}"
        self._node.get_logger().error(f"{self._failure}\n{traceback.format_exc()}")

    def judge(self, check: Check, *others: str) -> Check:
        """Return a check of the inputs and other problems, and clear them."""
        problems = [*self._of_topics(), *self._of_frames(), *self._of_times(), *self._of_shape()]
        problems += filter(None, others)
        level = max(check.level, Level.WARN) if problems else check.level
        if self._failure:
            problems.insert(0, self._failure)
            level, self._failure = Level.ERROR, ""
        self._overlaps = self._largest_step_ns = 0
        self._newest = None
        return replace(check, level=level, message="; ".join([check.message, *problems]))

    def _of_topics(self) -> list[str]:
        problems = []
        for topic in self._topics:
            name = self._node.resolve_topic_name(topic)
            infos = self._node.get_publishers_info_by_topic(name)
            if len(infos) > 1:
                who = sorted(f"{i.node_namespace.rstrip('/')}/{i.node_name}" for i in infos)
                more = f" and {len(who) - 4} more" if len(who) > 4 else ""
                problems.append(f"{len(who)} publishers on {name}: {', '.join(who[:4])}{more}")
        return problems

    def _of_frames(self) -> list[str]:
        problems = []
        for kind, frame in (("clouds", self.clouds), ("IMU samples", self.imu)):
            if frame.refused:
                problems.append(
                    f"{kind} in '{frame.refused}' refused while those in '{frame.name}' arrive"
                )
                frame.refused = ""
        return problems

    def _of_times(self) -> list[str]:
        problems = []
        if self._overlaps:
            problems.append(
                f"stamps go back by up to {self._largest_step_ns / 1e6:.0f} ms between clouds "
                f"({self._overlaps} times)"
            )
        is_simulated = self._node.get_parameter("use_sim_time").value
        if is_simulated and not self._node.count_publishers("/clock"):
            problems.append("use_sim_time is on, but there is no publisher of /clock")
        elif self._newest is not None:
            now = self._node.get_clock().now().nanoseconds
            apart = (now - self._newest.end) / 1e9
            if abs(apart) > _CLOCK_APART_S:
                side = "behind" if apart > 0 else "ahead of"
                hint = "" if is_simulated else "; with a recording set use_sim_time"
                problems.append(f"stamps are {abs(apart):.3g} s {side} the node's clock{hint}")
        return problems

    def _of_shape(self) -> list[str]:
        if self._newest is None or not len(self._newest.points):
            return []
        points = self._newest.points
        azimuth = np.arctan2(points["y"], points["x"])
        sectors = np.floor((azimuth / (2.0 * np.pi) + 0.5) * _SECTORS).astype(np.int64)
        covered = len(np.unique(sectors % _SECTORS)) * 360 // _SECTORS
        elevation = np.arctan2(points["z"], np.hypot(points["x"], points["y"]))
        low, high = np.percentile(elevation, (2.0, 98.0))
        if high - low < _FLAT_RAD:
            return ["the points of a cloud lie in one plane, as those of a LaserScan"]
        if covered < 180:
            return [f"the points of a cloud cover {covered} of 360 degrees of azimuth"]
        return []


def in_range(samples: Samples) -> NDArray[np.bool_]:
    """Return which samples (N,) have a stamp that a ROS message can carry, shape (N,)."""
    return (samples["stamp"] >= FIRST_STAMP) & (samples["stamp"] <= LAST_STAMP)


def steady_timer(node: Node, period_s: float, callback: Callable[[], None]) -> Timer:
    """Return a timer that is independent of the host's clock, /clock and replays."""
    return node.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def load_libraries(*names: str) -> None:
    """Import in a thread what the first sweep will need.

    Meanwhile the node is there and answers, and what comes waits in its queues.
    """

    def load() -> None:
        for name in names:
            import_module(name)
        gc.freeze()  # or every full collection walks all of it

    threading.Thread(target=load, name="import", daemon=True).start()


def answer_or_error(
    monitor: InputMonitor, answer: Callable[[Any, Any], T]
) -> Callable[[Any, Any], T]:
    """Return a service's callback that answers an unexpected error with its text."""

    @wraps(answer)
    def run(request: Any, response: Any) -> T:
        try:
            return answer(request, response)
        except Exception as error:
            monitor.failed(error)
            response.success, response.message = False, f"{type(error).__name__}: {error}"
            return response  # type: ignore[no-any-return]  # rclpy has no types

    return run
