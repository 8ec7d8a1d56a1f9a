"""Measures how far deskewed points are from where they should be, and what deskewing costs.

``make bench-deskew`` prints the table and writes ``out/bench/deskew.json``; with ``--docs`` it
also draws ``docs/deskew.png`` and puts the tables into ``docs/deskew.md``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from kiss_icp.pybind import kiss_icp_pybind
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks import calibration_units, deskew_rounds
from benchmarks.results import (
    Target,
    at_least,
    at_most,
    machine,
    publish,
    replaced,
    table,
    verdicts,
)
from l2lidar_node import rotations
from l2lidar_node.emulator.unit.inertial import ImuNoise
from l2lidar_node.settings import build
from l2lidar_node.types import F64, HostNs
from l2lidar_proc.cloud import positions
from l2lidar_proc.deskew.config import ProcConfig
from l2lidar_proc.deskew.deskew import deskew
from l2lidar_proc.deskew.pipeline import Pipeline
from l2lidar_proc.motion.config import MotionConfig
from l2lidar_proc.motion.imu_buffer import replay
from l2lidar_proc.motion.tracker import MotionTracker
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.odometry import Odometry
from tests.support import odometry_runs
from tests.support.deskew_scenarios import Recording, Scenario, TrueSweep, record, stamp
from tests.support.odometry_runs import Run

METHODS: Final = (
    "none",
    "per packet",
    "KISS ideal",
    "gyro only",
    "odometry",
    "true velocity",
)
_CLEAN: Final = ImuNoise.clean()
_WALK: Final = Scenario("walk 0.7 m/s", "walk", 0.7)

SCENARIOS: Final = (
    Scenario("still", "still", 0.0, imu=ImuNoise()),
    Scenario("pure rotation 3 rad/s", "pivot", 3.0),
    Scenario("spin 0.5 rad/s", "spin", 0.5),
    Scenario("spin 1 rad/s", "spin", 1.0),
    Scenario("spin 3 rad/s", "spin", 3.0),
    Scenario("walk 0.35 m/s", "walk", 0.35),
    _WALK,
    Scenario("walk 1.2 m/s", "walk", 1.2),
    Scenario("trot 0.8 m/s", "trot", 0.8),
    Scenario("drone 1 m/s", "drone", 1.0),
    replace(
        _WALK, name="walk, gyro bias 0.03", imu=replace(_CLEAN, gyro_bias=(0.03, -0.03, 0.03))
    ),
    replace(_WALK, name="walk, IMU noise", imu=ImuNoise()),
    Scenario("spin 3, IMU noise", "spin", 3.0, imu=ImuNoise()),
    replace(_WALK, name="walk, 10 ms IMU gaps", gap_s=0.010),
    replace(_WALK, name="walk, 5 % packet loss", loss=0.05),
    replace(_WALK, name="walk, mounted forward", mount="forward"),
    replace(_WALK, name="walk, mounted tilted", mount="tilted"),
)
_WALLS_S: Final = 14.0
_PATCH_M: Final = 0.5
_PATCH_POINTS: Final = 60
_SETTLED_S: Final = 4.0  # rest and start of the motion are over; judged from here on


def main() -> None:
    """Measure everything and write it down."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--docs", action="store_true", help="write docs/deskew.{md,png} as well")
    parser.add_argument("--no-node", action="store_true", help="leave the latency of the node out")
    parser.add_argument("--units", action="store_true", help="the walls of units alone")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    if arguments.units:
        rows = walls()
        publish("deskew_units", "Thickness of walls in deskewed sweeps, mm", rows, _thin(rows))
        if arguments.docs:
            write_units(rows)
        return
    shown = {}
    for scenario in SCENARIOS:
        recording = record(scenario)
        errors, clouds = evaluate(recording)
        rows += _rows(scenario, errors)
        shown[scenario.name] = clouds
        print(f"{scenario.name}: done", flush=True)
    costs = cost(record(replace(_WALK, seconds=5.0)))
    changed = _changed_bits(record(SCENARIOS[0]))
    of_units = walls()
    targets = [*_targets(rows), *_cost_targets(costs), *_thin(of_units)]
    targets.append(at_most("sweeps of a still sensor that changed", changed, 0))
    if not arguments.no_node:
        from benchmarks.deskew_rounds import latency_ms

        milliseconds = latency_ms()
        targets.append(at_most("sweep end to published cloud, p99, ms", milliseconds, 15.0))
    real = deskew_rounds.newer_college()
    targets += [at_most(f"{name}, median, mm", after, bound) for name, _, after, bound in real]
    rows += of_units
    publish("deskew", "RMS and 95th percentile of the error of deskewed points, mm", rows, targets)
    for name, value in costs.items():
        print(f"{name}: {value:.2f}")
    if arguments.docs:
        write(rows, targets, costs, real, shown["walk 1.2 m/s"])
        write_units(of_units)


def evaluate(recording: Recording) -> tuple[dict[str, list[F64]], dict[str, F64]]:
    """Return the errors of every method.

    Returns
    -------
    errors : dict of list of ndarray
        By method, for each settled sweep the distance of each point from its true place [m].
    clouds : dict of ndarray, shape (N, 3)
        The last sweep by method, and the truth.
    """
    errors: dict[str, list[F64]] = {method: [] for method in METHODS}
    trackers = {name: MotionTracker(MotionConfig()) for name in METHODS[3:]}
    odometry = Odometry(OdometryConfig(), MotionConfig().T_cloud_imu)
    clouds: dict[str, F64] = {}
    scans = (item.sweep for item in recording.sweeps)
    replayed = replay(scans, recording.samples)
    for item, (_, samples) in zip(recording.sweeps, replayed, strict=True):
        for first in range(0, len(samples), 5):
            part = samples[first : first + 5]
            for tracker in trackers.values():
                tracker.imu(part)
            odometry.imu(part)
        for instant, velocity in _true_velocities(recording, item):
            trackers["true velocity"].velocity(instant, velocity, "truth")
        if item.start_s >= _SETTLED_S:
            clouds = {
                "none": positions(item.sweep.points),
                "per packet": _per_packet(recording, item),
                **{name: _ours(tracker, item) for name, tracker in trackers.items()},
            }
            for name, cloud in clouds.items():
                errors[name].append(np.linalg.norm(cloud - item.at_start, axis=1))
            kiss = _kiss(recording, item)
            errors["KISS ideal"].append(np.linalg.norm(kiss - item.at_end, axis=1))
            clouds["truth"] = item.at_start
        _follow(odometry, trackers["odometry"], item)
    return errors, clouds


def _follow(odometry: Odometry, tracker: MotionTracker, item: TrueSweep) -> None:
    """Let the odometry tell the tracker how the sensor moved: of use from the next sweep on."""
    for estimate in odometry.register(item.sweep):
        tracker.velocity(estimate.stamp, estimate.velocity, "odometry")


def _ours(tracker: MotionTracker, item: TrueSweep) -> F64:
    path, _ = tracker.trajectory(item.sweep.start, item.sweep.end)
    return positions(deskew(item.sweep.points, item.sweep.start, path, item.sweep.start))


def _true_velocities(recording: Recording, item: TrueSweep) -> list[tuple[HostNs, F64]]:
    """Return the true velocities of a sweep at 50 Hz, with their instants."""
    times = np.arange(item.start_s, item.end_s + 0.02, 0.02)
    velocities = recording.motion.kinematics(times).velocity_body
    return [(stamp(t), v) for t, v in zip(times.tolist(), velocities, strict=True)]


def _per_packet(recording: Recording, item: TrueSweep) -> F64:
    """Turn every packet by the newest onboard orientation: what a driver's leveling can do."""
    packets = np.array([stamp(t) for t in np.unique(item.packet_start_s)])
    newest = np.searchsorted(recording.samples["stamp"], packets, side="right") - 1
    q = rotations.normalised(recording.samples["orientation_wxyz"][np.maximum(newest, 0)])
    turn = rotations.matrices(rotations.multiply(rotations.conjugate(q[0]), q))
    packet = np.unique(item.packet_start_s, return_inverse=True)[1]
    return np.asarray(np.einsum("nij,nj->ni", turn[packet], positions(item.sweep.points)))


def _kiss(recording: Recording, item: TrueSweep) -> F64:
    """Let kiss-icp's preprocessing move the points to the end, given the true motion."""
    delta = _pose(recording, item.start_s, item.end_s)
    vector = kiss_icp_pybind._Vector3dVector(positions(item.sweep.points))
    times = item.sweep.points["time"].astype(np.float64)
    return np.asarray(
        kiss_icp_pybind._Preprocessor(1e6, 0.0, True, 1)._preprocess(vector, times, delta)
    )


def _pose(recording: Recording, start_s: float, end_s: float) -> F64:
    """Return the true transform from the frame at the end to the frame at the start, (4, 4)."""
    positions, q = recording.motion.poses(np.array([start_s, end_s]))
    ends = [rotations.transform(q[i], positions[i]) for i in range(2)]
    return rotations.inverse(ends[0]) @ ends[1]


def walls() -> list[dict[str, Any]]:
    """Return how thick walls are in deskewed sweeps of three units, with their range noise."""
    rows = []
    for name, unit, file in (
        ("perfect unit", "perfect", None),
        ("typical unit", calibration_units.TYPICAL, None),
        ("typical unit calibrated", calibration_units.TYPICAL, calibration_units.calibrated()),
    ):
        run = calibration_units.recorded("room", "walk", 0, _WALLS_S, unit, file)
        row: dict[str, Any] = {"scenario": name, "figure": "wall", **dict.fromkeys(METHODS, "")}
        for method, found in _thicknesses(run).items():
            row[method] = round(1e3 * float(np.median(found)), 2)
        rows.append(row)
    return rows


def _thicknesses(run: Run) -> dict[str, F64]:
    """Return the thickness of every flat patch of every settled sweep, by method [m]."""
    trackers = {name: MotionTracker(MotionConfig()) for name in ("gyro only", "odometry")}
    odometry = Odometry(OdometryConfig(), MotionConfig().T_cloud_imu)
    found: dict[str, list[F64]] = {"none": [], **{name: [] for name in trackers}}
    for sweep, samples in replay(odometry_runs.sweeps(run, "turn"), run.imu):
        for first in range(0, len(samples), 5):
            part = samples[first : first + 5]
            for tracker in trackers.values():
                tracker.imu(part)
            odometry.imu(part)
        if sweep.start - odometry_runs.EPOCH >= _SETTLED_S * 1e9:
            found["none"].append(_flat_patches(positions(sweep.points)))
            for name, tracker in trackers.items():
                path, _ = tracker.trajectory(sweep.start, sweep.end)
                points = deskew(sweep.points, sweep.start, path, sweep.start)
                found[name].append(_flat_patches(positions(points)))
        for estimate in odometry.register(sweep):
            trackers["odometry"].velocity(estimate.stamp, estimate.velocity, "odometry")
    return {name: np.concatenate(parts) for name, parts in found.items()}


def _flat_patches(xyz: F64) -> F64:
    """Return the thickness of the flat cells of a cloud (N, 3): one standard deviation [m]."""
    cells = np.floor(xyz / _PATCH_M).astype(np.int64)
    order = np.lexsort(cells.T)
    cells, points = cells[order], xyz[order]
    first = np.flatnonzero(np.r_[True, (np.diff(cells, axis=0) != 0).any(axis=1)])
    counts = np.diff(np.append(first, len(points)))
    mean = np.add.reduceat(points, first) / counts[:, None]
    away = points - np.repeat(mean, counts, axis=0)
    spread = np.add.reduceat(away[:, :, None] * away[:, None, :], first) / counts[:, None, None]
    values = np.linalg.eigvalsh(spread[counts >= _PATCH_POINTS])
    flat = (values[:, 0] < 0.05 * values[:, 1]) & (values[:, 1] > 0.02 * _PATCH_M**2)
    return np.asarray(np.sqrt(np.maximum(values[flat, 0], 0.0)))


def _thin(rows: list[dict[str, Any]]) -> list[Target]:
    by_name = {row["scenario"]: row["odometry"] for row in rows}
    value = by_name["typical unit calibrated"] / by_name["perfect unit"]
    return [at_most("walls of a calibrated unit over those of a perfect one", value, 1.1)]


def cost(recording: Recording, rounds: int = 100) -> dict[str, float]:
    """Return milliseconds for a full turn of 15,000 points on one core, the best of many."""
    item = recording.sweeps[-2]
    tracker = MotionTracker(MotionConfig())
    for first in range(0, len(recording.samples), 10):
        tracker.imu(recording.samples[first : first + 10])
    for instant, velocity in _true_velocities(recording, recording.sweeps[-3])[:6]:
        tracker.velocity(instant, velocity, "truth")
    assert not tracker.trajectory(item.sweep.start, item.sweep.end)[1].is_still
    delta = _pose(recording, item.start_s, item.end_s)
    xyz = positions(item.sweep.points)
    vector = kiss_icp_pybind._Vector3dVector(xyz)
    times = item.sweep.points["time"].astype(np.float64)
    kiss = kiss_icp_pybind._Preprocessor(1e6, 0.0, True, 1)
    jobs: dict[str, Callable[[], object]] = {
        "ours, path and points": lambda: _timed_ours(tracker, item),
        "kiss-icp preprocess from an array": lambda: np.asarray(
            kiss._preprocess(kiss_icp_pybind._Vector3dVector(xyz), times, delta)
        ),
        "kiss-icp preprocess alone": lambda: kiss._preprocess(vector, times, delta),
    }
    best = dict.fromkeys(jobs, np.inf)
    for _ in range(rounds):  # in turns, so that all of them meet the same neighbors
        for name, job in jobs.items():
            begin = time.perf_counter()
            job()
            best[name] = min(best[name], 1e3 * (time.perf_counter() - begin))
    best["points"] = float(len(xyz))
    return best


def _timed_ours(tracker: MotionTracker, item: TrueSweep) -> None:
    path, _ = tracker.trajectory(item.sweep.start, item.sweep.end)
    deskew(item.sweep.points, item.sweep.start, path, item.sweep.start)


def _rows(scenario: Scenario, errors: dict[str, list[F64]]) -> list[dict[str, Any]]:
    rms: dict[str, Any] = {"scenario": scenario.name, "figure": "RMS"}
    far: dict[str, Any] = {"scenario": scenario.name, "figure": "p95"}
    for method, found in errors.items():
        millimeters = 1e3 * np.concatenate(found)
        rms[method] = round(float(np.sqrt((millimeters**2).mean())), 2)
        far[method] = round(float(np.quantile(millimeters, 0.95)), 2)
    return [rms, far]


def _targets(rows: list[dict[str, Any]]) -> list[Target]:
    by_name = {row["scenario"]: row for row in rows if row["figure"] == "RMS"}
    moving = [row for name, row in by_name.items() if name != "still"]
    clean = [row for row in moving if "noise" not in row["scenario"]]
    traveling = [row for row in moving if "pure rotation" not in row["scenario"]]
    found = []
    for method in ("odometry", "true velocity"):
        worst = max(row[method] for row in clean)
        found.append(at_most(f"{method}: worst RMS without IMU noise, mm", worst, 10.0))
        least = min(row["none"] / max(row[method], 0.01) for row in traveling)
        found.append(at_least(f"{method}: least gain over no deskew", least, 10.0))
    pure = by_name["pure rotation 3 rad/s"]
    for method in ("gyro only", "odometry"):
        found.append(at_most(f"{method}: pure rotation at 3 rad/s, mm", pure[method], 5.0))
    found.append(
        at_most("spin 3 rad/s with odometry, mm", by_name["spin 3 rad/s"]["odometry"], 5.0)
    )
    return found


def _cost_targets(costs: dict[str, float]) -> list[Target]:
    return [at_most("deskew of a full turn, ms", costs["ours, path and points"], 2.0)]


def _changed_bits(recording: Recording) -> int:
    """Return how many sweeps of a still sensor do not come out bit for bit."""
    pipeline = Pipeline(build(ProcConfig, {"keep_time": True}))
    changed = 0
    for sweep, samples in replay((item.sweep for item in recording.sweeps), recording.samples):
        pipeline.imu(samples)
        pipeline.sweep(sweep, 0)
        (done,) = pipeline.poll(0)
        changed += done.points.tobytes() != sweep.points.tobytes()
    return changed


PAGE: Final = Path("docs") / "deskew.md"
PICTURE: Final = Path("docs") / "deskew.png"


def write(
    rows: Sequence[dict[str, Any]],
    targets: Sequence[Target],
    costs: dict[str, float],
    real: Sequence[tuple[str, float, float, float]],
    clouds: dict[str, F64],
) -> None:
    """Replace tables and picture.

    Parameters
    ----------
    rows : sequence of dict
        RMS and p95 of each scenario: error of every method [mm].
    targets : sequence of Target
    costs : dict of float
        [ms] by what was timed.
    real : sequence
        Name, error before and after, bound [mm] of real scans.
    clouds : dict of ndarray, shape (N, 3)
        One sweep as different methods leave it, and the truth.
    """
    text = PAGE.read_text(encoding="utf-8")
    text = replaced(text, "errors", _errors(rows))
    text = replaced(text, "targets", verdicts(targets))
    text = replaced(text, "costs", _costs(costs))
    text = replaced(text, "real", _real(real))
    PAGE.write_text(text, encoding="utf-8")
    _draw(clouds)


def write_units(rows: Sequence[dict[str, Any]]) -> None:
    """Replace the table of how thick walls are [mm], by unit and method."""
    methods = [name for name, value in rows[0].items() if isinstance(value, float)]
    walls = table(
        ["walls [mm]", *methods],
        ([row["scenario"], *(f"{row[name]:.1f}" for name in methods)] for row in rows),
    )
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replaced(text, "units", walls), encoding="utf-8")


def _errors(rows: Sequence[dict[str, Any]]) -> str:
    methods = [name for name in rows[0] if name not in ("scenario", "figure")]
    far = {row["scenario"]: row for row in rows if row["figure"] == "p95"}
    lines = []
    for row in rows:
        if row["figure"] == "RMS":
            pairs = (f"{row[m]:.1f} / {far[row['scenario']][m]:.1f}" for m in methods)
            lines.append([row["scenario"], *pairs])
    return table(["RMS / p95 [mm]", *methods], lines)


def _costs(costs: dict[str, float]) -> str:
    rows = [[name, f"{value:.2f}"] for name, value in costs.items() if name != "points"]
    times = table([f"{costs['points']:.0f} points on one core", "ms"], rows)
    return f"{times}\n\nMeasured on one core of an {machine()['processor']}, the best of 100."


def _real(real: Sequence[tuple[str, float, float, float]]) -> str:
    rows = [[n, f"{a:.0f}", f"{b:.1f}", f"{c:.0f}"] for n, a, b, c in real]
    return table(["median error [mm]", "raw", "ours", "constant rate and velocity"], rows)


def _draw(clouds: dict[str, F64]) -> None:
    shown = {"as measured": "none", "gyro only": "gyro only", "with odometry": "odometry"}
    figure = Figure(figsize=(11, 4.2), dpi=85, layout="constrained")
    FigureCanvasAgg(figure)
    truth = clouds["truth"]
    inside = (truth[:, 2] > -0.3) & (truth[:, 2] < 1.6)
    for place, (title, method) in enumerate(shown.items(), start=1):
        plan = figure.add_subplot(1, 3, place)
        error = 1e3 * np.linalg.norm(clouds[method] - truth, axis=1)[inside]
        x, y, _ = clouds[method][inside].T
        plan.scatter(truth[inside, 0], truth[inside, 1], s=3.0, c="0.75", linewidths=0)
        dots = plan.scatter(x, y, s=3.0, c=error, cmap="turbo", vmin=0, vmax=400, linewidths=0)
        plan.set_aspect("equal")
        plan.set_title(f"{title}: RMS {np.sqrt((error**2).mean()):.1f} mm", fontsize=10)
        plan.tick_params(labelsize=7)
    figure.colorbar(dots, ax=figure.axes, label="error [mm]", shrink=0.8)
    figure.savefig(PICTURE)


if __name__ == "__main__":
    main()
