"""Rings by elevation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from l2lidar_node.clouds import OPTICAL_CENTRE_M, RINGS, rings
from l2lidar_node.driver.geometry import Projector
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.types import POINT
from tests.support import build


def at_elevation(*degrees: float, range_m: float = 5.0, heading: float = 0.7) -> np.ndarray:
    points = np.zeros(len(degrees), POINT)
    elevation = np.radians(degrees)
    points["x"] = range_m * np.cos(elevation) * math.cos(heading)
    points["y"] = range_m * np.cos(elevation) * math.sin(heading)
    points["z"] = range_m * np.sin(elevation) + OPTICAL_CENTRE_M
    return points


def test_rings_are_equal_steps_from_the_horizon_to_the_zenith() -> None:
    step = 90 / RINGS
    inside = [(ring + 0.5) * step for ring in range(RINGS)]
    assert rings(at_elevation(*inside)).tolist() == list(range(RINGS))


@pytest.mark.parametrize(("degrees", "ring"), [(90, RINGS - 1), (0.01, 0), (-6, 0), (-90, 0)])
def test_the_ends(degrees: float, ring: Any) -> None:
    assert rings(at_elevation(degrees)).tolist() == [ring]


@pytest.mark.parametrize("heading", [0.0, 2.0, -3.0])
@pytest.mark.parametrize("range_m", [0.1, 50.0])
def test_neither_heading_nor_range_matters(heading: float, range_m: float) -> None:
    points = at_elevation(10, 44, 80, range_m=range_m, heading=heading)
    assert rings(points).tolist() == rings(at_elevation(10, 44, 80)).tolist()


def test_type_and_no_points() -> None:
    assert rings(np.zeros(0, POINT)).dtype == np.uint16
    assert rings(np.zeros(3, POINT)).tolist() == [0, 0, 0]


def test_an_arc_climbs_all_rings_and_descends() -> None:
    calibration = build.PLAIN | {"a_axis_dist": OPTICAL_CENTRE_M}
    payload = build.points_3d(ranges=5000, calibration=calibration)
    points = Projector(PacketType.POINTS_3D).points([payload], np.zeros(1)).points
    numbers = rings(points).astype(int)
    # Slots sit on the rings' edges here, so a few fall into a neighbor.
    assert len(set(numbers)) > 0.9 * RINGS
    assert (np.diff(numbers[:150]) >= 0).all()
    assert (np.diff(numbers[151:]) <= 0).all()
