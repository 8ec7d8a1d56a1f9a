"""Times of any usual kind become one kind, and doubtful ones are refused with a reason."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from l2lidar_node.types import POINT, HostNs, Sweep
from l2lidar_proc.cloud import CloudError, cropped, joined, to_sweep, without_time

STAMP = HostNs(1_700_000_000_123_456_789)
OFFSETS_NS = np.array([0, 8_000, 50_000_000, 99_992_000], dtype=np.int64)
XY = [("x", "f4"), ("y", "f4")]


def cloud(name: str, kind: str, times: Any, **more: Any) -> np.ndarray:
    made = np.zeros(
        len(times), dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (name, kind), ("ring", "<u2")]
    )
    made["x"] = np.arange(len(times))
    made["ring"] = np.arange(len(times))[::-1]
    made[name] = times
    return made


def check(points: Any, start: Any = STAMP, offsets: Any = OFFSETS_NS, atol: float = 2e-8) -> Any:
    sweep = to_sweep(points, STAMP)
    assert abs(sweep.start - start) < 300
    assert sweep.points.dtype["time"] == np.dtype("<f4")
    np.testing.assert_allclose(sweep.points["time"], offsets * 1e-9, atol=atol)
    assert sweep.end == pytest.approx(sweep.start + offsets[-1], abs=300)
    return sweep


@pytest.mark.parametrize(
    ("name", "kind", "times", "atol"),
    [
        ("time", "<f4", OFFSETS_NS * 1e-9, 1e-8),  # velodyne, ours
        ("t", "<u4", OFFSETS_NS, 1e-8),  # ouster
        ("timestamp", "<f8", (STAMP + OFFSETS_NS) * 1e-9, 4e-7),  # hesai
        ("timestamp", "<f8", (STAMP + OFFSETS_NS).astype(float), 4e-7),  # livox
        ("timestamp", "<u8", STAMP + OFFSETS_NS, 1e-8),
        ("t", "<i8", OFFSETS_NS, 1e-8),
        ("time", "<f4", OFFSETS_NS * 1e-3, 1e-8),  # microseconds
        ("time", ">f4", OFFSETS_NS * 1e-9, 1e-8),
        ("time", "<f8", OFFSETS_NS * 1e-9, 1e-8),
        ("t", "<f4", OFFSETS_NS.astype(float), 1e-8),
    ],
)
def test_usual_types_and_units(name: str, kind: str, times: Any, atol: float) -> None:
    sweep = check(cloud(name, kind, times), atol=atol)
    assert sweep.points["x"].tolist() == [0, 1, 2, 3]
    assert sweep.points["ring"].tolist() == [3, 2, 1, 0]
    assert name == "time" or name not in sweep.points.dtype.names
    assert not sweep.points.flags.writeable


def test_a_stamp_at_the_end_of_the_sweep() -> None:
    times = (OFFSETS_NS - OFFSETS_NS[-1]) * 1e-9
    check(cloud("time", "<f4", times), start=STAMP - OFFSETS_NS[-1])


def test_a_first_point_after_the_stamp_keeps_the_stamp() -> None:
    sweep = to_sweep(cloud("time", "<f4", OFFSETS_NS[1:] * 1e-9), STAMP)
    assert sweep.start == STAMP
    assert sweep.points["time"][0] == np.float32(8e-6)


def test_unordered_points_are_put_in_order() -> None:
    sweep = check(cloud("time", "<f4", OFFSETS_NS[::-1] * 1e-9))
    assert sweep.points["x"].tolist() == [3, 2, 1, 0]


def test_what_is_not_finite_is_left_out() -> None:
    points = cloud("time", "<f4", [0, 0.01, np.nan, 0.03, 0.04])
    points["y"][1] = np.nan
    points["z"][3] = np.inf
    assert to_sweep(points, STAMP).points["x"].tolist() == [0, 4]


def test_what_was_not_measured_has_no_time() -> None:
    # drivers that keep the place of a lost packet or of no return fill all of it with zeros
    points = cloud("timestamp", "<f8", (STAMP + OFFSETS_NS) * 1e-9)
    points["x"][0], points["timestamp"][0] = 0.0, 0.0
    check(points, offsets=OFFSETS_NS[1:], atol=4e-7)
    assert to_sweep(points, STAMP).points["x"].tolist() == [1, 2, 3]
    points["x"][0] = 5.0  # a measured point whose time is wrong
    with pytest.raises(CloudError, match="no obvious unit"):
        to_sweep(points, STAMP)


def test_organised_clouds_are_taken_row_by_row() -> None:
    points = cloud("t", "<u4", [0, 2_000_000, 1_000_000, 3_000_000]).reshape(2, 2)
    assert to_sweep(points, STAMP).points["x"].tolist() == [0, 2, 1, 3]


def test_our_own_long_sweep_is_in_seconds() -> None:
    points = np.zeros(3, dtype=POINT)
    points["time"] = [0, 2, 18]
    assert to_sweep(points, STAMP).end - STAMP == 18_000_000_000
    assert to_sweep(points, STAMP).points.tobytes() == points.tobytes()
    with_ring = np.zeros(3, dtype=[*POINT.descr, ("ring", "<u2")])
    with_ring["time"] = [0, 2, 18]
    assert to_sweep(with_ring, STAMP).end - STAMP == 18_000_000_000


def test_a_given_unit_decides() -> None:
    assert to_sweep(cloud("time", "<f4", [0, 100]), STAMP, "ms").end == STAMP + 100_000_000
    assert to_sweep(cloud("t", "<u4", [0, 230_000]), STAMP, "us").end == STAMP + 230_000_000


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (cloud("time", "<f4", [0, 100]), "no obvious unit"),
        (cloud("t", "<u4", [0, 230_000]), "no obvious unit"),
        (cloud("time", "<f4", [0.1, 0.1, 0.1]), "equal"),
        (cloud("time", "<f4", [0.1]), "equal"),
        (cloud("timestamp", "<f8", [1e9, 1e9 + 0.1]), "neither"),
        (cloud("time", "<f4", [50.0, 50.1]), "neither"),
        (cloud("timestamp", "<u8", [2**63 + 10, 2**63 + 10**8]), "not valid times"),
        (cloud("stamp", "<f4", [0, 0.1]), "no time field"),
        (cloud("time", "<f4", [np.nan]), "finite"),
        (cloud("time", "<f4", []), "finite"),
        (np.zeros(2, [*XY, ("z", "f4"), ("t", "u4"), ("time", "f4")]), "several"),
        (np.zeros(2, [*XY, ("z", "u2"), ("t", "u4")]), "'z'"),
        (np.zeros(2, [*XY, ("z", "f4"), ("t", "u4", (2,))]), "'t'"),
    ],
)  # fmt: skip
def test_doubtful_times_are_refused_with_a_reason(points: Any, reason: str) -> None:
    with pytest.raises(CloudError, match=reason):
        to_sweep(points, STAMP)


def test_a_clock_near_zero_makes_wide_times_ambiguous_but_not_narrow_ones() -> None:
    with pytest.raises(CloudError, match="may be absolute"):
        to_sweep(cloud("timestamp", "<f8", [0.5, 0.6]), HostNs(500_000_000))
    assert to_sweep(cloud("time", "<f4", [0.0, 0.1]), HostNs(500_000_000)).start == 500_000_000


@given(
    st.lists(st.floats(width=32) | st.just(float("nan")), max_size=20),
    st.sampled_from(["<f4", "<f8", "<u8"]),
)
def test_nothing_else_than_a_cloud_error(times: Any, kind: Any) -> None:
    with np.errstate(all="ignore"):
        points = cloud("time", kind, np.array(times, dtype=np.float64).astype(kind))
        try:
            sweep = to_sweep(points, STAMP)
        except CloudError:
            return
    assert (np.diff(sweep.points["time"]) >= 0).all()
    assert (sweep.points["time"] >= 0).all()


def test_without_time() -> None:
    points = np.ones(3, dtype=POINT)
    slim = without_time(points)
    assert slim.dtype.names == ("x", "y", "z", "intensity", "range")
    assert slim.dtype.itemsize == 20
    assert slim["range"].tolist() == [1, 1, 1]


def measured(start: int, seconds: float, ranges: list[float], missing: int = 0) -> Sweep:
    points = np.zeros(len(ranges), dtype=POINT)
    points["y"] = ranges
    points["time"] = np.linspace(0.0, seconds, len(ranges))
    points.flags.writeable = False
    return Sweep(HostNs(start), HostNs(start + int(seconds * 1e9)), points, 10, missing)


def test_cropped_keeps_what_is_in_range() -> None:
    sweep = measured(STAMP, 0.1, [0.49, 0.5, -3.0, 8.0, 8.01, np.nan], missing=2)
    kept = cropped(sweep, 0.5, 8.0)
    assert kept.points["y"].tolist() == [0.5, -3.0, 8.0]
    np.testing.assert_array_equal(kept.points, sweep.points[1:4])
    assert (kept.start, kept.end, kept.packets, kept.missing) == (sweep.start, sweep.end, 10, 2)
    assert cropped(kept, 0.5, 8.0) is kept


def test_joined_sweeps_last_long_enough_and_keep_every_instant() -> None:
    spans = [(0, 0.05), (50, 0.05), (100, 0.1), (200, 0.05)]  # the last one stays too short
    sweeps = [
        measured(STAMP + ms * 1_000_000, seconds, [1.0 + k, 2.0], k)
        for k, (ms, seconds) in enumerate(spans)
    ]
    first, second = joined(sweeps, 100_000_000)
    assert second is sweeps[2]
    assert (first.start, first.end) == (sweeps[0].start, sweeps[1].end)
    assert (first.packets, first.missing) == (20, 1)
    assert first.points["y"].tolist() == [1.0, 2.0, 2.0, 2.0]
    np.testing.assert_allclose(first.points["time"], [0.0, 0.05, 0.05, 0.1], atol=1e-7)
