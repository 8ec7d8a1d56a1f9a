"""The node over real topics: clouds out, mounts from TF, faults told."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402  after importorskip
from geometry_msgs.msg import TransformStamped, TwistStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402
from sensor_msgs.msg import LaserScan, PointCloud2  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

from l2lidar_node.ros.conversions import from_cloud, from_time, to_time  # noqa: E402
from l2lidar_node.settings import SettingError  # noqa: E402
from l2lidar_proc.ros import deskew_node  # noqa: E402
from l2lidar_proc.ros.deskew_node import DeskewNode  # noqa: E402
from tests.l2lidar_proc.motion.analytic import Motion, at, rms, seen, xyz  # noqa: E402
from tests.l2lidar_proc.ros.bench import FRAME, IMU_FRAME, Bench  # noqa: E402

pytestmark = pytest.mark.ros

WALK = Motion(turn=1.0, nod=0.1, speed=1.0)


class DeskewBench(Bench):
    """A deskew node on the bench."""

    def __init__(self, *overrides: str) -> None:
        super().__init__(DeskewNode, overrides)
        self.clouds: list[PointCloud2] = []
        self.statistics: list[DiagnosticStatus] = []
        self.hear(PointCloud2, "points_deskewed", self.clouds.append)
        self.hear(DiagnosticStatus, "deskew_node/statistics", self.statistics.append)
        self.odometry_out = self.peer.create_publisher(Odometry, "odometry", 10)
        self.twist_out = self.peer.create_publisher(TwistStamped, "twist", 10)
        self.until(self.clouds_out.get_subscription_count)
        self.until(self.imu_out.get_subscription_count)
        self.until(self.node._output.get_subscription_count)
        self.until(self.node._statistics.get_subscription_count)

    def send_imu(self, samples: Any, frame: str = IMU_FRAME) -> None:
        window = self.node._pipeline.tracker.buffer
        for first in range(0, len(samples), 100):  # less than the node's queue holds
            for sample in samples[first : first + 100]:
                self.send_sample(sample, frame)
            last = int(samples["stamp"][first : first + 100][-1])
            self.until(lambda last=last: window.newest is not None and window.newest >= last)

    def send_odometry(self, seconds: float, velocity: Any, frame: str = FRAME) -> None:
        message = Odometry(child_frame_id=frame)
        message.header.stamp = to_time(at(seconds))
        linear = message.twist.twist.linear
        linear.x, linear.y, linear.z = (float(v) for v in velocity)
        self.until(self.odometry_out.get_subscription_count)
        self.odometry_out.publish(message)

    def known(self, seconds: float) -> bool:
        return self.node._pipeline.tracker.filter.newest_twist == at(seconds)


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> Iterator[Any]:
    made = DeskewBench(*getattr(request, "param", ()))
    yield made
    made.close()


def prime(bench: DeskewBench, seconds: float) -> None:
    """Give the node its cloud frame and IMU samples up to an instant."""
    bench.send_cloud(seen(WALK, 0, 0.23, 0)[0], at(0.0))
    bench.until(lambda: bench.clouds and bench.statistics)
    bench.clouds.clear()
    bench.statistics.clear()
    bench.send_imu(WALK.imu(0, seconds))


def stop_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the node wait for samples however long they take."""
    monkeypatch.setattr(deskew_node, "time", SimpleNamespace(monotonic_ns=lambda: 0))


@pytest.mark.parametrize("bench", [("imu_wait_ms:=1000",)], indirect=True)
def test_a_cloud_is_deskewed_with_odometry_once_the_imu_covers_it(
    bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    prime(bench, 2.1)
    stop_time(monkeypatch)
    bench.send_odometry(2.0, WALK.velocity(np.array([2.0]))[0])
    bench.until(lambda: bench.known(2.0))
    points, truth = seen(WALK, 2.0, 2.23, 2.0, count=3000)
    bench.send_cloud(points, at(2.0))
    bench.send_imu(WALK.imu(2.104, 2.232))
    bench.until(lambda: bench.clouds)
    (cloud,) = bench.clouds
    assert from_time(cloud.header.stamp) == at(2.0)
    assert cloud.header.frame_id == FRAME
    deskewed = from_cloud(cloud)
    assert "time" not in (deskewed.dtype.names or ())
    assert rms(xyz(points) - truth) > 0.3
    assert rms(xyz(deskewed) - truth) < 0.03
    bench.until(lambda: bench.statistics)
    values = {item.key: item.value for item in bench.statistics[-1].values}
    assert values["velocity source"] == "odometry"


def test_a_scan_and_its_level_frame_come_while_somebody_listens(
    bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not bench.peer.count_publishers("/scan") or not bench.node._scan._builder._slices
    scans: list[LaserScan] = []
    transforms: list[TransformStamped] = []
    bench.hear(LaserScan, "scan", scans.append)
    bench.hear(TFMessage, "/tf", lambda message: transforms.extend(message.transforms))
    bench.until(bench.node._scan._scans.get_subscription_count)
    bench.until(bench.node._scan._transforms.get_subscription_count)
    prime(bench, 2.1)
    stop_time(monkeypatch)
    bench.send_odometry(2.0, WALK.velocity(np.array([2.0]))[0])
    bench.until(lambda: bench.known(2.0))
    points, truth = seen(WALK, 2.0, 2.23, 2.0, count=3000)
    bench.send_cloud(points, at(2.0))
    bench.send_imu(WALK.imu(2.104, 2.232))
    bench.until(lambda: scans and transforms)
    scan, transform = scans[-1], transforms[-1]
    assert from_time(scan.header.stamp) == from_time(transform.header.stamp) == at(2.0)
    assert transform.header.frame_id == FRAME
    assert scan.header.frame_id == transform.child_frame_id == "l2lidar_level"
    assert len(scan.ranges) == 360
    assert scan.angle_max == pytest.approx(np.pi - scan.angle_increment, abs=1e-5)
    q = transform.transform.rotation
    level = Rotation.from_quat([q.x, q.y, q.z, q.w]).inv().apply(truth)
    kept = np.abs(level[:, 2]) < 0.1
    reach = np.hypot(level[kept, 0], level[kept, 1])
    ranges = np.array(scan.ranges)
    assert np.isfinite(ranges).sum() > 50
    # every range is that of a point, all but some at the edges of the slice
    off = np.abs(ranges[np.isfinite(ranges)][:, None] - reach).min(axis=1)
    assert np.mean(off < 0.03) > 0.9


def test_without_imu_the_cloud_passes_and_the_diagnostics_say_so(bench: Any) -> None:
    points, _ = seen(WALK, 0, 0.23, 0)
    bench.send_cloud(points, at(0.0))
    bench.until(lambda: bench.clouds)
    assert (from_cloud(bench.clouds[0])["x"] == points["x"]).all()
    bench.until(lambda: any("no IMU samples" in s.message for s in bench.diagnostics))
    status = next(s for s in bench.diagnostics if "no IMU samples" in s.message)
    assert status.level == DiagnosticStatus.ERROR
    assert status.name == "deskew_node: deskew"


@pytest.mark.parametrize("bench", [("imu_wait_ms:=1000", "point_layout:=velodyne")], indirect=True)
def test_the_output_has_the_layout_asked_for_without_a_time(
    bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    prime(bench, 2.1)
    stop_time(monkeypatch)
    points, _ = seen(WALK, 2.0, 2.23, 2.0, count=3000)
    bench.send_cloud(points, at(2.0))
    bench.send_imu(WALK.imu(2.104, 2.232))
    bench.until(lambda: bench.clouds)
    deskewed = from_cloud(bench.clouds[0])
    assert deskewed.dtype.names == ("x", "y", "z", "intensity", "ring")
    assert deskewed.dtype.itemsize == 22


def test_a_cloud_without_plain_times_passes_with_the_reason(bench: Any) -> None:
    points, _ = seen(WALK, 0, 0.23, 0)
    points["time"] = 0.05
    bench.send_cloud(points, at(0.0))
    bench.until(lambda: bench.clouds)
    assert from_cloud(bench.clouds[0]).dtype.names == ("x", "y", "z", "intensity", "range")
    bench.until(
        lambda: any("times are equal" in v.key for s in bench.diagnostics for v in s.values)
    )


def test_mounts_come_from_tf(bench: Any) -> None:
    bench.send_cloud(seen(WALK, 0, 0.23, 0)[0], at(0.0))
    bench.until(lambda: bench.clouds)
    mount = TransformStamped(child_frame_id="some_imu")
    mount.header.frame_id = FRAME
    mount.transform.rotation.w, mount.transform.rotation.z = 0.0, 1.0
    base = TransformStamped(child_frame_id=FRAME)
    base.header.frame_id = "base_link"
    base.transform.translation.x = 0.5
    base.transform.rotation.w = 1.0
    bench.tf_out.publish(TFMessage(transforms=[mount, base]))
    bench.until(lambda: bench.node._frames.version)
    bench.send_imu(WALK.imu(0, 0.1), frame="some_imu")
    np.testing.assert_allclose(
        bench.node._pipeline.tracker._T_cloud_imu, np.diag([-1, -1, 1, 1]), atol=1e-12
    )
    bench.send_odometry(0.4, (1.0, 0.0, 0.0), frame="base_link")
    bench.until(lambda: bench.known(0.4))
    bench.send_odometry(0.6, (1.0, 0.0, 0.0), frame="nowhere")
    bench.until(lambda: bench.node._untied)
    assert "'nowhere' is not tied" in bench.node._untied
    bench.send_odometry(0.8, (1.0, 0.0, 0.0), frame="base_link")
    bench.until(lambda: bench.known(0.8))
    assert bench.node._pipeline.tracker.filter.newest_twist == at(0.8)
    assert not bench.node._untied


@pytest.mark.parametrize(
    "bench", [("velocity_type:=twist", "velocity_topic:=twist")], indirect=True
)
def test_velocity_from_a_twist(bench: Any) -> None:
    prime(bench, 1.4)
    message = TwistStamped()
    message.header.frame_id = FRAME
    message.header.stamp = to_time(at(1.5))
    message.twist.linear.x = 0.7
    bench.until(bench.twist_out.get_subscription_count)
    bench.twist_out.publish(message)
    bench.until(lambda: bench.known(1.5))
    assert bench.node._pipeline.tracker.filter.source == "twist"


@pytest.mark.parametrize(
    "bench",
    [("keep_time:=true", "range_max:=8", "remove_boxes:=[0.,0.,0.,1.,1.,1.]")],
    indirect=True,
)
def test_filters_and_parameters_live(bench: Any) -> None:
    points, _ = seen(WALK, 0, 0.23, 0)
    bench.send_cloud(points, at(0.0))
    bench.until(lambda: bench.clouds)
    first = from_cloud(bench.clouds.pop())
    assert len(first) == (points["range"] <= 8).sum()
    assert first["time"][0] == 0.0
    (result,) = bench.node.set_parameters([Parameter("filters_before", value=["range", "voxel"])])
    assert result.successful, result.reason
    bench.send_cloud(points, at(0.3))
    bench.until(lambda: bench.clouds)
    assert len(from_cloud(bench.clouds.pop())) < len(first)
    for wrong in (Parameter("filters_before", value=["rnage"]), Parameter("range_min", value=9.0)):
        (result,) = bench.node.set_parameters([wrong])
        assert not result.successful
    (result,) = bench.node.set_parameters([Parameter("filters_before", value=[])])
    assert result.successful, result.reason


def test_a_driver_that_levels_is_denounced(bench: Any) -> None:
    bench.peer.declare_parameter("imu_adjust", True)
    bench.node._imu_adjust._ask()
    bench.until(lambda: "/peer" in bench.node._imu_adjust._clients)

    def asked() -> bool:
        bench.node._imu_adjust._ask()
        return bool(bench.node._imu_adjust.answer)

    bench.until(asked)
    bench.until(lambda: any("imu_adjust" in s.message for s in bench.diagnostics))
    bench.peer.set_parameters([Parameter("imu_adjust", value=False)])

    def retracted() -> bool:
        bench.node._imu_adjust._ask()
        return not bool(bench.node._imu_adjust.answer)

    bench.until(retracted)


def test_a_wrong_parameter_is_refused_at_the_start() -> None:
    rclpy.init(args=["test", "--ros-args", "-p", "reference:=beginning"])
    try:
        with pytest.raises(SettingError, match="reference"):
            DeskewNode()
    finally:
        rclpy.shutdown()
