"""Reports what the demo saw, how accurate it was, and where the pictures are."""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from l2lidar_node.demo import picture
from l2lidar_node.demo.observer import Observer
from l2lidar_node.demo.robot import BASE_FRAME, floor_and_ceiling, moved
from l2lidar_node.emulator.truth.results import Results
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.types import F64


class TrackError(NamedTuple):
    """How far an estimated track is from the true one.

    Attributes
    ----------
    ate_m : float
        Root mean square of the distances after the best rigid alignment [m].
    worst_m : float
        Largest of them [m].
    length_m : float
        Length of the true track between the first and the last estimate [m].
    estimated, true : ndarray, shape (N, 3)
        Both tracks in the world [m], the estimated one aligned.
    """

    ate_m: float
    worst_m: float
    length_m: float
    estimated: F64
    true: F64


def track_error(truth: Results, stamps: list[int], positions: F64) -> TrackError:
    """Return the error of estimated positions.

    Parameters
    ----------
    truth : Results
    stamps : list of int
        Instants of the estimates [ns].
    positions : ndarray, shape (N, 3)
        In any frame that is fixed to the world [m]; N at least 3.
    """
    poses = truth.trajectory()
    origin = int(stamps[0])
    instants = np.array([stamp - origin for stamp in stamps], np.float64)
    known = (poses["stamp"] - origin).astype(np.float64)
    true = np.stack(
        [np.interp(instants, known, poses["position"][:, axis]) for axis in range(3)], axis=1
    )
    middle, true_middle = positions.mean(axis=0), true.mean(axis=0)
    turn, _ = Rotation.align_vectors(true - true_middle, positions - middle)
    aligned = turn.apply(positions - middle) + true_middle
    error = np.linalg.norm(aligned - true, axis=1)
    length = float(np.linalg.norm(np.diff(true, axis=0), axis=1).sum())
    return TrackError(float(np.sqrt(np.mean(error**2))), float(error.max()), length, aligned, true)


def stamp_errors_ms(truth: Results, packet_type: PacketType, stamps: list[int]) -> F64:
    """Return how far stamps are from the nearest true instant of a packet of a type [ms].

    Packets are 4 ms and more apart, so the nearest is the right one for any error below 2 ms.
    """
    starts = np.sort(truth.packets["start_ns"][truth.packets["type"] == packet_type])
    wanted = np.array(stamps, np.int64)
    after = np.clip(np.searchsorted(starts, wanted), 1, len(starts) - 1)
    errors = np.stack([wanted - starts[after - 1], wanted - starts[after]])
    nearest = np.abs(errors).argmin(axis=0)
    return np.asarray(errors[nearest, np.arange(len(wanted))] / 1e6)


_SPACING_MS: Final = {"/points": 229.8, "/imu/data": 4.0}  # a cloud per turn of the head
_TOLERANCE: Final = 0.02
# An error of the calibration makes an odometry drift in proportion to the way: a typical unit does
# by 0.1 to 0.25 % (docs/mapping.md); calibrated it does by a tenth.
_MAX_ATE_SHARE: Final = 0.003
_LEAST_LIMIT_M: Final = 0.05  # over less than 17 m of way
_SENSOR_HEIGHT_M: Final = 1.0  # of the built-in motions above the floor
_HEIGHT_TOLERANCE_M: Final = 0.25  # a walk heaves and pitches
_MIN_POSES: Final = 10


def report(
    console: Console,
    observer: Observer,
    folder: Path,
    with_odometry: bool,
    mount: F64 | None = None,
) -> list[str]:
    """Print what was seen, write pictures, and return what is wrong.

    Parameters
    ----------
    console : Console
    observer : Observer
    folder : Path
        Of the pictures; its subfolder ``truth`` is what the virtual L2 wrote.
    with_odometry : bool
        Whether deskew and odometry took part.
    mount : ndarray, shape (4, 4), optional
        Pose of the cloud frame in the base frame of a robot; the cloud is then shown there.
    """
    console.print(_topics(observer, with_odometry))
    troubles = _troubles(observer)
    truth = Results(folder / "truth")
    if observer.points:
        console.print(
            f"{np.mean(observer.points):.0f} points per cloud, fields "
            f"{', '.join(observer.fields)}; /tf_static: "
            f"{', '.join(f'{parent} -> {child}' for parent, child in observer.transforms)}"
        )
    if len(observer.imu.stamps) > 1:
        spacing = observer.imu.intervals_ms
        errors = stamp_errors_ms(truth, PacketType.IMU, observer.imu.stamps)
        console.print(
            f"IMU stamps {spacing.mean():.4f} ms apart (standard deviation {spacing.std():.4f}), "
            f"off the truth by {np.median(errors):.3f} ms, p99 {np.percentile(errors, 99):.3f} ms"
        )
    console.print(f"lost packets: {_lost(observer.checks.get('link', {}))}")
    if observer.cloud is not None:
        if mount is None:
            picture.save_cloud(observer.cloud, folder / "cloud.png", "one cloud, as measured")
        else:
            troubles += _in_base(console, observer.cloud, mount, folder)
    if with_odometry:
        troubles += _odometry(console, observer, truth, folder)
    console.print(f"pictures: {', '.join(str(path) for path in sorted(folder.glob('*.png')))}")
    return troubles


def _in_base(console: Console, cloud: NDArray[np.void], mount: F64, folder: Path) -> list[str]:
    """Show a cloud as RViz does with the fixed frame base_link; return what is wrong."""
    shown = moved(cloud, mount)
    floor, ceiling = floor_and_ceiling(shown)
    text = f"in {BASE_FRAME} the floor is at z = {floor:.2f} m, the ceiling at {ceiling:.2f} m"
    console.print(text)
    picture.save_cloud(shown, folder / "cloud.png", text)
    expected = float(mount[2, 3]) - _SENSOR_HEIGHT_M
    if abs(floor - expected) > _HEIGHT_TOLERANCE_M:
        return [f"the floor is at z = {floor:.2f} m in {BASE_FRAME}, not {expected:.2f} m"]
    return []


def _topics(observer: Observer, with_odometry: bool) -> Table:
    table = Table("topic", "rate [1/s]", "frame", "stamps", "age p50 / p99 [ms]")
    records = {"/points": observer.clouds, "/imu/data": observer.imu}
    if with_odometry:
        records |= {"/points_deskewed": observer.deskewed, "/odometry": observer.odometry}
    for name, record in records.items():
        ages = np.percentile(record.ages_s, [50, 99]) * 1e3 if record.ages_s else [np.nan, np.nan]
        steps = record.backward_steps
        table.add_row(
            name,
            f"{record.rate_hz:.2f}",
            record.frame,
            "ascending" if not steps else f"{steps} steps back",
            f"{ages[0]:.1f} / {ages[1]:.1f}",
        )
    return table


def _odometry(console: Console, observer: Observer, truth: Results, folder: Path) -> list[str]:
    """Judge the track and draw it; return what is wrong."""
    if len(observer.positions) < _MIN_POSES:
        return [f"/odometry: {len(observer.positions)} poses, expected {_MIN_POSES} and more"]
    positions = np.array(observer.positions)
    track = track_error(truth, observer.odometry.stamps, positions)
    text = (
        f"odometry: {1e3 * track.ate_m:.1f} mm RMS off the truth "
        f"(at most {1e3 * track.worst_m:.1f} mm) over {track.length_m:.1f} m"
    )
    console.print(text)
    picture.save_track(track.estimated, track.true, folder / "track.png", text)
    moved = [(raw, deskewed) for raw, deskewed in observer.pairs.values() if raw is not None
             and deskewed is not None]  # fmt: skip
    if moved:
        picture.save_comparison(*moved[len(moved) // 2], folder / "deskew.png")
    if not observer.deskewed.stamps:
        return ["/points_deskewed: nothing received"]
    limit = max(_LEAST_LIMIT_M, _MAX_ATE_SHARE * track.length_m)
    if track.ate_m > limit:
        return [f"odometry is off by {track.ate_m:.3f} m, expected less than {limit:.3f} m"]
    return []


def _troubles(observer: Observer) -> list[str]:
    troubles = []
    for name, record in (("/points", observer.clouds), ("/imu/data", observer.imu)):
        if not record.stamps:
            troubles.append(f"{name}: nothing received")
            continue
        if record.backward_steps:
            troubles.append(f"{name}: stamps step back")
        # By stamp, not by arrival: where the machine pauses for a second, so do the messages.
        spacing = float(np.median(record.intervals_ms)) if len(record.stamps) > 1 else np.nan
        if not abs(spacing - _SPACING_MS[name]) < _TOLERANCE * _SPACING_MS[name]:
            troubles.append(
                f"{name}: stamps are {spacing:.2f} ms apart, expected {_SPACING_MS[name]}"
            )
    if not observer.diagnostics:
        return [*troubles, "/diagnostics: nothing received"]
    lost = _lost(observer.checks.get("link", {}))
    if lost:
        troubles.append(f"{lost} packets lost")
    return troubles


def _lost(link: dict[str, str]) -> int:
    return sum(int(link.get(f"{stream} lost", 0)) for stream in ("points", "imu"))
