"""Runs the whole chain for long and watches for growth, loss, steps back and unclean ends.

``make soak`` prints the table and writes ``out/bench/soak.json``.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import rclpy
from numpy.typing import NDArray

from l2lidar_node import wire
from l2lidar_node.demo.processes import Program, Programs, isolate_ros
from tools import chain
from tools.cpu import process_cpu_s, resident_mb
from tools.results import Target, at_most, publish
from tools.topic_watch import CLOUDS, DESKEWED, IMU, ODOMETRY, TopicWatch, backward_steps, missing

_START_S: Final = 60.0
_WARM_UP_S: Final = 20.0
_SAMPLES: Final = 120
_MAX_GROWTH_MB: Final = 10.0
_CLOUD_PACKETS: Final = 38
_PERIODS_S: Final = {
    IMU: 1 / wire.IMU_RATE_HZ,
    CLOUDS: _CLOUD_PACKETS * wire.MIRROR_PERIOD_S,
    DESKEWED: _CLOUD_PACKETS * wire.MIRROR_PERIOD_S,
    ODOMETRY: _CLOUD_PACKETS * wire.MIRROR_PERIOD_S,
}
_LINK: Final = ("points lost", "imu lost", "points late", "imu late", "kernel drops")
_STOPS: Final = 8


def sample(program: Program) -> tuple[float, int, int]:
    """Return memory [MB], threads and open files of a process."""
    folder = Path(f"/proc/{program.pid}")
    threads, files = (sum(1 for _ in (folder / name).iterdir()) for name in ("task", "fd"))
    return resident_mb(program.pid), threads, files


def growth_mb(memory: NDArray[np.float64]) -> float:
    """Return by how much memory grew, from the second to the last quarter of the samples [MB]."""
    quarter = max(len(memory) // 4, 1)
    return float(np.median(memory[-quarter:]) - np.median(memory[quarter : 2 * quarter]))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the chain and then end drivers at random moments; return 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--world", default="room")
    parser.add_argument("--motion", default="walk")
    options = parser.parse_args(arguments)
    isolate_ros()
    unit = ["--boot-scale", "0.1", "--world", options.world]
    unit += ["--motion", options.motion] if options.world != "pattern" else []
    rclpy.init()
    # Reliable, so that what is missing was lost by a node and not on the way to this one.
    watch = TopicWatch(list(_PERIODS_S), reliable=True)
    try:
        with Programs() as programs:
            programs_by_name = chain.start(programs, unit, {"qos_reliability": "reliable"})
            rows, targets = _soaked(watch, programs, programs_by_name, 60 * options.minutes)
        targets += _stopped_anywhere(rows)
    finally:
        watch.destroy_node()
        rclpy.try_shutdown()
    publish("soak", f"The whole chain for {options.minutes:g} minutes", rows, targets)
    return int(not all(target.met for target in targets))


def _soaked(
    watch: TopicWatch, programs: Programs, running: dict[str, Program], seconds: float
) -> tuple[list[dict[str, Any]], list[Target]]:
    deadline = time.monotonic() + _START_S
    while not len(watch.seen(CLOUDS)):
        watch.watch(0.2)
        programs.check()
        if time.monotonic() > deadline:
            raise TimeoutError("no clouds")
    watch.watch(min(_WARM_UP_S, seconds / 4))
    watch.forget()
    begin = time.monotonic()
    cpu = {name: process_cpu_s(program.pid) for name, program in running.items()}
    samples: dict[str, list[tuple[float, int, int]]] = {name: [] for name in running}
    while time.monotonic() - begin < seconds:
        for name, program in running.items():
            samples[name].append(sample(program))
        watch.watch(seconds / _SAMPLES)
        programs.check()
    lasted = time.monotonic() - begin
    shares = {name: (process_cpu_s(p.pid) - cpu[name]) / lasted for name, p in running.items()}
    return _reported(watch, running, samples, shares)


def _reported(
    watch: TopicWatch,
    running: dict[str, Program],
    samples: dict[str, list[tuple[float, int, int]]],
    shares: dict[str, float],
) -> tuple[list[dict[str, Any]], list[Target]]:
    rows: list[dict[str, Any]] = []
    targets: list[Target] = []
    for topic, period in _PERIODS_S.items():
        seen = watch.seen(topic)
        if not len(seen):
            continue
        gone, back = missing(seen, period), backward_steps(seen)
        rows.append(_row(topic, f"{len(seen)} messages, {gone} missing, {back} steps back"))
        targets += [
            at_most(f"{topic}: missing", gone, 0),
            at_most(f"{topic}: steps back", back, 0),
        ]
    link = watch.checks.get("link", {})
    counted = {name: int(link.get(name, 0)) for name in _LINK if name in link}
    rows.append(_row("driver's own count since its start", str(counted or link)))
    for name, program in running.items():
        values = np.array(samples[name])
        memory, threads, files = values.T
        grown = growth_mb(memory)
        more = [int(line[-1] - line[len(line) // 4]) for line in (threads, files)]
        begin = time.monotonic()
        code, said = program.stop()
        took = time.monotonic() - begin
        at = len(memory) // 4
        result = (
            f"{memory[at]:.1f} -> {memory[-1]:.1f} MB, {threads[-1]:.0f} threads, "
            f"{files[-1]:.0f} files, {100 * shares[name]:.1f} % CPU; "
            f"SIGINT: exit code {code} after {took:.1f} s"
        )
        rows.append(_row(name, result + (f": {_last_words(said)}" if code else "")))
        if name == "emulator":
            rows.append(_row("emulator's own report", " | ".join(said.splitlines()[-6:])))
            continue
        targets += [
            at_most(f"{name}: growth [MB]", grown, _MAX_GROWTH_MB),
            at_most(f"{name}: more threads", more[0], 0),
            at_most(f"{name}: more files", more[1], 0),
            at_most(f"{name}: exit code after SIGINT", abs(code) + ("Traceback" in said), 0),
        ]
    return rows, targets


def _stopped_anywhere(rows: list[dict[str, Any]]) -> list[Target]:
    """End chains at random moments of their start and their work."""
    rng = random.Random(3)
    unclean: list[str] = []
    early = 0
    for _ in range(_STOPS):
        with Programs() as programs:
            running = chain.start(programs, ["--boot-scale", "0.05", "--world", "pattern"])
            delay = rng.uniform(0.3, 10.0)
            time.sleep(delay)
            for name, program in running.items():
                code, said = program.stop()
                if code in (-2, 130):  # before there was a handler of signals
                    early += 1
                elif code or "Traceback" in said:
                    unclean.append(f"{name} after {delay:.1f} s: {code} {_last_words(said)}")
    remark = f"; {early} programs still imported and ended as Python does" if early else ""
    rows.append(
        _row(
            f"{_STOPS} chains ended at random moments",
            ("; ".join(unclean) or "all clean") + remark,
        )
    )
    return [at_most("unclean ends at random moments", len(unclean), 0)]


def _last_words(said: str) -> str:
    return " ".join(said.split())[-300:]


def _row(what: str, result: str) -> dict[str, Any]:
    return {"what": what, "result": result}


if __name__ == "__main__":
    sys.exit(main())
