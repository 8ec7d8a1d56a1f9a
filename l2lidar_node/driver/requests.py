"""Remembers commands until the device has answered them, repeats them, and gives up in time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from l2lidar_node.protocol import wire
from l2lidar_node.protocol.commands import Command
from l2lidar_node.protocol.packets import Ack
from l2lidar_node.types import HostNs

REPEAT_NS: Final = 400_000_000
TRIES: Final = 3
MAX_PENDING: Final = 64


@dataclass(frozen=True, slots=True)
class Answer:
    """How a command ended.

    Attributes
    ----------
    ticket : int
        What :meth:`Requests.add` returned.
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


class Requests:
    """The commands that wait for their ACK; at most :data:`MAX_PENDING`, the oldest give way."""

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
