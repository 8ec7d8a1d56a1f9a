"""`l2lidar start`, `stop` and `reset`: standby and reboot, undone when interrupted in between."""

from __future__ import annotations

import contextlib
import threading
from typing import Annotated

import numpy as np
import typer

from l2lidar_node.cli.console import say, with_network
from l2lidar_node.cli.device import Device, DeviceError
from l2lidar_node.clock import ClockEvent, ClockEventKind
from l2lidar_node.config import NetworkConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.protocol import wire

_LISTEN_S = 1.0
_SILENT_S = 0.5
_LOCK_S = 2.5
_RESTART_S = 60.0

WaitOption = Annotated[
    float, typer.Option(min=0.0, metavar="S", help="Wait so long for it to have taken effect.")
]


@with_network
def start(network: NetworkConfig, wait: WaitOption = 0.0) -> None:
    """Leave standby: the head turns, points come after 12 to 45 s.

    Interrupted while it waits, it puts a unit that was in standby back.
    """
    with Device(network) as device:
        was_running = device.is_measuring(_LISTEN_S)
        try:
            device.command(lambda driver, now: driver.start_rotation(now))
            points = _points(device)
            if wait and device.wait_for(lambda driver: _count(driver) > points, wait) is None:
                raise DeviceError(f"acknowledged, but there are no points after {wait:g} s")
        except KeyboardInterrupt:
            if not was_running:
                _restore(device, to_running=False)
            raise
        say("it was running already" if was_running else "started")


@with_network
def stop(network: NetworkConfig) -> None:
    """Go into standby: the motors stop, points and IMU with them.

    Interrupted before it is done, it starts a unit that was running again.
    """
    with Device(network) as device:
        was_running = device.is_measuring(_LISTEN_S)
        try:
            device.command(lambda driver, now: driver.stop_rotation(now)[0])
            if device.is_measuring(_SILENT_S) and device.is_measuring(_SILENT_S):
                raise DeviceError("the device acknowledged the command but keeps measuring")
        except KeyboardInterrupt:
            if was_running:
                _restore(device, to_running=True)
            raise
        say("stopped" if was_running else "nothing was coming before; it is in standby")


@with_network
def reset(network: NetworkConfig, wait: WaitOption = 0.0) -> None:
    """Reboot the unit: stored settings come into force, points are back in about 25 s.

    The unit does not acknowledge it; with --wait its clock tells that it began anew.
    """
    restarted = threading.Event()

    def notice(event: Event) -> None:
        if isinstance(event, ClockEvent) and event.kind is ClockEventKind.REBOOT:
            restarted.set()

    with Device(network, notice) as device:
        if device.is_measuring(_LISTEN_S):
            if wait:
                # A clock that is known shows a restart, however young the unit was before it.
                device.wait_for(lambda driver: driver.clock_status().locked, _LOCK_S)
        elif device.ask(lambda driver: not _heard(driver)):
            say("[yellow]nothing is heard from it: the command is sent all the same")
        before = device.ask(_stamp_s)
        restarted.clear()
        device.tell(lambda driver, now: driver.reset_device(now))
        if not wait:
            say("reset sent")
            return
        points = _points(device)

        def is_back(driver: Driver) -> bool:
            has_begun_anew = restarted.is_set() or _stamp_s(driver) < min(before, _RESTART_S)
            return _count(driver) > points and has_begun_anew

        if device.wait_for(is_back, wait) is None:
            raise DeviceError(f"the device did not restart within {wait:g} s")
        say("it has restarted, points are back")


def _restore(device: Device, *, to_running: bool) -> None:
    with contextlib.suppress(DeviceError):
        if to_running:
            device.command(lambda driver, now: driver.start_rotation(now))
        else:
            device.command(lambda driver, now: driver.stop_rotation(now)[0])
        say("interrupted: it is running again" if to_running else "interrupted: in standby")
        return
    say("[red]interrupted, and it did not take the command to undo it")


def _points(device: Device) -> int:
    return device.ask(_count)


def _count(driver: Driver) -> int:
    frames = driver.counters.frames
    return frames[wire.PacketType.POINTS_3D] + frames[wire.PacketType.POINTS_2D]


def _heard(driver: Driver) -> bool:
    return driver.counters.frames.total() > 0


def _stamp_s(driver: Driver) -> float:
    """Return what the device's clock showed at the latest points; infinity if there were none."""
    if driver.last_points is None:
        return float("inf")
    info = np.frombuffer(driver.last_points, wire.DATA_INFO, 1)[0]
    return float(info["sec"] + 1e-9 * info["nsec"])
