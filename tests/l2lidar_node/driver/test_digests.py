"""Decoded sweeps against their recorded digests: a change here changes what users get.

Explain it in the commit that writes the digests anew (``python -m tests.support.build``).
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from l2lidar_node.protocol import wire
from tests.support import build


@pytest.mark.parametrize("name", build.DIGESTED)
def test_sweeps_have_not_changed(name: Any) -> None:
    recorded = json.loads((build.DIGESTS / f"{name}.digest.json").read_text(encoding="utf-8"))
    changed = build.differences(recorded, build.digests(name))
    # Where only bits have changed no length did by 10 um and no time by 10 ns.
    assert changed == []


def test_every_digest_is_checked() -> None:
    assert {path.name for path in build.DIGESTS.iterdir()} == {
        f"{name}.digest.json" for name in build.DIGESTED
    }


@pytest.mark.parametrize("name", ["x", "y", "z", "intensity", "range", "time"])
def test_a_change_of_one_bit_is_seen_and_named_by_its_field(name: str) -> None:
    whole = build.sweeps(build.capture(0.5))
    before = [build.digest(sweep.points) for sweep in whole]
    points = whole[1].points.copy()
    points[name].view("<u4")[17] ^= 1
    after = [before[0], build.digest(points), *before[2:]]
    assert build.differences(before, after) in (
        [f"sweep 1: {name}: bits"],
        [f"sweep 1: {name}", f"sweep 1: {name}: bits"],  # where the bit is the last straw
    )


@pytest.mark.parametrize(
    ("at", "bit", "fields"),
    [
        ("ranges", 0, {"x", "y", "z", "range"}),
        ("intensities", 0, {"intensity"}),
        ("time_increment", 8, {"time"}),
    ],
)
def test_a_change_of_one_bit_of_a_packet_is_seen_and_named(at: str, bit: int, fields: Any) -> None:
    datagrams = list(build.capture(0.5))
    before = [build.digest(sweep.points) for sweep in build.sweeps(datagrams)]
    number = next(i for i, item in enumerate(datagrams) if len(item.data) > 1000)
    payload = bytearray(datagrams[number].data[wire.HEADER.size : -wire.TAIL.size])
    offset = int(dict(wire.POINTS_3D_PAYLOAD.fields or {})[at][1])
    payload[offset + bit // 8] ^= 1 << bit % 8
    data = build.frame(wire.PacketType.POINTS_3D, bytes(payload))
    datagrams[number] = datagrams[number]._replace(data=data)
    after = [build.digest(sweep.points) for sweep in build.sweeps(datagrams)]
    named = {line.removeprefix("sweep 0: ").partition(":")[0] for line in
             build.differences(before, after)}  # fmt: skip
    assert named == fields


def test_a_rounded_digest_does_not_depend_on_the_last_bits() -> None:
    points = build.sweeps(build.capture(0.2))[0].points.copy()
    before = build.digest(points)
    points["x"] = np.round(points["x"], 5) + 1e-6
    middle = build.digest(points)
    points["x"] += 1e-6
    assert build.differences([middle], [build.digest(points)]) == ["sweep 0: x: bits"]
    assert before["y"] == middle["y"]


def test_a_sweep_more_or_less_is_seen() -> None:
    whole = build.digests("unit_a_by_packets")
    assert build.differences(whole, whole[:-1]) == [
        f"{len(whole)} sweeps are {len(whole) - 1} now"
    ]
