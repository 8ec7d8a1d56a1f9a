"""Reads what processes use from /proc."""

from __future__ import annotations

import os
import time
from pathlib import Path

_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


def process_cpu_s(pid: int) -> float:
    """Return the CPU time a process has used, user and system, all threads [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S


def resident_mb(pid: int) -> float:
    """Return the memory of a process that is in RAM [MB]."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


class ForeignLoad:
    """How much of the machine programs use that are not of a process and its children.

    Parameters
    ----------
    pid : int
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self.begin()

    def begin(self) -> None:
        """Count from here on."""
        self._busy_s, self._own_s, self._at_s = *self._read(), time.monotonic()

    def share(self) -> float:
        """Return the share of all processors since the beginning, 0 to 1."""
        busy, own = self._read()
        elapsed = (time.monotonic() - self._at_s) * (os.cpu_count() or 1)
        return max(busy - self._busy_s - (own - self._own_s), 0.0) / max(elapsed, 1e-9)

    def _read(self) -> tuple[float, float]:
        """Return processor time of the machine and of the process with its children [s]."""
        counts = Path("/proc/stat").read_text().splitlines()[0].split()[1:9]
        busy = sum(map(int, counts)) - int(counts[3]) - int(counts[4])  # idle, iowait
        children: dict[int, list[int]] = {}
        own: dict[int, int] = {}
        for path in Path("/proc").glob("[0-9]*/stat"):
            try:
                fields = path.read_text().rpartition(")")[2].split()
            except OSError:  # it has ended
                continue
            pid = int(path.parent.name)
            children.setdefault(int(fields[1]), []).append(pid)
            own[pid] = int(fields[11]) + int(fields[12])
        total, todo = 0, [self._pid]
        while todo:
            pid = todo.pop()
            total += own.get(pid, 0)
            todo += children.get(pid, [])
        return busy / _TICKS_PER_S, total / _TICKS_PER_S
