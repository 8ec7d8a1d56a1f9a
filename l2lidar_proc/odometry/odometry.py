"""Estimates where the sensor is: sweeps and IMU samples in, one estimate per sweep out."""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import HostNs, Sweep
from l2lidar_proc.config import OdometryConfig
from l2lidar_proc.motion import initialization
from l2lidar_proc.motion.filter import InertialState, at_origin, interrupted, same_bias, slowed
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.odometry import static_start
from l2lidar_proc.odometry.estimate import AlignmentQuality, OdometryEstimate, Status
from l2lidar_proc.odometry.frame_jump import FrameJump
from l2lidar_proc.odometry.matcher import SweepMatcher
from l2lidar_proc.odometry.prediction import LONG_GAP_NS, Predictor
from l2lidar_proc.odometry.report import estimate_of, gaps_in
from l2lidar_proc.odometry.sweep_joining import cropped, joined
from l2lidar_proc.odometry.sweep_motion import SweepMotion
from l2lidar_proc.odometry.zero_velocity import PATIENCE_NS, Standstill, free_to_differ

F64 = NDArray[np.float64]

_OPENING_NS: Final = 450_000_000  # the first sweeps are held for so long
_OPENING_LONGEST_NS: Final = 3_000_000_000  # or, at rest, until they meet each other
_OPENING_FELT_NS: Final = 1_000_000_000  # whose samples tell whether the sensor rests
_OPENING_ROUNDS: Final = 6
_OPENING_STEP: Final = 0.02  # [m/s] a smaller change of the velocity ends the rounds
_REST_SPEED: Final = 0.06  # [m/s] faster, the sensor did not rest, however quiet the IMU
_WHOLE: Final = 0.7  # a sweep with this part of the points of the fullest may begin the map
_OPENING_SWEEP_NS: Final = 150_000_000  # shorter ones are joined: they would not meet
_LOST_NS: Final = 5_000_000_000  # of sweeps without a match
_FELT_NS: Final = 250_000_000  # in which the IMU tells that rest has ended
_EARLY_NS: Final = 4_000_000_000  # until then a rest that was none is begun again, as motion
_EARLY_FARTHEST: Final = 0.5  # [m] if that went no farther


class Odometry:
    """LiDAR-inertial odometry.

    The IMU carries the state from sweep to sweep and through each sweep; the deskewed sweep is
    aligned with a map of surfaces; what the alignment says of velocity and biases deskews the
    sweep again before it extends the map. KISS-ICP thins the points, keeps a map of points, tells
    from its adaptive threshold how good predictions are, and registers sweeps whose prediction is
    loose.

    Parameters
    ----------
    config : OdometryConfig
    T_cloud_imu : ndarray, shape (4, 4)
        IMU coordinates to cloud coordinates.

    Attributes
    ----------
    config : OdometryConfig
    T_cloud_imu : ndarray, shape (4, 4)
    matcher : SweepMatcher
        Holds the maps, whose origin is the IMU's first place.
    """

    def __init__(self, config: OdometryConfig, T_cloud_imu: F64) -> None:
        self.T_cloud_imu = np.array(T_cloud_imu, dtype=np.float64)
        self._lever: F64 = self.T_cloud_imu[:3, 3]
        self._predictor = Predictor(config, self.T_cloud_imu)
        self.config = config
        self.reset()

    def configure(self, config: OdometryConfig) -> None:
        """Take new live settings; the others come into force with :meth:`reset`."""
        self.config = config
        self.matcher.config = self._predictor.config = config

    def reset(self) -> None:
        """Forget map and motion; the next sweep begins a new map."""
        self.matcher = SweepMatcher(self.config, self._lever)
        self._held: list[Sweep] = []
        self._state: InertialState | None = None
        self._covariance: F64 = np.zeros((18, 18))
        self._predictor.reset()
        self._standstill = Standstill()
        self._early: list[Sweep] = []
        self._lost_ns = 0
        self._jump = FrameJump()
        self._last: OdometryEstimate | None = None

    def imu(self, samples: Samples) -> None:
        """Take IMU samples (N,), dtype IMU_SAMPLE, in any order and state."""
        self._predictor.imu(samples)

    def register(self, sweep: Sweep) -> list[OdometryEstimate]:
        """Return where the sensor was at the references of sweeps, oldest first.

        The first sweeps are held until they can be solved together (then their estimates come at
        once); from then on each sweep gives one estimate.

        Parameters
        ----------
        sweep : Sweep
            Any layout of points with x, y, z and time; IMU samples up to its end should have come.
        """
        reference = self._predictor.reference(sweep)
        status: list[Status] = []
        if self._last is not None and reference <= self._last.stamp:
            if reference > self._last.stamp - LONG_GAP_NS:
                return [self._last.refusing(sweep.points)]
            self._restart(reference)
            status.append(Status.RESTARTED)
        sweep = cropped(sweep, self.config.min_range, self.config.max_range)
        if self._state is None:
            return self._opened(sweep)
        motion = self._predictor.over_sweep(sweep, self._state, self._covariance)
        status += gaps_in(motion)
        if self._standstill.holds(self._predictor.felt(sweep.end - _FELT_NS, sweep.end)):
            stayed = self._stayed(sweep, motion, status)
            if stayed is not None:
                return [stayed]
            motion = self._predictor.over_sweep(sweep, self._state, self._covariance)
        self._early.clear()
        source = self.matcher.source(sweep, motion)
        found, uncharted = self.matcher.match(source, motion)
        guess, state, covariance = motion.state, motion.state, motion.covariance
        if found is None:
            few = len(source.points) < self.config.min_points
            status += [Status.PREDICTED, Status.SPARSE if few else Status.UNMATCHED]
            self._lost_ns += 0 if few else sweep.end - sweep.start
            self._standstill.clear()
        else:
            state, covariance = found.state, found.covariance
            self._lost_ns = 0
            felt = self._predictor.felt(sweep.end - PATIENCE_NS, sweep.end)
            self._standstill.watch(state, covariance, felt)
        lasted = (state.stamp - self._state.stamp) * 1e-9
        motion = motion.corrected(*slowed(state, covariance, lasted))
        self._keep(motion)
        moved = motion.deskewed(sweep, self._lever)
        if self._lost_ns >= _LOST_NS:
            status.append(Status.LOST)
            motion = self._begun_again(motion)
        if found is not None or uncharted or Status.LOST in status:
            self.matcher.extend(moved, motion, guess)
        quality = self.matcher.quality(len(source.points), found)
        return [self._estimate(motion, moved, status, quality)]

    def extrapolated(self, stamp: HostNs) -> OdometryEstimate | None:
        """Return what the IMU leads to since the latest reference, None before the first.

        Parameters
        ----------
        stamp : HostNs
            Not before the latest reference; best not after the newest IMU sample.
        """
        state = self._state
        if state is None or self._last is None or stamp <= state.stamp:
            return None
        motion = self._predictor.over(state, self._covariance, (state.stamp, stamp), stamp)
        nothing, noise = self._last.points[:0], self.config.inertial.gyro_noise
        say = ((Status.PREDICTED,), AlignmentQuality())
        return estimate_of(motion, self._lever, nothing, *say, noise, self._jump)

    # ---- beginnings

    def _opened(self, sweep: Sweep) -> list[OdometryEstimate]:
        """Hold the first sweeps until they tell how the sensor moves, then begin the map."""
        held = self._held
        if held and not 0 < sweep.start - held[-1].start < LONG_GAP_NS:
            held.clear()
        held.append(sweep)
        if held[-1].end - held[0].start < _OPENING_NS:
            return []
        whole = joined(held, _OPENING_SWEEP_NS)
        if len(whole) < 2 or whole[-1].end < sweep.end:
            return []
        # the very first sweep is seldom whole
        most = max(len(one.points) for one in whole)
        seed = next(k for k, one in enumerate(whole) if len(one.points) >= _WHOLE * most)
        if seed == len(whole) - 1 and most:
            return []
        enough = most > self.config.min_points
        motions = self._solved(whole[seed:], held[0].start) if enough else []
        if motions is None:
            return []
        if not motions:
            del held[0]
            return []
        motions[:0] = [motions[0]] * seed
        estimates = []
        for one in held:
            within = sum(part.end < one.end for part in whole)
            motion = motions[within].seen_from(self._predictor.reference(one))
            status = [Status.STARTING, *gaps_in(motion)]
            quality = self.matcher.quality(len(one.points), None)
            moved = motion.deskewed(one, self._lever)
            estimates.append(self._estimate(motion, moved, status, quality))
        held.clear()
        return estimates

    def _solved(
        self, sweeps: list[Sweep], since: HostNs, may_rest: bool = True
    ) -> list[SweepMotion] | None:
        """Begin the map with the first sweeps; return their motions, empty if they do not fit.

        As long as the velocity is not known the map's first sweep is smeared: what the following
        ones say of the velocity then deskews it better, in a few rounds. Where little comes back
        it takes many sweeps at rest before one meets what others saw: None as long as that may
        still happen.
        """
        reference = self._predictor.reference(sweeps[0])
        until = min(sweeps[-1].end, since + _OPENING_FELT_NS)
        samples = self._predictor.felt(since - _OPENING_NS, until)
        opening = initialization.opening(samples, reference, may_rest)
        self._predictor.trusts_gravity = opening.gravity_trusted
        late = sweeps[-1].end - since >= _OPENING_LONGEST_NS
        # the odometry frame begins at the cloud frame's origin, the state is the IMU's
        start = dataclasses.replace(opening.state, position=opening.state.rotation @ self._lever)
        self._standstill.clear()
        if opening.at_rest and self._standstill.anchored(start, samples):
            self.matcher.clear()
            parts = (self._predictor, self.matcher, self._standstill)
            motions, met = static_start.begun(sweeps, since, start, opening.covariance, *parts)
            if motions and not met and not late:
                return None
            if motions:
                self._early = list(sweeps)
                self._keep(motions[-1])
                return motions
            self._standstill.clear()
        for _ in range(_OPENING_ROUNDS):
            self.matcher.clear()
            first = self._predictor.over_sweep(sweeps[0], start, opening.covariance, since)
            motions = [first]
            self.matcher.extend(first.deskewed(sweeps[0], self._lever), first, first.state)
            met = False
            for sweep in sweeps[1:]:
                motion = self._predictor.over_sweep(
                    sweep, motions[-1].state, motions[-1].covariance
                )
                source = self.matcher.source(sweep, motion)
                found, uncharted = self.matcher.match(source, motion, opening=True)
                if found is not None:
                    motion = motion.corrected(found.state, found.covariance)
                    met = True
                elif not (uncharted and opening.at_rest):
                    return self._solved(sweeps, since, may_rest=False) if opening.at_rest else []
                motions.append(motion)
                self.matcher.extend(motion.deskewed(sweep, self._lever), motion, motion.state)
            velocity = motions[1].state_at(reference).velocity
            if opening.at_rest and np.linalg.norm(velocity) > _REST_SPEED:
                return self._solved(sweeps, since, may_rest=False)
            if not met and not late:
                return None
            if np.linalg.norm(velocity - start.velocity) < _OPENING_STEP:
                break
            start = dataclasses.replace(start, velocity=velocity)
        self._keep(motions[-1])
        return motions

    def _restart(self, reference: HostNs) -> None:
        """Keep pose and map, forget the motion."""
        assert self._state is not None
        self._jump = self._jump.unseen(self._state)
        stamp = HostNs(reference - 1)
        self._state, self._covariance = interrupted(self._state, self._covariance, stamp)
        self._standstill.clear()

    def _begun_again(self, motion: SweepMotion) -> SweepMotion:
        """Begin a new map where the sensor is now taken to be."""
        self._jump = self._jump.added(motion.state, motion.covariance)
        self._covariance = at_origin(self._covariance)
        self.matcher.clear()
        self._lost_ns = 0
        return dataclasses.replace(motion, covariance=self._covariance)

    # ---- rest

    def _stayed(
        self, sweep: Sweep, motion: SweepMotion, status: list[Status]
    ) -> OdometryEstimate | None:
        """Return the estimate of a sweep at rest, None if it tells that the sensor moves."""
        assert self._state is not None
        trial = motion.at_rest(self._state, free_to_differ())
        source = self.matcher.source(sweep, trial)
        found, _ = self.matcher.match(source, trial)
        if self._early:
            self._early.append(sweep)
        if found is None:
            self._standstill.clear()
            return None
        if not self._standstill.stays(found):
            self._covariance = self._standstill.loosened(self._covariance)
            return self._opened_again(sweep, status)
        if self._early and sweep.end - self._early[0].start > _EARLY_NS:
            self._early.clear()
        state = self._predictor.at_rest(self._state, self._covariance, trial.state.stamp)
        still = motion.at_rest(*state)
        self._keep(still)
        moved = still.deskewed(sweep, self._lever)
        self.matcher.extend(moved, still, still.state)
        quality = self.matcher.quality(len(source.points), found)
        return self._estimate(still, moved, status, quality)

    def _opened_again(self, sweep: Sweep, status: list[Status]) -> OdometryEstimate | None:
        """Begin the map again if the sensor has not stood still since; None if it is older."""
        early = self._early
        if not early or not self._standstill.drifted:
            return None
        for may_rest in (False, True):
            motions = self._solved(early, early[0].start, may_rest)
            if motions and np.linalg.norm(motions[-1].state.position) < _EARLY_FARTHEST:
                moved = motions[-1].deskewed(sweep, self._lever)
                quality = self.matcher.quality(len(sweep.points), None)
                self._early = []
                return self._estimate(motions[-1], moved, [*status, Status.STARTING], quality)
        self._lost_ns = _LOST_NS
        return None

    # ---- steps

    def _keep(self, motion: SweepMotion) -> None:
        """Remember the state for the next prediction."""
        state, covariance = motion.state, motion.covariance
        if motion.felt.missing.all() and self._state is not None:
            state, covariance = same_bias(state, covariance, self._state, self._covariance)
        self._state, self._covariance = state, covariance
        self._predictor.steady = motion.rate

    def _estimate(
        self,
        motion: SweepMotion,
        moved: NDArray[np.void],
        status: list[Status],
        quality: AlignmentQuality,
    ) -> OdometryEstimate:
        if not self._predictor.trusts_gravity:
            status.append(Status.GRAVITY_UNTRUSTED)
        noise = self.config.inertial.gyro_noise
        self._last = estimate_of(
            motion, self._lever, moved, tuple(status), quality, noise, self._jump
        )
        return self._last

    def map_points(self) -> F64:
        """Return the points of KISS-ICP's local map [m], shape (N, 3), odometry frame."""
        return self.matcher.kiss.points()
