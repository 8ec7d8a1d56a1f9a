"""Runs another odometry over a recording; a program of its own, in that odometry's own Python.

``python odometry_referee.py NAME RECORDING OUT``: RECORDING is a file of
:mod:`tools.odometry_runs`, OUT gets the arrays ``stamps`` [ns] and ``poses`` (N, 4, 4), cloud
frame to the odometry's own, and ``seconds``. Nothing of this project is imported here, and
nothing here is imported by it: one of the referees is GPL.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

RINGS = 32
COLUMNS = 1800
Poses = list[tuple[int, Any]]


class Recording:
    """Sweeps and IMU samples as the file has them."""

    def __init__(self, path: str) -> None:
        self._file = dict(np.load(path))
        self.imu = self._file["imu"]
        self.T_cloud_imu = self._file["T_cloud_imu"]

    def __iter__(self) -> Iterator[tuple[int, int, Any, Any]]:
        """Yield start [ns], end [ns], points (N, 3) [m] and times (N,) [s] after the start."""
        edges, spans = self._file["edges"], self._file["spans"]
        for first, last, (start, end) in zip(edges[:-1], edges[1:], spans, strict=True):
            points = self._file["points"][first:last].astype(np.float64)
            yield int(start), int(end), points, self._file["times"][first:last].astype(np.float64)

    def samples(self, since: int, until: int) -> Any:
        """Return the IMU samples of a span, stamps from (exclusive) to (inclusive) [ns]."""
        stamps = self.imu["stamp"]
        return self.imu[
            np.searchsorted(stamps, since, "right") : np.searchsorted(stamps, until, "right")
        ]


def rko_lio(recording: Recording) -> Poses:
    """RKO-LIO with a voxel size for rooms; its start-up phase finds the biases."""
    from rko_lio.config import LIOConfig
    from rko_lio.lio import LIO

    lio = LIO(LIOConfig(voxel_size=0.3, min_range=0.4, initialization_phase=True))
    out: Poses = []
    last = -1
    for start, end, points, times in recording:
        for sample in recording.samples(last, end + 4_000_000):
            lio.add_imu_measurement(
                sample["linear_acceleration"],
                sample["angular_velocity"],
                int(sample["stamp"]),
                extrinsic_imu2base=recording.T_cloud_imu,
            )
        last = end + 4_000_000
        stamps = start + np.round(times * 1e9).astype(np.int64)
        lio.register_scan(points, stamps, extrinsic_lidar2base=np.eye(4))
        out.append((int(stamps.max()), np.array(lio.pose())))
    return out


def genz_lio(recording: Recording) -> Poses:
    """GenZ-LIO as it comes; only the extrinsic and the nearest range are set."""
    from genz_lio import Config, GenZLIO

    config = Config()
    config.preprocess.blind_min = 0.4
    T_imu_cloud = np.linalg.inv(recording.T_cloud_imu)
    config.preprocess.scan_rate = 4
    config.mapping.extrinsic_r = T_imu_cloud[:3, :3]
    config.mapping.extrinsic_t = T_imu_cloud[:3, 3]
    lio = GenZLIO(config)
    out: Poses = []
    origin = int(recording.imu["stamp"][0])
    last = origin - 1
    for start, _, points, times in recording:
        end = start + round(float(times[-1]) * 1e9)
        samples = recording.samples(last, end)
        last = end
        seconds = (samples["stamp"] - origin) * 1e-9
        felt = samples["linear_acceleration"], samples["angular_velocity"]
        imu = np.column_stack((seconds, *felt))
        result = lio.register_scan(
            points,
            (start - origin) * 1e-9,
            (end - origin) * 1e-9,
            imu,
            timestamps=times,
        )
        if result.valid:
            out.append(
                (origin + round(result.timestamp * 1e9), np.array(result.pose) @ T_imu_cloud)
            )
    return out


def evalio(name: str, changes: dict[str, Any]) -> Callable[[Recording], Poses]:
    """Return a run of one of evalio's pipelines."""

    def run(recording: Recording) -> Poses:
        from evalio import types
        from evalio._cpp import pipelines

        pipeline = getattr(pipelines, name)()
        # some pipelines read their parameters when initialised, some only afterwards
        settings = {**pipeline.default_params(), **changes}
        pipeline.set_params(settings)
        pipeline.initialize()
        pipeline.set_params(settings)
        pipeline.set_lidar_params(
            types.LidarParams(
                num_rows=RINGS, num_columns=COLUMNS, min_range=0.4, max_range=60.0, rate=4.4
            )
        )
        pipeline.set_imu_params(
            types.ImuParams(
                gyro=2e-3, accel=4e-3, gyro_bias=1e-4, accel_bias=1e-3, bias_init=1e-3, rate=250.0
            )
        )
        pipeline.set_imu_T_lidar(types.SE3.from_mat(np.linalg.inv(recording.T_cloud_imu)))
        out: Poses = []
        last = -1
        for start, end, points, times in recording:
            for sample in recording.samples(last, end + 4_000_000):
                pipeline.add_imu(
                    types.ImuMeasurement(
                        types.Stamp.from_nsec(int(sample["stamp"])),
                        np.ascontiguousarray(sample["angular_velocity"]),
                        np.ascontiguousarray(sample["linear_acceleration"]),
                    )
                )
            last = end + 4_000_000
            pipeline.add_lidar(_measurement(types, start, points, times))
            # most pipelines say where the IMU is, in a frame of their own
            out += [
                (stamp.to_nsec(), pose.to_mat() @ np.linalg.inv(recording.T_cloud_imu))
                for stamp, pose in pipeline.saved_estimates()
            ]
        return out

    return run


def _measurement(types: Any, start: int, points: Any, times: Any) -> Any:
    """Return a sweep with elevation rings, as LIO-SAM sorts points."""
    ranges = np.linalg.norm(points, axis=1)
    elevation = np.arcsin(np.clip(points[:, 2] / np.maximum(ranges, 1e-6), 0.0, 1.0))
    rows = np.minimum((elevation / (np.pi / 2) * RINGS).astype(int), RINGS - 1)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    columns = ((azimuth + np.pi) / (2 * np.pi) * COLUMNS).astype(int) % COLUMNS
    made = [
        types.Point(x=x, y=y, z=z, t=types.Duration.from_nsec(t), range=r, row=row, col=column)
        for (x, y, z), t, r, row, column in zip(
            points.tolist(),
            np.round(times * 1e9).astype(int).tolist(),
            (ranges * 1e3).astype(int).tolist(),
            rows.tolist(),
            columns.tolist(),
            strict=True,
        )
    ]
    return types.LidarMeasurement(types.Stamp.from_nsec(start), made)


REFEREES: dict[str, Callable[[Recording], Poses]] = {
    "rko_lio": rko_lio,
    "genz_lio": genz_lio,
    "ct_icp": evalio("CTICP", {"ls_num_threads": 2}),
    "lio_sam": evalio("LioSAM", {"numberOfCores": 2}),
}


def main() -> int:
    """Run from a command line; return the exit code."""
    name, source, target = sys.argv[1:4]
    recording = Recording(source)
    begin = time.perf_counter()
    found = REFEREES[name](recording)
    seconds = time.perf_counter() - begin
    np.savez(
        target,
        stamps=np.array([stamp for stamp, _ in found], dtype=np.int64),
        poses=np.array([pose for _, pose in found]).reshape(-1, 4, 4),
        seconds=seconds,
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
