"""What is said about the device, aspect by aspect."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from l2lidar_node.driver.health import Period, judge, observe
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.types import Check, HostNs, Level
from tests.l2lidar_node.driver.test_driver import Run
from tests.support import build


class Link:
    """The counts of a transport."""

    foreign = 0
    stranger = ""
    kernel_drops = 0
    send_errors = 0


class Watched:
    """A run whose health is judged over what happens after the first second."""

    def __init__(self, **values: Any) -> None:
        self.run = Run(**values)
        self.link = Link()
        self.before = self.period()

    def period(self) -> Period:
        self.run.events += self.run.driver.catch_up()
        return observe(self.run.driver, self.link, HostNs(self.run.now))

    def begin(self) -> None:
        self.before = self.period()
        self.run.driver.gravity.take()

    def checks(self) -> dict[str, Check]:
        checks = judge(self.run.driver, self.before, self.period())
        return {check.name: check for check in checks}

    def verdict(self, name: str) -> tuple[Level, str]:
        check = self.checks()[name]
        return check.level, check.message


def streaming(seconds: float = 3.0, keep: Any = lambda item: True, **values: Any) -> Watched:
    """Return a run judged over all but its first second."""
    watched = Watched(**values)
    datagrams = [item for item in build.capture(seconds) if keep(item)]
    early = [item for item in datagrams if item.arrival_ns < build.EPOCH_NS + 1_000_000_000]
    watched.run.play(early)
    watched.begin()
    watched.run.play(datagrams[len(early) :])
    return watched


def is_imu(item: build.Datagram) -> bool:
    return len(item.data) == 80


@pytest.fixture(scope="module")
def healthy() -> Watched:
    return streaming()


def test_a_healthy_device_is_all_right(healthy: Watched) -> None:
    checks = healthy.checks()
    assert set(checks) >= {"device", "link", "clock", "points", "hardware"}
    assert {check.level for check in checks.values()} == {Level.OK}
    assert checks["device"].message == "streaming"
    assert float(checks["device"].values["point packets [1/s]"]) == pytest.approx(215.6, abs=2)
    assert float(checks["device"].values["IMU packets [1/s]"]) == pytest.approx(250, abs=2)
    assert checks["link"].values["points lost"] == "0"
    assert checks["points"].message == "91 % of the slots return"
    assert checks["clock"].message == "locked"
    assert float(checks["clock"].values["ratio"]) == pytest.approx(build.RATIO, rel=1e-5)
    assert checks["hardware"].values["mirror period [us]"] == "4639"
    assert checks["hardware"].values["APD temperature [degC]"] == "43.7"


def test_a_device_that_is_not_there() -> None:
    watched = Watched(l2_ip="192.168.1.99")
    watched.run.wait(1)
    assert watched.verdict("device") == (Level.ERROR, "no data from 192.168.1.99 yet")
    assert watched.verdict("clock") == (Level.OK, "no data yet")
    assert set(watched.checks()) == {"device", "link", "clock", "points"}


def test_spin_up_says_how_long() -> None:
    watched = Watched()
    watched.run.play(item for item in build.capture(1.0) if is_imu(item))
    level, message = watched.verdict("device")
    assert level is Level.WARN
    assert message == "spinning up, points in about 20 s"


def test_a_device_that_fell_silent() -> None:
    watched = streaming(1.5)
    watched.run.wait(2)
    assert watched.verdict("device") == (Level.ERROR, "192.168.1.62 has fallen silent")


def test_a_device_on_a_serial_line_is_named_by_that() -> None:
    waiting = Watched(serial_port="/dev/ttyACM0")
    waiting.run.wait(1)
    assert waiting.verdict("device") == (Level.ERROR, "no data from /dev/ttyACM0 yet")
    silent = streaming(1.5, serial_port="/dev/ttyACM0")
    silent.run.wait(2)
    assert silent.verdict("device") == (Level.ERROR, "/dev/ttyACM0 has fallen silent")


def test_standby_is_as_asked() -> None:
    watched = streaming(1.5)
    watched.run.driver.stop_rotation(HostNs(watched.run.now))
    watched.run.wait(2)
    assert watched.verdict("device") == (Level.OK, "in standby as asked")


def test_points_without_imu() -> None:
    watched = streaming(keep=lambda item: not is_imu(item))
    assert watched.verdict("device") == (Level.WARN, "streaming points but no IMU")


def test_a_slow_device() -> None:
    watched = streaming(keep=lambda item: is_imu(item) or item.arrival_ns // build.PERIOD_NS % 4)
    assert watched.verdict("device") == (Level.WARN, "streaming below its nominal rate")


@pytest.mark.parametrize(
    ("frame3d", "measured", "asked"), [(True, "2D", "3D"), (False, "3D", "2D")]
)
def test_the_other_dimension_than_asked_for(frame3d: bool, measured: str, asked: str) -> None:
    watched = Watched(frame3d=frame3d)
    for number in range(50):
        watched.run.now += 20_000_000
        payload = build.points_2d(number) if frame3d else build.points_3d(number)
        kind = PacketType.POINTS_2D if frame3d else PacketType.POINTS_3D
        watched.run.hear(kind, payload)
        watched.run.hear(PacketType.IMU, build.imu(number))
    message = f"it measures {measured} but frame3d asks for {asked}"
    assert watched.verdict("device") == (Level.ERROR, message)


def test_a_little_loss_is_a_warning_and_much_is_an_error() -> None:
    little = streaming(keep=lambda item: item.arrival_ns // 1_000 % 97)
    level, message = little.verdict("link")
    assert level is Level.WARN
    assert message.endswith("packets lost")
    much = streaming(keep=lambda item: item.arrival_ns // 1_000 % 7)
    level, message = much.verdict("link")
    assert level is Level.ERROR
    assert "packets lost in" in message


def test_much_loss_names_its_cause_where_it_is_known() -> None:
    watched = streaming(keep=lambda item: item.arrival_ns // 1_000 % 7)
    watched.link.kernel_drops = 9
    level, message = watched.verdict("link")
    assert level is Level.ERROR
    assert "packets lost in" in message
    assert "9 datagrams dropped by the kernel" in message


def test_damage_drops_and_foreigners_are_named() -> None:
    watched = streaming(1.5)
    watched.run.hear(PacketType.POINTS_3D, build.points_3d(count=999))
    bad = build.frame(PacketType.ACK, build.ack(1))
    watched.run.driver.receive(bad[:20] + b"\xee\xee" + bad[22:], HostNs(watched.run.now))
    watched.link.foreign, watched.link.kernel_drops, watched.link.send_errors = 3, 2, 4
    check = watched.checks()["link"]
    assert check.level is Level.WARN
    assert check.message == (
        "2 damaged or impossible packets; 2 datagrams dropped by the kernel; raise "
        "receive_buffer_bytes; 4 commands could not be sent; check the cable and the network; "
        "3 datagrams of other senders refused"
    )
    assert check.values["damaged: crc"] == check.values["rejected: 102.point_num"] == "1"
    watched.begin()
    assert watched.verdict("link") == (Level.OK, "no loss")


def test_a_flood_is_named_with_its_sender_and_what_to_do() -> None:
    watched = streaming(1.0)
    watched.link.foreign, watched.link.stranger = 50_000, "10.0.0.7"
    level, message = watched.verdict("link")
    assert level is Level.WARN
    assert message == (
        "50000 datagrams of other senders refused, the last seen from 10.0.0.7; this is a flood: "
        "block it with a firewall"
    )
    watched = streaming(3.0)  # the last two seconds are judged; a second L2 sends 500 a second
    for foreign, is_flood in ((1_800, False), (2_200, True)):
        watched.link.foreign = foreign
        assert ("flood" in watched.verdict("link")[1]) == is_flood


def test_a_device_at_another_address_is_named() -> None:
    watched = Watched()
    watched.run.now += 1_000_000_000
    watched.link.foreign, watched.link.stranger = 470, "192.168.1.63"
    level, message = watched.verdict("device")
    assert level is Level.ERROR
    assert message.endswith("but from 192.168.1.63: if that is the L2, set l2_ip to it")


def test_a_flood_under_the_devices_own_address_is_named() -> None:
    watched = streaming(1.0)
    for _ in range(20_000):
        watched.run.driver.receive(b"", HostNs(watched.run.now))
    level, message = watched.verdict("link")
    assert level is Level.WARN
    assert "claim to come from 192.168.1.62: an L2 sends 470" in message


def test_on_a_serial_line_there_is_no_other_host_however_small_the_pieces() -> None:
    watched = streaming(1.0, serial_port="/dev/ttyACM0")
    for _ in range(20_000):
        watched.run.driver.receive(b"", HostNs(watched.run.now))
    assert watched.verdict("link") == (Level.OK, "no loss")


def test_a_clock_that_is_not_locked() -> None:
    watched = Watched()
    watched.run.play(build.capture(0.2))
    assert watched.verdict("clock") == (Level.WARN, "not locked yet")


def test_a_covered_sensor() -> None:
    watched = Watched(publish_unlocked=True, aggregateNframes=1)
    watched.run.hear(PacketType.POINTS_3D, build.points_3d(ranges=[0] * 280 + [3000] * 20))
    level, message = watched.verdict("points")
    assert level is Level.WARN
    assert message == "hardly any returns; check whether the sensor is covered"


def test_where_no_cloud_is_made_nothing_is_said_of_its_slots() -> None:
    waiting = streaming(1.2, sweep_cut="packets", aggregateNframes=4000)
    assert waiting.verdict("points") == (Level.OK, "no cloud was completed recently")

    def has_gaps(item: Any) -> bool:
        """Tell whether it comes in the 0.15 s between outages of 0.25 s: a turn takes longer."""
        return bool((item.arrival_ns - build.EPOCH_NS) % 400_000_000 > 250_000_000)

    torn = streaming(3.0, has_gaps, sweep_cut="turn")
    level, message = torn.verdict("points")
    assert (level, message) == (
        Level.WARN,
        "no turn was complete, and parts of turns are dropped",
    )


def test_gravity_alignment_without_imu() -> None:
    watched = streaming(keep=lambda item: not is_imu(item), imu_adjust=True)
    assert watched.verdict("points") == (
        Level.WARN, "imu_adjust drops points for lack of IMU data",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("dirty_index", 6.0, "the cover is dirty"),
        ("apd_temperature", 81.0, "the detector is hot"),
        ("imu_temperature", 86.0, "the IMU is hot"),
        ("packet_lost_down", 0.02, "packets are lost inside the sensor"),
        ("apd_voltage", math.nan, "it reports values that are not numbers"),
    ],
)
def test_unhealthy_hardware(name: str, value: Any, message: str) -> None:
    watched = Watched(publish_unlocked=True)
    payload = build.points_3d(state=build.STATE | {name: value})
    watched.run.hear(PacketType.POINTS_3D, payload)
    assert watched.verdict("hardware") == (Level.WARN, message)


@pytest.mark.parametrize(
    ("acceleration", "level", "message"),
    [
        ((0.0, 0.0, 9.9), Level.OK, "agrees with gravity"),
        ((0.0, 0.0, 8.0), Level.WARN, "|a| is 8.0 m/s^2, not gravity"),
        ((17.0, 0.3, 10.0), Level.ERROR, "|a| is 19.7 m/s^2: the accelerometer fault"),
        ((5.0, 0.0, 8.43), Level.WARN, "the orientation is 31 degrees off gravity"),
    ],
)
def test_the_imu_against_gravity(acceleration: Any, level: Any, message: str) -> None:
    watched = Watched(publish_unlocked=True)
    watched.run.hear(PacketType.IMU, build.imu(acceleration=acceleration))
    found, text = watched.verdict("imu")
    assert found is level
    assert text.startswith(message)


def test_levels_are_those_of_the_ros_message() -> None:
    assert [int(level) for level in Level] == [0, 1, 2, 3]
    assert np.array([level.name for level in Level]).tolist() == ["OK", "WARN", "ERROR", "STALE"]
