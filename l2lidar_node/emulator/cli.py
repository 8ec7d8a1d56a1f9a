"""Command line of the virtual L2: options in, a running unit out."""

from __future__ import annotations

import errno
import inspect
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

import typer

from l2lidar_node.command_line import for_typer
from l2lidar_node.emulator.config import (
    AddressConfig,
    CrystalConfig,
    DelayConfig,
    DeviceConfig,
    FaultConfig,
    IdentityConfig,
    PowerConfig,
)
from l2lidar_node.emulator.link.port import Port, PortError
from l2lidar_node.emulator.physics import PhysicsConfig, RayCastError, RayCastWorker
from l2lidar_node.emulator.server import (
    MAX_SPEED,
    WORLDLESS,
    Server,
    opened,
    seen_from,
    stored_settings,
    unit,
)
from l2lidar_node.emulator.truth import write_packet_log
from l2lidar_node.emulator.unit.device import Link, VirtualL2
from l2lidar_node.emulator.unit.firmware import Flash
from l2lidar_node.emulator.unit.inertial import ImuNoise
from l2lidar_node.emulator.unit.returns import RangeNoise
from l2lidar_node.files import write_whole
from l2lidar_node.programs import interruptible
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.settings import Setting, SettingError, Value, build, settings_of, values_of

G = TypeVar("G")

_NUMBERS: Final = {int: "whole number", float: "number"}
_METAVARS: Final = {int: "N", float: "X", str: "TEXT", bool: None}

Panels = Mapping[str, Sequence[Setting]]
"""Settings by the heading under which the help shows them."""


def with_options(command: Callable[..., None], panels: Panels) -> Callable[..., None]:
    """Return a command that also takes an option per setting.

    Parameters
    ----------
    command : callable
        Takes its own annotated parameters and ``settings``, a dict from the name of a setting to
        the value that was given; settings that were not are not in it.
    panels : mapping

    Returns
    -------
    callable
        For :meth:`typer.Typer.command`.
    """
    parameters = [
        item.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for item in inspect.signature(command, eval_str=True).parameters.values()
        if item.name != "settings"
    ]
    made = {f"setting_{item.name}": item for items in panels.values() for item in items}
    parameters += [
        inspect.Parameter(
            f"setting_{item.name}",
            inspect.Parameter.KEYWORD_ONLY,
            default=None,
            annotation=_option(item, panel),
        )
        for panel, items in panels.items()
        for item in items
    ]

    def run(**arguments: Any) -> None:
        texts = {name: arguments.pop(name) for name in made}
        settings = {
            item.name: _value(item, texts[name])
            for name, item in made.items()
            if texts[name] is not None
        }
        command(**arguments, settings=settings)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # typer reads it
    run.__annotations__ = {item.name: item.annotation for item in parameters}
    run.__doc__ = command.__doc__
    return for_typer(run)


def group(kind: type[G], given: Mapping[str, Value]) -> G:
    """Return a group of settings made from those of the given values that belong to it."""
    own = {item.name for item in settings_of(kind)}
    return build(kind, {name: value for name, value in given.items() if name in own})


def flag(item: Setting) -> str:
    """Return the option of a setting."""
    return f"--{item.name.replace('_', '-')}"


def _value(item: Setting, given: bool | str) -> Value:
    try:
        if isinstance(given, bool):
            return item.check(given)
        if item.item is None:
            return item.check(item.type(given))
        parts = [part for part in given.split(",") if part.strip()]
        return item.check([item.item(part) for part in parts])
    except SettingError as error:
        text = str(error).removeprefix(f"parameter '{item.name}': ")
    except ValueError:
        kind = "list of numbers such as 1.5,4" if item.item else _NUMBERS[item.type]
        text = f"{given!r} is not a {kind}"
        if item.range_text:
            text += f", expected {item.range_text}"
    raise typer.BadParameter(text, param_hint=f"'{flag(item)}'")


def _option(item: Setting, panel: str) -> Any:
    # Numbers come as text: what is wrong with one is said in one place, by the setting.
    kind: Any = bool if item.type is bool else str
    names = [f"{flag(item)}/--no-{flag(item)[2:]}"] if kind is bool else [flag(item)]
    metavar = "|".join(item.choices) or ("A,B,..." if item.item else _METAVARS[item.type])
    facts = [f"{item.doc[0].upper()}{item.doc[1:]}."]
    if item.unit and not item.range_text.endswith(item.unit):
        facts.append(f"In {item.unit}.")
    if item.range_text and not item.choices:
        facts.append(f"{item.range_text[0].upper()}{item.range_text[1:]}.")
    facts.append(f"Default: {_text(item.default)}")
    return Annotated[
        kind | None,
        typer.Option(
            *names,
            help=" ".join(facts),
            rich_help_panel=panel,
            show_default=False,
            metavar=metavar,
        ),
    ]


def _text(value: Value) -> str:
    if isinstance(value, tuple):
        return ",".join(_text(item) for item in value) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value) if value != "" else "none"


def beginning(
    config: DeviceConfig, physics: PhysicsConfig, flash: Flash, port: Port
) -> Iterator[str]:
    """Yield the start-up lines: the unit, its addresses, and the faults."""
    power, identity = config.power, config.identity
    world = physics.world
    sight = world if world in WORLDLESS else f"{world}, {physics.motion}, {physics.mount}"
    yield (
        f"virtual {identity.product}, firmware {identity.firmware}, work mode {flash.work_mode}, "
        f"clock 1/{config.crystal.clock_ratio:g}: {sight}"
    )
    yield (
        f"{port.name}, IMU after {power.imu_s * power.boot_scale:g} s, "
        f"points after {power.points_s * power.boot_scale:g} s"
    )
    usual = values_of(FaultConfig())
    faults = [
        f"{name} {value}"
        for name, value in values_of(config.faults).items()
        if value != usual[name]
    ]
    if faults:
        yield f"faults: {', '.join(faults)}"


def end(device: VirtualL2, server: Server) -> Iterator[str]:
    """Yield the final lines: what was sent and received, the latency, the faults."""
    seconds = max(device.now_ns - device.power_on_ns, 0) * 1e-9
    sent = ", ".join(f"{count} {kind.name}" for kind, count in sorted(device.sent.items()))
    heard = ", ".join(
        f"{count} {PacketType(kind).name}" for kind, count in sorted(device.received.items())
    )
    yield f"sent in {seconds:.1f} s: {sent or 'nothing'}; heard: {heard or 'nothing'}"
    if server.latency.count:
        late = ", ".join(f"{name} {ms:.2f} ms" for name, ms in server.latency.summary_ms().items())
        yield f"latency: {late}"
    counts = device.packet_log.counts
    if counts:
        happened = ", ".join(f"{count} {fault.name}" for fault, count in counts.items())
        yield f"faults that happened: {happened}"
    if server.unsent:
        yield f"{server.unsent} datagrams could not be sent"


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
            help="File for what the unit stores. If it exists, its addresses and work "
            "mode override the command line.",
            rich_help_panel="Unit",
        ),
    ] = None,
    speed: Annotated[
        str,
        typer.Option(
            metavar="FACTOR|max",
            help="Speed of the unit's time, or max: as fast as a receiver on this machine "
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
            help="Seconds after power-on at which to end. Default: never",
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
            help="With --truth: also write the exact points of every packet (1.6 MB a second).",
            rich_help_panel=_RUN,
        ),
    ] = False,
) -> None:
    """Emulate a Unitree L2: stream a moving sensor's data, obey commands, fail on request.

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
            "contradicts '--boot-scale'; give only one of them", param_hint="'--ready'"
        )
    if truth_points and truth is None:
        raise typer.BadParameter("needs '--truth' too", param_hint="'--truth-points'")
    if ready:
        settings["boot_scale"] = 0.0
    pace = _pace(speed)
    config = group(DeviceConfig, settings)
    physics = seen_from(config, group(PhysicsConfig, settings))
    stored = stored_settings(flash, config, serial is not None)
    if truth is not None:
        _make_folder(truth)  # or a run would end with the truth having nowhere to go
    with ExitStack() as stack:
        port = opened(stored, config, serial)
        stack.callback(port.close)
        ray_cast_worker = None
        if physics.world not in WORLDLESS:
            ray_cast_worker = stack.enter_context(
                RayCastWorker(physics, truth if truth_points else None)
            )
        device = unit(
            config,
            stored,
            ray_cast_worker,
            power_on_ns=time.time_ns() + _LEAD_NS,
            link=Link.ETHERNET if serial is None else Link.SERIAL,
            empty=physics.world == "none",
            remember=truth is not None,
        )
        server = Server(device, port, pace, lambda changed: _keep(flash, changed))
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: server.stop())
        _hurry()
        _say(*beginning(config, physics, stored, port))
        try:
            server.run(duration)
        finally:
            _say(*end(device, server))
            if truth is not None:
                values = {**values_of(physics), **values_of(config), "speed": speed}
                _write_truth(truth, device, server, ray_cast_worker, values)


def _pace(text: str) -> float:
    if text == "max":
        return MAX_SPEED
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not 0.01 <= speed <= 1000.0:
        raise typer.BadParameter(
            f"{text!r} is not a speed; expected 0.01 to 1000, or max", param_hint="'--speed'"
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
    folder: Path,
    device: VirtualL2,
    server: Server,
    ray_cast_worker: RayCastWorker | None,
    values: dict[str, Value],
) -> None:
    run = {
        "power_on_ns": device.power_on_ns,
        "latency_ms": server.latency.summary_ms(),
        "settings": values,
    }
    write_packet_log(folder, device.packet_log, run)
    if ray_cast_worker is not None:
        lasted_s = max(device.now_ns - device.power_on_ns, 0) * 1e-9
        ray_cast_worker.write_trajectory(folder, lasted_s, device.power_on_ns)
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
    except (PortError, RayCastError) as error:
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
