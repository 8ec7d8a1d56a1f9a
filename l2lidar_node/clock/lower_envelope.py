"""Fits the line from device time to host time that no packet can have arrived before.

A packet arrives when it was measured plus a delay that is never below the constant part of the
path. So in the plane of device time and arrival all packets lie on or above the wanted line, many
close to it, some far above: a lower envelope. Of all lines with no packet below,
:func:`supporting_line` returns the one with the least sum of distances to the packets. It is the
edge of the lower convex hull that spans their mean device time (Moon, Skelly and Towsley,
"Estimation and removal of clock skew from network delay measurements", INFOCOM 1999, who solve the
same linear programme).

Why not a Kalman filter (filterpy): it averages, so for one-sided delays its answer moves with
their mean, by milliseconds when the network gets busy, and gets better with the square root of the
number of packets; the envelope moves with their minimum, and gets better with their number. No
noise level has to be known, and slope and offset come out together. Its one weakness, a curved
line (drifting rate), is met by the length of the window, see :class:`LowerEnvelope`.
"""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

_BLOCK_S: Final = 0.1
SHORT_BLOCKS: Final = 30
LONG_BLOCKS: Final = 160
_QUIET_NS: Final = 20_000.0  # excess of the block minima at which the short window starts to grow
_MIN_SPAN_NS: Final = 1_400_000_000  # [ns host] shorter data say nothing about the ratio
_RATIOS: Final = (0.45, 3.3)
_FORGET: Final = (
    2 * LONG_BLOCKS
)  # [blocks] a packet this old is no longer used, however few there are

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
        Median height [ns host] of the packets that were fitted above the line.
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
    hull: list[tuple[float, float]] = []
    for x, y in points:
        while len(hull) > 1:
            (ax, ay), (bx, by) = hull[-2], hull[-1]
            if (bx - ax) * (y - ay) > (by - ay) * (x - ax):
                break
            hull.pop()
        if hull and hull[-1][0] == x:
            if y >= hull[-1][1]:
                continue
            hull.pop()
        hull.append((x, y))
    if len(hull) < 2:
        return None
    mean = sum(x for x, _ in points) / len(points)
    right = next(i for i, (x, _) in enumerate(hull) if i and (x >= mean or i == len(hull) - 1))
    (ax, ay), (bx, by) = hull[right - 1], hull[right]
    slope = (by - ay) / (bx - ax)
    heights = sorted(y - ay - slope * (x - ax) for x, y in points)
    ratio = guess + slope
    return Line(u0, h0 + round(ay - slope * ax), ratio, heights[len(heights) // 2])


class LowerEnvelope:
    """Keeps the least delayed packet of every block and fits the line through the latest of them.

    Parameters
    ----------
    line : Line
        The first fit, from all packets since the start.
    packets : list of (int, int)
        Those packets: device time and arrival [ns], ascending in device time.

    Notes
    -----
    A long window averages better, a short one follows a drifting rate better: a drift of a per
    second makes an error of a T^2 / 8 over a window T. The window is 3 s while the network is
    quiet (the median block minimum lies less than 20 us above the line) and grows with the square
    root of that excess up to 16 s, one block at a time so the line never jumps because of it.
    """

    __slots__ = ("_blocks", "_low", "_low_at", "_reach", "_start", "line")

    def __init__(self, line: Line, packets: list[tuple[int, int]]) -> None:
        self.line = line
        self._blocks: deque[tuple[int, int]] = deque(maxlen=LONG_BLOCKS)
        self._reach = SHORT_BLOCKS
        self._restart(packets)

    def close(self, low: tuple[int, int], now: int) -> None:
        """Add the least delayed packet of a block that ends at ``now``, and fit."""
        blocks = self._blocks
        blocks.append(low)
        oldest = now - _FORGET * BLOCK_NS / self.line.ratio
        while blocks[0][0] < oldest and len(blocks) > 1:
            blocks.popleft()
        recent = sorted(list(blocks)[-self._reach :])
        ratio = self.line.ratio
        if (recent[-1][0] - recent[0][0]) * ratio < _MIN_SPAN_NS:
            self._shift(recent)
            return
        line = supporting_line(recent, ratio)
        if line is None or not is_credible(line.ratio):
            return
        self.line = line
        wanted = SHORT_BLOCKS * (max(line.excess, 0.0) / _QUIET_NS) ** 0.5
        if self._reach < min(wanted, LONG_BLOCKS):
            self._reach += 1
        elif self._reach > max(wanted, SHORT_BLOCKS):
            self._reach -= 1

    def move(self, lows: list[tuple[int, int]]) -> None:
        """Forget all packets but these and lay the line, its ratio unchanged, below them."""
        self._blocks.clear()
        self._blocks.extend(lows)
        self._reach = SHORT_BLOCKS
        self._shift(lows)

    def host_stepped(self, by_ns: int) -> None:
        """Move everything to another host time."""
        self.line = self.line._replace(host=self.line.host + by_ns)
        self._blocks = deque(((u, host + by_ns) for u, host in self._blocks), maxlen=LONG_BLOCKS)

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
