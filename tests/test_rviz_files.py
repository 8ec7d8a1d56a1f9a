"""RViz layouts: classes that exist, topics that are published, QoS and docks that fit."""

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from l2lidar_node.config import FrameConfig
from l2lidar_node.ros import topics
from l2lidar_node.types import POINT
from l2lidar_proc.deskew.config import DeskewTopics
from l2lidar_proc.odometry.config import OdometryTopics
from l2lidar_proc.slam.config import SlamTopics

LAYOUTS = Path(__file__).resolve().parent.parent / "rviz"
FIXED_FRAMES = {
    "rvizl2lidar.rviz": FrameConfig().cloud,
    "rvizl2lidar_example.rviz": "base_link",
    "slam.rviz": "odom",
    "lio_sam.rviz": "odom",
    "map.rviz": "map",
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
    topics.LIO_SAM_CLOUD: "PointCloud2",
    topics.LIO_SAM_MAP: "PointCloud2",
    topics.LIO_SAM_PATH: "Path",
    topics.LIO_SAM_ODOMETRY: "Odometry",
    topics.ODOMETRY: "Odometry",
    topics.MAP_POINTS: "PointCloud2",
    topics.MAP_PATH: "Path",
    topics.GRAPH: "MarkerArray",
    topics.ROBOT_DESCRIPTION: "RobotModel",
}


def load(name: Any) -> Any:
    return yaml.safe_load((LAYOUTS / name).read_text())


def displays(name: Any) -> Any:
    def walk(found: Any) -> Iterator[Any]:
        for display in found:
            yield display
            yield from walk(display.get("Displays", []))

    return list(walk(load(name)["Visualization Manager"]["Displays"]))


def topic_of(display: Any) -> Any:
    return display.get("Topic") or display.get("Description Topic")


def test_topics_and_frame_are_those_of_the_companions() -> None:
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
    slam = SlamTopics()
    assert f"/{slam.map_topic}" == topics.MAP_POINTS
    assert f"/{slam.path_topic}" == topics.MAP_PATH
    assert f"/{slam.graph_topic}" == topics.GRAPH
    assert slam.map_frame == FIXED_FRAMES["map.rviz"]
    assert slam.odometry_topic == odometry.odometry_topic
    assert slam.cloud_topic == odometry.deskewed_topic
    assert slam.odometry_status_topic == odometry.status_topic


def test_layouts_are_those_known() -> None:
    assert {path.name for path in LAYOUTS.iterdir()} == set(FIXED_FRAMES)


@pytest.mark.parametrize("name", FIXED_FRAMES)
def test_fixed_frame_is_one_that_is_published(name: Any) -> None:
    options = load(name)["Visualization Manager"]["Global Options"]
    assert options["Fixed Frame"] == FIXED_FRAMES[name]


@pytest.mark.parametrize("name", FIXED_FRAMES)
def test_classes_exist(name: Any) -> None:
    layout = load(name)
    manager = layout["Visualization Manager"]
    assert {display["Class"] for display in displays(name)} <= DISPLAYS
    assert {tool["Class"] for tool in manager["Tools"]} <= TOOLS
    assert {panel["Class"] for panel in layout["Panels"]} <= PANELS
    assert manager["Views"]["Current"]["Class"] == "rviz_default_plugins/Orbit"
    assert manager["Transformation"]["Current"]["Class"] == "rviz_default_plugins/TF"


@pytest.mark.parametrize("name", FIXED_FRAMES)
def test_displays_are_told_apart_and_on_or_off_in_both_places(name: Any) -> None:
    names = [display["Name"] for display in displays(name)]
    assert len(set(names)) == len(names)
    for display in displays(name):
        assert display["Enabled"] == display["Value"]
    expanded = load(name)["Panels"][0]["Property Tree Widget"]["Expanded"]
    assert {path.strip("/").rstrip("1") for path in expanded} <= set(names)


@pytest.mark.parametrize("name", FIXED_FRAMES)
def test_topics_are_those_of_the_nodes(name: Any) -> None:
    named = [display for display in displays(name) if topic_of(display)]
    assert named
    for display in named:
        topic = topic_of(display)["Value"]
        assert topic in (*topics.SHOWN_TOPICS, *topics.LIO_SAM_TOPICS)
        assert display["Class"] == f"rviz_default_plugins/{KINDS[topic]}"


@pytest.mark.parametrize("name", FIXED_FRAMES)
def test_qos_reaches_every_publisher(name: Any) -> None:
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
def test_clouds_are_coloured_by_what_they_carry(name: Any) -> None:
    clouds = [display for display in displays(name) if display["Class"].endswith("PointCloud2")]
    assert clouds
    for cloud in clouds:
        assert cloud["Color Transformer"] in COLOURS
        assert cloud["Position Transformer"] == "XYZ"
        assert cloud["Style"] in STYLES
        if cloud["Color Transformer"] == "Intensity":
            assert cloud["Channel Name"] in (POINT.names or ())
            assert cloud["Autocompute Intensity Bounds"] is False
            assert cloud["Min Intensity"] < cloud["Max Intensity"]


def test_sensor_alone_is_coloured_by_range_or_time() -> None:
    clouds = {d["Channel Name"]: d for d in displays("rvizl2lidar.rviz") if "Channel Name" in d}
    assert clouds["range"]["Enabled"]
    assert (clouds["range"]["Min Intensity"], clouds["range"]["Max Intensity"]) == (0, 5)
    assert not clouds["time"]["Enabled"]


def test_slam_shows_raw_beside_deskewed_and_where_the_sensor_went() -> None:
    shown = {
        topic_of(display)["Value"]
        for display in displays("slam.rviz")
        if topic_of(display) and display["Enabled"]
    }
    assert shown == {
        topics.REGISTERED_POINTS, topics.POINTS_DESKEWED, topics.POINTS,
        topics.LOCAL_MAP, topics.PATH, topics.ODOMETRY,
    }  # fmt: skip
    clouds = [d["Name"] for d in displays("slam.rviz") if d["Class"].endswith("/PointCloud2")]
    assert clouds[0] == "Registered"
    raw, deskewed = (
        next(d for d in displays("slam.rviz") if d["Name"] == name) for name in ("Raw", "Deskewed")
    )
    assert raw["Color Transformer"] == deskewed["Color Transformer"] == "FlatColor"
    assert raw["Color"] != deskewed["Color"]
    assert any(display["Class"].endswith("/TF") for display in displays("slam.rviz"))


class Dock(NamedTuple):
    """A panel as ``QMainWindow::saveState`` stores it."""

    area: str
    is_visible: bool
    size: int


class Docks:
    """Reads ``QMainWindow::saveState`` as Qt 5 and 6 write it, one dock in each area.

    Big-endian: marker 0xff and version; marker 0xfd, number of areas, and for each its side, size,
    orientation and docks (name, flags, position, size, least and greatest size); the size of the
    central widget; who owns the four corners; the tool bars.
    """

    SIDES = ("left", "right", "top", "bottom")

    def __init__(self, state: Any) -> None:
        self._bytes, self._at = bytes.fromhex(state), 0
        assert self._take(">iiB") == (0xFF, 0, 0xFD)
        self.docks, self.areas = {}, {}
        for _ in range(*self._take(">i")):
            side, width, height = self._take(">iii")
            self.areas[self.SIDES[side]] = (width, height)
            marker, orientation, count = self._take(">Bbi")
            assert (marker, count) == (0xFC, 1)
            assert orientation == (2 if side < 2 else 1)  # vertical beside, horizontal below
            (marker,) = self._take(">B")
            assert marker == 0xFB
            name, (flags, _, size, _, _) = self._text(), self._take(">Biiii")
            assert not flags & 2, f"{name} floats"
            self.docks[name] = Dock(self.SIDES[side], bool(flags & 1), size)
        self.central = self._take(">ii")
        self._take(">4i")
        marker, lines, position, count = self._take(">Biii")
        assert (marker, lines, position, count) == (0xFC, 1, 2, 1)  # one line of bars, above
        self.tool_bar = self._text()

    def _take(self, form: Any) -> Any:
        found = struct.unpack_from(form, self._bytes, self._at)
        self._at += struct.calcsize(form)
        return found

    def _text(self) -> Any:
        (length,) = self._take(">i")
        self._at += length
        return self._bytes[self._at - length : self._at].decode("utf-16-be")


@pytest.mark.parametrize("name", FIXED_FRAMES)
def test_window_opens_with_the_3d_view_at_most_of_its_width(name: Any) -> None:
    layout = load(name)
    geometry = layout["Window Geometry"]
    saved = Docks(geometry["QMainWindow State"])
    # RViz names a dock after its panel, and restores only docks of those names.
    assert set(saved.docks) == {panel["Name"] for panel in layout["Panels"]}
    assert saved.tool_bar == "Tools"
    assert {name: dock.area for name, dock in saved.docks.items()} == {
        "Displays": "left", "Views": "right", "Time": "bottom"
    }  # fmt: skip
    for panel, dock in saved.docks.items():
        assert dock.is_visible == (panel == "Displays")
        assert geometry.get(panel, {"collapsed": False})["collapsed"] == (not dock.is_visible)
    # What is hidden has a size to come back with.
    assert saved.areas["right"][0] >= 200
    assert saved.areas["bottom"][1] >= 40
    buttons = 2 * 16  # beside the 3D view, to hide the docks
    assert saved.central[0] - buttons >= 0.7 * geometry["Width"]
    assert saved.central[0] + saved.areas["left"][0] <= geometry["Width"]
    assert 0.85 * geometry["Height"] <= saved.central[1] < geometry["Height"]


@pytest.mark.parametrize("name", FIXED_FRAMES)
def test_qt_restores_the_window(name: Any) -> None:
    pytest.importorskip("PySide6.QtWidgets", reason="needs Qt (pip install PySide6-Essentials)")
    from PySide6 import QtCore, QtWidgets

    geometry = load(name)["Window Geometry"]
    # Kept by name: where it is collected, so are all widgets.
    application = QtWidgets.QApplication.instance() or QtWidgets.QApplication(
        ["test", "-platform", "offscreen"]
    )
    window = QtWidgets.QMainWindow()
    window.setCentralWidget(QtWidgets.QWidget())
    window.addToolBar("Tools").setObjectName("Tools")
    window.menuBar().addMenu("File")
    window.statusBar()
    docks = {panel["Name"]: QtWidgets.QDockWidget() for panel in load(name)["Panels"]}
    for panel, dock in docks.items():
        dock.setObjectName(panel)
        dock.setWidget(QtWidgets.QWidget())
        window.addDockWidget(QtCore.Qt.DockWidgetArea.LeftDockWidgetArea, dock)
    window.show()
    application.processEvents()
    window.resize(geometry["Width"], geometry["Height"])
    state = QtCore.QByteArray.fromHex(geometry["QMainWindow State"].encode())
    assert window.restoreState(state)
    application.processEvents()
    assert [panel for panel, dock in docks.items() if dock.isVisible()] == ["Displays"]
    assert window.centralWidget().width() - 32 >= 0.7 * geometry["Width"]


@pytest.mark.parametrize("name", FIXED_FRAMES)
def test_names_of_frames_can_be_read(name: Any) -> None:
    (tf,) = (display for display in displays(name) if display["Class"].endswith("/TF"))
    view = load(name)["Visualization Manager"]["Views"]["Current"]
    # RViz's camera opens 45 degrees; a name is 0.1 m high at a marker scale of 1.
    height = load(name)["Window Geometry"]["Height"] * 0.9
    pixels = 0.1 * tf["Marker Scale"] * height / (2 * view["Distance"] * math.tan(math.pi / 8))
    assert pixels >= 12
    assert 0.2 * tf["Marker Scale"] <= 0.1 * view["Distance"], "axes that fill the view"
    # 17 mm beside the sensor's frame, the IMU's name would be written over that one's.
    assert tf["Filter (blacklist)"] == "_imu$"
