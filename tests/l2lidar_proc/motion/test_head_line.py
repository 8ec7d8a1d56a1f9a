"""The gyro's line is found in step with the head, and nothing else is taken for it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from l2lidar_node.types import F64, IMU_SAMPLE, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.head_line import HeadAngle, HeadLine
from l2lidar_proc.motion.imu_buffer import Samples
from tests.l2lidar_proc.motion.analytic import EPOCH

RATE = 27.2  # [rad/s] 4.33 turns a second
TURN_S = 2.0 * np.pi / RATE
HEAD = HeadAngle(HostNs(EPOCH), 1.3, RATE)
NOISE = 0.03


def line_of(phases: F64, size: float) -> F64:
    """Return a line (N, 3) that differs between the axes, with a second harmonic."""
    first = np.sin(phases[:, None] + [0.0, 1.9, 4.1])
    second = 0.4 * np.sin(2.0 * phases[:, None] + [0.5, 2.2, 0.1])
    return size * np.array([0.5, 1.0, 0.3]) * (first + second)


def gyro(start: float, end: float, size: float, seed: int = 0, hz: float = 250.0) -> Samples:
    """Return the samples of a sensor at rest whose gyro has a bias, noise and a line."""
    times = np.arange(np.ceil(start * hz), np.floor(end * hz) + 1) / hz
    samples = np.zeros(len(times), IMU_SAMPLE)
    samples["stamp"] = EPOCH + np.round(times * 1e9).astype(np.int64)
    rates = line_of(HEAD.angle + RATE * times, size) + np.array([0.01, -0.02, 0.015])
    rng = np.random.default_rng((seed, round(1e3 * start)))
    samples["angular_velocity"] = rates + NOISE * rng.standard_normal(rates.shape)
    return samples


def learned(turns: int, size: float, seed: int = 0) -> HeadLine:
    line = HeadLine()
    for number in range(turns):
        start = number * TURN_S
        line.head = HeadAngle(HostNs(EPOCH + round(start * 1e9)), 1.3 + RATE * start, RATE)
        end = HostNs(EPOCH + round((start + TURN_S) * 1e9))
        assert line.is_due(end)
        line.learn(gyro(start, start + TURN_S, size, seed))
        assert not line.is_due(end)
    return line


@pytest.mark.parametrize("size", [0.03, 0.3])
def test_a_line_at_rest_is_removed_and_the_bias_stays(size: float) -> None:
    line = learned(12, size)
    later = gyro(12 * TURN_S, 14 * TURN_S, size, seed=3)
    found = line.removed(later)
    clean = gyro(12 * TURN_S, 14 * TURN_S, 0.0, seed=3)
    left = found["angular_velocity"] - clean["angular_velocity"]
    assert np.abs(left).max() < 0.012  # 4 sigma of what the noise leaves of the amplitudes
    np.testing.assert_array_equal(found["linear_acceleration"], later["linear_acceleration"])
    np.testing.assert_array_equal(found["stamp"], later["stamp"])


def test_amplitudes_err_by_what_the_noise_of_their_turns_allows() -> None:
    """Cosine and sine of both harmonics, beside a mean and a trend (Cramer-Rao bound)."""
    turns, count = 20, 57
    phases = RATE * np.linspace(0.0, TURN_S, count)
    fitted = np.column_stack(
        [f(k * phases) for k in (1, 2) for f in (np.cos, np.sin)]
        + [np.ones(count), np.linspace(-1.0, 1.0, count)]
    )
    bound = NOISE**2 * np.diag(np.linalg.inv(fitted.T @ fitted))[:4].sum() / 2.0 / (turns - 2)
    errors, chance = [], []
    for seed in range(60):
        found = learned(turns, 0.1, seed).removed(gyro(4.5, 4.9, 0.1, seed + 100))
        clean = gyro(4.5, 4.9, 0.0, seed + 100)
        errors.append(found["angular_velocity"] - clean["angular_velocity"])
        chance.append(learned(turns, 0.0, seed).amplitudes)
    # chance makes one of 20 turns differ, and three of them begin again
    assert 0.9 * bound < np.mean(np.square(errors)) < 2.0 * bound
    # where there is no line, less is removed than one would mistake for it
    assert np.mean(np.square(chance)) < 0.3 * bound


def test_nothing_is_removed_before_turns_are_alike_or_without_the_head() -> None:
    later = gyro(1.0, 1.2, 0.3)
    line = HeadLine()
    assert not line.is_due(HostNs(EPOCH))
    line.learn(later)
    assert line.removed(later) is later
    for turns in (1, 2, 3):
        assert learned(turns, 0.3).removed(later) is later
    line = learned(4, 0.3)
    assert line.removed(later) is not later
    assert len(line.removed(later[:0])) == 0
    old = gyro(3.0, 3.2, 0.3)
    assert line.head is not None
    assert old["stamp"][-1] - line.head.stamp > tuning.HEAD_LINE_AGE_NS
    assert line.removed(old) is old


@pytest.mark.parametrize(
    "motion",
    [
        lambda t: 0.4 * np.sin(2.0 * np.pi * 1.9 * t),  # steps
        lambda t: 0.3 * np.sin(2.0 * np.pi * 4.2 * t),  # nearly in step with the head
        lambda t: 0.5 * t**2,  # begins to turn
    ],
)
def test_motion_is_not_taken_for_the_line(motion: Callable[[F64], F64]) -> None:
    line = HeadLine()
    for number in range(40):
        start = number * TURN_S
        line.head = HeadAngle(HostNs(EPOCH + round(start * 1e9)), 1.3 + RATE * start, RATE)
        samples = gyro(start, start + TURN_S, 0.0)
        seconds = (samples["stamp"] - EPOCH) * 1e-9
        samples["angular_velocity"] += motion(seconds + 0.3)[:, None] * [1.0, -0.6, 0.3]
        line.learn(samples)
    assert np.abs(line.amplitudes).max() < 0.01


def test_steady_turning_teaches_as_well() -> None:
    line = HeadLine()
    for number in range(12):
        start = number * TURN_S
        line.head = HeadAngle(HostNs(EPOCH + round(start * 1e9)), 1.3 + RATE * start, RATE)
        samples = gyro(start, start + TURN_S, 0.1)
        samples["angular_velocity"] += [0.0, 0.0, 0.8]
        line.learn(samples)
    later = gyro(3.0, 3.4, 0.1, 5)
    found = line.removed(later)["angular_velocity"] - gyro(3.0, 3.4, 0.0, 5)["angular_velocity"]
    assert np.abs(found).max() < 0.015


def test_parts_of_turns_and_turns_with_a_gap_between_teach_nothing() -> None:
    line = HeadLine()
    line.head = HEAD
    for number in range(10):
        start = number * TURN_S
        line.learn(gyro(start, start + 0.8 * TURN_S, 0.3))
    assert not line.amplitudes.any()
    for number in range(10):
        start = 2 * number * TURN_S
        line.head = HeadAngle(HostNs(EPOCH + round(start * 1e9)), 1.3 + RATE * start, RATE)
        line.learn(gyro(start, start + TURN_S, 0.3))
    assert not line.amplitudes.any()
    line.learn(gyro(9.0, 9.0 + TURN_S, 0.3, hz=100.0))  # too few samples
    assert not line.amplitudes.any()
