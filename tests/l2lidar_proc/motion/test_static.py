"""Rest is told from motion in spite of the shaking head."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from l2lidar_node import rotations
from l2lidar_node.types import IMU_SAMPLE, STANDARD_GRAVITY, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.static import (
    gravity_is_plausible,
    initial_state,
    may_be_static,
    noise_spectrum,
    sample_period_s,
    static_reference,
    white_noise,
)
from tests.l2lidar_proc.motion.analytic import Motion, noisy

LEVELS = {"quiet": (0.0, 0.0, 0.0), "usual": (0.03, 0.03, 0.06), "rough": (0.1, 0.2, 0.1)}
BIAS = (0.03, -0.02, 0.01)
UNKNOWN = np.zeros(3)


@pytest.fixture(params=LEVELS, scope="module")
def level(request: pytest.FixtureRequest) -> Any:
    return LEVELS[request.param]


def still(level: Any, seconds: float = 20.0) -> Any:
    return noisy(Motion().imu(0, seconds, BIAS), *level)


def test_a_still_sensor_is_found_at_rest_with_its_bias(level: Any) -> None:
    samples = still(level)
    found = [static_reference(samples[i : i + 250], UNKNOWN, 0.1) for i in range(0, 4750, 250)]
    assert all(found)
    biases = np.array([rest.rate for rest in found])
    assert np.abs(biases.mean(axis=0) - BIAS).max() < 0.05 * (level[0] + level[1]) + 1e-6
    assert np.abs(biases - BIAS).max() < 0.25 * (level[0] + level[1]) + 1e-6


def test_too_few_samples_say_nothing(level: Any) -> None:
    samples = still(level, 2.0)
    rest = static_reference(samples[:250], UNKNOWN, 0.1)
    assert rest.matches(samples[250:310])
    for few in (samples[:0], samples[:1], samples[:24]):
        assert not rest.matches(few)
        assert static_reference(few, UNKNOWN, 0.1) is None
    assert may_be_static(samples)
    assert not may_be_static(samples[:1])
    assert not gravity_is_plausible(samples[:0], at_rest=True)
    assert not gravity_is_plausible(samples[:0], at_rest=False)


def test_it_is_still_still_in_every_head_turn(level: Any) -> None:
    samples = still(level)
    rest = static_reference(samples[:250], UNKNOWN, 0.1)
    assert all(rest.matches(samples[i : i + 60]) for i in range(250, 4900, 60))


@pytest.mark.parametrize(
    "motion",
    [Motion(turn=0.5), Motion(turn=3.0), Motion(speed=0.7, nod=0.05), Motion(speed=1.2, turn=0.5)],
)
def test_motion_is_neither_rest_nor_still(level: Any, motion: Any) -> None:
    rest = static_reference(still(level)[:250], UNKNOWN, 0.1)
    samples = noisy(motion.imu(0, 10, BIAS), *level)
    for i in range(0, 2250, 250):
        assert static_reference(samples[i : i + 250], UNKNOWN, 0.1) is None
        assert static_reference(samples[i : i + 250], rest.rate, 0.01) is None
    fraction = np.mean([rest.matches(samples[i : i + 60]) for i in range(0, 2400, 60)])
    assert fraction == 0.0


def test_a_known_bias_forbids_a_slow_turn_to_pass_for_rest() -> None:
    slow = noisy(Motion(turn=0.08).imu(0, 2, BIAS))
    assert static_reference(slow[:250], UNKNOWN, 0.2) is not None
    assert static_reference(slow[:250], np.array(BIAS), 0.01) is None


@pytest.mark.parametrize(
    ("hertz", "spread", "rests"), [(71.0, 1.7, True), (71.0, 3.0, False), (6.0, 1.7, False)]
)
def test_motors_may_shake_a_sensor_at_rest(hertz: float, spread: float, rests: bool) -> None:
    """A vibration at 71 Hz moves nothing by more than 10 um; one at 6 Hz is a motion."""
    samples = still(LEVELS["usual"], 1.0)
    phase = 2.0 * np.pi * hertz * 1e-9 * samples["stamp"]
    samples["linear_acceleration"][:, 2] += spread * np.sqrt(2.0) * np.sin(phase)
    assert (static_reference(samples, UNKNOWN, 0.1) is not None) == rests


def test_too_few_samples_prove_nothing() -> None:
    samples = still((0, 0, 0), 1.0)
    assert static_reference(samples[:99], UNKNOWN, 0.1) is None
    assert not static_reference(samples, UNKNOWN, 0.1).matches(samples[:20])


def test_the_first_state_is_level_and_calls_the_excess_over_gravity_bias() -> None:
    samples = noisy(Motion().imu(0, 1.0, BIAS), 0.001, 0.001, 0.0)
    tilt = np.radians(20.0)
    samples["linear_acceleration"] += 9.9 * np.array([np.sin(tilt), 0.0, np.cos(tilt)]) - (
        samples["linear_acceleration"].mean(axis=0)
    )
    found = initial_state(samples, HostNs(int(samples["stamp"][-1])))
    assert found.at_rest
    assert found.gravity_trusted
    force = samples["linear_acceleration"].mean(axis=0)
    np.testing.assert_allclose(found.state.rotation @ force, (0.0, 0.0, 9.9), atol=1e-9)
    excess = 1.0 - STANDARD_GRAVITY / 9.9
    np.testing.assert_allclose(found.state.accel_bias, excess * force, atol=1e-9)
    np.testing.assert_allclose(found.state.gyro_bias, BIAS, atol=1e-3)


def test_a_start_can_be_leveled_by_another_vertical() -> None:
    samples = noisy(Motion().imu(0, 1.0, BIAS), 0.001, 0.001, 0.0)
    samples["linear_acceleration"] += (1.2, 0.0, 0.0)
    found = initial_state(samples, HostNs(int(samples["stamp"][-1])), may_rest=False)
    assert found.gravity_trusted
    up = np.array([-0.12, 0.03, 0.0])
    up[2] = np.sqrt(1.0 - up @ up)
    level = found.leveled(up, 0.25)
    np.testing.assert_allclose(
        level.state.rotation @ found.state.rotation.T @ up, (0.0, 0.0, 1.0), atol=1e-12
    )
    np.testing.assert_array_equal(level.state.gravity, found.state.gravity)
    # which way is forward has not changed
    turn = rotations.log(rotations.from_matrix(level.state.rotation @ found.state.rotation.T))
    assert abs(turn[2]) < 1e-9
    before, after = (np.sqrt(np.diag(one.covariance)) for one in (found, level))
    assert (before[15:17] > 0.6).all()
    np.testing.assert_allclose(after[15:], (0.25, 0.25, 0.01))
    np.testing.assert_array_equal(after[:15], before[:15])


PERIOD_S = 0.004


@pytest.mark.parametrize("hz", [100.0, 250.0, 1000.0])
def test_the_period_of_an_imu_is_that_of_most_samples(hz: float) -> None:
    samples = np.zeros(50, IMU_SAMPLE)
    stamps = 1e9 / hz * np.arange(50) + np.random.default_rng(7).normal(0.0, 3e4, 50)
    stamps[20:] += 3e8  # a gap
    samples["stamp"] = stamps.astype(np.int64)
    assert sample_period_s(samples) == 1.0 / hz
    few = samples[: tuning.PERIOD_SAMPLES - 1]
    assert sample_period_s(few) == PERIOD_S
    samples["stamp"] = 5
    assert sample_period_s(samples) > 0.0


def test_the_spectrum_shows_white_noise_alone_as_it_is() -> None:
    rng = np.random.default_rng(1)
    for sigma in (0.01, 0.5):
        found = [noise_spectrum(rng.normal(0.0, sigma, (250, 3)), PERIOD_S) for _ in range(200)]
        floors, vibrations = np.array(found).T
        # of the worst axis, so a little more
        assert 1.0 < floors.mean() / sigma < 1.15
        assert np.abs(floors / floors.mean() - 1.0).max() < 0.3
        # 2 T s^2 / (2 pi f)^2 integrated from 15 to 125 Hz
        expected = sigma * np.sqrt(0.008 * (1.0 / 15.0 - 1.0 / 125.0)) / (2.0 * np.pi)
        assert vibrations.mean() == pytest.approx(expected, rel=0.2)


@pytest.mark.parametrize("lines", [(37.0,), (71.0, 113.0), (37.0, 71.0, 113.0)])
def test_vibrations_are_no_white_noise(lines: tuple[float, ...]) -> None:
    """A line of amplitude a at f integrates to a / (2 pi f), which oscillates about zero."""
    rng, times = np.random.default_rng(2), 0.004 * np.arange(250)
    force = rng.normal(0.0, 0.06, (250, 3))
    variance = 0.0
    for hz in lines:
        force[:, 1] += 1.2 * np.sin(2.0 * np.pi * hz * times + rng.random())
        variance += 0.5 * (1.2 / (2.0 * np.pi * hz)) ** 2
    found = noise_spectrum(force, PERIOD_S)
    assert found.floor == pytest.approx(0.06, rel=0.35)
    assert found.vibration == pytest.approx(np.sqrt(variance), rel=0.1)
    assert white_noise(force) > 5.0 * found.floor


def test_a_trembling_hand_is_no_noise() -> None:
    rng, times = np.random.default_rng(3), 0.004 * np.arange(250)[:, None]
    still = rng.normal(0.0, 0.06, (250, 3))
    held = still + 3.0 * np.sin(2.0 * np.pi * (9.0 * times + rng.random(3)))
    held += 9.8 + 2.0 * times
    found = noise_spectrum(held, PERIOD_S)
    assert found.floor == pytest.approx(noise_spectrum(still, PERIOD_S).floor, rel=0.15)
    assert found.vibration < 0.002


def test_a_few_samples_show_the_noise_of_their_differences() -> None:
    few = np.random.default_rng(4).normal(0.0, 0.3, (tuning.NOISE_LEAST_SAMPLES - 1, 3))
    assert noise_spectrum(few, PERIOD_S) == (white_noise(few), 0.0)
    assert noise_spectrum(few[:0], PERIOD_S) == (0.0, 0.0)
    enough = np.vstack((few, few[:1]))
    assert noise_spectrum(enough, PERIOD_S).vibration > 0.0
