"""Points find their packet and slot again by their times."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_node.types import POINT
from l2lidar_proc.deskew import filters
from l2lidar_proc.deskew.config import FilterConfig
from l2lidar_proc.deskew.filters import SLOTS, organise, slot_time

SLOT, PERIOD = 7.7316e-6, 4.63895e-3


def sweep(returned: np.ndarray, jitter: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points of packets x slots that returned, with x the packet and y the slot."""
    rng = np.random.default_rng(2)
    packet, slot = np.nonzero(returned)
    starts = np.arange(len(returned)) * PERIOD + rng.normal(0, jitter, len(returned))
    points = np.zeros(len(packet), dtype=POINT)
    times = starts[packet] + slot * SLOT
    points["time"] = times - times[0]
    points["x"], points["y"] = packet, slot
    return points, packet, slot


@pytest.mark.parametrize("share", [1.0, 0.66, 0.2])
def test_every_point_gets_its_place(share: float) -> None:
    returned = np.random.default_rng(1).random((50, SLOTS)) < share
    returned[7] = False  # a lost packet
    returned[3, 0] = True
    points, packet, slot = sweep(returned)
    image = organise(points, points["time"])
    assert image.shape == (50, SLOTS)
    assert (image["x"][packet, slot] == packet).all()
    assert (image["y"][packet, slot] == slot).all()
    assert np.isnan(image["x"][~returned]).all()
    assert np.isfinite(image["x"]).sum() == returned.sum()


def test_small_jitter_of_the_stamps_moves_a_row_by_a_slot_at_most() -> None:
    returned = np.ones((50, SLOTS), dtype=bool)
    points, *_ = sweep(returned, jitter=1e-6)
    image = organise(points, points["time"])
    assert image.shape == (50, SLOTS)
    shift = image["y"] - np.arange(SLOTS)
    assert np.nanmax(np.abs(shift)) <= 2


def test_first_slots_missing_in_one_packet_stay_empty() -> None:
    returned = np.ones((5, SLOTS), dtype=bool)
    returned[2, :40] = False
    points, *_ = sweep(returned)
    image = organise(points, points["time"])
    assert np.isnan(image["x"][2, :40]).all()
    assert image["y"][2, 40] == 40


def test_few_points_and_other_fields() -> None:
    for count in (0, 1, 2):
        points = np.zeros(count, dtype=[("x", "f4"), ("ring", "u2")])
        image = organise(points, np.arange(count, dtype=np.float32) * np.float32(SLOT))
        assert image.shape == (min(count, 1), SLOTS)
        assert np.isfinite(image["x"]).sum() == count
        assert not image["ring"].any()


@pytest.mark.parametrize("slots", [[0, 1, 12], [0, 1, 13], [0, 1, 2, *range(10, 90, 10)]])
def test_a_nearly_empty_cloud_has_a_slot_time_and_places(slots: list[int]) -> None:
    """Between a step of one slot and one of many lies no step."""
    returned = np.zeros((1, SLOTS), dtype=bool)
    returned[0, slots] = True
    points, packet, slot = sweep(returned)
    assert slot_time(points["time"]) == pytest.approx(SLOT, rel=1e-3)
    image = organise(points, points["time"])
    assert (image["y"][packet, slot] == slot).all()
    assert np.isfinite(image["x"]).sum() == len(slots)
    points["x"], points["y"] = 5.0, 0.0
    kept = filters.apply(points, ["isolated"], FilterConfig(isolated_neighbours=1))
    assert {0, 1} <= set(kept.tolist())
