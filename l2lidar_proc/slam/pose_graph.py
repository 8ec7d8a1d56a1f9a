"""Pose graph optimization with GTSAM: batch Levenberg-Marquardt over submap poses.

The graph is small enough to be rebuilt and solved at each loop, so that undoing one is nothing but
solving without it. The only module that imports gtsam.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64
from l2lidar_proc.slam.se3 import error

EDGE: Final = np.dtype(
    [
        ("first", "<i4"),
        ("second", "<i4"),
        ("kind", "<i1"),
        ("pose", "<f8", (4, 4)),  # T_first_second
        ("covariance", "<f8", (6, 6)),  # turn, translation; axes of the second
        ("way", "<f8"),  # [m] of odometry along the edge, 0 for a loop
    ]
)
"""A relative pose between two nodes."""

ODOMETRY: Final = 0
LOOP: Final = 1
CUT: Final = 2
"""Kinds of edges. A cut joins what the odometry could not join: it says nothing."""

_CAUCHY: Final = 2.0  # [sigma] beyond which a loop's weight falls
_UP_SIGMA: Final = np.radians(0.3)  # of the vertical in a submap: gravity as the odometry knows it
_ANCHOR_SIGMA: Final = (1e-4, 1e-3)  # [rad, m]
_ITERATIONS: Final = 30


class GtsamMissingError(ImportError):
    """gtsam is not installed."""

    def __init__(self) -> None:
        super().__init__(
            "SLAM needs the Python package gtsam; docs/install.md says how to add it without "
            "changing the system's Python. Or set 'loops' to false"
        )


def is_available() -> bool:
    """Return whether gtsam can be imported."""
    try:
        _gtsam()
    except GtsamMissingError:
        return False
    return True


def optimized(
    poses: F64, edges: NDArray[np.void], anchors: NDArray[np.int64], *, gravity: bool = True
) -> F64:
    """Return the poses (N, 4, 4) that fit the edges best.

    Parameters
    ----------
    poses : ndarray, shape (N, 4, 4)
        First guess; the z axes of submaps point up.
    edges : ndarray, shape (M,), dtype EDGE
        Loops get a Cauchy kernel.
    anchors : ndarray, shape (A,)
        Nodes that stay where they are.
    gravity : bool
        Whether roll and pitch are held by gravity.

    Raises
    ------
    GtsamMissingError
    """
    gtsam = _gtsam()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for number, pose in enumerate(poses):
        values.insert(number, gtsam.Pose3(pose))
    fixed = np.repeat(_ANCHOR_SIGMA, 3)
    for number in anchors.tolist():
        noise = gtsam.noiseModel.Diagonal.Sigmas(fixed)
        graph.add(gtsam.PriorFactorPose3(number, gtsam.Pose3(poses[number]), noise))
    robust = gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY)
    for edge in edges:
        noise = gtsam.noiseModel.Gaussian.Covariance(np.array(edge["covariance"]))
        if edge["kind"] == LOOP:
            noise = gtsam.noiseModel.Robust.Create(robust, noise)
        graph.add(
            gtsam.BetweenFactorPose3(
                int(edge["first"]), int(edge["second"]), gtsam.Pose3(edge["pose"]), noise
            )
        )
    if gravity:
        up, level = gtsam.Unit3(0.0, 0.0, 1.0), gtsam.noiseModel.Isotropic.Sigma(2, _UP_SIGMA)
        for number in range(len(poses)):
            graph.add(gtsam.AttitudeFactorPose3(number, up, level, up))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setMaxIterations(_ITERATIONS)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()
    return np.stack([solved.atPose3(number).matrix() for number in range(len(poses))])


def deviations(poses: F64, edges: NDArray[np.void]) -> F64:
    """Return how far each edge is off, in standard deviations of its worst component, shape (M,).

    Components are those along the principal axes of translation and rotation.
    """
    if not len(edges):
        return np.zeros(0)
    off = error(edges["pose"], relative(poses, edges["first"], edges["second"]))
    worst = np.zeros(len(edges))
    for part in (slice(0, 3), slice(3, 6)):
        variance, axes = np.linalg.eigh(edges["covariance"][:, part, part])
        along = np.einsum("nji,nj->ni", axes, off[:, part])
        worst = np.maximum(worst, np.abs(along / np.sqrt(variance)).max(axis=1))
    return worst


def relative(poses: F64, first: NDArray[Any], second: NDArray[Any]) -> F64:
    """Return ``T_first_second`` of pairs of nodes, shape (M, 4, 4)."""
    return np.asarray(np.linalg.inv(poses[first]) @ poses[second])


def _gtsam() -> Any:
    try:
        import gtsam
    except ImportError:
        raise GtsamMissingError from None
    return gtsam
