"""Session: the thread that runs a driver on a transport."""

from __future__ import annotations

import contextlib
import queue
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Final, Protocol, TypeVar

import numpy as np

from l2lidar_node.config import NetworkConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.transport.host_clock import HostClock
from l2lidar_node.transport.serial import SerialTransport
from l2lidar_node.transport.udp import UdpTransport
from l2lidar_node.types import HostNs, Transport

T = TypeVar("T")

_LARGEST_SWEEP: Final = 4_000_000  # [8 B]


class Loop(ABC):
    """What runs a driver, live or from a recording.

    Parameters
    ----------
    driver : Driver
    transport : Transport
        Closed when the loop ends.
    on_event : callable
        Called in the loop's thread with everything that happens, in order.
    """

    def __init__(
        self, driver: Driver, transport: Transport, on_event: Callable[[Event], None]
    ) -> None:
        self.driver = driver
        self.transport = transport
        self._on_event = on_event
        self._calls: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._stopping = threading.Event()
        self._ended = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="l2lidar-receive", daemon=True)

    @property
    def failure(self) -> BaseException | None:
        """Exception that ended the loop; None if there was none."""
        return self._failure

    @property
    def is_started(self) -> bool:
        """Whether the loop has been started; before that it answers no call."""
        return self._thread.ident is not None

    def start(self) -> None:
        """Start the loop."""
        # glibc gives freed blocks back to the system, and has every page of the next sweep cleared
        # again, unless one as large has been freed before.
        np.empty(_LARGEST_SWEEP)
        self._thread.start()

    def stop(self) -> None:
        """End the loop, everything collected handed out; returns when it has ended."""
        self._stopping.set()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join()
        if not self.is_started:
            self._end()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the loop has ended; return whether it has."""
        return self._ended.wait(timeout_s)

    def call(self, function: Callable[[Driver, HostNs], T]) -> Future[T]:
        """Have the loop's thread call ``function(driver, now)``; return its result to come.

        The future is cancelled when the loop ends before it gets to it.
        """
        future: Future[T] = Future()

        def run() -> None:
            if self._ended.is_set():
                future.cancel()
            if not future.set_running_or_notify_cancel():
                return
            try:
                self._hand_out(self.driver.catch_up())
                future.set_result(function(self.driver, self._now()))
            except Exception as error:  # the caller gets whatever it was
                future.set_exception(error)

        self._calls.put(run)
        if self._ended.is_set():
            self._run_calls()
        return future

    def stamp(self, now: HostNs) -> HostNs:
        """Return the stamp of what is true at a time of the driver; for calls of the loop."""
        return now

    @abstractmethod
    def _now(self) -> HostNs:
        """Return the time that counts for the driver."""

    @abstractmethod
    def _work(self) -> None:
        """Do everything until it is done or :attr:`_stopping` is set."""

    def _release(self) -> None:
        """Release the resources."""
        self.transport.close()

    def _run(self) -> None:
        try:
            self._work()
        except BaseException as error:
            self._failure = error
            raise
        finally:
            self._end()

    def _end(self) -> None:
        self._release()
        self._ended.set()
        self._run_calls()

    def _run_calls(self) -> None:
        while not self._calls.empty():
            with contextlib.suppress(queue.Empty):  # at the end two threads may be here
                self._calls.get_nowait()()

    def _hand_out(self, events: list[Event]) -> None:
        for event in events:
            self._on_event(event)


def open_transport(network: NetworkConfig) -> Transport:
    """Return the transport that the settings name.

    Raises
    ------
    TransportError
        If it cannot be open_transport; the message says what to do.
    """
    if network.serial_port:
        return SerialTransport(network.serial_port)
    return UdpTransport(network)


def describe_transport(network: NetworkConfig) -> str:
    """Return in words where the L2 is expected."""
    if network.serial_port:
        return f"listening on {network.serial_port}"
    return (
        f"listening on {network.host_ip}:{network.host_port} "
        f"for the L2 at {network.l2_ip}:{network.l2_port}"
    )


TICK_S: Final = 0.02
_TICK_NS: Final = round(TICK_S * 1e9)


class Tap(Protocol):
    """Receives everything that a driver's output depends on, in order."""

    def received(self, data: bytes, arrival: HostNs) -> None:
        """Record bytes that are passed to the driver."""

    def sent(self, frame: bytes, at: HostNs) -> None:
        """Record a frame and the time at which the driver counts it as sent."""

    def waited(self, until: HostNs) -> None:
        """Record that the driver stops waiting for what was due until then."""

    def stepped(self, by_ns: int, at: HostNs) -> None:
        """Record a step of the host's clock that is reported to the driver."""

    def slewed(self, by_ns: int, at: HostNs) -> None:
        """Record slewing of the host's clock that is reported to the driver."""

    def close(self) -> None:
        """Finish the record."""


class Taps:
    """Several taps that receive the same.

    Parameters
    ----------
    taps : sequence of Tap
    """

    def __init__(self, taps: Sequence[Tap]) -> None:
        self._taps = tuple(taps)

    def received(self, data: bytes, arrival: HostNs) -> None:
        """Pass on bytes that are handed to the driver."""
        for tap in self._taps:
            tap.received(data, arrival)

    def sent(self, frame: bytes, at: HostNs) -> None:
        """Pass on a frame that the driver counts as sent."""
        for tap in self._taps:
            tap.sent(frame, at)

    def waited(self, until: HostNs) -> None:
        """Pass on that the driver waits no longer."""
        for tap in self._taps:
            tap.waited(until)

    def stepped(self, by_ns: int, at: HostNs) -> None:
        """Pass on that the host's clock was set."""
        for tap in self._taps:
            tap.stepped(by_ns, at)

    def slewed(self, by_ns: int, at: HostNs) -> None:
        """Pass on how far slewing has moved the host's clock."""
        for tap in self._taps:
            tap.slewed(by_ns, at)

    def close(self) -> None:
        """Close all."""
        for tap in self._taps:
            tap.close()


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
        self._watch_slewing(now)
        while not self._stopping.is_set():
            batch = self.transport.receive(TICK_S, self.driver.awaited())
            events: list[Event] = []
            for data, arrival in batch:
                if self._tap:
                    self._tap.received(data, arrival)
                events += self.driver.receive(data, arrival)
            self._hand_out(events)
            before, now = now, self._now()
            if not 0 < next_tick - now <= _TICK_NS:  # the clock may have been set
                step = self._clock.step_ns()
                if step:
                    now = self._now()
                    self._stepped(step, now)
                self._watch_slewing(now)
                next_tick = HostNs(now + _TICK_NS)
                # More may wait in the socket than one batch holds.
                self._tick(now, batch[-1].arrival if batch else before)
            if not self._calls.empty():  # last: they are given the time by the clock as it was set
                self._run_calls()
                self._send()
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

    def _watch_slewing(self, now: HostNs) -> None:
        slewed = self._clock.slewed_ns()
        if slewed is not None:
            if self._tap:
                self._tap.slewed(slewed, now)
            self.driver.host_slewed(slewed, now)

    def _send(self) -> None:
        for frame, at in self.driver.outbox():
            if self._tap:
                self._tap.sent(frame, at)
            self.transport.send(frame)

    def _release(self) -> None:
        super()._release()
        if self._tap:
            self._tap.close()
