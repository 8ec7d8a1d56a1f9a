"""The hash table against a dictionary."""

from __future__ import annotations

import numpy as np
from hypothesis import given, strategies as st

from l2lidar_proc.odometry.surfel_map import CellIndex

KEYS = st.one_of(
    st.integers(0, (1 << 63) - 1),
    st.integers(0, 2000),  # neighbors
    st.integers(0, 200).map(lambda number: number << 52),  # that differ in high bits alone
)


@given(st.lists(st.lists(KEYS, max_size=400), max_size=6), st.lists(KEYS, max_size=100))
def test_it_finds_what_a_dictionary_finds(batches: list[list[int]], others: list[int]) -> None:
    index = CellIndex()
    known: dict[int, int] = {}
    for batch in batches:
        new = [key for key in dict.fromkeys(batch) if key not in known]
        rows = np.arange(len(known) + 1, len(known) + 1 + len(new))
        index.insert(np.array(new, np.int64), rows)
        known.update(zip(new, rows.tolist(), strict=True))
        assert len(index) == len(known)
        asked = np.array([*known, *others], np.int64)
        found = index.find(asked).tolist()
        assert found == [known.get(key, 0) for key in asked.tolist()]
    index.clear()
    assert len(index) == 0
    assert not index.find(np.array([*known, *others], np.int64)).any()
