"""The history hands out the velocities that serve a sweep, and none that does not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2lidar_proc.motion.velocity import VelocityHistory, carried_over
from l2lidar_proc.rotations import inverse, transform
from tests.l2lidar_proc.motion.analytic import at


def filled(*seconds: float, max_age_ns: int = 200_000_000) -> VelocityHistory:
    history = VelocityHistory(max_age_ns)
    for t in seconds:
        assert history.push(at(t), (t, 2 * t, 0.0))
    return history


def span(history: VelocityHistory, start: float, end: float) -> list[float]:
    found = history.around(at(start), at(end))
    assert found["velocity"][:, 0].tolist() == pytest.approx(
        ((found["stamp"] - at(0)) * 1e-9).tolist()
    )
    return [round(t, 6) for t in found["velocity"][:, 0].tolist()]


def test_within_and_one_on_either_side():
    history = filled(1.0, 1.1, 1.2, 1.3, 1.4)
    assert span(history, 1.15, 1.25) == [1.1, 1.2, 1.3]
    assert span(history, 1.1, 1.3) == [1.1, 1.2, 1.3]
    assert span(history, 1.45, 1.6) == [1.4]
    assert span(history, 0.9, 0.95) == [1.0]


def test_too_old_and_too_new_ones_do_not_count():
    history = filled(1.0, 1.1)
    assert span(history, 1.31, 1.5) == []
    assert span(history, 0.5, 0.75) == []
    history = filled(1.0, 2.0)
    assert span(history, 1.1, 1.3) == [1.0]
    assert span(history, 1.7, 1.9) == [2.0]
    assert span(history, 1.4, 1.6) == []
    assert span(VelocityHistory(), 0, 1) == []


def test_interpolates_between_two():
    history = filled(1.0, 1.1)
    np.testing.assert_allclose(history.at(at(1.05)), (1.05, 2.1, 0.0))
    np.testing.assert_allclose(history.at(at(1.2)), (1.1, 2.2, 0.0))
    assert history.at(at(1.5)) is None


def test_refuses_what_goes_back_or_is_no_number():
    history = filled(1.0)
    assert not history.push(at(1.0), (0, 0, 0))
    assert not history.push(at(0.5), (0, 0, 0))
    assert not history.push(at(1.1), (np.nan, 0, 0))
    assert not history.push(at(1.1), (1.0, 0))
    assert span(history, 1.0, 1.2) == [1.0]


def test_another_source_starts_afresh():
    history = filled(1.0, 1.1)
    assert history.push(at(0.9), (0.9, 0, 0), "wheels")
    assert history.source == "wheels"
    assert span(history, 0.8, 1.2) == [0.9]


def test_velocity_of_a_mounted_sensor():
    """A sensor one metre ahead of a body that turns left moves to the left as well."""
    mount = transform([np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)], (1.0, 0.0, 0.2))
    velocity = carried_over((0.5, 0, 0), (0, 0, 2.0), inverse(mount))
    expected = Rotation.from_euler("z", -90, degrees=True).apply((0.5, 2.0, 0))
    np.testing.assert_allclose(velocity, expected, atol=1e-12)
    np.testing.assert_allclose(mount @ inverse(mount), np.eye(4), atol=1e-12)
