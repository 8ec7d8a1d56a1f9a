"""The example policies allow each node what it does, and nothing else."""

from __future__ import annotations

import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

rclpy = pytest.importorskip("rclpy")

from rclpy.node import Node  # noqa: E402  after importorskip

from l2lidar_node.demo.processes import assigned, free_ros_domain, free_udp_ports  # noqa: E402
from l2lidar_node.ros.driver_node import DriverNode  # noqa: E402
from l2lidar_proc.ros.deskew_node import DeskewNode  # noqa: E402
from l2lidar_proc.ros.odometry_node import OdometryNode  # noqa: E402
from l2lidar_proc.ros.slam_node import SlamNode  # noqa: E402

pytestmark = pytest.mark.ros

FOLDER = Path(__file__).resolve().parents[3] / "config" / "security"
NODES: dict[str, Callable[[], Any]] = {
    "l2lidar_node": DriverNode,
    "deskew_node": DeskewNode,
    "odometry_node": OdometryNode,
    "slam_node": SlamNode,
}
AT_TIMES = {  # only in a replay, with use_sim_time, and once somebody publishes clouds
    "l2lidar_node": {"publish /clock", "subscribe /clock", "publish /l2lidar_node/packets"},
    "deskew_node": {"subscribe /clock", "request /l2lidar_node/get_parameters"},
    "odometry_node": {"subscribe /clock"},
    "slam_node": {"subscribe /clock"},
}
TIMEOUT_S = 60.0
ALWAYS = ("/rosout", "/parameter_events")
OWN_SERVICES = {
    f"reply /{node}/{service}"
    for node, services in {
        "odometry_node": ("reset", "save_map", "save_trajectory"),
        "slam_node": ("save", "load", "reset", "relocalize", "set_localization"),
    }.items()
    for service in services
}
"""Services that are there only while the node is configured."""


def allowed(path: Path) -> set[str]:
    """Return what a policy allows, such as ``publish /points``."""
    root = ElementTree.parse(path).getroot()
    assert (root.tag, root.get("version")) == ("policy", "0.2.0")
    (profile,) = root.iter("profile")
    name = profile.get("node")
    found = set()
    for group in profile:
        for verb, permission in group.attrib.items():
            assert permission == "ALLOW"
            for item in group:
                assert item.text
                text = item.text.replace("~", f"/{name}", 1)
                assert text.startswith("/")
                assert f"{verb} {text}" not in found
                found.add(f"{verb} {text}")
    return found


def used(node: Node) -> set[str]:
    """Return what a running node does."""
    name = node.get_name()
    return {
        f"{verb} {topic}"
        for verb, look in (
            ("publish", node.get_publisher_names_and_types_by_node),
            ("subscribe", node.get_subscriber_names_and_types_by_node),
            ("reply", node.get_service_names_and_types_by_node),
            ("request", node.get_client_names_and_types_by_node),
        )
        for topic, _ in look(name, "/")
    }


@pytest.mark.parametrize("name", NODES)
def test_a_policy_allows_what_its_node_does_and_nothing_else(name: str) -> None:
    if name == "slam_node":
        pytest.importorskip("gtsam")
    host, lidar = free_udp_ports(2)
    values: dict[str, object] = {
        "l2_ip": "127.0.0.1",
        "host_ip": "127.0.0.1",
        "l2_port": lidar,
        "host_port": host,
        "enable_IMU_publishing": True,
        "compressed_clouds": "lossless",
    }
    # In a domain of its own: what another test's processes left behind there would be asked, too.
    given = assigned(values) if name == "l2lidar_node" else []
    rclpy.init(args=["test", *given], domain_id=free_ros_domain())
    may = allowed(FOLDER / f"{name}.xml")
    at_times = AT_TIMES[name]
    node = NODES[name]()

    def matches(expected: set[str]) -> bool:
        """Tell whether that is what the node does; the middleware's view of it lags behind."""
        does = used(node)
        return does <= may and expected - at_times <= does <= expected | at_times

    try:
        until(lambda: matches(may), lambda: f"policy {may ^ used(node)}")
        node.trigger_deactivate()
        node.trigger_cleanup()  # what was configured goes, and comes back with it
        topics = {f"publish {topic}" for topic in ALWAYS} | {f"publish /{name}/transition_event"}
        idle = topics | {item for item in may if item.startswith("reply")} - OWN_SERVICES
        until(lambda: matches(idle), lambda: f"left {used(node) ^ idle}")
        node.trigger_configure()
        node.trigger_activate()
        until(lambda: matches(may), lambda: f"again {may ^ used(node)}")
    finally:
        node.destroy_node()
        rclpy.shutdown()


def until(condition: Callable[[], bool], problem: Callable[[], str]) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline, problem()
        time.sleep(0.01)


def test_the_operator_may_call_every_service_that_is_theirs() -> None:
    may = allowed(FOLDER / "operator.xml")
    common = {"get_type_description"}
    for name in NODES:
        for permission in allowed(FOLDER / f"{name}.xml"):
            verb, _, service = permission.partition(" ")
            if verb == "reply" and service.rpartition("/")[2] not in common:
                assert f"request {service}" in may
