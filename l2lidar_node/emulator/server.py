"""Runs a virtual L2 on a port, in real time or faster."""

from __future__ import annotations

import bisect
import dataclasses
import math
import os
import select
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from l2lidar_node.emulator.config import DeviceConfig
from l2lidar_node.emulator.link.port import Port, SerialPort, UdpPort
from l2lidar_node.emulator.physics import PhysicsConfig, RayCastWorker
from l2lidar_node.emulator.truth import PacketLog
from l2lidar_node.emulator.unit.device import Link, VirtualL2
from l2lidar_node.emulator.unit.firmware import Flash, version_payload
from l2lidar_node.emulator.unit.stream import VIEW, PatternScanner, PointSource, StillInertial
from l2lidar_node.protocol.wire import WorkMode

WORLDLESS: Final = ("pattern", "none")
"""Worlds that are not ray-cast: a shell, and nothing at all."""

_REMEMBERED: Final = 10_000  # packets, if the truth is not written


class FlashError(ValueError):
    """A file of stored settings that cannot be used; the message names it."""


def stored_settings(path: Path | None, config: DeviceConfig, serial: bool) -> Flash:
    """Return the unit's stored settings: those in a file, or a new unit's without one.

    Parameters
    ----------
    path : Path or None
        Need not exist.
    config : DeviceConfig
    serial : bool
        A new unit is set to its serial port.

    Raises
    ------
    FlashError
        If the file is none that the emulator wrote, or its folder cannot be written to.
    SettingError
        If an address or a version is not one.
    """
    version_payload(config.identity)  # says what is wrong with it before anything is started
    if path is not None and path.exists():
        try:
            return Flash.from_json(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise FlashError(f"{path}: {error.strerror}") from None
        except ValueError as error:
            raise FlashError(f"{path}: {error}") from None
    if path is not None and not os.access(path.parent, os.W_OK):
        raise FlashError(f"{path}: '{path.parent}' is not a writable folder")
    flash = Flash.factory(config.addresses, config.identity)
    mode = flash.work_mode | (WorkMode.SERIAL if serial else 0)
    return dataclasses.replace(flash, work_mode=int(mode))


def opened(flash: Flash, config: DeviceConfig, serial: str | None) -> Port:
    """Return the port at which the unit is reached.

    Raises
    ------
    PortError
        If it cannot be opened.
    """
    if serial is not None:
        return SerialPort(serial)
    return UdpPort(flash.network, config.addresses.reply_to_sender)


def seen_from(config: DeviceConfig, physics: PhysicsConfig) -> PhysicsConfig:
    """Return the physics at rest until the first points; earlier motion would not be seen."""
    spin_up_s = config.power.points_s * config.power.boot_scale
    return dataclasses.replace(physics, rest_s=physics.rest_s + spin_up_s)


def unit(
    config: DeviceConfig,
    flash: Flash,
    ray_cast_worker: RayCastWorker | None,
    *,
    power_on_ns: int,
    link: Link = Link.ETHERNET,
    empty: bool = False,
    remember: bool = False,
) -> VirtualL2:
    """Return a unit that is about to be switched on.

    Parameters
    ----------
    config : DeviceConfig
    flash : Flash
    ray_cast_worker : RayCastWorker or None
        What measures; without one a pattern does.
    power_on_ns : int
        True instant of power-on.
    link : Link
    empty : bool
        The pattern has no returns.
    remember : bool
        Keep the whole truth in memory instead of the latest of it.
    """
    sources: dict[WorkMode, PointSource] = {
        mode: ray_cast_worker.points(mode) if ray_cast_worker else _pattern(mode, empty)
        for mode in map(WorkMode, range(int(VIEW) + 1))
    }
    return VirtualL2(
        config,
        sources.pop(WorkMode(0)),
        ray_cast_worker.inertial() if ray_cast_worker else StillInertial(),
        power_on_ns=power_on_ns,
        flash=flash,
        link=link,
        modes=sources,
        packet_log=PacketLog(None if remember else _REMEMBERED),
    )


def _pattern(mode: WorkMode, empty: bool) -> PatternScanner:
    return PatternScanner(bool(mode & WorkMode.WIDE_FOV), bool(mode & WorkMode.MODE_2D), empty)


_BIN_NS: Final = 10_000
_FINE_NS: Final = 100_000_000
_COARSE_BIN_NS: Final = 10_000_000
_COARSE_NS: Final = 60_000_000_000


class Latency:
    """Distribution of delays, and the exact maximum.

    The resolution is 10 us up to 100 ms, and 10 ms up to a minute.
    """

    def __init__(self) -> None:
        self._edges: list[int] = [  # upper ends of the bins
            *range(_BIN_NS, _FINE_NS, _BIN_NS),
            *range(_FINE_NS, _COARSE_NS + 1, _COARSE_BIN_NS),
        ]
        self._counts = [0] * (len(self._edges) + 1)
        self.count = 0
        self.max_ns = 0

    def add(self, late_ns: int) -> None:
        """Count one delay; a negative one counts as none."""
        late_ns = max(late_ns, 0)
        self._counts[bisect.bisect_right(self._edges, late_ns)] += 1
        self.count += 1
        self.max_ns = max(self.max_ns, late_ns)

    def quantile_ns(self, share: float) -> int:
        """Return a delay that at least this share of all did not exceed; 0 without any."""
        seen = 0
        for count, edge in zip(self._counts, [*self._edges, self.max_ns], strict=True):
            seen += count
            if count and seen >= share * self.count:
                return edge if edge < self.max_ns else self.max_ns
        return 0

    def summary_ms(self) -> dict[str, float]:
        """Return median, 99th percentile and maximum [ms]: ``p50``, ``p99``, ``max``."""
        p50, p99 = self.quantile_ns(0.5), self.quantile_ns(0.99)
        return {"p50": p50 * 1e-6, "p99": p99 * 1e-6, "max": self.max_ns * 1e-6}


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
