"""Hash table from the keys of map cells to their rows, for arrays of keys at once."""

from __future__ import annotations

from typing import Final

import numpy as np

from l2lidar_node.types import I64

_ODD: Final = np.uint64(0x9E3779B97F4A7C15)  # 2^64 divided by the golden ratio (Knuth, 6.4)
_LEAST_BITS: Final = 10


class CellIndex:
    """Rows by key, for arrays of keys.

    The slot of a key follows from the high bits of its product with a constant (Fibonacci
    hashing); a slot that is taken passes it on to the next one (linear probing). At most half of
    the slots are in use, so most keys are found at once. A binary search of as many random keys
    takes four to five times as long.
    """

    def __init__(self) -> None:
        self._used = 0
        self._make_slots(_LEAST_BITS)

    def __len__(self) -> int:
        """Return the number of keys."""
        return self._used

    def clear(self) -> None:
        """Forget all keys; the slots stay for the next ones."""
        self._used = 0
        self._rows[:] = 0

    def find(self, keys: I64) -> I64:
        """Return the row of each key, 0 for those that are not known.

        Parameters
        ----------
        keys : ndarray, shape (N,)
        """
        slots = self._first_slots(keys)
        rows = self._rows[slots]
        # an empty slot ends the search
        left = np.flatnonzero((self._keys[slots] != keys) & (rows > 0))
        slots, keys = slots[left], keys[left]
        while len(left):
            slots = (slots + 1) & self._last
            found = self._rows[slots]
            rows[left] = found
            others = (self._keys[slots] != keys) & (found > 0)
            left, slots, keys = left[others], slots[others], keys[others]
        return rows

    def insert(self, keys: I64, rows: I64) -> None:
        """Add keys that are not known yet.

        Parameters
        ----------
        keys : ndarray, shape (N,)
            All different.
        rows : ndarray, shape (N,)
            From 1 on.
        """
        self._used += len(keys)
        if 2 * self._used > len(self._rows):
            taken = self._rows > 0
            keys = np.concatenate((self._keys[taken], keys))
            rows = np.concatenate((self._rows[taken], rows))
            self._make_slots((2 * self._used).bit_length())
        slots = self._first_slots(keys)
        while len(keys):
            free = self._rows[slots] == 0
            self._keys[slots[free]], self._rows[slots[free]] = keys[free], rows[free]
            lost = self._rows[slots] != rows  # taken before, or by another of these keys
            keys, rows = keys[lost], rows[lost]
            slots = (slots[lost] + 1) & self._last

    def _make_slots(self, bits: int) -> None:
        self._keys: I64 = np.zeros(1 << bits, np.int64)
        self._rows: I64 = np.zeros(1 << bits, np.int64)
        self._last = (1 << bits) - 1
        self._shift = np.uint64(64 - bits)

    def _first_slots(self, keys: I64) -> I64:
        return ((keys.view(np.uint64) * _ODD) >> self._shift).view(np.int64)
