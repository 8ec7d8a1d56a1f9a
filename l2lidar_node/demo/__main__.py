"""The demo's command line: starts everything, watches, reports."""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, NamedTuple

import rclpy
import typer
from rclpy.signals import SignalHandlerOptions
from rich.console import Console

from l2lidar_node.command_line import CommandError, UsageError, for_typer
from l2lidar_node.demo import machine, mapping
from l2lidar_node.demo.observer import Observer, TopicRecord, TopicRecorder
from l2lidar_node.demo.processes import (
    ProgramError,
    Programs,
    assigned,
    free_udp_ports,
    isolate_ros,
)
from l2lidar_node.demo.report import as_message, mount as example_mount, report
from l2lidar_node.programs import INTERRUPTED, interruptible

_WARM_UP_S = 3.0
_WATCHING_S = 20.0
_WORLD = "room"
_START_TIMEOUT_S = 180.0  # on a slow machine
_BOOT_SCALE = 0.05  # a real unit takes 25 s


def demo(
    duration: Annotated[
        float | None,
        typer.Option(
            min=3.0,
            max=3600.0,
            metavar="S",
            help=f"Seconds to watch; by default {_WATCHING_S:.0f}, with --slam "
            f"{mapping.MAPPING_S:.0f}.",
        ),
    ] = None,
    world: Annotated[
        str | None,
        typer.Option(
            help="Scene of the virtual L2, or a mesh file; l2lidar_emulator --help. By default "
            f"{_WORLD}, with --slam {mapping.WORLD}."
        ),
    ] = None,
    motion: Annotated[
        str, typer.Option(help="still, spin, shake, walk, trot, drone, or a TUM file.")
    ] = "walk",
    unit: Annotated[
        str,
        typer.Option(
            help="Virtual unit: perfect matches its reported calibration, typical and poor do "
            "not; a number selects one of many."
        ),
    ] = "typical",
    forward: Annotated[
        bool,
        typer.Option(
            "--forward",
            help="Mount the sensor on the front of the example robot; show the cloud in "
            "base_link.",
        ),
    ] = False,
    driver_only: Annotated[
        bool, typer.Option("--driver-only", help="Run without deskew and odometry.")
    ] = False,
    slam: Annotated[
        bool,
        typer.Option(
            "--slam",
            help="Build a map with loop closure, save it, and localize in it. 3 minutes.",
        ),
    ] = False,
    folder: Annotated[Path, typer.Option(help="Folder for pictures and truth.")] = Path(
        "out/demo"
    ),
    record: Annotated[
        Path | None, typer.Option(help="Bag to write: FILE.mcap, or a folder for rosbag2.")
    ] = None,
) -> None:
    """Show everything with a virtual L2: it streams over UDP into driver, deskew and odometry.

    The exit code is 1 if a figure is not as it should be, 75 if one is not but this machine did
    not keep up, so that the result is inconclusive.
    """
    if slam and driver_only:
        raise UsageError("--slam needs the odometry: omit --driver-only")
    options = _Options(
        duration or (mapping.MAPPING_S if slam else _WATCHING_S),
        world or (mapping.WORLD if slam else _WORLD),
        motion,
        unit,
        forward,
        driver_only,
        slam,
        folder,
        record,
    )
    code = _run(options)
    if code:
        raise typer.Exit(code)


class _Options(NamedTuple):
    """Options of the demo."""

    duration: float
    world: str
    motion: str
    unit: str
    forward: bool
    driver_only: bool
    slam: bool
    folder: Path
    record: Path | None


def main() -> int:
    """Run the demo by itself, as ``make demo`` does; return the exit code."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(for_typer(demo))
    try:
        app(prog_name="make demo")
    except CommandError as error:
        print(f"make demo: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def _run(options: _Options) -> int:
    """Return 0 if every figure is as it should be."""
    console = Console()
    began_ns = time.time_ns()
    failure = ""
    times: dict[str, machine.ProcessorTime] = {}
    isolate_ros()
    chain = "driver" if options.driver_only else "driver, deskew and odometry"
    if options.slam:
        chain = "driver, deskew, odometry and SLAM"
    console.print(
        f"A virtual L2 ({options.unit} unit) in a {options.world} ({options.motion}) streams over "
        f"UDP to {chain}; watching the topics for {options.duration:.0f} s ..."
    )
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C interrupts this one
    observer = Observer()
    mount = example_mount("forward") if options.forward else None
    if mount is not None:
        observer.publish_static(as_message(mount))
    try:
        with ExitStack() as stack:
            if options.record is not None:
                recorder = stack.enter_context(TopicRecorder(observer, options.record))
            programs = stack.enter_context(Programs())
            if options.slam:
                run = mapping.MappingRun(console, observer, programs, options.folder)
            _start(programs, options)
            _wait_for_data(observer, programs)
            if options.slam:
                run.watch(options.duration, _tell)
                run.save()
                run.start_again()
            else:
                _watch(console, observer, programs, options.duration)
            times = programs.processor_times()
    except (ProgramError, OSError) as error:
        failure = str(error)
    except KeyboardInterrupt:
        console.print("interrupted")
        return INTERRUPTED
    finally:
        observer.destroy_node()
        rclpy.try_shutdown()
    if options.record is not None and not failure:
        console.print(f"{recorder.messages} messages recorded in {options.record}")
    troubles = [failure]
    if not failure:
        troubles = report(
            console, observer, options.folder, with_odometry=not options.driver_only, mount=mount
        )
        troubles += run.report() if options.slam else []
    behind = machine.shortfall_since(began_ns, options.folder / "truth", times)
    code, said = machine.verdict(troubles, behind)
    for line in said:
        console.print(f"[red]{line}" if code else line)
    return code


def _start(programs: Programs, options: _Options) -> None:
    host_port, lidar_port = free_udp_ports(2)
    driver = {
        "l2_ip": "127.0.0.1",
        "l2_port": lidar_port,
        "host_ip": "127.0.0.1",
        "host_port": host_port,
        "enable_IMU_publishing": "true",
        "enable_latency_measure": "true",
        "imu_adjust": "false",
        "sweep_cut": "turn",
        "watchdog_action": "wait",  # until the world is there
    }
    programs.start("l2lidar_node.ros.driver_node", assigned(driver))
    if options.slam:  # one process for both is lighter
        programs.start("l2lidar_proc.ros.companion_node", [])
    elif not options.driver_only:
        programs.start("l2lidar_proc.ros.deskew_node", [])
        programs.start("l2lidar_proc.ros.odometry_node", [])
    programs.start(
        "l2lidar_node.emulator",
        [
            "--world", options.world,
            "--motion", options.motion,
            *(["--motion-speed", str(mapping.SPEED)] if options.slam else []),
            "--unit", options.unit,
            "--mount", "forward" if options.forward else "upright",
            "--host-port", str(host_port),
            "--lidar-port", str(lidar_port),
            "--boot-scale", str(_BOOT_SCALE),
            "--truth", str(options.folder / "truth"),
        ],
    )  # fmt: skip


def _watch(console: Console, observer: Observer, programs: Programs, seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        observer.watch(min(end, time.monotonic() + 1.0))
        programs.check()
        _tell(console, observer)


def _wait_for_data(observer: Observer, programs: Programs) -> None:
    """Watch until clouds arrive, then forget the start-up."""
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
    checks = observer.checks
    device, clock = checks.get("device", {}), checks.get("clock", {})
    console.print(
        f"  {device.get('point packets [1/s]')} point packets/s, "
        f"{device.get('IMU packets [1/s]')} IMU packets/s, {len(observer.clouds.stamps)} clouds, "
        f"{len(observer.positions)} poses; clock {clock.get('message')}"
    )


if __name__ == "__main__":
    sys.exit(interruptible(main))
