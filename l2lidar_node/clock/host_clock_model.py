"""Host clock model: maps device time to the host's clock, smoothly, and detects its steps."""

from __future__ import annotations

from collections import deque
from typing import Final

from l2lidar_node.clock.lower_envelope import (
    BLOCK_NS,
    Line,
    LowerEnvelope,
    is_credible,
    supporting_line,
)

_MS: Final = 1_000_000
_QUIET_LOCK_NS: Final = 400 * _MS  # data that suffice while arrivals hardly vary
_LOCK_NS: Final = 1_600 * _MS  # data that must suffice
_QUIET_NS: Final = 50_000.0  # median delay above the line below which arrivals hardly vary
_FEWEST: Final = 40
_MOST: Final = 4096  # packets kept while not locked

_SETTLE_NS: Final = 500.0 * _MS  # time constant with which what is published follows the fit
_SLEW: Final = 0.002  # at most by that much faster or slower
_SEGMENTS: Final = 8

# Published stamps jump by more than this instead of closing in: the rest is gone after a second.
_STEP_NS: Final = 1_500_000
_EARLY_NS: Final = 300_000  # a single block earlier than that is an error, more of them are news
_SPREADS: Final = 2.0  # these margins grow by that many times what the least delay varies by
# A foreign step that was bridged wrongly makes all packets late from then on.
_SLIPPED_NS: Final = 100_000
_SLIPPED_BLOCKS: Final = 4
_REANCHOR_BLOCKS: Final = 20
_FORWARD_BLOCKS: Final = 10  # late packets may have waited somewhere
_LOADED_BLOCKS: Final = 3  # where steps are told, late packets that keep coming mean load
_BACKWARD_BLOCKS: Final = 2  # early ones cannot have
_MOST_BEFORE_STEP: Final = 10_000  # packets, 20 s of them; more, and the step was told wrongly
_KNOTS: Final = 64  # of the slewing, told every 100 ms where it is steady
_SUDDEN: Final = 1e-3  # a rate that changes by more is followed at once
_FASTEST_SLEW: Final = 0.1  # adjtimex(2) allows a tenth, by the length of the tick
_FLOWING: Final = 0.7  # a backlog that drains arrives in no time, a stepped clock goes on


class HostSlewing:
    """How far slewing has moved the host's clock: a piecewise linear function of host time.

    Host time minus this is *even* host time, which runs at the rate of the host's oscillator.

    Attributes
    ----------
    is_told : bool
        Whether anything was told; until then nothing has moved.
    """

    __slots__ = ("_base", "_knots", "is_told")

    def __init__(self) -> None:
        self.is_told = False
        self._base = 0
        self._knots: deque[tuple[int, int]] = deque([(0, 0)], maxlen=_KNOTS)

    def told(self, by_ns: int, at: int) -> None:
        """Record the total slewing [ns] when the clock shows ``at``."""
        if not self.is_told:
            self.is_told = True
            self._base = by_ns
            self._knots.clear()
        knots = self._knots
        while knots and knots[-1][0] >= at:  # the clock was set back without a report
            knots.pop()
        knots.append((at, by_ns - self._base))

    def stepped(self, by_ns: int) -> None:
        """Record a step of the host's clock."""
        self._knots = deque(((at + by_ns, by) for at, by in self._knots), maxlen=_KNOTS)

    @property
    def rate(self) -> float:
        """Recent slewing [ns per ns of host time]."""
        knots = self._knots
        if len(knots) < 2:
            return 0.0
        (t0, s0), (t1, s1) = knots[-2], knots[-1]
        return min(max((s1 - s0) / (t1 - t0), -_FASTEST_SLEW), _FASTEST_SLEW)

    def at(self, host: int) -> int:
        """Return how far the clock was moved when it showed ``host`` [ns]."""
        knots = self._knots
        at, by = knots[-1]
        if host >= at:
            return by + round((host - at) * self.rate)
        for begin in range(len(knots) - 2, -1, -1):
            t0, s0 = knots[begin]
            if host >= t0:
                return s0 + (by - s0) * (host - t0) // (at - t0)
            at, by = t0, s0
        return by

    def host(self, even: int) -> int:
        """Return the host time of an even host time."""
        return even + self.at(even + self._knots[-1][1])


class HostClockModel:
    """Maps the device line to the host's clock.

    Attributes
    ----------
    ready : bool
        Whether :meth:`at` can be used.
    due : int
        Place on the device line at which :meth:`update` wants to be called.
    steps : deque of int
        Steps of what is published that arrivals made necessary [ns]: the host's clock was set, or
        if that ``is_told``, load had hidden the true delay; reading it clears it.
    uncertainty_ns : float
        By how much stamps may be off [ns], the constant part of the path delay aside.
    late_ns : int
        How late the least delayed packet of the last 100 ms was, against the fit.
    is_told : bool
        Whether steps of the host's clock are reported; if not, they are inferred.
    advance_ns : int
        How much earlier than the envelope stamps shall be: the constant part of the path delay.
    line : Line
        The latest fit; before the first, only its ratio means something: the guess.

    Notes
    -----
    What is published is not the fit itself, which moves a little with every new block, but a
    continuous, strictly rising line that runs at the fitted ratio and closes in on the fit with a
    time constant of 0.5 s, never more than 0.2 % faster or slower: samples 4 ms apart stay 4 ms
    apart.

    Where slewing of the host's clock is told, the fit is in even host time: its ratio is that of
    two oscillators, which no time server changes. What is published follows the slewing.
    """

    __slots__ = (
        "_before_step",
        "_envelope",
        "_from",
        "_guess",
        "_host",
        "_low",
        "_low_at",
        "_packets",
        "_reanchors",
        "_segments",
        "_slewing",
        "_slipped",
        "_slope",
        "_suspects",
        "_u",
        "advance_ns",
        "due",
        "is_told",
        "late_ns",
        "line",
        "ready",
        "steps",
        "uncertainty_ns",
    )

    def __init__(self, ratio: float) -> None:
        self.line = Line(0, 0, ratio, 0.0)
        self.advance_ns = 0
        self.is_told = False
        self._before_step = 0  # packets that were still told in the time before a step
        self._from = 0  # arrivals before may be told in a time before the clock was set
        self.steps: deque[int] = deque(maxlen=64)
        self._slewing = HostSlewing()
        self._envelope: LowerEnvelope | None = None
        self._guess = ratio
        self.reset()

    def reset(self) -> None:
        """Forget everything but the ratio, as a guess."""
        if self._envelope is not None and self._envelope.is_known:
            self._guess = self.line.ratio
        self.ready = False
        self.late_ns = 0
        self.uncertainty_ns = 0.0
        self._envelope = None
        self._packets: list[tuple[int, int]] = []
        self._suspects: list[tuple[int, int]] = []
        self._reanchors = 0
        self._slipped: list[tuple[int, int]] = []
        self._segments: deque[tuple[int, int, float]] = deque(maxlen=_SEGMENTS)
        self._u = self._host = 0
        self._slope = self.line.ratio
        self._low: float | None = None
        self._low_at = (0, 0)  # in even host time, once the block has ended
        self.due = 0

    def add(self, u: int, arrival: int) -> None:
        """Take one packet: its place on the device line, and when it could leave at the latest."""
        if arrival < self._from:
            self._before_step += 1
            if self._before_step > _MOST_BEFORE_STEP:
                self._from = 0
            return
        if not self.ready:
            self._packets.append((u, arrival - self._slewing.at(arrival)))
            if len(self._packets) > _MOST:
                del self._packets[: _MOST // 2]
            return
        height = (arrival - self._host) - (u - self._u) * self._slope
        low = self._low
        if low is None or height < low or (height == low and arrival < self._low_at[1]):
            self._low = height
            self._low_at = (u, arrival)

    def stepped(self, by_ns: int, at: int) -> None:
        """Record a step of the host's clock, which shows ``at``; 0 announces reports of steps.

        A packet is stamped in the time that was shown when it was measured, whenever it comes.
        """
        self.is_told = True
        if not by_ns:
            return
        self._from, self._before_step = at, 0
        self._slewing.stepped(by_ns)
        self._suspects.clear()
        self._low = None
        if self._envelope is None:
            self._packets.clear()
            return
        self._envelope.host_stepped(by_ns)
        u = self._u + max(int((at - by_ns - self._host) / self._slope), 0)
        self._go(u, self.at(u) + by_ns, self._slope)

    def slewed(self, by_ns: int, at: int) -> None:
        """Record the total slewing of the host's clock [ns] at ``at``."""
        before = self._slewing.rate
        self._slewing.told(by_ns, at)
        if self._envelope is None:
            return
        self._envelope.is_slewing_told = True
        after = self._slewing.rate
        if abs(after - before) > _SUDDEN and at > self._host:
            u = self._u + int((at - self._host) / self._slope)
            self._go(u, self.at(u), self._slope * (1.0 - before) / (1.0 - after))

    @property
    def slew_rate(self) -> float:
        """How fast the host's clock is being slewed [ns per ns], as far as that is told."""
        return self._slewing.rate

    def reanchor(self) -> None:
        """Let the next blocks say whether device time has slipped, as after a foreign step.

        Packets that are late from then on are not taken for load.
        """
        self._reanchors = _REANCHOR_BLOCKS

    def at(self, u: int) -> int:
        """Return the host time [ns] of a place on the device line; needs ``ready``."""
        since = u - self._u
        if since >= 0:
            return self._host + int(since * self._slope)
        for start, host, slope in reversed(self._segments):
            if u >= start:
                return host + int((u - start) * slope)
        return self._host + int(since * self._slope)

    def lateness(self, u: int, arrival: int) -> int | None:
        """Return how late a packet is [ns], None while that is unknown."""
        return arrival - self.at(u) if self.ready else None

    def update(self, u: int) -> None:
        """Fit again; to be called when a packet at or after ``due`` was added."""
        if self._envelope is None:
            self._acquire(u)
        elif u >= self._u:  # else it was measured before the host's clock was set
            self._follow(self._envelope, u)
        self.due = u + int(BLOCK_NS / self._slope)

    def _acquire(self, u: int) -> None:
        packets = self._packets
        if len(packets) < _FEWEST:  # none at all where they came before the clock was set
            return
        packets.sort()
        span = packets[-1][1] - packets[0][1]
        if span < _QUIET_LOCK_NS:
            return
        line = supporting_line(packets, self.line.ratio)
        if line is None or not is_credible(line.ratio):
            self._drop_first_half(span)
            return
        if span < _LOCK_NS and line.excess > _QUIET_NS:
            return
        self._envelope = LowerEnvelope(line, packets, guess=self._guess, is_told=self.is_told)
        self._envelope.is_slewing_told = self._slewing.is_told
        self._packets = []
        line = self._envelope.line
        self._go(u, self._wanted(line, u), line.ratio / (1.0 - self._slewing.rate))
        self.line = line
        self.uncertainty_ns = self._envelope.uncertainty_ns
        self.ready = True

    def _drop_first_half(self, span: int) -> None:
        """Begin again with the newer packets when all of them are on no line."""
        if span >= _LOCK_NS:
            del self._packets[: len(self._packets) // 2]

    def _follow(self, envelope: LowerEnvelope, u: int) -> None:
        low, self._low = self._low, None
        if low is not None:
            at, arrival = self._low_at
            self._low_at = at, arrival - self._slewing.at(arrival)
        moves = envelope.moves
        if low is not None and envelope.begins_anew(self._low_at):
            self._suspects.clear()
        elif low is not None and not self._stepped(envelope, u):
            envelope.close(self._low_at, u)
        self.line = line = envelope.line
        self.uncertainty_ns = envelope.uncertainty_ns
        wanted = self._wanted(line, u)
        ratio = line.ratio / (1.0 - self._slewing.rate)
        host = self.at(u)
        is_new = envelope.moves != moves or (self.is_told and not envelope.is_known)
        if is_new and abs(wanted - host) > _STEP_NS:
            self.steps.append(wanted - host)
            self._go(u, wanted, ratio)
            return
        self.uncertainty_ns += abs(wanted - host)
        pull = (wanted - host) / _SETTLE_NS
        self._go(u, host, ratio * (1.0 + min(max(pull, -_SLEW), _SLEW)))

    def _wanted(self, line: Line, u: int) -> int:
        """Return the host time of a place on a fitted line."""
        return self._slewing.host(line.at(u)) - self.advance_ns

    def _stepped(self, envelope: LowerEnvelope, u: int) -> bool:
        """Look for a step of the host's clock; return whether the block was dealt with."""
        line = envelope.line
        off = self._low_at[1] - line.at(self._low_at[0])
        self.late_ns = max(off, 0)
        margin = _SPREADS * envelope.spread_ns
        suspects = self._suspects
        if self._has_slipped(off > _SLIPPED_NS + margin):
            suspects.clear()
            envelope.move(self._slipped, widen=False)
            self._slipped = []
            return True
        is_early = off < -_EARLY_NS - margin
        # Bounds of a known ratio keep late blocks from doing harm.
        is_late = off > _STEP_NS + margin and not (self.is_told and envelope.is_known)
        if not is_early and not is_late:
            suspects.clear()
            return False
        if suspects and (suspects[-1][1] < line.at(suspects[-1][0])) != is_early:
            suspects.clear()
        suspects.append(self._low_at)
        if is_early:
            enough = _BACKWARD_BLOCKS
        else:
            enough = _LOADED_BLOCKS if self.is_told else _FORWARD_BLOCKS
        if len(suspects) < enough:
            return True
        first, last = suspects[0], suspects[-1]
        if last[1] - first[1] < _FLOWING * (last[0] - first[0]) * line.ratio:
            del suspects[0]
            return True
        heights = [host - line.at(at) for at, host in suspects]
        if is_late and (self.is_told or max(heights) - min(heights) > _STEP_NS + margin):
            envelope.extend(suspects[:-1])  # a loaded path; no step varies so much
            suspects.clear()
            return False
        envelope.move(suspects)
        suspects.clear()
        return True

    def _has_slipped(self, is_late: bool) -> bool:
        """Whether all blocks in a row, soon after a foreign step, are late."""
        if not self._reanchors:
            return False
        self._reanchors -= 1
        self._slipped = [*self._slipped, self._low_at] if is_late else []
        return len(self._slipped) >= _SLIPPED_BLOCKS

    def _go(self, u: int, host: int, slope: float) -> None:
        """Begin a new segment of what is published."""
        if self.ready:
            self._segments.append((self._u, self._host, self._slope))
        self._u, self._host, self._slope = u, host, slope
