"""Reorder buffers: sequence numbers of one stream, time order of both."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Generic, NamedTuple, TypeVar

from l2lidar_node.driver.device import SILENCE_NS
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.packets import ImuPacket, PointPacket
from l2lidar_node.types import HostNs, Stream

T = TypeVar("T")

_UNKNOWN: Final = 0
_NUMBERS: Final = 1 << 32
_LATE_REACH: Final = 64  # numbers this far behind are late ones, not a wrap


@dataclass(slots=True)
class SequenceCounts:
    """Counts from the sequence numbers of one stream.

    Attributes
    ----------
    lost : int
        Numbers that never came; of a silence longer than a turn of the numbers, what is beyond it.
    duplicates : int
        Packets that came again.
    late : int
        Packets that came after their place had been given up; they are dropped.
    reordered : int
        Packets that came after a later one and were put back into their place.
    restarts : int
        Times the numbers began anew.
    stale : int
        Packets from long ago that came between current ones; they are dropped.
    """

    lost: int = 0
    duplicates: int = 0
    late: int = 0
    reordered: int = 0
    restarts: int = 0
    stale: int = 0


class SequenceOrder(Generic[T]):
    """Releases packets in the order of their numbers.

    A packet that is next in line is released at once. One that is early waits for the missing ones
    until more than ``window`` packets wait; then the missing ones are given up as lost.

    Parameters
    ----------
    window : int
        How many early packets may wait; 0 releases everything at once.

    Attributes
    ----------
    counts : SequenceCounts
    waiting : dict
        What waits by its number, the longest first; only to be read.

    Notes
    -----
    Numbers wrap. The modulus is not documented (0..1024 has been seen), so it is learned: a number
    beyond it says that it is larger, and the next wrap says where; two wraps in a row from the
    same smaller number settle that one.
    """

    def __init__(self, window: int) -> None:
        self.counts = SequenceCounts()
        self._window = window
        self._reach = 2 * window + _LATE_REACH
        self._modulus = wire.SEQ_MODULUS
        self._next: int | None = None
        self.waiting: dict[int, T] = {}
        self._given_up: set[int] = set()  # of the numbers within reach: tells late from duplicate
        self._last_wrap = _UNKNOWN

    @property
    def oldest(self) -> T | None:
        """What has been waiting the longest; None if nothing waits."""
        return next(iter(self.waiting.values()), None)

    def is_earlier(self, seq: int, than: int) -> bool:
        """Tell whether a number comes a little before another one that came lately."""
        return self._next is not None and self._ahead(seq) < self._ahead(than)

    def is_near(self, seq: int) -> bool:
        """Tell whether a number is one that can come now: a little late, or a little early."""
        return self._next is None or self._ahead(seq) <= self._reach

    def is_missing(self, seq: int, before: int) -> bool:
        """Tell whether a number before another one has not come yet."""
        if self._next is None:
            return False
        return seq in self._given_up or (
            0 <= self._ahead(seq) < self._ahead(before) and seq not in self.waiting
        )

    def is_behind(self, seq: int) -> bool:
        """Tell whether the place of a number has been passed a little while ago."""
        return self._next is not None and self._ahead(seq) < 0

    def follows(self, seq: int) -> bool:
        """Take the next number while nothing waits; return whether it was that.

        It is as if it had been pushed and released at once.
        """
        if seq != self._next or self.waiting:
            return False
        self._next = seq + 1 if seq + 1 != self._modulus else 0
        if self._given_up:
            self._given_up.discard(seq)
        return True

    def all_follow(self, first: int, last: int) -> bool:
        """Take all numbers from the next one to another; return whether none wraps or waits."""
        if first != self._next or self.waiting or first < self._modulus <= last:
            return False
        self._next = self._after(last)
        if self._given_up:
            self._given_up.difference_update(range(first, last + 1))
        return True

    def push(self, seq: int, item: T) -> list[tuple[int, T]]:
        """Return what can be released now, each with how many are missing just before it."""
        if self.follows(seq):
            return [(0, item)]
        self._unlearn(seq)
        if self._next is None:
            self._next = self._after(seq)
            return [(0, item)]
        ahead = self._ahead(seq)
        if ahead < 0:
            self._count_behind(seq)
            return []
        if seq in self.waiting:
            self.counts.duplicates += 1
            return []
        if any(self._ahead(other) > ahead for other in self.waiting):
            self.counts.reordered += 1
        self.waiting[seq] = item
        released = self._run(0)
        while len(self.waiting) > self._window:
            released += self.give_up()
        return released

    def resume(self, seq: int, item: T) -> list[tuple[int, T]]:
        """Release everything that waits and then this packet, the first after a long silence.

        It is late for nothing, so its number only tells how many are missing at the least.
        """
        released = self.flush()
        self._unlearn(seq)
        missing = 0 if self._next is None else seq - self._next
        missing = missing % self._modulus if self._modulus != _UNKNOWN else max(missing, 0)
        self.counts.lost += missing
        self._given_up = self._numbers_before(seq, missing)
        self._next = self._after(seq)
        return [*released, (missing, item)]

    def give_up(self) -> list[tuple[int, T]]:
        """Release the first packets that wait, counting the numbers before them as lost."""
        if not self.waiting or self._next is None:
            return []
        first = min(self.waiting, key=self._ahead)
        missing = self._ahead(first)
        if first < self._next:
            missing = self._wrapped(first, missing)
        self.counts.lost += missing
        self._given_up |= self._numbers_before(first, missing)
        self._next = first
        self._given_up = {n for n in self._given_up if -self._reach <= self._ahead(n) < 0}
        return self._run(missing)

    def flush(self) -> list[tuple[int, T]]:
        """Release everything that waits, counting the numbers in between as lost."""
        released: list[tuple[int, T]] = []
        while self.waiting:
            released += self.give_up()
        return released

    def restart(self) -> list[tuple[int, T]]:
        """Release everything that waits and take the next number, whatever it is, as the first."""
        released = self.flush()
        if self._next is not None:
            self.counts.restarts += 1
        self._next = None
        self._given_up.clear()
        return released

    def _after(self, seq: int) -> int:
        return seq + 1 if seq + 1 != self._modulus else 0

    def _ahead(self, seq: int) -> int:
        """Return how many numbers lie between the next one and this one; negative if behind."""
        assert self._next is not None
        if self._modulus != _UNKNOWN:
            ahead = (seq - self._next) % self._modulus
            behind = self._modulus - ahead
            return -behind if behind <= min(self._reach, self._modulus // 2) else ahead
        if seq >= self._next - self._reach:
            return seq - self._next
        # It wrapped at an unknown number: after the largest one seen, as far as is known.
        largest = max((n for n in self.waiting if n >= self._next), default=self._next - 1)
        return largest + 1 - self._next + seq

    def _numbers_before(self, seq: int, count: int) -> set[int]:
        """Return so many numbers before one, those within reach."""
        numbers = range(seq - min(count, self._reach), seq)
        return {number % (self._modulus or _NUMBERS) for number in numbers}

    def _count_behind(self, seq: int) -> None:
        if seq in self._given_up:
            self._given_up.discard(seq)
            self.counts.lost -= 1
            self.counts.late += 1
        else:
            self.counts.duplicates += 1

    def _run(self, missing: int) -> list[tuple[int, T]]:
        released: list[tuple[int, T]] = []
        while self._next in self.waiting:
            seq = self._next
            released.append((missing, self.waiting.pop(seq)))
            self._given_up.discard(seq)
            missing = 0
            self._next = self._after(seq)
        return released

    def _unlearn(self, seq: int) -> None:
        """Record a number that shows the modulus to be too small."""
        if self._modulus != _UNKNOWN and seq >= self._modulus:
            if self._next == 0:
                self._next = self._modulus
            self._modulus = _UNKNOWN

    def _wrapped(self, first: int, missing: int) -> int:
        """Learn from a wrap to ``first``; return how many of the missing numbers do exist."""
        assert self._next is not None
        if self._modulus == _UNKNOWN:
            self._modulus = self._next + missing - first
        elif first == 0 and missing and self._next != self._last_wrap:
            self._last_wrap = self._next
        elif first == 0 and missing:
            self._modulus = self._next
            return 0
        return missing


REORDER_NS: Final = 60_000_000  # a packet waits at most this long for an earlier one
RESTART_NS: Final = 1_000_000_000  # device stamps that fall by more than this began anew

_IMU: Final = Stream.IMU  # to look up a member of an Enum takes long
_FEW: Final = 8  # packets that may be late in a row
_CONFIRMING: Final = 3  # packets in a row that show a restart, two of them could be stale
_MOST_SUSPECTS: Final = 64

# Bounds on how many packets can be missing between two: no stream is faster than 250 Hz, no clock
# ratio is above 3, and a network holds packets back for a second before it delivers them at once.
_MAX_RATE_HZ: Final = 300.0
_MAX_RATIO: Final = 3.0
_MAX_DELAY_NS: Final = 1_000_000_000
_SLACK: Final = 16  # packets, for small steps of the device's clock


class Timed(NamedTuple):
    """A packet with its arrival."""

    packet: PointPacket | ImuPacket
    arrival: HostNs


Released = list[tuple[int, Timed]]
"""Packets in order, each with how many are missing just before it."""


@dataclass(slots=True)
class _Lane:
    """State of one stream.

    ``suspects`` are packets in a row that either begin a new sequence or come from long ago. The
    next packets say which.
    """

    order: SequenceOrder[Timed]
    newest: PointPacket | ImuPacket | None = None
    arrival: int = 0  # [ns] of the packet that came last
    released: Timed | None = None  # the last one released; None: the newest one
    fallen: int = 0  # packets in a row whose stamps fell
    suspects: list[Timed] = field(default_factory=list)
    withholds: bool = False  # the packet that came last is one of them


class ReorderBuffer:
    """Reorder buffer of both streams.

    Parameters
    ----------
    window : int
        How many packets of a stream may wait for a missing earlier one.
    """

    def __init__(self, window: int) -> None:
        self._points = _Lane(SequenceOrder(window))
        self._imu = _Lane(SequenceOrder(window))
        self._lanes = {Stream.POINTS: self._points, Stream.IMU: self._imu}

    @property
    def counts(self) -> dict[Stream, SequenceCounts]:
        """What the sequence numbers say, by stream; goes on counting."""
        return {stream: lane.order.counts for stream, lane in self._lanes.items()}

    @property
    def last_arrivals(self) -> tuple[int, int]:
        """Arrivals of the last packets of points and of the IMU [ns]; 0 before there were any."""
        return self._points.arrival, self._imu.arrival

    def follows(self, stream: Stream, packet: PointPacket | ImuPacket, arrival: HostNs) -> bool:
        """Take a packet that comes just after the one before, as nearly all do.

        Returns whether it did. Others are for :meth:`begins_anew` and :meth:`push`, which would
        treat this one alike.
        """
        lane = self._imu if stream is _IMU else self._points
        if (
            lane.newest is None
            or packet.stamp < lane.newest.stamp
            or arrival - lane.arrival > SILENCE_NS
            or not lane.order.follows(packet.seq)
        ):
            return False
        _advance(lane, packet, arrival)
        return True

    def all_follow(self, first: Timed, last: Timed) -> bool:
        """Take packets of points of consecutive numbers, with stamps that do not fall.

        Return whether each :meth:`follows`. If not, none is taken.
        """
        lane = self._points
        if (
            lane.newest is None
            or first.packet.stamp < lane.newest.stamp
            or not self.is_flowing(first.arrival)
            or not lane.order.all_follow(first.packet.seq, last.packet.seq)
        ):
            return False
        _advance(lane, last.packet, last.arrival)
        return True

    def begins_anew(
        self, stream: Stream, packet: PointPacket | ImuPacket, arrival: HostNs
    ) -> bool:
        """Tell whether the device restarted before it measured this.

        Its stamps fall then. Those of packets that are late do so too where the device's clock was
        just set, but their numbers are earlier, they are few, and they come in company of later
        ones: after a pause nothing is late. An earlier number with a later stamp is not late
        either.

        A packet whose stamp falls and whose number is far off may also be stale: from long ago, by
        another path or from a replay. It is withheld until packets that continue it confirm a
        restart, or a current one refutes it.
        """
        lane = self._lanes[stream]
        newest = lane.newest
        if newest is None:
            return False
        if _is_suspect(lane, packet, arrival):
            return _suspected(lane, Timed(packet, arrival))
        if lane.suspects:
            before = lane.suspects[-1].packet
            is_next = 0 < packet.seq - before.seq <= _FEW  # the clock may have been set since
            is_current = packet.stamp >= newest.stamp and lane.order.is_near(packet.seq)
            if is_next and not is_current:
                return True
            _refute(lane)
        fall = newest.stamp - packet.stamp
        if fall > RESTART_NS:
            lane.fallen += 1
            is_alone = arrival - lane.arrival > REORDER_NS
            is_many = lane.fallen > _FEW
            return is_alone or is_many or not lane.order.is_earlier(packet.seq, newest.seq)
        lane.fallen = 0
        if fall >= 0 or packet.seq > newest.seq:
            return False
        is_fresh = arrival - lane.arrival <= SILENCE_NS
        return is_fresh and lane.order.is_earlier(packet.seq, newest.seq)

    def restart(self, stream: Stream) -> Released:
        """Return what waits; the next packet of the stream is in order, whatever its number."""
        lane = self._lanes[stream]
        released = _bounded(lane, lane.order.restart())
        lane.newest = lane.released = None
        lane.fallen = 0
        confirmed, lane.suspects = lane.suspects, []
        for packet, arrival in confirmed:
            released += self.push(stream, packet, arrival)
        return released

    def push(self, stream: Stream, packet: PointPacket | ImuPacket, arrival: HostNs) -> Released:
        """Return what a packet releases."""
        lane = self._lanes[stream]
        if lane.withholds:
            lane.withholds = False
            return []
        order, newest, pause = lane.order, lane.newest, arrival - lane.arrival
        if lane.released is None and newest is not None:
            lane.released = Timed(newest, HostNs(lane.arrival))
        lane.arrival = arrival
        is_late = pause <= SILENCE_NS and order.is_behind(packet.seq)
        if newest is None or (lane.fallen == 0 and not is_late):
            lane.newest = packet
        timed = Timed(packet, arrival)
        if newest is None:
            return _bounded(lane, order.restart() + order.push(packet.seq, timed))
        if pause > SILENCE_NS:
            return _bounded(lane, order.resume(packet.seq, timed))
        return _bounded(lane, order.push(packet.seq, timed))

    def last_in_order(self, stream: Stream) -> Timed | None:
        """Return the last packet of a stream if the next number is the only one to come now.

        None before there was a packet, and while anything waits or is withheld in either stream.
        """
        lane = self._lanes[stream]
        if any(one.order.waiting or one.suspects for one in self._lanes.values()):
            return None
        if lane.newest is None or lane.released is not None:
            return None
        return Timed(lane.newest, HostNs(lane.arrival))

    def is_flowing(self, until: HostNs) -> bool:
        """Tell whether points came a moment ago and nothing waits: so nothing can be overdue."""
        return (
            until - self._points.arrival <= REORDER_NS
            and not self._points.order.waiting
            and not self._imu.order.waiting
        )

    def is_overdue(self, until: HostNs) -> bool:
        """Tell whether :meth:`settle` would release anything."""
        return any(_overdue(lane.order, until) for lane in self._lanes.values())

    def settle(self, until: HostNs) -> Released:
        """Return what has waited for :data:`REORDER_NS`, nothing more having arrived by then."""
        released: Released = []
        for lane in self._lanes.values():
            while _overdue(lane.order, until):
                released += _bounded(lane, lane.order.give_up())
        return released

    def pause_ns(self, until: HostNs) -> int:
        """Return how long no points arrived; 0 before there were any."""
        return 0 if self._points.newest is None else until - self._points.arrival

    def flush(self) -> Released:
        """Return everything that waits."""
        lanes = self._lanes.values()
        return [item for lane in lanes for item in _bounded(lane, lane.order.flush())]

    def forget(self) -> None:
        """Take the next packet of each stream for the first one."""
        for lane in self._lanes.values():
            lane.newest = lane.released = None
            lane.suspects = []


def _is_suspect(lane: _Lane, packet: PointPacket | ImuPacket, arrival: HostNs) -> bool:
    """Tell whether a packet is from long ago or begins anew, in a stream that is flowing."""
    newest, order = lane.newest, lane.order
    if newest is None or packet.stamp >= newest.stamp or arrival - lane.arrival > REORDER_NS:
        return False
    if newest.stamp - packet.stamp > RESTART_NS:
        return not order.is_missing(packet.seq, newest.seq)
    return not order.is_near(packet.seq)


def _suspected(lane: _Lane, timed: Timed) -> bool:
    """Withhold a packet; return whether it confirms that the stream began anew."""
    suspects = lane.suspects
    if suspects and not _continues(suspects[-1], timed.packet):
        _refute(lane)
        suspects = lane.suspects
    if len(suspects) >= _CONFIRMING - 1:
        elapsed = timed.arrival - suspects[0].arrival
        # A burst of old packets comes faster than it was measured.
        if elapsed >= timed.packet.stamp - suspects[0].packet.stamp or elapsed > REORDER_NS:
            return True
    if len(suspects) < _MOST_SUSPECTS:
        suspects.append(timed)
    lane.withholds = True
    return False


def _continues(before: Timed, packet: PointPacket | ImuPacket) -> bool:
    """Tell whether a packet comes soon after another one, by number and stamp."""
    return (
        0 < packet.seq - before.packet.seq <= _FEW
        and 0 < packet.stamp - before.packet.stamp < RESTART_NS
    )


def _advance(lane: _Lane, packet: PointPacket | ImuPacket, arrival: HostNs) -> None:
    """Take a packet that follows the one before."""
    lane.newest = packet
    lane.arrival = arrival
    lane.released = None
    lane.fallen = 0
    if lane.suspects:
        _refute(lane)


def _refute(lane: _Lane) -> None:
    """Drop what is withheld: packets of now have shown that it is from long ago."""
    lane.order.counts.stale += len(lane.suspects)
    lane.suspects = []


def _bounded(lane: _Lane, released: Released) -> Released:
    """Take back from the lost what cannot have been sent in the time between two packets.

    A number that is far off, from whatever cause, says nothing of packets.
    """
    bounded: Released = []
    for missing, timed in released:
        before, lane.released = lane.released, timed
        most = missing if before is None else min(missing, _most_between(before, timed))
        lane.order.counts.lost -= missing - most
        bounded.append((most, timed))
    return bounded


def _most_between(before: Timed, after: Timed) -> int:
    """Return how many packets of a stream there can be between two."""
    if after.arrival < before.arrival:
        return _SLACK
    elapsed = after.arrival - before.arrival + _MAX_DELAY_NS
    measured = after.packet.stamp - before.packet.stamp
    if measured >= 0:  # else the device's clock was set back
        elapsed = min(elapsed, round(measured * _MAX_RATIO))
    return int(elapsed * 1e-9 * _MAX_RATE_HZ) + _SLACK


def _overdue(order: SequenceOrder[Timed], until: HostNs) -> bool:
    oldest = order.oldest
    return oldest is not None and until - oldest.arrival > REORDER_NS
