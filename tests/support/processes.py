"""The processes that a test starts, and their end whatever the test does."""

from __future__ import annotations

import subprocess

_running: list[subprocess.Popen[str]] = []


def ended_with_the_test(process: subprocess.Popen[str]) -> subprocess.Popen[str]:
    """Have a process killed when the test is over; return it."""
    _running.append(process)
    return process


def end_all() -> None:
    """Kill what still runs."""
    for process in _running:
        if process.poll() is None:
            process.kill()
            process.communicate()
    _running.clear()
