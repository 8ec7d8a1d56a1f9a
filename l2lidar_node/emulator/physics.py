"""World, motion, scanner and IMU of the virtual L2, and its ray-cast process.

Casting rays in a process of its own disturbs no deadline.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import wait
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.motion.motion import MOUNTS, Motion, from_tum
from l2lidar_node.emulator.truth import write_points, write_trajectory
from l2lidar_node.emulator.unit.inertial import ImuNoise, Inertial
from l2lidar_node.emulator.unit.returns import RangeNoise
from l2lidar_node.emulator.unit.scanner import Scanner, on_its_mount
from l2lidar_node.emulator.unit.units import Unit, unit as named_unit
from l2lidar_node.emulator.world import scenes
from l2lidar_node.emulator.world.world import World
from l2lidar_node.programs import held
from l2lidar_node.protocol.wire import WorkMode
from l2lidar_node.settings import setting


@dataclass(frozen=True, slots=True, kw_only=True)
class PhysicsConfig:
    """World, motion and imperfections of the virtual L2."""

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
    mount: str = setting("upright", "mount of the sensor on its carrier", choices=tuple(MOUNTS))
    mount_rpy_deg: tuple[float, ...] = setting(
        (), "roll, pitch, yaw of the sensor on its carrier, instead of `mount`", unit="deg"
    )
    unit: str = setting(
        "perfect",
        "unit: perfect matches its reported calibration, typical and poor do not, a number "
        "selects one of many; fast turns its head at 5.55 Hz, all others at 4.35 Hz",
    )
    power_up: int = setting(
        0, "number of power-ups before this one; each has another phase of the mirror",
        lo=0, hi=10**9,
    )  # fmt: skip
    seed: int = setting(0, "seed of everything random", lo=0, hi=2**63 - 1)
    ranges: RangeNoise = field(default_factory=RangeNoise)
    imu: ImuNoise = field(default_factory=ImuNoise)


@dataclass(frozen=True, slots=True, eq=False)
class Physics:
    """World, motion, scanner and IMU of the virtual L2."""

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
    motion = on_its_mount(motion, unit, config.seed)
    scanner = Scanner(world, motion, unit, config.ranges, config.seed)
    return Physics(world, motion, scanner, Inertial(motion, config.imu, config.seed, unit))


def _is_path(text: str) -> bool:
    return "." in text or "/" in text or Path(text).exists()


_AHEAD: Final = 4  # blocks
_GRACE_S: Final = 0.3  # for a block that is being measured; to prepare a world takes seconds
_IMU: Final = "imu"

Block = tuple[NDArray[np.void], NDArray[np.float64]]
_Key = tuple[str | WorkMode, int, int]


class RayCastError(RuntimeError):
    """The ray-cast process was killed."""


class RayCastWorker:
    """A process that casts rays ahead; its sources feed a :class:`VirtualL2`.

    Parameters
    ----------
    config : PhysicsConfig
        What there is to measure; assembled in the process.
    truth : Path, optional
        Folder into which the exact points of every measured packet are written.

    Raises
    ------
    ValueError
        For a scene, motion or file that cannot be used; the message names it.
    RayCastError
        If reading the world killed the process.
    """

    def __init__(self, config: PhysicsConfig, truth: Path | None = None) -> None:
        self._pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _settle)
        self._futures: dict[_Key, Future[Block]] = {}
        try:
            resource_tracker.ensure_running()  # or starting it lets signals through
            with held():
                prepared = self._pool.submit(_prepare, config, truth)
            # The process has its own by now. With another one open, the pipe would never end, and
            # the rest of a block that a killed process was writing would be waited for.
            results: Any = self._pool._result_queue
            results._writer.close()
            prepared.result()
        except BrokenProcessPool:  # open3d's readers crash on some damaged files
            self._end()
            raise RayCastError(
                f"world '{config.world}': the process that reads it crashed; the mesh file "
                "may be damaged or truncated"
            ) from None
        except BaseException:
            self._end()
            raise

    def __enter__(self) -> RayCastWorker:
        """Return the ray-cast worker itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End the process."""
        self.close()

    def close(self) -> None:
        """End the process; pending work is dropped."""
        self._end(_GRACE_S)

    def _end(self, grace_s: float = 0.0) -> None:
        workers = [*(self._pool._processes or {}).values()]  # there is no public way to get them
        manager: Any = self._pool._executor_manager_thread  # forgotten by not waiting for it
        self._pool.shutdown(wait=False, cancel_futures=True)
        if len(wait([worker.sentinel for worker in workers], grace_s)) < len(workers):
            for worker in workers:
                worker.kill()
        if manager is not None:
            manager.join()  # else it closes what the interpreter writes to at its end

    def points(self, mode: WorkMode) -> WorkerScanner:
        """Return the source of point packets in a work mode (field of view, 2D or 3D)."""
        return WorkerScanner(self._block, mode)

    def inertial(self) -> WorkerInertial:
        """Return the source of IMU packets."""
        return WorkerInertial(self._block)

    def write_trajectory(self, folder: Path, duration_s: float, origin_ns: int) -> None:
        """Write the poses of the cloud frame in the world; see :mod:`results`."""
        self._pool.submit(_trajectory, folder, duration_s, origin_ns).result()

    def _block(self, what: str | WorkMode, first: int, count: int) -> Block:
        """Return a block and order the next ones."""
        wanted: list[_Key] = [(what, first + ahead * count, count) for ahead in range(_AHEAD + 1)]
        for key in [key for key in self._futures if key[0] == what and key not in wanted]:
            self._futures.pop(key).cancel()
        try:
            for key in wanted:
                if key not in self._futures:
                    self._futures[key] = self._pool.submit(_measure, *key)
            return self._futures.pop(wanted[0]).result()
        except BrokenProcessPool:
            raise RayCastError("the ray-cast process ended") from None


class WorkerScanner:
    """Point packets from the ray-cast worker; a PointSource."""

    def __init__(self, block: Callable[[str | WorkMode, int, int], Block], mode: WorkMode) -> None:
        self._block = block
        self._mode = mode

    def packets(self, first: int, count: int) -> Block:
        """Return packets and their start times [s]; see :class:`sources.Source`."""
        return self._block(self._mode, first, count)


class WorkerInertial:
    """IMU packets from the ray-cast worker; an InertialSource."""

    def __init__(self, block: Callable[[str | WorkMode, int, int], Block]) -> None:
        self._block = block

    def samples(self, first: int, count: int) -> Block:
        """Return samples and their times [s]; see :class:`sources.Source`."""
        return self._block(_IMU, first, count)


_state: dict[str, Any] = {}  # of the measuring process


def leave_out_dash() -> None:
    """Let open3d be imported without notebook drawing, in half the time."""
    dash = ModuleType("dash")
    dash.__dict__.update(dict.fromkeys(("Dash", "dcc", "html")))
    sys.modules["dash"] = dash


def _settle() -> None:
    """Leave signals, which often go to the whole group, to the parent; go when it is gone."""
    leave_out_dash()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)

    def follow() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(0)

    threading.Thread(target=follow, daemon=True).start()


def _prepare(config: PhysicsConfig, truth: Path | None) -> None:
    _state["physics"] = assemble(config)
    _state["truth"] = truth


def _measure(what: str | WorkMode, first: int, count: int) -> Block:
    physics: Physics = _state["physics"]
    if isinstance(what, str):
        return physics.inertial.samples(first, count)
    wide_fov = bool(what & WorkMode.WIDE_FOV)
    scanner = physics.scanner
    measure = scanner.scan_2d if what & WorkMode.MODE_2D else scanner.scan
    scan = measure(first, count, wide_fov=wide_fov)
    if _state["truth"] is not None:
        write_points(_state["truth"], what, scan)
    return scan.packets, scan.times_s


def _trajectory(folder: Path, duration_s: float, origin_ns: int) -> None:
    write_trajectory(folder, _state["physics"].motion, duration_s, origin_ns)
