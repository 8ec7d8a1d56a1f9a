"""Verbs that command a unit: `l2lidar get`, `set`, `start`, `stop` and `reset`.

The first two show and change what the unit stores; the others change its standby or reboot it, and
undo that when they are interrupted in between.
"""

from __future__ import annotations

import contextlib
import ipaddress
import math
import threading
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Final, TypeVar

import numpy as np
import typer

from l2lidar_node.cli.console import (
    JsonOption,
    YesOption,
    change,
    facts,
    out,
    print_json,
    say,
    with_network,
)
from l2lidar_node.cli.device import Device, DeviceError, hardware_address
from l2lidar_node.clock import ClockEvent, ClockEventKind
from l2lidar_node.command_line import UsageError
from l2lidar_node.config import NetworkConfig
from l2lidar_node.driver.device import TRIES
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.protocol import commands, wire
from l2lidar_node.protocol.commands import Command
from l2lidar_node.protocol.wire import WorkMode
from l2lidar_node.recording.recording import endpoints

_NAMES: Final = {bit.name.lower(): bit for bit in WorkMode if bit.name}
_AT_ONCE: Final = WorkMode.WIDE_FOV | WorkMode.IMU_OFF
STANDARD: Final = "standard"


def parse_work_mode(text: str, now: int) -> int:
    """Return the work mode that a text names.

    Parameters
    ----------
    text : str
        A number (``0``, ``0x10``); names joined by commas (``wide_fov,imu_off``; ``standard`` for
        none); or changes to what is set now (``+imu_off,-wide_fov``).
    now : int
        The mode that is set.

    Raises
    ------
    ValueError
        If it is none of that.
    """
    try:
        number = int(text, 0)
    except ValueError:
        return _named(text, now)
    if text[:1] in "+-" or number & ~wire.WORK_MODE_MASK:
        raise ValueError(f"work mode {text}: expected 0 to {wire.WORK_MODE_MASK:#x}")
    return number


def _named(text: str, now: int) -> int:
    parts = [part.strip().lower() for part in text.split(",")]
    changes = [part for part in parts if part[:1] in ("+", "-")]
    if changes and len(changes) < len(parts):
        raise ValueError(f"work mode {text}: either all names need a sign or none")
    mode = now if changes else 0
    for part in parts:
        name = part.lstrip("+-")
        if name == STANDARD and not changes:
            continue
        if name not in _NAMES:
            known = ", ".join([STANDARD, *_NAMES])
            raise ValueError(f"work mode {text}: '{name}' is not known, expected {known}")
        mode = mode & ~_NAMES[name] if part.startswith("-") else mode | _NAMES[name]
    return int(mode)


def work_mode_text(mode: int) -> str:
    """Return a work mode as number and names."""
    names = [name for name, bit in _NAMES.items() if mode & bit]
    rest = mode & ~int(sum(_NAMES.values()))
    if rest:
        names.append(f"unknown bits {rest:#x}")
    return f"{mode} ({', '.join(names) or STANDARD})"


def needs_restart(before: int, after: int) -> bool:
    """Tell whether a change of the work mode acts only after a restart."""
    return bool((before ^ after) & ~int(_AT_ONCE))


def parameter_fields(payload: bytes) -> dict[str, float]:
    """Return the fields of a parameter block whose meaning is known, by dotted name."""
    row = np.frombuffer(payload, wire.PARAMETERS_PAYLOAD, 1)[0]
    return {name: float(_at(row, name)) for name in _fields()}


def with_parameters(payload: bytes, changes: list[str]) -> bytes:
    """Return a parameter block with fields replaced.

    Parameters
    ----------
    payload : bytes
    changes : list of str
        Each ``name=value``.

    Raises
    ------
    ValueError
        If a name is not known or a value is not a finite number.
    """
    block = np.frombuffer(payload, wire.PARAMETERS_PAYLOAD, 1).copy()
    for text in changes:
        name, sign, value = text.partition("=")
        if not sign:
            raise ValueError(f"{text}: expected NAME=VALUE")
        if name not in _fields():
            raise ValueError(f"{name}: not known, expected one of {', '.join(_fields())}")
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not abs(number) <= float(np.finfo(np.float32).max):
            raise ValueError(f"{name}: '{value}' is not a finite number")
        *groups, field = name.split(".")
        part: Any = block
        for group in groups:
            part = part[group]
        part[field] = number
    fields = parameter_fields(block.tobytes())
    if not 0.0 <= fields["range_min"] < fields["range_max"]:
        raise ValueError("range_min must be at least 0 and less than range_max")
    return block.tobytes()


def _fields() -> list[str]:
    """Return the dotted names of the known fields."""
    names = ["range_min", "range_max"]
    for group in wire.PARAMETERS_PAYLOAD.names or ():
        if group.startswith("calibration"):
            names += [f"{group}.{field}" for field in wire.CALIBRATION.names or ()]
    return names


def _at(row: Any, name: str) -> Any:
    for part in name.split("."):
        row = row[part]
    return row


_LISTEN_S: Final = 2.0
_MEASURING_S: Final = 1.0
_SILENT_S: Final = 0.5
_LOCK_S: Final = 2.5
_RESTART_S: Final = 60.0

get_app = typer.Typer(help="Show what is set in the unit.", no_args_is_help=True)


@get_app.command("work-mode")
@with_network
def get_work_mode(network: NetworkConfig, json_: JsonOption = False) -> None:
    """Say the stored work mode."""
    with Device(network) as device:
        mode = device.read_parameters().work_mode
    if json_:
        print_json({"work_mode": mode})
    else:
        say(work_mode_text(mode))


@get_app.command("parameters")
@with_network
def get_parameters(network: NetworkConfig, json_: JsonOption = False) -> None:
    """Say the stored parameters whose meaning is known."""
    with Device(network) as device:
        block = device.read_parameters()
    try:
        values: dict[str, Any] = dict(parameter_fields(block.payload))
    except ValueError:
        raise DeviceError(f"its block of {len(block.payload)} bytes has no known layout") from None
    values["work_mode"] = block.work_mode
    if json_:
        print_json(values)
    else:
        values = {name: f"{value:.9g}" for name, value in values.items()}
        out.print(facts("Parameters", values))


@get_app.command("network")
@with_network
def get_network(network: NetworkConfig, json_: JsonOption = False) -> None:
    """Say the addresses in use; there is no way to read the stored ones."""
    values = addresses_in_use(network)
    if json_:
        print_json(values)
    else:
        out.print(facts("In use", values))
        say("[dim]stored values cannot be read")


@get_app.command("mac")
@with_network
def get_mac(network: NetworkConfig, json_: JsonOption = False) -> None:
    """Say the hardware address that this machine has seen; the stored one cannot be read."""
    _hear(network)
    found = hardware_address(network.l2_ip)
    if json_:
        print_json({"mac": found})
    elif found is None:
        raise DeviceError(f"this machine has seen no hardware address for {network.l2_ip}")
    else:
        say(found)


def addresses_in_use(network: NetworkConfig) -> dict[str, str | int]:
    """Return both ends of the conversation with the unit.

    Raises
    ------
    DeviceError
        If the unit is not heard.
    """
    _hear(network)
    device, host = endpoints(network)
    return {
        "lidar_ip": device.ip,
        "lidar_port": device.port,
        "user_ip": host.ip,
        "user_port": host.port,
    }


def _hear(network: NetworkConfig) -> None:
    if network.serial_port:
        raise DeviceError("a serial line carries no network addresses; connect over UDP")
    with Device(network) as device:
        if device.wait_for(lambda driver: driver.counters.datagrams > 0, _LISTEN_S) is None:
            raise DeviceError(f"no data from the L2; {device.advice()}")


T = TypeVar("T")

_RESTART: Final = "takes effect after a restart: `l2lidar reset`, or a power cycle"

set_app = typer.Typer(
    help="Change what the unit stores in its flash memory: shown first, confirmed, verified.",
    no_args_is_help=True,
)


@set_app.command(
    "work-mode", context_settings={"ignore_unknown_options": True}
)  # -imu_off is none
@with_network
def set_work_mode(
    network: NetworkConfig,
    mode: Annotated[
        str,
        typer.Argument(
            help="A number; names: standard, wide_fov, mode_2d, imu_off, serial, wait_for_start; "
            "or changes to the present mode: +imu_off,-wide_fov",
        ),
    ],
    yes: YesOption = False,
) -> None:
    """Store a work mode. Field of view and IMU act at once, the rest after a restart.

    Interrupted after the command has gone out, it stores the old mode again.
    """
    _checked(lambda: parse_work_mode(mode, 0))  # a wrong work mode is refused without a unit
    with Device(network) as device:
        before = device.read_parameters().work_mode
        after = _checked(lambda: parse_work_mode(mode, before))
        old, new = ({"work mode": work_mode_text(value)} for value in (before, after))
        out.print(change(old, new))
        if before == after:
            say("nothing to change")
            return
        if after & ~before & WorkMode.SERIAL and not network.serial_port:
            say(
                "[bold red]After the next restart this unit can only be reached over its serial "
                "port: Ethernet is off until the mode is changed back over the serial line."
            )
        _ask(yes)
        with _undone_by(device, lambda: commands.set_work_mode(WorkMode(before))):
            device.send(commands.set_work_mode(WorkMode(after)))
            found = device.read_parameters().work_mode
        if found != after:
            raise DeviceError(f"acknowledged, but its work mode is {work_mode_text(found)}")
    say("stored and read back" + ("; " + _RESTART if needs_restart(before, after) else ""))


@set_app.command("parameters")
@with_network
def set_parameters(
    network: NetworkConfig,
    values: Annotated[
        list[str],
        typer.Argument(metavar="NAME=VALUE...", help="Names as in `l2lidar get parameters`."),
    ],
    yes: YesOption = False,
) -> None:
    """Store parameters: range limits and calibration. EXPERIMENTAL.

    The block's layout is known from observation alone, and nobody has published having written
    one: keep what `l2lidar get parameters --json` says. Interrupted after the command has gone
    out, it stores the old block again.
    """
    with Device(network) as device:
        before = device.read_parameters().payload
        after = _checked(lambda: with_parameters(before, values))
        old, new = (parameter_fields(block) for block in (before, after))
        changed = {name: value for name, value in new.items() if value != old[name]}
        if not changed:
            say("nothing to change")
            return
        out.print(change(old, changed))
        say("[bold yellow]Writing parameters is experimental.")
        _ask(yes)
        with _undone_by(device, lambda: commands.set_parameters(before)):
            device.send(commands.set_parameters(after))
            found = device.read_parameters().payload
        if found != after:
            raise DeviceError("acknowledged, but the device reports other values than those sent")
    say("stored and read back")


@set_app.command("network")
@with_network
def set_network(
    network: NetworkConfig,
    lidar_ip: Annotated[str | None, typer.Option(help="New address of the unit.")] = None,
    lidar_port: Annotated[int | None, typer.Option(help="New port of the unit.")] = None,
    user_ip: Annotated[str | None, typer.Option(help="New address to send to.")] = None,
    user_port: Annotated[int | None, typer.Option(help="New port to send to.")] = None,
    gateway: Annotated[
        str | None,
        typer.Option(help="New gateway; if omitted, the unit's address ending in .1."),
    ] = None,
    subnet_mask: Annotated[str, typer.Option(help="New subnet mask.")] = "255.255.255.0",
    blind: Annotated[
        bool,
        typer.Option(
            "--blind",
            help="The unit sends elsewhere: do not wait for its data. Needs all four.",
        ),
    ] = False,
    yes: YesOption = False,
) -> None:
    """Store addresses; omitted ones stay as they are.

    The unit never tells what it has stored, so its acknowledgement is all there is. Gateway and
    mask cannot be known beforehand and are always written. Over a serial line, or for a unit that
    sends to an unknown address, give both addresses and both ports.
    """
    given = {
        "lidar_ip": lidar_ip,
        "lidar_port": lidar_port,
        "user_ip": user_ip,
        "user_port": user_port,
    }
    is_hidden = blind or bool(network.serial_port)
    if is_hidden and None in given.values():
        missing = [f"--{name.replace('_', '-')}" for name in given if given[name] is None]
        raise UsageError(
            f"the device does not report its addresses: give {', '.join(missing)} too"
        )
    before = {} if is_hidden else addresses_in_use(network)
    after = before | {name: value for name, value in given.items() if value is not None}
    after["gateway"] = gateway or str(after["lidar_ip"]).rpartition(".")[0] + ".1"
    after["subnet_mask"] = subnet_mask
    _checked(lambda: _check_subnet(after))
    command = _checked(lambda: commands.set_network(**after))  # type: ignore[arg-type]  # by name
    out.print(change(before, after))
    _ask(yes)
    with Device(network) as device:
        if blind:
            for _ in range(TRIES):
                device.tell(lambda driver, now: driver.send(command, now))
            say(f"sent, but whether it arrived is unknown; {_RESTART}")
            return
        _send_for_good(device, command)
    say(f"stored; {_RESTART}")


@set_app.command("mac")
@with_network
def set_mac(
    network: NetworkConfig,
    address: Annotated[str, typer.Argument(help="Such as 4c:32:01:00:00:63")],
    yes: YesOption = False,
) -> None:
    """Store a hardware address; needed when two units of the same one share a network."""
    command = _checked(lambda: commands.set_mac(_mac_bytes(address)))
    seen = hardware_address(network.l2_ip) or "not known"
    out.print(change({"MAC": seen}, {"MAC": command.payload[:6].hex(":")}))
    with Device(network) as device:
        device.read_parameters()  # before asking for confirmation
        _ask(yes)
        _send_for_good(device, command)
    say(f"stored; {_RESTART}")


def _checked(make: Callable[[], T]) -> T:
    try:
        return make()
    except ValueError as error:
        raise UsageError(str(error)) from None


def _ask(yes: bool) -> None:
    if not yes:
        typer.confirm("Store this in the unit's flash memory?", abort=True)


@contextlib.contextmanager
def _undone_by(device: Device, make: Callable[[], Command]) -> Iterator[None]:
    """Send another command if the body is interrupted."""
    try:
        yield
    except KeyboardInterrupt:
        try:
            device.send(make())
            say("interrupted: the unit has its old value again")
        except DeviceError as error:
            say(f"[red]interrupted, and the old value could not be stored again: {error}")
        raise


def _send_for_good(device: Device, command: Command) -> None:
    try:
        device.send(command)
    except KeyboardInterrupt:
        say("[red]interrupted after the command was sent: it may have been stored")
        raise


def _check_subnet(values: dict[str, str | int]) -> None:
    mask = values["subnet_mask"]
    try:
        subnet = ipaddress.IPv4Network(f"{values['lidar_ip']}/{mask}", strict=False)
        ends = {name: ipaddress.IPv4Address(values[name]) for name in ("lidar_ip", "user_ip")}
    except ValueError as error:
        raise ValueError(f"{error}, expected IPv4 addresses and a mask") from None
    for name, address in ends.items():
        if address.is_multicast or address.is_unspecified:
            raise ValueError(f"{name}: {address} is not a host address")
        if address not in subnet:
            raise ValueError(f"{name}: {address} is not in the unit's subnet {subnet}")
        if address in (subnet.network_address, subnet.broadcast_address):
            raise ValueError(
                f"{name}: {address} is the network or broadcast address of subnet {subnet}"
            )
    same = values["lidar_ip"] == values["user_ip"]
    if same and (not ends["lidar_ip"].is_loopback or values["lidar_port"] == values["user_port"]):
        raise ValueError(f"lidar_ip and user_ip are both {values['lidar_ip']}")


def _mac_bytes(text: str) -> bytes:
    parts = text.replace("-", ":").split(":")
    try:
        if len(parts) != 6 or any(len(part) != 2 for part in parts):
            raise ValueError
        return bytes.fromhex("".join(parts))
    except ValueError:
        expected = "expected one such as 4c:32:01:00:00:63"
        raise ValueError(f"'{text}' is not a MAC address; {expected}") from None


WaitOption = Annotated[
    float, typer.Option(min=0.0, metavar="S", help="Seconds to wait until it has taken effect.")
]


@with_network
def start(network: NetworkConfig, wait: WaitOption = 0.0) -> None:
    """Leave standby: the head turns, points arrive after 12 to 45 s.

    Interrupted while it waits, it puts a unit that was in standby back.
    """
    with Device(network) as device:
        was_running = device.is_measuring(_MEASURING_S)
        try:
            device.command(lambda driver, now: driver.start_rotation(now))
            points = _points(device)
            if wait and device.wait_for(lambda driver: _count(driver) > points, wait) is None:
                raise DeviceError(f"acknowledged, but there are no points after {wait:g} s")
        except KeyboardInterrupt:
            if not was_running:
                _restore(device, to_running=False)
            raise
        say("it was running already" if was_running else "started")


@with_network
def stop(network: NetworkConfig) -> None:
    """Enter standby: the motors stop, and points and IMU with them.

    Interrupted before it is done, it starts a unit that was running again.
    """
    with Device(network) as device:
        was_running = device.is_measuring(_MEASURING_S)
        try:
            device.command(lambda driver, now: driver.stop_rotation(now)[0])
            if device.is_measuring(_SILENT_S) and device.is_measuring(_SILENT_S):
                raise DeviceError("the device acknowledged the command but keeps measuring")
        except KeyboardInterrupt:
            if was_running:
                _restore(device, to_running=True)
            raise
        say("stopped" if was_running else "no data arrived before; it is in standby")


@with_network
def reset(network: NetworkConfig, wait: WaitOption = 0.0) -> None:
    """Reboot the unit: stored settings take effect, points are back in about 25 s.

    The unit does not acknowledge it; with --wait its clock tells that it began anew.
    """
    restarted = threading.Event()

    def notice(event: Event) -> None:
        if isinstance(event, ClockEvent) and event.kind is ClockEventKind.REBOOT:
            restarted.set()

    with Device(network, notice) as device:
        if device.is_measuring(_MEASURING_S):
            if wait:
                # A clock that is known shows a restart, however young the unit was before it.
                device.wait_for(lambda driver: driver.clock_status().locked, _LOCK_S)
        elif device.ask(lambda driver: not _heard(driver)):
            say("[yellow]no data from it: the command is sent anyway")
        before = device.ask(_stamp_s)
        restarted.clear()
        device.tell(lambda driver, now: driver.reset_device(now))
        if not wait:
            say("reset sent")
            return
        points = _points(device)

        def is_back(driver: Driver) -> bool:
            has_begun_anew = restarted.is_set() or _stamp_s(driver) < min(before, _RESTART_S)
            return _count(driver) > points and has_begun_anew

        if device.wait_for(is_back, wait) is None:
            raise DeviceError(f"the device did not restart within {wait:g} s")
        say("it has restarted and sends points again")


def _restore(device: Device, *, to_running: bool) -> None:
    with contextlib.suppress(DeviceError):
        if to_running:
            device.command(lambda driver, now: driver.start_rotation(now))
        else:
            device.command(lambda driver, now: driver.stop_rotation(now)[0])
        say("interrupted: it is running again" if to_running else "interrupted: in standby")
        return
    say("[red]interrupted, and it did not acknowledge the command to undo it")


def _points(device: Device) -> int:
    return device.ask(_count)


def _count(driver: Driver) -> int:
    frames = driver.counters.frames
    return frames[wire.PacketType.POINTS_3D] + frames[wire.PacketType.POINTS_2D]


def _heard(driver: Driver) -> bool:
    return driver.counters.frames.total() > 0


def _stamp_s(driver: Driver) -> float:
    """Return the device's clock at the latest points [s]; infinity if there were none."""
    if driver.last_points is None:
        return float("inf")
    info = np.frombuffer(driver.last_points, wire.DATA_INFO, 1)[0]
    return float(info["sec"] + 1e-9 * info["nsec"])
