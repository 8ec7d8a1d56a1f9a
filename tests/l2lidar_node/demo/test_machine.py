"""What the demo says where the machine did not keep up, and that it excuses nothing else."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from l2lidar_node.demo.machine import (
    INCONCLUSIVE,
    ProcessorTime,
    processor_time,
    shortfall,
    shortfall_since,
    verdict,
)
from l2lidar_node.emulator.server import Latency
from l2lidar_node.emulator.truth import PacketLog, write_packet_log

OFF = "odometry is off by 0.505 m, expected less than 0.050 m"
BUSY = {"odometry": ProcessorTime(5.0, 1.0)}


def latency_ms(*stretches: tuple[float, int]) -> dict[str, float]:
    """Return the summary of so many packets that are so late [ms]."""
    latency = Latency()
    for late_ms, count in stretches:
        for _ in range(count):
            latency.add(round(late_ms * 1e6))
    return latency.summary_ms()


@pytest.mark.parametrize(
    ("late", "times"),
    [
        pytest.param(latency_ms((1.0, 9_000), (4_000.0, 1_000)), BUSY, id="stall"),
        pytest.param(latency_ms((9_000.0, 10_000)), {}, id="always late"),
        pytest.param(
            latency_ms((1.0, 9_000)), {"odometry": ProcessorTime(2.0, 9.0)}, id="starved"
        ),
    ],
)
def test_a_machine_that_stalls_is_blamed_itself(
    late: dict[str, float], times: dict[str, ProcessorTime]
) -> None:
    behind = shortfall({"latency_ms": late}, times)
    code, said = verdict([OFF], behind)
    assert code == INCONCLUSIVE != 1
    assert "THIS MACHINE DID NOT KEEP UP" in said[0]
    assert behind in said[0]
    assert any(OFF in line for line in said)
    code, said = verdict([], behind)
    assert code == 0
    assert "This machine was busy" in said[0]


@pytest.mark.parametrize(
    "late",
    [
        pytest.param(latency_ms((0.1, 10_000)), id="idle"),
        pytest.param(latency_ms((1.0, 9_950), (900.0, 50)), id="one hiccup"),
        pytest.param(latency_ms((60.0, 9_000), (400.0, 1_000)), id="busy"),
    ],
)
def test_a_wrong_odometry_on_a_machine_that_keeps_up_is_not_excused(
    late: dict[str, float],
) -> None:
    behind = shortfall({"latency_ms": late}, BUSY)
    assert behind == ""
    assert verdict([OFF], behind) == (1, [OFF])
    assert verdict([], behind) == (0, [])


def test_the_truth_of_an_earlier_run_excuses_nothing(tmp_path: Path) -> None:
    assert shortfall_since(0, tmp_path, {}) == ""  # there is none
    run = {"power_on_ns": 1_000, "latency_ms": latency_ms((3_000.0, 100))}
    write_packet_log(tmp_path, PacketLog(), run)
    assert "3.0 s late" in shortfall_since(500, tmp_path, {})
    assert shortfall_since(1_500, tmp_path, {}) == ""


def test_a_busy_process_is_seen_to_run() -> None:
    before = processor_time(os.getpid())
    np.linalg.svd(np.random.default_rng(1).normal(size=(300, 300)))
    after = processor_time(os.getpid())
    if before is None or after is None:
        pytest.skip("this kernel has no /proc/PID/schedstat")
    assert after.ran_s > before.ran_s
    assert after.waited_s >= before.waited_s
    assert processor_time(2**22 + 1) is None
