"""Beam angles of an L2, estimated from its clouds while the odometry runs.

The fan of the head points both ways: within one turn it sees every surface twice, with the half
that rises and with the half that falls. Units are off from their own calibration block by up to
0.4 degrees in ``xi_angle`` and ``beta_angle``, which moves the two views apart, by 4 cm at 5 m.
Registration then follows the pattern of the lines instead of the walls: a sensor at rest seems to
turn by half a degree in a second. ``l2lidar calibrate still`` measures the angles once and for
all; here they are estimated without it, from the gaps between the halves of each sweep.

A cloud does not say which half a point belongs to, but the head turns steadily: twice the azimuth
of a point is twice the head's angle in either half, so a line through it over time gives the
head's angle but for half a turn, and the elevation rises in one half and falls in the other.
Clouds without that pattern, of other sensors or in other frames, are left as they are.

To first order (:mod:`l2lidar_node.calibration.model`) an error of xi moves a point at range D by
-D, and one of beta by its height z, along e_A, the horizontal direction across the fan.
"""

from __future__ import annotations

import dataclasses
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records
from l2lidar_node.types import F64, I64, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.odometry.principal_axes import principal_axes, products

_HEAD_HZ: Final = np.arange(3.0, 8.0, 0.05)  # units were measured from 4.3 to 5.6
_RATE_NEAR: Final = 1.0 + np.arange(-0.02, 0.0201, 0.004)  # of a head whose rate is known
_NEAR_M: Final = 0.5  # from the head's axis; nearer, the azimuth says little
_FAN_S: Final = 2e-4  # between points that follow each other in a fan
_MOST: Final = 200  # points that show the head's angle
_SHOWN: Final = 3000  # points whose order tells the halves apart
_FITS: Final = 0.9  # length of the mean of unit vectors; 1 where a line fits all points
_RISES: Final = 0.1  # mean of the signs by which elevations change; 0 where there is no fan
_HALF_LEAST: Final = 0.05  # share of the points that the smaller half has
_GIVE_UP: Final = 20  # sweeps in a row without the pattern: it is another sensor


class Halves(NamedTuple):
    """Which half of the fan measured each point of a cloud.

    Attributes
    ----------
    sign : ndarray, shape (N,)
        1 where the elevation rises with time, -1 where it falls.
    rate : float
        Of the head [rad/s].
    """

    sign: F64
    rate: float


def halves(points: NDArray[np.void], rate: float | None = None) -> Halves | None:
    """Return the halves of a cloud, None where it has not the pattern of an L2.

    Parameters
    ----------
    points : ndarray, shape (N,)
        With x, y, z [m] in the cloud frame, not deskewed, and time [s], ascending.
    rate : float, optional
        Of the head as known so far [rad/s].
    """
    x, y, z, time = (points[name].astype(np.float32) for name in ("x", "y", "z", "time"))
    radius = np.maximum(np.sqrt(x * x + y * y), np.float32(1e-6))
    far = np.flatnonzero(radius > _NEAR_M)
    if len(far) < tuning.BEAM_POINTS:
        return None
    some = records.decimated(far, _MOST)
    doubled = ((x[some] + 1j * y[some]) / radius[some]) ** 2
    rates = 2.0 * np.pi * _HEAD_HZ if rate is None else rate * _RATE_NEAR
    means = np.exp(-2j * np.outer(rates, time[some])) @ doubled / len(some)
    best = int(np.abs(means).argmax())
    if np.abs(means[best]) < _FITS:
        return None
    found = float(rates[best])
    fan = np.float32(found) * time + np.float32(0.5 * np.angle(means[best]))
    sign = np.where(x * np.cos(fan) + y * np.sin(fan) >= 0.0, 1.0, -1.0)
    part = slice(_SHOWN)
    height = z[part] / radius[part]
    follows = (np.diff(time[part]) < _FAN_S) & (sign[1:_SHOWN] == sign[: len(height) - 1])
    rises = (np.sign(np.diff(height)) * sign[1:_SHOWN])[follows]
    if len(rises) < tuning.BEAM_POINTS or abs(rises.mean()) < _RISES:
        return None
    share = np.count_nonzero(sign > 0.0) / len(sign)
    if not _HALF_LEAST < share < 1.0 - _HALF_LEAST:
        return None
    return Halves(sign * np.sign(rises.mean()), found)


class BeamAngles:
    """The estimate of xi and beta of one unit, and the correction of its clouds.

    Attributes
    ----------
    correction : ndarray, shape (2,)
        Added to ``xi_angle`` and ``beta_angle`` [rad]; 0 along directions that are not known.
    """

    def __init__(self) -> None:
        self.correction: F64 = np.zeros(2)
        self._information: F64 = np.eye(2) / tuning.BEAM_SIGMA**2
        self._weighted: F64 = np.zeros(2)  # information by estimate
        self._rate: float | None = None
        self._failures = 0
        self._sweeps = 0
        self._latest: tuple[Sweep, F64, F64] | None = None  # its halves, and what corrected it

    def corrected(self, sweep: Sweep) -> Sweep:
        """Return a sweep as the unit would have measured it with the corrected angles.

        Parameters
        ----------
        sweep : Sweep
            As the unit reports it, in the cloud frame, not deskewed.
        """
        self._latest = None
        self._sweeps += 1
        is_due = self._teaches()
        if self._failures >= _GIVE_UP or not (is_due or self.correction.any()):
            return sweep
        found = halves(sweep.points, self._rate)
        if found is None:
            self._failures += self._rate is None
            return sweep
        self._failures, self._rate = 0, found.rate
        if self.correction.any():
            points = sweep.points.copy()
            for name, line in zip("xy", _levers(points, found.sign), strict=True):
                points[name] += self.correction @ line
            sweep = dataclasses.replace(sweep, points=points)
        if is_due:
            self._latest = sweep, found.sign, self.correction
        return sweep

    def learn(self, sweep: Sweep, moved: NDArray[np.void], *, at_rest: bool) -> None:
        """Take the gaps between the halves of a sweep.

        Velocity and rate that deskewed it may be a little off, which moves halves apart as well;
        so they are estimated along and forgotten.

        Parameters
        ----------
        sweep : Sweep
            The one that :meth:`corrected` returned last; others are left out.
        moved : ndarray, shape (N,)
            Its points, deskewed.
        at_rest : bool
            The sensor did not move for certain.
        """
        if self._latest is None or self._latest[0] is not sweep or len(moved) != len(sweep.points):
            return
        _, sign, used = self._latest
        gaps = between_halves(sweep.points, moved, sign)
        if gaps is None:
            return
        measured = gaps.levers @ used - gaps.gap
        residual = (measured - gaps.levers @ self._estimate) / tuning.BEAM_GAP_SCALE
        weights = 1.0 / (tuning.BEAM_GAP_SIGMA * (1.0 + residual**2)) ** 2
        weighted = gaps.levers * weights[:, None]
        information, gradient = weighted.T @ gaps.levers, weighted.T @ measured
        if not at_rest:
            prior = np.repeat((1.0 / tuning.BEAM_SPEED, 1.0 / tuning.BEAM_RATE), 3) ** 2
            own = gaps.motion * weights[:, None]
            shared = np.linalg.solve(
                own.T @ gaps.motion + np.diag(prior),
                np.column_stack([own.T @ gaps.levers, own.T @ measured]),
            )
            information -= weighted.T @ gaps.motion @ shared[:, :2]
            gradient -= weighted.T @ gaps.motion @ shared[:, 2]
        self._information = self._information + information
        self._weighted = self._weighted + gradient
        self.correction = self._known()

    @property
    def sigmas(self) -> tuple[float, float] | None:
        """What the angles of corrected clouds may be wrong by, 1 sigma [rad].

        Along the direction that is known best, and the other. What the estimate says but is not
        sure enough of to correct it counts as well. None for clouds without the pattern of an L2.
        """
        if self._failures >= _GIVE_UP:
            return None
        left = self._estimate - self.correction
        squared = np.linalg.inv(self._information) + np.outer(left, left)
        best, worst = np.sqrt(np.linalg.eigvalsh(squared)).tolist()
        return best, worst

    def _teaches(self) -> bool:
        """Return whether the present sweep is worth the time that its gaps take."""
        first, most = tuning.BEAM_OFTEN
        if self._sweeps < first or self._sweeps % tuning.BEAM_SELDOM == 0:
            return True
        unsure = np.linalg.eigvalsh(self._information)[-1] < 1.0 / tuning.BEAM_SURE**2
        return bool(unsure) and self._sweeps < most

    @property
    def _estimate(self) -> F64:
        return np.asarray(np.linalg.solve(self._information, self._weighted), dtype=np.float64)

    def _known(self) -> F64:
        """Return the estimate along those directions that are known, and differ from zero.

        Both angles together move the halves apart only high above the sensor. No unit is off by
        a degree: what seems so has another cause.
        """
        variances, axes = np.linalg.eigh(np.linalg.inv(self._information))
        variances += tuning.BEAM_FLOOR**2
        parts = axes.T @ self._estimate
        sure = (variances < tuning.BEAM_KNOWN**2) & (parts**2 > tuning.BEAM_SIGMAS**2 * variances)
        sure &= np.abs(parts) < tuning.BEAM_MOST
        return np.asarray(axes @ np.where(sure, parts, 0.0))


class Gaps(NamedTuple):
    """Flat cells that both halves see.

    Attributes
    ----------
    gap : ndarray, shape (C,)
        Of the rising half from the falling one along the normal [m].
    levers : ndarray, shape (C, 2)
        Derivatives of the gap by xi and beta [m/rad].
    motion : ndarray, shape (C, 6)
        Derivatives by errors of velocity [s] and rate [m s/rad] of what deskewed the points.
    """

    gap: F64
    levers: F64
    motion: F64


def _levers(points: NDArray[np.void], sign: F64) -> tuple[F64, F64]:
    """Return how points move along x and y, (2, N) each, with errors of xi and beta [m/rad]."""
    x, y, z = (points[name].astype(np.float64) for name in "xyz")
    flat = x * x + y * y
    radius = np.maximum(np.sqrt(flat), 1e-6)
    lever = np.stack((-np.sqrt(flat + z * z), z)) * (sign / radius)
    return lever * y, lever * -x


def between_halves(points: NDArray[np.void], moved: NDArray[np.void], sign: F64) -> Gaps | None:
    """Return the gaps between the halves of a cloud, None where no flat cell has both.

    Parameters
    ----------
    points, moved : ndarray, shape (N,)
        As measured, and deskewed.
    sign : ndarray, shape (N,)
        As :class:`Halves` has it.
    """
    at = np.stack([moved[name].astype(np.float64) for name in "xyz"])
    cell = _cells(at)
    count = int(cell.max()) + 1 if len(cell) else 0
    rising = sign > 0.0
    numbers = np.stack([np.bincount(cell[some], minlength=count) for some in (rising, ~rising)])
    both = numbers.min(axis=0, initial=len(sign)) >= tuning.BEAM_CELL_POINTS
    inside = both[cell]
    if not inside.any():
        return None
    kept = np.cumsum(both) - 1
    at, cell, rising = at[:, inside], kept[cell[inside]], rising[inside]
    numbers = numbers[:, both]
    x_levers, y_levers = _levers(points[inside], sign[inside])
    time = points["time"][inside].astype(np.float64)
    time -= 0.5 * (time.min() + time.max())
    lines = np.concatenate((at, x_levers, y_levers, time[None], time * at))
    means = np.stack([_means(lines, cell, some, n) for some, n in
                      zip((rising, ~rising), numbers, strict=True)])  # fmt: skip
    apart = means[0] - means[1]
    around = at - np.where(rising, means[0, :3][:, cell], means[1, :3][:, cell])
    total = numbers.sum(axis=0)
    covariance = [np.bincount(cell, line, len(total)) / total for line in products(*around)]
    spread, axes = principal_axes(np.stack(covariance))
    normal = axes[:, 0].T
    gap = (normal * apart[:3]).sum(axis=0)
    beside = np.sqrt(np.maximum((apart[:3] ** 2).sum(axis=0) - gap**2, 0.0))
    flat = (spread[:, 0] < tuning.BEAM_THICKNESS**2) & (
        spread[:, 1] > (tuning.BEAM_WIDTH * tuning.BEAM_CELL) ** 2
    )
    flat &= (beside < 0.5 * tuning.BEAM_CELL) & (np.abs(gap) < tuning.BEAM_GAP_MOST)
    if np.count_nonzero(flat) < tuning.BEAM_CELLS:
        return None
    levers = normal[0] * apart[3:5] + normal[1] * apart[5:7]
    turned = np.cross(apart[8:11].T, normal.T)
    motion = np.column_stack(((normal * apart[7]).T, turned))
    return Gaps(gap[flat], levers.T[flat], motion[flat])


def _means(lines: F64, cell: I64, some: NDArray[np.bool_], numbers: I64) -> F64:
    """Return the means of lines (L, N) over some points of each cell, (L, C)."""
    where = cell[some]
    sums = [np.bincount(where, line[some], len(numbers)) for line in lines]
    return np.asarray(np.stack(sums) / numbers)


def _cells(at: F64) -> I64:
    """Return the number of the cell of each point (3, N), from 0 on."""
    x, y, z = np.floor(at / tuning.BEAM_CELL).astype(np.int64)
    _, cell = np.unique((x << 40) + (y << 20) + z, return_inverse=True)
    return cell
