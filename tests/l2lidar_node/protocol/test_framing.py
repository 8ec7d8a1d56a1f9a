"""Frames out of a byte stream, whatever becomes of it on the way."""

from __future__ import annotations

import zlib
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, strategies as st

from l2lidar_node.protocol import framing, wire
from l2lidar_node.protocol.framing import Fault, Frame, FrameError, Framer
from l2lidar_node.protocol.wire import MAGIC, MAX_FRAME, PacketType
from tests.support import build

IMU = [build.frame(PacketType.IMU, build.imu(seq)) for seq in range(40)]
POINTS = build.frame(PacketType.POINTS_3D, build.points_3d())
PLANE = build.frame(PacketType.POINTS_2D, build.points_2d())
ACK = build.frame(PacketType.ACK, build.ack(100))
FRAGMENTS = [PLANE[:1384], PLANE[1384:2768], PLANE[2768:4152], PLANE[4152:]]
MIXED = [IMU[0], POINTS, ACK, IMU[1], PLANE, IMU[2]]


def frames(*datagrams: bytes, framer: Framer | None = None) -> list[bytes]:
    """Return the good frames that come of datagrams, encoded again."""
    framer = framer or Framer()
    found = [item for datagram in datagrams for item in framer.feed(datagram)]
    return [wire.encode_frame(*item) for item in found if isinstance(item, Frame)]


def errors(*datagrams: bytes) -> list[FrameError]:
    framer = Framer()
    found = [item for datagram in datagrams for item in framer.feed(datagram)]
    return [item for item in found if isinstance(item, FrameError)]


def header(packet_type: int, size: int) -> bytes:
    return wire.HEADER.pack(MAGIC, packet_type, size)


def test_one_frame_to_a_datagram() -> None:
    framer = Framer()
    for frame in MIXED:
        assert frames(frame, framer=framer) == [frame]
        assert framer.pending == 0


def test_byte_by_byte_nothing_comes_before_the_last_byte() -> None:
    framer = Framer()
    for frame in MIXED:
        for at in range(len(frame) - 1):
            assert framer.feed(frame[at : at + 1]) == []
        assert frames(frame[-1:], framer=framer) == [frame]


def test_coalesced_frames_and_a_piece_of_the_next() -> None:
    framer = Framer()
    assert frames(b"".join(MIXED) + POINTS[:700], framer=framer) == MIXED
    assert framer.pending == 700
    assert frames(POINTS[700:] + IMU[3], framer=framer) == [POINTS, IMU[3]]


@pytest.mark.parametrize("cut", [1, 2, 3])
def test_a_piece_of_a_magic_after_junk_is_kept(cut: int) -> None:
    assert frames(b"junk" + ACK[:cut], ACK[cut:]) == [ACK]
    assert errors(b"junk" + ACK[:cut], ACK[cut:]) == [FrameError(Fault.JUNK, 4)]


@given(st.lists(st.integers(0, 1472), max_size=30))
def test_cuts_anywhere(sizes: Any) -> None:
    assert frames(*build.cut(b"".join(MIXED), sizes)) == MIXED
    assert errors(*build.cut(b"".join(MIXED), sizes)) == []


@given(st.data())
def test_one_flipped_byte_costs_at_most_the_frame_it_hit(data: Any) -> None:
    stream = bytearray(b"".join([*MIXED, *IMU[3:40]]))
    at = data.draw(st.integers(0, sum(map(len, MIXED)) - 1))
    stream[at] ^= data.draw(st.integers(1, 255))
    sizes = data.draw(st.lists(st.integers(1, 1472), max_size=12))
    edges = [0, *(sum(map(len, MIXED[: n + 1])) for n in range(len(MIXED)))]
    hit = next(n for n, (lo, hi) in enumerate(pairwise(edges)) if lo <= at < hi)
    found = frames(*build.cut(bytes(stream), sizes))
    expected = [*MIXED[:hit], *MIXED[hit + 1 :], *IMU[3:40]]
    if len(found) > len(expected):  # the two ignored fields of the tail may be anything
        assert len(found) == len(expected) + 1
        del found[hit]
    assert found == expected


@pytest.mark.parametrize("kept", [1, 3, 4, 11, 12, 13, 600, 1043])
def test_a_truncated_frame_costs_only_itself_and_delays_nothing(kept: int) -> None:
    framer = Framer()
    framer.feed(POINTS[:kept])
    for frame in (IMU[0], PLANE, ACK):
        assert frames(frame, framer=framer) == [frame]


@pytest.mark.parametrize("stub", [PLANE[:1384], PLANE[:40], POINTS[:600], IMU[9][:40]])
def test_split_frames_behind_a_stub_come_as_soon_as_they_are_complete(stub: Any) -> None:
    framer = Framer()
    framer.feed(stub)
    for number in range(60):
        frame = IMU[number % 40]
        assert frames(frame[:50], framer=framer) == []
        assert frames(frame[50:], framer=framer) == [frame]
        assert framer.pending < MAX_FRAME


def test_coalesced_frames_behind_a_stub_come_at_once() -> None:
    framer = Framer()
    framer.feed(PLANE[:1384])
    assert frames(IMU[0] + IMU[1] + POINTS[:500], framer=framer) == IMU[:2]
    assert frames(POINTS[500:] + IMU[2], framer=framer) == [POINTS, IMU[2]]


def test_a_lost_fragment_costs_one_packet() -> None:
    found = frames(*FRAGMENTS[:2], IMU[0], *FRAGMENTS[3:], IMU[1], *FRAGMENTS, IMU[2])
    assert found == [IMU[0], IMU[1], PLANE, IMU[2]]


@pytest.mark.parametrize("between", [IMU[0], IMU[0] + IMU[1], POINTS])
def test_a_datagram_between_the_fragments_of_a_packet_loses_nothing(between: Any) -> None:
    for place in (1, 2, 3):
        datagrams = [*FRAGMENTS[:place], between, *FRAGMENTS[place:]]
        assert sorted(frames(*datagrams)) == sorted([*frames(between), PLANE])
        assert errors(*datagrams) == []


@pytest.mark.parametrize("head", [2, 4, 8])
def test_a_datagram_inside_a_header_loses_nothing(head: int) -> None:
    assert frames(POINTS[:head], IMU[0], POINTS[head:]) == [IMU[0], POINTS]


def test_a_damaged_datagram_between_fragments_costs_only_itself() -> None:
    damaged = IMU[0][:40] + b"\xee" + IMU[0][41:]
    assert frames(*FRAGMENTS[:2], damaged, *FRAGMENTS[2:]) == [PLANE]


@pytest.mark.parametrize("packet_type", [104, 100, 107, 2001, 4242, 0, 0xFFFF_FFFF])
@pytest.mark.parametrize("size", [0, 12, 23, 24, 10_001, 0x7FFF_FFFF, 0xFFFF_FFFF])
def test_impossible_sizes_are_dropped_at_once(packet_type: int, size: int) -> None:
    bad = header(packet_type, size)
    assert frames(bad + IMU[0]) == [IMU[0]]
    assert frames(bad, IMU[0]) == [IMU[0]]
    assert errors(bad + IMU[0]) == [FrameError(Fault.SIZE, 12)]


def test_a_known_type_must_have_its_size() -> None:
    wrong = build.frame(PacketType.POINTS_3D, b"\0" * 500)
    assert frames(wrong + IMU[0]) == [IMU[0]]
    assert errors(wrong) == [FrameError(Fault.SIZE, len(wrong))]


@pytest.mark.parametrize("size", [1, 4, 180, MAX_FRAME - wire.OVERHEAD])
@pytest.mark.parametrize("packet_type", [2001, 4242])
def test_unknown_types_and_parameters_may_have_any_size(packet_type: int, size: Any) -> None:
    frame = build.frame(packet_type, bytes(size))
    assert frames(frame) == [frame]


def test_faults_are_told_apart() -> None:
    crc = POINTS[:300] + b"\xee" + POINTS[301:]
    tail = POINTS[:-1] + b"\xfe"
    assert errors(b"garbage" + IMU[0]) == [FrameError(Fault.JUNK, 7)]
    assert errors(crc) == [FrameError(Fault.CRC, 1044)]
    assert errors(tail) == [FrameError(Fault.TAIL, 1044)]
    assert errors(tail + crc + IMU[0]) == errors(tail) + errors(crc)


def test_the_ignored_fields_of_the_tail_are_ignored() -> None:
    free = POINTS[:-8] + b"\x12\x34\x56\x78\x9a\xbc" + POINTS[-2:]
    assert frames(free) == [POINTS]


@pytest.mark.parametrize("junk", [b"\x55", b"\x55\x55", MAGIC, MAGIC[:3], MAGIC[:2] * 3])
def test_pieces_of_a_magic_before_a_frame(junk: Any) -> None:
    assert frames(junk + IMU[0] + IMU[1]) == IMU[:2]
    assert frames(IMU[0] + junk, IMU[1], IMU[2]) == IMU[:3]


@given(st.lists(st.one_of(
    st.binary(max_size=200),
    st.sampled_from([MAGIC, MAGIC[:2], IMU[0], IMU[0][:30], POINTS[:99], PLANE[:1384]]),
    st.builds(header, st.sampled_from([101, 102, 103, 104, 2001, 77]), st.integers(0, 2**32 - 1)),
    st.builds(header, st.sampled_from([101, 103, 2001, 77]), st.integers(0, 6001)),
), max_size=40))  # fmt: skip
def test_garbage_never_raises_never_grows_and_ends(pieces: Any) -> None:
    framer = Framer()
    for piece in pieces:
        before = framer.pending
        accounted = 0
        for item in framer.feed(piece):
            good = isinstance(item, Frame)
            accounted += len(item.payload) + wire.OVERHEAD if good else item.skipped
        assert framer.pending < MAX_FRAME
        assert before + len(piece) == accounted + framer.pending
    assert IMU[5] in frames(*[b"\0" * 1000] * 6, IMU[5], framer=framer)


def test_reset_forgets_the_incomplete_frame() -> None:
    framer = Framer()
    framer.feed(POINTS[:600])
    framer.reset()
    assert framer.pending == 0
    assert frames(IMU[0], framer=framer) == [IMU[0]]


def dense_magics(length: int) -> bytes:
    """Return headers of an unknown type, 12 bytes apart, each with an end mark where it claims."""
    unit = header(0xFF00_0000, 5996)
    assert (5996 - 2) % 12 == 6
    return unit * (length // 12)


def checked_bytes(monkeypatch: pytest.MonkeyPatch, pieces: list[bytes]) -> int:
    """Return how many bytes checksums are taken of, which is what hostile bytes cost."""
    total = 0

    def crc32(data: bytes) -> int:
        nonlocal total
        total += len(data)
        return zlib.crc32(data)

    with monkeypatch.context() as patch:
        patch.setattr(framing, "zlib", type("counted", (), {"crc32": staticmethod(crc32)}))
        framer = Framer()
        for piece in pieces:
            framer.feed(piece)
    return total


def test_the_cost_of_hostile_bytes_grows_with_their_number_only(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    per_byte = MAX_FRAME / wire.HEADER.size
    for length in (12_000, 24_000, 48_000):
        hostile = dense_magics(length)
        assert checked_bytes(monkeypatch, [hostile]) <= per_byte * length
        pieces = [hostile[at : at + 100] for at in range(0, length, 100)]
        assert checked_bytes(monkeypatch, pieces) <= 2 * per_byte * length


def test_the_cost_of_a_call_behind_a_stub_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    hostile = header(103, 5536) + dense_magics(5000)
    before = checked_bytes(monkeypatch, [hostile])
    for calls in (10, 100):
        cost = checked_bytes(monkeypatch, [hostile, *[b"\0"] * calls]) - before
        assert cost <= calls * 8 * MAX_FRAME


def test_looking_behind_an_incomplete_frame_is_not_repeated_for_every_magic(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looked = 0
    frame_at = framing._frame_at

    def counted(*arguments: Any) -> Any:
        nonlocal looked
        looked += 1
        return frame_at(*arguments)

    framer = Framer()
    framer.feed(header(103, 5536) + dense_magics(5000))
    monkeypatch.setattr(framing, "_frame_at", counted)
    for _ in range(100):
        framer.feed(b"\0")
    assert looked <= 100 * 10
