from __future__ import annotations

import struct
from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from l2lidar_node.emulator.config import (
    AddressConfig,
    DelayConfig,
    DeviceConfig,
    IdentityConfig,
    PowerConfig,
)
from l2lidar_node.emulator.unit.device import Link, VirtualL2
from l2lidar_node.emulator.unit.firmware import Flash, Inbox, network_payload
from l2lidar_node.emulator.unit.stream import PatternScanner, StillInertial
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import WorkMode
from l2lidar_node.settings import SettingError
from tests.l2lidar_node.emulator.rig import MS, READY, Bench, S, acks, command, identity, read

OK, CRC_ERROR, HEADER_ERROR, BLOCK_ERROR, NOT_READY = 1, 2, 3, 4, 5

# As captured from the vendor's client, tails of uninitialised memory included.
CLIENT = {
    "start": "55aa050a 64000000 20000000 02000000 00000000 14d80727 a1ff7f00 5b5f00ff",
    "mode 0": "55aa050a d2070000 1c000000 00000000 1cdf4421 fe7f0000 50da00ff",
    "reset": "55aa050a 64000000 20000000 01000000 01000000 92b83411 00000000 000000ff",
    "version": "55aa050a d0070000 20000000 04000000 00000000 93d168e1 1111ff7f ffff00ff",
    "parameters": "55aa050a d0070000 20000000 03000000 03000000 647718f9 1111ff7f 000000ff",
    "latency 101": "55aa050a d0070000 20000000 06000000 65000000 dfd1b5af 1111ff7f 000000ff",
}


def client(name: str) -> bytes:
    return bytes.fromhex(CLIENT[name])


def stored(mode: WorkMode) -> Flash:
    config = DeviceConfig(identity=IdentityConfig(work_mode=int(mode)))
    return Flash.factory(config.addresses, config.identity)


@pytest.mark.parametrize(
    ("sent", "answers"),
    [
        (client("start"), [(101, (100, 2, 0, OK))]),
        (client("mode 0"), [(101, (2002, 0, 0, OK))]),
        (client("version"), [(105, None), (101, (2000, 4, 0, OK))]),
        (client("parameters"), [(2001, None), (101, (2000, 3, 3, OK))]),
        (client("latency 101"), [(101, (2000, 6, 101, OK))]),
        (client("reset"), []),
        (command(100, 1, 0), []),
        (command(100, 2, 1), [(101, (100, 2, 1, OK))]),
        (command(100, 3, 0), [(105, None), (101, (100, 3, 0, OK))]),
        (command(100, 4, 77), [(101, (100, 4, 77, OK))]),
        (command(100, 5, 0), [(101, (100, 5, 0, OK))]),
        (command(100, 6, 0), [(2001, None), (101, (100, 6, 0, OK))]),
        (command(100, 7, 1), [(101, (100, 7, 1, OK))]),
        (command(100, 8, 0), [(101, (100, 8, 0, HEADER_ERROR))]),
        (command(2000, 1, 0), [(101, (2000, 1, 0, OK))]),
        (command(2000, 2, 0), [(101, (2000, 2, 0, OK))]),
        (command(2000, 5, 1), [(101, (2000, 5, 1, OK))]),
        (command(2000, 5, 2), [(101, (2000, 5, 2, BLOCK_ERROR))]),
        (command(2000, 7, 0), [(101, (2000, 7, 0, OK))]),
        (command(2000, 8, 0), [(101, (2000, 8, 0, HEADER_ERROR))]),
        (command(106, 1, 2), [(101, (106, 0, 0, OK))]),
        (command(107, 0), [(101, (107, 0, 0, OK))]),
        (command(108, 1, 2, 3, 4, 0x18391838), [(101, (108, 0, 0, OK))]),
        (command(108, 1, 2, 3, 4, 0), [(101, (108, 0, 0, BLOCK_ERROR))]),
        (command(109, 1, 2), [(101, (109, 0, 0, OK))]),
        (wire.encode_frame(2001, bytes(172)), [(101, (2001, 0, 0, OK))]),
        (command(106, 1), [(101, (106, 0, 0, HEADER_ERROR))]),
        (command(104, 1, 2), [(101, (104, 0, 0, HEADER_ERROR))]),
        (command(4711, 1), [(101, (4711, 0, 0, HEADER_ERROR))]),
        (
            client("start")[:20] + b"\0\0\0\0" + client("start")[24:],
            [(101, (100, 0, 0, CRC_ERROR))],
        ),
        (
            client("start")[:8] + b"\x0c\0\0\0" + client("start")[12:],
            [(101, (100, 0, 0, HEADER_ERROR))],
        ),
    ],
)
def test_every_command_gets_its_answer(sent: Any, answers: Any) -> None:
    bench = Bench()
    bench.run(1.0)
    got = bench.ask(sent)
    assert [frame.packet_type for frame in got] == [packet_type for packet_type, _ in answers]
    assert acks(got) == [ack for _, ack in answers if ack is not None]


def test_the_answer_leaves_after_the_reply_delay() -> None:
    bench = Bench(delays=DelayConfig(reply_delay_us=300.0))
    bench.run(1.0)
    bench.device.command(client("latency 101"), bench.now)
    answer = [time for time, data in bench.run(0.01) if len(data) == 40]
    assert answer == [S + 300_000]


def test_version_says_who_the_unit_is() -> None:
    bench = Bench()
    bench.run(1.0)
    payload = bench.ask(client("version"))[0].payload
    assert payload[:8] == bytes([2, 2, 1, 1, 2, 8, 11, 1])
    assert payload[8:32].rstrip(b"\0") == b"YS-L2"
    assert payload[32:40].rstrip(b"\0") == b"250715"


def test_version_is_ignored_then_refused_then_answered_also_in_standby() -> None:
    bench = Bench(DeviceConfig())
    answers = {}
    for at in (1.0, 3.0, 10.0, 26.0):
        bench.run(at - bench.now / S)
        answers[at] = bench.ask(client("version"))
    assert answers[1.0] == []
    assert answers[3.0] == []
    assert acks(answers[10.0]) == [(2000, 4, 0, NOT_READY)]
    assert [frame.packet_type for frame in answers[26.0]] == [105, 101]
    bench.ask(command(100, 2, 1))
    assert [frame.packet_type for frame in bench.ask(client("version"))] == [105, 101]


def test_other_commands_are_heard_as_soon_as_the_link_is_up() -> None:
    bench = Bench(DeviceConfig())
    bench.run(1.9)
    assert bench.ask(client("latency 101")) == []
    bench.run(0.2)
    assert acks(bench.ask(client("latency 101"))) == [(2000, 6, 101, OK)]


def test_parameters_state_work_mode_limits_and_calibration() -> None:
    bench = Bench(flash=stored(WorkMode.WAIT_FOR_START))
    bench.ask(command(2002, 0x15))
    payload = bench.ask(client("parameters"))[0].payload
    assert struct.unpack_from("<I", payload, 12) == (0x15,)
    assert struct.unpack_from("<2f", payload, 28) == pytest.approx((50.0, 0.05))
    assert struct.unpack_from("<8f", payload, 40) == pytest.approx(
        (0.0445, 0.006586, 2.0769, 0.032398, 0.003818, 0.002945, -365.625, 0.000978)
    )
    assert len(payload) == 172


def test_parameters_can_be_replaced_and_reset() -> None:
    bench = Bench()
    bench.run(1.0)
    factory = bench.ask(client("parameters"))[0].payload
    changed = factory[:40] + struct.pack("<f", 0.05) + factory[44:]
    bench.ask(wire.encode_frame(2001, changed))
    assert bench.ask(client("parameters"))[0].payload == changed
    bench.ask(command(2000, 1, 0))
    assert bench.ask(client("parameters"))[0].payload == factory


def test_power_on_timeline() -> None:
    bench = Bench(DeviceConfig(), power_on_ns=7 * S)
    bench.run(30.0)
    packets = bench.device.packet_log.packets
    imu, points = packets[packets["type"] == 104], packets[packets["type"] == 102]
    assert imu["start_ns"][0] == 7 * S + 4 * S
    assert 0 <= points["start_ns"][0] - (7 + 25) * S < 4_639_000


@pytest.mark.parametrize("scale", [0.0, 0.1])
def test_the_timeline_can_be_compressed(scale: float) -> None:
    bench = Bench(DeviceConfig(power=PowerConfig(boot_scale=scale)))
    bench.run(3.0)
    packets = bench.device.packet_log.packets
    assert packets["start_ns"][packets["type"] == 104][0] == round(4 * scale * S)
    assert 0 <= packets["start_ns"][packets["type"] == 102][0] - 25 * scale * S < 4_639_000


def test_rates_and_sequence_numbers() -> None:
    bench = Bench()
    count = bench.count(60.0)
    assert count[104] == 60 * 250
    assert count[102] == int((60 - 0.00246) / 0.004639) + 1
    for packet_type in (102, 104):
        seq = bench.device.packet_log.of_type(packet_type)["seq"]
        assert (seq == np.arange(len(seq)) % 1025).all()


def test_a_points_packet_is_stamped_at_its_first_slot_and_leaves_after_its_last() -> None:
    bench = Bench(delays=DelayConfig(points_delay_us=200.0, imu_delay_us=100.0))
    times = {identity(read(data)[0]): time for time, data in bench.run(1.0)}
    packets = bench.device.packet_log.packets
    assert len(times) == len(packets)
    for row in packets:
        key = int(row["type"]), int(row["seq"]), int(row["stamp_ns"])
        assert times[key] == row["left_ns"]
    late = packets["left_ns"] - packets["start_ns"]
    assert set(late[packets["type"] == 104]) == {100_000}
    sweep = 299 * 4_639_000 / 600
    assert late[packets["type"] == 102] == pytest.approx(sweep + 200_000, abs=2)


def test_the_measurement_is_the_scanners_and_the_frame_is_right() -> None:
    bench = Bench()
    frames = [read(data)[0] for _, data in bench.run(0.5)]
    expected, _ = PatternScanner().packets(0, 50)
    points = [frame.payload for frame in frames if frame.packet_type == 102]
    assert [payload[16:] for payload in points[:50]] == [row.tobytes()[16:] for row in expected]
    assert struct.unpack_from("<I", points[0], 4) == (1020,)
    samples, _ = StillInertial().samples(0, 1)
    imu = next(frame.payload for frame in frames if frame.packet_type == 104)
    assert imu[16:] == samples.tobytes()[16:]
    assert struct.unpack_from("<I", imu, 4) == (56,)


def test_standby_stops_both_streams_and_start_brings_the_imu_back_first() -> None:
    bench = Bench(DeviceConfig(power=PowerConfig(imu_s=0.0, points_s=0.0, link_s=0.0)))
    bench.run(1.0)
    bench.ask(command(100, 2, 1))
    assert bench.count(5.0) == {}
    began = bench.now
    assert acks(bench.ask(client("start"))) == [(100, 2, 0, OK)]
    bench.run(20.0)
    packets = bench.device.packet_log.packets
    new = packets[packets["start_ns"] > began]
    imu, points = new[new["type"] == 104], new[new["type"] == 102]
    assert 0 <= imu["start_ns"][0] - (began + S) < 4_000_000
    assert 0 <= points["start_ns"][0] - (began + 15 * S) < 4_639_000
    assert (
        imu["seq"][0]
        == packets[(packets["type"] == 104) & (packets["start_ns"] < began)]["seq"][-1] + 1
    )


def test_start_while_running_changes_nothing() -> None:
    bench, other = Bench(), Bench()
    for item in (bench, other):
        item.run(1.0)
    bench.device.command(client("start"), bench.now)
    answered = [item for item in bench.run(3.0) if len(item[1]) != 40]
    assert answered == other.run(3.0)


def test_some_units_do_not_wake() -> None:
    bench = Bench(power=PowerConfig(boot_scale=0.0, wakes=False))
    bench.run(0.1)
    bench.ask(command(100, 2, 1))
    bench.ask(client("start"))
    assert bench.count(30.0) == {}
    bench.ask(client("reset"))
    assert bench.count(1.0)[104] == 250


def test_reset_is_a_reboot() -> None:
    bench = Bench(DeviceConfig(power=PowerConfig(boot_scale=0.1)))
    bench.run(10.0)
    assert bench.ask(client("reset")) == []
    began = bench.now - MS
    bench.run(10.0)
    packets = bench.device.packet_log.packets
    new = packets[packets["boot"] == 1]
    assert (packets["boot"][packets["start_ns"] < began] == 0).all()
    first = new[0]
    assert first["type"] == 104
    assert first["seq"] == 0
    assert 0 <= first["start_ns"] - (began + 0.4 * S) < 4 * MS
    assert first["stamp_ns"] == int((int(first["start_ns"]) - began) / 1.99866)
    assert new[new["type"] == 102]["seq"][0] == 0
    assert 0 <= new[new["type"] == 102]["start_ns"][0] - (began + 2.5 * S) < 4_639_000


def test_what_follows_a_reset_in_the_same_datagram_is_forgotten() -> None:
    bench = Bench()
    bench.run(1.0)
    assert bench.ask(client("reset") + command(100, 2, 1)) == []
    assert bench.device.boots == 1
    assert bench.count(1.0)[104] == 250, "it did not go to standby"


def test_network_settings_come_into_force_after_a_reset() -> None:
    bench = Bench()
    before = bench.device.network
    wanted = before._replace(lidar_ip="127.0.0.9", user_ip="127.0.0.8", user_port=7000)
    bench.ask(wire.encode_frame(108, network_payload(wanted)))
    assert bench.device.network == before
    assert bench.device.flash.network == wanted
    bench.ask(client("reset"))
    assert bench.device.network == wanted
    bench.ask(command(100, 5, 0))
    bench.ask(client("reset"))
    assert bench.device.network == before


def test_network_bytes_are_in_dotted_order() -> None:
    bench = Bench()
    payload = bytes([192, 168, 1, 62, 192, 168, 1, 2, 192, 168, 1, 1, 255, 255, 255, 0])
    bench.ask(wire.encode_frame(108, payload + struct.pack("<HH", 6101, 6201)))
    assert bench.device.flash.network == (
        "192.168.1.62", "192.168.1.2", "192.168.1.1", "255.255.255.0", 6101, 6201,
    )  # fmt: skip


def test_the_hardware_address_is_stored() -> None:
    bench = Bench()
    bench.ask(wire.encode_frame(109, bytes.fromhex("0200000000070000")))
    assert bench.device.flash.mac == "02:00:00:00:00:07"


def test_imu_off_and_wide_view_act_at_once() -> None:
    bench = Bench()
    bench.run(1.0)
    bench.ask(command(2002, int(WorkMode.IMU_OFF | WorkMode.WIDE_FOV)))
    frames = bench.frames(1.0)
    assert Counter(frame.packet_type for frame in frames)[104] == 0
    angle, increment = struct.unpack_from("<2f", frames[5].payload, 104)
    assert angle == pytest.approx(-0.105, abs=0.001)
    assert np.degrees(increment * 300 + 2 * angle) == pytest.approx(180.0, abs=0.1)
    bench.ask(client("mode 0"))
    assert bench.count(1.0)[104] in (249, 250)


def test_2d_mode_acts_after_a_restart_and_comes_in_four_datagrams() -> None:
    bench = Bench()
    bench.ask(command(2002, int(WorkMode.MODE_2D)))
    assert bench.count(1.0)[103] == 0
    bench.ask(client("reset"))
    datagrams = bench.run(1.0)
    frames = read(b"".join(data for _, data in datagrams))
    assert Counter(frame.packet_type for frame in frames)[103] in (49, 50)
    assert max(len(data) for _, data in datagrams) == 1472
    sizes = [len(data) for _, data in datagrams if len(data) != 80]
    assert sizes[:8] == [1472, 1472, 1472, 1120] * 2
    row = np.frombuffer(
        next(f.payload for f in frames if f.packet_type == 103), wire.POINTS_2D_PAYLOAD
    )
    assert row["point_num"][0] == 1800


def test_the_serial_bit_loses_ethernet_at_the_next_boot() -> None:
    bench = Bench()
    bench.ask(command(2002, int(WorkMode.SERIAL)))
    assert bench.count(0.1)[104] == 25
    bench.ask(client("reset"))
    assert bench.count(5.0) == {}
    assert bench.ask(client("mode 0")) == []
    assert bench.device.next_ns is None


def test_a_unit_on_its_serial_port_answers_there() -> None:
    bench = Bench(flash=stored(WorkMode.SERIAL), link=Link.SERIAL)
    assert bench.count(1.0)[104] == 250
    assert acks(bench.ask(client("latency 101"))) == [(2000, 6, 101, OK)]


def test_wait_for_start_waits() -> None:
    bench = Bench(flash=stored(WorkMode.WAIT_FOR_START))
    assert bench.count(5.0) == {}
    assert acks(bench.ask(client("version"))) == [(2000, 4, 0, NOT_READY)]
    bench.ask(client("start"))
    assert bench.count(1.0)[102] > 200
    assert [frame.packet_type for frame in bench.ask(client("version"))] == [105, 101]


def test_the_vendors_client_gets_what_it_waits_for() -> None:
    bench = Bench(DeviceConfig(power=PowerConfig(boot_scale=0.05)))
    bench.run(1.5)
    for name in ("start", "mode 0", "reset"):
        bench.ask(client(name))
        bench.run(1.0)
    bench.run(2.0)
    sync = command(106, 1_800_000_000, 5)
    answers = bench.ask(sync + client("version") + client("parameters") + client("latency 101"))
    assert [frame.packet_type for frame in answers] == [101, 105, 101, 2001, 101, 101]
    assert acks(answers)[-1] == (2000, 6, 101, OK)
    assert identity(bench.frames(0.1)[0])[2] // S == 1_800_000_000


@pytest.mark.parametrize("cut", [1, 4, 11, 12, 31])
def test_commands_may_be_split_and_follow_garbage(cut: int) -> None:
    bench = Bench()
    bench.run(1.0)
    stream = b"\x55\x55\xaa" + client("latency 101")
    assert bench.ask(stream[:cut]) == []
    assert acks(bench.ask(stream[cut:])) == [(2000, 6, 101, OK)]


@pytest.mark.parametrize("prefix", [wire.MAGIC, client("start")[:8] + b"\x20\0\0\0\0\0"])
def test_a_command_may_begin_within_what_looked_like_one(prefix: Any) -> None:
    bench = Bench()
    bench.run(1.0)
    assert acks(bench.ask(prefix + client("latency 101") + bytes(20)))[-1] == (2000, 6, 101, OK)


def test_half_a_command_costs_itself_alone() -> None:
    bench = Bench()
    bench.run(1.0)
    assert bench.ask(client("start")[:20]) == []
    assert acks(bench.ask(client("latency 101")))[-1] == (2000, 6, 101, OK)


def test_it_does_not_matter_how_often_one_looks() -> None:
    whole, fine = Bench(), Bench()
    whole.run(2.0)
    whole.ask(client("latency 101"))
    whole.run(1.0)
    while (due := fine.device.next_ns) is not None and due <= 2 * S:
        fine.log += fine.device.advance(due)
    fine.now = 2 * S
    fine.device.command(client("latency 101"), fine.now)
    while (due := fine.device.next_ns) is not None and due <= whole.now:
        fine.log += fine.device.advance(due)
    assert fine.log == whole.log
    assert (fine.device.packet_log.packets == whole.device.packet_log.packets).all()


def test_next_is_when_the_next_datagram_leaves() -> None:
    bench = Bench()
    for _ in range(100):
        due = bench.device.next_ns
        assert due is not None
        assert bench.device.advance(due - 1) == []
        assert [time for time, _ in bench.device.advance(due)] == [due]


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(max_size=300), max_size=10))
def test_garbage_never_hurts(pieces: Any) -> None:
    inbox = Inbox()
    for piece in pieces:
        list(inbox.feed(piece))
    inbox_size = len(inbox._buffer)
    assert inbox_size <= 300
    found = list(inbox.feed(bytes(256) + client("latency 101")))
    assert found[-1].payload == struct.pack("<2I", 6, 101)


def test_flash_survives_as_text() -> None:
    bench = Bench()
    bench.ask(command(2002, 5))
    bench.ask(wire.encode_frame(109, bytes.fromhex("0200000000070000")))
    assert Flash.from_json(bench.device.flash.to_json()) == bench.device.flash


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"network": {}}', '{"network": 3}', "null"])
def test_broken_flash_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="stored settings"):
        Flash.from_json(text)


@pytest.mark.parametrize(
    ("groups", "name"),
    [
        ({"addresses": AddressConfig(lidar_ip="l2.local")}, "lidar_ip"),
        ({"addresses": AddressConfig(host="256.0.0.1")}, "host"),
        ({"identity": IdentityConfig(firmware="2.8")}, "firmware"),
        ({"identity": IdentityConfig(mac="1234")}, "mac"),
    ],
)
def test_wrong_settings_are_named(groups: Any, name: str) -> None:
    with pytest.raises(SettingError, match=f"parameter '{name}'"):
        VirtualL2(DeviceConfig(power=READY, **groups), PatternScanner(), StillInertial())
