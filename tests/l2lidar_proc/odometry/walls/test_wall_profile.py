"""The profile of walls: what a spot is, which velocity a corridor tells, and how certain it is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from l2lidar_node.types import F64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.odometry.walls import wall_profile
from l2lidar_proc.odometry.walls.wall_profile import (
    SPOT,
    Spots,
    WallProfile,
    extract_spots,
    log_likelihood,
    velocity_likelihood,
)
from tests.support.passed_walls import (
    AXES,
    DOORS,
    EPOCH,
    HALF_WIDTH,
    NICHES,
    PAINTED,
    SPEED,
    SWEEP_S,
    Opening,
    known,
    passed,
    state_at,
    swept,
)

ERRORS = np.linspace(-0.4, 0.4, 81)


def likelihood(spots: Spots) -> F64:
    now = int(spots["stamp"].max())
    return np.asarray(np.log(velocity_likelihood(spots, now, AXES, ERRORS)))


def mean_and_sigma(logs: F64) -> tuple[float, float]:
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    mean = float(weights @ ERRORS)
    return mean, float(np.sqrt(weights @ (ERRORS - mean) ** 2))


# ---- spots


def upright(count: int = 20, across: float = 1.2, along: float = 3.01, up: float = 0.61) -> F64:
    """Return points of an upright line on the left wall, within one cell."""
    points = np.zeros((count, 3))
    points[:, 0] = along
    points[:, 1] = across
    points[:, 2] = np.linspace(up, up + 0.28, count)
    return points


def extracted(points: F64, intensities: F64 | None = None) -> Spots:
    stamps = np.arange(len(points)) * 1000
    return extract_spots(points, stamps, intensities, points, AXES)


def test_an_upright_line_is_a_spot() -> None:
    points = upright()
    found = extracted(points, np.full(20, 100.0))
    assert len(found) == 1
    assert found["place"][0] == pytest.approx(points.mean(axis=0))
    assert found["sight"][0] == pytest.approx(points.mean(axis=0))
    assert found["stamp"][0] == 9500
    assert found["points"][0] == 20
    assert found["brightness"][0] == pytest.approx(np.log(100.0))


def test_cells_are_small_and_sides_apart() -> None:
    lines = [upright(), upright(across=-1.2), upright(along=3.04), upright(up=0.91)]
    assert len(extracted(np.concatenate(lines))) == 4


@pytest.mark.parametrize(
    ("change", "is_spot"),
    [
        ("none", True),
        ("floor", False),
        ("thick", False),
        ("two points", False),
        ("near the axis", False),
    ],
)
def test_only_upright_faces_beside_the_sensor_are_spots(change: str, is_spot: bool) -> None:
    points = upright()
    if change == "floor":
        points[:, 1], points[:, 2] = np.linspace(1.0, 1.05, 20), 0.7
    elif change == "thick":
        points[::2, 1] += 0.07
    elif change == "two points":
        points = points[:2]
    elif change == "near the axis":
        points[:, 1] = 0.25
    assert len(extracted(points)) == is_spot


def test_points_without_an_intensity_are_left_out_if_others_have_one() -> None:
    points = np.concatenate([upright(), upright()])
    bad = np.resize([0.0, np.nan, np.inf, -1.0], 20)
    both = np.concatenate([np.full(20, 50.0), bad])
    found = extracted(points, both)
    assert found["points"].tolist() == [20.0]
    assert found["brightness"][0] == pytest.approx(np.log(50.0))
    assert extracted(points, np.concatenate([bad, bad]))["points"].tolist() == [40.0]
    assert extracted(points, None)["brightness"].tolist() == [0.0]


def test_an_empty_sweep_has_no_spots() -> None:
    assert len(extracted(np.zeros((0, 3)))) == 0


def test_the_number_of_spots_is_bounded() -> None:
    lines = [upright(along=0.01 + 0.03 * k) for k in range(2 * tuning.PROFILE_SPOTS)]
    assert 0 < len(extracted(np.concatenate(lines))) <= tuning.PROFILE_SPOTS


# ---- likelihood


@pytest.mark.parametrize("error", [-0.15, 0.0, 0.1])
@pytest.mark.parametrize(
    ("openings", "has_intensity"),
    [(PAINTED, True), (NICHES, True), (NICHES, False), (DOORS, True), (DOORS, False)],
)
def test_edges_tell_the_velocity(
    openings: tuple[Opening, ...], has_intensity: bool, error: float
) -> None:
    spots = passed(3, openings, error, has_intensity=has_intensity)
    mean, sigma = mean_and_sigma(likelihood(spots))
    assert sigma < 0.08
    assert abs(mean + error) < 3.0 * np.hypot(sigma, 0.01)


@pytest.mark.parametrize("bend", [0.0, 0.002])
@pytest.mark.parametrize("error", [-0.2, 0.0])
def test_bare_walls_leave_the_velocity_open(error: float, bend: float) -> None:
    spots = passed(4, (), error, bend=bend)
    logs = likelihood(spots)
    near = np.abs(ERRORS) < 0.2
    assert np.ptp(logs[near]) < 3.0


def test_a_bend_of_the_walls_is_no_edge() -> None:
    straight, bent = (passed(5, DOORS, 0.1, bend=bend) for bend in (0.0, 0.003))
    (mean, sigma), (other, _) = (mean_and_sigma(likelihood(s)) for s in (straight, bent))
    assert other == pytest.approx(mean, abs=0.3 * sigma)


@pytest.mark.parametrize("openings", [DOORS, NICHES])
def test_what_niches_hide_is_no_motion(openings: tuple[Opening, ...]) -> None:
    """The part of a niche that its near edge hides shrinks as it is passed; reveals are deep."""
    found = np.array(
        [
            mean_and_sigma(likelihood(passed(seed, openings, 0.0, seconds=4.0)))
            for seed in range(60)
        ]
    )
    assert abs(found[:, 0].mean()) < 0.015
    assert 0.3 < np.mean((found[:, 0] / found[:, 1]) ** 2) < 2.0


def test_a_shift_of_all_spots_changes_nothing() -> None:
    spots = passed(6, DOORS, 0.1)
    before = likelihood(spots)
    spots["place"] += (17.0, 0.0, 0.0)
    assert likelihood(spots) == pytest.approx(before, abs=1e-6)


def test_the_direction_may_be_turned_round() -> None:
    spots = passed(7, DOORS, 0.1)
    now, turned = int(spots["stamp"].max()), np.diag([-1.0, -1.0, 1.0])
    found = log_likelihood(spots, now, turned, -ERRORS)
    assert found == pytest.approx(log_likelihood(spots, now, AXES, ERRORS), rel=1e-3)


def test_an_acceleration_shears_what_was_seen_before_by_its_square() -> None:
    """Both errors at once, against spots that a sensor with them has placed."""
    spots = passed(3, DOORS, 0.0, seconds=4.0)
    now, error, acceleration = int(state_at(4.0).stamp), 0.3, -0.4
    age = 1e-9 * (now - spots["stamp"])
    off = spots.copy()
    off["place"][:, 0] += error * age - 0.5 * acceleration * age**2
    right = log_likelihood(spots, now, AXES, np.zeros(1))
    assert log_likelihood(
        off, now, AXES, np.array([error]), np.array([acceleration])
    ) == pytest.approx(right, rel=0.02)
    for wrong in (0.0, 0.4):
        found = log_likelihood(off, now, AXES, np.array([error]), np.array([wrong]))
        assert found[0] < right[0] - 100.0


@pytest.mark.parametrize("lean", [0.04, -0.06])
def test_walls_that_seem_to_lean_are_walls(lean: float) -> None:
    """A sensor whose roll is off sees them so: no spot counted, and it ended 12 m off."""
    spots = passed(5, DOORS, 0.1)
    upright_ones = likelihood(spots)
    spots["place"][:, 1] += lean * (spots["place"][:, 2] + 0.5)
    (mean, sigma), (expected, _) = mean_and_sigma(likelihood(spots)), mean_and_sigma(upright_ones)
    assert sigma < 0.08
    assert mean == pytest.approx(expected, abs=sigma)


def chain(
    brightness: list[float], along: list[float], *, copies: int = tuning.PROFILE_SIDE
) -> Spots:
    """Return the spots of a row of a bare left wall, as often as it takes to be one."""
    found = np.zeros(len(along) * copies, SPOT)
    found["stamp"] = EPOCH
    found["points"] = 9
    found["sight"] = 0.0, HALF_WIDTH, 0.0
    found["place"] = 0.0, HALF_WIDTH, 0.1
    found["place"][:, 0] = np.repeat(along, copies)
    found["brightness"] = np.repeat(brightness, copies)
    return found


def test_neighbors_are_alike_or_there_is_an_edge_between_them() -> None:
    """Against the densities of a normal distribution and the probability of an edge."""
    copies, step, apart = tuning.PROFILE_SIDE, 0.4, 0.5
    spots = chain([0.0, step, step], [0.0, apart, 2.0 * apart], copies=copies)
    spots["brightness"][:copies] += np.resize([0.01, -0.01], copies)  # a scatter, for the trend
    samples = wall_profile._samples(spots, EPOCH, AXES)
    found = log_likelihood(spots, EPOCH, AXES, np.zeros(1))

    def log_normal(change: F64, variance: F64) -> F64:
        return np.asarray(-0.5 * (change**2 / variance + np.log(variance)))

    gaps = np.diff(samples["along"])
    stays, edge = np.zeros(len(gaps)), np.zeros(len(gaps))
    for name, jump in (
        ("brightness", tuning.PROFILE_BRIGHTNESS[2]),
        ("depth", tuning.PROFILE_DEPTH[3]),
    ):
        change = np.diff(samples[name][:, 0])
        variance = samples[name][1:, 1] + samples[name][:-1, 1]
        stays += log_normal(change, variance)
        edge += log_normal(change, variance + jump**2)
    none = np.exp(-tuning.PROFILE_RATE * (gaps + tuning.PROFILE_EDGE))
    expected = np.log(none * np.exp(stays) + (1.0 - none) * np.exp(edge)).sum()
    assert found[0] == pytest.approx(expected, rel=1e-9)


def test_walls_and_rows_are_apart() -> None:
    """The likelihood of two walls is the product of theirs, however far errors move spots."""
    spots = passed(11, DOORS, 0.1)
    is_near = np.abs(spots["place"][:, 0] - 4.0) < 1.0
    errors, now = np.array([-3.0, -1.0, 0.0, 2.0]), int(spots["stamp"].max())
    for kept in (spots, spots[is_near]):
        is_left = kept["sight"][:, 1] > 0.0
        parts = [log_likelihood(kept[side], now, AXES, errors) for side in (is_left, ~is_left)]
        assert (np.abs(parts) > 1.0).all()
        assert log_likelihood(kept, now, AXES, errors) == pytest.approx(sum(parts), rel=1e-6)


def test_variances_are_those_of_points_and_reach() -> None:
    spots = chain([0.0], [0.0])
    spots["points"][::2] = 4
    spots["sight"][:, 0] = np.linspace(0.0, 8.0, len(spots))
    samples = wall_profile._samples(spots, EPOCH, AXES)
    reach = np.linalg.norm(spots["sight"], axis=1)
    assert samples["brightness"][:, 1] == pytest.approx(0.03**2 + 0.05**2 / spots["points"])
    depth = 0.01**2 + (0.005 * reach) ** 2 + 0.012**2 / spots["points"]
    assert samples["depth"][:, 1] == pytest.approx(depth)


def test_a_few_spots_are_no_wall() -> None:
    spots = chain([0.0], [0.0], copies=tuning.PROFILE_SIDE)
    assert len(wall_profile._samples(spots, EPOCH, AXES)) == len(spots)
    assert len(wall_profile._samples(spots[1:], EPOCH, AXES)) == 0
    assert log_likelihood(spots[1:], EPOCH, AXES, np.zeros(3)).tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("share", "depth", "is_wall"),
    [
        (0.03, -0.5, True),  # a little stands before it
        (0.08, -0.5, False),
        (0.08, -0.06, True),  # within its noise
        (0.15, 0.5, True),  # niches
        (0.3, -0.5, False),
    ],
)
def test_what_stands_before_a_wall_rules_it_out(share: float, depth: float, is_wall: bool) -> None:
    """What it hides would tell a velocity, as the edge of that moves with the view."""
    spots = passed(12, (), 0.0)
    spots = spots[spots["sight"][:, 1] > 0.0]
    rng = np.random.default_rng(12)
    others = rng.random(len(spots)) < share
    spots["place"][others, 1] += depth
    assert (len(wall_profile._samples(spots, int(spots["stamp"].max()), AXES)) > 0) == is_wall


@pytest.mark.parametrize(("place", "speed"), [(6.0, 0.0), (2.5, SPEED), (-0.5, 2.0)])
def test_people_before_a_wall_say_nothing_about_it(place: float, speed: float) -> None:
    """One who walks beside the sensor looks like a rim of its view: 42 m off in a corridor."""
    spots = passed(14, DOORS, 0.2, seconds=4.0)
    now, is_right = int(spots["stamp"].max()), spots["sight"][:, 1] < 0.0
    seconds = 1e-9 * (spots["stamp"] - EPOCH)
    person = (spots["place"][:, 0] - place - (speed + 0.2) * seconds) / 0.08
    is_hidden = is_right & (np.abs(person) < 1.0)
    assert 0.01 < np.count_nonzero(is_hidden) / np.count_nonzero(is_right) < 0.06
    depth = 0.04 + 0.15 * np.sqrt(1.0 - np.minimum(np.abs(person[is_hidden]), 1.0))
    spots["place"][is_hidden, 1] += depth
    spots["brightness"][is_hidden] -= 0.5
    found = log_likelihood(spots, now, AXES, ERRORS)
    alone = log_likelihood(spots[~is_hidden], now, AXES, ERRORS)
    assert found - found.max() == pytest.approx(alone - alone.max(), abs=0.05 * np.ptp(alone))


@pytest.mark.parametrize(
    ("share", "depth", "are"),
    [(0.0, 0.0, True), (0.25, -0.6, True), (0.25, 0.5, True), (0.6, -0.6, False)],
)
def test_most_spots_of_a_wall_make_one_whatever_stands_before_it(
    share: float, depth: float, are: bool
) -> None:
    rng = np.random.default_rng(3)
    spots = swept(rng, 2.0, (), 0.0)
    some = rng.random(len(spots)) < share
    spots["place"][some, 1] += depth * np.sign(spots["sight"][some, 1])
    spots["place"][some, 1] += 0.1 * rng.standard_normal(int(some.sum()))
    assert wall_profile.are_walls(spots, AXES) == are
    assert not wall_profile.are_walls(spots[: tuning.PROFILE_SIDE - 1], AXES)


def test_scattered_things_are_no_wall() -> None:
    spots = passed(13, (), 0.0)
    rng = np.random.default_rng(13)
    spots["place"][:, 1] += 0.05 * rng.standard_normal(len(spots))
    assert len(wall_profile._samples(spots, int(spots["stamp"].max()), AXES)) == 0


def test_errors_are_compared_finely_and_not_beyond_reason() -> None:
    few, many = wall_profile._candidates(0.01), wall_profile._candidates(5.0)
    assert few.max() == pytest.approx(0.04)
    assert len(few) == 2 * tuning.PROFILE_STEPS + 1
    assert many.max() == pytest.approx(tuning.PROFILE_REACH)
    assert np.diff(many).max() <= tuning.PROFILE_STEP + 1e-12


def test_the_trend_of_a_wall_is_removed_and_edges_stay() -> None:
    rng = np.random.default_rng(8)
    x = np.sort(rng.uniform(-6.0, 6.0, 800))
    step = np.where((x > 1.0) & (x < 2.0), 0.3, 0.0)
    rest = wall_profile._without_trend(
        0.5 + 0.1 * x + 0.02 * x * x + step + 0.01 * rng.standard_normal(800), x
    )
    assert np.abs(np.median(rest[step == 0.0])) < 0.002
    assert np.median(rest[step > 0.0]) == pytest.approx(0.3, abs=0.01)


# ---- state


def driven(
    seed: int, openings: tuple[Opening, ...], error: float, sigma: float, seconds: float = 5.0
) -> tuple[InertialState, F64]:
    """Return what is known of the velocity at the end of a drive past some openings."""
    rng = np.random.default_rng(seed)
    profile, state, covariance = WallProfile(), state_at(0.0, error), known(sigma)
    for time in np.arange(0.0, seconds, SWEEP_S).tolist():
        lasted = time - (int(state.stamp) - EPOCH) * 1e-9
        state = dataclasses.replace(
            state,
            stamp=HostNs(EPOCH + round(time * 1e9)),
            position=state.position + lasted * state.velocity,
        )
        found = swept(rng, time, openings, 0.0)
        found["place"][:, 0] += state.position[0] - SPEED * time
        state, covariance = profile.update(state, covariance, found, AXES)
    return state, covariance


def test_a_wrong_velocity_is_corrected() -> None:
    state, covariance = driven(1, DOORS, 0.15, 0.15)
    sigma = np.sqrt(covariance[6, 6])
    assert sigma < 0.07
    assert abs(state.velocity[0] - SPEED) < 3.0 * sigma


@pytest.mark.parametrize("openings", [PAINTED, DOORS, NICHES])
def test_the_covariance_tells_the_error(openings: tuple[Opening, ...]) -> None:
    """The mean of the NEES is 1 if it is right."""
    rng = np.random.default_rng(2)
    nees = []
    for seed in range(40):
        error = 0.1 * rng.standard_normal()
        state, covariance = driven(seed, openings, error, 0.1)
        nees.append((state.velocity[0] - SPEED) ** 2 / covariance[6, 6])
    assert 0.15 < np.mean(nees) < 1.5
    assert np.mean(np.array(nees) < 3.84) > 0.9  # the bound of 95 %


def test_what_it_measures_is_the_velocity_in_the_middle() -> None:
    """A velocity known now, of a wrong acceleration: the bias of the accelerometer explains it."""
    error, seconds = 0.1, 4.0
    state, covariance = state_at(seconds, error), 1e-10 * np.eye(eskf.ERRORS)
    covariance[eskf.ACCEL_BIAS, eskf.ACCEL_BIAS] = 0.1**2 * np.eye(3)
    spots = passed(1, DOORS, error, seconds=seconds)
    after, posterior = WallProfile().update(state, covariance, spots, AXES)
    assert after.velocity[0] == pytest.approx(state.velocity[0], abs=1e-6)
    sigma = np.sqrt(posterior[eskf.ACCEL_BIAS, eskf.ACCEL_BIAS][0, 0])
    assert sigma < 0.05
    assert abs(after.accel_bias[0] + error / (0.5 * seconds)) < 3.0 * sigma
    assert after.accel_bias[1:] == pytest.approx([0.0, 0.0], abs=1e-6)


@pytest.mark.parametrize("sigma", [0.1, 1.0])
def test_without_walls_nothing_is_learned(sigma: float) -> None:
    """However uncertain the velocity is."""
    spots = passed(1, (), 0.0, seconds=4.0)
    spots["place"][:, 1] += 0.2 * np.random.default_rng(1).standard_normal(len(spots))
    state = state_at(4.0)
    after, covariance = WallProfile().update(state, known(sigma), spots, AXES)
    assert after.velocity[0] == pytest.approx(SPEED)
    assert covariance == pytest.approx(known(sigma))


def test_a_time_line_that_begins_earlier_is_measured_at_once() -> None:
    profile = WallProfile()
    hour = 3600.0
    spots = passed(1, DOORS, 0.1, seconds=4.0)
    later = spots.copy()
    later["stamp"] += round(hour * 1e9)
    profile.update(state_at(4.0 + hour, 0.1), known(0.1), later, AXES)
    profile.clear()
    after, _ = profile.update(state_at(4.0, 0.1), known(0.1), spots, AXES)
    assert after.velocity[0] < SPEED + 0.1 - 0.01


def test_a_well_known_velocity_is_left_alone() -> None:
    state = state_at(4.0, 0.1)
    spots = passed(1, DOORS, 0.1, seconds=4.0)
    covariance = known(0.9 * tuning.PROFILE_SURE)
    after, posterior = WallProfile().update(state, covariance, spots, AXES)
    assert after is state
    assert posterior is covariance
    after, _ = WallProfile().update(state, known(1.1 * tuning.PROFILE_SURE), spots, AXES)
    assert after.velocity[0] < state.velocity[0]


def test_bare_walls_do_no_harm() -> None:
    moves, sigmas = [], []
    for seed in range(20):
        state, covariance = driven(seed, (), 0.0, 0.05)
        moves.append(state.velocity[0] - SPEED)
        sigmas.append(np.sqrt(covariance[6, 6]))
    assert np.abs(moves).max() < 0.025
    assert np.mean(sigmas) > 0.045


def test_the_velocity_is_that_of_the_middle() -> None:
    """Against numerical derivatives of the velocity some seconds ago."""
    rng = np.random.default_rng(9)
    state = state_at(1.0).boxplus(rng.normal(0.0, 0.3, eskf.ERRORS))
    along, age, force = np.array([0.8, 0.6, 0.0]), 2.5, np.array([0.1, -0.2, 9.7])

    def velocity(one: InertialState) -> float:
        # the attitude is taken for known
        sensed = state.rotation @ (force - one.accel_bias) + one.gravity
        return float(along @ (one.velocity - age * sensed))

    h = wall_profile.velocity_jacobian(state, age, along)
    for k in range(eskf.ERRORS):
        if k in range(*eskf.ROTATION.indices(eskf.ERRORS)):
            continue
        step = np.zeros(eskf.ERRORS)
        step[k] = 1e-5
        slope = (velocity(state.boxplus(step)) - velocity(state.boxplus(-step))) / 2e-5
        assert h[k] == pytest.approx(slope, abs=1e-6)


def test_the_acceleration_is_what_gravity_and_the_accelerometer_make() -> None:
    """Against numerical derivatives."""
    rng = np.random.default_rng(9)
    state = state_at(1.0).boxplus(rng.normal(0.0, 0.3, eskf.ERRORS))
    along, force = np.array([0.8, 0.6, 0.0]), np.array([0.1, -0.2, 9.7])
    h = wall_profile.acceleration_jacobian(state, along)
    for k in range(eskf.ERRORS):
        if k in range(*eskf.ROTATION.indices(eskf.ERRORS)):
            continue  # the attitude is taken for known
        step = np.zeros(eskf.ERRORS)
        step[k] = 1e-5
        there, back = (
            along @ (state.rotation @ (force - one.accel_bias) + one.gravity)
            for one in (state.boxplus(step), state.boxplus(-step))
        )
        assert h[k] == pytest.approx((there - back) / 2e-5, abs=1e-6)


def test_spots_are_compared_about_once_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    instants: list[int] = []

    def noted(spots: Spots, now: int, axes: F64, errors: F64) -> F64:
        instants.append(now)
        return log_likelihood(spots, now, axes, errors)

    monkeypatch.setattr(wall_profile, "log_likelihood", noted)
    driven(1, DOORS, 0.0, 0.1, seconds=10.0)
    assert instants[0] - EPOCH >= tuning.PROFILE_SPAN_NS
    pauses = np.diff(instants)
    assert pauses.min() >= tuning.PROFILE_PAUSE_NS
    assert pauses.max() <= tuning.PROFILE_PAUSE_NS + SWEEP_S * 1e9 + 1


def test_walls_do_not_change_with_the_incidence_of_a_sensor_that_sways() -> None:
    """Bare walls tell no velocity then, and doors the same one as without."""
    now, errors = int(state_at(2.2).stamp), np.linspace(-2.0, 2.0, 41)
    for seed in range(4):
        spots = passed(seed, (), 0.0, sway=0.25, seconds=2.2)
        assert np.ptp(log_likelihood(spots, now, AXES, errors)) < 100.0
        steady, swaying = (
            log_likelihood(
                passed(seed, DOORS, 0.1, sway=sway), int(state_at(5.5).stamp), AXES, ERRORS
            )
            for sway in (0.0, 0.25)
        )
        assert ERRORS[swaying.argmax()] == pytest.approx(ERRORS[steady.argmax()], abs=0.02)


def test_what_is_seen_through_an_opening_is_no_part_of_the_wall() -> None:
    """Of a doorway beside a sensor at rest, each view of the next room is another one."""
    spots = passed(1, DOORS, 0.0)
    now = int(state_at(5.5).stamp)
    through = spots[::20].copy()
    for name in ("place", "sight"):
        through[name][:, 1] *= 4.0
    both = wall_profile._samples(np.concatenate((spots, through)), now, AXES)
    assert len(both) == len(wall_profile._samples(spots, now, AXES))
    assert both["depth"][:, 0].max() < tuning.PROFILE_BEHIND


def test_spots_follow_what_the_state_has_passed() -> None:
    """A correction of place and velocity moves spots as it does the places passed."""
    profile, state = WallProfile(), state_at(2.0)
    found = swept(np.random.default_rng(1), 1.0, DOORS, 0.0)
    profile.update(state, known(0.01), found.copy(), AXES)
    change = np.zeros(eskf.ERRORS)
    change[eskf.POSITION], change[eskf.VELOCITY] = (0.5, 0.1, 0.0), (0.2, 0.3, 0.1)
    profile.correct(state, state.boxplus(change))
    moved: NDArray[np.float64] = profile._kept["place"] - found["place"]
    # across the way the sweep has measured where it was
    assert moved == pytest.approx(np.broadcast_to([0.3, 0.0, 0.0], moved.shape))


def test_spots_are_forgotten() -> None:
    profile, rng = WallProfile(), np.random.default_rng(1)
    counts = []
    for time in np.arange(0.0, 60.0, SWEEP_S).tolist():
        state = state_at(time)
        profile.update(state, known(0.1), swept(rng, time, DOORS, 0.0), AXES)
        counts.append(len(profile._kept))
    within = int(tuning.PROFILE_KEPT_NS * 1e-9 / SWEEP_S) + 2
    assert max(counts) <= within * tuning.PROFILE_SPOTS
    assert max(counts[60:]) < 1.5 * np.median(counts[60:])
    profile.clear()
    assert len(profile._kept) == 0


def test_crowded_spots_take_bounded_time(monkeypatch: pytest.MonkeyPatch) -> None:
    spots = np.resize(passed(1, DOORS, 0.1), 100_000)
    compared = wall_profile._samples

    def bounded(some: Spots, now: int, axes: F64) -> NDArray[np.void]:
        assert len(some) <= tuning.PROFILE_MOST
        return compared(some, now, axes)

    monkeypatch.setattr(wall_profile, "_samples", bounded)
    mean, sigma = mean_and_sigma(likelihood(spots))
    assert abs(mean + 0.1) < 3.0 * sigma
