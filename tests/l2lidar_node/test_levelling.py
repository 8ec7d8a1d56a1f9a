"""Points turned level by the sensor's own orientation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2lidar_node.geometry import PointBatch, Projector
from l2lidar_node.levelling import MAX_AGE_NS, Levelling
from l2lidar_node.types import HostNs, ImuSample
from l2lidar_node.wire import PacketType
from tests import build

START = build.EPOCH_NS
PERIOD = build.PERIOD_NS


def batch(packets: int = 3, **fields) -> tuple[PointBatch, list[HostNs]]:
    starts = [HostNs(START + n * PERIOD) for n in range(packets)]
    payloads = [build.points_3d(theta=n * 0.127, **fields) for n in range(packets)]
    seconds = (np.array(starts) - START) / 1e9
    return Projector(PacketType.POINTS_3D).points(payloads, seconds), starts


def sample(stamp: int, rotation: Rotation) -> ImuSample:
    x, y, z, w = rotation.as_quat()
    return ImuSample(HostNs(stamp), (w, x, y, z), (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))


def levelling(*samples: ImuSample, roll_pitch_only: bool = False) -> Levelling:
    result = Levelling(roll_pitch_only)
    for item in samples:
        result.add(item)
    return result


def xyz(points) -> np.ndarray:
    return np.stack([points["x"], points["y"], points["z"]], axis=1).astype(np.float64)


ORIENTATIONS = [
    Rotation.identity(),
    Rotation.from_euler("x", 30, degrees=True),
    Rotation.from_euler("y", -50, degrees=True),
    Rotation.from_euler("z", 140, degrees=True),
    Rotation.from_euler("ZYX", [70, 20, -35], degrees=True),
    Rotation.from_euler("x", 180, degrees=True),
]


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_points_are_turned_from_the_sensor_into_the_world(orientation):
    points, starts = batch()
    level = levelling(*(sample(start, orientation) for start in starts))
    turned = level(points, starts)
    np.testing.assert_allclose(
        xyz(turned.points), orientation.apply(xyz(points.points)), atol=2e-6
    )
    for name in ("intensity", "range", "time"):
        np.testing.assert_array_equal(turned.points[name], points.points[name])


@pytest.mark.parametrize("yaw", [-170, -20, 0, 90])
@pytest.mark.parametrize(("pitch", "roll"), [(0, 0), (30, 0), (0, -40), (25, 170), (-60, 15)])
def test_without_the_yaw_only_roll_and_pitch_are_left(yaw, pitch, roll):
    points, starts = batch()
    orientation = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True)
    level = levelling(*(sample(start, orientation) for start in starts), roll_pitch_only=True)
    expected = Rotation.from_euler("ZYX", [0, pitch, roll], degrees=True).apply(xyz(points.points))
    np.testing.assert_allclose(xyz(level(points, starts).points), expected, atol=2e-6)


@pytest.mark.parametrize("only", [False, True])
def test_a_floor_seen_by_a_tilted_sensor_is_level_afterwards(only):
    """What is straight up in the world is on the z axis, however the sensor is tilted."""
    orientation = Rotation.from_euler("ZYX", [40, 25, -30], degrees=True)
    up_in_sensor = orientation.inv().apply([0.0, 0.0, 1.0])
    points, starts = batch(1)
    points.points["x"], points.points["y"], points.points["z"] = up_in_sensor * 5
    turned = levelling(sample(START, orientation), roll_pitch_only=only)(points, starts)
    np.testing.assert_allclose(xyz(turned.points), [[0, 0, 5]] * 300, atol=1e-5)


def test_every_packet_has_its_own_orientation():
    points, starts = batch(3)
    turns = [Rotation.from_euler("z", angle, degrees=True) for angle in (0, 20, 40)]
    level = levelling(*(sample(s + 100, t) for s, t in zip(starts, turns, strict=True)))
    turned = xyz(level(points, starts).points)
    for index, turn in enumerate(turns):
        part = slice(300 * index, 300 * (index + 1))
        np.testing.assert_allclose(turned[part], turn.apply(xyz(points.points)[part]), atol=2e-6)


def test_the_nearest_orientation_is_used():
    points, starts = batch(1)
    tilted = Rotation.from_euler("x", 30, degrees=True)
    level = levelling(
        sample(START - 3_000_000, Rotation.identity()),
        sample(START + 1_000_000, tilted),
        sample(START + 5_000_000, Rotation.identity()),
    )
    turned = xyz(level(points, starts).points)
    np.testing.assert_allclose(turned, tilted.apply(xyz(points.points)), atol=2e-6)


def test_without_imu_there_is_nothing_to_turn_by():
    points, starts = batch(2)
    level = levelling()
    result = level(points, starts)
    assert len(result.points) == 0
    assert result.counts.tolist() == [0, 0]
    assert level.dropped == 600


@pytest.mark.parametrize(("age", "kept"), [(MAX_AGE_NS, True), (MAX_AGE_NS + 1, False)])
@pytest.mark.parametrize("sign", [-1, 1])
def test_an_orientation_may_be_so_old_and_no_older(age, sign, kept):
    points, starts = batch(1)
    level = levelling(sample(START + sign * age, Rotation.identity()))
    assert (len(level(points, starts).points) == 300) is kept


def test_packets_without_orientation_are_left_out_and_times_begin_at_the_first_kept():
    starts = [HostNs(START), HostNs(START + 100_000_000), HostNs(START + 200_000_000)]
    payloads = [build.points_3d(ranges=2000 + 100 * n) for n in range(3)]
    projector = Projector(PacketType.POINTS_3D)
    points = projector.points(payloads, np.array([0.0, 0.1, 0.2]))
    level = levelling(sample(START + 185_000_000, Rotation.identity()))
    result = level(points, starts)
    assert result.counts.tolist() == [0, 0, 300]
    assert result.first_s == pytest.approx(0.2)
    assert result.points["time"][0] == 0
    np.testing.assert_array_equal(result.points["x"], points.points["x"][600:])
    assert level.dropped == 600


def test_the_batch_itself_is_left_alone():
    points, starts = batch()
    before = points.points.copy()
    levelling(sample(START, ORIENTATIONS[4]))(points, starts)
    np.testing.assert_array_equal(points.points, before)


def test_old_samples_are_forgotten_and_clear_forgets_all():
    points, starts = batch(1)
    level = levelling(
        *(sample(START - n * 4_000_000, Rotation.identity()) for n in range(100, 0, -1))
    )
    level(points, starts)
    assert len(level._samples) == MAX_AGE_NS // 4_000_000
    level.clear()
    assert len(level(points, starts).points) == 0


def test_memory_is_bounded_while_nobody_asks():
    level = Levelling(False)
    item = sample(START, Rotation.identity())
    for _ in range(20_000):
        level.add(item)
    assert len(level._samples) < 10_000
