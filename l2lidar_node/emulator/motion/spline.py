"""Interpolates poses by one smooth spline whose derivatives are exact.

Position and quaternion form one vector of seven numbers, interpolated by a spline over time, the
quaternion then divided by its norm. With Q the spline's unnormalised
quaternion the body's angular velocity is ``w = 2 vec(Q* Q') / |Q|^2`` and its derivative
``2 vec(Q* Q'') / |Q|^2 - w (|Q|^2)' / |Q|^2``: no numeric differentiation anywhere.
"""

from __future__ import annotations

from math import factorial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations

if TYPE_CHECKING:
    from scipy.interpolate import PPoly


class Derivatives(NamedTuple):
    """Pose and its first two derivatives with respect to the spline's parameter, each of N rows.

    ``position``, ``velocity``, ``acceleration`` (N, 3) are in the world frame,
    ``angular_velocity`` and ``angular_acceleration`` (N, 3) in the body frame; ``quaternion_wxyz``
    (N, 4) is body to world.
    """

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    quaternion_wxyz: NDArray[np.float64]
    angular_velocity: NDArray[np.float64]
    angular_acceleration: NDArray[np.float64]


class PoseSpline:
    """A smooth curve of poses.

    Parameters
    ----------
    knots : ndarray, shape (N,)
        Strictly ascending parameter values (seconds, usually), at least 4.
    positions : ndarray, shape (N, 3)
        [m], world frame.
    quaternions_wxyz : ndarray, shape (N, 4)
        Unit, body to world, neighbours less than half a turn apart; the sign of each does not
        matter.
    periodic : bool
        The last pose equals the first and the curve goes on smoothly from there.
    degree : int
        3 (two continuous derivatives; overshoots least between uneven knots) or 5 (four).

    Attributes
    ----------
    start, end : float
        Span of the parameter; outside it a periodic curve repeats, any other must not be asked.
    periodic : bool
    """

    def __init__(
        self,
        knots: NDArray[np.float64],
        positions: NDArray[np.float64],
        quaternions_wxyz: NDArray[np.float64],
        *,
        periodic: bool = False,
        degree: int = 3,
    ) -> None:
        values = np.hstack([positions, _continuous(quaternions_wxyz)])
        if periodic:
            if values[0, 3:] @ values[-1, 3:] < 0:  # an odd number of turns: go round twice
                second = values[1:] * np.r_[np.ones(3), -np.ones(4)]
                knots = np.r_[knots, knots[1:] + (knots[-1] - knots[0])]
                values = np.vstack([values, second])
            values[-1] = values[0]
        self._pieces = _pieces(knots, values, periodic, degree)
        self.start = float(knots[0])
        self.end = float(knots[-1])
        self.periodic = periodic

    def turned(self, mount_wxyz: NDArray[np.float64]) -> PoseSpline:
        """Return the curve of a frame fixed to the body at R_body_frame = ``mount_wxyz``."""
        copy = object.__new__(PoseSpline)
        copy.start, copy.end, copy.periodic = self.start, self.end, self.periodic
        coefficients = self._pieces.c.copy()
        coefficients[..., 3:] = rotations.multiply(coefficients[..., 3:], mount_wxyz)
        copy._pieces = type(self._pieces)(
            coefficients, self._pieces.x, extrapolate=self._pieces.extrapolate
        )
        return copy

    def poses(self, u: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions (N, 3) and unit quaternions (N, 4) at parameter values (N,)."""
        values = self._pieces(u)
        quaternion = values[:, 3:]
        return values[:, :3], quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)

    def derivatives(self, u: NDArray[np.float64]) -> Derivatives:
        """Return pose and derivatives at parameter values (N,)."""
        value, first, second = self._pieces(u), self._pieces(u, 1), self._pieces(u, 2)
        q, dq, ddq = value[:, 3:], first[:, 3:], second[:, 3:]
        square = np.sum(q * q, axis=1, keepdims=True)
        conjugate = q * np.array([1.0, -1.0, -1.0, -1.0])
        rate = 2.0 * rotations.multiply(conjugate, dq)[:, 1:] / square
        shrink = 2.0 * np.sum(q * dq, axis=1, keepdims=True) / square
        acceleration = 2.0 * rotations.multiply(conjugate, ddq)[:, 1:] / square - rate * shrink
        return Derivatives(
            value[:, :3], first[:, :3], second[:, :3], q / np.sqrt(square), rate, acceleration
        )


def _continuous(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Choose signs so that neighbours lie on the same side."""
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    signs = np.where(np.r_[0, np.cumsum(flips)] % 2, -1.0, 1.0)
    return quaternions * signs[:, None]


def _pieces(
    knots: NDArray[np.float64], values: NDArray[np.float64], periodic: bool, degree: int
) -> PPoly:
    """Return the interpolating spline as polynomial pieces, which evaluate fastest."""
    from scipy.interpolate import PPoly, make_interp_spline

    spline = make_interp_spline(knots, values, k=degree, bc_type="periodic" if periodic else None)
    breaks = spline.t[degree:-degree]
    powers = range(degree, -1, -1)
    coefficients = np.array([spline(breaks[:-1], nu=power) / factorial(power) for power in powers])
    return PPoly(coefficients, breaks, extrapolate="periodic" if periodic else True)
