"""Nothing that the driver's node waits for keeps it from answering others."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

rclpy = pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402  after importorskip
from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState  # noqa: E402
from rcl_interfaces.srv import GetParameters  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import qos_profile_sensor_data  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402
from std_srvs.srv import SetBool, Trigger  # noqa: E402

from l2lidar_node.demo.processes import assigned, free_udp_ports  # noqa: E402
from l2lidar_node.driver import device as device_module, driver  # noqa: E402
from l2lidar_node.protocol import wire  # noqa: E402
from l2lidar_node.ros import diagnostics, driver_node  # noqa: E402
from l2lidar_node.ros.conversions import from_time  # noqa: E402
from l2lidar_node.ros.diagnostics import HealthPublisher  # noqa: E402
from l2lidar_node.ros.driver_node import DriverNode  # noqa: E402
from l2lidar_node.types import LAST_STAMP, HostNs, Sweep  # noqa: E402
from tests.l2lidar_proc.motion.analytic import Motion, seen  # noqa: E402
from tests.support import build  # noqa: E402
from tests.support.build import PERIOD_NS, frames_3d, points_3d  # noqa: E402

pytestmark = pytest.mark.ros
TIMEOUT_S = 120.0  # generous: only a failure waits that long


class Rig:
    """A driver's node without a device, and a peer, in one thread."""

    def __init__(self, **parameters: str) -> None:
        self.host_port, self.lidar_port = free_udp_ports(2)
        values = {
            "l2_ip": "127.0.0.1",
            "host_ip": "127.0.0.1",
            "l2_port": self.lidar_port,
            "host_port": self.host_port,
            **parameters,
        }
        given = [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]
        rclpy.init(args=["test", "--ros-args", *given])
        self.node = DriverNode()
        self.peer = rclpy.create_node("peer")
        self.said: list[str] = []
        self.stamps: list[int] = []
        self.units: set[str] = set()
        self.clouds: list[PointCloud2] = []
        self.peer.create_subscription(DiagnosticArray, "/diagnostics", self._hear, 10)
        self.peer.create_subscription(
            PointCloud2, "/points", self.clouds.append, qos_profile_sensor_data
        )
        self.parameters = self.peer.create_client(GetParameters, "/l2lidar_node/get_parameters")
        self.enable = self.peer.create_client(SetBool, "/l2lidar_node/enable")
        self.reset = self.peer.create_client(Trigger, "/l2lidar_node/reset")
        self.lifecycle = self.peer.create_client(ChangeState, "/l2lidar_node/change_state")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.executor.add_node(self.peer)
        for client in (self.parameters, self.enable, self.reset, self.lifecycle):
            self.until(client.service_is_ready)

    def _hear(self, message: DiagnosticArray) -> None:
        self.stamps.append(from_time(message.header.stamp))
        self.said.extend(status.message for status in message.status)
        self.units.update(status.hardware_id for status in message.status)

    def until(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + TIMEOUT_S
        while not condition():
            assert time.monotonic() < deadline
            self.executor.spin_once(timeout_sec=0.05)

    def answers(self) -> bool:
        """Ask for a parameter and wait for the answer."""
        future = self.parameters.call_async(GetParameters.Request(names=["l2_ip"]))
        self.until(future.done)
        return bool(future.result().values[0].string_value == "127.0.0.1")

    def change(self, label: str) -> bool:
        """Ask for a transition and return whether it took place."""
        request = ChangeState.Request(transition=Transition(label=label))
        future = self.lifecycle.call_async(request)
        self.until(future.done)
        return bool(future.result().success)


@contextmanager
def open_rig(**parameters: str) -> Iterator[Rig]:
    made = Rig(**parameters)
    try:
        yield made
    finally:
        made.executor.shutdown()
        made.peer.destroy_node()
        made.node.destroy_node()
        rclpy.shutdown()


@pytest.fixture
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    with open_rig(**getattr(request, "param", {})) as made:
        yield made


def test_while_a_device_does_not_acknowledge_everything_else_goes_on(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver_node, "_ANSWER_TIMEOUT_S", TIMEOUT_S)
    with monkeypatch.context() as patch:
        patch.setattr(device_module, "REPEAT_NS", 10**15)  # until the other call is answered
        pending = [rig.enable.call_async(SetBool.Request(data=value)) for value in (True, False)]
        assert rig.answers()
        assert not any(future.done() for future in pending)
    for future in pending:
        rig.until(future.done)
        assert not future.result().success
        assert "did not acknowledge" in future.result().message
    resetting = rig.reset.call_async(Trigger.Request())
    rig.until(resetting.done)
    assert not resetting.result().success
    assert "no data from a device at 127.0.0.1" in resetting.result().message
    rig.until(lambda: rig.units)
    assert rig.units == {"L2 at 127.0.0.1"}


def test_a_receiving_thread_that_hangs_is_named_and_holds_nobody_up(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver_node, "_ANSWER_TIMEOUT_S", 0.5)
    free, held = threading.Event(), threading.Event()

    def hang(driver: Any, now: Any) -> None:
        held.set()
        free.wait()

    rig.node._session.call(hang)
    rig.until(held.is_set)
    try:
        pending = [rig.enable.call_async(SetBool.Request(data=True)),
                   rig.reset.call_async(Trigger.Request())]  # fmt: skip
        assert rig.answers()
        for future in pending:
            rig.until(future.done)
            assert not future.result().success
            assert future.result().message == "the driver did not respond in time"
        rig.until(lambda: any("receive thread has not responded for" in t for t in rig.said))
    finally:
        free.set()
    rig.said.clear()
    rig.until(lambda: any("no data from 127.0.0.1" in text for text in rig.said))
    assert not any("has not responded" in text for text in rig.said[-5:])


def test_a_replay_that_has_not_begun_is_not_taken_for_one_that_hangs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.pcap"
    build.write_capture(path, build.capture(3.0))
    looks = 0
    ask = HealthPublisher._ask

    def counted(health: HealthPublisher) -> None:
        nonlocal looks
        ask(health)
        looks += 1

    monkeypatch.setattr(HealthPublisher, "_ask", counted)
    monkeypatch.setattr(diagnostics, "PERIOD_S", 0.02)
    with open_rig(replay_file=str(path), replay_loop="true", autostart="false") as rig:
        with monkeypatch.context() as patch:
            patch.setattr(diagnostics, "_SILENT_S", 0.0)
            assert rig.change("configure")
            rig.until(lambda: looks > 5)
        assert rig.change("activate")
        rig.until(lambda: rig.said)
        assert not any("has not responded" in text for text in rig.said)


def test_the_health_of_a_replay_goes_on_in_time_from_lap_to_lap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.pcap"
    build.write_capture(path, build.capture(1.5))
    monkeypatch.setattr(diagnostics, "PERIOD_S", 0.05)
    monkeypatch.setattr(diagnostics, "_SILENT_S", TIMEOUT_S)  # on the wall's time
    in_third_lap = build.EPOCH_NS + 2 * 1_500_000_000
    with open_rig(replay_file=str(path), replay_loop="true", replay_rate="2.0") as rig:
        stamps = rig.stamps
        rig.until(lambda: stamps and (stamps != sorted(stamps) or stamps[-1] > in_third_lap))
        assert stamps == sorted(stamps)
        assert build.EPOCH_NS < stamps[0] < build.EPOCH_NS + 1_600_000_000


@pytest.mark.parametrize("how", ["enable", "reset", "end"])
@pytest.mark.parametrize(
    "rig", [{"UseSystemTimeTS": "true", "imu_adjust": "false"}], indirect=True, ids=[""]
)
def test_what_was_collected_is_published_at_a_stop(
    rig: Rig, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "MAX_GAP_NS", 10**18)  # else it is after 200 ms without points
    rig.until(rig.node._cloud_publisher.get_subscription_count)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        device.bind(("127.0.0.1", rig.lidar_port))
        for frame in frames_3d(points_3d(number, number * PERIOD_NS) for number in range(7)):
            device.sendto(frame, ("127.0.0.1", rig.host_port))
    counters = rig.node._session.driver.counters
    rig.until(lambda: counters.frames[wire.PacketType.POINTS_3D] == 7)
    assert rig.clouds == []
    if how == "enable":
        rig.enable.call_async(SetBool.Request(data=False))
    elif how == "reset":
        rig.reset.call_async(Trigger.Request())
    else:
        rig.node._session.stop()
    rig.until(lambda: rig.clouds)
    (cloud,) = rig.clouds
    assert cloud.width == 7 * wire.POINTS_PER_3D_PACKET


def test_a_host_clock_after_2038_ends_nothing(rig: Rig) -> None:
    rig.until(rig.node._cloud_publisher.get_subscription_count)
    points = seen(Motion(), 0.0, 0.2, 0.0)[0]
    for start in (LAST_STAMP + 1, 2_000_000_000_000_000_000):
        rig.node._handle(Sweep(HostNs(start), HostNs(start + 200_000_000), points, 38, 0))
    rig.until(lambda: rig.clouds)
    assert [cloud.header.stamp.sec for cloud in rig.clouds] == [2_000_000_000]


def test_a_manager_is_told_what_cannot_be_done_and_nothing_ends(rig: Rig) -> None:
    assert rig.node.state_label == "active"
    assert not rig.change("activate")  # it is
    assert not rig.change("dance")
    assert rig.change("deactivate")  # whether the device obeys or not
    assert not rig.change("activate")  # there is no device to start
    assert rig.node.state_label == "inactive"
    assert rig.change("cleanup")
    enabling = rig.enable.call_async(SetBool.Request(data=True))
    rig.until(enabling.done)
    assert "not configured" in enabling.result().message
    network = rig.node._settings.value.network
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((network.host_ip, network.host_port))  # it was given up
        assert not rig.change("configure")
        assert rig.node.state_label == "unconfigured"
    assert rig.change("configure")
    assert rig.answers()
    references = len(rig.node.default_callback_group.entities)
    for _ in range(10):  # each makes a dozen anew
        assert rig.change("cleanup")
        assert rig.change("configure")
    assert len(rig.node.default_callback_group.entities) < 2 * references


def test_a_destroyed_node_leaves_the_graph_and_may_be_destroyed_twice(rig: Rig) -> None:
    assert "l2lidar_node" in rig.peer.get_node_names()
    rig.executor.remove_node(rig.node)
    rig.node.destroy_node()
    rig.until(lambda: "l2lidar_node" not in rig.peer.get_node_names())
    rig.node.destroy_node()


def test_names_that_stay_outside_of_the_namespace_are_warned_of(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Upstream's names are absolute, so a namespace alone does not keep two sensors apart."""
    hints = ["-r", "/points:=points", "-r", "/imu/data:=imu/data"]

    def said(*given: str) -> str:
        port = free_udp_ports(1)[0]
        values = assigned(
            {"l2_ip": "127.0.0.1", "host_ip": "127.0.0.1", "host_port": port,
             "enable_IMU_publishing": True}
        )  # fmt: skip
        rclpy.init(args=["test", *values, *given])
        try:
            DriverNode().destroy_node()
        finally:
            rclpy.shutdown()
        return capfd.readouterr().err

    alone = said("-r", "__ns:=/front")
    assert "/points and /imu/data stay outside of the namespace /front" in alone
    assert " ".join(hints) in alone
    assert "outside" not in said("-r", "__ns:=/front", *hints)
    assert "outside" not in said()
