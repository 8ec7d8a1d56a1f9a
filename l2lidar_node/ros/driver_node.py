"""Driver node: reads parameters, runs the session, publishes its events."""

from __future__ import annotations

import array
import itertools
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeVar

import rclpy
from lifecycle_msgs.msg import Transition
from rclpy._rclpy_pybind11 import RCLError
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, PointCloud2
from std_msgs.msg import UInt8MultiArray
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

from l2lidar_node import clouds
from l2lidar_node.clock import ClockEvent
from l2lidar_node.config import DriverConfig, NetworkConfig
from l2lidar_node.driver.device import REPEAT_NS, TRIES, Answer
from l2lidar_node.driver.driver import Driver, Event, Silence
from l2lidar_node.files import free_name
from l2lidar_node.protocol.packets import Parameters, Version
from l2lidar_node.recording.capture import CaptureError
from l2lidar_node.recording.packet_bag import PacketBatch, open_packets
from l2lidar_node.recording.recording import Playback, Recorder, Recording, endpoints
from l2lidar_node.ros.conversions import CloudTemplate, ImuTemplate, imu_transform, to_time
from l2lidar_node.ros.diagnostics import HealthPublisher
from l2lidar_node.ros.managed_node import ManagedNode, NextTurn
from l2lidar_node.ros.parameters import ParameterSet
from l2lidar_node.ros.program import StartError, run
from l2lidar_node.ros.topics import DRIVER_TOPICS
from l2lidar_node.transport import session
from l2lidar_node.transport.session import Loop, Session, Tap, Taps
from l2lidar_node.transport.udp import TransportError
from l2lidar_node.types import HostNs, ImuSample, StampError, Sweep, is_ros_time, split_stamp

_DEPTH = 100  # 5 s: a recorder that finds the driver within that has all from its first packet


class PacketPublisher:
    """A session's tap that publishes raw packets, 50 ms per message.

    Parameters
    ----------
    node : Node
    topic : str
    network : NetworkConfig
        Addresses that the captures name.
    """

    def __init__(self, node: Node, topic: str, network: NetworkConfig) -> None:
        self._node = node
        latched = QoSProfile(depth=_DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publisher = node.create_publisher(UInt8MultiArray, topic, latched)
        self._batch = PacketBatch(*endpoints(network))

    def received(self, data: bytes, arrival: HostNs) -> None:
        """Publish bytes that came from the device."""
        self._add("received", data, arrival)

    def sent(self, frame: bytes, at: HostNs) -> None:
        """Publish a frame that goes to the device."""
        self._add("sent", frame, at)

    def waited(self, until: HostNs) -> None:
        """Publish that the driver gave up waiting."""
        self._add("waited", until)

    def stepped(self, by_ns: int, at: HostNs) -> None:
        """Publish that the driver was told that the host's clock was set."""
        self._add("stepped", by_ns, at)

    def slewed(self, by_ns: int, at: HostNs) -> None:
        """Publish how far slewing has moved the host's clock."""
        self._add("slewed", by_ns, at)

    def close(self) -> None:
        """Publish what is left."""
        self._publish()

    def _add(self, kind: str, *arguments: object) -> None:
        now = arguments[-1]
        assert isinstance(now, int)
        if self._batch.is_due(HostNs(now)):
            self._publish()
        try:
            self._batch.add(kind, *arguments)
        except OSError as error:
            text = f"packets not published: {error.strerror}"
            self._node.get_logger().error(text, throttle_duration_sec=10.0)

    def _publish(self) -> None:
        data = self._batch.take()
        if not data:
            return
        try:
            self._publisher.publish(UInt8MultiArray(data=array.array("B", data)))
        except RCLError:
            # A signal ends rclpy while the session still hands out what it holds.
            if self._node.context.ok():
                raise


T = TypeVar("T")

_CLOCK_DEPTH = 10


def open_loop(node: Node, config: DriverConfig, on_event: Callable[[Event], None]) -> Loop:
    """Return the loop that the settings ask for, not started yet; says in the log what it is.

    Nothing stays open where it raises.

    Raises
    ------
    SettingError
        If the calibration file cannot be used.
    StartError
        If a socket, device or file cannot be opened; the message says what to do.
    """
    with ExitStack() as opened:  # until the loop is there to close it
        if config.files.replay_file:
            loop: Loop = _playback(node, config, on_event, opened)
        else:
            loop = _live(node, config, on_event, opened)
        opened.pop_all()
    return loop


def _live(
    node: Node, config: DriverConfig, on_event: Callable[[Event], None], opened: ExitStack
) -> Session:
    driver = Driver(config)
    try:
        transport = session.open_transport(config.network)
    except TransportError as error:
        raise StartError(str(error.strerror)) from None
    opened.callback(transport.close)
    node.get_logger().info(session.describe_transport(config.network))
    taps: list[Tap] = []
    if config.topics.publish_packets:
        taps.append(PacketPublisher(node, config.topics.packet_topic_id, config.network))
    if config.files.record_file:  # last: a start that fails must not leave an empty capture
        path = free_name(Path(config.files.record_file).expanduser())
        try:
            taps.append(Recorder(path, config.network, node.get_logger().error))
        except OSError as error:
            raise StartError(f"cannot record to {path}: {error.strerror}") from None
        node.get_logger().info(f"recording to {path}")
    return Session(driver, transport, on_event, Taps(taps) if taps else None)


def _playback(
    node: Node, config: DriverConfig, on_event: Callable[[Event], None], opened: ExitStack
) -> Playback:
    path = Path(config.files.replay_file).expanduser()
    try:
        stream = opened.enter_context(open_packets(path))
        recording = Recording(stream, config.network.l2_ip)
        split_stamp(recording.start)
    except OSError as error:
        raise StartError(f"cannot replay {path}: {error.strerror}") from None
    except (CaptureError, StampError) as error:
        raise StartError(f"cannot replay {path}: {error}") from None
    logger = node.get_logger()
    rate = config.files.replay_rate
    logger.info(
        f"replaying what the L2 at {recording.device} sent, from {path}, "
        + (f"{rate:g} times as fast" if rate else "as fast as possible")
    )
    clock = node.create_publisher(Clock, "/clock", _CLOCK_DEPTH)

    def on_time(now: HostNs) -> None:
        if config.files.replay_clock and node.context.ok() and is_ros_time(now):
            clock.publish(Clock(clock=to_time(now)))

    def on_lap(shift_ns: int | None) -> None:
        cut = ", which is cut off" if recording.is_cut_off else ""
        if playback.damage:
            logger.error(f"{path} cannot be read beyond this point: {playback.damage}")
        if shift_ns is not None:
            seconds = shift_ns / 1e9
            logger.info(
                f"starting again from the beginning of {path}{cut}; stamps are shifted by "
                f"{seconds:.3f} s"
            )
        else:
            logger.info(f"end of {path}{cut}")
            rclpy.try_shutdown(context=node.context)

    playback = Playback(recording, config, on_event, on_time, on_lap)
    return playback


_ANSWER_TIMEOUT_S = (REPEAT_NS * TRIES) / 1e9 + 1.0
_NOT_IN_TIME = "the driver did not respond in time"
_NO_DEVICE = "a recording is being replayed, so there is no device to command"
_NOT_CONFIGURED = "the node is not configured; run: ros2 lifecycle set {name} configure"
# 4 s, of half turns, for reliable subscribers that are held up.
_CLOUD_DEPTH = 40
_IMU_DEPTH = 1000


class DriverNode(ManagedNode):
    """Publishes clouds, IMU samples and the static transform of one L2.

    Configured, it listens and says in ``/diagnostics`` what the device does. Active, it publishes.
    A manager that activates or deactivates it starts or stops the device as well, as ``~/enable``
    does, which in turn changes the state. A replay begins when the node is first activated.

    Raises
    ------
    SettingError
        If a parameter is wrong.
    StartError
        If the socket, the serial device or the recording cannot be opened.
    """

    def __init__(self) -> None:
        super().__init__("l2lidar_node")
        self.exit_code = 0
        self._answers: dict[int, Future[Answer]] = {}  # touched by the session's thread only
        self._samples = itertools.count()
        self._session: Loop | None = None
        self._settings = ParameterSet(self, DriverConfig, self._configure)
        self.create_service(SetBool, "~/enable", self._enable)
        self.create_service(Trigger, "~/reset", self._reset)
        self.start(self._settings.value.lifecycle.autostart)

    @property
    def session(self) -> Loop:
        """What receives; only while the node is configured."""
        assert self._session is not None
        return self._session

    def set_up(self) -> None:
        """Open publishers and the socket, device or recording, and listen."""
        config = self._settings.value
        self._open_publishers(config)
        self._session = open_loop(self, config, self._handle)
        self._health = HealthPublisher(self, self._session)
        if not config.files.replay_file:
            self._session.start()

    def begin(self) -> None:
        """Begin a replay."""
        if not self.session.is_started:
            self.session.start()

    def tear_down(self) -> None:
        """End the session, what it still holds handed out."""
        if self._session is not None:
            self._session.stop()
            self._session = None

    def _open_publishers(self, config: DriverConfig) -> None:
        topics = config.topics
        reliability = (
            ReliabilityPolicy.RELIABLE
            if topics.qos_reliability == "reliable"
            else ReliabilityPolicy.BEST_EFFORT
        )
        self._layout = clouds.LAYOUTS[topics.point_layout].with_rings(topics.ring_count)
        self._cloud_template = CloudTemplate(self._layout.dtype, config.frames.cloud)
        self._cloud_publisher = self.create_lifecycle_publisher(
            PointCloud2,
            topics.point_cloud_topic_id,
            QoSProfile(depth=_CLOUD_DEPTH, reliability=reliability),
        )
        self._compressed: Any = None
        if topics.compressed_clouds != "none":
            self._open_compressed(config, reliability)
        self._imu_publisher = None
        self._publish_every = config.imu.publish_every
        if config.imu.enable_publishing:
            self._imu_template = ImuTemplate(config.frames.imu, config.imu)
            self._imu_publisher = self.create_lifecycle_publisher(
                Imu, topics.imu_topic_id, QoSProfile(depth=_IMU_DEPTH, reliability=reliability)
            )
            # What its publish() does beside costs more than the message, when 250 come a second:
            # nobody destroys the publisher while the session runs.
            self._publish_imu = self._imu_publisher.handle.publish_raw
        self._warn_of_absolute_topics()
        if config.frames.publish_tf:
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._tf_publisher = self.create_publisher(TFMessage, "/tf_static", latched)
            now = HostNs(self.get_clock().now().nanoseconds)
            self._tf_publisher.publish(TFMessage(transforms=[imu_transform(config.frames, now)]))

    def _warn_of_absolute_topics(self) -> None:
        """Warn where the node is in a namespace and upstream's absolute topic names are not."""
        publishers = (self._cloud_publisher, self._imu_publisher)
        names = [item.topic_name for item in publishers if item is not None]
        outside = [name for name in names if name in DRIVER_TOPICS]
        if outside and self.get_namespace() != "/":
            remaps = " ".join(f"-r {name}:={name.removeprefix('/')}" for name in outside)
            self.get_logger().warning(
                f"{' and '.join(outside)} stay outside of the namespace {self.get_namespace()}, "
                "since upstream's names begin with '/'; to have them in it, use the launch files "
                f"or add '{remaps}'"
            )

    def _open_compressed(self, config: DriverConfig, reliability: ReliabilityPolicy) -> None:
        try:
            from point_cloud_interfaces.msg import CompressedPointCloud2

            from l2lidar_node.ros.compressed_cloud import CompressedCloudTemplate
        except ImportError as error:
            raise StartError(
                f"parameter 'compressed_clouds': needs '{error.name}', which is not installed; "
                "sudo apt install ros-jazzy-point-cloud-interfaces python3-zstandard, or set it "
                "to none"
            ) from None
        topics = config.topics
        is_lossy = topics.compressed_clouds == "millimeter"
        self._compressed_template = CompressedCloudTemplate(
            self._layout.dtype, config.frames.cloud, topics.zstd_level, is_lossy
        )
        self._compressed = self.create_lifecycle_publisher(
            CompressedPointCloud2,
            f"{topics.point_cloud_topic_id}/zstd",
            QoSProfile(depth=_CLOUD_DEPTH, reliability=reliability),
        )

    def _configure(self, config: DriverConfig) -> None:
        self._publish_every = config.imu.publish_every
        if self._session is not None:
            self._session.call(lambda driver, now: driver.configure(config))

    def _handle(self, event: Event) -> None:
        try:
            if isinstance(event, ImuSample):
                imu = self._imu_publisher
                if imu and imu.is_activated and next(self._samples) % self._publish_every == 0:
                    self._publish_imu(self._imu_template.serialize(event))
            elif isinstance(event, Sweep):
                if not self._cloud_publisher.is_activated:
                    return
                points = self._layout.convert(event.points, event.start)
                self._cloud_publisher.publish(self._cloud_template.serialize(points, event.start))
                if self._compressed is not None and self._compressed.get_subscription_count():
                    self._compressed.publish(
                        self._compressed_template.serialize(points, event.start)
                    )
            else:
                self._report(event)
        except StampError as error:
            self.get_logger().error(f"not published: {error}", throttle_duration_sec=10.0)
        except RCLError:
            # A signal ends rclpy while the session still hands out what it holds.
            if self.context.ok():
                raise

    def _report(self, event: Answer | Silence | ClockEvent | Version | Parameters) -> None:
        if isinstance(event, Answer):
            self._answered(event)
        elif isinstance(event, Silence):
            self._silent(event)
        elif isinstance(event, Version):
            self.get_logger().info(
                f"the device is {event.name}, firmware {event.firmware} ({event.date}), "
                f"hardware {event.hardware}"
            )
        elif isinstance(event, ClockEvent):
            self.get_logger().info(f"clock: {event.text}")

    def _silent(self, silence: Silence) -> None:
        config = self._settings.value
        text = (
            f"no data from the L2 at {config.network.where} for {silence.duration_ns / 1e9:.1f} s "
            f"(watchdog_timeout_ms {config.watchdog.timeout_ms})"
        )
        if config.watchdog.action == "wait" or not self.is_active:
            self.get_logger().error(f"{text}; waiting for it")
            return
        self.get_logger().fatal(f"{text}; shutting down")
        self.exit_code = 1
        rclpy.try_shutdown()

    def _answered(self, answer: Answer) -> None:
        future = self._answers.pop(answer.ticket, None)
        if future is not None:
            future.set_result(answer)

    async def allows(self, transition: int) -> bool:
        """Start or stop the device before the node is activated or deactivated.

        A device that does not answer keeps the node from becoming active, but not from becoming
        inactive.
        """
        starts = transition == Transition.TRANSITION_ACTIVATE
        if not starts and transition != Transition.TRANSITION_DEACTIVATE:
            return True
        if self._settings.value.files.replay_file:
            return True
        worked, text = await self._command(starts)
        if not worked:
            self.get_logger().warning(f"{'activate' if starts else 'deactivate'}: {text}")
        return worked or not starts

    async def _enable(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        response.success, response.message = False, self._refusal()
        if response.message:
            return response
        response.success, response.message = await self._command(request.data)
        if response.success and self.is_configured and self.is_active != request.data:
            (self.trigger_activate if request.data else self.trigger_deactivate)()
        return response

    def _refusal(self) -> str:
        """Return why the device cannot be commanded, empty if it can."""
        if self._session is None:
            return _NOT_CONFIGURED.format(name=self.get_fully_qualified_name())
        return _NO_DEVICE if self._settings.value.files.replay_file else ""

    async def _command(self, starts: bool) -> tuple[bool, str]:
        """Start or stop the device; return whether it did, and what it or the driver says."""
        future: Future[Answer] = Future()

        def command(driver: Driver, now: HostNs) -> None:
            if starts:
                ticket, events = driver.start_rotation(now), list[Event]()
            else:
                ticket, events = driver.stop_rotation(now)
            self._answers[ticket] = future
            for event in events:
                self._handle(event)

        await self._completed(self.session.call(command))
        answer = await self._completed(future)
        return (answer.ok, answer.text) if answer is not None else (False, _NOT_IN_TIME)

    async def _reset(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        del request
        response.success, response.message = False, self._refusal()
        if response.message:
            return response

        def command(driver: Driver, now: HostNs) -> tuple[bool, str]:
            is_there = driver.is_there(now)
            for event in driver.reset_device(now):
                self._handle(event)
            if not is_there:
                where = driver.config.network.where
                return False, (
                    f"no data from a device at {where} recently; the reset was sent anyway, "
                    "but a device never acknowledges it"
                )
            return True, "reset sent; the device does not acknowledge it and is back in about 25 s"

        done = await self._completed(self.session.call(command))
        response.success, response.message = done or (False, _NOT_IN_TIME)
        return response

    async def _completed(self, future: Future[T]) -> T | None:
        """Return a future's result, None where it does not come in time.

        Meanwhile the executor does everything else: timers, parameters, other calls.
        """
        executor = self.executor
        future.add_done_callback(lambda _: executor.wake())
        deadline = time.monotonic() + _ANSWER_TIMEOUT_S
        while not future.done() and time.monotonic() < deadline:
            await NextTurn()
        return future.result() if future.done() and not future.cancelled() else None


def main(args: list[str] | None = None) -> int:
    """Run the driver node; see :func:`l2lidar_node.ros.program.run`."""
    return run("l2lidar_node", DriverNode, args)


if __name__ == "__main__":
    sys.exit(main())
