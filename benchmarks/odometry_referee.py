"""Runs another odometry over a recording; a program of its own, in that odometry's own Python.

``python odometry_referee.py NAME RECORDING OUT SKIPPED``: RECORDING is a file of
:mod:`tests.support.odometry_runs`. OUT gets the arrays ``stamps`` [ns], ``poses`` (N, 4, 4), cloud
frame to the odometry's own, and ``seconds``. Nothing of this project is imported here, and nothing
here is imported by it: one of the referees is GPL.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

LIO_SAM = Path("config") / "consumers" / "lio_sam" / "params.yaml"
OPTICAL_CENTRE_M = 0.0445  # the rings are those of the `velodyne` layout: elevation from here
CT_ICP = {
    # evalio's defaults are for streets (42 mm in the room); these are finer, for 30 m and less
    "init_sample_voxel_size": 0.5,
    "sample_voxel_size": 0.5,
    "voxel_size": 0.1,
    "size_voxel_map": 0.5,
    "min_distance_points": 0.05,
    "num_iters_icp": 10,
    "ls_num_threads": 1,
}
Poses = list[tuple[int, Any]]


class Recording:
    """Sweeps and IMU samples as the file has them, without so many sweeps at the beginning."""

    def __init__(self, path: str, skipped: int = 0) -> None:
        self._skipped = skipped
        self._file = dict(np.load(path))
        self.imu = self._file["imu"]
        self.T_cloud_imu = self._file["T_cloud_imu"]

    def __iter__(self) -> Iterator[tuple[int, int, Any, Any]]:
        """Yield start [ns], end [ns], points (N, 3) [m] and times (N,) [s] after the start."""
        edges, spans = self._file["edges"][self._skipped :], self._file["spans"][self._skipped :]
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


def ct_icp(recording: Recording) -> Poses:
    """CT-ICP through evalio; a pose is that of the sweep's first point."""
    return _evalio(recording, "CTICP", CT_ICP, _lio_sam_parameters(), 0)


def lio_sam(recording: Recording) -> Poses:
    """LIO-SAM through evalio, with the parameters that we ship for it, on deskewed clouds.

    It holds two sweeps back: what it says after a sweep is the pose at the start of the second
    one before.
    """
    given = _lio_sam_parameters()
    from evalio._cpp import pipelines

    known = pipelines.LioSAM.default_params()
    changes = {name: type(known[name])(given[name]) for name in known if name in given}
    return _evalio(recording, "LioSAM", {**changes, "numberOfCores": 1}, given, 2)


def _lio_sam_parameters() -> dict[str, Any]:
    import yaml

    found = yaml.safe_load(LIO_SAM.read_text(encoding="utf-8"))["/**"]["ros__parameters"]
    return dict(found)


def _evalio(
    recording: Recording, name: str, changes: dict[str, Any], given: dict[str, Any], latency: int
) -> Poses:
    """Run one of evalio's pipelines; the poses are ``latency`` sweeps behind."""
    from evalio import types
    from evalio._cpp import pipelines

    pipeline = getattr(pipelines, name)()
    pipeline.set_params({**pipeline.default_params(), **changes})
    pipeline.set_imu_params(
        types.ImuParams(
            gyro=given["imuGyrNoise"],
            accel=given["imuAccNoise"],
            gyro_bias=given["imuGyrBiasN"],
            accel_bias=given["imuAccBiasN"],
            bias_init=1e-3,
            gravity=np.array([0.0, 0.0, -given["imuGravity"]]),  # the vector, not what is felt
            rate=250.0,
        )
    )
    rings, columns = given["N_SCAN"], given["Horizon_SCAN"]
    pipeline.set_lidar_params(
        types.LidarParams(
            num_rows=rings,
            num_columns=columns,
            min_range=given["lidarMinRange"],
            max_range=given["lidarMaxRange"],
            rate=4.4,
        )
    )
    T_imu_cloud = np.linalg.inv(recording.T_cloud_imu)
    pipeline.set_imu_T_lidar(types.SE3.from_mat(T_imu_cloud))
    pipeline.initialize()  # takes a copy of what it was told: nothing counts that is set later
    out: Poses = []
    starts: list[int] = []
    last = -1
    for start, end, points, times in recording:
        starts.append(start)
        for sample in recording.samples(last, end + 4_000_000):
            pipeline.add_imu(
                types.ImuMeasurement(
                    types.Stamp.from_nsec(int(sample["stamp"])),
                    np.ascontiguousarray(sample["angular_velocity"]),
                    np.ascontiguousarray(sample["linear_acceleration"]),
                )
            )
        last = end + 4_000_000
        pipeline.add_lidar(_measurement(types, start, points, times, rings, columns))
        # what is saved says where the IMU is
        found = [pose.to_mat() @ T_imu_cloud for _, pose in pipeline.saved_estimates()]
        if len(starts) > latency and found:
            out.append((starts[-1 - latency], found[-1]))
    return out


def _measurement(types: Any, start: int, points: Any, times: Any, rings: int, columns: int) -> Any:
    """Return a sweep with the rings and columns of LIO-SAM's range image."""
    ranges = np.linalg.norm(points, axis=1)
    elevation = np.arctan2(points[:, 2] - OPTICAL_CENTRE_M, np.hypot(points[:, 0], points[:, 1]))
    rows = np.clip(np.floor(elevation * (rings / (np.pi / 2))), 0, rings - 1).astype(int)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    around = ((azimuth + np.pi) / (2 * np.pi) * columns).astype(int) % columns
    made = [
        types.Point(x=x, y=y, z=z, t=types.Duration.from_nsec(t), range=r, row=row, col=column)
        for (x, y, z), t, r, row, column in zip(
            points.tolist(),
            np.round(times * 1e9).astype(int).tolist(),
            (ranges * 1e3).astype(int).tolist(),
            rows.tolist(),
            around.tolist(),
            strict=True,
        )
    ]
    return types.LidarMeasurement(types.Stamp.from_nsec(start), made)


REFEREES: dict[str, Callable[[Recording], Poses]] = {
    "rko_lio": rko_lio,
    "genz_lio": genz_lio,
    "ct_icp": ct_icp,
    "lio_sam": lio_sam,
}


def main() -> int:
    """Run from a command line; return the exit code."""
    name, source, target, skipped = sys.argv[1:5]
    recording = Recording(source, int(skipped))
    begin = time.process_time()
    found = REFEREES[name](recording)
    seconds = time.process_time() - begin
    np.savez(
        target,
        stamps=np.array([stamp for stamp, _ in found], dtype=np.int64),
        poses=np.array([pose for _, pose in found]).reshape(-1, 4, 4),
        seconds=seconds,
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
