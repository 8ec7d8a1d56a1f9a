"""Unit and sign of accelerometers, against motions whose accelerations are known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from l2lidar_node import rotations
from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.unit.inertial import ImuNoise, Inertial
from l2lidar_node.emulator.world import scenes
from l2lidar_node.types import IMU_SAMPLE, HostNs
from l2lidar_proc.motion.imu_corrections import ImuConvention


def samples_of(motion: Any, seconds: float, factor: float = 1.0) -> np.ndarray:
    raw, times = Inertial(motion, ImuNoise(), 3).samples(0, int(250 * seconds))
    samples = np.zeros(len(raw), IMU_SAMPLE)
    samples["stamp"] = np.round(times * 1e9).astype(np.int64)
    samples["linear_acceleration"] = factor * raw["linear_acceleration"]
    return samples


def watched(
    name: str, factor: float, noise_m: float = 0.001, first_pose: int | None = None
) -> tuple[ImuConvention, int]:
    """Return a convention after 20 s, and the number of poses until the sign was changed."""
    motion = trajectories.make(name, scenes.make("room"), seed=1)
    samples = samples_of(motion, 20.0, factor)
    convention, rng, first = ImuConvention(), np.random.default_rng(5), 0
    if first_pose is not None:
        convention.watch(HostNs(first_pose), np.eye(3), np.zeros(3))
    for number, t in enumerate(np.arange(0.2, 20.0, 0.23)):
        last = int(np.searchsorted(samples["stamp"], (t + 0.115) * 1e9))
        convention.corrected(samples[first:last])
        first = last
        place, quaternion = motion.poses(np.array([t]))
        place = place[0] + rng.normal(0.0, noise_m, 3)
        turn = rotations.matrices(quaternion)[0]
        if convention.watch(HostNs(round(t * 1e9)), turn, place):
            return convention, number
    return convention, -1


@pytest.mark.parametrize("name", ["walk", "trot", "drone", "still", "spin"])
def test_a_sound_accelerometer_stays_as_it_is(name: str) -> None:
    convention, changed = watched(name, 1.0)
    assert changed == -1
    assert convention.notes == []


@pytest.mark.parametrize("factor", [-1.0, -1.0 / 9.80665])
def test_the_opposite_sign_is_found_within_seconds_of_motion(factor: float) -> None:
    convention, changed = watched("walk", factor)
    assert 20 <= changed < 50
    assert convention.reversed
    assert "has the opposite sign" in convention.notes[-1]
    assert convention.in_g == (abs(factor) < 0.5)


def test_a_pose_of_another_time_does_not_end_the_watch() -> None:
    convention, changed = watched("walk", -1.0, first_pose=10**18)
    assert 20 <= changed < 50
    assert convention.reversed


def test_poses_that_are_too_coarse_do_not_decide_about_the_sign() -> None:
    """Their noise bends twice as much as the trot does."""
    convention, changed = watched("trot", -1.0, noise_m=0.02)
    assert changed == -1
    assert not convention.reversed


def test_at_rest_nothing_can_be_said_of_the_sign() -> None:
    convention, changed = watched("still", -1.0, noise_m=0.003)
    assert changed == -1
    assert not convention.reversed


def test_samples_in_g_are_multiplied() -> None:
    motion = trajectories.make("walk", scenes.make("room"))
    true, given = samples_of(motion, 2.0), samples_of(motion, 2.0, 1.0 / 9.80665)
    convention = ImuConvention()
    found = np.concatenate([convention.corrected(given[k : k + 1]) for k in range(len(given))])
    np.testing.assert_allclose(
        found["linear_acceleration"], true["linear_acceleration"], rtol=1e-6, atol=1e-6
    )
    assert given["linear_acceleration"][0, 2] < 2.0  # what came in was not changed


def test_where_no_poses_come_the_unit_is_found_and_no_sample_is_kept() -> None:
    motion = trajectories.make("walk", scenes.make("room"))
    true, given = samples_of(motion, 2.0), samples_of(motion, 2.0, 1.0 / 9.80665)
    convention = ImuConvention()
    assert not convention.knows_unit
    assert convention.factor == 1.0
    found = convention.in_units(given)
    assert convention.knows_unit
    assert convention.factor == 9.80665
    np.testing.assert_allclose(
        found["linear_acceleration"], true["linear_acceleration"], rtol=1e-6, atol=1e-6
    )
    assert not len(convention._recent)
    another = ImuConvention()
    another.adopt(convention)
    assert another.in_g
    assert not another.reversed


def moved(name: str, seconds: float = 12.0) -> np.ndarray:
    """Return samples of a motion; "yaw" is a turn about the vertical at 0.5 rad/s."""
    if name == "yaw":
        samples = np.zeros(round(250 * seconds), IMU_SAMPLE)
        samples["angular_velocity"][:, 2] = 0.5
        samples["linear_acceleration"][:, 2] = 9.8
    else:
        motion = trajectories.make(name, scenes.make("room"), seed=1)
        samples = samples_of(motion, seconds)
        raw, _ = Inertial(motion, ImuNoise(), 3).samples(0, len(samples))
        samples["angular_velocity"] = raw["angular_velocity"]
    samples["stamp"] = 10**18 + 4_000_000 * np.arange(len(samples))
    return samples


def in_parts(convention: ImuConvention, samples: np.ndarray, size: int) -> np.ndarray:
    parts = [convention.corrected(samples[k : k + size]) for k in range(0, len(samples), size)]
    return np.concatenate(parts)


@pytest.mark.parametrize("at_once", [1, 40, 3000])
@pytest.mark.parametrize("name", ["walk", "trot", "drone", "yaw"])
def test_a_gyro_in_degrees_is_recognized(name: str, at_once: int) -> None:
    true = moved(name)
    given = true.copy()
    given["angular_velocity"] = np.rad2deg(given["angular_velocity"])
    rng = np.random.default_rng(3)
    given = given[np.argsort(given["stamp"] + rng.uniform(0.0, 8e6, len(given)))]  # some are late
    came = given.copy()
    convention = ImuConvention()
    found = in_parts(convention, given, at_once)
    assert convention.in_degrees
    assert convention.notes == ["the gyro measures in degrees per second: multiplied by pi / 180"]
    np.testing.assert_allclose(
        found["angular_velocity"][-200:],
        np.deg2rad(given["angular_velocity"][-200:]),
        rtol=1e-6,
        atol=1e-9,
    )
    np.testing.assert_array_equal(found["linear_acceleration"], given["linear_acceleration"])
    np.testing.assert_array_equal(given, came)
    another = ImuConvention()
    another.adopt(convention)
    assert another.in_degrees


@pytest.mark.parametrize("name", ["walk", "trot", "drone", "spin", "shake", "still", "yaw"])
def test_a_gyro_in_radians_stays_as_it_is(name: str) -> None:
    convention = ImuConvention()
    given = moved(name, 30.0)
    assert convention.corrected(given) is given
    assert convention.notes == []


@pytest.mark.parametrize(
    "spoil",
    ["flips", "spikes", "frozen", "no forces", "shaken", "gaps", "slow", "not a number", "once"],
)
def test_nothing_else_is_taken_for_degrees(spoil: str) -> None:
    given = moved("yaw")
    rates, forces = given["angular_velocity"], given["linear_acceleration"]
    if spoil == "flips":  # of a drone, twice at 25 rad/s for 0.25 s
        rates[300:363, 0] = rates[900:963, 0] = 25.0
    elif spoil == "spikes":
        rates[::3] = 1e6
    elif spoil == "frozen":
        rates[:, 0] = 2.0
    elif spoil == "no forces":
        rates[:, 0], forces[:] = 2.0, 0.0
    elif spoil == "shaken":  # so much that no gravity shows
        rates[:, 0] = 2.0
        forces[:] = np.random.default_rng(1).normal(0.0, 20.0, forces.shape)
    elif spoil == "gaps":
        rates[:] = 28.0
        given["stamp"] += given["stamp"] // 1_000_000_000 * 200_000_000
    elif spoil == "slow":
        rates[:] = 28.0
        given = given[::30]
    elif spoil == "not a number":
        rates[:, 1] = np.nan
    elif spoil == "once":
        rates[300:1000, 2] = 28.0
    convention = ImuConvention()
    assert in_parts(convention, given, 10).tobytes() == given.tobytes()
    assert not convention.in_degrees


def test_samples_whose_stamps_do_not_advance_do_not_pile_up() -> None:
    samples = np.zeros(500, IMU_SAMPLE)
    samples["linear_acceleration"][:, 2] = 9.8
    convention = ImuConvention()
    for _ in range(60):
        convention.in_units(samples)
    assert sum(map(len, convention._window)) <= 10_000


def test_the_known_fault_of_the_l2_is_not_taken_for_a_unit() -> None:
    samples = samples_of(trajectories.make("still", scenes.make("room")), 1.0, 2.0)
    convention = ImuConvention()
    assert convention.corrected(samples) is samples
    assert convention.notes == []


def test_samples_without_poses_do_not_pile_up() -> None:
    samples = np.zeros(500, IMU_SAMPLE)
    convention = ImuConvention()
    for k in range(100):
        samples["stamp"] = np.arange(500) * 4_000_000 + k * 2_000_000_000
        convention.corrected(samples)
    assert len(convention._recent) < 11_000
    nothing = ImuConvention()
    hostile = np.zeros(3, IMU_SAMPLE)
    hostile["linear_acceleration"] = np.nan
    assert np.isnan(nothing.corrected(hostile)["linear_acceleration"]).all()
    assert not nothing.in_g
