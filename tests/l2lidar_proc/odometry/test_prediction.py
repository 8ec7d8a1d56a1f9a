"""Dead reckoning against the odometry's own extrapolation, its next estimate, and bad samples."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest

from l2lidar_node import rotations
from l2lidar_node.types import IMU_SAMPLE, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.motion.head_line import HeadAngle, LineRates
from l2lidar_proc.motion.imu_buffer import replay
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.odometry import Odometry
from l2lidar_proc.odometry.prediction import LONGEST_NS, DeadReckoning, ImuUse, Predictor
from l2lidar_proc.odometry.uncertainty import MapDrift
from tests.l2lidar_proc.motion.analytic import EPOCH, Motion
from tests.l2lidar_proc.odometry.odometry_world import T_CLOUD_IMU, recording
from tests.support.odometry_runs import sweeps

STEP = 5  # samples, 20 ms
GAP_NS = 50_000_000


@cache
def track(world: str, motion: str) -> list[tuple[Any, Any, Any]]:
    """Return dead reckoning, extrapolation and the extrapolation after the sweep, of each."""
    found, run = [], recording(world, motion)
    odometry = Odometry(OdometryConfig(), T_CLOUD_IMU)
    reckoning = DeadReckoning(T_CLOUD_IMU, GAP_NS)
    for sweep, samples in replay(sweeps(run, "turn"), run.imu):
        for begin in range(0, len(samples), STEP):
            some = samples[begin : begin + STEP]
            odometry.imu(some)
            carried = carry(reckoning, some)
        newest = HostNs(int(samples["stamp"][-1]))
        full = odometry.extrapolated(newest)
        odometry.register(sweep)
        corrected = odometry.extrapolated(newest)
        if carried is not None:
            assert carried.stamp == full.stamp == corrected.stamp == newest
            found.append((carried, full, corrected))
        reckoning.reset(corrected)
    return found


def carry(reckoning: DeadReckoning, samples: Any) -> Any:
    """Return the estimate at the last of some samples, None if there is none."""
    pose = reckoning.carry(samples)
    if pose is None:
        return None
    np.testing.assert_array_equal(reckoning.estimate.T_map_lidar, pose)
    return reckoning.estimate


def turned_by(one: Any, other: Any) -> Any:
    between = one.T_map_lidar[:3, :3].T @ other.T_map_lidar[:3, :3]
    return np.arccos(np.clip((np.trace(between) - 1.0) / 2.0, -1.0, 1.0))


@pytest.mark.parametrize(("world", "motion"), [("room", "trot"), ("yard", "drone")])
def test_it_is_as_good_as_every_sample_by_itself(world: str, motion: str) -> None:
    found = track(world, motion)
    assert len(found) >= 15
    for carried, full, _ in found:
        apart = carried.T_map_lidar[:3, 3] - full.T_map_lidar[:3, 3]
        assert np.linalg.norm(apart) < 1e-3
        assert turned_by(carried, full) < 1e-3
        np.testing.assert_allclose(carried.velocity, full.velocity, atol=0.05)
        sigmas = np.sqrt(np.diag(carried.covariance) / np.diag(full.covariance))
        assert sigmas.min() > 0.75
        assert sigmas.max() < 1.5
        together, expected = carried.gyro_bias_covariance, full.gyro_bias_covariance
        scale = np.sqrt(np.diag(full.covariance)[3:].max() * expected[6:].max())
        np.testing.assert_allclose(together[3:6], expected[3:6], atol=5e-3 * scale)
        np.testing.assert_allclose(together[6:], expected[6:], rtol=2e-3)


@pytest.mark.parametrize(("world", "motion"), [("room", "walk"), ("room", "trot")])
def test_what_the_next_sweep_corrects_is_within_the_reported_sigma(
    world: str, motion: str
) -> None:
    corrections = np.array(
        [
            np.abs(corrected.T_map_lidar[:3, 3] - carried.T_map_lidar[:3, 3])
            / np.sqrt(np.diag(carried.covariance)[:3])
            for carried, _, corrected in track(world, motion)
        ]
    )
    assert len(corrections) >= 15
    assert corrections.max() < 3.0


@pytest.fixture(scope="module")
def estimate() -> Any:
    """Return an estimate without a line of the head, as that of another sensor."""
    found = track("room", "walk")[5][0]
    assert found.gyro_line is not None
    return dataclasses.replace(found, gyro_line=None)


def samples(start: Any, count: Any, **fields: Any) -> Any:
    made = np.zeros(count, IMU_SAMPLE)
    made["stamp"] = start + 4_000_000 * np.arange(1, count + 1)
    made["linear_acceleration"] = [0.0, 0.0, 9.80665]
    for name, value in fields.items():
        made[name] = value
    return made


def test_nothing_comes_of_nothing(estimate: Any) -> None:
    reckoning = DeadReckoning(T_CLOUD_IMU, GAP_NS)
    with pytest.raises(ValueError, match="no estimate"):
        assert reckoning.estimate
    assert carry(reckoning, samples(estimate.stamp, 5)) is None
    reckoning.reset(estimate)
    assert carry(reckoning, samples(estimate.stamp, 0)) is None


def test_samples_that_are_damaged_or_late_move_nothing(estimate: Any) -> None:
    reckoning = DeadReckoning(T_CLOUD_IMU, GAP_NS)
    reckoning.reset(estimate)
    good = carry(reckoning, samples(estimate.stamp, 5))
    assert good is not None
    assert carry(reckoning, samples(estimate.stamp, 5)) is None, "again"
    bad = samples(good.stamp, 3, angular_velocity=np.nan)
    assert carry(reckoning, bad) is None
    shuffled = samples(good.stamp, 4)[::-1]  # of which only the first is later than all before
    carried = carry(reckoning, shuffled)
    assert carried.stamp == shuffled["stamp"][0]
    assert np.isfinite(carried.T_map_lidar).all()


@pytest.mark.parametrize("silence", [60_000_000, LONGEST_NS, 10**15])
def test_it_ends_with_a_gap_and_begins_with_the_next_sweep(estimate: Any, silence: Any) -> None:
    reckoning = DeadReckoning(T_CLOUD_IMU, GAP_NS)
    reckoning.reset(estimate)
    assert carry(reckoning, samples(estimate.stamp + silence, 5)) is None
    assert carry(reckoning, samples(estimate.stamp + silence + 20_000_000, 5)) is None
    later = dataclasses.replace(estimate, stamp=estimate.stamp + silence + 40_000_000)
    reckoning.reset(later)
    assert carry(reckoning, samples(later.stamp, 5)) is not None


def test_it_ends_a_second_after_the_latest_sweep(estimate: Any) -> None:
    reckoning = DeadReckoning(T_CLOUD_IMU, GAP_NS)
    reckoning.reset(estimate)
    lasted = [
        carry(reckoning, samples(estimate.stamp + 20_000_000 * n, 5)) is not None
        for n in range(60)
    ]
    assert lasted == [True] * 50 + [False] * 10


def test_the_covariance_grows_by_what_speed_and_rate_are_uncertain_by(estimate: Any) -> None:
    """A fifth of a second: the bound for any correlation of place and speed, white rates."""
    place, turned, speed, rate = 0.01, 0.002, 0.1, 0.03  # standard deviations
    known = dataclasses.replace(
        estimate,
        covariance=np.diag(np.square([place] * 3 + [turned] * 3)),
        twist_covariance=np.diag(np.square([speed] * 3 + [rate] * 3)),
        gyro_bias_covariance=np.zeros((9, 3)),
        map_error=None,
    )
    reckoning = DeadReckoning(T_CLOUD_IMU, GAP_NS)
    reckoning.reset(known)
    for n in range(10):
        carried = carry(reckoning, samples(known.stamp + 20_000_000 * n, 5))
    assert carried.stamp == known.stamp + 200_000_000
    sigma = np.sqrt(np.diag(carried.covariance))
    np.testing.assert_allclose(sigma[:3], place + speed * 0.2, rtol=1e-6)
    share = tuning.GYRO_SHARE * np.abs(carried.angular_velocity).max()
    expected = np.sqrt(turned**2 + (rate**2 * 0.004 + share**2) * 0.2)
    np.testing.assert_allclose(sigma[3:], expected, rtol=1e-6)

    still = dataclasses.replace(known, twist_covariance=np.zeros((6, 6)))
    reckoning.reset(still)
    carried = carry(reckoning, samples(known.stamp, 5))
    grown = known.covariance + np.diag([0.0] * 3 + [share**2 * 0.02] * 3)
    np.testing.assert_allclose(carried.covariance, grown, atol=1e-12)


@pytest.mark.parametrize("correlation", [0.0, -0.6, 0.9])
def test_turns_by_an_uncertain_gyro_bias_grow_with_the_time(
    estimate: Any, correlation: float
) -> None:
    """At 2 rad/s about z with a bias about x, whose turns make an arc in the map."""
    turned, bias, spin = 0.002, 0.01, 2.0  # rad, rad/s, rad/s
    along = np.diag([1.0, 0.0, 0.0])
    level = np.eye(4)
    known = dataclasses.replace(
        estimate,
        T_map_lidar=level,
        covariance=turned**2 * np.eye(6),
        twist_covariance=np.kron(np.diag([0.0, 1.0]), bias**2 * along),
        angular_velocity=np.array([0.0, 0.0, spin]),
        gyro_bias=np.zeros(3),
        gyro_bias_covariance=np.vstack(
            (0.3 * turned * bias * along, correlation * turned * bias * along, bias**2 * along)
        ),
        map_error=None,
    )
    reckoning = DeadReckoning(T_CLOUD_IMU, GAP_NS)
    for steps in (20, 1):
        reckoning.reset(known)
        for n in range(steps):
            turning = samples(known.stamp + 20_000_000 * n, 5, angular_velocity=[0.0, 0.0, spin])
            carried = carry(reckoning, turning)
        lasted = 0.02 * steps
        arc = np.array([np.sin(spin * lasted), 1.0 - np.cos(spin * lasted), 0.0]) / spin
        together = correlation * turned * bias * np.outer(arc, [1.0, 0.0, 0.0])
        white = known.quality.variance_factor * (tuning.GYRO_SHARE * spin) ** 2 * lasted
        expected = (turned**2 + white) * np.eye(3) + bias**2 * np.outer(arc, arc)
        expected -= together + together.T
        np.testing.assert_allclose(carried.covariance[3:, 3:], expected, rtol=1e-3, atol=1e-9)
        with_place = -0.3 * turned * bias * np.outer(arc, [1.0, 0.0, 0.0])
        np.testing.assert_allclose(carried.covariance[3:, :3], with_place, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("factor", [1.0, 0.5])
def test_the_map_errs_the_more_the_farther_away_it_was_begun(estimate: Any, factor: float) -> None:
    """0.2 m from the origin on, with and without every direction observed of late."""
    drift = MapDrift()
    known = dataclasses.replace(
        estimate,
        T_map_lidar=np.eye(4),
        velocity=np.array([1.0, 0.0, 0.0]),
        quality=dataclasses.replace(estimate.quality, variance_factor=factor),
        gravity=np.zeros(3),
        map_error=drift.error,
    )
    there, alone = DeadReckoning(np.eye(4), GAP_NS), DeadReckoning(np.eye(4), GAP_NS)
    there.reset(known)
    alone.reset(dataclasses.replace(known, map_error=None))
    for n in range(10):
        step = samples(known.stamp + 20_000_000 * n, 5)
        found, without = carry(there, step), carry(alone, step)
    place = found.T_map_lidar[:3, 3]
    assert np.linalg.norm(place) == pytest.approx(0.2, abs=0.01)
    added = drift.reported_at(place) - drift.reported_at(np.zeros(3))
    assert np.diag(added).min() > 0.0
    np.testing.assert_allclose(found.covariance - without.covariance, added, atol=1e-12)


def test_the_covariance_of_the_twist_turns_with_its_axes(estimate: Any) -> None:
    """A quarter turn about z, with a speed that is known ten times as well to the left."""
    known = dataclasses.replace(
        estimate,
        T_map_lidar=np.eye(4),
        covariance=np.zeros((6, 6)),
        angular_velocity=np.zeros(3),
        twist_covariance=np.diag(np.square([0.1, 0.01, 0.01, 1e-4, 1e-4, 1e-4])),
        gyro_bias=np.zeros(3),
        gyro_bias_covariance=np.zeros((9, 3)),
        stamp_velocity_error=np.array([0.02, 0.0, 0.0]),
        map_error=None,
        gravity=np.zeros(3),
    )
    reckoning = DeadReckoning(np.eye(4), GAP_NS)
    reckoning.reset(known)
    rate = [0.0, 0.0, 0.5 * np.pi / 0.24]
    for n in range(12):
        step = samples(known.stamp + 20_000_000 * n, 5, angular_velocity=rate)
        found = carry(reckoning, step)
    sigmas = np.sqrt(np.diag(found.twist_covariance)[:3])
    np.testing.assert_allclose(sigmas, (0.01, 0.1, 0.01), rtol=1e-3)
    np.testing.assert_allclose(found.stamp_velocity_error, (0.0, -0.02, 0.0), atol=1e-4)
    place = np.sqrt(np.diag(found.covariance)[:3])  # of the map, where nothing has turned
    np.testing.assert_allclose(place[1:], 0.24 * 0.01, rtol=1e-3)
    assert place[0] == pytest.approx(0.24 * np.sqrt(0.1**2 - 0.02**2), rel=1e-3)


def test_untrusted_gravity_holds_the_speed(estimate: Any) -> None:
    reckoning = DeadReckoning(np.eye(4), GAP_NS)
    reckoning.reset(dataclasses.replace(estimate, gravity=np.zeros(3)))
    carried = carry(reckoning, samples(estimate.stamp, 10, linear_acceleration=[40.0, 0.0, 0.0]))
    before = estimate.T_map_lidar[:3, :3] @ estimate.velocity
    np.testing.assert_allclose(carried.T_map_lidar[:3, :3] @ carried.velocity, before, atol=1e-9)


def test_noise_is_a_density_and_more_than_the_parameter_where_more_shows() -> None:
    """White noise of a standard deviation s in samples 4 ms apart has the density 2 s sqrt(ms)."""
    predictor = Predictor(OdometryConfig(), np.eye(4))
    settings = OdometryConfig().inertial
    samples = Motion().imu(0, 40)
    predictor.imu(samples)
    quiet = predictor._noise(samples)
    assert quiet.gyro == pytest.approx(settings.gyro_noise * np.sqrt(0.004))
    assert quiet.accel == pytest.approx(settings.accel_noise * np.sqrt(0.004))
    assert (quiet.gyro_share, quiet.accel_share) == (tuning.GYRO_SHARE, tuning.ACCEL_SHARE)
    rng = np.random.default_rng(0)
    samples["angular_velocity"] += rng.normal(0.0, 0.3, (len(samples), 3))
    samples["linear_acceleration"] += rng.normal(0.0, 0.7, (len(samples), 3))
    predictor.reset()
    predictor.imu(samples)
    loud = predictor._noise(samples)
    assert loud.gyro == pytest.approx(tuning.GYRO_NOISE_FACTOR * 0.3 * np.sqrt(0.004), rel=0.2)
    assert predictor.gyro_noise == pytest.approx(loud.gyro / np.sqrt(0.004))
    assert loud.accel == pytest.approx(0.7 * np.sqrt(0.004), rel=0.2)
    # white noise vibrates as well: 3.5 ms of its standard deviation above 15 Hz
    assert loud.gyro_vibration == pytest.approx(0.3 * 0.0035, rel=0.3)
    assert loud.accel_vibration == pytest.approx(0.7 * 0.0035, rel=0.3)


def at_rate(hz: float, seconds: float, noise: float = 0.0) -> Any:
    """Return samples of an IMU with another rate, at rest, with white noise of its gyro."""
    made = np.zeros(round(hz * seconds), IMU_SAMPLE)
    made["stamp"] = EPOCH + (1e9 / hz * np.arange(len(made))).astype(np.int64)
    made["linear_acceleration"] = [0.0, 0.0, 9.80665]
    made["angular_velocity"] = np.random.default_rng(8).normal(0.0, noise, (len(made), 3))
    return made


def test_less_of_the_imu_holds_the_velocity_or_the_rate_as_well() -> None:
    """What is tried without the IMU does not change how noisy its gyro is taken to be."""
    predictor = Predictor(OdometryConfig(), np.eye(4))
    samples = at_rate(250.0, 3.0, 0.05)
    samples["angular_velocity"] += (0.0, 0.0, 0.5)
    samples["linear_acceleration"] += (1.0, 0.0, 0.0)
    predictor.imu(samples)
    predictor.trusts_gravity = True
    predictor.steady_rate = np.array([0.0, 0.0, -0.2])
    begin, end = HostNs(EPOCH + 2_000_000_000), HostNs(EPOCH + 2_200_000_000)
    velocity = np.array([0.3, -0.1, 0.0])
    state = InertialState(
        begin, np.eye(3), np.zeros(3), velocity, np.zeros(3), np.zeros(3),
        np.array([0.0, 0.0, -9.80665]),
    )  # fmt: skip
    covariance = 1e-4 * np.eye(eskf.ERRORS)
    speeds, turns, noises = [], [], []
    for use in ImuUse:
        motion = predictor.over(state, covariance, (begin, end), end, use=use)
        speeds.append(motion.state.velocity[0])
        turns.append(rotations.log(rotations.from_matrix(motion.state.rotation))[2])
        noises.append((predictor.gyro_noise, predictor.gyro_density))
    assert list(ImuUse) == [ImuUse.ALL, ImuUse.GYRO, ImuUse.NOTHING]
    np.testing.assert_allclose(speeds, [0.5, 0.3, 0.3], atol=0.02)
    np.testing.assert_allclose(turns, [0.1, 0.1, -0.04], atol=0.01)
    assert noises[0] == noises[1] == noises[2]


@pytest.mark.parametrize("reference", ["start", "middle", "end"])
def test_noise_within_a_sweep_moves_its_attitude_as_a_random_walk(reference: Any) -> None:
    """Of many, the mean over the sweep differs from the value at the reference by as much."""
    predictor = Predictor(OdometryConfig(reference=reference), np.eye(4))
    predictor.imu(at_rate(250.0, 2.0, 0.03))
    predictor._noise(predictor.samples(EPOCH, EPOCH + 2_000_000_000))
    sweep = next(iter(sweeps(recording("room", "walk"), "turn")))
    lasted = (sweep.end - sweep.start) * 1e-9
    steps = 200
    rng = np.random.default_rng(4)
    walks = rng.normal(0.0, predictor.gyro_density * np.sqrt(lasted / steps), (4000, steps))
    walks = np.cumsum(walks, axis=1)
    at = {"start": 0, "middle": steps // 2, "end": steps - 1}[reference]
    spread = np.var(walks.mean(axis=1) - walks[:, at])
    assert predictor.attitude_variance(sweep) == pytest.approx(spread, rel=0.08)
    empty = dataclasses.replace(sweep, end=sweep.start)
    assert predictor.attitude_variance(empty) == 0.0


@pytest.mark.parametrize("hz", [100.0, 200.0, 400.0, 1000.0])
def test_an_imu_may_have_another_rate(hz: float) -> None:
    """The parameters are densities, told for 250 Hz; measured noise is that of its samples."""
    settings = OdometryConfig().inertial
    quiet, loud = (Predictor(OdometryConfig(), np.eye(4)) for _ in range(2))
    quiet.imu(at_rate(hz, 2.0))
    found = quiet._noise(at_rate(hz, 2.0))
    assert found.gyro == pytest.approx(settings.gyro_noise * np.sqrt(0.004))
    assert found.accel == pytest.approx(settings.accel_noise * np.sqrt(0.004))
    loud.imu(at_rate(hz, 2.0, noise=0.3))
    found = loud._noise(at_rate(hz, 2.0, noise=0.3))
    assert found.gyro == pytest.approx(tuning.GYRO_NOISE_FACTOR * 0.3 / np.sqrt(hz), rel=0.25)


@pytest.mark.parametrize("hz", [100.0, 250.0])
def test_the_velocity_is_kept_while_no_cloud_comes_but_samples_do(hz: float) -> None:
    zero, down = np.zeros(3), np.array([0.0, 0.0, -9.80665])
    velocity = np.array([1.0, 0.0, 0.0])
    state = InertialState(HostNs(EPOCH), np.eye(3), zero, velocity, zero, zero, down)
    until = HostNs(EPOCH + 1_500_000_000)
    for samples, kept in ((at_rate(hz, 2.0), True), (at_rate(hz, 0.5), False)):
        predictor = Predictor(OdometryConfig(), np.eye(4))
        predictor.trusts_gravity = True
        predictor.imu(samples)
        motion = predictor.over(state, 1e-4 * np.eye(eskf.ERRORS), (state.stamp, until), until)
        assert (np.linalg.norm(motion.state.velocity - velocity) < 0.1) == kept


def test_samples_are_without_the_line_of_the_head_once_turns_have_shown_it() -> None:
    rate, turn_ns = 27.2, round(2e9 * np.pi / 27.2)
    predictor = Predictor(OdometryConfig(), np.eye(4))
    imu = Motion().imu(0, 4)
    since = (imu["stamp"] - imu["stamp"][0]) * 1e-9
    line = 0.3 * np.sin(0.7 + rate * since)
    measured = imu.copy()
    measured["angular_velocity"][:, 1] += line
    predictor.imu(measured)
    first = HostNs(int(imu["stamp"][0]))
    for number in range(10):
        start = HostNs(first + number * turn_ns)
        head = HeadAngle(start, 0.7 + rate * (start - first) * 1e-9, rate)
        end = HostNs(start + turn_ns)
        found = predictor.samples(start, end)
        kept = measured[np.isin(measured["stamp"], found["stamp"])]
        if number < 4:
            np.testing.assert_array_equal(found, kept)
        predictor.note_head(head, end)
    true = imu[np.isin(imu["stamp"], found["stamp"])]
    np.testing.assert_allclose(found["angular_velocity"], true["angular_velocity"], atol=1e-3)
    predictor.reset()
    np.testing.assert_array_equal(predictor.samples(start, end), kept)


def test_dead_reckoning_does_not_follow_the_line_of_the_head(estimate: Any) -> None:
    head = HeadAngle(estimate.stamp, 0.7, 27.2)
    amplitudes = np.zeros((4, 3))
    amplitudes[0] = 0.3, -0.2, 0.1
    amplitudes[3] = 0.1, 0.2, -0.1
    line = LineRates(head, amplitudes)
    true, found, other = (DeadReckoning(np.eye(4), GAP_NS) for _ in range(3))
    true.reset(estimate)
    found.reset(dataclasses.replace(estimate, gyro_line=line))
    other.reset(estimate)
    worst = 0.0
    for n in range(10):
        step = samples(estimate.stamp + 20_000_000 * n, 5)
        measured = step.copy()
        measured["angular_velocity"] += line.at(step["stamp"])
        expected = carry(true, step).T_map_lidar
        np.testing.assert_allclose(carry(found, measured).T_map_lidar, expected, atol=1.5e-3)
        followed = carry(other, measured).T_map_lidar
        worst = max(worst, float(np.abs(followed - expected).max()))
    assert worst > 0.008


_KNOWN = np.r_[eskf.ROTATION, eskf.VELOCITY]


@pytest.mark.parametrize("hz", [37.0, 71.0, 113.0])
def test_attitude_and_velocity_of_a_vibrating_frame_stay_known(hz: float) -> None:
    """What vibrates does not add up: the uncertainty after a second is nearly a quiet unit's."""
    rng = np.random.default_rng(3)
    sigmas, errors = [], []
    for force in (0.0, 1.2):
        samples = at_rest(0.0, 0.0, 3.0)
        times = 0.004 * np.arange(len(samples))
        phases = 2.0 * np.pi * (hz * times[:, None] + rng.random(3))
        samples["linear_acceleration"] += rng.normal(0.0, 0.06, (len(samples), 3))
        samples["linear_acceleration"] += force * np.sin(phases)
        samples["angular_velocity"] += 0.25 * force * np.sin(phases) - 0.01
        predictor = Predictor(OdometryConfig(), np.eye(4))
        predictor.imu(samples)
        zero, down = np.zeros(3), np.array([0.0, 0.0, -9.80665])
        state = InertialState(HostNs(EPOCH + 10**9), np.eye(3), zero, zero, zero, zero, down)
        covariance = 1e-12 * np.eye(eskf.ERRORS)
        for _ in range(5):
            until = HostNs(state.stamp + 200_000_000)
            motion = predictor.over(state, covariance, (state.stamp, until), until)
            state, covariance = motion.state, motion.covariance
        sigmas.append(np.sqrt(np.diag(covariance)[_KNOWN]))
        errors.append(
            state.boxminus(dataclasses.replace(state, rotation=np.eye(3), velocity=zero))
        )
    assert (np.abs(np.array(errors)[:, _KNOWN]) < 3.0 * np.array(sigmas)).all()
    assert (sigmas[1] > sigmas[0]).all()
    assert (sigmas[1] < 2.0 * sigmas[0]).all()


def at_rest(line: float, noise: float, seconds: float) -> Any:
    """Return samples of a sensor at rest, with white noise and a line of the head [rad/s]."""
    count = round(250 * seconds)
    found = np.zeros(count, IMU_SAMPLE)
    found["stamp"] = EPOCH + 4_000_000 * np.arange(count)
    found["angular_velocity"] = np.random.default_rng(4).normal(0.01, noise, (count, 3))
    found["angular_velocity"][:, 1] += line * np.sin(2.0 * np.pi * 4.33 * 0.004 * np.arange(count))
    found["linear_acceleration"][:, 2] = 9.80665
    return found


def rested(line: float, noise: float, seconds: float) -> Predictor:
    """Return a predictor that was at rest for so long, a turn of the head at a time."""
    predictor = Predictor(OdometryConfig(), np.eye(4))
    predictor.imu(at_rest(line, noise, seconds))
    zero = np.zeros(3)
    down = np.array([0.0, 0.0, -9.80665])
    state = InertialState(EPOCH, np.eye(3), zero, zero, np.full(3, 0.01), zero, down)
    covariance = 1e-4 * np.eye(eskf.ERRORS)
    for turn in range(1, int(seconds / 0.231) + 1):
        until = HostNs(EPOCH + 231_000_000 * turn)
        state, covariance = predictor.static_update(state, covariance, until)
        state = dataclasses.replace(state, stamp=until)
    return predictor


@pytest.mark.parametrize(("line", "noise"), [(0.3, 0.03), (0.0, 0.06), (0.03, 0.0)])
def test_at_rest_the_gyro_shows_its_noise_with_the_lines_of_the_head(
    line: float, noise: float
) -> None:
    predictor = rested(line, noise, 3.0)
    moving = Motion().imu(0, 40)
    moving["stamp"] += 10**9 + at_rest(line, noise, 3.0)["stamp"][-1] - moving["stamp"][0]
    predictor.imu(moving)
    expected = np.sqrt(noise**2 + 0.5 * line**2)
    assert predictor._noise(moving).gyro == pytest.approx(expected * np.sqrt(0.004), rel=0.1)
    predictor.reset()
    predictor.imu(moving)
    predictor._noise(moving)
    assert predictor.gyro_noise == OdometryConfig().inertial.gyro_noise


def test_a_short_rest_shows_no_noise_and_no_gyro_is_perfect() -> None:
    moving = Motion().imu(0, 40)
    short, still = rested(0.0, 0.03, 0.3), rested(0.0, 0.001, 3.0)
    short._noise(moving)
    assert short.gyro_noise == OdometryConfig().inertial.gyro_noise
    still._noise(moving)
    assert still.gyro_noise == tuning.LEAST_GYRO_NOISE


def test_the_noise_at_rest_follows_the_unit() -> None:
    """What the sensor showed minutes ago counts no more."""
    predictor = Predictor(OdometryConfig(), np.eye(4))
    for noise in (0.3, 0.03):
        for _ in range(40):
            predictor._note_rest(at_rest(0.0, noise, 1.0), np.full(3, 0.01))
    predictor._noise(Motion().imu(0, 40))
    assert predictor.gyro_noise == pytest.approx(0.03, rel=0.15)
