"""LiDAR-inertial odometry: sweeps and IMU samples in, one estimate per sweep out."""

from __future__ import annotations

import dataclasses
import functools
from collections import deque
from typing import Final, NamedTuple

import numpy as np

from l2lidar_node.types import F64, HostNs, Sweep
from l2lidar_proc import cloud, tuning
from l2lidar_proc.motion import carrier_priors, filter as eskf
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry import kiss
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.earlier_maps import EarlierMaps, MapRevisit, Relocalization
from l2lidar_proc.odometry.estimate import (
    AlignmentQuality,
    OdometryEstimate,
    Status,
    estimate_of,
    gaps_in,
)
from l2lidar_proc.odometry.initialization.first_rest import FirstRest, Remapping
from l2lidar_proc.odometry.initialization.late_gravity import LateGravity
from l2lidar_proc.odometry.initialization.map_initialization import InitializedMap, MapInitializer
from l2lidar_proc.odometry.initialization.start_velocity import StartVelocity
from l2lidar_proc.odometry.innovation_gate import (
    GatedAlignment,
    InnovationGate,
    Prediction,
    is_narrow,
)
from l2lidar_proc.odometry.innovations import InnovationTest
from l2lidar_proc.odometry.interface import Phase, SweepOrder, sweep_order
from l2lidar_proc.odometry.intrinsics.lidar_intrinsics import LidarIntrinsics
from l2lidar_proc.odometry.matcher import MatchStatus, SweepMatcher
from l2lidar_proc.odometry.prediction import ImuUse, Predictor, blur_of
from l2lidar_proc.odometry.registration.alignment import Alignment, unobserved_directions
from l2lidar_proc.odometry.registration.correspondences import Source
from l2lidar_proc.odometry.uncertainty import FrameJump
from l2lidar_proc.odometry.walls.wall_velocity import WallVelocity, level_axes
from l2lidar_proc.odometry.zero_velocity import (
    ZeroVelocityTest,
    free_pose,
    with_unnoticed_motion,
)

LIBRARIES: Final = (*kiss.LIBRARIES, eskf.LIBRARY, "scipy.spatial.transform")
"""Imported with the first sweeps, unless something has done so before."""


class Posterior(NamedTuple):
    """State after the measurements of a sweep.

    Attributes
    ----------
    state : InertialState
    covariance : ndarray, shape (18, 18)
    """

    state: InertialState
    covariance: F64


class Registration(NamedTuple):
    """Scan-to-map registration of a sweep.

    Attributes
    ----------
    predicted : SweepMotion
    source : Source
        Its points, deskewed by the prediction.
    alignment : Alignment or None
        None where the sweep does not fit, or tells nothing that can be believed.
    match_status : MatchStatus
        Of the first match, before the innovation gate.
    blur : ndarray, shape (18, 18), or None
        Covariance that the alignment does not show, as of :func:`blur_of`.
    guess : InertialState
        As of :meth:`SweepMatcher.extend`.
    """

    predicted: SweepMotion
    source: Source
    alignment: Alignment | None
    match_status: MatchStatus
    blur: F64 | None
    guess: InertialState


def _note_suspect(status: list[Status]) -> None:
    if Status.SUSPECT not in status:
        status.append(Status.SUSPECT)


class Odometry:
    """LiDAR-inertial odometry.

    The IMU carries the state from sweep to sweep and through each sweep; the deskewed sweep is
    aligned with a map of surfaces; the velocity and biases of the alignment deskew the sweep again
    before it extends the map. KISS-ICP thins the points, keeps a map of points, measures with its
    adaptive threshold how good predictions are, and registers sweeps whose prediction is loose.

    Parameters
    ----------
    config : OdometryConfig
    T_cloud_imu : ndarray, shape (4, 4)
        IMU coordinates to cloud coordinates.

    Attributes
    ----------
    config : OdometryConfig
    T_cloud_imu : ndarray, shape (4, 4)
    phase : Phase
    motion : SweepMotion or None
        Of the sweep that was registered last.
    matcher : SweepMatcher
        Holds the maps; their origin is that of the cloud frame where the first map began.
    """

    def __init__(self, config: OdometryConfig, T_cloud_imu: F64) -> None:
        self.T_cloud_imu = np.array(T_cloud_imu, dtype=np.float64)
        self._lever: F64 = self.T_cloud_imu[:3, 3]
        self._predictor = Predictor(config, self.T_cloud_imu)
        self.config = config
        self.reset()

    def configure(self, config: OdometryConfig) -> None:
        """Take new live settings; the others take effect with :meth:`reset`."""
        self.config = config
        self.matcher.config = self._predictor.config = config

    def reset(self) -> None:
        """Forget map and motion; the next sweep begins a new map."""
        self.phase = Phase.INITIALIZING
        self.motion: SweepMotion | None = None
        self._latest_posterior: Posterior | None = None  # None until a map has begun
        # posteriors of the present rest, oldest first
        self._at_rest: deque[Posterior] = deque()
        self._predictor.reset()
        self._late_gravity = LateGravity(self._predictor)
        self._zero_velocity = ZeroVelocityTest()
        self._innovations = InnovationTest()
        self._intrinsics = LidarIntrinsics()
        self.matcher = SweepMatcher(self.config, self._lever)
        self._initializer = self._map_initializer()
        self._first_rest = FirstRest(self._initializer, self._zero_velocity, self._intrinsics)
        self._start = StartVelocity(self._lever, self._intrinsics)
        self._carrier = carrier_priors.Carrier()
        self._unmatched_ns = 0  # of sweeps with enough points since the latest match
        self._was_blind = False  # a sweep since then had few
        self._gate = InnovationGate()
        self._walls = WallVelocity()
        self._jump = FrameJump()
        self._earlier = EarlierMaps()
        self._revisit = MapRevisit()
        self._last: OdometryEstimate | None = None

    def _use(self, matcher: SweepMatcher) -> None:
        """Go on with the maps of a matcher."""
        matcher.correct(self.matcher.drift.corrections)
        matcher.notes_sights = self.matcher.notes_sights
        self.matcher = matcher
        self._initializer = self._first_rest.initializer = self._map_initializer()

    def _map_initializer(self) -> MapInitializer:
        return MapInitializer(
            self._predictor, self.matcher, self._zero_velocity, self.config.min_points
        )

    def imu(self, samples: Samples) -> None:
        """Take IMU samples (N,), dtype IMU_SAMPLE, in any order and state."""
        self._predictor.imu(samples)

    def register(self, sweep: Sweep, *, may_skip: bool = False) -> list[OdometryEstimate]:
        """Return where the sensor was at the references of sweeps, oldest first.

        The first sweeps are held until they can be solved together (then their estimates come at
        once); from then on each sweep gives one estimate.

        Parameters
        ----------
        sweep : Sweep
            Any layout of points with x, y, z and time; IMU samples up to its end should have come.
        may_skip : bool
            There is no time to align it: where the IMU has no gap, it alone may carry the pose
            through it.
        """
        status: list[Status] = []
        if self._last is not None:
            order = sweep_order(self._predictor.reference(sweep) - self._last.stamp)
            if order is SweepOrder.LATE:
                return [self._last.refusing(sweep.points)]
            if order is SweepOrder.OTHER_TIME_LINE:
                self._begin_time_line(self._predictor.reference(sweep))
                status.append(Status.RESTARTED)
        sweep = cloud.cropped(sweep, self.config.min_range, self.config.max_range)
        self._reported = sweep  # as the unit reports it, for what is mapped again
        head = self._intrinsics.head(sweep)
        # The gyro's noise in the settings has room for the lines of an L2's spinning head. Without
        # such a head it is taken for less once a map has begun, but not at rest, where the samples
        # show it themselves.
        moves = self.phase in (Phase.TRACKING, Phase.LOST)
        tracks_without_head = moves and self._intrinsics.is_other
        self._predictor.may_have_head_lines = not tracks_without_head
        if head is not None:
            self._predictor.note_head(head, sweep.end)
        self.matcher.notes_sights = self.config.correct_beams and self._intrinsics.learns_from_map
        if self.config.correct_beams:
            sweep = self._intrinsics.corrected(sweep)
            self.matcher.correct(self._intrinsics.corrections)
        if self.phase is Phase.INITIALIZING:
            return self._initialize(sweep)
        if may_skip and not status:
            skipped = self._skip(sweep)
            if skipped is not None:
                return [skipped]
        if self.phase is Phase.STATIONARY:
            held = self._hold(sweep, status)
            if held is not None:
                return [held]
        return [self._track(sweep, status)]

    def extrapolated(self, stamp: HostNs) -> OdometryEstimate | None:
        """Return the IMU's continuation of the latest estimate.

        Parameters
        ----------
        stamp : HostNs
            After the latest reference; best not after the newest IMU sample.

        Returns
        -------
        OdometryEstimate or None
            None before the first estimate, at an instant not after the latest reference, and more
            than :data:`tuning.TIME_JUMP_NS` after it.
        """
        if self._last is None:
            return None
        state, covariance = self._posterior
        if not 0 < stamp - state.stamp <= tuning.TIME_JUMP_NS:
            return None
        motion = self._predictor.over(state, covariance, (state.stamp, stamp), stamp)
        nothing, noise = self._last.points[:0], self._predictor.gyro_noise
        last = self._last.quality
        quality = AlignmentQuality(
            variance_factor=last.variance_factor,
            velocity_factor=last.velocity_factor,
            unobserved=last.unobserved,
            attitude_variance=last.attitude_variance,
        )
        return estimate_of(
            motion,
            self._lever,
            nothing,
            (Status.PREDICTED,),
            quality,
            noise,
            self._predictor.gyro_line,
            self._jump,
            self.matcher.drift,
        )

    @property
    def _posterior(self) -> Posterior:
        """What the next prediction begins from, once a map has begun."""
        assert self._latest_posterior is not None
        return self._latest_posterior

    @property
    def newest_imu(self) -> HostNs | None:
        """Stamp of the newest IMU sample, None before the first."""
        return self._predictor.newest_imu

    def map_points(self) -> F64:
        """Return the points of KISS-ICP's local map [m], shape (N, 3), map frame."""
        return self.matcher.kiss.points()

    # ---- initializing

    def _initialize(self, sweep: Sweep) -> list[OdometryEstimate]:
        """Hold the first sweeps until the map can begin; then return the estimates of all."""
        begun = self._initializer.add(sweep)
        if begun is None:
            return []
        held = self._initializer.held
        self._enter_map(begun)
        estimates = []
        for one in held:
            within = sum(part.end < one.end for part in begun.sweeps)
            motion = begun.motions[within].anchored_at(self._predictor.reference(one))
            status = [Status.STARTING, *gaps_in(motion)]
            quality = self.matcher.quality(len(one.points), None)
            estimates.append(self._estimate(one, motion, status, quality))
        held.clear()
        return estimates

    def _enter_map(self, begun: InitializedMap) -> None:
        """Go on from a map that has just begun."""
        self._at_rest.clear()
        self._keep(begun.motions[-1])
        self._forget_unmatched()
        at_rest = self._zero_velocity.anchor is not None
        self.phase = Phase.STATIONARY if at_rest else Phase.TRACKING
        self._first_rest.begin(begun.sweeps[begun.seed :] if at_rest else [])
        moving = self._initializer.moving
        self._start.clear()
        if moving is not None and not at_rest:
            seed = begun.seed
            self._start.begin(
                begun.sweeps[seed:], begun.motions[seed:], begun.since, moving.open_axes
            )

    # ---- tracking

    def _track(self, sweep: Sweep, status: list[Status]) -> OdometryEstimate:
        """Align a sweep, correct the state, relocalize, report the sweep, and map it."""
        registration = self._align(sweep, status)
        corrected = self._correct(sweep, registration, status)
        registration, located = self._relocalize(sweep, registration, corrected, status)
        alignment = registration.alignment
        motion, is_mapped = self._with_start_velocity(sweep, located, alignment, status)
        if alignment is not None:
            motion = self._late_gravity.estimated(motion)
        self._keep(motion)
        estimate = self._tracking_estimate(sweep, registration, motion, status)
        self._learn_intrinsics(sweep, registration, motion, estimate)
        if alignment is not None:
            is_mapped |= self._map_ended_rest(motion)
        if not is_mapped:
            self._extend_map(registration, motion, estimate)
        return estimate

    def _align(self, sweep: Sweep, status: list[Status]) -> Registration:
        """Predict the motion of a sweep, and align the sweep with the map if it fits."""
        before = self._posterior
        predicted = self._predictor.over_sweep(sweep, *before)
        source = self.matcher.source(sweep, predicted)
        first, match_status = self.matcher.match(source, predicted)
        blur = blur_of(predicted, before.covariance)
        if blur is not None:
            self._innovations.clear()
        gated = self._gated(sweep, Prediction(predicted, source), first, blurred=blur is not None)
        if gated.is_suspect:
            _note_suspect(status)
        status += gaps_in(gated.predicted)
        alignment = gated.alignment
        if alignment is not None:
            alignment = self._with_wall_velocity(sweep, gated.predicted, alignment)
        return Registration(
            gated.predicted, gated.source, alignment, match_status, blur, gated.predicted.state
        )

    def _correct(
        self, sweep: Sweep, registration: Registration, status: list[Status]
    ) -> SweepMotion:
        """Return the motion of a sweep, corrected by its registration and the carrier's priors."""
        predicted, alignment = registration.predicted, registration.alignment
        if alignment is None:
            self._note_unmatched(sweep, len(registration.source.points), status)
            posterior = Posterior(predicted.state, predicted.covariance)
        else:
            self._note_aligned(sweep, predicted, alignment)
            seconds = (predicted.state.stamp - self._posterior.state.stamp) * 1e-9
            self.matcher.meet(alignment, seconds)
            covariance = alignment.covariance
            if registration.blur is not None:
                covariance = covariance + registration.blur
            posterior = Posterior(alignment.state, covariance)
        motion = self._constrained(predicted, posterior, status)
        self._walls.correct(posterior.state, motion.state)
        return motion

    def _relocalize(
        self,
        sweep: Sweep,
        registration: Registration,
        motion: SweepMotion,
        status: list[Status],
    ) -> tuple[Registration, SweepMotion]:
        """Begin a new map if the odometry is lost; go on in an earlier one that the sweep meets.

        Return registration and motion in the map that is then in use.
        """
        # after a blind stretch, a view that the map does not hold will not match later either, and
        # the prediction drifts; without such a stretch something may be in the way
        is_elsewhere = registration.match_status is MatchStatus.UNMAPPED and self._was_blind
        if self._unmatched_ns >= (tuning.UNMAPPED_NS if is_elsewhere else tuning.LOST_NS):
            status.append(Status.LOST)
            motion = self._begin_new_map(motion)
        found = self._relocalization(sweep, motion)
        if found is None:
            if self._revisit.is_contradicted:
                _note_suspect(status)
            return registration, motion
        status.append(Status.RETURNED)
        return (
            registration._replace(alignment=found.alignment, guess=motion.state),
            self._return_to_map(found, motion),
        )

    def _tracking_estimate(
        self, sweep: Sweep, registration: Registration, motion: SweepMotion, status: list[Status]
    ) -> OdometryEstimate:
        """Report a sweep with its motion and the quality of its registration."""
        alignment = registration.alignment
        quality = self.matcher.quality(len(registration.source.points), alignment)
        quality = self._consistency(quality, alignment, motion.state.stamp)
        if alignment is not None and not motion.imu.missing.all():
            variance = self._predictor.attitude_variance(sweep)
            quality = dataclasses.replace(quality, attitude_variance=variance)
        return self._estimate(sweep, motion, status, quality)

    def _learn_intrinsics(
        self,
        sweep: Sweep,
        registration: Registration,
        motion: SweepMotion,
        estimate: OdometryEstimate,
    ) -> None:
        """Learn beam angles and range bias from a sweep, if it was aligned."""
        source, alignment = registration.source, registration.alignment
        if alignment is None:
            return
        rest_force = motion.state.rest_force
        self._intrinsics.learn(sweep, estimate.points, at_rest=False, rest_force=rest_force)
        if self.matcher.notes_sights:
            seen = self.matcher.seen_again(source, alignment.state)
            self._intrinsics.learn_from_map(seen)

    def _extend_map(
        self, registration: Registration, motion: SweepMotion, estimate: OdometryEstimate
    ) -> None:
        """Add a sweep to the map if it was aligned or the map begins with it."""
        is_new = registration.match_status is MatchStatus.NEW_MAP or Status.LOST in estimate.status
        if registration.alignment is None and not is_new:
            return
        expected_share = self._innovations.expected_share
        fresh = self.matcher.extend(estimate.points, motion, registration.guess, expected_share)
        self._anchor_anew(fresh)

    def _gated(
        self, sweep: Sweep, given: Prediction, found: Alignment | None, *, blurred: bool
    ) -> GatedAlignment:
        """Return what passes the innovation gate of a prediction and its alignment.

        The other predictions hold the velocity instead of using the accelerometer, and the rate as
        well instead of using the gyro. A narrow view fits its map at other turns too, so there the
        gyro is used in any case.
        """
        before = self._posterior

        def held(use: ImuUse) -> Prediction:
            motion = self._predictor.over_sweep(sweep, *before, use=use)
            return Prediction(motion, self.matcher.source(sweep, motion))

        others = []
        if given.motion.use_forces:
            others.append(functools.partial(held, ImuUse.GYRO))
        if not (given.motion.imu.missing.all() or is_narrow(given.source.points)):
            others.append(functools.partial(held, ImuUse.NOTHING))
        return self._gate.passed(self.matcher, given, found, others, blurred=blurred)

    def _map_ended_rest(self, motion: SweepMotion) -> bool:
        """Go on in a map of the rest that has just ended, if the unit is known better by now.

        Return whether that is so; the map has the latest sweep then.
        """
        remapped = self._first_rest.mapped_again(self._reported, motion)
        if remapped is None:
            return False
        self._use(remapped.matcher)
        self._walls.clear()
        self._innovations.clear()
        self._keep(remapped.motion)
        self._anchor_anew(remapped.fresh)
        return True

    def _with_start_velocity(
        self, sweep: Sweep, motion: SweepMotion, found: Alignment | None, status: list[Status]
    ) -> tuple[SweepMotion, bool]:
        """Return the motion with the velocity that the sweeps since a start in motion show.

        After it comes whether the map has begun again with that velocity, and has the sweep.
        """
        start = self._start
        if not len(start):
            return motion, False
        start.note(self._reported, motion)
        if found is None or not start.is_due(sweep.end):
            return motion, False
        state, covariance, span = motion.state, motion.covariance, (start.since, sweep.end)
        whole = self._predictor.over(state, covariance, span, state.stamp)
        vertical = None
        if self._predictor.trusts_gravity:
            vertical = self._initializer.vertical(-state.gravity / np.linalg.norm(state.gravity))
        information = found.information[eskf.POSITION, eskf.POSITION]
        better = start.search(whole, information, vertical)
        motions: list[SweepMotion] = []
        if better is not None:
            self._walls.correct(state, better.state)
            motion = motion.with_state(better.state, better.covariance)
            whole = whole.with_state(better.state, better.covariance)
        if start.may_begin_again and better is not None and better.is_open:
            motions = self._initializer.begin_with(
                start.sweeps(), start.since, start.beginning(whole)
            )
        elif start.may_begin_again and not start.is_open:
            fitted = start.fitted(whole)
            if fitted is not None:
                motions = self._initializer.begin_as_fitted(
                    start.sweeps(), start.since, fitted, motion.covariance
                )
        if motions:
            self._carrier.note_found(motions[-1].state, motions[-1].covariance)
            start.replace(motions)
            motion = motions[-1]
            self._walls.clear()
            self._innovations.clear()
            status.append(Status.STARTING)
        start.end_search(sweep.end)
        return motion, bool(motions)

    def _with_wall_velocity(
        self, sweep: Sweep, predicted: SweepMotion, found: Alignment
    ) -> Alignment:
        """Return an alignment with what walls tell of the velocity that surfaces leave free."""
        self._walls.correct(predicted.state, found.state)
        is_open = self._start.is_open
        if self._start.is_awaited:
            return found
        direction = self.matcher.driving_direction(found, is_open=is_open)
        if direction is None:
            return found
        axes = level_axes(direction, found.state.gravity)
        motion = predicted.with_state(found.state, found.covariance)
        spots, lines = self.matcher.beside_walls(sweep, motion, axes)
        if is_open:
            lines = lines[:0]  # nothing tells false votes from right ones
        state, covariance = self._walls.update(found.state, found.covariance, spots, lines, axes)
        return dataclasses.replace(found, state=state, covariance=covariance)

    def _constrained(
        self, predicted: SweepMotion, posterior: Posterior, status: list[Status]
    ) -> SweepMotion:
        """Return the motion with the state after a sweep, held to what physics allows."""
        before = self._posterior.state
        lasted = (predicted.state.stamp - before.stamp) * 1e-9
        self._carrier.note_speed(*posterior, lasted)
        # between bare walls, rims of the view hold a wrong velocity as if it were moved by hand
        between_walls = self.matcher.begins_between_walls
        self.matcher.driving = self._carrier.drives or (
            between_walls and self._carrier.may_drive(*posterior)
        )
        likely = self._with_priors(before.position, posterior, lasted)
        bounded = Posterior(*carrier_priors.bound_speed(*likely, self.config.max_speed))
        is_suspect = bounded.state is not likely.state or self._is_suspect(predicted)
        if is_suspect:
            _note_suspect(status)
        drift, gravity, velocity = self.matcher.drift, eskf.GRAVITY, eskf.VELOCITY
        self._start.note_velocity(posterior.covariance[velocity, velocity])
        drift.lean(likely.state.gravity, likely.covariance[gravity, gravity])
        drift.correct_velocity(
            predicted.covariance[velocity, velocity], bounded.covariance[velocity, velocity]
        )
        return predicted.with_state(*bounded)

    def _with_priors(self, place: F64, posterior: Posterior, seconds: float) -> Posterior:
        """Return a posterior, [s] after that at a place (3,), with the priors of carriers."""
        state, covariance = self._carrier.with_priors(
            *posterior,
            seconds,
            # the prior of an open start has said already how fast carriers are
            least_speed=tuning.CARRIER_SPEED_SIGMA if self._start.is_open else 0.0,
            height_observed=self.matcher.observes_height,
        )
        lean = float(np.linalg.norm(state.position - place)) * tuning.MAP_BEND**2
        return Posterior(state, eskf.with_leaning_gravity(state, covariance, lean))

    def _skip(self, sweep: Sweep) -> OdometryEstimate | None:
        """Carry the pose through a sweep by the IMU alone, if it can; the map stays as it is."""
        state, covariance = self._posterior
        predicted = self._predictor.over_sweep(sweep, state, covariance)
        if gaps_in(predicted):
            return None
        status = [Status.PREDICTED, Status.SKIPPED]
        if self._test_rest(sweep):
            rested = self._predictor.static_update(state, covariance, predicted.state.stamp)
            motion = predicted.at_rest(*rested)
            self._keep_at_rest(motion)
        else:
            posterior = Posterior(predicted.state, predicted.covariance)
            motion = self._constrained(predicted, posterior, status)
            self._walls.correct(predicted.state, motion.state)
            self._keep(motion)
        quality = self.matcher.quality(len(sweep.points), None)
        quality = self._consistency(quality, None, motion.state.stamp)
        return self._estimate(sweep, motion, status, quality)

    def _is_suspect(self, motion: SweepMotion) -> bool:
        """Return whether the latest sweeps contradict the IMU, or the biases any sensor's."""
        if self._innovations.contradicts:
            return True
        # without a gyro its bias stands for the change of the rate
        return not (motion.imu.missing.all() or carrier_priors.biases_are_plausible(motion.state))

    def _consistency(
        self, quality: AlignmentQuality, aligned: Alignment | None, stamp: HostNs
    ) -> AlignmentQuality:
        """Return the quality of the alignment at an instant with what the innovations say."""
        found = self._innovations
        if not quality.observes_all:
            directions = np.eye(3)
            if aligned is not None and aligned.matched:
                directions = unobserved_directions(
                    aligned.information[eskf.POSITION, eskf.POSITION]
                )
            found.note_unobserved(stamp, directions)
            self._revisit.note_unobserved(stamp)
        return dataclasses.replace(
            quality,
            nis_per_dof=found.nis_per_dof,
            velocity_nis_per_dof=found.velocity_nis_per_dof,
            variance_factor=found.variance_factor,
            velocity_factor=found.velocity_factor,
            unobserved=tuple((x, y, z) for x, y, z in found.unobserved.T.tolist()),
        )

    def _anchor_anew(self, fresh: float) -> None:
        """Measure places from now on relative to what has just become map, by its share.

        There the place is known by definition: how uncertain it is in the older map is what the
        new part of the map is uncertain by. Else the next alignment, which compares with what was
        put there at the same wrong place, would confirm velocity and biases that led to it.
        """
        state, covariance = self._posterior
        scale = np.ones(eskf.ERRORS)
        scale[eskf.POSITION] = np.sqrt(1.0 - min(fresh, tuning.DRIFT_MOST_FRESH))
        self._latest_posterior = Posterior(state, covariance * np.outer(scale, scale))

    def _note_unmatched(self, sweep: Sweep, points: int, status: list[Status]) -> None:
        """Count a sweep that was not aligned: a few seconds of them, and the odometry is lost."""
        few = points < self.config.min_points
        status += [Status.PREDICTED, Status.SPARSE if few else Status.UNMATCHED]
        self._unmatched_ns += 0 if few else sweep.end - sweep.start
        self._was_blind |= points < tuning.UNMAPPED_POINTS
        self._zero_velocity.clear()

    def _discard_map(self) -> None:
        """Forget the map, which is of no use; the sweep to be tracked begins another, as LOST."""
        self.matcher.clear()
        self._unmatched_ns = tuning.LOST_NS

    def _forget_unmatched(self) -> None:
        """Begin to count anew: the pose is known relative to the map in use."""
        self._unmatched_ns, self._was_blind = 0, False

    def _forget_sweeps(self) -> None:
        """Forget what the latest sweeps have shown together: the next are not tied to them."""
        self._first_rest.end()
        self._walls.clear()
        self._start.clear()
        self._late_gravity.clear()
        self._innovations.clear()

    def _note_aligned(self, sweep: Sweep, predicted: SweepMotion, found: Alignment) -> None:
        """Test the innovation of an aligned sweep, and whether the sensor is at rest with it.

        The sensor is tracked again if it was lost.
        """
        state, covariance = found.state, found.covariance
        self._innovations.take(predicted.state, predicted.covariance, state, covariance)
        self._forget_unmatched()
        samples = self._predictor.samples(sweep.end - tuning.STILL_TEST_NS, sweep.end)
        rests = self._zero_velocity.detect_rest(state, covariance, samples)
        self.phase = Phase.STATIONARY if rests else Phase.TRACKING
        if rests:
            self._innovations.clear()
            self._walls.clear()
            self._start.clear()

    def _begin_new_map(self, motion: SweepMotion) -> SweepMotion:
        """Begin a new map at the predicted pose; keep the one before, it may be seen again."""
        before = self._jump
        self._jump = before.added(
            motion.state, motion.covariance, self.matcher.drift.at(motion.state.position)
        )
        if self.matcher.is_young:
            self.matcher.clear()
        else:
            self._earlier.keep(self.matcher, before, motion.state.stamp)
            self._use(self.matcher.for_another_map())
        self._forget_sweeps()
        self._forget_unmatched()
        self.phase = Phase.LOST
        return dataclasses.replace(motion, covariance=eskf.at_map_origin(motion.covariance))

    # ---- relocalization

    def _relocalization(self, sweep: Sweep, motion: SweepMotion) -> Relocalization | None:
        """Search the earlier maps and the older part of this one, where it is time to."""
        source = functools.cache(lambda: self.matcher.source(sweep, motion))
        if self._earlier.is_due(motion.state.stamp):
            found = self._earlier.search(source(), motion, self._jump)
            if found is not None:
                return found
        part = self._revisit.part_due(self.matcher, motion.state, source)
        return None if part is None else self._revisit.search(source(), part, motion, self._jump)

    def _return_to_map(self, found: Relocalization, motion: SweepMotion) -> SweepMotion:
        """Go on in an earlier map; return the motion of the sweep that met it."""
        self._use(found.map.matcher)
        self._jump = found.map.jump
        self.matcher.config = self.config
        self.matcher.meet(found.alignment, 0.0)
        self._zero_velocity.clear()
        self._forget_sweeps()
        self._forget_unmatched()
        self._leave_rest()
        return motion.with_state(found.alignment.state, found.alignment.covariance)

    # ---- stationary

    def _hold(self, sweep: Sweep, status: list[Status]) -> OdometryEstimate | None:
        """Hold the pose; return None if IMU or sweep show motion, then the sweep is tracked."""
        first = self._first_rest
        sweeps = first.sweeps
        if not self._test_rest(sweep):
            begun = first.begun_in_motion(sweeps, *self._posterior)
            if begun is not None:
                self._enter_map(begun)
                status.append(Status.STARTING)
            return None
        state, covariance = self._posterior
        predicted = self._predictor.over_sweep(sweep, state, covariance)
        trial = predicted.at_rest(state, free_pose())
        source = self.matcher.source(sweep, trial)
        alignment, match_status = self.matcher.match(source, trial)
        gaps = gaps_in(predicted)
        status = [*status, *gaps]
        if alignment is None and (gaps or match_status is not MatchStatus.NEW_MAP):
            self._zero_velocity.clear()
            self._first_rest.end()
            self._leave_rest()
            return None
        rested = self._predictor.static_update(state, covariance, trial.state.stamp)
        still = predicted.at_rest(*rested)
        remapping = Remapping.NONE
        if alignment is None:
            # the IMU proves the rest, and so young a map contradicts nothing
            status += [Status.PREDICTED, Status.UNMATCHED]
        else:
            at_rest = self._zero_velocity.test_registration(alignment)
            if self.config.correct_beams:
                remapping = first.map_with_known_beams(still, doubted=not at_rest)
                if remapping is not Remapping.NONE:
                    at_rest = remapping is Remapping.CONFIRMED
                elif not at_rest:
                    at_rest = first.resume_if_beams_explain(still, source)
            if not at_rest:
                return self._retry_in_motion(sweep, status)
        first.end_doubt()
        relocalization = self._relocalization(sweep, still)
        if relocalization is not None:
            still = self._return_to_map(relocalization, still)
            status.append(Status.RETURNED)
            self._keep(still)
        else:
            still = self._late_gravity.estimated(still)
            self._keep_at_rest(still)
        quality = self.matcher.quality(len(source.points), alignment)
        estimate = self._estimate(sweep, still, status, quality)
        if remapping is Remapping.NONE:  # else the beams have learned from all sweeps of this rest
            self._intrinsics.learn(sweep, estimate.points, at_rest=True)
            self.matcher.extend(estimate.points, still, still.state)
        return estimate

    def _test_rest(self, sweep: Sweep) -> bool:
        """Test a rest by the IMU over a sweep, end it if that shows motion.

        Return whether the sensor is at rest. If the rest ends, the state to go on from is the one
        before the motion can have begun.
        """
        if self.phase is not Phase.STATIONARY:
            return False
        samples = self._predictor.samples(sweep.end - tuning.STILL_IMU_NS, sweep.end)
        if not self._zero_velocity.test_imu(samples):
            if self._at_rest:
                # the onset of the motion is in samples that passed for rest
                self._latest_posterior = self._at_rest[0]
            self._first_rest.end_with(*self._posterior)
            self._leave_rest()
            return False
        self._first_rest.note(self._reported)
        return True

    def _leave_rest(self) -> None:
        self._at_rest.clear()
        self.phase = Phase.TRACKING

    def _retry_in_motion(self, sweep: Sweep, status: list[Status]) -> OdometryEstimate | None:
        """Begin the map again, as in motion, if the sensor was taken for still since its start."""
        state, covariance = self._posterior
        self._latest_posterior = Posterior(state, self._zero_velocity.widened(covariance))
        sweeps = self._first_rest.sweeps
        self._first_rest.end_with(state, covariance, moving=1)
        test = self._zero_velocity
        if sweeps and test.drifted and not test.ended_suddenly:
            begun = self._first_rest.retried(sweeps)
            if begun is not None:
                self._enter_map(begun)
                self._first_rest.end()
                quality = self.matcher.quality(len(sweep.points), None)
                return self._estimate(
                    sweep, begun.motions[-1], [*status, Status.STARTING], quality
                )
            self._discard_map()
            self._first_rest.end()
        self._leave_rest()
        return None

    # ---- steps

    def _keep(self, motion: SweepMotion) -> None:
        """Remember a motion for the next prediction."""
        posterior, before = Posterior(motion.state, motion.covariance), self._latest_posterior
        if motion.imu.missing.all() and before is not None:
            posterior = Posterior(*eskf.with_gyro_bias_of(*posterior, *before))
        self._predictor.steady_rate = motion.rate
        self._latest_posterior = posterior
        self.motion = motion

    def _keep_at_rest(self, motion: SweepMotion) -> None:
        """Remember a motion at rest, and those before it that motion cannot have begun in."""
        self._keep(motion)
        recent = self._at_rest
        recent.append(Posterior(motion.state, motion.covariance))
        onset = motion.state.stamp - tuning.STILL_ONSET_NS
        while len(recent) > 1 and recent[1].state.stamp <= onset:
            recent.popleft()

    def _begin_time_line(self, reference: HostNs) -> None:
        """Keep pose and map after a jump of time; the motion is unknown."""
        before = self._posterior
        self._jump = self._jump.unseen(before.state)
        self._latest_posterior = Posterior(*eskf.after_time_jump(*before, HostNs(reference - 1)))
        self._zero_velocity.clear()
        self._forget_sweeps()
        self._gate.restart(reference)
        self._earlier.restart(reference)
        self._revisit.restart(reference)
        if self.phase is Phase.STATIONARY:
            self._leave_rest()

    def _estimate(
        self,
        sweep: Sweep,
        motion: SweepMotion,
        status: list[Status],
        quality: AlignmentQuality,
    ) -> OdometryEstimate:
        """Deskew a sweep with its motion and report it."""
        if not self._predictor.trusts_gravity:
            status.append(Status.GRAVITY_UNTRUSTED)
        if self.phase is Phase.STATIONARY:
            covariance = with_unnoticed_motion(motion.covariance)
            motion = dataclasses.replace(motion, covariance=covariance)
        drift, (angles, ranges) = self.matcher.drift, self._intrinsics.corrections
        xi, beta, alpha = angles.tolist()
        drift.errors = self._intrinsics.errors
        drift.errors_began = self._intrinsics.errors_with(drift.began)
        self._last = estimate_of(
            motion,
            self._lever,
            self.matcher.deskewed(sweep, motion),
            tuple(status),
            dataclasses.replace(
                quality, beam_correction=(xi, beta, alpha), range_correction=ranges
            ),
            self._predictor.gyro_noise,
            self._predictor.gyro_line,
            self._jump,
            drift,
        )
        return self._last
