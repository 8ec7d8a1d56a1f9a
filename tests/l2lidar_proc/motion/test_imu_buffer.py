"""The window keeps order whatever comes in; sweeps wait for it no longer than allowed."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from l2lidar_node.types import IMU_SAMPLE, POINT, HostNs, Sweep
from l2lidar_proc.motion.imu_buffer import ImuBuffer, Reason, Sequencer, replay

MS = 1_000_000
S = 1_000_000_000
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


def sweep(start: int, length: int = 200 * MS) -> Sweep:
    return Sweep(HostNs(start), HostNs(start + length), np.zeros(0, POINT), 0, 0)


def test_goes_when_the_imu_covers_its_end() -> None:
    sequencer = Sequencer(50 * MS)
    first = sweep(10 * S)
    sequencer.push(first, now=0)
    assert sequencer.release(None, 0) == []
    assert sequencer.release(HostNs(first.end - 1), 10 * MS) == []
    (release,) = sequencer.release(first.end, 12 * MS)
    assert (release.sweep, release.reason, release.waited_ns) == (first, Reason.COVERED, 12 * MS)
    assert len(sequencer) == 0
    assert sequencer.due_ns is None


def test_goes_when_its_time_is_up() -> None:
    sequencer = Sequencer(50 * MS)
    sequencer.push(sweep(10 * S), now=7)
    assert sequencer.due_ns == 7 + 50 * MS
    assert sequencer.release(None, 6 + 50 * MS) == []
    assert [r.reason for r in sequencer.release(None, 7 + 50 * MS)] == [Reason.WAITED]


def test_order_is_kept() -> None:
    sequencer = Sequencer(50 * MS)
    sweeps = [sweep(10 * S + i * 200 * MS) for i in range(3)]
    for i, item in enumerate(sweeps):
        sequencer.push(item, now=i)
    assert [r.sweep for r in sequencer.release(sweeps[1].end, 3)] == sweeps[:2]
    assert [r.sweep for r in sequencer.release(sweeps[2].end, 3)] == sweeps[2:]


def test_a_clock_that_jumps_back_releases_those_that_wait() -> None:
    sequencer = Sequencer(50 * MS)
    old, new = sweep(100 * S), sweep(10 * S)
    assert not sequencer.push(old, now=0)
    assert sequencer.push(new, now=1)
    (release,) = sequencer.release(None, 2)
    assert (release.sweep, release.reason) == (old, Reason.CLOCK_JUMP)
    assert len(sequencer) == 1
    sequencer.jump()
    assert [r.sweep for r in sequencer.release(None, 3)] == [new]


def test_a_sweep_slightly_out_of_order_is_no_jump() -> None:
    sequencer = Sequencer(50 * MS)
    sequencer.push(sweep(10 * S), now=0)
    assert not sequencer.push(sweep(10 * S - 200 * MS), now=1)


def test_the_number_that_waits_is_bounded() -> None:
    sequencer = Sequencer(10 * S)
    sweeps = [sweep(10 * S + i * MS) for i in range(25)]
    for item in sweeps:
        sequencer.push(item, now=0)
    released = sequencer.release(None, 1)
    assert [r.sweep for r in released] == sweeps[:5]
    assert {r.reason for r in released} == {Reason.CROWDED}


def test_a_replay_gives_each_sample_once_before_the_sweep_that_ends_with_it() -> None:
    given = samples(*range(0, 1000, 4))
    some = [sweep(BASE + start * MS) for start in (0, 201, 402)]
    replayed = list(replay(some, given))
    assert [one for one, _ in replayed] == some
    stamps = np.concatenate([part["stamp"] for _, part in replayed])
    assert (stamps == given["stamp"][: len(stamps)]).all()
    for one, part in replayed:
        assert part["stamp"][-2] < one.end <= part["stamp"][-1]
