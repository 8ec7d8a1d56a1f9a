"""Recordings of the hard runs: made once, kept below ``out/``, judged again and again.

A recording is an ``.npz`` of 1 to 4 MB per second: the sweeps as an odometry gets them, the IMU
samples, and the truth. It is also what :mod:`benchmarks.odometry_referee` reads.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.hard_scenarios import Imperfections, Scenario, Setting, prepare
from l2lidar_node.driver.geometry import Projector
from l2lidar_node.emulator.unit.inertial import Inertial
from l2lidar_node.emulator.unit.returns import RangeNoise
from l2lidar_node.emulator.unit.scanner import Scanner, on_its_mount
from l2lidar_node.emulator.unit.units import Unit, unit as named_unit
from l2lidar_node.protocol import wire
from l2lidar_node.types import F64, IMU_SAMPLE, HostNs, Sweep
from tests.support.other_sensors import CLOUD_POINT, SENSORS

FOLDER: Final = Path("out") / "recordings"
EPOCH: Final = 1_700_000_000_000_000_000
_VERSION: Final = 2  # of what a scenario's name stands for; a new one makes all recordings anew
_BYTES_PER_S: Final = 1_200_000  # mean of all families
_BATCH: Final = 50
_TRUTH_HZ: Final = 500

TRUTH: Final = np.dtype(
    [
        ("stamp", "<i8"),  # [ns]
        ("position", "<f8", (3,)),  # [m] of the sensor's frame in the world, z up
        ("quaternion_wxyz", "<f8", (4,)),  # sensor to world
        ("velocity", "<f8", (3,)),  # [m/s] world frame
    ]
)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """What one run measured, and the truth.

    Attributes
    ----------
    path : Path
    points : ndarray, shape (N,), dtype CLOUD_POINT
    edges : ndarray, shape (S + 1,)
        Where each sweep's points begin.
    spans : ndarray, shape (S, 2)
        Start and end of each sweep [ns].
    imu : ndarray, shape (M,), dtype IMU_SAMPLE
    T_cloud_imu : ndarray, shape (4, 4)
        What an odometry is told; not always the truth.
    truth : ndarray, shape (K,), dtype TRUTH
    """

    path: Path
    points: NDArray[np.void]
    edges: NDArray[np.int64]
    spans: NDArray[np.int64]
    imu: NDArray[np.void]
    T_cloud_imu: F64
    truth: NDArray[np.void]

    @property
    def seconds(self) -> float:
        """Length of the recording [s]."""
        return float(self.spans[-1, 1] - self.spans[0, 0]) * 1e-9

    @property
    def way_m(self) -> float:
        """Length of the true way, without trembling [m]."""
        places = self.truth["position"][:: _TRUTH_HZ // 2]
        return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())

    def sweeps(self) -> Iterator[Sweep]:
        """Yield the sweeps that have points."""
        for first, last, (start, end) in zip(
            self.edges[:-1], self.edges[1:], self.spans.tolist(), strict=True
        ):
            if last > first:
                yield Sweep(HostNs(start), HostNs(end), self.points[first:last], 0, 0)

    def truth_at(self, stamps: NDArray[np.int64]) -> NDArray[np.void]:
        """Return the truth at instants (N,) [ns]; to some 10 um and 0.1 mrad between samples."""
        at = (stamps - self.truth["stamp"][0]) * 1e-9 * _TRUTH_HZ
        low = np.clip(np.floor(at).astype(np.int64), 0, len(self.truth) - 2)
        share = (at - low)[:, None]
        a, b = self.truth[low], self.truth[low + 1]
        found = np.zeros(len(stamps), TRUTH)
        found["stamp"] = stamps
        step = 1.0 / _TRUTH_HZ  # Hermite: places and velocities at both ends
        found["position"] = (
            (1.0 + 2.0 * share) * (1.0 - share) ** 2 * a["position"]
            + share * (1.0 - share) ** 2 * step * a["velocity"]
            + share**2 * (3.0 - 2.0 * share) * b["position"]
            - share**2 * (1.0 - share) * step * b["velocity"]
        )
        found["velocity"] = (1.0 - share) * a["velocity"] + share * b["velocity"]
        sign = np.sign(np.einsum("ni,ni->n", a["quaternion_wxyz"], b["quaternion_wxyz"]))
        turn = (1.0 - share) * a["quaternion_wxyz"] + (
            share * sign[:, None] * b["quaternion_wxyz"]
        )
        found["quaternion_wxyz"] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
        return found


def path_of(given: Scenario) -> Path:
    """Return where the recording of a scenario is kept."""
    words = "".join(c if c.isalnum() else "_" for c in given.family).strip("_")
    digest = hashlib.sha256(f"{_VERSION} {given!r} {Imperfections()!r}".encode()).hexdigest()
    return FOLDER / f"{words}-{given.seed}-{given.seconds:g}s-{digest[:8]}.npz"


def missing_bytes(wanted: Iterable[Scenario]) -> float:
    """Return about how much the recordings of scenarios need that are not there yet."""
    return sum(_BYTES_PER_S * one.seconds for one in wanted if not path_of(one).exists())


def recording(given: Scenario, *, fresh: bool = False) -> Recording:
    """Return the recording of a scenario, from its file where there is one.

    Parameters
    ----------
    given : Scenario
    fresh : bool
        Make it anew in any case.
    """
    path = path_of(given)
    if fresh or not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        measured = _measured(given)
        part = path.with_name(f"{path.stem}.{os.getpid()}.part.npz")
        try:
            np.savez(part, **measured)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    with np.load(path) as file:
        points = np.zeros(len(file["times"]), CLOUD_POINT)
        points["x"], points["y"], points["z"] = file["points"].T
        points["time"], points["intensity"] = file["times"], file["intensities"]
        points.flags.writeable = False
        return Recording(
            path,
            points,
            file["edges"],
            file["spans"],
            file["imu"],
            file["T_cloud_imu"],
            file["truth"],
        )


def _measured(given: Scenario) -> dict[str, Any]:
    """Return the arrays of a recording."""
    setting = prepare(given)
    measure = _l2 if given.sensor == "l2" else _other
    points, edges, spans = measure(given, setting)
    T_cloud_imu = np.eye(4)
    T_cloud_imu[:3, 3] = wire.IMU_POSITION_M
    t = np.arange(0.0, given.seconds + 1.0, 1.0 / _TRUTH_HZ)
    truth = np.zeros(len(t), TRUTH)
    moving = setting.motion.kinematics(t)
    truth["stamp"] = EPOCH + np.round(t * 1e9).astype(np.int64)
    truth["position"], truth["velocity"] = moving.position, moving.velocity
    truth["quaternion_wxyz"] = moving.quaternion_wxyz
    return {
        "points": np.stack([points[axis] for axis in "xyz"], axis=1),
        "times": points["time"],
        "intensities": points["intensity"],
        "edges": edges,
        "spans": spans,
        "imu": _samples(given, setting),
        "T_cloud_imu": T_cloud_imu,
        "truth": truth,
    }


def _l2(
    given: Scenario, setting: Setting
) -> tuple[NDArray[np.void], NDArray[np.int64], NDArray[np.int64]]:
    """Measure with the virtual L2; return points, edges and spans of full turns."""
    noise = RangeNoise(particles=given.particles, dropout=2.0 if given.imperfect else 1.0)
    unit = _unit(given)
    scanner = Scanner(
        setting.world,
        on_its_mount(setting.motion, unit, given.seed),
        noise=noise,
        seed=given.seed,
        unit=unit,
        view=setting.view,
    )
    rng = np.random.default_rng((given.seed, 22))
    total = int(given.seconds / scanner.period_s)
    projector = Projector(wire.PacketType.POINTS_3D)
    reported = _reported(given, scanner.unit.calibration_record)
    lost = _lost(rng, total) if given.imperfect else np.zeros(total, np.bool_)
    clouds, instants, counts, starts, heads = [], [], [], [], []
    for first in range(0, total, _BATCH):
        packets, times = scanner.packets(first, min(_BATCH, total - first))
        kept = ~lost[first : first + len(packets)]
        packets, times = packets[kept], times[kept]
        if not len(packets):
            continue
        packets["calibration"] = reported
        for start, end in setting.covered:
            packets["ranges"][(times >= start) & (times < end)] = 0
        batch = projector.points([packet.tobytes() for packet in packets], times - times[0])
        clouds.append(batch.points)
        instants.append(times[0] + batch.first_s + batch.points["time"].astype(np.float64))
        counts.append(batch.counts)
        starts.append(times)
        heads.append(packets["com_horizontal_angle_start"].astype(np.float64))
    head, start_s = np.concatenate(heads), np.concatenate(starts)
    cuts = np.concatenate(([0], np.flatnonzero(np.abs(np.diff(head)) > np.pi) + 1, [len(head)]))
    upto = np.concatenate(([0], np.cumsum(np.concatenate(counts))))
    edges = upto[cuts]
    cloud, when = np.concatenate(clouds), np.concatenate(instants)
    length = 299 * wire.MIRROR_PERIOD_S / 600.0
    spans = np.stack([start_s[cuts[:-1]], start_s[cuts[1:] - 1] + length], axis=1)
    points = np.zeros(len(cloud), CLOUD_POINT)
    for name in ("x", "y", "z", "intensity"):
        points[name] = cloud[name]
    for k, (first, last) in enumerate(pairwise(edges.tolist())):
        if last > first:
            spans[k, 0] = when[first]
            points["time"][first:last] = when[first:last] - when[first]
    return points, edges, EPOCH + np.round(spans * 1e9).astype(np.int64)


def _other(
    given: Scenario, setting: Setting
) -> tuple[NDArray[np.void], NDArray[np.int64], NDArray[np.int64]]:
    """Measure with another sensor; return points, edges and spans of its clouds."""
    sensor = SENSORS[given.sensor]
    clouds = []
    for k in range(int(given.seconds / sensor.sweep_s)):
        at = k * sensor.sweep_s
        cloud = sensor.measure(setting.world, setting.motion, k, given.seed, given.particles)
        if any(start <= at < end for start, end in setting.covered):
            cloud = cloud[:0]
        clouds.append(cloud)
    edges = np.cumsum([0, *(len(cloud) for cloud in clouds)])
    starts = EPOCH + np.round(np.arange(len(clouds)) * sensor.sweep_s * 1e9).astype(np.int64)
    last = float(sensor.beams(0)[0][-1])
    spans = np.stack([starts, starts + round(last * 1e9)], axis=1)
    return np.concatenate(clouds), edges, spans


def _unit(given: Scenario) -> Unit:
    """Return the unit that measures."""
    return named_unit(str(given.seed) if given.drawn_unit else "perfect")


def _reported(given: Scenario, true: NDArray[np.void]) -> NDArray[np.void]:
    """Return the calibration that the packets carry, which is not the unit's own."""
    reported = true.copy()
    if given.imperfect and not given.drawn_unit:
        fault = Imperfections()
        signs = np.random.default_rng((given.seed, 23)).choice([-1.0, 1.0], 3)
        reported["beta_angle"] += signs[0] * fault.beam_rad
        reported["xi_angle"] += signs[1] * fault.beam_rad
        reported["range_scale"] *= 1.0 + signs[2] * fault.range_scale
    return reported


def _lost(rng: np.random.Generator, total: int) -> NDArray[np.bool_]:
    """Return which packets are lost, in runs of one to five."""
    lost = np.zeros(total, np.bool_)
    for at in np.flatnonzero(rng.random(total) < Imperfections().packets_lost / 3.0):
        lost[at : at + rng.integers(1, 6)] = True
    return lost


def _samples(given: Scenario, setting: Setting) -> NDArray[np.void]:
    """Return the IMU samples, with the unit's imperfections."""
    unit = _unit(given)
    motion = on_its_mount(setting.motion, unit, given.seed)
    inertial = Inertial(motion, setting.imu, given.seed, unit)
    raw, times = inertial.samples(0, int(given.seconds * wire.IMU_RATE_HZ))
    samples = np.zeros(len(raw), IMU_SAMPLE)
    samples["orientation_wxyz"] = raw["quaternion_wxyz"] / wire.QUATERNION_NORM
    rate = raw["angular_velocity"].astype(np.float64)
    force = raw["linear_acceleration"].astype(np.float64)
    if given.imperfect:
        fault = Imperfections()
        rng = np.random.default_rng((given.seed, 24))
        for frequency in (37.0, 71.0, 113.0):
            phase = 2.0 * np.pi * (frequency * times[:, None] + rng.random((1, 3)))
            force += fault.shake_force * rng.normal(size=3) * np.sin(phase)
            rate += fault.shake_rate * rng.normal(size=3) * np.sin(phase + 1.0)
        turn = _small_turn(rng, fault.extrinsic_rad)
        if not given.drawn_unit:
            rate, force = rate @ turn, force @ turn
            times = times + fault.imu_late_s
        kept = np.ones(len(times), np.bool_)
        gaps = round(fault.imu_gaps * given.seconds / 60.0)
        for at in rng.uniform(min(3.0, given.seconds), given.seconds, gaps):
            kept &= (times < at) | (times > at + rng.uniform(0.02, 0.06))
        samples, rate, force, times = samples[kept], rate[kept], force[kept], times[kept]
    samples["stamp"] = EPOCH + np.round(times * 1e9).astype(np.int64)
    samples["angular_velocity"], samples["linear_acceleration"] = rate, force
    return samples


def _small_turn(rng: np.random.Generator, angle: float) -> F64:
    """Return a rotation matrix about a random axis."""
    x, y, z = rng.normal(size=3)
    axis = np.array([x, y, z]) / np.linalg.norm([x, y, z])
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k)
