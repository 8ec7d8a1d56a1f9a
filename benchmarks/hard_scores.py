"""Judges an odometry on a hard run: how far off it is, and whether its covariance says so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.hard_recordings import Recording
from benchmarks.hard_scenarios import Imperfections
from l2lidar_node import rotations
from l2lidar_node.types import F64

Row = dict[str, Any]

FAILED_SHARE: Final = 0.01  # of the way, at the end
FAILED_LEAST_M: Final = 0.3
SILENT_SIGMAS: Final = 3.0
SILENT_LEAST_M: Final = 0.1  # errors below do no harm, whatever the covariance says
FEWEST: Final = 0.7  # poses for each sweep: a method with fewer gave up
QUANTILE: Final = {3: 7.8147, 6: 12.5916}  # 95 % of chi-squared


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """What an odometry said of a recording.

    Attributes
    ----------
    stamps : ndarray, shape (N,), int64
        [ns]
    poses : ndarray, shape (N, 4, 4)
        Sensor to the odometry's own frame.
    seconds : float
        Processor time of all threads.
    covariances : ndarray, shape (N, 6, 6), optional
        Of x, y, z and turns about the odometry's axes.
    velocities : ndarray, shape (N, 3), optional
        Of the sensor's frame, sensor axes [m/s].
    velocity_covariances : ndarray, shape (N, 3, 3), optional
    status : sequence of tuple of str, optional
        Names of what was said of each pose.
    """

    stamps: NDArray[np.int64]
    poses: F64
    seconds: float
    covariances: F64 | None = None
    velocities: F64 | None = None
    velocity_covariances: F64 | None = None
    status: Sequence[tuple[str, ...]] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Errors of every pose of a track, in the odometry's frame.

    That frame is tied to the world at the first pose: covariances are relative to the map, which
    begins there.

    Attributes
    ----------
    position, turn, velocity : ndarray, shape (N, 3)
        [m, rad, m/s]; the velocity's in the sensor's axes.
    """

    position: F64
    turn: F64
    velocity: F64


def errors(recording: Recording, track: Track) -> Errors:
    """Return the errors of every pose."""
    truth = recording.truth_at(track.stamps)
    T_world_sensor = np.tile(np.eye(4), (len(truth), 1, 1))
    T_world_sensor[:, :3, :3] = rotations.matrices(truth["quaternion_wxyz"])
    T_world_sensor[:, :3, 3] = truth["position"]
    T_odom_world = track.poses[0] @ np.linalg.inv(T_world_sensor[0])
    expected = T_odom_world @ T_world_sensor
    turn = _logs(track.poses[:, :3, :3] @ expected[:, :3, :3].transpose(0, 2, 1))
    velocity = np.zeros((len(truth), 3))
    if track.velocities is not None:
        body = np.einsum("nji,nj->ni", T_world_sensor[:, :3, :3], truth["velocity"])
        velocity = track.velocities - body
    return Errors(track.poses[:, :3, 3] - expected[:, :3, 3], turn, velocity)


def score(recording: Recording, track: Track | None) -> Row:
    """Return the figures of one run; infinite errors for a method that gave up."""
    wanted = int(np.count_nonzero(np.diff(recording.edges)))
    row: Row = {
        "way_m": recording.way_m,
        "scale_ate_m": scale_ate(recording),
        "poses": 0 if track is None else len(track.stamps) / max(wanted, 1),
        "ate_m": np.inf,
        "end_m": np.inf,
        "end_share": np.inf,
        "max_m": np.inf,
        "failed": True,
        "lost": 0,
        "silent": 0,
        "sigmas": np.nan,
        "nees_pose": np.nan,
        "nees_velocity": np.nan,
        "mean_nees_pose": np.nan,
        "mean_nees_velocity": np.nan,
        "real_time_factor": 0.0,
        "status": "",
    }
    if track is None or len(track.stamps) < FEWEST * wanted:
        return row
    found = errors(recording, track)
    far = np.linalg.norm(found.position, axis=1)
    end = float(far[-1])
    row |= {
        "ate_m": _ate(recording, track),
        "end_m": end,
        "end_share": end / max(recording.way_m, 1e-3),
        "max_m": float(far.max()),
        "failed": bool(end > max(FAILED_SHARE * recording.way_m, FAILED_LEAST_M)),
        "real_time_factor": recording.seconds / max(track.seconds, 1e-9),
    }
    if track.covariances is not None:
        row |= _consistency(found, far, track)
    return row


def _consistency(found: Errors, far: F64, track: Track) -> Row:
    """Return what the covariances and the status are worth."""
    assert track.covariances is not None
    assert track.velocity_covariances is not None
    pose = np.hstack([found.position, found.turn])
    nees = normalized(pose, track.covariances)
    speed = normalized(found.velocity, track.velocity_covariances)
    ahead = found.position / np.maximum(far, 1e-12)[:, None]
    sigma = np.sqrt(
        np.maximum(np.einsum("ni,nij,nj->n", ahead, track.covariances[:, :3, :3], ahead), 1e-18)
    )
    quiet = np.array([not set(names) - {"STARTING"} for names in track.status])
    wrong = quiet & (far > SILENT_SIGMAS * sigma) & (far > SILENT_LEAST_M)
    judged = np.array(["STARTING" not in names for names in track.status])
    return {
        "lost": sum("LOST" in names for names in track.status),
        "silent": int(wrong.sum()),
        "sigmas": float((far / sigma)[quiet].max()) if quiet.any() else 0.0,
        "nees_pose": float((nees[judged] <= QUANTILE[6]).mean()),
        "nees_velocity": float((speed[judged] <= QUANTILE[3]).mean()),
        "mean_nees_pose": float(nees[judged].mean() / 6.0),
        "mean_nees_velocity": float(speed[judged].mean() / 3.0),
        "status": sequence(track.status),
    }


def normalized(error: F64, covariance: F64) -> F64:
    """Return the normalized squared errors (NEES) of errors (N, D), covariances (N, D, D)."""
    solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    return np.asarray(np.einsum("ni,ni->n", error, solved))


def sequence(status: Sequence[tuple[str, ...]]) -> str:
    """Return what was said in order, as ``ALIGNED x40, DEGENERATE x3``, without a long middle."""
    runs = [
        (" ".join(sorted(names)) or "ALIGNED", len(list(same))) for names, same in groupby(status)
    ]
    words = [f"{name} x{count}" for name, count in runs]
    if len(words) > 12:
        words = [*words[:6], f"... {len(words) - 10} more ...", *words[-4:]]
    return ", ".join(words)


def _ate(recording: Recording, track: Track) -> float:
    """Return the absolute trajectory error after an SE(3) alignment (Umeyama), by evo [m]."""
    from evo.core.metrics import APE, PoseRelation
    from evo.core.trajectory import PoseTrajectory3D

    truth = recording.truth_at(track.stamps)
    seconds = (track.stamps - track.stamps[0]) * 1e-9
    reference = PoseTrajectory3D(truth["position"], truth["quaternion_wxyz"], seconds)
    estimate = PoseTrajectory3D(poses_se3=list(track.poses), timestamps=seconds)
    try:
        estimate.align(reference)
    except Exception:  # evo has an exception of its own for a way without any extent
        return float("inf")
    ape = APE(PoseRelation.translation_part)
    ape.process_data((reference, estimate))
    return float(np.sqrt(np.mean(ape.error**2)))


def scale_ate(recording: Recording) -> float:
    """Return the ATE [m] of the truth itself, of the size that ranges of a wrong scale give it.

    Scaled by 1 + e about its mean, which no rotation improves, every place is off by e times its
    distance from there.
    """
    places = recording.truth_at(recording.spans.mean(axis=1).astype(np.int64))["position"]
    spread = np.square(places - places.mean(axis=0)).sum(axis=1).mean()
    return Imperfections().range_scale * float(np.sqrt(spread))


def _logs(turns: F64) -> F64:
    """Return the rotation vectors [rad] of matrices (N, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(turns).as_rotvec())
