"""The point layouts clouds are published in."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_node.config import TopicConfig
from l2lidar_node.geometry import Projector
from l2lidar_node.layouts import LAYOUTS
from l2lidar_node.rings import rings
from l2lidar_node.settings import settings_of
from l2lidar_node.types import POINT, HostNs, Sweep
from l2lidar_node.wire import PacketType
from tests import build


@pytest.fixture
def sweep() -> Sweep:
    payload = build.points_3d(intensities=np.arange(300) % 256)
    points = Projector(PacketType.POINTS_3D).points([payload], np.zeros(1)).points
    return Sweep(HostNs(0), HostNs(1), points, 1, 0)


def test_every_choice_of_the_setting_has_a_layout():
    (setting,) = (item for item in settings_of(TopicConfig) if item.name == "point_layout")
    assert set(setting.choices) == set(LAYOUTS)


def test_native_is_the_point_itself(sweep):
    layout = LAYOUTS["native"]
    assert layout.dtype.names == ("x", "y", "z", "intensity", "range", "time")
    assert all(entry[0] == np.float32 for entry in (layout.dtype.fields or {}).values())
    assert layout.convert(sweep) is sweep.points


def test_native_ring_adds_the_ring(sweep):
    layout = LAYOUTS["native_ring"]
    points = layout.convert(sweep)
    assert points.dtype == layout.dtype
    assert layout.dtype.names == (*(POINT.names or ()), "ring")
    for name in POINT.names or ():
        np.testing.assert_array_equal(points[name], sweep.points[name])
    np.testing.assert_array_equal(points["ring"], rings(sweep.points))


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_layout_converts_no_points(name, sweep):
    empty = Sweep(HostNs(0), HostNs(1), sweep.points[:0], 1, 0)
    points = LAYOUTS[name].convert(empty)
    assert points.shape == (0,)
    assert points.dtype == LAYOUTS[name].dtype
