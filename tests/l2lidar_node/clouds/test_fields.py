"""Fields and points of a PointCloud2: every size, row and type, and what cannot be."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from l2lidar_node.clouds import DATATYPES, Field, dtype_of, points_of

CODES = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]


def message(
    points: np.ndarray, fields: list[Field], width: int, height: int = 1, padding: int = 0
) -> Any:
    """Return a cloud whose rows are followed by some bytes of padding."""
    step = points.dtype.itemsize
    rows = points.view(np.uint8).reshape(height, width * step)
    data = np.hstack([rows, np.full((height, padding), 255, np.uint8)]).tobytes()
    return SimpleNamespace(
        fields=fields, width=width, height=height, point_step=step, is_bigendian=False,
        row_step=width * step + padding, data=data,
    )  # fmt: skip


def test_numbers_stand_for_the_types_of_the_ros_message() -> None:
    assert [DATATYPES[number] for number in range(1, 9)] == CODES
    assert len(DATATYPES) == 8


@pytest.mark.parametrize(("number", "code"), list(enumerate(CODES, 1)))
@pytest.mark.parametrize("count", [1, 3])
def test_a_field_may_end_where_the_point_ends_and_no_later(
    number: int, code: str, count: int
) -> None:
    size = np.dtype(code).itemsize * count
    field = Field("a", 5, number, count)
    layout = dtype_of([field], 5 + size, False)
    assert layout.itemsize == 5 + size
    assert layout["a"] == np.dtype((f"<{code}", (count,)) if count > 1 else f"<{code}")
    assert dtype_of([field], 5 + size, True)["a"].base == np.dtype(f">{code}")
    with pytest.raises(ValueError, match=f"field 'a': does not fit point_step {4 + size}"):
        dtype_of([field], 4 + size, False)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ([], "there are no fields"),
        ([Field("", 0, 7, 1)], "field '': no name"),
        ([Field("x", 0, 7, 1), Field("x", 4, 7, 1)], "field 'x': occurs twice"),
        ([Field("x", 0, 9, 1)], "field 'x': datatype 9 is not known"),
    ],
)
def test_impossible_fields_are_named(fields: list[Field], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        dtype_of(fields, 16, False)


def test_a_count_of_0_is_1_as_other_drivers_mean_it() -> None:
    assert dtype_of([Field("x", 0, 7, 0)], 4, False)["x"] == np.dtype("<f4")


@pytest.mark.parametrize("padding", [0, 7])
@pytest.mark.parametrize("height", [1, 3])
def test_points_come_row_by_row_without_padding(height: int, padding: int) -> None:
    points = np.zeros(height * 4, dtype=[("x", "<f4"), ("n", "<u2")])
    points["x"], points["n"] = np.arange(len(points)) * 0.5, np.arange(len(points))
    cloud = message(points, [Field("x", 0, 7, 1), Field("n", 4, 4, 1)], 4, height, padding)
    found = points_of(cloud)
    np.testing.assert_array_equal(found["x"], points["x"])
    np.testing.assert_array_equal(found["n"], points["n"])
    if not padding:  # some drivers leave it at 0
        cloud.row_step = 0
        np.testing.assert_array_equal(points_of(cloud)["n"], points["n"])


@pytest.mark.parametrize("change", [{"row_step": 23}, {"height": 2}, {"width": 5}])
def test_sizes_that_contradict_each_other_are_named(change: dict[str, int]) -> None:
    points = np.zeros(4, dtype=[("x", "<f4"), ("n", "<u2")])
    cloud = message(points, [Field("x", 0, 7, 1)], 4)
    vars(cloud).update(change)
    with pytest.raises(ValueError, match="points of 6 B has row_step"):
        points_of(cloud)


def test_a_type_is_named_as_in_the_table() -> None:
    assert Field("x", 0, 7, 1).code == "f4"
    assert Field("x", 0, 8, 3).code == "f8[3]"
    assert Field("x", 0, 42, 1).code == "?42"
