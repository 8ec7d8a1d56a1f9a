"""Deskew and odometry in one process: shared subscriptions, and one motion for each sweep."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2

from l2lidar_node import rotations
from l2lidar_node.ros.conversions import from_cloud, from_time
from l2lidar_node.settings import SettingError
from l2lidar_node.types import STANDARD_GRAVITY, Sweep
from l2lidar_proc.motion.imu_buffer import replay
from l2lidar_proc.ros.companion_node import make_nodes
from tests.l2lidar_proc.odometry.odometry_world import recording
from tests.l2lidar_proc.ros.bench import Bench
from tests.support.odometry_runs import EPOCH, Run, sweeps, truth

pytestmark = pytest.mark.ros


class CompanionBench(Bench):
    """Both nodes, and what they publish."""

    def __init__(self, overrides: tuple[str, ...]) -> None:
        self.nodes: list[Any] = []

        def make() -> Any:
            self.nodes = make_nodes()
            return self.nodes[0]

        super().__init__(make, overrides)
        self.executor.add_node(self.nodes[1])
        self.poses: list[Odometry] = []
        self.clouds: list[PointCloud2] = []
        self.hear(Odometry, "/odometry", self.poses.append)
        self.hear(PointCloud2, "/points_deskewed", self.clouds.append)

    def close(self) -> None:
        self.nodes[1].destroy_node()
        super().close()


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> Iterator[CompanionBench]:
    made = CompanionBench(getattr(request, "param", ()))
    yield made
    made.close()


def play(bench: CompanionBench, run: Run, seconds: float) -> list[Sweep]:
    """Send a recording in its own order; return the sweeps that were sent."""
    bench.until(
        lambda: (
            bench.clouds_out.get_subscription_count()
            and bench.imu_out.get_subscription_count()
            and bench.peer.count_publishers("/points_deskewed")
        )
    )
    sent = []
    for sweep, samples in replay(sweeps(run, "turn"), run.imu):
        if sweep.end - EPOCH > seconds * 1e9:
            break
        for sample in samples:
            bench.send_sample(sample)
        bench.send_cloud(sweep.points, sweep.start)
        sent.append(sweep)
        count = len(sent)
        bench.until(lambda count=count: len(bench.clouds) == count)
    return sent


def test_each_cloud_comes_in_once_and_out_of_both(bench: CompanionBench) -> None:
    run = recording("room", "walk", 6.0)
    sent = play(bench, run, 5.5)
    bench.until(lambda: len(bench.poses) >= len(sent) - 1)
    odometry, deskew = bench.nodes
    assert [node.get_name() for node in bench.nodes] == ["odometry_node", "deskew_node"]
    assert bench.clouds_out.get_subscription_count() == 1
    assert bench.imu_out.get_subscription_count() == 1
    assert deskew._sensors is odometry.sensors
    assert deskew._pipeline.tracker.buffer.counts.accepted > 1000
    assert deskew._last.values["velocity source"] == "odometry"
    assert deskew._last.values["velocity age [ms]"] == "0"
    # against the truth: where a sensor at rest at the stamp would have seen the same points
    cloud = bench.clouds[-1]
    assert from_time(cloud.header.stamp) == sent[-1].start
    points = from_cloud(cloud)
    estimate = odometry._pipeline.last
    at_start = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float64)
    at_middle = np.stack([estimate.points[axis] for axis in "xyz"], axis=1).astype(np.float64)
    # the odometry leaves out near points
    kept = np.isin(sent[-1].points["range"], estimate.points["range"])
    stamps = np.array([sent[-1].start, estimate.stamp])
    positions, q = truth(run, stamps)
    turn = rotations.multiply(rotations.conjugate(q[0]), q[1])
    way = rotations.rotate(rotations.conjugate(q[0]), positions[1] - positions[0])
    assert np.linalg.norm(way) > 0.05
    expected = rotations.rotate(turn, at_middle) + way
    assert np.median(np.linalg.norm(at_start[kept] - expected, axis=1)) < 0.01


@pytest.mark.parametrize("bench", [("deskew_node:publish_scan:=always",)], indirect=True)
def test_sweeps_of_a_scan_move_with_the_sensor(bench: CompanionBench) -> None:
    """The odometry knows how far it went from one to the next."""
    run = recording("room", "walk", 6.0)
    builder = bench.nodes[1]._scan._builder
    add, motions = builder.add, []

    def noted(points: Any, T_scan_cloud: Any, T_now_before: Any) -> Any:
        motions.append(T_now_before)
        return add(points, T_scan_cloud, T_now_before)

    builder.add = noted
    sent = play(bench, run, 5.5)
    starts = np.array([sweep.start for sweep in sent])
    positions, q = truth(run, starts)
    for number in range(-8, 0):
        before, now = number - 1, number
        back = rotations.conjugate(q[now])
        way = rotations.rotate(back, positions[before] - positions[now])
        assert np.linalg.norm(way) > 0.05
        np.testing.assert_allclose(motions[now][:3, 3], way, atol=0.01)
        turn = rotations.matrices(rotations.multiply(back, q[before]))
        np.testing.assert_allclose(motions[now][:3, :3], turn, atol=0.01)


def test_one_goes_on_while_a_manager_takes_the_other_out_and_back(bench: CompanionBench) -> None:
    """Clouds are still deskewed, and poses come again, each before its cloud."""
    odometry, deskew = bench.nodes
    run = recording("room", "walk", 6.0)
    sent = play(bench, run, 2.0)
    bench.until(lambda: len(bench.poses) >= len(sent) - 1)
    odometry.trigger_deactivate()
    odometry.trigger_cleanup()
    assert odometry.state_label == "unconfigured"
    assert bench.clouds_out.get_subscription_count() == 1  # the same subscription
    bench.poses.clear()
    bench.clouds.clear()
    play(bench, run, 1.0)
    assert not bench.poses
    assert deskew._last.values["velocity source"] != "odometry"
    odometry.trigger_configure()
    odometry.trigger_activate()
    bench.clouds.clear()
    play(bench, run, 3.0)
    bench.until(lambda: bench.poses)
    assert deskew._last.values["velocity source"] == "odometry"
    for node in bench.nodes:
        node.trigger_deactivate()
    bench.until(lambda: not bench.clouds_out.get_subscription_count())
    assert not bench.imu_out.get_subscription_count()


def test_the_deskew_knows_unit_and_sign_that_the_odometry_finds(bench: CompanionBench) -> None:
    """An accelerometer in g and with the opposite sign: the level frame is not upside down."""
    odometry, deskew = bench.nodes
    imu = recording("yard", "walk", 7.0).imu.copy()
    imu["linear_acceleration"] /= -STANDARD_GRAVITY
    sent = play(bench, replace(recording("yard", "walk", 7.0), imu=imu), 7.0)
    assert odometry._pipeline.convention.in_g
    assert odometry._pipeline.convention.reversed
    assert deskew._pipeline.tracker.up(sent[-1].start)[2] > 0.98
    assert not deskew._pipeline.tracker.filter.is_faulty
    bench.until(lambda: any(told(status) for status in bench.diagnostics))


def told(status: DiagnosticStatus) -> bool:
    values = {item.key: item.value for item in status.values}
    return status.name == "deskew_node: deskew" and "opposite sign" in values.get("recognized", "")


@pytest.mark.parametrize("bench", [("deskew_node:imu_topic:=/other/imu",)], indirect=True)
def test_other_topics_have_subscriptions_of_their_own(bench: CompanionBench) -> None:
    odometry, deskew = bench.nodes
    assert deskew._sensors is not odometry.sensors
    assert deskew._pipeline.odometry_motion is None
    assert deskew._pipeline.odometry_convention is None
    assert odometry.get_parameter("imu_topic").value == "/imu/data"


WHEELS = ("deskew_node:velocity_type:=twist", "deskew_node:velocity_topic:=wheels")


@pytest.mark.parametrize("bench", [WHEELS], indirect=True)
def test_another_source_of_velocity_is_respected(bench: CompanionBench) -> None:
    odometry, deskew = bench.nodes
    assert deskew._sensors is odometry.sensors
    assert deskew._pipeline.odometry_motion is None


def test_twists_on_the_topic_of_the_odometry_are_refused() -> None:
    with pytest.raises(SettingError, match=r"velocity_topic.*not twists"):
        CompanionBench(WHEELS[:1])
    rclpy.shutdown()
