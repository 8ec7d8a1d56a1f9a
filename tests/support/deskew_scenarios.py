"""Records what the virtual L2 sees and feels on a motion, with the truth beside it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.motion.motion import Motion, PoseSpline
from l2lidar_node.emulator.physics import Physics, PhysicsConfig, assemble
from l2lidar_node.emulator.truth import undistorted
from l2lidar_node.emulator.unit.inertial import ImuNoise, Inertial
from l2lidar_node.emulator.unit.returns import RangeNoise
from l2lidar_node.emulator.unit.scanner import Scan, Scanner, local_rays
from l2lidar_node.types import F64, IMU_SAMPLE, POINT, HostNs, Sweep

EPOCH = 1_700_000_000_000_000_000
TURN = 50  # packets: a little more than a turn of the head, 15,000 slots


@dataclass(frozen=True, slots=True)
class Scenario:
    """A motion and what is wrong with the measurements; ranges are always free of noise.

    Attributes
    ----------
    name : str
    motion : str
        Built-in motion of the emulator, or ``pivot``: turning about the cloud frame's own origin.
    speed : float
        [m/s], for spin [rad/s].
    mount : str
        Built-in mount of the emulator.
    imu : ImuNoise
    gap_s : float
        Length of the gaps that are cut into the IMU samples, ten a second.
    loss : float
        Share of packets that is lost.
    world : str
    seconds : float
        Length of the recording.
    """

    name: str
    motion: str
    speed: float
    mount: str = "upright"
    imu: ImuNoise = field(default_factory=ImuNoise.clean)
    gap_s: float = 0.0
    loss: float = 0.0
    world: str = "room"
    seconds: float = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class TrueSweep:
    """A sweep and where its points are in truth.

    Attributes
    ----------
    sweep : Sweep
    at_start, at_end : ndarray, shape (N, 3)
        True places of the points from the frames at the sweep's start and end [m].
    packet_start_s : ndarray, shape (N,)
        When the packet of each point began [s].
    start_s, end_s : float
        On the motion's time line.
    """

    sweep: Sweep
    at_start: F64
    at_end: F64
    packet_start_s: F64
    start_s: float
    end_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Everything about one run of a scenario.

    Attributes
    ----------
    motion : Motion
    samples : ndarray, dtype IMU_SAMPLE
    sweeps : list of TrueSweep
    """

    motion: Motion
    samples: NDArray[np.void]
    sweeps: list[TrueSweep]


def stamp(seconds: float) -> HostNs:
    """Return the stamp of an instant on the motion's time line."""
    return HostNs(EPOCH + round(seconds * 1e9))


def record(scenario: Scenario) -> Recording:
    """Return a recording of a scenario, from rest at time 0 on."""
    physics = _physics(scenario)
    random = np.random.default_rng(5)
    packets = int(scenario.seconds / physics.scanner.period_s)
    sweeps = [
        _sweep(physics, physics.scanner.scan(first, TURN), random, scenario.loss)
        for first in range(0, packets - TURN, TURN)
    ]
    return Recording(physics.motion, _samples(physics, scenario), sweeps)


def _physics(scenario: Scenario) -> Physics:
    pivots = scenario.motion == "pivot"
    physics = assemble(
        PhysicsConfig(
            world=scenario.world,
            motion="still" if pivots else scenario.motion,
            speed=scenario.speed,
            mount=scenario.mount,
            ranges=RangeNoise.clean(),
            imu=scenario.imu,
        )
    )
    if not pivots:
        return physics
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    place, _ = physics.motion.poses(np.zeros(1))
    q = np.stack((np.cos(turn / 2), 0 * turn, 0 * turn, np.sin(turn / 2)), axis=-1)
    places = np.repeat(place, len(turn), axis=0)
    motion = Motion(PoseSpline(turn / scenario.speed, places, q, periodic=True, degree=5))
    return Physics(
        physics.world,
        motion,
        Scanner(physics.world, motion, noise=RangeNoise.clean()),
        Inertial(motion, scenario.imu),
    )


def _samples(physics: Physics, scenario: Scenario) -> NDArray[np.void]:
    raw, times = physics.inertial.samples(0, int((scenario.seconds + 0.1) * 250))
    samples = np.zeros(len(raw), dtype=IMU_SAMPLE)
    samples["stamp"] = EPOCH + np.round(times * 1e9).astype(np.int64)
    samples["orientation_wxyz"] = raw["quaternion_wxyz"]
    samples["angular_velocity"] = raw["angular_velocity"]
    samples["linear_acceleration"] = raw["linear_acceleration"]
    # a gap of 10 ms is what two lost samples leave, and a bit
    return samples[(times % 0.1) >= scenario.gap_s - 1e-9] if scenario.gap_s else samples


def _sweep(physics: Physics, scan: Scan, random: np.random.Generator, loss: float) -> TrueSweep:
    kept = scan.returned & (random.random(len(scan.packets)) >= loss)[:, None]
    origins, directions = local_rays(scan.packets)
    xyz = (origins + directions * scan.rays["measured"][..., None])[kept]
    times = scan.rays["time"][kept]
    start_s, end_s = float(times[0]), float(times[-1])
    points = np.zeros(len(xyz), dtype=POINT)
    points["x"], points["y"], points["z"] = xyz.T
    points["range"] = scan.rays["measured"][kept]
    points["time"] = times - start_s
    points.flags.writeable = False
    return TrueSweep(
        Sweep(stamp(start_s), stamp(end_s), points, len(scan.packets), 0),
        undistorted(scan, physics.motion, start_s, measured=True)[kept],
        undistorted(scan, physics.motion, end_s, measured=True)[kept],
        np.broadcast_to(scan.times_s[:, None], kept.shape)[kept],
        start_s,
        end_s,
    )
