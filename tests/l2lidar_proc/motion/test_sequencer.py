"""Sweeps wait for the IMU, no longer than allowed, and none is lost."""

from __future__ import annotations

import numpy as np

from l2lidar_node.types import POINT, HostNs, Sweep
from l2lidar_proc.motion.sequencer import Reason, Sequencer

MS = 1_000_000
S = 1_000_000_000


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
