"""IMU buffer: the recent samples in order of time, whatever order and state they arrive in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import IMU_SAMPLE, HostNs
from l2lidar_proc import tuning

Samples = NDArray[np.void]
"""Array of dtype IMU_SAMPLE, shape (N,)."""


def earlier(samples: Samples, by_ms: float) -> Samples:
    """Return samples with stamps that were late by so much [ms] put right."""
    if not by_ms:
        return samples
    moved = samples.copy()
    moved["stamp"] -= round(by_ms * 1e6)
    return moved


@dataclass(frozen=True, slots=True)
class ImuCounts:
    """Counts of what has come into a buffer since it was made.

    Attributes
    ----------
    accepted : int
        Samples kept, those that were put in order included.
    reordered : int
        Samples that came late and were put where they belong.
    duplicate : int
        Samples with a stamp that was already there; refused.
    invalid : int
        Samples with a number that is not finite or that no sensor can measure; refused.
    stale : int
        Samples older than everything that is kept; refused.
    outlier : int
        Samples far from those before and after them; refused.
    jumps : int
        Times the clock went back, or far ahead, and the buffer was emptied.
    """

    accepted: int = 0
    reordered: int = 0
    duplicate: int = 0
    invalid: int = 0
    stale: int = 0
    outlier: int = 0
    jumps: int = 0


class ImuBuffer:
    """Samples of the last seconds in strictly ascending order of time.

    Parameters
    ----------
    length_s : float
        How much is kept behind the newest sample [s].
    jump_s : float
        A sample this much behind the newest one, or ahead of it, means a changed clock if the next
        one confirms it: the buffer starts afresh with both [s].
    """

    def __init__(self, length_s: float = 4.0, jump_s: float = 1.0) -> None:
        self._length_ns = round(length_s * 1e9)
        self._jump_ns = round(jump_s * 1e9)
        self._buffer = np.empty(2048, dtype=IMU_SAMPLE)
        self._head = 0
        self._tail = 0
        self._suspect: Samples | None = None  # a sample of another time, not confirmed yet
        self._tally = dict.fromkeys(ImuCounts.__dataclass_fields__, 0)

    @property
    def counts(self) -> ImuCounts:
        """What came in so far."""
        return ImuCounts(**self._tally)

    @property
    def samples(self) -> Samples:
        """Everything that is kept, shape (N,); a view that the next :meth:`push` may change."""
        return self._buffer[self._head : self._tail]

    @property
    def newest(self) -> HostNs | None:
        """Stamp of the newest sample, None when empty."""
        return HostNs(int(self._buffer["stamp"][self._tail - 1])) if len(self) else None

    def __len__(self) -> int:
        """Return how many samples are kept."""
        return self._tail - self._head

    def clear(self) -> None:
        """Forget all samples; the counts stay."""
        self._head = self._tail = 0
        self._suspect = None

    def between(self, start: HostNs, end: HostNs) -> Samples:
        """Return a copy of the samples of a span with a neighbour on either side, shape (M,)."""
        stamps = self.samples["stamp"]
        first = max(int(np.searchsorted(stamps, start, side="right")) - 1, 0)
        last = int(np.searchsorted(stamps, end, side="left")) + 1
        return self.samples[first:last].copy()

    def turn(self, rotation: NDArray[np.float64]) -> None:
        """Turn rates and forces of all samples by a rotation matrix (3, 3)."""
        kept = self.samples
        for name in ("angular_velocity", "linear_acceleration"):
            kept[name] = kept[name] @ rotation.T

    def push(self, samples: Samples) -> Samples:
        """Take samples in any order.

        Parameters
        ----------
        samples : ndarray, shape (N,), dtype IMU_SAMPLE

        Returns
        -------
        ndarray, shape (M,), dtype IMU_SAMPLE
            Those that continue the buffer in order: what a filter that runs along may use.
        """
        # NaN compares as false
        possible = (np.abs(samples["angular_velocity"]) <= tuning.MAX_RATE).all(axis=1)
        possible &= (np.abs(samples["linear_acceleration"]) <= tuning.MAX_FORCE).all(axis=1)
        if not possible.all():
            self._tally["invalid"] += int((~possible).sum())
            samples = samples[possible]
        if not len(samples):
            return samples
        stamps = samples["stamp"]
        newest = self.newest
        steps = np.diff(stamps, prepend=stamps[0] - 1 if newest is None else newest)
        if (steps > 0).all() and (steps <= self._jump_ns).all():
            self._drop_suspect()
            self._append(samples)
            return samples
        in_order = [self._push_one(samples[i : i + 1]) for i in range(len(samples))]
        return samples[in_order]

    def _push_one(self, sample: Samples) -> bool:
        """Take one sample wherever it belongs; return whether it continues the buffer."""
        stamp = int(sample["stamp"][0])
        newest = self.newest
        if newest is None:
            self._append(sample)
            return True
        if abs(stamp - newest) > self._jump_ns:
            return self._is_jump(sample, newest)
        self._drop_suspect()
        if stamp > newest:
            self._append(sample)
            return True
        place = int(np.searchsorted(self.samples["stamp"], stamp))
        if self.samples["stamp"][place] == stamp:
            self._tally["duplicate"] += 1
        elif place == 0:
            self._tally["stale"] += 1
        else:
            self._append(sample)
            self.samples[place + 1 :] = self.samples[place:-1].copy()
            self.samples[place] = sample[0]
            self._tally["reordered"] += 1
        return False

    def _is_jump(self, sample: Samples, newest: int) -> bool:
        """Start afresh if a sample of another time is not the first; else wait for the next."""
        suspect = self._suspect
        stamp = int(sample["stamp"][0])
        if suspect is not None:
            since = stamp - int(suspect["stamp"][0])
            if 0 < since < abs(stamp - newest):
                self._tally["jumps"] += 1
                self.clear()
                self._append(suspect)
                self._append(sample)
                return True
            self._drop_suspect()
        self._suspect = sample.copy()
        return False

    def _drop_suspect(self) -> None:
        if self._suspect is not None:
            self._tally["outlier"] += 1
            self._suspect = None

    def _append(self, samples: Samples) -> None:
        self._tally["accepted"] += len(samples)
        kept = self.samples
        if self._tail + len(samples) > len(self._buffer):
            oldest = int(samples["stamp"][-1]) - self._length_ns
            kept = kept[np.searchsorted(kept["stamp"], oldest) :]
            size = len(self._buffer)
            while len(kept) + len(samples) > size // 2:
                size *= 2
            fresh = np.empty(size, dtype=IMU_SAMPLE)
            fresh[: len(kept)] = kept
            self._buffer, self._head, self._tail = fresh, 0, len(kept)
        self._buffer[self._tail : self._tail + len(samples)] = samples
        self._tail += len(samples)
        oldest = int(self._buffer["stamp"][self._tail - 1]) - self._length_ns
        self._head += int(np.searchsorted(self.samples["stamp"], oldest))
        self._head = max(self._head, self._tail - tuning.MAX_SAMPLES)
