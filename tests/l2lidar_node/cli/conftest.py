"""A virtual unit over real sockets, and the command line run in this process."""

from __future__ import annotations

import dataclasses
import io
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from l2lidar_node.cli import device, discover, status
from l2lidar_node.cli.main import main
from l2lidar_node.demo.processes import free_udp_ports
from l2lidar_node.emulator.config import (
    AddressConfig,
    DeviceConfig,
    FaultConfig,
    IdentityConfig,
    PowerConfig,
)
from l2lidar_node.emulator.link.port import UdpPort
from l2lidar_node.emulator.server import Server
from l2lidar_node.emulator.unit.device import VirtualL2
from l2lidar_node.emulator.unit.firmware import Flash
from l2lidar_node.emulator.unit.stream import PatternScanner, StillInertial

LIMIT_S = 120.0  # generous: only a failure waits that long


def free_port() -> int:
    return free_udp_ports(1)[0]


class Unit:
    """A virtual L2 that runs in a thread; what it stores can be looked at."""

    def __init__(
        self, faults: FaultConfig, power: PowerConfig, mode: int, scanner: PatternScanner
    ) -> None:
        self.host_port = free_port()
        addresses = AddressConfig(lidar_port=free_port(), host_port=self.host_port)
        config = DeviceConfig(
            addresses=addresses,
            power=power,
            faults=faults,
            identity=IdentityConfig(work_mode=mode),
        )
        flash = Flash.factory(config.addresses, config.identity)
        self.port = UdpPort(flash.network)
        self.lidar_port = self.port.address[1]
        self.device = VirtualL2(
            config, scanner, StillInertial(), flash=flash, power_on_ns=time.time_ns()
        )
        self.server = Server(self.device, self.port)
        self._thread = threading.Thread(target=self.server.run)
        self._thread.start()

    @property
    def flash(self) -> Flash:
        return self.device.flash

    @property
    def options(self) -> list[str]:
        return [
            "--l2-ip", "127.0.0.1", "--l2-port", str(self.lidar_port),
            "--host-port", str(self.host_port),
        ]  # fmt: skip

    def stop(self) -> None:
        self.server.stop()
        self._thread.join(LIMIT_S)
        self.port.close()


@pytest.fixture
def make_unit() -> Iterator[Callable[..., Unit]]:
    units: list[Unit] = []

    def make(
        mode: int = 0,
        faults: FaultConfig | None = None,
        scanner: PatternScanner | None = None,
        **power: Any,
    ) -> Unit:
        settings = dataclasses.replace(PowerConfig(boot_scale=0.0), **power)
        units.append(Unit(faults or FaultConfig(), settings, mode, scanner or PatternScanner()))
        return units[-1]

    yield make
    for unit in units:
        unit.stop()


@pytest.fixture
def unit(make_unit: Callable[..., Unit]) -> Unit:
    return make_unit()


class UnitTime:
    """Stands in for :mod:`time` in a verb: a busy machine that holds the unit up stops it.

    What the unit makes up for at once afterwards counts for a moment: others have to as well.

    Parameters
    ----------
    device : VirtualL2
    """

    def __init__(self, device: VirtualL2) -> None:
        self._device = device
        self._seen = device.now_ns
        self._passed = 0.0

    def monotonic(self) -> float:
        now = self._device.now_ns
        self._passed += min((now - self._seen) / 1e9, 0.1)
        self._seen = now
        return self._passed

    def sleep(self, seconds: float) -> None:
        end, deadline = self.monotonic() + seconds, time.monotonic() + LIMIT_S
        while self.monotonic() < end:
            assert time.monotonic() < deadline
            time.sleep(0.01)


@pytest.fixture
def timed_by(monkeypatch: pytest.MonkeyPatch) -> Callable[[Unit], None]:
    """Have the verbs count seconds by what a unit has measured."""

    def use(unit: Unit) -> None:
        for module in (device, discover, status):
            monkeypatch.setattr(module, "time", UnitTime(unit.device))

    return use


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a command left behind."""

    code: int
    out: str
    err: str


Run = Callable[..., Outcome]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run ``l2lidar`` with these arguments; nobody is there to answer questions."""

    def invoke(*arguments: str, answer: str = "") -> Outcome:
        monkeypatch.setattr(sys, "argv", ["l2lidar", *arguments])
        monkeypatch.setattr(sys, "stdin", io.StringIO(f"{answer}\n" if answer else ""))
        code = main()
        captured = capsys.readouterr()
        return Outcome(code, captured.out, captured.err)

    return invoke
