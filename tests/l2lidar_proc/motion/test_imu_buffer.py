"""The window keeps order whatever comes in."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from l2lidar_node.types import IMU_SAMPLE, HostNs
from l2lidar_proc.motion.imu_buffer import ImuBuffer

MS = 1_000_000
BASE = 10**18


def samples(*milliseconds: float) -> Any:
    made = np.zeros(len(milliseconds), dtype=IMU_SAMPLE)
    made["stamp"] = BASE + np.round(np.array(milliseconds) * MS).astype(np.int64)
    made["orientation_wxyz"][:, 0] = milliseconds
    return made


def kept(window: ImuBuffer) -> list[float]:
    rates = window.samples["orientation_wxyz"][:, 0].tolist()
    assert ((window.samples["stamp"] - BASE) / MS).tolist() == rates, (
        "stamp and value belong together"
    )
    return rates


def test_any_order_ends_up_in_order() -> None:
    order = np.random.default_rng(3).permutation(60) * 4.0
    one_by_one, at_once = ImuBuffer(), ImuBuffer()
    one_by_one.push(samples(-1.0))
    at_once.push(samples(-1.0))
    for value in order:
        one_by_one.push(samples(value))
    at_once.push(samples(*order))
    assert kept(one_by_one) == kept(at_once) == [-1.0, *sorted(order)]
    assert not any(asdict(ImuBuffer().counts).values())
    assert one_by_one.counts.accepted == 61
    assert one_by_one.counts.reordered == at_once.counts.reordered > 0


def test_push_returns_only_what_continues_the_window() -> None:
    window = ImuBuffer()
    window.push(samples(0, 4))
    fresh = window.push(samples(12, 8, 16))
    assert fresh["orientation_wxyz"][:, 0].tolist() == [12.0, 16.0]
    assert kept(window) == [0, 4, 8, 12, 16]


def test_duplicates_invalid_and_stale_samples_are_refused_and_counted() -> None:
    window = ImuBuffer()
    window.push(samples(0, 4, 8))
    window.push(samples(4))
    window.push(samples(8))
    broken = samples(12, 16)
    broken["linear_acceleration"][0, 1] = np.nan
    broken["angular_velocity"][1, 2] = 1e6
    window.push(broken)
    window.push(samples(-4))
    assert kept(window) == [0, 4, 8]
    counts = window.counts
    assert (counts.duplicate, counts.invalid, counts.stale, counts.jumps) == (2, 2, 1, 0)


def test_a_jump_of_the_clock_starts_afresh() -> None:
    window = ImuBuffer(jump_s=1.0)
    window.push(samples(10_000, 10_004))
    window.push(samples(100, 104))
    assert kept(window) == [100, 104]
    window.push(samples(5_000))
    window.push(samples(5_004))
    assert kept(window) == [5_000, 5_004]
    window.push(samples(8_000))
    window.push(samples(11_000))  # slower than any IMU, but no outlier
    assert kept(window) == [8_000, 11_000]
    assert window.counts.jumps == 3
    assert window.counts.outlier == 0


@pytest.mark.parametrize("at", [10**9, -(10**9), 2_000])
def test_one_sample_of_another_time_changes_nothing(at: int) -> None:
    window = ImuBuffer(jump_s=1.0)
    window.push(samples(0, 4))
    assert not len(window.push(samples(at)))
    window.push(samples(8))
    assert len(window.push(samples(12, at, 16))) == 2
    assert len(window.push(samples(at, 20))) == 1
    assert kept(window) == [0, 4, 8, 12, 16, 20]
    assert (window.counts.jumps, window.counts.outlier) == (0, 3)
    window.push(samples(at))
    window.clear()
    window.push(samples(at + 4, at + 8))
    assert kept(window) == [at + 4, at + 8]


def test_between_includes_a_neighbour_on_either_side() -> None:
    window = ImuBuffer()
    window.push(samples(0, 4, 8, 12, 16))

    def span(start: float, end: float) -> list[float]:
        found = window.between(HostNs(BASE + round(start * MS)), HostNs(BASE + round(end * MS)))
        return found["orientation_wxyz"][:, 0].tolist()

    assert span(5, 11) == [4, 8, 12]
    assert span(4, 12) == [4, 8, 12]
    assert span(-9, 1) == [0, 4]
    assert span(15, 99) == [12, 16]
    assert span(90, 99) == [16]


def test_memory_is_bounded_and_old_samples_go() -> None:
    window = ImuBuffer(length_s=1.0)
    for first in range(0, 60_000, 400):
        window.push(samples(*range(first, first + 400, 4)))
    assert len(window) == 251
    assert kept(window)[-1] == 59_996
    assert window._buffer.nbytes < 2**20
