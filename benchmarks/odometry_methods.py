"""The odometries that are compared: ours, KISS-ICP in two ways, referees in their own Python."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.protocol import wire
from l2lidar_node.types import F64, HostNs, Sweep
from l2lidar_proc.deskew.config import DeskewConfig, ProcConfig
from l2lidar_proc.deskew.pipeline import Deskewed, Pipeline
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.kiss import PlainKiss
from l2lidar_proc.odometry.odometry import Odometry
from l2lidar_proc.odometry.plain import PlainOdometry
from tests.support import odometry_runs
from tests.support.odometry_runs import Run

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
    begin = time.process_time()
    poses = {
        OURS: _ours, TYPICAL: _ours, CALIBRATED: _ours, PLAIN: _plain, DESKEWED: _deskewed
    }[name](run, some)  # fmt: skip
    seconds = time.process_time() - begin
    stamps = np.array([stamp for stamp, _ in poses], dtype=np.int64)
    return Found(stamps, np.array([pose for _, pose in poses]), seconds)


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
    first = 0
    for sweep in some:
        last = int(np.searchsorted(run.imu["stamp"], sweep.end)) + 1
        odometry.imu(run.imu[first:last])
        first = last
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
    first = 0
    for sweep in some:
        last = int(np.searchsorted(run.imu["stamp"], sweep.end)) + 1
        pipeline.imu(run.imu[first:last])
        first = last
        pipeline.sweep(sweep, sweep.end)
        for item in pipeline.poll(sweep.end + 10**9):
            xyz = np.stack([item.points[axis] for axis in "xyz"], axis=1).astype(np.float64)
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
    first = 0
    for sweep in odometry_runs.sweeps(run, cut):
        last = int(np.searchsorted(run.imu["stamp"], sweep.end)) + 1
        pipeline.imu(run.imu[first:last])
        first = last
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
