"""Device clock model: maps device stamps to one continuous time base for both streams.

The device's clock runs evenly until a time-sync command, of this host or of another, steps it. The
time between two steps is an *epoch*. Each epoch has an offset, its ``base``; stamp minus base is
the place on the *device line*, which has no steps.

Two questions have to be answered for each packet: in which epoch was it stamped, and how large
was the step that began it? The packets themselves answer both. Both streams are so regular that
:mod:`l2lidar_node.clock.cadence` predicts a stamp to microseconds from its sequence number,
however late the packet arrives. The values of the syncs that this host sent tell which of them
took effect. Arrival times decide only where regularity cannot: after long gaps, and for stamps
that nothing else explains.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple

from l2lidar_node.clock.cadence import Cadence
from l2lidar_node.types import DeviceNs, HostNs, Stream

_MS: Final = 1_000_000
_SYNC_ERROR_NS: Final = 50_000  # first stamp after a sync may be this much below its value
_MOST_EARLY_NS: Final = -1 * _MS  # error of the host line: real packets seem no earlier than that
_MOST_LATE_NS: Final = 500 * _MS  # no path delays packets longer
_NUMBERS_HOLD_NS: Final = 150 * _MS  # disagreement with arrivals up to which numbers are believed
# A sync cannot take effect before it is sent. The margin covers the host line's error under load.
_BEFORE_SENT_NS: Final = 20 * _MS
_SHORTEST_STANDBY_NS: Final = 50 * _MS  # [device] the numbers do not count while it lasts
_SYNC_DELAY_NS: Final = 2_000 * _MS  # a sync that has not taken effect by then was lost
# Gains of the loops: the IMU's sampler has a constant period, the mirror's motor has not.
_IMU_GAIN: Final = 0.02
_POINTS_GAIN: Final = 0.5
_SILENCE_NS: Final = 1_000 * _MS
_IMU_OFF_NS: Final = 500 * _MS  # [device] without a sample, until points alone are trusted
_AFTER_BOOT_NS: Final = 600_000 * _MS  # a device that has just started shows less
_AFTER_BOOT_SEQ: Final = 16  # and its sequence numbers are below this
_IN_FLIGHT: Final = 64  # packets, and epochs, that may still arrive late
_SYNCS: Final = 128
_IMU: Final = Stream.IMU  # to look up a member of an Enum takes long


class Step(Enum):
    """A discontinuity that this host did not cause."""

    REBOOT = "reboot"
    FOREIGN_SYNC = "foreign sync"
    LOST = "lost"


@dataclass(slots=True, eq=False)
class _Sync:
    """A time-sync command of this host. Compared by identity: two may have equal values."""

    value: int
    sent: int


_NO_SYNC: Final = _Sync(1 << 80, 0)  # its value is above every stamp


class _Epoch:
    """Time without a step of the device's clock: place on the line = stamp - ``base``."""

    __slots__ = ("base", "sync")

    def __init__(self, base: int, sync: _Sync | None) -> None:
        self.base = base
        self.sync = sync  # that began it; None if it was not one of this host


class Forecast(NamedTuple):
    """What predicts the next packets of points.

    Attributes
    ----------
    cadence : Cadence
        A copy, at the last packet.
    base : int
        Of the epoch [ns device].
    end : int
        Stamp from which on a packet may belong to another epoch [ns device].
    """

    cadence: Cadence
    base: int
    end: int


class _StreamState:
    """The last packet of one stream, and the loop that predicts the next one."""

    __slots__ = ("arrival", "cadence", "epoch", "stamp", "suspect", "u")

    def __init__(self, gain: float) -> None:
        self.cadence = Cadence(gain)
        self.epoch: _Epoch | None = None  # None until the stream is on the line
        self.u = -_IMU_OFF_NS  # place of the last packet on the line
        self.stamp = 0
        self.arrival = 0
        self.suspect: tuple[int, int] | None = None  # number and stamp that nothing explains


class DeviceClockModel:
    """Places stamps on the device line.

    Parameters
    ----------
    ratio : float
        First guess of host nanoseconds per device nanosecond.
    lateness : callable
        Returns arrival minus the instant of a place on the line [ns host], None while that is
        unknown.

    Attributes
    ----------
    ratio : float
        To be kept up to date by the owner.
    steps : deque of (Step, int)
        Discontinuities and their sizes [ns device]; the reader removes them.
    restarts : int
        How often a new line began; places on different lines cannot be compared.
    epochs : int
        Steps of the clock that were bridged.
    is_firm : bool
        Whether the latest place is as accurate as it can be. False for a point packet whose epoch
        the IMU stream, the more regular one, has not reached yet.
    """

    def __init__(
        self, ratio: float, lateness: Callable[[int, int], int | None] = lambda u, arrival: None
    ) -> None:
        self.ratio = ratio
        self.steps: deque[tuple[Step, int]] = deque(maxlen=64)
        self.restarts = 0
        self.epochs = 0
        self.is_firm = True
        self._lateness = lateness
        self._syncs: deque[_Sync] = deque(maxlen=_SYNCS)
        self._epochs: deque[_Epoch] = deque(maxlen=_IN_FLIGHT)
        self._newest_sync = _NO_SYNC  # the latest one that is known to have taken effect
        self._imu = _StreamState(_IMU_GAIN)
        self._points = _StreamState(_POINTS_GAIN)

    def forecast(self) -> Forecast | None:
        """Return what predicts the next packets of points, while both streams are in one epoch.

        None while they are in two, while a step may have begun another one, or while a sync may be
        about to.
        """
        imu, points = self._imu, self._points
        epoch, newest = points.epoch, self._newest_sync
        if epoch is None or (imu.epoch is not None and imu.epoch is not epoch):
            return None
        if imu.suspect is not None or points.suspect is not None:
            return None
        if self._syncs:
            last = self._syncs[-1]
            if last is not newest and points.arrival - last.sent < _SYNC_DELAY_NS:
                return None
        end = _NO_SYNC.value if epoch.sync is newest else newest.value
        return Forecast(copy(points.cadence), epoch.base, end)

    def predicts_imu(self, seq: int, stamp: DeviceNs) -> bool:
        """Tell whether an IMU sample is the predicted next one.

        Its place neither depends on packets of points then, if a forecast holds for them, nor
        affects theirs.
        """
        state, newest = self._imu, self._newest_sync
        epoch = state.epoch
        if epoch is None or (stamp >= newest.value and epoch.sync is not newest):
            return False
        return state.cadence.deviation(seq, stamp - epoch.base - state.u) is not None

    def synced(self, value: HostNs, sent: HostNs) -> None:
        """Record a sync that this host sent; whether it arrives is unknown."""
        self._syncs.append(_Sync(value, sent))

    def host_stepped(self, by_ns: int, at: int) -> None:
        """Convert earlier arrivals to the new time after the host's clock was set.

        A packet may have arrived after the step and before it was noticed; its arrival is in the
        new time already.
        """
        for stream in (self._imu, self._points):
            is_old = stream.arrival + by_ns <= at if by_ns > 0 else stream.arrival > at
            if is_old:
                stream.arrival += by_ns
        for sync in self._syncs:
            sync.sent += by_ns

    def restart(self) -> None:
        """Begin a new line; only the modulus of the sequence numbers is kept."""
        self._epochs.clear()
        self._newest_sync = _NO_SYNC
        for stream in (self._imu, self._points):
            stream.epoch = None
            stream.u = -_IMU_OFF_NS
            stream.suspect = None
            stream.cadence.forget()
        self.restarts += 1

    def place(self, stream: Stream, seq: int, stamp: DeviceNs, arrival: HostNs) -> int | None:
        """Return the place of a stamp on the device line [ns device], None if it has none yet.

        Never raises, whatever the arguments; see :meth:`DeviceClock.observe`.
        """
        state = self._imu if stream is _IMU else self._points
        epoch = state.epoch
        if epoch is None:
            return self._acquire(state, seq, stamp, arrival)
        u = stamp - epoch.base
        newest = self._newest_sync
        may_be_in_newer_epoch = stamp >= newest.value and epoch.sync is not newest
        if not may_be_in_newer_epoch and state.cadence.follows(seq, u - state.u):
            state.u = u
            state.stamp = stamp
            state.arrival = arrival
            self.is_firm = epoch is self._imu.epoch or u - self._imu.u > _IMU_OFF_NS
            return u
        return self._place_unpredicted(state, epoch, seq, stamp, arrival)

    def _place_unpredicted(
        self, state: _StreamState, epoch: _Epoch, seq: int, stamp: int, arrival: int
    ) -> int | None:
        """Place a packet that is not where the cadence predicts it.

        The possible reasons, in the order in which they are tested: the packet is old; a standby;
        a sync of this host; an epoch that another packet has begun; a gap. What is left is a step
        that another host made.
        """
        cadence = state.cadence
        if self._is_old(state, seq, stamp):
            return None
        u = stamp - epoch.base
        gap = cadence.gap(seq, u - state.u)
        advance = cadence.advance(gap)
        expected = state.u + advance
        is_gap_known = gap > 0 and self._arrivals_agree(state, seq, advance, arrival)
        if is_gap_known:
            is_elsewhere = abs(u - expected) > cadence.slip(gap)
            if is_elsewhere and self._was_in_standby(state, epoch, stamp, expected):
                return self._confirm_step(state, epoch, seq, stamp, arrival, None)
            begun = self._epoch_of_sync(state, epoch, stamp, expected, cadence.noise(gap))
            if begun is not None:
                return self._accept(state, begun, seq, stamp, arrival)
            nearest = min(self._epochs, key=lambda item: abs(stamp - item.base - expected))
            off = abs(stamp - nearest.base - expected)
            if off <= cadence.wander(gap) and stamp - nearest.base > state.u:
                return self._accept(state, nearest, seq, stamp, arrival)
        if is_gap_known:
            is_after_gap = u > expected + _SHORTEST_STANDBY_NS
        else:
            is_after_gap = u > state.u and not self._synced_since(state)
        if is_after_gap and self._is_plausible(state, u, arrival):
            return self._accept(state, epoch, seq, stamp, arrival)
        return self._confirm_step(
            state, epoch, seq, stamp, arrival, expected if is_gap_known else None
        )

    def _arrivals_agree(self, state: _StreamState, seq: int, advance: int, arrival: int) -> bool:
        """Return whether arrivals agree with the advance that the sequence numbers give.

        A packet may have been delayed, but not so long that the numbers can have wrapped.
        """
        late = arrival - state.arrival - advance * self.ratio
        if not state.cadence.ascends(seq):
            return abs(late) < _NUMBERS_HOLD_NS
        lap = state.cadence.lap_ns * self.ratio
        return -_SILENCE_NS < late < max(lap - _SILENCE_NS, _SILENCE_NS)

    def _is_old(self, state: _StreamState, seq: int, stamp: int) -> bool:
        """Return whether a packet is a duplicate of the last one, or from before it."""
        back = state.cadence.back(seq)
        if not 0 <= back <= _IN_FLIGHT:
            return False
        place = state.u + state.cadence.advance(-back)
        slip = state.cadence.slip(back)
        return any(abs(stamp - epoch.base - place) <= slip for epoch in self._epochs)

    def _was_in_standby(
        self, state: _StreamState, epoch: _Epoch, stamp: int, expected: int
    ) -> bool:
        """Return whether the stream paused without its numbers showing it, as in standby.

        The predicted place is too early then. If the stamp follows a sync of this host, that sync
        would have taken effect before it was sent.
        """
        base = stamp - expected
        for sync in reversed(self._syncs):
            if sync is epoch.sync:
                break
            if -_SYNC_ERROR_NS <= stamp - sync.value <= expected - state.u + _MS:
                before = self._lateness(sync.value - base, sync.sent)
                return before is not None and before > _BEFORE_SENT_NS
        return False

    def _epoch_of_sync(
        self, state: _StreamState, epoch: _Epoch, stamp: int, expected: int, noise: float
    ) -> _Epoch | None:
        """Return the epoch of the sync of this host that the stamp follows, None without one.

        The stream that arrives first defines the base of a new epoch. The IMU stream, being more
        regular, corrects it when it gets there.
        """
        base = stamp - expected
        step = abs(base - epoch.base)
        for sync in reversed(self._syncs):
            if sync is epoch.sync:
                break
            if not -_SYNC_ERROR_NS <= stamp - sync.value <= expected - state.u + _MS:
                continue
            begun = next((item for item in self._epochs if item.sync is sync), None)
            if begun is None:
                if step <= noise:
                    continue
                begun = _Epoch(base, sync)
                self.epochs += 1
                self._newest_sync = sync
                self._epochs.append(begun)
            elif not self._is_after_step(state, epoch, begun, stamp, base, noise):
                continue
            elif state is self._imu:
                if self._points.epoch is begun:
                    self._points.u += begun.base - base
                begun.base = base
            return begun
        return None

    def _is_after_step(
        self,
        state: _StreamState,
        epoch: _Epoch,
        begun: _Epoch,
        stamp: int,
        base: int,
        noise: float,
    ) -> bool:
        """Return whether a stamp above the value of a sync comes from after the step.

        It need not: a clock that is ahead of the host's passes the value before the sync steps it
        back. The epoch in which the stamp is nearer to its prediction is the right one. If the
        step is too small for that, the device line decides, on which the IMU stream has placed it.
        """
        is_nearer = abs(base - begun.base) <= abs(base - epoch.base)
        if state is self._imu or begun.sync is None or abs(begun.base - epoch.base) > 2.0 * noise:
            return is_nearer
        if stamp - epoch.base >= begun.sync.value - begun.base:
            return True
        return begun.base < epoch.base and is_nearer

    def _synced_since(self, state: _StreamState) -> bool:
        """Return whether a sync of this host may have stepped the clock since the last packet."""
        return any(sync.sent > state.arrival - _MOST_LATE_NS for sync in self._syncs)

    def _accept(
        self, state: _StreamState, epoch: _Epoch, seq: int, stamp: int, arrival: int
    ) -> int:
        """Continue the stream from a packet in an epoch; return its place."""
        state.cadence.resume(seq, stamp - epoch.base - state.u)
        return self._enter(state, epoch, stamp, arrival)

    def _enter(self, state: _StreamState, epoch: _Epoch, stamp: int, arrival: int) -> int:
        state.epoch = epoch
        state.u = u = stamp - epoch.base
        state.stamp = stamp
        state.arrival = arrival
        state.suspect = None
        self.is_firm = epoch is self._imu.epoch or u - self._imu.u > _IMU_OFF_NS
        return u

    def _confirm_step(
        self,
        state: _StreamState,
        epoch: _Epoch,
        seq: int,
        stamp: int,
        arrival: int,
        expected: int | None,
    ) -> int | None:
        """Wait for a second packet that confirms an unexplained one; then bridge or restart.

        ``expected`` is the predicted place on the line, None where the numbers do not give one.
        """
        suspect, state.suspect = state.suspect, (seq, stamp)
        if suspect is None or not state.cadence.regular(seq - suspect[0], stamp - suspect[1]):
            return None
        numbers_began = expected is None and seq < _AFTER_BOOT_SEQ
        numbers_began = numbers_began and not state.cadence.ascends(seq)
        if numbers_began or (stamp < state.stamp and stamp < _AFTER_BOOT_NS):
            self.steps.append((Step.REBOOT, stamp - state.stamp))
        elif expected is not None and self._is_prompt(state, expected, arrival):
            self.steps.append((Step.FOREIGN_SYNC, stamp - epoch.base - expected))
            self.epochs += 1
            self._epochs.append(_Epoch(stamp - expected, None))
            return self._accept(state, self._epochs[-1], seq, stamp, arrival)
        else:
            self.steps.append((Step.LOST, stamp - state.stamp))
        self.restart()
        return None

    def _is_prompt(self, state: _StreamState, place: int, arrival: int) -> bool:
        """Return whether a packet came soon after its predicted place.

        If it is late, the stream may have paused instead, and the prediction says nothing.
        """
        late = self._lateness(place, arrival)
        if late is None:
            late = round(arrival - state.arrival - (place - state.u) * self.ratio)
        return late < _NUMBERS_HOLD_NS

    def _acquire(self, state: _StreamState, seq: int, stamp: int, arrival: int) -> int | None:
        """Put a new stream on the line as soon as its cadence is known."""
        if not state.cadence.learn(seq, stamp):
            return None
        other = self._points if state is self._imu else self._imu
        if other.epoch is None:
            self._epochs.append(_Epoch(0, None))
            return self._enter(state, self._epochs[-1], stamp, arrival)
        epoch = self._least_late_epoch(other, stamp, arrival)
        if epoch is not None:
            return self._enter(state, epoch, stamp, arrival)
        if arrival - other.arrival > _SILENCE_NS:
            self.steps.append((Step.LOST, stamp - other.stamp))
            self.restart()
        return None

    def _least_late_epoch(self, other: _StreamState, stamp: int, arrival: int) -> _Epoch | None:
        """Return the epoch in which a stamp is least late, given where the other stream is.

        None if it is early, or later than any path could make it, in all of them.
        """
        best: _Epoch | None = None
        least = _MOST_LATE_NS
        end: int | None = None  # of the epoch, on the line: where the next one begins
        for epoch in reversed(self._epochs):
            u = stamp - epoch.base
            begin = None if epoch.sync is None else epoch.sync.value - epoch.base
            is_inside = (begin is None or u >= begin - _SYNC_ERROR_NS) and (
                end is None or u <= end
            )
            end = begin
            if not is_inside:
                continue
            late = self._lateness(u, arrival)
            if late is None:
                late = abs(round(arrival - other.arrival - (u - other.u) * self.ratio))
            if _MOST_EARLY_NS <= late < least:
                best, least = epoch, late
        return best

    def _is_plausible(self, state: _StreamState, u: int, arrival: int) -> bool:
        """Return whether a packet measured at a place can have arrived when it did."""
        late = self._lateness(u, arrival)
        if late is None:
            elapsed = arrival - state.arrival
            return abs((u - state.u) * self.ratio - elapsed) < _NUMBERS_HOLD_NS
        return _MOST_EARLY_NS <= late <= _MOST_LATE_NS
