"""Drivers of several sensors in one process, without ROS; says at the end what they got.

``python -m benchmarks.load_host BUFFER FIRST PORT...`` hears the sensors of
:mod:`benchmarks.load_sender` from number FIRST on, one at each port with a receive buffer of so
many bytes, until it is interrupted, and prints what it counted as JSON.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from concurrent.futures import CancelledError
from contextlib import suppress

from benchmarks.load_sender import address
from l2lidar_node.config import DriverConfig
from l2lidar_node.driver import health
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.emulator.link.port import unread
from l2lidar_node.settings import build
from l2lidar_node.transport.session import Session
from l2lidar_node.transport.udp import UdpTransport
from l2lidar_node.types import HostNs, Sweep
from tests.support.cpu import process_cpu_s


def main() -> int:
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


if __name__ == "__main__":
    sys.exit(main())
