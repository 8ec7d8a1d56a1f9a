"""Deskews what the emulator cannot show: real scans with a reference, and clouds through the node.

The node: how long after the end of a sweep its cloud is out.

The scans: three of the Newer College data, kept outside this repository. They carry no IMU
samples, so the motion is fitted: rates and forces of an IMU, and the first velocity, that bring a
few hundred points to their reference; all points are judged.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Final

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from scipy.optimize import least_squares
from sensor_msgs.msg import Imu, PointCloud2

from l2lidar_node.config import ImuConfig
from l2lidar_node.demo.processes import Programs, isolate_ros
from l2lidar_node.ros.conversions import CloudTemplate, ImuTemplate, from_time
from l2lidar_node.types import F64, IMU_SAMPLE, POINT, HostNs, ImuSample
from l2lidar_proc.deskew.deskew import deskew
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.motion.preintegration import integrate, segment
from l2lidar_proc.motion.sweep_motion import SweepTrajectory
from tests.support.deskew_scenarios import Recording, Scenario, record

FOLDER: Final = Path(__file__).resolve().parents[2] / "shared" / "data" / "newer_college"
BOUNDS_MM: Final = (31.0, 6.0, 20.0)  # what a fit with one constant rate and velocity leaves

_START: Final = HostNs(1_600_000_000_000_000_000)
_SPAN_S: Final = 0.1
_RATES: Final = 6
_FORCES: Final = 2


def newer_college(scans: tuple[int, ...] = (0, 1, 2)) -> list[tuple[str, float, float, float]]:
    """Return name, median error before and after [mm] and bound of each scan there is."""
    found = []
    for number in scans:
        if not (FOLDER / f"raw_0{number}.bin").exists():
            continue
        raw, times, expected = _scan(number)
        path = _fitted(raw, times, expected)
        points = np.zeros(len(raw), dtype=POINT)
        points["x"], points["y"], points["z"] = raw.T
        points["time"] = times
        order = np.argsort(times, kind="stable")
        moved = deskew(points[order], _START, path, _START)
        cloud = np.stack([moved[axis] for axis in "xyz"], axis=-1)
        before = 1e3 * float(np.median(np.linalg.norm(raw - expected, axis=1)))
        after = 1e3 * float(np.median(np.linalg.norm(cloud - expected[order], axis=1)))
        found.append((f"Newer College scan {number}", before, after, BOUNDS_MM[number]))
    return found


def _scan(number: int) -> tuple[F64, F64, F64]:
    """Return raw points (N, 3) in the frame of the reference, times [s] (N,), reference (N, 3)."""
    raw = np.fromfile(FOLDER / f"raw_0{number}.bin", np.float32).reshape(-1, 3)
    times = np.fromfile(FOLDER / f"times_0{number}.bin", np.float32)
    expected = np.fromfile(FOLDER / f"deskewed_0{number}.bin", np.float32).reshape(-1, 3)
    usable = np.isfinite(raw).all(axis=1) & np.isfinite(expected).all(axis=1)
    turned = raw[usable].astype(np.float64) * (-1.0, -1.0, 1.0)
    return turned, times[usable].astype(np.float64), expected[usable].astype(np.float64)


def _fitted(raw: F64, times: F64, expected: F64) -> SweepTrajectory:
    chosen = np.random.default_rng(0).choice(len(raw), 500, replace=False)
    stamps = _START + np.round(times[chosen] * 1e9).astype(np.int64)

    def residuals(motion: F64) -> F64:
        q, p = _path(motion).poses(stamps)
        w, u = q[:, :1], q[:, 1:]
        t = 2.0 * np.cross(u, raw[chosen])
        moved = raw[chosen] + w * t + np.cross(u, t) + p
        return np.asarray((moved - expected[chosen]).ravel())

    unknowns = np.zeros(3 * (_RATES + _FORCES + 1))
    fit = least_squares(residuals, unknowns, loss="soft_l1", f_scale=0.02, max_nfev=40)
    return _path(fit.x)


def _path(motion: F64) -> SweepTrajectory:
    samples = np.zeros(_RATES, dtype=IMU_SAMPLE)
    at = np.linspace(0.0, 1.0, _RATES)
    samples["stamp"] = _START + np.round(at * _SPAN_S * 1e9).astype(np.int64)
    rates, forces, (velocity,) = np.split(motion.reshape(-1, 3), (_RATES, _RATES + _FORCES))
    samples["angular_velocity"] = rates
    samples["linear_acceleration"] = forces[0] + at[:, None] * (forces[1] - forces[0])
    nothing = np.zeros(3)
    state = InertialState(_START, np.eye(3), nothing, velocity, nothing, nothing, nothing)
    end = HostNs(_START + round(_SPAN_S * 1e9))
    imu = segment(samples, [_START, end], 10**9, nothing)
    preintegrated = integrate(
        imu, 0, gyro_bias=nothing, accel_bias=nothing, rest_force=state.rest_force
    )
    return SweepTrajectory.of(preintegrated, state, nothing)


_WAIT_S = 20.0
_FIELDS = ("orientation_wxyz", "angular_velocity", "linear_acceleration")


class _Bench(Node):  # type: ignore[misc]  # rclpy has no types
    """Sends a recording in real time and notes when what comes back."""

    def __init__(self) -> None:
        super().__init__("deskew_latency")
        self._cloud = CloudTemplate(POINT, "l2lidar_link")
        self._imu = ImuTemplate("l2lidar_imu", ImuConfig())
        self.clouds = self.create_publisher(PointCloud2, "/points", QoSProfile(depth=10))
        self.samples = self.create_publisher(Imu, "/imu/data", QoSProfile(depth=200))
        self.create_subscription(PointCloud2, "points_deskewed", self._back, QoSProfile(depth=10))
        self.came: dict[int, int] = {}

    def _back(self, message: PointCloud2) -> None:
        self.came[from_time(message.header.stamp)] = time.monotonic_ns()

    def play(self, recording: Recording) -> dict[int, int]:
        """Send everything at its time; return when each sweep and its IMU samples were there."""
        origin = int(recording.samples["stamp"][0])
        begin = time.monotonic_ns()
        events = [(int(row["stamp"]), row) for row in recording.samples]
        events += [(int(item.sweep.end), item.sweep) for item in recording.sweeps]
        sent: dict[int, int] = {}
        waiting: dict[int, int] = {}
        for stamp, what in sorted(events, key=lambda event: event[0]):
            pause = (begin + stamp - origin - time.monotonic_ns()) * 1e-9
            if pause > 0:
                time.sleep(pause)
            if isinstance(what, np.void):
                q, rate, force = (tuple(what[name].tolist()) for name in _FIELDS)
                self.samples.publish(self._imu.serialize(ImuSample(HostNs(stamp), q, rate, force)))
                for start in [start for start, end in waiting.items() if stamp >= end]:
                    sent[start] = time.monotonic_ns()
                    del waiting[start]
            else:
                self.clouds.publish(self._cloud.serialize(what.points, what.start))
                waiting[int(what.start)] = int(what.end)
        return sent


def latency_ms(seconds: float = 40.0) -> float:
    """Return the 99th percentile [ms] of a run: from the last input a cloud needs to the cloud."""
    recording = record(Scenario("latency", "walk", 0.7, seconds=seconds))
    isolate_ros()
    rclpy.init()
    node = _Bench()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    with Programs() as programs:
        programs.start("l2lidar_proc.ros.deskew_node", [])
        deadline = time.monotonic() + _WAIT_S
        while not (node.clouds.get_subscription_count() and node.samples.get_subscription_count()):
            programs.check()
            if time.monotonic() > deadline:
                raise TimeoutError("the deskew node did not subscribe")
            time.sleep(0.1)
        sent = node.play(recording)
        time.sleep(0.5)
        programs.check()
    executor.shutdown()
    thread.join()
    node.destroy_node()
    rclpy.try_shutdown()
    delays = [1e-6 * (node.came[start] - at) for start, at in sent.items() if start in node.came]
    if len(delays) < 0.98 * len(sent):
        raise RuntimeError(f"{len(sent) - len(delays)} of {len(sent)} clouds did not come back")
    print(f"latency of {len(delays)} clouds: median {np.median(delays):.1f} ms")
    return float(np.quantile(delays[5:], 0.99))
