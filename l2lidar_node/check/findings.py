"""Says what was found: one line, how bad it is, and what to do about it."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class Level(IntEnum):
    """How bad a finding is."""

    OK = 0
    WARN = 1  # works, worse than it could
    ERROR = 2  # does not work


class Finding(NamedTuple):
    """The result of one check.

    Attributes
    ----------
    level : Level
    subject : str
        What was looked at: cloud, times, imu, frames, qos.
    check : str
        Name of the check, for programs.
    text : str
        What was found and what is demanded; one line.
    fix : str
        What to do; empty where nothing is to be done.
    """

    level: Level
    subject: str
    check: str
    text: str
    fix: str = ""

    @property
    def line(self) -> str:
        """Everything in one line."""
        return f"{self.text}; {self.fix}" if self.fix else self.text


def ok(subject: str, check: str, text: str) -> Finding:
    """Return a finding that is fine."""
    return Finding(Level.OK, subject, check, text)


def not_judged(subject: str, check: str, text: str) -> Finding:
    """Return a finding that nothing can be said, and why."""
    return Finding(Level.OK, subject, check, f"not judged: {text}")


def worst(findings: list[Finding]) -> Level:
    """Return the worst level; OK of none."""
    return max((item.level for item in findings), default=Level.OK)
