"""Finds where the driver stops keeping up: by sweep length, number of sensors and packet rate."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from l2lidar_node.config import DriverConfig, NetworkConfig
from l2lidar_node.demo.processes import free_udp_ports
from l2lidar_node.driver.driver import Driver
from l2lidar_node.emulator.config import DeviceConfig, IdentityConfig, PowerConfig
from l2lidar_node.emulator.unit.device import VirtualL2
from l2lidar_node.emulator.unit.pattern import PatternScanner, StillInertial
from l2lidar_node.protocol import wire
from l2lidar_node.settings import build
from l2lidar_node.types import HostNs

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
            [sys.executable, "-m", "benchmarks.load_host", str(buffer), str(first),
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
            [sys.executable, "-m", "benchmarks.load_sender", str(rate), str(seconds),
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
