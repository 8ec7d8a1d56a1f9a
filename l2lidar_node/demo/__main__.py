"""The demo's command line: starts everything, watches, reports."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import rclpy
from rich.console import Console
from rich.table import Table

from l2lidar_node.demo.observer import Observer, TopicRecord
from l2lidar_node.demo.picture import save_cloud
from l2lidar_node.demo.processes import ProgramError, Programs, free_udp_ports, isolate_ros

_NOMINAL = {"point packets [1/s]": 215.6, "IMU packets [1/s]": 250.0}
_TOLERANCE = 0.02
_WARM_UP_S = 3.0
_START_TIMEOUT_S = 60.0


def main() -> int:
    """Run the demo; return 0 if every figure is as it should be."""
    options = _arguments()
    console = Console()
    isolate_ros()
    host_port, lidar_port = free_udp_ports(2)
    console.print(
        f"A virtual L2 in a {options.world} ({options.motion}) streams over UDP to the driver; "
        f"watching its topics for {options.duration:.0f} s ..."
    )
    rclpy.init()
    observer = Observer()
    try:
        with Programs() as programs:
            programs.start(
                "l2lidar_node.ros.driver_node",
                _driver_arguments(host_port, lidar_port),
            )
            programs.start(
                "l2lidar_node.emulator", _emulator_arguments(options, host_port, lidar_port)
            )
            _wait_for_data(observer, programs)
            end = time.monotonic() + options.duration
            while time.monotonic() < end:
                observer.watch(min(end, time.monotonic() + 1.0))
                programs.check()
                _tell(console, observer)
    except ProgramError as error:
        console.print(f"[red]{error}")
        return 1
    except KeyboardInterrupt:
        console.print("interrupted")
        return 130
    finally:
        observer.destroy_node()
        rclpy.try_shutdown()
    troubles = report(console, observer)
    if options.picture and observer.cloud is not None:
        save_cloud(
            observer.cloud, options.picture, f"one cloud of a virtual L2 in a {options.world}"
        )
        console.print(f"picture: {options.picture}")
    for trouble in troubles:
        console.print(f"[red]{trouble}")
    return 1 if troubles else 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="make demo", description=__doc__)
    parser.add_argument("--duration", type=float, default=15.0, help="seconds to watch (15)")
    parser.add_argument(
        "--world", default="room", help="room, corridor, yard or a mesh file (room)"
    )
    parser.add_argument(
        "--motion", default="walk", help="still, spin, walk, trot, drone or a TUM file (walk)"
    )
    parser.add_argument(
        "--picture", type=Path, default=Path("out/demo/cloud.png"), help="PNG to write"
    )
    options = parser.parse_args()
    if not 3 <= options.duration <= 3600:
        parser.error(f"--duration: {options.duration} is out of range, expected 3 to 3600 s")
    return options


def _driver_arguments(host_port: int, lidar_port: int) -> list[str]:
    values = {
        "l2_ip": "127.0.0.1",
        "l2_port": lidar_port,
        "host_ip": "127.0.0.1",
        "host_port": host_port,
        "enable_IMU_publishing": "true",
        "enable_latency_measure": "true",
        "imu_adjust": "false",
        "sweep_cut": "turn",
    }
    return [
        "--ros-args",
        *[part for name, value in values.items() for part in ("-p", f"{name}:={value}")],
    ]


def _emulator_arguments(options: argparse.Namespace, host_port: int, lidar_port: int) -> list[str]:
    return [
        "--world", options.world,
        "--motion", options.motion,
        "--host-port", str(host_port),
        "--lidar-port", str(lidar_port),
        "--boot-scale", "0.05",
    ]  # fmt: skip


def _wait_for_data(observer: Observer, programs: Programs) -> None:
    """Watch until clouds come, then forget what start-up looked like."""
    deadline = time.monotonic() + _START_TIMEOUT_S
    while not observer.clouds.stamps:
        observer.watch(time.monotonic() + 0.2)
        programs.check()
        if time.monotonic() > deadline:
            raise ProgramError(f"no cloud within {_START_TIMEOUT_S:.0f} s")
    observer.watch(time.monotonic() + _WARM_UP_S)
    observer.clouds, observer.imu = TopicRecord(), TopicRecord()
    observer.points.clear()
    observer.diagnostics.clear()


def _tell(console: Console, observer: Observer) -> None:
    if not observer.diagnostics:
        return
    device, clock = (
        observer.diagnostics[-1].get("device", {}),
        observer.diagnostics[-1].get("clock", {}),
    )
    console.print(
        f"  {device.get('point packets [1/s]')} point packets/s, "
        f"{device.get('IMU packets [1/s]')} IMU packets/s, {len(observer.clouds.stamps)} clouds; "
        f"clock: {clock.get('message')}, ratio {clock.get('ratio')}"
    )


def report(console: Console, observer: Observer) -> list[str]:
    """Print what was seen and return what is wrong with it."""
    table = Table("topic", "rate [1/s]", "frame", "stamps", "age p50 / p99 [ms]")
    for name, record in (("/points", observer.clouds), ("/imu/data", observer.imu)):
        ages = np.percentile(record.ages_s, [50, 99]) * 1e3 if record.ages_s else [np.nan, np.nan]
        steps = record.backward_steps
        table.add_row(
            name,
            f"{record.rate_hz:.2f}",
            record.frame,
            "ascending" if not steps else f"{steps} steps back",
            f"{ages[0]:.1f} / {ages[1]:.1f}",
        )
    console.print(table)
    troubles = _troubles(observer)
    if observer.points:
        console.print(
            f"{np.mean(observer.points):.0f} points per cloud, fields "
            f"{', '.join(observer.fields)}; /tf_static: "
            f"{', '.join(f'{parent} -> {child}' for parent, child in observer.transforms)}"
        )
    if observer.imu.stamps:
        spacing = observer.imu.intervals_ms
        console.print(
            f"IMU stamps {spacing.mean():.4f} ms apart, standard deviation {spacing.std():.4f} ms"
        )
    if observer.diagnostics:
        link = observer.diagnostics[-1].get("link", {})
        console.print(f"lost packets: {_lost(link)}")
    return troubles


def _troubles(observer: Observer) -> list[str]:
    troubles = []
    for name, record in (("/points", observer.clouds), ("/imu/data", observer.imu)):
        if not record.stamps:
            troubles.append(f"{name}: nothing received")
        elif record.backward_steps:
            troubles.append(f"{name}: stamps step back")
    if not observer.diagnostics:
        return [*troubles, "/diagnostics: nothing received"]
    for name, nominal in _NOMINAL.items():
        rates = [
            float(entry["device"][name]) for entry in observer.diagnostics if "device" in entry
        ]
        if abs(np.mean(rates) - nominal) > _TOLERANCE * nominal:
            troubles.append(f"{name} is {np.mean(rates):.1f}, expected {nominal}")
    lost = _lost(observer.diagnostics[-1].get("link", {}))
    if lost:
        troubles.append(f"{lost} packets lost")
    return troubles


def _lost(link: dict[str, str]) -> int:
    return sum(int(link.get(f"{stream} lost", 0)) for stream in ("points", "imu"))


if __name__ == "__main__":
    sys.exit(main())
