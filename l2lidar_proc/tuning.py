"""Tuning constants of the estimators: every number that is neither physics nor a parameter.

Each has its unit in brackets and its meaning; a comment above several, or above their section,
holds for all of them. Where they come from:

* *derived*: follows from the sensor's data sheet or from another number,
* *source*: taken from the publication or the measurement named,
* *tuned on*: chosen on the recordings named; the built-in scenes are room, yard, corridor and box
  with walk, trot and drone, and "captures" are the two of a real unit at rest
  (docs/odometry_design.md),
* *observed*: a figure that was measured, and that the number keeps clear of,
* *judged on*: chosen otherwise, and confirmed on the recordings named,
* *speed only*, *bounds the time* or *the memory*: accuracy does not depend on it.
"""

from __future__ import annotations

from typing import Final, NamedTuple


class ByPlace(NamedTuple):
    """A number that depends on whether surfaces fix the place in every direction."""

    fixed: float
    free: float


class OfPose(NamedTuple):
    """A number for the rotation and one for the position of a pose."""

    rotation: float  # [rad]
    position: float  # [m]


class ByPrediction(NamedTuple):
    """A number that depends on how well the pose was predicted."""

    good: float
    loose: float


# ---- IMU samples

IMU_PERIOD_S: Final = 0.004  # [s] derived: 250 Hz; the noise parameters are stated for it
PERIOD_SAMPLES: Final = 10  # that show another period; fewer may lie beside a gap
MAX_RATE: Final = 100.0  # [rad/s] derived: no gyro measures more
MAX_FORCE: Final = 5000.0  # [m/s^2] derived: no accelerometer measures more
MAX_SAMPLES: Final = 100_000  # in a buffer; derived: 25 s at 4 kHz
# Distance of samples, in periods, from which on some are missing and what is between is uncertain.
# Derived: two lost; stamps of ROS drivers jitter by half a period and more
SPARSE_PERIODS: Final = 2.5
TREND_SAMPLES: Final = 5  # that count at either edge of a gap; one alone is too noisy
AROUND_SAMPLES: Final = 25  # on either side of a gap: more than a blow of 0.12 s lasts
GAP_STEP_NS: Final = 20_000_000  # [ns] knots in a gap; rotation in one stays below 0.1 rad at 5/s
GAP_KNOTS: Final = 64  # at most in one gap, however long: bounds work and memory
TIME_JUMP_NS: Final = 10_000_000_000  # [ns] a longer step of time starts a new time line

# ---- gyro: line of the head. Tuned on: corridors, seeds 50 to 55, lines of 0.03 and 0.3 rad/s

HEAD_LINE_SAMPLES: Final = 30  # of a turn, at least; 57 at 250 Hz
HEAD_LINE_TURN: Final = 0.05  # by which the span of the samples may differ from a turn
HEAD_LINE_LEAST: Final = 1e-3  # [rad/s] by which turns differ at any rate
HEAD_LINE_NEXT: Final = 1.6  # turns from the end of one to that of the next
HEAD_LINE_SIGMAS: Final = 3.0  # by which they may differ; by chance 1 of 20 turns does
HEAD_LINE_TURNS: Final = 2500  # that count; derived: ten minutes
HEAD_LINE_LEAST_TURNS: Final = 2  # until the line is removed
HEAD_LINE_AGE_NS: Final = 2_000_000_000  # [ns] of the head's angle, at most; 0.2 rad by then

# ---- error-state filter

COVARIANCE_STEPS: Final = 6  # per prediction; the mean uses every sample. Tuned on: room walk
# What a carrier may do where nothing is measured, as densities per sqrt(Hz). Tuned on: gaps and
# missing IMUs in room, field and garden.
BLIND_GYRO: Final = 0.5  # [rad/s/sqrt(Hz)]
BLIND_GYRO_SHARE: Final = 0.6  # [sqrt(s)] and this part of the rate held: what shakes turns back
BLIND_ACCEL: Final = 1.0  # [m/s^2/sqrt(Hz)]
# In gaps no longer than that, what the steps around them show, with these as the least spread
# [rad/s, m/s^2]. Derived: hands tremble by these within 0.1 s; with the densities above, a gap of
# 55 ms made a velocity uncertain by 0.2 m/s that was known to 0.03
BLIND_SHORT_S: Final = 0.1
BLIND_SHORT_SPREAD: Final = (0.2, 0.5)
BLIND_STEPS: Final = 2  # without a gap, at least
ZERO_VELOCITY: Final = 0.003  # [m/s] noise of a zero-velocity update. Tuned on: captures
# Zero-velocity prior: a velocity less certain than PRIOR_FROM_SIGMA, and where the carrier drives
# less certain than its peak speed, gets a pseudo-measurement of zero once a second. Derived:
# walking and driving speeds are a few meters a second. Tuned on: corridors at 1.25 m/s, and
# cameras moved by hand at up to 0.6 m/s.
DRIVING_SPEED: Final = 0.8  # [m/s] a carrier that has been faster drives
PRIOR_FROM_SIGMA: Final = 0.2  # [m/s]
PRIOR_SPEED: Final = 1.0  # [m/s] sigma of the pseudo-measurement
PRIOR_LEARN_SIGMA: Final = 0.1  # [m/s] of velocities that show the peak speed
PRIOR_LEARN_SIGMAS: Final = 2.0  # less certain ones count with so many sigmas subtracted
PRIOR_MEMORY_S: Final = 60.0  # [s] time constant of its decay
# A carrier that was never as fast as DRIVING_SPEED is moved by hand. Tuned on: narrow views and
# corridors, seeds 100 to 115
HAND_FROM_SIGMA: Final = 0.1  # [m/s] a velocity less certain than this is drawn to zero
HAND_SPEED: Final = 0.3  # [m/s] least sigma of that; the peak speed if it is more
# The same for the vertical velocity where sweeps hardly ever fix the height. Derived: the height
# of what walks or drives wanders by half a meter in a minute. Tuned on: bare trunks.
RISE_FROM_SIGMA: Final = 0.02  # [m/s] least sigma, as the IMU may know better
RISE_SPEED: Final = 0.07  # [m/s] sigma of the pseudo-measurement
# [m/s] to which it is known at best. Derived: a slope of a tenth at a walk, and slopes last;
# drones rise and sink by 0.17. Tuned on: bare trunks, seeds 0 to 7; with 0.1, 6 to 27 % of the
# velocities of a drone were outside the bound that 5 % should exceed
RISE_FLOOR: Final = 0.14
HEIGHT_MEMORY_S: Final = 20.0  # [s] of which the height is fixed for less than the share below
HEIGHT_SHARE: Final = 0.1  # where a floor or a crown is in view now and then it is 0.15 and more
SPEED_BOUND_SHARE: Final = 0.02  # of max_speed: its noise as a measurement. Derived: a hard bound
MAP_ORIGIN_SIGMA: Final = 1e-3  # [m, rad] of the pose with which a new map begins
# After a time jump. Derived: the sensor may have been moved by hand meanwhile.
TIME_JUMP_ROTATION: Final = 0.1  # [rad]
TIME_JUMP_POSITION: Final = 0.5  # [m]
TIME_JUMP_VELOCITY: Final = 1.0  # [m/s]
STEADY_RATE_SIGMA: Final = 0.5  # [rad/s] of the assumption that the rate stays, without a gyro
LONG_GAP_NS: Final = 1_000_000_000  # [ns] of silence after which an old velocity says nothing

# ---- static detection

# Readings of units at rest were published from 0.03 to 0.35 rad/s of noise, lines included.
STATIC_BLOCK_S: Final = 0.1  # [s] long enough to show a sudden start
# Samples of a block, at least: of so many, white noise shows twice its spread once in 1e5 blocks;
# of 5 (50 Hz), once in 2000
STATIC_BLOCK_LEAST: Final = 10
STATIC_SIGMAS: Final = 5.0  # of a mean's noise; a false alarm in 1e6 blocks
STATIC_LEARN_S: Final = 0.4  # [s] needed to learn a reference
STATIC_RATE_FLOOR: Final = 0.005  # [rad/s] no change, however quiet the unit
STATIC_FORCE_FLOOR: Final = 0.03  # [m/s^2]
STATIC_RATE_SPREAD: Final = 0.5  # [rad/s] stronger shaking is not rest
# [m/s^2] of means over STATIC_SMOOTHED_S. Motors shake above 25 Hz, which these hardly show;
# carriers move below. Units of the hard runs: 0.16 at rest, 0.26 to 2.6 in motion
STATIC_FORCE_SPREAD: Final = 1.2
STATIC_SMOOTHED_S: Final = 0.04  # [s]
STATIC_VIBRATION: Final = 2.5  # [m/s^2] of single samples; beyond it slow motion does not show
STATIC_ENTRY_SIGMAS: Final = 3.0  # to enter rest; missing one costs little, a wrong one teaches
STATIC_BLEND: Final = 0.1  # share of each newer second in the reference
START_SAMPLES: Final = 20
START_RATE: Final = 0.12  # [rad/s] a larger mean is not a bias
START_RATE_CHANGE: Final = 0.12  # [rad/s] between means over a sixth of the samples
START_FORCE_CHANGE: Final = 0.25  # [m/s^2]
GRAVITY_AT_REST: Final = (8.8, 10.8)  # [m/s^2] sound units; the known fault reads 16 to 21
GRAVITY_IN_MOTION: Final = (7.5, 12.5)  # [m/s^2] mean of |a| over a second of walking

# ---- initialization


class InitialSigmas(NamedTuple):
    """How well the first state is known, 1 sigma."""

    velocity: float  # [m/s]
    gyro_bias: float  # [rad/s]
    accel_bias: float  # [m/s^2]
    gravity: tuple[float, float, float]  # [m/s^2] x, y, z of the map


START_POSE_SIGMA: Final = 1e-4  # [m, rad] the first pose defines the map frame
CARRIER_SPEED_SIGMA: Final = 1.0  # [m/s] of a carrier of which nothing is known
INITIAL_AT_REST: Final = InitialSigmas(0.02, 0.01, 0.02, (0.01, 0.01, 0.01))
# Gyro bias: a third of the zero-rate levels of data sheets (MOST_GYRO_BIAS) on average
INITIAL_IN_MOTION: Final = InitialSigmas(CARRIER_SPEED_SIGMA, 0.025, 0.15, (0.7, 0.7, 0.05))
GRAVITY_SIZE_SIGMA: Final = 0.01  # [m/s^2] of its size, which is known to 0.1 %
ACCEL_BIAS_SIGMA: Final = 0.15  # [m/s^2] of units; source: IMUs of this class

# ---- motion of a sweep without odometry (deskew)

TRACKER_MEMORY_S: Final = 25.0  # [s] longer than the longest sweep
TRACKER_STEP_NS: Final = 100_000_000  # [ns] of the static detector
TRACKER_IDLE_NS: Final = 5_000_000_000  # [ns] between updates while an odometry knows the motion
TRACKER_WINDOW: Final = 10  # steps a static decision spans
TRACKER_TURN: Final = 3  # steps of a turn of the head, over which its vibration averages out
TRACKER_LAG_NS: Final = 500_000_000  # [ns] the filter waits for late velocities
TRACKER_LAG_MAX_NS: Final = 2_000_000_000  # [ns] and at most, for a source that is later
TRACKER_BREAK_NS: Final = 500_000_000  # [ns] a gap after which the vertical is unknown
TRACKER_STILL_NS: Final = 500_000_000  # [ns] static is judged over two turns of the head at least
TRACKER_GAP_NS: Final = 50_000_000  # [ns] a longer stretch without samples is bridged
TRACKER_START_NS: Final = 100_000_000  # [ns] of samples before the first attitude
TRACKER_GYRO_NOISE: Final = 0.1  # [rad/s] per sample at least, lines of the head included
TRACKER_ACCEL_NOISE: Final = 0.15  # [m/s^2]
TRACKER_GYRO_WALK: Final = 1e-4  # [rad/s/sqrt(s)] tuned on: room walk
TRACKER_ACCEL_WALK: Final = 1e-3  # [m/s^2/sqrt(s)]
TWIST_SIGMA: Final = 0.01  # [m/s] of a velocity that comes without a covariance
TWIST_SIGMA_LEAST: Final = 0.005  # [m/s] a smaller one is not believed
TWIST_AHEAD_NS: Final = 1_000_000_000  # [ns] before the newest IMU sample; more is another clock
TWIST_STEP_NS: Final = 10_000_000  # [ns] faster sources are thinned to this
TWIST_NIS: Final = 50.0  # of 3 components; beyond it the velocity of the filter is dropped
TWIST_STILL_SPEED: Final = 0.1  # [m/s] at a higher one the IMU cannot claim rest
MAX_SPEED: Final = 1000.0  # [m/s] a faster velocity is refused
# Derived: half a turn (0.115 s) away that is 12 mm, as much as the range noise
DESKEW_SPEED_SIGMA: Final = 0.1  # [m/s] a velocity known worse than that is not trusted
TRUSTED_ACCELERATION: Final = 0.6  # [m/s^2] largest uncertainty with which forces are integrated

# ---- odometry: prediction

# The gyro's noise is measured at rest, and by the spectrum of samples in motion, which shows its
# white part but not the lines of the head. Source: units from 0.03 to 0.35 rad/s, most of it
# lines; with 0.3 rad/s of them that were not known, a crowded hall ended 220 m off.
GYRO_REST_SAMPLES: Final = 100  # needed
GYRO_REST_MEMORY: Final = 1000  # that count, 4 s
LEAST_GYRO_NOISE: Final = 0.01  # [rad/s]
# Derived: errors of scale and axes of 0.6 %, in turns of a second; source: calibrations of units
GYRO_SHARE: Final = 0.006  # [sqrt(s)] of the angular velocity
GYRO_NOISE_FACTOR: Final = 1.7  # on the white part. Tuned on: narrow views, seeds 8 to 15
# [sqrt(s)] of the acceleration, likewise. Tuned on: narrow views, seeds 100 to 109; with 0.01,
# three of six cameras on stairs ended 0.3 to 3 m off
ACCEL_SHARE: Final = 0.004
NOISE_WINDOW_NS: Final = 1_000_000_000  # [ns] of samples whose spectrum shows the noise
NOISE_LEAST_SAMPLES: Final = 64  # Derived: lines of 4 bins each leave the median alone
# Derived: hands tremble at 8 to 12 Hz, legs step below; motors and frames vibrate above
NOISE_FROM_HZ: Final = 15.0

RATE_SMOOTHING_NS: Final = 20_000_000  # [ns] either side, over which the reported rate is averaged
# [s] of the stamps of samples against those of points. Derived: a sample is a mean over 4 ms, and
# its stamp is somewhere in there
IMU_STAMP_SIGMA: Final = 0.0012
ODOMETRY_MEMORY_S: Final = 12.0  # [s] of IMU samples; more than a held-up node has waiting

# ---- odometry: alignment

FIRST_REACH_M: Final = 0.5  # [m] farthest point from its plane in the first step; halved each step
LAST_REACH_SCALES: Final = 3.0  # outlier scales, down to which it shrinks
INLIER_SCALES: Final = 2.0  # of the robust kernel, within which a point fits a surface
SCATTER_SHARED: Final = 3.0  # points in a cell that is not flat err together. Tuned on: foliage
# A smaller step is the last. At 2e-4 it takes a third more steps, and no ATE is better.
CONVERGED: Final = 5e-4  # [rad, m]
# Without an IMU it is the velocity that has to settle. Tuned on: bushes, poles
CONVERGED_TWIST: Final = 5e-3  # [m/s, rad/s]
DEGENERATE_SHARE: Final = 0.01  # of the points; with fewer a direction is hardly observed
# [s] from one sweep to the next of an L2: in a map that began with an open velocity, ages count in
# such sweeps. Counted in its own, the rims of a spinning lidar had half the time, and two drives
# ended 37 and 125 m off; counted so in all maps, cameras that began at rest were 1.5 times as far
# off. And the bounds of that time, and the share of each newer step in its mean
SWEEP_S: Final = 0.23
SWEEP_LEAST_S: Final = 0.01
SWEEP_MOST_S: Final = 0.5
SWEEP_BLEND: Final = 0.05
# Weak directions. Tuned on: camera in the room, corridor with a view of 80 degrees, rosette lidar
WEAK_SHARE: Final = 0.12  # of the strongest; below it rims and noise of normals may prevail
WEAK_FACING: Final = 0.35  # cosine: normals of walls are up to 20 degrees off in the finest cells
# Points on surfaces that face a direction of the place: with no more than so many, the whole sweep
# tells nothing about it. Tuned on: narrow views, seeds 100 to 115; 8 do as well, 0 worse
FREE_FACING: Final = 4
WEAK_HEIGHT: Final = 0.7  # cosine to the vertical of what counts as the height: 45 degrees
FREE_LEFT: Final = 0.5  # length that is left of a weak direction beside the free ones
WEAK_AGE: Final = 8  # sweeps since a surface was opened: until then it is a rim of the view
# A point also lies on another surface if so many points near it have one that faces elsewhere, and
# it is less than twice the range noise away from that. Tuned on: cameras looking into rooms, cones
# and corridors, seeds 0 to 6
AMBIGUOUS_LEAST: Final = 2
# [s] since its surface was opened. Without, 2 of 20 starts in motion ran away
AMBIGUOUS_AGE_S: Final = 3.0
AMBIGUOUS_MOST: Final = 100  # points compared; with more, the few false ones do not matter
AMBIGUOUS_NEAR: Final = 0.5  # [m]
AMBIGUOUS_THICKNESS: Final = 0.03  # [m]
AMBIGUOUS_FACING: Final = 0.5  # cosine
WEAK_STEP: Final = 0.04  # [m] the sweep is moved; below outlier_scale, above the noise
WEAK_SIGMAS: Final = 1.0  # by which the share that is real is taken smaller
WEAK_STEPS: Final = 2  # iterations with the weak directions known
WEAK_LEAST_ARM: Final = 0.3  # [m] however near the points are
# The same where the carrier drives along them. Tuned on: seeds 0 to 5 of the hard corridors. Most
# cells there that seem to face along the corridor and do not have fewer than 20 points of 2 to 5
# sweeps, and normals 20 to 45 degrees off at a scatter of 3 to 15 mm. With the scatter below they
# are 2 to 5 sigma from the wall's normal, reveals of doors more than 15.
DRIVING_WAY: Final = 0.9  # of a direction's unit is place, not turn
DRIVING_SLOPE: Final = 0.5  # sine of it against the horizontal
DRIVING_AGE: Final = 3  # as WEAK_AGE
DRIVING_POINTS: Final = 1600  # of a sweep; with fewer, it is thinned by
DRIVING_VOXEL: Final = 0.5  # of source_voxel
FACING_VOXEL: Final = 0.25  # of source_voxel: what faces the direction
FACING_SIGMAS: Final = 5.0  # of the error of its normal, by which a surface faces a direction
# [m] of a surface that faces the way, 1 sigma. Derived: 2.5 times the range noise; what is called
# a reveal and is none has 0.02 to 0.033, niches 0.03 to 0.085
FACING_WIDTH: Final = 0.03
# Sweeps that have seen it, at least. Judged on: 10 corridors with 12 people, whose ends fell to a
# third; 14 with 8 people and 120 degrees, a quarter larger; 12 without people stayed the same
FACING_SWEEPS: Final = 4
# [m] How often surfaces that face the way are real, for a density of false ones: with fewer
# points than below, or with as many. Tuned on: narrow corridors, seeds 100 to 115: 5 to
# 20 points had 0.12 of the sweeps with a right velocity, 0.05 of those with a wrong one
FACING_TRUE: Final = 0.3
FACING_TRUE_MANY: Final = 1.7
FACING_MANY: Final = 20
NORMAL_SCATTER: Final = 0.015  # [m] of points about their plane, at least: few happen to lie flat
NORMAL_LEAST_EXTENT: Final = 0.001  # [m] Derived: keeps a division finite
NORMAL_KNOWN: Final = 0.02  # [rad] from here on, a normal's error lowers its weight
# [rad] by which the walls may be turned against those along which the place has become uncertain.
# Tuned on: narrow corridors, seeds 100 to 127. Without it, 2 mm across were taken for 0.4 m along,
# and the velocity changed by 0.05 m/s in a sweep that told nothing about it
WAY_TURN: Final = 0.02
# [rad] the same for a carrier that does not drive, whose loosest direction each sweep sees anew.
# Observed: it differs by 0.02 to 0.1 from sweep to sweep. Tuned on: cameras and spinning lidars
# that begin in motion, seeds 0 to 9; without it, a velocity 0.5 m/s off was known to 0.1
LOOSE_AXIS_TURN: Final = 0.1
WALL_ROUNDS: Final = 2  # in which what faces the direction is left out
WALL_LEAST: Final = 0.2  # share of the points that must be left
WALL_BLEND: Final = 0.95  # share of the scatter that is left at each sweep: 4 s
WALL_BEND: Final = 0.2  # [rad] between the sweep's direction and the steady one: a corner
WALL_FLAT: Final = 0.1  # of the scatter's second eigenvalue: below it the first is a direction
# Range noise of two captures of a real unit, along lines of smooth surface: 10-13 mm to 10 m,
# 17 mm to 15 m, 24-30 mm to 25 m. A floor of 10 mm and a part linear in range fit that within
# 2 mm. The floor is part of the parameter point_noise, whose size hides the rest: half or double
# the slope changes no ATE by more than its spread
# (tests/l2lidar_proc/odometry/registration/test_alignment.py).
RANGE_NOISE_SLOPE: Final = 0.0011  # [m/m]
RANGE_NOISE_FACTOR: Final = 2.0  # on the standard deviation: neighbors err together

# ---- odometry: velocity along walls

WALL_POINTS: Final = 15_000  # of a sweep. Bounds the time; a turn of an L2 has fewer

# ---- odometry: vertical lines. Tuned on: seeds 0 to 7 of the hard corridors, where 4 to 9 sweeps
# see a reveal of a door, and each gives its place along the corridor to 2 or 3 mm.

LINE_SLOPE: Final = 0.3  # sine of the direction against the horizontal
LINE_RANGE: Final = 8.0  # [m] farther away they are few, and false ones prevail
LINE_WALL_SLOPE: Final = 0.2  # cosine: surfaces along the direction are walls
LINE_WALL_REACH: Final = 0.02  # [m] points nearer to a wall belong to it
LINE_WALL_THICKNESS: Final = 0.015  # [m] a thicker surface may be a wall and a reveal in one
LINE_RADIUS: Final = 0.03  # [m] in plan, 2.5 times the range noise
LINE_ROUNDS: Final = 3  # of mean shift
LINE_MOST: Final = 60  # of a sweep. Bounds the time
LINE_POINTS: Final = 12  # of a line, at least
LINE_HEIGHT: Final = 0.25  # [m] standard deviation of the heights, at least
LINE_SPREAD: Final = 0.0135  # [m] standard deviation along the direction, at most
LINE_NOISE: Final = (0.008, 0.004)  # [m] of one point at least, and common to all of a line
LINE_KEPT_NS: Final = 6_000_000_000  # [ns] in which a door is passed
LINE_KEPT: Final = 1000  # lines at most. Bounds memory and time
LINE_PAIRS: Final = 1000  # of lines at most, likewise: a matrix has as many rows and columns
LINE_PAUSE_S: Final = 0.1  # [s] between two sweeps, at least
LINE_DEEPEST: Final = 0.15  # [m] across, between two lines of one reveal
LINE_REACH: Final = 0.3  # [m] along, between two of one reveal: two reveals are farther apart
LINE_SIGMAS: Final = 3.0  # of that distance, as the velocity may err, at most
LINE_BETWEEN: Final = 0.008  # [m] 1 sigma of that distance with the right velocity
LINE_FIT_NOISE: Final = 0.003  # [m] added to the noise of that distance, 1 sigma
LINE_WANDER: Final = 0.01  # [m/s^2/sqrt(Hz)] by which the error of the velocity changes meanwhile
LINE_FACE: Final = 0.02  # [m] along: lines of a sweep that are nearer are one face
LINE_OUTLIER: Final = 2.5  # sigma by which a pair may disagree
# Votes needed: where the velocity may have moved the lines by less than the length below, or more.
LINE_VOTES: Final = 0.8
LINE_VOTES_UNSURE: Final = 1.5
LINE_UNSURE: Final = 0.025  # [m] 1 sigma
LINE_CHANCE: Final = 2.0  # times the votes that chance gives, besides
LINE_RIVAL: Final = 0.6  # of the votes, that no other velocity may have
# [m/s] How often the velocity with most votes is right, for a density of false ones: with two
# votes, and by how much more often with each further one. Tuned on: narrow corridors, seeds 100
# to 115, where 7 of 71 with less than two votes were false, 1 of 445 with more
LINE_TRUE: Final = 4.0
LINE_TRUE_VOTE: Final = 10.0
LINE_SURE: Final = 20.0  # votes from which on more of them add nothing. Bounds the power
LINE_RELIEF: Final = 0.015  # [m] across, by which the lines of a reveal differ at least

# ---- odometry: wall profile. Tuned on: hard corridors, seeds 100 to 115, at first with the true
# poses; the rest in the corridor of tests/l2lidar_proc/odometry/walls/test_wall_profile.py.

PROFILE_RANGE: Final = 10.0  # [m] farther away, lines on a wall are meters apart
PROFILE_CELL: Final = 0.03  # [m] length of a spot along the way, 2.5 times the range noise
PROFILE_ROW: Final = 0.3  # [m] height of a spot: four points of an L2 at 6 m
PROFILE_POINTS: Final = 3  # of a spot, at least
PROFILE_FLAT: Final = 0.03  # [m] standard deviation across, at most: 2.5 times the range noise
PROFILE_UPRIGHT: Final = 1.5  # times as high as wide, at least: a floor is not
PROFILE_BESIDE: Final = 0.3  # [m] beside the sensor, at least
PROFILE_SPOTS: Final = 300  # of a sweep at most; an L2 has 130 to 250. Bounds memory and time
PROFILE_MOST: Final = 10_000  # spots compared, at most. Bounds the time
PROFILE_KEPT_NS: Final = 4_000_000_000  # [ns] in which a door is passed
PROFILE_PAUSE_NS: Final = 900_000_000  # [ns] between comparisons, four sweeps
PROFILE_SPAN_NS: Final = 1_500_000_000  # [ns] over which spots are spread, at least
PROFILE_SIDE: Final = 100  # spots of a wall, at least
# [m] Scatter of a wall's depth at most: of walls of corridors it is 0.01, of what stands in a
# hall 0.05 to 5. And [m], sigma, and share of spots that may stand before a wall
PROFILE_SCATTER: Final = 0.03
PROFILE_BEFORE: Final = (0.1, 3.0, 0.05)
# [m] What stands farther before a wall is none of it: people walk along with the sensor, and spots
# that are part wall and part of them lie 0.03 to 0.1 m before it. Derived: 2.5 times the range
# noise. Judged on: corridors with 8 to 12 people, seeds 0 to 7
PROFILE_PROUD: Final = 0.03
# [m] What is farther behind a wall is seen through an opening, at another place along the wall
# than that is. Observed: a doorway looked through at rest showed 2 m/s; niches are less deep
PROFILE_BEHIND: Final = 0.6
# Terms of the likelihood that say the same: seven rows of a wall see an edge together, and each
# edge counts with all pairs of neighbors. With this number the errors of the velocity are as
# large as the likelihood says (their NEES is 0.2 to 1.5).
PROFILE_DEPENDENT: Final = 20.0
PROFILE_NOISE: Final = 0.01  # [m/s] 1 sigma, common to all spots: what niches hide, for one
PROFILE_SURE: Final = 0.03  # [m/s] 1 sigma: below, that would count
PROFILE_SIGMAS: Final = 4.0  # of the velocity: how far errors of it are tried
PROFILE_REACH: Final = 1.5  # [m/s] largest error of the velocity that is tried
PROFILE_STEP: Final = 0.01  # [m/s] between errors: 4 cm in the time that spots are kept
PROFILE_STEPS: Final = 15  # errors to each side, at least
# Standard deviations, common to a spot and of one of its points (12 mm: range noise), and of an
# edge: of the logarithm of the intensity; and of the depth [m], where errors of the beams add
# some per meter
PROFILE_BRIGHTNESS: Final = (0.03, 0.05, 0.25)
PROFILE_DEPTH: Final = (0.01, 0.005, 0.012, 0.3)
# Bare walls along the way, with people before them or not: a share of the spots beside the way
# within a thickness of a wall, and hardly any surface across
WALLS_LEAST: Final = 30  # spots on a side
WALLS_THICKNESS: Final = 0.15  # [m] niches are less deep
WALLS_MOST: Final = 0.6
WALLS_FACING: Final = 0.8  # cosine of a surface across
WALLS_ACROSS: Final = 0.1  # share of the upright area, at most
PROFILE_RATE: Final = 0.3  # [1/m] edges of a wall
PROFILE_EDGE: Final = 0.1  # [m] width of an edge: without, reveals seem to repel each other
PROFILE_ROUNDS: Final = 6  # of weighting
PROFILE_CAUCHY: Final = 2.0  # [1] times the scatter: weight one half

# ---- odometry: map of surfaces

ELONGATED: Final = 9.0  # variance ratio: a surface is at least 3 times wider than it is thick
FLAT_WIDTH: Final = 0.08  # of its cell (1 sigma) in its shorter direction
NARROW: Final = 0.16  # of the cell's edge: largest scatter that fixes a place; evenly filled: 0.29
NARROW_SWEEPS: Final = 4  # that must have seen it: one scan line on a wall is narrow as well
# Extent of a flat surface on either side of its middle: so many standard deviations of its points,
# and so much more [m]. Derived: twice the half width of evenly spread points, and 1.5 times the
# range noise. Observed: points on the front of a wall, taken for the jamb beside it, were 4 to 7
# standard deviations away
EXTENT: Final = (3.5, 0.02)
# Share of a surface's weight that both neighbors across it have where something larger continues.
# Tuned on: cameras looking into rooms and cones, seeds 0 to 7, where 0.2 does as well
CONTINUED: Final = 0.5
# Sine of the angle by which a surface may be seen from behind: the normals of small ones are off
SIDE_SLACK: Final = 0.1
# A point at this range has half the weight in the map of one at hand: there, the error of a range
# of 10 mm and that of an attitude of 5 mrad are equal. Tuned on: narrow views, seeds 100 to 115,
# where 1 to 4 m do equally well
WEIGHT_RANGE: Final = 2.0  # [m]
EDGE_SHARE: Final = 0.4  # of the points that may lack a flat surface where flat ones abound
REFIT_GROWTH: Final = 1.2  # growth of the weight before a cell is fitted again. Speed only

# ---- odometry: uncertainty of the map

DRIFT_GROUP: Final = 4  # sweeps that share an entry, of 288 bytes
DRIFT_ENTRIES: Final = 8192  # at most: after two hours twice as many share one, and so on
# Share left a sweep later of what the uncertainty was larger. Tuned on: camera looking into rooms,
# 0.5 m -> 0.03 -> 0.17 in three sweeps, 0.37 m off
DRIFT_FALL: Final = 0.6
# A cell is as old as the coarsest one around it, unless the pose that opens it is so uncertain and
# by so much more than the one that opened that. Derived: as LOOSE_POSITION, a surface off
APART_LEAST: Final = 0.06  # [m] 1 sigma of the place
APART_SHARE: Final = 0.5  # of that
DRIFT_MOST_FRESH: Final = 0.9  # share of a sweep that counts as new map at most
# Of a unit whose block of calibration is not quite its own. Derived: captures of a real one show
# beam angles 0.4 degrees off; with that, ranges 0.2 % off and an IMU turned by 0.5 degrees the
# hard runs drift by 0.2 to 0.9 % of the distance from the start and turn by 0.1 to 0.7 degrees; of
# three units in woods, two were off by more than 3 sigma with 0.4 % and 0.3 degrees.
UNIT_SHARE: Final = 0.006  # of the distance from the map's origin, each axis
UNIT_WAY_SHARE: Final = 0.002  # of the way, around and back. Tuned on: as MAP_WAY, 0.19 of 80 m
UNIT_TURN: Final = 0.0075  # [rad] each axis
UNIT_SHIFT: Final = 0.005  # [m] each axis
UNIT_FROM_M: Final = 0.3  # [m] from the start at which these hold
# What is reported for a unit whose beam angles are estimated. Source of the scale: captures, as
# above. Tuned on: poses of the hard runs, seeds 0 to 6 and 253 to 256, so that 85 % of those of
# each scene at least are within their 95 % bound; and on a yard that a typical unit sees in half
# turns, which show little of it: with 0.12, 0.3, 0.015 and 0.03 for BEAM_TURN, ALPHA_TURN,
# BEAM_SWING and RANGE_BIAS_TURN, 69 % of its poses are within theirs
RANGE_SCALE: Final = 0.002  # error of ranges that nothing shows, 1 sigma
BEAM_TURN: Final = 0.15  # about each axis at once, by error of the better known beam angle
# about each level axis at once, by error of alpha. In one office, 0.3 degrees turned poses by
# 0.24, root mean square; what is left of it once it is known turns them by less
ALPHA_TURN: Final = 0.4
BEAM_SWING: Final = 0.02  # [1/m] about the vertical, by error of the other one and by the way
MAP_TURN: Final = 0.00017  # [rad] each axis, however good the unit
MAP_TURN_BEND: Final = 0.00005  # [rad/sqrt(m)] of the way
MAP_SHIFT: Final = 0.0012  # [m] each axis
MAP_SHARE: Final = 0.0003  # of the way, each axis
# Of other sensors, whose makers have calibrated them, as if these were their beam angles. Tuned
# on: a spinning lidar, seeds 0 to 7, whose first pose is turned against the map by 2 mrad, which
# is BEAM_TURN times the first
OTHER_BEAM_SIGMAS: Final = (0.0133, 0.0018)  # [rad]
# [m, rad] of the first pose of a map begun in motion, beyond its covariance. Tuned on: walks,
# seeds 0 to 7, which err by 17 mm and 4 mrad on each axis
BEGUN_IN_MOTION: Final = (0.015, 0.004)
# Turn of that pose for the uncertainty of the first velocity [rad s/m], and the largest of these
# uncertainties that counts [m/s]: beyond, a search tells more. Derived: a sweep of 0.23 s that is
# deskewed with a wrong velocity, and things 2 m away. Judged on: starts, seeds 1000 to 1039, of
# whose poses 87 % were within their bound, and now 94 %
BEGUN_TURN: Final = (0.115, 0.2)
# The map bends where it grows, so the vertical where it began is not quite that of its other end.
# Tuned on: narrow corridors, seeds 100 to 127, where 0.01 m/s^2 (0.06 degrees) makes 1 to 5 m.
# With 0.0008, the acceleration along them erred by 0.3 to 0.5 sigma where nothing was false
MAP_BEND: Final = 0.0005  # [rad/sqrt(m)] of the way
# Gravity is known, as a direction, when it is known as well as at rest, where it cannot be told
# from a bias (ACCEL_BIAS_SIGMA, 0.9 degrees); as much of what it turns later may be that bias.
LEAN_KNOWN: Final = 0.02  # [rad]
LEAN_FROM: Final = 0.015  # [rad]

# ---- odometry: beam angles. Tuned on: imperfect rooms, halls and woods, seeds 0 to 2

BEAM_SIGMA: Final = 0.009  # [rad] of units; source: captures of a real one, 0.4 degrees
# [rad] of alpha, 0.23 degrees; source: 0.27 between two captures of a real one. With BEAM_SIGMA,
# the cells of a wood were too far away to tell which things were the same
ALPHA_SIGMA: Final = 0.004
BEAM_POINTS: Final = 200  # of a cloud that show the turning of the head
BEAM_CELL: Final = 0.5  # [m] edge of the cells in which halves are compared
BEAM_CELL_POINTS: Final = 12  # of either half in a cell
BEAM_CELLS: Final = 5  # flat ones of a sweep, at least
BEAM_THICKNESS: Final = 0.03  # [m] of a flat cell, each half by itself
BEAM_WIDTH: Final = 0.15  # of the cell's edge (1 sigma) in its shorter direction
BEAM_GAP_SIGMA: Final = 0.02  # [m] of the gap in one cell; 12 mm of range noise hardly count
BEAM_GAP_SCALE: Final = 0.04  # [m] off, a gap keeps a quarter of its weight
BEAM_GAP_MOST: Final = 0.2  # [m] farther apart, they are two surfaces
# Sweeps at rest are compared together. Tuned on: the first 2 s of trunks, woods, rooms, halls and
# corridors, seeds 0 to 7 and 34 to 41: both angles err by 0.2 to 1.2 sigma, root mean square
BEAM_REST_POINTS: Final = 8  # of either half in a cell
BEAM_REST_LINES: Final = 4  # scan lines of either half in a cell, if they are
BEAM_REST_APART: Final = 0.008  # [rad] apart; a head in step with its packets repeats its lines
# of a cell's edge: scatter (1 sigma) of what does not end in the cell. Evenly filled, it is 0.29
BEAM_REST_WIDTH: Final = 0.15
BEAM_REST_SCATTER: Final = 2.0  # a mean's variance, by the points' over the number of lines
BEAM_REST_UNKNOWN: Final = 0.1  # [m] of a gap as the angles are known, 1 sigma, to be compared
BEAM_REST_NS: Final = 1_200_000_000  # [ns] of rest before its sweeps are compared
BEAM_REST_AGAIN: Final = 1.4  # times as long until they are compared again. Speed only
# Sweeps at rest deviate by so many standard deviations of the angle that is known less. Source:
# trunks and woods, where 0.57 degrees turned them by 0.35 to 0.66 degrees; 12 mm allow for noise
BEAM_DRIFT_TURN: Final = 1.3
BEAM_DRIFT_SHIFT: Final = 1.3  # [m/rad]
# By which the motion that deskewed a sweep may be off. With 0.05 m/s, a constant error of 0.1 m/s
# passed for 0.3 degrees of a unit that was right.
BEAM_SPEED: Final = 0.2  # [m/s]
BEAM_RATE: Final = 0.08  # [rad/s]
# 0.02 degrees; source: calibrations of one unit from part to part
BEAM_FLOOR: Final = 3.5e-4  # [rad]
# [rad] 0.26 degrees: less certain, a direction is not corrected, nor if it may as well be zero.
# The estimates are better than they claim: both angles together, in eight narrow corridors, by
# 0.02 to 0.22 degrees after 5 s, where they claim 0.18 to 0.25. With 0.1 degrees and 3 sigma it
# took a minute until they were corrected, and the corridor had bent by 2.4 degrees
BEAM_KNOWN: Final = 0.0045
BEAM_SIGMAS: Final = 1.5
BEAM_MOST: Final = 0.0175  # [rad] 1 degree, where `l2lidar calibrate` refuses as well
# The first sweeps teach the angles, more of them where these are not well known yet, then a few.
BEAM_OFTEN: Final = (20, 250)  # Speed only, as both below
BEAM_SURE: Final = 0.0009  # [rad] along the best known direction
BEAM_SELDOM: Final = 16  # each so many'th
BEAM_CHANGE: Final = 0.0009  # [rad] after which a map at rest is begun again: 5 mm at 5 m

# ---- odometry: range bias. Tuned on: room, corridor, hall and flat of one unit, 34 mm off

# [m] of units; source: the population of the virtual L2, and 15 mm of a published recording
RANGE_BIAS_SIGMA: Final = 0.02
RANGE_BIAS_MOST: Final = 0.08  # [m] of any unit: four sigma
RANGE_BIAS_NEAREST: Final = 1.5  # [m] nearer, ranges are not linear
RANGE_BIAS_CELLS: Final = 8  # of a plane, at least
RANGE_BIAS_SEEDS: Final = 12  # cells of a sweep from which planes grow, at most. Speed only
RANGE_BIAS_FACING: Final = 0.985  # cosine of the angle between a cell and its plane, 10 degrees
RANGE_BIAS_BEND_MOST: Final = 0.12  # [m] from the plane: six sigma of the bias
# [m] of a cell's mean; 12 mm of range noise hardly count. What hangs on a wall does
RANGE_BIAS_CELL_SIGMA: Final = 0.012
# Of the ground, which faces up within 45 degrees: [m] by what half of the cells lie beside it at
# most. Of floors it is up to 3 mm; of lawns and forest ground 14 to 20, which seem 0.1 m of bias.
# Tuned on: drones above woods
RANGE_BIAS_GROUND: Final = 0.7
RANGE_BIAS_ROUGH: Final = 0.005
# [1/m] of the ground, at most. Floors show 0.1 to 0.3 mm/m^2; a road that falls by 2 mm/m^2 to its
# sides seems a bias of 30 mm
RANGE_BIAS_CURVATURE: Final = 7e-4
RANGE_BIAS_CURVED_F: Final = 5.0  # F of these three unknowns; 1 of 300 flat floors has more
RANGE_BIAS_SCALE: Final = 0.02  # [m] off, a cell keeps a quarter of its weight
RANGE_BIAS_STEPS: Final = 4  # of either fit
# [m] however long a place is looked at: skirting boards and furniture bend walls in the same way
RANGE_BIAS_FLOOR: Final = 0.003
RANGE_BIAS_KNOWN: Final = 0.01  # [m] less certain, it is not corrected
# [m] more certain, it is corrected even if it may be zero. Tuned on: corridors of six drawn units,
# of which three are off by 4 mm, which bent the map by 3 mrad in 70 m
RANGE_BIAS_SURE: Final = 0.006
RANGE_BIAS_SWEEPS: Final = 12  # of a rest that are looked at. Speed only
# [m] after which a map at rest is begun again; a smaller one is not known, see RANGE_BIAS_FLOOR
RANGE_BIAS_CHANGE: Final = 0.003
# Of the map, where planes do not show it. Tuned on: woods, 14 units drawn and imperfect
RANGE_BIAS_MAP_POINTS: Final = 50  # of a sweep that meet surfaces, at least
RANGE_BIAS_MAP_SIGMA: Final = 0.02  # [m] of a point beside a surface, ground and bark included
RANGE_BIAS_MAP_PRIOR: Final = 0.1  # [m] wide: a single sweep shows little
# Of its information: points of one surface err alike, sweep after sweep
RANGE_BIAS_MAP_SHARE: Final = 0.1
RANGE_BIAS_MAP_SWEEPS: Final = 40  # within which sweeps are forgotten
RANGE_BIAS_MAP_FLOOR: Final = 0.004  # [m] however long
# [rad] 0.15 degrees of the best known beam angles: with wrong ones the map showed 50 mm
RANGE_BIAS_MAP_BEAMS: Final = 0.0026
RANGE_BIAS_MOVED: Final = 5e-4  # [m] smaller changes leave the map as it is. Speed only
RANGE_BIAS_STEP: Final = 0.003  # [m] by which the correction changes from sweep to sweep
# [rad/m] by which it lets the map lean, about each level axis; 0.02 to 0.2 in room, corridor,
# hall and wood. Tuned on: the hard runs, as BEAM_TURN
RANGE_BIAS_TURN: Final = 0.06
# Correlation of the place with the turn; 0.5 does as well. Tuned on: woods, four drawn units
BEND_CORRELATION: Final = 0.8

# ---- odometry: innovation consistency

NIS_WINDOW_NS: Final = 3_000_000_000  # [ns] over which innovations are judged
NIS_LEAST: Final = 5  # alignments, before that nothing is said
# Share of its variance that an alignment takes from a direction that it measures
NIS_SEEN: Final = 0.05
# 3 s of turns measure 60 and more components. Derived: their mean exceeds 2 in one of 1e5 windows
NIS_SUSPECT: Final = 2.0
NIS_CHANCE: Final = 3.8  # mean of 3 components that chance exceeds in one of 100 windows
NIS_SPEED_FLOOR: Final = 0.03  # [m/s] of corrections in a window that never count
# Of a single alignment, for each degree of freedom. Observed: at most 3.1 in the hard runs as
# long as poses are right; 8 to 59 where it met wrong surfaces, or the prediction was wrong
NIS_GATE: Final = 5.0
# From which on a prediction is doubted. Observed: 2.6 to 5 in the first sweep of a blow of 4 to 16
# m/s^2 that only the accelerometer felt, in a room; 0.1 without one
NIS_DOUBT: Final = 2.0
# A sweep that fits the map badly is also aligned as if the prediction might be wrong by so much
# [m, m/s], once in a while, and believed there if so many more of its points fit. Derived: blows
# of 3 to 12 m/s^2 for 0.2 s that only the accelerometer felt; maps that drifted by 0.1 to 0.5 m
DOUBT_POSITION_SIGMA: Final = 0.3
DOUBT_VELOCITY_SIGMA: Final = 1.0
DOUBT_BETTER: Final = 0.05  # share of the points
# or if almost as many points fit, with so much of the mean square distance, and less of it where
# they fix a place that was free. Observed in these blows: 0.2 to 0.63; chance alone: 0.99
DOUBT_AS_MANY: Final = 0.97
DOUBT_CLOSER: Final = ByPlace(fixed=0.75, free=0.5)  # by whether it was fixed before
# Outliers, by the usual ones and by a share, from which on a place that is free is doubted.
# Observed: 0.055 in a warehouse where end walls were 12 cm off, 0.003 to 0.02 before
DOUBT_OUTLIERS_FACTOR: Final = 2.0
DOUBT_OUTLIERS_SHARE: Final = 0.01
# Of the points that are at known surfaces, at least, where these fix the place, or do not
DOUBT_MATCHED: Final = ByPlace(fixed=0.5, free=0.9)
DOUBT_MANY: Final = 300  # points, where not. Tuned on: a cone, 134 at a wrong place
# [m/s] that the IMU leaves open after a sweep, 1 sigma, from which on the points are blurred.
# Observed: 0.01 to 0.11 in the hard runs, up to 0.18 in gaps; 0.23 and more where a blow spoils it
BLUR_SPEED: Final = 0.15
# Share of it that an aligned sweep leaves open as well. Observed with it, in walks covered after a
# blow (room, yard, warehouse, seeds 2 to 6): NEES of the place from 1 to 4, where 3 is right
BLUR_SHARE: Final = 0.5
DOUBT_PAUSE_NS: Final = 1_000_000_000  # [ns]
# Length of the points' mean direction, above which a view is narrow. Observed: 0.56 to 0.70 for an
# L2, 0.83 if its carrier leaves 120 degrees, 0.88 to 0.95 for cameras and cones. A cone whose gyro
# was not believed turned by 66 mrad at rest
NARROW_VIEW: Final = 0.77
NIS_MOST: Final = 25.0  # by which variances are raised at most, or lowered
# Variances are lowered to so many times what the window shows. Tuned on: velocities of the hard
# runs, seeds 0 to 3; from 1.25 to 1.5, 85 to 99 % of them are within their 95 % bound.
NIS_MARGIN: Final = 1.4
# The same for the velocity where some directions are not measured: lowered less. Tuned on: narrow
# views, corridors and trunks, seeds 0 to 4; with 4 or 7, velocities of 3 or 1 of these 11 scenes
# are outside 85 to 99 %
NIS_PARTLY_MOST: Final = 5.0
NIS_UNOBSERVED: Final = 0.1  # [rad] by which directions differ that are two
# To so many times, of poses that add to the drift of the map: their errors are not independent.
# Tuned on: poses of narrow views, seeds 0 to 7 and 50 to 57; with 1.4, 68 to 93 % of those of a
# scene are within their 95 % bound, with 3 it is 75 to 99 %
NIS_DRIFT_MARGIN: Final = 5.0
# Zero-rate and zero-g levels of MEMS sensors; source: data sheets of the ICM-20948 (0.09 rad/s,
# 0.5 m/s^2) and of the BMI160 (0.05 rad/s, 0.4 m/s^2). Twice these values cannot be a bias.
MOST_GYRO_BIAS: Final = 0.2  # [rad/s]
MOST_ACCEL_BIAS: Final = 1.0  # [m/s^2]

# ---- odometry: matching. Tuned on: loose predictions after gaps and blockages in all scenes

LOOSE_POSITION: Final = 0.06  # [m] a prediction less certain may be a surface off
LOOSE_ROTATION: Final = 0.03  # [rad] or turned too far
INLIER_RATIO: Final = ByPrediction(good=0.6, loose=0.92)  # needed
# Sizes of cells in which a point off the surface contradicts it. Through a door that opens, a room
# appears in coarse cells of what is known of its frame: no outlier in the two finest sizes at the
# right pose, 12 to 45 % in all (camera looking into rooms).
FINE_LEVELS: Final = 2
# After a loose prediction it may have so many times the usual number of recent outliers. Tuned on:
# wood in rain (inliers 0.85 to 0.90 at the right place, up to 0.72 at wrong ones), bare trunks
USUAL_OUTLIERS: Final = 2.5
USUAL_BLEND: Final = 0.1  # share of each newer sweep in what is usual
USUAL_LEAST: Final = 0.75  # inliers needed whatever is usual
# Share of the points that must meet the map
OVERLAP: Final = ByPrediction(good=0.0, loose=0.25)
# A pose farther from the predicted one than the robust kernel reaches needs so many points, as a
# few fit in many places (tuned on: camera on stairs, where 30 at the right place were refused for
# 6 s), and so many that fix the place along the way there. Tuned on: camera looking into rooms (4
# at wrong places, 11 to 19 at the right one)
FAR_MOVE: Final = 0.1  # [m]
FAR_TURN: Final = 0.03  # [rad]
FAR_MATCHED: Final = 50
FAR_POINTS: Final = 10.0
# It has to be the only one: no other with that share of its points, and inliers less by so little.
# Tuned on: camera looking into rooms (50 of 50 points at places half a meter apart)
FAR_UNIQUE: Final = (0.8, 0.02)
MEETING: Final = (0.25, 100)  # share of the points that must be near surfaces, and enough of them
YOUNG_SWEEPS: Final = 12  # in a map before a sweep without surfaces around is remarkable
# Turn, and sweeps, since the latest keyframe of KISS-ICP's map that make another. Derived: points
# in a room, at 5 m, have moved by a voxel of it; a second of an L2, whose scan lines fill the map
KEYFRAME_TURN: Final = 0.1  # [rad]
KEYFRAME_SWEEPS: Final = 4
KISS_SIGMA: Final = OfPose(0.03, 0.15)  # of KISS-ICP's registration on its own
# A surface that was not seen for so much way is forgotten: met again it contradicts the present by
# the drift. Tuned on: a lap of 80 m in an office, typical unit (0.25 % of the way): the floor met
# 0.19 m off, the odometry jumped, then slid along the corridor by 5 m.
MAP_WAY: Final = 30.0  # [m]
MAP_WAY_STEP: Final = 2.0  # [m] between the times that this is looked after
PRUNE_SHARE: Final = 0.2  # of the map's radius traveled before far cells are dropped

# ---- odometry: free space. Tuned on: narrow views; 0 to 3 % of the rays pass through surfaces at
# right poses, 10 to 20 % at wrong ones that fit

RAYS_THROUGH: Final = 0.06  # share of the rays that pass through known surfaces, at most
RAYS: Final = 250  # of a sweep. Bounds the time
RAY_LONGEST: Final = 10.0  # [m] likewise
RAY_FROM: Final = 0.3  # [m] from the sensor
RAY_MARGIN: Final = 0.35  # [m] before the point, where the surface itself may be
RAY_STEP: Final = 0.08  # [m]
RAY_NEAR: Final = 0.06  # [m] to the surface; more than half of a step
RAY_FACING: Final = 0.5  # cosine of the angle between ray and normal
RAY_EXTENT: Final = 1.5  # standard deviations of a surface's points within which it is known
RAY_POINTS: Final = 30.0  # of a surface, at least
RAY_SWEEPS: Final = 3.0  # that have seen it, at least

# ---- odometry: relocalization

SEARCH_STEP_M: Final = 0.3  # [m] between places that are tried
SEARCH_NEAR_M: Final = 0.15  # [m] a point this near a surface counts
SEARCH_RADIUS_M: Final = (0.3, 4.0)  # [m] least and most about the prediction
SEARCH_ROTATION: Final = 1.0  # [rad] about each axis
SEARCH_PLACES: Final = 1200  # hypotheses scored. Bounds the time to 0.1 s
SEARCH_POINTS: Final = 200  # of the sweep that score one
SEARCH_REFINED: Final = 24  # attitudes of the first round that are varied again
SEARCH_FINER: Final = 4.0  # times smaller variations of these
SEARCH_ARM_M: Final = 3.0  # [m] at which a rotation counts like the way it makes there

# ---- odometry: vertical of a built place. Tuned on: family `starts`, seeds 0 to 143, first maps.
# Errors with these bounds: 0.8 degrees at most in 78 of 144 starts, none of them in a wood

VERTICAL_SURFACES: Final = 20  # fewer do not show one
VERTICAL_STEP: Final = 0.12  # [rad] between first guesses: an acceleration of 1.2 m/s^2
VERTICAL_SCALE: Final = 0.035  # [rad] noise of normals, and of what is built (Cauchy)
VERTICAL_BOUND: Final = 0.052  # [rad] nearer surfaces agree with a vertical
VERTICAL_TRY: Final = 0.5  # share with which the map is begun again, to see whether more agree
# Share of the area that has to. Observed: 0.76 to 0.97 in buildings, 0.1 to 0.7 in woods
VERTICAL_AGREE: Final = 0.75
# With less, but this share, it is up to 4 degrees off (slopes of woods), and the accelerometer up
# to 3. Where the two differ by more than the sine below, it was the accelerometer that was off: 5
# shaken and driven starts by 8 to 24 degrees
VERTICAL_LIKELY: Final = 0.6
VERTICAL_CONTRADICTS: Final = 0.1
# Information about the tilt that is known worse, by that of level surfaces alone. One wall leaves
# a tilt open: 3.5 degrees off at 0.03 to 0.11
VERTICAL_FIXED: Final = 0.12
VERTICAL_ROUNDS: Final = 15
VERTICAL_CONVERGED: Final = 1e-5  # [rad]
# [m/s^2] sigma of gravity's direction then: one degree. Buildings are truer, ramps are not level.
# And of one that is likely
VERTICAL_SIGMA: Final = 0.17
VERTICAL_LIKELY_SIGMA: Final = 0.4
VERTICAL_TILTED: Final = 3.0  # sigmas: farther off, the accelerometer does not show the vertical

# ---- odometry: velocity of a start in motion. Tuned on: family `starts`, seeds 0 to 631

START_NS: Final = 2_200_000_000  # [ns] of the points compared
START_PAUSE_NS: Final = 1_100_000_000  # [ns] between searches
# [ns] in which a search that finds nothing is made again. Derived: a door is passed every 2 to 4 s
START_AWAITED_NS: Final = 5_000_000_000
START_WATCHED_NS: Final = 12_000_000_000  # [ns] of the searches; by then gravity is known
# Share of the information along the strongest direction, below which the first sweeps leave a
# velocity open: it was wrong in 14 of 22 starts, above in 1 of 86
START_FIXED: Final = 0.01
START_SHARE: Final = 0.05  # such a share, below which a later sweep is worth a search
START_LEVEL: Final = 0.7  # length that is left of a direction in the plane
START_LEVEL_SIGMA: Final = 0.085  # [m/s^2] of gravity along the vertical of the map: half a degree
START_LEVEL_SIGMAS: Final = 3.0  # by which it has to be off to be put there
# [m/s^2] sigma of gravity's level components, beyond which any vertical of a built place is
# better: at 0.5, two drives begun at 1.2 m/s^2 had 2.5 sigma left of it, and ended 1 and 86 m off
START_LEVEL_KNOWN: Final = 0.3
START_PRIOR: Final = 0.7  # [m/s] sigma along an open direction at the first search, at least
START_LATER: Final = 0.25  # [m/s] sigma at later searches, at least
START_ACCELERATION: Final = 0.15  # [m/s^2] sigma; of accelerometers' biases
START_OPEN: Final = 0.2  # [m/s] sigma of a velocity that is open
START_CHANGE: Final = 0.15  # [m/s] of the velocity, at least, to be news
START_SIGNIFICANT: Final = 3.0  # sigmas of that change, at least
START_MOST_CHANGE: Final = 0.6  # [m/s] after the first search: larger changes are not believed
START_SIGMAS: Final = 3.0  # of the velocity: how far errors of it are tried
START_REACH: Final = 3.0  # [m/s] largest error of the velocity that is tried
START_STEP: Final = 0.1  # [m/s] between errors: 0.2 m in the time of the points
START_NOISE: Final = 0.08  # [m/s] added error, 1 sigma: the median of 90 searches
START_BETTER: Final = 0.5  # of the variance before, at most, or nothing was found
# Difference of logarithms between the most and the least likely velocity by the profile of walls.
# Observed at the right velocity: 500 to 5000; without edges in view 0 to 310
START_PROFILE: Final = 500.0
# [m/s, m/s^2] between motions along walls that are compared, 0.2 m in the time of the points; and
# into how many each of them is divided that is likely by the logarithm. Tuned on: corridors, of
# which spinning lidars and L2 with 80 and 120 degrees begin in motion, seeds 0 to 15
START_WALL_STEPS: Final = (0.1, 0.3)
START_WALL_FINER: Final = (5, 5)
START_WALL_LIKELY: Final = 8.0
START_WALL_REFINED: Final = 30  # at most. Bounds the time to 0.4 s
# [m/s^2] error besides, 1 sigma: with it, and the one above for the velocity, the NEES of 133 such
# searches is 1.1 and 1.3
START_ACCELERATION_NOISE: Final = 0.05
# The poses of the first 0.3 s were found with the velocity that is to be judged. Tuned on starts 0
# to 200: what the later ones show of it is off by 0.05 m/s (median; a tenth by more than 0.12)
START_FITTED_NS: Final = 300_000_000  # [ns]
START_FITTED_LEAST: Final = 5  # poses after them; three are fitted anyway
START_FITTED_CHANGE: Final = 0.2  # [m/s] between the two, at least, if the map is to begin again
START_FITTED_SIGMA: Final = 0.1  # [m/s] of the fitted velocity, at least
START_RANGE: Final = 25.0  # [m] farther away, points are few
START_SLICE_NS: Final = 50_000_000  # [ns] in which 3 m/s are half a column
START_COLUMN: Final = (0.3, 0.3, 0.25)  # [m] three on top of each other are upright
START_SPOT: Final = (0.05, 0.05, 0.25)  # [m] in which one point of a sweep counts
START_MOST: Final = 8000  # such points; bounds the time
START_POSTS: Final = 300  # such points, at least: fewer tell nothing
START_CELLS: Final = (0.4, 0.2, 0.1)  # [m] length of cells along the way
START_ACROSS: Final = 0.15  # [m] least width of cells across it, to which it is known
START_ROW: Final = 0.5  # [m] height of cells
# Walls: columns of points of one sweep that lie in a row. Tuned on: starts in halls, seeds 2000 to
# 2139
START_WALL_COLUMN: Final = 0.2  # [m] in which points are one column
# Of the range, in which columns are compared: scan lines are 0.12 of it apart. [m] at least, most
START_WALL_REACH: Final = (0.3, 0.6, 5.0)
START_WALL_COLUMNS: Final = 3  # columns within that reach, at least
START_WALL_LENGTH: Final = 0.15  # 1 sigma of them along the wall, of the reach, at least
START_WALL_FLAT: Final = 0.15  # 1 sigma of them across it, of that along it, at most
START_WALL_ANGLE: Final = 0.14  # [rad] walls that differ by less have one direction
START_WALL_POINTS: Final = 40  # of walls of one direction, at least
START_WALLS: Final = 4  # directions of walls, at most
START_WALL_CELL: Final = 4.0  # [m] length of cells, longer than the gaps between columns
START_WALL_ROW: Final = 2.0  # [m] height of these cells
START_FEW_POSTS: Final = 100  # points of posts, below which the scale below stays
# Cells more for one unit of the logarithm, by the square root of the points. With it, a gap of
# 5 units to the next best velocity was right to 0.3 m/s in 85 of 90 searches
START_SCALE: Final = 0.3
# Yaw rate of such a start, searched over the same points. Observed in 70 searches: 9 rates were
# wrong by 1 to 4 degrees per second. All that were found with so much more on the logarithm were
# right to 0.4, but for one of 1.2 and one where gravity was off. At later searches it was wrong in
# 4 starts and right in 2
START_YAW_SIGMA: Final = 0.04  # [rad/s] of what is known before, at least
START_YAW_REACH: Final = 0.105  # [rad/s] largest error of the rate that is tried
START_YAW_STEP: Final = 0.0175  # [rad/s] between errors: 0.4 m at 10 m in the time of the points
START_YAW_FINER: Final = 0.0045  # [rad/s] between errors near the best of them
START_YAW_VELOCITY_STEP: Final = 0.3  # [m/s] between velocities compared at each
START_YAW_MOST: Final = 3000  # points of the first search, with the two coarser cells. Bounds time
START_YAW_BETTER: Final = 4.0  # by the logarithm, than near no change
# Sigmas of a change, at least. Observed in 21 searches: what was found near no change was right to
# 0.4 degrees per second where the present rate was wrong by up to 1.1
START_YAW_SIGNIFICANT: Final = 1.5
START_YAW_NOISE: Final = 0.004  # [rad/s] error besides, 1 sigma: half of the finer steps

# ---- odometry: initialization of the map. Tuned on: starts at rest and in motion, all scenes

INITIAL_NS: Final = 450_000_000  # [ns] the first sweeps are held for so long
INITIAL_MAX_NS: Final = 3_000_000_000  # [ns] or, at rest, until they meet each other
INITIAL_IMU_NS: Final = 1_000_000_000  # [ns] whose samples show whether the sensor rests
INITIAL_ROUNDS: Final = 6
INITIAL_STEP: Final = 0.02  # [m/s] a smaller change of the velocity ends the rounds
INITIAL_SPEED: Final = 1.0  # [m/s] a walk; tried along a direction that the scene hardly fixes
# Information about the place along the weakest direction, by that along the strongest, with which
# such a start is believed, and by how much it has to exceed that of the start from rest. Tuned on:
# office corridor, typical unit: 0.04 to 0.15 at the right velocity, 0.0001 to 0.024 at wrong ones.
INITIAL_FIXED: Final = 0.03
INITIAL_BETTER: Final = 2.0
INITIAL_CLOSER: Final = 0.01  # share of inliers; it differs by up to 0.002 by chance
# Share of inliers by which a walk either way fits better, however weakly it fixes the place. Three
# of 632 starts have one: two are right with it, and one is as before
INITIAL_FAR_CLOSER: Final = 0.05
INITIAL_REST_SPEED: Final = 0.06  # [m/s] faster, the sensor did not rest, however quiet the IMU
# Share of inliers below which a start from rest is doubted, and one in motion tried. Observed:
# 0.69 where a gliding drone passed for one at rest, 0.87 at its velocity; 0.97 and more at rest
INITIAL_INLIERS: Final = 0.9
# A wood shows few surfaces: of a sensor at rest the second sweep may meet too little of the first
# one to fit, and the third fits what both saw. Sweeps until a motion is tried instead, and until
# the rest is given up. Tuned on: imperfect woods, seeds 0 to 30
INITIAL_MISSED: Final = (3, 5)
INITIAL_WHOLE: Final = 0.7  # of the points of the fullest sweep needed to begin the map
INITIAL_SWEEP_NS: Final = 150_000_000  # [ns] shorter sweeps are joined: they would not meet

# ---- odometry: zero-velocity test. Tuned on: captures, and slow starts in room and yard

STILL_TEST_NS: Final = 2_000_000_000  # [ns] it has to look like rest; doubled where it was none
STILL_TEST_MAX_NS: Final = 64_000_000_000  # [ns]
STILL_NEAR: Final = (0.005, 0.02)  # [rad, m] within which poses stay meanwhile
STILL_SPEED: Final = 0.03  # [m/s]
STILL_SPEED_SIGMA: Final = 0.05  # [m/s] of a velocity that may be called zero
STILL_BIAS_MARGIN: Final = 0.02  # [rad/s] by which the mean rate may differ from the known bias
STILL_REACH: Final = (0.02, 0.05)  # [rad, m] a sweep may deviate, a priori
STILL_LEAST: Final = (1e-4, 5e-4)  # [rad, m] deviations that never count
STILL_FAR: Final = (0.035, 0.1)  # [rad, m] and one that always does
STILL_TURN_NS: Final = 200_000_000  # [ns] shorter sweeps are averaged into a turn
STILL_COMPARED: Final = 40  # turns whose deviations are compared
STILL_TESTED: Final = 12  # of the latest of these are compared with all before, at most
# Turns that agreed before the latest one or two did not: it was a rest until then. Derived: with
# fewer, one that accelerates evenly from the start looks like that
STILL_OLDER: Final = 6
STILL_DRIFT: Final = 160.0  # squared Mahalanobis distance of a drift (6) that is not chance
# Share of the points that fixed the weakest direction at first, to tell that motion has blurred it
# since. A creep of 0.05 m/s through a room: 0.1 at first, 0.01 after 2 s; at rest 0.06 to 0.12
STILL_FIXED: Final = 0.04
# Of that share is left, on average of two sweeps: a rosette at rest that fixed its height by few
# points alternated between 0.1 and 0.03
STILL_BLURRED: Final = 0.45
STILL_DRIFT_S: Final = 0.5  # [s] how quickly a drift may have come about
STILL_IMU_NS: Final = 250_000_000  # [ns] in which the IMU shows that rest has ended
STILL_ONSET_NS: Final = 300_000_000  # [ns] before that, in which it may have begun to end
# [rad, m, m/s] 1 sigma of a motion that has begun and is not noticed yet. Source: errors of the
# poses at rest in the hard runs, which rest for two seconds
STILL_UNNOTICED: Final = (4e-4, 2e-4, 2.5e-3)
RETRY_NS: Final = 4_000_000_000  # [ns] so long the map of a rest may begin again as in motion
RETRY_SHORT_NS: Final = 1_000_000_000  # [ns] so long also if the IMU alone ends it, and it fits
RETRY_FARTHEST_M: Final = 0.5  # [m] how far such a motion may lead
# A rest that has ended is mapped again with what the first sweeps in motion tell about the unit,
# until then, and if it went no farther. Tuned on: halls, seeds 222 to 228, where walks at 1.2 m/s
# had known the range bias 0.2 to 1.9 s after the rest
ENDED_REST_NS: Final = 5_000_000_000  # [ns]
ENDED_REST_M: Final = 4.0  # [m]

# ---- odometry: lost, and jumps of time

LOST_NS: Final = 5_000_000_000  # [ns] of sweeps without a match
# Sooner where a view, after a blind stretch, holds little that the map knows. Tuned on: a cone of
# 70 degrees that turned from a wall into a room, where 0.1 to 0.2 of 1,500 points were in known
# cells, and predictions were off by 0.1 m after a second, by 1.2 m after five
UNMAPPED_NS: Final = 1_000_000_000  # [ns] of sweeps without a match
UNMAPPED_POINTS: Final = 300  # of a sweep, at least; with fewer it is blind
UNMAPPED_KNOWN: Final = 0.25  # share of these in known cells of the coarsest size, at most
# How a sensor may have moved unseen while a clock went back, 1 sigma
UNSEEN_POSITION: Final = 0.5  # [m]
UNSEEN_ROTATION: Final = 0.5  # [rad]
UNSEEN_S: Final = 2.0  # [s] at the velocity that it had
EARLIER_MAPS: Final = 2  # kept after losses. Bounds the memory
# Searching them takes 0.2 to 0.4 s, so it is done once a second at first, then ever more rarely.
EARLIER_PAUSE_NS: Final = 1_000_000_000  # [ns]
EARLIER_PAUSE_SHARE: Final = 0.1  # of the time since the loss
EARLIER_SIGMA: Final = OfPose(0.05, 0.1)  # of a pose that the search has found
EARLIER_SAME: Final = OfPose(0.05, 0.25)  # within which two meetings agree
# The older part of the map in use is searched likewise while the pose is less certain than that.
# Tuned on: narrow views in rooms and flats.
REVISIT_FROM_SIGMA: Final = 0.12  # [m] 1 sigma of the place
# Not ever more rarely, as after losses: an old place is in view for a few seconds only
REVISIT_PAUSE_NS: Final = 3_000_000_000  # [ns] between searches, at most
REVISIT_LOOK_NS: Final = 200_000_000  # [ns] between looks whether it is
# By which the pose may lean against gravity there. Tuned on: a cone of 70 degrees that returned
# leaning by 3 degrees, and ran away by 25 m
REVISIT_LEAN: Final = 0.01  # [rad] 1 sigma
REVISIT_LEAST_M: Final = 0.06  # [m] by which the pose has to jump
REVISIT_MATCHED: Final = 0.35  # least share of the sweep's points that meet the older part
REVISIT_INLIERS: Final = 0.85  # least share of those that are near its surfaces
REVISIT_MET_NS: Final = 2_000_000_000  # [ns] within which a meeting must be confirmed
# [m] within which two places on a level agree where one of the sweeps leaves the height free;
# otherwise EARLIER_SAME. Observed: right places stayed within 1 cm from sweep to sweep, wrong ones
# moved by 3 to 20
REVISIT_SAME_M: Final = 0.02
REVISIT_AGREEING: Final = 3  # sweeps in a row have to, where others of that time fit elsewhere
# Relocalization on a level is tried with each sweep for so long after one that left a direction
# free: the surface that fixes it again may be in sight for a second only.
REVISIT_SIGHT_NS: Final = 2_000_000_000  # [ns]
# A sweep sees through surfaces that are older than what holds its pose. Some are not: people have
# moved. Observed: 9 of 10 were opened within a second, and the others up to 100 sweeps later
REVISIT_SEEN: Final = 0.9  # share of them that count as older
# It needs a place at least so uncertain. If it is less, what fits elsewhere may be something else.
# Tuned on: camera in a room, 0.3 m
RELOCALIZE_FROM_SIGMA: Final = 0.35  # [m] 1 sigma
# The same where sweeps see through the map as the pose has it; just above REVISIT_FROM_SIGMA.
# Judged on: narrow views, seeds 190 to 205
RELOCALIZE_CONTRADICTED_SIGMA: Final = 0.15  # [m] 1 sigma
# How far from the predicted place others are tried, of the drift that has to be allowed for, and
# how far the pose may jump, of the expected drift. Tuned on: cones of 70 degrees in flats, where
# right places were up to 1.4 away, and other corners that look alike 2.2 to 3.4
RELOCALIZE_SIGMAS: Final = 2.0
# A drift so likely that one sweep counts; the next may show nothing. Tuned on: as above, where 15
# of 15 such places were right, and what showed three of them was in sight for one sweep only
RELOCALIZE_LIKELY: Final = 1.0
# One that counts only if many sweeps in a row agree. Tuned on: a camera in a room, seed 295, which
# fitted the first map 0.46 m away, 2.5 sigma, sweep after sweep for five seconds
RELOCALIZE_UNLIKELY: Final = 4.0
REVISIT_UNLIKELY_AGREEING: Final = 8
RELOCALIZE_STEP_M: Final = 0.1  # [m] between the places; the robust kernel reaches as far
# At most; they are farther apart where these do not suffice. Bounds the time
RELOCALIZE_PLACES: Final = 600
RELOCALIZE_STARTS: Final = 4  # places from which sweeps are aligned, at most
RELOCALIZE_APART_M: Final = 0.25  # [m] between these, at least
# Tuned on: camera on stairs, where sweeps fit 0.16 m and more higher or lower as well, and flats
# with a cone of 70 degrees and a rosette, where the height had drifted by 0.1 m besides
RELOCALIZE_HEIGHT_M: Final = 0.15  # [m] by which the place may move up or down
# Where the height is all that a sweep leaves free, sine of how far from the vertical. Observed in
# such views: 0.06 at most
RELOCALIZE_TILT: Final = 0.2
RELOCALIZE_FLOOR_M: Final = 0.05  # [m] added to its uncertainty in each direction
# Share of the points on surfaces, of all in their cells and of those in the finest. Coarse cells
# near an old place hold what has not been seen before: 0.56 to 0.98 at right places, 0.38 at wrong
# ones. Tuned on: as above
RELOCALIZE_INLIERS: Final = (0.5, 0.85)
RELOCALIZE_MATCHED: Final = 0.15  # of all points, on surfaces of the finest cells
# Time in which the place may have moved by the jump. Observed: a view lacks for 3 to 10 s.
REVISIT_DRIFT_S: Final = 5.0  # [s]
