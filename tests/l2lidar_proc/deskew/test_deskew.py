"""Deskewed points against where a sensor standing still would have seen them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from l2lidar_node import rotations
from l2lidar_proc.deskew.deskew import deskew
from l2lidar_proc.motion.sweep_motion import still_trajectory
from tests.l2lidar_proc.motion.analytic import Motion, at, rms, seen, xyz
from tests.l2lidar_proc.motion.test_sweep_trajectory import trajectory

START, END = 0.3, 0.53


def path_of(motion: Motion) -> Any:
    return trajectory(motion, START, END, START)


@pytest.mark.parametrize("reference", [START, (START + END) / 2, END])
@pytest.mark.parametrize(
    ("motion", "bound"),
    [
        (Motion(turn=1.0, nod=0.1, speed=1.0), 0.0005),
        (Motion(turn=3.0), 0.0001),
        (Motion(turn=20.0), 0.001),
        (Motion(speed=2.0), 0.0005),
    ],
)
def test_points_go_where_a_still_sensor_would_have_seen_them(
    motion: Any, bound: float, reference: Any
) -> None:
    points, truth = seen(motion, START, END, reference)
    deskewed = deskew(points, at(START), path_of(motion), at(reference))
    assert rms(xyz(points) - truth) > 100 * bound
    assert rms(xyz(deskewed) - truth) < bound
    for name in ("intensity", "range", "time"):
        assert (deskewed[name] == points[name]).all()


def test_the_batch_equals_the_loop() -> None:
    motion = Motion(turn=3.0, nod=0.3, speed=1.5)
    points, _ = seen(motion, START, END, START, count=500)
    path = path_of(motion)
    stamps = at(START) + np.round(points["time"].astype(np.float64) * 1e9).astype(np.int64)
    expected = []
    for point, stamp in zip(points, stamps, strict=True):
        q, p = path.pose(stamp)
        expected.append(rotations.rotate(q, [point["x"], point["y"], point["z"]]) + p)
    np.testing.assert_allclose(
        xyz(deskew(points, at(START), path, at(START))), expected, atol=2e-5
    )


def test_the_points_at_the_reference_stay() -> None:
    motion = Motion(turn=3.0, speed=1.0)
    points, _ = seen(motion, START, END, START)
    deskewed = deskew(points, at(START), path_of(motion), at(START))
    assert deskewed[0] == points[0]


def test_a_still_sensor_changes_no_bit() -> None:
    points, _ = seen(Motion(), START, END, START)
    points["x"][:3] = (-0.0, 0.0, np.float32(1e-40))
    still = still_trajectory(at(START), at(END))
    assert deskew(points, at(START), still, at(END)).tobytes() == points.tobytes()


def test_the_input_is_left_alone_and_nothing_is_enough() -> None:
    motion = Motion(turn=3.0)
    points, _ = seen(motion, START, END, START)
    before = points.tobytes()
    points.flags.writeable = False
    deskew(points, at(START), path_of(motion), at(END))
    assert points.tobytes() == before
    assert len(deskew(points[:0], at(START), path_of(motion), at(END))) == 0
    assert len(deskew(points[:1], at(START), path_of(motion), at(END))) == 1
