"""IMU samples: gravity, integration back to the pose, lever arm, and sizes of imperfections."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.unit.inertial import ImuNoise, Inertial
from l2lidar_node.emulator.unit.units import UNITS
from l2lidar_node.emulator.world import scenes
from l2lidar_node.protocol import wire
from l2lidar_node.types import STANDARD_GRAVITY

ROOM = scenes.make("room")
CLEAN = ImuNoise.clean()
RATE = 250.0


def inertial(
    motion: str, noise: ImuNoise = CLEAN, *, seed: int = 0, unit: str = "a", **more: Any
) -> Inertial:
    return Inertial(trajectories.make(motion, ROOM, **more), noise, seed, UNITS[unit])


def orientation(samples: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.roll(samples["quaternion_wxyz"].astype(float), -1, axis=-1))


def test_a_level_sensor_at_rest_feels_gravity_on_plus_z() -> None:
    samples, times = inertial("still").samples(0, 500)

    np.testing.assert_allclose(times, np.arange(500) / RATE, atol=1e-12)
    np.testing.assert_allclose(
        samples["linear_acceleration"], np.tile([0, 0, STANDARD_GRAVITY], (500, 1)), atol=1e-6
    )
    np.testing.assert_array_equal(samples["angular_velocity"], 0)
    assert (samples["info"]["payload_size"] == 56).all()


@pytest.mark.parametrize(
    ("motion", "mount"),
    [("spin", "upright"), ("walk", "forward"), ("trot", "upright"), ("drone", "forward")],
)
def test_clean_samples_integrate_to_the_true_pose(motion: str, mount: str) -> None:
    device = inertial(motion, mount=mount)
    first, count = 250, 2000  # from within the rest, 8 s
    samples, times = device.samples(first, count)
    arm = np.array(wire.IMU_POSITION_M)
    positions, quaternions = device.motion.poses(times)
    truth = Rotation.from_quat(np.roll(quaternions, -1, axis=-1))
    place = positions + truth.apply(arm)

    dt = 1 / RATE
    rate = samples["angular_velocity"].astype(float)
    force = samples["linear_acceleration"].astype(float)
    turned, velocity, place_now = truth[0], np.zeros(3), place[0].copy()
    for k in range(count - 1):
        # the mean of neighbors, and the second-order coning term
        step = dt * (rate[k] + rate[k + 1]) / 2 + dt**2 / 12 * np.cross(rate[k], rate[k + 1])
        after = turned * Rotation.from_rotvec(step)
        felt = (turned.apply(force[k]) + after.apply(force[k + 1])) / 2
        felt = felt - np.array([0, 0, STANDARD_GRAVITY])
        place_now += dt * velocity + dt**2 / 2 * felt
        velocity += dt * felt
        turned = after

    assert (turned.inv() * truth[-1]).magnitude() < 2e-3
    assert np.linalg.norm(place_now - place[-1]) < 0.06
    assert np.ptp(place, axis=0).max() > 0.05  # something did move


def test_the_lever_arm_is_felt() -> None:
    rate = 6.0
    samples, _ = inertial("spin", speed=rate).samples(1500, 250)
    mean = samples["linear_acceleration"].astype(float).mean(axis=0)

    # the cloud frame's origin circles at 40 mm, x axis outwards; centripetal at the IMU
    radius = np.array([0.04 + wire.IMU_POSITION_M[0], wire.IMU_POSITION_M[1]])
    np.testing.assert_allclose(mean[:2], -(rate**2) * radius, atol=1e-4)


def test_the_wires_quaternion_turns_the_body_into_the_world_and_is_short() -> None:
    device = inertial("walk", mount="tilted")
    samples, times = device.samples(2000, 500)
    norm = np.linalg.norm(samples["quaternion_wxyz"], axis=1)

    np.testing.assert_allclose(norm, 0.9983, atol=1e-6)
    _, truth = device.motion.poses(times)
    up = Rotation.from_quat(np.roll(truth, -1, axis=-1)).inv().apply([0, 0, 1])
    np.testing.assert_allclose(orientation(samples).inv().apply([0, 0, 1]), up, atol=1e-6)


@pytest.mark.parametrize("seed", [0, 1])
def test_yaw_is_zero_at_power_on(seed: int) -> None:
    noise = ImuNoise(tilt_error=0.0)
    samples, _ = inertial("walk", noise, seed=seed).samples(0, 1)

    forward = orientation(samples).apply([1, 0, 0])[0]
    assert np.arctan2(forward[1], forward[0]) == pytest.approx(0.0, abs=1e-6)


def test_the_onboard_orientation_drifts_in_yaw_and_little_in_tilt() -> None:
    device = inertial("still", ImuNoise(yaw_drift=3.0, tilt_error=0.6))
    samples, _ = device.samples(0, 250 * 60)
    turned = orientation(samples)

    up = turned.inv().apply([0, 0, 1])
    tilt = np.rad2deg(np.arccos(up[:, 2]))
    assert 0.4 < tilt.max() < 1.0
    forward = turned.apply([1, 0, 0])
    yaw = np.rad2deg(np.unwrap(np.arctan2(forward[:, 1], forward[:, 0])))
    assert yaw[-1] - yaw[0] == pytest.approx(3.0, abs=0.1)


def test_noise_and_bias_have_their_sizes() -> None:
    noise = ImuNoise(gyro_noise=0.05, gyro_line=0.0, accel_noise=0.1)
    samples, _ = inertial("still", noise).samples(0, 20_000)
    rate = samples["angular_velocity"].astype(float)
    force = samples["linear_acceleration"].astype(float) - [0, 0, STANDARD_GRAVITY]

    np.testing.assert_allclose(rate.mean(axis=0), noise.gyro_bias, atol=0.0015)
    np.testing.assert_allclose(rate.std(axis=0), 0.05, rtol=0.03)
    np.testing.assert_allclose(force.mean(axis=0), noise.accel_bias, atol=0.003)
    np.testing.assert_allclose(force.std(axis=0), 0.1, rtol=0.03)
    white = np.corrcoef(rate[1:, 0], rate[:-1, 0])[0, 1]
    assert abs(white) < 0.03


def test_defaults_are_within_what_units_show() -> None:
    samples, _ = inertial("still", ImuNoise()).samples(0, 5000)
    rate, force = samples["angular_velocity"], samples["linear_acceleration"]

    assert ((rate.std(axis=0) > 0.03) & (rate.std(axis=0) < 0.1)).all()
    assert 9.59 < np.linalg.norm(force, axis=1).mean() < 10.14


@pytest.mark.parametrize(("unit", "frequency"), [("a", 4.352), ("fast", 5.55)])
def test_the_gyro_has_lines_at_the_heads_frequency_and_its_double(
    unit: str, frequency: float
) -> None:
    noise = ImuNoise(gyro_line=0.1, gyro_noise=0.005)
    samples, _ = inertial("still", noise, unit=unit).samples(0, 10_000)
    spectrum = np.abs(np.fft.rfft(samples["angular_velocity"][:, 1] - noise.gyro_bias[1])) / 5000
    frequencies = np.fft.rfftfreq(10_000, 1 / RATE)

    strongest = frequencies[np.argsort(spectrum)[::-1]]
    assert strongest[0] == pytest.approx(frequency, abs=0.03)
    far = strongest[np.abs(strongest - frequency) > 0.2]
    assert far[0] == pytest.approx(2 * frequency, abs=0.03)
    near = np.abs(frequencies - frequency) < 0.1
    assert np.sqrt((spectrum[near] ** 2).sum()) == pytest.approx(0.1, rel=0.15)


def test_the_gyros_line_has_a_fixed_phase_to_the_head() -> None:
    from l2lidar_node.emulator.unit.scanner import mean_angle

    noise = ImuNoise(gyro_line=0.1, gyro_noise=0.0)
    phases = []
    for seed in (1, 2, 3):
        samples, times = inertial("still", noise, seed=seed).samples(300, 2500)
        head = mean_angle(times, UNITS["a"], seed)
        line = (samples["angular_velocity"][:, 1] - noise.gyro_bias[1]) @ np.exp(-1j * head)
        phases.append(np.angle(line))

    np.testing.assert_allclose(phases, phases[0], atol=0.01)


@pytest.mark.parametrize("mount", ["forward", "tilted"])
def test_wrong_gravity_doubles_the_force_at_power_on(mount: str) -> None:
    noise = ImuNoise(wrong_gravity=True)
    samples, _ = inertial("still", noise, mount=mount).samples(0, 1000)
    right, _ = inertial("still", mount=mount).samples(0, 1)
    mean = samples["linear_acceleration"].mean(axis=0)

    assert 18.5 < np.linalg.norm(mean) < 21.5
    np.testing.assert_allclose(mean, 2 * right["linear_acceleration"][0], atol=0.3)


def test_wrong_gravity_stays_wrong_when_the_sensor_turns() -> None:
    noise = ImuNoise(wrong_gravity=True)
    moving, _ = inertial("drone", noise, mount="forward").samples(2000, 2000)

    norm = np.linalg.norm(moving["linear_acceleration"], axis=1)
    assert norm.mean() > 17


def test_a_sample_depends_on_its_number_and_the_seed_alone() -> None:
    noise = ImuNoise()
    whole, times = inertial("trot", noise, seed=4).samples(990, 120)
    other = inertial("trot", noise, seed=4)
    parts = [other.samples(first, count)[0] for first, count in ((1050, 60), (990, 1), (991, 59))]

    assert whole.tobytes() == b"".join(parts[k].tobytes() for k in (1, 2, 0))
    assert times[0] == pytest.approx(3.96)
    assert whole.tobytes() != inertial("trot", noise, seed=5).samples(990, 120)[0].tobytes()


def test_no_samples_are_an_empty_array() -> None:
    samples, times = inertial("walk", ImuNoise()).samples(75, 0)

    assert len(samples) == len(times) == 0


def test_another_gravity_is_felt() -> None:
    noise = ImuNoise(accel_noise=0.0, accel_bias=(0.0, 0.0, 0.0), gravity=9.75)
    samples, _ = inertial("still", noise).samples(0, 1)

    assert samples["linear_acceleration"][0, 2] == pytest.approx(9.75)
