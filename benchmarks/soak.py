"""Runs the whole chain for long and watches for growth, loss, steps back and unclean ends.

``make soak`` prints the table and writes ``out/bench/soak.json``, which says every half a minute
how it stands: a run that is interrupted has its result as well.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.signals import SignalHandlerOptions

from benchmarks import chain, interrupts
from benchmarks.chain import CLOUDS, DESKEWED, IMU, ODOMETRY, TopicWatch, backward_steps, missing
from benchmarks.results import Target, at_most, keep, publish
from l2lidar_node.demo.processes import Program, Programs, isolate_ros
from l2lidar_node.programs import interruptible
from l2lidar_node.protocol import wire
from tests.support.cpu import process_cpu_s, resident_mb

_WARM_UP_S: Final = 20.0
_LOOK_S: Final = 30.0
_MAX_GROWTH_MB: Final = 10.0
_CLOUD_PACKETS: Final = 38
_CLOUD_S: Final = _CLOUD_PACKETS * wire.MIRROR_PERIOD_S
_PERIODS_S: Final = {
    IMU: 1 / wire.IMU_RATE_HZ, CLOUDS: _CLOUD_S, DESKEWED: _CLOUD_S, ODOMETRY: _CLOUD_S,
}  # fmt: skip
_LINK: Final = ("points lost", "imu lost", "points late", "imu late", "kernel drops")
_ROUNDS: Final = 4  # of interruptions of every program


@dataclass(slots=True)
class Tally:
    """What came on a topic, counted as it comes.

    Attributes
    ----------
    messages, missing, steps_back : int
    """

    messages: int = 0
    missing: int = 0
    steps_back: int = 0
    _last: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))

    def add(self, seen: NDArray[np.int64], period_s: float) -> None:
        """Count the messages that came since the last call."""
        line = np.concatenate([self._last, seen])
        self.messages += len(seen)
        self.missing += missing(line, period_s)
        self.steps_back += backward_steps(line)
        self._last = line[-1:]


class Soak:
    """The chain at work, and what has been seen of it so far.

    Parameters
    ----------
    running : dict of str to Program
    watch, casual : TopicWatch
        Who asks for reliable delivery, and who takes what comes.
    """

    def __init__(self, running: dict[str, Program], watch: TopicWatch, casual: TopicWatch) -> None:
        self.running = running
        self._watches = watch, casual
        self._tallies = [{topic: Tally() for topic in _PERIODS_S} for _ in self._watches]
        self._samples: dict[str, list[tuple[float, int, int]]] = {name: [] for name in running}
        self._loads: list[float] = []
        self._begun = time.monotonic()
        self._cpu = {name: process_cpu_s(program.pid) for name, program in running.items()}
        for item in self._watches:
            item.forget()

    @property
    def minutes(self) -> float:
        """How long it has been going."""
        return (time.monotonic() - self._begun) / 60

    def look(self) -> None:
        """Count what came and measure every program."""
        for item, tallies in zip(self._watches, self._tallies, strict=True):
            for topic, tally in tallies.items():
                tally.add(item.seen(topic), _PERIODS_S[topic])
            item.forget()
        for name, program in self.running.items():
            self._samples[name].append(sample(program))
        self._loads.append(os.getloadavg()[0])

    def found(self) -> tuple[list[dict[str, Any]], list[Target]]:
        """Return rows and targets as they stand."""
        rows: list[dict[str, Any]] = []
        targets: list[Target] = []
        lows, highs = min(self._loads, default=0.0), max(self._loads, default=0.0)
        rows.append(
            _row("time", f"{self.minutes:.1f} min, load of the machine {lows:.1f} to {highs:.1f}")
        )
        reliable, casual = self._tallies
        for topic, tally in reliable.items():
            text = f"{tally.messages} messages, {tally.missing} missing"
            rows.append(_row(topic, f"{text}, {tally.steps_back} steps back"))
            targets += [
                at_most(f"{topic}: missing", tally.missing, 0),
                at_most(f"{topic}: steps back", tally.steps_back, 0),
            ]
        for topic, tally in casual.items():
            text = f"{tally.messages} messages, {tally.missing} missing"
            rows.append(_row(f"{topic}, to a best-effort subscriber", text))
        link = self._watches[0].checks.get("link", {})
        counted = {name: int(link[name]) for name in _LINK if name in link}
        rows.append(_row("driver's own count since its start", str(counted or link)))
        for name in self.running:
            row, more = self._program(name)
            rows.append(row)
            targets += [] if name == "emulator" else more
        return rows, targets

    def _program(self, name: str) -> tuple[dict[str, Any], list[Target]]:
        memory, threads, files = np.array(self._samples[name]).T
        at = len(memory) // 4
        try:
            used = process_cpu_s(self.running[name].pid) - self._cpu[name]
        except OSError:
            return _row(name, "has ended"), [at_most(f"{name}: has ended", 1, 0)]
        text = (
            f"{memory[at]:.1f} -> {memory[-1]:.1f} MB, {threads[-1]:.0f} threads, "
            f"{files[-1]:.0f} files, {100 * used / (60 * self.minutes):.1f} % CPU"
        )
        return _row(name, text), [
            at_most(f"{name}: growth [MB]", growth_mb(memory), _MAX_GROWTH_MB),
            at_most(f"{name}: more threads", int(threads[-1] - threads[at]), 0),
            at_most(f"{name}: more files", int(files[-1] - files[at]), 0),
        ]


def sample(program: Program) -> tuple[float, int, int]:
    """Return memory [MB], threads and open files of a process."""
    folder = Path(f"/proc/{program.pid}")
    threads, files = (sum(1 for _ in (folder / name).iterdir()) for name in ("task", "fd"))
    return resident_mb(program.pid), threads, files


def growth_mb(memory: NDArray[np.float64]) -> float:
    """Return by how much memory grew, from the second to the last quarter of the samples [MB]."""
    if len(memory) < 4:
        return float(memory[-1] - memory[0])
    quarter = len(memory) // 4
    return float(np.median(memory[-quarter:]) - np.median(memory[quarter : 2 * quarter]))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the chain, end it and then every program at random moments; return 1 on a miss."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--world", default="room")
    parser.add_argument("--motion", default="walk")
    parser.add_argument("--rounds", type=int, default=_ROUNDS, help="of interruptions")
    options = parser.parse_args(arguments)
    isolate_ros()
    unit = ["--boot-scale", "0.1", "--world", options.world]
    unit += ["--motion", options.motion] if options.world != "pattern" else []
    title = f"The whole chain for {options.minutes:g} minutes"
    with Programs() as programs, _watching() as (watch, casual):
        running = chain.start(programs, unit, {"qos_reliability": "reliable"})
        watch.until(lambda: len(watch.seen(CLOUDS)) > 0, programs, "no clouds")
        watch.watch(min(_WARM_UP_S, 15 * options.minutes))
        soak = Soak(running, watch, casual)
        trouble = _went_on(soak, programs, watch, options.minutes)
        rows, targets = soak.found()
        targets.append(at_most("ended before its time", int(bool(trouble)), 0))
        if trouble:
            rows.append(_row("ended before its time", trouble))
        for name, program in running.items():
            targets += _stopped(name, program, rows)
    if options.rounds and not trouble:
        targets.append(_interrupted(options.rounds, rows))
    publish("soak", title, rows, targets)
    return int(not all(target.met for target in targets))


@contextmanager
def _watching() -> Iterator[tuple[TopicWatch, TopicWatch]]:
    """Give who watches as reliable and as best-effort subscriber."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    with ExitStack() as stack:
        stack.callback(rclpy.try_shutdown)
        watch = TopicWatch(list(_PERIODS_S), reliable=True)
        stack.callback(watch.destroy_node)
        casual = TopicWatch(list(_PERIODS_S), name="casual_watch")
        stack.callback(casual.destroy_node)
        watch.spin_with(casual)
        yield watch, casual


def _went_on(soak: Soak, programs: Programs, watch: TopicWatch, minutes: float) -> str:
    """Let it go on, noting how it stands; return what ended it before its time."""
    try:
        while (left := minutes - soak.minutes) > 0:
            watch.watch(min(_LOOK_S, minutes * 60 / 8, left * 60))
            soak.look()
            programs.check()
            keep("soak", *soak.found())
    except KeyboardInterrupt:
        soak.look()
        return f"interrupted after {soak.minutes:.1f} min"
    except RuntimeError as error:
        return str(error)
    return ""


def _stopped(name: str, program: Program, rows: list[dict[str, Any]]) -> list[Target]:
    begin = time.monotonic()
    code, said = program.stop()
    took = time.monotonic() - begin
    words = f": {_last_words(said)}" if code else ""
    rows.append(_row(f"{name}: SIGINT", f"exit code {code} after {took:.1f} s{words}"))
    if name == "emulator":
        rows.append(_row("emulator's own report", " | ".join(said.splitlines()[-6:])))
    return [at_most(f"{name}: exit code after SIGINT", abs(code) + ("Traceback" in said), 0)]


def _interrupted(rounds: int, rows: list[dict[str, Any]]) -> Target:
    """Interrupt every program at random moments of its start and its work."""
    ends = interrupts.run(list(interrupts.commands(Path())), rounds, seed=3)
    ends += interrupts.run(["deskew_node", "odometry_node"], rounds, seed=4, is_fed=True)
    unclean = [
        f"{sent.program} after {sent.delay_s:.2f} s: {complaint}"
        for sent, how in ends
        if (complaint := how.complaint(sent))
    ]
    result = "; ".join(unclean) or "all clean"
    rows.append(_row(f"{len(ends)} programs ended at random moments", result))
    return at_most("unclean ends at random moments", len(unclean), 0)


def _last_words(said: str) -> str:
    return " ".join(said.split())[-300:]


def _row(what: str, result: str) -> dict[str, Any]:
    return {"what": what, "result": result}


if __name__ == "__main__":
    sys.exit(interruptible(main))
