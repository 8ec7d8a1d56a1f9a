"""A sensor at rest stays where it is, one that creeps does not; real clouds and virtual ones."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.types import IMU_SAMPLE, POINT, HostNs, Sweep
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import ERRORS, GYRO_BIAS, POSE, POSITION, VELOCITY, InertialState
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import OdometryEstimate, Status
from l2lidar_proc.odometry.initialization.map_initialization import MapInitializer
from l2lidar_proc.odometry.intrinsics.lidar_intrinsics import LidarIntrinsics
from l2lidar_proc.odometry.odometry import Odometry
from l2lidar_proc.odometry.registration.alignment import Alignment
from l2lidar_proc.odometry.zero_velocity import ZeroVelocityTest, free_pose
from tests.l2lidar_proc.odometry.odometry_world import T_CLOUD_IMU, drive, feed
from tests.support.build import REAL_L2
from tests.support.odometry_runs import EPOCH, record, sweeps, truth

PERIOD = 4.633e-3  # [s] from packet to packet
HZ = 100  # of a motion file
RESTED = 2.0  # [s] at the beginning of every recording


def way(estimates: list[OdometryEstimate]) -> NDArray[np.float64]:
    """Return how far each pose is from the first [m]."""
    places = np.array([one.T_map_lidar[:3, 3] for one in estimates])
    return np.linalg.norm(places - places[0], axis=1)


def turned(estimates: list[OdometryEstimate]) -> NDArray[np.float64]:
    """Return by how much each pose is turned against the first [rad]."""
    turns = np.array([one.T_map_lidar[:3, :3] for one in estimates])
    cosines = (np.einsum("ij,nij->n", turns[0], turns) - 1.0) / 2.0
    return np.arccos(np.clip(cosines, -1.0, 1.0))


def captured(number: int, packets: int) -> list[Sweep]:
    """Return a capture of the real unit in sweeps of so many packets."""
    xyz = np.load(REAL_L2 / f"capture_00{number}.npy")
    returned = np.isfinite(np.load(REAL_L2 / f"capture_00{number}_packets.npz")["range_m"])
    packet, slot = np.nonzero(returned)
    times = packet * PERIOD + slot * PERIOD / 600.0
    out = []
    for first in range(0, len(returned) - packets, packets):
        inside = (packet >= first) & (packet < first + packets)
        points = np.zeros(int(inside.sum()), POINT)
        points["x"], points["y"], points["z"] = xyz[: len(packet)][inside].T
        points["range"] = np.linalg.norm(xyz[: len(packet)][inside], axis=1)
        points["time"] = times[inside] - times[inside][0]
        start = EPOCH + round(times[inside][0] * 1e9)
        end = EPOCH + round((first + packets - 0.5) * PERIOD * 1e9)
        out.append(Sweep(HostNs(start), HostNs(end), points, packets, 0))
    return out


def resting(seconds: float, noise: float) -> NDArray[np.void]:
    """Return samples of a tilted IMU at rest, gyro noise in rad/s."""
    random = np.random.default_rng(0)
    samples = np.zeros(round(seconds * 250), IMU_SAMPLE)
    samples["stamp"] = EPOCH + np.arange(len(samples)) * 4_000_000
    samples["orientation_wxyz"][:, 0] = 1.0
    drawn = random.standard_normal((2, len(samples), 3))
    samples["angular_velocity"] = [0.01, -0.02, 0.015] + noise * drawn[0]
    samples["linear_acceleration"] = [0.06, -3.05, 9.43] + 2.0 * noise * drawn[1]
    return samples


@pytest.mark.skipif(not REAL_L2.exists(), reason="the recordings are not here")
@pytest.mark.parametrize(("number", "packets", "noise"), [(1, 50, 0.2), (2, 38, 0.04)])
def test_a_real_unit_at_rest_stays_where_it_is(number: int, packets: int, noise: float) -> None:
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    odometry.imu(resting(6.0, noise))
    estimates = [one for sweep in captured(number, packets) for one in odometry.register(sweep)]
    assert len(estimates) >= 20
    assert way(estimates).max() < 0.005
    assert turned(estimates).max() < np.radians(0.1)


def creeping(path: Path, velocity: tuple[float, float, float], rate: float) -> str:
    """Write a motion: rest for a second, four of creeping, and rest again; return its path."""
    time = np.arange(0.0, 16.0, 1.0 / HZ)
    ramp = np.clip((time - 1.0) / 0.2, 0.0, 1.0) - np.clip((time - 5.0) / 0.2, 0.0, 1.0)
    lasted = np.cumsum(ramp) / HZ
    places = np.array([0.3, -0.2, 1.2]) + lasted[:, None] * velocity
    half = 0.5 * rate * lasted
    none = np.zeros_like(half)
    rows = np.column_stack((time, places, none, none, np.sin(half), np.cos(half)))
    np.savetxt(path, rows, fmt="%.9f")
    return str(path)


def vibrating(samples: NDArray[np.void], amplitude: float) -> NDArray[np.void]:
    """Return samples of an IMU that three lines of so many m/s^2 each shake, and the gyro less."""
    samples = samples.copy()
    seconds = (samples["stamp"] - EPOCH) * 1e-9
    for frequency in (37.0, 71.0, 113.0):
        phase = 2.0 * np.pi * (frequency * seconds[:, None] + np.array([0.1, 0.4, 0.8]))
        samples["linear_acceleration"] += amplitude * np.sin(phase)
        samples["angular_velocity"] += 0.05 * amplitude * np.sin(phase + 1.0)
    return samples


@pytest.mark.parametrize(
    ("velocity", "rate", "vibration"),
    [
        ((0.009, -0.007, 0.008), 0.0, 0.65),
        ((0.0, 0.0, 0.0), np.radians(1.0), 0.0),
    ],
)
def test_a_sensor_that_creeps_is_followed_and_its_rests_stay(
    tmp_path: Path, velocity: Any, rate: Any, vibration: float
) -> None:
    run = record("room", creeping(tmp_path / "creep.tum", velocity, rate), 1, RESTED + 10.0)
    estimates = drive(run, imu=vibrating(run.imu, vibration))
    stamps = np.array([one.stamp for one in estimates])
    true, _ = truth(run, stamps)
    error = np.abs(way(estimates) - np.linalg.norm(true - true[0], axis=1))
    since = (stamps - EPOCH) * 1e-9 - RESTED
    before, after = since < 0.9, since > 8.5
    assert before.sum() > 8
    assert way(estimates)[before].max() < 1e-9
    assert error.max() < 0.025
    assert error[after].max() < 0.006
    assert np.abs(turned(estimates)[after] - 4.0 * abs(rate)).max() < np.radians(0.15)
    # at rest again, exactly
    assert np.ptp(way(estimates)[after]) < 1e-9


@pytest.mark.parametrize("unit", ["perfect", "typical"])
def test_a_start_in_slow_motion_is_not_taken_for_wrong_beams(
    tmp_path: Path, unit: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the halves of a moving sensor show at rest explains no drift, and is forgotten."""
    slow = creeping(tmp_path / "creep.tum", (0.05, 0.0, 0.0), 0.0)
    run = record("room", slow, 1, RESTED + 5.0, unit=unit)
    since = EPOCH + round((RESTED + 2.0) * 1e9)
    moving = [one for one in sweeps(run, "turn") if one.start > since]
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    forget, forgot = LidarIntrinsics.forget, []

    def counted(intrinsics: LidarIntrinsics) -> None:
        forgot.append(intrinsics.angles.copy())
        forget(intrinsics)

    monkeypatch.setattr(LidarIntrinsics, "forget", counted)
    estimates = feed(odometry, run, moving)
    assert len(forgot) == 1
    begun = [k for k, item in enumerate(estimates) if Status.STARTING in item.status]
    assert 1 < begun[-1] < 12
    true, _ = truth(run, np.array([one.stamp for one in estimates]))
    gone = way(estimates) - np.linalg.norm(true - true[0], axis=1)
    assert np.abs(gone).max() < 0.12
    assert np.abs(gone[begun[-1] :]).max() < 0.02
    wrong = 0.4 if unit == "typical" else 0.0
    assert np.abs(np.degrees(odometry._intrinsics.angles)).max() < wrong + 0.05


@pytest.mark.parametrize("vibration", [0.0, 0.65])
def test_a_rest_of_less_than_a_second_stays_one(tmp_path: Path, vibration: float) -> None:
    """The map begins only once, although the IMU ends the rest while it may still be doubted."""
    walk = creeping(tmp_path / "walk.tum", (0.6, 0.3, 0.0), 0.2)
    since = RESTED + 1.0  # so long before it moves, less a second
    run = record("room", walk, 1, 3.0, since=since)
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    doubted = []
    begin_again = MapInitializer.begin_again_in_motion

    def counted(*given: Any) -> Any:
        doubted.append(begin_again(*given))
        return doubted[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MapInitializer, "begin_again_in_motion", counted)
        shaken = dataclasses.replace(run, imu=vibrating(run.imu, vibration))
        estimates = feed(odometry, shaken, list(sweeps(run, "turn")))
    assert doubted == [[]]
    starting = [Status.STARTING in item.status for item in estimates]
    assert starting == sorted(starting, reverse=True)
    true, _ = truth(run, np.array([one.stamp for one in estimates]))
    gone = np.linalg.norm(true - true[0], axis=1)
    assert gone.max() > 1.0
    assert np.abs(way(estimates) - gone).max() < 0.02


def test_a_shock_ends_rest_at_once() -> None:
    run = record("room", "walk", 1, RESTED + 3.0)
    estimates = drive(run)
    stamps = np.array([one.stamp for one in estimates])
    true, _ = truth(run, stamps)
    error = np.abs(way(estimates) - np.linalg.norm(true - true[0], axis=1))
    assert np.linalg.norm(true - true[0], axis=1).max() > 0.5
    assert error.max() < 0.02


# ---- the test by itself: what registrations say of an anchor

ORIGIN = InertialState(
    HostNs(EPOCH),
    np.eye(3),
    np.zeros(3),
    np.zeros(3),
    np.zeros(3),
    np.zeros(3),
    np.array([0, 0, -9.8]),
)


def found_at(
    seconds: float, error: NDArray[np.float64], claimed: Any = (1.0, 1.0, 1.0)
) -> Alignment:
    """Return the registration of a sweep that is off the anchor, known to a millimeter."""
    deviation = np.zeros(ERRORS)
    deviation[POSE] = error
    state = dataclasses.replace(ORIGIN, stamp=HostNs(EPOCH + round(seconds * 1e9)))
    covariance = 1e-6 * np.eye(ERRORS)
    nobody = np.empty(0, np.int64), np.empty(0)
    nothing = np.zeros((ERRORS, ERRORS))
    return Alignment(
        state.boxplus(deviation), covariance, nothing, np.diag(claimed), 500, 1.0, 0.0, nobody
    )


def anchored() -> ZeroVelocityTest:
    tested = ZeroVelocityTest()
    assert tested.try_anchor(ORIGIN, resting(0.0, 0.0))
    return tested


def until_released(tested: ZeroVelocityTest, period: float, errors: Any) -> int:
    """Return how many sweeps the anchor stands."""
    for number, error in enumerate(errors):
        if not tested.test_registration(found_at((number + 1) * period, np.array(error))):
            return number
    return len(errors)


def test_noise_does_not_end_rest_and_a_drift_of_as_much_does() -> None:
    rng = np.random.default_rng(2)
    noise = rng.normal(0.0, [[3e-4] * 3 + [2e-3] * 3], (200, 6))
    assert until_released(anchored(), 0.23, noise) == 200
    for axis, rate in ((1, 1.5e-3), (5, 1e-2)):  # [rad/s, m/s]
        drift = noise.copy()
        drift[:, axis] += rate * 0.23 * np.arange(200)
        tested = anchored()
        lasted = until_released(tested, 0.23, drift)
        assert 3 <= lasted < 20
        assert tested.anchor is None
        assert tested.drifted
        assert np.abs(tested._drift).argmax() == axis
        assert tested._drift[axis] == pytest.approx(drift[lasted, axis], rel=0.8)


def test_what_half_turns_see_differently_is_averaged_over_the_turn() -> None:
    """Each half has its own error of a centimeter; together they agree."""
    halves = np.zeros((100, 6))
    halves[::2, 3], halves[1::2, 3] = 0.01, -0.01
    assert until_released(anchored(), 0.115, halves) == 100
    moved = np.zeros((100, 6))
    moved[50:, 3] = 0.01
    assert 100 > until_released(anchored(), 0.115, moved) > 50


def test_a_far_deviation_ends_rest_at_once_and_widens_what_is_known() -> None:
    tested = anchored()
    error = np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.2])
    assert until_released(tested, 0.23, [np.zeros(6), error]) == 1
    before = 1e-4 * np.eye(ERRORS)
    grown = tested.widened(before) - before
    np.testing.assert_allclose(grown[POSE, POSE], np.outer(error, error), atol=1e-12)
    speed, rate = (0.2 / tuning.STILL_DRIFT_S) ** 2, (0.02 / tuning.STILL_DRIFT_S) ** 2
    np.testing.assert_allclose(grown[VELOCITY, VELOCITY], speed * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(grown[GYRO_BIAS, GYRO_BIAS], rate * np.eye(3), atol=1e-12)
    assert np.count_nonzero(grown) == 4 + 6
    tested.clear()
    np.testing.assert_array_equal(tested.widened(before), before)


def test_a_rest_that_is_taken_up_again_compares_no_earlier_sweep() -> None:
    rng = np.random.default_rng(4)
    noise = rng.normal(0.0, [[3e-4] * 3 + [2e-3] * 3], (40, 6))
    turned = noise + np.array([0.0, 0.0, 0.008, 0.0, 0.0, 0.0])
    tested = anchored()
    lasted = until_released(tested, 0.23, [*noise[:10], *turned])
    assert 10 < lasted < 20
    assert tested.has_drifted_within(0.009, 0.005, np.eye(3), np.zeros(3))
    assert not tested.has_drifted_within(0.005, 0.005, np.eye(3), np.zeros(3))
    assert not tested.has_drifted_within(0.009, 1e-4, np.eye(3), np.zeros(3))
    moving = dataclasses.replace(ORIGIN, velocity=np.array([0.1, 0.0, 0.0]))
    tested.resume(moving)
    assert tested.anchor is not None
    np.testing.assert_array_equal(tested.anchor.velocity, 0.0)
    assert not tested.drifted
    assert not tested.has_drifted_within(1.0, 1.0, np.eye(3), np.zeros(3))
    assert until_released(tested, 0.23, noise) == 40


def test_a_drift_that_turns_the_sensor_about_what_it_sees_is_small_there() -> None:
    rng = np.random.default_rng(5)
    rotation = rotations.matrices(rotations.exp((0.1, -0.2, 0.7)))
    arm, turn = np.array([3.0, -1.0, 0.5]), np.array([0.001, -0.002, 0.008])
    moved = -rotation @ np.cross(turn, arm)
    assert np.linalg.norm(moved) > 0.02
    noise = rng.normal(0.0, [[3e-4] * 3 + [2e-3] * 3], (30, 6))
    drifted = noise + np.r_[turn, moved]
    tested = ZeroVelocityTest()
    assert tested.try_anchor(dataclasses.replace(ORIGIN, rotation=rotation), resting(0.0, 0.0))
    found = found_at(0.0, np.zeros(6))
    for number, error in enumerate((*noise[:10], *drifted)):
        state = dataclasses.replace(ORIGIN, rotation=rotation).boxplus(np.r_[error, np.zeros(12)])
        state = dataclasses.replace(state, stamp=HostNs(EPOCH + round((number + 1) * 0.23e9)))
        if not tested.test_registration(dataclasses.replace(found, state=state)):
            break
    assert tested.drifted
    assert tested.has_drifted_within(0.009, 0.006, rotation, arm)
    assert not tested.has_drifted_within(0.009, 0.006, np.eye(3), np.zeros(3))
    assert not tested.has_drifted_within(0.009, 0.006, rotation, -arm)
    assert not tested.has_drifted_within(0.007, 0.006, rotation, arm)


def test_along_a_direction_that_nothing_fixes_rest_is_up_to_the_imu() -> None:
    share = 0.9 * tuning.DEGENERATE_SHARE
    corridor = (share, 0.5, 0.5 - share)
    tested = anchored()
    assert not tested.test_registration(found_at(0.23, np.zeros(6), corridor))
    assert tested.anchor is None
    assert not tested.drifted
    quiet = resting(1.0, 0.01)
    state = dataclasses.replace(ORIGIN, gyro_bias=quiet["angular_velocity"].mean(axis=0))
    for axis, stands in ((3, True), (4, False)):  # along the corridor, across it
        drifts = np.zeros((60, 6))
        drifts[:, axis] = 0.01 * 0.23 * np.arange(60)
        tested = ZeroVelocityTest()
        assert tested.try_anchor(state, quiet)
        sweeps = iter(enumerate(drifts, 1))
        while tested.anchor is not None and (sweep := next(sweeps, None)) is not None:
            tested.test_registration(found_at(0.23 * sweep[0], sweep[1], corridor))
        assert (tested.anchor is not None) == stands
        assert tested.drifted != stands


def test_under_test_nothing_but_the_pose_may_differ() -> None:
    sigma = np.sqrt(np.diag(free_pose()))
    np.testing.assert_allclose(sigma[POSE], np.repeat(tuning.STILL_REACH, 3))
    assert sigma[POSE.stop :].max() <= 1e-6


def test_rest_is_taken_up_when_poses_and_samples_have_shown_it_for_the_test_time() -> None:
    quiet, known = resting(2.0, 0.01), 1e-4 * np.eye(ERRORS)
    rng = np.random.default_rng(3)

    def taken_up(tested: ZeroVelocityTest, speed: float, known: Any, samples: Any) -> float:
        """Return when a sensor that moves so fast is said to rest [s], 0 if never."""
        for number in range(60):
            seconds = 0.23 * number
            error = np.zeros(ERRORS)
            error[POSITION] = rng.normal((speed * seconds, 0.0, 0.0), 1e-3)
            error[VELOCITY] = [speed, 0.0, 0.0]
            stamp = HostNs(EPOCH + round(seconds * 1e9))
            state = dataclasses.replace(ORIGIN, stamp=stamp).boxplus(error)
            if tested.detect_rest(state, known, samples):
                assert tested.anchor is not None
                assert not tested.anchor.velocity.any()
                return seconds
        return 0.0

    tested = ZeroVelocityTest()
    first = taken_up(tested, 0.0, known, quiet)
    assert 2.0 <= first < 2.5
    assert until_released(tested, 0.23, [[0.0, 0.0, 0.0, 0.0, 0.0, 0.2]]) == 0
    assert 4.0 <= taken_up(tested, 0.0, known, quiet) < 4.5  # it was wrong: twice as long
    assert not taken_up(ZeroVelocityTest(), 0.02, known, quiet)  # slow, but it moves on
    assert not taken_up(ZeroVelocityTest(), 0.0, 0.01 * np.eye(ERRORS), quiet)
    assert not taken_up(ZeroVelocityTest(), 0.0, known, resting(2.0, 1.0))
