"""The layout watch: tf2's rule of what can be transformed, and which displays are asked."""

import pytest
from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage

from benchmarks.bench_rviz import Outcome, TransformTimes, displays

MS = 1_000_000


def message(parent: str, child: str, stamp_ms: int = 0) -> TFMessage:
    item = TransformStamped(child_frame_id=child)
    item.header.frame_id = parent
    item.header.stamp.nanosec = stamp_ms * MS
    return TFMessage(transforms=[item])


@pytest.fixture
def times() -> TransformTimes:
    known = TransformTimes()
    known.take(message("base", "lidar"), is_static=True)
    for stamp_ms in (100, 120, 140):
        known.take(message("odom", "base", stamp_ms), is_static=False)
    return known


@pytest.mark.parametrize(
    ("stamp_ms", "problem"),
    [
        (100, ""),
        (130, ""),
        (140, ""),
        (145, "'base' is 5 ms behind"),
        (90, "'base' begins 10 ms later"),
    ],
)
def test_a_moving_joint_needs_a_transform_on_either_side(
    times: TransformTimes, stamp_ms: int, problem: str
) -> None:
    assert times.problem("odom", "lidar", stamp_ms * MS) == problem
    assert times.problem("lidar", "odom", stamp_ms * MS) == problem


def test_static_joints_hold_for_ever(times: TransformTimes) -> None:
    assert times.problem("base", "lidar", 10**18) == ""
    assert times.problem("odom", "odom", 0) == ""


def test_unconnected_frames_are_named(times: TransformTimes) -> None:
    assert times.problem("map", "lidar", 100 * MS) == "'lidar' and 'map' are not connected"


def test_what_tf2_forgets_is_forgotten(times: TransformTimes) -> None:
    later = message("odom", "base", 130)
    later.transforms[0].header.stamp.sec = 10
    times.take(later, is_static=False)
    assert times.problem("odom", "base", 120 * MS) == "'base' begins 20 ms later"


def test_messages_count_from_the_first_that_is_shown() -> None:
    outcome = Outcome()
    for problem in ("early", "", "late", ""):
        outcome.note(problem, 1.0)
    assert (outcome.before, outcome.shown, outcome.dropped) == (1, 2, 1)
    assert dict(outcome.reasons) == {"late": 1}


def test_every_layout_is_asked() -> None:
    asked = list(displays())
    assert {item.layout for item in asked} == {
        "lio_sam.rviz", "map.rviz", "rvizl2lidar.rviz", "rvizl2lidar_example.rviz", "slam.rviz",
    }  # fmt: skip
    raw = next(item for item in asked if (item.layout, item.name) == ("slam.rviz", "Raw"))
    assert (raw.topic, raw.fixed_frame, raw.kind) == ("/points", "odom", "PointCloud2")
    assert (raw.depth, raw.is_reliable) == (5, False)
