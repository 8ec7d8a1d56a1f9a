"""Subscriptions to clouds and IMU samples, parsed once for one node or two.

The IMU subscription stays out of the executor's wait set: at 250 messages a second, waking up for
each costs more than all the work on them. Its queue is drained when a cloud arrives, on a
slow timer, and on a fast one while a sweep waits for its last samples. A thread drains it as well
if a listener wants samples while the executor is busy with a cloud.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from itertools import groupby
from operator import attrgetter
from typing import Any, Final, NamedTuple, Protocol

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from sensor_msgs.msg import Imu, PointCloud2

from l2lidar_node import records
from l2lidar_node.types import Sweep
from l2lidar_proc.cloud import CloudError, to_sweep
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.ros import serialized
from l2lidar_proc.ros.inputs import steady_timer
from l2lidar_proc.ros.serialized import Cloud, ImuBatch

# A node that is held up for some seconds catches up at once: better late than a hole in the map.
CLOUD_DEPTH: Final = 30
IMU_DEPTH: Final = 2000
_AHEAD: Final = 4  # clouds that are taken out of their queue at once, to know how many wait

SLOW_LOOK_S: Final = 0.25
"""Period of reading the IMU's queue while no sweep waits."""

_WAIT_S: Final = 0.003  # between looks while a sweep waits for its last samples

RELIABILITY: Final = {
    "best_effort": ReliabilityPolicy.BEST_EFFORT,
    "reliable": ReliabilityPolicy.RELIABLE,
}


class ReceivedCloud:
    """A cloud, turned into a sweep at most once per unit of its times.

    Attributes
    ----------
    cloud : Cloud
    backlog : int
        How many later clouds have come already, counted up to 3.
    """

    def __init__(self, cloud: Cloud, backlog: int = 0) -> None:
        self.cloud = cloud
        self.backlog = backlog
        self._sweeps: dict[str, Sweep | CloudError] = {}

    def sweep(self, unit: str = "auto", *, snapshots: bool = False) -> Sweep:
        """Return the cloud as a sweep; see :func:`l2lidar_proc.cloud.to_sweep`.

        Raises
        ------
        CloudError
        """
        points, stamp, _ = self.cloud
        if unit not in self._sweeps:
            try:
                self._sweeps[unit] = to_sweep(points, stamp, unit, snapshots=True)
            except CloudError as error:
                self._sweeps[unit] = error
        found = self._sweeps[unit]
        if isinstance(found, CloudError):
            raise found
        # a snapshot has no times: raise for a caller that needs them
        return found if snapshots or found.start < found.end else to_sweep(points, stamp, unit)


class Listener(Protocol):
    """What receives the clouds and samples."""

    @property
    def is_waiting(self) -> bool:
        """Whether a sweep waits for IMU samples."""

    def take_samples(self, samples: Samples, frame: str) -> None:
        """Take IMU samples (N,) of a frame."""

    def take_cloud(self, item: ReceivedCloud) -> None:
        """Take a cloud."""

    def refuse_cloud(self, error: ValueError) -> None:
        """Take note of a cloud that could not be read."""

    def advance(self) -> None:
        """Publish finished results."""


class NeverExecuted(CallbackGroup):
    """Keeps its entities out of the executor's wait set; their owner takes the messages."""

    def can_execute(self, entity: Any) -> bool:
        """Return False."""
        del entity
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Return False."""
        del entity
        return False

    def ending_execution(self, entity: Any) -> None:
        """Do nothing."""


Guard = Callable[[Callable[..., None]], Callable[..., None]]


class _Feed(NamedTuple):
    """The guarded callbacks of a listener."""

    samples: Callable[..., None]
    cloud: Callable[..., None]
    refusal: Callable[..., None]
    advance: Callable[..., None]


class _Entities(NamedTuple):
    """Subscriptions and timers."""

    imu: Subscription
    clouds: Subscription
    look: Timer
    soon: Timer


class SensorSubscriptions:
    """Subscriptions to a cloud topic and an IMU topic, held while there is a listener.

    Parameters
    ----------
    node : Node
        Owns subscriptions and timers.
    cloud_topic, imu_topic : str
    reliability : str
        Asked of both: "best_effort" or "reliable".
    period_s : float
        Between the looks of the thread into the IMU's queue.
    """

    def __init__(
        self,
        node: Node,
        cloud_topic: str,
        imu_topic: str,
        reliability: str,
        period_s: float = SLOW_LOOK_S,
    ) -> None:
        self._node = node
        self._topics = cloud_topic, imu_topic
        self._reliability = RELIABILITY[reliability]
        self._period_s = period_s
        self._queue = threading.Lock()  # held while the IMU's messages are taken
        self._taken: deque[ImuBatch] = deque(maxlen=IMU_DEPTH)  # and not handed out yet
        self._clouds: deque[bytes] = deque()  # messages that wait
        self._fast: dict[Listener, Callable[..., None]] = {}
        self._thread: tuple[threading.Thread, threading.Event] | None = None
        self._listeners: list[Listener] = []
        self._feeds: list[_Feed] = []
        self._open: _Entities | None = None

    @property
    def entities(self) -> list[Any]:
        """Subscriptions and timers that there are at the moment."""
        return list(self._open) if self._open is not None else []

    def add(
        self,
        listener: Listener,
        guard: Guard,
        *,
        is_first: bool = False,
        fast: Callable[[Samples, str], None] | None = None,
    ) -> None:
        """Feed a listener.

        Parameters
        ----------
        listener : Listener
        guard : callable
            Makes a callback survive its own errors: one listener must not stop another.
        is_first : bool
            Feed it before the others rather than after them.
        fast : callable, optional
            Gets the samples as well, earlier: from a thread, also while a cloud is worked on.
            It must survive its own errors.
        """
        feed = _Feed(
            guard(listener.take_samples),
            guard(listener.take_cloud),
            guard(listener.refuse_cloud),
            guard(listener.advance),
        )
        at = 0 if is_first else len(self._feeds)
        self._listeners.insert(at, listener)
        self._feeds.insert(at, feed)
        if self._open is None:
            self._open = self._subscribed()
        if fast is not None:
            self._fast[listener] = fast
            self._start_thread()

    def remove(self, listener: Listener) -> None:
        """Feed a listener no more."""
        if listener not in self._listeners:
            return
        at = self._listeners.index(listener)
        del self._listeners[at], self._feeds[at]
        if self._fast.pop(listener, None) is not None and not self._fast:
            self._stop_thread()
        if not self._listeners and self._open is not None:
            node, opened = self._node, self._open
            with self._queue:
                self._open = None
            self._taken.clear()
            self._clouds.clear()
            node.destroy_timer(opened.soon)
            node.destroy_timer(opened.look)
            node.destroy_subscription(opened.clouds)
            node.destroy_subscription(opened.imu)

    def _subscribed(self) -> _Entities:
        node, (cloud_topic, imu_topic) = self._node, self._topics
        imu = node.create_subscription(
            Imu,
            imu_topic,
            lambda message: None,
            QoSProfile(depth=IMU_DEPTH, reliability=self._reliability),
            callback_group=NeverExecuted(),
            raw=True,
        )
        clouds = node.create_subscription(
            PointCloud2,
            cloud_topic,
            self._cloud,
            QoSProfile(depth=CLOUD_DEPTH, reliability=self._reliability),
            raw=True,
        )
        look = steady_timer(node, SLOW_LOOK_S, self.look)
        soon = steady_timer(node, _WAIT_S, self.look)
        soon.cancel()
        return _Entities(imu, clouds, look, soon)

    def drain(self) -> None:
        """Hand out the IMU samples that have come."""
        self._take()
        taken = [self._taken.popleft() for _ in range(len(self._taken))]
        # listeners work per batch, hardly per sample: join what came in several
        for frame, batches in groupby(taken, key=attrgetter("frame")):
            samples = records.joined([batch.samples for batch in batches])
            for feed in self._feeds:
                feed.samples(samples, frame)

    def _take(self) -> None:
        """Take the IMU's messages out of their queue; the executor and the thread do."""
        with self._queue:
            if self._open is None:
                return
            messages = [bytes(message) for message in waiting(self._open.imu, IMU_DEPTH)]
            for batch in serialized.imu_batches(messages):
                for fast in list(self._fast.values()):
                    fast(*batch)
                self._taken.append(batch)

    def _start_thread(self) -> None:
        if self._thread is not None:
            return
        stopped = threading.Event()

        def run() -> None:
            try:
                while not stopped.wait(self._period_s):
                    self._take()
            except Exception:
                if self._node.context.ok():  # else ROS was shut down meanwhile
                    raise

        thread = threading.Thread(target=run, name="imu", daemon=True)
        self._thread = thread, stopped
        thread.start()

    def _stop_thread(self) -> None:
        if self._thread is not None:
            thread, stopped = self._thread
            stopped.set()
            thread.join()
            self._thread = None

    def look(self) -> None:
        """Pass on new messages, and let the listeners publish finished results."""
        self.drain()
        if self._clouds:
            self._hand_out(self._clouds.popleft())
        for feed in self._feeds:
            feed.advance()
        if self._open is None:
            return
        if self._clouds or any(listener.is_waiting for listener in self._listeners):
            self._open.soon.reset()
        else:
            self._open.soon.cancel()

    def _cloud(self, message: bytes) -> None:
        """Take a cloud and all that wait behind it, and handle the first.

        Listeners are told how many wait. The others are handled one by one, so that services and
        timers get their turn between two of them.
        """
        self._clouds.append(message)
        if self._open is not None:
            self._clouds.extend(waiting(self._open.clouds, _AHEAD - len(self._clouds)))
        self.look()

    def _hand_out(self, message: bytes) -> None:
        try:
            item = ReceivedCloud(serialized.cloud(message), len(self._clouds))
        except ValueError as error:
            for feed in self._feeds:
                feed.refusal(error)
            return
        for feed in self._feeds:
            feed.cloud(item)


def waiting(subscription: Subscription, limit: int) -> Iterator[Any]:
    """Yield the messages that wait at a subscription, at most ``limit``.

    The executor takes one message of every topic in turn: a node that has fallen behind would
    handle one IMU sample to a cloud, and every cloud before the samples that belong to it.
    """
    handle = subscription.handle
    with handle:
        for _ in range(limit):
            taken = handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                return
            yield taken[0]
