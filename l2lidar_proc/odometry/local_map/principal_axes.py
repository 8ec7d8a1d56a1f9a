"""Principal axes of many small covariances at once, in closed form."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from l2lidar_node.types import F64

PAIRS: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Axes of the lines of a covariance: xx, xy, xz, yy, yz, zz."""


def products(x: F64, y: F64, z: F64) -> Iterator[F64]:
    """Yield the products of coordinates (N,), in the order of :func:`principal_axes`."""
    axes = x, y, z
    return (axes[i] * axes[j] for i, j in PAIRS)


def principal_axes(covariance: F64) -> tuple[F64, F64]:
    """Return variances along principal axes and these axes, of many 3 x 3 covariances.

    In closed form, half of the time of ``numpy.linalg.eigh`` for a thousand of them: the
    eigenvalue that is farthest from the others by Smith (1961), its axis as the largest cross
    product of two rows (Eberly, "A Robust Eigensolver for 3 x 3 Symmetric Matrices", 2014), and
    one Jacobi rotation in the plane across it.

    Parameters
    ----------
    covariance : ndarray, shape (6, N)
        Lines xx, xy, xz, yy, yz, zz [m^2].

    Returns
    -------
    spread : ndarray, shape (N, 3)
        Ascending [m^2].
    axes : ndarray, shape (N, 3, 3)
        Rows: unit vectors of the same order, orthogonal, either sign.
    """
    xx, xy, xz, yy, yz, zz = covariance
    mean = (xx + yy + zz) / 3.0
    # without their mean the eigenvalues sum to 0
    xx, yy, zz = xx - mean, yy - mean, zz - mean
    size = np.sqrt((xx**2 + yy**2 + zz**2 + 2.0 * (xy**2 + xz**2 + yz**2)) / 6.0)
    size = np.maximum(size, np.finfo(np.float64).tiny ** 0.25)
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    ratio = np.clip(determinant / (2.0 * size**3), -1.0, 1.0)
    far = np.copysign(2.0 * size * np.cos(np.arccos(np.abs(ratio)) / 3.0), ratio)
    axis = _null_axis(xx - far, xy, xz, yy - far, yz, zz - far)
    u, v = _across(axis)
    mapped = np.stack(
        (
            xx * u[0] + xy * u[1] + xz * u[2],
            xy * u[0] + yy * u[1] + yz * u[2],
            xz * u[0] + yz * u[1] + zz * u[2],
        )
    )
    uu, uv = (u * mapped).sum(axis=0), (v * mapped).sum(axis=0)
    vv = -far - uu
    angle = 0.5 * np.arctan2(2.0 * uv, uu - vv)
    cos, sin = np.cos(angle), np.sin(angle)
    radius = np.hypot(0.5 * (uu - vv), uv)
    small, large = -0.5 * far - radius, -0.5 * far + radius
    small_axis, large_axis = cos * v - sin * u, cos * u + sin * v
    is_last = far > 0.0
    spread = np.where(is_last, (small, large, far), (far, small, large)) + mean
    axes = np.where(is_last, (small_axis, large_axis, axis), (axis, small_axis, large_axis))
    return np.ascontiguousarray(spread.T), np.ascontiguousarray(axes.transpose(2, 0, 1))


def _null_axis(xx: F64, xy: F64, xz: F64, yy: F64, yz: F64, zz: F64) -> F64:
    """Return the unit vectors (3, N) across all rows of symmetric matrices of rank 2 or less."""
    crosses = np.array(
        (
            (xy * yz - xz * yy, xz * xy - xx * yz, xx * yy - xy * xy),
            (xy * zz - xz * yz, xz * xz - xx * zz, xx * yz - xy * xz),
            (yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz),
        )
    )
    lengths = np.sqrt((crosses**2).sum(axis=1))
    best = lengths.argmax(axis=0)
    each = np.arange(lengths.shape[1])
    length = lengths[best, each]
    axis = crosses[best, :, each].T / np.where(length > 0.0, length, 1.0)
    axis[2, length <= 0.0] = 1.0  # all directions are alike
    return np.asarray(axis)


def _across(axis: F64) -> tuple[F64, F64]:
    """Return two unit vectors (3, N) that stand on unit vectors (3, N) and on each other."""
    x, y, z = axis
    zero = np.zeros_like(x)
    u = np.where(np.abs(x) > np.abs(y), (-z, zero, x), (zero, z, -y))
    u /= np.sqrt((u**2).sum(axis=0))
    v = np.stack((y * u[2] - z * u[1], z * u[0] - x * u[2], x * u[1] - y * u[0]))
    return u, v
