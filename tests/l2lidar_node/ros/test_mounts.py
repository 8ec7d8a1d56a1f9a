"""The example robots with a virtual L2 on them: points are where the world is, in base_link."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from geometry_msgs.msg import TransformStamped  # noqa: E402  after importorskip
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

from l2lidar_node.config import FrameConfig  # noqa: E402
from l2lidar_node.demo.report import as_message, floor_and_ceiling, mount, moved  # noqa: E402
from l2lidar_node.ros.diagnostics import MAX_TILT_DEG, MountMonitor  # noqa: E402
from l2lidar_node.types import Level  # noqa: E402
from tests.l2lidar_node.ros.rig import TIMEOUT_S, open_rig  # noqa: E402
from tests.support.odometry_runs import record, sweeps  # noqa: E402

pytestmark = pytest.mark.ros

MOUNTS = {"top": "upright", "forward": "forward"}
SENSOR_HEIGHT = 1.0  # of the built-in motions
CEILING = 2.8  # of the built-in room
BAND = 0.06  # [m] range noise and the onboard orientation's error included


def heights(points: Any, pose: Any) -> Any:
    """Return the heights of points (N,) above base_link's origin [m]."""
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1)
    return xyz @ pose[2, :3] + pose[2, 3]


def is_upright(points: Any, pose: Any) -> Any:
    """Return whether floor and ceiling are at their heights in base_link, and nothing beyond."""
    floor = pose[2, 3] - SENSOR_HEIGHT
    z = heights(points, pose)
    shares = [np.mean(np.abs(z - at) < BAND) for at in (floor, floor + CEILING)]
    beyond = np.mean((z < floor - 2 * BAND) | (z > floor + CEILING + 2 * BAND))
    sees_floor = pose[2, 2] < 0.5  # an upright L2 sees nothing below its own horizon
    return bool(shares[1] > 0.1 and (shares[0] > 0.1 or not sees_floor) and beyond < 0.001)


@pytest.mark.parametrize(("example", "emulated"), MOUNTS.items())
def test_points_as_measured_are_upright_on_every_example_robot(
    example: Any, emulated: Any
) -> None:
    run = record("room", "still", 0, 1.0, mount=emulated)
    points = list(sweeps(run, "turn"))[1].points
    pose = mount(example)
    assert is_upright(points, pose)
    _, ceiling = floor_and_ceiling(moved(points, pose))
    assert ceiling == pytest.approx(pose[2, 3] - SENSOR_HEIGHT + CEILING, abs=BAND)
    # Turned upright already, and then by TF once more: right where the mount is level.
    leveled = points.copy()
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1) @ pose[:3, :3].T
    for axis, values in zip("xyz", xyz.T, strict=True):
        leveled[axis] = values
    assert is_upright(leveled, pose) == (example == "top")


@pytest.fixture
def node() -> Iterator[Any]:
    rclpy.init()
    made = rclpy.create_node("driver")
    yield made
    made.destroy_node()
    rclpy.shutdown()


def publish(node: Any, monitor: Any, message: Any, frame: Any) -> None:
    """Publish static transforms and wait until the monitor has them."""
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(TFMessage, "/tf_static", latched)
    publisher.publish(message)
    deadline = time.monotonic() + TIMEOUT_S
    while monitor.tilt_deg()[0] != frame:
        assert time.monotonic() < deadline, f"nothing above is known but {monitor.tilt_deg()}"
        rclpy.spin_once(node, timeout_sec=0.05)


@pytest.mark.parametrize(
    ("example", "tilt", "level"), [("top", 0.0, Level.OK), ("forward", 90.0, Level.WARN)]
)
def test_a_mount_that_is_not_level_is_warned_of_where_points_are_leveled(
    node: Any, example: str, tilt: float, level: Any
) -> None:
    monitor = MountMonitor(node, FrameConfig().cloud)
    assert monitor.judge(True) is None, "no mount, nothing to say"
    publish(node, monitor, as_message(mount(example)), "base_link")
    assert monitor.tilt_deg()[1] == pytest.approx(tilt, abs=1e-3)
    assert monitor.judge(True).level == level
    assert monitor.judge(False).level == Level.OK
    if level == Level.WARN:
        assert "set imu_adjust: false" in monitor.judge(True).message


def test_a_chain_of_frames_is_followed_and_loops_and_damage_are_not(node: Any) -> None:
    monitor = MountMonitor(node, "lidar")
    chain = TFMessage()
    for parent, child, roll in (("base", "mast", 40.0), ("mast", "lidar", -40.0 + MAX_TILT_DEG)):
        item = TransformStamped(child_frame_id=child)
        item.header.frame_id = parent
        turn = item.transform.rotation
        turn.x, turn.y, turn.z, turn.w = Rotation.from_euler("x", roll, degrees=True).as_quat()
        chain.transforms.append(item)
    damaged = TransformStamped(child_frame_id="base")
    damaged.header.frame_id = "nowhere"
    damaged.transform.rotation.w = float("nan")
    chain.transforms.append(damaged)
    publish(node, monitor, chain, "base")
    assert monitor.tilt_deg()[1] == pytest.approx(MAX_TILT_DEG, abs=1e-6)
    loop = TransformStamped(child_frame_id="base")
    loop.header.frame_id = "lidar"
    loop.transform.rotation.w = 1.0
    before = monitor._frames.version
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(TFMessage, "/tf_static", latched)
    publisher.publish(TFMessage(transforms=[loop]))
    deadline = time.monotonic() + TIMEOUT_S
    while monitor._frames.version == before:
        assert time.monotonic() < deadline
        rclpy.spin_once(node, timeout_sec=0.05)
    assert np.isfinite(monitor.tilt_deg()[1])


def test_the_driver_warns_and_its_points_come_upright_once_told() -> None:
    """The example that looks ahead, with the driver's own defaults first."""
    pose = mount("forward")
    with open_rig() as rig:
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        publisher = rig.observer.create_publisher(TFMessage, "/tf_static", latched)
        publisher.publish(as_message(pose))
        rig.emulator("--ready", "--world", "room", "--motion", "still", "--mount", "forward")
        rig.driver(imu_adjust=True, sweep_cut="turn")
        checks = rig.observer

        def mount_check() -> Any:
            return checks.checks.get("mount", {})

        rig.wait_for(lambda: "is applied twice" in mount_check().get("message", ""), "a warning")
        rig.wait_for(lambda: rig.observer.cloud is not None, "a cloud")
        assert not is_upright(rig.observer.cloud, pose)
        from rcl_interfaces.srv import SetParameters

        request = SetParameters.Request(
            parameters=[Parameter("imu_adjust", value=False).to_parameter_msg()]
        )
        rig.call(SetParameters, "/l2lidar_node/set_parameters", request)
        seen = len(rig.observer.points)
        # The sweep that is being collected may be half of each.
        rig.wait_for(lambda: len(rig.observer.points) >= seen + 3, "clouds as measured")
        assert is_upright(rig.observer.cloud, pose)
        rig.wait_for(lambda: "tilted by 90" in mount_check().get("message", ""), "all clear")
