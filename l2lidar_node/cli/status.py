"""`l2lidar info` and `l2lidar monitor`: what the unit is, and how it is doing."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.live import Live
from rich.table import Table

from l2lidar_node.cli.console import (
    JsonOption,
    as_data,
    facts,
    judgement,
    out,
    print_json,
    with_network,
)
from l2lidar_node.cli.device import Device, DeviceError
from l2lidar_node.cli.stored import work_mode_text
from l2lidar_node.config import NetworkConfig
from l2lidar_node.driver import health
from l2lidar_node.driver.driver import Driver
from l2lidar_node.driver.metadata import metadata
from l2lidar_node.types import Level

_WAIT_S = 3.0
_PERIOD_S = 1.0  # that is judged at a time


@with_network
def info(
    network: NetworkConfig,
    file: Annotated[
        Path | None,
        typer.Argument(
            help="A file to describe instead of a unit: capture, MCAP file, rosbag2 folder, "
            "calibration.",
            show_default=False,
        ),
    ] = None,
    json_: JsonOption = False,
) -> None:
    """Say what the unit is: versions, work mode, calibration, scan geometry, and its state.

    Of a file it says what is in it: from when, how long, how much, what was lost.
    """
    if file is not None:
        _describe(file, network.l2_ip, json_)
        return
    with Device(network) as device:
        if device.wait_for(lambda driver: driver.counters.frames.total() > 0, _WAIT_S) is None:
            raise DeviceError(f"nothing heard from the L2; {device.advice()}")
        device.wait_for(_is_known, _WAIT_S)
        before = device.period()
        time.sleep(_PERIOD_S)
        checks, _ = device.checks(before)
        about: dict[str, Any] = dataclasses.asdict(device.ask(metadata))
    if json_:
        print_json({**about, "health": as_data(checks)})
        return
    calibration = about.pop("calibration")
    for name in list(about):
        if name.startswith("calibration_"):
            del about[name]  # of use where a driver runs
    del about["work_mode_names"]
    mode = about["work_mode"]
    about["work_mode"] = None if mode is None else work_mode_text(mode)
    for name, value in about.items():
        about[name] = "not known" if value in ("", None) else _text(value)
    out.print(facts("Unit", about))
    if calibration:
        named = {name: _text(value) for name, value in calibration.items()}
        out.print(facts("\nCalibration", named))
    out.print()
    out.print(judgement(checks))


def _describe(file: Path, l2_ip: str, json_: bool) -> None:
    from l2lidar_node.cli import recorded

    about = recorded.describe(file, l2_ip)
    if json_:
        print_json(about)
        return
    topics = about.pop("topics", None)
    title = str(about.pop("kind")).capitalize()
    flat = dict(_flat(about.pop("content", None) or about))
    if "bytes" in flat:
        flat["size"] = f"{flat.pop('bytes') / 1e6:.1f} MB"
    shown = {
        name.replace("_", " "): "not known" if value in ("", None) else _text(value)
        for name, value in flat.items()
    }
    out.print(facts(title, shown))
    if topics is not None:
        table = Table(box=None, pad_edge=False)
        for heading in ("\nTopic", "\ntype", "\nmessages", "\nper s", "\nQoS"):
            table.add_column(heading, overflow="fold")
        for topic in topics:
            rate = "" if topic["rate"] is None else f"{topic['rate']:g}"
            qos = "; ".join(topic["qos"])
            table.add_row(topic["name"], topic["type"], str(topic["messages"]), rate, qos)
        out.print(table)


def _flat(values: object, above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the leaves of nested mappings, each named by its path."""
    if not isinstance(values, dict):
        yield above or "content", values
        return
    for name, value in values.items():
        if value != {}:
            yield from _flat(value, f"{above} {name}".strip())


@with_network
def monitor(
    network: NetworkConfig,
    duration: Annotated[
        float, typer.Option(min=0.0, help="Seconds to watch; for ever if left out.")
    ] = math.inf,
    json_: JsonOption = False,
) -> None:
    """Watch the unit live: one line per aspect, as on /diagnostics. Ctrl-C ends it.

    The exit code is 1 if any aspect was in error at the end. With --json one line per second.
    """
    with Device(network, enable_latency_measure=True) as device:
        judged: list[health.Check] = []
        try:
            with Live(console=out, auto_refresh=False, transient=False) as live:
                for judged in _seconds(device, duration):
                    if json_:
                        typer.echo(json.dumps(as_data(judged)))
                    else:
                        live.update(judgement(judged), refresh=True)
        except KeyboardInterrupt:
            pass
    if any(check.level is Level.ERROR for check in judged):
        raise typer.Exit(1)


def _seconds(device: Device, duration: float) -> Iterator[list[health.Check]]:
    before = device.period()
    while duration > 0.0:
        time.sleep(min(_PERIOD_S, duration))
        duration -= _PERIOD_S
        checks, before = device.checks(before)
        yield checks


def _is_known(driver: Driver) -> bool:
    is_answered = driver.version is not None and driver.parameters is not None
    return is_answered and driver.last_points is not None


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.9g}"
    if isinstance(value, tuple | list):
        return ", ".join(_text(item) for item in value)
    return str(value)
