"""Lays the stamps of both streams, over the steps of the device's clock, onto one even line.

Between two syncs the device's clock runs evenly; a sync, of this host or another, steps it. Each
stretch in between is an *epoch*: a constant that, taken from a stamp, gives the *device line*,
which has no steps. Which epoch a packet was stamped in, and how large the step was, is told by the
packets themselves: both streams are so regular that the stamp of the next packet is known to
microseconds from its sequence number, whatever the network does to arrivals. The values this host
sent tell which sync it was. Arrivals are asked only when regularity cannot answer: after long gaps
and for stamps that nothing explains.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final

from l2lidar_node.clock.cadence import Cadence
from l2lidar_node.types import DeviceNs, HostNs, Stream

_MS: Final = 1_000_000
_SLACK_NS: Final = 50_000  # a sync may take effect that much beside its value
_EARLY_NS: Final = -1 * _MS  # arrivals may seem that early without making a stamp impossible
_LATE_NS: Final = 500 * _MS  # no path delays packets more than that
_REACH_NS: Final = 150 * _MS  # sequence numbers are believed while arrivals agree with them so far
# A sync cannot take effect before it is sent; that much is for the line, under load, and the path.
_BEFORE_NS: Final = 20 * _MS
_PAUSE_NS: Final = 50 * _MS  # [device] no standby, in which numbers do not count, is shorter
_IMU_GAIN: Final = 0.02
_POINTS_GAIN: Final = 0.5
_SILENT_NS: Final = 1_000 * _MS
_STALE_NS: Final = 500 * _MS  # [device]
_BOOT_NS: Final = 600_000 * _MS  # stamps below it can be those of a device that has just started
_BOOT_SEQ: Final = 16  # so can sequence numbers
_KEEP: Final = 64  # packets, and epochs, that may still be on their way
_SYNCS: Final = 128
_IMU: Final = Stream.IMU  # to look up a member of an Enum takes long


class Step(Enum):
    """What this host did not cause: the clock was stepped, or the line had to begin anew."""

    REBOOT = "reboot"
    FOREIGN_SYNC = "foreign sync"
    LOST = "lost"


@dataclass(slots=True, eq=False)
class _Sync:
    """A sync of this host; equal only to itself."""

    value: int
    sent: int


_NO_SYNC: Final = _Sync(1 << 80, 0)  # its value is after every stamp


class _Epoch:
    """A stretch without a step: ``base`` is what a stamp is ahead of the device line."""

    __slots__ = ("base", "sync")

    def __init__(self, base: int, sync: _Sync | None) -> None:
        self.base = base
        self.sync = sync  # of this host, that began it


class _Track:
    """Where one stream is."""

    __slots__ = ("arrival", "cadence", "epoch", "stamp", "suspect", "u")

    def __init__(self, gain: float) -> None:
        self.cadence = Cadence(gain)
        self.epoch: _Epoch | None = None  # None until it has joined the line
        self.u = -_STALE_NS  # place of the last packet
        self.stamp = 0
        self.arrival = 0
        self.suspect: tuple[int, int] | None = None  # number and stamp that nothing explains


class DeviceClockModel:
    """Places stamps on the device line.

    Parameters
    ----------
    ratio : float
        First guess of host nanoseconds per device nanosecond; to be kept up to date in ``ratio``.
    lateness : callable
        Returns arrival minus the instant of a place on the line [ns host], None while that is
        unknown.

    Attributes
    ----------
    ratio : float
    steps : deque of (Step, int)
        What happened and by how much [ns device]; whoever reads it takes it out. A line that began
        anew says so in ``restarts``.
    restarts : int
        How often the line began anew, places before and after having nothing in common.
    epochs : int
        Steps of the clock that were bridged.
    is_firm : bool
        Whether the latest place was told as well as it can be: false for point packets while the
        IMU stream, whose word counts, is in another epoch.
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
        self._epochs: deque[_Epoch] = deque(maxlen=_KEEP)
        self._newest = _NO_SYNC  # the latest that is known to have taken effect
        self._imu = _Track(_IMU_GAIN)
        self._points = _Track(_POINTS_GAIN)

    def synced(self, value: HostNs, sent: HostNs) -> None:
        """Take note of a sync that left this host; whether it arrives is not known."""
        self._syncs.append(_Sync(value, sent))

    def host_stepped(self, by_ns: int, at: int) -> None:
        """Take note that the host's clock was set: what was before is told in its new time."""
        for track in (self._imu, self._points):
            # The last packets may have come after it was set, but before that was noticed.
            if track.arrival + by_ns <= at if by_ns > 0 else track.arrival > at:
                track.arrival += by_ns
        for sync in self._syncs:
            sync.sent += by_ns

    def restart(self) -> None:
        """Forget everything but how sequence numbers wrap."""
        self._epochs.clear()
        self._newest = _NO_SYNC
        for track in (self._imu, self._points):
            track.epoch = None
            track.u = -_STALE_NS
            track.suspect = None
            track.cadence.forget()
        self.restarts += 1

    def place(self, stream: Stream, seq: int, stamp: DeviceNs, arrival: HostNs) -> int | None:
        """Return the place of a stamp on the device line [ns device], None while it is not known.

        Never raises, whatever the arguments; see :meth:`DeviceClock.observe`.
        """
        track = self._imu if stream is _IMU else self._points
        epoch = track.epoch
        if epoch is None:
            return self._join(track, seq, stamp, arrival)
        u = stamp - epoch.base
        newest = self._newest
        behind = stamp >= newest.value and epoch.sync is not newest
        if not behind and track.cadence.follows(seq, u - track.u):
            track.u = u
            track.stamp = stamp
            track.arrival = arrival
            self.is_firm = epoch is self._imu.epoch or u - self._imu.u > _STALE_NS
            return u
        return self._step(track, epoch, seq, stamp, arrival)

    def _step(
        self, track: _Track, epoch: _Epoch, seq: int, stamp: int, arrival: int
    ) -> int | None:
        """Place a stamp that is not where the cadence wants it."""
        cadence = track.cadence
        if self._is_late(track, seq, stamp):
            return None
        u = stamp - epoch.base
        gap = cadence.gap(seq, u - track.u)
        advance = cadence.advance(gap)
        expected = track.u + advance
        counted = gap > 0 and self._agrees(track, seq, advance, arrival)
        if counted:
            slip = cadence.slip(gap)
            is_elsewhere = abs(u - expected) > slip
            if is_elsewhere and self._has_paused(track, epoch, stamp, expected):
                return self._unexplained(track, epoch, seq, stamp, arrival, None)
            begun = self._begun(track, epoch, stamp, expected, cadence.noise(gap))
            if begun is not None:
                return self._accept(track, begun, seq, stamp, arrival)
            nearest = min(self._epochs, key=lambda item: abs(stamp - item.base - expected))
            off = abs(stamp - nearest.base - expected)
            if off <= cadence.wander(gap) and stamp - nearest.base > track.u:
                return self._accept(track, nearest, seq, stamp, arrival)
        late = (
            u > expected + _PAUSE_NS if counted else u > track.u and not self._synced_since(track)
        )
        if late and self._possible(track, u, arrival):
            return self._accept(track, epoch, seq, stamp, arrival)
        return self._unexplained(track, epoch, seq, stamp, arrival, expected if counted else None)

    def _agrees(self, track: _Track, seq: int, advance: int, arrival: int) -> bool:
        """Whether arrivals agree with how far a packet should be after the last one.

        It may have waited on its way, but not for so long that numbers can have wrapped meanwhile.
        """
        late = arrival - track.arrival - advance * self.ratio
        if not track.cadence.ascends(seq):
            return abs(late) < _REACH_NS
        lap = track.cadence.lap_ns * self.ratio
        return -_SILENT_NS < late < max(lap - _SILENT_NS, _SILENT_NS)

    def _is_late(self, track: _Track, seq: int, stamp: int) -> bool:
        """Whether a packet is from before the last one, or is the last one again."""
        back = track.cadence.back(seq)
        if not 0 <= back <= _KEEP:
            return False
        place = track.u + track.cadence.advance(-back)
        slip = track.cadence.slip(back)
        return any(abs(stamp - epoch.base - place) <= slip for epoch in self._epochs)

    def _has_paused(self, track: _Track, epoch: _Epoch, stamp: int, expected: int) -> bool:
        """Whether the stream paused in a way that its numbers do not show, as in standby.

        The place that numbers predict would then have a sync of this host, which the stamp is just
        after, take effect before it was sent.
        """
        base = stamp - expected
        for sync in reversed(self._syncs):
            if sync is epoch.sync:
                break
            if -_SLACK_NS <= stamp - sync.value <= expected - track.u + _MS:
                before = self._lateness(sync.value - base, sync.sent)
                return before is not None and before > _BEFORE_NS
        return False

    def _begun(
        self, track: _Track, epoch: _Epoch, stamp: int, expected: int, noise: float
    ) -> _Epoch | None:
        """Return the epoch of the sync of this host that a stamp is just after.

        The stream that comes first tells where the epoch lies on the line; the IMU stream, more
        regular, has the last word.
        """
        base = stamp - expected
        off = abs(base - epoch.base)
        for sync in reversed(self._syncs):
            if sync is epoch.sync:
                break
            if not -_SLACK_NS <= stamp - sync.value <= expected - track.u + _MS:
                continue
            begun = next((item for item in self._epochs if item.sync is sync), None)
            if begun is None:
                if off <= noise:
                    continue
                begun = _Epoch(base, sync)
                self.epochs += 1
                self._newest = sync
                self._epochs.append(begun)
            elif not self._is_after(track, epoch, begun, stamp, base, noise):
                continue
            elif track is self._imu:
                if self._points.epoch is begun:
                    self._points.u += begun.base - base
                begun.base = base
            return begun
        return None

    def _is_after(
        self, track: _Track, epoch: _Epoch, begun: _Epoch, stamp: int, base: int, noise: float
    ) -> bool:
        """Whether a stamp past the value of a sync is from after the step.

        Clocks faster than the host's pass that value before they are stepped back. The side on
        which the stamp is nearer to where it is expected counts; where the step is too small for
        that, the line does, on which the IMU stream has placed the step.
        """
        is_nearer = abs(base - begun.base) <= abs(base - epoch.base)
        if track is self._imu or begun.sync is None or abs(begun.base - epoch.base) > 2.0 * noise:
            return is_nearer
        if stamp - epoch.base >= begun.sync.value - begun.base:
            return True
        return begun.base < epoch.base and is_nearer

    def _synced_since(self, track: _Track) -> bool:
        """Whether a sync may have stepped the clock since the last packet."""
        return any(sync.sent > track.arrival - _LATE_NS for sync in self._syncs)

    def _accept(self, track: _Track, epoch: _Epoch, seq: int, stamp: int, arrival: int) -> int:
        track.cadence.resume(seq, stamp - epoch.base - track.u)
        return self._enter(track, epoch, stamp, arrival)

    def _enter(self, track: _Track, epoch: _Epoch, stamp: int, arrival: int) -> int:
        track.epoch = epoch
        track.u = u = stamp - epoch.base
        track.stamp = stamp
        track.arrival = arrival
        track.suspect = None
        self.is_firm = epoch is self._imu.epoch or u - self._imu.u > _STALE_NS
        return u

    def _unexplained(
        self,
        track: _Track,
        epoch: _Epoch,
        seq: int,
        stamp: int,
        arrival: int,
        expected: int | None,
    ) -> int | None:
        """Wait for a second packet that confirms the first; then say what happened and go on."""
        suspect, track.suspect = track.suspect, (seq, stamp)
        if suspect is None or not track.cadence.regular(seq - suspect[0], stamp - suspect[1]):
            return None
        begins = expected is None and seq < _BOOT_SEQ and not track.cadence.ascends(seq)
        if begins or (stamp < track.stamp and stamp < _BOOT_NS):
            self.steps.append((Step.REBOOT, stamp - track.stamp))
        elif expected is not None and self._is_prompt(track, expected, arrival):
            self.steps.append((Step.FOREIGN_SYNC, stamp - epoch.base - expected))
            self.epochs += 1
            self._epochs.append(_Epoch(stamp - expected, None))
            return self._accept(track, self._epochs[-1], seq, stamp, arrival)
        else:
            self.steps.append((Step.LOST, stamp - track.stamp))
        self.restart()
        return None

    def _is_prompt(self, track: _Track, place: int, arrival: int) -> bool:
        """Whether a packet at a place is not so late that the stream may have paused instead."""
        late = self._lateness(place, arrival)
        if late is None:
            late = round(arrival - track.arrival - (place - track.u) * self.ratio)
        return late < _REACH_NS

    def _join(self, track: _Track, seq: int, stamp: int, arrival: int) -> int | None:
        """Let a stream that is new onto the line once its cadence is known."""
        if not track.cadence.learn(seq, stamp):
            return None
        other = self._points if track is self._imu else self._imu
        if other.epoch is None:
            self._epochs.append(_Epoch(0, None))
            return self._enter(track, self._epochs[-1], stamp, arrival)
        epoch = self._fitting(other, stamp, arrival)
        if epoch is not None:
            return self._enter(track, epoch, stamp, arrival)
        if arrival - other.arrival > _SILENT_NS:
            self.steps.append((Step.LOST, stamp - other.stamp))
            self.restart()
        return None

    def _fitting(self, other: _Track, stamp: int, arrival: int) -> _Epoch | None:
        """Return the epoch in which a stamp is least late, given where the other stream is."""
        best: _Epoch | None = None
        least = _LATE_NS
        end: int | None = None  # of an epoch on the line
        for epoch in reversed(self._epochs):
            u = stamp - epoch.base
            begin = None if epoch.sync is None else epoch.sync.value - epoch.base
            inside = (begin is None or u >= begin - _SLACK_NS) and (end is None or u <= end)
            end = begin
            if not inside:
                continue
            late = self._lateness(u, arrival)
            if late is None:
                late = abs(round(arrival - other.arrival - (u - other.u) * self.ratio))
            if _EARLY_NS <= late < least:
                best, least = epoch, late
        return best

    def _possible(self, track: _Track, u: int, arrival: int) -> bool:
        """Whether a packet measured at this place could have arrived when it did."""
        late = self._lateness(u, arrival)
        if late is None:
            return abs((u - track.u) * self.ratio - (arrival - track.arrival)) < _REACH_NS
        return _EARLY_NS <= late <= _LATE_NS
