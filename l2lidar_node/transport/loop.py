"""A thread that alone touches a driver, and takes calls from other threads."""

from __future__ import annotations

import contextlib
import queue
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future
from typing import Final, TypeVar

import numpy as np

from l2lidar_node.driver.driver import Driver, Event
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
        """What ended the loop before it was stopped; None if nothing did."""
        return self._failure

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
        if self._thread.ident is None:
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
                future.set_result(function(self.driver, self._now()))
            except Exception as error:  # the caller gets whatever it was
                future.set_exception(error)

        self._calls.put(run)
        if self._ended.is_set():
            self._run_calls()
        return future

    @abstractmethod
    def _now(self) -> HostNs:
        """Return the time that counts for the driver."""

    @abstractmethod
    def _work(self) -> None:
        """Do everything until it is done or :attr:`_stopping` is set."""

    def _release(self) -> None:
        """Give up what is held."""
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
