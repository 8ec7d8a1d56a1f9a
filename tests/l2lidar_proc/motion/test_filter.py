"""The error-state filter: derivatives against differences, and an honest covariance (NEES)."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.special import chdtri

from l2lidar_node import rotations
from l2lidar_node.types import F64, IMU_SAMPLE, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion import carrier_priors, filter as eskf
from l2lidar_proc.motion.filter import InertialState, Noise
from l2lidar_proc.motion.preintegration import integrate, segment
from tests.l2lidar_proc.motion.analytic import EPOCH, G, Motion, at

STEP = 1e-6
LEVER = np.array([-0.2, 0.1, 0.3])


def some_state(seed: int = 1) -> InertialState:
    rng = np.random.default_rng(seed)
    return InertialState(
        at(0.0),
        rotations.matrices(rotations.exp(rng.normal(0.0, 0.8, 3))),
        rng.normal(0.0, 2.0, 3),
        rng.normal(0.0, 1.0, 3),
        rng.normal(0.0, 0.02, 3),
        rng.normal(0.0, 0.1, 3),
        np.array([0.1, -0.2, -G]),
    )


def predicted(state: InertialState, end: float) -> InertialState:
    """Return the state at the end of a walk's samples."""
    imu = segment(
        Motion(turn=1.0, nod=0.2, speed=1.0).imu(0.0, end + 0.01),
        [at(0.0), at(end)],
        50_000_000,
        np.zeros(3),
    )
    sums = integrate(
        imu,
        0,
        gyro_bias=state.gyro_bias,
        accel_bias=state.accel_bias,
        rest_force=state.rest_force,
    )
    return state.at(sums, len(imu.stamps) - 1)


def test_boxminus_undoes_boxplus() -> None:
    state = some_state()
    error = np.random.default_rng(2).normal(0.0, 0.3, eskf.ERRORS)
    np.testing.assert_allclose(state.boxplus(error).boxminus(state), error, atol=1e-9)


def test_the_transition_is_the_derivative_of_the_prediction() -> None:
    dt = 0.04
    state = some_state()
    base = predicted(state, dt)
    measured = np.empty((eskf.ERRORS, eskf.ERRORS))
    for column in range(eskf.ERRORS):
        error = np.zeros(eskf.ERRORS)
        error[column] = STEP
        measured[:, column] = predicted(state.boxplus(error), dt).boxminus(base) / STEP
    turn = state.rotation.T @ base.rotation
    gained = state.rotation.T @ (base.velocity - state.velocity - dt * state.gravity)
    found = eskf.transition(state.rotation, turn, gained / dt, dt)
    # first order in the turn within a step: 0.04 s at 1 rad/s
    np.testing.assert_allclose(found, measured, atol=0.05 * dt)


def test_the_covariance_is_that_of_one_step_after_the_other() -> None:
    """With a gap in the samples, so that the noise differs between the steps."""
    state, p = some_state(), np.diag(np.linspace(0.1, 1.0, eskf.ERRORS)) ** 2
    samples = Motion(turn=1.0, nod=0.2, speed=1.0).imu(0.0, 0.41)
    samples = samples[(samples["stamp"] < at(0.1)) | (samples["stamp"] > at(0.22))]
    imu = segment(samples, [at(0.0), at(0.4)], 50_000_000, np.zeros(3))
    sums = integrate(
        imu,
        0,
        gyro_bias=state.gyro_bias,
        accel_bias=state.accel_bias,
        rest_force=state.rest_force,
    )
    noise, knot = Noise(0.005, 0.02, 1e-4, 1e-3), len(imu.stamps) - 1
    found = eskf.predict(state, p, imu, sums, knot, noise)[1]
    edges = np.linspace(0, knot, tuning.COVARIANCE_STEPS + 1).astype(int).tolist()
    shares = []
    for first, last in pairwise(edges):
        one, other = state.at(sums, first), state.at(sums, last)
        dt = (other.stamp - one.stamp) * 1e-9
        gained = other.velocity - one.velocity - dt * state.gravity
        f = eskf.transition(
            one.rotation, one.rotation.T @ other.rotation, one.rotation.T @ gained / dt, dt
        )
        spans = np.diff(imu.stamps[first : last + 1])
        blind = float(spans[imu.missing[first:last]].sum() / spans.sum())
        held = np.abs(sums.rates[first : last + 1]).max()
        unmeasured = tuning.BLIND_GYRO**2 + (tuning.BLIND_GYRO_SHARE * held) ** 2
        gyro2 = (1.0 - blind) * noise.gyro**2 + blind * unmeasured
        accel2 = (1.0 - blind) * noise.accel**2 + blind * tuning.BLIND_ACCEL**2
        p = f @ p @ f.T + eskf.process_noise(gyro2, accel2, noise, dt)
        shares.append(blind)
    assert min(shares) == 0.0 < max(shares)
    np.testing.assert_allclose(found, p, rtol=1e-9, atol=1e-12)


def at_rest() -> InertialState:
    state = some_state()
    return dataclasses.replace(
        state,
        rotation=np.eye(3),
        velocity=np.zeros(3),
        gyro_bias=np.zeros(3),
        accel_bias=np.zeros(3),
        gravity=np.array([0.0, 0.0, -G]),
    )


def blow(t: F64) -> F64:
    """Return the accelerations [m/s^2] of a push by a centimeter and back, in 0.12 s at 0.2 s."""
    u = np.clip((t - 0.2) / 0.06, -1.0, 1.0)
    bump = np.polynomial.Polynomial([1.0, 0.0, -1.0]) ** 5
    return np.asarray(0.01 * bump.deriv(2)(u) / 0.06**2)


def sigmas_after_gap(lasted: float, motion: Motion) -> tuple[float, float]:
    """Return the sigmas of attitude [rad] and velocity [m/s] that 0.3 s with a gap in them add."""
    samples = motion.imu(0.0, 0.31)
    begin = 0.1 + 1e-4  # between two samples
    samples = samples[(samples["stamp"] < at(begin)) | (samples["stamp"] > at(begin + lasted))]
    imu = segment(samples, [at(0.0), at(0.3)], 50_000_000, np.zeros(3))
    state = dataclasses.replace(at_rest(), rotation=motion.rotation(np.zeros(1)).as_matrix()[0])
    sums = integrate(
        imu,
        0,
        gyro_bias=state.gyro_bias,
        accel_bias=state.accel_bias,
        rest_force=state.rest_force,
    )
    nothing = np.zeros((eskf.ERRORS, eskf.ERRORS))
    knot = len(imu.stamps) - 1
    found = eskf.predict(state, nothing, imu, sums, knot, Noise(0.0, 0.0, 0.0, 0.0))[1]
    turned, moved = np.linalg.eigvalsh(found[eskf.ROTATION, eskf.ROTATION]), found[8, 8]
    return float(np.sqrt(turned[-1])), float(np.sqrt(moved))


@pytest.mark.parametrize("lasted", [0.036, 0.056])
def test_a_blow_between_two_samples_is_within_the_covariance(lasted: float) -> None:
    """Too few samples are missing for a gap, or just enough; the force turns by 50 m/s^2."""
    stamps = np.arange(0.0, 0.4, 0.004)
    normalized = []
    for first in np.arange(0.12, 0.24, 0.004):
        samples = np.zeros(len(stamps), IMU_SAMPLE)
        samples["stamp"] = [at(instant) for instant in stamps.tolist()]
        samples["linear_acceleration"][:, 0] = blow(stamps)
        samples["linear_acceleration"][:, 2] = G
        lost = (stamps > first + 1e-4) & (stamps < first + lasted - 1e-4)
        state = at_rest()
        imu = segment(samples[~lost], [at(0.0), at(0.36)], 50_000_000, np.zeros(3))
        sums = integrate(
            imu, 0, gyro_bias=np.zeros(3), accel_bias=np.zeros(3), rest_force=state.rest_force
        )
        nothing, knot = np.zeros((eskf.ERRORS, eskf.ERRORS)), len(imu.stamps) - 1
        noise = Noise(0.0, 0.0, 0.0, 0.0)
        end, p = eskf.predict(state, nothing, imu, sums, knot, noise)
        variance = p[eskf.VELOCITY, eskf.VELOCITY][0, 0]
        normalized.append(end.velocity[0] ** 2 / variance)  # a blow leaves no velocity behind
    assert max(normalized) < 3.0**2
    assert 0.1 < np.mean(normalized) < 2.0


def test_in_a_short_gap_a_carrier_goes_on_as_around_it() -> None:
    steady, walk = Motion(turn=0.3), Motion(turn=0.3, nod=0.3, speed=1.2)
    least_rate, least_acceleration = tuning.BLIND_SHORT_SPREAD
    for lasted in (0.06, 0.09):
        turned, moved = sigmas_after_gap(lasted, steady)
        # drifts by the least spread for as long as the gap, from sample to sample
        assert turned == pytest.approx(least_rate * (lasted + 0.004), rel=0.05)
        assert moved == pytest.approx(least_acceleration * (lasted + 0.004), rel=0.2)
        more_turned, more_moved = sigmas_after_gap(lasted, walk)
        assert more_turned > 3.0 * turned
        assert more_moved > 2.0 * moved
    # beyond that nothing around it tells
    turned, moved = sigmas_after_gap(0.11, steady)
    assert turned > tuning.BLIND_GYRO * np.sqrt(0.11)
    assert moved > tuning.BLIND_ACCEL * np.sqrt(0.11)


def test_a_short_gap_costs_no_more_than_a_long_one() -> None:
    """However the carrier is shaken: here by up to 75 m/s^2."""
    _, moved = sigmas_after_gap(0.09, Motion(speed=30.0))
    assert moved == pytest.approx(tuning.BLIND_ACCEL * np.sqrt(0.094), rel=0.1)


def test_the_probability_of_an_association_is_its_frequency() -> None:
    """Right innovations as expected, and false ones anywhere, a hundred in each unit."""
    rng = np.random.default_rng(3)
    sigma, count, density = 0.2, 400, 1000.0
    odds = count / density
    right = sigma * rng.standard_normal(100 * count)
    false = rng.uniform(-2.0, 2.0, round(100 * density * 4.0))
    for innovation in (0.0, 0.15, 0.4, 0.8):
        hits, misses = (
            np.count_nonzero(np.abs(some - innovation) < 0.02) for some in (right, false)
        )
        found = eskf.association_probability(innovation, sigma**2, odds)
        assert found == pytest.approx(hits / (hits + misses), rel=0.1, abs=0.01)


def test_a_share_of_the_rate_counts_as_noise_of_the_gyro() -> None:
    """Errors of scale and axes; where the sensor hardly turns they are nothing."""
    state, p = some_state(), 1e-6 * np.eye(eskf.ERRORS)
    for turn in (0.0, 2.0):
        imu = segment(
            Motion(turn=turn).imu(0.0, 0.21), [at(0.0), at(0.2)], 50_000_000, np.zeros(3)
        )
        sums = integrate(
            imu,
            0,
            gyro_bias=np.zeros(3),
            accel_bias=state.accel_bias,
            rest_force=state.rest_force,
        )
        knot = len(imu.stamps) - 1
        found, expected = (
            eskf.predict(state, p, imu, sums, knot, noise)[1]
            for noise in (
                Noise(0.003, 0.02, 1e-4, 1e-3, 0.002),
                Noise(float(np.hypot(0.003, 0.002 * turn)), 0.02, 1e-4, 1e-3),
            )
        )
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-15)


def covariance_after(noise: Noise, motion: Motion, **changes: Any) -> F64:
    """Return the covariance after 0.2 s of a motion."""
    state, p = dataclasses.replace(some_state(), **changes), 1e-6 * np.eye(eskf.ERRORS)
    imu = segment(motion.imu(0.0, 0.21), [at(0.0), at(0.2)], 50_000_000, np.zeros(3))
    sums = integrate(
        imu, 0, gyro_bias=np.zeros(3), accel_bias=state.accel_bias, rest_force=state.rest_force
    )
    return eskf.predict(state, p, imu, sums, len(imu.stamps) - 1, noise)[1]


@pytest.mark.parametrize("force", [0.0, 2.0])
def test_a_share_of_the_acceleration_counts_as_noise_of_the_accelerometer(force: float) -> None:
    """Gravity, which the accelerometer measures as well, does not count."""
    state = some_state()
    gravity = np.array([0.0, 0.0, -9.80665])
    steady = Motion(turn=0.0).imu(0.0, 0.21)
    measured = steady["linear_acceleration"][0]
    # so that the force is that of rest, and some acceleration
    bias = measured + state.rotation.T @ gravity - np.array([force, 0.0, 0.0])
    assert np.ptp(steady["linear_acceleration"], axis=0).max() < 1e-9
    found, expected = (
        covariance_after(noise, Motion(turn=0.0), accel_bias=bias, gravity=gravity)
        for noise in (
            Noise(0.003, 0.02, 1e-4, 1e-3, accel_share=0.01),
            Noise(0.003, float(np.hypot(0.02, 0.01 * force)), 1e-4, 1e-3),
        )
    )
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-15)


def test_a_vibration_errs_at_both_ends_however_long_it_lasts() -> None:
    quiet = covariance_after(Noise(0.003, 0.02, 1e-4, 1e-3), Motion())
    shaken = Noise(0.003, 0.02, 1e-4, 1e-3, gyro_vibration=0.001, accel_vibration=0.02)
    found = covariance_after(shaken, Motion())
    expected = np.zeros((eskf.ERRORS, eskf.ERRORS))
    expected[eskf.ROTATION, eskf.ROTATION] = 2.0 * 0.001**2 * np.eye(3)
    expected[eskf.VELOCITY, eskf.VELOCITY] = 2.0 * 0.02**2 * np.eye(3)
    np.testing.assert_allclose(found - quiet, expected, atol=1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_the_twist_jacobian_is_the_derivative_of_the_velocity(seed: int) -> None:
    state, rate = some_state(seed), np.array([0.3, -0.5, 1.0])
    base = eskf.body_velocity(state, rate, LEVER)
    found = eskf.twist_jacobian(state, LEVER)
    for column in range(eskf.ERRORS):
        error = np.zeros(eskf.ERRORS)
        error[column] = STEP
        moved = eskf.body_velocity(state.boxplus(error), rate, LEVER)
        np.testing.assert_allclose(found[:, column], (moved - base) / STEP, atol=1e-5)


def test_a_twist_sets_the_velocity_and_reports_its_surprise() -> None:
    state = some_state()
    sigma = np.full(eskf.ERRORS, 1e-3)
    sigma[eskf.VELOCITY] = 1.0
    rate, wanted = np.array([0.0, 0.0, 1.0]), np.array([1.0, 2.0, -0.5])
    noise = 0.01**2 * np.eye(3)
    found = eskf.update_twist(state, np.diag(sigma**2), wanted, noise, rate, LEVER)
    np.testing.assert_allclose(eskf.body_velocity(found.state, rate, LEVER), wanted, atol=2e-3)
    innovation = wanted - eskf.body_velocity(state, rate, LEVER)
    assert found.nis == pytest.approx(float(innovation @ innovation), rel=0.05)


def test_a_static_stretch_measures_bias_and_gravity() -> None:
    samples = np.zeros(500, IMU_SAMPLE)
    samples["stamp"] = EPOCH + np.arange(500) * 4_000_000
    state = some_state()
    samples["angular_velocity"] = (0.03, -0.02, 0.01)
    tilted = rotations.matrices(rotations.exp((0.02, -0.01, 0.0)))
    samples["linear_acceleration"] = tilted.T @ state.rest_force
    sigma = np.full(eskf.ERRORS, 0.05)
    sigma[eskf.ACCEL_BIAS], sigma[eskf.GRAVITY] = 1e-4, 1e-4
    noise = Noise(0.005, 0.01, 1e-4, 1e-3)
    found, covariance = eskf.update_static(
        state, np.diag(sigma**2), samples, noise, True, levels=True
    )
    np.testing.assert_allclose(found.gyro_bias, (0.03, -0.02, 0.01), atol=1e-3)
    force = samples["linear_acceleration"][0]
    np.testing.assert_allclose(found.rest_force + found.accel_bias, force, atol=0.01)
    assert not found.velocity.any()
    assert np.diag(covariance)[eskf.GYRO_BIAS].max() < 0.004**2
    held, _ = eskf.update_static(state, np.diag(sigma**2), samples, noise, True)
    np.testing.assert_array_equal(held.rotation, state.rotation)


def test_the_prior_touches_only_a_velocity_that_is_hardly_known() -> None:
    state = some_state()
    tight = np.eye(eskf.ERRORS) * 0.1**2
    assert carrier_priors.apply_zero_velocity_prior(state, tight, 1.0, 0.0)[0] is state
    loose = np.eye(eskf.ERRORS)
    slowed, covariance = carrier_priors.apply_zero_velocity_prior(state, loose, 1.0, 0.0)
    np.testing.assert_allclose(slowed.velocity, 0.5 * state.velocity, atol=1e-9)
    assert covariance[6, 6] == pytest.approx(0.5)
    # nor does one that drives, until its velocity is known worse than it has ever driven
    drives = tuning.DRIVING_SPEED + 0.1
    known = np.eye(eskf.ERRORS) * (0.99 * drives) ** 2
    level = dataclasses.replace(state, gravity=np.zeros(3))
    assert carrier_priors.apply_zero_velocity_prior(level, known, 1.0, drives)[0] is level
    slowed, _ = carrier_priors.apply_zero_velocity_prior(level, 1.1 * known, 1.0, drives)
    assert np.linalg.norm(slowed.velocity) < 0.6 * np.linalg.norm(level.velocity)
    crawls = tuning.DRIVING_SPEED - 0.1
    assert carrier_priors.apply_zero_velocity_prior(level, known, 1.0, crawls)[0] is not level


def test_a_minute_of_the_prior_brakes_no_drive_but_ends_a_climb() -> None:
    # known by the IMU alone to 0.3 m/s, of a carrier that was seen to drive at 1.2 m/s
    gravity = np.array([3.0, 0.0, -9.3])
    up = -gravity / np.linalg.norm(gravity)
    ahead = np.array([-up[2], 0.0, up[0]])
    start = dataclasses.replace(some_state(), gravity=gravity, velocity=1.2 * ahead + 1.5 * up)
    state, covariance = start, np.eye(eskf.ERRORS) * 0.3**2
    for _ in range(600):
        state, covariance = carrier_priors.apply_zero_velocity_prior(state, covariance, 0.1, 1.2)
    assert ahead @ state.velocity == pytest.approx(1.2, abs=1e-9)
    # until the vertical velocity is known well enough
    least = tuning.PRIOR_FROM_SIGMA**2
    assert up @ covariance[eskf.VELOCITY, eskf.VELOCITY] @ up == pytest.approx(least, rel=0.01)
    assert up @ state.velocity == pytest.approx(1.5 * least / 0.3**2, rel=0.01)
    # a slow carrier stops; where gravity is not known nothing is vertical
    slow, _ = carrier_priors.apply_zero_velocity_prior(
        start, np.eye(eskf.ERRORS) * 0.3**2, 60.0, 0.3
    )
    assert np.linalg.norm(slow.velocity) < 0.2 * np.linalg.norm(start.velocity)
    adrift = dataclasses.replace(start, gravity=np.zeros(3))
    assert (
        carrier_priors.apply_zero_velocity_prior(adrift, np.eye(eskf.ERRORS) * 0.3**2, 60.0, 1.2)[
            0
        ]
        is adrift
    )


def test_unobserved_heights_draw_the_vertical_velocity_only() -> None:
    gravity = np.array([3.0, 0.0, -9.3])
    up = -gravity / np.linalg.norm(gravity)
    ahead = np.array([-up[2], 0.0, up[0]])
    start = dataclasses.replace(some_state(), gravity=gravity, velocity=0.5 * ahead + 0.1 * up)
    sigma = 1.4 * tuning.RISE_FLOOR
    loose = np.eye(eskf.ERRORS) * sigma**2
    assert carrier_priors.apply_zero_velocity_prior(start, loose, 0.1, 1.2)[0] is start
    noise = tuning.RISE_SPEED**2 / 0.1
    left = noise / (noise + sigma**2)
    state, covariance = carrier_priors.apply_zero_velocity_prior(
        start, loose, 0.1, 1.2, height_observed=False
    )
    assert up @ state.velocity == pytest.approx(0.1 * left, rel=1e-6)
    assert ahead @ state.velocity == pytest.approx(0.5, abs=1e-12)
    speeds = covariance[eskf.VELOCITY, eskf.VELOCITY]
    assert up @ speeds @ up == pytest.approx(sigma**2 * left, rel=1e-6)
    assert ahead @ speeds @ ahead == pytest.approx(sigma**2)
    # nor does it become certain by that
    for _ in range(100):
        state, covariance = carrier_priors.apply_zero_velocity_prior(
            state, covariance, 0.1, 1.2, height_observed=False
        )
    assert up @ state.velocity == pytest.approx(0.0, abs=1e-6)
    speeds = covariance[eskf.VELOCITY, eskf.VELOCITY]
    np.testing.assert_allclose(speeds @ up, tuning.RISE_FLOOR**2 * up, atol=1e-12)
    assert ahead @ speeds @ ahead == pytest.approx(sigma**2)
    # what the IMU knows better stays as it is
    known = np.eye(eskf.ERRORS) * (0.9 * tuning.RISE_FROM_SIGMA) ** 2
    assert (
        carrier_priors.apply_zero_velocity_prior(start, known, 0.1, 1.2, height_observed=False)[0]
        is start
    )
    # in all directions a velocity that is hardly known at all is drawn as before
    lost, _ = carrier_priors.apply_zero_velocity_prior(
        start, np.eye(eskf.ERRORS), 1.0, 0.0, height_observed=False
    )
    assert ahead @ lost.velocity == pytest.approx(0.25)
    assert up @ lost.velocity < 0.001


def test_the_peak_speed_is_the_highest_that_was_known_of_late() -> None:
    state = dataclasses.replace(some_state(), velocity=np.array([0.0, 1.2, 0.0]))
    known = np.eye(eskf.ERRORS) * (0.9 * tuning.PRIOR_LEARN_SIGMA) ** 2
    assert carrier_priors.peak_speed_after(0.3, state, known, 0.1) == pytest.approx(1.2)
    # one that stands is slow after some minutes
    left = carrier_priors.peak_speed_after(2.4, state, known, tuning.PRIOR_MEMORY_S / 2.0)
    assert left == pytest.approx(2.4 * np.exp(-0.5))
    assert carrier_priors.peak_speed_after(
        2.4, state, known, 3.0 * tuning.PRIOR_MEMORY_S
    ) == pytest.approx(1.2)


def test_of_a_velocity_that_is_hardly_known_only_the_least_speed_counts() -> None:
    state = dataclasses.replace(some_state(), velocity=np.array([0.0, 1.3, 0.0]))
    loose = np.eye(eskf.ERRORS) * 1e-4
    for sigma in (1.1 * tuning.PRIOR_LEARN_SIGMA, 0.2):
        loose[8, 8] = sigma**2
        expected = 1.3 - tuning.PRIOR_LEARN_SIGMAS * sigma
        assert carrier_priors.peak_speed_after(0.3, state, loose, 0.1) == pytest.approx(expected)
    # nothing is forgotten meanwhile
    loose[8, 8] = 1.0
    assert carrier_priors.peak_speed_after(0.3, state, loose, 60.0) == 0.3


@pytest.mark.parametrize(
    ("speed", "sigma", "may_drive", "drives_if_found"),
    [
        (0.3, 0.2, False, False),
        (0.3, 0.3, True, False),
        (0.9, 0.2, True, True),
        (0.9, 0.5, True, False),  # it may as well stand
    ],
)
def test_a_carrier_may_drive_by_what_is_known_of_its_velocity(
    speed: float, sigma: float, may_drive: bool, drives_if_found: bool
) -> None:
    state = dataclasses.replace(some_state(), velocity=np.array([0.0, speed, 0.0]))
    loose = np.eye(eskf.ERRORS) * 1e-4
    loose[8, 8] = sigma**2
    carrier = carrier_priors.Carrier()
    assert carrier.may_drive(state, loose) == may_drive
    assert not carrier.drives
    carrier.note_found(state, loose)
    assert carrier.drives == drives_if_found
    carrier.peak_speed = 2.0
    carrier.note_found(state, loose)
    assert carrier.peak_speed == 2.0
    known = 1e-4 * np.eye(eskf.ERRORS)
    assert carrier.may_drive(state, known) == (speed > tuning.DRIVING_SPEED)


def test_what_is_moved_by_hand_is_drawn_to_zero_by_its_own_speed() -> None:
    level = dataclasses.replace(
        some_state(), velocity=np.array([0.0, 0.4, 0.0]), gravity=np.zeros(3)
    )
    known = np.eye(eskf.ERRORS) * (0.9 * tuning.HAND_FROM_SIGMA) ** 2
    loose = np.eye(eskf.ERRORS) * (1.1 * tuning.HAND_FROM_SIGMA) ** 2
    assert carrier_priors.apply_zero_velocity_prior(level, known, 1.0, 0.5)[0] is level
    # of a carrier of which nothing is known, it has to be less certain
    assert carrier_priors.apply_zero_velocity_prior(level, loose, 1.0, 0.0)[0] is level
    for peak in (0.5, 0.01):  # a very slow one does not say that it stands
        noise = max(peak, tuning.HAND_SPEED) ** 2 / 0.5
        left = noise / (noise + loose[7, 7])
        slowed, covariance = carrier_priors.apply_zero_velocity_prior(level, loose, 0.5, peak)
        assert slowed.velocity[1] == pytest.approx(0.4 * left)
        assert covariance[7, 7] == pytest.approx(loose[7, 7] * left)


def test_the_size_of_gravity_comes_back_and_the_bias_with_it() -> None:
    down = np.array([0.02, -0.01, -9.80])
    state = dataclasses.replace(some_state(), gravity=down)
    covariance = 1e-4 * np.eye(eskf.ERRORS)
    assert carrier_priors.with_gravity_of_known_size(state, covariance)[0] is state  # within 0.1 %
    nothing = dataclasses.replace(state, gravity=np.zeros(3))
    assert carrier_priors.with_gravity_of_known_size(nothing, covariance)[0] is nothing
    # 1 % of gravity and a bias along it have been taken for each other
    state = dataclasses.replace(state, gravity=1.01 * down)
    along = np.zeros((eskf.ERRORS, 1))
    along[eskf.GRAVITY, 0] = down / 9.8
    along[eskf.ACCEL_BIAS, 0] = state.rotation.T @ down / 9.8
    found, after = carrier_priors.with_gravity_of_known_size(
        state, covariance + 0.1**2 * along @ along.T
    )
    assert np.linalg.norm(found.gravity) == pytest.approx(9.80665, abs=0.01)
    np.testing.assert_allclose(np.cross(found.gravity, down), 0.0, atol=0.02)
    moved = found.accel_bias - state.accel_bias
    np.testing.assert_allclose(state.rotation @ moved, found.gravity - state.gravity, atol=0.01)
    assert np.trace(after) < np.trace(covariance + 0.1**2 * along @ along.T)


def test_a_leaning_map_makes_the_vertical_less_certain_not_its_size() -> None:
    state = dataclasses.replace(some_state(), gravity=np.array([0.0, 0.0, -9.8]))
    before = 1e-6 * np.eye(eskf.ERRORS)
    added = eskf.with_leaning_gravity(state, before, 0.01**2) - before
    np.testing.assert_allclose(
        added[eskf.GRAVITY, eskf.GRAVITY], np.diag([0.098**2, 0.098**2, 0.0]), atol=1e-12
    )
    added[eskf.GRAVITY, eskf.GRAVITY] = 0.0
    assert not added.any()


def test_biases_that_no_sensor_has_are_told() -> None:
    state = dataclasses.replace(some_state(), gyro_bias=np.zeros(3), accel_bias=np.zeros(3))
    assert carrier_priors.biases_are_plausible(state)
    fast = dataclasses.replace(state, gyro_bias=np.array([0.0, 0.25, 0.0]))
    assert not carrier_priors.biases_are_plausible(fast)
    heavy = dataclasses.replace(state, accel_bias=np.array([0.0, 0.0, -1.1]))
    assert not carrier_priors.biases_are_plausible(heavy)


def test_a_speed_above_the_bound_comes_back_with_what_it_led_to() -> None:
    state = dataclasses.replace(some_state(), velocity=np.array([6.0, 8.0, 0.0]))
    covariance = 0.01 * np.eye(eskf.ERRORS)
    # 2 s of a wrong velocity are in the place
    covariance[3:6, 3:6] = 0.05 * np.eye(3)
    covariance[3:6, 6:9] = covariance[6:9, 3:6] = 0.02 * np.eye(3)
    assert carrier_priors.bound_speed(state, covariance, 10.0)[0] is state
    found, after = carrier_priors.bound_speed(state, covariance, 3.0)
    assert np.linalg.norm(found.velocity) == pytest.approx(3.0, abs=0.02)
    np.testing.assert_allclose(found.velocity / np.linalg.norm(found.velocity), (0.6, 0.8, 0.0))
    moved = found.position - state.position
    np.testing.assert_allclose(np.cross(moved, (0.6, 0.8, 0.0)), 0.0, atol=1e-9)
    assert moved @ (0.6, 0.8, 0.0) < 0.0
    # nothing is surer than before, and the velocity allows for the excess
    assert np.linalg.eigvalsh(after - covariance).min() > -1e-12
    assert after[6, 6] == pytest.approx(0.01 + 7.0**2 * 0.36)


def test_information_form_equals_the_ordinary_update() -> None:
    state, rng = some_state(), np.random.default_rng(5)
    covariance = np.diag(rng.uniform(0.01, 0.1, eskf.ERRORS) ** 2)
    jacobian, residual = rng.normal(0, 1, (40, eskf.ERRORS)), rng.normal(0, 0.01, 40)
    weight = 1.0 / 0.05**2
    plain = eskf.update(state, covariance, residual, jacobian, np.eye(40) / weight)
    # iterated: where the residuals are linearized is not the prior
    off = rng.normal(0, 0.02, eskf.ERRORS)
    at = state.boxplus(off)
    root = eskf.square_root(covariance)
    np.testing.assert_allclose(root @ root.T, covariance, atol=1e-18)
    found, posterior = eskf.update_with_information(
        state,
        root,
        at,
        weight * jacobian.T @ jacobian,
        weight * jacobian.T @ (residual - jacobian @ at.boxminus(state)),
    )
    np.testing.assert_allclose(found.boxminus(plain.state), 0.0, atol=2e-4)  # turns do not commute
    np.testing.assert_allclose(posterior, plain.covariance, atol=1e-12)


def test_the_information_form_keeps_what_is_certain_and_is_never_negative() -> None:
    """Of a singular covariance, and of information that is a million million times stronger."""
    state, rng = some_state(), np.random.default_rng(6)
    sigma = rng.uniform(0.01, 0.1, eskf.ERRORS)
    sigma[eskf.POSITION] = 0.0
    jacobian = rng.normal(0, 1, (40, eskf.ERRORS))
    found, posterior = eskf.update_with_information(
        state,
        eskf.square_root(np.diag(sigma**2)),
        state,
        1e12 * jacobian.T @ jacobian,
        1e12 * jacobian.T @ rng.normal(0, 0.01, 40),
    )
    np.testing.assert_allclose(found.position, state.position, atol=1e-12)
    np.testing.assert_allclose(posterior[eskf.POSITION], 0.0, atol=1e-18)
    np.testing.assert_array_equal(posterior, posterior.T)
    assert np.linalg.eigvalsh(posterior).min() > -1e-24
    assert (np.diag(posterior)[eskf.VELOCITY] < 1e-10).all()


def simulated_nees(seed: int, accel_scale: float = 1.0) -> F64:
    """Return the NEES of velocity and rotation after each of some twists, one run."""
    rng = np.random.default_rng(seed)
    noise = Noise(0.002, 0.01, 1e-4, 1e-3)
    rate_hz, sigma_twist = 250.0, 0.02
    motion = Motion(turn=0.6, nod=0.15, speed=0.8)
    samples = motion.imu(0.0, 6.0)
    count = len(samples)
    samples["angular_velocity"] += rng.normal(0, noise.gyro * rate_hz**0.5, (count, 3))
    force = rng.normal(0, accel_scale * noise.accel * rate_hz**0.5, (count, 3))
    samples["linear_acceleration"] += force
    h, t0 = 1e-4, np.array([0.0])

    def truth(t: F64) -> tuple[F64, F64]:
        velocity = (motion.position(t + h) - motion.position(t - h)) / (2 * h)
        return motion.rotation(t).as_matrix()[0], velocity[0]

    rotation, velocity = truth(t0)
    zero = np.zeros(3)
    true = InertialState(at(0.0), rotation, zero, velocity, zero, zero, np.array([0.0, 0.0, -G]))
    sigma = np.full(eskf.ERRORS, 1e-4)
    sigma[eskf.ROTATION], sigma[eskf.VELOCITY] = 0.02, 0.1
    sigma[eskf.GYRO_BIAS], sigma[eskf.ACCEL_BIAS] = 0.003, 0.02
    covariance = np.diag(sigma**2)
    off = rng.normal(0, 1, eskf.ERRORS) * sigma
    off[eskf.GYRO_BIAS] = off[eskf.ACCEL_BIAS] = 0.0  # these errors are in the samples instead
    state = true.boxplus(off)
    samples["angular_velocity"] += rng.normal(0, 0.003, 3)
    samples["linear_acceleration"] += rng.normal(0, 0.02, 3)
    found = []
    for k in range(1, 25):
        stamp = HostNs(at(0.25 * k))
        first, last = np.searchsorted(samples["stamp"], [state.stamp, stamp])
        imu = segment(samples[first : last + 2], [state.stamp, stamp], 50_000_000, zero)
        sums = integrate(
            imu,
            0,
            gyro_bias=state.gyro_bias,
            accel_bias=state.accel_bias,
            rest_force=state.rest_force,
        )
        state, covariance = eskf.predict(state, covariance, imu, sums, len(imu.stamps) - 1, noise)
        rotation, velocity = truth(np.array([0.25 * k]))
        measured = rotation.T @ velocity + rng.normal(0, sigma_twist, 3)
        state, covariance, _ = eskf.update_twist(
            state, covariance, measured, sigma_twist**2 * np.eye(3), zero, zero
        )
        turn = rotations.log(rotations.from_matrix(rotation.T @ state.rotation))
        error = np.concatenate((turn, state.velocity - velocity))
        some = np.r_[eskf.ROTATION, eskf.VELOCITY]
        found.append(error @ np.linalg.solve(covariance[np.ix_(some, some)], error))
    return np.array(found)


def test_the_covariance_is_honest() -> None:
    """NEES over 30 runs: its mean within the 99.8 % band of 6 degrees of freedom."""
    runs = np.array([simulated_nees(seed) for seed in range(30)])
    means = runs[:, 4:].mean(axis=0)
    low, high = chdtri(6 * 30, [0.999, 0.001]) / 30  # quantiles of chi2
    # the IMU's lever arm of the analytic motion is 2 cm and is left out: a little above 6
    assert (means > low).mean() > 0.9
    assert (means < 1.3 * high).mean() > 0.9


def test_noise_of_another_scale_shows_in_the_nees() -> None:
    honest = np.mean([simulated_nees(seed)[8:].mean() for seed in range(6)])
    louder = np.mean([simulated_nees(seed, 6.0)[8:].mean() for seed in range(6)])
    assert louder > 2.0 * honest
