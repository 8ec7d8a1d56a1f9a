"""A connection to one L2 for a verb, and the addresses of this machine."""

from __future__ import annotations

import fcntl
import socket
import struct
import time
from collections.abc import Callable
from concurrent.futures import Future, TimeoutError as NoAnswerError
from pathlib import Path
from types import TracebackType
from typing import Final, TypeVar

from l2lidar_node.command_line import CommandError
from l2lidar_node.config import DriverConfig, NetworkConfig
from l2lidar_node.driver import health
from l2lidar_node.driver.device import REPEAT_NS, TRIES, Answer
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.protocol import commands
from l2lidar_node.protocol.commands import Command
from l2lidar_node.protocol.packets import Parameters
from l2lidar_node.settings import build, values_of
from l2lidar_node.transport import session
from l2lidar_node.transport.session import Session, Tap
from l2lidar_node.types import Check, HostNs

_SIOCGIFADDR: Final = 0x8915
_NEIGHBOURS: Final = Path("/proc/net/arp")


def local_addresses() -> list[str]:
    """Return the IPv4 addresses of this machine's network interfaces, without the loopback's."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as item:
        for _, name in socket.if_nameindex():
            request = struct.pack("256s", name.encode()[:15])
            try:
                answer = fcntl.ioctl(item.fileno(), _SIOCGIFADDR, request)
            except OSError:  # without an address
                continue
            found.append(socket.inet_ntoa(answer[20:24]))
    return [address for address in found if not address.startswith("127.")]


def hardware_address(ip: str) -> str | None:
    """Return the hardware address that answers for an IPv4 address; None if it is not known."""
    try:
        lines = _NEIGHBOURS.read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return None
    for line in lines:
        address, _, _, hardware, *_ = line.split()
        if address == ip and hardware != "00:00:00:00:00:00":
            return hardware
    return None


T = TypeVar("T")

ANSWER_S: Final = TRIES * REPEAT_NS / 1e9 + 1.0  # the driver says sooner that nothing came
_LOOK_S: Final = 0.02


class DeviceError(CommandError):
    """The device does not answer or did not do what it was asked; the message says which."""


class Device:
    """A connection to an L2, open during a ``with`` statement.

    Nothing about it is changed by connecting: its clock is left alone, only its version and
    parameters are asked for.

    Parameters
    ----------
    network : NetworkConfig
    on_event : callable, optional
        Called in the receiving thread with everything that happens.
    tap : Tap, optional
        Told everything that is received and sent.
    settings
        Further settings of the driver by name.

    Raises
    ------
    TransportError
        If socket or serial device cannot be opened.
    """

    def __init__(
        self,
        network: NetworkConfig,
        on_event: Callable[[Event], None] | None = None,
        tap: Tap | None = None,
        **settings: object,
    ) -> None:
        quiet = {
            "enable_l2_host_sync": False,
            "watchdog_action": "wait",
            "standby_on_powerup_enabled": True,
        }
        self.network = network
        self.config = build(DriverConfig, {**values_of(network), **quiet, **settings})
        self._on_event = on_event
        self._answers: dict[int, Future[Answer]] = {}
        self._blocks: list[Parameters] = []
        self._session = Session(
            Driver(self.config), session.open_transport(network), self._handle, tap
        )

    def __enter__(self) -> Device:
        """Begin to listen."""
        self._session.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End the connection."""
        self._session.stop()

    def ask(self, question: Callable[[Driver], T]) -> T:
        """Return the result of a function of the driver, called in the thread that owns it."""
        return self._session.call(lambda driver, now: question(driver)).result()

    def wait_for(self, question: Callable[[Driver], T | None], timeout_s: float) -> T | None:
        """Ask until the answer is neither None nor False; None if that takes too long."""
        deadline = time.monotonic() + timeout_s
        while True:
            is_late = time.monotonic() >= deadline
            answer = self.ask(question)
            if answer is not None and answer is not False:
                return answer
            if is_late:
                return None
            time.sleep(_LOOK_S)

    def command(self, start: Callable[[Driver, HostNs], int]) -> Answer:
        """Send the command that ``start`` queues, wait for its answer and return it.

        Raises
        ------
        DeviceError
            If the device does not acknowledge it, or refuses.
        """
        future: Future[Answer] = Future()

        def begin(driver: Driver, now: HostNs) -> None:
            self._answers[start(driver, now)] = future

        self._session.call(begin).result()
        try:
            answer = future.result(ANSWER_S)
        except NoAnswerError:
            raise DeviceError("the device did not answer") from None
        if not answer.ok:
            raise DeviceError(answer.text)
        return answer

    def tell(self, function: Callable[[Driver, HostNs], object]) -> None:
        """Have something queued that the device does not answer."""
        self._session.call(function).result()

    def send(self, command: Command) -> Answer:
        """Send a command that is acknowledged; see :meth:`command`."""
        return self.command(lambda driver, now: driver.send(command, now))

    def read_parameters(self) -> Parameters:
        """Return the device's parameter block as it is now.

        Raises
        ------
        DeviceError
            If the device does not send it.
        """

        def begin(driver: Driver, now: HostNs) -> None:
            self._blocks.clear()
            driver.send(commands.request_parameters(), now)

        self._session.call(begin).result()
        found = self.wait_for(lambda driver: self._blocks[-1] if self._blocks else None, ANSWER_S)
        if found is None:
            raise DeviceError(f"the L2 did not send its parameters; {self.advice()}")
        return found

    def period(self) -> health.Period:
        """Return the counts so far."""
        return self._session.call(
            lambda driver, now: health.observe(driver, self._session.transport, now)
        ).result()

    def checks(self, before: health.Period) -> tuple[list[Check], health.Period]:
        """Return the checks of the period since then, and the present counts."""

        def look(driver: Driver, now: HostNs) -> tuple[list[Check], health.Period]:
            after = health.observe(driver, self._session.transport, now)
            return health.judge(driver, before, after), after

        return self._session.call(look).result()

    def is_measuring(self, seconds: float) -> bool:
        """Listen for so long at the most; return whether points or IMU samples come."""
        before = self.ask(lambda driver: driver.counters.frames.total())
        return bool(
            self.wait_for(lambda driver: driver.counters.frames.total() > before + 10, seconds)
        )

    def advice(self) -> str:
        """Return what to check if no data arrive."""
        if self.network.serial_port:
            return (
                f"check that it is at {self.network.serial_port}, that it has power, and that its "
                "work mode is set to serial"
            )
        if self.network.host_ip == "0.0.0.0":
            addresses = ", ".join(local_addresses()) or "none"
            target = f"one of this machine's addresses ({addresses})"
        else:
            target = self.network.host_ip
        return (
            f"check that it is at {self.network.l2_ip}, sends to {target}, port "
            f"{self.network.host_port}, and has power"
        )

    def _handle(self, event: Event) -> None:
        if isinstance(event, Answer):
            future = self._answers.pop(event.ticket, None)
            if future is not None:
                future.set_result(event)
        elif isinstance(event, Parameters):
            self._blocks.append(event)
        if self._on_event is not None:
            self._on_event(event)
