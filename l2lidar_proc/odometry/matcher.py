"""Scan-to-map registration: the maps, and the alignment of sweeps with them.

After a loose prediction the alignment begins from several hypotheses for the pose.
"""

from __future__ import annotations

import copy
import dataclasses
from collections import deque
from enum import Enum, auto
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import records
from l2lidar_node.types import F64, HostNs, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.cloud import positions_by_axis
from l2lidar_proc.deskew.deskew import coordinates, deskew
from l2lidar_proc.motion.carrier_priors import is_driving_speed
from l2lidar_proc.motion.filter import (
    POSE,
    POSITION,
    ROTATION,
    VELOCITY,
    InertialState,
    pose_covariance,
    square_root,
    update_with_information,
)
from l2lidar_proc.motion.sweep_motion import SweepMotion
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import AlignmentQuality
from l2lidar_proc.odometry.intrinsics.corrections import Corrections
from l2lidar_proc.odometry.intrinsics.range_bias import SeenAgain
from l2lidar_proc.odometry.kiss import KissMatcher, thinned_indices
from l2lidar_proc.odometry.local_map.free_space import SeenThrough, seen_through
from l2lidar_proc.odometry.local_map.surfel_map import SurfelMap
from l2lidar_proc.odometry.local_map.surfels import YoungSurfaces
from l2lidar_proc.odometry.registration.alignment import (
    Alignment,
    align,
    degeneracy_ratio,
    unobserved_directions,
    weakest_direction,
)
from l2lidar_proc.odometry.registration.correspondences import Source
from l2lidar_proc.odometry.registration.pose_hypotheses import (
    is_explained_by_drift,
    level_basis,
    level_hypotheses,
    pose_hypotheses,
    rotation_is_loose,
)
from l2lidar_proc.odometry.uncertainty import MapDrift
from l2lidar_proc.odometry.walls.vertical_lines import Lines, extract_lines
from l2lidar_proc.odometry.walls.wall_profile import Spots, extract_spots


class MatchStatus(Enum):
    """Whether a sweep was aligned, and if not, why."""

    ALIGNED = auto()
    REJECTED = auto()  # too few points meet a surface, or they do not fit as they should
    NEW_MAP = auto()  # it has just begun, and has no surface here: the prediction is good enough
    UNMAPPED = auto()  # the place is not known well, and a rich view is where the map is empty


class Match(NamedTuple):
    """Result of matching a sweep with the map.

    Attributes
    ----------
    alignment : Alignment or None
        The one that can be believed; None unless the status is ALIGNED.
    status : MatchStatus
    """

    alignment: Alignment | None
    status: MatchStatus


class SweepMatcher:
    """Two maps of the same points, surfaces and KISS-ICP's, and the matching of sweeps with them.

    Parameters
    ----------
    config : OdometryConfig
    lever : ndarray, shape (3,)
        Place of the IMU in the cloud frame [m].

    Attributes
    ----------
    config : OdometryConfig
        May be replaced; what is not live comes into force with a new matcher.
    lever : ndarray, shape (3,)
    surfaces : SurfelMap
    kiss : KissMatcher
    drift : MapDrift
        How wrong the map may be where the latest sweep is.
    driving : bool
        Whether the carrier is one that drives, not one moved by hand.
    notes_sights : bool
        Whether to note how surfaces are seen, for :meth:`seen_again`.
    """

    def __init__(self, config: OdometryConfig, lever: F64) -> None:
        self.config = config
        self.lever = lever
        settings = config.surfaces
        self.surfaces = SurfelMap(
            settings.surface_sizes,
            thickness=settings.surface_thickness,
            least=settings.surface_points,
            capacity=settings.surface_capacity,
        )
        self.kiss = KissMatcher(config)
        self.drift = MapDrift()
        self.driving = False
        self.notes_sights = True
        self._pruned_at = np.zeros(3)
        self._begin_way()

    def for_another_map(self) -> SweepMatcher:
        """Return one without maps, for the same sweeps."""
        another = SweepMatcher(self.config, self.lever)
        another.drift.corrections = another.drift.began = self.drift.corrections
        another.notes_sights = self.notes_sights
        return another

    def _begin_way(self) -> None:
        self._sweeps = 0
        self._way = 0.0
        self._before: F64 | None = None  # place of the sweep before
        self._added = 0  # stamp of the sweep before
        self._oldest = 0  # sweep from which on places are still in the map
        self._ways: deque[tuple[float, int]] = deque()  # way at some sweeps since
        self._inliers = 0.0, 0  # recent mean inlier ratio, and its number of sweeps
        # of the normals of the walls along which the carrier drives
        self._normal_scatter: F64 = np.zeros((3, 3))
        self._is_weak = False  # along them, in the latest sweep
        self._range_correction = 0.0  # of what is in the map [m]
        self._height_fixed_s = 0.0, 0.0  # of late, and the time that counts in all

    def correct(self, corrections: Corrections) -> None:
        """Take the corrections of the sweeps to come, and correct the ranges in the map likewise.

        Otherwise the pose of a sensor that looks ahead would move by the change.

        Parameters
        ----------
        corrections : Corrections
        """
        self.drift.corrections = corrections
        change = corrections.ranges - self._range_correction
        if self._sweeps and abs(change) >= tuning.RANGE_BIAS_MOVED:
            self.surfaces.correct_ranges(change)
            self._range_correction = corrections.ranges

    @property
    def is_young(self) -> bool:
        """Whether the maps have only just begun."""
        return self._sweeps < tuning.YOUNG_SWEEPS

    @property
    def begins_between_walls(self) -> bool:
        """Whether the map has begun in motion, between bare walls, with the velocity open."""
        return self.surfaces.young is YoungSurfaces.IGNORED

    @property
    def observes_height(self) -> bool:
        """Whether sweeps have fixed the height of late, now and then at least."""
        fixed, total = self._height_fixed_s
        return fixed >= tuning.HEIGHT_SHARE * total

    def clear(self) -> None:
        """Forget the maps."""
        self._begin_way()
        self.surfaces.clear()
        self.kiss.clear()
        self.drift.clear()

    def deskewed(self, sweep: Sweep, motion: SweepMotion) -> NDArray[np.void]:
        """Return the points of a sweep as seen from the reference of a motion, shape (N,)."""
        return deskew(sweep.points, sweep.start, motion.trajectory(self.lever), motion.state.stamp)

    def source(self, sweep: Sweep, motion: SweepMotion) -> Source:
        """Return the points to align, deskewed along a predicted motion."""
        # thinned before they are moved: a tenth of the points is left to deskew
        settings, points = self.config.surfaces, xyz(sweep.points)
        chosen = thinned_indices(points, settings.source_voxel)
        if self._is_weak and len(chosen) < tuning.DRIVING_POINTS:
            chosen = thinned_indices(points, tuning.DRIVING_VOXEL * settings.source_voxel)
        chosen = records.decimated(chosen, settings.source_points)

        def denser() -> Source:
            dense = thinned_indices(points, tuning.FACING_VOXEL * settings.source_voxel)
            return self._source(sweep, np.setdiff1d(dense, chosen), motion)

        return dataclasses.replace(self._source(sweep, chosen, motion), denser=denser)

    def _source(self, sweep: Sweep, chosen: NDArray[np.int64], motion: SweepMotion) -> Source:
        """Return some points of a sweep, deskewed along a motion."""
        some = records.selected(sweep.points, chosen)
        moved = coordinates(some, sweep.start, motion.trajectory(self.lever), motion.state.stamp)
        points = np.stack(moved, dtype=np.float64).T
        offset = (sweep.start - motion.state.stamp) * 1e-9
        return Source(
            points - self.lever,
            offset + some["time"].astype(np.float64),
            np.linalg.norm(points, axis=1),
        )

    def match(
        self,
        source: Source,
        motion: SweepMotion,
        *,
        initial: bool = False,
        on_trial: bool = False,
    ) -> Match:
        """Return the alignment that can be believed, if there is one.

        A prediction that may be a surface off is not the only one to begin from: KISS-ICP's
        registration and a search around it give others, and the result has to fit the map as
        wrong ones do not.

        Parameters
        ----------
        source : Source
        motion : SweepMotion
            The one that deskewed the source.
        initial : bool
            The map has only just begun: it cannot be searched, and wrong results are sorted out
            later.
        on_trial : bool
            Nothing is learned from it of what is usual here, unless :meth:`note_usual` is called.
        """
        found = self._matched(source, motion, initial=initial)
        if found.alignment is not None and not on_trial:
            self.note_usual(found.alignment)
        return found

    def _matched(self, source: Source, motion: SweepMotion, *, initial: bool) -> Match:
        """Return the alignment that can be believed, as :meth:`match`."""
        if len(source.points) < self.config.min_points or not len(self.surfaces):
            return Match(None, MatchStatus.REJECTED)
        # a start tries its first sweeps at several velocities: what they fix tells which is right
        if not (initial and self.surfaces.young is YoungSurfaces.TRUSTED):
            motion = self._with_turned_axis(motion)
        loose = self._place_is_loose(motion.covariance) or rotation_is_loose(motion.covariance)
        young = self.is_young
        strict = loose and not initial and not young
        found = self._align(source, motion, motion.state)
        is_good = self._is_believable(found, source, motion, strict)
        near = found is not None and not is_far(found, motion)
        if is_good and (not loose or (strict and near)):
            return Match(found, MatchStatus.ALIGNED)
        if not loose:
            is_new = young and found is None
            return Match(None, MatchStatus.NEW_MAP if is_new else MatchStatus.REJECTED)
        starts = [self._registered(source, motion.state)]
        if strict:
            starts += pose_hypotheses(motion.state, motion.covariance, source, self.surfaces)
        others = [found, *(self._align(source, motion, start) for start in starts)]
        good = [
            other
            for other in others
            if other and self._is_believable(other, source, motion, strict)
        ]
        best = max(good, key=lambda other: other.inlier_ratio * other.matched, default=None)
        if strict and best is not None and is_ambiguous(best, others, motion):
            best = None
        elif strict and self._is_confirmed(found, source, motion):
            assert found is not None
            if best is None or best.fine_inliers <= found.fine_inliers:
                best = found
        if best is None and motion.imu.missing.all():
            # nobody measured the turn: where surfaces say nothing KISS-ICP by itself is not lost
            best = self._placed(source, motion, np.inf)
        elif best is None and young and found is None:
            best = self._placed(source, motion, tuning.KISS_SIGMA.position)
        if best is None and strict and self._is_unmapped(source, motion.state):
            return Match(None, MatchStatus.UNMAPPED)
        return Match(best, MatchStatus.REJECTED if best is None else MatchStatus.ALIGNED)

    def relocalize(self, source: Source, motion: SweepMotion, places: F64) -> Alignment | None:
        """Return how a sweep fits the map at the only other place on its level where it does.

        None if there is no such place, or more than one.

        For a place that has drifted while no surface fixed it. Of the first surface that fixes it
        again few points are seen, and all others fit anywhere along their walls. So the places
        tried are close together, and only points in the finest cells count. There must be one
        such place only, on the same level, as a step of a stair looks like the next. What lies
        farther away than drift explains may be another door in the same wall. The height is the
        predicted one where the sweep leaves it free.

        Parameters
        ----------
        source : Source
        motion : SweepMotion
            The one that deskewed the source; its pose is loose.
        places : ndarray, shape (3, 3)
            How uncertain the place in this map has to be allowed to be, map axes [m^2].
        """
        state = motion.state
        if not state.gravity.any() or len(source.points) < tuning.FAR_MATCHED:
            return None
        starts = level_hypotheses(state, places, source, self.surfaces)
        others = [self._align(source, motion, start) for start in starts]
        good = [one for one in others if one and self._fits_on_level(one, source, motion, places)]
        best = max(good, key=lambda one: one.fine_inliers, default=None)
        if best is None or any(_are_apart(one, best) for one in good):
            return None
        move = best.state.position - state.position
        free = unobserved_directions(best.information[POSITION, POSITION])
        position = best.state.position - free @ (free.T @ move)
        return dataclasses.replace(best, state=dataclasses.replace(best.state, position=position))

    def _fits_on_level(
        self, found: Alignment, source: Source, motion: SweepMotion, places: F64
    ) -> bool:
        """Return whether an alignment fixes another place on the level of the predicted one."""
        move, gravity = found.state.position - motion.state.position, motion.state.gravity
        if not is_far(found, motion) or self._is_far_fetched(found, motion):
            return False
        if abs(float(move @ gravity)) > tuning.RELOCALIZE_HEIGHT_M * float(
            np.linalg.norm(gravity)
        ):
            return False
        if not is_explained_by_drift(move, places):
            return False
        inliers, fine_inliers = tuning.RELOCALIZE_INLIERS
        if found.inlier_ratio < inliers or found.fine_ratio < fine_inliers:
            return False
        if found.fine_inliers < tuning.RELOCALIZE_MATCHED * len(source.points):
            return False
        if self._sees_through(found, source):
            return False
        free = unobserved_directions(found.information[POSITION, POSITION])
        return not free.size or is_vertical(free, gravity)

    @property
    def _wall_direction(self) -> F64 | None:
        """The direction (3,) of the walls along which the carrier drives, None where it does not.

        Unit, map axes.
        """
        if not (self.driving and self._is_weak):
            return None
        return np.asarray(np.linalg.eigh(self._normal_scatter)[1][:, 0])

    def _with_turned_axis(self, motion: SweepMotion) -> SweepMotion:
        """Return a predicted motion that allows for a loosest direction which is not known well.

        Where surfaces leave a direction free, place and velocity are uncertain along it by meters.
        Each sweep sees that direction a few degrees off. What it measures across, to millimeters,
        would then be taken for a measurement along (Huang, Mourikis and Roumeliotis 2010 show it
        for the unobservable directions of SLAM).
        """
        axis, turn = self._wall_direction, tuning.WAY_TURN
        if axis is None:
            axes = np.linalg.eigh(motion.covariance[VELOCITY, VELOCITY])[1]
            axis, turn = axes[:, -1], tuning.LOOSE_AXIS_TURN
        across = np.eye(3) - np.outer(axis, axis)
        covariance = motion.covariance.copy()
        for errors in (POSITION, VELOCITY):
            along = float(axis @ covariance[errors, errors] @ axis)
            covariance[errors, errors] += turn**2 * along * across
        return dataclasses.replace(motion, covariance=covariance)

    def _place_is_loose(self, covariance: F64) -> bool:
        """Return whether the place is so uncertain that it may be a surface off.

        Along bare walls it does not matter how far: they fit everywhere.
        """
        places = covariance[POSITION, POSITION]
        way = self._wall_direction
        if way is not None:
            across = np.eye(3) - np.outer(way, way)
            places = across @ places @ across
        return bool(np.linalg.eigvalsh(places)[-1] > tuning.LOOSE_POSITION**2)

    def extend(
        self,
        moved: NDArray[np.void],
        motion: SweepMotion,
        guess: InertialState,
        expected_share: float = 1.0,
    ) -> float:
        """Add the deskewed points (N,) of a sweep to the maps.

        Return the share of them that fell where there was no map before.

        Parameters
        ----------
        moved : ndarray, shape (N,)
        motion : SweepMotion
            The one that deskewed them.
        guess : InertialState
            What was predicted: from it KISS-ICP learns how good predictions are.
        expected_share : float
            Of the covariance of the pose, for the drift of the map.
        """
        state = motion.state
        points = xyz(moved) - self.lever
        placed = (state.rotation @ points.T + state.position[:, None]).T
        added = pose_covariance(state, motion.covariance)
        self.drift.record(self._sweeps, state.position, added, expected_share)
        apart = self.drift.more_certain(state.position)
        # what is ahead of a carrier that drives was seen from afar first, and tells its way:
        # points from nearby, which the errors of that way have moved, must not take its place
        weighted = not self.driving
        self._note_period(state.stamp)
        if not self._sweeps:
            self._range_correction = self.drift.corrections.ranges
        fresh = self.surfaces.add(
            placed,
            self._sweeps,
            apart,
            state.position,
            weighted=weighted,
            range_correction=self.drift.corrections.ranges if self.notes_sights else None,
        )
        measured = not motion.imu.missing.all()
        self.kiss.update(points, state.pose, guess.pose, keyframes=measured)
        self._walk(state.position)
        self._sweeps += 1
        return fresh

    def seen_again(self, source: Source, state: InertialState) -> SeenAgain:
        """Return the points of a sweep that meet surfaces, and how the map has seen these.

        Parameters
        ----------
        source : Source
        state : InertialState
            Of the sweep.
        """
        apart = source.ranges > tuning.RANGE_BIAS_NEAREST
        from_imu = source.points[apart] @ state.rotation.T
        found = self.surfaces.match(from_imu + state.position, origins=state.position)
        sights = self.surfaces.sights(found.cells)
        noted = np.flatnonzero(sights["weight"] > 0.0)
        weights = sights["weight"][noted, None].astype(np.float64)
        return SeenAgain(
            (from_imu + state.rotation @ self.lever)[found.index[noted]],
            found.normals[noted],
            found.distances[noted],
            sights["lines"][noted] / weights,
            sights["corrected"][noted] / weights,
            self.drift.corrections.ranges,
        )

    def _note_period(self, stamp: HostNs) -> None:
        """Take the instant of a sweep, for the time from one to the next."""
        seconds = (stamp - self._added) * 1e-9
        if self._sweeps and seconds > 0.0:
            now = min(max(seconds, tuning.SWEEP_LEAST_S), tuning.SWEEP_MOST_S)
            blend = max(tuning.SWEEP_BLEND, 1.0 / self._sweeps)
            self.surfaces.sweep_s += blend * (now - self.surfaces.sweep_s)
        self._added = stamp

    def _walk(self, place: F64) -> None:
        """Count the way to a place; drop what is far, or was left behind long ago.

        A place that is met again after a long way is not where the map has it: the odometry has
        drifted meanwhile. Both cannot be matched at once; what was seen last is what an odometry
        without jumps goes on from.
        """
        if self._before is not None:
            self._way += float(np.linalg.norm(place - self._before))
        self._before = place
        if not self._ways or self._way - self._ways[-1][0] > tuning.MAP_WAY_STEP:
            self._ways.append((self._way, self._sweeps))
        aged = False
        while self._way - self._ways[0][0] > tuning.MAP_WAY:
            self._oldest, aged = self._ways.popleft()[1] + 1, True
        far = np.linalg.norm(place - self._pruned_at) > tuning.PRUNE_SHARE * self.config.max_range
        if far or aged:
            self.surfaces.forget(place, self.config.max_range, self._oldest)
            self._pruned_at = place

    def meet(self, found: Alignment, seconds: float) -> None:
        """Let a pose be as uncertain as the surfaces that an alignment has met.

        Parameters
        ----------
        found : Alignment
        seconds : float
            Since the sweep before.
        """
        self._note_height(found, seconds)
        self._is_weak = found.normal_scatter is not None
        if found.normal_scatter is not None:
            self._normal_scatter = found.normal_scatter
        free = unobserved_directions(found.information[POSITION, POSITION])
        if not free.size:
            self.drift.meet(found.support, found.state.position, found.weakly, found.strongly)
            return
        self.drift.meet_partly(
            found.support,
            found.state.position,
            free,
            found.covariance[VELOCITY, VELOCITY],
            seconds,
            found.strongly,
        )

    def driving_direction(self, found: Alignment, *, is_open: bool = False) -> F64 | None:
        """Return the direction (3,) along which a carrier drives while its place is free.

        None unless an alignment leaves exactly one direction of the place free, which is level,
        and the carrier drives: by what it has shown before, or by its present velocity, or since
        that is open.
        """
        free = unobserved_directions(found.information[POSITION, POSITION])
        gravity = found.state.gravity
        if free.shape[1] != 1 or not gravity.any():
            return None
        along = free[:, 0]
        if abs(float(along @ gravity)) > tuning.LINE_SLOPE * float(np.linalg.norm(gravity)):
            return None
        sigma = float(np.sqrt(along @ found.covariance[VELOCITY, VELOCITY] @ along))
        least = abs(float(along @ found.state.velocity)) - sigma
        return along if is_open or self.driving or is_driving_speed(least) else None

    def beside_walls(self, sweep: Sweep, motion: SweepMotion, axes: F64) -> tuple[Spots, Lines]:
        """Return what a sweep sees beside the way: spots of walls, and vertical lines elsewhere.

        Parameters
        ----------
        sweep : Sweep
        motion : SweepMotion
            Places the points.
        axes : ndarray, shape (3, 3)
            As :func:`~l2lidar_proc.odometry.walls.wall_velocity.level_axes` returns them, of the
            direction along which the walls run.
        """
        seen = xyz(sweep.points)
        near = np.flatnonzero((seen**2).sum(axis=1) < tuning.PROFILE_RANGE**2)
        near = records.decimated(near, tuning.WALL_POINTS)
        some = dataclasses.replace(sweep, points=records.selected(sweep.points, near))
        moved = self.deskewed(some, motion)
        state = motion.state
        sights = (xyz(moved) - self.lever) @ state.rotation.T
        placed = sights + state.position
        stamps = sweep.start + np.round(moved["time"] * 1e9).astype(np.int64)
        has_intensity = "intensity" in (moved.dtype.names or ())
        bright = moved["intensity"].astype(np.float64) if has_intensity else None
        spots = extract_spots(placed, stamps, bright, sights, axes)
        close = (sights**2).sum(axis=1) < tuning.LINE_RANGE**2
        placed, stamps = placed[close], stamps[close]
        is_wall = self.surfaces.are_along(placed, axes[0])
        return spots, extract_lines(placed, stamps, is_wall, axes)

    def _note_height(self, found: Alignment, seconds: float) -> None:
        """Note for how long the height has been fixed, of late."""
        gravity = found.state.gravity
        places = found.information[POSITION, POSITION]
        least = tuning.DEGENERATE_SHARE * (gravity @ gravity) * np.trace(places)
        fixes = bool(gravity @ places @ gravity > least)
        left = float(np.exp(-seconds / tuning.HEIGHT_MEMORY_S))
        fixed, total = self._height_fixed_s
        self._height_fixed_s = left * fixed + seconds * fixes, left * total + seconds

    def part_of(self, sweeps: NDArray[np.bool_]) -> SweepMatcher:
        """Return this with only the surfaces that some of the sweeps (S,) were the first to see.

        All else is shared; one of the two may go on.
        """
        part = copy.copy(self)
        part.surfaces = self.surfaces.part_of(sweeps)
        return part

    def quality(self, points: int, found: Alignment | None) -> AlignmentQuality:
        """Return how well a sweep with so many points to align could be matched."""
        quality = AlignmentQuality(
            points=points, kiss_threshold_m=self.kiss.threshold, map_cells=len(self.surfaces)
        )
        if found is None:
            return quality
        return dataclasses.replace(
            quality,
            matched=found.matched,
            inlier_ratio=found.inlier_ratio,
            residual_m=found.residual,
            degeneracy_ratio=degeneracy_ratio(found.information[POSITION, POSITION]),
            weakest=weakest_direction(found.information[POSITION, POSITION]),
        )

    def _is_believable(
        self, found: Alignment | None, source: Source, motion: SweepMotion, strict: bool
    ) -> bool:
        """Return whether the result of an alignment fits the map as wrong ones do not."""
        overlap = tuning.OVERLAP.loose if strict else tuning.OVERLAP.good
        if found is None or found.matched < overlap * len(source.points):
            return False
        if strict and self._is_far_fetched(found, motion):
            return False
        if found.inlier_ratio < self._needed_inliers(strict):
            return False
        return not (strict and is_far(found, motion) and self._sees_through(found, source))

    def seen_through(self, source: Source, state: InertialState) -> SeenThrough:
        """Return the known surfaces through which a sweep would see from a state."""
        placed = source.points @ state.rotation.T + state.position
        return seen_through(self.surfaces, state.position, placed)

    def _sees_through(self, found: Alignment, source: Source) -> bool:
        """Return whether the sweep would see through known surfaces where an alignment puts it."""
        return self.seen_through(source, found.state).share > tuning.RAYS_THROUGH

    def note_usual(self, found: Alignment) -> None:
        """Learn from an alignment that is believed what share of inliers is usual here."""
        if not found.matched:
            return
        usual, sweeps = self._inliers
        blend = max(tuning.USUAL_BLEND, 1.0 / (sweeps + 1))
        self._inliers = usual + blend * (found.inlier_ratio - usual), sweeps + 1

    def fits_badly(self, found: Alignment) -> bool:
        """Return whether an alignment fits the map as wrong ones do, or as new places."""
        return not self.is_young and found.inlier_ratio < self._needed_inliers(True)

    def lost_sight(self, found: Alignment) -> bool:
        """Return whether an alignment leaves a direction free, and has many more outliers.

        More than of late: surfaces that fixed the direction may be there, but beyond reach. Not
        along the walls of a carrier that drives, as one niche looks like the next.
        """
        usual, sweeps = self._inliers
        if self.driving or self.is_young or not sweeps or found.fixes_place:
            return False
        most = tuning.DOUBT_OUTLIERS_FACTOR * (1.0 - usual) + tuning.DOUBT_OUTLIERS_SHARE
        return bool(1.0 - found.inlier_ratio > most)

    def _is_confirmed(self, found: Alignment | None, source: Source, motion: SweepMotion) -> bool:
        """Return whether the finest cells confirm a loose prediction.

        Where a new place comes into sight, most of it lies in coarse cells of what is known
        beside it, off their surfaces: these outliers are no sign of a wrong pose.
        """
        least = max(self.config.min_points, tuning.OVERLAP.loose * len(source.points))
        return (
            found is not None
            and not is_far(found, motion)
            and found.fine_inliers >= least
            and found.fine_ratio >= self._needed_inliers(True)
        )

    def _is_far_fetched(self, found: Alignment, motion: SweepMotion) -> bool:
        """Return whether a place far from the predicted one rests on a few points.

        A few points fit in many places. A handful that face a direction find a surface somewhere
        along it, if the prediction leaves enough room; the others agree with every place along it.
        """
        if not is_far(found, motion):
            return False
        move = found.state.position - motion.state.position
        far = float(np.linalg.norm(move))
        points = self.config.surfaces.point_noise**2 * found.information[POSITION, POSITION]
        facing = float(move @ points @ move)
        return found.matched < tuning.FAR_MATCHED or (
            far >= tuning.FAR_MOVE and facing < tuning.FAR_POINTS * far**2
        )

    def _needed_inliers(self, strict: bool) -> float:
        """Return the inlier ratio that a result needs.

        In rain, foliage or a crowd the right place has one point in eight off every surface, and
        none would ever be found again if it had to fit as in a bare room.
        """
        needed = tuning.INLIER_RATIO.loose if strict else tuning.INLIER_RATIO.good
        usual, sweeps = self._inliers
        if strict and sweeps:
            usual = max(1.0 - tuning.USUAL_OUTLIERS * (1.0 - usual), tuning.USUAL_LEAST)
            needed = min(needed, usual)
        return needed

    def _is_unmapped(self, source: Source, state: InertialState) -> bool:
        """Return whether a sweep with many points sees little that the map knows, from a state."""
        points = source.points
        if len(points) < tuning.UNMAPPED_POINTS:
            return False
        known = self.surfaces.are_known(points @ state.rotation.T + state.position)
        return bool(np.mean(known) < tuning.UNMAPPED_KNOWN)

    def _align(
        self, source: Source, motion: SweepMotion, start: InertialState
    ) -> Alignment | None:
        share, enough = tuning.MEETING
        least = min(enough, max(self.config.min_points // 2, round(share * len(source.points))))
        return align(
            motion.state,
            motion.covariance,
            source,
            self.surfaces,
            self.config.surfaces,
            least,
            start,
            driving=self.driving,
            normal_scatter=self._normal_scatter,
        )

    def _placed(self, source: Source, motion: SweepMotion, most: float) -> Alignment:
        """Return what the place that KISS-ICP's registration finds is worth by itself."""
        place = self._registered(source, motion.state, most)
        information = np.zeros_like(motion.covariance)
        information[ROTATION, ROTATION] = np.eye(3) / tuning.KISS_SIGMA.rotation**2
        information[POSITION, POSITION] = np.eye(3) / tuning.KISS_SIGMA.position**2
        still = np.zeros(len(information))
        state, covariance = update_with_information(
            motion.state, square_root(motion.covariance), place, information, still
        )
        nobody = np.empty(0, np.int64), np.empty(0)
        claimed = information[POSITION, POSITION]
        return Alignment(state, covariance, information, claimed, 0, 0.0, 0.0, nobody)

    def _registered(
        self, source: Source, guess: InertialState, most: float = np.inf
    ) -> InertialState:
        """Return the guess with the pose that KISS-ICP's registration finds."""
        better = self.kiss.register(source.points, guess.pose, most)
        if better is None:
            return guess
        return dataclasses.replace(guess, rotation=better[:3, :3], position=better[:3, 3])


def is_far(found: Alignment, motion: SweepMotion) -> bool:
    """Return whether an alignment ended farther away than the robust kernel reaches.

    Along directions that it does not fix, the place only follows what the prior ties to it.
    """
    turn, way = np.split(found.state.boxminus(motion.state)[POSE], 2)
    free = unobserved_directions(found.information[POSITION, POSITION])
    way = way - free @ (free.T @ way)
    return bool(np.linalg.norm(way) >= tuning.FAR_MOVE or np.linalg.norm(turn) >= tuning.FAR_TURN)


def is_vertical(directions: F64, gravity: F64) -> bool:
    """Return whether directions (3, K), orthonormal, are that of a gravity (3,) alone."""
    level = level_basis(gravity).T @ directions
    return bool(np.linalg.norm(level) < tuning.RELOCALIZE_TILT)


def is_ambiguous(best: Alignment, others: list[Alignment | None], motion: SweepMotion) -> bool:
    """Return whether a place far from the predicted one is one of several that fit.

    What little of a new room is seen at first fits in an old one, and not only in one place.
    """
    matched, worse = tuning.FAR_UNIQUE
    return is_far(best, motion) and any(
        other.matched > matched * best.matched
        and other.inlier_ratio > best.inlier_ratio - worse
        and np.linalg.norm(other.state.position - best.state.position) > tuning.FAR_MOVE
        for other in others
        if other is not None
    )


def _are_apart(one: Alignment, other: Alignment) -> bool:
    """Return whether two alignments put the sensor in different places."""
    way = one.state.position - other.state.position
    return bool(np.linalg.norm(way) > tuning.RELOCALIZE_APART_M)


def xyz(points: NDArray[np.void]) -> F64:
    """Return the coordinates of structured points (N,) as float64, shape (N, 3).

    Each axis is contiguous: that is how the maps compute with them.
    """
    return positions_by_axis(points).T
