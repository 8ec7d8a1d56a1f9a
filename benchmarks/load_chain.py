"""Measures the whole chain at the real rate: latency from stage to stage, CPU share and memory."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import rclpy
from numpy.typing import NDArray

from benchmarks import chain
from benchmarks.topic_watch import CLOUDS, DESKEWED, ODOMETRY, TopicWatch, missing
from l2lidar_node.demo.processes import Programs, isolate_ros
from l2lidar_node.protocol import wire
from tests.support.cpu import process_cpu_s, resident_mb

_PACKETS: Final = 38  # in a cloud
_PERIOD_S: Final = _PACKETS * wire.MIRROR_PERIOD_S
_DELAY_S: Final = 150e-6  # of the virtual L2, last slot measured to packet sent
_SWEEP_NS: Final = round(
    ((_PACKETS - 1) * wire.MIRROR_PERIOD_S + wire.MIRROR_PERIOD_S / 2 + _DELAY_S) * 1e9
)
"""From a cloud's stamp to the instant at which the unit sends its last packet."""
_WARM_UP_S: Final = 8.0


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


def measured(seconds: float, world: str) -> ChainCost:
    """Run the chain for so long and measure it."""
    isolate_ros()
    rclpy.init()
    watch = TopicWatch([CLOUDS, DESKEWED, ODOMETRY])
    cost = ChainCost()
    try:
        with Programs() as programs:
            running = chain.start(programs, ["--ready", "--world", world])
            watch.until(lambda: len(watch.seen(CLOUDS)) > 0, programs, "no clouds")
            watch.watch(_WARM_UP_S)
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
            cost.latencies_ms[topic] = _latencies_ms(clouds[:, 0], watch.seen(topic))
    finally:
        watch.destroy_node()
        rclpy.try_shutdown()
    return cost


def _latencies_ms(clouds: NDArray[np.int64], seen: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the time from a cloud's last packet to each message made of that cloud.

    A message made of a cloud carries the cloud's stamp or an instant within the sweep.
    """
    at = np.searchsorted(clouds, seen[:, 0], side="right") - 1
    known = at >= 0
    return np.asarray((seen[known, 1] - clouds[at[known]] - _SWEEP_NS) / 1e6)
