"""slam_node over real topics: pairs, TF, pose, state, services, saved maps."""

from __future__ import annotations

import dataclasses
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("gtsam")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402  after importorskip
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped  # noqa: E402
from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState  # noqa: E402
from nav_msgs.msg import (  # noqa: E402
    Odometry,
    Path as PathMessage,
)
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402
from std_srvs.srv import SetBool, Trigger  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402
from visualization_msgs.msg import MarkerArray  # noqa: E402

from l2lidar_node.ros.conversions import from_time, to_cloud, to_time  # noqa: E402
from l2lidar_node.ros.program import StartError  # noqa: E402
from l2lidar_node.types import HostNs  # noqa: E402
from l2lidar_proc.ros import odometry_messages as messages, slam_worker  # noqa: E402
from l2lidar_proc.ros.map_transform import Blend, reach  # noqa: E402
from l2lidar_proc.ros.slam_node import SlamNode, _sweep  # noqa: E402
from l2lidar_proc.ros.slam_worker import SlamWorker  # noqa: E402
from l2lidar_proc.slam import atlas, se3  # noqa: E402
from l2lidar_proc.slam.config import SlamNodeConfig, SlamTopics  # noqa: E402
from l2lidar_proc.slam.nodes import Health, Map, OdometrySweep, SlamState  # noqa: E402
from l2lidar_proc.slam.slam import Slam  # noqa: E402
from tests.l2lidar_proc.conftest import STEP  # noqa: E402
from tests.l2lidar_proc.ros.bench import FRAME, Bench  # noqa: E402
from tests.support.mapping_runs import MappingRun, drifting  # noqa: E402

pytestmark = pytest.mark.ros


class SlamBench(Bench):
    """A SLAM node on the bench."""

    def __init__(self, *overrides: str, remappings: tuple[str, ...] = ()) -> None:
        super().__init__(SlamNode, overrides, remappings)
        self.transforms: list[TransformStamped] = []
        self.poses: list[PoseWithCovarianceStamped] = []
        self.states: list[str] = []
        self.maps: list[PointCloud2] = []
        self.paths: list[PathMessage] = []
        self.graphs: list[MarkerArray] = []
        self.keyframes: list[Odometry] = []
        self.keyframe_points: list[PointCloud2] = []
        self.hear(TFMessage, "/tf", self.take_transforms)
        self.hear(PoseWithCovarianceStamped, "pose", self.poses.append)
        self.hear(DiagnosticStatus, "slam_status", lambda m: self.states.append(m.message))
        self.hear(PointCloud2, "map_points", self.maps.append)
        self.hear(PathMessage, "map_path", self.paths.append)
        self.hear(MarkerArray, "graph", self.graphs.append)
        self.hear(Odometry, "keyframes", self.keyframes.append)
        self.hear(PointCloud2, "keyframe_points", self.keyframe_points.append)
        self.odometry_out = self.peer.create_publisher(Odometry, "odometry", 50)
        self.deskewed_out = self.peer.create_publisher(PointCloud2, "deskewed_points", 50)
        self.status_out = self.peer.create_publisher(DiagnosticArray, "odometry_status", 50)
        self.given_out = self.peer.create_publisher(PoseWithCovarianceStamped, "/initialpose", 5)
        self.tf_also = self.peer.create_publisher(TFMessage, "/tf", 50)
        for publisher in (self.odometry_out, self.deskewed_out, self.status_out, self.given_out):
            self.until(publisher.get_subscription_count)
        self.until(self.node._transform._publisher.get_subscription_count)
        self.until(self.node._pose.get_subscription_count)
        status = self.node.resolve_topic_name("odometry_status")
        self.until(lambda: self.node.count_publishers(status))
        self.sent = 0

    def take_transforms(self, message: TFMessage) -> None:
        self.transforms += [t for t in message.transforms if t.header.frame_id == "map"]

    def send(self, sweep: OdometrySweep, frame: str = FRAME, remarks: str = "ALIGNED") -> None:
        """Send the three messages of a sweep, and wait until the node has taken them."""
        self.send_pose_and_cloud(sweep, frame)
        self.send_status(sweep, remarks)
        self.until(lambda: self.is_taken(sweep.stamp))
        self.sent += 1

    def send_pose_and_cloud(self, sweep: OdometrySweep, frame: str = FRAME) -> None:
        odometry = Odometry(child_frame_id=frame)
        odometry.header.stamp = to_time(sweep.stamp)
        odometry.header.frame_id = "odom"
        odometry.pose.pose = messages.pose(sweep.T_odom_body)
        self.odometry_out.publish(odometry)
        cloud = messages.as_cloud(sweep.points)
        self.deskewed_out.publish(to_cloud(cloud, sweep.stamp, FRAME))

    def send_status(self, sweep: OdometrySweep, remarks: str) -> None:
        status = DiagnosticArray(status=[DiagnosticStatus(name="odometry", message=remarks)])
        status.header.stamp = to_time(sweep.stamp)
        self.status_out.publish(status)

    def is_taken(self, stamp: int) -> bool:
        latest = self.node._latest
        return latest is not None and latest.stamp >= stamp and stamp not in self.node._parts

    def call(self, name: str, wanted: bool | None = None) -> Any:
        kind: Any = Trigger if wanted is None else SetBool
        client = self.peer.create_client(kind, f"slam_node/{name}")
        self.until(client.service_is_ready)
        request = kind.Request()
        if wanted is not None:
            request.data = wanted
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def drain(self) -> None:
        """Wait until the worker has done all it was given."""
        done: list[object] = []
        self.node._worker.request(lambda: (True, ""), done.append)  # all before it is done
        self.until(lambda: done)


def reaches(bench: SlamBench, stamp: int) -> bool:
    """Tell whether the newest transform is of a later instant."""
    return bool(bench.transforms) and from_time(bench.transforms[-1].header.stamp) > stamp


def sweeps_of(run: MappingRun, seed: int = 1) -> list[OdometrySweep]:
    return list(run.sweeps(drifting(run.truth, 0.5, seed, STEP)))


def test_a_walk_becomes_a_map_that_is_saved_and_shown(
    office: MappingRun,
    tmp_path: Path,
) -> None:
    bench = SlamBench(f"data_dir:={tmp_path}", "map_period_s:=0.3", "autosave_s:=0.0")
    try:
        some = sweeps_of(office)[:60]
        for sweep in some:
            bench.send(sweep)
        bench.drain()
        saved = bench.call("save")
        bench.until(lambda: bench.maps and bench.paths and bench.graphs)
        bench.until(lambda: bench.states)

        assert saved.success
        assert "submaps" in saved.message
        loaded, warnings = atlas.load(tmp_path / "map")
        assert warnings == []
        assert len(loaded.nodes) >= 4
        assert bench.states[-1] == "LOCALIZED"
        assert bench.poses
        assert all(m.header.frame_id == "map" for m in bench.poses)
        stamps = [from_time(t.header.stamp) for t in bench.transforms]
        assert len(stamps) > 10
        assert np.all(np.diff(stamps) > 0)
        assert stamps[0] >= some[0].stamp + 500_000_000  # transform_tolerance
        assert from_time(bench.paths[-1].header.stamp) in {sweep.stamp for sweep in some}
        assert {t.child_frame_id for t in bench.transforms} == {"odom"}
        assert len(bench.maps[-1].data) > 10_000
        assert len(bench.graphs[-1].markers) == 3
        assert_is_chain(bench, loaded)
    finally:
        bench.close()


def assert_is_chain(bench: SlamBench, built: Map) -> None:
    """Compare what other back ends are given with the edges of the map."""
    bench.until(lambda: len(bench.keyframes) == len(built.nodes))
    bench.until(lambda: len(bench.keyframe_points) == len(built.nodes))
    poses = [messages.matrix(item.pose.pose) for item in bench.keyframes]
    for number, (item, cloud) in enumerate(
        zip(bench.keyframes, bench.keyframe_points, strict=True)
    ):
        assert item.header.frame_id == "odom"
        assert item.child_frame_id == cloud.header.frame_id == f"keyframe_{number}"
        assert item.header.stamp == cloud.header.stamp
        covariance = np.array(item.pose.covariance).reshape(6, 6)
        if number == 0:
            assert np.array_equal(covariance, 9999.0 * np.eye(6))
            continue
        edge = built.edges[number - 1]
        assert np.allclose(se3.inverse(poses[number - 1]) @ poses[number], edge["pose"])
        turn = poses[number][:3, :3]
        assert np.allclose(covariance[:3, :3], turn @ edge["covariance"][3:, 3:] @ turn.T)
        assert np.allclose(covariance[3:, 3:], turn @ edge["covariance"][:3, :3] @ turn.T)
        own = np.array(item.twist.covariance).reshape(6, 6)
        assert np.allclose(own[:3, :3], edge["covariance"][3:, 3:])


def test_the_map_stays_while_it_localizes_and_grows_again_afterwards(
    office: MappingRun,
    tmp_path: Path,
) -> None:
    bench = SlamBench(f"data_dir:={tmp_path}", "autosave_s:=0.0", "blend_s:=0.5")
    worker = bench.node._worker
    try:
        some = sweeps_of(office)
        assert not bench.call("set_localization", True).success  # no map yet
        for sweep in some[:50]:
            bench.send(sweep)
        bench.drain()
        known = worker.T_map_odom
        assert bench.call("set_localization", True).success
        saved = len(atlas.load(tmp_path / "map")[0].nodes)
        for sweep in some[50:70]:
            bench.send(sweep)
        bench.drain()
        assert worker.state is SlamState.LOCALIZED  # without searching
        assert worker.submaps == saved
        assert known is not None
        assert worker.T_map_odom is not None
        there = (worker.T_map_odom - known) @ some[60].T_odom_body
        assert np.linalg.norm(there[:3, 3]) < 0.1

        assert bench.call("set_localization", False).success
        for sweep in some[70:100]:
            bench.send(sweep)
        bench.drain()
        assert worker.state is SlamState.LOCALIZED
        assert worker.submaps > saved
        assert bench.call("save").success
        grown, _ = atlas.load(tmp_path / "map")
        assert grown.largest_part().all()
        true = se3.inverse(se3.leveled(office.truth[0])) @ office.true_pose(grown.nodes[-1].stamp)
        assert np.linalg.norm((grown.poses[-1] - true)[:3, 3]) < 0.3
    finally:
        bench.close()


@pytest.mark.parametrize(
    ("waited_s", "transforms_s", "expected_s"),
    [
        (0.0, 0.0, 100.0),  # there are none
        (0.1, 100.05, 100.1),
        (0.1, 100.3, 100.3),  # dead reckoning is ahead
        (0.1, 106.0, 106.0),  # sweeps wait on a busy machine, the IMU carries the pose on
        (5.0, 100.3, 102.0),  # the odometry has stopped
        (0.1, 200.0, 100.1),  # another clock
    ],
)
def test_the_transform_reaches_as_far_as_the_odometry(
    waited_s: float, transforms_s: float, expected_s: float
) -> None:
    found = reach(HostNs(100 * 10**9), round(waited_s * 1e9), round(transforms_s * 1e9))
    assert found == round(expected_s * 1e9)


def test_a_correction_is_blended_where_the_body_is() -> None:
    blend, body = Blend(), se3.planar(100.0, 0.0, 0.0)
    first, second = np.eye(4), se3.planar(0.0, 0.0, 0.02)
    assert blend.toward(None, body, 0.0, 2.0) is None
    assert blend.toward(first, body, 1.0, 2.0) is first  # nothing to come from
    places = []
    for instant in (10.0, 10.5, 11.0, 11.5, 12.0, 13.0):
        shown = blend.toward(second, body, instant, 2.0)
        assert shown is not None
        places.append((shown @ body)[:3, 3])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert np.allclose(places[0], (first @ body)[:3, 3])
    assert np.allclose(steps[:4], 0.5, atol=1e-3)
    assert np.allclose(places[-1], (second @ body)[:3, 3])
    third = np.eye(4)
    assert blend.toward(third, body, 14.0, 0.0) is third  # at once


def test_while_a_service_waits_for_the_worker_everything_else_goes_on(
    office: MappingRun,
    tmp_path: Path,
) -> None:
    bench = SlamBench(f"data_dir:={tmp_path}", "autosave_s:=0.0")
    first, last, began = threading.Event(), threading.Event(), threading.Event()

    def busy(release: threading.Event) -> tuple[bool, str]:
        began.set()
        release.wait()
        return True, ""

    try:
        some = sweeps_of(office)
        for sweep in some[:30]:
            bench.send(sweep)
        bench.drain()
        worker = bench.node._worker
        worker.request(lambda: busy(first), lambda answer: None)
        bench.until(began.is_set)
        for sweep in some[30:40]:
            worker.sweep(sweep)
        worker.request(lambda: busy(last), lambda answer: None)
        client = bench.peer.create_client(Trigger, "slam_node/save")
        bench.until(client.service_is_ready)
        saved = client.call_async(Trigger.Request())
        bench.until(lambda: bench.node._answering)  # a map to show may wait, too
        # However long all that took: those of before reach 2 s beyond their sweep at most.
        for sweep in some[40:100:15]:
            bench.send(sweep)
            stamp = sweep.stamp
            bench.until(lambda stamp=stamp: reaches(bench, stamp))
        assert not saved.done()

        first.set()
        bench.until(saved.done)  # before the sweeps, and what comes after them

        assert not last.is_set()
        assert saved.result().success
        assert atlas.load(tmp_path / "map")[1] == []
    finally:
        first.set()
        last.set()
        bench.close()


def test_an_error_of_the_worker_is_answered_and_counted(
    office: MappingRun,
    tmp_path: Path,
) -> None:
    bench = SlamBench(f"data_dir:={tmp_path}", "autosave_s:=0.0")
    try:
        worker = bench.node._worker
        broken = dataclasses.replace(sweeps_of(office)[0], points=np.zeros((3, 2)))
        worker.sweep(broken)
        bench.until(lambda: worker.failures)
        for sweep in sweeps_of(office)[1:15]:
            bench.send(sweep)
        bench.drain()

        assert bench.call("save").success
        assert worker.failures == 1
        bench.diagnostics.clear()
        bench.until(lambda: any("slam" in status.name for status in bench.diagnostics))
        (said,) = [s for s in bench.diagnostics if "slam" in s.name][:1]
        assert {v.key: v.value for v in said.values}["internal errors"] == "1"
    finally:
        bench.close()


@pytest.mark.parametrize("load_map", [False, True])
def test_a_new_map_takes_the_name_of_an_old_one_but_not_its_place(
    office: MappingRun, mapped: Slam, tmp_path: Path, load_map: bool
) -> None:
    atlas.AtlasWriter(tmp_path / "map").save(mapped.map())
    topics = SlamTopics(data_dir=str(tmp_path), load_map=load_map)
    said: list[str] = []
    worker = SlamWorker(SlamNodeConfig(topics=topics), said.append, lambda keyframe: None)
    try:
        for sweep in sweeps_of(office)[:30]:
            worker._add(sweep)
        assert worker.save()[0]
        assert worker.reset()[0]
        for sweep in sweeps_of(office)[:30]:
            worker._add(sweep)
        assert worker.save()[0]  # what it saved itself it replaces
    finally:
        worker.close()

    assert sorted(path.name for path in tmp_path.iterdir()) == ["map", "map-1"]
    assert said == [f"the previous map in {tmp_path}/map is now {tmp_path}/map-1"]
    assert len(atlas.load(tmp_path / "map")[0].nodes) < len(mapped.nodes)
    assert len(atlas.load(tmp_path / "map-1")[0].nodes) >= len(mapped.nodes)


@pytest.mark.parametrize("autosave_s", [60.0, 0.0])
def test_at_the_end_what_is_unsaved_is_saved_or_told_of(
    office: MappingRun, tmp_path: Path, autosave_s: float
) -> None:
    """Who switched autosaving off did not ask for a file, but should know what is lost."""
    topics = SlamTopics(data_dir=str(tmp_path), autosave_s=autosave_s)
    said: list[str] = []
    worker = SlamWorker(SlamNodeConfig(topics=topics), said.append, lambda keyframe: None)
    for sweep in sweeps_of(office)[:30]:
        worker.sweep(sweep)
    done = threading.Event()
    worker.request(lambda: (True, ""), lambda answer: done.set())
    assert done.wait(60.0)
    worker.close()

    if autosave_s:
        assert len(atlas.load(tmp_path / "map")[0].nodes) == worker.submaps > 0
        assert said == []
    else:
        assert list(tmp_path.iterdir()) == []
        (only,) = said
        assert "not saved" in only
        assert "autosave_s is 0" in only


def test_a_worker_that_cannot_save_at_the_end_says_so(office: MappingRun, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    topics = SlamTopics(data_dir=str(tmp_path / "file"))
    said: list[str] = []
    worker = SlamWorker(SlamNodeConfig(topics=topics), said.append, lambda keyframe: None)
    for sweep in sweeps_of(office)[:30]:
        worker._add(sweep)
    worker.close()

    assert [text.partition(": ")[0] for text in said] == ["autosave"]
    assert worker.failures == 0


def test_a_worker_that_is_busy_does_not_hold_the_end_up(
    office: MappingRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slam_worker, "_END_S", 0.2)
    topics = SlamTopics(data_dir=str(tmp_path))
    said: list[str] = []
    worker = SlamWorker(SlamNodeConfig(topics=topics), said.append, lambda keyframe: None)
    for sweep in sweeps_of(office)[:30]:
        worker._add(sweep)
    begun, over = threading.Event(), threading.Event()

    def work() -> tuple[bool, str]:
        begun.set()
        return over.wait(60.0), ""

    worker.request(work, lambda answer: None)
    assert begun.wait(60.0)
    worker.close()
    over.set()

    assert said == [
        "the map was not saved within 0.2 s: what was added since the last save is lost"
    ]


def test_after_ctrl_c_the_worker_ends_without_a_traceback(
    office: MappingRun, tmp_path: Path
) -> None:
    """The signal shuts the context down while the worker may be about to publish."""
    bench = SlamBench(f"data_dir:={tmp_path}")
    node = bench.node
    some = sweeps_of(office)[:30]
    bench.send(some[0])
    worker = node.worker
    rclpy.shutdown()
    try:
        for sweep in some[1:]:
            worker.sweep(sweep)
        worker.show(lambda built, loops: node._show_map(built, loops, some[0].stamp))
        done = threading.Event()
        worker.request(lambda: (True, ""), lambda answer: done.set())
        assert done.wait(60.0)
    finally:
        node.destroy_node()
        bench.peer.destroy_node()

    assert worker.failures == 0
    assert len(atlas.load(tmp_path / "map")[0].nodes) == worker.submaps > 0


@pytest.mark.parametrize(
    "transitions",
    [
        [
            Transition(id=Transition.TRANSITION_DEACTIVATE),
            Transition(id=Transition.TRANSITION_CLEANUP),
        ],
        [
            Transition(id=Transition.TRANSITION_DEACTIVATE, label="deactivate"),
            Transition(id=Transition.TRANSITION_CLEANUP, label="cleanup"),
        ],
        [Transition(id=Transition.TRANSITION_ACTIVE_SHUTDOWN, label="shutdown")],
    ],
    ids=["numbers", "labels of a clean-up", "label of a shutdown"],
)
def test_a_transition_waits_for_the_answers_that_are_under_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, transitions: list[Transition]
) -> None:
    """``ros2 lifecycle`` sends the label together with the number."""
    bench = SlamBench(f"data_dir:={tmp_path}")
    busy = threading.Event()
    taken: list[int] = []

    async def allows(transition: int) -> bool:
        taken.append(transition)
        return True

    monkeypatch.setattr(bench.node, "allows", allows)
    try:
        bench.node.worker.request(lambda: (busy.wait(60.0), ""), lambda answer: None)
        reset = bench.peer.create_client(Trigger, "slam_node/reset")
        change = bench.peer.create_client(ChangeState, "slam_node/change_state")
        bench.until(lambda: reset.service_is_ready() and change.service_is_ready())
        asked = reset.call_async(Trigger.Request())
        bench.until(lambda: bench.node._answering)
        down = [change.call_async(ChangeState.Request(transition=item)) for item in transitions]
        bench.until(lambda: len(taken) == len(transitions) or down[-1].done())
        assert taken == [item.id for item in transitions]
        busy.set()
        bench.until(lambda: asked.done() and down[-1].done())

        assert asked.result().success
        assert all(item.result().success for item in down)
        assert not bench.node.is_configured
    finally:
        busy.set()
        bench.close()


def test_a_clouds_frame_that_is_not_that_of_the_pose_is_named_and_dropped(
    office: MappingRun,
    tmp_path: Path,
) -> None:
    bench = SlamBench(f"data_dir:={tmp_path}")
    try:
        for sweep in sweeps_of(office)[:3]:
            bench.send(sweep, frame="base_link")
        bad = dataclasses.replace(sweeps_of(office)[3], T_odom_body=np.full((4, 4), 0.0))
        odometry = Odometry(child_frame_id=FRAME)
        odometry.header.stamp = to_time(bad.stamp)
        odometry.pose.pose.orientation.w = float("nan")
        bench.odometry_out.publish(odometry)
        far = Odometry(child_frame_id=FRAME)
        far.pose.pose.orientation.w = 1.0
        far.header.stamp.sec = 2**31 - 1
        bench.odometry_out.publish(far)
        vague = Odometry(child_frame_id=FRAME)
        vague.pose.pose.orientation.w = 1.0
        vague.pose.covariance[3] = float("inf")
        bench.odometry_out.publish(vague)
        bench.until(lambda: bench.node._refused == 6)

        assert bench.node._latest.stamp == sweeps_of(office)[2].stamp
        assert bench.node._worker.submaps == 0
    finally:
        bench.close()


def test_an_odometry_without_a_status_is_lost_where_its_covariance_says_so(
    office: MappingRun,
) -> None:
    sweep = sweeps_of(office)[0]
    odometry = Odometry(child_frame_id=FRAME)
    odometry.pose.pose = messages.pose(sweep.T_odom_body)
    cloud = to_cloud(messages.as_cloud(sweep.points), sweep.stamp, FRAME)
    for variances, health in (
        ([1e-4] * 6, Health.GOOD),
        ([1e-4, 1e-4, 1e6, 1e6, 1e6, 1e-4], Health.GOOD),  # a planar one does not know its height
        ([9999.0] * 6, Health.CUT),
    ):
        odometry.pose.covariance = np.diag(variances).ravel()
        assert _sweep(sweep.stamp, odometry, cloud, None).health is health


@pytest.mark.parametrize("remappings", [(), ("odometry_status:=/elsewhere/status",)])
def test_a_sweep_waits_for_its_status(
    office: MappingRun, tmp_path: Path, remappings: tuple[str, ...]
) -> None:
    bench = SlamBench(f"data_dir:={tmp_path}", remappings=remappings)
    try:
        sweep = sweeps_of(office)[0]
        taken: list[OdometrySweep] = []
        bench.node.worker.sweep = taken.append
        bench.send_pose_and_cloud(sweep)
        bench.until(lambda: bench.node._latest)
        parts = bench.node._parts
        bench.until(lambda: taken or (sweep.stamp in parts and parts[sweep.stamp].cloud))
        assert not taken
        bench.send_status(sweep, "LOST")
        bench.until(lambda: taken)

        assert taken[0].health is Health.CUT
    finally:
        bench.close()


def test_another_parent_of_odom_silences_the_transform(
    office: MappingRun,
    tmp_path: Path,
) -> None:
    bench = SlamBench(f"data_dir:={tmp_path}")
    try:
        bench.send(sweeps_of(office)[0])
        bench.until(lambda: bench.transforms)
        inverted = messages.transform(np.eye(4), sweeps_of(office)[0].stamp, "base_link", "odom")
        bench.until(bench.tf_also.get_subscription_count)
        bench.tf_also.publish(inverted)
        bench.until(lambda: bench.node._transform.other_parent)
        before = len(bench.transforms)
        bench.diagnostics.clear()
        bench.until(lambda: bench.diagnostics)

        assert "invert_tf" in bench.diagnostics[-1].message
        assert bench.diagnostics[-1].level == DiagnosticStatus.ERROR
        assert len(bench.transforms) <= before + 2  # what was on its way
    finally:
        bench.close()


def test_localization_says_nothing_until_it_knows_and_takes_an_initial_pose(
    office: MappingRun,
    mapped: Slam,
    tmp_path: Path,
) -> None:
    atlas.AtlasWriter(tmp_path / "map").save(mapped.map())
    before = {path.name: path.read_bytes() for path in (tmp_path / "map").iterdir()}
    bench = SlamBench(f"data_dir:={tmp_path}", "mode:=localization", "relocalize:=never")
    try:
        run = office.part(20, 50)
        true = se3.inverse(se3.leveled(office.truth[0])) @ run.truth
        all_sweeps = sweeps_of(run, 9)
        bench.send(all_sweeps[0])
        bench.until(lambda: "SEARCHING" in bench.states)
        assert bench.transforms == []
        given = PoseWithCovarianceStamped()
        given.header.frame_id = "map"
        for x in (1e300, np.inf, np.nan):  # refused; what comes after it is taken
            given.pose.pose = messages.pose(se3.planar(0.0, 0.0, 0.0))
            given.pose.pose.position.x = x
            bench.given_out.publish(given)
        pose = se3.planar(true[0, 0, 3] + 0.3, true[0, 1, 3], se3.yaw_of(true[0]) + 0.1)
        given.pose.pose = messages.pose(pose)
        bench.given_out.publish(given)
        bench.until(lambda: bench.node._worker.T_map_odom is not None)
        assert np.linalg.norm(bench.node._worker.T_map_odom[:3, 3]) < 1e3
        for sweep in all_sweeps[1:]:
            bench.send(sweep)
        bench.until(lambda: not bench.node._worker.waiting)
        bench.until(lambda: bench.states[-1] == "LOCALIZED")
        refused = bench.call("save")

        assert bench.transforms
        found = bench.node._worker.T_map_odom @ all_sweeps[-1].T_odom_body
        assert np.linalg.norm((found - true[-1])[:3, 3]) < 0.15
        assert not refused.success
        after = {path.name: path.read_bytes() for path in (tmp_path / "map").iterdir()}
        assert after == before
    finally:
        bench.close()


def test_without_a_map_localization_does_not_start(tmp_path: Path) -> None:
    rclpy.init(
        args=["test", "--ros-args", "-p", f"data_dir:={tmp_path}", "-p", "mode:=localization"]
    )
    try:
        with pytest.raises(StartError, match=r"not a saved map: there is no atlas\.json"):
            SlamNode()
    finally:
        rclpy.shutdown()


@pytest.mark.parametrize("name", ["../outside", "/etc", "a/b", ""])
def test_a_map_is_never_written_outside_its_folder(tmp_path: Path, name: str) -> None:
    bench = SlamBench(f"data_dir:={tmp_path}")
    try:
        (result,) = bench.node.set_parameters([Parameter("map_name", value=name)])

        assert not result.successful
        assert "map_name" in result.reason
    finally:
        bench.close()
