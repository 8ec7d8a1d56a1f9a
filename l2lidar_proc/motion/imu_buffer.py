"""IMU buffer: recent samples in time order, and the sequencer of sweeps.

:class:`Sequencer` holds sweeps until samples cover their end, or their time is up.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records
from l2lidar_node.types import IMU_SAMPLE, HostNs, Sweep
from l2lidar_proc import tuning

Samples = NDArray[np.void]
"""Array of dtype IMU_SAMPLE, shape (N,)."""

_MOST: Final = 20  # sweeps that wait at once; beyond that the oldest goes as it is
_JUMP_NS: Final = 1_000_000_000


def earlier(samples: Samples, by_ms: float) -> Samples:
    """Return samples with stamps that were late by so much [ms] put right."""
    if not by_ms:
        return samples
    moved = samples.copy()
    moved["stamp"] -= round(by_ms * 1e6)
    return moved


def replay(sweeps: Iterable[Sweep], samples: Samples) -> Iterator[tuple[Sweep, Samples]]:
    """Yield the sweeps of a recording, each with the samples that it needs and none had yet.

    Parameters
    ----------
    sweeps : iterable of Sweep
        In order.
    samples : ndarray, shape (N,), dtype IMU_SAMPLE
        Of the whole recording, in order.

    Yields
    ------
    sweep : Sweep
    samples : ndarray, shape (M,), dtype IMU_SAMPLE
        Up to the first one that is not before the sweep's end; a view.
    """
    first = 0
    for sweep in sweeps:
        last = int(np.searchsorted(samples["stamp"], sweep.end)) + 1
        yield sweep, samples[first:last]
        first = last


@dataclass(frozen=True, slots=True)
class ImuCounts:
    """Counts of samples since the buffer was created.

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
        """Counts of samples so far."""
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
        """Return a copy of the samples of a span with a neighbor on either side, shape (M,)."""
        stamps = self.samples["stamp"]
        first = max(int(np.searchsorted(stamps, start, side="right")) - 1, 0)
        last = int(np.searchsorted(stamps, end, side="left")) + 1
        return records.copied(self.samples[first:last])

    def turn(self, rotation: NDArray[np.float64]) -> None:
        """Turn rates and forces of all samples by a rotation matrix (3, 3)."""
        kept = self.samples
        for name in ("angular_velocity", "linear_acceleration"):
            kept[name] = kept[name] @ rotation.T

    def scale(self, rates: float, forces: float) -> None:
        """Multiply the angular velocities and the forces of all samples by a factor each."""
        self.samples["angular_velocity"] *= rates
        self.samples["linear_acceleration"] *= forces

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
            return self._confirm_jump(sample, newest)
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

    def _confirm_jump(self, sample: Samples, newest: int) -> bool:
        """Start afresh with the second sample of another time, else wait for it.

        Return whether the buffer has started afresh.
        """
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


class Reason(Enum):
    """Why a sweep was released."""

    COVERED = "IMU samples cover it"
    WAITED = "it waited long enough"
    CROWDED = "too many sweeps wait"
    CLOCK_JUMP = "the clock jumped"


@dataclass(frozen=True, slots=True)
class Release:
    """A released sweep.

    Attributes
    ----------
    sweep : Sweep
    reason : Reason
    waited_ns : int
        How long it was held.
    """

    sweep: Sweep
    reason: Reason
    waited_ns: int


class Sequencer:
    """Holds sweeps until IMU samples cover them; first in, first out.

    Parameters
    ----------
    wait_ns : int
        Longest time a sweep is held.
    """

    def __init__(self, wait_ns: int) -> None:
        self.wait_ns = wait_ns
        self._waiting: deque[tuple[Sweep, int]] = deque()
        self._jumped: list[tuple[Sweep, int]] = []
        self._last_start: HostNs | None = None

    def __len__(self) -> int:
        """Return how many sweeps wait."""
        return len(self._waiting) + len(self._jumped)

    @property
    def due_ns(self) -> int | None:
        """When the first sweep's time is up, None if none waits."""
        return self._waiting[0][1] + self.wait_ns if self._waiting else None

    def push(self, sweep: Sweep, now: int) -> bool:
        """Take a sweep that arrives at ``now`` [ns]; return whether the clock jumped back with it.

        After a jump those that wait belong to another time and are released as they are.
        """
        jumped = self._last_start is not None and sweep.start < self._last_start - _JUMP_NS
        if jumped:
            self.jump()
        self._last_start = sweep.start
        self._waiting.append((sweep, now))
        return jumped

    def jump(self) -> None:
        """Give up on the sweeps that wait, as after a jump of the IMU's clock."""
        self._jumped.extend(self._waiting)
        self._waiting.clear()

    def release(self, newest_imu: HostNs | None, now: int) -> list[Release]:
        """Return the sweeps that need not wait any more, in order.

        Parameters
        ----------
        newest_imu : HostNs or None
            Stamp of the newest IMU sample.
        now : int
            The same clock as in :meth:`push` [ns].
        """
        released = [Release(s, Reason.CLOCK_JUMP, now - since) for s, since in self._jumped]
        self._jumped.clear()
        while self._waiting:
            sweep, since = self._waiting[0]
            if newest_imu is not None and newest_imu >= sweep.end:
                reason = Reason.COVERED
            elif now - since >= self.wait_ns:
                reason = Reason.WAITED
            elif len(self._waiting) > _MOST:
                reason = Reason.CROWDED
            else:
                break
            self._waiting.popleft()
            released.append(Release(sweep, reason, now - since))
        return released
