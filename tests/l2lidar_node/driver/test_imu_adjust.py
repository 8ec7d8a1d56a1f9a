"""Points turned level by the sensor's own orientation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2lidar_node.driver.geometry import PointBatch, Projector
from l2lidar_node.driver.orientation import MAX_AGE_NS, GravityAlignment
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.types import HostNs, ImuSample
from tests.support import build

START = build.EPOCH_NS
PERIOD = build.PERIOD_NS


def measure(
    level: GravityAlignment | None,
    packets: int = 3,
    times_ns: list[int] | None = None,
    **fields: Any,
) -> PointBatch:
    """Return the points of some packets, levelled or as the sensor sees them."""
    starts = times_ns or [START + n * PERIOD for n in range(packets)]
    payloads = [build.points_3d(theta=n * 0.127, **fields) for n in range(len(starts))]
    return Projector(PacketType.POINTS_3D).points(
        payloads,
        (np.array(starts) - START) / 1e9,
        rotations=None if level is None else level([HostNs(start) for start in starts]),
    )


def sample(stamp: int, rotation: Rotation) -> ImuSample:
    x, y, z, w = rotation.as_quat()
    return ImuSample(HostNs(stamp), (w, x, y, z), (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))


def gravity_alignment(*samples: ImuSample, roll_pitch_only: bool = False) -> GravityAlignment:
    result = GravityAlignment(roll_pitch_only)
    for item in samples:
        result.add([item])
    return result


def xyz(points: Any) -> np.ndarray:
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
def test_points_are_turned_from_the_sensor_into_the_world(orientation: Any) -> None:
    points = measure(None).points
    level = gravity_alignment(*(sample(START + n * PERIOD, orientation) for n in range(3)))
    turned = measure(level).points
    np.testing.assert_allclose(xyz(turned), orientation.apply(xyz(points)), atol=1e-6)
    for name in ("intensity", "range", "time"):
        np.testing.assert_array_equal(turned[name], points[name])


@pytest.mark.parametrize("yaw", [-170, -20, 0, 90])
@pytest.mark.parametrize(("pitch", "roll"), [(0, 0), (30, 0), (0, -40), (25, 170), (-60, 15)])
def test_without_the_yaw_only_roll_and_pitch_are_left(yaw: int, pitch: int, roll: int) -> None:
    orientation = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True)
    level = gravity_alignment(sample(START, orientation), roll_pitch_only=True)
    expected = Rotation.from_euler("ZYX", [0, pitch, roll], degrees=True)
    np.testing.assert_allclose(
        xyz(measure(level).points), expected.apply(xyz(measure(None).points)), atol=1e-6
    )


@pytest.mark.parametrize("only", [False, True])
def test_what_is_straight_up_in_the_world_is_on_the_z_axis(only: bool) -> None:
    orientation = Rotation.from_euler("ZYX", [40, 25, -30], degrees=True)
    up_in_sensor = orientation.inv().apply([0.0, 0.0, 1.0])
    (rotation,) = gravity_alignment(sample(START, orientation), roll_pitch_only=only)(
        [HostNs(START)]
    )
    np.testing.assert_allclose(rotation @ up_in_sensor, [0, 0, 1], atol=1e-12)


def test_every_packet_has_its_own_orientation() -> None:
    turns = [Rotation.from_euler("z", angle, degrees=True) for angle in (0, 20, 40)]
    level = gravity_alignment(
        *(sample(START + n * PERIOD + 100, turn) for n, turn in enumerate(turns))
    )
    points, turned = xyz(measure(None).points), xyz(measure(level).points)
    for index, turn in enumerate(turns):
        part = slice(300 * index, 300 * (index + 1))
        np.testing.assert_allclose(turned[part], turn.apply(points[part]), atol=1e-6)


@pytest.mark.parametrize("offset", [-2_900_000, -500_000, 900_000, 2_900_000, 3_100_000])
def test_the_nearest_orientation_is_used(offset: int) -> None:
    tilted = Rotation.from_euler("x", 30, degrees=True)
    others = {-3_000_000: Rotation.identity(), 1_000_000: tilted, 5_000_000: Rotation.identity()}
    level = gravity_alignment(*(sample(START + at, turn) for at, turn in others.items()))
    (rotation,) = level([HostNs(START + offset)])
    nearest = min(others, key=lambda at: abs(at - offset))
    np.testing.assert_allclose(rotation, others[nearest].as_matrix(), atol=1e-12)


def test_without_imu_there_is_nothing_to_turn_by() -> None:
    batch = measure(gravity_alignment(), 2)
    assert len(batch.points) == 0
    assert batch.counts.tolist() == [0, 0]
    assert batch.left_out == 600


@pytest.mark.parametrize(("age", "kept"), [(MAX_AGE_NS, True), (MAX_AGE_NS + 1, False)])
@pytest.mark.parametrize("sign", [-1, 1])
def test_an_orientation_may_be_so_old_and_no_older(age: Any, sign: int, kept: bool) -> None:
    level = gravity_alignment(sample(START + sign * age, Rotation.identity()))
    assert (len(measure(level, 1).points) == 300) is kept


def test_packets_without_orientation_are_left_out_and_times_begin_at_the_first_kept() -> None:
    level = gravity_alignment(sample(START + 185_000_000, Rotation.identity()))
    times = [START, START + 100_000_000, START + 200_000_000]
    batch = measure(level, times_ns=times, ranges=[2000, 0] * 150)
    assert batch.counts.tolist() == [0, 0, 150]
    assert batch.first_s == pytest.approx(0.2)
    assert batch.points["time"][0] == 0
    unturned = measure(None, times_ns=times, ranges=[2000, 0] * 150).points
    np.testing.assert_array_equal(batch.points["x"], unturned["x"][300:])
    assert batch.left_out == 300


def test_old_samples_are_forgotten_and_clear_forgets_all() -> None:
    level = gravity_alignment(
        *(sample(START - n * 4_000_000, Rotation.identity()) for n in range(100, 0, -1))
    )
    level([HostNs(START)])
    assert len(level) == MAX_AGE_NS // 4_000_000
    level.clear()
    assert np.isnan(level([HostNs(START)])).all()


def test_memory_is_bounded_while_nobody_asks() -> None:
    level = GravityAlignment(False)
    item = sample(START, Rotation.identity())
    for number in range(40_000):
        level.add([item._replace(stamp=HostNs(START + number * 4_000_000))])
        assert len(level) < 20_000
    longest_sweep = [HostNs(START + (40_000 - ago * 250) * 4_000_000) for ago in (20, 10, 1)]
    np.testing.assert_array_equal(level(longest_sweep), [np.eye(3)] * 3)
