"""`l2lidar set`: changes what the unit stores; shows it first, asks, and verifies where it can."""

from __future__ import annotations

import contextlib
import ipaddress
from collections.abc import Callable, Iterator
from typing import Annotated, Final, TypeVar

import typer

from l2lidar_node.cli.addresses import hardware_address
from l2lidar_node.cli.console import YesOption, change, out, say, with_network
from l2lidar_node.cli.device import Device, DeviceError
from l2lidar_node.cli.get import addresses_in_use
from l2lidar_node.cli.stored import (
    needs_restart,
    parameter_fields,
    with_parameters,
    work_mode as parsed_mode,
    work_mode_text,
)
from l2lidar_node.command_line import UsageError
from l2lidar_node.config import NetworkConfig
from l2lidar_node.driver.device import TRIES
from l2lidar_node.protocol import commands
from l2lidar_node.protocol.commands import Command
from l2lidar_node.protocol.wire import WorkMode

T = TypeVar("T")

_RESTART: Final = "it acts after a restart: `l2lidar reset`, or a power cycle"

app = typer.Typer(
    help="Change what the unit stores in its flash memory: shown before, asked for, verified.",
    no_args_is_help=True,
)


@app.command("work-mode", context_settings={"ignore_unknown_options": True})  # -imu_off is none
@with_network
def work_mode(
    network: NetworkConfig,
    mode: Annotated[
        str,
        typer.Argument(
            help="A number; names: standard, wide_fov, mode_2d, imu_off, serial, wait_for_start; "
            "or changes to what is set: +imu_off,-wide_fov",
        ),
    ],
    yes: YesOption = False,
) -> None:
    """Store a work mode. Field of view and IMU act at once, the rest after a restart.

    Interrupted after the command has gone out, it stores the old mode again.
    """
    _checked(lambda: parsed_mode(mode, 0))  # what is no work mode needs no unit
    with Device(network) as device:
        before = device.read_parameters().work_mode
        after = _checked(lambda: parsed_mode(mode, before))
        old, new = ({"work mode": work_mode_text(value)} for value in (before, after))
        out.print(change(old, new))
        if before == after:
            say("nothing to change")
            return
        if after & ~before & WorkMode.SERIAL and not network.serial_port:
            say(
                "[bold red]After the next restart this unit will be reached by its serial port "
                "only: Ethernet is gone until the mode is set back over the serial line."
            )
        _ask(yes)
        with _undone_by(device, lambda: commands.set_work_mode(WorkMode(before))):
            device.send(commands.set_work_mode(WorkMode(after)))
            found = device.read_parameters().work_mode
        if found != after:
            raise DeviceError(f"acknowledged, but its work mode is {work_mode_text(found)}")
    say("stored and read back" + ("; " + _RESTART if needs_restart(before, after) else ""))


@app.command()
@with_network
def parameters(
    network: NetworkConfig,
    values: Annotated[
        list[str],
        typer.Argument(metavar="NAME=VALUE...", help="Names as `l2lidar get parameters` says."),
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
            raise DeviceError("acknowledged, but the device reports other values than were sent")
    say("stored and read back")


@app.command("network")
@with_network
def network_(
    network: NetworkConfig,
    lidar_ip: Annotated[str | None, typer.Option(help="New address of the unit.")] = None,
    lidar_port: Annotated[int | None, typer.Option(help="New port of the unit.")] = None,
    user_ip: Annotated[str | None, typer.Option(help="New address to send to.")] = None,
    user_port: Annotated[int | None, typer.Option(help="New port to send to.")] = None,
    gateway: Annotated[
        str | None,
        typer.Option(help="New gateway; the unit's address, ending in .1, if left out."),
    ] = None,
    subnet_mask: Annotated[str, typer.Option(help="New subnet mask.")] = "255.255.255.0",
    blind: Annotated[
        bool,
        typer.Option(
            "--blind",
            help="The unit sends elsewhere: do not wait to hear from it. Needs all four.",
        ),
    ] = False,
    yes: YesOption = False,
) -> None:
    """Store addresses; what is left out stays as it is in use now.

    The unit never tells what it has stored, so its acknowledgement is all there is. Gateway and
    mask cannot be known beforehand and are always written. Over a serial line, or for a unit that
    sends to an address nobody knows any more, give both addresses and both ports.
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
            say(f"sent, whether it has arrived is not known; {_RESTART}")
            return
        _send_for_good(device, command)
    say(f"stored; {_RESTART}")


@app.command()
@with_network
def mac(
    network: NetworkConfig,
    address: Annotated[str, typer.Argument(help="Such as 4c:32:01:00:00:63")],
    yes: YesOption = False,
) -> None:
    """Store a hardware address; needed when two units of the same one share a network."""
    command = _checked(lambda: commands.set_mac(_mac_bytes(address)))
    seen = hardware_address(network.l2_ip) or "not known"
    out.print(change({"MAC": seen}, {"MAC": command.payload[:6].hex(":")}))
    with Device(network) as device:
        device.read_parameters()  # so that nobody is asked in vain
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
    """Send another command when what happens within is interrupted."""
    try:
        yield
    except KeyboardInterrupt:
        try:
            device.send(make())
            say("interrupted: the unit has stored what it had before")
        except DeviceError as error:
            say(f"[red]interrupted, and the old value could not be stored again: {error}")
        raise


def _send_for_good(device: Device, command: Command) -> None:
    try:
        device.send(command)
    except KeyboardInterrupt:
        say("[red]interrupted after the command had gone out: it may have been stored")
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
            raise ValueError(f"{name}: {address} stands for the whole subnet {subnet}")
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
