"""`l2lidar sync-check`: how fast a unit's clock runs and how evenly its packets arrive."""

from __future__ import annotations

import math
from collections import Counter
from typing import Annotated, Any, Final

import numpy as np
import typer
from rich.progress import track
from rich.table import Table

from l2lidar_node.cli.console import JsonOption, out, print_json, say, with_network
from l2lidar_node.cli.device import Device, DeviceError
from l2lidar_node.clock import ClockEvent
from l2lidar_node.clock.lower_envelope import supporting_line
from l2lidar_node.config import NetworkConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.protocol.framing import Frame, Framer
from l2lidar_node.protocol.packets import ImuPacket, PointPacket, decode
from l2lidar_node.types import HostNs, Stream

_FEWEST: Final = 50
_HEAR_S: Final = 3.0


class _Collector:
    """A tap that keeps device stamps and arrivals."""

    def __init__(self) -> None:
        self.seen: dict[Stream, list[tuple[int, int]]] = {stream: [] for stream in Stream}
        self._framer = Framer()

    def received(self, data: bytes, arrival: HostNs) -> None:
        """Keep the stamps of what is measured; points leave when their last slot is measured."""
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
            raise DeviceError(f"no measurements come from the L2; {device.advice()}")
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
        raise DeviceError("no line fits the arrivals: network or device clock are too irregular")


def _is_measuring(driver: Driver) -> bool:
    """Tell whether a stream has stamps: with the IMU off or in 2D mode there is only one."""
    return driver.counters.samples > 0 or driver.last_points is not None


def judged(seen: list[tuple[int, int]], ratio: float) -> dict[str, float]:
    """Return what stamps and arrivals of one stream say.

    Parameters
    ----------
    seen : list
        Device stamp [ns] of each packet, and when it can have left at the latest [ns].
    ratio : float
        Of host to device time, about.

    Returns
    -------
    dict
        ``rate_hz``; ``ratio`` of the line below all arrivals, since packets come late but never
        early; ``jitter_p50_us``, ``jitter_p99_us`` and ``jitter_max_us`` above that line;
        ``interval_std_us`` of the stamps, in true time.
    """
    line = supporting_line(sorted(seen), ratio)
    late = [arrival - line.at(stamp) for stamp, arrival in seen] if line else [0]
    stamps, arrivals = np.array(seen, np.int64).T
    p50, p99, most = np.percentile(np.array(late) - min(late), [50, 99, 100]) / 1e3
    return {
        "packets": len(seen),
        "rate_hz": float((len(seen) - 1) * 1e9 / (arrivals[-1] - arrivals[0])),
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
