"""Load on the way from the device to the host: batching, jitter, queues, stalls.

A :class:`Load` lasts from one second to another and delays packets; a :class:`LoadedPath` applies
the loads of a run, packet by packet, in simulated time. Nothing here knows the estimator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

_MS: Final = 1_000_000
_S: Final = 1_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """A stretch of time during which packets are delayed.

    Attributes
    ----------
    start, stop : float
        When it begins and ends [s], by when a packet would have arrived without it.
    batch_ms : float
        Packets are held back until the next multiple of this; 0 for no batching.
    least_ms : float
        Delay of every packet.
    jitter_ms : float
        Random delay, uniform from 0: one for each batch, or for each packet without batching.
    mean_ms : float
        Random delay, exponential with this mean, likewise.
    per_packet : bool
        Whether the packets of a batch are delayed each by itself.
    rising : float
        Share of the load over which these grow linearly from 0; 0 begins at full strength.
    stall_every_s, stall_ms : float
        Mean time between stalls, exponential, and the mean length of one, likewise.
    on_s, off_s : float
        The load comes and goes: so long it acts, so long it does not; 0 acts always.
    streams : str
        ``all``, ``imu`` or ``points``.
    """

    start: float
    stop: float
    batch_ms: float = 0.0
    least_ms: float = 0.0
    jitter_ms: float = 0.0
    mean_ms: float = 0.0
    per_packet: bool = False
    rising: float = 0.0
    stall_every_s: float = 0.0
    stall_ms: float = 0.0
    on_s: float = 0.0
    off_s: float = 0.0
    streams: str = "all"


class LoadedPath:
    """Delays packets as the loads of a run say; those of one path keep their order.

    Parameters
    ----------
    loads : sequence of Load
    seed : int
    """

    def __init__(self, loads: Sequence[Load], seed: int) -> None:
        self._rng = np.random.default_rng([seed, 77])
        self._loads = [_Queue(load, self._rng) for load in loads]

    def deliver(self, arrival: int, is_imu: bool) -> int:
        """Return when a packet arrives [ns since the start] that would at ``arrival``.

        Packets are handed in in the order in which they would arrive.
        """
        for queue in self._loads:
            arrival = queue.deliver(arrival, is_imu)
        return arrival


class _Queue:
    """Where packets wait while one load lasts."""

    def __init__(self, load: Load, rng: np.random.Generator) -> None:
        self._load = load
        self._rng = rng
        self._batch = -1
        self._random = 0.0
        self._latest = 0
        self._stall_end = 0
        self._next_stall = round(load.start * _S)
        if load.stall_every_s:
            self._next_stall += round(rng.exponential(load.stall_every_s) * _S)

    def deliver(self, arrival: int, is_imu: bool) -> int:
        load = self._load
        if load.streams != "all" and (load.streams == "imu") != is_imu:
            return arrival
        if self._acts(arrival):
            arrival = self._delayed(arrival)
        self._latest = arrival = max(arrival, self._latest)
        return arrival

    def _acts(self, arrival: int) -> bool:
        load = self._load
        since = arrival / _S - load.start
        if not 0.0 <= since < load.stop - load.start:
            return False
        return not load.on_s or since % (load.on_s + load.off_s) < load.on_s

    def _delayed(self, arrival: int) -> int:
        load = self._load
        share = 1.0
        if load.rising:
            through = (arrival / _S - load.start) / (load.stop - load.start)
            share = min(through / load.rising, 1.0)
        batch = arrival
        if load.batch_ms:
            length = round(load.batch_ms * _MS)
            batch = -(-arrival // length)
            arrival = batch * length
        if batch != self._batch or load.per_packet:
            self._batch = batch
            self._random = self._rng.uniform(0.0, load.jitter_ms)
            self._random += self._rng.exponential(load.mean_ms) if load.mean_ms else 0.0
        arrival += round(share * (load.least_ms + self._random) * _MS)
        return self._stalled(arrival) if load.stall_every_s else arrival

    def _stalled(self, arrival: int) -> int:
        load = self._load
        while arrival >= self._next_stall:
            length = round(self._rng.exponential(load.stall_ms) * _MS)
            self._stall_end = self._next_stall + length
            gap = round(self._rng.exponential(load.stall_every_s) * _S)
            self._next_stall = self._stall_end + gap
        return max(arrival, self._stall_end)


@dataclass(frozen=True, slots=True)
class LoadErrors:
    """How far stamps were off under load and after it, the constant path delay set aside.

    Attributes
    ----------
    least_ms : float
        What the load added to the path's least delay: the largest, over the load, of the least
        delay in half a second. A clock that sees nothing but arrivals cannot know it.
    during_ms : float
        Largest error until the end of the load.
    unsaid_ms : float
        Largest error beyond the stated uncertainty and the least delay of any packet so far, which
        is the constant part of the path as far as anybody can know.
    after_p99_ms, after_max_ms : float
        Errors from one second after the end of the load.
    """

    least_ms: float
    during_ms: float
    unsaid_ms: float
    after_p99_ms: float
    after_max_ms: float


def load_errors(
    notes: NDArray[np.void], loads: Sequence[Load], begin: int, path_ns: int
) -> LoadErrors:
    """Return the errors of a run.

    Parameters
    ----------
    notes : ndarray, shape (N,)
        Every packet, with ``truth``, ``duration``, ``arrival``, ``published`` and ``uncertainty``
        [ns].
    loads : sequence of Load
    begin : int
        Instant that the loads count from [ns].
    path_ns : int
        Delay of a packet without load [ns].
    """
    end = max(load.stop for load in loads)
    at = (notes["arrival"] - begin) / _S
    delays = (notes["arrival"] - notes["truth"] - notes["duration"] - path_ns) / _MS
    halves = (at * 2.0).astype(np.int64)
    least = [float(delays[halves == half].min()) for half in np.unique(halves[at < end]).tolist()]
    stamped = notes["published"] != 0
    errors = np.abs(notes["published"] - notes["truth"] - path_ns) / _MS
    unsaid = errors - notes["uncertainty"] / _MS - np.minimum.accumulate(np.maximum(delays, 0.0))
    after = errors[stamped & (at > end + 1.0)]
    return LoadErrors(
        max(least),
        float(errors[stamped & (at < end)].max(initial=0.0)),
        float(unsaid[stamped].max()),
        float(np.percentile(after, 99)),
        float(after.max()),
    )


def _shape(*loads: Load) -> tuple[Load, ...]:
    return loads


SHAPES: Final[dict[str, tuple[Load, ...]]] = {
    "20 ms batches + jitter, first 3 s": _shape(Load(start=0, stop=3, batch_ms=20, jitter_ms=20)),
    "20 ms batches + jitter, first 30 s": _shape(
        Load(start=0, stop=30, batch_ms=20, jitter_ms=20)
    ),
    "20 ms batches + jitter, mid-run 40 s": _shape(
        Load(start=8, stop=48, batch_ms=20, jitter_ms=20)
    ),
    "20 ms batches, jitter per packet, first 30 s": _shape(
        Load(start=0, stop=30, batch_ms=20, jitter_ms=20, per_packet=True)
    ),
    "20 ms batches, jitter per packet, mid-run 40 s": _shape(
        Load(start=8, stop=48, batch_ms=20, jitter_ms=20, per_packet=True)
    ),
    "20 ms batches, jitter per packet, first 3 s": _shape(
        Load(start=0, stop=3, batch_ms=20, jitter_ms=20, per_packet=True)
    ),
    "20 ms batches, first 10 s": _shape(Load(start=0, stop=10, batch_ms=20)),
    "50 ms batches + jitter, mid-run 20 s": _shape(
        Load(start=8, stop=28, batch_ms=50, jitter_ms=20)
    ),
    "100 ms batches + jitter, first 15 s": _shape(
        Load(start=0, stop=15, batch_ms=100, jitter_ms=30)
    ),
    "jitter 0-20 ms, mid-run 15 s": _shape(Load(start=8, stop=23, jitter_ms=20)),
    "jitter 0-20 ms, first 15 s": _shape(Load(start=0, stop=15, jitter_ms=20)),
    "jitter rising to 40 ms over 20 s": _shape(Load(start=5, stop=25, jitter_ms=40, rising=1.0)),
    "queue filling to 15 ms over 20 s": _shape(
        Load(start=5, stop=25, least_ms=15, mean_ms=0.3, rising=1.0)
    ),
    "queue filling from the start": _shape(
        Load(start=0, stop=12, least_ms=12, mean_ms=0.5, rising=1.0)
    ),
    "detour of 8 ms for 20 s": _shape(Load(start=8, stop=28, least_ms=8, mean_ms=0.1)),
    "detour of 4 ms for 20 s": _shape(Load(start=8, stop=28, least_ms=4, mean_ms=0.1)),
    "detour of 10 ms, first 20 s": _shape(Load(start=0, stop=20, least_ms=10, mean_ms=0.1)),
    "Wi-Fi power save, mid-run 20 s": _shape(Load(start=8, stop=28, batch_ms=102.4, mean_ms=3.0)),
    "Wi-Fi power save, first 20 s": _shape(Load(start=0, stop=20, batch_ms=102.4, mean_ms=3.0)),
    "Wi-Fi contention, bursts of 2 s": _shape(
        Load(start=4, stop=40, least_ms=2, mean_ms=8.0, on_s=2.0, off_s=2.0)
    ),
    "USB adapter, 16 ms latency timer, first 20 s": _shape(
        Load(start=0, stop=20, batch_ms=16, least_ms=1, jitter_ms=2)
    ),
    "USB adapter, 4 ms batches and stalls": _shape(
        Load(start=5, stop=30, batch_ms=4, jitter_ms=1, stall_every_s=0.7, stall_ms=30)
    ),
    "CPU starvation, first 15 s": _shape(
        Load(start=0, stop=15, mean_ms=4, stall_every_s=0.2, stall_ms=80)
    ),
    "CPU starvation, mid-run 20 s": _shape(
        Load(start=8, stop=28, mean_ms=4, stall_every_s=0.2, stall_ms=80)
    ),
    "IMU only, jitter 0-20 ms, mid-run": _shape(
        Load(start=8, stop=28, least_ms=5, jitter_ms=15, streams="imu")
    ),
    "points only, jitter 0-20 ms, first 20 s": _shape(
        Load(start=0, stop=20, least_ms=5, jitter_ms=15, streams="points")
    ),
    "easing off in three steps": _shape(
        Load(start=0, stop=10, batch_ms=20, jitter_ms=20),
        Load(start=10, stop=16, least_ms=4, jitter_ms=6),
        Load(start=16, stop=22, least_ms=1.5, jitter_ms=2),
    ),
}
