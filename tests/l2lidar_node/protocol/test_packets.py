"""Typed packets out of payloads, and a reason where there is none."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, strategies as st

from l2lidar_node.protocol import wire
from l2lidar_node.protocol.framing import Frame, Framer
from l2lidar_node.protocol.packets import (
    Ack,
    DecodeError,
    ImuPacket,
    Parameters,
    PointPacket,
    UnknownPacket,
    Version,
    decode,
    decode_imu,
    decode_points,
)
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.types import Datagram, HostNs
from tests.support import build

KINDS = [PacketType.POINTS_3D, PacketType.POINTS_2D]
MAKERS = {PacketType.POINTS_3D: build.points_3d, PacketType.POINTS_2D: build.points_2d}


def patched(payload: bytes, offset: int, layout: str, value: float) -> bytes:
    """Return a payload with a value written at an offset of the frame (header included)."""
    changed = bytearray(payload)
    struct.pack_into(layout, changed, offset - wire.HEADER.size, value)
    return bytes(changed)


def reason(packet_type: int, payload: bytes) -> str:
    packet = decode(Frame(packet_type, payload))
    assert isinstance(packet, DecodeError), packet
    assert packet.packet_type == packet_type
    return packet.reason


def test_a_3d_packet_from_its_bytes() -> None:
    payload = bytearray(1020)
    struct.pack_into("<4I", payload, 0, 1023, 1020, 110, 406_000_123)
    struct.pack_into("<8f", payload, 84, 1.25, 2e-4, 0.0046, 0.05, 50.0, 0.0, 0.0105, 7.7e-6)
    struct.pack_into("<I", payload, 116, 300)
    packet = decode(Frame(102, bytes(payload)))
    assert isinstance(packet, PointPacket)
    assert packet.packet_type == PacketType.POINTS_3D
    assert packet.seq == 1023
    assert packet.stamp == 110_406_000_123
    assert packet.head_angle == 1.25
    assert packet.duration_ns == pytest.approx(299 * 7_700, abs=2)
    assert packet.payload == payload


def test_a_2d_packet() -> None:
    packet = decode(Frame(103, build.points_2d(7, 12_000_000_001, time_increment=5e-6)))
    assert isinstance(packet, PointPacket)
    assert (packet.packet_type, packet.seq) == (PacketType.POINTS_2D, 7)
    assert packet.stamp == 12_000_000_001
    assert packet.head_angle == 0.0
    assert packet.duration_ns == pytest.approx(1799 * 5_000, abs=2)


def test_an_imu_packet_from_its_bytes() -> None:
    payload = struct.pack(
        "<4I 4f 3f 3f", 5, 56, 3, 4, 0.9, 0.1, 0.2, 0.3, 0.5, 0.25, -0.5, 1.0, 2.0, 9.5
    )
    packet = decode(Frame(104, payload))
    assert isinstance(packet, ImuPacket)
    assert (packet.seq, packet.stamp) == (5, 3_000_000_004)
    norm = math.sqrt(0.81 + 0.01 + 0.04 + 0.09)
    assert packet.orientation_wxyz == pytest.approx(
        (0.9 / norm, 0.1 / norm, 0.2 / norm, 0.3 / norm), abs=1e-7
    )
    assert packet.angular_velocity == (0.5, 0.25, -0.5)
    assert packet.linear_acceleration == (1.0, 2.0, 9.5)


@pytest.mark.parametrize("norm", [0.5001, 0.9983, 1.0, 1.5])
def test_the_quaternion_is_normalised(norm: float) -> None:
    quaternion = np.array([0.5, -0.5, 0.5, 0.5]) * norm
    packet = decode(Frame(104, build.imu(quaternion_wxyz=quaternion.tolist())))
    assert isinstance(packet, ImuPacket)
    assert math.hypot(*packet.orientation_wxyz) == pytest.approx(1.0, abs=1e-12)
    assert packet.orientation_wxyz == pytest.approx((0.5, -0.5, 0.5, 0.5), abs=1e-6)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (0.49, 0, 0, 0)])
def test_an_imu_that_is_switched_off_is_dropped(quaternion: Any) -> None:
    assert reason(104, build.imu(quaternion_wxyz=list(quaternion))) == "quaternion_norm"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("offset", range(28, 68, 4))
def test_an_imu_value_that_is_no_number(offset: Any, value: Any) -> None:
    assert reason(104, patched(build.imu(), offset, "<f", value)) == "not_finite"


@pytest.mark.parametrize("offset", [44, 48, 52, 56, 60, 64])
def test_an_imu_value_beyond_any_sensor(offset: int) -> None:
    assert reason(104, patched(build.imu(), offset, "<f", 1e24)) == "implausible"
    limit = 1e3 if offset < 56 else 1e4
    assert reason(104, patched(build.imu(), offset, "<f", -1.1 * limit)) == "implausible"
    good = decode(Frame(104, patched(build.imu(), offset, "<f", -0.9 * limit)))
    assert isinstance(good, ImuPacket)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("offset", range(64, 128, 4))
def test_a_calibration_or_angle_of_3d_that_is_no_number(offset: Any, value: Any) -> None:
    assert reason(102, patched(build.points_3d(), offset, "<f", value)) == "not_finite"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("offset", range(64, 120, 4))
def test_a_calibration_or_angle_of_2d_that_is_no_number(offset: Any, value: Any) -> None:
    assert reason(103, patched(build.points_2d(), offset, "<f", value)) == "not_finite"


@pytest.mark.parametrize("offset", range(64, 124, 4))
@pytest.mark.parametrize("value", [3e38, -2e6])
def test_a_calibration_or_angle_beyond_any_unit(offset: Any, value: float) -> None:
    assert reason(102, patched(build.points_3d(), offset, "<f", value)) == "implausible"


@pytest.mark.parametrize("offset", range(36, 64, 4))
def test_health_that_is_no_number_costs_no_points(offset: Any) -> None:
    payload = patched(build.points_3d(), offset, "<f", math.nan)
    assert isinstance(decode(Frame(102, payload)), PointPacket)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("surplus", [1, 5000, 0xFFFF_FFFF])
def test_more_points_than_there_is_room_for(kind: Any, surplus: int) -> None:
    capacity = {PacketType.POINTS_3D: 300, PacketType.POINTS_2D: 1800}[kind]
    payload = MAKERS[kind](count=min(capacity + surplus, 0xFFFF_FFFF))
    assert reason(kind, payload) == "point_num"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [0, 1, 299, 300])
def test_fewer_points_are_fine(kind: Any, count: int) -> None:
    packet = decode(Frame(kind, MAKERS[kind](count=count, time_increment=1e-5)))
    assert isinstance(packet, PointPacket)
    assert packet.duration_ns == pytest.approx(max(count - 1, 0) * 10_000, abs=2)


@pytest.mark.parametrize("packet_type", [102, 103, 104])
@pytest.mark.parametrize("nsec", [1_000_000_000, 0xFFFF_FFFF])
def test_a_stamp_with_too_many_nanoseconds(packet_type: int, nsec: int) -> None:
    makers: dict[int, Any] = {102: build.points_3d, 103: build.points_2d, 104: build.imu}
    maker = makers[packet_type]
    assert reason(packet_type, patched(maker(), 24, "<I", nsec)) == "stamp"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("increment", [0.0, -7e-6, 1e-3, 0.5])
def test_a_time_increment_that_cannot_be(kind: Any, increment: float) -> None:
    assert reason(kind, MAKERS[kind](time_increment=increment)) == "time_increment"


@pytest.mark.parametrize("packet_type", [101, 102, 103, 104, 105])
@pytest.mark.parametrize("change", [-1, 1, 4])
def test_a_wrong_length(packet_type: int, change: int) -> None:
    size = wire.PAYLOADS[packet_type].itemsize
    assert reason(packet_type, bytes(size + change)) == "length"


def test_a_version() -> None:
    packet = decode(Frame(105, build.version()))
    assert packet == Version("2.2.1.1", "2.8.11.1", "YS-L2", "250715", "")


def test_a_version_with_full_and_foreign_text() -> None:
    packet = decode(Frame(105, build.version(name=b"x" * 24, date=b"\xff2507\x0099")))
    assert isinstance(packet, Version)
    assert packet.name == "x" * 24
    assert packet.date == "\N{REPLACEMENT CHARACTER}2507"


def test_an_ack() -> None:
    assert decode(Frame(101, struct.pack("<4I", 2000, 6, 101, 9))) == Ack(2000, 6, 101, 9)


@pytest.mark.parametrize(
    ("size", "range_min", "range_max"),
    [
        (16, None, None),
        (28, None, None),
        (32, None, 50.0),
        (36, 0.0625, 50.0),
        (172, 0.0625, 50.0),
    ],
)
def test_parameters_of_every_size_a_firmware_may_send(
    size: int, range_min: Any, range_max: Any
) -> None:
    payload = (build.parameters(17, 0.0625, 50.0) + bytes(40))[:size]
    assert decode(Frame(2001, payload)) == Parameters(17, range_min, range_max, payload)


def test_parameters_too_short_for_the_work_mode() -> None:
    assert reason(2001, bytes(15)) == "length"


@pytest.mark.parametrize("packet_type", [100, 106, 107, 108, 109, 2000, 2002, 0, 4242])
def test_what_only_hosts_send_is_unknown(packet_type: int) -> None:
    assert decode(Frame(packet_type, b"abc")) == UnknownPacket(packet_type, b"abc")


@given(
    st.one_of(st.sampled_from(list(wire.PacketType)), st.integers(0, 2**32 - 1)),
    st.binary(max_size=300),
)
@example(2001, b"")
def test_any_payload_decodes_to_something(packet_type: Any, payload: Any) -> None:
    decode(Frame(packet_type, payload))


@given(st.sampled_from([102, 103, 104, 105, 101, 2001]), st.randoms(use_true_random=False))
def test_any_payload_of_the_right_size_decodes_to_finite_values(
    packet_type: Any, random: Any
) -> None:
    payload = random.randbytes(wire.PAYLOADS[packet_type].itemsize)
    packet = decode(Frame(packet_type, payload))
    if isinstance(packet, PointPacket):
        assert math.isfinite(packet.head_angle)
        assert packet.duration_ns >= 0
    if isinstance(packet, ImuPacket):
        assert math.hypot(*packet.orientation_wxyz) == pytest.approx(1)
        assert all(map(math.isfinite, packet.angular_velocity + packet.linear_acceleration))


def one_by_one(data: bytes) -> Any:
    """Return the packet of a datagram that is one good frame; None if it is not."""
    found = [decode(item) for item in Framer().feed(data) if isinstance(item, Frame)]
    return found[0] if len(found) == 1 and isinstance(found[0], PointPacket | ImuPacket) else None


@st.composite
def whole_frames(draw: Any, kind: PacketType, first: int) -> bytes:
    """Draw a datagram of the size of a frame, good or with a word changed from a place on."""
    maker = build.imu if kind == PacketType.IMU else MAKERS[kind]
    payload = maker(draw(st.integers(0, 1024)), draw(st.integers(0, 2**40)))
    if draw(st.booleans()):  # an impossible value with a good checksum, or a harmless one
        word = struct.pack("<f", draw(st.floats(width=32)))
        at = 4 * draw(st.integers(0, 30))
        if at + 4 <= len(payload):
            payload = payload[:at] + word + payload[at + 4 :]
    data = bytearray(build.frame(kind, payload))
    if draw(st.integers(0, 3)) == 0:
        data[draw(st.integers(first, len(data) - 1))] ^= 1 << draw(st.integers(0, 7))
    return bytes(data)


@given(st.data(), st.sampled_from(KINDS))
def test_points_decoded_together_are_those_decoded_one_by_one(data: Any, kind: Any) -> None:
    frames = data.draw(st.lists(whole_frames(kind, wire.HEADER.size), min_size=1, max_size=4))
    expected = [one_by_one(frame) for frame in frames]
    packets = decode_points([Datagram(frame, HostNs(0)) for frame in frames])
    assert packets == (None if None in expected else expected)


@given(whole_frames(PacketType.IMU, 0))
def test_a_whole_frame_of_the_imu_is_what_the_framer_makes_of_it(frame: bytes) -> None:
    assert decode_imu(frame) == one_by_one(frame)
