"""A gyro against poses: derivatives, recovery of what was put in, what a motion cannot tell."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from l2lidar_node import rotations
from l2lidar_node.types import F64
from l2lidar_proc.motion import gyro_alignment as gyro
from l2lidar_proc.motion.gyro_alignment import GyroError, GyroModel
from tests.l2lidar_proc.motion.turned_gyro import EPOCH, TRUE, recording


def test_the_derivatives_are_those_of_differences() -> None:
    stamps, q, samples = recording(seconds=3.0)
    around = GyroModel.of(TRUE.values * 0.7)
    turns = gyro.turns_between(stamps, q, samples, around)
    for number in range(gyro.PARAMETERS):
        h = 1e-5 if number != gyro.OFFSET else 2e-4
        residuals = []
        for sign in (1.0, -1.0):
            values = around.values
            step = np.zeros(3)
            if number < 3:
                step[number] = sign * h
            else:
                values[number] += sign * h
            model = GyroModel.of(values)
            turned = model.rotation @ rotations.matrices(rotations.exp(step))
            model = GyroModel(turned, model.scale, model.skew, model.bias, model.offset_s)
            residuals.append(gyro.turns_between(stamps, q, samples, model).residual)
        numeric = (residuals[0] - residuals[1]) / (2 * h)
        np.testing.assert_allclose(
            turns.jacobian[:, :, number], numeric, atol=0.03 * np.abs(numeric).max() + 1e-6
        )


def test_what_was_put_in_is_found() -> None:
    found = gyro.align(*recording())
    off = np.abs(found.model.values - TRUE.values)
    assert off[gyro.ROTATION].max() < np.deg2rad(0.01)
    assert off[gyro.SCALE].max() < 3e-4
    assert off[gyro.SKEW].max() < 3e-4
    assert off[gyro.BIAS].max() < 3e-4
    assert off[gyro.OFFSET] < 5e-5
    assert (found.excitation > 50.0).all()


def test_the_truth_is_within_the_stated_deviations() -> None:
    away = []
    for seed in range(12):
        found = gyro.align(*recording(noise=1e-3, seed=seed))
        away.append((found.model.values - TRUE.values) / found.sd)
    assert np.abs(away).max() < 6.0
    assert np.mean(np.abs(away) < 3.0) > 0.95
    # the deviations are not just large
    assert np.sqrt(np.mean(np.square(away))) > 0.4


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_a_sensor_at_rest_without_any_noise_shows_its_bias_alone(share: float) -> None:
    """All residuals, or more than half of them, are exactly zero."""
    stamps, q, samples = recording()
    count = round(share * len(stamps))
    q[:count] = 1.0, 0.0, 0.0, 0.0
    q[count:] = rotations.exp(np.linspace(0.0, 1e-3, len(stamps) - count)[:, None] * np.ones(3))
    samples["angular_velocity"] = 0.0
    normal, right = gyro.information(gyro.turns_between(stamps, q, samples, GyroModel.ideal()))
    assert np.isfinite(normal).all()
    assert np.isfinite(right).all()
    assert (np.diag(normal)[gyro.BIAS] > 1e4).all()
    found = gyro.align(stamps, q, samples)
    assert (found.sd[gyro.BIAS] < 1e-3).all()
    assert np.abs(found.model.bias).max() < 1e-3
    assert found.sd[gyro.ROTATION].min() > np.deg2rad(5.0)
    assert found.outliers <= len(stamps) - count


@pytest.mark.parametrize(("pose", "between"), [(1.0, 0.5), (0.0, 1.0)])
def test_errors_that_neighbors_share_are_told_from_those_of_each_interval(
    pose: float, between: float
) -> None:
    """A bias alone, from many runs: it scatters as the information says it does."""
    rng = np.random.default_rng(3)
    count, scale = 120, 1e-3
    jacobian = np.zeros((count, 3, gyro.PARAMETERS))
    jacobian[:, :, gyro.BIAS] = -np.eye(3)
    found, stated = [], []
    for _ in range(60):
        poses = pose * rng.standard_normal((count + 1, 3))
        residual = scale * (np.diff(poses, axis=0) + between * rng.standard_normal((count, 3)))
        turns = gyro.Turns(residual, jacobian, np.arange(count))
        normal, right = (item[gyro.BIAS] for item in gyro.information(turns))
        found.append(np.linalg.solve(normal[:, gyro.BIAS], right))
        stated.append(np.sqrt(np.diag(np.linalg.inv(normal[:, gyro.BIAS]))))
    scatter = np.sqrt(np.mean(np.square(found)))
    assert scatter / np.mean(stated) == pytest.approx(1.0, rel=0.25)


def test_turning_about_one_axis_tells_what_it_can() -> None:
    found = gyro.align(*recording(axes=(0.0, 0.0, 1.3), noise=1e-3))
    assert found.sd[2] > np.deg2rad(3.0)  # a turn about that very axis
    # about the others but for a misalignment, which looks the same, so far as that is known
    assert found.sd[:2].max() < np.deg2rad(0.6)
    assert found.sd[gyro.SCALE][:2].min() > 0.01
    assert found.sd[gyro.SCALE][2] < 3e-3
    assert found.excitation[2] > 50.0
    assert found.excitation[:2].max() < 1.0


def test_axes_that_turn_together_are_not_excited() -> None:
    t = np.arange(0, 20, 0.004)
    stamps = np.round(t * 1e9).astype(np.int64)
    together = np.outer(np.sin(2 * np.pi * 0.5 * t), [1.0, 1.0, 0.0])
    assert gyro.excitation(stamps, together).max() < 0.6
    head = 0.5 * np.outer(np.sin(2 * np.pi * 4.35 * t), [1.0, 1.0, 1.0])
    assert gyro.excitation(stamps, head).max() < 0.05  # a line of the head is no turning
    assert gyro.excitation(stamps[:0], together[:0]).max() == 0.0


def test_gaps_and_strays_do_not_spoil_it() -> None:
    stamps, q, samples = recording()
    samples = samples[(samples["stamp"] - EPOCH) % 7_000_000_000 > 400_000_000]
    q = q.copy()
    q[40] = rotations.multiply(q[40], rotations.exp((0.0, 0.3, 0.0)))  # a pose that is wrong
    found = gyro.align(stamps, q, samples)
    assert found.outliers >= 2
    assert np.abs(found.model.values - TRUE.values)[gyro.ROTATION].max() < np.deg2rad(0.2)
    with pytest.raises(GyroError, match="expected 32"):
        gyro.align(stamps[:20], q[:20], samples)
    with pytest.raises(GyroError, match="0 turns"):
        gyro.align(stamps, q, samples[:0])


def turned(samples: NDArray[np.void], rotation: F64) -> NDArray[np.void]:
    """Return the samples of an IMU whose axes lie in the clouds' as a rotation (3, 3) says."""
    out = samples.copy()
    out["angular_velocity"] = samples["angular_velocity"] @ TRUE.rotation.T @ rotation
    return out


def test_a_large_rotation_is_found_and_its_deviation_is_that_of_the_errors() -> None:
    squares = []
    for seed in range(30):
        rotation = Rotation.random(random_state=seed).as_matrix()
        stamps, q, samples = recording(axes=(0.05, 0.04, 0.3), noise=5e-3, seed=seed)
        found = gyro.coarse_rotation(stamps, q, turned(samples, rotation))
        assert found is not None
        assert found.is_clear
        off = float(Rotation.from_matrix(found.matrix @ rotation.T).magnitude())
        squares.append((off / found.sd) ** 2)
    assert 0.2 < np.mean(squares) < 2.0  # of the worst axis, and two better ones


@pytest.mark.parametrize("rpy", [(180, 0, 0), (0, 0, 90), (-90, 0, 90), (0, 90, 0)])
def test_axes_that_lie_along_others_are_found_exactly(rpy: tuple[float, ...]) -> None:
    rotation = Rotation.from_euler("xyz", rpy, degrees=True).as_matrix()
    stamps, q, samples = recording(axes=(0.05, 0.04, 0.3), noise=5e-3)
    found = gyro.coarse_rotation(stamps, q, turned(samples, rotation))
    assert found is not None
    assert found.is_clear
    np.testing.assert_allclose(found.matrix, rotation, atol=1e-9)


@pytest.mark.parametrize("degrees", [0.0, 8.0])
def test_axes_near_those_of_the_clouds_are_no_finding(degrees: float) -> None:
    """What is off by some degrees, calibrate measures."""
    rotation = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    for seed in range(10):
        stamps, q, samples = recording(axes=(0.05, 0.04, 0.3), noise=5e-3, seed=seed)
        found = gyro.coarse_rotation(stamps, q, turned(samples, rotation))
        assert found is not None
        assert not found.is_clear
        assert not found.contradicts_drawn


def test_a_bias_of_the_gyro_does_not_turn_it() -> None:
    rotation = Rotation.from_euler("xyz", (30, -50, 110), degrees=True).as_matrix()
    stamps, q, samples = recording(axes=(0.05, 0.04, 0.3), noise=5e-3)
    samples = turned(samples, rotation)
    samples["angular_velocity"] += (0.4, -0.3, 0.2)
    found = gyro.coarse_rotation(stamps, q, samples)
    assert found is not None
    assert found.is_clear
    off = Rotation.from_matrix(found.matrix @ rotation.T).magnitude()
    assert off < 4.0 * found.sd


def test_an_imu_that_also_turns_by_itself_has_no_rotation() -> None:
    """As one below a head that pans."""
    rotation = Rotation.from_euler("x", 180, degrees=True).as_matrix()
    stamps, q, samples = recording(seconds=200.0)
    samples = turned(samples, rotation)
    samples["angular_velocity"] += samples["angular_velocity"][::-1].copy()
    found = gyro.coarse_rotation(stamps, q, samples)
    assert found is not None
    assert found.contradicts_drawn
    assert not found.is_clear


def test_left_handed_axes_are_no_rotation() -> None:
    stamps, q, samples = recording()
    samples["angular_velocity"][:, 0] *= -1.0
    found = gyro.coarse_rotation(stamps, q, samples)
    assert found is not None
    assert not found.is_clear


def test_samples_that_are_not_finite_do_not_hide_a_rotation() -> None:
    rotation = Rotation.from_euler("x", 180, degrees=True).as_matrix()
    stamps, q, samples = recording(axes=(0.05, 0.04, 0.3), noise=5e-3)
    samples = turned(samples, rotation)
    samples["angular_velocity"][::7, 1] = np.nan
    samples["angular_velocity"][3::90] = np.inf
    found = gyro.coarse_rotation(stamps, q, samples)
    assert found is not None
    assert found.is_clear
    np.testing.assert_allclose(found.matrix, rotation, atol=1e-9)


def test_turns_about_one_axis_alone_tell_no_rotation_about_it() -> None:
    rotation = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    stamps, q, samples = recording(axes=(0.0, 0.0, 1.0), noise=5e-3)
    found = gyro.coarse_rotation(stamps, q, turned(samples, rotation))
    assert found is not None
    assert not found.is_clear


def test_a_gyro_that_does_not_turn_with_the_clouds_has_no_rotation() -> None:
    stamps, q, samples = recording()
    samples["angular_velocity"] = samples["angular_velocity"][::-1]
    found = gyro.coarse_rotation(stamps, q, samples)
    assert found is not None
    assert not found.is_clear


def test_a_few_turns_are_too_few() -> None:
    stamps, q, samples = recording()
    assert gyro.coarse_rotation(stamps[:12], q[:12], samples) is None
    assert gyro.coarse_rotation(stamps[:0], q[:0], samples) is None
    assert gyro.coarse_rotation(stamps, q, samples[:0]) is None
