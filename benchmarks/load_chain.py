"""Measures the chain and the driver node alone at the real rate: latency, CPU share, memory."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import rclpy
from numpy.typing import NDArray

from benchmarks import chain
from benchmarks.chain import CLOUDS, DESKEWED, DRIVER, IMU, ODOMETRY, TopicWatch, missing
from benchmarks.load_scale import address
from l2lidar_node.demo.processes import Programs, assigned, free_udp_ports, isolate_ros
from l2lidar_node.protocol import wire
from tests.support.cpu import process_cpu_s, resident_mb

_PACKETS: Final = 38  # in a cloud
_PERIOD_S: Final = _PACKETS * wire.MIRROR_PERIOD_S
_DELAY_S: Final = 150e-6  # of the virtual L2, last slot measured to packet sent
_SWEEP_NS: Final = round(
    ((_PACKETS - 1) * wire.MIRROR_PERIOD_S + wire.MIRROR_PERIOD_S / 2 + _DELAY_S) * 1e9
)
"""From a cloud's stamp to the instant at which the unit sends its last packet."""
_CHAIN_WARM_UP_S: Final = 8.0


@dataclass(slots=True)
class ChainCost:
    """What the chain needs.

    Attributes
    ----------
    latencies_ms : dict
        By stage, from the last packet sent by the unit to the arrival at a subscriber, shape (N,).
    shares, memory_mb : dict
        By program.
    missing : int
        Clouds that did not come.
    """

    latencies_ms: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    shares: dict[str, float] = field(default_factory=dict)
    memory_mb: dict[str, float] = field(default_factory=dict)
    missing: int = 0


def measure_chain(seconds: float, world: str) -> ChainCost:
    """Run the chain for so long and measure it."""
    isolate_ros()
    rclpy.init()
    watch = TopicWatch([CLOUDS, DESKEWED, ODOMETRY])
    cost = ChainCost()
    try:
        with Programs() as programs:
            running = chain.start(programs, ["--ready", "--world", world])
            watch.until(lambda: len(watch.seen(CLOUDS)) > 0, programs, "no clouds")
            watch.watch(_CHAIN_WARM_UP_S)
            watch.forget()
            begin = time.monotonic()
            cpu = {name: process_cpu_s(program.pid) for name, program in running.items()}
            watch.watch(seconds)
            lasted = time.monotonic() - begin
            for name, program in running.items():
                cost.shares[name] = (process_cpu_s(program.pid) - cpu[name]) / lasted
                cost.memory_mb[name] = resident_mb(program.pid)
        clouds = watch.seen(CLOUDS)
        cost.missing = missing(clouds, _PERIOD_S)
        for topic in (CLOUDS, DESKEWED, ODOMETRY):
            cost.latencies_ms[topic] = _chain_latencies_ms(clouds[:, 0], watch.seen(topic))
    finally:
        watch.destroy_node()
        rclpy.try_shutdown()
    return cost


def _chain_latencies_ms(clouds: NDArray[np.int64], seen: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the time from a cloud's last packet to each message made of that cloud.

    A message made of a cloud carries the cloud's stamp or an instant within the sweep.
    """
    at = np.searchsorted(clouds, seen[:, 0], side="right") - 1
    known = at >= 0
    return np.asarray((seen[known, 1] - clouds[at[known]] - _SWEEP_NS) / 1e6)


_PERIOD_NS: Final = round(wire.MIRROR_PERIOD_S * 1e9)
_TO_SENT_NS: Final = round(_PERIOD_NS / 2) + 150_000  # from a packet's first slot, at the unit
_NODE_WARM_UP_S: Final = 5.0  # the clock locks and settles


@dataclass(frozen=True, slots=True)
class NodeCost:
    """What the driver node needs beside a sender and a subscriber that need little.

    Attributes
    ----------
    share : float
        Of a core.
    latencies_ms : ndarray, shape (N,)
        From the last packet of each cloud sent to the cloud at the subscriber.
    latest_ms : float
        The largest delay of the sender: how much the machine does beside.
    """

    share: float
    latencies_ms: NDArray[np.float64]
    latest_ms: float


def measure_node(seconds: float) -> NodeCost:
    """Run the node for so long and measure it."""
    isolate_ros()
    (port,) = free_udp_ports(1)
    parameters = {
        "l2_ip": address(0), "host_ip": "127.0.0.1", "host_port": port,
        "enable_IMU_publishing": "true", "enable_l2_host_sync": "false",
    }  # fmt: skip
    rclpy.init()
    watch = TopicWatch([CLOUDS, IMU])
    try:
        with Programs() as programs:
            node = programs.start(DRIVER, assigned(parameters))
            watch.until(
                lambda: watch.count_publishers(CLOUDS) > 0, programs, "the driver does not start"
            )
            with subprocess.Popen(
                [
                    *(sys.executable, "-m", "benchmarks.load_scale", "send"),
                    *("1", str(seconds + _NODE_WARM_UP_S + 1.0), str(port), "--instants"),
                ],
                stdout=subprocess.PIPE,
                text=True,
            ) as sender:
                while not len(watch.seen(CLOUDS)) and sender.poll() is None:
                    watch.watch(0.1)
                watch.watch(_NODE_WARM_UP_S - 1.0)
                watch.forget()
                cpu, begin = process_cpu_s(node.pid), time.monotonic()
                watch.watch(seconds)
                share = (process_cpu_s(node.pid) - cpu) / (time.monotonic() - begin)
                clouds = watch.seen(CLOUDS)
                told = json.loads(sender.communicate()[0])
    finally:
        watch.destroy_node()
        rclpy.try_shutdown()
    sent = np.array(told["points_sent_ns"], np.int64)
    return NodeCost(share, _node_latencies_ms(clouds, sent), told["latest_ms"])


def _node_latencies_ms(clouds: NDArray[np.int64], sent: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the time from the last packet of each cloud to its arrival.

    ``clouds`` are stamps and arrivals, shape (N, 2), ``sent`` the instants at which the packets
    left, both [ns]. A cloud's stamp tells its first packet: it lies within its slots, which take
    half a period.
    """
    number = np.arange(len(sent))
    begun = np.median(sent - number * _PERIOD_NS) - _TO_SENT_NS  # robust: a sender may be late
    first = np.floor((clouds[:, 0] - begun) / _PERIOD_NS + 0.25).astype(np.int64)
    last = first + _PACKETS - 1
    known = (first >= 0) & (last < len(sent))
    return np.asarray((clouds[known, 1] - sent[last[known]]) / 1e6)
