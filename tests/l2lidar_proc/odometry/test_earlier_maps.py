"""Earlier maps: how a state is carried into another frame, and how many maps are kept."""

from __future__ import annotations

import numpy as np

from l2lidar_node import rotations
from l2lidar_node.types import HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import ERRORS, POSITION, ROTATION, InertialState, with_loose_pose
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.earlier_maps import EarlierMaps, moved
from l2lidar_proc.odometry.matcher import SweepMatcher
from l2lidar_proc.odometry.uncertainty import FrameJump

RNG = np.random.default_rng(3)
STATE = InertialState(
    HostNs(0), rotations.matrices(rotations.exp((0.3, -0.2, 1.0))), *RNG.normal(size=(5, 3))
)


def test_in_another_frame_the_sensor_feels_and_sees_the_same() -> None:
    transform = np.eye(4)
    transform[:3, :3] = rotations.matrices(rotations.exp((0.1, 0.2, -2.0)))
    transform[:3, 3] = [3.0, -1.0, 0.5]
    there = moved(STATE, transform)
    np.testing.assert_allclose(there.rest_force, STATE.rest_force)
    body = STATE.rotation.T @ STATE.velocity
    np.testing.assert_allclose(there.rotation.T @ there.velocity, body)
    point = np.array([1.0, 2.0, 3.0])
    seen = transform @ [*(STATE.rotation @ point + STATE.position), 1.0]
    np.testing.assert_allclose(there.rotation @ point + there.position, seen[:3])


def test_a_loose_pose_is_uncertain_by_what_is_added_about_the_axes_of_the_map() -> None:
    root = RNG.normal(size=(ERRORS, ERRORS))
    before = root @ root.T
    more = np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    after = with_loose_pose(STATE, before, more)
    turn = STATE.rotation @ (after - before)[ROTATION, ROTATION] @ STATE.rotation.T
    np.testing.assert_allclose(turn, more[3:, 3:], atol=1e-12)
    np.testing.assert_allclose((after - before)[POSITION, POSITION], more[:3, :3], atol=1e-12)
    np.testing.assert_array_equal(after[6:, 6:], before[6:, 6:])
    assert not after[:6, 6:].any()


def test_a_few_maps_are_kept_and_the_smallest_go() -> None:
    maps = EarlierMaps()
    kept = []
    for count in (30, 10, 20):
        matcher = SweepMatcher(OdometryConfig(), np.zeros(3))
        matcher.surfaces.add(RNG.uniform(-9.0, 9.0, (count, 3)))
        maps.keep(matcher, FrameJump(), HostNs(5))
        kept.append(matcher)
    assert len(maps) == tuning.EARLIER_MAPS
    assert not maps.is_due(HostNs(5))
    assert maps.is_due(HostNs(5 + tuning.EARLIER_PAUSE_NS))
    assert [item.matcher for item in maps] == [kept[0], kept[2]]
