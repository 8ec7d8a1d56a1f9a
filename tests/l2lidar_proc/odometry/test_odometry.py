"""The odometry against the virtual L2's truth, and what it does when something is missing."""

from __future__ import annotations

import dataclasses
from collections import Counter
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.types import F64, POINT, HostNs, Level, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion.imu_buffer import replay
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import OdometryEstimate, Status
from l2lidar_proc.odometry.interface import Phase
from l2lidar_proc.odometry.local_map.free_space import SeenThrough
from l2lidar_proc.odometry.matcher import SweepMatcher
from l2lidar_proc.odometry.odometry import Odometry
from l2lidar_proc.odometry.pipeline import OdometryPipeline, judge
from l2lidar_proc.odometry.uncertainty import MapDrift
from tests.l2lidar_proc.odometry.odometry_world import (
    T_CLOUD_IMU,
    drive,
    driven,
    errors,
    feed,
    recording,
)
from tests.support.odometry_runs import record, sweeps, truth


@pytest.mark.parametrize(
    ("scene", "motion", "cut"),
    [("room", "walk", "turn"), ("yard", "drone", "38 packets"), ("room", "trot", "half turn")],
)
def test_error_is_a_few_millimetres(scene: str, motion: str, cut: str) -> None:
    run = recording(scene, motion)
    estimates = drive(run, cut) if cut != "turn" else driven(scene, motion)
    found = errors(run, estimates)
    assert np.sqrt((found**2).mean()) < 0.006
    assert found.max() < 0.02
    assert [item.stamp for item in estimates] == sorted({item.stamp for item in estimates})
    assert not estimates[-1].status


def test_every_sweep_has_its_estimate_at_its_middle() -> None:
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))
    estimates = driven("room", "walk")
    assert [item.stamp for item in estimates] == [(one.start + one.end) // 2 for one in some]


@pytest.mark.parametrize("reference", ["start", "end"])
def test_other_references_are_stamped_and_met(reference: str) -> None:
    run = recording("room", "walk")
    estimates = drive(run, config=OdometryConfig(reference=reference))
    some = list(sweeps(run, "turn"))
    assert [item.stamp for item in estimates] == [getattr(one, reference) for one in some]
    assert errors(run, estimates).max() < 0.02


def test_covariance_and_twist_are_those_of_the_errors() -> None:
    run = recording("room", "walk")
    estimates = driven("room", "walk")[8:]
    found = errors(run, estimates)
    sigma = np.array([np.sqrt(np.trace(item.covariance[:3, :3])) for item in estimates])
    assert 0.2 < np.sqrt((found**2 / sigma**2).mean()) < 3.0
    moving = run.motion.kinematics(
        (np.array([e.stamp for e in estimates]) - sweep_epoch(run)) * 1e-9
    )
    velocity = np.array([item.velocity for item in estimates])
    assert np.abs(velocity - moving.velocity_body).max() < 0.06
    rate = np.array([item.angular_velocity for item in estimates])
    assert np.abs(rate - moving.angular_velocity).max() < 0.1


@pytest.mark.parametrize("scene", ["room", "yard"])
def test_the_covariance_of_the_velocity_is_neither_too_small_nor_too_large(
    scene: str,
) -> None:
    """Normalized squared errors (NEES); 3 is their mean if the covariance is right."""
    run = recording(scene, "walk", 14.0)
    moved = [item for item in drive(run, "half turn") if item.quality.nis_per_dof > 0.0]
    assert len(moved) > 60
    seconds = (np.array([item.stamp for item in moved]) - sweep_epoch(run)) * 1e-9
    found = np.array([item.velocity for item in moved])
    found -= run.motion.kinematics(seconds).velocity_body
    covariances = np.array([item.twist_covariance[:3, :3] for item in moved])
    nees = np.einsum("ni,ni->n", found, np.linalg.solve(covariances, found[..., None])[..., 0])
    assert 0.6 < nees.mean() < 6.0
    assert np.mean(nees < 7.8147) > 0.85  # the bound of 95 %


def test_the_velocity_may_be_that_of_another_instant_by_what_stamps_are_off(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = recording("room", "walk")
    known, sigma = drive(run)[-1], tuning.IMU_STAMP_SIGMA
    monkeypatch.setattr(tuning, "IMU_STAMP_SIGMA", 0.0)
    exact = drive(run)[-1]
    np.testing.assert_array_equal(known.T_map_lidar, exact.T_map_lidar)
    moving = run.motion.kinematics(
        (exact.stamp - sweep_epoch(run)) * 1e-9 + np.array([-0.02, 0.0, 0.02])
    )
    gained = (moving.velocity[2] - moving.velocity[0]) / 0.04
    late = sigma * gained @ rotations.matrices(moving.quaternion_wxyz[1])
    assert np.linalg.norm(late) > 1e-4
    added = known.twist_covariance - exact.twist_covariance
    np.testing.assert_allclose(added[:3, :3], np.outer(late, late), atol=0.15 * late @ late)
    np.testing.assert_allclose(added[3:], 0.0, atol=1e-15)


@pytest.mark.parametrize(
    ("scene", "unit"), [("room", "perfect"), ("yard", "perfect"), ("yard", "typical")]
)
def test_the_covariance_of_the_pose_is_neither_too_small_nor_too_large(
    scene: str, unit: str
) -> None:
    """NEES of errors relative to the first pose; 6 is their mean if the covariance is right.

    In half turns hardly anything shows whether the unit is a good one: then it is less.
    """
    run = record(scene, "walk", 1, 14.0, unit=unit)
    estimates = drive(run, "half turn")
    places, quaternions = truth(run, np.array([item.stamp for item in estimates]))
    turns = rotations.matrices(quaternions)
    nees = []
    for item, place, turn in zip(estimates, places, turns, strict=True):
        if item.quality.nis_per_dof == 0.0:
            continue
        aligned = estimates[0].T_map_lidar[:3, :3] @ turns[0].T
        off = item.T_map_lidar[:3, :3] @ (aligned @ turn).T
        shift = item.T_map_lidar[:3, 3] - estimates[0].T_map_lidar[:3, 3]
        shift = shift - aligned @ (place - places[0])
        error = np.r_[shift, rotations.log(rotations.from_matrix(off))]
        nees.append(float(error @ np.linalg.solve(item.covariance, error)))
    assert len(nees) > 60
    assert 0.5 < np.mean(nees) < 9.0
    assert np.mean(np.array(nees) < 12.5916) > 0.85  # the bound of 95 %


def test_a_unit_that_shows_its_beam_angles_is_more_certain_of_its_pose() -> None:
    run = recording("room", "walk")
    seen = driven("room", "walk")[-1]
    unseen = drive(run, config=OdometryConfig(correct_beams=False))[-1]
    # its ranges are corrected by the millimeter that planes are wrong by
    np.testing.assert_allclose(seen.T_map_lidar, unseen.T_map_lidar, atol=0.001)
    assert 0.0 < seen.quality.attitude_variance < np.diag(seen.covariance)[3:].min()
    assert (np.diag(seen.covariance)[3:] < 0.3 * np.diag(unseen.covariance)[3:]).all()


@pytest.mark.parametrize("what", ["covered", "skipped", "one wall"])
def test_no_variance_is_lowered_after_a_sweep_that_missed_a_direction(
    what: str,
) -> None:
    run = recording("room", "walk", 14.0)
    some = list(sweeps(run, "half turn"))
    middle = len(some) // 2
    points = some[middle].points
    if what == "covered":
        points = points[:5]
    elif what == "one wall":
        points = points[points["x"] > 0.9 * points["x"].max()]
    some[middle] = dataclasses.replace(some[middle], points=points)
    skips = middle if what == "skipped" else -1
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    estimates = feed(odometry, run, some, may_skip=lambda number: number == skips)
    assert len(estimates) == len(some)
    assert {Status.DEGENERATE, Status.PREDICTED} & set(estimates[middle].status)
    factors = np.array([item.quality.variance_factor for item in estimates])
    seconds = (np.array([item.stamp for item in estimates]) - estimates[middle].stamp) * 1e-9
    since = 1e-9 * tuning.NIS_WINDOW_NS
    assert (factors[(seconds > -2.0) & (seconds < 0.0)] < 0.5).all()
    assert (factors[(seconds >= 0.0) & (seconds < since)] == 1.0).all()
    assert (factors[seconds > since + 0.2] < 0.5).all()
    # what its calibration may be wrong by has not become more
    turns = np.array([item.covariance[5, 5] for item in estimates]) / tuning.UNIT_TURN**2
    assert (turns[seconds > -2.0] < 0.3).all()


@pytest.mark.parametrize("scene", ["room", "yard"])
@pytest.mark.parametrize(
    ("samples", "seconds", "fault"),
    [
        ("linear_acceleration", np.inf, "frozen"),
        ("linear_acceleration", np.inf, "zero"),
        ("angular_velocity", np.inf, "frozen"),
        ("angular_velocity", np.inf, "zero"),
        ("angular_velocity", 0.1, (3.0, 0.0, 0.0)),
        ("angular_velocity", 0.1, (0.0, 10.0, 0.0)),
    ],
)
def test_an_imu_that_fails_while_it_moves_does_not_lead_away(
    samples: str, seconds: float, fault: Any, scene: str
) -> None:
    """The sweeps show it; a gyro that stood still, or felt a turn, led 19 m away."""
    run = recording(scene, "walk")
    some = list(sweeps(run, "turn"))
    begin = int(some[len(some) // 2].start) + 70_000_000
    imu = run.imu.copy()
    since = (imu["stamp"] - begin) * 1e-9
    during = (since >= 0.0) & (since < seconds)
    if fault == "frozen":
        imu[samples][during] = imu[samples][np.argmax(during)]
    elif fault == "zero":
        imu[samples][during] = 0.0
    else:
        imu[samples][during] += fault
    estimates = drive(run, imu=imu)
    after = np.array([item.stamp for item in estimates]) > begin
    assert any(Status.SUSPECT in item.status for item in estimates)
    assert errors(run, estimates)[after].max() < 0.05


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("scene", ["room", "yard"])
def test_a_blow_of_any_kind_that_only_the_accelerometer_felt_moves_nothing(
    scene: str, seed: int
) -> None:
    """Of 3 to 40 m/s^2 for 0.05 to 0.5 s, in any direction: 18 of 60 led away by up to 20 m."""
    rng = np.random.default_rng((seed, 77))
    size, lasts = np.exp(rng.uniform(np.log(3.0), np.log(40.0))), rng.uniform(0.05, 0.5)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    run = recording(scene, "walk")
    some = list(sweeps(run, "turn"))
    begin = int(some[int(rng.integers(len(some) // 2, 3 * len(some) // 4))].start)
    begin += int(rng.uniform(0.0, 2e8))
    end = begin + int(lasts * 1e9)
    imu = run.imu.copy()
    imu["linear_acceleration"][(imu["stamp"] >= begin) & (imu["stamp"] < end)] += size * direction
    estimates = drive(run, imu=imu)
    later = np.array([item.stamp for item in estimates]) > end + 1_000_000_000
    assert later.any()
    assert errors(run, estimates)[later].max() < 0.05


@pytest.mark.parametrize("blow", [1.0, 3.0, 8.0, 12.0, 30.0])
@pytest.mark.parametrize(("scene", "axis"), [("room", 0), ("room", 1), ("yard", 0)])
def test_a_sweep_that_contradicts_the_prediction_is_aligned_without_it(
    scene: str, axis: int, blow: float
) -> None:
    """For a fifth of a second the accelerometer reports a blow that did not move the sensor."""
    run = recording(scene, "walk")
    some = list(sweeps(run, "turn"))
    middle = some[len(some) // 2].start
    imu = run.imu.copy()
    during = (imu["stamp"] >= middle) & (imu["stamp"] < middle + 200_000_000)
    imu["linear_acceleration"][during, axis] += blow
    estimates = drive(run, imu=imu)
    stamps = np.array([item.stamp for item in estimates])
    suspect = np.array([Status.SUSPECT in item.status for item in estimates])
    assert suspect.any()
    assert all(item.is_aligned for item in estimates)
    assert not suspect[stamps < middle].any()
    later = stamps > middle + 1_000_000_000
    assert later.sum() > 5
    assert errors(run, estimates)[later].max() < 0.05
    assert not suspect[later].any()


@pytest.mark.parametrize(("scene", "seed", "before"), [("room", 2, 0.0), ("warehouse", 3, 0.02)])
def test_blows_during_which_the_imu_is_silent_are_survived(
    scene: str, seed: int, before: float
) -> None:
    """Five blows turn the sensor by 4 degrees and back; of each, 52 ms of samples are lost.

    The parts of such a sweep do not fit together. Aligned all the same it gave a velocity that was
    off by 1 m/s, and a map that confirmed it.
    """
    blows = 4.5, 6.03, 7.51, 9.04, 10.57
    run = record(scene, "walk", seed, 12.0, hits=blows)
    since = (run.imu["stamp"] - sweep_epoch(run)) * 1e-9
    lost = [(since > blow - before) & (since < blow - before + 0.052) for blow in blows]
    estimates = drive(run, imu=run.imu[~np.any(lost, axis=0)])
    assert any(Status.PREDICTED in item.status for item in estimates)
    assert not any(Status.LOST in item.status for item in estimates)
    found = errors(run, estimates)
    assert found.max() < 0.1
    assert found[-3:].max() < 0.01


@pytest.mark.parametrize(("scene", "seed"), [("room", 4), ("yard", 5), ("warehouse", 4)])
def test_after_a_blow_in_a_gap_a_covered_sensor_knows_how_far_off_it_may_be(
    scene: str, seed: int
) -> None:
    """The last points come from before the blow, and tell nothing about what follows it."""
    blow, covered = 7.0, 3.0
    run = record(scene, "walk", seed, 12.0, hits=(blow,))
    since = (run.imu["stamp"] - sweep_epoch(run)) * 1e-9
    lost = (since > blow - 0.02) & (since < blow + 0.024)
    some = []
    for sweep in sweeps(run, "turn"):
        instants = (sweep.start - sweep_epoch(run)) * 1e-9 + sweep.points["time"]
        seen = (instants < blow - 0.02) | (instants > blow + covered)
        some.append(dataclasses.replace(sweep, points=sweep.points[seen]))
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    estimates = feed(odometry, run, some, run.imu[~lost])
    stamps = np.array([item.stamp for item in estimates])
    places, quaternions = truth(run, stamps)
    turn = estimates[0].T_map_lidar[:3, :3] @ rotations.matrices(quaternions[0]).T
    moved = np.array([item.T_map_lidar[:3, 3] for item in estimates])
    off = moved - moved[0] - (places - places[0]) @ turn.T
    within = np.array([item.covariance[:3, :3] for item in estimates])
    nees = (off * np.linalg.solve(within, off[..., None])[..., 0]).sum(axis=1)
    after = (stamps - sweep_epoch(run)) * 1e-9 - blow
    blind = (after > 0.0) & (after < covered - 0.05)
    assert blind.sum() > 10
    assert np.linalg.norm(off[blind], axis=1).max() > 0.5
    assert nees[blind].mean() < 6.0  # 3 on average; 5 to 17 where the blow passed for known
    assert np.linalg.norm(off[-3:], axis=1).max() < 0.02


def test_a_carrier_that_glides_from_the_first_sweep_on_does_not_rest() -> None:
    """Its IMU is as quiet as one at rest: the first sweeps tell."""
    run = record("street_block", "drone", 2, 5.0, since=7.0)
    estimates = drive(run)
    assert errors(run, estimates).max() < 0.5  # 5.7 where its rates passed for biases


@pytest.mark.parametrize("seconds", [20, 3600])
def test_a_sweep_is_aligned_again_after_the_clock_has_gone_back(seconds: int) -> None:
    """Sweeps that fit badly are aligned again once a second at most, whatever the clock said."""
    run, gone_back = recording("room", "walk", 14.0), seconds * 1_000_000_000
    some = list(sweeps(run, "turn"))
    imu = run.imu.copy()
    for at in (len(some) // 3, 3 * len(some) // 4):
        begin = some[at].start
        during = (imu["stamp"] >= begin) & (imu["stamp"] < begin + 200_000_000)
        imu["linear_acceleration"][during, 1] += 4.0
    jump = some[len(some) // 2].start
    imu["stamp"][imu["stamp"] >= jump] -= gone_back
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    estimates, first = [], 0
    for sweep in some:
        last = int(np.searchsorted(run.imu["stamp"], sweep.end)) + 1
        odometry.imu(imu[first:last])
        first = last
        back = gone_back * (sweep.start >= jump)
        moved = dataclasses.replace(
            sweep, start=HostNs(sweep.start - back), end=HostNs(sweep.end - back)
        )
        found = odometry.register(moved)
        estimates += [dataclasses.replace(one, stamp=HostNs(one.stamp + back)) for one in found]
    suspect = [Status.SUSPECT in item.status for item in estimates]
    half = len(suspect) // 2
    assert any(suspect[:half])
    assert any(suspect[half:])
    assert errors(run, estimates)[-8:].max() < 0.05


def sweep_epoch(run: Any) -> Any:
    return int(run.imu["stamp"][0])


def test_biases_and_up_are_found() -> None:
    last = driven("room", "walk")[-1]
    assert np.abs(last.gyro_bias - [0.01, -0.02, 0.015]).max() < 0.01
    assert np.linalg.norm(last.gravity) == pytest.approx(9.80665, abs=0.1)
    assert last.gravity[2] < -9.7


def test_the_vertical_of_a_map_begun_in_motion_is_found() -> None:
    run = record("room", "drone", 2, 10.4, since=5.0)
    estimates = drive(run)
    _, turns = truth(run, np.array([item.stamp for item in estimates]))

    def off(index: int, vertical: Any) -> float:
        """Return how far a direction in the map is from the vertical [deg]."""
        true = estimates[index].T_map_lidar[:3, :3] @ rotations.matrices(turns[index])[2]
        return float(np.degrees(np.arccos(true @ vertical / np.linalg.norm(vertical))))

    assert off(0, [0.0, 0.0, 1.0]) < 0.5  # floor and walls show it, and the IMU by 1.2 degrees not
    # errors relative to the first pose, which the first sweeps were hardly deskewed for
    assert np.sqrt(estimates[0].covariance[5, 5]) > 0.9 * tuning.BEGUN_IN_MOTION[1]
    assert np.sqrt(driven("room", "walk")[0].covariance[5, 5]) < 0.001
    last = estimates[-1]
    assert off(-1, -last.gravity) < 0.5
    assert np.degrees(last.tilt) == pytest.approx(off(-1, [0.0, 0.0, 1.0]), abs=0.5)
    assert np.linalg.norm(last.gravity) == pytest.approx(9.80665, abs=0.02)


def test_the_cloud_is_the_one_of_the_stamp() -> None:
    run = recording("room", "walk")
    estimates = driven("room", "walk")
    position, quaternion = truth(run, np.array([estimates[-1].stamp]))
    first, q0 = truth(run, np.array([estimates[5].stamp]))
    points = {}
    for index, p, q in ((-1, position[0], quaternion), (5, first[0], q0)):
        cloud = estimates[index].points
        xyz = np.stack([cloud[axis] for axis in "xyz"], axis=1).astype(np.float64)
        points[index] = xyz @ rotations.matrices(q)[0].T + p
    # both in the world: the ceiling is at one height
    for xyz in points.values():
        ceiling = xyz[(xyz[:, 2] > 2.72) & (np.abs(xyz[:, 0]) < 0.9)]
        assert abs(np.median(ceiling[:, 2]) - 2.8) < 0.01


def test_standing_still_stays_there() -> None:
    run = recording("room", "still", 3.0)
    estimates = drive(run)
    way = np.array([item.T_map_lidar[:3, 3] for item in estimates])
    assert np.abs(way[0]).max() < 1e-9  # the map begins at the cloud's origin, not the IMU's
    assert np.abs(way - way[0]).max() < 0.008
    assert np.abs(estimates[-1].velocity).max() < 0.02


def test_clouds_that_come_twice_or_late_do_not_keep_the_map_from_beginning() -> None:
    run = recording("room", "still", 3.0)
    some = list(sweeps(run, "turn"))[:8]
    disordered = [one for k, sweep in enumerate(some) for one in (sweep, some[max(k - 1, 0)])]
    orderly, found = (
        feed(Odometry(OdometryConfig(), T_CLOUD_IMU), run, given) for given in (some, disordered)
    )
    used = [item.stamp for item in found if Status.REFUSED not in item.status]
    assert used == [item.stamp for item in orderly]
    assert len(used) == len(some)


def test_without_imu_it_holds_and_says_so() -> None:
    run = recording("room", "walk")
    estimates = drive(run, imu=run.imu[:0])
    assert errors(run, estimates).max() < 0.04
    assert Status.NO_IMU in estimates[-1].status
    assert Status.GRAVITY_UNTRUSTED in estimates[-1].status
    assert not any(item.gravity.any() for item in estimates)


def test_imu_gap_is_bridged_and_reported() -> None:
    run = recording("room", "walk")
    seconds = (run.imu["stamp"] - sweep_epoch(run)) * 1e-9
    estimates = drive(run, imu=run.imu[(seconds < 3.6) | (seconds > 4.1)])
    assert errors(run, estimates).max() < 0.03
    assert sum(Status.IMU_GAP in e.status or Status.NO_IMU in e.status for e in estimates) >= 2
    assert Status.IMU_GAP not in estimates[-1].status


def test_doubled_gravity_is_not_trusted_and_survived() -> None:
    run = recording("room", "walk")
    imu = run.imu.copy()
    imu["linear_acceleration"] *= 2.05
    estimates = drive(run, imu=imu)
    assert all(Status.GRAVITY_UNTRUSTED in item.status for item in estimates)
    assert not any(item.gravity.any() for item in estimates)
    assert errors(run, estimates).max() < 0.04


def test_blocked_sensor_is_predicted_with_growing_covariance() -> None:
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))
    blind = slice(15, 20)
    some[blind] = [dataclasses.replace(one, points=one.points[:3]) for one in some[blind]]
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    estimates = feed(odometry, run, some)
    for item in estimates[blind]:
        assert {Status.PREDICTED, Status.SPARSE} <= set(item.status)
        assert not item.is_aligned
    traces = [np.trace(item.covariance[:3, :3]) for item in estimates[14:20]]
    assert all(later > earlier for earlier, later in pairwise(traces))
    assert traces[-1] > 4.0 * traces[0]
    assert estimates[-1].is_aligned
    assert errors(run, estimates).max() < 0.05


def test_skipped_sweeps_are_carried_by_the_imu() -> None:
    """Three of four: a computer that is four times too slow."""
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    estimates = feed(odometry, run, some, may_skip=lambda number: number > 8 and number % 4 > 0)
    assert [item.stamp for item in estimates] == [(one.start + one.end) // 2 for one in some]
    for number, item in enumerate(estimates):
        skipped = number > 8 and number % 4 > 0
        assert (Status.SKIPPED in item.status) == (Status.PREDICTED in item.status) == skipped
    found = errors(run, estimates)
    sigma = np.array([np.sqrt(np.trace(item.covariance[:3, :3])) for item in estimates])
    assert found.max() < 0.03
    # the first pose has no error by definition; found is relative to the whole way
    assert (found < 3.0 * sigma + found[0]).all()
    traces = [np.trace(item.covariance[:3, :3]) for item in estimates[12:16]]
    assert all(later > earlier for earlier, later in pairwise(traces))


def test_a_sensor_at_rest_stays_there_while_sweeps_are_skipped() -> None:
    run = recording("room", "still", 3.0)
    some = list(sweeps(run, "turn"))
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    estimates = feed(odometry, run, some, may_skip=lambda number: number % 4 > 0)
    assert sum(Status.SKIPPED in item.status for item in estimates) > len(some) // 2
    assert odometry.phase is Phase.STATIONARY
    way = np.array([item.T_map_lidar[:3, 3] for item in estimates])
    assert np.abs(way - way[0]).max() < 0.008


def test_what_the_imu_cannot_carry_is_not_skipped() -> None:
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))[:14]
    seconds = (run.imu["stamp"] - sweep_epoch(run)) * 1e-9
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    estimates = feed(odometry, run, some, run.imu[seconds < 2.0], may_skip=lambda number: True)
    without = [
        item
        for item, one in zip(estimates, some, strict=True)
        if one.end > 2.1e9 + sweep_epoch(run)
    ]
    assert len(without) > 3
    assert not any(Status.SKIPPED in item.status for item in without)


def test_only_a_backlog_makes_a_pipeline_skip_and_never_many_in_a_row() -> None:
    run = recording("room", "walk")
    for backlog, most, expected in (
        (1, 3, "0000"),
        (2, 0, "0000"),
        (2, 3, "1110"),
        (9, 1, "1010"),
    ):
        pipeline = OdometryPipeline(OdometryConfig(), T_CLOUD_IMU, max_skipped=most)
        skipped = []
        for sweep, samples in replay(list(sweeps(run, "turn"))[:12], run.imu):
            pipeline.imu(samples)
            pipeline.sweep(sweep, sweep.end, backlog)
            skipped += [Status.SKIPPED in item.status for item in pipeline.poll(sweep.end)]
        begun = skipped.index(True) if "1" in expected else 4
        assert begun < 8
        assert "".join("01"[one] for one in skipped[begun : begun + 4]) == expected


def test_a_live_odometry_begins_again_when_its_gyro_turns_out_to_measure_in_degrees() -> None:
    run = recording("yard", "walk", 11.5)
    imu = run.imu.copy()
    imu["angular_velocity"] = np.rad2deg(imu["angular_velocity"])
    pipeline = OdometryPipeline(OdometryConfig(), T_CLOUD_IMU)
    since = 0
    estimates: list[OdometryEstimate] = []
    for sweep, samples in replay(sweeps(run, "turn"), imu):
        for sample in samples.reshape(-1, 1):
            pipeline.imu(sample)
            if not since and pipeline.convention.in_degrees:
                since = int(sample["stamp"][0])
                estimates.clear()
        pipeline.sweep(sweep, sweep.end)
        estimates += pipeline.poll(sweep.end)
    assert 0 < since < imu["stamp"][-1] - 2_000_000_000
    assert errors(run, estimates).max() < 0.02
    assert len(pipeline.trajectory.poses) == len(estimates)


def test_the_newest_sample_is_not_the_one_that_comes_last() -> None:
    run = recording("room", "walk")
    pipeline = OdometryPipeline(OdometryConfig(), T_CLOUD_IMU)
    assert pipeline.newest_imu is None
    pipeline.imu(run.imu[20:60])
    pipeline.imu(run.imu[5:6])  # late
    far = run.imu[60:61].copy()
    far["stamp"] += 3_600_000_000_000  # a damaged stamp, which no other sample confirms
    pipeline.imu(far)
    assert pipeline.newest_imu == run.imu["stamp"][59]


def test_a_clock_of_clouds_that_stands_still_is_said_to() -> None:
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))[:9]
    pipeline = OdometryPipeline(OdometryConfig(), T_CLOUD_IMU)
    for number, sweep in enumerate(some):
        length = sweep.end - sweep.start
        still = dataclasses.replace(sweep, start=some[0].start, end=HostNs(some[0].start + length))
        pipeline.imu(run.imu[100 * number : 100 * (number + 1)])
        pipeline.sweep(still, sweep.end)
        pipeline.poll(HostNs(sweep.end + 1_000_000_000))
    assert pipeline.counts == {Status.REFUSED: 8}
    found = judge(pipeline.last, pipeline.sweeps, 4, pipeline.counts, Counter())
    assert (found.level, found.message) == (Level.WARN, "the stamps of the clouds do not advance")
    # a clock that stood still and goes on
    waiting = judge(None, 20, 4, pipeline.counts, Counter())
    assert waiting.message == "waiting until the first sweeps match"


def test_sweeps_that_are_held_until_the_map_begins_are_not_refused() -> None:
    run = recording("room", "walk")
    pipeline = OdometryPipeline(OdometryConfig(), T_CLOUD_IMU)
    for sweep, samples in replay(list(sweeps(run, "turn"))[:2], run.imu):
        pipeline.imu(samples)
        pipeline.sweep(sweep, sweep.end)
        assert pipeline.poll(sweep.end) == []
    assert not pipeline.counts


def test_a_skipped_sweep_is_a_warning_and_a_blocked_sensor_an_error() -> None:
    last = driven("room", "walk")[-1]
    for status, expected in (
        ((Status.PREDICTED, Status.SKIPPED), Level.WARN),
        ((Status.PREDICTED, Status.SPARSE), Level.ERROR),
        ((), Level.OK),
    ):
        one = dataclasses.replace(last, status=status)
        assert judge(one, 9, 4, Counter(), Counter()).level == expected


def test_dropped_sweeps_are_survived() -> None:
    run = recording("room", "walk")
    some = [one for k, one in enumerate(sweeps(run, "turn")) if not 12 <= k < 17]
    estimates = feed(Odometry(OdometryConfig(), T_CLOUD_IMU), run, some)
    assert errors(run, estimates).max() < 0.03


def test_corridor_tells_its_weak_direction() -> None:
    run = recording("corridor", "walk")
    estimates = drive(run)
    assert errors(run, estimates).max() < 0.05
    item = estimates[-1]
    along = np.abs(np.linalg.eigh(item.covariance[:3, :3])[1][:, -1])
    _, q = truth(run, np.array([item.stamp, estimates[0].stamp]))
    axis = rotations.matrices(q)[1].T @ [1.0, 0.0, 0.0]
    assert along @ np.abs(axis) > 0.8
    assert any(Status.DEGENERATE in one.status for one in estimates)
    # it begins with 2 s of rest, which the IMU vouches for along the corridor; what it measured
    # before the motion was noticed is not lost
    stamps = np.array([one.stamp for one in estimates])
    places = np.array([one.T_map_lidar[:3, 3] for one in estimates])
    true, _ = truth(run, stamps)
    way, true_way = (np.linalg.norm(some - some[0], axis=1) for some in (places, true))
    since = (stamps - run.imu["stamp"][0]) * 1e-9
    assert way[since < 1.9].max() < 1e-9
    walked = (since > 3.2) & (since < 3.8)
    assert true_way[walked].min() > 0.3
    assert np.abs(way - true_way)[walked].max() < 0.004


def test_no_estimate_is_faster_than_its_carrier_and_it_says_so() -> None:
    run = recording("yard", "walk")
    estimates = drive(run, config=OdometryConfig(max_speed=0.2))
    speeds = [float(np.linalg.norm(one.velocity)) for one in estimates]
    assert max(speeds) < 0.3  # of the cloud's frame, which turns about the IMU
    assert any(Status.SUSPECT in one.status for one in estimates)


def test_a_sweep_that_is_not_later_is_refused() -> None:
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    before = feed(odometry, run, some[:8])[-1]
    (again,) = odometry.register(some[6])
    assert again.status == (Status.REFUSED,)
    assert again.stamp == before.stamp


def test_clock_that_goes_back_keeps_pose_and_map() -> None:
    run = recording("room", "still", 6.0)
    some = list(sweeps(run, "turn"))
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    feed(odometry, run, some[:12])
    back = 3_600_000_000_000
    imu = run.imu.copy()
    imu["stamp"] -= back
    late = [
        dataclasses.replace(s, start=HostNs(s.start - back), end=HostNs(s.end - back))
        for s in some[12:]
    ]
    estimates = feed(odometry, run, late, imu)
    assert Status.RESTARTED in estimates[0].status
    assert np.abs(estimates[-1].T_map_lidar[:3, 3]).max() < 0.02
    assert estimates[-1].is_aligned
    # the hour between may have hidden a step
    assert np.sqrt(np.diag(estimates[-1].covariance)).min() > 0.3


def test_lost_elsewhere_it_begins_a_new_map_and_returns_into_the_old_one() -> None:
    """Carried blindly into another place, and back: the pose jumps back to where it is."""
    room, yard = recording("room", "walk", 11.5), recording("yard", "walk", 11.5)
    epoch = sweep_epoch(room)
    away, home = epoch + 3_300_000_000, epoch + 9_000_000_000
    some = [one for one in sweeps(room, "turn") if one.end < away]
    some += [one for one in sweeps(yard, "turn") if away <= one.start < home]
    some += [one for one in sweeps(room, "turn") if one.start >= home]
    estimates = feed(Odometry(OdometryConfig(), T_CLOUD_IMU), room, some)

    def largest(item: Any) -> float:
        return float(np.linalg.eigvalsh(item.covariance[:3, :3])[-1])

    lost, back = (
        next(k for k, item in enumerate(estimates) if status in item.status)
        for status in (Status.LOST, Status.RETURNED)
    )
    assert estimates[lost].stamp > away + 4_000_000_000
    there = estimates[lost + 1 : back]
    assert any(item.is_aligned for item in there)
    # a map begun elsewhere is as uncertain as the way there
    assert all(largest(item) > largest(estimates[lost - 1]) for item in there)
    assert estimates[back].stamp > home
    after = estimates[back:]
    assert len(after) > 1
    assert all(item.is_aligned for item in after)
    assert max(map(largest, after)) < 0.03**2
    before = [item for item in estimates if item.stamp < away]
    assert errors(room, before + after).max() < 0.03
    assert [item for item in estimates if Status.RETURNED in item.status] == [estimates[back]]


@pytest.mark.parametrize("is_blind", [True, False])
def test_what_is_seen_after_a_blind_stretch_and_is_not_in_the_map_begins_one_in_a_second(
    is_blind: bool,
) -> None:
    """Without the blind stretch the view may be blocked, and what the map holds is awaited."""
    room, yard = recording("room", "walk", 11.5), recording("yard", "walk", 11.5)
    dark = sweep_epoch(room) + 3_300_000_000
    light = dark + 3_000_000_000 * is_blind
    some = [one for one in sweeps(room, "turn") if one.end < dark]
    some += [
        dataclasses.replace(one, points=one.points[:20])
        for one in sweeps(room, "turn")
        if dark <= one.start < light
    ]
    some += [one for one in sweeps(yard, "turn") if one.start >= light]
    estimates = feed(Odometry(OdometryConfig(), T_CLOUD_IMU), room, some)
    lost = next(k for k, item in enumerate(estimates) if Status.LOST in item.status)
    late_ns = estimates[lost].stamp - light
    if is_blind:
        assert late_ns < 1_500_000_000
    else:
        assert late_ns > 4_500_000_000
    assert any(item.is_aligned for item in estimates[lost + 1 :])


def test_the_old_map_is_searched_again_after_the_clock_has_gone_back() -> None:
    room, yard = recording("room", "walk", 10.5), recording("yard", "walk", 10.5)
    epoch, hour = sweep_epoch(room), 3_600_000_000_000
    away, home = epoch + 3_300_000_000, epoch + 9_000_000_000
    some = [one for one in sweeps(room, "turn") if one.end < away]
    some += [one for one in sweeps(yard, "turn") if away <= one.start < home]
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    assert any(Status.LOST in item.status for item in feed(odometry, room, some))
    imu = room.imu[room.imu["stamp"] >= home].copy()
    imu["stamp"] -= hour
    back = [
        dataclasses.replace(one, start=HostNs(one.start - hour), end=HostNs(one.end - hour))
        for one in sweeps(room, "turn")
        if one.start >= home
    ]
    estimates = feed(odometry, room, back, imu)
    assert Status.RESTARTED in estimates[0].status
    assert any(Status.RETURNED in item.status for item in estimates)


def test_an_older_part_of_the_map_is_looked_for_again_after_the_clock_has_gone_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With each sweep, where the pose is as certain as the map."""
    run, hour = recording("room", "walk", 8.0), 3_600_000_000_000
    some = list(sweeps(run, "turn"))
    half = len(some) // 2
    look, places = MapDrift.more_certain_than_held, []

    def noted(drift: MapDrift, place: F64) -> NDArray[np.bool_] | None:
        places.append(place)
        return look(drift, place)

    monkeypatch.setattr(MapDrift, "more_certain_than_held", noted)
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    feed(odometry, run, some[:half])
    places.clear()
    imu = run.imu[run.imu["stamp"] >= some[half].start].copy()
    imu["stamp"] -= hour
    late = [
        dataclasses.replace(one, start=HostNs(one.start - hour), end=HostNs(one.end - hour))
        for one in some[half:]
    ]
    estimates = feed(odometry, run, late, imu)
    assert Status.RESTARTED in estimates[0].status
    assert len(places) == len(late) > 10


@pytest.mark.parametrize(("share", "is_suspect"), [(0.05, False), (0.07, True)])
def test_a_pose_from_which_walls_are_seen_through_is_suspect(
    monkeypatch: pytest.MonkeyPatch, share: float, is_suspect: bool
) -> None:
    """More than 6 % of the rays pass through them; looked at while the place is uncertain."""
    seen = SeenThrough(share, np.zeros(9, np.int64))
    monkeypatch.setattr(MapDrift, "more_certain_than_held", lambda *_: np.zeros(9, np.bool_))
    monkeypatch.setattr(SweepMatcher, "seen_through", lambda *_: seen)
    estimates = drive(recording("room", "walk", 8.0), "turn")[-10:]
    assert all((Status.SUSPECT in item.status) == is_suspect for item in estimates)


@pytest.mark.parametrize("count", [0, 1, 2, 9, 50])
@pytest.mark.parametrize("mode", ["alone", "in the middle"])
def test_thin_clouds_do_no_harm(count: int, mode: str) -> None:
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    if mode == "in the middle":
        feed(odometry, run, some[:6])
    for one in some[6:9]:
        odometry.register(dataclasses.replace(one, points=one.points[:count]))
    rest = feed(odometry, run, some[9:14])
    assert rest[-1].is_aligned


def test_equal_times_and_numbers_that_are_not_finite_do_no_harm() -> None:
    run = recording("room", "walk")
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    some = list(sweeps(run, "turn"))
    for k, one in enumerate(some[:8]):
        points = one.points.copy()
        points["x"][k::97] = np.nan
        points["z"][k::89] = np.inf
        if k == 6:
            points["time"] = 0.0
        estimates = feed(odometry, run, [dataclasses.replace(one, points=points)])
    assert np.isfinite(estimates[-1].T_map_lidar).all()
    assert estimates[-1].is_aligned


def test_reset_begins_again() -> None:
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    first = feed(odometry, run, some[:12])
    odometry.reset()
    again = feed(odometry, run, some[:12])
    np.testing.assert_array_equal(again[-1].T_map_lidar, first[-1].T_map_lidar)


def test_extrapolation_leads_to_the_next_sweep() -> None:
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    assert odometry.extrapolated(some[0].start) is None
    last = feed(odometry, run, some[:20])[-1]
    odometry.imu(run.imu[run.imu["stamp"] > some[19].end][:25])
    ahead = odometry.extrapolated(HostNs(last.stamp + 150_000_000))
    true, _ = truth(run, np.array([last.stamp, ahead.stamp]))
    moved = np.linalg.norm(ahead.T_map_lidar[:3, 3] - last.T_map_lidar[:3, 3])
    assert moved == pytest.approx(np.linalg.norm(true[1] - true[0]), abs=0.01)
    assert np.trace(ahead.covariance) > np.trace(last.covariance)


def test_any_layout_with_times_will_do() -> None:
    run = recording("room", "walk")
    layout = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("time", "<f4")]
    some = []
    for one in sweeps(run, "turn"):
        points = np.zeros(len(one.points), layout)
        for name, _ in layout:
            points[name] = one.points[name]
        some.append(Sweep(one.start, one.end, points, 0, 0))
    plain = feed(Odometry(OdometryConfig(), T_CLOUD_IMU), run, some[:10])
    assert plain[-1].points.dtype == np.dtype(layout)
    assert np.dtype(layout) != POINT
    full = feed(Odometry(OdometryConfig(), T_CLOUD_IMU), run, list(sweeps(run, "turn"))[:10])
    np.testing.assert_array_equal(plain[-1].T_map_lidar, full[-1].T_map_lidar)


def test_imu_axes_follow_the_extrinsic() -> None:
    run = recording("room", "walk")
    turned = T_CLOUD_IMU.copy()
    turned[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    imu = run.imu.copy()
    for name in ("angular_velocity", "linear_acceleration"):
        imu[name] = run.imu[name] @ turned[:3, :3]
    odometry = Odometry(OdometryConfig(), turned)
    estimates = feed(odometry, run, list(sweeps(run, "turn")), imu)
    assert errors(run, estimates).max() < 0.02
