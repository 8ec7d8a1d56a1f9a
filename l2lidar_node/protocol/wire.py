"""Wire format of the Unitree L2: numbers, layouts, sizes, and the frame.

Facts come from Unitree's BSD-3 headers (unilidar_sdk2) and from the behavior of its client. All
numbers are little-endian and packed. Sizes called ``size`` include the 12-byte header and the
12-byte tail; a ``payload`` is what stands between them. The CRC-32 covers the payload only.
"""

from __future__ import annotations

import struct
import zlib
from enum import IntEnum, IntFlag
from typing import Final

import numpy as np

MAGIC: Final = b"\x55\xaa\x05\x0a"
TAIL_END: Final = b"\x00\xff"
HEADER: Final = struct.Struct("<4sII")  # magic, packet type, size of the whole frame
TAIL: Final = struct.Struct("<II2s2s")  # crc of the payload, two ignored fields, end mark
OVERHEAD: Final = HEADER.size + TAIL.size

POINTS_PER_3D_PACKET: Final = 300
POINTS_PER_2D_PACKET: Final = 1800
MAX_DATAGRAM: Final = 1472  # the device never sends larger ones (no jumbo frames)

SEQ_MODULUS: Final = 1025
"""Sequence numbers of the units known so far count modulo this; readers learn the real one."""

LIDAR_IP: Final = "192.168.1.62"
LIDAR_PORT: Final = 6101
HOST_IP: Final = "192.168.1.2"
HOST_PORT: Final = 6201

IMU_RATE_HZ: Final = 250.0
MIRROR_PERIOD_S: Final = 0.004639  # one fast-mirror turn, so one 3D packet
PERIOD_2D_S: Final = 0.02  # of 2D packets
IMU_POSITION_M: Final = (-0.007698, -0.014655, 0.00667)  # in the cloud frame; axes are parallel
QUATERNION_NORM: Final = 0.9983  # what units really send


class PacketType(IntEnum):
    """Type of a frame's payload, in its header."""

    USER_COMMAND = 100
    ACK = 101
    POINTS_3D = 102
    POINTS_2D = 103
    IMU = 104
    VERSION = 105
    TIME_SYNC = 106
    WORK_MODE_CONFIG = 107
    NETWORK = 108
    MAC = 109
    COMMAND = 2000
    PARAMETERS = 2001
    WORK_MODE = 2002


class UserCommand(IntEnum):
    """``command`` of a :data:`COMMAND_PAYLOAD` in a packet of type 100."""

    RESET = 1
    STANDBY = 2  # value 0 starts rotation, 1 stops it
    VERSION = 3
    LATENCY = 4
    CONFIG_RESET = 5
    CONFIG_GET = 6
    AUTO_STANDBY = 7


class Command(IntEnum):
    """``command`` of a :data:`COMMAND_PAYLOAD` in a packet of type 2000 (the second family)."""

    PARAM_RESET = 1
    PARAM_SAVE = 2
    PARAM_GET = 3
    VERSION = 4
    STANDBY = 5
    LATENCY = 6
    CONFIG_RESET = 7


class AckStatus(IntEnum):
    """``status`` of an ACK."""

    OK = 1
    CRC_ERROR = 2
    HEADER_ERROR = 3
    BLOCK_ERROR = 4
    NOT_READY = 5


class WorkMode(IntFlag):
    """Bits of the work mode; the factory value is 0."""

    WIDE_FOV = 1 << 0  # 192 degrees instead of 180; acts at once
    MODE_2D = 1 << 1  # 2D instead of 3D; acts after a restart
    IMU_OFF = 1 << 2  # acts at once
    SERIAL = 1 << 3  # serial port instead of Ethernet; acts after a restart, and Ethernet is gone
    WAIT_FOR_START = 1 << 4  # stays in standby after power-on; acts after a restart


WORK_MODE_MASK: Final = 0x3F_FFFF  # what the official client lets through


DATA_INFO: Final = np.dtype(
    [("seq", "<u4"), ("payload_size", "<u4"), ("sec", "<u4"), ("nsec", "<u4")]
)
"""Head of every measurement; (sec, nsec) is the device clock."""

INSIDE_STATE: Final = np.dtype(
    [
        ("sys_rotation_period", "<u4"),  # [us] per turn of the fast mirror
        ("com_rotation_period", "<u4"),  # [us] per turn of the head
        ("dirty_index", "<f4"),  # [%]
        ("packet_lost_up", "<f4"),  # [1]
        ("packet_lost_down", "<f4"),  # [1]
        ("apd_temperature", "<f4"),  # [degC]
        ("apd_voltage", "<f4"),  # [V]
        ("laser_voltage", "<f4"),  # [V]
        ("imu_temperature", "<f4"),  # [degC]
    ]
)

CALIBRATION: Final = np.dtype(
    [
        ("a_axis_dist", "<f4"),  # [m]
        ("b_axis_dist", "<f4"),  # [m]
        ("theta_angle_bias", "<f4"),  # [rad]
        ("alpha_angle_bias", "<f4"),  # [rad]
        ("beta_angle", "<f4"),  # [rad]
        ("xi_angle", "<f4"),  # [rad]
        ("range_bias", "<f4"),  # [raw counts]
        ("range_scale", "<f4"),  # [m per raw count]
    ]
)

POINTS_3D_PAYLOAD: Final = np.dtype(
    [
        ("info", DATA_INFO),
        ("state", INSIDE_STATE),
        ("calibration", CALIBRATION),
        ("com_horizontal_angle_start", "<f4"),  # [rad] head angle at slot 0
        ("com_horizontal_angle_step", "<f4"),  # [rad] head advance per slot
        ("scan_period", "<f4"),  # [s] mirror turn, dark half included
        ("range_min", "<f4"),  # [m]
        ("range_max", "<f4"),  # [m]
        ("angle_min", "<f4"),  # [rad]
        ("angle_increment", "<f4"),  # [rad] per slot
        ("time_increment", "<f4"),  # [s] per slot, true time
        ("point_num", "<u4"),
        ("ranges", "<u2", (POINTS_PER_3D_PACKET,)),  # [raw counts], 0 = no return
        ("intensities", "u1", (POINTS_PER_3D_PACKET,)),
    ]
)

POINTS_2D_PAYLOAD: Final = np.dtype(
    [
        ("info", DATA_INFO),
        ("state", INSIDE_STATE),
        ("calibration", CALIBRATION),
        ("scan_period", "<f4"),
        ("range_min", "<f4"),
        ("range_max", "<f4"),
        ("angle_min", "<f4"),
        ("angle_increment", "<f4"),
        ("time_increment", "<f4"),
        ("point_num", "<u4"),
        ("ranges", "<u2", (POINTS_PER_2D_PACKET,)),
        ("intensities", "u1", (POINTS_PER_2D_PACKET,)),
    ]
)

IMU_PAYLOAD: Final = np.dtype(
    [
        ("info", DATA_INFO),
        ("quaternion_wxyz", "<f4", (4,)),  # body to world, norm about 0.9983
        ("angular_velocity", "<f4", (3,)),  # [rad/s]
        ("linear_acceleration", "<f4", (3,)),  # [m/s^2] specific force, +g on z when level
    ]
)

VERSION_PAYLOAD: Final = np.dtype(
    [
        ("hardware", "u1", (4,)),
        ("software", "u1", (4,)),
        ("name", "S24"),
        ("date", "S8"),
        ("reserve", "S40"),
    ]
)

ACK_PAYLOAD: Final = np.dtype(
    [("packet_type", "<u4"), ("command", "<u4"), ("value", "<u4"), ("status", "<u4")]
)

PARAMETERS_PAYLOAD: Final = np.dtype(
    [
        ("unknown_0", "u1", (4,)),
        ("unknown_4", "<u2", (4,)),
        ("work_mode", "<u4"),
        ("unknown_16", "<u4", (2,)),
        ("unknown_24", "<f4"),
        ("range_max", "<f4"),
        ("range_min", "<f4"),
        ("unknown_36", "<f4"),
        ("calibration_3d", CALIBRATION),
        ("calibration_3d_wide", CALIBRATION),
        ("calibration_2d", CALIBRATION),
        ("calibration_2d_wide", CALIBRATION),
        ("unknown_168", "u1", (4,)),
    ]
)
"""Layout as reverse-engineered in public; fields called unknown have no known meaning."""

COMMAND_PAYLOAD: Final = np.dtype([("command", "<u4"), ("value", "<u4")])
TIME_SYNC_PAYLOAD: Final = np.dtype([("sec", "<u4"), ("nsec", "<u4")])
WORK_MODE_PAYLOAD: Final = np.dtype([("mode", "<u4")])
NETWORK_PAYLOAD: Final = np.dtype(
    [
        ("lidar_ip", "u1", (4,)),
        ("user_ip", "u1", (4,)),
        ("gateway", "u1", (4,)),
        ("subnet_mask", "u1", (4,)),
        ("lidar_port", "<u2"),
        ("user_port", "<u2"),
    ]
)
MAC_PAYLOAD: Final = np.dtype([("mac", "u1", (6,)), ("reserve", "u1", (2,))])

PAYLOADS: Final[dict[int, np.dtype[np.void]]] = {
    PacketType.USER_COMMAND: COMMAND_PAYLOAD,
    PacketType.ACK: ACK_PAYLOAD,
    PacketType.POINTS_3D: POINTS_3D_PAYLOAD,
    PacketType.POINTS_2D: POINTS_2D_PAYLOAD,
    PacketType.IMU: IMU_PAYLOAD,
    PacketType.VERSION: VERSION_PAYLOAD,
    PacketType.TIME_SYNC: TIME_SYNC_PAYLOAD,
    PacketType.WORK_MODE_CONFIG: WORK_MODE_PAYLOAD,
    PacketType.NETWORK: NETWORK_PAYLOAD,
    PacketType.MAC: MAC_PAYLOAD,
    PacketType.COMMAND: COMMAND_PAYLOAD,
    PacketType.PARAMETERS: PARAMETERS_PAYLOAD,
    PacketType.WORK_MODE: WORK_MODE_PAYLOAD,
}
"""Payload layout of every known packet type."""

FRAME_SIZES: Final[dict[int, int]] = {
    int(packet_type): dtype.itemsize + OVERHEAD for packet_type, dtype in PAYLOADS.items()
}
"""Size of the whole frame [bytes] of every known packet type."""

MAX_FRAME: Final = 6000  # bound for types this table does not know [bytes]


def encode_frame(packet_type: int, payload: bytes) -> bytes:
    """Return the frame of a payload: header, payload, CRC and tail.

    Parameters
    ----------
    packet_type : int
        Number for the header, see :class:`PacketType`.
    payload : bytes
        The packed payload.

    Returns
    -------
    bytes
        ``len(payload) + 24`` bytes, ready for a datagram.
    """
    header = HEADER.pack(MAGIC, packet_type, len(payload) + OVERHEAD)
    return header + payload + TAIL.pack(zlib.crc32(payload), 0, b"\x00\x00", TAIL_END)
