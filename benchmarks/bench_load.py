"""Measures what the driver costs: packets per CPU second, and the node's share of a core.

``make bench-load`` prints the table and writes ``out/bench/load.json``.
"""

from __future__ import annotations

import argparse
import socket
import statistics
import struct
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import rclpy

from benchmarks import load_chain, load_scale
from benchmarks.results import (
    Relative,
    Target,
    at_least,
    at_most,
    checksums_per_cpu_s,
    packets_per_cpu_s,
    publish,
    relative,
)
from benchmarks.vendor_client import VendorClient, build as build_client
from l2lidar_node.config import DriverConfig
from l2lidar_node.demo.observer import Observer
from l2lidar_node.demo.processes import Programs, assigned, free_udp_ports, isolate_ros
from l2lidar_node.driver.driver import Driver
from l2lidar_node.driver.geometry import Projector
from l2lidar_node.emulator.config import DeviceConfig, IdentityConfig, PowerConfig
from l2lidar_node.emulator.unit.device import VirtualL2
from l2lidar_node.emulator.unit.stream import PatternScanner, StillInertial
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.framing import Frame, Framer
from l2lidar_node.protocol.packets import PointPacket, decode
from l2lidar_node.settings import build
from l2lidar_node.transport.udp import UdpTransport
from l2lidar_node.types import HostNs
from tests.support.cpu import process_cpu_s, resident_mb

FULL_TURN = 50
_SOCKET_RUNS = 4
_LENGTH_RUNS = 4
_VENDOR_CLIENT = 29_000 / 1_260_000
"""Packets that the vendor's client takes from a socket in the time of one CRC-32 by zlib.

Both per CPU second on one core of an AMD EPYC: the client over loopback (socket, byte parser, CRC,
parse), and zlib's checksum of as many packets. Only an estimate for other processors:
``--vendor-sdk`` measures it.
"""
_SYNTHETIC_PACKETS = 5_000
_SENT_AT_ONCE = 80  # datagrams, which fit in the receive buffer that the kernel grants by default
_WARM_UP_SWEEPS = 10
_STAMP = struct.Struct("<II")
_CLOCK_RATIO = 1.99866  # of the virtual L2
Row = Callable[..., None]
_EPOCH_NS = 1_700_000_000 * 10**9


def decode_rate(rounds: int) -> float:
    """Return packets per CPU second of framing, CRC, decoding and geometry, full turns."""
    payloads, _ = PatternScanner().packets(0, _SYNTHETIC_PACKETS)
    datagrams = [wire.encode_frame(wire.PacketType.POINTS_3D, item.tobytes()) for item in payloads]
    starts = np.arange(FULL_TURN, dtype=np.float64) * wire.MIRROR_PERIOD_S
    rates = []
    for _ in range(rounds):
        framer, projector = Framer(), Projector(wire.PacketType.POINTS_3D)
        begin = time.process_time()
        batch: list[bytes] = []
        for datagram in datagrams:
            for event in framer.feed(datagram):
                if isinstance(event, Frame):
                    packet = decode(event)
                    if isinstance(packet, PointPacket):
                        batch.append(packet.payload)
            if len(batch) == FULL_TURN:
                projector.points(batch, starts)
                batch.clear()
        rates.append(len(datagrams) / (time.process_time() - begin))
    return statistics.median(rates)


def socket_rate(seconds: float, with_imu: bool) -> dict[str, float]:
    """Return what it costs to make full-turn sweeps of packets from a socket."""
    host_port, lidar_port = ports = free_udp_ports(2)
    values = {
        "l2_ip": "127.0.0.1", "l2_port": lidar_port,
        "host_ip": "127.0.0.1", "host_port": host_port, "receive_interval_ms": 0,
        "imu_adjust": False, "sweep_cut": "turn", "enable_l2_host_sync": False,
    }  # fmt: skip
    config = build(DriverConfig, values)
    driver, transport = Driver(config), UdpTransport(config.network)
    driver.host_stepped(0, HostNs(_EPOCH_NS))  # steps will be told, as the node's session does

    def take(datagrams: Sequence[bytes]) -> float | None:
        arrivals = iter([_arrival_at_real_time(data) for data in datagrams])
        begin = time.process_time()
        _take(driver, transport, arrivals, len(datagrams))
        is_warm = driver.counters.sweeps > _WARM_UP_SWEEPS
        return time.process_time() - begin if is_warm else None

    rate = _packets_per_cpu_s(seconds, with_imu, ports, take)
    transport.close()
    lost = sum(counts.lost for counts in driver.counters.sequence.values())
    return {"rate": rate, "speed": rate * wire.MIRROR_PERIOD_S, "lost": lost}


def vendor_rate(seconds: float, program: Path) -> float:
    """Return how many packets per CPU second the vendor's client makes into full-turn clouds."""
    host_port, lidar_port = ports = free_udp_ports(2)
    with closing(VendorClient(program, host_port, lidar_port, FULL_TURN)) as client:

        def take(datagrams: Sequence[bytes]) -> float | None:
            spent = client.take(datagrams)
            is_warm = client.points > _WARM_UP_SWEEPS * FULL_TURN * wire.POINTS_PER_3D_PACKET
            return spent if is_warm else None

        return _packets_per_cpu_s(seconds, False, ports, take)


def _packets_per_cpu_s(
    seconds: float,
    with_imu: bool,
    ports: Sequence[int],
    take: Callable[[Sequence[bytes]], float | None],
) -> float:
    """Return at which rate a reader takes packets of points from a socket.

    A virtual L2's datagrams are put into the socket some at a time and then read, so that the
    reader never waits for its sender. Only the CPU time of reading counts, which ``take`` returns;
    None while it warms up.
    """
    host_port, lidar_port = ports
    mode = 0 if with_imu else int(wire.WorkMode.IMU_OFF)
    unit = DeviceConfig(power=PowerConfig(boot_scale=0.0), identity=IdentityConfig(work_mode=mode))
    device = VirtualL2(unit, PatternScanner(), StillInertial(), power_on_ns=_EPOCH_NS)
    now, spent, end = _EPOCH_NS, 0.0, time.monotonic() + seconds
    packets, size = 0, wire.FRAME_SIZES[wire.PacketType.POINTS_3D]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", lidar_port))
        while time.monotonic() < end:
            now += 1_000_000_000
            datagrams = [data for _, data in device.advance(now)]
            for first in range(0, len(datagrams), _SENT_AT_ONCE):
                some = datagrams[first : first + _SENT_AT_ONCE]
                for data in some:
                    sender.sendto(data, ("127.0.0.1", host_port))
                seconds_taken = take(some)
                if seconds_taken is not None:
                    spent += seconds_taken
                    packets += sum(len(data) == size for data in some)
    return packets / spent


def _take(driver: Driver, transport: UdpTransport, arrivals: Iterator[HostNs], count: int) -> None:
    """Handle so many datagrams."""
    arrival = HostNs(0)
    while count:
        batch = transport.receive(1.0)
        if not batch:
            raise RuntimeError(f"{count} datagrams were lost on the way")
        count -= len(batch)
        for (data, _), arrival in zip(batch, arrivals, strict=False):
            driver.receive(data, arrival)
    driver.tick(arrival)


def _arrival_at_real_time(data: bytes) -> HostNs:
    """Return when a datagram would have come at the real rate: the clock has its usual work."""
    seconds, nanoseconds = _STAMP.unpack_from(data, wire.HEADER.size + 8)
    return HostNs(_EPOCH_NS + round((seconds * 10**9 + nanoseconds) * _CLOCK_RATIO))


def node_share(seconds: float) -> dict[str, float]:
    """Return the driver node's CPU share at the real rate, with one subscriber of both topics."""
    isolate_ros()
    host_port, lidar_port = free_udp_ports(2)
    parameters = {
        "l2_ip": "127.0.0.1", "l2_port": lidar_port,
        "host_ip": "127.0.0.1", "host_port": host_port,
        "enable_IMU_publishing": "true",
    }  # fmt: skip
    rclpy.init()
    observer = Observer()
    try:
        with Programs() as programs:
            node = programs.start("l2lidar_node.ros.driver_node", assigned(parameters))
            programs.start(
                "l2lidar_node.emulator",
                ["--ready", "--world", "pattern",
                 "--host-port", str(host_port), "--lidar-port", str(lidar_port)],
            )  # fmt: skip
            while not observer.clouds.stamps:
                observer.watch(time.monotonic() + 0.5)
                programs.check()
            observer.watch(time.monotonic() + 2.0)
            seen = len(observer.clouds.stamps), len(observer.imu.stamps)
            cpu, wall = process_cpu_s(node.pid), time.monotonic()
            observer.watch(wall + seconds)
            share = (process_cpu_s(node.pid) - cpu) / (time.monotonic() - wall)
            clouds = (len(observer.clouds.stamps) - seen[0]) / seconds
            imu = (len(observer.imu.stamps) - seen[1]) / seconds
            memory = resident_mb(node.pid)
    finally:
        observer.destroy_node()
        rclpy.try_shutdown()
    return {"share": share, "clouds": clouds, "imu": imu, "memory": memory}


def main() -> int:
    """Run the measurements; return 0 whatever they found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="length of each measurement")
    parser.add_argument("--chain-seconds", type=float, default=0.0, help="of the whole chain")
    parser.add_argument("--world", default="pattern", help="what the chain sees")
    parser.add_argument(
        "--vendor-sdk", type=Path, metavar="DIR", help="checkout of unilidar_sdk2: run its client"
    )
    options = parser.parse_args()
    seconds: float = options.seconds
    program: Path | None = None
    if options.vendor_sdk is not None:
        try:
            program = build_client(options.vendor_sdk)
        except FileNotFoundError as error:
            parser.error(str(error))
    rows: list[dict[str, Any]] = []

    def row(what: str, value: float, unit: str, remark: str = "") -> None:
        rows.append({"what": what, "value": round(value, 4), "unit": unit, "remark": remark})

    pure = relative(lambda: decode_rate(1), 5)
    row(
        "framing + CRC + decode + geometry, full turns", pure.rate, "packets per CPU s",
        _in_reference(pure, "reference load"),
    )  # fmt: skip
    runs: list[dict[str, float]] = []

    def points_rate() -> float:
        runs.append(socket_rate(seconds / _SOCKET_RUNS, with_imu=False))
        return runs[-1]["rate"]

    if program is None:
        points = relative(points_rate, _SOCKET_RUNS, checksums_per_cpu_s)
        in_vendors = points.ratio / _VENDOR_CLIENT
        remark = f"{_in_reference(points, 'rate of CRC-32 alone')}, by which the vendor's is told"
    else:
        points = relative(
            points_rate, _SOCKET_RUNS, lambda: vendor_rate(seconds / _SOCKET_RUNS, program)
        )
        in_vendors = points.ratio
        remark = _in_reference(points, "rate of the vendor's client")
    row(
        "socket to sweep, points only", points.rate, "packets per CPU s",
        f"{remark}; {runs[-1]['speed']:.0f} x real time, "
        f"{sum(run['lost'] for run in runs):.0f} lost",
    )  # fmt: skip
    mixed = socket_rate(seconds, with_imu=True)
    row(
        "socket to sweep, points with their share of IMU", mixed["rate"],
        "point packets per CPU s",
        f"{mixed['speed']:.0f} x real time, {mixed['lost']:.0f} lost",
    )  # fmt: skip
    node = node_share(seconds)
    row(
        "driver node, one subscriber", 100 * node["share"], "% of a core",
        f"{node['clouds']:.2f} clouds/s, {node['imu']:.1f} IMU samples/s received",
    )  # fmt: skip
    row("driver node, memory", node["memory"], "MB")
    alone = load_chain.measure_node(seconds)
    p50, p99 = np.percentile(alone.latencies_ms, (50, 99))
    row(
        "driver alone: last packet sent -> cloud received, p50", p50, "ms",
        f"p99 {p99:.2f} ms, max {alone.latencies_ms.max():.2f} ms, {len(alone.latencies_ms)} "
        f"clouds; {100 * alone.share:.1f} % of a core; sender up to {alone.latest_ms:.1f} ms late",
    )  # fmt: skip
    targets: list[Target] = [
        at_least("framing + CRC + decode + geometry [packets per CPU s]", pure.rate, 60_000),
        at_least("socket to sweep, in the vendor client's", in_vendors, 1.1),
        at_most("driver node [% of a core]", 100 * node["share"], 5.0),
        at_most("driver alone: publish latency p99 [ms]", float(p99), 5.0),
    ]
    targets += _chain_rows(row, options.chain_seconds or seconds, options.world)
    targets += _scale_rows(row, min(seconds, 4.0))
    publish("load", "What the driver costs", rows, targets)
    return 0


def _in_reference(found: Relative, load: str) -> str:
    return f"{found.ratio:.4f} of the {load} ({found.low:.4f} to {found.high:.4f})"


def _chain_rows(row: Row, seconds: float, world: str) -> list[Target]:
    cost = load_chain.measure_chain(seconds, world)
    for name, share in cost.shares.items():
        row(f"chain: {name}", 100 * share, "% of a core", f"{cost.memory_mb[name]:.0f} MB")
    for topic, values in cost.latencies_ms.items():
        if not len(values):
            continue
        p50, p99 = np.percentile(values, (50, 99))
        row(
            f"chain: last packet sent -> {topic} received, p50", p50, "ms",
            f"p99 {p99:.2f} ms, max {values.max():.2f} ms, {len(values)} messages",
        )  # fmt: skip
    clouds = cost.latencies_ms["/points"]
    return [
        at_most("chain: publish latency p99 [ms]", float(np.percentile(clouds, 99)), 5.0),
        at_most("chain: clouds missing", cost.missing, 0),
    ]


def _scale_rows(row: Row, seconds: float) -> list[Target]:
    targets: list[Target] = []
    before = packets_per_cpu_s()
    (lengths,) = load_scale.by_length(25.0)
    rate = (before + packets_per_cpu_s()) / 2.0
    for length, found in lengths.items():
        row(
            f"datagram to sweep, {length} packets a sweep", found, "packets per CPU s",
            f"{found / rate:.4f} of the reference load",
        )  # fmt: skip
    runs = load_scale.by_length(25.0, (200, 4000), _LENGTH_RUNS)
    dearer = [run[200] / run[4000] for run in runs]
    row(
        "a packet in a sweep of 4000, in those of one of 200", statistics.median(dearer), "",
        f"{min(dearer):.3f} to {max(dearer):.3f} in {len(dearer)} runs",
    )  # fmt: skip
    targets.append(
        at_most("a packet in a sweep of 4000, in those of one of 200, worst", max(dearer), 1.25)
    )
    for sensors, processes in load_scale.CROWDS:
        got = load_scale.crowd(sensors, processes, 1.0, seconds)
        row(f"{sensors} sensors, {processes} processes", got["cpu"], "cores", _crowd_remark(got))
        if (sensors, processes) == (8, 1):
            targets.append(at_most("8 sensors in one process: lost", _gone(got), 0))
    for rate in load_scale.RATES:
        got = load_scale.crowd(1, 1, rate, seconds)
        sent = "" if got["rate"] > 0.98 * rate else f", sent at {got['rate']:.0f} x"
        row(f"one sensor, {rate} x the packets{sent}", got["cpu"], "cores", _crowd_remark(got))
        targets.append(at_most(f"{rate} x: lost without being counted", got["unsaid"], 0))
        if rate == 5:
            targets.append(at_most("5 x: lost", _gone(got), 0))
    return targets


def _gone(got: dict[str, Any]) -> int:
    return int(got["sent"] - got["received"])


def _crowd_remark(got: dict[str, Any]) -> str:
    remark = (
        f"{got['received']} of {got['sent']} packets, {got['kernel_drops']} dropped by the kernel "
        f"and counted, {got['sweeps']} sweeps; sender up to {got['latest_ms']:.0f} ms late"
    )
    return "; ".join((remark, *(f"it says: {text}" for text in got["complaints"])))


if __name__ == "__main__":
    sys.exit(main())
