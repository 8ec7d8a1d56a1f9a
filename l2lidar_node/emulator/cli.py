"""Command line of the virtual L2: options in, a running unit out."""

from __future__ import annotations

import errno
import math
import os
import signal
import sys
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated, Final

import typer

from l2lidar_node.emulator import assembly, report
from l2lidar_node.emulator.config import (
    AddressConfig,
    CrystalConfig,
    DelayConfig,
    DeviceConfig,
    FaultConfig,
    IdentityConfig,
    PowerConfig,
)
from l2lidar_node.emulator.link.port import PortError
from l2lidar_node.emulator.options import group, with_options
from l2lidar_node.emulator.physics import PhysicsConfig
from l2lidar_node.emulator.ray_cast_worker import Studio, StudioError
from l2lidar_node.emulator.server import MAX_SPEED, Server
from l2lidar_node.emulator.truth.results import write_ledger
from l2lidar_node.emulator.unit.device import Link, VirtualL2
from l2lidar_node.emulator.unit.flash import Flash
from l2lidar_node.emulator.unit.inertial import ImuNoise
from l2lidar_node.emulator.unit.returns import RangeNoise
from l2lidar_node.files import write_whole
from l2lidar_node.programs import interruptible
from l2lidar_node.settings import Setting, Value, settings_of, values_of

_LEAD_NS: Final = 100_000_000  # from ready to power-on, so that the first packets are in time
_NICENESS: Final = -10
_RUN: Final = "Run"
_PANELS: Final[dict[str, tuple[type, ...]]] = {
    "Network": (AddressConfig,),
    "Unit": (IdentityConfig,),
    "Clock": (CrystalConfig, DelayConfig),
    "Power": (PowerConfig,),
    "Range errors": (RangeNoise,),
    "IMU errors": (ImuNoise,),
    "Faults": (FaultConfig,),
    _RUN: (DeviceConfig,),
    "World and motion": (PhysicsConfig,),
}
"""Groups of settings by panel; a setting is shown where it comes first."""


def emulate(
    settings: dict[str, Value],
    ready: Annotated[
        bool,
        typer.Option(
            "--ready", help="Skip the spin-up: same as --boot-scale 0.", rich_help_panel="Power"
        ),
    ] = False,
    serial: Annotated[
        str | None,
        typer.Option(
            metavar="PATH",
            help="Use a serial device at 4 Mbaud instead of UDP; 'pty' makes a pseudo-terminal.",
            rich_help_panel="Network",
        ),
    ] = None,
    flash: Annotated[
        Path | None,
        typer.Option(
            help="File that keeps what the unit stores. Once it exists its addresses and its work "
            "mode count, not those of the command line.",
            rich_help_panel="Unit",
        ),
    ] = None,
    speed: Annotated[
        str,
        typer.Option(
            metavar="FACTOR|max",
            help="Seconds of the unit's life per second, or as fast as a receiver on this machine "
            "reads. Default: 1",
            rich_help_panel=_RUN,
            show_default=False,
        ),
    ] = "1",
    duration: Annotated[
        float,
        typer.Option(
            min=0.0,
            metavar="S",
            help="End so long after power-on. Default: never",
            rich_help_panel=_RUN,
            show_default=False,
        ),
    ] = math.inf,
    truth: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the truth: every packet and its fate, every fault, the trajectory.",
            rich_help_panel=_RUN,
        ),
    ] = None,
    truth_points: Annotated[
        bool,
        typer.Option(
            "--truth-points",
            help="With --truth also the exact points of every packet (1.6 MB a second).",
            rich_help_panel=_RUN,
        ),
    ] = False,
) -> None:
    """Emulate a Unitree L2: stream what a moving sensor sees, obey commands, fail on request.

    Without options a unit on 127.0.0.1:6101 sends to 127.0.0.1:6201, carried through a furnished
    room, with points from 25 s on.

    Examples
    --------
    l2lidar_emulator --ready --motion spin

    l2lidar_emulator --lidar-ip 192.168.1.62 --host 192.168.1.2 --world yard --motion trot

    l2lidar_emulator --ready --world pattern --loss 0.05 --duration 60 --truth out/truth
    """
    if ready and "boot_scale" in settings:
        raise typer.BadParameter(
            "contradicts '--boot-scale', give one of them", param_hint="'--ready'"
        )
    if truth_points and truth is None:
        raise typer.BadParameter("needs '--truth' too", param_hint="'--truth-points'")
    if ready:
        settings["boot_scale"] = 0.0
    pace = _pace(speed)
    config = group(DeviceConfig, settings)
    physics = assembly.seen_from(config, group(PhysicsConfig, settings))
    stored = assembly.stored_settings(flash, config, serial is not None)
    if truth is not None:
        _make_folder(truth)  # or a run would end with the truth having nowhere to go
    with ExitStack() as stack:
        port = assembly.opened(stored, config, serial)
        stack.callback(port.close)
        studio = None
        if physics.world not in assembly.WORLDLESS:
            studio = stack.enter_context(Studio(physics, truth if truth_points else None))
        device = assembly.unit(
            config,
            stored,
            studio,
            power_on_ns=time.time_ns() + _LEAD_NS,
            link=Link.ETHERNET if serial is None else Link.SERIAL,
            empty=physics.world == "none",
            remember=truth is not None,
        )
        server = Server(device, port, pace, lambda changed: _keep(flash, changed))
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: server.stop())
        _hurry()
        _say(*report.beginning(config, physics, stored, port))
        try:
            server.run(duration)
        finally:
            _say(*report.end(device, server))
            if truth is not None:
                values = {**values_of(physics), **values_of(config), "speed": speed}
                _write_truth(truth, device, studio, values)


def _pace(text: str) -> float:
    if text == "max":
        return MAX_SPEED
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not 0.01 <= speed <= 1000.0:
        raise typer.BadParameter(
            f"{text!r} is no speed, expected 0.01 to 1000, or max", param_hint="'--speed'"
        )
    return speed


def _keep(path: Path | None, flash: Flash) -> None:
    if path is not None:
        write_whole(path, flash.to_json().encode())


def _make_folder(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder))


def _write_truth(
    folder: Path, device: VirtualL2, studio: Studio | None, values: dict[str, Value]
) -> None:
    run = {"power_on_ns": device.power_on_ns, "settings": values}
    write_ledger(folder, device.ledger, run)
    if studio is not None:
        lasted_s = max(device.now_ns - device.power_on_ns, 0) * 1e-9
        studio.write_trajectory(folder, lasted_s, device.power_on_ns)
    _say(f"truth in {folder}")


def _hurry() -> None:
    """Ask to go first, where that is allowed: a sensor does not wait for the host's processor."""
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, _NICENESS)


def _say(*lines: str) -> None:
    for line in lines:
        typer.echo(line)


def _panels() -> dict[str, list[Setting]]:
    known: set[str] = set()
    panels: dict[str, list[Setting]] = {}
    for panel, groups in _PANELS.items():
        items = [item for kind in groups for item in settings_of(kind) if item.name not in known]
        known |= {item.name for item in items}
        panels[panel] = items
    return panels


def main() -> None:
    """Run the command line.

    Leaves with 0 at the end of the duration and when told to stop, 1 where the system refuses
    a port or a file, 2 for a wrong option, 130 when interrupted before it runs.
    """
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(with_options(emulate, _panels()))
    try:
        app(prog_name="l2lidar_emulator", standalone_mode=True)
    except OSError as error:
        text = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        typer.echo(f"l2lidar_emulator: {text}", err=True)
        sys.exit(1)
    except (PortError, StudioError) as error:
        typer.echo(f"l2lidar_emulator: {error}", err=True)
        sys.exit(1)
    except ImportError as error:
        typer.echo(f"l2lidar_emulator: {error}; '--world pattern' needs no rays", err=True)
        sys.exit(1)
    except ValueError as error:
        typer.echo(f"l2lidar_emulator: {error}", err=True)
        sys.exit(2)


if __name__ == "__main__":
    sys.exit(interruptible(main))
