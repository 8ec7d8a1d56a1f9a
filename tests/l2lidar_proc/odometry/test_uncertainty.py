"""The uncertainty of the map: carried by what holds a pose, and lost only back in old places."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_proc import tuning
from l2lidar_proc.odometry.intrinsics.corrections import Corrections, IntrinsicErrors
from l2lidar_proc.odometry.uncertainty import MapDrift

ZERO = np.zeros(3)
SURE = np.diag([1e-6] * 6)


def unit_alone(place: np.ndarray) -> np.ndarray:
    """Return what an undrifted map adds at a place."""
    return MapDrift().at(place)


def held_by(*sweeps: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array(sweeps), np.full(len(sweeps), 1.0 / len(sweeps))


def settle(
    drift: MapDrift,
    support: tuple[np.ndarray, np.ndarray],
    place: np.ndarray | None = None,
    weakly: tuple[np.ndarray, tuple[np.ndarray, np.ndarray]] | None = None,
) -> None:
    """Let sweep after sweep be held by the same surfaces."""
    for _ in range(40):
        drift.meet(support, place, weakly)


def test_the_first_pose_has_no_error_by_definition() -> None:
    np.testing.assert_array_equal(MapDrift().at(np.zeros(3)), np.zeros((6, 6)))


def test_the_first_pose_of_a_map_begun_in_motion_may_be_turned_against_all_others() -> None:
    drift = MapDrift()
    drift.first_pose = np.diag(np.repeat(np.square(tuning.BEGUN_IN_MOTION), 3))
    shift, turn = np.square(tuning.BEGUN_IN_MOTION)
    added = drift.at(np.array([10.0, 0.0, 0.0])) - unit_alone(np.array([10.0, 0.0, 0.0]))
    expected = np.diag([shift, shift + 100.0 * turn, shift + 100.0 * turn, turn, turn, turn])
    expected[1, 5] = expected[5, 1] = 10.0 * turn
    expected[2, 4] = expected[4, 2] = -10.0 * turn
    np.testing.assert_allclose(added, expected, atol=1e-12)
    drift.clear()
    np.testing.assert_array_equal(drift.at(ZERO), np.zeros((6, 6)))


def test_a_pose_is_as_uncertain_as_what_holds_it() -> None:
    drift = MapDrift()
    place = np.array([3.0, -2.0, 1.0])
    drift.record(0, np.zeros(3), SURE)
    doubt = np.diag([0.04, 0.01, 0.0, 0.0, 0.0, 1e-4])
    later = 10 * tuning.DRIFT_GROUP
    drift.meet(held_by(0))
    drift.record(later, place, doubt)
    drift.meet(held_by(later))
    np.testing.assert_allclose(drift.at(place) - unit_alone(place) - SURE, doubt, atol=3e-5)
    # a turn of the map there moves what is elsewhere
    far = place + np.array([10.0, 0.0, 0.0])
    moved = drift.at(far) - unit_alone(far)
    assert moved[1, 1] == pytest.approx(0.01 + 10.0**2 * 1e-4, abs=2e-4)
    # half of it held by the first part of the map
    settle(drift, held_by(0, later))
    half = drift.at(place) - unit_alone(place)
    assert half[0, 0] == pytest.approx(0.02, abs=1e-4)
    # back in the first part nothing of it is left, but a single sweep does not decide that
    drift.meet(held_by(0))
    told = (drift.at(place) - unit_alone(place))[0, 0]
    assert told == pytest.approx(tuning.DRIFT_FALL * half[0, 0], rel=0.01)
    settle(drift, held_by(0))
    np.testing.assert_allclose(drift.at(place) - unit_alone(place), SURE, atol=3e-5)


def test_around_and_back_only_the_first_map_of_the_place_holds_it() -> None:
    drift = MapDrift()
    corners = np.array([[0, 0, 0], [20, 0, 0], [20, 20, 0], [0, 20, 0], [0, 0, 0]], np.float64)
    for number, corner in enumerate(corners):
        drift.record(number * tuning.DRIFT_GROUP, corner, SURE)
    drift.meet(held_by(4 * tuning.DRIFT_GROUP))
    added = (drift.at(ZERO) - SURE)[:3, :3]
    expected = (tuning.UNIT_WAY_SHARE * 80.0) ** 2 + tuning.UNIT_SHIFT**2
    np.testing.assert_allclose(added, np.eye(3) * expected, rtol=1e-4)
    turned = (drift.at(ZERO) - SURE)[3:, 3:]
    expected = tuning.MAP_BEND**2 * 80.0 + tuning.UNIT_TURN**2
    np.testing.assert_allclose(turned, np.eye(3) * expected, rtol=1e-4)
    drift.meet(held_by(0))
    np.testing.assert_allclose(drift.at(ZERO), SURE, atol=1e-9)


def test_what_gravity_has_turned_in_the_map_the_attitude_may_be_wrong_by() -> None:
    """Gravity counts from when it is known, and only by more than a bias may feign."""
    known, unknown = 0.01 * np.eye(3), 0.1 * np.eye(3)
    drift = MapDrift()
    drift.lean(ZERO, known)  # not trusted
    drift.lean(np.array([0.6, 0.0, -9.8]), unknown)
    drift.lean(np.array([0.0, 0.0, -9.8]), known)
    for lean, counts in ((0.5 * tuning.LEAN_FROM, 0.0), (0.1, 0.1 - tuning.LEAN_FROM)):
        # rolled by a map that twists: to the sensor gravity seems to turn about x
        drift.lean(9.8 * np.array([0.0, np.sin(lean), -np.cos(lean)]), unknown)
        expected = np.zeros((6, 6))
        expected[3, 3] = counts**2
        np.testing.assert_allclose(drift.at(ZERO), expected, rtol=0.01, atol=1e-12)
    drift.clear()
    np.testing.assert_array_equal(drift.at(ZERO), np.zeros((6, 6)))


def known_so_well(
    better: float = 0.0, worse: float = 0.0, *, alpha: float = 0.0, ranges: float = 0.0
) -> IntrinsicErrors:
    return IntrinsicErrors((better, worse), alpha, ranges)


def upright(better: float = 0.0, worse: float = 0.0) -> MapDrift:
    """Return a map that knows its vertical, of a unit with beam angles known so well."""
    drift = MapDrift()
    drift.errors = drift.errors_began = known_so_well(better, worse)
    for _ in range(2):
        drift.lean(np.array([0.0, 0.0, -9.8]), 0.01 * np.eye(3))
    return drift


def test_what_is_reported_of_the_first_pose_has_no_error_by_definition() -> None:
    np.testing.assert_array_equal(upright(0.009, 0.009).reported_at(ZERO), np.zeros((6, 6)))


def test_what_ranges_are_wrong_by_moves_places_along_the_line_from_the_origin() -> None:
    place = np.array([40.0, 0.0, 30.0])
    told = upright().reported_at(place)
    along, across = place / 50.0, np.array([-0.6, 0.0, 0.8])
    least = (50.0 * tuning.MAP_SHARE) ** 2 + tuning.MAP_SHIFT**2
    assert along @ told[:3, :3] @ along == pytest.approx(0.1**2 + least, rel=1e-6)
    assert across @ told[:3, :3] @ across == pytest.approx(least, rel=1e-6)
    # far less than what has to be allowed for a unit that nobody has looked at
    assert np.trace(told) < 0.1 * np.trace(unit_alone(place))


def test_a_map_turns_about_the_vertical_as_it_grows_with_wrong_beam_angles() -> None:
    sigma, place = 0.005, np.array([20.0, 0.0, 0.0])
    added = upright(0.0, sigma).reported_at(place) - upright().reported_at(place)
    swing = (tuning.BEAM_SWING * sigma * 20.0) ** 2
    expected = [400.0 * swing, 400.0 * swing, 0.0, 0.0, 0.0, swing]
    np.testing.assert_allclose(added, np.diag(expected), rtol=1e-6, atol=1e-15)
    # where gravity does not show the vertical it may be any axis
    drift = upright(0.0, sigma)
    drift.lean(ZERO, 0.01 * np.eye(3))
    added = drift.reported_at(place) - upright().reported_at(place)
    expected = [400.0 * swing] * 3 + [swing] * 3
    np.testing.assert_allclose(added, np.diag(expected), rtol=1e-6, atol=1e-15)


def test_what_was_mapped_with_wrong_beam_angles_stays_turned() -> None:
    """Known later, they no longer turn what is added; back at the origin the turn is undone."""
    drift, way, nothing = upright(0.0, 0.005), np.array([1.0, 0.0, 0.0]), np.zeros((6, 6))
    drift.record(0, ZERO, nothing)
    drift.record(10 * tuning.DRIFT_GROUP, 10.0 * way, nothing)
    drift.errors = known_so_well()
    drift.record(150 * tuning.DRIFT_GROUP, 20.0 * way, nothing)  # in a longer history
    swing = (tuning.BEAM_SWING * 0.005 * 10.0) ** 2
    others = upright().reported_at(20.0 * way)[5, 5]
    for sweep, expected in ((150, swing), (10, swing), (0, 0.0)):
        drift.meet(held_by(sweep * tuning.DRIFT_GROUP))
        assert drift.reported_at(20.0 * way)[5, 5] == pytest.approx(others + expected, rel=1e-3)
    drift.clear()
    drift.record(0, ZERO, nothing)
    drift.record(tuning.DRIFT_GROUP, 20.0 * way, nothing)
    drift.meet(held_by(tuning.DRIFT_GROUP))
    assert drift.reported_at(20.0 * way)[5, 5] == pytest.approx(others, rel=1e-3)


@pytest.mark.parametrize(
    ("errors", "turn", "together"),
    [
        (known_so_well(alpha=0.004), tuning.ALPHA_TURN * 0.004, 1.0),
        (known_so_well(ranges=0.02), tuning.RANGE_BIAS_TURN * 0.02, tuning.BEND_CORRELATION),
    ],
)
def test_a_map_leans_by_what_alpha_and_ranges_may_be_wrong_by(
    errors: IntrinsicErrors, turn: float, together: float
) -> None:
    """Now, or when the surroundings of the origin were mapped: what was mapped then has leant."""
    place = np.array([5.0, 0.0, 0.0])
    expected = turn**2 * np.diag([0.0, 0.0, 25.0, 1.0, 1.0, 0.0])
    expected[2, 4] = expected[4, 2] = -5.0 * together * turn**2
    for name in ("errors", "errors_began"):
        drift = upright()
        setattr(drift, name, errors)
        added = drift.reported_at(place) - upright().reported_at(place)
        np.testing.assert_allclose(added, expected, rtol=1e-6, atol=1e-15)


def test_a_map_knows_with_which_corrections_it_began() -> None:
    drift, way = MapDrift(), np.array([1.0, 0.0, 0.0])
    first, later = (Corrections(np.zeros(3), ranges) for ranges in (0.01, 0.02))
    for sweep, (corrections, place) in enumerate([(first, 0.1), (later, 0.2), (first, 5.0)]):
        drift.corrections = corrections
        drift.record(sweep, place * way, np.zeros((6, 6)))
    assert drift.began is later  # the last ones before the way began
    drift.clear()
    assert drift.began is first


@pytest.mark.parametrize("first", [0.001, 0.005])
@pytest.mark.parametrize("now", [0.001, 0.005])
def test_a_map_is_turned_by_beam_angles_that_its_first_pose_did_not_know(
    first: float, now: float
) -> None:
    drift, way = upright(first), np.array([1.0, 0.0, 0.0])
    drift.record(0, ZERO, np.zeros((6, 6)))
    drift.errors = known_so_well(now)
    drift.record(1, 5.0 * way, np.zeros((6, 6)))
    added = drift.reported_at(5.0 * way) - upright().reported_at(5.0 * way)
    turn = (tuning.BEAM_TURN * max(first, now)) ** 2
    expected = np.diag([0.0, 25.0 * turn, 25.0 * turn, turn, turn, turn])
    expected[1, 5] = expected[5, 1] = 5.0 * turn  # what is turned about the origin moves
    expected[2, 4] = expected[4, 2] = -5.0 * turn
    np.testing.assert_allclose(added, expected, rtol=1e-6, atol=1e-15)


def test_no_more_is_reported_than_any_unit_is_allowed() -> None:
    drift, place = upright(0.001, 0.001), np.array([20.0, -3.0, 1.0])
    drift.record(0, ZERO, SURE)
    drift.meet(held_by(0))
    assert np.linalg.eigvalsh(drift.at(place) - drift.reported_at(place)).min() > 0.0


def test_what_is_reported_drifts_and_leans_like_the_map() -> None:
    drift = MapDrift()
    alone = drift.reported_at(ZERO)
    drift.first_pose = np.diag(np.repeat(np.square(tuning.BEGUN_IN_MOTION), 3))
    drift.record(0, ZERO, np.diag([0.04, 0.0, 0.0, 0.0, 0.0, 0.0]))
    drift.meet(held_by(0))
    for lean in (0.0, 0.1):
        drift.lean(9.8 * np.array([0.0, np.sin(lean), -np.cos(lean)]), 0.01 * np.eye(3))
    shift, turn = np.square(tuning.BEGUN_IN_MOTION)
    lean = (0.1 - tuning.LEAN_FROM) ** 2
    expected = [0.04 + shift, shift, shift, lean + turn, turn, turn]
    np.testing.assert_allclose(drift.reported_at(ZERO) - alone, np.diag(expected), rtol=0.01)


def test_all_that_has_to_be_allowed_for_is_expected_of_a_map_that_is_doubted() -> None:
    drift, covariance = MapDrift(), np.diag([0.04, 0.01, 0.01, 1e-4, 1e-4, 1e-4])
    for sweep in range(40):
        drift.record(sweep, ZERO, SURE)
    alone = drift.reported_at(ZERO)
    for sweep in range(40, 80):
        drift.record(sweep, ZERO, covariance, 0.25)
    drift.meet(held_by(60), ZERO)
    added = drift.reported_at(ZERO) - alone
    np.testing.assert_allclose(added, PLACES_ALONE * covariance, rtol=0.01, atol=1e-9)
    drift.is_doubted = True
    added = drift.reported_at(ZERO) - alone
    np.testing.assert_allclose(added, covariance, rtol=0.01, atol=1e-9)
    drift.clear()
    assert not drift.is_doubted


@pytest.mark.parametrize("gain", [0.0, 0.02, 0.3])
def test_the_drift_of_a_velocity_that_is_corrected_is_as_large_as_its_errors(gain: float) -> None:
    """The velocity is estimated by a Kalman filter in equilibrium, its error added up (NEES)."""
    rng = np.random.default_rng(5)
    along, seconds, steps, runs = np.array([0.6, 0.8, 0.0]), 0.1, 200, 400
    prior = 0.05**2
    posterior = (1.0 - gain) * prior
    measured = prior * posterior / (prior - posterior) if gain else 0.0  # noise variance
    drift = MapDrift()
    drift.record(0, ZERO, SURE)
    drift.meet(held_by(0))
    start = drift.reported_at(ZERO)
    speed = rng.normal(0.0, np.sqrt(prior), runs)
    place = np.zeros(runs)
    for _ in range(steps):
        place += speed * seconds
        drift.meet_partly(held_by(0), ZERO, along[:, None], prior * np.eye(3), seconds)
        drift.correct_velocity(prior * np.eye(3), posterior * np.eye(3))
        speed = (1.0 - gain) * speed - gain * rng.normal(0.0, np.sqrt(measured), runs)
        speed += rng.normal(0.0, np.sqrt(prior - posterior), runs)  # what the motion adds
    gained = (drift.reported_at(ZERO) - start)[:3, :3]
    variance = along @ gained @ along
    assert np.mean(place**2) / variance == pytest.approx(1.0, abs=0.15)
    # all of it along the free direction, and none of it lasts where surfaces hold the place
    np.testing.assert_allclose(gained, variance * np.outer(along, along), atol=1e-9)
    drift.meet(held_by(0))
    before = drift.reported_at(ZERO)
    drift.meet_partly(held_by(0), ZERO, along[:, None], prior * np.eye(3), seconds)
    settle(drift, held_by(0))
    assert np.trace(drift.reported_at(ZERO)) <= np.trace(before)


def test_a_velocity_that_is_right_at_once_adds_nothing() -> None:
    """However uncertain it was before: only what it errs by from now on adds up."""
    drift, free, known = MapDrift(), np.eye(3)[:, :1], 1e-10 * np.eye(3)
    drift.record(0, ZERO, SURE)
    drift.meet(held_by(0))
    for _ in range(10):
        drift.meet_partly(held_by(0), ZERO, free, np.eye(3), 0.1)
    before = drift.reported_at(ZERO)
    drift.correct_velocity(np.eye(3), known)
    for _ in range(100):
        drift.meet_partly(held_by(0), ZERO, free, known, 0.1)
    np.testing.assert_allclose(drift.reported_at(ZERO), before, rtol=1e-6, atol=1e-12)


PLACES_ALONE = np.outer(np.repeat((0.5, 1.0), 3), np.repeat((0.5, 1.0), 3))
"""What is expected of a covariance (6, 6) if a quarter of that of the place is."""


def test_decisions_allow_for_all_of_a_covariance_and_reports_for_what_is_expected() -> None:
    drift, doubt, place = upright(), np.diag([0.04] * 3 + [1e-4] * 3), np.array([5.0, 0.0, 0.0])
    drift.record(0, place, doubt, 0.25)
    drift.meet(held_by(0))
    unit = upright()
    np.testing.assert_allclose(drift.at(place) - unit.at(place), doubt, rtol=1e-6, atol=1e-9)
    expected = drift.reported_at(place) - unit.reported_at(place)
    np.testing.assert_allclose(expected, PLACES_ALONE * doubt, rtol=1e-6, atol=1e-9)
    # of sweeps that share an entry the least certain counts, in either sense
    drift.clear()
    drift.record(0, place, doubt, 0.25)
    drift.record(1, place, 0.5 * doubt, 1.0)
    drift.meet(held_by(1))
    np.testing.assert_allclose(drift.at(place) - unit.at(place), doubt, rtol=1e-6, atol=1e-9)
    expected = drift.reported_at(place) - unit.reported_at(place)
    np.testing.assert_allclose(expected, 0.5 * doubt, rtol=1e-6, atol=1e-9)


def test_chains_of_new_places_add_up_and_a_new_map_forgets() -> None:
    drift = MapDrift()
    step = np.diag([1e-4] * 3 + [0.0] * 3)
    for number in range(1000):
        drift.record(number * tuning.DRIFT_GROUP, np.zeros(3), step)
        drift.meet(held_by(number * tuning.DRIFT_GROUP))
    assert drift.at(np.zeros(3))[0, 0] == pytest.approx(0.1, rel=1e-3)
    assert np.linalg.eigvalsh(drift.at(np.array([5.0, 1.0, 0.0]))).min() > 0.0
    drift.clear()
    np.testing.assert_array_equal(drift.at(np.zeros(3)), np.zeros((6, 6)))
    drift.meet(held_by(17))  # nothing is known yet
    np.testing.assert_array_equal(drift.at(np.zeros(3)), np.zeros((6, 6)))


def test_along_a_direction_that_few_surfaces_hold_only_these_count() -> None:
    """Walls seen from afar long ago do not tell how far along them a niche is."""
    drift = MapDrift()
    along, place = np.array([0.6, 0.8, 0.0]), np.array([4.0, 2.0, 0.0])
    across = np.array([-0.8, 0.6, 0.0])
    later = 10 * tuning.DRIFT_GROUP
    drift.record(0, ZERO, SURE)
    drift.meet(held_by(0))
    drift.record(later, place, np.diag([0.04, 0.04, 0.04, 1e-6, 1e-6, 1e-6]))
    drift.meet(held_by(0), place, (along, held_by(later)))
    added = (drift.at(place) - unit_alone(place))[:3, :3]
    assert along @ added @ along == pytest.approx(0.04, abs=1e-3)
    assert across @ added @ across < 1e-3
    # the niche was there from the beginning
    settle(drift, held_by(0, later), place, (along, held_by(0)))
    added = (drift.at(place) - unit_alone(place))[:3, :3]
    assert along @ added @ along < 1e-3
    assert across @ added @ across == pytest.approx(0.02, abs=1e-3)


def test_along_a_direction_that_nothing_holds_the_errors_of_a_velocity_add_up() -> None:
    drift = MapDrift()
    free = np.array([[0.6], [0.8], [0.0]])
    place = np.array([4.0, 2.0, 0.0])
    drift.record(0, ZERO, SURE)
    drift.meet(held_by(0))
    before = drift.at(place)
    for number in range(1, 101):  # 10 s with an error of 5 cm/s
        drift.meet_partly(held_by(0), place, free, 0.05**2 * np.eye(3), 0.1)
        drift.record(number * tuning.DRIFT_GROUP, place, SURE)
    gained = (drift.at(place) - before)[:3, :3]
    assert np.sqrt(free[:, 0] @ gained @ free[:, 0]) == pytest.approx(0.5, rel=0.02)
    assert gained[2, 2] < 3e-5
    assert np.linalg.eigvalsh(drift.at(place)).min() > 0.0
    # what was put there meanwhile is as uncertain; the first part of the map is not
    drift.meet(held_by(100 * tuning.DRIFT_GROUP))
    assert drift.at(place)[0, 0] - before[0, 0] == pytest.approx(0.6**2 * 0.25, rel=0.1)
    settle(drift, held_by(0))
    np.testing.assert_allclose(drift.at(place), before, atol=1e-5)


@pytest.mark.parametrize("meets", [1, 3])
def test_few_sweeps_that_seem_to_be_held_do_not_make_a_free_direction_known(meets: int) -> None:
    """Along it the place is as uncertain as was reported of the sweep before."""
    drift, free = MapDrift(), np.eye(3)[:, :1]
    drift.record(0, ZERO, SURE)
    drift.meet(held_by(0))
    for number in range(1, 101):  # 10 s with an error of 5 cm/s
        drift.meet_partly(held_by(0), ZERO, free, 0.05**2 * np.eye(3), 0.1)
        drift.record(number * tuning.DRIFT_GROUP, ZERO, SURE)
    lost = np.array([drift.at(ZERO)[0, 0], drift.reported_at(ZERO)[0, 0]])
    for _ in range(meets):
        drift.meet(held_by(0))
    kept = np.array([drift.at(ZERO)[0, 0], drift.reported_at(ZERO)[0, 0]])
    np.testing.assert_allclose(kept, tuning.DRIFT_FALL**meets * lost, rtol=0.01)
    for _ in range(20):
        drift.meet_partly(held_by(0), ZERO, free, 1e-12 * np.eye(3), 0.1)
    now = np.array([drift.at(ZERO)[0, 0], drift.reported_at(ZERO)[0, 0]])
    np.testing.assert_allclose(now, kept, rtol=0.01)


def grown() -> MapDrift:
    """Return a map of which the sweeps from 40 on are 0.2 m uncertain along x."""
    drift = MapDrift()
    for sweep in range(80):
        doubt = SURE + np.diag([0.04 * (sweep >= 40), 0.0, 0.0, 0.0, 0.0, 0.0])
        drift.record(sweep, np.array([0.05 * sweep, 0.0, 0.0]), doubt)
    return drift


def test_sweeps_that_were_far_more_certain_are_told_apart() -> None:
    place = np.array([4.0, 0.0, 0.0])
    apart = grown().more_certain(place)
    assert apart is not None
    assert apart[:40].all()
    assert not apart[40:].any()
    certain = MapDrift()
    assert certain.more_certain(place) is None
    for sweep in range(80):
        certain.record(sweep, place, SURE)
    assert certain.more_certain(place) is None


def test_sweeps_that_were_far_more_certain_than_what_holds_a_place_now_are_told_apart() -> None:
    drift, place = grown(), np.array([4.0, 0.0, 0.0])
    drift.meet(held_by(20), place)
    assert drift.more_certain_than_held(place) is None
    drift.meet(held_by(60), place)
    apart = drift.more_certain_than_held(place)
    assert apart is not None
    assert apart[:40].all()
    assert not apart[40:].any()
    drift.meet(held_by(20), place)  # once may be by chance
    assert drift.more_certain_than_held(place) is not None
    settle(drift, held_by(20), place)
    assert drift.more_certain_than_held(place) is None
    drift.clear()
    assert drift.more_certain_than_held(place) is None


def test_all_sweeps_before_the_last_that_was_far_more_certain_are_told_apart() -> None:
    """Between them the place may have been uncertain: what was mapped then is as old."""
    drift, place = MapDrift(), np.array([4.0, 0.0, 0.0])
    for sweep in range(120):
        doubt = SURE + np.diag([0.04 * (sweep % 60 >= 30), 0.0, 0.0, 0.0, 0.0, 0.0])
        drift.record(sweep, place, doubt)
    drift.meet(held_by(110), place)
    apart = drift.more_certain_than_held(place)
    assert apart is not None
    assert apart[:88].all()
    assert not apart[92:].any()


def test_of_a_long_history_more_sweeps_share_an_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that stands for days: memory and time stay as they are."""
    place, most = np.array([4.0, 0.0, 0.0]), 64
    whole = MapDrift()
    monkeypatch.setattr(tuning, "DRIFT_ENTRIES", most)
    bounded = MapDrift()
    for sweep in range(1000):
        doubt = SURE + np.diag([0.04 * (sweep >= 300), 0.0, 0.0, 0.0, 0.0, 0.0])
        at = np.array([0.01 * sweep, 0.0, 0.0])
        bounded.record(sweep, at, doubt)
        monkeypatch.setattr(tuning, "DRIFT_ENTRIES", 10**6)
        whole.record(sweep, at, doubt)
        monkeypatch.setattr(tuning, "DRIFT_ENTRIES", most)
    assert len(bounded._history) <= most
    group = bounded._group
    assert group * most >= 1000
    found, expected = bounded.more_certain(place), whole.more_certain(place)
    assert found is not None
    assert expected is not None
    assert len(found) >= 1000
    # no sweep of an entry is taken for more certain than the least certain in it
    assert not (found[:1000] & ~expected[:1000]).any()
    assert (found[: 300 // group * group]).all()
    for drift in (whole, bounded):
        drift.meet(held_by(700))
    assert bounded.error.behind == pytest.approx(whole.error.behind, abs=0.01 * group)


def test_what_an_estimate_knows_of_the_map_stays_as_it_is() -> None:
    drift = MapDrift()
    before = drift.error
    drift.shift_first_pose(np.array([0.3, 0.0, 0.0]))
    assert not before.first_pose.any()
    assert drift.error.first_pose[0, 0] == pytest.approx(0.09)


def test_sweeps_that_share_an_entry_are_as_uncertain_as_the_least_certain() -> None:
    """The first of them came before sight was lost, the others after."""
    drift = MapDrift()
    last = tuning.DRIFT_GROUP
    drift.record(0, ZERO, SURE)
    drift.record(last, ZERO, SURE)
    drift.record(last + 1, ZERO, np.diag([0.25, 0.0, 0.0, 0.0, 0.0, 0.0]))
    drift.meet(held_by(last + 1))
    assert drift.at(ZERO)[0, 0] > 0.2


def test_each_direction_is_as_uncertain_as_what_holds_it() -> None:
    """A wall seen long ago says nothing of the place along it, even if that is not the weakest."""
    drift = grown()
    place = np.array([4.0, 0.0, 0.0])
    x, y, z = np.eye(3)
    drift.meet(held_by(0), place, (z, held_by(0)), ((x, held_by(60)), (y, held_by(0))))
    added = np.diag(drift.at(place) - unit_alone(place))
    assert added[0] == pytest.approx(0.04, rel=0.05)
    assert added[1:3].max() < 1e-3
