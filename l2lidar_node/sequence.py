"""Puts the packets of one stream back into order by their sequence numbers and counts what is missing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Generic, TypeVar

T = TypeVar("T")

FIRST_MODULUS: Final = 1025  # every published number is below it; corrected by what is seen
_UNKNOWN: Final = 0
_LATE_REACH: Final = 64  # numbers this far behind are late ones, not a wrap


@dataclass(slots=True)
class SequenceCounts:
    """What the sequence numbers of one stream said so far.

    Attributes
    ----------
    lost : int
        Numbers that never came.
    duplicates : int
        Packets that came again.
    late : int
        Packets that came after their place had been given up; they are dropped.
    reordered : int
        Packets that came after a later one and were put back into their place.
    restarts : int
        Times the numbers began anew.
    """

    lost: int = 0
    duplicates: int = 0
    late: int = 0
    reordered: int = 0
    restarts: int = 0


class SequenceOrder(Generic[T]):
    """Releases packets in the order of their numbers.

    A packet that is next in line is released at once. One that is early waits for the missing ones until
    more than ``window`` packets wait; then the missing ones are counted as lost.

    Parameters
    ----------
    window : int
        How many early packets may wait; 0 releases everything at once.

    Notes
    -----
    Numbers wrap. The modulus is not documented (0..1024 has been seen), so it is learned: a number beyond
    it makes it unknown, and two wraps in a row from the same number settle it.
    """

    def __init__(self, window: int) -> None:
        self.counts = SequenceCounts()
        self._window = window
        self._modulus = FIRST_MODULUS
        self._next: int | None = None
        self._waiting: dict[int, T] = {}
        self._recent: set[int] = set()  # numbers given up lately: tells late from duplicate
        self._last_wrap = _UNKNOWN

    @property
    def waiting(self) -> int:
        """Packets that came early and wait."""
        return len(self._waiting)

    def push(self, seq: int, item: T) -> list[tuple[int, T]]:
        """Return what can be released now, each with the count of numbers missing just before it."""
        if seq == self._next and not self._waiting:
            self._next = self._after(seq)
            return [(0, item)]
        if self._next is None:
            self._next = self._after(seq)
            return [(0, item)]
        if self._modulus != _UNKNOWN and seq >= self._modulus:
            self._next = self._next or self._modulus
            self._modulus = _UNKNOWN
        ahead = self._ahead(seq)
        if ahead < 0:
            self._count_behind(seq)
            return []
        if seq in self._waiting:
            self.counts.duplicates += 1
            return []
        if ahead == 0:
            self.counts.reordered += 1
        self._waiting[seq] = item
        released = self._run(0)
        while len(self._waiting) > self._window:
            released += self._skip()
        return released

    def flush(self) -> list[tuple[int, T]]:
        """Release everything that waits, counting the numbers in between as lost."""
        released: list[tuple[int, T]] = []
        while self._waiting:
            released += self._skip()
        return released

    def restart(self) -> list[tuple[int, T]]:
        """Release everything that waits and take the next number, whatever it is, as the first."""
        released = self.flush()
        self._next = None
        self._recent.clear()
        self.counts.restarts += 1
        return released

    def _after(self, seq: int) -> int:
        return seq + 1 if seq + 1 != self._modulus else 0

    def _ahead(self, seq: int) -> int:
        """Return how many numbers lie between the next one and this one; negative if it is behind."""
        assert self._next is not None
        reach = 2 * self._window + _LATE_REACH
        if self._modulus != _UNKNOWN:
            ahead = (seq - self._next) % self._modulus
            return ahead - self._modulus if ahead >= self._modulus - reach else ahead
        if seq >= self._next or self._next - seq <= reach:
            return seq - self._next
        return seq  # it wrapped, and where is not known yet: only the numbers after 0 can be missed

    def _count_behind(self, seq: int) -> None:
        if seq in self._recent:
            self._recent.discard(seq)
            self.counts.lost -= 1
            self.counts.late += 1
        else:
            self.counts.duplicates += 1

    def _skip(self) -> list[tuple[int, T]]:
        """Give up the numbers before the first waiting packet and release from there."""
        first = min(self._waiting, key=self._ahead)
        missing = self._ahead(first)
        assert self._next is not None
        if first < self._next and first == 0:
            missing -= self._learn_wrap(self._next, missing)
        self._recent = {(first - back) % (self._modulus or 1 << 32) for back in range(1, missing + 1)[:_LATE_REACH]}
        self.counts.lost += missing
        self._next = first
        return self._run(missing)

    def _run(self, missing: int) -> list[tuple[int, T]]:
        released: list[tuple[int, T]] = []
        while self._next in self._waiting:
            seq = self._next
            released.append((missing, self._waiting.pop(seq)))
            missing = 0
            self._next = self._after(seq)
        return released

    def _learn_wrap(self, wrapped_from: int, missing: int) -> int:
        """Learn the modulus from a wrap to 0; return how many of the missing numbers do not exist."""
        if wrapped_from != self._last_wrap:
            self._last_wrap = wrapped_from
            return 0
        self._modulus = wrapped_from
        return missing
