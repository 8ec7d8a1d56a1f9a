"""Batched operations on unit quaternions (w, x, y, z) and rotation vectors, components last.

A quaternion ``q_a_b`` takes vectors of frame b to frame a, like the matrix of the same name.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from l2lidar_node.types import F64

_Number = TypeVar("_Number", float, F64)


def multiply(a_wxyz: ArrayLike, b_wxyz: ArrayLike) -> F64:
    """Return the products ``a b`` (first b, then a), shape (..., 4) by broadcasting."""
    aw, ax, ay, az = _parts(a_wxyz)
    bw, bx, by, bz = _parts(b_wxyz)
    return _joined(
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def conjugate(q_wxyz: ArrayLike) -> F64:
    """Return the inverse rotations, shape (..., 4)."""
    return np.asarray(q_wxyz, dtype=np.float64) * (1.0, -1.0, -1.0, -1.0)


def normalised(q_wxyz: ArrayLike) -> F64:
    """Return the quaternions with unit norm, shape (..., 4)."""
    q = np.asarray(q_wxyz, dtype=np.float64)
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def cross(a: ArrayLike, b: ArrayLike) -> F64:
    """Return the cross products, shape (..., 3); ``numpy.cross`` is several times slower."""
    ax, ay, az = _parts(a)
    bx, by, bz = _parts(b)
    return _joined(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


def exp(rotation_vectors: ArrayLike) -> F64:
    """Return the quaternions of rotation vectors.

    Parameters
    ----------
    rotation_vectors : array-like, shape (..., 3)
        Axis times angle [rad].

    Returns
    -------
    ndarray, shape (..., 4)
        Exactly (1, 0, 0, 0) for a zero vector.
    """
    phi = np.asarray(rotation_vectors, dtype=np.float64)
    if phi.ndim == 1:
        return _exp_of_one(*phi.tolist())
    half = 0.5 * np.sqrt((phi * phi).sum(axis=-1, keepdims=True))
    # numpy's sinc is sin(pi x) / (pi x) and is exact at zero
    return np.concatenate((np.cos(half), 0.5 * np.sinc(half / np.pi) * phi), axis=-1)


def _exp_of_one(x: float, y: float, z: float) -> F64:
    """Return :func:`exp` of one vector, to the bit, in a tenth of the time."""
    half = 0.5 * math.sqrt(x * x + y * y + z * z)
    angle = np.pi * (half / np.pi) or np.finfo(np.float64).eps
    factor = 0.5 * float(np.sin(angle) / angle)
    return np.array((float(np.cos(half)), factor * x, factor * y, factor * z))


def log(q_wxyz: ArrayLike) -> F64:
    """Return the shortest rotation vectors [rad] of unit quaternions, shape (..., 3)."""
    q = np.asarray(q_wxyz, dtype=np.float64)
    if q.ndim == 1:
        return _log_of_one(*q.tolist())
    q = np.where(q[..., :1] < 0.0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    small = sine < 1e-12
    factor = np.where(small, 2.0, angle / np.where(small, 1.0, sine))
    return np.asarray(factor * q[..., 1:])


def _log_of_one(w: float, x: float, y: float, z: float) -> F64:
    """Return :func:`log` of one quaternion, to the bit, in a tenth of the time."""
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 if sine < 1e-12 else 2.0 * float(np.arctan2(sine, w)) / sine
    return np.array((factor * x, factor * y, factor * z))


def rotate(q_wxyz: ArrayLike, vectors: ArrayLike) -> F64:
    """Return the vectors turned by the quaternions, shape (..., 3) by broadcasting."""
    q = np.asarray(q_wxyz, dtype=np.float64)
    v = np.asarray(vectors, dtype=np.float64)
    u = q[..., 1:]
    t = 2.0 * cross(u, v)
    return np.asarray(v + q[..., :1] * t + cross(u, t))


def matrices(q_wxyz: ArrayLike) -> F64:
    """Return the rotation matrices, shape (..., 3, 3); exactly I for (1, 0, 0, 0)."""
    q = np.asarray(q_wxyz, dtype=np.float64)
    if q.ndim == 1:  # plain numbers take a tenth of the time
        return np.array(_entries(*q.tolist())).reshape(3, 3)
    entries = _joined(*_entries(*_parts(q)))
    return entries.reshape(*entries.shape[:-1], 3, 3)


def _entries(w: _Number, x: _Number, y: _Number, z: _Number) -> tuple[_Number, ...]:
    """Return the entries of the matrices of quaternions, row by row."""
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


def matrix_exp(rotation_vector: F64) -> F64:
    """Return the matrix of one rotation vector [rad], (3, 3), by Rodrigues' formula.

    For one vector it takes a tenth of the time of ``matrices(exp(...))``.
    """
    x, y, z = rotation_vector.tolist()
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < 1e-4:  # where the quotients lose digits the series has them all
        sine, cosine = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        sine, cosine = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    xy, xz, yz = cosine * x * y, cosine * x * z, cosine * y * z
    x2, y2, z2 = cosine * x * x, cosine * y * y, cosine * z * z
    x, y, z = sine * x, sine * y, sine * z
    return np.array(
        (
            (1.0 - y2 - z2, xy - z, xz + y),
            (xy + z, 1.0 - x2 - z2, yz - x),
            (xz - y, yz + x, 1.0 - x2 - y2),
        )
    )


def from_matrix(matrix: ArrayLike) -> F64:
    """Return the quaternion of one rotation matrix, shape (4,), w not negative.

    The largest component comes from the diagonal, the others from it (Shepperd 1978); SciPy's
    ``Rotation.from_matrix`` takes twenty times as long, and this is asked for at every pose.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.asarray(matrix, dtype=np.float64).tolist()
    trace = xx + yy + zz
    largest = max((trace, "w"), (xx, "x"), (yy, "y"), (zz, "z"))[1]
    if largest == "w":
        found = (1.0 + trace, zy - yz, xz - zx, yx - xy)
    elif largest == "x":
        found = (zy - yz, 1.0 + 2.0 * xx - trace, xy + yx, xz + zx)
    elif largest == "y":
        found = (xz - zx, xy + yx, 1.0 + 2.0 * yy - trace, yz + zy)
    else:
        found = (yx - xy, xz + zx, yz + zy, 1.0 + 2.0 * zz - trace)
    w, x, y, z = found
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        norm = -norm
    return np.array((w / norm, x / norm, y / norm, z / norm))


def from_rpy(rpy: ArrayLike) -> F64:
    """Return the matrix of roll, pitch, yaw [rad] about fixed x, y, z, in this order, (3, 3)."""
    roll, pitch, yaw = np.asarray(rpy, dtype=np.float64)
    turns = exp([(0.0, 0.0, yaw), (0.0, pitch, 0.0), (roll, 0.0, 0.0)])
    return matrices(multiply(multiply(turns[0], turns[1]), turns[2]))


def to_rpy(matrix: ArrayLike) -> F64:
    """Return roll, pitch, yaw [rad] of one rotation matrix, shape (3,); see :func:`from_rpy`."""
    m = np.asarray(matrix, dtype=np.float64)
    pitch = np.arctan2(-m[2, 0], np.hypot(m[0, 0], m[1, 0]))
    return np.array([np.arctan2(m[2, 1], m[2, 2]), pitch, np.arctan2(m[1, 0], m[0, 0])])


def cumulative(q_wxyz: ArrayLike) -> F64:
    """Return the running products ``q[0] q[1] ... q[k]``, shape (K, 4).

    A prefix scan: log2(K) batched products instead of a loop over K.
    """
    q = np.array(q_wxyz, dtype=np.float64)
    step = 1
    while step < len(q):
        q[step:] = multiply(q[:-step], q[step:])
        step *= 2
    return q


def between(a: ArrayLike, b: ArrayLike) -> F64:
    """Return the shortest rotation from the direction of ``a`` to that of ``b``, shape (4,)."""
    u = np.asarray(a, dtype=np.float64) / np.linalg.norm(a)
    v = np.asarray(b, dtype=np.float64) / np.linalg.norm(b)
    w = 1.0 + float(u @ v)
    if w < 1e-9:  # opposite: half a turn about any axis across
        across = cross(u, np.eye(3)[np.argmin(np.abs(u))])
        return np.concatenate(([0.0], across / np.linalg.norm(across)))
    return normalised(np.concatenate(([w], cross(u, v))))


def transform(q_wxyz: ArrayLike, translation: ArrayLike) -> F64:
    """Return the (4, 4) matrix of a rotation followed by a translation [m]."""
    matrix = np.eye(4)
    matrix[:3, :3] = matrices(q_wxyz)
    matrix[:3, 3] = translation
    return matrix


def inverse(transform: F64) -> F64:
    """Return the inverse of a rigid transform, (4, 4)."""
    back = np.eye(4)
    back[:3, :3] = transform[:3, :3].T
    back[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return back


def _parts(values: ArrayLike) -> list[F64]:
    """Return the components, (...) each; ``numpy.moveaxis`` takes ten times as long."""
    array = np.asarray(values, dtype=np.float64)
    return [array[..., i] for i in range(array.shape[-1])]


def _joined(*components: ArrayLike) -> F64:
    """Return components (...) as the last axis; ``numpy.stack`` takes twice as long."""
    first = np.asarray(components[0])
    out = np.empty((*first.shape, len(components)))
    for i, component in enumerate(components):
        out[..., i] = component
    return out
