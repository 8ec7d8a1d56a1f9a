"""Replays a recording through a driver: at once, or at its own pace in a thread."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Final

from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.recording.capture import CaptureError
from l2lidar_node.recording.recording import Entry, Received, Recording, Sent, Slewed, Stepped
from l2lidar_node.transport.session import Loop
from l2lidar_node.types import (
    LAST_STAMP,
    NOT_AWAITED,
    Datagram,
    HostNs,
    ImuSample,
    Sweep,
    is_ros_time,
)


def feed(driver: Driver, entry: Entry) -> list[Event]:
    """Return what an entry of a recording makes a driver hand out.

    Raises
    ------
    CaptureError
        If its time is beyond what a ROS 2 stamp can hold.
    """
    if not is_ros_time(entry.time):
        raise CaptureError(
            f"its times reach {entry.time // 1_000_000_000} s after 1970; stamps of ROS 2 end at "
            f"{(LAST_STAMP + 1) // 1_000_000_000} s, in January 2038. Was the clock of that "
            "machine set?"
        )
    if isinstance(entry, Received):
        return driver.receive(entry.data, entry.time)
    if isinstance(entry, Sent):
        return driver.sent(entry.command, entry.time)
    if isinstance(entry, Stepped):
        return driver.host_stepped(entry.by_ns, entry.time)
    if isinstance(entry, Slewed):
        driver.host_slewed(entry.by_ns, entry.time)
        return []
    return driver.settle(entry.time)


def events(recording: Recording, config: DriverConfig) -> Iterator[Event]:
    """Yield everything a driver hands out for a recording, in order.

    Parameters
    ----------
    recording : Recording
    config : DriverConfig
        The settings of the live run give what it gave; others decode the same data otherwise.
    """
    driver = Driver(config)
    for entry in recording:
        yield from feed(driver, entry)
    yield from driver.flush()


def measurements(
    recording: Recording, config: DriverConfig
) -> Iterator[tuple[HostNs, Sweep | ImuSample]]:
    """Yield sweeps and IMU samples, each with the time at which a driver could hand it out.

    Parameters
    ----------
    recording : Recording
    config : DriverConfig
        See :func:`events`.
    """
    driver = Driver(config)
    now = recording.start
    for entry in recording:
        now = entry.time
        for event in feed(driver, entry):
            if isinstance(event, Sweep | ImuSample):
                yield now, event
    for event in driver.flush():
        if isinstance(event, Sweep | ImuSample):
            yield now, event


def shifted(event: Event, by_ns: int) -> Event:
    """Return an event as if it had happened that much later."""
    if isinstance(event, Sweep):
        return dataclasses.replace(
            event, start=HostNs(event.start + by_ns), end=HostNs(event.end + by_ns)
        )
    if isinstance(event, ImuSample):
        return event._replace(stamp=HostNs(event.stamp + by_ns))
    return event


LAP_GAP_NS: Final = 5_000_000  # between the last datagram of a lap and the first of the next
_CLOCK_NS: Final = 10_000_000
_LOOK_S: Final = 0.01  # longest time between two looks at calls and stop


class NoTransport:
    """Stands for the transport that a recording has not."""

    foreign = 0
    stranger = ""
    kernel_drops = 0

    def receive(self, timeout_s: float, awaited: HostNs = NOT_AWAITED) -> list[Datagram]:
        """Return nothing."""
        del timeout_s, awaited
        return []

    def send(self, frame: bytes) -> None:
        """Send nothing: there is no device."""

    def close(self) -> None:
        """Do nothing."""


class Playback(Loop):
    """The session of a recording instead of a device.

    Parameters
    ----------
    recording : Recording
    config : DriverConfig
        With ``replay_rate`` and ``replay_loop``.
    on_event : callable
        Called in the loop's thread with everything that happens, in order.
    on_time : callable
        Called with the recording's time every 10 ms of it, before what happens then.
    on_lap : callable
        Called at the end of each lap with the nanoseconds by which all that follows is later than
        recorded; None after the last one.

    Attributes
    ----------
    damage : str
        Why the recording could not be read to its end; empty while it could.

    Notes
    -----
    Each lap begins with a new driver, so all give the same, each later by the length of those
    before it: stamps never go backwards.
    """

    def __init__(
        self,
        recording: Recording,
        config: DriverConfig,
        on_event: Callable[[Event], None],
        on_time: Callable[[HostNs], None],
        on_lap: Callable[[int | None], None],
    ) -> None:
        super().__init__(Driver(config), NoTransport(), on_event)
        self._recording = recording
        self._rate = config.files.replay_rate
        self._is_loop = config.files.replay_loop
        self._on_time = on_time
        self._on_lap = on_lap
        self._time = recording.start
        self._shift_ns = 0
        self.damage = ""

    def _now(self) -> HostNs:
        """Return the recording's own time: the driver knows no other."""
        return self._time

    def _work(self) -> None:
        while True:
            self._play()
            if self._stopping.is_set():
                return
            if not self._is_loop:
                self._on_lap(None)
                return
            self._shift_ns += self._time - self._recording.start + LAP_GAP_NS
            self._on_lap(self._shift_ns)
            self._time = self._recording.start
            self.driver = Driver(self.driver.config, self.driver.blocks.file)

    def _play(self) -> None:
        first = self._recording.start
        begun = time.monotonic()
        next_clock = 0
        for entry in self._entries():
            if self._rate:
                self._wait(begun + (entry.time - first) / (1e9 * self._rate))
            self._run_calls()
            if self._stopping.is_set():
                break
            self._time = max(self._time, entry.time)
            if self._time >= next_clock:
                next_clock = self._time + _CLOCK_NS
                self._on_time(HostNs(self._time + self._shift_ns))
            self._give(feed(self.driver, entry))
        self._give(self.driver.flush())

    def _entries(self) -> Iterator[Entry]:
        try:
            yield from self._recording
        except CaptureError as error:
            self.damage = str(error)

    def _wait(self, until: float) -> None:
        while (left := until - time.monotonic()) > 0 and not self._stopping.is_set():
            self._stopping.wait(min(left, _LOOK_S))
            self._run_calls()

    def _give(self, events: list[Event]) -> None:
        shift = self._shift_ns
        self._hand_out([shifted(event, shift) for event in events] if shift else events)
