"""Lower envelope of the delays: the line from device time to host time below all arrivals.

A packet arrives when it was measured plus a delay that is never below the constant part of the
path. In the plane of device time and arrival all packets therefore lie on or above the wanted
line. :func:`supporting_line` returns the line below all of them with the least sum of distances,
an edge of their lower convex hull (Moon, Skelly and Towsley, "Estimation and removal of clock skew
from network delay measurements", INFOCOM 1999; Zhang, Liu and Xia, "Clock synchronization
algorithms for network measurements", INFOCOM 2002). :class:`LowerEnvelope` keeps such a line up to
date.

A Kalman filter would average. Delays are one-sided, so its answer moves with their mean, by
milliseconds when the network gets busy. The envelope moves with their minimum, needs no noise
model, and yields ratio and offset together. Its weakness is that the minimum itself may change:
under load even the least delayed packet is late. Three rules keep that out of the estimate.

* The ratio moves within bounds that only evidence narrows and that time widens no faster than a
  crystal can drift. A change of the delays cannot tilt the line by more.
* Each block of packets carries an error bound, as in the clock filter of NTP (RFC 5905, section
  10): its height above the line plus a dispersion that grows with its age. Only the blocks with
  the least bounds select the edge, so packets of a loaded path do not outvote those of a quiet
  one before or after it.
* The least of these bounds is the stated uncertainty. It grows under load.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from itertools import pairwise
from operator import itemgetter
from typing import Final, NamedTuple

_BLOCK_S: Final = 0.1
SHORT_BLOCKS: Final = 30
# About a minute: longer than the loads that a link recovers from, and short enough for the
# dispersion, 2 ms by then, to be useful.
_LONG_BLOCKS: Final = 640
_QUIET_NS: Final = 20_000.0  # median height of the blocks at which the short window starts to grow
_MIN_SPAN_NS: Final = 1_400_000_000  # [ns host] shorter data say nothing about the ratio
_RATIOS: Final = (0.45, 3.3)
_FORGET: Final = 2 * _LONG_BLOCKS  # [blocks] older ones are not used, however few there are

# AT-cut crystals change by up to about 1 ppm/K away from their turning point, and no housing of a
# sensor warms up by more than 1 K/s.
_DRIFT_PER_S: Final = 1e-6
# How far a ratio may always be from the best estimate, as a share. Two crystals: a draft of cold
# air. A host that does not tell of its adjustments: 500 ppm (adjtimex(2)), and the crystals.
_LEAST_WIDTH: Final = 5e-6
_UNTOLD_WIDTH: Final = 600e-6

# Blocks in which a trend is looked for once one is that late. The longer ones find it in spite of
# batches and jitter.
_TRENDS: Final = (15, 60, 120)
_TREND_NS: Final = 50_000
_STRAIGHT: Final = 2.5  # times the error of its ratio: a load that grows is less straight

_VOTERS: Final = 8  # blocks that suffice to select an edge: two lie on it, the others confirm it
_LEVEL: Final = 4.0  # blocks with bounds up to this many times the least ones are used as well
_PARTS: Final = 4  # of the data, compared to see how well the minimum repeats
_RESOLUTION_NS: Final = 10_000.0  # to which the minimum of a quiet path repeats, block by block
# Measured on simulated loads: the error of a ratio stays within three times the error of the
# minimum over the span.
_SAFETY: Final = 3.0
_KNOWN: Final = 50e-6  # a ratio is known when it is known to what crystals differ by
_TIGHT: Final = 200e-6  # the latest blocks alone say as much only after a load has ended
_BETTER: Final = 4.0  # and must repeat so much better than those that a known ratio comes from
_FAR_BETTER: Final = 30.0  # or so much better where it is not known: jitter of 0.2 ms after 20 ms
_WRONG: Final = 0.02  # a ratio found under load can be off by that; a backlog that drains is more
_GUESS: Final = 1e-3  # deviation of units from the guess, as a share; those measured are 7e-4 off
# Sum of distances of packets to a line with the guessed ratio over that of the best line. Where
# the guess was right it was below this in 99 of 100 simulated loads of 16 batches and more.
_CONTRADICTED: Final = 1.5

_DEVICE_TIME: Final = itemgetter(0)  # of a point

BLOCK_NS: Final = int(_BLOCK_S * 1e9)
"""Length of a block [ns host]: of the packets in one, only the least delayed one is kept."""


def is_credible(ratio: float) -> bool:
    """Whether a clock can run at this ratio: those of units lie between 0.5 and 3."""
    return _RATIOS[0] < ratio < _RATIOS[1]


class Line(NamedTuple):
    """Host time as a straight line over device time.

    Attributes
    ----------
    u : int
        Device time [ns] at which the line is anchored.
    host : int
        Host time [ns] there.
    ratio : float
        Host nanoseconds per device nanosecond.
    excess : float
        Median height [ns host] of the fitted packets above the line.
    """

    u: int
    host: int
    ratio: float
    excess: float

    def at(self, u: int) -> int:
        """Return the host time [ns] of a device time [ns]."""
        return self.host + int((u - self.u) * self.ratio)


def supporting_line(packets: list[tuple[int, int]], guess: float) -> Line | None:
    """Return the line below all packets with the least sum of distances to them.

    Parameters
    ----------
    packets : list of (int, int)
        Device time and arrival [ns], ascending in device time.
    guess : float
        Ratio that is roughly right; it is taken out before floats are used.

    Returns
    -------
    Line or None
        None if all packets have the same device time.
    """
    u0, h0 = packets[0]
    points = [(float(u - u0), (h - h0) - guess * (u - u0)) for u, h in packets]
    edge = _edge(points, sum([x for x, _ in points]) / len(points))
    if edge is None:
        return None
    base, slope = edge
    heights = sorted(_heights(points, base, slope))
    return Line(u0, h0 + round(base), guess + slope, heights[len(heights) // 2])


def _is_within(above: list[tuple[float, int]], lo: float, hi: float) -> bool:
    """Tell whether the slope of the supporting line of points (y, x) lies within bounds.

    Seen along a line that is too steep, the lowest point is behind their mean; too flat, before.
    """
    mean = sum([x for _, x in above]) / len(above)
    steep = min([(y - hi * x, x) for y, x in above])[1]
    flat = min([(y - lo * x, x) for y, x in above])[1]
    return flat <= mean <= steep


def _above_lowest(packets: list[tuple[int, int]], ratio: float) -> list[float]:
    """Return the heights of packets above the line of a ratio through the lowest of them."""
    u0, h0 = packets[0]
    heights = [(h - h0) - ratio * (u - u0) for u, h in packets]
    lowest = min(heights)
    return [height - lowest for height in heights]


def _edge(points: list[tuple[float, float]], at: float) -> tuple[float, float] | None:
    """Return height at 0 and slope of the edge over a place of the lower convex hull of points.

    The walk along the hull (Jarvis, Information Processing Letters 2, 1973) begins at the lowest
    point, which is hardly ever more than three edges away.

    Parameters
    ----------
    points : list of (float, float)
        Ascending in x.
    at : float
        Between the first x and the last one.

    Returns
    -------
    (float, float) or None
        None if all x are the same.
    """
    heights = [y for _, y in points]
    lowest = heights.index(min(heights))
    x, y = points[lowest]
    left = [point for point in points[:lowest] if point[0] < x]
    right = [point for point in points[lowest + 1 :] if point[0] > x]
    slope = 0.0
    if left and (at <= x or not right):
        while left and x >= at:
            slopes = [(y - b) / (x - a) for a, b in left]
            slope = max(slopes)
            farthest = slopes.index(slope)
            x, y = left[farthest]
            left = [point for point in left[:farthest] if point[0] < x]
    elif right:
        while right and x < at:
            slopes = [(b - y) / (a - x) for a, b in right]
            slope = min(slopes)
            farthest = len(slopes) - 1 - slopes[::-1].index(slope)
            x, y = right[farthest]
            right = [point for point in right[farthest + 1 :] if point[0] > x]
    else:
        return None
    return y - slope * x, slope


def _heights(points: list[tuple[float, float]], base: float, slope: float) -> list[float]:
    """Return the heights of points above a line."""
    return [y - base - slope * x for x, y in points]


class LowerEnvelope:
    """Keeps the least delayed packet of every block and fits the line through the latest of them.

    Parameters
    ----------
    line : Line
        The first fit, from all packets since the start.
    packets : list of (int, int)
        Those packets: device time and arrival [ns], ascending in device time.
    guess : float
        Ratio that a unit usually has; it counts as long as the packets say less.
    is_told : bool
        Whether the host tells when its clock is adjusted, so that the ratio is that of two
        crystals.

    Attributes
    ----------
    line : Line
    is_slewing_told : bool
        Whether the slewing of the host's clock is taken off the arrivals; else it is inferred.
    moves : int
        How often the line was laid elsewhere at once, instead of following the blocks.
    spread_ns : float
        How well the least delay repeats [ns host].
    uncertainty_ns : float
        By how much the line may be off [ns host], the constant part of the path delay aside.

    Notes
    -----
    A long window averages better, a short one follows a drifting rate better: a drift of a per
    second makes an error of a T^2 / 8 over a window T. The window is 3 s while the network is
    quiet (the median block minimum lies less than 20 us above the line) and grows with the square
    root of that excess up to a minute, one block at a time: its beginning stays where it is
    while a load lasts.

    While the ratio is not known, as under a load that lasts since the start, all blocks count, and
    the line may be off by as much as the least delay varies. From batches that are late by 10 ms
    and more the ratio follows to a percent in the first two seconds, and a line with such an error
    leads far away from the blocks that it lies on. The guess is weighed against it by the variance
    of either, unless the packets contradict it. The first quiet blocks begin a new line.
    """

    __slots__ = ("_blocks", "_evidence", "_fitted_u", "_guess", "_hi", "_latest", "_lo", "_reach",
                 "is_slewing_told", "is_told", "line", "moves", "spread_ns",
                 "uncertainty_ns")  # fmt: skip

    def __init__(
        self, line: Line, packets: list[tuple[int, int]], *, guess: float, is_told: bool
    ) -> None:
        self.line = line
        self._guess = guess
        self.is_told = is_told
        self.is_slewing_told = False
        self._blocks: deque[tuple[int, int]] = deque(maxlen=_LONG_BLOCKS)
        self._latest: deque[tuple[int, int]] = deque(maxlen=_VOTERS)
        self.moves = 0
        self._reach = SHORT_BLOCKS
        self._fitted_u = packets[-1][0]
        u0, h0 = packets[0]
        points = [(float(u - u0), (h - h0) - line.ratio * (u - u0)) for u, h in packets]
        self._lo, self._hi = _RATIOS
        self._evidence = math.inf
        error = self._learn(points, _heights(points, float(line.host - h0), 0.0))
        self.spread_ns = error
        self.uncertainty_ns = error if self.is_known else self._weigh_guess(packets, error)
        self._restart(packets)

    def begins_anew(self, low: tuple[int, int]) -> bool:
        """Begin a new line if the latest blocks say far more than those so far.

        A known ratio they have to contradict as well.

        Parameters
        ----------
        low : (int, int)
            The least delayed packet of the block that just ended.

        Returns
        -------
        bool
            Whether it did; the block has been used then.
        """
        self._latest.append(low)
        if len(self._latest) < _VOTERS or self._evidence < _BETTER * _RESOLUTION_NS:
            return False  # too few, or no blocks can say so much more
        recent = sorted(self._latest)
        ratio = self.line.ratio
        line = supporting_line(recent, ratio)
        if line is None or abs(line.ratio - ratio) > _WRONG * ratio:
            return False
        u0, h0 = recent[0]
        points = [(float(u - u0), (h - h0) - line.ratio * (u - u0)) for u, h in recent]
        error = self._error(points, _heights(points, float(line.host - h0), 0.0))
        width = self._width(points, error)
        is_far_better = not self.is_known and _FAR_BETTER * error < self._evidence
        if width > _TIGHT and not is_far_better:
            return False
        if self.is_known and abs(line.ratio - ratio) < width * ratio:
            return False
        if _BETTER * error > self._evidence:
            return False
        self._begin(line, recent, points)
        return True

    def close(self, low: tuple[int, int], now: int) -> None:
        """Add the least delayed packet of a block that ends at ``now``, and fit."""
        blocks = self._blocks
        blocks.append(low)
        oldest = now - _FORGET * BLOCK_NS / self.line.ratio
        while blocks[0][0] < oldest and len(blocks) > 1:
            blocks.popleft()
        self._age(now)
        recent = sorted(list(blocks)[-self._reach :])
        off = low[1] - self.line.at(low[0])
        self._fit(recent)
        if self.is_known and (off > _TREND_NS or not self._lo < self.line.ratio < self._hi):
            self._follow_adjustment()
        wanted = SHORT_BLOCKS * (max(self.line.excess, 0.0) / _QUIET_NS) ** 0.5
        if self._reach < min(wanted, _LONG_BLOCKS):
            self._reach += 1
        elif self._reach > max(wanted, SHORT_BLOCKS):
            self._reach -= 1

    def _follow_adjustment(self) -> None:
        """Follow the host's clock where its rate is being adjusted.

        Load cannot be told from that by any single packet, but it makes the least delay vary, and
        it sets in with a jump: only blocks on a straight line that began at the present one count.
        Where slewing is told, all that is left is what two crystals can differ by.
        """
        most = _KNOWN if self.is_slewing_told else _UNTOLD_WIDTH
        guess = self.line.ratio
        blocks = list(self._blocks)[-_TRENDS[-1] :]
        u0, h0 = blocks[0]
        above = [(h - h0 - guess * (u - u0), u - u0) for u, h in blocks]
        for count in _TRENDS:
            if len(blocks) < count:
                return
            if _is_within(above[-count:], self._lo - guess, self._hi - guess):
                continue  # nothing to follow
            recent = sorted(blocks[-count:])
            line = supporting_line(recent, guess)
            if line is None or abs(line.ratio - guess) > most * line.ratio:
                continue
            u0, h0 = recent[0]
            points = [(float(u - u0), (h - h0) - line.ratio * (u - u0)) for u, h in recent]
            error = self._error(points, _heights(points, float(line.host - h0), 0.0))
            width = self._width(points, error) * line.ratio
            grown = abs(line.ratio - self.line.ratio) * (recent[-1][0] - u0)
            if abs(line.at(u0) - self.line.at(u0)) > grown:
                continue
            width *= _STRAIGHT
            if line.ratio - width > self._hi or line.ratio + width < self._lo:
                self._begin(line, recent, points)
                return

    def _begin(
        self, line: Line, recent: list[tuple[int, int]], points: list[tuple[float, float]]
    ) -> None:
        """Take a line through the latest blocks for the one so far."""
        self._blocks.clear()
        self._blocks.extend(recent)
        self._reach = SHORT_BLOCKS
        self.moves += 1
        self.line = line
        self._lo, self._hi = _RATIOS
        self._learn(points, _heights(points, float(line.host - recent[0][1]), 0.0))

    def move(self, lows: list[tuple[int, int]], *, widen: bool = True) -> None:
        """Forget all packets but these and lay the line, its ratio unchanged, below them.

        Unless something else explains the move, the bounds of the ratio ``widen`` by what it says
        about the line so far.
        """
        span = max((lows[-1][0] - self._blocks[0][0]) * self.line.ratio, float(BLOCK_NS))
        self._blocks.clear()
        self._blocks.extend(lows)
        self._reach = SHORT_BLOCKS
        self.moves += 1
        before = self.line
        self._shift(sorted(lows))
        off = abs(self.line.host - before.host) if widen else 0
        self._lo -= before.ratio * off / span
        self._hi += before.ratio * off / span

    def extend(self, lows: list[tuple[int, int]]) -> None:
        """Add blocks that were held back; the next fit uses them."""
        self._blocks.extend(lows)

    def host_stepped(self, by_ns: int) -> None:
        """Move everything to another host time."""
        self._latest.clear()
        self.line = self.line._replace(host=self.line.host + by_ns)
        self._blocks = deque(((u, host + by_ns) for u, host in self._blocks), maxlen=_LONG_BLOCKS)

    def _fit(self, recent: list[tuple[int, int]]) -> None:
        """Lay the line below the blocks along the edge that the best of them select."""
        guess = self.line.ratio
        u0, h0 = recent[0]
        points = [(float(u - u0), (h - h0) - guess * (u - u0)) for u, h in recent]
        base = min([y for _, y in points])
        bounds = self._bounds(points, base, points[-1][0])
        least = sorted(bounds)
        level = least[min(_VOTERS, len(least)) - 1]
        used = points
        if self.is_known:
            cut = _LEVEL * level + _RESOLUTION_NS
            used = [point for point, bound in zip(points, bounds, strict=True) if bound <= cut]
        slope = 0.0
        span = (used[-1][0] - used[0][0]) * guess
        edge = None
        if span >= _MIN_SPAN_NS:
            edge = _edge(points, sum([x for x, _ in used]) / len(used))
        if edge is not None:
            slope = min(max(edge[1], self._lo - guess), self._hi - guess)
            base = min([y - slope * x for x, y in points])
        heights = _heights(points, base, slope)
        excess = sorted(heights)[len(heights) // 2]
        self.line = Line(u0, h0 + round(base), guess + slope, excess)
        learn = self._learn if span >= _MIN_SPAN_NS else self._error
        error = learn(points, heights)
        self.spread_ns = level if self.is_known else error
        self.uncertainty_ns = level if self.is_known else self._weigh_guess(recent, error)

    def _weigh_guess(self, packets: list[tuple[int, int]], error: float) -> float:
        """Turn the line towards the guess as far as packets leave room; return its uncertainty.

        Parameters
        ----------
        packets : list of (int, int)
            Those that the line was fitted to, ascending in device time.
        error : float
            How well their minimum repeats [ns host].

        Returns
        -------
        float
            What the line may be off by at its ends [ns host], the guess not being believed.
        """
        line, guess = self.line, self._guess
        u0, h0 = packets[0]
        span = (packets[-1][0] - u0) * line.ratio
        best, guessed = (_above_lowest(packets, ratio) for ratio in (line.ratio, guess))
        if span > 0.0 and sum(guessed) < _CONTRADICTED * sum(best):
            variance = (error / span) ** 2
            share = variance / (variance + _GUESS**2)
            ratio = line.ratio + share * (guess - line.ratio)
            lowest = min((h - h0) - ratio * (u - u0) for u, h in packets)
            heights = _above_lowest(packets, ratio)
            self.line = Line(u0, h0 + round(lowest), ratio, sorted(heights)[len(heights) // 2])
            points = [(float(u - u0), y) for (u, _), y in zip(packets, heights, strict=True)]
            error = max(error, self._error(points, heights))
        return (1.0 + 0.5 * _SAFETY) * error

    def _bounds(self, points: list[tuple[float, float]], base: float, end: float) -> list[float]:
        """Return the error bound of every block: height plus dispersion."""
        ratio = self.line.ratio
        spread = max(self._hi - ratio, ratio - self._lo) if self.is_known else 0.0
        bend = 0.5 * _DRIFT_PER_S * ratio * ratio * 1e-9
        return [y - base + (spread + bend * (end - x)) * (end - x) for x, y in points]

    def _error(self, points: list[tuple[float, float]], heights: list[float]) -> float:
        """Return how well the minimum of the heights of points repeats [ns host].

        The least height of each quarter of the time says so. Where heights vary much and quarters
        have few points, that may be chance.
        """
        end = points[-1][0]
        cuts = [
            0,
            *(
                bisect_left(points, part * end / _PARTS, key=_DEVICE_TIME)
                for part in range(1, _PARTS)
            ),
        ]
        least = [min(heights[a:b]) for a, b in pairwise([*cuts, len(points)]) if a < b]
        chance = sorted(heights)[len(heights) // 2] * _PARTS / len(heights)
        return max(*least, 0.0) + chance + _RESOLUTION_NS

    def _width(self, points: list[tuple[float, float]], error: float) -> float:
        """Return to which share a ratio is known from points whose minimum repeats so well."""
        span = points[-1][0] * self.line.ratio
        return _SAFETY * error / span if span > 0.0 else 1.0

    def _learn(self, points: list[tuple[float, float]], heights: list[float]) -> float:
        """Narrow the bounds of the ratio if a fit says enough; return the error of its minimum."""
        error = self._error(points, heights)
        self._evidence = min(error, self._evidence) if self.is_known else error
        width = self._width(points, error)
        if width <= _KNOWN:
            width = max(width, _LEAST_WIDTH if self.is_told else _UNTOLD_WIDTH)
            ratio = self.line.ratio
            self._lo = max(self._lo, ratio * (1.0 - width))
            self._hi = min(self._hi, ratio * (1.0 + width))
        return error

    @property
    def is_known(self) -> bool:
        """Whether the ratio is known so well that the bounds count."""
        return self._hi - self._lo <= 4.0 * _KNOWN * self.line.ratio

    def _age(self, now: int) -> None:
        """Widen the bounds of the ratio by what crystals may have drifted."""
        ratio = self.line.ratio
        drift = _DRIFT_PER_S * ratio * max(now - self._fitted_u, 0) * ratio * 1e-9
        self._fitted_u = now
        self._lo -= drift
        self._hi += drift

    def _shift(self, packets: list[tuple[int, int]]) -> None:
        line = self.line
        lowest = min(host - line.at(u) for u, host in packets)
        self.line = line._replace(host=line.host + lowest)

    def _restart(self, packets: list[tuple[int, int]]) -> None:
        line = self.line
        length = BLOCK_NS / line.ratio
        end = packets[0][0] + length
        low: tuple[int, int] | None = None
        least = 0
        for u, host in packets:
            if u >= end and low is not None:
                self._blocks.append(low)
                low = None
                end = u + length
            height = host - line.at(u)
            if low is None or height < least:
                low, least = (u, host), height
        if low is not None:
            self._blocks.append(low)
