"""Placements and motions of a virtual L2, for `l2lidar calibrate --emulator`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from l2lidar_node.calibration.observation import Gathering, Place
from l2lidar_node.emulator.config import DeviceConfig, PowerConfig
from l2lidar_node.emulator.motion.motion import Motion, PoseSpline
from l2lidar_node.emulator.physics import Physics, PhysicsConfig, assemble
from l2lidar_node.emulator.unit.device import VirtualL2
from l2lidar_node.emulator.unit.inertial import ImuNoise, Inertial
from l2lidar_node.emulator.unit.scanner import Scanner
from l2lidar_node.emulator.unit.units import Unit, unit
from l2lidar_node.protocol import wire
from l2lidar_node.recording.capture import Endpoint
from l2lidar_node.recording.recording import RecordingWriter
from l2lidar_node.types import HostNs

POSES_DEG: Final = {
    "upright": (0.0, 0.0, 0.0),
    "tilted": (0.0, 30.0, 40.0),
    "on its side": (90.0, 0.0, 100.0),
    "turned": (25.0, -10.0, 200.0),
}
"""Roll, pitch, yaw of the places that the guide asks for."""

_RATIO: Final = 1.99866  # true seconds per second of the unit's clock
_POWER_ON_NS: Final = 1_700_000_000_000_000_000
_STEP_S: Final = 0.2
_SKIP_S: Final = 2.0  # the motion begins with a rest, and so does a recording


def still_places(
    own: str | Unit,
    *,
    seconds: float = 10.0,
    poses: tuple[str, ...] = tuple(POSES_DEG),
    power_up: int = 0,
    world: str = "room",
    seed: int = 0,
    imu: ImuNoise | None = None,
) -> list[Place]:
    """Return the measurements of a virtual unit at still placements.

    Parameters
    ----------
    own : str or Unit
        Name as of :func:`emulator.unit.units.unit`.
    seconds : float
        At each place.
    poses : tuple of str
        Names of :data:`POSES_DEG`.
    power_up : int
        How often the unit was switched on before.
    world : str
    seed : int
        Of the noise.
    imu : ImuNoise, optional
    """
    made = unit(own, power_up) if isinstance(own, str) else own
    found = []
    for number, pose in enumerate(poses):
        config = PhysicsConfig(
            world=world,
            motion="still",
            mount_rpy_deg=POSES_DEG[pose],
            seed=seed * 1009 + 17 * power_up + number,
            imu=imu or ImuNoise(),
        )
        name = pose if power_up == 0 else f"{pose}, power-up {power_up + 1}"
        found.append(_place(config, made, seconds, name, power_up))
    return found


def slide(own: str | Unit, length: float, *, seconds: float = 10.0, seed: int = 0) -> list[Place]:
    """Return the measurements of a virtual unit at both ends of a tape in a room.

    Parameters
    ----------
    own : str or Unit
    length : float
        Of the way [m], in the direction with most room.
    seconds : float
        At each end.
    seed : int
    """
    made = unit(own) if isinstance(own, str) else own
    found = []
    for number, name in enumerate(("start", "end")):
        config = PhysicsConfig(motion="still", seed=seed * 1009 + number, rest_s=0.0)
        physics = assemble(config, made)
        start, _ = physics.motion.poses(np.zeros(1))
        angles = np.arange(4) * np.pi / 2
        around = np.stack((np.cos(angles), np.sin(angles), 0 * angles), axis=-1)
        free = physics.world.distances(np.repeat(start, 4, axis=0), around)
        ahead = around[int(np.argmax(free + np.roll(free, 2)))]
        # Half of the way lies behind the middle of the room.
        place = start[0] + ahead * (number - 0.5) * length
        knots = np.linspace(0.0, 2.0, 17)
        turn = np.tile([1.0, 0.0, 0.0, 0.0], (17, 1))
        curve = PoseSpline(knots, np.tile(place, (17, 1)), turn, periodic=True, degree=5)
        motion = Motion(curve, rest_s=0.0)
        moved = Physics(
            physics.world,
            motion,
            Scanner(physics.world, motion, made, config.ranges, config.seed),
            Inertial(motion, config.imu, config.seed, made),
        )
        found.append(_measured(moved, seconds, name, 0))
    return found


def capture(
    path: Path,
    own: str | Unit,
    seconds: float,
    *,
    motion: str = "shake",
    world: str = "room",
    seed: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> None:
    """Write a capture of a virtual unit in motion, after a rest of two seconds.

    Parameters
    ----------
    path : Path
        Replaced if it exists.
    own : str or Unit
    seconds : float
        Of the capture.
    motion, world : str
        See :class:`emulator.physics.PhysicsConfig`.
    seed : int
    progress : callable
        Told how far it is, 0 to 1.
    """
    made = unit(own) if isinstance(own, str) else own
    physics = assemble(PhysicsConfig(world=world, motion=motion, seed=seed), made)
    config = DeviceConfig(power=PowerConfig(boot_scale=0.0), seed=seed)
    device = VirtualL2(config, physics.scanner, physics.inertial, power_on_ns=_POWER_ON_NS)
    ends = Endpoint(wire.LIDAR_IP, wire.LIDAR_PORT), Endpoint(wire.HOST_IP, wire.HOST_PORT)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as stream:
        writer = RecordingWriter(stream, *ends)
        for step in range(1, round(seconds / _STEP_S) + 1):
            now = _POWER_ON_NS + round(step * _STEP_S * 1e9)
            for at, data in device.advance(now):
                writer.received(data, HostNs(at))
            progress(step * _STEP_S / seconds)


def _place(config: PhysicsConfig, own: Unit, seconds: float, name: str, power_up: int) -> Place:
    return _measured(assemble(config, own), seconds, name, power_up)


def _measured(physics: Physics, seconds: float, name: str, power_up: int) -> Place:
    scanner, inertial = physics.scanner, physics.inertial
    packets, starts = scanner.packets(
        round(_SKIP_S / scanner.period_s), round(seconds / scanner.period_s)
    )
    samples, times = inertial.samples(
        round(_SKIP_S / inertial.period_s), round(seconds / inertial.period_s)
    )
    gathering = Gathering(name, power_up)
    order = np.argsort(np.concatenate((starts + scanner.period_s / 2, times)), kind="stable")
    for index in order.tolist():
        if index < len(packets):
            row = packets[index : index + 1]
            gathering.points(float(starts[index]) / _RATIO, row.tobytes())
        else:
            row = samples[index - len(packets) : index - len(packets) + 1]
            gathering.imu(float(times[index - len(packets)]) / _RATIO, row.tobytes())
    return gathering.place()
