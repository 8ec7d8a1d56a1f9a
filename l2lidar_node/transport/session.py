"""Runs a driver on a transport in one thread, which alone touches both."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol

from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.transport.host_clock import HostClock
from l2lidar_node.transport.loop import Loop
from l2lidar_node.types import HostNs, Transport

TICK_S: Final = 0.01
_TICK_NS: Final = round(TICK_S * 1e9)


class Tap(Protocol):
    """Somebody who notes everything that a driver's output depends on, in order."""

    def received(self, data: bytes, arrival: HostNs) -> None:
        """Take note of bytes that are handed to the driver."""

    def sent(self, frame: bytes, at: HostNs) -> None:
        """Take note of a frame that the driver counts as sent at an instant."""

    def waited(self, until: HostNs) -> None:
        """Take note that the driver is told to wait no longer for what was due until then."""

    def stepped(self, by_ns: int, at: HostNs) -> None:
        """Take note that the driver is told that the host's clock was set."""

    def close(self) -> None:
        """Take note that this was all."""


class Session(Loop):
    """The receive loop of one device.

    Parameters
    ----------
    driver : Driver
    transport : Transport
        Closed when the session ends.
    on_event : callable
        Called in the loop's thread with everything that happens, in order.
    tap : Tap, optional
        Told everything in the loop's thread; closed when the session ends.
    clock : HostClock, optional
        The clock that the transport tells arrivals in.
    """

    def __init__(
        self,
        driver: Driver,
        transport: Transport,
        on_event: Callable[[Event], None],
        tap: Tap | None = None,
        clock: HostClock | None = None,
    ) -> None:
        super().__init__(driver, transport, on_event)
        self._tap = tap
        self._clock = clock or HostClock()

    def _now(self) -> HostNs:
        return self._clock.now()

    def _work(self) -> None:
        now = next_tick = self._now()
        self._stepped(0, now)
        while not self._stopping.is_set():
            batch = self.transport.receive(TICK_S)
            for data, arrival in batch:
                if self._tap:
                    self._tap.received(data, arrival)
                events = self.driver.receive(data, arrival)
                if events:
                    self._hand_out(events)
            if not self._calls.empty():
                self._run_calls()
                self._send()
            before, now = now, self._now()
            if not 0 < next_tick - now <= _TICK_NS:  # the clock may have been set
                step = self._clock.step_ns()
                if step:
                    now = self._now()
                    self._stepped(step, now)
                next_tick = HostNs(now + _TICK_NS)
                # More may wait in the socket than one batch holds.
                self._tick(now, batch[-1].arrival if batch else before)
        self._run_calls()
        self._send()
        self._hand_out(self.driver.flush())

    def _tick(self, now: HostNs, heard_until: HostNs) -> None:
        if self._tap and self.driver.is_overdue(heard_until):
            self._tap.waited(heard_until)
        self._hand_out(self.driver.tick(now, heard_until))
        self._send()

    def _stepped(self, by_ns: int, at: HostNs) -> None:
        if self._tap:
            self._tap.stepped(by_ns, at)
        self._hand_out(self.driver.host_stepped(by_ns, at))

    def _send(self) -> None:
        for frame, at in self.driver.outbox():
            if self._tap:
                self._tap.sent(frame, at)
            self.transport.send(frame)

    def _release(self) -> None:
        super()._release()
        if self._tap:
            self._tap.close()
