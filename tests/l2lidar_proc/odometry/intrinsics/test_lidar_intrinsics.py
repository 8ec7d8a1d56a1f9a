"""Errors of a unit's beam angles are found from its clouds, and none where there are none."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest

from l2lidar_node.calibration import model
from l2lidar_node.calibration.model import ALPHA, BETA, NAMES, RETURN, XI, Block
from l2lidar_node.protocol import wire
from l2lidar_node.types import IMU_SAMPLE, STANDARD_GRAVITY, HostNs, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.odometry.config import OdometryConfig, OdometryNodeConfig
from l2lidar_proc.odometry.initialization.first_rest import Remapping
from l2lidar_proc.odometry.interface import Phase
from l2lidar_proc.odometry.intrinsics.fan_halves import angle_derivatives, between_halves, halves
from l2lidar_proc.odometry.intrinsics.lidar_intrinsics import LidarIntrinsics
from l2lidar_proc.odometry.matcher import xyz
from l2lidar_proc.odometry.odometry import Odometry
from l2lidar_proc.verbs.recorded import run_events
from tests.l2lidar_proc.odometry.odometry_world import T_CLOUD_IMU, errors, feed
from tests.support.build import SHARED_DATA
from tests.support.odometry_runs import record, sweeps

HEAD_RATE, SLOTS, PACKETS = 27.1, 300, 50
BLOCK = Block(np.zeros(1, wire.CALIBRATION).tobytes())
ROOM = np.array([4.2, 3.3, 2.7])  # [m] half the edges
HALL = np.array([10.0, 10.0, 4.0])
CLOUD = np.dtype([(name, "<f4") for name in ("x", "y", "z", "time")])
UNIT = (0.4, -0.3, 0.0)  # [degrees] xi, beta, alpha
CONFIG = OdometryNodeConfig()
REAL = SHARED_DATA / "unitree_l2_static"


def turn(
    unit: Any,
    number: int,
    rate: float = HEAD_RATE,
    drift: Any = (0.0, 0.0, 0.0),
    *,
    trunks: Any = None,
    box: Any = ROOM,
    advance: float = 0.37,
) -> Any:
    """Return one turn, as a unit off by (xi, beta, alpha) [degrees] reports it, and halves.

    Parameters
    ----------
    drift : array_like, shape (3,)
        Velocity of the sensor [m/s], for which nobody corrects the points.
    trunks : array_like, shape (N, 3), optional
        Places and radii [m] of upright cylinders. Without them there is a box.
    box : array_like, shape (3,)
        Half its edges [m]; the sensor is in its middle.
    advance : float
        Of the head from turn to turn, beside whole ones [rad].
    """
    rng = np.random.default_rng(number)
    returns = np.zeros(SLOTS * PACKETS, RETURN)
    slot = np.tile(np.arange(SLOTS), PACKETS)
    packet = np.repeat(np.arange(PACKETS), SLOTS)
    time = 1.53e-5 * (packet * SLOTS + slot)
    # packets do not begin at the same angles in every turn
    returns["theta"] = 1.7 + advance * number + rate * time[packet * SLOTS]
    returns["alpha"] = np.pi * (slot + rng.random()) / SLOTS
    correction = np.zeros(len(NAMES))
    correction[[XI, BETA, ALPHA]] = np.radians(unit)
    returns["range"] = 1.0
    direction = model.beams(returns, BLOCK, correction).direction
    place = time[:, None] * drift
    if trunks is None:
        reach = (np.sign(direction) * box - place) / np.where(direction == 0.0, 1e-9, direction)
    else:
        reach = _to_trunks(direction, np.asarray(trunks))
    nearest = reach.min(axis=1)
    hit = nearest < 25.0
    returns["range"] = np.where(hit, nearest, 1.0) + 0.01 * rng.standard_normal(len(returns))
    reported = model.beams(returns, BLOCK, np.zeros(len(NAMES))).points
    cloud = np.zeros(len(returns), CLOUD)
    for name, line in zip("xyz", reported.T, strict=True):
        cloud[name] = line
    cloud["time"] = time
    start = HostNs(number * 230_000_000)
    sweep = Sweep(start, HostNs(start + 229_000_000), cloud[hit], PACKETS, 0)
    return sweep, np.where(returns["alpha"] < np.pi / 2, 1.0, -1.0)[hit]


def _to_trunks(direction: Any, trunks: Any) -> Any:
    """Return how far it is to each cylinder (N, M) along unit vectors (N, 3) [m]."""
    flat = direction[:, :2]
    squared = np.maximum((flat**2).sum(axis=1), 1e-9)[:, None]
    ahead = flat @ trunks[:, :2].T / squared
    beside = (trunks[:, :2] ** 2).sum(axis=1) - ahead**2 * squared
    into = trunks[:, 2] ** 2 - beside
    depth = np.sqrt(np.maximum(into, 0.0) / squared)
    return np.where((into > 0.0) & (ahead > depth), ahead - depth, np.inf)


def learned(unit: Any, at_rest: bool = True, drift: Any = (0.0, 0.0, 0.0)) -> LidarIntrinsics:
    intrinsics = LidarIntrinsics()
    for number in range(12):
        sweep = intrinsics.corrected(turn(unit, number, drift=drift)[0])
        intrinsics.learn(sweep, sweep.points, at_rest=at_rest)
    return intrinsics


@pytest.mark.parametrize("seconds", [0.002, 0.01, 0.03, 0.05, 0.1])
def test_a_first_sweep_that_is_cut_does_not_hide_the_pattern(seconds: float) -> None:
    """A driver that starts within a turn: so short a part fits any rate of the head."""
    whole, _ = turn(UNIT, 0)
    part = dataclasses.replace(whole, points=whole.points[whole.points["time"] < seconds])
    intrinsics = LidarIntrinsics()
    intrinsics.learn(intrinsics.corrected(part), part.points, at_rest=True)
    for number in range(1, 12):
        sweep = intrinsics.corrected(turn(UNIT, number)[0])
        assert intrinsics.head(sweep) is not None
        intrinsics.learn(sweep, sweep.points, at_rest=True)
    expected = learned(UNIT).angles
    assert expected.any()
    np.testing.assert_allclose(np.degrees(intrinsics.angles - expected), 0.0, atol=0.05)


def test_a_rate_of_the_head_that_does_not_fit_is_searched_anew() -> None:
    intrinsics = LidarIntrinsics()
    for number in range(8):
        assert intrinsics.head(turn(UNIT, number, 27.1)[0]) is not None
    found = [intrinsics.head(turn(UNIT, number, 34.9)[0]) for number in range(8)]
    assert found[0] is None
    assert found[-1] is not None
    assert found[-1].rate == pytest.approx(34.9, rel=0.02)
    nothing = dataclasses.replace(turn(UNIT, 0)[0], points=turn(UNIT, 0)[0].points[:0])
    for _ in range(50):  # covered, it stays an L2
        assert intrinsics.head(nothing) is None
    assert intrinsics.head(turn(UNIT, 9, 34.9)[0]) is not None


@pytest.mark.parametrize("rate", [27.1, 34.9])
@pytest.mark.parametrize("number", range(4))
def test_the_half_of_every_point_is_found(rate: float, number: int) -> None:
    sweep, true = turn(UNIT, number, rate)
    found = halves(sweep.points)
    assert found is not None
    assert found.rate == pytest.approx(rate, rel=0.02)
    radius = np.hypot(sweep.points["x"], sweep.points["y"])
    assert np.mean((found.sign == true)[radius > 0.5]) > 0.995
    half = sweep.points[: len(sweep.points) // 2]
    again = halves(half, found.rate)
    assert again is not None
    assert np.mean((again.sign == true[: len(half)])[radius[: len(half)] > 0.5]) > 0.995


def test_points_near_the_axis_of_the_head_are_corrected_as_exactly_as_others() -> None:
    """By the azimuth of each point those within 2 m of it were 27 mm off, 8 m above the sensor."""
    returns = np.zeros(SLOTS * PACKETS, RETURN)
    time = 1.53e-5 * np.arange(len(returns))
    returns["theta"] = 0.4 + HEAD_RATE * time
    returns["alpha"] = np.pi * (np.arange(len(returns)) % SLOTS + 0.5) / SLOTS
    returns["range"] = 8.0
    correction = np.zeros(len(NAMES))
    correction[[XI, BETA, ALPHA]] = np.radians(UNIT)
    true = model.beams(returns, BLOCK, correction).points
    cloud = np.zeros(len(returns), CLOUD)
    cloud["time"] = time
    reported = model.beams(returns, BLOCK, np.zeros(len(NAMES))).points
    for name, line in zip("xyz", reported.T, strict=True):
        cloud[name] = line
    head = halves(cloud)
    assert head is not None
    moved = np.einsum("jan,a->nj", angle_derivatives(cloud, head), np.radians(UNIT))
    corrected = np.stack([cloud[name] for name in "xyz"], axis=1) + moved
    off = np.linalg.norm(corrected - true, axis=1)
    near = np.hypot(true[:, 0], true[:, 1]) < 2.0
    assert np.count_nonzero(near) > 1000
    assert np.linalg.norm(moved[near], axis=1).min() > 0.08
    for some in (near, ~near):
        assert np.sqrt(np.mean(off[some] ** 2)) < 0.002


def test_the_angle_of_the_head_is_known_for_the_whole_turn() -> None:
    """Not but for half a turn: the half that rises is on the other side by then."""
    intrinsics, offsets = LidarIntrinsics(), []
    for number in range(18):
        sweep = turn(UNIT, number)[0]
        head = intrinsics.head(sweep)
        assert head is not None
        assert head.stamp == sweep.start
        assert intrinsics.head(sweep) == head
        offsets.append(head.angle - (1.7 + 0.37 * number))
    # a rate that is 0.4 % off moves the angle at the beginning by half of that in a turn
    assert np.ptp(np.unwrap(offsets)) < 0.03
    room = sweep.points.copy()
    rng = np.random.default_rng(1)
    room["x"], room["y"] = rng.permutation(room["x"]), rng.permutation(room["y"])
    assert LidarIntrinsics().head(dataclasses.replace(sweep, points=room)) is None


@pytest.mark.parametrize("at_rest", [True, False])
@pytest.mark.parametrize("unit", [UNIT, (-0.4, 0.4, 0.0), (0.5, 0.1, 0.0)])
def test_what_moves_the_halves_apart_is_found(unit: Any, at_rest: bool) -> None:
    """Along the other direction, both angles together, 12 turns tell nothing: it is not used."""
    found = np.degrees(learned(unit, at_rest).angles)
    size = float(np.linalg.norm(found))
    axis = found / size
    assert abs(axis[0]) > 0.9
    assert size == pytest.approx(np.dot(unit, axis), abs=0.05)


@pytest.mark.parametrize("at_rest", [True, False])
@pytest.mark.parametrize("alpha", [0.3, -0.5])
@pytest.mark.parametrize("others", [(0.0, 0.0), (0.4, -0.3)])
def test_where_the_turn_of_the_mirror_begins_is_found(
    others: Any, alpha: float, at_rest: bool
) -> None:
    """It differs from one power-up of a unit to the next, and makes ceilings double."""
    intrinsics = learned((*others, alpha), at_rest)
    found = np.degrees(intrinsics.angles)
    assert found[2] == pytest.approx(alpha, abs=0.05)
    size = float(np.linalg.norm(found[:2]))
    assert size == pytest.approx(np.dot(others, found[:2] / max(size, 1e-9)), abs=0.05)
    assert np.degrees(intrinsics.errors.alpha) < 0.05
    sweep, _ = turn((*others, alpha), 30)

    def off(cloud: Any) -> float:
        ceiling = np.abs(cloud["z"] - ROOM[2]) < 0.15
        ceiling &= (np.abs(cloud["x"]) < ROOM[0] - 0.3) & (np.abs(cloud["y"]) < ROOM[1] - 0.3)
        return float(np.std(cloud["z"][ceiling]))

    assert off(intrinsics.applied_to(sweep).points) < 0.75 * off(sweep.points)


def test_a_unit_that_is_right_is_left_alone() -> None:
    intrinsics = learned((0.0, 0.0, 0.0), at_rest=False)
    np.testing.assert_array_equal(intrinsics.angles, (0.0, 0.0, 0.0))
    assert abs(intrinsics.corrections.ranges) < tuning.RANGE_BIAS_FLOOR
    sweep, _ = turn((0.0, 0.0, 0.0), 20)
    intrinsics.ranges.forget()
    assert intrinsics.corrected(sweep) is sweep


def test_how_wrong_the_angles_may_still_be_is_told() -> None:
    """What is found but not sure enough to be corrected is an error that stays."""
    assert LidarIntrinsics().errors.beams == pytest.approx((tuning.BEAM_SIGMA, tuning.BEAM_SIGMA))
    assert LidarIntrinsics().errors.alpha == pytest.approx(tuning.ALPHA_SIGMA)
    units = ((0.0, 0.0, 0.0), (0.5, -0.2, 0.0), (0.4, 0.8, 0.0))
    right, across, along = (learned(unit).errors.beams for unit in units)
    assert right is not None
    assert across is not None
    assert along is not None
    assert right[0] < 0.2 * tuning.BEAM_SIGMA < 0.5 * tuning.BEAM_SIGMA < right[1]
    assert across == pytest.approx(right, rel=0.3)  # it is corrected
    assert along[1] > 1.3 * right[1]  # it is not


def _some_trunks(seed: int) -> Any:
    rng = np.random.default_rng(seed)
    places = rng.uniform(-9.0, 9.0, (60, 2))
    places = places[np.hypot(*places.T) > 1.5]
    return np.column_stack((places, rng.uniform(0.06, 0.15, len(places))))


OUT_OF_STEP = 0.4  # [rad] the lines of one turn lie between those of the others
IN_STEP = 3.0 * HEAD_RATE * 1.53e-5 * SLOTS  # [rad] they lie on them


def rested(unit: Any, turns: int, trunks: Any, advance: float = OUT_OF_STEP) -> LidarIntrinsics:
    intrinsics = LidarIntrinsics()
    intrinsics.learn_at_rest(
        [turn(unit, k, trunks=trunks, advance=advance)[0] for k in range(turns)]
    )
    return intrinsics


@pytest.mark.parametrize(
    "unit", [UNIT, (0.4, 0.4, 0.0), (-0.4, 0.4, 0.0), (0.0, 0.0, 0.0), (0.4, -0.3, 0.3)]
)
def test_sweeps_at_rest_show_both_angles_together(unit: Any) -> None:
    """Single sweeps show only one direction of them in a room."""
    np.testing.assert_allclose(np.degrees(rested(unit, 12, None).angles), unit, atol=0.06)


def test_what_sweeps_have_shown_one_by_one_outlasts_a_comparison_that_shows_less() -> None:
    """In a large hall no cell has enough points of both halves to compare all sweeps."""
    some = [
        turn((0.1, 0.1, -0.45), number, box=HALL, advance=OUT_OF_STEP)[0] for number in range(6)
    ]
    intrinsics = LidarIntrinsics()
    for sweep in some:
        corrected = intrinsics.corrected(sweep)
        intrinsics.learn(corrected, corrected.points, at_rest=True)
    before, error = intrinsics.angles, intrinsics.errors.alpha
    assert before[2] < -2.0 * error
    intrinsics.learn_at_rest(some)
    np.testing.assert_allclose(intrinsics.angles, before, atol=0.1 * error)
    assert intrinsics.errors.alpha <= 1.05 * error


def at_rest() -> tuple[Odometry, list[Sweep]]:
    """Return an odometry after four sweeps at rest, and these."""
    odometry = Odometry(OdometryConfig(), np.eye(4))
    odometry.imu(resting())
    some = [turn(UNIT, k)[0] for k in range(4)]
    for sweep in some:
        odometry.register(sweep)
    return odometry, some


def test_sweeps_that_deviate_are_compared_at_once() -> None:
    odometry, _ = at_rest()
    assert odometry._intrinsics._rested_ns == 0
    assert odometry.motion is not None
    rest = odometry._first_rest
    assert rest.map_with_known_beams(odometry.motion, doubted=False) is Remapping.NONE
    assert odometry._intrinsics._rested_ns == 0
    rest.map_with_known_beams(odometry.motion, doubted=True)
    assert odometry._intrinsics._rested_ns > 600_000_000


@pytest.mark.parametrize("doubted", [False, True])
def test_a_better_known_unit_does_not_refute_a_rest_that_is_not_in_doubt(doubted: bool) -> None:
    """Somebody walks by: mapped again, the sweeps seem to drift by more than a rest allows."""
    odometry, _ = at_rest()
    rest, test, still = odometry._first_rest, odometry._zero_velocity, odometry.motion
    assert still is not None
    for number, sweep in enumerate(rest.sweeps):
        points = sweep.points.copy()
        points["x"] += 0.08 * number
        rest.sweeps[number] = dataclasses.replace(sweep, points=points)
    odometry._intrinsics.ranges.correction += 0.03
    count = len(rest.sweeps)
    found = rest.map_with_known_beams(still, doubted=doubted)
    assert found is (Remapping.REFUTED if doubted else Remapping.CONFIRMED)
    assert (test.anchor is None) == doubted
    if not doubted:  # all sweeps are in the map, corrected; the next are compared from here on
        assert test.anchor is not None
        np.testing.assert_array_equal(test.anchor.position, still.state.position)
        assert not test.drifted
        assert odometry.matcher._sweeps == count
        corrected = odometry._intrinsics.applied_to(rest.sweeps[0])
        met = odometry.matcher.surfaces.match(xyz(corrected.points))
        assert np.median(np.abs(met.distances)) < 0.01  # else 0.02


def test_a_rest_that_has_just_ended_is_recalibrated_if_the_unit_is_known_better() -> None:
    odometry, some = at_rest()
    rest, intrinsics = odometry._first_rest, odometry._intrinsics
    state, covariance = odometry._posterior
    assert rest.recalibrated(state) is None  # it has not ended
    rest.end_with(state, covariance)
    assert rest.recalibrated(state) is None  # no more than in its map
    intrinsics.ranges.correction += 0.03
    found = rest.recalibrated(state)
    assert found is not None
    assert rest.recalibrated(state) is None  # once is enough
    assert len(found.sweeps) == len(some)
    shift = float(np.sqrt(found.moved[0, 0]))
    assert shift == pytest.approx(0.03, abs=0.005)
    for better, one in zip(found.sweeps, some, strict=True):
        further = np.linalg.norm(xyz(better.points), axis=1) - np.linalg.norm(
            xyz(one.points), axis=1
        )
        assert np.median(further) == pytest.approx(0.03, abs=0.005)
    far = dataclasses.replace(state, position=state.position + tuning.ENDED_REST_M)
    late = dataclasses.replace(state, stamp=HostNs(some[-1].end + tuning.ENDED_REST_NS + 1))
    for now in (far, late):
        rest.begin(list(some))
        rest.end_with(state, covariance)
        intrinsics.ranges.correction += 0.03
        assert rest.recalibrated(now) is None
        assert rest.recalibrated(state) is None  # it is over


def test_what_showed_that_a_rest_had_ended_is_not_part_of_it() -> None:
    odometry, some = at_rest()
    rest = odometry._first_rest
    rest.end_with(*odometry._posterior, moving=1)
    odometry._intrinsics.ranges.correction += 0.03
    found = rest.recalibrated(odometry._posterior.state)
    assert found is not None
    assert [one.start for one in found.sweeps] == [one.start for one in some[:-1]]
    assert rest.sweeps == []


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("unit", [UNIT, (-0.4, 0.4, 0.0), (0.0, 0.0, 0.0)])
def test_sweeps_at_rest_show_what_moves_the_halves_apart_even_among_trunks(
    unit: Any, seed: int
) -> None:
    """No cell there is flat: trunks are 12 to 30 cm thick."""
    intrinsics = rested(unit, 12, _some_trunks(seed))
    assert np.degrees(intrinsics.errors.beams[0]) < 0.08
    apart = np.degrees(intrinsics.angles) - unit
    assert apart @ (0.82, -0.57, 0.0) == pytest.approx(0.0, abs=0.17)


def test_what_sweeps_at_rest_show_is_as_uncertain_as_it_says() -> None:
    rng = np.random.default_rng(5)
    nees = []
    for number in range(12):
        alpha = np.random.default_rng(number).normal(0.0, 0.2)
        unit = np.append(rng.normal(0.0, 0.4, 2), alpha)
        trunks = _some_trunks(number) if number % 2 else None
        intrinsics = rested(unit, int(rng.integers(6, 14)), trunks, float(rng.uniform(0.3, 0.5)))
        error = intrinsics._estimate - np.radians(unit)
        nees.append(float(error @ intrinsics._information @ error))
    assert 0.1 < np.mean(nees) < 4.0  # three angles
    assert max(nees) < 16.3  # the bound of 99.9 %


def test_a_head_in_step_with_its_packets_tells_no_more_than_one_turn_does() -> None:
    """Its lines repeat: they would pass for the edges of what they happen to hit."""
    trunks = _some_trunks(0)
    repeated, spread = (rested(UNIT, 12, trunks, step) for step in (IN_STEP, OUT_OF_STEP))
    assert repeated.errors.beams[0] > 3.0 * spread.errors.beams[0]
    error = repeated._estimate - np.radians(UNIT)
    assert error @ repeated._information @ error < 16.3


def test_sweeps_at_rest_are_compared_again_when_there_are_many_more() -> None:
    intrinsics = LidarIntrinsics()
    turns = [turn(UNIT, k, trunks=_some_trunks(0), advance=OUT_OF_STEP)[0] for k in range(20)]
    compared = []
    for count in range(1, 21):
        if intrinsics.is_due_at_rest(turns[:count]):
            intrinsics.learn_at_rest(turns[:count])
            compared.append(count)
    lasted = [(turns[count - 1].end - turns[0].start) for count in compared]
    assert tuning.BEAM_REST_NS <= lasted[0] < tuning.BEAM_REST_NS + 230_000_000
    assert len(lasted) == 4
    for before, after in itertools.pairwise(lasted):
        assert before * tuning.BEAM_REST_AGAIN <= after
        assert after < before * tuning.BEAM_REST_AGAIN + 230_000_000
    intrinsics.forget()
    np.testing.assert_array_equal(intrinsics.angles, (0.0, 0.0, 0.0))
    assert intrinsics.errors.beams == pytest.approx((tuning.BEAM_SIGMA, tuning.BEAM_SIGMA))


def test_of_other_sensors_nothing_is_learned_at_rest() -> None:
    intrinsics = LidarIntrinsics()
    some = [Sweep(HostNs(k), HostNs(k + 1), _camera(k), 0, 0) for k in range(12)]
    intrinsics.learn_at_rest(some)
    intrinsics.learn_at_rest([dataclasses.replace(turn(UNIT, 0)[0], points=_camera(0)[:0])])
    np.testing.assert_array_equal(intrinsics.angles, (0.0, 0.0, 0.0))
    far = [turn(UNIT, k, trunks=[[20.0, 0.0, 0.1]])[0] for k in range(6)]
    intrinsics.learn_at_rest(far)  # nothing that both halves see often enough
    np.testing.assert_array_equal(intrinsics.angles, (0.0, 0.0, 0.0))


@pytest.mark.parametrize("drift", [(0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (-0.1, 0.1, 0.0)])
def test_a_velocity_that_is_off_does_not_pass_for_beam_angles(drift: Any) -> None:
    """10 cm/s move the halves apart by 12 mm where they see the same surface half a turn later."""
    right = learned((0.0, 0.0, 0.0), at_rest=False, drift=drift)
    np.testing.assert_array_equal(right.angles, (0.0, 0.0, 0.0))
    assert learned((0.0, 0.0, 0.0), at_rest=True, drift=(0.0, 0.1, 0.0)).angles.any()


def test_no_unit_is_off_by_more_than_a_degree() -> None:
    off = np.array((1.3, -1.0, 0.0))
    np.testing.assert_array_equal(learned(off).angles, (0.0, 0.0, 0.0))
    assert learned(0.5 * off).angles.any()


def test_corrected_clouds_lie_on_the_walls() -> None:
    intrinsics = learned(UNIT)
    sweep, _ = turn(UNIT, 30)
    better = intrinsics.corrected(sweep)
    assert better is not sweep

    def off(cloud: Any) -> float:
        wall = (np.abs(cloud["x"]) < 2.0) & (np.abs(cloud["z"]) < 2.0) & (cloud["z"] > 0.1)
        radius = np.hypot(cloud["x"], cloud["y"])
        oblique = wall & (np.abs(cloud["x"]) > 0.4 * radius)
        return float(np.sqrt(np.mean((np.abs(cloud["y"][oblique]) - ROOM[1]) ** 2)))

    assert off(sweep.points) > 0.013
    assert off(better.points) < 0.0105
    assert sweep.points.dtype == better.points.dtype
    for name in ("z", "time"):
        np.testing.assert_array_equal(better.points[name], sweep.points[name])


def _spinning(number: int) -> Any:
    """Return a turn of a lidar with 16 rings."""
    rng = np.random.default_rng(number)
    cloud = np.zeros(16 * 900, CLOUD)
    azimuth = np.repeat(np.linspace(0.0, 2.0 * np.pi, 900), 16)
    cloud["x"], cloud["y"] = 5.0 * np.cos(azimuth), 5.0 * np.sin(azimuth)
    cloud["z"] = 5.0 * np.tan(np.radians(np.tile(np.arange(-15.0, 16.0, 2.0), 900)))
    cloud["z"] += 0.01 * rng.standard_normal(len(cloud))
    cloud["time"] = azimuth / (2.0 * np.pi) * 0.1
    return cloud


def _camera(number: int) -> Any:
    """Return an image of a depth camera, all pixels at once."""
    rng = np.random.default_rng(number)
    cloud = np.zeros(1500, CLOUD)
    cloud["x"] = 3.0
    cloud["y"], cloud["z"] = rng.uniform(-2.0, 2.0, (2, 1500))
    return cloud


@pytest.mark.parametrize("backwards", [0, 100_000_000])
def test_clouds_whose_clock_does_not_advance_are_not_kept(backwards: int) -> None:
    intrinsics = LidarIntrinsics()
    for number in range(50):
        start = 10_000_000_000 - backwards * number
        cloud = _camera(number)
        intrinsics.head(Sweep(HostNs(start), HostNs(start + 50_000_000), cloud, 0, 0))
        assert len(intrinsics._unshown) == 1


@pytest.mark.parametrize("measure", [_spinning, _camera])
def test_clouds_of_other_sensors_are_left_as_they_are(measure: Any) -> None:
    intrinsics = LidarIntrinsics()
    for number in range(30):
        start, end = (HostNs(100_000_000 * k) for k in (number, number + 1))
        sweep = Sweep(start, end, measure(number), 0, 0)
        assert intrinsics.corrected(sweep) is sweep
        intrinsics.learn(sweep, sweep.points, at_rest=True)
        assert intrinsics.is_other == (number >= 8), "known after three turns of a head"
    np.testing.assert_array_equal(intrinsics.angles, (0.0, 0.0, 0.0))
    assert intrinsics.is_other
    # it has given up: an L2 later is not looked at
    sweep, _ = turn(UNIT, 0)
    intrinsics.corrected(sweep)
    intrinsics.learn(sweep, sweep.points, at_rest=True)
    np.testing.assert_array_equal(intrinsics.angles, (0.0, 0.0, 0.0))


def test_other_sweeps_may_be_corrected_without_being_learned() -> None:
    intrinsics, other = LidarIntrinsics(), LidarIntrinsics()
    for number in range(12):
        sweep, _ = turn(UNIT, number)
        corrected = intrinsics.corrected(sweep)
        for _ in range(30):
            intrinsics.applied_to(turn(UNIT, 0)[0])
        intrinsics.learn(corrected, corrected.points, at_rest=True)
        corrected = other.corrected(sweep)
        other.learn(corrected, corrected.points, at_rest=True)
    np.testing.assert_array_equal(intrinsics.angles, other.angles)
    assert intrinsics.errors.beams == other.errors.beams
    assert intrinsics.angles.any()
    shown, again = intrinsics.applied_to(sweep), intrinsics.corrected(sweep)
    np.testing.assert_array_equal(shown.points, again.points)
    assert (shown.points["x"] != sweep.points["x"]).any()


def test_nonsense_does_no_harm() -> None:
    intrinsics = LidarIntrinsics()
    sweep, _ = turn(UNIT, 0)
    for points in (sweep.points[:0], sweep.points[:100], sweep.points[::-1].copy()):
        odd = dataclasses.replace(sweep, points=points)
        assert intrinsics.corrected(odd) is odd
        intrinsics.learn(odd, points, at_rest=False)
    kept = intrinsics.corrected(sweep)
    intrinsics.learn(kept, kept.points[:-1], at_rest=True)  # not the same points
    intrinsics.learn(turn(UNIT, 1)[0], kept.points, at_rest=True)  # not the latest sweep
    np.testing.assert_array_equal(intrinsics.angles, (0.0, 0.0, 0.0))


def _captured(number: int, first: int) -> Sweep:
    """Return fifty packets of a capture of a real unit at rest, from a packet on."""
    returned = np.isfinite(np.load(REAL / f"capture_00{number}_packets.npz")["range_m"])
    xyz = np.load(REAL / f"capture_00{number}.npy")
    until = np.cumsum(returned.sum(axis=1))
    packet, slot = np.nonzero(returned[first : first + 50])
    cloud = np.zeros(len(packet), CLOUD)
    points = xyz[until[first + 49] - len(packet) : until[first + 49]]
    for name, line in zip("xyz", points.T, strict=True):
        cloud[name] = line
    cloud["time"] = packet * 4.639e-3 + slot * 4.639e-3 / 600
    return Sweep(HostNs(first), HostNs(first + 50), cloud, 50, 0)


@pytest.mark.skipif(not REAL.exists(), reason="the recordings are not here")
@pytest.mark.parametrize("number", [1, 2])
def test_the_halves_of_a_real_unit_come_together_within_a_second(number: int) -> None:
    intrinsics, gaps = LidarIntrinsics(), []
    for first in range(0, 500, 50):
        sweep = _captured(number, first)
        better = intrinsics.corrected(sweep)
        intrinsics.learn(better, better.points, at_rest=True)
        sides = halves(sweep.points)
        assert sides is not None
        found = [between_halves(one.points, one.points, sides) for one in (sweep, better)]
        gaps.append([np.median(np.abs(item.gap)) for item in found if item is not None])
    reported, corrected = np.median(gaps[5:], axis=0)
    assert reported > 0.018
    assert corrected < 0.5 * reported


@pytest.mark.skipif(not REAL.exists(), reason="the recordings are not here")
def test_two_captures_of_a_real_unit_agree_but_for_where_the_mirror_begins() -> None:
    """`l2lidar calibrate still` finds 0.36 and 0.39 degrees, and alpha 0.27 degrees apart."""
    found = []
    for number in (1, 2):
        intrinsics = LidarIntrinsics()
        intrinsics.learn_at_rest([_captured(number, first) for first in range(0, 1000, 50)])
        found.append(np.degrees(intrinsics._estimate))
    apart = np.array(found) @ (1.0, -0.7, 0.0)
    assert apart == pytest.approx([0.375, 0.375], abs=0.03)
    assert abs(found[0][2] - found[1][2]) == pytest.approx(0.23, abs=0.05)


def test_the_odometry_of_an_uncalibrated_unit_is_better_for_it() -> None:
    """Of 8 s the errors differ twofold by chance, so they are taken over three recordings."""
    squares = np.zeros((3, 2))
    for number in range(3):
        run = record("yard", "walk", number + 1, 8.0, unit="typical")
        some = list(sweeps(run, "turn"))
        for correct in (False, True):
            odometry = Odometry(OdometryConfig(correct_beams=correct), T_CLOUD_IMU)
            squares[number, int(correct)] = np.mean(errors(run, feed(odometry, run, some)) ** 2)
    rms = np.sqrt(squares.mean(axis=0))
    assert rms[1] < 0.75 * rms[0]
    assert (squares[:, 1] < squares[:, 0]).all()


def resting() -> Any:
    """Return 4 s of IMU samples at rest, from 0.4 s before the first turn."""
    rng = np.random.default_rng(0)
    imu = np.zeros(1000, IMU_SAMPLE)
    imu["stamp"] = np.arange(-100, 900) * 4_000_000
    imu["angular_velocity"] = 0.02 * rng.standard_normal((1000, 3))
    imu["linear_acceleration"] = rng.normal((0.0, 0.0, STANDARD_GRAVITY), 0.05, (1000, 3))
    return imu


def test_a_map_begun_at_rest_is_begun_again_once_the_beams_are_known() -> None:
    """What was mapped before does not stay beside it, so later sweeps fit as well as they can."""
    residuals = []
    for correct in (False, True):
        odometry = Odometry(OdometryConfig(correct_beams=correct), np.eye(4))
        odometry.imu(resting())
        estimates = [item for k in range(14) for item in odometry.register(turn(UNIT, k)[0])]
        assert odometry.phase is Phase.STATIONARY
        residuals.append(np.mean([item.quality.residual_m for item in estimates[-4:]]))
    assert residuals[1] < 0.012  # of 10 mm of range noise
    assert residuals[1] < 0.8 * residuals[0]


def test_a_run_over_a_recording_says_what_was_corrected() -> None:
    for unit, said in ((UNIT, 1), ((0.0, 0.0, 0.0), 0)):
        turns = [turn(unit, k)[0] for k in range(12)]
        run = run_events(iter([(0, resting()), *((int(one.end), one) for one in turns)]), CONFIG)
        notes = [note for note in run.report if "l2lidar calibrate still" in note]
        assert len(notes) == said


def test_a_rest_is_mapped_again_with_each_thing_that_becomes_known() -> None:
    odometry, _ = at_rest()
    assert odometry.motion is not None
    odometry._first_rest.end_with(*odometry._posterior)
    for _ in range(2):
        before = odometry.matcher
        assert not odometry._map_ended_rest(odometry.motion)  # nothing is known better
        odometry._intrinsics.ranges.correction += 0.03
        assert odometry._map_ended_rest(odometry.motion)
        assert odometry.matcher is not before
        assert odometry._first_rest.initializer.matcher is odometry.matcher


def test_a_rest_before_a_gap_of_the_clock_is_not_mapped_again() -> None:
    odometry, some = at_rest()
    assert odometry.motion is not None
    odometry._first_rest.end_with(*odometry._posterior)
    odometry._begin_time_line(HostNs(some[-1].end + 1))
    odometry._intrinsics.ranges.correction += 0.03
    assert not odometry._map_ended_rest(odometry.motion)
