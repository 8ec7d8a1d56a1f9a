"""Runs a virtual L2 on a port: in real time, faster, or as fast as the receiver takes it."""

from __future__ import annotations

import math
import select
import sys
import time
from collections.abc import Callable
from typing import Final

from l2lidar_node.emulator.link.port import Port
from l2lidar_node.emulator.unit.device import VirtualL2
from l2lidar_node.emulator.unit.flash import Flash

_BIN_NS: Final = 10_000
_BINS: Final = 10_000  # up to 100 ms


class Latency:
    """Distribution of delays with a resolution of 10 us up to 100 ms, and the exact maximum."""

    def __init__(self) -> None:
        self._counts = [0] * (_BINS + 1)
        self.count = 0
        self.max_ns = 0

    def add(self, late_ns: int) -> None:
        """Count one delay; a negative one counts as none."""
        late_ns = max(late_ns, 0)
        self._counts[min(late_ns // _BIN_NS, _BINS)] += 1
        self.count += 1
        self.max_ns = max(self.max_ns, late_ns)

    def quantile_ns(self, share: float) -> int:
        """Return a delay that at least this share of all did not exceed; 0 without any."""
        seen = 0
        for number, count in enumerate(self._counts):
            seen += count
            if count and seen >= share * self.count:
                return self.max_ns if number == _BINS else min((number + 1) * _BIN_NS, self.max_ns)
        return 0


_LONGEST_WAIT_S: Final = 0.05  # to notice a stop or a held-back packet
_CHUNK_NS: Final = 20_000_000  # of the unit's time between two looks at receiver and stop
MAX_SPEED: Final = math.inf


class Server:
    """Joins a virtual unit and a port.

    Parameters
    ----------
    device : VirtualL2
    port : Port
    speed : float
        Seconds of the unit's life per second; with :data:`MAX_SPEED` the receiver sets the pace.
    on_flash : callable, optional
        Called with the stored settings whenever they have changed.

    Attributes
    ----------
    latency : Latency
        How long after its instant each datagram was sent, at the unit's time scale.
    unsent : int
        Datagrams that the port could not take.
    """

    def __init__(
        self,
        device: VirtualL2,
        port: Port,
        speed: float = 1.0,
        on_flash: Callable[[Flash], None] | None = None,
    ) -> None:
        self.latency = Latency()
        self.unsent = 0
        self._device = device
        self._port = port
        self._speed = speed
        self._on_flash = on_flash
        self._flash = device.flash
        self._network = device.network
        self._is_stopped = False

    def stop(self) -> None:
        """Let :meth:`run` return soon; may be called from a signal handler or another thread."""
        self._is_stopped = True

    def run(self, duration_s: float = math.inf) -> None:
        """Serve until :meth:`stop` or the end of a duration.

        The unit's instant of power-on is taken for one on the wall clock; from then on the
        monotonic clock counts.

        Parameters
        ----------
        duration_s : float
            Seconds of the unit's life after power-on.

        Raises
        ------
        PortError
            If the unit moves to an address that cannot be bound, or loses its connector.
        """
        power_on_ns = self._device.power_on_ns
        end_ns = sys.maxsize
        if not math.isinf(duration_s):
            end_ns = power_on_ns + round(duration_s * 1e9)
        if math.isinf(self._speed):
            self._race(power_on_ns, end_ns)
        else:
            self._keep_pace(power_on_ns, end_ns)

    def _keep_pace(self, power_on_ns: int, end_ns: int) -> None:
        speed = self._speed
        base_ns = time.monotonic_ns() + power_on_ns - time.time_ns()

        def now() -> int:
            return power_on_ns + round((time.monotonic_ns() - base_ns) * speed)

        until_ns = 0
        while not self._is_stopped and until_ns < end_ns:
            due_ns = self._device.next_ns
            wait_s = _LONGEST_WAIT_S
            if due_ns is not None:
                wait_s = min(max((due_ns - now()) / speed * 1e-9, 0.0), wait_s)
            is_spoken_to = bool(select.select([self._port], [], [], wait_s)[0])
            # After a pause of the machine there is much to catch up with; a stop is heard between.
            until_ns = min(now() if due_ns is None else due_ns + _CHUNK_NS, now(), end_ns)
            for time_ns, data in self._device.advance(until_ns):
                self.unsent += not self._port.send(data)
                self.latency.add(now() - time_ns)
            if is_spoken_to:  # what was due before goes out as it was, if late
                self._listen(until_ns)

    def _race(self, power_on_ns: int, end_ns: int) -> None:
        now_ns = power_on_ns
        while not self._is_stopped and now_ns < end_ns:
            if select.select([self._port], [], [], 0.0)[0]:
                self._listen(now_ns)
            next_ns = self._device.next_ns
            if next_ns is None:
                select.select([self._port], [], [], _CHUNK_NS * 1e-9)
            now_ns = min(max(next_ns or 0, now_ns) + _CHUNK_NS, end_ns)
            for _, data in self._device.advance(now_ns):
                self._drain()
                self.unsent += not self._port.send(data)
        self._drain()  # a serial line may have taken only a part of the last packet

    def _drain(self) -> None:
        while not self._is_stopped and not self._port.drain(_LONGEST_WAIT_S):
            pass

    def _listen(self, now_ns: int) -> None:
        for data in self._port.receive():
            self._device.command(data, now_ns)
        if self._device.flash != self._flash:
            self._flash = self._device.flash
            if self._on_flash:
                self._on_flash(self._flash)
        if self._device.network != self._network:
            self._network = self._device.network
            self._port.follow(self._network)
