"""Sends what several sensors of any packet rate would send, cheaply: one process for all.

``python -m tools.load_sender RATE SECONDS PORT...`` sends to each port of 127.0.0.1 from an
address of its own (127.0.1.1, 127.0.1.2, ...), as a unit whose mirror and IMU run RATE times as
fast. It prints what it sent as JSON.
"""

from __future__ import annotations

import json
import socket
import struct
import sys
import time
import zlib
from itertools import count
from typing import Final

from l2lidar_node import wire
from l2lidar_node.emulator.pattern import PatternScanner, StillInertial
from l2lidar_node.wire import PacketType

_RATIO: Final = 1.99866  # true seconds per second of a unit's clock
_MODULUS: Final = 1025
_VARIANTS: Final = 64  # different packets per stream, then they come again
_STAMP: Final = struct.Struct("<I4xII")
_LAST_SLOT_NS: Final = 150_000  # after the last slot a packet leaves


def address(number: int) -> str:
    """Return the address of the sensor with this number, from 0."""
    return f"127.0.1.{1 + number}"


class _Stream:
    """Packets of one type at even intervals; numbers and stamps are put in when they are sent."""

    def __init__(self, kind: PacketType, rate: float) -> None:
        self.sent = 0
        if kind == PacketType.IMU:
            payloads, _ = StillInertial().samples(0, _VARIANTS)
            self.period_ns = 1e9 / wire.IMU_RATE_HZ / rate
            self.delay_ns = _LAST_SLOT_NS
        else:
            payloads, _ = PatternScanner().packets(0, _VARIANTS)
            for name in ("time_increment", "scan_period"):
                payloads[name] /= rate
            self.period_ns = wire.MIRROR_PERIOD_S * 1e9 / rate
            self.delay_ns = _LAST_SLOT_NS + round(self.period_ns / 2)
        frames = [bytearray(wire.encode_frame(kind, item.tobytes())) for item in payloads]
        self._frames = frames
        self._size = len(frames[0])

    @property
    def due_ns(self) -> int:
        """When the next packet leaves, after the start."""
        return round(self.sent * self.period_ns) + self.delay_ns

    def take(self, uptime_ns: int) -> bytearray:
        """Return the next packet of a unit that started so long before the first one."""
        frame = self._frames[self.sent % _VARIANTS]
        stamp = round((uptime_ns + self.sent * self.period_ns) / _RATIO)
        _STAMP.pack_into(
            frame, wire.HEADER.size, self.sent % _MODULUS, *divmod(stamp, 1_000_000_000)
        )
        end = self._size - wire.TAIL.size
        struct.pack_into("<I", frame, end, zlib.crc32(memoryview(frame)[wire.HEADER.size : end]))
        self.sent += 1
        return frame


def main() -> int:
    """Send for so long as the command line says."""
    rate, seconds = float(sys.argv[1]), float(sys.argv[2])
    ends = [("127.0.0.1", int(port)) for port in sys.argv[3:]]
    sockets = []
    for number in range(len(ends)):
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind((address(number), 0))
        sockets.append(sock)
    streams = [_Stream(kind, rate) for kind in (PacketType.POINTS_3D, PacketType.IMU)]
    begin = time.monotonic_ns()
    late = 0
    for _ in count():
        stream = min(streams, key=lambda item: item.due_ns)
        due = stream.due_ns
        if due > seconds * 1e9:
            break
        now = time.monotonic_ns() - begin
        if now < due:
            time.sleep((due - now) / 1e9)
        late = max(late, time.monotonic_ns() - begin - due)
        data = stream.take(10_000_000_000)
        for sock, end in zip(sockets, ends, strict=True):
            sock.sendto(data, end)
    lasted = (time.monotonic_ns() - begin) / 1e9
    time.sleep(0.5)
    for stream in streams:  # the kernel says with the next datagram what it dropped before
        data = stream.take(10_500_000_000)
        for sock, end in zip(sockets, ends, strict=True):
            sock.sendto(data, end)
    sent = sum(stream.sent for stream in streams)
    print(json.dumps({"sent": sent, "seconds": lasted, "latest_ms": late / 1e6}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
