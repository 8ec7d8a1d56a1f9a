"""Online intrinsic calibration of an L2 from its clouds.

The fan of the head points both ways: within one turn it sees every surface twice, with the half
that rises and with the half that falls. Units are off from their own calibration block by up to
0.4 degrees in ``xi_angle`` and ``beta_angle``, which moves the two views apart, by 4 cm at 5 m.
Registration then follows the pattern of the lines instead of the walls: a sensor at rest seems to
turn by half a degree in a second. ``l2lidar calibrate still`` measures the angles once and for
all; here they are estimated without it, from the gaps between the halves of each sweep
(:mod:`l2lidar_proc.odometry.intrinsics.fan_halves`). How far all ranges are off is estimated
beside them (:mod:`l2lidar_proc.odometry.intrinsics.range_bias`). Clouds of other sensors are left
as they are.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import F64, Sweep
from l2lidar_proc import cloud, tuning
from l2lidar_proc.motion.head_line import HeadAngle
from l2lidar_proc.odometry.intrinsics.corrections import Corrections, IntrinsicErrors
from l2lidar_proc.odometry.intrinsics.fan_halves import (
    Halves,
    angle_derivatives,
    angles_at_rest,
    between_halves,
    halves,
)
from l2lidar_proc.odometry.intrinsics.range_bias import RangeBias, SeenAgain

# [ns] of points in which the pattern of an L2 is searched: a whole turn of a slow head shows it in
# any view. Shorter clouds seldom show it in narrow views
_TURN_NS: Final = 250_000_000
_GIVE_UP: Final = 3  # turns without the pattern, after which it is taken for another sensor
_ENOUGH: Final = 1000  # points of a turn; fewer, as of a covered sensor, show nothing
_RATE_MISSES: Final = 5  # sweeps without the known rate's pattern, after which it is searched anew
# information of units [1/rad^2]
_PRIOR: Final = np.diag(
    1.0 / np.square((tuning.BEAM_SIGMA, tuning.BEAM_SIGMA, tuning.ALPHA_SIGMA))
)


class LidarIntrinsics:
    """The estimate of beam angles and range bias of one unit, and the correction of its clouds.

    Attributes
    ----------
    angles : ndarray, shape (3,)
        Added to ``xi_angle``, ``beta_angle`` and ``alpha_angle_bias`` [rad]; 0 along directions
        that are not known.
    ranges : RangeBias
        Estimated beside them.
    """

    def __init__(self) -> None:
        self.ranges = RangeBias()
        self.angles: F64
        self._information: F64
        self._weighted: F64  # information by estimate
        self.forget()
        self._rate: float | None = None
        self._is_shown = False  # whether clouds have had the pattern of an L2
        self._misses = 0  # sweeps in a row without it
        self._unshown: list[Sweep] = []  # the first of all, until they last for a turn
        self._turns = 0  # without the pattern
        self._sweeps = 0
        self._rested_ns = 0  # of the sweeps at rest that were compared last
        self._seen: tuple[Sweep, Halves | None] | None = None  # the latest sweep
        # the one to learn from: its halves, and what corrected angles and ranges
        self._latest: tuple[Sweep, Halves, F64, float] | None = None

    @property
    def is_other(self) -> bool:
        """Whether the clouds are taken for those of another sensor, and looked at no more."""
        return not self._is_shown and self._turns >= _GIVE_UP

    def head(self, sweep: Sweep) -> HeadAngle | None:
        """Return the angle of the head in a sweep, None where its points do not show it."""
        found = self._halves_of(sweep)
        return None if found is None else HeadAngle(sweep.start, found.angle, found.rate)

    def _halves_of(self, sweep: Sweep) -> Halves | None:
        if self.is_other:
            return None
        if self._seen is None or self._seen[0] is not sweep:
            found = halves(sweep.points, self._rate)
            if found is not None:
                self._is_shown, self._misses, self._rate = True, 0, found.rate
            else:
                self._misses += 1
                if self._misses >= _RATE_MISSES:
                    self._rate = None
                if not self._is_shown:
                    self._search_pattern(sweep)
            self._seen = sweep, found
        return self._seen[1]

    def _search_pattern(self, sweep: Sweep) -> None:
        """Search the pattern in a whole turn of the first sweeps."""
        if self._unshown and sweep.start <= self._unshown[-1].start:
            self._unshown = []  # the clock was set, and they might never last for a turn
        self._unshown.append(sweep)
        for turn in cloud.joined(self._unshown, _TURN_NS):
            self._unshown = []
            if halves(turn.points) is not None:
                self._is_shown = True
            elif len(turn.points) >= _ENOUGH:
                self._turns += 1

    def corrected(self, sweep: Sweep) -> Sweep:
        """Return the next sweep with corrected angles; remember it, if it is to :meth:`learn`.

        Parameters
        ----------
        sweep : Sweep
            As the unit reports it, in the cloud frame, not deskewed.
        """
        self._latest = None
        self._sweeps += 1
        corrected = self.applied_to(sweep)
        found = self._halves_of(sweep) if self._teaches() else None
        if found is not None:
            self._latest = corrected, found, self.angles, self.ranges.correction
        return corrected

    def applied_to(self, sweep: Sweep) -> Sweep:
        """Return a sweep as the unit would have measured it with the corrected angles.

        Parameters
        ----------
        sweep : Sweep
            As for :meth:`corrected`.
        """
        is_corrected = self.angles.any() or self.ranges.correction
        found = self._halves_of(sweep) if is_corrected else None
        if found is None:
            return sweep
        points = sweep.points.copy()
        for name, line in zip("xyz", angle_derivatives(points, found), strict=True):
            points[name] += self.angles @ line
        self.ranges.correct(points)
        return dataclasses.replace(sweep, points=points)

    def learn(
        self,
        sweep: Sweep,
        moved: NDArray[np.void],
        *,
        at_rest: bool,
        rest_force: F64 | None = None,
    ) -> None:
        """Take the gaps between the halves of a sweep.

        Errors of the velocity and rate that deskewed it move the halves apart as well, so they are
        estimated together with the angles, and then dropped.

        Parameters
        ----------
        sweep : Sweep
            The one that :meth:`corrected` returned last; others are left out.
        moved : ndarray, shape (N,)
            Its points, deskewed.
        at_rest : bool
            The sensor did not move for certain.
        rest_force : ndarray, shape (3,), optional
            As for :func:`~l2lidar_proc.odometry.intrinsics.range_bias.bend_of_planes`.
        """
        if self._latest is None or self._latest[0] is not sweep or len(moved) != len(sweep.points):
            return
        _, head, used, used_range = self._latest
        if not at_rest:  # a rest shows the same walls again and again
            self.ranges.learn(moved, used=used_range, rest_force=rest_force)
        gaps = between_halves(sweep.points, moved, head)
        if gaps is None:
            return
        measured = gaps.derivatives @ used - gaps.gap
        residual = (measured - gaps.derivatives @ self._estimate) / tuning.BEAM_GAP_SCALE
        weights = 1.0 / (tuning.BEAM_GAP_SIGMA * (1.0 + residual**2)) ** 2
        weighted = gaps.derivatives * weights[:, None]
        information, gradient = weighted.T @ gaps.derivatives, weighted.T @ measured
        if not at_rest:
            prior = np.repeat((1.0 / tuning.BEAM_SPEED, 1.0 / tuning.BEAM_RATE), 3) ** 2
            own = gaps.motion * weights[:, None]
            shared = np.linalg.solve(
                own.T @ gaps.motion + np.diag(prior),
                np.column_stack([own.T @ gaps.derivatives, own.T @ measured]),
            )
            information -= weighted.T @ gaps.motion @ shared[:, :3]
            gradient -= weighted.T @ gaps.motion @ shared[:, 3]
        self._information = self._information + information
        self._weighted = self._weighted + gradient
        self.angles = self._known()

    def learn_from_map(self, seen: SeenAgain) -> None:
        """Learn the range bias from the distances of a sweep's points to the map.

        Wrong beam angles bend the map as well, so they have to be known first.
        """
        if not self.is_other and self.errors.beams[0] < tuning.RANGE_BIAS_MAP_BEAMS:
            self.ranges.learn_from_map(seen)

    def is_due_at_rest(self, sweeps: list[Sweep]) -> bool:
        """Return whether a rest has lasted long enough for :meth:`learn_at_rest`, or once more."""
        lasted = sweeps[-1].end - sweeps[0].start
        return lasted >= max(tuning.BEAM_REST_NS, tuning.BEAM_REST_AGAIN * self._rested_ns)

    def learn_at_rest(self, sweeps: list[Sweep], rest_force: F64 | None = None) -> None:
        """Estimate the angles anew from the sweeps of a sensor at rest, all of them together.

        Parameters
        ----------
        sweeps : list of Sweep
            As the unit reports them, from one place, oldest first.
        rest_force : ndarray, shape (3,), optional
            As for :func:`~l2lidar_proc.odometry.intrinsics.range_bias.bend_of_planes`.
        """
        self._rested_ns = sweeps[-1].end - sweeps[0].start
        if self.is_other:
            return
        shown = [(one.points, halves(one.points, self._rate)) for one in sweeps]
        whole = [(points, found) for points, found in shown if found is not None]
        if not whole:
            return
        found = angles_at_rest(whole, _PRIOR, (self._estimate, self._information))
        if found is not None:
            self._intersect(*found)
            self.angles = self._known()
        self.ranges.forget()
        step = -(-len(sweeps) // tuning.RANGE_BIAS_SWEEPS)
        seen = (self.applied_to(one).points for one in sweeps[::step])
        self.ranges.learn(*seen, rest_force=rest_force)

    def _intersect(self, angles: F64, information: F64) -> None:
        """Fuse another estimate of the angles, from points that this one may come from as well.

        Covariance intersection (Julier and Uhlmann 1997) with the smallest determinant: it is not
        overconfident however the errors of the two are correlated.

        Parameters
        ----------
        angles : ndarray, shape (3,)
            [rad]
        information : ndarray, shape (3, 3)
            Of them, the prior's included [1/rad^2].
        """
        shares = np.linspace(0.0, 1.0, 21)[:, None, None]
        fused = shares * information + (1.0 - shares) * self._information
        best = int(np.linalg.slogdet(fused)[1].argmax())
        share = float(shares[best, 0, 0])
        self._weighted = share * information @ angles + (1.0 - share) * self._weighted
        self._information = fused[best]

    def forget(self) -> None:
        """Forget what was learned, as when the sensor had moved during a supposed rest."""
        self.ranges.forget()
        self.angles = np.zeros(3)
        self._information, self._weighted = _PRIOR, np.zeros(3)

    @property
    def corrections(self) -> Corrections:
        """Corrections that are added to the unit's angles and ranges."""
        return Corrections(self.angles, self.ranges.correction)

    @property
    def errors(self) -> IntrinsicErrors:
        """Uncertainty of corrected clouds."""
        return self.errors_with(self.corrections)

    def errors_with(self, used: Corrections) -> IntrinsicErrors:
        """Return the present uncertainty of clouds that got some corrections.

        An estimate that is too uncertain to be used as a correction counts as an error. Clouds
        without the pattern of an L2 are as good as their makers say.
        """
        if self.is_other:
            return IntrinsicErrors(tuning.OTHER_BEAM_SIGMAS, 0.0, 0.0)
        left = self._estimate - used.angles
        covariance = np.linalg.inv(self._information)
        variances, axes = np.linalg.eigh(covariance[:2, :2])
        best, worst = np.sqrt(variances + (axes.T @ left[:2]) ** 2).tolist()
        alpha = float(np.hypot(np.sqrt(covariance[2, 2]), left[2]))
        return IntrinsicErrors((best, worst), alpha, self.ranges.sigma_with(used.ranges))

    @property
    def learns_from_map(self) -> bool:
        """Whether :meth:`learn_from_map` is of use."""
        return self._is_shown and self.ranges.needs_map

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
        """Return the estimate along directions in which it is certain and not zero.

        One combination of xi and beta moves the halves apart only high above the sensor, so their
        principal axes are judged; alpha is independent. No unit is off by a degree: a larger
        estimate has another cause.
        """
        covariance = np.linalg.inv(self._information)
        variances, axes = np.ones(3), np.eye(3)
        variances[:2], axes[:2, :2] = np.linalg.eigh(covariance[:2, :2])
        variances[2] = covariance[2, 2]
        variances += tuning.BEAM_FLOOR**2
        parts = axes.T @ self._estimate
        sure = (variances < tuning.BEAM_KNOWN**2) & (parts**2 > tuning.BEAM_SIGMAS**2 * variances)
        sure &= np.abs(parts) < tuning.BEAM_MOST
        return np.asarray(axes @ np.where(sure, parts, 0.0))
