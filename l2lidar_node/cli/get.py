"""`l2lidar get`: what is set in the unit, as far as it can be told."""

from __future__ import annotations

from typing import Any, Final

import typer

from l2lidar_node.cli.addresses import hardware_address
from l2lidar_node.cli.console import JsonOption, facts, out, print_json, say, with_network
from l2lidar_node.cli.device import Device, DeviceError
from l2lidar_node.cli.stored import parameter_fields, work_mode_text
from l2lidar_node.config import NetworkConfig
from l2lidar_node.recording.recording import endpoints

_LISTEN_S: Final = 2.0

app = typer.Typer(help="Say what is set in the unit.", no_args_is_help=True)


@app.command("work-mode")
@with_network
def work_mode(network: NetworkConfig, json_: JsonOption = False) -> None:
    """Say the stored work mode."""
    with Device(network) as device:
        mode = device.read_parameters().work_mode
    if json_:
        print_json({"work_mode": mode})
    else:
        say(work_mode_text(mode))


@app.command()
@with_network
def parameters(network: NetworkConfig, json_: JsonOption = False) -> None:
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


@app.command("network")
@with_network
def network_(network: NetworkConfig, json_: JsonOption = False) -> None:
    """Say the addresses in use; there is no way to read the stored ones."""
    values = addresses_in_use(network)
    if json_:
        print_json(values)
    else:
        out.print(facts("In use", values))
        say("[dim]what is stored cannot be read")


@app.command()
@with_network
def mac(network: NetworkConfig, json_: JsonOption = False) -> None:
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
        raise DeviceError("a serial line carries no network addresses; connect by UDP")
    with Device(network) as device:
        if device.wait_for(lambda driver: driver.counters.datagrams > 0, _LISTEN_S) is None:
            raise DeviceError(f"nothing heard from the L2; {device.advice()}")
