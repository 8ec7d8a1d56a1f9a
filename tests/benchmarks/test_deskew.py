"""The whole chain against the virtual L2's truth: what the bench measures, in short."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.bench_deskew import evaluate
from l2lidar_node.emulator.unit.inertial import ImuNoise
from tests.support.deskew_scenarios import Scenario, record


def rms_mm(scenario: Scenario) -> dict[str, float]:
    errors, _ = evaluate(record(scenario))
    return {
        method: 1e3 * float(np.sqrt((np.concatenate(found) ** 2).mean()))
        for method, found in errors.items()
    }


@pytest.mark.parametrize(
    "scenario",
    [
        Scenario("walk", "walk", 1.0, seconds=5.5),
        Scenario("noise and bias", "trot", 0.8, seconds=5.5, imu=ImuNoise(gyro_bias=(0.03,) * 3)),
        Scenario("tilted", "walk", 0.7, mount="forward", seconds=5.5, gap_s=0.01, loss=0.05),
    ],
    ids=lambda scenario: scenario.name,
)
def test_with_odometry_a_moving_sensor_sees_what_a_still_one_would(scenario: Any) -> None:
    found = rms_mm(scenario)
    assert found["odometry"] < 10.0
    assert found["odometry"] < found["none"] / 10.0
    assert found["odometry"] < found["KISS ideal"]
    assert found["true velocity"] < 6.0
    assert found["gyro only"] < found["none"]


def test_turning_in_place_needs_no_velocity() -> None:
    found = rms_mm(Scenario("pivot", "pivot", 3.0, seconds=5.0))
    assert found["none"] > 500.0
    assert found["gyro only"] < 1.0
