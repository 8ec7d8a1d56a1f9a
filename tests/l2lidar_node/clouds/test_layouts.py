"""The point layouts clouds are published in."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from l2lidar_node.clouds import LAYOUTS, RINGS, rings
from l2lidar_node.driver.geometry import Projector
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.types import POINT, HostNs
from tests.support import build

START = HostNs(1_700_000_000_123_456_789)


@pytest.fixture
def points() -> Any:
    payload = build.points_3d(intensities=np.arange(300) % 256)
    return Projector(PacketType.POINTS_3D).points([payload], np.zeros(1)).points


# Offset and type of every field as the consumers' own drivers publish them.
PUBLISHED = {
    "native": (24, "x0<f4 y4<f4 z8<f4 intensity12<f4 range16<f4 time20<f4"),
    "native_ring": (26, "x0<f4 y4<f4 z8<f4 intensity12<f4 range16<f4 time20<f4 ring24<u2"),
    "velodyne": (22, "x0<f4 y4<f4 z8<f4 intensity12<f4 ring16<u2 time18<f4"),
    "unitree": (32, "x0<f4 y4<f4 z8<f4 intensity16<f4 ring20<u2 time24<f4"),
    "ouster_legacy": (
        48,
        "x0<f4 y4<f4 z8<f4 intensity16<f4 t20<u4 reflectivity24<u2 ring26|u1 noise28<u2 "
        "range32<u4",
    ),
    "hesai": (26, "x0<f4 y4<f4 z8<f4 intensity12<f4 ring16<u2 timestamp18<f8"),
    "autoware": (
        32,
        "x0<f4 y4<f4 z8<f4 intensity12|u1 return_type13|u1 channel14<u2 azimuth16<f4 "
        "elevation20<f4 distance24<f4 time_stamp28<u4",
    ),
    "xyzi": (16, "x0<f4 y4<f4 z8<f4 intensity12<f4"),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_offsets_and_types_are_the_published_ones(name: Any) -> None:
    layout = LAYOUTS[name].dtype
    fields = (layout.fields or {}).items()
    words = [f"{field}{offset}{kind.str}" for field, (kind, offset, *_) in fields]
    assert (layout.itemsize, " ".join(words)) == PUBLISHED[name]


def test_native_is_the_point_itself(points: Any) -> None:
    assert LAYOUTS["native"].convert(points, START) is points


@pytest.mark.parametrize("name", LAYOUTS)
def test_positions_and_intensities_are_kept(name: Any, points: Any) -> None:
    converted = LAYOUTS[name].convert(points, START)
    assert converted.dtype == LAYOUTS[name].dtype
    for field in ("x", "y", "z", "intensity"):
        np.testing.assert_array_equal(converted[field], points[field])


@pytest.mark.parametrize("name", LAYOUTS)
def test_times_are_in_the_consumers_unit(name: Any, points: Any) -> None:
    layout = LAYOUTS[name]
    converted = layout.convert(points, START)
    seconds = points["time"].astype(np.float64)
    if layout.time_field == "time":
        np.testing.assert_array_equal(converted["time"], points["time"])
    elif layout.time_field in ("t", "time_stamp"):
        np.testing.assert_allclose(converted[layout.time_field], seconds * 1e9, atol=0.5)
    elif layout.time_field == "timestamp":
        # A double holds the seconds since the epoch to a quarter of a microsecond.
        np.testing.assert_allclose(converted["timestamp"] - START / 1e9, seconds, atol=5e-7)
    else:
        assert name == "xyzi"


@pytest.mark.parametrize("name", ["ouster_legacy", "autoware"])
def test_times_that_do_not_fit_do_not_begin_anew(name: str, points: Any) -> None:
    late = points[:4].copy()
    late["time"] = [0.0, 4.2, 4.4, 9.0]
    layout = LAYOUTS[name]
    times = layout.convert(late, START)[layout.time_field].tolist()
    assert times[:2] == pytest.approx([0, 4.2e9], rel=1e-6)
    assert times[2:] == [layout.longest_ns] * 2 == [2**32 - 1] * 2


@pytest.mark.parametrize("name", LAYOUTS)
def test_without_time_only_the_time_is_missing(name: Any, points: Any) -> None:
    layout = LAYOUTS[name]
    bare = layout.without_time()
    assert bare.time_field == ""
    assert bare.dtype.itemsize == layout.dtype.itemsize
    whole, part = layout.convert(points, START), bare.convert(points, START)
    assert set(whole.dtype.names or ()) - set(part.dtype.names or ()) == {layout.time_field} - {""}
    for field in part.dtype.names:
        np.testing.assert_array_equal(part[field], whole[field])


def test_ranges_are_in_the_consumers_unit(points: Any) -> None:
    millimeters = LAYOUTS["ouster_legacy"].convert(points, START)["range"]
    np.testing.assert_allclose(millimeters / 1e3, points["range"], atol=5.1e-4)
    meters = LAYOUTS["autoware"].convert(points, START)["distance"]
    np.testing.assert_array_equal(meters, points["range"])


def test_angles_of_autoware_lead_back_to_the_point(points: Any) -> None:
    converted = LAYOUTS["autoware"].convert(points, START)
    distance = np.linalg.norm([points["x"], points["y"], points["z"]], axis=0)
    level = distance * np.cos(converted["elevation"])
    np.testing.assert_allclose(level * np.cos(converted["azimuth"]), points["x"], atol=1e-5)
    np.testing.assert_allclose(level * np.sin(converted["azimuth"]), points["y"], atol=1e-5)


@pytest.mark.parametrize("name", ["velodyne", "unitree", "hesai", "native_ring", "ouster_legacy"])
def test_the_ring_is_that_of_the_point(name: str, points: Any) -> None:
    converted = LAYOUTS[name].convert(points, START)
    np.testing.assert_array_equal(converted["ring"], rings(points))
    assert converted["ring"].max() < RINGS


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_layout_converts_no_points(name: Any) -> None:
    converted = LAYOUTS[name].convert(np.empty(0, POINT), START)
    assert converted.shape == (0,)


def test_lio_sam_keeps_nearly_all_points() -> None:
    """Its projection keeps the first point of each cell of ring and azimuth column."""
    packets = 50
    payloads = [
        build.points_3d(
            seq=index, theta=(index * 0.12686) % (2 * np.pi), ranges=np.full(300, 5000)
        )
        for index in range(packets)
    ]
    starts = np.arange(packets) * build.PERIOD_NS / build.NS
    points = Projector(PacketType.POINTS_3D).points(payloads, starts).points
    columns = 1800
    azimuth = np.degrees(np.arctan2(points["x"], points["y"]))
    column = columns // 2 - np.round((azimuth - 90) / (360 / columns)).astype(int)
    column = np.where(column >= columns, column - columns, column)
    cells = np.unique(rings(points).astype(int) * columns + column)
    assert len(cells) > 0.95 * len(points)


def test_points_of_other_drivers_get_what_they_lack(points: Any) -> None:
    bare = np.zeros(len(points), [("x", "f4"), ("y", "f4"), ("z", "f4"), ("time", "f4")])
    for name in bare.dtype.names:
        bare[name] = points[name]
    converted = LAYOUTS["native"].convert(bare, START)
    norms = np.linalg.norm([points["x"], points["y"], points["z"]], axis=0)
    np.testing.assert_allclose(converted["range"], norms, rtol=1e-6)
    assert not converted["intensity"].any()


def test_return_type_is_that_of_a_single_strongest_return() -> None:
    with_type = [
        layout for layout in LAYOUTS.values() if "return_type" in (layout.dtype.names or ())
    ]
    assert with_type
    for layout in with_type:
        converted = layout.convert(np.zeros(3, POINT), HostNs(1_700_000_000_000_000_000))
        assert converted["return_type"].tolist() == [1, 1, 1]
