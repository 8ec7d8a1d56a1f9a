"""A recording in a thread like a live session's."""

from __future__ import annotations

import io
import struct
import threading
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest

from l2lidar_node.driver.driver import Event
from l2lidar_node.recording.recording import Playback, Recording
from l2lidar_node.settings import change
from l2lidar_node.types import ImuSample, Sweep
from tests.l2lidar_node.driver.virtual_host import essence, live_run

LIMIT_S = 120.0  # generous: only a failure waits that long


class Unhurried(Playback):
    """A playback that only notes until when it would wait, and its time by then."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.waits: list[float] = []
        self.nows: list[int] = []
        self.elapsed: list[int] = []  # as the diagnostics count it

    def _wait(self, until: float) -> None:
        self.waits.append(until)
        self.nows.append(self._now())
        self.elapsed.append(self._now() - self.driver.clock_status().stepped_ns)


class Played:
    """A playback and everything it says."""

    def __init__(
        self,
        stream: io.BytesIO,
        config: Any,
        laps: int = 1,
        kind: Callable[..., Playback] = Playback,
        **files: Any,
    ) -> None:
        self.events: list[Event] = []
        self.laps: list[list[Event]] = []
        self.shifts: list[int | None] = []
        self.times: list[int] = []
        self.ended = threading.Event()
        self._laps = laps
        settings = change(config, {"replay_rate": 0.0, **files})
        recording = Recording(io.BytesIO(stream.getvalue()))  # which is closed at the end
        self.playback = kind(recording, settings, self.events.append, self.times.append, self._lap)
        self.playback.start()

    def _lap(self, shift: int | None) -> None:
        self.laps.append(list(self.events))
        self.events.clear()
        self.shifts.append(shift)
        if len(self.laps) == self._laps:
            self.ended.set()


def assert_begins(live: list[Event], replayed: list[Event]) -> None:
    """Assert that the samples of a replay are those with which the live run began."""
    part, whole = (
        [item for item in some if isinstance(item, ImuSample)] for some in (replayed, live)
    )
    assert part
    assert part == whole[: len(part)]


@pytest.fixture
def recorded() -> Any:
    config, events, tap = live_run(2.5, faults={"loss": 0.01, "reorder": 0.02})
    return config, events, tap.stream


def test_it_hands_out_what_the_live_session_did_and_ends(recorded: Any) -> None:
    config, live, stream = recorded
    played = Played(stream, config)
    assert played.playback.wait(LIMIT_S)
    assert played.playback.failure is None
    assert played.shifts == [None]
    assert essence(played.laps[0]) == essence(live)


def test_its_time_is_the_recordings(recorded: Any) -> None:
    config, _, stream = recorded
    played = Played(stream, config)
    assert played.playback.wait(LIMIT_S)
    assert played.times == sorted(played.times)
    assert all(9e6 < b - a < 80e6 for a, b in zip(played.times, played.times[1:], strict=False))
    assert played.times[0] >= Recording(stream).start
    done = played.playback.call(lambda driver, now: now)
    assert done.cancelled()


def test_its_time_stands_where_the_recordings_goes_back(recorded: Any) -> None:
    config, _, stream = recorded
    data = bytearray(stream.getvalue())
    at, number, last = 24, 0, 0
    while at < len(data):
        seconds, nanoseconds, length = struct.unpack_from("<3I", data, at)
        when = 10**9 * seconds + nanoseconds
        if number % 3 == 2:  # as packets do that waited in the kernel while a command was sent
            when = last - 15_000_000
            struct.pack_into("<2I", data, at, *divmod(when, 10**9))
        last = when
        at += 16 + length
        number += 1
    played = Played(io.BytesIO(bytes(data)), config)
    assert played.playback.wait(LIMIT_S)
    assert len(played.times) > 20
    assert played.times == sorted(played.times)


def test_laps_are_alike_and_never_go_back_in_time(recorded: Any) -> None:
    config, live, stream = recorded
    played = Played(stream, config, laps=3, replay_loop=True)
    assert played.ended.wait(LIMIT_S)
    played.playback.stop()
    first = played.shifts[0]
    assert first is not None
    assert played.shifts[:2] == [first, 2 * first]
    stamps: list[int] = []
    for number, lap in enumerate(played.laps[:3]):
        later = number * first
        samples = [item for item in lap if isinstance(item, ImuSample)]
        assert [item.stamp - later for item in samples] == [
            item.stamp for item in live if isinstance(item, ImuSample)
        ]
        assert [(item.start - later, item.points.tobytes()) for item in lap
                if isinstance(item, Sweep)] == [
            (item.start, item.points.tobytes()) for item in live if isinstance(item, Sweep)
        ]  # fmt: skip
        stamps += [item.stamp for item in samples]
    assert stamps == sorted(stamps)
    assert played.times == sorted(played.times)


def test_it_answers_calls_and_stops_while_it_waits(recorded: Any) -> None:
    config, _, stream = recorded
    played = Played(stream, config, replay_rate=0.01)
    start = Recording(io.BytesIO(stream.getvalue())).start
    now = played.playback.call(lambda driver, now: now).result(LIMIT_S)
    assert 0 <= now - start < 1e9
    played.playback.stop()
    assert played.playback.wait(0)
    assert played.shifts == []


def with_time(stream: io.BytesIO, seconds: int) -> io.BytesIO:
    """Return a capture in the middle of which one packet has another time."""
    data = bytearray(stream.getvalue())
    at = 24
    while at < len(data) // 2:
        at += 16 + struct.unpack_from("<I", data, at + 8)[0]
    struct.pack_into("<I", data, at, seconds)
    return io.BytesIO(bytes(data))


@pytest.mark.parametrize("rate", [0.0, 100.0])
def test_a_time_that_cannot_be_is_damage(recorded: Any, rate: float) -> None:
    config, live, stream = recorded
    played = Played(with_time(stream, 0xF0000000), config, replay_rate=rate)
    assert played.playback.wait(LIMIT_S)
    assert played.playback.failure is None
    assert "its times reach 4026531840 s after 1970" in played.playback.damage
    assert_begins(live, played.laps[0])


@pytest.mark.parametrize("busy", [0.0, 0.05])
@pytest.mark.parametrize("steps", [(), (60.0,), (-60.0,), (-3600.0, 7200.0), (1e8,), (-1e9,)])
def test_its_pace_does_not_depend_on_how_the_clock_was_set(
    steps: tuple[float, ...], busy: float
) -> None:
    host_steps = [(2.0 + number, step) for number, step in enumerate(steps)]
    config, _, tap = live_run(4.0, host_steps=host_steps, busy=busy)
    played = Played(tap.stream, config, kind=Unhurried, replay_rate=1.0)
    assert played.playback.wait(LIMIT_S)
    assert played.playback.failure is None
    playback = played.playback
    assert isinstance(playback, Unhurried)
    waits = playback.waits
    assert waits == sorted(waits)
    assert waits[-1] - waits[0] == pytest.approx(4.0, abs=0.1)
    assert max(after - before for before, after in pairwise(waits)) < 0.1 + 0.5 * bool(busy)
    # The driver is asked by the clock of which it knows.
    shown = [after - before for before, after in pairwise(playback.nows)]
    jumps = [by for by in shown if abs(by) > 1e9]
    assert [round(by / 1e9) for by in jumps] == list(steps)
    assert all(by >= 0 for by in shown if by not in jumps)
    assert playback.elapsed == sorted(playback.elapsed)
    assert (playback.elapsed[-1] - playback.elapsed[0]) / 1e9 == pytest.approx(4.0, abs=0.1)


@pytest.mark.parametrize("years", [-8, 8])
def test_a_time_far_off_is_waited_for_for_a_minute_at_most(recorded: Any, years: int) -> None:
    config, _, stream = recorded
    far = Recording(stream).start // 10**9 + years * 365 * 86_400
    played = Played(with_time(stream, far), config, kind=Unhurried, replay_rate=1.0)
    assert played.playback.wait(LIMIT_S)
    playback = played.playback
    assert isinstance(playback, Unhurried)
    waits = playback.waits
    assert waits == sorted(waits)
    longest = max(after - before for before, after in pairwise(waits))
    assert longest == pytest.approx(60.0, abs=0.1)
    assert waits[-1] - waits[0] == pytest.approx(62.5, abs=0.2)


def test_damage_ends_it_with_a_reason(recorded: Any) -> None:
    config, live, stream = recorded
    data = bytearray(stream.getvalue())
    at = 24
    while at < len(data) // 2:
        at += 16 + struct.unpack_from("<I", data, at + 8)[0]
    struct.pack_into("<I", data, at + 8, 1 << 30)
    played = Played(io.BytesIO(bytes(data)), config)
    assert played.playback.wait(LIMIT_S)
    assert played.playback.failure is None
    assert "claims 1073741824 bytes" in played.playback.damage
    assert_begins(live, played.laps[0])
