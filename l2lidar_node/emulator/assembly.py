"""Puts a virtual L2 together from its settings: stored settings, port, world and unit."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Final

from l2lidar_node.emulator.config import DeviceConfig
from l2lidar_node.emulator.link.port import Port, SerialPort, UdpPort
from l2lidar_node.emulator.physics import PhysicsConfig
from l2lidar_node.emulator.ray_cast_worker import RayCastWorker
from l2lidar_node.emulator.truth.packet_log import PacketLog
from l2lidar_node.emulator.unit.device import Link, VirtualL2
from l2lidar_node.emulator.unit.firmware import version_payload
from l2lidar_node.emulator.unit.flash import Flash
from l2lidar_node.emulator.unit.pattern import PatternScanner, StillInertial
from l2lidar_node.emulator.unit.stream import VIEW, PointSource
from l2lidar_node.protocol.wire import WorkMode

WORLDLESS: Final = ("pattern", "none")
"""Worlds that are not ray-cast: a shell, and nothing at all."""

_REMEMBERED: Final = 10_000  # packets, when nobody asks for the truth


class FlashError(ValueError):
    """A file of stored settings that cannot be used; the message names it."""


def stored_settings(path: Path | None, config: DeviceConfig, serial: bool) -> Flash:
    """Return what the unit's flash holds: a file's content, or a new unit's settings without one.

    Parameters
    ----------
    path : Path or None
        Need not exist.
    config : DeviceConfig
    serial : bool
        A new unit is set to its serial port.

    Raises
    ------
    FlashError
        If the file is none that the emulator wrote, or its folder cannot be written to.
    SettingError
        If an address or a version is not one.
    """
    version_payload(config.identity)  # says what is wrong with it before anything is started
    if path is not None and path.exists():
        try:
            return Flash.from_json(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise FlashError(f"{path}: {error.strerror}") from None
        except ValueError as error:
            raise FlashError(f"{path}: {error}") from None
    if path is not None and not os.access(path.parent, os.W_OK):
        raise FlashError(f"{path}: there is no folder '{path.parent}' that can be written to")
    flash = Flash.factory(config.addresses, config.identity)
    mode = flash.work_mode | (WorkMode.SERIAL if serial else 0)
    return dataclasses.replace(flash, work_mode=int(mode))


def opened(flash: Flash, config: DeviceConfig, serial: str | None) -> Port:
    """Return the port at which the unit is reached.

    Raises
    ------
    PortError
        If it cannot be opened.
    """
    if serial is not None:
        return SerialPort(serial)
    return UdpPort(flash.network, config.addresses.reply_to_sender)


def seen_from(config: DeviceConfig, physics: PhysicsConfig) -> PhysicsConfig:
    """Return the physics with a rest until the first points: nobody sees the motion before."""
    spin_up_s = config.power.points_s * config.power.boot_scale
    return dataclasses.replace(physics, rest_s=physics.rest_s + spin_up_s)


def unit(
    config: DeviceConfig,
    flash: Flash,
    ray_cast_worker: RayCastWorker | None,
    *,
    power_on_ns: int,
    link: Link = Link.ETHERNET,
    empty: bool = False,
    remember: bool = False,
) -> VirtualL2:
    """Return a unit that is about to be switched on.

    Parameters
    ----------
    config : DeviceConfig
    flash : Flash
    ray_cast_worker : RayCastWorker or None
        What measures; without one a pattern does.
    power_on_ns : int
        True instant of power-on.
    link : Link
    empty : bool
        The pattern has no returns.
    remember : bool
        Keep the whole truth in memory instead of the latest of it.
    """
    sources: dict[WorkMode, PointSource] = {
        mode: ray_cast_worker.points(mode) if ray_cast_worker else _pattern(mode, empty)
        for mode in map(WorkMode, range(int(VIEW) + 1))
    }
    return VirtualL2(
        config,
        sources.pop(WorkMode(0)),
        ray_cast_worker.inertial() if ray_cast_worker else StillInertial(),
        power_on_ns=power_on_ns,
        flash=flash,
        link=link,
        modes=sources,
        packet_log=PacketLog(None if remember else _REMEMBERED),
    )


def _pattern(mode: WorkMode, empty: bool) -> PatternScanner:
    return PatternScanner(bool(mode & WorkMode.WIDE_FOV), bool(mode & WorkMode.MODE_2D), empty)
