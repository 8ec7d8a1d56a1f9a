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
from l2lidar_node.types import F64, I64

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


class Angles(NamedTuple):
    """Sines and cosines of the corrected angles of returns, each of shape (N,) or ()."""

    cos_theta: F64
    sin_theta: F64
    cos_alpha: F64
    sin_alpha: F64
    cos_beta: F64
    sin_beta: F64
    cos_xi: F64
    sin_xi: F64

    @property
    def direction(self) -> tuple[F64, F64, F64]:
        """The rays along e_A, e_B and z, each of shape (N,)."""
        return (
            -self.cos_beta * self.sin_xi + self.sin_beta * self.cos_xi * self.sin_alpha,
            self.cos_alpha * self.cos_xi,
            self.sin_beta * self.sin_xi + self.cos_beta * self.cos_xi * self.sin_alpha,
        )


def angles(
    returns: NDArray[np.void], block: Block, correction: F64, group: I64 | None = None
) -> Angles:
    """Return what :func:`beams` and :func:`derivatives` need of the angles; see there."""
    own = block.values
    theta = np.ascontiguousarray(returns["theta"])
    alpha = np.ascontiguousarray(returns["alpha"])
    if correction[..., STRETCH].any():
        alpha = alpha + _each(correction[..., STRETCH], group) * (alpha - np.pi / 2)
    alpha = alpha + _each(correction[..., ALPHA], group)
    xi = own["xi_angle"] + correction[..., XI]
    beta = own["beta_angle"] + correction[..., BETA]
    cos_beta, sin_beta = _each(np.cos(beta), group), _each(np.sin(beta), group)
    if correction[..., ROCK_COS:].any():
        cosine, sine = np.cos(2.0 * theta), np.sin(2.0 * theta)
        rock_cos = _each(correction[..., ROCK_COS], group)
        rock_sin = _each(correction[..., ROCK_SIN], group)
        alpha = alpha + rock_cos * cosine + rock_sin * sine
        tilted = _each(beta, group) - rock_cos * sine + rock_sin * cosine
        cos_beta, sin_beta = np.cos(tilted), np.sin(tilted)
    return Angles(
        np.cos(theta),
        np.sin(theta),
        np.cos(alpha),
        np.sin(alpha),
        cos_beta,
        sin_beta,
        _each(np.cos(xi), group),
        _each(np.sin(xi), group),
    )


def beams(
    returns: NDArray[np.void],
    block: Block,
    correction: F64,
    group: I64 | None = None,
    at: Angles | None = None,
) -> Beams:
    """Return the rays of returns under a corrected block.

    Parameters
    ----------
    returns : ndarray, shape (N,), dtype RETURN
    block : Block
    correction : ndarray, shape (8,) or (G, 8)
        In the order of :data:`NAMES`.
    group : ndarray, shape (N,), int, optional
        Which row of the correction is that of each return.
    at : Angles, optional
        Where they are known already.
    """
    own = block.values
    at = angles(returns, block, correction, group) if at is None else at
    along, across, up = at.direction
    b = own["b_axis_dist"] + _each(correction[..., B], group)
    origin = np.empty((len(returns), 3))
    origin[:, 0] = at.cos_theta * b
    origin[:, 1] = at.sin_theta * b
    origin[:, 2] = own["a_axis_dist"]
    direction = np.empty((len(returns), 3))
    direction[:, 0] = at.cos_theta * along - at.sin_theta * across
    direction[:, 1] = at.sin_theta * along + at.cos_theta * across
    direction[:, 2] = up
    return Beams(origin, direction, returns["range"] + _each(correction[..., BIAS], group))


def derivatives(returns: NDArray[np.void], at: Angles, normals: F64, distance: F64) -> F64:
    """Return how far each parameter moves a point along a normal.

    Parameters
    ----------
    returns : ndarray, shape (N,), dtype RETURN
    at : Angles
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
    along, across, up = at.direction
    n_a = at.cos_theta * normals[:, 0] + at.sin_theta * normals[:, 1]
    n_b = at.cos_theta * normals[:, 1] - at.sin_theta * normals[:, 0]
    n_c = normals[:, 2]
    s, c, sb, cb = at.sin_alpha, at.cos_alpha, at.sin_beta, at.cos_beta
    sx, cx = at.sin_xi, at.cos_xi
    found = np.empty((len(NAMES), len(returns)))
    found[XI] = n_a * (-cb * cx - sb * sx * s) - n_b * c * sx + n_c * (sb * cx - cb * sx * s)
    found[BETA] = n_a * up - n_c * along
    found[ALPHA] = n_a * sb * cx * c - n_b * s * cx + n_c * cb * cx * c
    found[[XI, BETA, ALPHA]] *= distance
    found[STRETCH] = found[ALPHA] * (returns["alpha"] - np.pi / 2)
    cosine = at.cos_theta**2 - at.sin_theta**2
    sine = 2.0 * at.sin_theta * at.cos_theta
    found[ROCK_COS] = found[ALPHA] * cosine - found[BETA] * sine
    found[ROCK_SIN] = found[ALPHA] * sine + found[BETA] * cosine
    found[B] = n_a
    found[BIAS] = n_a * along + n_b * across + n_c * up
    return found.T


def _each(values: F64, group: I64 | None) -> F64:
    """Return a value () as it is, values (G,) for each return."""
    return values if group is None else values[group]
