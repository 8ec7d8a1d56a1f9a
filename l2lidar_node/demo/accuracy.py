"""Compares what was published with the truth of the virtual L2."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from l2lidar_node.emulator.truth.results import Results
from l2lidar_node.protocol.wire import PacketType

F8 = NDArray[np.float64]


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
    estimated: F8
    true: F8


def track_error(truth: Results, stamps: list[int], positions: F8) -> TrackError:
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


def stamp_errors_ms(truth: Results, packet_type: PacketType, stamps: list[int]) -> F8:
    """Return how far stamps are from the nearest true instant of a packet of a type [ms].

    Packets are 4 ms and more apart, so the nearest is the right one for any error below 2 ms.
    """
    starts = np.sort(truth.packets["start_ns"][truth.packets["type"] == packet_type])
    wanted = np.array(stamps, np.int64)
    after = np.clip(np.searchsorted(starts, wanted), 1, len(starts) - 1)
    errors = np.stack([wanted - starts[after - 1], wanted - starts[after]])
    nearest = np.abs(errors).argmin(axis=0)
    return np.asarray(errors[nearest, np.arange(len(wanted))] / 1e6)
