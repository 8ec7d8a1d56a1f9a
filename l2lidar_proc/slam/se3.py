"""Rigid transforms as (4, 4) matrices: errors, adjoints, interpolation.

Small errors are vectors of six: rotation vector [rad], then translation [m], both in the axes of
the moving frame, ``T boxplus e = T @ exp(e)``. This is GTSAM's order for ``Pose3``.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from l2lidar_node import rotations
from l2lidar_node.types import F64
from l2lidar_proc.motion.filter import skew

TURN: Final = slice(0, 3)
SHIFT: Final = slice(3, 6)


def inverse(transform: F64) -> F64:
    """Return the inverses of rigid transforms, shape (..., 4, 4)."""
    back = np.zeros_like(transform)
    turn = np.swapaxes(transform[..., :3, :3], -1, -2)
    back[..., :3, :3] = turn
    back[..., :3, 3] = -np.einsum("...ij,...j->...i", turn, transform[..., :3, 3])
    back[..., 3, 3] = 1.0
    return back


def error(measured: F64, predicted: F64) -> F64:
    """Return ``predicted boxminus measured`` to first order in the translation, shape (..., 6)."""
    delta = inverse(measured) @ predicted
    if delta.ndim == 2:
        turn = rotations.log(rotations.from_matrix(delta[:3, :3]))
        return np.concatenate((turn, delta[:3, 3]))
    turn = Rotation.from_matrix(delta[..., :3, :3].reshape(-1, 3, 3)).as_rotvec()
    return np.concatenate((turn.reshape(*delta.shape[:-2], 3), delta[..., :3, 3]), axis=-1)


def exp(errors: ArrayLike) -> F64:
    """Return the transforms of rotation vectors and translations, shape (..., 4, 4)."""
    vector = np.asarray(errors, np.float64)
    out = np.zeros((*vector.shape[:-1], 4, 4))
    turns = Rotation.from_rotvec(vector[..., TURN].reshape(-1, 3)).as_matrix()
    out[..., :3, :3] = turns.reshape(*vector.shape[:-1], 3, 3)
    out[..., :3, 3] = vector[..., SHIFT]
    out[..., 3, 3] = 1.0
    return out


def planar(x: float, y: float, yaw: float, z: float = 0.0) -> F64:
    """Return a transform that keeps z up, from a position [m] and a yaw [rad]."""
    return exp((0.0, 0.0, yaw, x, y, z))


def yaw_of(transform: F64) -> float:
    """Return the heading of the x axis [rad]; of y where x points up or down."""
    forward = transform[:3, 0]
    if np.hypot(forward[0], forward[1]) < 1e-3:
        return float(np.arctan2(transform[1, 1], transform[0, 1]) - np.pi / 2.0)
    return float(np.arctan2(forward[1], forward[0]))


def leveled(transform: F64) -> F64:
    """Return the transform at the same place and heading, z up."""
    x, y, z = transform[:3, 3]
    return planar(x, y, yaw_of(transform), z)


def adjoint(transform: F64) -> F64:
    """Return the adjoint of ``T_a_b``: errors in axes b to axes a, shape (..., 6, 6)."""
    turn, shift = transform[..., :3, :3], transform[..., :3, 3]
    out = np.zeros((*transform.shape[:-2], 6, 6))
    out[..., TURN, TURN] = out[..., SHIFT, SHIFT] = turn
    out[..., SHIFT, TURN] = skew(shift) @ turn
    return out


def transformed(transform: F64, points: F64) -> F64:
    """Return points (N, 3) in the outer frame of a transform (4, 4)."""
    return np.asarray(points @ transform[:3, :3].T + transform[:3, 3])


def interpolated(first: F64, second: F64, share: F64) -> F64:
    """Return transforms between two (4, 4), at shares (N,) of the way, shape (N, 4, 4)."""
    step = error(first, second)
    return np.asarray(first @ exp(share[:, None] * step))


def magnitude(errors: F64) -> tuple[float, float]:
    """Return the size of an error (6,): angle [rad], distance [m]."""
    return float(np.linalg.norm(errors[TURN])), float(np.linalg.norm(errors[SHIFT]))
