"""Each filter against a plain restatement of what it promises, and chains of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from l2lidar_node.settings import SettingError, build
from l2lidar_node.types import POINT
from l2lidar_proc.deskew import filters
from l2lidar_proc.deskew.config import FILTERS, FilterConfig
from l2lidar_proc.deskew.filters import FilterError, slot_time

RNG = np.random.default_rng(8)
SLOT = 7.73e-6


def points(*xyz: Any) -> np.ndarray:
    made = np.zeros(len(xyz), dtype=POINT)
    made["x"], made["y"], made["z"] = np.array(xyz, dtype=float).reshape(-1, 3).T
    made["time"] = np.arange(len(xyz)) * SLOT
    return made


CLOUD = points(*RNG.uniform(-5, 5, (500, 3)))
CLOUD["intensity"] = RNG.integers(0, 256, 500)


def kept(name: str, cloud: Any = CLOUD, **settings: Any) -> list[int]:
    return filters.apply(cloud, [name], replace(FilterConfig(), **settings)).tolist()


def expected(condition: Any) -> list[int]:
    return [
        i for i, p in enumerate(CLOUD) if condition(float(p["x"]), float(p["y"]), float(p["z"]))
    ]


def test_every_name_is_a_filter_and_every_filter_has_a_name() -> None:
    assert set(FILTERS) == set(filters.FILTERS)


def test_range() -> None:
    found = kept("range", range_min=2.0, range_max=4.0)
    assert found == expected(lambda x, y, z: 4.0 <= x * x + y * y + z * z <= 16.0)
    assert 0 < len(found) < 500


def test_elevation() -> None:
    found = kept("vertical", vertical_min=-10.0, vertical_max=30.0)
    assert found == expected(
        lambda x, y, z: -10.0 <= np.degrees(np.arctan2(z, np.sqrt(x * x + y * y))) <= 30.0
    )


@pytest.mark.parametrize(
    ("low", "high", "inside", "outside"),
    [
        (-45, 45, [(1, 0, 0), (1, 0.9, 0)], [(1, 1.1, 0), (-1, 0, 0)]),
        (135, -135, [(-1, 0, 0), (-1, 0.9, 0), (-1, -0.9, 0)], [(1, 0, 0), (0, 1, 0)]),
        (135, 225, [(-1, 0, 0), (-1, -0.9, 0)], [(0, 1, 0)]),
        (-180, 180, [(-1, 0, 0), (1, 0, 0), (0, -1, 0)], []),
    ],
)
def test_azimuth_window_may_go_across_the_back(
    low: int, high: int, inside: Any, outside: Any
) -> None:
    cloud = points(*inside, *outside)
    found = kept("azimuth", cloud, azimuth_min=float(low), azimuth_max=float(high))
    assert found == list(range(len(inside)))


def test_boxes() -> None:
    boxes = (-1.0, -1.0, -1.0, 1.0, 2.0, 3.0, 4.0, 4.0, 4.0, 3.0, 3.0, 3.0)
    inside = expected(
        lambda x, y, z: (
            (-1 <= x <= 1 and -1 <= y <= 2 and -1 <= z <= 3)
            or (3 <= x <= 4 and 3 <= y <= 4 and 3 <= z <= 4)
        )
    )
    assert inside
    assert kept("keep_boxes", keep_boxes=boxes) == inside
    assert kept("remove_boxes", remove_boxes=boxes) == sorted(set(range(500)) - set(inside))
    assert len(kept("keep_boxes")) == len(kept("remove_boxes")) == 500


def test_intensity() -> None:
    found = kept("intensity", intensity_min=10.0, intensity_max=200.0)
    assert found == [i for i in range(500) if 10 <= CLOUD["intensity"][i] <= 200]
    with pytest.raises(FilterError, match="intensity"):
        kept("intensity", CLOUD[["x", "y", "z"]])


def test_voxel_keeps_the_first_point_of_every_cube() -> None:
    cells, first = {}, []
    for i, p in enumerate(CLOUD):
        cell = tuple(int(np.floor(float(p[axis]) / 1.5)) for axis in "xyz")
        if cell not in cells:
            cells[cell] = i
            first.append(i)
    assert kept("voxel", voxel_size=1.5) == first
    assert kept("voxel", points((1e5, -1e5, 1e5), (-1e5, 1e5, -1e5)), voxel_size=0.01) == [0, 1]


@pytest.mark.parametrize("sizes", [(2, 30, 3), (30, 3, 2), (3, 2, 30)])
def test_no_two_voxels_of_a_long_cloud_are_taken_for_one(sizes: tuple[int, int, int]) -> None:
    grid = np.stack(np.meshgrid(*map(np.arange, sizes), indexing="ij"), axis=-1).reshape(-1, 3)
    cloud = points(*(0.5 + grid - (1.0, 2.0, 0.0)).tolist())
    assert kept("voxel", cloud, voxel_size=1.0) == list(range(len(grid)))


def wall_with_dust() -> np.ndarray:
    """Return four packets that look along a wall 3 m away, with three specks of dust before it."""
    slot = np.arange(0, 300)
    lines = []
    for packet in range(4):
        angle = np.radians(slot * 0.6)
        line = points(
            *np.stack((3 / np.sin(angle + 0.01), 3 / np.tan(angle + 0.01), slot * 0), axis=1)[
                40:260
            ]
        )
        line["time"] = packet * 4.639e-3 + slot[40:260] * SLOT
        lines.append(line)
    cloud = np.concatenate(lines)
    cloud["intensity"] = 100
    for i in (50, 300, 301 + 220):
        for axis in "xyz":
            cloud[axis][i] *= 0.4
        cloud["intensity"][i] = 5
    return cloud


def test_isolated_finds_dust_on_the_scan_line() -> None:
    cloud = wall_with_dust()
    assert slot_time(cloud["time"]) == pytest.approx(SLOT, rel=1e-3)
    removed = sorted(set(range(len(cloud))) - set(kept("isolated", cloud)))
    assert removed == [50, 300, 521]
    cloud["intensity"][300] = 200
    assert 300 in kept("isolated", cloud, isolated_intensity=150.0)
    assert 521 not in kept("isolated", cloud, isolated_intensity=150.0)


def test_isolated_does_not_take_the_next_packet_for_a_neighbour() -> None:
    lonely = points((1, 0, 0), (1, 0.001, 0))
    lonely["time"] = (0, 4.639e-3)
    assert kept("isolated", lonely) == []
    pair = points((5, 0, 0), (5, 0.01, 0))
    assert kept("isolated", pair, isolated_slots=1, isolated_neighbours=1) == [0, 1]
    assert kept("isolated", lonely[:1]) == []
    with pytest.raises(FilterError, match="time"):
        kept("isolated", lonely[["x", "y", "z"]])


def test_outliers_by_open3d() -> None:
    pytest.importorskip("open3d")
    blob = RNG.normal(0, 0.1, (200, 3))
    cloud = points(*blob, (9, 9, 9), (-8, 7, 2))
    assert kept("statistical", cloud)[-1] < 200
    assert kept("radius", cloud, radius=0.5, radius_neighbours=3) == list(range(200))
    pair = points((0, 0, 0), (0.1, 0, 0))
    assert kept("radius", pair, radius=0.5, radius_neighbours=1) == [0, 1]
    assert kept("radius", pair, radius=0.5, radius_neighbours=2) == []


def test_a_chain_is_applied_in_its_order() -> None:
    config = replace(FilterConfig(), range_min=3.0, voxel_size=20.0)
    origin_first = np.concatenate((points((0.1, 0.1, 0.1)), CLOUD[CLOUD["range"] >= 0]))
    far_first = filters.apply(origin_first, ["range", "voxel"], config)
    voxel_first = filters.apply(origin_first, ["voxel", "range"], config)
    assert len(far_first) == 8
    assert len(voxel_first) < 8
    assert filters.apply(origin_first, [], config).tolist() == list(range(501))
    assert len(filters.apply(origin_first[:0], list(FILTERS), config)) == 0


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"range_min": 5.0, "range_max": 4.0}, "range_min"),
        ({"keep_boxes": [1.0, 2.0]}, "six"),
        ({"filters_before": ["rnage"]}, "rnage"),
        ({"voxel_size": 0.0}, "voxel_size"),
    ],
)
def test_wrong_settings_are_refused(values: Any, reason: str) -> None:
    with pytest.raises(SettingError, match=reason):
        build(FilterConfig, values)
