"""Finds where the driver stops keeping up: by sweep length, number of sensors and packet rate.

Sender and receivers are processes of this module.

``python -m benchmarks.load_scale send RATE SECONDS PORT...`` sends to each port of 127.0.0.1 from
an address of its own (127.0.1.1, 127.0.1.2, ...), as a unit whose mirror and IMU run RATE times as
fast. It prints what it sent as JSON, with ``--instants`` also when each point packet was sent.
All packets are made before the first one is sent.

``python -m benchmarks.load_scale receive BUFFER FIRST PORT...`` runs the drivers, without ROS, of
the sensors from number FIRST on, one at each port with a receive buffer of so many bytes, until it
is interrupted, and prints what it counted as JSON.
"""

from __future__ import annotations

import heapq
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from operator import itemgetter
from typing import Any, Final

import numpy as np

from l2lidar_node.config import DriverConfig, NetworkConfig
from l2lidar_node.demo.processes import free_udp_ports
from l2lidar_node.driver import health
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.emulator.config import DeviceConfig, IdentityConfig, PowerConfig
from l2lidar_node.emulator.link.port import unread
from l2lidar_node.emulator.unit.device import VirtualL2
from l2lidar_node.emulator.unit.stream import PatternScanner, StillInertial
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.settings import build
from l2lidar_node.transport.session import Session
from l2lidar_node.transport.udp import UdpTransport
from l2lidar_node.types import HostNs, Sweep
from tests.support.cpu import process_cpu_s

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


def _send() -> int:
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


def _receive() -> int:
    """Run the sessions."""
    buffer, first = int(sys.argv[1]), int(sys.argv[2])
    latencies: list[float] = []

    def handle(event: Event) -> None:
        if isinstance(event, Sweep):
            latencies.append((time.time_ns() - event.end) / 1e6)

    sessions = []
    for number, host_port in enumerate(sys.argv[3:], start=first):
        values = {
            "l2_ip": address(number), "host_ip": "127.0.0.1", "host_port": int(host_port),
            "watchdog_action": "wait", "imu_adjust": False, "enable_l2_host_sync": False,
            "receive_buffer_bytes": buffer,
            "publish_unlocked": True,  # a unit so fast that its clock is not believed counts too
        }  # fmt: skip
        config = build(DriverConfig, values)
        sessions.append(Session(Driver(config), UdpTransport(config.network), handle))
    stopping = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: stopping.set())
    for session in sessions:
        session.start()
    begin = process_cpu_s(os.getpid())
    before = [health.observe(one.driver, one.transport, _now()) for one in sessions]
    print("listening", flush=True)
    stopping.wait()
    _take_what_waits(sessions)
    for session in sessions:
        session.stop()
    complaints = set()
    for one, since in zip(sessions, before, strict=True):
        after = health.observe(one.driver, one.transport, _now())
        link = next(c for c in health.judge(one.driver, since, after) if c.name == "link")
        complaints |= {link.message} if link.level else set()
    counts = [session.driver.counters for session in sessions]
    found = {
        "received": sum(one.datagrams for one in counts),
        "lost": sum(item.lost for one in counts for item in one.sequence.values()),
        "late": sum(item.late for one in counts for item in one.sequence.values()),
        "kernel_drops": sum(session.transport.kernel_drops for session in sessions),
        "sweeps": sum(one.sweeps for one in counts),
        "cpu_s": process_cpu_s(os.getpid()) - begin,
        "failures": [repr(session.failure) for session in sessions if session.failure],
        "complaints": sorted(complaints),
        "latencies_ms": latencies,
    }
    print(json.dumps(found))
    return 0


def _take_what_waits(sessions: list[Session]) -> None:
    """Wait until the sessions have taken what their sockets hold, however slow this machine is."""
    for one in sessions:
        network = one.driver.config.network
        while unread(network.host_ip, network.host_port) and not one.failure:
            time.sleep(0.05)
    for one in sessions:  # its thread answers when it is through with what it took
        with suppress(CancelledError):
            one.call(lambda driver, now: None).result()


def _now() -> HostNs:
    return HostNs(time.time_ns())


LENGTHS: Final = (1, 10, 50, 200, 1000, 4000)
CROWDS: Final = ((1, 1), (4, 1), (8, 1), (16, 1), (8, 2), (8, 4))
"""Sensors, and processes that they are shared among."""
RATES: Final = (1, 5, 10, 20, 50, 100, 200)
_BUFFER: Final = NetworkConfig().receive_buffer_bytes
_EPOCH_NS: Final = 1_700_000_000 * 10**9


def by_length(
    seconds: float, lengths: Sequence[int] = LENGTHS, rounds: int = 1
) -> list[dict[int, float]]:
    """Return point packets per CPU second, datagram to sweep, for sweeps of so many packets.

    Parameters
    ----------
    seconds : float
        Of the sensor's packets.
    lengths : sequence of int
    rounds : int
        How often each length has its turn; one dict for each.
    """
    unit = DeviceConfig(
        power=PowerConfig(boot_scale=0.0),
        identity=IdentityConfig(work_mode=int(wire.WorkMode.IMU_OFF)),
    )
    device = VirtualL2(unit, PatternScanner(), StillInertial(), power_on_ns=_EPOCH_NS)
    sent = device.advance(_EPOCH_NS + round(seconds * 1e9))
    return [
        {length: len(sent) / _received_s(sent, length) for length in lengths}
        for _ in range(rounds)
    ]


def _received_s(sent: Sequence[tuple[int, bytes]], length: int) -> float:
    """Return the CPU time that datagrams take in sweeps of so many packets [s]."""
    values = {"imu_adjust": False, "aggregateNframes": length, "enable_l2_host_sync": False}
    driver = Driver(build(DriverConfig, values))
    begin = time.process_time()
    for arrival, data in sent:
        driver.receive(data, HostNs(arrival))
    driver.flush()
    return time.process_time() - begin


def crowd(
    sensors: int, processes: int, rate: float, seconds: float, buffer: int = _BUFFER
) -> dict[str, Any]:
    """Return what drivers got of sensors that send ``rate`` times as fast as real ones.

    Each driver asks for a receive buffer of ``buffer`` bytes.

    Returns
    -------
    dict
        ``sent``, ``received``, ``lost`` (by their numbers), ``kernel_drops``, ``late``,
        ``cpu`` (cores), ``p99_ms`` (last slot measured to sweep made), ``latest_ms`` (of the
        sender), ``rate`` (at which it sent in the end, in units of a real sensor's),
        ``unsaid`` (lost datagrams that no counter knows), ``complaints`` (what the driver says of
        its link).
    """
    ports = free_udp_ports(sensors)
    share = sensors // processes
    hosts = [
        subprocess.Popen(
            [sys.executable, "-m", "benchmarks.load_scale", "receive", str(buffer), str(first),
             *map(str, ports[first : first + share])],
            stdout=subprocess.PIPE, text=True,
        )
        for first in range(0, sensors, share)
    ]  # fmt: skip
    try:
        for host in hosts:
            assert host.stdout is not None
            host.stdout.readline()
        sender = subprocess.run(
            [sys.executable, "-m", "benchmarks.load_scale", "send", str(rate), str(seconds),
             *map(str, ports)],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        for host in hosts:
            host.send_signal(signal.SIGINT)
        results = [json.loads(host.communicate(timeout=300)[0]) for host in hosts]
    finally:
        for host in hosts:
            if host.poll() is None:
                host.kill()
                host.communicate()
    told = json.loads(sender.stdout)
    found: dict[str, Any] = {
        name: sum(result[name] for result in results)
        for name in ("received", "lost", "late", "kernel_drops", "sweeps")
    }
    latencies = [value for result in results for value in result["latencies_ms"]]
    found["sent"] = told["sent"] * sensors
    found["latest_ms"] = told["latest_ms"]
    found["rate"] = rate * seconds / told["seconds"]
    found["complaints"] = sorted({text for result in results for text in result["complaints"]})
    found["cpu"] = sum(result["cpu_s"] for result in results) / told["seconds"]
    found["p99_ms"] = float(np.percentile(latencies, 99)) if latencies else float("nan")
    found["unsaid"] = found["sent"] - found["received"] - found["kernel_drops"]
    found["failures"] = sum(len(result["failures"]) for result in results)
    return found


def main() -> int:
    """Be the sender or a receiver, as :func:`crowd` starts them."""
    role = sys.argv.pop(1)
    return _send() if role == "send" else _receive()


if __name__ == "__main__":
    sys.exit(main())
