"""Checks whether the machine kept up with the demo; if not, the figures are inconclusive."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from l2lidar_node.emulator.truth import Results

INCONCLUSIVE: Final = os.EX_TEMPFAIL
"""Exit code of a demo whose figures are wrong on a machine that did not keep up."""

MAX_LATENCY_MS: Final = 500.0
"""Of the virtual L2's packets, all but one in a hundred. A real L2 is never late, and a machine
that keeps up sends them within 50 ms."""
MAX_WAITING: Final = 0.5
"""Largest share of the time in which a program could run that it waits for a processor."""


class ProcessorTime(NamedTuple):
    """Processor time of a program's main thread.

    Attributes
    ----------
    ran_s, waited_s : float
        How long it ran, and how long it could have run but had to wait for a processor [s].
    """

    ran_s: float
    waited_s: float

    @property
    def waiting(self) -> float:
        """Share of the time in which it could run that it waited."""
        return self.waited_s / max(self.ran_s + self.waited_s, 1e-9)


_NO_TIME: Final = ProcessorTime(0.0, 0.0)


def processor_time(pid: int) -> ProcessorTime | None:
    """Return the processor time of a process; None where the system does not tell."""
    try:
        ran_ns, waited_ns = Path(f"/proc/{pid}/schedstat").read_text().split()[:2]
    except (OSError, ValueError):
        return None
    return ProcessorTime(int(ran_ns) * 1e-9, int(waited_ns) * 1e-9)


def shortfall(run: Mapping[str, Any], times: Mapping[str, ProcessorTime]) -> str:
    """Return where the machine fell behind; empty if it kept up.

    Only what has nothing to do with the driver and what follows it counts: an odometry that skips
    sweeps may just be slow.

    Parameters
    ----------
    run : mapping
        What the virtual L2 says of its run, see :attr:`Results.run`.
    times : mapping
        Processor time by the name of a program.
    """
    found = []
    latency = run["latency_ms"]
    if latency["p99"] > MAX_LATENCY_MS:
        found.append(
            f"the virtual L2 sent its packets up to {latency['max'] / 1e3:.1f} s late (half of "
            f"them by more than {latency['p50'] / 1e3:.2f} s), which a real one never does"
        )
    name, worst = max(times.items(), key=lambda item: item[1].waiting, default=("", _NO_TIME))
    if worst.waiting > MAX_WAITING:
        found.append(
            f"{name} ran for {worst.ran_s:.1f} s and waited {worst.waited_s:.1f} s for a processor"
        )
    return "; ".join(found)


def shortfall_since(began_ns: int, truth: Path, times: Mapping[str, ProcessorTime]) -> str:
    """Return the :func:`shortfall` of a run that began at an instant, by the truth it wrote."""
    try:
        run = Results(truth).run
    except OSError:
        return ""
    is_of_this_run = run["power_on_ns"] > began_ns
    return shortfall(run, times) if is_of_this_run else ""


def verdict(troubles: list[str], behind: str) -> tuple[int, list[str]]:
    """Return the exit code and the final message.

    Parameters
    ----------
    troubles : list of str
        What is not as it should be.
    behind : str
        See :func:`shortfall`.
    """
    if not behind:
        return int(bool(troubles)), troubles
    cores = len(os.sched_getaffinity(0))
    load = f"load average {os.getloadavg()[0]:.1f} on {cores} processors"
    if not troubles:
        return 0, [
            f"This machine was busy ({load}): {behind}. All figures are right nevertheless."
        ]
    return INCONCLUSIVE, [
        f"THIS MACHINE DID NOT KEEP UP ({load}): {behind}.",
        "So the following says nothing about the driver or the odometry:",
        *(f"  {trouble}" for trouble in troubles),
        "Close other programs, or wait until the machine is idle, and run it again. On a small "
        'computer: make demo DEMO_ARGS="--driver-only", which needs a third of the processor.',
    ]
