"""Commands waiting for their ACK."""

from __future__ import annotations

from typing import Any

import pytest

from l2lidar_node.driver.device import MAX_PENDING, REPEAT_NS, TRIES, CommandClient
from l2lidar_node.protocol import commands, wire
from l2lidar_node.protocol.commands import Command
from l2lidar_node.protocol.packets import Ack
from l2lidar_node.protocol.wire import AckStatus, UserCommand
from l2lidar_node.types import HostNs
from tests.support import build

NOW = HostNs(build.EPOCH_NS)


def after(ns: int) -> HostNs:
    return HostNs(NOW + ns)


def echo(command: Command, status: int = AckStatus.OK) -> Ack:
    number, value = (int.from_bytes(command.payload[at : at + 4], "little") for at in (0, 4))
    return Ack(command.packet_type, number, value, status)


def test_an_ack_answers_with_the_ticket_and_the_round_trip() -> None:
    requests = CommandClient()
    ticket = requests.add(commands.start(), NOW)
    answer = requests.answer(echo(commands.start()), after(700_000))
    assert answer is not None
    assert (answer.ticket, answer.ok, answer.round_trip_ns) == (ticket, True, 700_000)
    assert answer.command == commands.start()
    assert answer.text == "start rotation: acknowledged"
    assert requests.answer(echo(commands.start()), after(800_000)) is None


@pytest.mark.parametrize(
    ("status", "text"),
    [
        (AckStatus.NOT_READY, "start rotation: refused: not ready"),
        (AckStatus.CRC_ERROR, "start rotation: refused: crc error"),
        (77, "start rotation: refused: unknown status 77"),
    ],
)
def test_a_refusal_says_why(status: Any, text: str) -> None:
    requests = CommandClient()
    requests.add(commands.start(), NOW)
    answer = requests.answer(echo(commands.start(), status), after(1))
    assert answer is not None
    assert not answer.ok
    assert answer.text == text


def test_an_ack_of_something_else_answers_nothing() -> None:
    requests = CommandClient()
    requests.add(commands.start(), NOW)
    assert requests.answer(Ack(wire.PacketType.TIME_SYNC, 0, 0, 1), NOW) is None
    assert requests.expire(NOW) == ([], [])


def test_an_unanswered_command_is_repeated_and_then_given_up() -> None:
    requests = CommandClient()
    ticket = requests.add(commands.start(), NOW)
    assert requests.expire(after(REPEAT_NS - 1)) == ([], [])
    for number in range(1, TRIES):
        assert requests.expire(after(number * REPEAT_NS)) == ([commands.start()], [])
        assert requests.expire(after(number * REPEAT_NS + 1)) == ([], [])
    repeats, (answer,) = requests.expire(after(TRIES * REPEAT_NS))
    assert repeats == []
    assert (answer.ticket, answer.ok, answer.round_trip_ns) == (ticket, False, None)
    assert answer.text == "start rotation: the device did not acknowledge it"
    assert requests.expire(after(99 * REPEAT_NS)) == ([], [])


def test_the_round_trip_counts_from_the_last_repeat() -> None:
    requests = CommandClient()
    requests.add(commands.start(), NOW)
    requests.expire(after(REPEAT_NS))
    answer = requests.answer(echo(commands.start()), after(REPEAT_NS + 5))
    assert answer is not None
    assert answer.round_trip_ns == 5


def test_a_later_command_of_the_kind_stops_the_repeats_of_the_earlier_one() -> None:
    """Otherwise a start that nobody acknowledged would undo the stop that followed."""
    requests = CommandClient()
    first = requests.add(commands.start(), NOW)
    second = requests.add(commands.standby(), after(10))
    repeats, answers = requests.expire(after(REPEAT_NS + 10))
    assert repeats == [commands.standby()]
    assert [(answer.ticket, answer.ok) for answer in answers] == [(first, False)]
    answer = requests.answer(echo(commands.standby()), after(REPEAT_NS + 20))
    assert answer is not None
    assert answer.ticket == second


def test_an_exact_echo_is_preferred_to_the_oldest() -> None:
    requests = CommandClient()
    first = requests.add(commands.start(), NOW)
    second = requests.add(commands.standby(), NOW)
    tickets = []
    for ack in (echo(commands.standby()), echo(commands.start())):
        answer = requests.answer(ack, NOW)
        assert answer is not None
        tickets.append(answer.ticket)
    assert tickets == [second, first]


def test_an_echo_with_a_wrong_value_answers_the_oldest() -> None:
    requests = CommandClient()
    first = requests.add(commands.start(), NOW)
    requests.add(commands.standby(), NOW)
    answer = requests.answer(Ack(wire.PacketType.USER_COMMAND, UserCommand.STANDBY, 99, 1), NOW)
    assert answer is not None
    assert answer.ticket == first


def test_a_single_try_is_not_repeated() -> None:
    requests = CommandClient()
    requests.add(commands.latency(101), NOW, tries=1)
    repeats, (answer,) = requests.expire(after(REPEAT_NS))
    assert repeats == []
    assert not answer.ok


def test_a_host_clock_set_back_does_not_freeze_a_command() -> None:
    requests = CommandClient()
    requests.add(commands.start(), NOW)
    assert requests.expire(after(-3_600_000_000_000)) == ([commands.start()], [])


@pytest.mark.parametrize("count", [1, 31, 40, 60, 63, 64])
def test_so_many_may_wait_at_once(count: int) -> None:
    requests = CommandClient()
    tickets = [requests.add(commands.latency(number), NOW) for number in range(count)]
    for number, ticket in enumerate(tickets):
        answer = requests.answer(echo(commands.latency(number)), NOW)
        assert answer is not None
        assert answer.ticket == ticket


def test_too_many_are_given_up_oldest_first_and_said_so() -> None:
    requests = CommandClient()
    tickets = [requests.add(commands.latency(n), NOW) for n in range(MAX_PENDING + 3)]
    repeats, answers = requests.expire(after(1))
    assert repeats == []
    assert [answer.ticket for answer in answers] == tickets[:3]
    assert requests.answer(echo(commands.latency(3)), NOW) is not None
