"""Copies of structured arrays: what numpy's own give, for every layout, shape and selection."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as arrays

from l2lidar_node import records
from l2lidar_node.types import IMU_SAMPLE, POINT

PADDED = np.dtype({"names": ["x", "t"], "formats": ["<f4", "<f8"], "offsets": [4, 16]})
LAYOUTS = st.sampled_from([POINT, IMU_SAMPLE, PADDED])


def some(layout: np.dtype[Any]) -> st.SearchStrategy[Any]:
    return arrays.arrays(
        layout, arrays.array_shapes(min_dims=1, max_dims=2, min_side=0), fill=None
    )


@given(LAYOUTS.flatmap(some), st.integers(1, 3), st.data())
def test_they_are_equal_to_numpys_own(found: Any, step: int, data: st.DataObject) -> None:
    found = found[::step]  # also where it is not contiguous
    mask = data.draw(arrays.arrays(np.bool_, len(found)))
    written, expected = records.copied(found), found.copy()
    records.assign(written, np.flatnonzero(mask), found[::-1][mask])
    expected[mask] = found[::-1][mask]
    for mine, theirs in (
        (written, expected),
        (records.copied(found), found.copy()),
        (records.selected(found, mask), found[mask]),
        (records.selected(found, np.flatnonzero(mask)), found[np.flatnonzero(mask)]),
        (records.joined([found, found[1:]]), np.concatenate([found, found[1:]])),
    ):
        assert mine.dtype == found.dtype  # numpy's own joined arrays lose their padding
        for name in found.dtype.names or ():
            np.testing.assert_array_equal(mine[name], theirs[name])


def test_a_copy_is_its_own() -> None:
    found = np.zeros(3, POINT)
    for copy in (records.copied(found), records.joined([found])):
        copy["x"] = 1.0
    assert not found["x"].any()


@pytest.mark.parametrize("parts", [[], [np.zeros(2, POINT), np.zeros(2, IMU_SAMPLE)]])
def test_what_cannot_be_joined_is_refused(parts: list[Any]) -> None:
    with pytest.raises(ValueError, match="one layout"):
        records.joined(parts)


@given(st.integers(0, 200), st.integers(1, 50))
def test_decimated_are_the_most_evenly_spaced_that_are_few_enough(rows: int, most: int) -> None:
    left = records.decimated(np.arange(rows), most)
    assert len(left) <= most
    assert left.tolist() == list(range(0, rows, int(left[1]) if len(left) > 1 else rows or 1))
    if 1 < len(left) < rows:
        assert len(range(0, rows, int(left[1]) - 1)) > most
    if rows <= most:
        assert len(left) == rows
