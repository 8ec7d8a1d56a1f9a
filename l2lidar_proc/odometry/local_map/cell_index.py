"""Hash table from the keys of map cells to their rows, for arrays of keys at once."""

from __future__ import annotations

from typing import Final

import numpy as np

from l2lidar_node.types import I64

_ODD: Final = np.uint64(0x9E3779B97F4A7C15)  # 2^64 divided by the golden ratio (Knuth, 6.4)
_LEAST_BITS: Final = 10
# In place of a key and its row: the slot still passes on what was stored behind it.
_GONE: Final = -1, np.iinfo(np.int64).max


class CellIndex:
    """Rows by key, for arrays of keys.

    The slot of a key follows from the high bits of its product with a constant (Fibonacci
    hashing); a slot that is taken passes it on to the next one (linear probing). At most half of
    the slots are in use, so most keys are found at once. A binary search of as many random keys
    takes four to five times as long.
    """

    def __init__(self) -> None:
        self._known = 0
        self._used = 0  # slots, those of removed keys included
        self._make_slots(_LEAST_BITS)
        self._last_call: tuple[I64, I64] | None = None  # keys and rows of find_again

    def __len__(self) -> int:
        """Return the number of keys."""
        return self._known

    def clear(self) -> None:
        """Forget all keys; the slots stay for the next ones."""
        self._known = self._used = 0
        self._rows[:] = 0
        self._last_call = None

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

    def find_again(self, keys: I64) -> I64:
        """Return what :meth:`find` does, sooner where most keys are those of the last call.

        The steps of an alignment ask for the same points, which hardly move from step to step.

        Parameters
        ----------
        keys : ndarray, shape (N,)
            The caller must not change them later.
        """
        if self._last_call is None or self._last_call[0].shape != keys.shape:
            rows = self.find(keys)
        else:
            before, rows = self._last_call
            others = np.flatnonzero(keys != before)
            rows = rows.copy()
            rows[others] = self.find(keys[others])
        self._last_call = keys, rows
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
        self._last_call = None
        self._known += len(keys)
        self._used += len(keys)
        if 2 * self._used > len(self._rows):
            taken = (self._rows > 0) & (self._keys != _GONE[0])
            keys = np.concatenate((self._keys[taken], keys))
            rows = np.concatenate((self._rows[taken], rows))
            # a third at most: room for as many as half of these before the next time
            self._make_slots((3 * self._known).bit_length())
            self._used = self._known
        slots = self._first_slots(keys)
        while len(keys):
            free = self._rows[slots] == 0
            self._keys[slots[free]], self._rows[slots[free]] = keys[free], rows[free]
            lost = self._rows[slots] != rows  # taken before, or by another of these keys
            keys, rows = keys[lost], rows[lost]
            slots = (slots[lost] + 1) & self._last

    def remove(self, keys: I64) -> None:
        """Forget keys.

        Parameters
        ----------
        keys : ndarray, shape (N,)
            All known, all different.
        """
        self._last_call = None
        self._known -= len(keys)
        slots = self._slots_of(keys)
        self._keys[slots], self._rows[slots] = _GONE

    def move(self, keys: I64, rows: I64) -> None:
        """Give keys other rows.

        Parameters
        ----------
        keys : ndarray, shape (N,)
            All known.
        rows : ndarray, shape (N,)
            From 1 on.
        """
        self._last_call = None
        self._rows[self._slots_of(keys)] = rows

    def _slots_of(self, keys: I64) -> I64:
        """Return the slots of keys that are known."""
        slots = self._first_slots(keys)
        left = np.flatnonzero(self._keys[slots] != keys)
        while len(left):
            slots[left] = (slots[left] + 1) & self._last
            left = left[self._keys[slots[left]] != keys[left]]
        return slots

    def _make_slots(self, bits: int) -> None:
        # side by side: what a lookup needs of a slot comes into the cache at once
        slots = np.zeros((1 << bits, 2), np.int64)
        self._keys: I64 = slots[:, 0]
        self._rows: I64 = slots[:, 1]
        self._last = (1 << bits) - 1
        self._shift = np.uint64(64 - bits)

    def _first_slots(self, keys: I64) -> I64:
        return ((keys.view(np.uint64) * _ODD) >> self._shift).view(np.int64)
