"""The odometry node over real topics: pose, twist, TF, path, services and diagnostics."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402  after importorskip
from geometry_msgs.msg import TransformStamped  # noqa: E402
from nav_msgs.msg import (  # noqa: E402
    Odometry,
    Path as PathMessage,
)
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

from l2lidar_node.ros.conversions import from_cloud, from_time  # noqa: E402
from l2lidar_node.types import Sweep  # noqa: E402
from l2lidar_proc.motion.imu_buffer import replay  # noqa: E402
from l2lidar_proc.odometry.estimate import OdometryEstimate  # noqa: E402
from l2lidar_proc.odometry.kiss import PlainOdometry  # noqa: E402
from l2lidar_proc.ros.odometry_messages import matrix  # noqa: E402
from l2lidar_proc.ros.odometry_node import OdometryNode  # noqa: E402
from l2lidar_proc.ros.subscriptions import NeverExecuted, waiting  # noqa: E402
from tests.l2lidar_proc.odometry.odometry_world import recording  # noqa: E402
from tests.l2lidar_proc.ros.bench import FRAME, LATCHED, Bench  # noqa: E402
from tests.support.odometry_runs import sweeps, truth  # noqa: E402

pytestmark = pytest.mark.ros


class OdometryBench(Bench):
    """An odometry node on the bench."""

    def __init__(self, *overrides: str) -> None:
        super().__init__(OdometryNode, overrides)
        self.poses: list[Odometry] = []
        self.fast: list[Odometry] = []
        self.paths: list[PathMessage] = []
        self.maps: list[PointCloud2] = []
        self.registered: list[PointCloud2] = []
        self.transforms: list[TransformStamped] = []
        # When each was published, and its stamp [ns].
        self.transforms_out: list[tuple[int, int]] = []
        self.poses_out: list[tuple[int, int]] = []
        self.sent: list[tuple[int, int]] = []
        self.hear(Odometry, "odometry", self._pose)
        self.hear(Odometry, "odometry_imu", self.fast.append)
        self.hear(PathMessage, "path", self.paths.append, LATCHED)
        self.hear(PointCloud2, "local_map", self.maps.append, LATCHED)
        self.hear(PointCloud2, "registered_points", self.registered.append)
        self.hear(TFMessage, "/tf", self._transform)
        self.hear(PointCloud2, "/points", self._raw)
        self.until(self.clouds_out.get_subscription_count)
        self.until(self.imu_out.get_subscription_count)
        self.until(self.node._odometry.get_subscription_count)
        self.until(self.node._registered.get_subscription_count)
        self.until(self.node._tf.get_subscription_count)

    def _pose(self, message: Odometry, info: dict[str, int]) -> None:
        self.poses.append(message)
        self.poses_out.append((info["source_timestamp"], from_time(message.header.stamp)))

    def _transform(self, message: TFMessage, info: dict[str, int]) -> None:
        self.transforms.extend(message.transforms)
        (only,) = message.transforms
        self.transforms_out.append((info["source_timestamp"], from_time(only.header.stamp)))

    def _raw(self, message: PointCloud2, info: dict[str, int]) -> None:
        self.sent.append((info["source_timestamp"], from_time(message.header.stamp)))

    def known_until(self, instant: int) -> int:
        """Return the stamp that /tf had reached at an instant [ns]."""
        return max((stamp for sent, stamp in self.transforms_out if sent <= instant), default=0)

    def send(self, run: Any, some: Any) -> None:
        """Send sweeps, each after the samples that cover it."""
        pipeline = self.node._pipeline
        for sweep, samples in replay(some, run.imu):
            for sample in samples:
                self.send_sample(sample)
                self.executor.spin_once(timeout_sec=0.0)
            newest = int(samples["stamp"][-1])
            if not isinstance(pipeline.odometry, PlainOdometry):  # which has no use for them
                self.until(lambda newest=newest: (pipeline.newest_imu or 0) >= newest)
            before = pipeline.sweeps
            self.send_cloud(sweep.points, sweep.start)
            self.until(lambda before=before: pipeline.sweeps > before)

    def call(self, name: str) -> Trigger.Response:
        client = self.peer.create_client(Trigger, f"odometry_node/{name}")
        self.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.until(future.done)
        return future.result()


@pytest.fixture
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Any]:
    made = OdometryBench(f"data_dir:={tmp_path}", *getattr(request, "param", ()))
    yield made
    made.close()


@pytest.mark.parametrize("bench", [("map_period_s:=0.2",)], indirect=True)
def test_everything_that_is_published(bench: Any, tmp_path: Path) -> None:
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))[:18]
    bench.send(run, some)
    bench.until(lambda: len(bench.poses) == 18 and len(bench.registered) == 18)
    # a message has no end of its sweep but the last point's time
    middles = np.array([(s.start + s.end) // 2 for s in some])
    found = np.array([from_time(m.header.stamp) for m in bench.poses])
    assert np.abs(found - middles).max() < 200_000
    last = bench.poses[-1]
    assert (last.header.frame_id, last.child_frame_id) == ("odom", FRAME)
    stamps = np.array([from_time(bench.poses[0].header.stamp), from_time(last.header.stamp)])
    true, _ = truth(run, stamps)
    place = last.pose.pose.position
    assert np.linalg.norm([place.x, place.y, place.z]) == pytest.approx(
        np.linalg.norm(true[1] - true[0]), abs=0.02
    )
    assert 0.0 < last.pose.covariance[0] < 1e-3
    moving = run.motion.kinematics(np.array([(stamps[1] - run.imu["stamp"][0]) * 1e-9]))
    assert last.twist.twist.linear.x == pytest.approx(moving.velocity_body[0, 0], abs=0.05)
    (tf,) = (t for t in bench.transforms if from_time(t.header.stamp) == found[0])
    assert (tf.header.frame_id, tf.child_frame_id) == ("odom", FRAME)
    assert tf.transform.translation.x == bench.poses[0].pose.pose.position.x
    assert bench.registered[-1].header.frame_id == "odom"
    assert "time" not in (from_cloud(bench.registered[-1]).dtype.names or ())
    bench.until(lambda: bench.maps and bench.fast and bench.paths)
    assert bench.maps[-1].width > 1000
    bench.until(lambda: bench.diagnostics)
    assert bench.diagnostics[-1].name == "odometry_node: odometry"
    assert bench.call("save_map").success
    assert (tmp_path / "map.ply").stat().st_size > 10_000
    assert bench.call("save_trajectory").success
    lines = (tmp_path / "trajectory.tum").read_text().splitlines()
    assert len(lines) == len((tmp_path / "trajectory.kitti").read_text().splitlines()) == 18
    assert lines[0].split()[0] == "{}.{:09d}".format(*divmod(int(stamps[0]), 10**9))
    assert bench.call("reset").success
    assert not len(bench.node._pipeline.trajectory.poses)


@pytest.mark.parametrize(
    ("bench", "words"),
    [
        (("base_frame:=base_link",), "'base_link' is not tied to 'l2lidar_link' on /tf_static"),
        (("base_frame:=base_link", "use_tf:=false"), "use_tf is false"),
    ],
    indirect=["bench"],
)
def test_a_base_that_is_not_on_tf_is_an_error_that_says_so(bench: Any, words: str) -> None:
    bench.send(recording("room", "walk"), list(sweeps(recording("room", "walk"), "turn"))[:3])
    bench.until(lambda: any(words in status.message for status in bench.diagnostics))
    (first, *_) = [status for status in bench.diagnostics if words in status.message]
    assert first.level == DiagnosticStatus.ERROR
    assert "poses are those of 'l2lidar_link'" in first.message


@pytest.mark.parametrize(
    "bench", [("base_frame:=base_link", "invert_tf:=true", "odom_frame:=map")], indirect=True
)
def test_base_frame_from_tf_with_the_transform_inverted(bench: Any) -> None:
    run = recording("room", "walk")
    mount = TransformStamped(child_frame_id=FRAME)
    mount.header.frame_id = "base_link"
    mount.transform.translation.z = 1.0
    mount.transform.rotation.w = 1.0
    bench.tf_out.publish(TFMessage(transforms=[mount]))
    bench.until(lambda: bench.node._frames.version)
    bench.send(run, list(sweeps(run, "turn"))[:8])
    bench.until(lambda: len(bench.poses) == 8 and bench.transforms)
    assert (bench.poses[0].header.frame_id, bench.poses[0].child_frame_id) == ("map", "base_link")
    tf = bench.transforms[-1]
    assert (tf.header.frame_id, tf.child_frame_id) == ("base_link", "map")
    assert abs(bench.poses[0].pose.pose.position.z) < 1e-6
    assert abs(bench.poses[-1].pose.pose.position.z) < 0.05
    assert not bench.node._untied()


def static(parent: str, child: str) -> TFMessage:
    mount = TransformStamped(child_frame_id=child)
    mount.header.frame_id = parent
    mount.transform.translation.z = 1.0
    mount.transform.rotation.w = 1.0
    return TFMessage(transforms=[mount])


@pytest.mark.parametrize(
    ("bench", "mount", "words"),
    [
        (
            (),
            ("base_link", FRAME),
            ("'base_link' is already the parent of 'l2lidar_link'", "base_frame to 'base_link'"),
        ),
        (("use_tf:=false",), ("base_link", FRAME), ("base_frame to 'base_link'",)),
        (
            ("base_frame:=base_link", "invert_tf:=true"),
            ("map", "odom"),
            ("'map' is already the parent of 'odom'", "take 'odom' off", "publish_tf to false"),
        ),
        # base_frame cannot be odom_frame, nor can the transform be inverted
        ((), ("odom", "base_link"), ("'base_link' is already", "take 'odom' off /tf_static")),
        (("invert_tf:=true",), ("odom", "base_link"), ("'odom' is already above", "'odom' off")),
    ],
    indirect=["bench"],
)
def test_a_frame_that_has_a_parent_gets_no_second_one(
    bench: Any, mount: tuple[str, str], words: tuple[str, ...]
) -> None:
    """A cloud frame below a robot's base_link: tf2 would drop the mount."""
    run = recording("room", "walk")
    bench.tf_out.publish(static(*mount))
    bench.tf_out.publish(static("base_link", FRAME))
    bench.until(lambda: bench.node._static.version == 2)
    bench.send(run, list(sweeps(run, "turn"))[:8])
    bench.until(lambda: len(bench.poses) == 8 and bench.fast)
    bench.diagnostics.clear()
    bench.until(lambda: any(words[0] in status.message for status in bench.diagnostics))

    (said, *_) = [status for status in bench.diagnostics if words[0] in status.message]
    assert said.level == DiagnosticStatus.ERROR
    for word in words:
        assert word in said.message
    assert bench.transforms == []


@pytest.mark.parametrize("bench", [(), ("base_frame:=base_link",)], indirect=True)
def test_a_mount_that_comes_late_ends_the_transforms_of_a_frame_below_it(bench: Any) -> None:
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))[:14]
    is_root = bench.node._base_name == "base_link"
    bench.send(run, some[:7])
    bench.until(lambda: len(bench.poses) == 7 and bench.transforms)
    bench.tf_out.publish(static("base_link", FRAME))
    bench.until(lambda: bench.node._static.version)
    newest = bench.node._pipeline.newest_imu
    bench.send(run, some[7:])
    bench.until(lambda: len(bench.poses) == 14)
    bench.diagnostics.clear()
    bench.until(lambda: bench.diagnostics)

    assert ("is already the parent" in bench.diagnostics[-1].message) is not is_root
    assert (bench.known_until(2**62) > newest) is is_root


def test_a_cloud_can_be_transformed_when_it_comes(bench: Any) -> None:
    """RViz, Nav2 and others drop a cloud whose transform has not come yet."""
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))[:18]
    bench.send(run, some)
    bench.until(lambda: len(bench.poses) == 18 and len(bench.sent) == 18)
    first, _ = bench.transforms_out[0]
    ends = {(s.start + s.end) // 2: s.end for s in some}
    # Until the first sweeps have begun the map there is no frame of that name.
    later = [item for item in bench.sent if item[0] > first]
    assert len(later) >= 12
    later_poses = [item for item in bench.poses_out if item[1] > later[0][1]]
    bench.until(lambda: bench.known_until(2**62) >= some[-1].end - 5_000_000)
    for sent, stamp in later:
        assert bench.known_until(sent) >= stamp, "raw cloud, stamped with its start"
    for sent, stamp in later_poses:
        end = ends[min(ends, key=lambda middle: abs(middle - stamp))]
        assert bench.known_until(sent) >= end - 5_000_000, "what is deskewed to the end"
    stamps = np.array([stamp for _, stamp in bench.transforms_out])
    assert (np.diff(stamps) > 0).all()
    tracking = stamps[stamps >= later_poses[0][1]]
    assert np.diff(tracking).max() <= 24_000_000, "50 a second, a sample late at most"


def test_transforms_ascend_where_sweeps_come_seconds_late(bench: OdometryBench) -> None:
    """As on a busy machine: the samples are there, and the clouds behind them."""
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))[:9]
    last = int(np.searchsorted(run.imu["stamp"], some[-1].end)) + 1
    for sample in run.imu[:last]:
        bench.send_sample(sample)
        bench.executor.spin_once(timeout_sec=0.0)
    newest = int(run.imu["stamp"][last - 1])
    pipeline = bench.node._pipeline
    bench.until(lambda: (pipeline.newest_imu or 0) >= newest)
    for number, sweep in enumerate(some):
        bench.send_cloud(sweep.points, sweep.start)
        bench.until(lambda number=number: pipeline.sweeps > number)
        bench.send_sample(run.imu[last + number])  # lets TF go on
    bench.until(lambda: len(bench.poses) == len(some))
    stamps = np.array([stamp for _, stamp in bench.transforms_out])
    assert len(stamps) > 1
    assert (np.diff(stamps) > 0).all()


def test_transforms_go_on_while_a_sweep_is_registered(bench: OdometryBench) -> None:
    """On a small computer that takes longer than a controller can do without a pose."""
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))[:12]
    bench.send(run, some[:-1])
    bench.until(lambda: len(bench.poses) == len(some) - 1)
    heard = bench.peer.create_subscription(
        TFMessage, "/tf", lambda message: None, 100, callback_group=NeverExecuted()
    )
    bench.until(lambda: bench.node._tf.get_subscription_count() == 2)
    odometry = bench.node._pipeline.odometry
    register = odometry.register
    first = int(np.searchsorted(run.imu["stamp"], some[-1].end)) + 1
    later = run.imu[first : first + 100]  # as many as 0.4 s of work let come
    stamps: list[int] = []

    def slow(sweep: Sweep, *, may_skip: bool) -> list[OdometryEstimate]:
        for sample in later:
            bench.send_sample(sample)
        deadline = time.monotonic() + 60.0
        while not stamps or stamps[-1] < later["stamp"][-1] - 24_000_000:
            assert time.monotonic() < deadline
            for message in waiting(heard, 100):
                stamps.extend(from_time(item.header.stamp) for item in message.transforms)
        odometry.register = register
        return register(sweep, may_skip=may_skip)

    odometry.register = slow
    bench.send(run, some[-1:])
    bench.until(lambda: len(bench.poses) == len(some))
    assert np.diff(stamps).max() <= 24_000_000
    # What came meanwhile moves the new estimate as well: no later pose is missing.
    for sample in run.imu[first + 100 : first + 110]:
        bench.send_sample(sample)
    newest = int(run.imu["stamp"][first + 109])
    bench.until(lambda: bench.known_until(2**62) >= newest - 24_000_000)
    ascending = np.array([stamp for _, stamp in bench.transforms_out])
    assert (np.diff(ascending) > 0).all()
    assert np.diff(ascending[ascending >= stamps[0]]).max() <= 24_000_000


@pytest.mark.parametrize("bench", [("imu_rate:=0.0",)], indirect=True)
def test_without_a_rate_there_is_one_transform_for_each_sweep(bench: Any) -> None:
    run = recording("room", "walk")
    bench.send(run, list(sweeps(run, "turn"))[:6])
    bench.until(lambda: len(bench.poses) == 6 and len(bench.transforms) == 6)
    assert [stamp for _, stamp in bench.transforms_out] == [stamp for _, stamp in bench.poses_out]
    assert bench.transforms[-1].transform.translation.x == bench.poses[-1].pose.pose.position.x
    assert not bench.fast


def test_a_reset_leaves_nothing_of_the_old_map_to_the_new_frame(bench: Any) -> None:
    """The thread of the IMU publishes dead-reckoned poses all the while."""
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))[:12]
    bench.send(run, some)
    bench.until(lambda: len(bench.poses) == len(some))
    base, last = bench.node._base, int(np.searchsorted(run.imu["stamp"], some[-1].end)) + 1
    reset = base.reset

    def reset_between_samples() -> None:
        reset()
        bench.node._poses.take(run.imu[last : last + 20])

    base.reset = reset_between_samples
    assert bench.call("reset").success
    bench.poses.clear()
    bench.send(run, list(sweeps(run, "turn"))[12:18])
    bench.until(lambda: bench.poses)

    first = bench.poses[0].pose.pose.position
    assert np.linalg.norm((first.x, first.y, first.z)) < 1e-6


@pytest.mark.parametrize("bench", [("map_period_s:=3600.0",)], indirect=True)
def test_the_period_of_the_map_can_be_changed_while_it_runs(bench: Any) -> None:
    run = recording("room", "walk")
    bench.send(run, list(sweeps(run, "turn"))[:6])
    bench.until(lambda: bench.poses and bench.node._map.get_subscription_count())
    node = bench.node

    def set_period(value: float) -> bool:
        return bool(node.set_parameters([Parameter("map_period_s", value=value)])[0].successful)

    assert not bench.maps
    assert set_period(0.1)
    bench.until(lambda: len(bench.maps) > 1)
    assert set_period(0.0)
    timers = len(list(node.timers))
    assert set_period(5.0)
    assert len(list(node.timers)) == timers + 1
    node.trigger_deactivate()
    assert set_period(0.1)
    assert not list(node.timers)
    node.trigger_activate()
    bench.maps.clear()
    bench.until(lambda: bench.maps)


@pytest.mark.parametrize("bench", [("mode:=plain",)], indirect=True)
def test_plain_kiss_icp(bench: Any) -> None:
    run = recording("room", "still", 3.0)
    bench.send(run, list(sweeps(run, "turn"))[:5])
    bench.until(lambda: len(bench.poses) == 5)
    assert abs(bench.poses[-1].pose.pose.position.x) < 0.1
    bench.until(lambda: len(bench.transforms) == 5)


def test_a_cloud_that_cannot_be_used_is_told_of(bench: Any) -> None:
    run = recording("room", "still", 3.0)
    points = next(sweeps(run, "turn")).points.copy()
    points["time"] += 1e6
    bench.send_cloud(points, 10**18)
    bench.until(lambda: any("neither" in v.key for s in bench.diagnostics for v in s.values))
    assert not bench.call("save_map").success


@pytest.mark.parametrize("bench", [("time_unit:=us",)], indirect=True)
def test_times_are_in_the_unit_that_is_set(bench: Any) -> None:
    run = recording("room", "still", 3.0)
    some = list(sweeps(run, "turn"))[:5]
    for sweep in some:
        kinds = [*((axis, "<f4") for axis in "xyz"), ("t", "<u4")]
        points = np.zeros(len(sweep.points), kinds)
        for axis in "xyz":
            points[axis] = sweep.points[axis]
        points["t"] = np.round(sweep.points["time"].astype(np.float64) * 1e6)
        bench.send_cloud(points, sweep.start)
    bench.until(lambda: len(bench.poses) == 5)
    assert bench.node._pipeline.last.stamp - some[4].start < some[4].end - some[4].start


def test_what_other_sensors_do_differently_is_recognized_and_said(bench: Any) -> None:
    run = recording("room", "still", 3.0)
    some = list(sweeps(run, "turn"))[:5]
    in_g = run.imu.copy()
    in_g["linear_acceleration"] /= 9.80665
    for sample in in_g[:40]:
        bench.send_sample(sample, frame=FRAME)
    bench.until(lambda: bench.node._pipeline.convention.in_g)
    for sweep in some:
        points = sweep.points.copy()
        points["time"] = 0.0
        bench.send_cloud(points, sweep.start)
    bench.until(
        lambda: any(
            "measures in g" in v.value
            and "without a time per point" in v.value
            and f"the same frame '{FRAME}'" in v.value
            for s in bench.diagnostics
            for v in s.values
        )
    )
    bench.until(lambda: len(bench.poses) == 5)
    assert np.allclose(bench.node._pipeline.odometry.T_cloud_imu, np.eye(4))


@pytest.mark.parametrize(
    ("bench", "most"), [((), 3), (("max_skipped:=0",), 0)], indirect=["bench"]
)
def test_clouds_that_wait_are_skipped_in_part_and_all_come_out(bench: Any, most: int) -> None:
    """As after a hold-up: eight clouds at once, and the samples that cover them."""
    statuses: list[DiagnosticArray] = []
    bench.hear(DiagnosticArray, "odometry_status", statuses.append)
    bench.until(bench.node._status.get_subscription_count)
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))[:16]
    bench.send(run, some[:8])
    first, last = np.searchsorted(run.imu["stamp"], [some[7].end, some[-1].end]) + 1
    for sample in run.imu[first:last]:
        bench.send_sample(sample)
        bench.executor.spin_once(timeout_sec=0.0)
    for sweep in some[8:]:
        bench.send_cloud(sweep.points, sweep.start)
    bench.until(lambda: len(statuses) == len(bench.poses) == 16)

    stamps = [from_time(message.header.stamp) for message in bench.poses]
    middles = [(sweep.start + sweep.end) // 2 for sweep in some]
    # a cloud ends with its last point, where the sweep may end with a packet
    np.testing.assert_allclose(np.subtract(stamps, middles), 0, atol=100_000)
    skipped = ["SKIPPED" in message.status[0].message for message in statuses]
    assert not any(skipped[:8])
    assert any(skipped) == (most > 0)
    in_a_row = max(len(part) for part in "".join("01"[one] for one in skipped).split("0"))
    assert in_a_row <= most
    assert not any(skipped[-2:]), "no two clouds wait behind the last ones"


def test_back_ends_get_deskewed_clouds_and_the_status_of_each_pose(bench: Any) -> None:
    clouds: list[PointCloud2] = []
    statuses: list[DiagnosticArray] = []
    bench.hear(PointCloud2, "deskewed_points", clouds.append)
    bench.hear(DiagnosticArray, "odometry_status", statuses.append)
    bench.until(bench.node._deskewed.get_subscription_count)
    bench.until(bench.node._status.get_subscription_count)
    run = recording("room", "walk")
    bench.send(run, list(sweeps(run, "turn"))[:8])
    bench.until(lambda: len(clouds) == len(statuses) == len(bench.registered) == 8)

    stamps = [from_time(m.header.stamp) for m in bench.poses]
    assert [from_time(m.header.stamp) for m in clouds] == stamps
    assert [from_time(m.header.stamp) for m in statuses] == stamps
    assert {m.header.frame_id for m in clouds} == {FRAME}
    assert statuses[-1].status[0].message == "ALIGNED"
    values = {item.key: item.value for item in statuses[-1].status[0].values}
    sigma = np.sqrt(np.asarray(bench.poses[-1].pose.covariance).reshape(6, 6).diagonal())
    assert float(values["position_sigma_m"]) == pytest.approx(sigma[:3].max(), abs=1e-4)
    assert float(values["variance_factor"]) == 1.0
    assert 0.0 <= float(values["nis"]) < 2.0
    assert float(values["tilt_rad"]) < 0.02
    assert values["degenerate_direction"] == "0.000 0.000 0.000"
    assert float(values["age_s"]) > 1e6  # the recording is of 2023
    pose = matrix(bench.poses[-1].pose.pose)
    body, world = from_cloud(clouds[-1]), from_cloud(bench.registered[-1])
    moved = np.stack([body[axis] for axis in "xyz"], axis=1) @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(moved, np.stack([world[a] for a in "xyz"], axis=1), atol=1e-4)
    assert "time" not in (body.dtype.names or ())
