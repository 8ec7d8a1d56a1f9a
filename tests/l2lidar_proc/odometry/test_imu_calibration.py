"""An IMU calibrated against the odometry of a virtual unit that is turned and shaken."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import polar

from l2lidar_node import rotations
from l2lidar_node.calibration.result import Verdict
from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.unit.inertial import Inertial
from l2lidar_node.emulator.unit.units import TYPICAL, unit
from l2lidar_node.emulator.world import scenes
from l2lidar_node.types import F64, IMU_SAMPLE, POINT, HostNs, Level, Sweep
from l2lidar_proc.motion import gyro_alignment as gyro
from l2lidar_proc.motion.config import ImuConfig
from l2lidar_proc.motion.gyro_alignment import GyroError
from l2lidar_proc.odometry import imu_calibration
from l2lidar_proc.odometry.estimate import Status
from l2lidar_proc.odometry.imu_calibration import ExtrinsicCheck, ImuResult
from l2lidar_proc.odometry.pipeline import judge
from tests.l2lidar_proc.motion.turned_gyro import TRUE, recording
from tests.l2lidar_proc.odometry.bare_estimates import estimate
from tests.support import odometry_runs

Recording = tuple[list[Sweep], NDArray[np.void]]


def recorded(motion: str, seconds: float, unit: str) -> Recording:
    """Return thinned sweeps: a twelfth of the points costs little and loses little."""
    run = odometry_runs.record("room", motion, 0, seconds, unit=unit)
    sweeps = [
        replace(sweep, points=np.sort(sweep.points[::12], order="time"))
        for sweep in odometry_runs.sweeps(run, "turn")
    ]
    return sweeps, run.imu


@pytest.fixture(scope="module")
def shaken() -> Recording:
    return recorded("shake", 18.0, "typical")


def test_the_imu_of_a_typical_unit_is_found(shaken: Recording) -> None:
    result = imu_calibration.calibrate(*shaken)
    assert result.refusals == ()
    assert result.is_corrected
    mixing, turn = polar(
        TYPICAL.gyro_matrix() @ rotations.matrices(TYPICAL.imu_quaternion()).T, side="left"
    )[::-1]
    true = rotations.log(rotations.from_matrix(turn.T))
    made = result.calibration()
    found = rotations.log(rotations.from_matrix(rotations.from_rpy(made.rotation_rpy)))
    np.testing.assert_allclose(found, true, atol=np.deg2rad(0.12))
    assert made.time_offset == pytest.approx(TYPICAL.imu_time_offset, abs=4e-4)
    np.testing.assert_allclose(made.gyro_scale, np.diag(mixing) - 1.0, atol=2e-3)
    assert result.alignment.turns.rms < 0.6 * result.before.rms
    for name in ("rotation x", "rotation y", "rotation z", "time offset"):
        assert result.estimates[name].verdict is Verdict.CORRECTED, name
    assert "the rotation about" in result.weakest
    assert result.estimates["scale x"].sd > 5e-4, "the beams are as reported"


def test_without_the_packets_it_says_what_to_switch_on(shaken: Recording) -> None:
    sweeps, samples = shaken
    with pytest.raises(GyroError, match="-imu_off"):
        imu_calibration.calibrate(sweeps, samples[:0])
    with pytest.raises(GyroError, match="-mode_2d"):
        imu_calibration.calibrate([], samples)


def result_of(axes: tuple[float, ...], seconds: float = 30.0, loose_deg: float = 0.0) -> ImuResult:
    """Return the result of true poses; the IMU comes loose after half of the way."""
    stamps, quaternions, samples = recording(axes, noise=5e-4, seconds=seconds)
    late = samples["stamp"] > stamps[len(stamps) // 2]
    turn = rotations.matrices(rotations.exp((np.deg2rad(loose_deg), 0.0, 0.0)))
    samples["angular_velocity"][late] = samples["angular_velocity"][late] @ turn
    estimates = [
        estimate(stamp, rotations.transform(q, np.zeros(3)))
        for stamp, q in zip(stamps.tolist(), quaternions, strict=True)
    ]
    sweeps = [
        Sweep(HostNs(stamp), HostNs(stamp + 229_000_000), np.empty(0, POINT), 50, 0)
        for stamp in stamps.tolist()
    ]
    found = gyro.align(stamps, quaternions, samples)
    return imu_calibration.judged(found, estimates, sweeps, samples)


def test_a_good_motion_tells_everything() -> None:
    result = result_of((1.0, 0.8, 1.3))
    assert result.refusals == ()
    assert Verdict.UNKNOWN not in {item.verdict for item in result.estimates.values()}
    assert result.calibration().time_offset == pytest.approx(TRUE.offset_s, abs=2e-4)


def test_a_robot_on_wheels_cannot_tell_everything() -> None:
    result = result_of((0.0, 0.0, 1.3))
    verdicts = {name: item.verdict for name, item in result.estimates.items()}
    assert verdicts["rotation z"] is Verdict.UNKNOWN
    assert "x and y" in result.estimates["rotation z"].reason
    assert verdicts["scale x"] is verdicts["scale y"] is Verdict.UNKNOWN
    assert verdicts["scale z"] is Verdict.CORRECTED
    assert verdicts["time offset"] is Verdict.CORRECTED
    assert "rotation z" in result.notes[0]
    stored = result.calibration()
    assert stored.rotation_rpy == (0.0, 0.0, 0.0)
    assert stored.gyro_scale[:2] == (0.0, 0.0)


def test_what_cannot_be_believed_is_refused_with_what_to_do() -> None:
    assert "15 s are needed" in result_of((1.0, 0.8, 1.3), seconds=12.0).refusals[0].reason
    still = result_of((0.0, 0.0, 0.0))
    assert "hardly turned" in still.refusals[0].reason
    assert not still.is_corrected
    loose = result_of((1.0, 0.8, 1.3), loose_deg=4.0)
    assert any("of the recording says" in item.reason for item in loose.refusals)
    assert all(item.advice for item in (*still.refusals, *loose.refusals))


EPOCH = 1_700_000_000_000_000_000
DRAWN = np.eye(3)


def followed(
    name: str,
    motion: str = "shake",
    rotation: F64 = DRAWN,
    *,
    late_ms: float = 0.0,
    seconds: float = 60.0,
    status: tuple[Status, ...] = (),
) -> ExtrinsicCheck:
    """Return the check after a motion: true poses with 0.05 degrees of noise, a unit's own IMU."""
    source = np.random.default_rng(3)
    made = trajectories.make(motion, scenes.make("room"))
    raw, times = Inertial(made, unit=unit(name)).samples(0, round(seconds * 250))
    samples = np.zeros(len(raw), IMU_SAMPLE)
    samples["stamp"] = EPOCH + np.round((times + 1e-3 * late_ms) * 1e9).astype(np.int64)
    samples["angular_velocity"] = raw["angular_velocity"]
    at = np.arange(0.5, seconds, 0.23)
    _, quaternions = made.poses(at)
    noisy = rotations.multiply(
        quaternions, rotations.exp(np.deg2rad(0.05) * source.standard_normal((len(at), 3)))
    )
    check = ExtrinsicCheck(rotation)
    first = 0
    for t, q in zip(at.tolist(), noisy, strict=True):
        last = int(np.searchsorted(samples["stamp"], EPOCH + round((t + 0.13) * 1e9)))
        check.imu(samples[first:last])
        first = last
        pose = rotations.transform(q, (0.0, 0.0, 0.0))
        check.pose(estimate(EPOCH + round(t * 1e9), pose, status))
    return check


@pytest.mark.parametrize("name", ["perfect", "typical"])
@pytest.mark.parametrize("motion", ["shake", "walk", "spin", "still"])
def test_nothing_is_said_of_units_within_tolerance(name: str, motion: str) -> None:
    check = followed(name, motion)
    assert check.finding == ""
    if motion == "shake":
        assert "extrinsic rotation off, x y z [deg]" in check.values
        assert "IMU time offset off [ms]" in check.values
    if motion == "still":
        assert check.values == {}


def test_a_rotation_that_is_off_is_said_with_its_size() -> None:
    turned = rotations.matrices(rotations.exp(np.deg2rad([0.0, 0.0, 1.2])))
    check = followed("perfect", rotation=turned)
    assert "extrinsic rotation looks 1.2 degrees off (" in check.finding
    assert "-1.2 about z" in check.finding
    judged = judge(estimate(EPOCH, np.eye(4)), 10, 1, Counter(), Counter(), check=check)
    assert judged.level is Level.WARN
    assert judged.message == f"aligned; {check.finding}"
    told = [float(x) for x in judged.values["extrinsic rotation off, x y z [deg]"].split()]
    np.testing.assert_allclose(told, (0.0, 0.0, -1.2), atol=0.15)


def test_turning_about_one_axis_only_is_silent_about_what_it_cannot_know() -> None:
    turned = rotations.matrices(rotations.exp(np.deg2rad([0.0, 0.0, 5.0])))
    check = followed("perfect", "spin", turned)
    assert check.finding == ""


def test_late_stamps_are_said() -> None:
    assert "stamps of IMU samples look 8.0 ms too late" in followed("perfect", late_ms=8.0).finding


def test_poses_that_are_not_aligned_tell_nothing() -> None:
    turned = rotations.matrices(rotations.exp(np.deg2rad([0.0, 0.0, 9.0])))
    for status in (Status.PREDICTED, Status.LOST, Status.RESTARTED, Status.RETURNED):
        assert followed("perfect", rotation=turned, status=(status,), seconds=40).values == {}


def test_bad_stamps_and_numbers_do_no_harm() -> None:
    check = ExtrinsicCheck(DRAWN)
    bad = np.zeros(30_000, IMU_SAMPLE)
    bad["angular_velocity"] = np.nan
    for _ in range(3):
        check.imu(bad)
    source = np.random.default_rng(0)
    for stamp in source.integers(0, 2**62, 3000).tolist():
        check.pose(estimate(stamp, np.eye(4)))
    assert check.finding == ""


def test_the_imu_is_where_the_drawing_has_it() -> None:
    np.testing.assert_array_equal(ImuConfig().T_cloud_imu[:3, :3], DRAWN)
