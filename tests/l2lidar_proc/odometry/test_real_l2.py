"""Real points of an L2: the filter made for its lines, and the image its slots form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from l2lidar_node.types import POINT
from l2lidar_proc.deskew import filters
from l2lidar_proc.deskew.config import FilterConfig
from l2lidar_proc.deskew.filters import organise
from tests.support.build import SHARED_DATA

FOLDER = SHARED_DATA / "unitree_l2_static"
pytestmark = pytest.mark.skipif(not FOLDER.exists(), reason="the recordings are not here")

PACKETS = 50
SLOT, PERIOD = 4.639e-3 / 600, 4.639e-3


@pytest.fixture(scope="module")
def turn() -> tuple[np.ndarray, np.ndarray]:
    """Return a full turn as it was measured, and which slots came back."""
    returned = np.isfinite(np.load(FOLDER / "capture_001_packets.npz")["range_m"])
    skipped = int(returned[:200].sum())
    returned = returned[200 : 200 + PACKETS]
    xyz = np.load(FOLDER / "capture_001.npy")[skipped : skipped + int(returned.sum())]
    packet, slot = np.nonzero(returned)
    points = np.zeros(len(xyz), dtype=POINT)
    points["x"], points["y"], points["z"] = xyz.T
    points["range"] = np.linalg.norm(xyz, axis=1)
    points["intensity"] = 100
    times = packet * PERIOD + slot * SLOT
    points["time"] = times - times[0]
    return points, returned


def test_every_real_point_finds_its_slot(turn: tuple[np.ndarray, np.ndarray]) -> None:
    points, returned = turn
    image = organise(points, points["time"])
    assert image.shape == returned.shape
    np.testing.assert_array_equal(np.isfinite(image["x"]), returned)
    np.testing.assert_array_equal(image["x"][returned], points["x"])


def test_dust_is_found_and_the_scene_stays(turn: tuple[np.ndarray, np.ndarray]) -> None:
    points, _ = turn
    config = FilterConfig()
    kept = filters.apply(points, ["isolated"], config)
    assert len(kept) > 0.96 * len(points)
    dusty = points.copy()
    specks = np.random.default_rng(0).choice(len(points), 60, replace=False)
    specks = specks[points["range"][specks] > 1.0]
    for axis in ("x", "y", "z", "range"):
        dusty[axis][specks] *= 0.4
    kept = filters.apply(dusty, ["isolated"], config)
    assert len(np.intersect1d(kept, specks)) < 0.15 * len(specks)
    spread = filters.apply(points, ["isolated"], replace(config, isolated_neighbours=3))
    assert len(spread) < len(kept)
