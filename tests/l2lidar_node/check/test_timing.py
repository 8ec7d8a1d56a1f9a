"""Times as each consumer takes them, against its rules."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from l2lidar_node.check.observation import Gathering, Observation, kept_share
from l2lidar_node.check.points import reading
from l2lidar_node.check.report import judge
from l2lidar_node.check.requirements import CONSUMERS, TimeField, TimeUnit
from l2lidar_node.check.timing import Timing, timing
from l2lidar_node.clouds import LAYOUTS
from tests.l2lidar_node.check import recordings

STAMP = 1_700_000_000_250_000_000


def read(unit: TimeUnit, code: str, *values: float) -> Timing:
    field = TimeField("t", (code,), unit)
    return timing(observed(code, *values).clouds, field, code)


def observed(code: str, *values: float, name: str = "t") -> Observation:
    points = np.zeros(len(values), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (name, f"<{code}")])
    points[name] = values
    gathering = Gathering()
    gathering.cloud(recordings.cloud(points, STAMP), STAMP)
    return gathering.observation()


@pytest.mark.parametrize(
    ("unit", "code", "values", "first", "spread"),
    [
        (TimeUnit.S, "f4", (0.0, 0.25), 0.0, 0.25),
        (TimeUnit.NS, "u4", (1_000_000, 201_000_000), 0.001, 0.2),
        (TimeUnit.EPOCH_S, "f8", (1_700_000_000.25, 1_700_000_000.5), 0.0, 0.25),
        (TimeUnit.EPOCH_AUTO, "f8", (1_700_000_000.25, 1_700_000_000.5), 0.0, 0.25),
        (TimeUnit.EPOCH_AUTO, "f8", (STAMP, STAMP + 2.5e8), 0.0, 0.25),
        (TimeUnit.GLIM, "f4", (0.0, 0.25), 0.0, 0.25),
        (TimeUnit.GLIM, "u4", (0, 250_000_000), 0.0, 0.25),
        (TimeUnit.GLIM, "f8", (1_700_000_000.25, 1_700_000_000.5), 0.0, 0.25),
        (TimeUnit.GLIM, "f8", (STAMP, STAMP + 2.5e8), 0.0, 0.25),
        (TimeUnit.RKO, "f4", (0.0, 0.25), 0.0, 0.25),
        (TimeUnit.RKO, "u4", (0, 250_000_000), 0.0, 0.25),
        (TimeUnit.RKO, "f4", (-0.25, 0.0), -0.25, 0.25),
        (TimeUnit.RKO, "f8", (1_700_000_000.25, 1_700_000_000.5), 0.0, 0.25),
        (TimeUnit.RKO, "f8", (1_700_000_000.0, 1_700_000_000.25), -0.25, 0.25),
    ],
)
def test_values_become_seconds_after_the_stamp(
    unit: Any, code: str, values: Any, first: float, spread: float
) -> None:
    found = read(unit, code, *values)
    assert found.refused == 0
    assert found.first[0] == pytest.approx(first, abs=1e-6)
    assert found.spread[0] == pytest.approx(spread, abs=1e-6)


@pytest.mark.parametrize("first", [0.0011, 0.1, 3.0])
def test_rko_lio_refuses_a_first_time_from_1_ms_on(first: float) -> None:
    assert read(TimeUnit.RKO, "f4", first, first + 0.2).refused == 1
    assert read(TimeUnit.RKO, "f4", 0.0009, 0.2).refused == 0


def test_glim_takes_a_second_or_more_for_absolute() -> None:
    assert read(TimeUnit.GLIM, "f4", 0.0, 0.999).least[0] == 0.0
    assert read(TimeUnit.GLIM, "f4", 0.0, 1.001).least[0] < -1e9


def test_kiss_icp_takes_any_unit_and_origin() -> None:
    for values in ((5.0, 5.25), (0, 250_000_000)):
        found = read(TimeUnit.SPREAD, "f8", *values)
        assert (found.first[0], found.spread[0]) == pytest.approx((0.0, 0.25))


@pytest.mark.parametrize(
    ("consumer", "name", "code", "when"),
    [
        ("lio_sam", "time", "f4", "sensor: velodyne"),
        ("fast_lio", "t", "u4", "lidar_type: 3"),
        ("dlio", "timestamp", "f8", ""),
        ("rtabmap", "stamps", "f4", ""),
    ],
)
def test_the_input_that_fits_best_is_taken(consumer: str, name: str, code: str, when: str) -> None:
    form = observed(code, 0.0, name=name).clouds[0].format
    way = reading(form, CONSUMERS[consumer])
    assert (way.input.when, way.time.name, way.code) == (when, name, code)


def test_an_ouster_cloud_is_judged_as_such() -> None:
    made = recordings.copied(recordings.good("lio_sam"))
    layout = LAYOUTS["ouster_legacy"].with_rings(CONSUMERS["lio_sam"].ring_count)
    made.clouds = [
        recordings.cloud(layout.convert(sweep.points, sweep.start), sweep.start)
        for sweep in recordings.sweeps()
    ]
    findings = judge(made.observe(), CONSUMERS["lio_sam"])
    assert [item.line for item in findings if item.level] == []
    assert any("sensor: ouster" in item.text for item in findings)


def test_a_cell_keeps_one_point() -> None:
    """Four points in two rings: two share ring and column, one is half a degree beside."""
    angle = np.radians([10.0, 10.01, 10.5, 10.0])
    ring = np.array([3, 3, 3, 4])
    assert kept_share(ring, np.sin(angle), np.cos(angle)) == 0.75
    assert kept_share(ring[:0], angle[:0], angle[:0]) == 1.0
