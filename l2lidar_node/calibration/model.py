"""Beam model of the L2: points of raw returns under a corrected block, and their derivatives.

In the head frame at head angle theta, with e_A = (cos theta, sin theta, 0),
e_B = (-sin theta, cos theta, 0) and z up, a return of range D lies at::

    A = (-cos(beta) sin(xi) + sin(beta) cos(xi) sin(alpha)) D + b
    B = cos(alpha) cos(xi) D
    C = (sin(beta) sin(xi) + cos(beta) cos(xi) sin(alpha)) D + a

A still sensor sees every surface with both halves of its fan, alpha below and above 90 degrees. An
error of xi, beta, alpha or b moves the two views apart; a common rotation about z, a common shift
along z and the scale of ranges move them together and cannot be known at rest.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.protocol import wire
from l2lidar_node.types import F64

RETURN: Final = np.dtype(
    [
        ("packet", "<i4"),  # number of the packet within its place
        ("theta", "<f8"),  # [rad] head angle with the reported theta_angle_bias
        ("alpha", "<f8"),  # [rad] mirror angle with the reported alpha_angle_bias
        ("range", "<f8"),  # [m] by the reported scale and bias
        ("intensity", "<f4"),  # 0 to 255
    ]
)
"""One return of a 3D packet, in the order of measurement."""


class Block(NamedTuple):
    """A calibration block as a unit reports it.

    Attributes
    ----------
    octets : bytes
        The 32 bytes of :data:`wire.CALIBRATION`: the identity of a unit and its mode.
    """

    octets: bytes

    @property
    def values(self) -> dict[str, float]:
        """Every entry by its name in :data:`wire.CALIBRATION`."""
        record = np.frombuffer(self.octets, wire.CALIBRATION, 1)[0]
        return {name: float(record[name]) for name in wire.CALIBRATION.names or ()}


NAMES: Final = ("xi", "beta", "alpha", "b", "bias", "stretch", "rock_cos", "rock_sin")
"""Parameters of a correction, in the order of every array of them; each is added to the block.

``xi``, ``beta`` and ``alpha`` [rad] to ``xi_angle``, ``beta_angle`` and ``alpha_angle_bias``;
``b`` [m] to ``b_axis_dist``; ``bias`` [m] to every range. ``stretch`` [1] widens the fan about 90
degrees, as another ``angle_increment`` would: it only serves to test whether a bias is one.
``rock_cos`` and ``rock_sin`` [rad] tilt the housing against the turning of the head; what it tilts
with the head is the same as ``alpha`` and ``beta``.
"""

XI, BETA, ALPHA, B, BIAS, STRETCH, ROCK_COS, ROCK_SIN = range(len(NAMES))


class Beams(NamedTuple):
    """Rays in the cloud frame of a still sensor: the point of range D is origin + D direction.

    Attributes
    ----------
    origin, direction : ndarray, shape (N, 3)
        [m] and unit.
    distance : ndarray, shape (N,)
        Corrected range [m].
    """

    origin: F64
    direction: F64
    distance: F64

    @property
    def points(self) -> F64:
        """The returns in the cloud frame [m], shape (N, 3)."""
        return self.origin + self.direction * self.distance[:, None]


def beams(returns: NDArray[np.void], block: Block, correction: F64) -> Beams:
    """Return the rays of returns under a corrected block.

    Parameters
    ----------
    returns : ndarray, shape (N,), dtype RETURN
    block : Block
    correction : ndarray, shape (8,) or (N, 8)
        In the order of :data:`NAMES`.
    """
    own = block.values
    xi = own["xi_angle"] + correction[..., XI]
    alpha, beta = _angles(returns, own, correction)
    cos_theta, sin_theta = np.cos(returns["theta"]), np.sin(returns["theta"])
    along = -np.cos(beta) * np.sin(xi) + np.sin(beta) * np.cos(xi) * np.sin(alpha)
    across = np.cos(alpha) * np.cos(xi)
    up = np.sin(beta) * np.sin(xi) + np.cos(beta) * np.cos(xi) * np.sin(alpha)
    b = own["b_axis_dist"] + correction[..., B]
    origin = np.stack(
        (cos_theta * b, sin_theta * b, np.full(len(returns), own["a_axis_dist"])), axis=-1
    )
    direction = np.stack(
        (cos_theta * along - sin_theta * across, sin_theta * along + cos_theta * across, up),
        axis=-1,
    )
    return Beams(origin, direction, returns["range"] + correction[..., BIAS])


def derivatives(
    returns: NDArray[np.void], block: Block, correction: F64, normals: F64, distance: F64
) -> F64:
    """Return how far each parameter moves a point along a normal.

    Parameters
    ----------
    returns : ndarray, shape (N,), dtype RETURN
    block : Block
    correction : ndarray, shape (8,) or (N, 8)
    normals : ndarray, shape (N, 3)
        Unit, cloud frame.
    distance : ndarray, shape (N,)
        Where on the ray [m]. Where the ray meets its plane: at the measured range the derivatives
        would contain the noise, and the estimate would be pulled towards short ranges.

    Returns
    -------
    ndarray, shape (N, 8)
        [m/rad], for ``b`` and ``bias`` [1], for ``stretch`` [m].
    """
    own = block.values
    xi = own["xi_angle"] + correction[..., XI]
    alpha, beta = _angles(returns, own, correction)
    cos_theta, sin_theta = np.cos(returns["theta"]), np.sin(returns["theta"])
    n_a = cos_theta * normals[:, 0] + sin_theta * normals[:, 1]
    n_b = cos_theta * normals[:, 1] - sin_theta * normals[:, 0]
    n_c = normals[:, 2]
    sx, cx, sb, cb = np.sin(xi), np.cos(xi), np.sin(beta), np.cos(beta)
    s, c = np.sin(alpha), np.cos(alpha)
    along, across, up = -cb * sx + sb * cx * s, c * cx, sb * sx + cb * cx * s
    found = np.empty((len(returns), len(NAMES)))
    found[:, XI] = n_a * (-cb * cx - sb * sx * s) - n_b * c * sx + n_c * (sb * cx - cb * sx * s)
    found[:, BETA] = n_a * up - n_c * along
    found[:, ALPHA] = n_a * sb * cx * c - n_b * s * cx + n_c * cb * cx * c
    found[:, STRETCH] = found[:, ALPHA] * (returns["alpha"] - np.pi / 2)
    cosine, sine = np.cos(2.0 * returns["theta"]), np.sin(2.0 * returns["theta"])
    found[:, ROCK_COS] = found[:, ALPHA] * cosine - found[:, BETA] * sine
    found[:, ROCK_SIN] = found[:, ALPHA] * sine + found[:, BETA] * cosine
    found[:, [XI, BETA, ALPHA, STRETCH, ROCK_COS, ROCK_SIN]] *= distance[:, None]
    found[:, B] = n_a
    found[:, BIAS] = n_a * along + n_b * across + n_c * up
    return found


def _angles(returns: NDArray[np.void], own: dict[str, float], correction: F64) -> tuple[F64, F64]:
    """Return alpha and beta of every return [rad]."""
    alpha = returns["alpha"]
    alpha = alpha + correction[..., ALPHA] + correction[..., STRETCH] * (alpha - np.pi / 2)
    beta = np.broadcast_to(own["beta_angle"] + correction[..., BETA], alpha.shape)
    if not correction[..., ROCK_COS:].any():
        return alpha, beta
    cosine, sine = np.cos(2.0 * returns["theta"]), np.sin(2.0 * returns["theta"])
    rock_cos, rock_sin = correction[..., ROCK_COS], correction[..., ROCK_SIN]
    return (
        alpha + rock_cos * cosine + rock_sin * sine,
        beta - rock_cos * sine + rock_sin * cosine,
    )
