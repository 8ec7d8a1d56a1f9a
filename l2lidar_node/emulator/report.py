"""Says in a few lines what a virtual L2 is and what became of it."""

from __future__ import annotations

from collections.abc import Iterator

from l2lidar_node.emulator.assembly import WORLDLESS
from l2lidar_node.emulator.config import DeviceConfig, FaultConfig
from l2lidar_node.emulator.link.port import Port
from l2lidar_node.emulator.physics import PhysicsConfig
from l2lidar_node.emulator.server import Server
from l2lidar_node.emulator.unit.device import VirtualL2
from l2lidar_node.emulator.unit.flash import Flash
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.settings import values_of


def beginning(
    config: DeviceConfig, physics: PhysicsConfig, flash: Flash, port: Port
) -> Iterator[str]:
    """Yield the lines for the start: what is emulated, where it sends and what will go wrong."""
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
    """Yield the lines for the end: what was sent and heard, how punctually, what went wrong."""
    seconds = max(device.now_ns - device.power_on_ns, 0) * 1e-9
    sent = ", ".join(f"{count} {kind.name}" for kind, count in sorted(device.sent.items()))
    heard = ", ".join(
        f"{count} {PacketType(kind).name}" for kind, count in sorted(device.received.items())
    )
    yield f"sent in {seconds:.1f} s: {sent or 'nothing'}; heard: {heard or 'nothing'}"
    late = server.lateness
    if late.count:
        p50, p99 = late.quantile_ns(0.5) * 1e-6, late.quantile_ns(0.99) * 1e-6
        yield f"lateness: p50 {p50:.2f} ms, p99 {p99:.2f} ms, max {late.max_ns * 1e-6:.2f} ms"
    counts = device.ledger.counts
    if counts:
        happened = ", ".join(f"{count} {fault.name}" for fault, count in counts.items())
        yield f"faults that happened: {happened}"
    if server.unsent:
        yield f"{server.unsent} datagrams found no way out"
