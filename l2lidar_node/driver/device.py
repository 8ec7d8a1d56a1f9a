"""Watchdog, queries and commands of a device."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final

from l2lidar_node.config import WatchdogConfig
from l2lidar_node.protocol import commands, wire
from l2lidar_node.protocol.commands import Command
from l2lidar_node.protocol.packets import Ack
from l2lidar_node.types import HostNs, Stream

SILENCE_NS: Final = 1_000_000_000  # a stream that paused this long has stopped
RUN_OUT_NS: Final = 5_000_000_000  # points that come so long after a stop say it was none
MAX_STEP_NS: Final = 5_000_000_000  # time does not pass in larger steps between two questions
SPIN_UP_NS: Final = 21_000_000_000  # from the first IMU packet to the first points, at power-on

_POINTS: Final = Stream.POINTS  # to look up a member of an Enum takes long


class DeviceState(Enum):
    """What the device is doing, as far as the host can tell."""

    WAITING = "waiting"  # nothing has been heard yet
    SPINNING_UP = "spinning_up"  # IMU but no points yet
    STREAMING = "streaming"
    STANDBY = "standby"  # stopped on request
    STALLED = "stalled"  # it was heard before and fell silent, or its points stopped


class Watchdog:
    """Follows the two streams of a device.

    Parameters
    ----------
    config : WatchdogConfig
    """

    def __init__(self, config: WatchdogConfig) -> None:
        self._timeout_ns = config.timeout_ms * 1_000_000
        self._waits_for_start = config.standby_on_powerup_enabled
        self._last: dict[Stream, HostNs] = {}
        self._watching_since: HostNs | None = None
        self._imu_since: HostNs | None = None
        self._points_seen = False
        self._standby_since: HostNs | None = None
        self._reported = False
        self._checked: HostNs | None = None

    def heard(self, stream: Stream, now: HostNs) -> None:
        """Note a measurement of a stream."""
        last = self._last.get(stream)
        if stream is _POINTS:
            self._points_seen = True
            since = self._standby_since
            if since is not None and now - since > RUN_OUT_NS:
                self._standby_since = None  # it did not obey, or another host started it
        elif last is None or now - last > SILENCE_NS:
            self._imu_since = now
        self._last[stream] = now

    def stopped(self, now: HostNs) -> None:
        """Note that the device was told to stop: silence is what is wanted."""
        self._standby_since = now

    def started(self, now: HostNs) -> None:
        """Note that the device was told to start, or rebooted: the time allowed begins now."""
        self._standby_since = None
        self._watching_since = now
        self._points_seen = False
        self._imu_since = None
        self._last.clear()
        self._reported = False

    def state(self, now: HostNs) -> DeviceState:
        """Return what the device is doing."""
        points, imu = (self._fresh(stream, now) for stream in (Stream.POINTS, Stream.IMU))
        if points:
            return DeviceState.STREAMING
        if self._standby_since is not None:
            return DeviceState.STANDBY
        if imu and not self._points_seen:
            return DeviceState.SPINNING_UP
        return DeviceState.STALLED if self._last else DeviceState.WAITING

    def is_there(self, now: HostNs) -> bool:
        """Tell whether the device was heard in the last seconds, or is silent as told."""
        if self._standby_since is not None:
            return bool(self._last)
        return any(now - last <= RUN_OUT_NS for last in self._last.values())

    def spin_up_left_s(self, now: HostNs) -> float:
        """Return the seconds until points can be expected; 0 when they are overdue."""
        if self._imu_since is None:
            return SPIN_UP_NS / 1e9
        return max(0.0, (self._imu_since + SPIN_UP_NS - now) / 1e9)

    def silence_ns(self, now: HostNs) -> int:
        """Return how long nothing has been measured, 0 while that is as it should be."""
        if self._standby_since is not None or (self._waits_for_start and not self._last):
            return 0
        if self._watching_since is None:
            self._watching_since = now
        return now - max([*self._last.values(), self._watching_since])

    def expired(self, now: HostNs) -> bool:
        """Tell, once per silence, that it has lasted too long; to be asked regularly."""
        step = 0 if self._checked is None else now - self._checked
        self._checked = now
        if not 0 <= step <= MAX_STEP_NS:
            self._follow_clock(now)
        over = self.silence_ns(now) > self._timeout_ns
        if over and not self._reported:
            self._reported = True
            return True
        self._reported = over
        return False

    def _follow_clock(self, now: HostNs) -> None:
        """Begin to count anew: the host's clock was set, or the host slept.

        A board without a battery starts in the past and jumps when it finds a time server: that
        does not count as silence.
        """
        self._last = dict.fromkeys(self._last, now)
        if self._watching_since is not None:
            self._watching_since = now
        if self._imu_since is not None:
            self._imu_since = now

    def _fresh(self, stream: Stream, now: HostNs) -> bool:
        last = self._last.get(stream)
        return last is not None and now - last <= SILENCE_NS


QUERY_NS: Final = 1_000_000_000  # interval of version, parameter and latency requests
_FIRST_ID: Final = 100


class QuerySchedule:
    """Queries that the driver sends by itself.

    Parameters
    ----------
    with_latency : bool
        Whether the round trip is measured, too.
    """

    def __init__(self, with_latency: bool) -> None:
        self._with_latency = with_latency
        self._next = HostNs(0)
        self._latency_id = _FIRST_ID

    def due(self, now: HostNs, *, version: bool, parameters: bool) -> list[Command]:
        """Return the queries that are due; ``version``, ``parameters``: whether they are known."""
        if 0 <= self._next - now <= QUERY_NS:
            return []
        self._next = HostNs(now + QUERY_NS)
        due: list[Command] = []
        if not version:
            due.append(commands.request_version())
        if not parameters:
            due.append(commands.request_parameters())
        if self._with_latency:
            self._latency_id += 1
            due.append(commands.latency(self._latency_id))
        return due


REPEAT_NS: Final = 400_000_000
TRIES: Final = 3
MAX_PENDING: Final = 64


@dataclass(frozen=True, slots=True)
class Answer:
    """Outcome of a command.

    Attributes
    ----------
    ticket : int
        What :meth:`CommandClient.add` returned.
    command : Command
    ok : bool
        Whether the device acknowledged it without objection.
    text : str
        One sentence for a person.
    round_trip_ns : int or None
        From the last sending to the ACK; None without one.
    """

    ticket: int
    command: Command
    ok: bool
    text: str
    round_trip_ns: int | None


@dataclass(slots=True)
class _Pending:
    ticket: int
    command: Command
    sent: HostNs
    tries_left: int


class CommandClient:
    """Commands that wait for their ACK; at most :data:`MAX_PENDING`, the oldest are dropped."""

    def __init__(self) -> None:
        self._pending: list[_Pending] = []
        self._tickets = 0

    def add(self, command: Command, now: HostNs, tries: int = TRIES) -> int:
        """Remember a command that is being sent; return the ticket its answer will carry."""
        self._tickets += 1
        for entry in self._pending:
            if entry.command.is_same_kind(command):
                entry.tries_left = 0  # repeated now, it would undo this command
        self._pending = [
            entry for entry in self._pending if not (entry.command.is_latency and _old(entry, now))
        ]
        self._pending.append(_Pending(self._tickets, command, now, tries - 1))
        return self._tickets

    def answer(self, ack: Ack, now: HostNs) -> Answer | None:
        """Return how the command that this ACK belongs to ended; None if it belongs to none."""
        candidates = [
            entry
            for entry in self._pending
            # Too late is too late, whether or not expire() came by in the meantime.
            if entry.command.is_answered_by(ack) and (entry.tries_left > 0 or not _old(entry, now))
        ]
        if not candidates:
            return None
        entry = next((e for e in candidates if e.command.is_echoed_by(ack)), candidates[0])
        self._pending.remove(entry)
        ok = ack.status == wire.AckStatus.OK
        outcome = "acknowledged" if ok else f"refused: {_status(ack.status)}"
        text = f"{entry.command.name}: {outcome}"
        return Answer(entry.ticket, entry.command, ok, text, now - entry.sent)

    def expire(self, now: HostNs) -> tuple[list[Command], list[Answer]]:
        """Return the commands to send again and the ends of those that were given up."""
        repeats: list[Command] = []
        given_up: list[Answer] = []
        if not self._pending:
            return repeats, given_up
        too_many = len(self._pending) - MAX_PENDING
        for index, entry in enumerate(list(self._pending)):
            if not _old(entry, now) and index >= too_many:
                continue
            if entry.tries_left > 0 and index >= too_many:
                entry.tries_left -= 1
                entry.sent = now
                repeats.append(entry.command)
            else:
                self._pending.remove(entry)
                text = f"{entry.command.name}: the device did not acknowledge it"
                given_up.append(Answer(entry.ticket, entry.command, False, text, None))
        return repeats, given_up


def _old(entry: _Pending, now: HostNs) -> bool:
    return not 0 <= now - entry.sent < REPEAT_NS


def _status(status: int) -> str:
    try:
        return wire.AckStatus(status).name.lower().replace("_", " ")
    except ValueError:
        return f"unknown status {status}"
