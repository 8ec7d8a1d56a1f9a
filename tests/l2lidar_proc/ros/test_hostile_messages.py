"""No message and no service call ends a node of the companion or leaves it stuck."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from geometry_msgs.msg import TransformStamped  # noqa: E402  after importorskip
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import Imu, PointCloud2  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

from l2lidar_node.ros.conversions import point_fields, to_cloud  # noqa: E402
from l2lidar_node.types import HostNs  # noqa: E402
from l2lidar_proc.ros import deskew_node, inputs, odometry_node  # noqa: E402
from tests.l2lidar_proc.motion.analytic import Motion, at, seen  # noqa: E402
from tests.l2lidar_proc.odometry.odometry_world import recording  # noqa: E402
from tests.l2lidar_proc.ros.bench import FRAME, IMU_FRAME  # noqa: E402
from tests.l2lidar_proc.ros.test_deskew_node import DeskewBench  # noqa: E402
from tests.l2lidar_proc.ros.test_odometry_node import OdometryBench  # noqa: E402
from tests.support.odometry_runs import sweeps  # noqa: E402

pytestmark = pytest.mark.ros

WALK = Motion(turn=1.0, nod=0.1, speed=1.0)


@pytest.fixture(autouse=True)
def _no_error_is_unforeseen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let errors through that a node would survive but nobody foresaw."""

    def failed(self: Any, error: Any) -> None:
        raise error

    monkeypatch.setattr(inputs.InputMonitor, "failed", failed)


@pytest.fixture(scope="module", params=[DeskewBench, OdometryBench], ids=["deskew", "odometry"])
def bench(request: pytest.FixtureRequest) -> Iterator[Any]:
    """One node lives through all of it, and works at the end.

    Its diagnostics come ten times a second, so that nobody waits for them.
    """
    with pytest.MonkeyPatch.context() as patch:
        for module in (deskew_node, odometry_node):
            patch.setattr(
                module,
                "steady_timer",
                lambda node, period_s, callback: inputs.steady_timer(
                    node, period_s / 10.0, callback
                ),
            )
        made = request.param()
    yield made
    made.close()


def wait_for_text(bench: Any, text: str) -> None:
    """Wait until the diagnostics say so; the next ones come within a second."""
    bench.diagnostics.clear()
    bench.until(lambda: any(text in status.message for status in bench.diagnostics))


def wait_for_value(bench: Any, text: str) -> None:
    """Wait until a figure of the diagnostics is called so."""
    bench.diagnostics.clear()
    bench.until(lambda: any(text in v.key for s in bench.diagnostics for v in s.values))


def works(bench: Any) -> None:
    """Give the node good data and wait for what it makes of them."""
    run = recording("room", "walk")
    if isinstance(bench, OdometryBench):
        some = list(sweeps(run, "turn"))[:10]
        bench.poses.clear()
        bench.send(run, some)
        bench.until(lambda: len(bench.poses) == len(some))
        return
    bench.clouds.clear()
    bench.send_imu(WALK.imu(100.0, 100.4))
    for start in (100.0, 100.15):
        bench.send_cloud(seen(WALK, start, start + 0.15, start)[0], at(start))
    bench.until(lambda: len(bench.clouds) == 2)


def cloud_with(names: list[str], kind: str = "<f4", stamp: int | None = None) -> PointCloud2:
    """Return a cloud with just these fields, times ascending over 0.2 s."""
    points = np.zeros(100, dtype=[(name, kind) for name in names])
    for name in names:
        points[name] = np.arange(100) * (0.002 if name == "time" else 1)
    whole = np.zeros(100, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    message = to_cloud(whole, at(0.0) if stamp is None else HostNs(stamp), FRAME)
    message.fields = point_fields(points.dtype)
    message.point_step = points.dtype.itemsize
    message.row_step = message.point_step * message.width
    message.data = points.tobytes()
    return message


@pytest.mark.parametrize(
    ("names", "kind", "told"),
    [
        (["range", "azimuth", "time"], "<f4", "field 'x' is missing"),
        (["x", "z", "time"], "<f4", "field 'y' is missing"),
        (["x", "y", "time"], "<f4", "field 'z' is missing"),
        (["x", "y", "z", "time"], "<i4", "field 'x' is int32"),
        (["intensity"], "<f4", "field 'x' is missing"),
    ],
)
def test_clouds_without_positions_are_named(bench: Any, names: Any, kind: str, told: str) -> None:
    bench.clouds_out.publish(cloud_with(names, kind))
    wait_for_value(bench, told)


def transform(
    child: str, parent: str, q: Any = (0.0, 0.0, 0.0, 1.0), p: Any = (0.0, 0.0, 0.0)
) -> Any:
    item = TransformStamped(child_frame_id=child)
    item.header.frame_id = parent
    rotation, place = item.transform.rotation, item.transform.translation
    rotation.x, rotation.y, rotation.z, rotation.w = q
    place.x, place.y, place.z = p
    return item


@pytest.mark.parametrize(
    ("q", "p", "told"),
    [
        ((math.nan, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), "not finite"),
        ((0.0, 0.0, 0.0, 1.0), (0.0, math.inf, 0.0), "not finite"),
        ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), "the norm 0"),
        ((0.0, 0.0, 0.0, 1e200), (0.0, 0.0, 0.0), "the norm 1e+200"),
        ((0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1e30), "1e+30 m long"),
    ],
)
def test_a_mount_that_cannot_be_is_refused_and_named(
    bench: Any, q: Any, p: Any, told: str
) -> None:
    bench.until(bench.tf_out.get_subscription_count)
    good = transform("else", "where", p=(1.0, 0.0, 0.0))
    bad = transform(IMU_FRAME, FRAME, q, p)
    bench.tf_out.publish(TFMessage(transforms=[good, bad]))
    wait_for_text(bench, told)
    assert bench.node._frames.find("where", "else") is not None


def test_mounts_in_a_circle_have_an_end(bench: Any) -> None:
    bench.until(bench.tf_out.get_subscription_count)
    loop = [transform("a", "b"), transform("b", "c"), transform("c", "a"), transform("a", "a")]
    bench.tf_out.publish(TFMessage(transforms=loop))
    wait_for_text(bench, "its own parent")
    assert bench.node._frames.find("a", "nowhere") is None


def test_clouds_of_90_seconds_are_refused_and_named(bench: Any) -> None:
    points = seen(WALK, 0.0, 90.0, 0.0)[0]
    for number in range(7):
        bench.send_cloud(points, at(90.0 * number))
    wait_for_value(bench, "s is too long; up to 25 s")


def test_clouds_of_another_frame_are_refused_while_the_first_come(bench: Any) -> None:
    points = seen(WALK, 0.0, 0.2, 0.0)[0]
    for number in range(5):
        bench.send_cloud(points, at(number))
        bench.clouds_out.publish(to_cloud(points, at(number), "rear"))
    wait_for_text(bench, "clouds in 'rear' refused while those in 'l2lidar_link' arrive")
    assert bench.node._cloud_frame == FRAME


def test_a_second_publisher_is_named(bench: Any) -> None:
    second = bench.peer.create_publisher(PointCloud2, "/points", 10)
    wait_for_text(bench, "2 publishers on /points: /peer, /peer")
    bench.peer.destroy_publisher(second)


def test_stamps_that_go_back_are_named(bench: Any) -> None:
    points = seen(WALK, 0.0, 0.2, 0.0)[0]
    for start in (50.0, 50.127):  # later than those of the other tests
        bench.send_cloud(points, at(start))
    wait_for_text(bench, "stamps go back by up to 73 ms between clouds (1 times)")


@pytest.mark.parametrize(("seconds", "nanoseconds"), [(2**31 - 1, 999_999_999), (-(2**31), 0)])
def test_a_stamp_at_the_end_of_time_is_refused(bench: Any, seconds: Any, nanoseconds: int) -> None:
    message = to_cloud(seen(WALK, 0.0, 0.2, 0.0)[0], HostNs(0), FRAME)
    message.header.stamp.sec, message.header.stamp.nanosec = seconds, nanoseconds
    if seconds < 0:  # and one just before it
        message.header.stamp.nanosec = 0
        points = seen(WALK, 0.0, 0.2, 0.0)[0]
        points["time"] -= 1.0
        message = to_cloud(points, HostNs(0), FRAME)
        message.header.stamp.sec = seconds
    bench.clouds_out.publish(message)
    wait_for_value(bench, "its time is out of range")


@pytest.mark.parametrize("nanoseconds", [2**32 - 1])
def test_a_sample_at_the_end_of_time_is_refused(bench: Any, nanoseconds: Any) -> None:
    message = Imu()
    message.header.frame_id = IMU_FRAME
    message.header.stamp.sec, message.header.stamp.nanosec = 2**31 - 1, nanoseconds
    bench.imu_out.publish(message)
    wait_for_value(bench, "IMU sample with a stamp that is out of range")


def test_a_flat_and_a_half_cloud_are_named(bench: Any) -> None:
    flat = seen(WALK, 0.0, 0.2, 0.0)[0]
    flat["z"] = 0.0
    bench.send_cloud(flat, at(0.0))
    wait_for_text(bench, "lie in one plane, as those of a LaserScan")
    half = seen(WALK, 1.0, 1.2, 1.0)[0]
    half["y"] = np.abs(half["x"]) + np.abs(half["y"])
    bench.send_cloud(half, at(1.0))
    wait_for_text(bench, "of 360 degrees of azimuth")


def test_simulated_time_that_nobody_publishes_is_named_and_nothing_waits_for_it(
    bench: Any,
) -> None:
    bench.node.set_parameters([Parameter("use_sim_time", value=True)])
    try:
        wait_for_text(bench, "use_sim_time is on, but there is no publisher of /clock")
        if isinstance(bench, DeskewBench):
            bench.clouds.clear()
            bench.send_cloud(seen(WALK, 0.0, 0.2, 0.0)[0], at(0.0))  # no IMU: the wait must end
            bench.until(lambda: bench.clouds)
    finally:
        bench.node.set_parameters([Parameter("use_sim_time", value=False)])


def test_stamps_far_from_the_nodes_clock_are_named(bench: Any) -> None:
    bench.send_cloud(seen(WALK, 0.0, 0.2, 0.0)[0], at(0.0))
    wait_for_text(bench, "s behind the node's clock; with a recording set use_sim_time")


def test_reasons_have_an_end(bench: Any) -> None:
    monitor = inputs.InputMonitor(bench.node, ())
    for number in range(1000):
        monitor.refuse(f"field '{number}'")
    assert len(monitor.refused) == 21
    assert monitor.refused.total() == 1000


def test_what_is_read_at_the_start_stays(bench: Any) -> None:
    if isinstance(bench, DeskewBench):
        changes = {"cloud_topic": "/other", "use_tf": False}
    else:
        changes = {"data_dir": "/etc", "overwrite": True, "cloud_topic": "/other"}
    for name, value in changes.items():
        before = bench.node.get_parameter(name).value
        (result,) = bench.node.set_parameters([Parameter(name, value=value)])
        assert not result.successful
        assert bench.node.get_parameter(name).value == before
        assert bench.node.describe_parameter(name).read_only


def test_after_all_that_good_data_come_through(bench: Any) -> None:
    works(bench)
