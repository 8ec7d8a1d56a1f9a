"""Decoded sweeps against their recorded digests: a change here changes what users get.

Explain it in the commit that writes the digests anew (``python -m tests.build``).
"""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests import build


@pytest.mark.parametrize("name", build.DIGESTED)
def test_sweeps_have_not_changed(name):
    recorded = json.loads((build.DIGESTS / f"{name}.digest.json").read_text(encoding="utf-8"))
    assert build.digests(name) == recorded


def test_every_digest_is_checked():
    assert {path.name for path in build.DIGESTS.iterdir()} == {
        f"{name}.digest.json" for name in build.DIGESTED
    }


@pytest.mark.parametrize("name", ["x", "y", "z", "intensity", "range", "time"])
def test_a_digest_notices_a_changed_field(name):
    points = build.sweeps(build.capture(0.2))[0].points.copy()
    before = build.digest(points)
    points[name][17] += 1e-7 if name == "time" else 1
    after = build.digest(points)
    assert {key for key in before if before[key] != after[key]} == {name}


def test_a_digest_does_not_depend_on_the_last_bits():
    points = build.sweeps(build.capture(0.2))[0].points.copy()
    before = build.digest(points)
    points["x"] = np.round(points["x"], 5) + 1e-6
    middle = build.digest(points)
    points["x"] += 1e-6
    assert build.digest(points) == middle
    assert before["y"] == middle["y"]
