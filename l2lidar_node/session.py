"""Runs a driver on a transport in one thread, which alone touches both."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Final, Protocol, TypeVar

from l2lidar_node.driver import Driver, Event
from l2lidar_node.transport import Transport
from l2lidar_node.types import HostNs

T = TypeVar("T")

TICK_S: Final = 0.01


class Tap(Protocol):
    """Somebody who notes everything that a driver's output depends on, in order."""

    def received(self, data: bytes, arrival: HostNs) -> None:
        """Take note of bytes that are handed to the driver."""

    def sent(self, frame: bytes, at: HostNs) -> None:
        """Take note of a frame that the driver counts as sent at an instant."""

    def waited(self, until: HostNs) -> None:
        """Take note that the driver is told to wait no longer for what was due until then."""

    def close(self) -> None:
        """Take note that this was all."""


class Session:
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
    """

    def __init__(
        self,
        driver: Driver,
        transport: Transport,
        on_event: Callable[[Event], None],
        tap: Tap | None = None,
    ) -> None:
        self.driver = driver
        self.transport = transport
        self._on_event = on_event
        self._tap = tap
        self._calls: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._stopping = threading.Event()
        self._ended = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="l2lidar-receive", daemon=True)

    @property
    def failure(self) -> BaseException | None:
        """What ended the loop before it was stopped; None if nothing did."""
        return self._failure

    def start(self) -> None:
        """Start the loop."""
        self._thread.start()

    def stop(self) -> None:
        """End the loop, everything collected handed out; returns when it has ended."""
        self._stopping.set()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join()
        if self._thread.ident is None:
            self._end()

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
                future.set_result(function(self.driver, HostNs(time.time_ns())))
            except Exception as error:  # the caller gets whatever it was
                future.set_exception(error)

        self._calls.put(run)
        if self._ended.is_set():
            self._run_calls()
        return future

    def _run(self) -> None:
        try:
            next_tick = 0.0
            while not self._stopping.is_set():
                heard_until = HostNs(time.time_ns())
                batch = self.transport.receive(TICK_S)
                for data, arrival in batch:
                    if self._tap:
                        self._tap.received(data, arrival)
                    self._hand_out(self.driver.receive(data, arrival))
                self._run_calls()
                self._send()
                now = time.monotonic()
                if now >= next_tick:
                    next_tick = now + TICK_S
                    # More may wait in the socket than one batch holds.
                    self._tick(batch[-1].arrival if batch else heard_until)
            self._run_calls()
            self._send()
            self._hand_out(self.driver.flush())
        except BaseException as error:
            self._failure = error
            raise
        finally:
            self._end()

    def _tick(self, heard_until: HostNs) -> None:
        if self._tap and self.driver.is_overdue(heard_until):
            self._tap.waited(heard_until)
        self._hand_out(self.driver.tick(HostNs(time.time_ns()), heard_until))
        self._send()

    def _end(self) -> None:
        self.transport.close()
        if self._tap:
            self._tap.close()
        self._ended.set()
        self._run_calls()

    def _run_calls(self) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                self._calls.get_nowait()()

    def _send(self) -> None:
        for frame, at in self.driver.outbox():
            if self._tap:
                self._tap.sent(frame, at)
            self.transport.send(frame)

    def _hand_out(self, events: list[Event]) -> None:
        for event in events:
            self._on_event(event)
