"""Counts by how much things happen too late, in bounded memory."""

from __future__ import annotations

from typing import Final

_BIN_NS: Final = 10_000
_BINS: Final = 10_000  # up to 100 ms


class Lateness:
    """Distribution of delays with a resolution of 10 us up to 100 ms, and the exact maximum."""

    def __init__(self) -> None:
        self._counts = [0] * (_BINS + 1)
        self.count = 0
        self.max_ns = 0

    def add(self, late_ns: int) -> None:
        """Count one delay; a negative one counts as none."""
        late_ns = max(late_ns, 0)
        self._counts[min(late_ns // _BIN_NS, _BINS)] += 1
        self.count += 1
        self.max_ns = max(self.max_ns, late_ns)

    def quantile_ns(self, share: float) -> int:
        """Return a delay that at least this share of all did not exceed; 0 without any."""
        seen = 0
        for number, count in enumerate(self._counts):
            seen += count
            if count and seen >= share * self.count:
                return self.max_ns if number == _BINS else min((number + 1) * _BIN_NS, self.max_ns)
        return 0
