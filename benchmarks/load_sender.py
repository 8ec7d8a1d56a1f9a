"""Sends what several sensors of any packet rate would send, cheaply: one process for all.

``python -m benchmarks.load_sender RATE SECONDS PORT...`` sends to each port of 127.0.0.1 from an
address of its own (127.0.1.1, 127.0.1.2, ...), as a unit whose mirror and IMU run RATE times as
fast. It prints what it sent as JSON, with ``--instants`` also when each point packet was sent.
All packets are made before the first one is sent.
"""

from __future__ import annotations

import heapq
import json
import socket
import struct
import sys
import time
import zlib
from collections.abc import Iterator
from operator import itemgetter
from typing import Final

from l2lidar_node.emulator.link.port import unread
from l2lidar_node.emulator.unit.pattern import PatternScanner, StillInertial
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import PacketType

_RATIO: Final = 1.99866  # true seconds per second of a unit's clock
_VARIANTS: Final = 64  # different packets per stream, then they come again
_STAMP: Final = struct.Struct("<I4xII")
_LAST_SLOT_NS: Final = 150_000  # after the last slot a packet leaves
_UPTIME_NS: Final = 10_000_000_000  # of the unit at its first packet
_NS: Final = 1_000_000_000
_ROOM_S: Final = 60.0  # longest wait for room in a socket


def address(number: int) -> str:
    """Return the address of the sensor with this number, from 0."""
    return f"127.0.1.{1 + number}"


def _packets(kind: PacketType, rate: float, seconds: float) -> Iterator[tuple[int, bytes]]:
    """Yield when each packet of a type leaves after the start [ns], and the packet."""
    if kind == PacketType.IMU:
        payloads, _ = StillInertial().samples(0, _VARIANTS)
        period_ns = _NS / wire.IMU_RATE_HZ / rate
        delay_ns = _LAST_SLOT_NS
    else:
        payloads, _ = PatternScanner().packets(0, _VARIANTS)
        for name in ("time_increment", "scan_period"):
            payloads[name] /= rate
        period_ns = wire.MIRROR_PERIOD_S * _NS / rate
        delay_ns = _LAST_SLOT_NS + round(period_ns / 2)
    frames = [bytearray(wire.encode_frame(kind, item.tobytes())) for item in payloads]
    end = len(frames[0]) - wire.TAIL.size
    for number in range(round(seconds * _NS / period_ns)):
        frame = frames[number % _VARIANTS]
        stamp = round((_UPTIME_NS + number * period_ns) / _RATIO)
        _STAMP.pack_into(frame, wire.HEADER.size, number % wire.SEQ_MODULUS, *divmod(stamp, _NS))
        struct.pack_into("<I", frame, end, zlib.crc32(memoryview(frame)[wire.HEADER.size : end]))
        yield round(number * period_ns) + delay_ns, bytes(frame)


def main() -> int:
    """Send for so long as the command line says."""
    arguments = [item for item in sys.argv[1:] if item != "--instants"]
    rate, seconds = float(arguments[0]), float(arguments[1])
    ends = []
    for number, port in enumerate(arguments[2:]):
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind((address(number), 0))
        ends.append((sock, ("127.0.0.1", int(port))))
    kinds = (PacketType.POINTS_3D, PacketType.IMU)
    streams = (_packets(kind, rate, seconds) for kind in kinds)
    *packets, last = heapq.merge(*streams, key=itemgetter(0))
    instants = []
    late = 0
    begin = time.time_ns()
    for due, data in packets:
        now = time.time_ns() - begin
        if now < due:
            time.sleep((due - now) * 1e-9)
            now = time.time_ns() - begin
        late = max(late, now - due)
        instants.append(begin + now)
        for sock, end in ends:
            sock.sendto(data, end)
    lasted = (time.time_ns() - begin) / 1e9
    for sock, end in ends:  # the kernel says with the next datagram what it dropped before
        until = time.monotonic() + _ROOM_S
        while unread(*end) and time.monotonic() < until:
            time.sleep(0.05)
        sock.sendto(last[1], end)
    told: dict[str, object] = {
        "sent": len(packets) + 1, "seconds": lasted, "latest_ms": late / 1e6
    }  # fmt: skip
    if "--instants" in sys.argv:
        size = wire.FRAME_SIZES[PacketType.POINTS_3D]
        sent = zip(instants, packets, strict=True)
        told["points_sent_ns"] = [at for at, (_, data) in sent if len(data) == size]
    print(json.dumps(told))
    return 0


if __name__ == "__main__":
    sys.exit(main())
