"""Still places measured by a virtual L2: what `l2lidar calibrate still --emulator` works on."""

from __future__ import annotations

from typing import Final

import numpy as np

from l2lidar_node.calibration.observation import Gathering, Place
from l2lidar_node.emulator.physics import PhysicsConfig, assemble
from l2lidar_node.emulator.unit.inertial import ImuNoise
from l2lidar_node.emulator.unit.units import Unit, unit

POSES_DEG: Final = {
    "upright": (0.0, 0.0, 0.0),
    "tilted": (0.0, 30.0, 40.0),
    "on its side": (90.0, 0.0, 100.0),
    "turned": (25.0, -10.0, 200.0),
}
"""Roll, pitch, yaw of the places that the guide asks for."""

_RATIO: Final = 1.99866  # true seconds per second of the unit's clock
_SKIP_S: Final = 2.0  # the motion begins with a rest, and so does a recording


def still_places(
    own: str | Unit,
    *,
    seconds: float = 10.0,
    poses: tuple[str, ...] = tuple(POSES_DEG),
    power_ups: int = 1,
    world: str = "room",
    seed: int = 0,
    imu: ImuNoise | None = None,
) -> list[Place]:
    """Return what a virtual unit measures at still places.

    Parameters
    ----------
    own : str or Unit
        Name as of :func:`emulator.unit.units.unit`.
    seconds : float
        At each place.
    poses : tuple of str
        Names of :data:`POSES_DEG`.
    power_ups : int
        After each of them all poses are measured.
    world : str
    seed : int
        Of the noise.
    imu : ImuNoise, optional
    """
    found = []
    for power_up in range(power_ups):
        made = unit(own, power_up) if isinstance(own, str) else own
        for number, pose in enumerate(poses):
            config = PhysicsConfig(
                world=world,
                motion="still",
                mount_rpy_deg=POSES_DEG[pose],
                seed=seed * 1009 + 17 * power_up + number,
                imu=imu or ImuNoise(),
            )
            name = pose if power_ups == 1 else f"{pose}, power-up {power_up + 1}"
            found.append(_place(config, made, seconds, name, power_up))
    return found


def _place(config: PhysicsConfig, own: Unit, seconds: float, name: str, power_up: int) -> Place:
    physics = assemble(config, own)
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
