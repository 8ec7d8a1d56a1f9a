"""The layouts against the protocol's own offsets, counted from the frame's first byte."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
import pytest

from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import PacketType

SIZES = {
    100: 32, 101: 40, 102: 1044, 103: 5536, 104: 80, 105: 104, 106: 32, 107: 28, 108: 44, 109: 32,
    2000: 32, 2001: 196, 2002: 28,
}  # fmt: skip

OFFSETS_3D = {
    "info": 12, "state": 28, "calibration": 64, "com_horizontal_angle_start": 96,
    "com_horizontal_angle_step": 100, "scan_period": 104, "range_min": 108, "range_max": 112,
    "angle_min": 116, "angle_increment": 120, "time_increment": 124, "point_num": 128,
    "ranges": 132, "intensities": 732,
}  # fmt: skip
OFFSETS_2D = {
    "info": 12, "state": 28, "calibration": 64, "scan_period": 96, "range_min": 100,
    "range_max": 104, "angle_min": 108, "angle_increment": 112, "time_increment": 116,
    "point_num": 120, "ranges": 124, "intensities": 3724,
}  # fmt: skip
OFFSETS_IMU = {
    "info": 12, "quaternion_wxyz": 28, "angular_velocity": 44, "linear_acceleration": 56,
}  # fmt: skip
OFFSETS_VERSION = {"hardware": 12, "software": 16, "name": 20, "date": 44, "reserve": 52}
OFFSETS_ACK = {"packet_type": 12, "command": 16, "value": 20, "status": 24}
OFFSETS_PARAMETERS = {
    "unknown_0": 12, "unknown_4": 16, "work_mode": 24, "unknown_16": 28, "unknown_24": 36,
    "range_max": 40, "range_min": 44, "unknown_36": 48, "calibration_3d": 52,
    "calibration_3d_wide": 84, "calibration_2d": 116, "calibration_2d_wide": 148,
    "unknown_168": 180,
}  # fmt: skip


def test_commands_of_both_families_have_the_protocols_numbers() -> None:
    user, factory = wire.UserCommand, wire.Command
    assert [user.RESET, user.STANDBY, user.VERSION, user.LATENCY] == [1, 2, 3, 4]
    assert [user.CONFIG_RESET, user.CONFIG_GET, user.AUTO_STANDBY] == [5, 6, 7]
    assert [factory.PARAM_RESET, factory.PARAM_SAVE, factory.PARAM_GET] == [1, 2, 3]
    assert [factory.VERSION, factory.STANDBY, factory.LATENCY] == [4, 5, 6]
    assert factory.CONFIG_RESET == 7


def test_frame_sizes_are_the_protocols() -> None:
    assert wire.FRAME_SIZES == SIZES
    assert max(SIZES.values()) <= wire.MAX_FRAME


def test_every_packet_type_has_a_layout() -> None:
    assert set(wire.PAYLOADS) == set(PacketType)


@pytest.mark.parametrize(
    ("packet_type", "offsets"),
    [
        (PacketType.POINTS_3D, OFFSETS_3D),
        (PacketType.POINTS_2D, OFFSETS_2D),
        (PacketType.IMU, OFFSETS_IMU),
        (PacketType.VERSION, OFFSETS_VERSION),
        (PacketType.ACK, OFFSETS_ACK),
        (PacketType.PARAMETERS, OFFSETS_PARAMETERS),
    ],
)
def test_fields_stand_where_the_protocol_says(packet_type: Any, offsets: Any) -> None:
    fields = wire.PAYLOADS[packet_type].fields
    assert fields is not None
    assert {name: entry[1] + 12 for name, entry in fields.items()} == offsets


def test_blocks_stand_where_the_protocol_says() -> None:
    state = {name: entry[1] for name, entry in (wire.INSIDE_STATE.fields or {}).items()}
    assert list(state.values()) == [0, 4, 8, 12, 16, 20, 24, 28, 32]
    assert state["com_rotation_period"] == 4
    assert state["imu_temperature"] == 32
    calibration = {name: entry[1] for name, entry in (wire.CALIBRATION.fields or {}).items()}
    assert calibration == {
        "a_axis_dist": 0, "b_axis_dist": 4, "theta_angle_bias": 8, "alpha_angle_bias": 12,
        "beta_angle": 16, "xi_angle": 20, "range_bias": 24, "range_scale": 28,
    }  # fmt: skip


@pytest.mark.parametrize("packet_type", list(PacketType))
def test_layouts_are_little_endian_and_packed(packet_type: Any) -> None:
    def check(layout: np.dtype) -> int:
        if layout.fields is None:
            base = layout.base
            assert base.kind == "S" or base.itemsize == 1 or base == base.newbyteorder("<")
            return layout.itemsize
        return sum(check(entry[0]) for entry in layout.fields.values())

    layout = wire.PAYLOADS[packet_type]
    assert check(layout) == layout.itemsize


def test_encode_frame_is_what_the_protocol_shows() -> None:
    payload = struct.pack("<II", 2, 0)
    assert wire.encode_frame(100, payload).hex() == (
        "55aa050a 64000000 20000000 02000000 00000000 14d80727 00000000 0000 00ff".replace(" ", "")
    )


@pytest.mark.parametrize("size", [0, 1, 1020])
def test_crc_covers_the_payload_only(size: int) -> None:
    payload = bytes(range(256)) * 4
    payload = payload[:size]
    frame = wire.encode_frame(4242, payload)
    assert len(frame) == size + 24
    assert struct.unpack_from("<I", frame, 12 + size)[0] == zlib.crc32(payload)
    assert frame[-2:] == b"\x00\xff"
