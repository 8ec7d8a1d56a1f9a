"""Initialization of the map: the first sweeps are held and solved together.

Half a turn of the head does not meet what the other half saw, and a map whose first sweep was
taken for still is smeared if the sensor moved. So the first sweeps are tried as those of a sensor
at rest, where the IMU allows it, and otherwise in rounds: the velocity that the later sweeps show
deskews the first one better.

In motion the accelerometer does not show the vertical. What is built does, so the map begins again
with that. Where the sweeps leave the velocity open, it is left open:
:mod:`~l2lidar_proc.odometry.initialization.start_velocity` finds it out within seconds.
"""

from __future__ import annotations

import dataclasses
from enum import Enum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records
from l2lidar_node.types import F64, STANDARD_GRAVITY, HostNs, Sweep
from l2lidar_proc import cloud, tuning
from l2lidar_proc.motion.filter import ERRORS, POSITION, VELOCITY, InertialState
from l2lidar_proc.motion.static import InitialState, initial_state
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.initialization.start_velocity import Beginning, FittedStart
from l2lidar_proc.odometry.initialization.trial import Trial
from l2lidar_proc.odometry.initialization.vertical_direction import Vertical, vertical_direction
from l2lidar_proc.odometry.interface import SweepOrder, sweep_order
from l2lidar_proc.odometry.local_map.surfels import YoungSurfaces
from l2lidar_proc.odometry.matcher import MatchStatus, SweepMatcher
from l2lidar_proc.odometry.prediction import Predictor
from l2lidar_proc.odometry.walls.wall_profile import are_walls
from l2lidar_proc.odometry.walls.wall_velocity import level_axes
from l2lidar_proc.odometry.zero_velocity import ZeroVelocityTest, free_pose

UP: Final = np.array([0.0, 0.0, 1.0])
"""Of a map whose first attitude is that of the accelerometer."""


class NotBegun(Enum):
    """Why sweeps have not begun a map; the value is a description."""

    TOO_EARLY = "more sweeps are needed to tell"
    FEW_POINTS = "none has enough points"
    NO_FIT = "they do not fit together, neither at rest nor in motion"


class MovingStart(NamedTuple):
    """A start in motion.

    Attributes
    ----------
    initial : InitialState
    open_axes : ndarray, shape (K, 3)
        Directions along which the first sweeps do not tell the velocity, map axes.
    """

    initial: InitialState
    open_axes: F64


class InitializedMap(NamedTuple):
    """A map that has begun.

    Attributes
    ----------
    motions : list of SweepMotion
        One for each of :attr:`sweeps`.
    sweeps : list of Sweep
        Those held, short ones joined.
    seed : int
        The first of them in the map; those before it were not whole.
    since : HostNs
        The first motion reaches back to it.
    """

    motions: list[SweepMotion]
    sweeps: list[Sweep]
    seed: int
    since: HostNs


class MapInitializer:
    """Collects the first sweeps and begins the map with them.

    Parameters
    ----------
    predictor : Predictor
    matcher : SweepMatcher
        Its maps are filled.
    zero_velocity : ZeroVelocityTest
        Anchored where the sensor turns out to be at rest.
    min_points : int
        A fullest sweep with fewer points cannot begin a map.

    Attributes
    ----------
    matcher : SweepMatcher
    held : list of Sweep
        Sweeps without an estimate so far, oldest first.
    moving : MovingStart or None
        What the map began with, where the sensor was in motion; None where it was at rest, and
        where gravity is not trusted.
    """

    def __init__(
        self,
        predictor: Predictor,
        matcher: SweepMatcher,
        zero_velocity: ZeroVelocityTest,
        min_points: int,
    ) -> None:
        self._predictor = predictor
        self.matcher = matcher
        self._zero_velocity = zero_velocity
        self._min_points = min_points
        self.held: list[Sweep] = []
        self.moving: MovingStart | None = None
        self._young = YoungSurfaces.TRUSTED  # of the map that begins in motion
        self._lead_s = 0.0  # from the first pose of all to that of the first sweep in the map
        self._lead_velocity: F64 = np.zeros(3)  # with which that pose was estimated [m/s]

    def for_another_map(self) -> MapInitializer:
        """Return one that fills other maps, and leaves this one's test of rest as it is."""
        matcher = self.matcher.for_another_map()
        return MapInitializer(self._predictor, matcher, ZeroVelocityTest(), self._min_points)

    def add(self, sweep: Sweep) -> InitializedMap | None:
        """Hold a sweep; return the map if it can begin now."""
        held = self.held
        step = sweep.start - held[-1].start if held else 1
        if sweep_order(step) is SweepOrder.LATE:
            return None
        if abs(step) >= tuning.LONG_GAP_NS:
            held.clear()
        held.append(sweep)
        if held[-1].end - held[0].start < tuning.INITIAL_NS:
            return None
        whole = cloud.joined(held, tuning.INITIAL_SWEEP_NS)
        if len(whole) < 2 or whole[-1].end < sweep.end:
            return None
        # the very first sweep is seldom whole
        most = max(len(one.points) for one in whole)
        seed = next(
            k for k, one in enumerate(whole) if len(one.points) >= tuning.INITIAL_WHOLE * most
        )
        if seed == len(whole) - 1 and most:
            return None
        enough = most > self._min_points
        lead = self._predictor.reference(whole[seed]) - self._predictor.reference(held[0])
        self._lead_s = 1e-9 * lead
        motions = self.begin(whole[seed:], held[0].start) if enough else NotBegun.FEW_POINTS
        if motions is NotBegun.TOO_EARLY:
            return None
        if isinstance(motions, NotBegun):
            del held[0]
            while len(held) > 1 and held[-1].end - held[0].start >= tuning.INITIAL_MAX_NS:
                del held[0]
            return None
        self._lead_velocity = motions[0].state.velocity
        return InitializedMap([motions[0]] * seed + motions, whole, seed, held[0].start)

    def begin(
        self, sweeps: list[Sweep], since: HostNs, may_rest: bool = True
    ) -> list[SweepMotion] | NotBegun:
        """Begin the map with sweeps.

        Parameters
        ----------
        sweeps : list of Sweep
        since : HostNs
            The first motion reaches back to it.
        may_rest : bool
            False where the sensor is known to move, however quiet the IMU is.

        Returns
        -------
        list of SweepMotion or NotBegun
            One for each sweep. It is too early to tell where little comes back, for instance, and
            it takes many sweeps at rest before one meets another.
        """
        late = sweeps[-1].end - since >= tuning.INITIAL_MAX_NS
        initial = self._begin_anew(sweeps, since, may_rest)
        start = self._at_cloud_origin(initial)
        self._zero_velocity.clear()
        is_static = initial.at_rest and self._zero_velocity.try_anchor(
            start, self._samples(sweeps, since)
        )
        rest = Trial([], met=False)
        if is_static:
            rest = self._at_rest(sweeps, since, start, initial.covariance)
            if rest.motions and not rest.missed:
                return rest.motions if rest.met or late else NotBegun.TOO_EARLY
            if rest.missed and not rest.met and len(sweeps) < tuning.INITIAL_MISSED[0]:
                return NotBegun.TOO_EARLY
            self._zero_velocity.clear()
        trial = self._unproven(sweeps, since, initial, is_static=is_static)
        if rest.motions and not trial.disproves(rest):
            if not rest.met:
                is_early = len(sweeps) < tuning.INITIAL_MISSED[1]
                return NotBegun.TOO_EARLY if is_early else NotBegun.NO_FIT
            self._begin_anew(sweeps, since, may_rest)
            self._zero_velocity.try_anchor(start, self._samples(sweeps, since))
            rest = self._at_rest(sweeps, since, start, initial.covariance)
            return rest.motions or NotBegun.NO_FIT
        if not trial.motions:
            return NotBegun.NO_FIT
        return trial.motions if trial.met or late else NotBegun.TOO_EARLY

    def _unproven(
        self, sweeps: list[Sweep], since: HostNs, initial: InitialState, *, is_static: bool
    ) -> Trial:
        """Begin the map in motion, or from a rest that IMU and sweeps do not both prove.

        A quiet IMU may also be that of a carrier that glides, or that speeds up evenly.
        """
        trial = self._in_motion(sweeps, since, initial)
        if not initial.at_rest:
            return trial
        leaves_open = not is_static and trial.leaves_open(tuning.START_FIXED)
        moves = leaves_open or self._is_tilted(initial)
        if not (moves or trial.is_doubtful or (trial.met and not is_static)):
            return trial
        moving = self._in_motion(sweeps, since, self._initial(sweeps, since, may_rest=False))
        margin = 0.0 if trial.is_doubtful else tuning.INITIAL_CLOSER
        if (moves and moving.motions) or moving.fits_closer(trial, margin):
            return moving
        # the maps are those of the latest one
        return self._in_motion(sweeps, since, self._begin_anew(sweeps, since, may_rest=True))

    def begin_again_at_rest(
        self, sweeps: list[Sweep], state: InertialState, covariance: F64
    ) -> bool:
        """Begin the map of a rest again; return whether the sweeps agree that it is one.

        Parameters
        ----------
        sweeps : list of Sweep
            Those of the rest so far, as they are known now.
        state : InertialState
            At rest, at any stamp.
        covariance : ndarray, shape (18, 18)
        """
        start = dataclasses.replace(state, stamp=self._predictor.reference(sweeps[0]))
        self._zero_velocity.resume(start)
        rest = self._at_rest(sweeps, sweeps[0].start, start, covariance)
        agree = bool(rest.motions) and (rest.met or not rest.missed)
        if not agree and not self._zero_velocity.drifted:
            self._zero_velocity.clear()  # a sweep met nothing of those before it
        return agree

    def map_rest(self, sweeps: list[Sweep], state: InertialState, covariance: F64) -> None:
        """Begin the map again with a rest that is over, and was one beyond doubt.

        Parameters
        ----------
        sweeps, state, covariance
            As for :meth:`begin_again_at_rest`.
        """
        start = dataclasses.replace(state, stamp=self._predictor.reference(sweeps[0]))
        self._at_rest(sweeps, sweeps[0].start, start, covariance, is_known=True)

    def begin_again_in_motion(
        self, sweeps: list[Sweep], state: InertialState, covariance: F64
    ) -> list[SweepMotion]:
        """Begin the map of a short rest again as in motion, if its sweeps fit closer then.

        A carrier whose motors shake the IMU may have glided.

        Parameters
        ----------
        sweeps : list of Sweep
            All those of the rest.
        state : InertialState
            At rest, at any stamp.
        covariance : ndarray, shape (18, 18)

        Returns
        -------
        list of SweepMotion
            One for each sweep; empty if it was a rest, whose map is as before then.
        """
        since = sweeps[0].start
        start = dataclasses.replace(state, stamp=self._predictor.reference(sweeps[0]))
        self._zero_velocity.resume(start)
        rest = self._at_rest(sweeps, since, start, covariance)
        moving = self._in_motion(sweeps, since, self._initial(sweeps, since, may_rest=False))
        if rest.motions and moving.fits_closer(rest, tuning.INITIAL_CLOSER):
            speed = float(np.linalg.norm(moving.motions[0].state.velocity))
            if speed > tuning.INITIAL_REST_SPEED:
                self._zero_velocity.clear()
                return moving.motions
        self._begin_anew(sweeps, since, may_rest=True)
        self._at_rest(sweeps, since, start, covariance, is_known=True)
        self._zero_velocity.clear()
        return []

    def _samples(self, sweeps: list[Sweep], since: HostNs) -> NDArray[np.void]:
        """Return the samples that show the first attitude, none of them from before a long gap."""
        first = since - tuning.INITIAL_NS
        last = min(sweeps[-1].end, since + tuning.INITIAL_IMU_NS)
        found = self._predictor.samples(first, last)
        stamps = found["stamp"]
        apart = np.maximum(first - stamps, stamps - last)
        return records.selected(found, np.flatnonzero(apart < tuning.LONG_GAP_NS))

    def _begin_anew(self, sweeps: list[Sweep], since: HostNs, may_rest: bool) -> InitialState:
        """Forget what an attempt has found out of a motion; return the first state again."""
        self.moving = None
        self._young = YoungSurfaces.TRUSTED
        return self._initial(sweeps, since, may_rest)

    def _initial(self, sweeps: list[Sweep], since: HostNs, may_rest: bool) -> InitialState:
        reference = self._predictor.reference(sweeps[0])
        initial = initial_state(self._samples(sweeps, since), reference, may_rest)
        self._predictor.trusts_gravity = initial.gravity_trusted
        return initial

    def _at_cloud_origin(self, initial: InitialState) -> InertialState:
        """Return the first state: the map begins at the cloud's origin, the state is the IMU's."""
        place = initial.state.rotation @ self.matcher.lever
        return dataclasses.replace(initial.state, position=place)

    def _at_rest(
        self,
        sweeps: list[Sweep],
        since: HostNs,
        state: InertialState,
        covariance: F64,
        *,
        is_known: bool = False,
    ) -> Trial:
        """Add sweeps to an empty map where they are at rest, as long as they agree, or all.

        A sweep that fits nowhere does not contradict the rest: two sweeps of a wood may have too
        few surfaces in common.
        """
        matcher = self.matcher
        matcher.clear()
        motions: list[SweepMotion] = []
        met, missed, last = False, False, None
        for sweep in sweeps:
            before = motions[-1].state if motions else state
            reach = None if motions else since
            predicted = self._predictor.over_sweep(sweep, before, covariance, reach)
            motion = predicted.at_rest(state, covariance)
            if motions and not is_known:
                source = matcher.source(sweep, motion)
                trial = motion.at_rest(state, free_pose())
                found, status = matcher.match(source, trial, initial=True)
                if found is None:
                    missed |= status is not MatchStatus.NEW_MAP
                elif self._zero_velocity.test_registration(found):
                    met, last = True, found
                else:
                    return Trial([], False)
            motions.append(motion)
            matcher.extend(matcher.deskewed(sweep, motion), motion, motion.state)
        return Trial(motions, met, last, missed)

    def begin_with(
        self, sweeps: list[Sweep], since: HostNs, beginning: Beginning
    ) -> list[SweepMotion]:
        """Begin the map of a start in motion again, with what has been found out since.

        Parameters
        ----------
        sweeps : list of Sweep
            Those since the start.
        since : HostNs
            As for :meth:`begin`.
        beginning : Beginning
            Of these sweeps.

        Returns
        -------
        list of SweepMotion
            One for each sweep; the IMU alone carries it through one that fits nowhere.
        """
        self._young = YoungSurfaces.IGNORED
        return self._again(sweeps, since, beginning)

    def begin_as_fitted(
        self, sweeps: list[Sweep], since: HostNs, fitted: FittedStart, covariance: F64
    ) -> list[SweepMotion]:
        """Begin the map of a start in motion again, if the fit of its beginning says so.

        Otherwise the first pose is as uncertain as it is off the fit.

        Parameters
        ----------
        sweeps, since, covariance
            As for :meth:`begin_with`; the velocity is as certain as the fit.
        fitted : FittedStart

        Returns
        -------
        list of SweepMotion
            As :meth:`begin_with` returns it; empty if the map stays.
        """
        if not fitted.begins_again:
            before = self._lead_s * (fitted.state.velocity - self._lead_velocity)
            shift = fitted.shift + before
            self.matcher.drift.shift_first_pose(shift)
            return []
        assert self.moving is not None
        known = covariance.copy()
        known[VELOCITY] = known[:, VELOCITY] = 0.0
        known[VELOCITY, VELOCITY] = fitted.velocity_sigma**2 * np.eye(3)
        self._young = YoungSurfaces.TRUSTED
        # the sweeps have fixed the attitude, then and now
        start = dataclasses.replace(fitted.state, rotation=self.moving.initial.state.rotation)
        begun = Beginning(start, known, start, np.zeros((6, 6)))
        return self._again(sweeps, since, begun)

    def _again(
        self, sweeps: list[Sweep], since: HostNs, beginning: Beginning
    ) -> list[SweepMotion]:
        """Begin the map of a start in motion again, with a state at the first reference."""
        assert self.moving is not None
        pose = self._at_cloud_origin(self.moving.initial)
        state, covariance, first, way = beginning
        # the first pose of all stays where it is
        turn = pose.rotation @ first.rotation.T
        lead = self._lead_s * (turn @ first.velocity - self._lead_velocity)
        start = dataclasses.replace(
            state,
            rotation=turn @ state.rotation,
            position=pose.position + lead + turn @ (state.position - first.position),
            velocity=turn @ state.velocity,
            gravity=turn @ state.gravity,
        )
        known = self.moving.initial.covariance.copy()
        found = slice(VELOCITY.start, ERRORS)
        known[found, found] = covariance[found, found]
        initial = dataclasses.replace(self.moving.initial, covariance=known)
        motions = self._round(sweeps, since, start, initial, may_miss=True).motions
        self.matcher.drift.first_pose = self.matcher.drift.first_pose + way
        return motions

    def _in_motion(self, sweeps: list[Sweep], since: HostNs, initial: InitialState) -> Trial:
        """Begin the map in motion: level where it is built, and with its velocity left open.

        The velocity is open where the first sweeps fit at many, as in a hall or between walls.
        """
        trial, begun = self._with_walks(sweeps, since, initial)
        if initial.at_rest or not (initial.gravity_trusted and trial.motions):
            return trial
        initial, begun, trial = self._leveled(sweeps, since, initial, begun, trial)
        self.moving = MovingStart(initial, np.zeros((0, 3)))
        if trial.last is None:
            return trial
        strengths, axes = np.linalg.eigh(trial.last.information[POSITION, POSITION])
        shares = strengths / max(float(strengths[-1]), 1e-9)
        is_open = shares < (tuning.INITIAL_FIXED if trial.is_doubtful else tuning.START_FIXED)
        young = YoungSurfaces.APART
        if shares[0] < tuning.INITIAL_FIXED and self._is_beside_walls(sweeps, trial, axes[:, 0]):
            # what faces the way between bare walls are the rims of the view
            young, is_open[0] = YoungSurfaces.IGNORED, True
        if not is_open.any():
            return trial
        self._young = young
        apart = self._with_open_velocity(sweeps, since, initial, trial)
        if not apart.motions:
            self._young = YoungSurfaces.TRUSTED
            return self._round(sweeps, since, begun, initial)
        self.moving = MovingStart(initial, axes[:, is_open].T)
        return apart

    def _with_open_velocity(
        self, sweeps: list[Sweep], since: HostNs, initial: InitialState, trial: Trial
    ) -> Trial:
        """Begin the map from rest, or from the velocity of a trial that fits clearly closer then.

        Young surfaces do not tell the velocity here, so it stays near the one to begin with.
        """
        start = self._at_cloud_origin(initial)
        found, begun = self._rounds(sweeps, since, start, initial)
        if self._young is YoungSurfaces.IGNORED:
            return found
        walking = dataclasses.replace(start, velocity=trial.motions[0].state.velocity)
        other, _ = self._rounds(sweeps, since, walking, initial)
        if other.fits_closer(found, tuning.INITIAL_CLOSER):
            return other
        return self._round(sweeps, since, begun, initial)

    def _leveled(
        self,
        sweeps: list[Sweep],
        since: HostNs,
        initial: InitialState,
        begun: InertialState,
        trial: Trial,
    ) -> tuple[InitialState, InertialState, Trial]:
        """Return the start with the vertical that its map shows, and the map begun with that.

        A wrong vertical smears the map, and a smeared map hides the vertical: where some surfaces
        agree on one, more may do so once the map has begun with it. Where fewer do, one that the
        accelerometer contradicts strongly is still nearer than the accelerometer.
        """
        found = self.vertical()
        if found is None or found.agreement < tuning.VERTICAL_TRY:
            return initial, begun, trial
        level = initial.leveled(found.direction, tuning.VERTICAL_SIGMA)
        again, better_begun = self._with_walks(sweeps, since, level)
        better = self.vertical() if again.motions else None
        if again.motions and (found.is_certain or (better is not None and better.is_certain)):
            return level, better_begun, again
        is_contradicted = found.is_beyond(tuning.VERTICAL_CONTRADICTS, UP)
        if is_contradicted and better is not None and better.is_likely:
            likely = initial.leveled(found.direction, tuning.VERTICAL_LIKELY_SIGMA)
            trial, begun = self._with_walks(sweeps, since, likely)
            return likely, begun, trial
        return initial, begun, self._round(sweeps, since, begun, initial)

    def vertical(self, guess: F64 = UP) -> Vertical | None:
        """Return the vertical that the surfaces of the map show, near a guess (3,), map axes."""
        return vertical_direction(*self._normals(), guess)

    def _is_tilted(self, initial: InitialState) -> bool:
        """Return whether the map shows another vertical than the accelerometer does."""
        found = self.vertical() if initial.gravity_trusted else None
        if found is None or not found.is_certain:
            return False
        sine = tuning.VERTICAL_TILTED * tuning.VERTICAL_SIGMA / STANDARD_GRAVITY
        return found.is_beyond(sine, UP)

    def _is_beside_walls(self, sweeps: list[Sweep], trial: Trial, direction: F64) -> bool:
        """Return whether the map shows bare walls along a direction (3,), and nothing across."""
        gravity = trial.motions[-1].state.gravity
        axes = level_axes(direction, gravity)
        normals, areas = self._normals()
        upright = areas * (np.abs(normals @ axes[2]) < tuning.WEAK_FACING)
        across = upright * (np.abs(normals @ axes[0]) > tuning.WALLS_FACING)
        if across.sum() > tuning.WALLS_ACROSS * upright.sum():
            return False
        spots = [
            self.matcher.beside_walls(sweep, motion, axes)[0]
            for sweep, motion in zip(sweeps, trial.motions, strict=True)
        ]
        return are_walls(records.joined(spots), axes)

    def _normals(self) -> tuple[F64, F64]:
        """Return the normals (N, 3) of the surfaces of the map, and their areas (N,) [m^2]."""
        levels = self.matcher.surfaces.flat_cells()
        normals = np.concatenate([normals for *_, normals in levels])
        areas = [np.full(len(places), size**2) for size, places, *_ in levels]
        return normals, np.concatenate(areas)

    def _with_walks(
        self, sweeps: list[Sweep], since: HostNs, initial: InitialState
    ) -> tuple[Trial, InertialState]:
        """Begin the map in rounds, each with the velocity that the round before has shown.

        Where the first sweeps hardly fix a direction, as in a corridor, rounds that begin at rest
        may end at the wrong velocity along it: rounds from a walk either way are tried as well.
        Where they fit badly, as where a yard shows ground and few walls, also along the others.
        """
        start = self._at_cloud_origin(initial)
        trial, begun = self._rounds(sweeps, since, start, initial)
        if initial.at_rest or trial.last is None:
            return trial, begun
        best, best_begun, latest = trial, begun, trial
        axes = np.linalg.eigh(trial.last.information[POSITION, POSITION])[1]
        is_weak = trial.leaves_open(tuning.WEAK_SHARE)
        for number, axis in enumerate(axes.T):  # weakest first
            if not (best.is_doubtful or (is_weak and number == 0)):
                break
            for speed in (tuning.INITIAL_SPEED, -tuning.INITIAL_SPEED):
                walking = dataclasses.replace(start, velocity=speed * axis)
                latest, begun = self._rounds(sweeps, since, walking, initial)
                if latest.motions and latest.fits_better(best):
                    best, best_begun = latest, begun
        if best is not latest:  # the maps are those of the latest one
            best = self._round(sweeps, since, best_begun, initial)
        return best, best_begun

    def _rounds(
        self, sweeps: list[Sweep], since: HostNs, start: InertialState, initial: InitialState
    ) -> tuple[Trial, InertialState]:
        """Return the last one of some rounds, and the state that it began with."""
        trial = Trial([], False)
        for _ in range(tuning.INITIAL_ROUNDS):
            begun = start
            trial = self._round(sweeps, since, begun, initial)
            if not trial.motions:
                break
            velocity = trial.motions[1].state_at(start.stamp).velocity
            if initial.at_rest and np.linalg.norm(velocity) > tuning.INITIAL_REST_SPEED:
                return Trial([], False), begun
            if not trial.met or np.linalg.norm(velocity - start.velocity) < tuning.INITIAL_STEP:
                break
            start = dataclasses.replace(start, velocity=velocity)
        return trial, begun

    def _round(
        self,
        sweeps: list[Sweep],
        since: HostNs,
        start: InertialState,
        initial: InitialState,
        *,
        may_miss: bool = False,
    ) -> Trial:
        """Begin the map with a first state; without motions if a sweep fits nowhere.

        Where one may, the IMU alone carries it.
        """
        matcher = self.matcher
        matcher.clear()
        matcher.surfaces.young = self._young
        first = self._predictor.over_sweep(sweeps[0], start, initial.covariance, since)
        motions = [first]
        matcher.extend(matcher.deskewed(sweeps[0], first), first, first.state)
        met, last = False, None
        for sweep in sweeps[1:]:
            motion = self._predictor.over_sweep(sweep, motions[-1].state, motions[-1].covariance)
            source = matcher.source(sweep, motion)
            found, status = matcher.match(source, motion, initial=True)
            if found is not None:
                motion = motion.with_state(found.state, found.covariance)
                met, last = True, found
            elif may_miss:
                motions.append(motion)
                continue
            elif not (status is MatchStatus.NEW_MAP and initial.at_rest):
                return Trial([], False)
            motions.append(motion)
            matcher.extend(matcher.deskewed(sweep, motion), motion, motion.state)
        if not initial.at_rest:
            matcher.drift.first_pose = self._first_pose(motions[1])
        return Trial(motions, met, last)

    def _first_pose(self, second: SweepMotion) -> F64:
        """Return the covariance (6, 6) of the first pose of all against the map, map axes.

        The velocity until the first sweep in the map is known as well as in the second one. A
        wrong one has also deskewed the first sweeps, which turns them against those that follow.
        """
        covariance = np.diag(np.repeat(np.square(tuning.BEGUN_IN_MOTION), 3))
        velocity = second.covariance[VELOCITY, VELOCITY]
        covariance[:3, :3] += self._lead_s**2 * velocity
        turn, most = tuning.BEGUN_TURN
        worst = min(float(np.linalg.eigvalsh(velocity)[-1]), most**2)
        covariance[3:, 3:] += turn**2 * worst * np.eye(3)
        return covariance
