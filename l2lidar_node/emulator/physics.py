"""Composes world, motion, scanner and IMU from one group of settings."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.motion.motion import MOUNTS, Motion, from_tum
from l2lidar_node.emulator.unit.errors import RockingMotion
from l2lidar_node.emulator.unit.inertial import ImuNoise, Inertial
from l2lidar_node.emulator.unit.returns import RangeNoise
from l2lidar_node.emulator.unit.scanner import Scanner, mean_angle
from l2lidar_node.emulator.unit.units import Unit, unit as named_unit
from l2lidar_node.emulator.world import scenes
from l2lidar_node.emulator.world.world import World
from l2lidar_node.settings import setting


@dataclass(frozen=True, slots=True, kw_only=True)
class PhysicsConfig:
    """Where the virtual L2 is, how it moves and what is imperfect about it."""

    world: str = setting(
        "room",
        "built-in scene (box, room, corridor, yard, or for mapping: street_block, office_ring, "
        "furnished_office, warehouse, car_park, garages, bare_corridor) or path of a mesh file "
        "(PLY, STL, OBJ)",
    )
    motion: str = setting(
        "walk",
        "built-in motion (still, spin, shake, walk, trot, drone) or path of a TUM file",
    )
    speed: float = setting(
        0.0,
        "speed of a built-in motion in m/s, of spin and shake in rad/s, 0 = its own",
        name="motion_speed",
        lo=0.0,
        hi=50.0,
    )
    rest_s: float = setting(
        2.0, "rest at the beginning of the motion", unit="s", lo=0.0, hi=3600.0
    )
    mount: str = setting("upright", "how the sensor sits on its carrier", choices=tuple(MOUNTS))
    mount_rpy_deg: tuple[float, ...] = setting(
        (), "roll, pitch, yaw of the sensor on its carrier, in place of `mount`", unit="deg"
    )
    unit: str = setting(
        "perfect",
        "which unit: perfect reports what is true, typical and poor do not, a number is one of "
        "many; fast turns its head at 5.55 Hz, all others at 4.35 Hz",
    )
    power_up: int = setting(
        0, "how often the unit was switched on before; the phase of its mirror differs each time",
        lo=0, hi=10**9,
    )  # fmt: skip
    seed: int = setting(0, "everything random follows from this number", lo=0, hi=2**63 - 1)
    ranges: RangeNoise = field(default_factory=RangeNoise)
    imu: ImuNoise = field(default_factory=ImuNoise)


@dataclass(frozen=True, slots=True, eq=False)
class Physics:
    """What the virtual L2 measures with."""

    world: World
    motion: Motion
    scanner: Scanner
    inertial: Inertial


def assemble(config: PhysicsConfig, own: Unit | None = None) -> Physics:
    """Return the physics of a configuration.

    Parameters
    ----------
    config : PhysicsConfig
    own : Unit, optional
        In place of the configuration's.

    Raises
    ------
    ValueError
        For a scene, motion or file that cannot be used; the message names it.
    """
    if config.world in scenes.NAMES:
        scene = scenes.make(config.world)
        world = World(scene.triangles, scene.reflectivity)
    elif _is_path(config.world):
        world = World.load(config.world)
        scene = scenes.of_world(world)
    else:
        scene = scenes.make(config.world)
    if config.mount_rpy_deg and len(config.mount_rpy_deg) != 3:
        raise ValueError(f"mount_rpy_deg: expected 3 angles, got {len(config.mount_rpy_deg)}")
    mount: str | tuple[float, float, float] = config.mount
    if config.mount_rpy_deg:
        roll, pitch, yaw = np.deg2rad(config.mount_rpy_deg).tolist()
        mount = (roll, pitch, yaw)
    if config.motion not in trajectories.MOTIONS and _is_path(config.motion):
        motion = from_tum(config.motion, rest_s=config.rest_s, mount=mount)
    else:
        motion = trajectories.make(
            config.motion,
            scene,
            speed=config.speed,
            rest_s=config.rest_s,
            mount=mount,
            seed=config.seed,
        )
    unit = named_unit(config.unit, config.power_up) if own is None else own
    if unit.errors.rocks:
        rate = 2.0 * np.pi / unit.head_period_s
        bias = float(unit.calibration_record["theta_angle_bias"])
        start = float(mean_angle(np.zeros(1), unit, config.seed)[0]) + bias
        motion = RockingMotion(motion, unit.errors, start, rate)
    scanner = Scanner(world, motion, unit, config.ranges, config.seed)
    return Physics(world, motion, scanner, Inertial(motion, config.imu, config.seed, unit))


def _is_path(text: str) -> bool:
    return "." in text or "/" in text or Path(text).exists()
