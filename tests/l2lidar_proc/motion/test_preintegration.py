"""Preintegration against motions known in closed form; bounded work over any gap."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from l2lidar_node import rotations
from l2lidar_node.types import IMU_SAMPLE, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.preintegration import coverage, integrate, segment
from tests.l2lidar_proc.motion.analytic import EPOCH, G, Motion, at

ZERO = np.zeros(3)
GAP_NS = 50_000_000
WALK = Motion(turn=1.0, nod=0.15, speed=1.0)


def integrated(samples: Any, start: Any, end: Any, **options: Any) -> Any:
    imu = segment(samples, [at(start), at(end)], GAP_NS, ZERO)
    given = {"gyro_bias": ZERO, "accel_bias": ZERO, "rest_force": ZERO, **options}
    return imu, integrate(imu, 0, **given)


def test_the_sums_lead_along_a_walk() -> None:
    imu, sums = integrated(WALK.imu(0.0, 0.5), 0.05, 0.35)
    ends = np.array([0.05, 0.35])
    turn = WALK.rotation(ends)
    found = rotations.log(sums.rotations_wxyz[-1])
    np.testing.assert_allclose(found, (turn[0].inv() * turn[1]).as_rotvec(), atol=3e-5)
    # the IMU's own place and velocity, from the analytic motion
    lever = np.array([-0.007698, -0.014655, 0.00667])
    places = WALK.position(ends) + turn.apply(lever)
    h = 1e-4
    after, before = ends + h, ends - h
    velocities = (
        WALK.position(after)
        + WALK.rotation(after).apply(lever)
        - WALK.position(before)
        - WALK.rotation(before).apply(lever)
    ) / (2 * h)
    gravity = np.array([0.0, 0.0, -G])
    gained = turn[0].inv().apply(velocities[1] - velocities[0] - 0.3 * gravity)
    np.testing.assert_allclose(sums.velocities[-1], gained, atol=2e-4)
    way = places[1] - places[0] - 0.3 * velocities[0] - 0.5 * 0.3**2 * gravity
    np.testing.assert_allclose(sums.positions[-1], turn[0].inv().apply(way), atol=1e-4)
    assert not imu.missing.any()


def test_coning_is_integrated_to_second_order() -> None:
    """Between two samples the rate turns by a right angle: the mean alone is 3 mrad off."""
    samples = np.zeros(2, IMU_SAMPLE)
    samples["stamp"] = at(0.0), at(0.04)
    samples["angular_velocity"] = (5.0, 0.0, 0.0), (0.0, 5.0, 0.0)
    _, sums = integrated(samples, 0.0, 0.04)
    fine = np.linspace(0.0, 1.0, 2001)
    middles = 0.5 * (fine[1:] + fine[:-1])[:, None]
    rates = (
        samples["angular_velocity"][0] * (1 - middles) + samples["angular_velocity"][1] * middles
    )
    expected = rotations.cumulative(rotations.exp(rates * 0.04 / 2000))[-1]
    off = rotations.log(rotations.multiply(rotations.conjugate(expected), sums.rotations_wxyz[-1]))
    assert np.linalg.norm(off) < 5e-5
    mean = rotations.exp(np.array([0.1, 0.1, 0.0]))
    plain = rotations.log(rotations.multiply(rotations.conjugate(expected), mean))
    assert np.linalg.norm(plain) > 3e-3


def test_another_anchor_gives_the_same_sums() -> None:
    _, sums = integrated(WALK.imu(0.0, 0.5), 0.05, 0.35)
    back = sums.anchored_at(len(sums.stamps) - 1).anchored_at(0)
    np.testing.assert_allclose(back.positions, sums.positions, atol=1e-12)
    np.testing.assert_allclose(back.velocities, sums.velocities, atol=1e-12)


def test_gaps_hold_rate_and_speed() -> None:
    samples = np.zeros(101, IMU_SAMPLE)
    samples["stamp"] = EPOCH + np.arange(101) * 4_000_000
    samples["angular_velocity"] = [0.0, 0.0, 0.5]
    samples["linear_acceleration"] = [0.0, 0.0, G]
    holed = np.delete(samples, np.arange(40, 70))
    imu = segment(holed, [at(0.0), at(0.6)], GAP_NS, np.array([0.0, 0.0, 0.5]))
    assert imu.missing.any()
    up = np.array([0.0, 0.0, G])
    sums = integrate(imu, 0, gyro_bias=ZERO, accel_bias=ZERO, rest_force=up)
    assert rotations.log(sums.rotations_wxyz[-1])[2] == pytest.approx(0.3, abs=1e-6)
    np.testing.assert_allclose(sums.velocities[-1], [0.0, 0.0, 0.6 * G], atol=1e-6)


def test_between_samples_that_are_far_apart_the_errors_are_what_those_beside_it_show() -> None:
    samples = WALK.imu(0.0, 0.5)
    regular = segment(samples, [at(0.1), at(0.4)], GAP_NS, ZERO)
    assert not regular.rate_errors.any()
    assert not regular.force_errors.any()
    # one lost sample is jitter; beside a long gap the samples do not tell what happened in it
    holed = np.delete(samples, [20, *range(40, 48), *range(80, 106)])
    imu = segment(holed, [at(0.0), at(0.18), at(0.45)], GAP_NS, ZERO)
    is_sparse = imu.stamps[:-1] >= samples["stamp"][39]
    is_sparse &= imu.stamps[1:] <= samples["stamp"][48]
    assert np.count_nonzero(is_sparse) == 2  # the mark at 0.18 s lies within
    left = np.delete(np.arange(len(samples)), [20, *range(40, 48), *range(80, 106)])
    near = [*range(35, 40), *range(48, 53)]
    around = left[np.searchsorted(left, 40) - 25 : np.searchsorted(left, 48) + 25]
    for errors, name in (
        (imu.rate_errors, "angular_velocity"),
        (imu.force_errors, "linear_acceleration"),
    ):
        apart = samples[name][near] - samples[name][around].mean(axis=0)
        spread = np.sqrt((apart**2).mean(axis=0).sum())
        assert spread > 0.01
        np.testing.assert_allclose(errors, np.where(is_sparse, spread, 0.0), atol=1e-12)


def test_in_a_gap_the_rate_goes_straight_from_before_to_after() -> None:
    samples = np.zeros(201, IMU_SAMPLE)
    samples["stamp"] = EPOCH + np.arange(201) * 4_000_000
    samples["angular_velocity"][:, 2] = np.linspace(0.0, 1.0, 201)
    holed = np.delete(samples, np.arange(60, 140))
    _, sums = integrated(holed, 0.0, 0.8)
    assert rotations.log(sums.rotations_wxyz[-1])[2] == pytest.approx(0.4, abs=2e-3)


@pytest.mark.parametrize(("last", "turned"), [(0.452, 0.152 + 0.02), (0.2, 0.0)])
def test_beyond_the_samples_the_rate_is_held_a_little_and_then_stops(
    last: float, turned: Any
) -> None:
    samples = Motion(turn=1.0).imu(0, last)
    imu = segment(samples, [at(0.3), at(0.6)], GAP_NS, ZERO, 20_000_000)
    sums = integrate(imu, 0, gyro_bias=ZERO, accel_bias=ZERO, rest_force=ZERO)
    assert rotations.log(sums.rotations_wxyz[-1])[2] == pytest.approx(turned, abs=1e-4)


def test_before_the_samples_likewise() -> None:
    imu = segment(Motion(turn=1.0).imu(0.4, 1.0), [at(0.3), at(0.6)], GAP_NS, ZERO, 20_000_000)
    sums = integrate(imu, 0, gyro_bias=ZERO, accel_bias=ZERO, rest_force=ZERO)
    assert rotations.log(sums.rotations_wxyz[-1])[2] == pytest.approx(0.22, abs=1e-4)


def test_without_forces_the_velocity_turns_with_the_body() -> None:
    circle = Motion(turn=2.0)
    imu = segment(circle.imu(0, 1), [at(0.1), at(0.6)], GAP_NS, ZERO)
    ahead = np.array([1.0, 0.0, 0.0])
    sums = integrate(
        imu, 0, gyro_bias=ZERO, accel_bias=ZERO, rest_force=ZERO, use_forces=False,
        body_velocity=ahead,
    )  # fmt: skip
    place = 0.5 * ahead + sums.positions[-1]
    np.testing.assert_allclose(place, (np.sin(1.0) / 2, (1 - np.cos(1.0)) / 2, 0), atol=1e-4)


@settings(max_examples=60, deadline=None)
@given(
    jump=st.integers(-60 * 365 * 86_400 * 10**9, 60 * 365 * 86_400 * 10**9),
    count=st.integers(0, 60),
)
def test_work_is_bounded_whatever_the_clock_does(jump: int, count: int) -> None:
    samples = WALK.imu(0.0, 0.3)[:count]
    later = HostNs(at(0.3) + jump)
    marks = [at(0.0), later]
    if marks[0] == later:
        return
    tracemalloc.start()
    try:
        imu = segment(samples, marks, GAP_NS, ZERO)
        sums = integrate(imu, 0, gyro_bias=ZERO, accel_bias=ZERO, rest_force=ZERO)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(imu.stamps) <= count + 2 * tuning.GAP_KNOTS + 12
    assert peak < 2_000_000
    assert (np.diff(imu.stamps) > 0).all()
    assert np.isfinite(sums.rotations_wxyz).all()


@pytest.mark.parametrize(
    ("stamps", "share", "gap"),
    [
        ([0, 4, 8, 12], 1.0, 4),
        ([1, 4, 8, 11], 1.0, 4),
        ([-9, 4, 8, 60], 1.0, 52),
        ([2, 4, 8, 12], 0.9, 4),
        ([-5, 5], 0.4, 10),
        ([-8, -4], 0.0, 15),
        ([30, 34], 0.0, 29),
        ([3], 0.0, 8),
        ([], 0.0, 10),
    ],
)
def test_coverage_of_a_span(stamps: Any, share: float, gap: int) -> None:
    found = coverage(np.array(stamps, dtype=np.int64), HostNs(1), HostNs(11))
    assert found == (pytest.approx(share), gap)
