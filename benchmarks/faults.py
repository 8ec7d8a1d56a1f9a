"""Makes everything go wrong that the virtual L2 and its surroundings can, and judges the driver.

``make faults`` prints the table and writes ``out/bench/faults.json``. First in simulated time:
every fault alone, then random combinations for as long as asked. Then in real time over sockets:
cables, addresses, suspended hosts, ports, disks and subscribers. The slow subscriber is a process
of this module.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Imu, PointCloud2

from benchmarks import fault_world
from benchmarks.chain import CLOUDS, IMU, TopicWatch, backward_steps, missing
from benchmarks.fault_world import Finding
from benchmarks.results import Target, at_least, at_most, publish
from l2lidar_node.demo.processes import Program, Programs, assigned, free_udp_ports, isolate_ros
from l2lidar_node.protocol import wire
from tests.support.cpu import resident_mb
from tests.support.fault_runs import SINGLE, FaultCase, Verdict, random_case, run

_TURN_S: Final = 0.229769  # of the head


def run_subscribers() -> list[Finding]:
    """Return what a stalled and a killed reliable subscriber do to the topics."""
    isolate_ros()
    host_port, lidar_port = free_udp_ports(2)
    values = {
        "l2_ip": "127.0.0.1", "l2_port": lidar_port, "host_ip": "127.0.0.1",
        "host_port": host_port, "enable_IMU_publishing": "true", "imu_adjust": "false",
        "sweep_cut": "turn", "qos_reliability": "reliable",
    }  # fmt: skip
    rclpy.init()
    watch = TopicWatch([CLOUDS, IMU], reliable=True)
    try:
        with Programs() as programs:
            driver = programs.start("l2lidar_node.ros.driver_node", assigned(values))
            programs.start(
                "l2lidar_node.emulator",
                ["--ready", "--world", "pattern",
                 "--host-port", str(host_port), "--lidar-port", str(lidar_port)],
            )  # fmt: skip
            slow = programs.start("benchmarks.faults", ["subscriber"])
            watch.until(
                lambda: len(watch.seen(CLOUDS)) >= 10 and watch.count_subscribers(CLOUDS) >= 2,
                programs,
                "no clouds, or no second subscriber",
            )
            return [
                _watched(watch, driver, "two reliable subscribers", lambda: None),
                _watched(
                    watch, driver, "one of them stopped 6 s",
                    lambda: _signal(slow, signal.SIGSTOP),
                ),
                _watched(
                    watch, driver, "that one killed",
                    lambda: _signal(slow, signal.SIGKILL),
                ),
            ]  # fmt: skip
    finally:
        watch.destroy_node()
        rclpy.try_shutdown()


def _signal(program: Program, number: signal.Signals) -> None:
    os.kill(program.pid, number)


def _watched(watch: TopicWatch, driver: Program, name: str, happen: Callable[[], None]) -> Finding:
    watch.forget()
    before_mb = resident_mb(driver.pid)
    happen()
    watch.watch(6.0)
    clouds, imu = watch.seen(CLOUDS), watch.seen(IMU)
    finding = Finding(name, published=len(clouds) + len(imu))
    finding.backwards = backward_steps(clouds) + backward_steps(imu)
    finding.missing = missing(imu, 1 / wire.IMU_RATE_HZ) + missing(clouds, _TURN_S)
    finding.recovery_s = float(np.diff(imu[:, 1]).max(initial=0)) / 1e9
    growth = resident_mb(driver.pid) - before_mb
    finding.remark = (
        f"longest pause of the other {finding.recovery_s * 1e3:.0f} ms, "
        f"driver grows by {growth:.1f} MB"
    )
    finding.good = finding.missing == finding.backwards == 0 and finding.published > 1000
    return finding


class _Subscriber(Node):  # type: ignore[misc]  # rclpy is used as if it had no types
    """Takes everything, reliably, with a short queue."""

    def __init__(self) -> None:
        super().__init__("slow_subscriber")
        for kind, topic in ((PointCloud2, "/points"), (Imu, "/imu/data")):
            self.create_subscription(kind, topic, lambda message: None, QoSProfile(depth=5))


def _subscribe() -> int:
    """Be the subscriber."""
    rclpy.init()
    rclpy.spin(_Subscriber())
    return 0


_COMBINATION_S: Final = 30.0
_MAX_ERROR_MS: Final = 2.0
_SUM: Final = ("sent", "destroyed", "used", "unlocked", "lost_good", "backwards", "wrong_sweeps")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run everything; return 1 if anything was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=0.1, help="of simulated combinations")
    parser.add_argument("--first", type=int, default=0, help="number of the first combination")
    parser.add_argument("--no-world", action="store_true", help="leave out what needs real time")
    parser.add_argument("--no-ros", action="store_true", help="leave out what needs ROS")
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    singles = [run(case, 1) for case in SINGLE]
    rows += [_simulated(case, verdict) for case, verdict in zip(SINGLE, singles, strict=True)]
    count = round(options.hours * 3600 / _COMBINATION_S)
    numbers = range(options.first, options.first + count)
    random = [_combination(random_case(number, _COMBINATION_S), number) for number in numbers]
    if random:
        rows.append(_simulated(FaultCase(f"{count} random combinations", {}), _sum(random)))
    findings: list[Finding] = []
    if not options.no_world:
        findings += [fault_world.run(case) for case in fault_world.CASES]
        if not options.no_ros:
            findings += run_subscribers()
    rows += [_real(finding) for finding in findings]
    targets = _targets(singles + random, findings, options.hours)
    publish("faults", "Faults, judged by the truth", rows, targets)
    return int(not all(target.met for target in targets))


def _combination(case: FaultCase, number: int) -> Verdict:
    verdict = run(case, number)
    if not is_right(verdict):
        print(f"{case}: {verdict}", file=sys.stderr)
    return verdict


def is_right(verdict: Verdict) -> bool:
    """Tell whether nothing wrong was published and nothing good was lost."""
    return (
        verdict.worst_ms < _MAX_ERROR_MS
        and verdict.backwards == verdict.wrong_sweeps == 0
        and verdict.lost_good <= verdict.late
    )


def _sum(verdicts: Sequence[Verdict]) -> Verdict:
    total = Verdict(**{name: sum(getattr(one, name) for one in verdicts) for name in _SUM})
    for name in ("worst_ms", "lock_s", "gap_s"):
        setattr(total, name, max(getattr(one, name) for one in verdicts))
    total.late = sum(one.late for one in verdicts)
    return total


def _simulated(case: FaultCase, verdict: Verdict) -> dict[str, Any]:
    counted = ", ".join(f"{count} {name}" for name, count in verdict.counted.items() if count)
    return {
        "fault": case.name,
        "sent": verdict.sent,
        "destroyed": verdict.destroyed,
        "published": verdict.used,
        "without time": verdict.unlocked,
        "lost": verdict.lost_good,
        "wrong": verdict.wrong_sweeps + verdict.backwards,
        "worst stamp [ms]": round(verdict.worst_ms, 3),
        "first lock [s]": round(verdict.lock_s, 2),
        "recovery [s]": round(verdict.gap_s, 2),
        "remark": f"counted: {counted}" if counted else "",
    }


def _real(finding: Finding) -> dict[str, Any]:
    return {
        "fault": f"{finding.name} (real time)",
        "sent": finding.arrived,
        "destroyed": 0,
        "published": finding.published,
        "without time": finding.unlocked,
        "lost": finding.missing,
        "wrong": finding.backwards,
        "worst stamp [ms]": round(finding.worst_ms, 3),
        "first lock [s]": "",
        "recovery [s]": round(finding.recovery_s, 2),
        "remark": finding.remark if finding.good else f"NOT AS IT HAS TO BE; {finding.remark}",
    }


def _targets(
    verdicts: Sequence[Verdict], findings: Sequence[Finding], hours: float
) -> list[Target]:
    worst = max([one.worst_ms for one in verdicts] + [one.worst_ms for one in findings])
    backwards = sum(one.backwards for one in verdicts) + sum(one.backwards for one in findings)
    lost = sum(max(one.lost_good - one.late, 0) for one in verdicts)
    return [
        at_least("simulated combinations [h]", hours, 1.0),
        at_most("worst stamp after the lock [ms]", worst, _MAX_ERROR_MS),
        at_most("stamps that step backwards", backwards, 0),
        at_most("sweeps with wrong points", sum(one.wrong_sweeps for one in verdicts), 0),
        at_most("good packets lost, too late ones aside", lost, 0),
        at_most("good packets lost, real time", sum(one.missing for one in findings), 0),
        at_most("real-time cases not as they have to be", sum(not x.good for x in findings), 0),
    ]


if __name__ == "__main__":
    if sys.argv[1:] == ["subscriber"]:
        sys.exit(_subscribe())
    begin = time.monotonic()
    code = main()
    print(f"took {time.monotonic() - begin:.0f} s")
    sys.exit(code)
