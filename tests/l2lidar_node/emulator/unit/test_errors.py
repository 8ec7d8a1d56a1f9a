"""Units that are not what they report."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2lidar_node.emulator.physics import Physics, PhysicsConfig, assemble
from l2lidar_node.emulator.unit.inertial import ImuNoise
from l2lidar_node.emulator.unit.returns import RangeNoise
from l2lidar_node.emulator.unit.scanner import local_rays
from l2lidar_node.emulator.unit.units import TYPICAL, UNITS, UnitErrors, drawn, unit

DEG = np.pi / 180


def physics(errors: UnitErrors, motion: str = "still") -> Physics:
    config = PhysicsConfig(
        world="box", motion=motion, ranges=RangeNoise.clean(), imu=ImuNoise.clean()
    )
    return assemble(config, replace(UNITS["a"], errors=errors))


def test_names_give_units() -> None:
    assert unit("perfect") is UNITS["a"]
    assert unit("typical").errors.xi == TYPICAL.xi
    assert unit("7").errors.xi == drawn(7).xi != drawn(8).xi
    assert np.std([drawn(k).xi for k in range(40)]) == pytest.approx(0.2 * DEG, rel=0.4)
    with pytest.raises(ValueError, match="expected perfect, typical, poor"):
        unit("good")


def test_the_phase_of_the_mirror_differs_from_power_up_to_power_up() -> None:
    found = [unit("typical", number).errors.alpha for number in range(30)]
    assert np.std(found) == pytest.approx(TYPICAL.alpha_phase, rel=0.5)
    assert unit("typical", 3).errors.alpha == found[3]


def test_a_unit_reports_one_block_and_measures_by_another() -> None:
    errors = UnitErrors(xi=0.5 * DEG, alpha=-0.4 * DEG, b=1e-3, range_bias=0.05)
    scan = physics(errors).scanner.scan(0, 50)
    perfect = physics(UnitErrors()).scanner.scan(0, 50)
    assert scan.packets["calibration"].tobytes() == perfect.packets["calibration"].tobytes()
    origin, direction = local_rays(scan.packets)
    own = scan.packets["calibration"]
    distance = own["range_scale"][:, None] * (scan.packets["ranges"] + own["range_bias"][:, None])
    seen = scan.returned
    walls = (origin + direction * distance[..., None])[seen]
    true = perfect.packets
    origin, direction = local_rays(true)
    distance = own["range_scale"][:, None] * (true["ranges"] + own["range_bias"][:, None])
    right = (origin + direction * distance[..., None])[perfect.returned]
    # the wall of the box ahead: where a perfect unit sees it within the count's step
    assert np.ptp(right[right[:, 2] > np.quantile(right[:, 2], 0.8), 2]) < 2e-3
    assert np.ptp(walls[walls[:, 2] > np.quantile(walls[:, 2], 0.8), 2]) > 0.02


def test_the_range_finder_is_not_linear_when_near() -> None:
    errors = UnitErrors(near=0.02, incidence=0.01, intensity=0.004)
    distance = np.array([0.0, 0.75, 1.5, 10.0])
    steep = errors.range_response(distance, np.ones(4), np.full(4, 0.5))
    np.testing.assert_allclose(steep, [-0.02, -0.005, 0.0, 0.0], atol=1e-12)
    slanted = errors.range_response(distance[3:], np.array([0.5]), np.array([0.5]))
    assert slanted == pytest.approx(0.005)
    black, white = errors.range_response(np.full(2, 9.0), np.ones(2), np.array([0.0, 1.0]))
    assert (black, white) == pytest.approx((0.004, -0.004))


@pytest.mark.parametrize("motion", ["still", "walk"])
def test_the_gyro_feels_the_mount_rock(motion: str) -> None:
    errors = UnitErrors(
        precession=(0.3 * DEG, -0.1 * DEG),
        precession_back=(0.05 * DEG, 0.1 * DEG),
        precession_pivot=0.2,
    )
    made = physics(errors, motion)
    t = np.linspace(4.0, 5.0, 101)
    step = 1e-4
    places, turns = zip(*(made.motion.poses(t + k * step) for k in (-1, 0, 1)), strict=True)
    before, now, after = (Rotation.from_quat(q[:, [1, 2, 3, 0]]) for q in turns)
    numeric = (now.inv() * after).as_rotvec() - (now.inv() * before).as_rotvec()
    found = made.motion.kinematics(t)
    np.testing.assert_allclose(found.angular_velocity, numeric / (2 * step), atol=2e-3)
    velocity = (places[2] - places[0]) / (2 * step)
    np.testing.assert_allclose(found.velocity, velocity, atol=5e-3)


def test_the_imu_is_turned_late_and_stretched() -> None:
    errors = UnitErrors(
        imu_rotation=(0.0, 0.0, 1.0 * DEG), imu_time_offset=0.01, gyro_scale=(0.0, 0.0, 0.1),
        gyro_bias_slope=(1e-3, 0.0, 0.0),
    )  # fmt: skip
    made, ideal = physics(errors, "walk"), physics(UnitErrors(), "walk")
    samples, times = made.inertial.samples(1000, 500)
    rates = ideal.motion.kinematics(times - 0.01).angular_velocity
    cosine, sine = np.cos(DEG), np.sin(DEG)
    expected = np.stack(
        (
            cosine * rates[:, 0] + sine * rates[:, 1],
            cosine * rates[:, 1] - sine * rates[:, 0],
            1.1 * rates[:, 2],
        ),
        axis=-1,
    )
    expected[:, 0] += 13e-3 * (1 - np.exp(-times / 600))
    np.testing.assert_allclose(samples["angular_velocity"], expected, atol=1e-5)
