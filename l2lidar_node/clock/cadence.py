"""Phase-locked loop that predicts a stream's next stamp from its sequence number."""

from __future__ import annotations

import statistics
from itertools import pairwise
from typing import Final

FIRST_MODULUS: Final = 1025  # sequence numbers seen so far are below it; learned when they wrap

_ACQUISITION_PACKETS: Final = 9  # needed to estimate the period for the first time
_AVERAGING_PACKETS: Final = 512  # length of the running mean of the period
_MIN_TOLERANCE_NS: Final = 2_000.0  # smaller deviations never count as a step of the clock
_MAX_TOLERANCE_NS: Final = 150_000.0
_TOLERANCE_DEVIATIONS: Final = 5.0  # tolerance in mean absolute deviations
_DEVIATION_GAIN: Final = 0.01  # of the running mean of the absolute deviation
_MAX_MISSING_AT_WRAP: Final = 64  # packets that may be lost where the numbers wrap first
_RANDOM_WALK_PACKETS: Final = 16  # deviations accumulate over this many packets at most
_MAX_IRREGULARITY: Final = 0.05  # of the advance; no stream is more irregular than that


class Cadence:
    """Phase and period of one stream, in device nanoseconds.

    Parameters
    ----------
    gain : float
        Share of each deviation that corrects the phase, 0 to 1.

    Notes
    -----
    A first-order phase-locked loop beside a running mean of the period. The gain depends on what
    makes a stream irregular. If its period varies (the motor of the mirror), the last packet is
    the best reference: the gain is high. If its period is constant and single stamps are noisy
    (the IMU's sampler), the gain is low. With a high one, every bridged step of the clock would
    add the noise of one stamp to the device line.
    """

    __slots__ = (
        "_deviation",
        "_gain",
        "_history",
        "_is_modulus_confirmed",
        "_modulus",
        "_period",
        "_period_packets",
        "_phase",
        "_seq",
        "_tolerance",
    )

    def __init__(self, gain: float) -> None:
        self._gain = gain
        self._modulus = FIRST_MODULUS  # 0: unknown
        self._is_modulus_confirmed = False
        self._history: list[tuple[int, int]] = []
        self._seq = 0
        self._period = 0.0
        self._period_packets = 0  # that the mean of the period is taken over
        self._phase = 0.0  # predicted minus measured place of the last packet
        self._deviation = 0.0  # mean absolute deviation from the prediction
        self._tolerance = _MIN_TOLERANCE_NS

    def forget(self) -> None:
        """Drop the packets collected so far; the modulus of the sequence numbers stays."""
        self._history.clear()

    def learn(self, seq: int, stamp: int) -> bool:
        """Collect a packet to acquire the period; return whether the period is known now.

        The period is the median over the last few packets, so a single step does not spoil it.
        """
        history = self._history
        history.append((seq, stamp))
        if len(history) < _ACQUISITION_PACKETS:
            return False
        del history[:-_ACQUISITION_PACKETS]
        periods = [
            (b - a) / self._distance(m, n)
            for (m, a), (n, b) in pairwise(history)
            if self._distance(m, n) > 0
        ]
        period = statistics.median(periods) if periods else 0.0
        if period <= 0.0:
            return False
        self._period = period
        self._period_packets = len(history)
        self._deviation = statistics.median(abs(item - period) for item in periods)
        self._seq = seq
        self._phase = 0.0
        tolerance = _MIN_TOLERANCE_NS + _TOLERANCE_DEVIATIONS * self._deviation
        self._tolerance = min(tolerance, _MAX_TOLERANCE_NS)
        history.clear()
        return True

    def deviation(self, seq: int, advance: int) -> tuple[int, float] | None:
        """Return by how many numbers a packet is after the last one, and its deviation [ns].

        That is how far it is from where the loop predicts it. None if it is too far.
        """
        gap = seq - self._seq
        if gap <= 0:
            gap += self._modulus
        off = advance - gap * self._period - self._phase
        tolerance = self._tolerance if gap == 1 else self.noise(gap)
        return (gap, off) if gap > 0 and -tolerance <= off <= tolerance else None

    def follows(self, seq: int, advance: int) -> bool:
        """Update the loop with the next packet, if that is where the loop predicts it.

        Parameters
        ----------
        seq : int
        advance : int
            Device time from the last packet to this one [ns].

        Returns
        -------
        bool
            False if it is elsewhere; the loop is unchanged then.
        """
        found = self.deviation(seq, advance)
        if found is None:
            return False
        gap, off = found
        if seq < self._seq:
            self._is_modulus_confirmed = True
        self._phase = (self._gain - 1.0) * off
        count = self._period_packets
        if count < _AVERAGING_PACKETS:
            self._period_packets = count = count + 1
        self._period += (advance / gap - self._period) / count
        self._seq = seq
        if gap == 1:
            deviation = self._deviation
            deviation += _DEVIATION_GAIN * ((off if off > 0.0 else -off) - deviation)
            self._deviation = deviation
            tolerance = _MIN_TOLERANCE_NS + _TOLERANCE_DEVIATIONS * deviation
            self._tolerance = tolerance if tolerance < _MAX_TOLERANCE_NS else _MAX_TOLERANCE_NS
        return True

    def resume(self, seq: int, advance: int) -> None:
        """Continue from a packet that was not where the loop predicted it.

        A small deviation still corrects the phase. After a larger one, such as a bridged step, the
        packet itself is the new reference.
        """
        off = advance - self.gap(seq, advance) * self._period - self._phase
        self._phase = (self._gain - 1.0) * off if abs(off) < self._tolerance else 0.0
        self._seq = seq

    def gap(self, seq: int, advance: int) -> int:
        """Return by how many numbers a packet is after the last one.

        Where the numbers wrap for the first time, the advance gives the gap and the gap gives the
        modulus.
        """
        gap = seq - self._seq
        if gap > 0:
            return gap
        if self._seq >= self._modulus:
            self._modulus = 0
            self._is_modulus_confirmed = False
        elif self._is_modulus_confirmed:
            return gap + self._modulus
        counted = round(advance / self._period)
        is_near = 0 < counted <= _MAX_MISSING_AT_WRAP
        if is_near and abs(advance - counted * self._period) <= self._tolerance:
            self._modulus = self._seq + counted - seq
            return counted
        return gap + self._modulus if self._modulus else 1

    def back(self, seq: int) -> int:
        """Return by how many numbers a packet is before the last one, if they did not wrap."""
        return self._seq - seq

    def advance(self, gap: int) -> int:
        """Return the predicted device time from the last packet to one ``gap`` later [ns]."""
        return round(gap * self._period + self._phase)

    @property
    def lap_ns(self) -> float:
        """Device time until a sequence number comes again [ns]; 0 while unknown."""
        return self._modulus * self._period

    def ascends(self, seq: int) -> bool:
        """Return whether a number is above the last one: no wrap and no restart in between."""
        return seq > self._seq

    def noise(self, gap: int) -> float:
        """Return the tolerance for a packet ``gap`` after the last one [ns].

        It grows with the gap, because deviations of the period accumulate.
        """
        return min(gap, _RANDOM_WALK_PACKETS) * self._tolerance

    def slip(self, gap: int) -> int:
        """Return the largest deviation that needs no step of the clock to explain it [ns].

        Irregularity of the stream, or one packet that the numbers do not count.
        """
        return round(self._tolerance + max(_MAX_IRREGULARITY * gap, 1.0) * self._period)

    def wander(self, gap: int) -> int:
        """Return the largest deviation that the stream's irregularity alone can make [ns]."""
        return round(self.noise(gap) + _MAX_IRREGULARITY * gap * self._period)

    def regular(self, gap: int, advance: int) -> bool:
        """Return whether two packets are as far apart as their numbers say."""
        return gap > 0 and abs(advance - gap * self._period) <= self.wander(gap)

    def _distance(self, first: int, second: int) -> int:
        gap = second - first
        return gap + self._modulus if gap <= 0 else gap
