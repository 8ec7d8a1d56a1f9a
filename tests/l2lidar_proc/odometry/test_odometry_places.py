"""The odometry where surfaces are few: open sky, foliage, a long blindness, a direction unseen."""

from __future__ import annotations

import dataclasses
import tracemalloc
from typing import Any

import numpy as np
import pytest

from l2lidar_node.types import IMU_SAMPLE, HostNs, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import ERRORS, POSITION, ROTATION, InertialState
from l2lidar_proc.motion.static import initial_state
from l2lidar_proc.odometry.config import OdometryConfig, SurfaceConfig
from l2lidar_proc.odometry.estimate import OdometryEstimate, Status
from l2lidar_proc.odometry.local_map.surfel_map import SurfelMap
from l2lidar_proc.odometry.matcher import SweepMatcher, xyz
from l2lidar_proc.odometry.odometry import Odometry
from l2lidar_proc.odometry.prediction import Predictor
from l2lidar_proc.odometry.registration.alignment import align
from l2lidar_proc.odometry.registration.correspondences import Source
from tests.l2lidar_proc.odometry.odometry_places import SEED, driven_round, shaken, visited
from tests.l2lidar_proc.odometry.odometry_world import T_CLOUD_IMU, drive, errors, feed, recording
from tests.support.odometry_runs import record, sweeps, truth


@pytest.mark.parametrize(
    ("place", "cut"), [("bushes", "turn"), ("poles", "turn"), ("poles", "38 packets")]
)
def test_foliage_and_poles_are_enough(place: str, cut: str) -> None:
    run = visited(place)
    estimates = drive(run, cut)
    assert len(estimates) == len(list(sweeps(run, cut)))
    found = errors(run, estimates)
    assert np.sqrt((found**2).mean()) < 0.012
    assert found.max() < 0.04
    assert estimates[-1].is_aligned


def test_a_start_while_walking_along_a_corridor_is_not_taken_for_slow() -> None:
    """The first sweeps of an uncalibrated unit fit a slow walk back nearly as well."""
    run = record("furnished_office", "walk", 0, 1.4, unit="typical", speed=1.0, since=115.12)
    estimates = drive(run)
    assert len(estimates) >= 5
    assert errors(run, estimates).max() < 0.03


def test_between_walls_without_a_floor_the_height_does_not_wander_off() -> None:
    """Only the IMU and that carriers come back to their height tell it."""
    run = recording("box", "walk", 14.0)
    bare = [
        dataclasses.replace(sweep, points=sweep.points[np.abs(sweep.points["z"]) < 0.5])
        for sweep in sweeps(run, "turn")
    ]
    estimates = feed(Odometry(OdometryConfig(), T_CLOUD_IMU), run, bare)
    assert {item.status for item in estimates[5:]} == {(Status.DEGENERATE,)}
    rise_sigmas = np.sqrt([item.twist_covariance[2, 2] for item in estimates])
    assert rise_sigmas[-1] == pytest.approx(tuning.RISE_FLOOR, rel=0.1)
    true, _ = truth(run, np.array([item.stamp for item in estimates]))
    rises = np.array([item.T_map_lidar[2, 3] for item in estimates]) - true[:, 2]
    sigmas = np.sqrt([item.covariance[2, 2] for item in estimates])
    assert (np.abs(rises - rises[0]) < 3.0 * sigmas + 0.01).all()


def test_short_sweeps_below_an_open_sky_are_enough() -> None:
    """A hundred points each; half the packets of a turn do not meet what the other half saw."""
    run = visited("poles")
    estimates = drive(run, "10 packets")
    assert len(estimates) == len(list(sweeps(run, "10 packets")))
    assert all(item.is_aligned for item in estimates)
    assert errors(run, estimates).max() < 0.03


@pytest.mark.parametrize(("place", "cut"), [("bushes", "turn"), ("poles", "half turn")])
def test_without_an_imu_foliage_and_poles_are_no_worse_than_for_kiss_icp(
    place: str, cut: str
) -> None:
    run = visited(place)
    estimates = drive(run, cut, imu=run.imu[:0])
    assert all(item.is_aligned for item in estimates)
    assert errors(run, estimates).max() < 0.25


def test_the_cloud_of_a_first_part_of_a_turn_lies_where_it_says() -> None:
    run = recording("room", "drone")
    some = [one for one in sweeps(run, "turn") if one.start > run.imu["stamp"][0] + 3.1e9][:8]
    some[0] = dataclasses.replace(some[0], points=some[0].points[: len(some[0].points) // 2])
    estimates = feed(Odometry(OdometryConfig(), T_CLOUD_IMU), run, some)
    assert Status.STARTING in estimates[0].status
    surfaces = SurfelMap((0.15, 0.3))
    for item in estimates[1:]:
        surfaces.add(_placed(item))
    for item in estimates[:3]:
        distances = np.abs(surfaces.match(_placed(item)).distances)
        assert np.percentile(distances, 80) < 0.03


def test_in_foliage_it_can_start_in_motion() -> None:
    run = visited("bushes")
    moving = [one for one in sweeps(run, "turn") if one.start > run.imu["stamp"][0] + 3.5e9]
    estimates = feed(Odometry(OdometryConfig(), T_CLOUD_IMU), run, moving)
    assert len(estimates) == len(moving)
    assert all(item.is_aligned for item in estimates[5:])
    assert errors(run, estimates[5:]).max() < 0.06


def test_a_turn_that_nobody_measured_is_found_again() -> None:
    """Shaken, the rate at the beginning of a gap says nothing about its end."""
    run = shaken()
    seconds = (run.imu["stamp"] - run.imu["stamp"][0]) * 1e-9
    estimates = drive(run, imu=run.imu[(seconds < 5.0) | (seconds > 5.3)])
    after = [item for item in estimates if item.stamp > run.imu["stamp"][0] + 6_000_000_000]
    assert all(item.is_aligned for item in after)
    before = [item for item in estimates if item.stamp < run.imu["stamp"][0] + 5_000_000_000]
    assert errors(run, before + after).max() < 0.02


def test_a_long_blindness_ends_where_the_sensor_is() -> None:
    """Seconds without points, in which the sensor walks on: none of it may be taken for rest."""
    run = recording("room", "walk", 9.0)
    some = list(sweeps(run, "turn"))
    some[17:18] = [dataclasses.replace(some[30], points=some[30].points[-120:])]
    del some[18:31]
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    estimates = feed(odometry, run, some)
    found = errors(run, [item for item in estimates if item.is_aligned])
    assert found.max() < 0.02
    blind = [item for item in estimates if not item.is_aligned]
    assert blind
    assert all(np.linalg.norm(item.velocity) > 0.4 for item in blind)


def test_a_drive_goes_on_while_nothing_is_seen() -> None:
    """Slow carriers are drawn to rest after a second or two; one that was fast is not."""
    run = driven_round(11.5, 1.6)
    some = list(sweeps(run, "turn"))
    some[24:] = [dataclasses.replace(one, points=one.points[:3]) for one in some[24:]]
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    estimates = feed(odometry, run, some)
    assert not any(item.is_aligned for item in estimates[24:])
    assert errors(run, estimates[:46]).max() < 0.5  # 0.8 m if it counts as slow
    assert odometry.matcher.driving


def _placed(estimate: OdometryEstimate) -> Any:
    """Return the points of an estimate in the odometry frame, shape (N, 3)."""
    pose = estimate.T_map_lidar
    return xyz(estimate.points) @ pose[:3, :3].T + pose[:3, 3]


def _corridor(rng: np.random.Generator, count: int) -> Any:
    """Return points on the two walls, the floor and the ceiling of a corridor along x."""
    points = rng.uniform((-6.0, -1.0, -1.2), (6.0, 1.0, 1.2), (count, 3))
    side = rng.integers(0, 4, count)
    points[side == 0, 1], points[side == 1, 1] = -1.0, 1.0
    points[side == 2, 2], points[side == 3, 2] = -1.2, 1.2
    return points + 0.011 * rng.standard_normal((count, 3))


def test_noise_does_not_tell_the_place_along_a_corridor() -> None:
    rng = np.random.default_rng(SEED)
    surfaces = SurfelMap((0.15, 0.3, 0.6, 1.5))
    for _ in range(12):
        surfaces.add(_corridor(rng, 4000))
    zero = np.zeros(3)
    state = InertialState(
        HostNs(0), np.eye(3), zero, zero, zero, zero, np.array([0.0, 0.0, -9.80665])
    )
    sigma = np.full(ERRORS, 0.01)
    sigma[POSITION], sigma[ROTATION] = 0.1, 0.02
    points = _corridor(rng, 1500)
    source = Source(points, rng.uniform(-0.1, 0.1, len(points)), np.linalg.norm(points, axis=1))
    found = align(state, np.diag(sigma**2), source, surfaces, SurfaceConfig(), 100)
    across = np.sqrt(np.diag(found.covariance)[POSITION])
    assert across[0] > 0.08
    assert across[1:].max() < 0.01


def _box(rng: np.random.Generator, drops: float) -> Any:
    """Return a cloud from the middle of a box, with this share of rain drops before its walls."""
    points = rng.uniform(-3.4, 3.4, (4000, 3))
    walls, sides = rng.integers(0, 3, 4000), rng.choice((-1.0, 1.0), 4000)
    rain = rng.random(4000) < drops
    points[np.arange(4000), walls] = sides * (3.4 - rain * rng.uniform(0.2, 0.38, 4000))
    cloud = np.zeros(4000, [(name, "<f4") for name in ("x", "y", "z", "time")])
    for axis, values in zip("xyz", points.T, strict=True):
        cloud[axis] = values + 0.01 * rng.standard_normal(4000)
    return cloud


@pytest.mark.parametrize("drops", [0.0, 0.15])
def test_a_loose_prediction_is_matched_as_well_as_good_ones_were_of_late(drops: float) -> None:
    rng = np.random.default_rng(SEED)
    imu = np.zeros(100, IMU_SAMPLE)
    imu["stamp"] = np.arange(100) * 4_000_000
    imu["linear_acceleration"] = [0.0, 0.0, 9.80665]
    predictor = Predictor(OdometryConfig(), np.eye(4))
    predictor.imu(imu)
    zero = np.zeros(3)
    state = InertialState(HostNs(0), np.eye(3), zero, zero, zero, zero, np.array([0, 0, -9.8]))
    span = (HostNs(0), HostNs(200_000_000))
    matcher = SweepMatcher(OdometryConfig(), zero)

    def matched(cloud: Any, sigma: float, place: Any = zero) -> Any:
        covariance = np.diag(np.full(ERRORS, 1e-4))
        covariance[POSITION, POSITION] = sigma**2 * np.eye(3)
        here = dataclasses.replace(state, position=place)
        motion = predictor.over(here, covariance, span, HostNs(100_000_000))
        found, _ = matcher.match(matcher.source(Sweep(*span, cloud, 0, 0), motion), motion)
        return motion, found

    for _ in range(14):
        motion, _ = matched(_box(rng, 0.0), 0.01)
        matcher.extend(matcher.deskewed(Sweep(*span, _box(rng, 0.0), 0, 0), motion), motion, state)
    if drops:
        for _ in range(6):
            assert matched(_box(rng, drops), 0.01)[1] is not None
    # now a prediction that is 15 cm off, in rain: the right place or none
    _, found = matched(_box(rng, 0.15), 0.2, np.array([0.15, 0.0, 0.0]))
    assert (found is not None) == (drops > 0.0)
    if found is not None:
        assert found.inlier_ratio < tuning.INLIER_RATIO.loose
        assert np.abs(found.state.position).max() < 0.01


def test_a_pole_tells_two_directions_and_one_scan_line_none() -> None:
    rng = np.random.default_rng(SEED)
    surfaces = SurfelMap((0.3,))
    angle, height = rng.uniform(0.0, 2.0 * np.pi, 120), rng.uniform(0.01, 0.29, 120)
    pole = np.column_stack([0.15 + 0.03 * np.cos(angle), 0.15 + 0.03 * np.sin(angle), height])
    for part in np.array_split(pole, 6):
        surfaces.add(part)
    line = np.column_stack([np.full(40, 1.05), np.full(40, 0.15), np.linspace(0.01, 0.29, 40)])
    surfaces.add(line + 0.003 * rng.standard_normal(line.shape))
    probe = np.array([[0.18, 0.15, 0.1], [1.06, 0.15, 0.1]])
    assert not len(surfaces.match(probe).index)
    found = surfaces.match(probe, narrow=True)
    assert found.index.tolist() == [0, 0]
    assert np.abs(found.normals[:, 2]).max() < 0.2
    assert np.linalg.norm(found.distances) == pytest.approx(0.03, abs=0.008)
    assert (found.point_variances > 0.01**2).all()


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("noise", [0.03, 0.25])
def test_rest_is_told_from_a_walk_however_noisy_the_unit(noise: float, seed: Any) -> None:
    """Units at rest were measured from 0.03 to 0.35 rad/s."""
    rng = np.random.default_rng(seed)
    run = recording("room", "walk")
    some = run.imu[:230].copy()
    some["angular_velocity"] += noise * rng.standard_normal((230, 3))
    some["linear_acceleration"] += 2.0 * noise * rng.standard_normal((230, 3))
    assert initial_state(some, HostNs(int(some["stamp"][100]))).at_rest
    moving = run.imu[900:1130].copy()
    moving["angular_velocity"] += noise * rng.standard_normal((230, 3))
    moving["linear_acceleration"] += 2.0 * noise * rng.standard_normal((230, 3))
    assert not initial_state(moving, HostNs(int(moving["stamp"][100]))).at_rest


def test_a_map_begun_again_is_a_new_one_in_the_same_memory() -> None:
    points = [_corridor(np.random.default_rng(seed), 20_000) for seed in range(4)]
    again, fresh = SurfelMap((0.15, 0.6)), SurfelMap((0.15, 0.6))
    tracemalloc.start()
    try:
        again.add(points[0] + 7.0)
        again.add(points[1])
        first, _ = tracemalloc.get_traced_memory()
        again.clear()
        before, _ = tracemalloc.get_traced_memory()
        for part in points[2:]:
            again.add(part)
            fresh.add(part)
        assert before > 0.6 * first
    finally:
        tracemalloc.stop()
    assert len(again) == len(fresh)
    found, wanted = again.match(points[0], narrow=True), fresh.match(points[0], narrow=True)
    assert np.array_equal(found.distances, wanted.distances)
