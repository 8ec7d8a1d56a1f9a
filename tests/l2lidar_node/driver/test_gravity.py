"""The accelerometer against gravity and the onboard orientation."""

from __future__ import annotations

from typing import Any

import pytest
from scipy.spatial.transform import Rotation

from l2lidar_node.driver.orientation import GravityMonitor, GravityReport
from l2lidar_node.types import STANDARD_GRAVITY, HostNs, ImuSample

UP = (0.0, 0.0, STANDARD_GRAVITY)


def sample(acceleration: Any = UP, rotation: Rotation | None = None) -> ImuSample:
    x, y, z, w = (rotation or Rotation.identity()).as_quat()
    return ImuSample(HostNs(0), (w, x, y, z), (0.0, 0.0, 0.0), tuple(acceleration))


def report(*samples: ImuSample) -> GravityReport | None:
    monitor = GravityMonitor()
    for item in samples:
        monitor.add([item])
    return monitor.take()


def test_nothing_to_report() -> None:
    assert report() is None


@pytest.mark.parametrize("angles", [(0, 0, 0), (30, 20, -40), (0, -90, 0), (10, 0, 180)])
def test_a_tilted_sensor_at_rest_agrees_with_gravity(angles: Any) -> None:
    """Specific force points up in the world, so in the sensor it is up turned back."""
    rotation = Rotation.from_euler("ZYX", angles, degrees=True)
    found = report(sample(rotation.inv().apply(UP), rotation))
    assert found is not None
    assert found.norm == pytest.approx(STANDARD_GRAVITY)
    assert found.tilt_deg == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("degrees", [5, 90, 180])
def test_an_orientation_that_is_off(degrees: int) -> None:
    found = report(sample(UP, Rotation.from_euler("x", degrees, degrees=True)))
    assert found is not None
    assert found.tilt_deg == pytest.approx(degrees)


def test_vibration_is_averaged_and_a_period_begins_anew() -> None:
    monitor = GravityMonitor()
    for sign in (1, -1) * 50:
        monitor.add([sample((3.0 * sign, -2.0 * sign, STANDARD_GRAVITY + sign))])
    found = monitor.take()
    assert found is not None
    assert found.samples == 100
    assert found.norm == pytest.approx(STANDARD_GRAVITY)
    assert monitor.take() is None
    monitor.add([sample((0.0, 0.0, 18.0))])
    found = monitor.take()
    assert found is not None
    assert (found.samples, found.norm) == (1, 18.0)


def test_free_fall_has_no_direction() -> None:
    found = report(sample((0.0, 0.0, 0.0)))
    assert found is not None
    assert found.norm == 0
    assert found.tilt_deg == 90
