"""Range scale by tape measure."""

from __future__ import annotations

from dataclasses import replace

import pytest

from l2lidar_node.calibration.observation import Place
from l2lidar_node.calibration.scale import by_tape
from l2lidar_node.calibration.still import CalibrationError
from l2lidar_node.cli.virtual_places import slide
from l2lidar_node.emulator.unit.units import UNITS, UnitErrors

WAY = 3.0


@pytest.fixture(scope="module")
def ends() -> list[Place]:
    errors = UnitErrors(range_scale=0.004, range_bias=0.04)
    places = slide(replace(UNITS["a"], errors=errors), WAY, seconds=3.0)
    return [replace(place, returns=place.returns[::3]) for place in places]


def test_the_scale_is_found_whatever_the_bias(ends: list[Place]) -> None:
    found = by_tape(ends[0], ends[1], WAY)
    assert found.scale == pytest.approx(0.004, abs=0.0004)
    assert abs(found.scale - 0.004) < 3 * found.sd
    assert found.sd < 0.001
    assert found.surfaces >= 100
    assert found.is_significant


def test_a_wrong_tape_is_refused(ends: list[Place]) -> None:
    with pytest.raises(CalibrationError, match="read the tape again"):
        by_tape(ends[0], ends[1], 4.0)
    with pytest.raises(
        CalibrationError, match="a range scale explains at most 3 %: read the tape"
    ):
        by_tape(ends[0], ends[1], 3.15)
    with pytest.raises(CalibrationError, match="too short"):
        by_tape(ends[0], ends[1], 0.5)


def test_a_sensor_that_stayed_is_refused(ends: list[Place]) -> None:
    with pytest.raises(CalibrationError, match=r"not found again|a range scale explains at most"):
        by_tape(ends[0], ends[0], WAY)
