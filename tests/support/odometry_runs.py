"""Records what the virtual L2 sees and feels on a motion, in sweeps, with the truth beside it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.calibration.file import CalibrationFile
from l2lidar_node.driver.geometry import Projector
from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.motion.motion import Motion
from l2lidar_node.emulator.physics import Physics, PhysicsConfig, assemble
from l2lidar_node.emulator.unit.inertial import Inertial
from l2lidar_node.emulator.unit.scanner import Scanner
from l2lidar_node.emulator.unit.units import unit as named_unit
from l2lidar_node.protocol import wire
from l2lidar_node.types import F64, IMU_SAMPLE, HostNs, Sweep

EPOCH = 1_700_000_000_000_000_000
BATCH = 50
CUTS = ("turn", "38 packets", "half turn")


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A recording.

    Attributes
    ----------
    name : str
    seconds : float
    points : ndarray, shape (N,), dtype POINT
        Of all packets; ``time`` means nothing yet.
    instants : ndarray, shape (N,)
        Of each point [s].
    edges : ndarray, shape (P + 1,)
        Where each packet's points begin.
    starts : ndarray, shape (P,)
        Instant of each packet's slot 0 [s].
    heads : ndarray, shape (P,)
        Head angle at slot 0 [rad].
    imu : ndarray, shape (M,), dtype IMU_SAMPLE
    motion : Motion
        The truth.
    """

    name: str
    seconds: float
    points: NDArray[np.void]
    instants: F64
    edges: NDArray[np.int64]
    starts: F64
    heads: F64
    imu: NDArray[np.void]
    motion: Motion


def record(
    scene: str,
    motion: str,
    seed: int,
    seconds: float,
    mount: str = "upright",
    unit: str = "perfect",
    calibration: CalibrationFile | None = None,
    *,
    speed: float = 0.0,
    since: float = 0.0,
    hits: Sequence[float] = (),
) -> Run:
    """Return a recording of a built-in motion in a built-in scene.

    Parameters
    ----------
    scene, motion : str
    seed : int
    seconds : float
    mount : str
    unit : str
        As the emulator names it.
    calibration : CalibrationFile, optional
        Used as the driver uses it.
    speed : float
        [m/s], 0 = the motion's own.
    since : float
        When the recording begins [s].
    hits : sequence of float
        Instants of blows [s].
    """
    config = PhysicsConfig(
        world=scene, motion=motion, speed=speed, seed=seed, mount=mount, unit=unit
    )
    physics = assemble(config)
    if hits:
        physics = _hit(physics, config, trajectories.hit(physics.motion, seconds + 1, hits, seed))
    used = None if calibration is None else calibration.corrected
    projector = Projector(wire.PacketType.POINTS_3D)
    begin = int(since / physics.scanner.period_s)
    total = begin + int(seconds / physics.scanner.period_s)
    points, instants, counts, starts, heads = [], [], [], [], []
    for first in range(begin, total, BATCH):
        packets, times = physics.scanner.packets(first, min(BATCH, total - first))
        payloads = [packet.tobytes() for packet in packets]
        batch = projector.points(payloads, times - times[0], used=used)
        points.append(batch.points)
        instants.append(times[0] + batch.first_s + batch.points["time"].astype(np.float64))
        counts.append(batch.counts)
        starts.append(times)
        heads.append(packets["com_horizontal_angle_start"].astype(np.float64))
    samples, times = physics.inertial.samples(
        int(since * wire.IMU_RATE_HZ), int(seconds * wire.IMU_RATE_HZ)
    )
    imu = np.zeros(len(samples), IMU_SAMPLE)
    imu["stamp"] = EPOCH + np.round(times * 1e9).astype(np.int64)
    imu["orientation_wxyz"] = samples["quaternion_wxyz"] / wire.QUATERNION_NORM
    imu["angular_velocity"] = samples["angular_velocity"]
    imu["linear_acceleration"] = samples["linear_acceleration"]
    return Run(
        f"{scene} {motion} {seed}",
        seconds,
        np.concatenate(points),
        np.concatenate(instants),
        np.concatenate(([0], np.cumsum(np.concatenate(counts)))),
        np.concatenate(starts),
        np.concatenate(heads),
        imu,
        physics.motion,
    )


def _hit(physics: Physics, config: PhysicsConfig, motion: Motion) -> Physics:
    """Return physics with another motion."""
    unit = named_unit(config.unit, config.power_up)
    scanner = Scanner(physics.world, motion, unit, config.ranges, config.seed)
    return Physics(physics.world, motion, scanner, Inertial(motion, config.imu, config.seed, unit))


def sweeps(run: Run, cut: str) -> Iterator[Sweep]:
    """Yield the sweeps of a recording, cut in one of the ways of :data:`CUTS`."""
    length = 299 * wire.MIRROR_PERIOD_S / 600.0
    for first, last in zip(*_bounds(run, cut), strict=True):
        part = slice(run.edges[first], run.edges[last])
        if part.stop == part.start:
            continue
        points = run.points[part].copy()
        instants = run.instants[part]
        points["time"] = instants - instants[0]
        start = EPOCH + round(instants[0] * 1e9)
        end = EPOCH + round((run.starts[last - 1] + length) * 1e9)
        yield Sweep(HostNs(start), HostNs(end), points, last - first, 0)


def count(run: Run, cut: str) -> int:
    """Return how many sweeps a recording has."""
    return len(_bounds(run, cut)[0])


def _bounds(run: Run, cut: str) -> tuple[list[int], list[int]]:
    if cut == "turn":
        edges = np.flatnonzero(np.abs(np.diff(run.heads)) > np.pi) + 1
    elif cut == "half turn":
        edges = np.flatnonzero(np.diff(run.heads % (2 * np.pi) >= np.pi)) + 1
    else:
        edges = np.arange(0, len(run.heads), int(cut.split()[0]))
    edges = np.unique(np.concatenate(([0], edges)))
    return edges[:-1].tolist(), edges[1:].tolist()


def truth(run: Run, stamps: NDArray[np.int64]) -> tuple[F64, F64]:
    """Return positions (N, 3) [m] and quaternions w, x, y, z (N, 4) of the cloud frame."""
    return run.motion.poses(np.asarray((stamps - EPOCH) * 1e-9, dtype=np.float64))


def write(run: Run, cut: str, path: Path) -> None:
    """Write the sweeps for :mod:`benchmarks.odometry_referee`."""
    cutted = list(sweeps(run, cut))
    points = np.concatenate([sweep.points for sweep in cutted])
    T_cloud_imu = np.eye(4)
    T_cloud_imu[:3, 3] = wire.IMU_POSITION_M
    np.savez(
        path,
        points=np.stack([points[axis] for axis in "xyz"], axis=1),
        times=points["time"],
        edges=np.cumsum([0, *(len(sweep.points) for sweep in cutted)]),
        spans=np.array([(sweep.start, sweep.end) for sweep in cutted], dtype=np.int64),
        imu=run.imu,
        T_cloud_imu=T_cloud_imu,
    )
