"""The odometries that are compared, what is to be run of them, and the file of what was found."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.results import KeptRows
from l2lidar_node.protocol import wire
from l2lidar_node.types import F64, HostNs, Sweep
from l2lidar_proc.cloud import positions
from l2lidar_proc.deskew.config import DeskewConfig, ProcConfig
from l2lidar_proc.deskew.pipeline import Deskewed, Pipeline
from l2lidar_proc.motion.imu_buffer import replay
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.kiss import PlainKiss, PlainOdometry
from l2lidar_proc.odometry.odometry import LIBRARIES, Odometry
from tests.support import odometry_runs
from tests.support.odometry_runs import CUTS, Run

OURS = "ours"
PLAIN = "kiss-icp"
DESKEWED = "kiss-icp, our deskew"
TYPICAL = "ours, typical unit"
CALIBRATED = "ours, typical unit calibrated"
REFEREES = ("rko_lio", "genz_lio", "ct_icp", "lio_sam")
PACKAGES = ("numpy", "rko_lio", "genz-lio", "evalio")
FOLDER = Path("out") / "referees"
_LIMIT_S = 600  # of processor time
# LIO-SAM crashes by chance where its first sweep has fewer than five edges: it may begin with
# another one, during the rest at the beginning.
_TRIES = 6
# As evalio builds it, it also reads array elements that it has not set, or that lie before the
# beginning: this sets them to 0, and lets no array have a mapping of its own.
_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "MALLOC_PERTURB_": "255",
    "MALLOC_MMAP_THRESHOLD_": str(32 << 20),
}


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What an odometry made of a recording.

    Attributes
    ----------
    stamps : ndarray, shape (N,), int64
    poses : ndarray, shape (N, 4, 4)
        Cloud frame to the odometry's own.
    seconds : float
        Processor time of all threads: on an idle machine it takes no longer than that.
    """

    stamps: NDArray[np.int64]
    poses: F64
    seconds: float


def run_method(name: str, run: Run, cut: str) -> Found | None:
    """Return what a method finds, None where it gives up."""
    if name in REFEREES:
        return _referee(name, run, cut)
    some = list(odometry_runs.sweeps(run, cut))
    load_libraries()
    begin = time.process_time()
    poses = {
        OURS: _ours, TYPICAL: _ours, CALIBRATED: _ours, PLAIN: _plain, DESKEWED: _deskewed
    }[name](run, some)  # fmt: skip
    seconds = time.process_time() - begin
    stamps = np.array([stamp for stamp, _ in poses], dtype=np.int64)
    return Found(stamps, np.array([pose for _, pose in poses]), seconds)


def load_libraries() -> None:
    """Import what our odometry imports with its first sweep: nobody's imports are timed."""
    for name in LIBRARIES:
        import_module(name)


def referee_python() -> Path | None:
    """Return the Python that has the referees, None where they are not installed."""
    path = FOLDER / "bin" / "python"
    return path if path.exists() else None


def install_referees() -> None:
    """Make a virtual environment with the referees: benchmarks of this measurement only."""
    subprocess.run(["python3", "-m", "venv", str(FOLDER)], check=True)
    subprocess.run([str(FOLDER / "bin" / "pip"), "install", "--quiet", *PACKAGES], check=True)


def _ours(run: Run, some: list[Sweep]) -> list[tuple[int, F64]]:
    T_cloud_imu = np.eye(4)
    T_cloud_imu[:3, 3] = wire.IMU_POSITION_M
    odometry = Odometry(OdometryConfig(), T_cloud_imu)
    out: list[tuple[int, F64]] = []
    for sweep, samples in replay(some, run.imu):
        odometry.imu(samples)
        out += [(item.stamp, item.T_map_lidar) for item in odometry.register(sweep)]
    return out


def _plain(run: Run, some: list[Sweep]) -> list[tuple[int, F64]]:
    odometry = PlainOdometry(OdometryConfig(mode="plain"))
    return [(item.stamp, item.T_map_lidar) for sweep in some for item in odometry.register(sweep)]


def _deskewed(run: Run, some: list[Sweep]) -> list[tuple[int, F64]]:
    """Feed KISS-ICP with clouds deskewed by our node's pipeline, and that with its velocity."""
    pipeline = Pipeline(ProcConfig(deskew=DeskewConfig(reference="end")))
    kiss = PlainKiss(OdometryConfig())
    out: list[tuple[int, F64]] = []
    for sweep, samples in replay(some, run.imu):
        pipeline.imu(samples)
        pipeline.sweep(sweep, sweep.end)
        for item in pipeline.poll(sweep.end + 10**9):
            xyz = positions(item.points)
            kiss.register(xyz[np.linalg.norm(xyz, axis=1) > 0.4], np.empty(0))
            pose = kiss.pose.copy()
            if out:
                dt = (item.stamp - out[-1][0]) * 1e-9
                velocity = pose[:3, :3].T @ (pose[:3, 3] - out[-1][1][:3, 3]) / dt
                pipeline.velocity(HostNs(item.stamp), velocity, "kiss-icp")
            out.append((item.stamp, pose))
    return out


def _deskew_file(run: Run, cut: str, path: Path) -> None:
    """Replace the sweeps of a file by what our deskew node gives LIO-SAM.

    Deskewed to the middle by the IMU alone, stamped there, without times: with
    config/consumers/lio_sam/deskew.yaml nothing tells it a velocity.
    """
    pipeline = Pipeline(ProcConfig(deskew=DeskewConfig(reference="middle")))
    found: list[Deskewed] = []
    for sweep, samples in replay(odometry_runs.sweeps(run, cut), run.imu):
        pipeline.imu(samples)
        pipeline.sweep(sweep, sweep.end)
        found += pipeline.poll(sweep.end + 10**9)
    xyz = [np.stack([item.points[axis] for axis in "xyz"], axis=1) for item in found]
    with np.load(path) as file:
        kept = {name: file[name] for name in ("imu", "T_cloud_imu")}
    np.savez(
        path,
        points=np.concatenate(xyz),
        times=np.zeros(sum(map(len, xyz)), np.float32),
        edges=np.cumsum([0, *map(len, xyz)]),
        spans=np.array([(item.stamp, item.stamp) for item in found], dtype=np.int64),
        **kept,
    )


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (_LIMIT_S, _LIMIT_S))


def _referee(name: str, run: Run, cut: str) -> Found | None:
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "recording.npz"
        odometry_runs.write(run, cut, source)
        if name == "lio_sam":
            _deskew_file(run, cut, source)
        return run_referee(name, source)


def run_referee(name: str, source: Path) -> Found | None:
    """Return what a referee finds in a file of sweeps, None where it gives up.

    Parameters
    ----------
    name : str
        One of :data:`REFEREES`.
    source : Path
        See :mod:`benchmarks.odometry_referee`.
    """
    python = referee_python()
    if python is None:
        return None
    script = Path(__file__).with_name("odometry_referee.py")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "found.npz"
        for skipped in range(_TRIES):
            done = subprocess.run(
                [str(python), str(script), name, str(source), str(target), str(skipped)],
                env={**os.environ, **_ENVIRONMENT},
                preexec_fn=_limit,
                capture_output=True,
                check=False,
            )
            if done.returncode != -signal.SIGSEGV:
                break
        if not target.exists():
            return None
        with np.load(target) as found:
            return Found(found["stamps"], found["poses"], float(found["seconds"]))


SLOW = ("ct_icp", "lio_sam")
KEY = ("scene", "motion", "seed", "seconds", "sweeps", "method")

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Task:
    """What is run over one recording.

    Attributes
    ----------
    scene, motion : str
    seed : int
    seconds : float
    wanted : tuple of (str, str)
        Kind of sweeps and method of each run.
    """

    scene: str
    motion: str
    seed: int
    seconds: float
    wanted: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Plan:
    """Which runs there are.

    Attributes
    ----------
    scenes, motions : tuple of str
    seeds : int
    seconds : float
        Length of a recording.
    sweeps, methods : tuple of str
    referee_seeds : int
        Seeds that the referees get.
    slow_seeds : int
        Seeds that those of :data:`SLOW` get with other sweeps than full turns.
    """

    scenes: tuple[str, ...]
    motions: tuple[str, ...]
    seeds: int
    seconds: float
    sweeps: tuple[str, ...]
    methods: tuple[str, ...]
    referee_seeds: int
    slow_seeds: int

    def tasks(self, done: Sequence[Row] = ()) -> list[Task]:
        """Return what is to be done, without what is.

        First the first seed, then the other seeds without referees, then with them, slow ones
        last: whenever it is cut, what is there can be compared.
        """
        known = {tuple(row[name] for name in KEY) for row in done}
        found = []
        orders = [
            *((rank, 0) for rank in (0, 1)),
            *((rank, seed) for rank in (0, 1) for seed in range(1, self.seeds)),
            *((2, seed) for seed in range(self.seeds)),
        ]
        for (rank, seed), scene, motion in product(orders, self.scenes, self.motions):
            wanted = tuple(
                (cut, name)
                for cut, name in product(self.sweeps, self.methods)
                if self._rank(seed, cut, name) == rank
                and (scene, motion, seed, self.seconds, cut, name) not in known
            )
            if wanted:
                found.append(Task(scene, motion, seed, self.seconds, wanted))
        return found

    def has(self, row: Row) -> bool:
        """Return whether a row is of this plan."""
        return (
            row["scene"] in self.scenes
            and row["motion"] in self.motions
            and row["seconds"] == self.seconds
            and row["seed"] < self.seeds
            and row["sweeps"] in self.sweeps
            and row["method"] in self.methods
            and self._rank(row["seed"], row["sweeps"], row["method"]) is not None
        )

    def _rank(self, seed: int, cut: str, name: str) -> int | None:
        """Return when a run's turn is: 0 first, None never."""
        if name not in REFEREES:
            return 0
        if seed >= self.referee_seeds:
            return None
        if name not in SLOW or cut == CUTS[0]:
            return 1
        return 2 if seed < self.slow_seeds else None


@dataclass(frozen=True, slots=True)
class Rows(KeptRows):
    """The rows of the odometry's runs."""

    path: Path = Path("out") / "bench" / "odometry.jsonl"
    key: tuple[str, ...] = KEY

    def describe(self, row: Row) -> str:
        """Return what is printed of a row."""
        words = ", ".join(str(row[name]) for name in self.key)
        return f"{words}: {1e3 * row['ate_m']:.1f} mm, {row['real_time_factor']:.1f} x real time"
