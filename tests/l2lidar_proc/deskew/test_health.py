"""What is short of ideal is said, and at a level that fits."""

from __future__ import annotations

from typing import Any

import pytest

from l2lidar_node.types import Check, Level
from l2lidar_proc.deskew import pipeline
from l2lidar_proc.deskew.pipeline import PipelineCounts
from l2lidar_proc.motion.imu_buffer import ImuCounts
from l2lidar_proc.motion.tracker import Flag, Quality


def quality(*flags: Flag, still: bool = False) -> Quality:
    return Quality(
        1.0, 4_000_000, 0.1, 0.2, "odometry", 120_000_000, (0.01, 0, 0), still, True, flags
    )


@pytest.mark.parametrize(
    ("flags", "level"),
    [
        ((), Level.OK),
        ((Flag.NO_VELOCITY,), Level.WARN),
        ((Flag.IMU_GAP,), Level.WARN),
        ((Flag.UNTRUSTED_VELOCITY,), Level.WARN),
        ((Flag.NO_IMU,), Level.ERROR),
        ((Flag.NO_VELOCITY, Flag.ACCELEROMETER_FAULT), Level.ERROR),
    ],
)
def test_a_sweep(flags: Any, level: Any) -> None:
    told = pipeline.of_sweep(quality(*flags), 7_000_000)
    assert told.level == level
    assert all(flag.value in told.message for flag in flags)
    assert told.values["velocity source"] == "odometry"
    assert told.values["velocity age [ms]"] == "120"
    assert told.values["rotation [deg]"] == "5.73"
    assert told.values["waited for the IMU [ms]"] == "7.0"


def period(
    before: int, after: int, last: Any, *, is_leveled: bool = False, untied: str = ""
) -> Check:
    return pipeline.of_period(
        PipelineCounts(sweeps=before), PipelineCounts(sweeps=after), last, ImuCounts(), None,
        {"no time field": 3}, is_leveled=is_leveled, untied=untied,
    )  # fmt: skip


def test_a_period() -> None:
    last = pipeline.of_sweep(quality(still=True), 0)
    told = period(3, 8, last)
    assert told.level == Level.OK
    assert "5 sweeps" in told.message
    assert "at rest" in told.message
    assert told.values["clouds refused: no time field"] == "3"
    assert told.values["last: at rest"] == "true"
    assert period(8, 8, last).level == Level.WARN
    assert period(3, 8, None).level == Level.OK


def test_a_velocity_that_cannot_be_used_is_told_unless_worse_is() -> None:
    told = period(3, 8, pipeline.of_sweep(quality(), 0), untied="'base' is not tied")
    assert told.level == Level.WARN
    assert told.message.endswith("velocity not used: 'base' is not tied")
    assert (
        period(3, 8, pipeline.of_sweep(quality(Flag.NO_IMU), 0), untied="x").level == Level.ERROR
    )


def test_levelled_clouds_are_an_error_whatever_else() -> None:
    told = period(3, 8, pipeline.of_sweep(quality(), 0), is_leveled=True)
    assert told.level == Level.ERROR
    assert "imu_adjust" in told.message
