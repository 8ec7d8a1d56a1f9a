"""`l2lidar info`, `monitor` and `sync-check`: identity, health and clock of a unit."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import typer
from rich.live import Live
from rich.progress import track
from rich.table import Table

from l2lidar_node.cli.commands import work_mode_text
from l2lidar_node.cli.console import (
    JsonOption,
    as_data,
    facts,
    judgement,
    out,
    print_json,
    say,
    with_network,
)
from l2lidar_node.cli.device import Device, DeviceError
from l2lidar_node.clock import ClockEvent
from l2lidar_node.clock.lower_envelope import supporting_line
from l2lidar_node.config import NetworkConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.driver.health import metadata
from l2lidar_node.protocol.framing import Frame, Framer
from l2lidar_node.protocol.packets import ImuPacket, PointPacket, decode
from l2lidar_node.types import Check, HostNs, Level, Stream

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
    """Show what the unit is: versions, work mode, calibration, scan geometry, and its state.

    Of a file it says what is in it: from when, how long, how much, what was lost.
    """
    if file is not None:
        _describe(file, network.l2_ip, json_)
        return
    with Device(network) as device:
        if device.wait_for(lambda driver: driver.counters.frames.total() > 0, _WAIT_S) is None:
            raise DeviceError(f"no data from the L2; {device.advice()}")
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
    if isinstance(values, list) and all(isinstance(item, dict) for item in values):
        values = [item.get("name", item) for item in values]
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
        float, typer.Option(min=0.0, help="Seconds to monitor; until Ctrl-C if omitted.")
    ] = math.inf,
    json_: JsonOption = False,
) -> None:
    """Monitor the unit live: the checks of /diagnostics, one per line. Ctrl-C ends it.

    The exit code is 1 if any aspect was in error at the end. With --json one line per second.
    """
    with Device(network, enable_latency_measure=True) as device:
        judged: list[Check] = []
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


def _seconds(device: Device, duration: float) -> Iterator[list[Check]]:
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


_FEWEST: Final = 50
_HEAR_S: Final = 3.0


class _Collector:
    """A tap that keeps device stamps and arrivals."""

    def __init__(self) -> None:
        self.seen: dict[Stream, list[tuple[int, int]]] = {stream: [] for stream in Stream}
        self._framer = Framer()

    def received(self, data: bytes, arrival: HostNs) -> None:
        """Keep the stamps of measurements; points leave after their last slot is measured."""
        for item in self._framer.feed(data):
            packet = decode(item) if isinstance(item, Frame) else None
            if isinstance(packet, PointPacket):
                self.seen[Stream.POINTS].append((packet.stamp, arrival - packet.duration_ns))
            elif isinstance(packet, ImuPacket):
                self.seen[Stream.IMU].append((packet.stamp, arrival))

    def sent(self, frame: bytes, at: HostNs) -> None:
        """Ignore it."""

    def waited(self, until: HostNs) -> None:
        """Ignore it."""

    def stepped(self, by_ns: int, at: HostNs) -> None:
        """Ignore it."""

    def slewed(self, by_ns: int, at: HostNs) -> None:
        """Ignore it."""

    def close(self) -> None:
        """Do nothing."""


@with_network
def sync_check(
    network: NetworkConfig,
    duration: Annotated[float, typer.Option(min=2.0, max=3600.0, help="Seconds to measure.")] = 10,
    json_: JsonOption = False,
) -> None:
    """Measure the unit's clock: its ratio to this host's, jitter of the arrivals, round trip.

    The clock is left as it is. A ratio of 1.99866 means that the unit counts one second in
    1.99866 true ones; the driver finds it out by itself, this is to know the unit.
    """
    collector = _Collector()
    happened: Counter[str] = Counter()

    def count(event: Event) -> None:
        if isinstance(event, ClockEvent):
            happened[event.kind.value] += 1

    with Device(network, count, collector, enable_latency_measure=True) as device:
        if device.wait_for(_is_measuring, _HEAR_S) is None:
            raise DeviceError(f"no measurements from the L2; {device.advice()}")
        steps = range(round(duration * 10))
        for _ in steps if json_ else track(steps, "measuring", console=out, transient=True):
            device.wait_for(lambda driver: None, 0.1)
        status = device.ask(lambda driver: driver.clock_status())
        trips = device.ask(lambda driver: list(driver.round_trips))
        lost = device.ask(
            lambda driver: {
                stream.value: counts.lost for stream, counts in driver.counters.sequence.items()
            }
        )
    streams = {
        stream.value: judged(seen, status.ratio) | {"lost": lost[stream.value]}
        for stream, seen in collector.seen.items()
        if len(seen) >= _FEWEST
    }
    result: dict[str, Any] = {
        "ratio": status.ratio,
        "rate": 1.0 / status.ratio,
        "slow_by_s_per_hour": 3600.0 * (1.0 - 1.0 / status.ratio),
        "locked": status.locked,
        "streams": streams,
        "round_trip_ms": [trip / 1e6 for trip in trips],
        "events": dict(happened),
    }
    if json_:
        print_json(result)
    else:
        _show(result)
    if not status.locked:
        raise DeviceError(
            "no line fits the arrivals: the network or the device clock is too irregular"
        )


def _is_measuring(driver: Driver) -> bool:
    """Tell whether a stream has stamps: with the IMU off or in 2D mode there is only one."""
    return driver.counters.samples > 0 or driver.last_points is not None


def judged(seen: list[tuple[int, int]], ratio: float) -> dict[str, float]:
    """Return the statistics of one stream's stamps and arrivals.

    Parameters
    ----------
    seen : list
        Device stamp [ns] of each packet, and when it can have left at the latest [ns].
    ratio : float
        Of host to device time, about.

    Returns
    -------
    dict
        ``rate_hz`` by the stamps, since arrivals come in bunches; ``ratio`` of the line below all
        arrivals, since packets come late but never early; ``jitter_p50_us``, ``jitter_p99_us``
        and ``jitter_max_us`` above that line; ``interval_std_us`` of the stamps, in true time.
    """
    line = supporting_line(sorted(seen), ratio)
    late = [arrival - line.at(stamp) for stamp, arrival in seen] if line else [0]
    stamps = np.array([stamp for stamp, _ in seen], np.int64)
    p50, p99, most = np.percentile(np.array(late) - min(late), [50, 99, 100]) / 1e3
    return {
        "packets": len(seen),
        "rate_hz": float(
            (len(seen) - 1) * 1e9 / (max(int(stamps.max() - stamps.min()), 1) * ratio)
        ),
        "ratio": line.ratio if line else math.nan,
        "jitter_p50_us": float(p50),
        "jitter_p99_us": float(p99),
        "jitter_max_us": float(most),
        "interval_std_us": float(np.std(np.diff(stamps)) * ratio / 1e3),
    }


def _show(result: dict[str, Any]) -> None:
    say(
        f"clock ratio [bold]{result['ratio']:.6f}[/]: it runs at {result['rate']:.6f} of the true "
        f"rate and falls behind by {result['slow_by_s_per_hour']:.1f} s an hour"
    )
    table = Table(box=None, pad_edge=False)
    names = ("", "packets", "1/s", "ratio", "arrival jitter p50/p99/max [us]", "stamp jitter [us]")
    for name in (*names, "lost"):
        table.add_column(name)
    for name, found in result["streams"].items():
        jitter = "/".join(f"{found[f'jitter_{part}_us']:.0f}" for part in ("p50", "p99", "max"))
        table.add_row(
            name,
            str(found["packets"]),
            f"{found['rate_hz']:.2f}",
            f"{found['ratio']:.6f}",
            jitter,
            f"{found['interval_std_us']:.1f}",
            str(found["lost"]),
        )
    out.print(table)
    trips = result["round_trip_ms"]
    if trips:
        mean = sum(trips) / len(trips)
        say(f"round trip min {min(trips):.3f}, mean {mean:.3f}, max {max(trips):.3f} ms")
    for name, count in result["events"].items():
        if name != "locked":
            say(f"[yellow]{name}: {count} times")
