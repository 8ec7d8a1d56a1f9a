"""Packet decoder: frame to typed packet or decode error."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from l2lidar_node.protocol import wire
from l2lidar_node.protocol.framing import Frame
from l2lidar_node.types import Datagram, DeviceNs, Quaternion, Vector3, new_tuple

NS: Final = 1_000_000_000

# Measurements are decoded hundreds of times a second: one precompiled struct each instead of a
# dtype view.
_IMU = struct.Struct("<4I10f")
_IMU_FRAME = struct.Struct(f"<{wire.HEADER.size}s4I10fI6x2s")
_IMU_HEADER: Final = wire.HEADER.pack(wire.MAGIC, wire.PacketType.IMU, _IMU_FRAME.size)
_PAYLOAD: Final = slice(wire.HEADER.size, -wire.TAIL.size)  # of a whole frame

_MAX_FIELD: Final = 1e6  # in any unit: all real ones are below 1e4, and points must fit float32
_MAX_TIME_INCREMENT_S: Final = 1e-3
_MIN_QUATERNION_NORM: Final = 0.5  # with its IMU switched off a unit may send zeros
_MAX_RATE: Final = 1e3  # [rad/s]; broken units have been seen to send 1e24
_MAX_ACCELERATION: Final = 1e4  # [m/s^2]


class PointPacket(NamedTuple):
    """One packet of ranges, still raw.

    Attributes
    ----------
    packet_type : int
        ``POINTS_3D`` or ``POINTS_2D``.
    seq : int
        Number within its type.
    stamp : DeviceNs
        Instant of the first slot.
    duration_ns : int
        From the first slot to the last one, in true time, rounded up.
    head_angle : float
        Head angle at the first slot [rad]; 0 for 2D packets.
    payload : bytes
        The whole payload, one item of ``wire.PAYLOADS[packet_type]``.
    """

    packet_type: int
    seq: int
    stamp: DeviceNs
    duration_ns: int
    head_angle: float
    payload: bytes


class ImuPacket(NamedTuple):
    """One IMU packet; the quaternion is normalised, IMU to a z-up world."""

    seq: int
    stamp: DeviceNs
    orientation_wxyz: Quaternion
    angular_velocity: Vector3
    linear_acceleration: Vector3


@dataclass(frozen=True, slots=True)
class Version:
    """Identity of a unit; versions as printed, most significant number first."""

    hardware: str
    firmware: str
    name: str
    date: str
    reserve: str


@dataclass(frozen=True, slots=True)
class Ack:
    """The device's answer to a command; ``status`` need not be a :class:`wire.AckStatus`."""

    packet_type: int
    command: int
    value: int
    status: int


@dataclass(frozen=True, slots=True)
class Parameters:
    """The parameter block; only what has a known meaning is named.

    Attributes
    ----------
    work_mode : int
        Bits of :class:`wire.WorkMode`.
    range_min, range_max : float or None
        [m]; None when the firmware's block is too short to hold them.
    payload : bytes
        The block as it came.
    """

    work_mode: int
    range_min: float | None
    range_max: float | None
    payload: bytes


@dataclass(frozen=True, slots=True)
class UnknownPacket:
    """A good frame of an unknown type, or of one that only a host sends."""

    packet_type: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class DecodeError:
    """A good frame with impossible content.

    Attributes
    ----------
    packet_type : int
    reason : str
        One of a fixed set of words, fit for a counter's name.
    """

    packet_type: int
    reason: str


Packet = PointPacket | ImuPacket | Version | Ack | Parameters | UnknownPacket | DecodeError


def decode(frame: Frame) -> Packet:
    """Return the typed packet of a frame, or why there is none. Never raises."""
    decoder = _DECODERS.get(frame.packet_type)
    if decoder is None:
        return UnknownPacket(frame.packet_type, frame.payload)
    return decoder(frame.payload)


class _PointLayout(NamedTuple):
    """Layout of a point packet."""

    packet_type: int
    size: int
    capacity: int
    fields: struct.Struct  # time increment and number of points are the last ones
    frame: struct.Struct  # the same fields, the CRC and the end mark
    head_angle: int | None  # place among the fields


_INTEGERS: Final = 4  # fields before the floats


def _layout(
    packet_type: wire.PacketType, capacity: int, fields: str, head_angle: int | None
) -> _PointLayout:
    size = wire.PAYLOADS[packet_type].itemsize
    layout = struct.Struct(f"<{fields}")
    rest = size - layout.size
    frame = struct.Struct(f"<{wire.HEADER.size}x{fields}{rest}xI6x2s")
    return _PointLayout(int(packet_type), size, capacity, layout, frame, head_angle)


_POINTS_3D: Final = _layout(wire.PacketType.POINTS_3D, wire.POINTS_PER_3D_PACKET, "4I36x8f8fI", 12)
_POINTS_2D: Final = _layout(
    wire.PacketType.POINTS_2D, wire.POINTS_PER_2D_PACKET, "4I36x8f6fI", None
)
_LAYOUTS: Final = {layout.packet_type: layout for layout in (_POINTS_3D, _POINTS_2D)}


def _points(layout: _PointLayout, payload: bytes) -> PointPacket | DecodeError:
    if len(payload) != layout.size:
        return DecodeError(layout.packet_type, "length")
    return _point_packet(layout, layout.fields.unpack_from(payload), payload)


def _point_packet(
    layout: _PointLayout, fields: Sequence[Any], payload: bytes
) -> PointPacket | DecodeError:
    packet_type, _, capacity, _, _, head_angle = layout
    seq, _, sec, nsec = fields[:_INTEGERS]
    time_increment, count = fields[-2:]
    if count > capacity:
        return DecodeError(packet_type, "point_num")
    if nsec >= NS:
        return DecodeError(packet_type, "stamp")
    length = math.hypot(*fields[_INTEGERS:-1])  # one NaN or infinity anywhere makes it one
    if not length <= _MAX_FIELD:
        is_finite = math.isfinite(length)
        return DecodeError(packet_type, "implausible" if is_finite else "not_finite")
    if not 0.0 < time_increment < _MAX_TIME_INCREMENT_S:
        return DecodeError(packet_type, "time_increment")
    stamp = sec * NS + nsec
    duration_ns = math.ceil((count - 1) * time_increment * NS) if count else 0
    angle = 0.0 if head_angle is None else fields[head_angle]
    return new_tuple(PointPacket, (packet_type, seq, stamp, duration_ns, angle, payload))


def decode_points(datagrams: Sequence[Datagram]) -> list[PointPacket] | None:
    """Decode whole frames of points, in half the time that they take one by one.

    Parameters
    ----------
    datagrams : sequence of Datagram
        Not empty. Each has the size and the header of a frame of points of the same type.

    Returns
    -------
    list of PointPacket or None
        Those that :class:`~l2lidar_node.protocol.framing.Framer` and :func:`decode` make of them.
        None if anything is wrong with one: these tell what.
    """
    layout = _LAYOUTS[wire.HEADER.unpack_from(datagrams[0].data)[1]]
    unpack = layout.frame.unpack
    packets = []
    for data, _ in datagrams:
        payload = data[_PAYLOAD]
        *fields, crc, end = unpack(data)
        if end != wire.TAIL_END or crc != zlib.crc32(payload):
            return None
        packet = _point_packet(layout, fields, payload)
        if isinstance(packet, DecodeError):
            return None
        packets.append(packet)
    return packets


def decode_imu(data: bytes) -> ImuPacket | None:
    """Decode a datagram that is one frame of the IMU, faster than a framer and :func:`decode`.

    None if it is not a good one: these tell what.
    """
    header, *fields, crc, end = _IMU_FRAME.unpack(data)
    if header != _IMU_HEADER or end != wire.TAIL_END or crc != zlib.crc32(data[_PAYLOAD]):
        return None
    packet = _imu_packet(fields)
    return packet if isinstance(packet, ImuPacket) else None


def _imu(payload: bytes) -> ImuPacket | DecodeError:
    if len(payload) != _IMU.size:
        return DecodeError(wire.PacketType.IMU, "length")
    return _imu_packet(_IMU.unpack(payload))


def _imu_packet(fields: Sequence[Any]) -> ImuPacket | DecodeError:
    seq, _, sec, nsec, w, x, y, z, p, q, r, ax, ay, az = fields
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not (
        nsec < NS
        and _MIN_QUATERNION_NORM <= norm < math.inf
        and -_MAX_RATE <= p <= _MAX_RATE
        and -_MAX_RATE <= q <= _MAX_RATE
        and -_MAX_RATE <= r <= _MAX_RATE
        and -_MAX_ACCELERATION <= ax <= _MAX_ACCELERATION
        and -_MAX_ACCELERATION <= ay <= _MAX_ACCELERATION
        and -_MAX_ACCELERATION <= az <= _MAX_ACCELERATION
    ):
        return DecodeError(wire.PacketType.IMU, _wrong_with(nsec, norm, p, q, r, ax, ay, az))
    attitude = w / norm, x / norm, y / norm, z / norm
    return new_tuple(ImuPacket, (seq, sec * NS + nsec, attitude, (p, q, r), (ax, ay, az)))


def _wrong_with(nsec: int, norm: float, *components: float) -> str:
    """Return why an IMU packet is not believed, the first reason that applies."""
    if nsec >= NS:
        return "stamp"
    if not math.isfinite(norm + sum(components)):
        return "not_finite"
    return "quaternion_norm" if norm < _MIN_QUATERNION_NORM else "implausible"


def _version(payload: bytes) -> Version | DecodeError:
    if len(payload) != wire.VERSION_PAYLOAD.itemsize:
        return DecodeError(wire.PacketType.VERSION, "length")
    block = np.frombuffer(payload, wire.VERSION_PAYLOAD)[0]
    return Version(
        hardware=".".join(str(number) for number in block["hardware"]),
        firmware=".".join(str(number) for number in block["software"]),
        name=_text(block["name"]),
        date=_text(block["date"]),
        reserve=_text(block["reserve"]),
    )


def _text(raw: bytes) -> str:
    return bytes(raw).split(b"\0", 1)[0].decode("ascii", "replace")


def _ack(payload: bytes) -> Ack | DecodeError:
    if len(payload) != wire.ACK_PAYLOAD.itemsize:
        return DecodeError(wire.PacketType.ACK, "length")
    return Ack(*struct.unpack("<4I", payload))


def _parameters(payload: bytes) -> Parameters | DecodeError:
    fields = wire.PARAMETERS_PAYLOAD.fields
    assert fields is not None
    if len(payload) < fields["work_mode"][1] + 4:
        return DecodeError(wire.PacketType.PARAMETERS, "length")

    def meters(name: str) -> float | None:
        offset = fields[name][1]
        if len(payload) < offset + 4:
            return None
        return float(struct.unpack_from("<f", payload, offset)[0])

    return Parameters(
        work_mode=struct.unpack_from("<I", payload, fields["work_mode"][1])[0],
        range_min=meters("range_min"),
        range_max=meters("range_max"),
        payload=payload,
    )


_DECODERS: Final[dict[int, Callable[[bytes], Packet]]] = {
    wire.PacketType.POINTS_3D: partial(_points, _POINTS_3D),
    wire.PacketType.POINTS_2D: partial(_points, _POINTS_2D),
    wire.PacketType.IMU: _imu,
    wire.PacketType.VERSION: _version,
    wire.PacketType.ACK: _ack,
    wire.PacketType.PARAMETERS: _parameters,
}
