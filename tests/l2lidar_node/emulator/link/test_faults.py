from __future__ import annotations

import dataclasses
from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from l2lidar_node.emulator.config import DeviceConfig, FaultConfig
from l2lidar_node.emulator.link.faults import HOSTILE_SIZES, Path
from l2lidar_node.emulator.truth import Datagram, Fault, PacketLog, Piece
from l2lidar_node.emulator.unit.firmware import Flash
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import WorkMode
from tests.l2lidar_node.emulator.rig import (
    MS,
    READY,
    Bench,
    S,
    booked,
    command,
    identities,
    is_sane,
    read,
)

RANDOM = (
    "bad_crc", "truncate", "hostile_size", "hostile_count", "nan", "garbage",
    "coalesce", "split", "loss", "duplicate", "reorder",
)  # fmt: skip
TIMED: dict[str, dict[str, Any]] = {
    "jitter": {"jitter": "heavy", "jitter_ms": 20.0},
    "burst": {"burst_ms": 100.0, "burst_every_s": 0.7},
    "silence": {"silence_at": (1.0, 3.0), "silence_s": 0.5},
    "reboot": {"reboot_at": (1.5,)},
    "clock_step": {"clock_step_at": (1.0,)},
    "foreign_sync": {"foreign_sync_at": (1.0,)},
}
EVERY: dict[str, dict[str, Any]] = {**{name: {name: 0.1} for name in RANDOM}, **TIMED}
OFF: dict[str, Any] = dict.fromkeys(RANDOM, 0.0)
DESTRUCTIVE = {"bad_crc", "truncate", "hostile_size", "hostile_count", "nan", "loss", "silence"}


PLAIN = WorkMode(0)


def bench_with(seed: int = 3, mode: WorkMode = PLAIN, **faults: Any) -> Bench:
    config = DeviceConfig(power=READY, faults=FaultConfig(**faults), seed=seed)
    flash = Flash.factory(config.addresses, config.identity)
    return Bench(config, flash=dataclasses.replace(flash, work_mode=int(mode)))


def struck(bench: Bench, fault: Fault) -> np.ndarray:
    packets = bench.device.packet_log.packets
    return packets[(packets["faults"] & int(fault)) != 0]


def test_without_faults_every_packet_is_its_own_datagram_in_time() -> None:
    bench = bench_with()
    datagrams = bench.run(5.0)
    packets = bench.device.packet_log.packets
    assert len(datagrams) == len(packets)
    assert [time for time, _ in datagrams] == packets["left_ns"].tolist()
    assert (packets["copies"] == 1).all()
    assert (packets["arrived_ns"] == packets["left_ns"]).all()
    assert bench.device.packet_log.events == ()


def test_a_rate_of_zero_is_byte_identical_to_no_fault() -> None:
    plain, zero = bench_with(), bench_with(**OFF, jitter_ms=7.0)
    assert plain.run(3.0) == zero.run(3.0)


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("mode", [PLAIN, WorkMode.MODE_2D])
def test_the_packet_log_knows_what_a_good_reader_gets(name: Any, mode: Any) -> None:
    bench = bench_with(mode=mode, **EVERY[name])
    datagrams = bench.run(6.0)
    assert identities(datagrams) == booked(bench.device)
    packets = bench.device.packet_log.packets
    assert {event.fault.name.lower() for event in bench.device.packet_log.events} <= {name}
    if name in DESTRUCTIVE:
        lost = packets["copies"] == 0
        assert lost.any()
        assert (packets["faults"][lost] == int(Fault[name.upper()])).all()
        assert (packets["faults"][~lost] == 0).all()
    elif name == "duplicate":
        again = packets["faults"] != 0
        assert (packets["copies"][~again] == 1).all()
        if mode == PLAIN:
            assert (packets["copies"][again] == 2).all()
    elif name == "reorder":
        assert (packets["copies"][packets["type"] == 104] <= 1).all()
    elif name not in ("jitter", "burst"):
        settled = packets["left_ns"] < 5.9 * S  # the last may still wait for company
        assert (packets["copies"][settled] == 1).all(), "only time, stamp or company changed"


@settings(max_examples=20, deadline=None)
@given(
    st.fixed_dictionaries({}, optional={name: st.floats(0.01, 0.5) for name in RANDOM}),
    st.fixed_dictionaries({}, optional={"burst_ms": st.just(30.0), "jitter": st.just("uniform")}),
    st.sampled_from([PLAIN, WorkMode.MODE_2D]),
    st.integers(0, 1000),
)
def test_the_packet_log_is_right_for_any_mixture(
    rates: Any, timed: Any, mode: Any, seed: Any
) -> None:
    bench = bench_with(seed, mode, **rates, **timed, burst_every_s=0.1)
    bench.run(0.4)
    bench.ask(command(100, 4, 9))
    bench.run(2.0)
    got, expected = identities(bench.log), booked(bench.device)
    assert expected - got == Counter()
    # Two packets cut within their tails, which are alike, may complete each other.
    assert (got - expected).total() <= (1 if "split" in rates else 0)
    times = [time for time, _ in bench.log]
    assert times == sorted(times)
    assert max(len(data) for _, data in bench.log) <= wire.MAX_DATAGRAM


@pytest.mark.parametrize("name", EVERY)
def test_the_same_seed_does_the_same(name: Any) -> None:
    first, second = bench_with(5, **EVERY[name]), bench_with(5, **EVERY[name])
    whole = first.run(3.0)
    parts = [item for _ in range(300) for item in second.run(0.01)]
    if name == "coalesce":  # how long a packet waits for company depends on when one looks
        assert identities(whole) == identities(parts)
    else:
        assert whole == parts


@pytest.mark.parametrize("name", RANDOM)
def test_another_seed_does_something_else(name: Any) -> None:
    first, second = bench_with(5, **EVERY[name]), bench_with(6, **EVERY[name])
    assert first.run(3.0) != second.run(3.0)


def test_one_fault_strikes_alike_with_and_without_another() -> None:
    alone, both = bench_with(loss=0.05), bench_with(loss=0.05, duplicate=0.5)
    alone.run(5.0)
    both.run(5.0)
    assert (struck(alone, Fault.LOSS)["ordinal"] == struck(both, Fault.LOSS)["ordinal"]).all()


@pytest.mark.parametrize("name", RANDOM)
def test_the_rate_is_met(name: Any) -> None:
    rate: dict[str, Any] = {name: 0.1}
    bench = bench_with(**rate)
    bench.run(20.0)
    count = bench.device.packet_log.counts[Fault[name.upper()]]
    of = len(bench.device.packet_log.of_type(102)) if name == "hostile_count" else None
    of = of or len(bench.device.packet_log.packets)
    assert 0.08 < count / of < 0.12


def test_random_faults_keep_to_their_window() -> None:
    bench = bench_with(loss=0.5, nan=0.5, reorder=0.5, fault_from_s=1.0, fault_until_s=2.0)
    bench.run(3.0)
    times = np.array([event.time_ns for event in bench.device.packet_log.events]) / S
    assert len(times) > 100
    assert times.min() >= 1.0
    assert times.max() < 2.0


def test_bad_crc_flips_one_bit_of_the_payload() -> None:
    plain, bad = bench_with().run(2.0), bench_with(bad_crc=0.2).run(2.0)
    flipped = 0
    for (_, a), (_, b) in zip(plain, bad, strict=True):
        difference = np.unpackbits(np.frombuffer(a, np.uint8) ^ np.frombuffer(b, np.uint8))
        if difference.any():
            assert difference.sum() == 1
            assert 12 * 8 <= difference.argmax() < (len(a) - 12) * 8
            assert read(b) == []
            flipped += 1
    assert flipped > 50


def test_truncation_keeps_a_beginning() -> None:
    plain, cut = bench_with().run(2.0), bench_with(truncate=0.2).run(2.0)
    shorter = [(a, b) for (_, a), (_, b) in zip(plain, cut, strict=True) if a != b]
    assert len(shorter) > 50
    assert all(a.startswith(b) and 0 < len(b) <= len(a) - 12 for a, b in shorter)


def test_hostile_sizes_are_the_famous_ones() -> None:
    sizes = {
        int.from_bytes(data[8:12], "little") for _, data in bench_with(hostile_size=0.3).run(3.0)
    }
    assert sizes == {1044, 80, *HOSTILE_SIZES}
    assert set(HOSTILE_SIZES) == {12, 24, 10001, 0xFFFFFFFF}


@pytest.mark.parametrize(("mode", "room"), [(PLAIN, 300), (WorkMode.MODE_2D, 1800)])
def test_hostile_counts_have_a_right_crc(mode: Any, room: int) -> None:
    bench = bench_with(mode=mode, hostile_count=0.5)
    frames = read(b"".join(data for _, data in bench.run(3.0)))
    points = [frame for frame in frames if frame.packet_type in (102, 103)]
    layout = wire.PAYLOADS[points[0].packet_type]
    counts = {int(np.frombuffer(frame.payload, layout)["point_num"][0]) for frame in points}
    assert counts == {room, room + 1, 0xFFFFFFFF}


def test_nan_has_a_right_crc_and_reaches_every_vital_float() -> None:
    bench = bench_with(nan=0.9)
    frames = read(b"".join(data for _, data in bench.run(10.0)))
    assert len(frames) == len(bench.device.packet_log.packets)
    ill = [frame for frame in frames if not is_sane(frame)]
    assert 0.87 < len(ill) / len(frames) < 0.93
    reached = set()
    for frame in ill:
        row = np.frombuffer(frame.payload, wire.PAYLOADS[frame.packet_type])[0]
        for name in row.dtype.names:
            if row.dtype[name].base == np.float32 and not np.isfinite(row[name]).all():
                reached.add(name)
            if name == "calibration" and not np.isfinite(row[name].tolist()).all():
                reached.add(name)
    assert reached == {
        "quaternion_wxyz", "angular_velocity", "linear_acceleration", "calibration",
        "com_horizontal_angle_start", "com_horizontal_angle_step", "range_min", "range_max",
        "angle_min", "angle_increment", "time_increment",
    }  # fmt: skip


def test_garbage_comes_before_packets_and_costs_nothing() -> None:
    plain, dirty = bench_with().run(3.0), bench_with(garbage=0.3).run(3.0)
    good = [item for item in dirty if item in set(plain)]
    assert good == plain
    assert len(dirty) > len(plain) + 200


def test_coalescing_fills_datagrams_up_to_the_limit() -> None:
    bench = bench_with(coalesce=0.6)
    datagrams = bench.run(5.0)
    sizes = {len(data) for _, data in datagrams}
    assert {160, 1124, 1044, 80} <= sizes
    assert max(sizes) <= 1472
    assert len(datagrams) < 0.7 * len(bench.device.packet_log.packets)
    plain = bench_with().run(5.0)
    joined = b"".join(data for _, data in datagrams)
    assert b"".join(data for _, data in plain).startswith(joined)


def test_nothing_waits_for_company_for_ever() -> None:
    bench = bench_with(coalesce=1.0)
    bench.run(1.0)
    bench.ask(command(100, 2, 1))
    bench.run(1.0)
    packets = bench.device.packet_log.packets
    assert (packets["copies"] == 1).all()


def test_splitting_loses_no_byte() -> None:
    plain, cut = bench_with().run(3.0), bench_with(split=0.5).run(3.0)
    assert len(cut) > 1.4 * len(plain)
    assert b"".join(data for _, data in plain) == b"".join(data for _, data in cut)


def test_duplicates_come_twice_with_nothing_between() -> None:
    datagrams = bench_with(duplicate=0.5).run(3.0)
    plain = bench_with().run(3.0)
    assert list(dict.fromkeys(datagrams)) == plain
    assert 1.4 < len(datagrams) / len(plain) < 1.6


def test_a_reordered_packet_is_late_and_the_others_are_not() -> None:
    bench = bench_with(reorder=0.05, reorder_ms=10.0)
    bench.run(10.0)
    packets = bench.device.packet_log.packets
    late = packets["arrived_ns"] - packets["left_ns"]
    hit = (packets["faults"] != 0) & (packets["copies"] > 0)
    assert set(late[hit]) == {10 * MS}
    assert set(late[packets["faults"] == 0]) == {0}
    order = np.argsort(packets["arrived_ns"][packets["copies"] > 0], kind="stable")
    assert (np.diff(order) < 0).any()


@pytest.mark.parametrize(
    ("kind", "median", "p99"), [("uniform", 10.0, 19.8), ("heavy", 0.92, 20.0)]
)
def test_jitter_has_the_stated_distribution_and_keeps_the_order(
    kind: str, median: float, p99: float
) -> None:
    bench = bench_with(jitter=kind, jitter_ms=20.0)
    times = [time for time, _ in bench.run(60.0)]
    assert times == sorted(times)
    bench.run(1.0)
    packets = bench.device.packet_log.packets
    packets = packets[packets["copies"] > 0]
    late = (packets["arrived_ns"] - packets["left_ns"]) / MS
    assert (np.diff(packets["arrived_ns"]) >= 0).all()
    assert late.min() >= 0.0
    # Queueing behind a late one only adds: the bounds of a single delay hold from below.
    assert np.quantile(late, 0.5) >= median * 0.9
    assert np.quantile(late, 0.99) >= p99 * 0.9
    assert late.max() <= (20.0 if kind == "uniform" else 100.0)


def test_bursts_withhold_and_let_go_at_once() -> None:
    bench = bench_with(burst_ms=100.0, burst_every_s=1.0)
    bench.run(5.5)
    packets = bench.device.packet_log.packets
    phase = packets["left_ns"] % S
    held = phase < 100 * MS
    assert (packets["arrived_ns"][held] % S == 100 * MS).all()
    assert (packets["arrived_ns"][~held] == packets["left_ns"][~held]).all()
    assert 35 < np.count_nonzero(held & (packets["left_ns"] // S == 2)) < 55


def test_silence_is_a_pulled_cable_in_both_directions() -> None:
    bench = bench_with(silence_at=(1.0,), silence_s=0.5)
    bench.run(1.2)
    assert bench.ask(command(100, 4, 9)) == []
    bench.run(1.0)
    packets = bench.device.packet_log.packets
    gone = packets[packets["copies"] == 0]
    assert gone["left_ns"].min() >= S
    assert gone["left_ns"].max() < 1.5 * S
    assert len(gone) == pytest.approx(0.5 * (250 + 215.5), abs=4)
    seq = packets[packets["type"] == 104]["seq"]
    assert (np.diff(seq) == 1).all(), "the unit goes on counting"
    assert bench.ask(command(100, 4, 9)) != []


def test_a_reboot_by_itself() -> None:
    bench = bench_with(reboot_at=(1.0, 2.0))
    bench.run(3.0)
    assert bench.device.boots == 2
    assert [event.time_ns for event in bench.device.packet_log.events] == [S, 2 * S]
    boots = bench.device.packet_log.of_type(102)["boot"]
    assert set(boots) == {0, 1, 2}


def test_lost_commands_have_no_effect() -> None:
    bench = bench_with(command_loss=1.0)
    assert bench.ask(command(100, 2, 1)) == []
    assert bench.count(1.0)[104] in (249, 250)
    assert bench.device.packet_log.counts[Fault.COMMAND_LOSS] == 1


def test_fault_events_name_the_packet() -> None:
    bench = bench_with(loss=0.1)
    bench.run(3.0)
    packets = bench.device.packet_log.packets
    gone = packets[packets["copies"] == 0]
    events = [
        (event.packet_type, event.ordinal, event.time_ns)
        for event in bench.device.packet_log.events
    ]
    assert events == [(int(r["type"]), int(r["ordinal"]), int(r["left_ns"])) for r in gone]


def test_a_short_memory_is_bounded_and_still_right() -> None:
    config = DeviceConfig(power=READY, faults=FaultConfig(split=0.5, reorder=0.1))
    full, small = Bench(config), Bench(config, packet_log=PacketLog(keep=100))
    for _ in range(100):
        assert small.run(0.1) == full.run(0.1)
    packet_log = small.device.packet_log
    assert len(packet_log.packets) <= 400
    assert len(packet_log.events) <= 1000
    assert (packet_log.packets[-100:] == full.device.packet_log.packets[-100:]).all()
    assert packet_log.counts == full.device.packet_log.counts


def test_pieces_that_do_not_follow_each_other_make_no_packet() -> None:
    packet_log = PacketLog()
    rows = np.zeros(2, packet_log.packets.dtype)
    assert packet_log.book(rows) == 0
    path = Path([], packet_log)
    first = Datagram(1, b"abcd", (Piece(0, 0, 4, 4),)).cut(2)
    other = Datagram(1, b"xy", (Piece(1, 0, 2, 2),))
    path.send([first[0], other, first[1]], 1)
    assert [item.data for item in path.arrivals(1)] == [b"ab", b"xy", b"cd"]
    assert packet_log.packets["copies"].tolist() == [0, 1]


@given(st.binary(min_size=1, max_size=5000), st.lists(st.integers(1, 4999), max_size=5))
def test_cutting_and_joining_change_nothing(data: Any, cuts: Any) -> None:
    whole = Datagram(5, data, (Piece(0, 0, len(data), len(data)),))
    rest = whole
    parts: list[Any] = []
    for at in sorted(cuts):
        done = sum(len(part.data) for part in parts)
        if done < at < len(data):
            part, rest = rest.cut(at - done)
            parts.append(part)
    parts.append(rest)
    joined = parts[0]
    for part in parts[1:]:
        joined = joined.join(part)
    assert joined.data == data
    assert [(p.start, p.stop) for p in joined.pieces] == [
        (sum(len(q.data) for q in parts[:i]), sum(len(q.data) for q in parts[: i + 1]))
        for i in range(len(parts))
    ]
    assert all(len(part.data) <= wire.MAX_DATAGRAM for part in whole.fragments())
    assert b"".join(part.data for part in whole.fragments()) == data
