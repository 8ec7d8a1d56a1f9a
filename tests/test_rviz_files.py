"""Every RViz layout names classes that exist, topics that are published, and QoS that fits."""

from pathlib import Path

import pytest
import yaml

from l2lidar_node.config import FrameConfig
from l2lidar_node.ros import topics
from l2lidar_node.types import POINT
from l2lidar_proc.config import DeskewTopics
from l2lidar_proc.odometry_config import OdometryTopics

LAYOUTS = Path(__file__).resolve().parent.parent / "rviz"
FIXED_FRAMES = {
    "rvizl2lidar.rviz": FrameConfig().cloud,
    "rvizl2lidar_example.rviz": "base_link",
    "slam.rviz": "odom",
}
# Of rviz_common and rviz_default_plugins as Jazzy has them (14.1).
DISPLAYS = {
    "rviz_common/Group",
    *(
        f"rviz_default_plugins/{name}"
        for name in (
            "AccelStamped", "Axes", "Camera", "CameraInfo", "DepthCloud", "Effort",
            "FluidPressure", "Grid", "GridCells", "Illuminance", "Image", "InteractiveMarkers",
            "LaserScan", "Map",
            "Marker", "MarkerArray", "Odometry", "Path", "PointCloud", "PointCloud2",
            "PointStamped", "Polygon", "Pose", "PoseArray", "PoseWithCovariance", "Range",
            "RelativeHumidity", "RobotModel", "TF", "Temperature", "TwistStamped", "Wrench",
        )
    ),
}  # fmt: skip
TOOLS = {
    f"rviz_default_plugins/{name}"
    for name in (
        "FocusCamera", "Interact", "Measure", "MoveCamera", "PublishPoint", "Select", "SetGoal",
        "SetInitialPose",
    )
}  # fmt: skip
PANELS = {f"rviz_common/{name}" for name in ("Displays", "Selection", "Time", "Views")}
COLOURS = {"AxisColor", "FlatColor", "Intensity", "RGB8", "RGBF32"}
STYLES = {"Points", "Squares", "Flat Squares", "Spheres", "Boxes", "Tiles"}
KINDS = {
    topics.POINTS: "PointCloud2",
    topics.POINTS_DESKEWED: "PointCloud2",
    topics.REGISTERED_POINTS: "PointCloud2",
    topics.LOCAL_MAP: "PointCloud2",
    topics.PATH: "Path",
    topics.ODOMETRY: "Odometry",
    topics.ROBOT_DESCRIPTION: "RobotModel",
}


def load(name):
    return yaml.safe_load((LAYOUTS / name).read_text())


def displays(name):
    def walk(found):
        for display in found:
            yield display
            yield from walk(display.get("Displays", []))

    return list(walk(load(name)["Visualization Manager"]["Displays"]))


def topic_of(display):
    return display.get("Topic") or display.get("Description Topic")


def test_topics_and_frame_are_those_of_the_companions():
    deskew, odometry = DeskewTopics(), OdometryTopics()
    assert (deskew.cloud_topic, deskew.imu_topic) == topics.DRIVER_TOPICS
    assert (odometry.cloud_topic, odometry.imu_topic) == topics.DRIVER_TOPICS
    # Named without a slash: they follow the namespace by themselves.
    assert f"/{deskew.output_topic}" == topics.POINTS_DESKEWED
    assert f"/{odometry.registered_topic}" == topics.REGISTERED_POINTS
    assert f"/{odometry.map_topic}" == topics.LOCAL_MAP
    assert f"/{odometry.path_topic}" == topics.PATH
    assert f"/{odometry.odometry_topic}" == f"/{deskew.velocity_topic}" == topics.ODOMETRY
    assert odometry.odom_frame == FIXED_FRAMES["slam.rviz"]


def test_layouts_are_those_known():
    assert {path.name for path in LAYOUTS.iterdir()} == set(FIXED_FRAMES)


@pytest.mark.parametrize("name", FIXED_FRAMES)
def test_fixed_frame_is_one_that_is_published(name):
    options = load(name)["Visualization Manager"]["Global Options"]
    assert options["Fixed Frame"] == FIXED_FRAMES[name]


@pytest.mark.parametrize("name", FIXED_FRAMES)
def test_classes_exist(name):
    layout = load(name)
    manager = layout["Visualization Manager"]
    assert {display["Class"] for display in displays(name)} <= DISPLAYS
    assert {tool["Class"] for tool in manager["Tools"]} <= TOOLS
    assert {panel["Class"] for panel in layout["Panels"]} <= PANELS
    assert manager["Views"]["Current"]["Class"] == "rviz_default_plugins/Orbit"
    assert manager["Transformation"]["Current"]["Class"] == "rviz_default_plugins/TF"


@pytest.mark.parametrize("name", FIXED_FRAMES)
def test_displays_are_told_apart_and_on_or_off_in_both_places(name):
    names = [display["Name"] for display in displays(name)]
    assert len(set(names)) == len(names)
    for display in displays(name):
        assert display["Enabled"] == display["Value"]
    expanded = load(name)["Panels"][0]["Property Tree Widget"]["Expanded"]
    assert {path.strip("/").rstrip("1") for path in expanded} <= set(names)


@pytest.mark.parametrize("name", FIXED_FRAMES)
def test_topics_are_those_of_the_nodes(name):
    named = [display for display in displays(name) if topic_of(display)]
    assert named
    for display in named:
        topic = topic_of(display)["Value"]
        assert topic in topics.SHOWN_TOPICS
        assert display["Class"] == f"rviz_default_plugins/{KINDS[topic]}"


@pytest.mark.parametrize("name", FIXED_FRAMES)
def test_qos_reaches_every_publisher(name):
    for display in displays(name):
        topic = topic_of(display)
        if not topic:
            continue
        assert topic["History Policy"] == "Keep Last"
        assert topic["Depth"] >= 1
        if topic["Value"] == topics.ROBOT_DESCRIPTION:
            assert topic["Durability Policy"] == "Transient Local"
            assert topic["Reliability Policy"] == "Reliable"
        else:
            # Asking for more than the publisher offers would mean no messages at all.
            assert topic["Durability Policy"] == "Volatile"
            if display["Class"].endswith(("PointCloud2", "Odometry")):  # selectable on both
                assert topic["Reliability Policy"] == "Best Effort"


@pytest.mark.parametrize("name", FIXED_FRAMES)
def test_clouds_are_coloured_by_what_they_carry(name):
    clouds = [display for display in displays(name) if display["Class"].endswith("PointCloud2")]
    assert clouds
    for cloud in clouds:
        assert cloud["Color Transformer"] in COLOURS
        assert cloud["Position Transformer"] == "XYZ"
        assert cloud["Style"] in STYLES
        if cloud["Color Transformer"] == "Intensity":
            assert cloud["Channel Name"] in POINT.names
            assert cloud["Autocompute Intensity Bounds"] is False
            assert cloud["Min Intensity"] < cloud["Max Intensity"]


def test_sensor_alone_is_coloured_by_range_or_time():
    clouds = {d["Channel Name"]: d for d in displays("rvizl2lidar.rviz") if "Channel Name" in d}
    assert clouds["range"]["Enabled"]
    assert (clouds["range"]["Min Intensity"], clouds["range"]["Max Intensity"]) == (0, 5)
    assert not clouds["time"]["Enabled"]


def test_slam_shows_raw_beside_deskewed_and_where_the_sensor_went():
    shown = {
        topic_of(display)["Value"]
        for display in displays("slam.rviz")
        if topic_of(display) and display["Enabled"]
    }
    assert shown == {
        topics.POINTS, topics.POINTS_DESKEWED, topics.LOCAL_MAP, topics.PATH, topics.ODOMETRY
    }  # fmt: skip
    raw, deskewed = (
        next(d for d in displays("slam.rviz") if d["Name"] == name) for name in ("Raw", "Deskewed")
    )
    assert raw["Color Transformer"] == deskewed["Color Transformer"] == "FlatColor"
    assert raw["Color"] != deskewed["Color"]
    assert any(display["Class"].endswith("/TF") for display in displays("slam.rviz"))
