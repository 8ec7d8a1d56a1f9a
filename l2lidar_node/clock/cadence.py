"""Knows how regular a stream's stamps are and predicts the next one from its sequence number."""

from __future__ import annotations

import statistics
from itertools import pairwise
from typing import Final

FIRST_MODULUS: Final = 1025  # every published number is below it; corrected by what is seen

_LEARN: Final = 9  # packets from which the period is learned
_MEMORY: Final = 512  # packets over which the period is averaged
_FLOOR_NS: Final = 2_000.0  # deviations this small are never a step
_CEILING_NS: Final = 150_000.0
_SIGMAS: Final = 5.0  # in mean absolute deviations
_NEAR: Final = 64  # packets that may be missing where numbers wrap for the first time
_WANDER: Final = 16  # packets over which deviations may add up
_SLIP: Final = 0.05  # of the advance, or one period: more irregular than that a stream is not


class Cadence:
    """Phase and period of one stream, in device nanoseconds.

    Parameters
    ----------
    gain : float
        Share of a deviation that moves the phase, 0 to 1.

    Notes
    -----
    A phase-locked loop beside a running mean of the period. A stream whose period itself varies (a
    motor's) is best predicted from its last packet: high gain. One with a steady period and noise
    on single stamps (a sampler's) needs a long memory, or every bridged step would add the noise
    of one stamp to the line.
    """

    __slots__ = (
        "_count",
        "_gain",
        "_history",
        "_lag",
        "_modulus",
        "_noise",
        "_period",
        "_seq",
        "_sure",
        "_tolerance",
    )

    def __init__(self, gain: float) -> None:
        self._gain = gain
        self._modulus = FIRST_MODULUS  # 0 while unknown
        self._sure = False  # numbers have wrapped there
        self._history: list[tuple[int, int]] = []
        self._seq = 0
        self._period = 0.0
        self._count = 0  # packets that the period is the mean of
        self._lag = 0.0  # predicted phase minus the last stamp
        self._noise = 0.0
        self._tolerance = _FLOOR_NS

    def forget(self) -> None:
        """Forget phase and period, not the modulus."""
        self._history.clear()

    def learn(self, seq: int, stamp: int) -> bool:
        """Take a packet to learn from; return whether the period is known now."""
        history = self._history
        history.append((seq, stamp))
        if len(history) < _LEARN:
            return False
        del history[:-_LEARN]
        steps = [
            (b - a) / self._distance(m, n)
            for (m, a), (n, b) in pairwise(history)
            if self._distance(m, n) > 0
        ]
        period = statistics.median(steps) if steps else 0.0
        if period <= 0.0:
            return False
        self._period = period
        self._count = len(history)
        self._noise = statistics.median(abs(step - period) for step in steps)
        self._seq = seq
        self._lag = 0.0
        self._tolerance = min(_FLOOR_NS + _SIGMAS * self._noise, _CEILING_NS)
        history.clear()
        return True

    def follows(self, seq: int, advance: int) -> bool:
        """Take the next packet if it is where it is expected.

        ``advance`` is how far its place is from the last packet's.
        """
        gap = seq - self._seq
        if gap <= 0:
            gap += self._modulus
        period = self._period
        off = advance - gap * period - self._lag
        noise = self._tolerance if gap == 1 else self.noise(gap)
        if gap <= 0 or not -noise <= off <= noise:
            return False
        if seq < self._seq:
            self._sure = True
        self._lag = (self._gain - 1.0) * off
        count = self._count
        if count < _MEMORY:
            self._count = count = count + 1
        self._period = period + (advance / gap - period) / count
        self._seq = seq
        if gap == 1:
            noise = self._noise
            self._noise = noise = noise + 0.01 * ((off if off > 0.0 else -off) - noise)
            tolerance = _FLOOR_NS + _SIGMAS * noise
            self._tolerance = tolerance if tolerance < _CEILING_NS else _CEILING_NS
        return True

    def resume(self, seq: int, advance: int) -> None:
        """Go on from a packet that is not where it was expected, or where a step was bridged."""
        off = advance - self.gap(seq, advance) * self._period - self._lag
        self._lag = (self._gain - 1.0) * off if abs(off) < self._tolerance else 0.0
        self._seq = seq

    def gap(self, seq: int, advance: int) -> int:
        """Return how many numbers a packet is after the last; learn where numbers wrap."""
        gap = seq - self._seq
        if gap > 0:
            return gap
        if self._seq >= self._modulus:
            self._modulus = 0
            self._sure = False
        elif self._sure:
            return gap + self._modulus
        counted = round(advance / self._period)
        if 0 < counted <= _NEAR and abs(advance - counted * self._period) <= self._tolerance:
            self._modulus = self._seq + counted - seq
            return counted
        return gap + self._modulus if self._modulus else 1

    def back(self, seq: int) -> int:
        """Return by how many numbers a packet is before the last one, if numbers did not wrap."""
        return self._seq - seq

    def advance(self, gap: int) -> int:
        """Return the device time from the last packet to one some numbers later [ns]."""
        return round(gap * self._period + self._lag)

    @property
    def lap_ns(self) -> float:
        """Time from a number to its next use [ns device]; 0 while unknown."""
        return self._modulus * self._period

    def ascends(self, seq: int) -> bool:
        """Whether a number is above the last one, so neither wrapped nor restarted since."""
        return seq > self._seq

    def noise(self, gap: int) -> float:
        """Return by how much a packet may be off before it is not where it was expected [ns]."""
        return min(gap, _WANDER) * self._tolerance

    def slip(self, gap: int) -> int:
        """Return by how much a packet may be off without a step being the reason [ns]."""
        return round(self._tolerance + max(_SLIP * gap, 1.0) * self._period)

    def wander(self, gap: int) -> int:
        """Return by how much a stream may be off by its own irregularity [ns]."""
        return round(self.noise(gap) + _SLIP * gap * self._period)

    def regular(self, gap: int, advance: int) -> bool:
        """Whether two packets so many numbers apart are as far apart as they should be."""
        return gap > 0 and abs(advance - gap * self._period) <= self.wander(gap)

    def _distance(self, first: int, second: int) -> int:
        gap = second - first
        return gap + self._modulus if gap <= 0 else gap
