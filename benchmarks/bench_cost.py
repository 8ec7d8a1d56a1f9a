"""Measures where the CPU time of the running chain goes, by process and thread.

``make bench-cost`` runs a virtual L2, the driver, and deskew and odometry in one process at the
real rate. Times also stand in units of a fixed reference load, measured in the same run: those do
not change with the speed of the day's machine.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
import zlib
from collections import defaultdict
from pathlib import Path
from typing import Final

import numpy as np
import rclpy

from benchmarks import chain
from benchmarks.topic_watch import CLOUDS, DESKEWED, ODOMETRY, TopicWatch
from l2lidar_node.demo.processes import Programs, isolate_ros

PAGE: Final = Path("docs") / "results" / "cost.md"
_WARM_UP_S: Final = 10.0
_TICK_S: Final = 1.0 / os.sysconf("SC_CLK_TCK")
_ROUNDS: Final = 20
_PROGRAMS: Final = ("driver_node", "companion_node")


def reference_rate(rounds: int = _ROUNDS) -> float:
    """Return how many packets per CPU second a fixed load takes: their CRC-32 and a view."""
    packet = bytes(range(256)) * 4 + bytes(20)  # as long as a packet of points
    layout = np.dtype(np.uint16)
    count = 2_000
    begin = time.process_time()
    for _ in range(rounds * count):
        zlib.crc32(packet)
        np.frombuffer(packet, layout)
    return rounds * count / (time.process_time() - begin)


def thread_times(pid: int) -> dict[str, float]:
    """Return CPU seconds of a process by thread or group of threads."""
    found: dict[str, float] = defaultdict(float)
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            text = (task / "stat").read_text()
        except OSError:  # it has ended meanwhile
            continue
        name = text[text.index("(") + 1 : text.rindex(")")]
        fields = text[text.rindex(")") + 2 :].split()
        if int(task.name) == pid:
            name = "executor (main thread)"
        elif name.startswith("python") or name == "pt_main_thread":
            name = "other threads of Python"
        elif name.startswith("dds."):
            name = "Fast DDS"
        found[name] += _TICK_S * (int(fields[11]) + int(fields[12]))
    return found


def measured(
    seconds: float, world: str
) -> tuple[dict[str, dict[str, float]], float, dict[str, float]]:
    """Return ms per second by program and thread, the reference rate, and messages a second."""
    isolate_ros()
    rclpy.init()
    watch = TopicWatch([CLOUDS, DESKEWED, ODOMETRY])
    try:
        with Programs() as programs:
            running = chain.start(programs, ["--ready", "--world", world], {"sweep_cut": "turn"})
            watch.until(lambda: len(watch.seen(ODOMETRY)) > 0, programs, "no odometry")
            watch.watch(_WARM_UP_S)
            watch.forget()
            before = {name: thread_times(running[name].pid) for name in _PROGRAMS}
            begun = time.monotonic()
            watch.watch(seconds / 2)
            rate = reference_rate()
            watch.watch(seconds / 2)
            lasted = time.monotonic() - begun
            after = {name: thread_times(running[name].pid) for name in _PROGRAMS}
        flow = {topic: len(watch.seen(topic)) / lasted for topic in (CLOUDS, DESKEWED, ODOMETRY)}
    finally:
        watch.destroy_node()
        rclpy.try_shutdown()
    spent = {
        name: {
            thread: 1e3 * (total - before[name].get(thread, 0.0)) / lasted
            for thread, total in after[name].items()
        }
        for name in _PROGRAMS
    }
    return spent, rate, flow


def main() -> int:
    """Measure, print, and write the page if asked to; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--world", default="room")
    parser.add_argument("--page", action="store_true", help=f"write {PAGE}")
    given = parser.parse_args()
    spent, rate, flow = measured(given.seconds, given.world)
    lines = [
        "| process | thread | ms of CPU in a second | in reference packets |",
        "|---|---|---:|---:|",
    ]
    for name, threads in spent.items():
        most_first = sorted(threads.items(), key=lambda item: -item[1])
        for thread, ms in [*most_first, ("all", sum(threads.values()))]:
            if ms >= 0.5:
                lines.append(f"| {name} | {thread} | {ms:.0f} | {ms * 1e-3 * rate:.0f} |")
    text = "\n".join(lines)
    rates = ", ".join(f"{topic} {per_s:.2f}" for topic, per_s in flow.items())
    machine = f"Python {platform.python_version()}, {os.cpu_count()} cores"
    print(f"{text}\n\nmessages a second: {rates}; reference: {rate:.0f} packets per CPU second")
    if given.page:
        PAGE.write_text(
            _PAGE.format(
                seconds=given.seconds,
                world=given.world,
                table=text,
                rates=rates,
                machine=machine,
                rate=rate,
            )
        )
        print(PAGE)
    return 0


_PAGE: Final = """# Where the CPU time goes

Written by `make bench-cost BENCH_ARGS=--page`. A virtual L2 in the world `{world}` at the real
rate, the driver, and deskew and odometry in one process, {seconds:.0f} s after a warm-up; one
subscriber of clouds, deskewed clouds and odometry. {machine}.

The last column counts packets of a fixed reference load, CRC-32 and `numpy.frombuffer` of as many
bytes as a packet of points has: {rate:.0f} of them took a CPU second in the same run. It is the
column to compare between machines and days.

{table}

Messages a second: {rates}.
"""

if __name__ == "__main__":
    sys.exit(main())
