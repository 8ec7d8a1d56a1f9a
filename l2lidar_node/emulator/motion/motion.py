"""Motion of the sensor: pose, rates and accelerations on a smooth curve.

Position and quaternion form one vector of seven numbers, interpolated by a spline over time, the
quaternion then divided by its norm. With Q the spline's unnormalised
quaternion the body's angular velocity is ``w = 2 vec(Q* Q') / |Q|^2`` and its derivative
``2 vec(Q* Q'') / |Q|^2 - w (|Q|^2)' / |Q|^2``: no numeric differentiation anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.recording import tum
from l2lidar_node.types import STANDARD_GRAVITY

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
        Unit, body to world, neighbors less than half a turn apart; the sign of each does not
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
    """Choose signs so that neighbors lie on the same side."""
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


MOUNTS: Final[dict[str, tuple[float, float, float]]] = {
    "upright": (0.0, 0.0, 0.0),
    "forward": (np.pi, -np.pi / 2, 0.0),  # the dome looks ahead
    "tilted": (0.0, np.deg2rad(30.0), 0.0),  # the dome leans ahead
    "upside_down": (np.pi, 0.0, 0.0),
}
"""Roll, pitch, yaw [rad] of the cloud frame in the carrier's frame (x ahead, z up) by name."""


@dataclass(frozen=True, slots=True, eq=False)
class Kinematics:
    """Kinematics of the cloud frame at N instants.

    Attributes
    ----------
    position, velocity, acceleration : ndarray, shape (N, 3)
        Of the cloud frame's origin in the world frame [m, m/s, m/s^2].
    quaternion_wxyz : ndarray, shape (N, 4)
        Unit, cloud to world.
    angular_velocity, angular_acceleration : ndarray, shape (N, 3)
        In the cloud frame [rad/s, rad/s^2].
    """

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    quaternion_wxyz: NDArray[np.float64]
    angular_velocity: NDArray[np.float64]
    angular_acceleration: NDArray[np.float64]

    @property
    def velocity_body(self) -> NDArray[np.float64]:
        """Velocity of the cloud frame's origin in the cloud frame [m/s], shape (N, 3)."""
        return _into_body(self.quaternion_wxyz, self.velocity)

    def specific_force(
        self,
        lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0),
        gravity: float = STANDARD_GRAVITY,
    ) -> NDArray[np.float64]:
        """Return the specific force of an ideal accelerometer [m/s^2], cloud frame, shape (N, 3).

        Parameters
        ----------
        lever_arm : tuple of float
            Place of the accelerometer in the cloud frame [m].
        gravity : float
            [m/s^2]; a level sensor at rest measures it on +z.
        """
        arm = np.asarray(lever_arm)
        force = _into_body(self.quaternion_wxyz, self.acceleration + np.array([0.0, 0.0, gravity]))
        spin = self.angular_velocity
        return (
            force + np.cross(self.angular_acceleration, arm) + np.cross(spin, np.cross(spin, arm))
        )


class Motion:
    """The sensor's trajectory through the world.

    The time line begins with a rest, then speeds up smoothly (three continuous derivatives) within
    ``ramp_s`` to the pace of the underlying curve. A periodic curve goes on for ever; any other
    slows down within ``ramp_s`` before its end and holds there. Before time 0 the sensor rests.

    Parameters
    ----------
    curve : PoseSpline
        Poses of the carrier (x ahead, z up at rest), world frame (z up), over seconds.
    rest_s : float
        Rest at the beginning [s]. With 0 there is neither rest nor ramp: the curve begins at full
        pace.
    ramp_s : float
        How long speeding up and slowing down take [s].
    mount_wxyz : tuple of float
        Rotation of the cloud frame in the carrier's frame, see :func:`mount_quaternion`.
    """

    def __init__(
        self,
        curve: PoseSpline,
        *,
        rest_s: float = 2.0,
        ramp_s: float = 1.5,
        mount_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
    ) -> None:
        self._curve = curve.turned(np.asarray(mount_wxyz))
        self.rest_s = rest_s
        span = curve.end - curve.start
        self.ramp_s = 0.0 if rest_s == 0 else ramp_s if curve.periodic else min(ramp_s, span)

    @property
    def duration_s(self) -> float:
        """When the sensor comes to its final hold [s]; infinite for a motion that repeats."""
        if self._curve.periodic:
            return np.inf
        return self.rest_s + self.ramp_s + self._curve.end - self._curve.start

    @property
    def lap_s(self) -> float:
        """How long one lap takes at full pace [s]; infinite for a motion without laps."""
        return self._curve.end - self._curve.start if self._curve.periodic else np.inf

    def poses(self, t_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return where the cloud frame is.

        Parameters
        ----------
        t_s : ndarray, shape (N,)
            [s] on the motion's time line.

        Returns
        -------
        positions : ndarray, shape (N, 3)
            [m], world frame.
        quaternions_wxyz : ndarray, shape (N, 4)
            Unit, cloud to world.
        """
        return self._curve.poses(self._warp(np.asarray(t_s, np.float64))[0])

    def kinematics(self, t_s: NDArray[np.float64]) -> Kinematics:
        """Return pose, velocity and acceleration at instants (N,) [s]: exact derivatives."""
        u, rate, change = self._warp(np.asarray(t_s, np.float64))
        d = self._curve.derivatives(u)
        rate, change = rate[:, None], change[:, None]
        return Kinematics(
            d.position,
            d.velocity * rate,
            d.acceleration * rate**2 + d.velocity * change,
            d.quaternion_wxyz,
            d.angular_velocity * rate,
            d.angular_acceleration * rate**2 + d.angular_velocity * change,
        )

    def trajectory(self, t_s: NDArray[np.float64], origin_ns: int = 0) -> NDArray[np.void]:
        """Return the poses at instants (N,) as a POSE array; time 0 gets stamp ``origin_ns``."""
        stamps = origin_ns + np.round(np.asarray(t_s) * 1e9).astype(np.int64)
        return tum.pose_array(stamps, *self.poses(t_s))

    def _warp(
        self, t: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the curve's parameter at each instant, its rate and the rate's derivative."""
        start, span = self._curve.start, self._curve.end - self._curve.start
        t = t - self.rest_s
        if self.ramp_s == 0.0:
            moving = (t >= 0.0) & ((t <= span) | self._curve.periodic)
            u = np.maximum(t, 0.0) if self._curve.periodic else np.clip(t, 0.0, span)
            return start + u, moving.astype(np.float64), np.zeros_like(t)
        u, rate, change = _ramp(t, self.ramp_s)
        if not self._curve.periodic:
            late, late_rate, late_change = _ramp(t - span, self.ramp_s)
            u, rate, change = np.minimum(u - late, span), rate - late_rate, change - late_change
        return start + u, rate, change


def mount_quaternion(mount: str | tuple[float, float, float]) -> tuple[float, float, float, float]:
    """Return the rotation (w, x, y, z) of the cloud frame in the carrier's frame.

    Parameters
    ----------
    mount : str or tuple of float
        A name of :data:`MOUNTS`, or roll, pitch, yaw [rad]: R = Rz(yaw) Ry(pitch) Rx(roll).

    Raises
    ------
    ValueError
        For a name that is not known.
    """
    if isinstance(mount, str):
        if mount not in MOUNTS:
            raise ValueError(f"mount '{mount}' is not known, expected one of {', '.join(MOUNTS)}")
        mount = MOUNTS[mount]
    w, x, y, z = rpy_quaternions(np.array([mount]))[0].tolist()
    return (w, x, y, z)


def rpy_quaternions(rpy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return quaternions (N, 4) of roll, pitch, yaw (N, 3) [rad]: Rz(yaw) Ry(pitch) Rx(roll)."""
    zero = np.zeros(len(rpy))
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy.T / 2), np.sin(rpy.T / 2)
    roll = np.stack([cr, sr, zero, zero], axis=1)
    pitch = np.stack([cp, zero, sp, zero], axis=1)
    yaw = np.stack([cy, zero, zero, sy], axis=1)
    return rotations.multiply(yaw, rotations.multiply(pitch, roll))


def from_tum(
    path: str | Path,
    *,
    rest_s: float = 2.0,
    mount: str | tuple[float, float, float] = "upright",
) -> Motion:
    """Return the motion along a TUM file's poses, which are taken as the carrier's.

    The first pose is reached at time ``rest_s`` (with a rest the pace first rises, see
    :class:`Motion`).

    Raises
    ------
    ValueError
        If the file is not a trajectory of at least four poses with rising stamps.
    """
    poses = tum.load(path)
    if len(poses) < 4:
        raise tum.TrajectoryError(f"{path}: {len(poses)} poses, a motion needs at least 4")
    seconds = (poses["stamp"] - poses["stamp"][0]) * 1e-9
    curve = PoseSpline(seconds, poses["position"], poses["quaternion_wxyz"])
    return Motion(curve, rest_s=rest_s, mount_wxyz=mount_quaternion(mount))


def _ramp(
    t: NDArray[np.float64], length: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return integral, value and derivative of a smooth step from 0 at t = 0 to 1 at t = length.

    The step is the polynomial of degree 7 with three vanishing derivatives at both ends.
    """
    s = np.clip(t / length, 0.0, 1.0)
    value = s**4 * (35.0 + s * (-84.0 + s * (70.0 - 20.0 * s)))
    change = 140.0 * s**3 * (1.0 - s) ** 3 / length
    integral = length * s**5 * (7.0 + s * (-14.0 + s * (10.0 - 2.5 * s)))
    return integral + np.maximum(t - length, 0.0), value, change


def _into_body(
    quaternions_wxyz: NDArray[np.float64], vectors: NDArray[np.float64]
) -> NDArray[np.float64]:
    matrices = rotations.matrices(quaternions_wxyz)
    return np.asarray(np.einsum("nij,ni->nj", matrices, vectors))
