"""Shows what the nodes publish in rerun: clouds raw and deskewed, path, map, IMU plots, health."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu, PointCloud2

from l2lidar_node.ros.conversions import from_cloud, from_time

_ODOMETRY: Final = "world"
_SENSOR: Final = f"{_ODOMETRY}/sensor"
_MAX_RANGE_M: Final = 10.0  # end of the colour scale
_DISPLAYS: Final = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
_LEVELS: Final = {0: "INFO", 1: "WARN", 2: "ERROR", 3: "ERROR"}


class ViewerError(RuntimeError):
    """The viewer cannot be had; the message says what to do."""


class ViewerNode(Node):
    """Hands every message to rerun.

    Parameters
    ----------
    rerun : module
        The rerun SDK, initialised.
    topics : dict
        Topic names by role: ``raw``, ``deskewed``, ``map``, ``imu``, ``odometry``.
    """

    def __init__(self, rerun: Any, topics: dict[str, str]) -> None:
        super().__init__("l2lidar_viewer")
        self.messages = 0
        self._rerun = rerun
        self._track: list[tuple[float, float, float]] = []
        rerun.log(_ODOMETRY, rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        sensor_data = qos_profile_sensor_data
        clouds = {"raw": f"{_SENSOR}/raw", "deskewed": f"{_SENSOR}/deskewed"}
        for role, entity in {**clouds, "map": f"{_ODOMETRY}/map"}.items():
            self.create_subscription(
                PointCloud2,
                topics[role],
                lambda message, entity=entity: self._cloud(message, entity),
                sensor_data,
            )
        self.create_subscription(Imu, topics["imu"], self._imu, sensor_data)
        self.create_subscription(Odometry, topics["odometry"], self._odometry, sensor_data)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._health, 10)

    def _at(self, stamp: Any) -> None:
        self.messages += 1
        self._rerun.set_time("stamp", timestamp=np.datetime64(from_time(stamp), "ns"))

    def _cloud(self, message: PointCloud2, entity: str) -> None:
        self._at(message.header.stamp)
        points = from_cloud(message)
        xyz = np.stack([points[name] for name in ("x", "y", "z")], axis=1)
        distance = np.linalg.norm(xyz, axis=1)
        self._rerun.log(
            entity, self._rerun.Points3D(xyz, colors=range_colours(distance), radii=0.012)
        )

    def _imu(self, message: Imu) -> None:
        self._at(message.header.stamp)
        rate, force = message.angular_velocity, message.linear_acceleration
        scalars = self._rerun.Scalars
        self._rerun.log("imu/rate", scalars([rate.x, rate.y, rate.z]))
        self._rerun.log("imu/specific_force", scalars([force.x, force.y, force.z]))

    def _odometry(self, message: Odometry) -> None:
        self._at(message.header.stamp)
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        self._rerun.log(
            _SENSOR,
            self._rerun.Transform3D(
                translation=[place.x, place.y, place.z],
                quaternion=self._rerun.Quaternion(xyzw=[turn.x, turn.y, turn.z, turn.w]),
            ),
        )
        self._track.append((place.x, place.y, place.z))
        self._rerun.log(f"{_ODOMETRY}/path", self._rerun.LineStrips3D([self._track]))

    def _health(self, message: DiagnosticArray) -> None:
        self._at(message.header.stamp)
        for status in message.status:
            text = f"{status.name}: {status.message}"
            level = _LEVELS.get(status.level[0], "INFO")
            self._rerun.log("health", self._rerun.TextLog(text, level=level))


def range_colours(distance: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return colours from red (near) over green to blue (far), shape (N, 3)."""
    share = np.clip(distance / _MAX_RANGE_M, 0.0, 1.0)[:, None]
    peaks = np.array([[0.1, 0.5, 0.9]])
    return np.asarray(255 * np.clip(1.4 - 2.8 * np.abs(share - peaks), 0.0, 1.0), np.uint8)


def open_viewer(web: bool, save: Path | None) -> Any:
    """Return the rerun SDK with a window, a browser page or a file to draw into.

    Raises
    ------
    ViewerError
        If rerun is not installed or its window cannot be opened.
    """
    try:
        import rerun
        import rerun.blueprint as blueprint
    except ImportError:
        raise ViewerError(
            "the viewer needs rerun: install it with `pip install rerun-sdk`"
        ) from None
    layout = blueprint.Blueprint(
        blueprint.Horizontal(
            blueprint.Vertical(
                blueprint.Spatial3DView(origin=_SENSOR, contents=[f"{_SENSOR}/raw"], name="raw"),
                blueprint.Spatial3DView(
                    origin=_SENSOR, contents=[f"{_SENSOR}/deskewed"], name="deskewed"
                ),
            ),
            blueprint.Spatial3DView(origin=_ODOMETRY, name="map and path"),
            blueprint.Vertical(
                blueprint.TimeSeriesView(origin="imu/rate", name="angular velocity [rad/s]"),
                blueprint.TimeSeriesView(
                    origin="imu/specific_force", name="specific force [m/s^2]"
                ),
                blueprint.TextLogView(origin="health", name="health"),
            ),
            column_shares=[2, 3, 2],
        )
    )
    rerun.init("l2lidar")
    if save is not None:
        save.parent.mkdir(parents=True, exist_ok=True)
        rerun.save(save, default_blueprint=layout)
    elif web:
        address = rerun.serve_grpc(default_blueprint=layout)
        rerun.serve_web_viewer(connect_to=address, open_browser=False)
    else:
        _open_window(rerun, layout)
    return rerun


def _open_window(rerun: Any, layout: Any) -> None:
    if sys.platform == "linux" and not any(map(os.environ.get, _DISPLAYS)):
        raise ViewerError("there is no display to open a window on; try --web or --save")
    # Its program stands beside Python's, in a virtual environment that need not be activated.
    folders = [str(Path(sys.executable).parent), os.environ.get("PATH", "")]
    os.environ["PATH"] = os.pathsep.join(folders)
    try:
        rerun.spawn(default_blueprint=layout)
    except RuntimeError as error:
        raise ViewerError(f"cannot open a window ({error}); try --web or --save") from None


def view(rerun: Any, topics: dict[str, str], seconds: float | None) -> int:
    """Show topics until interrupted or for some seconds; return how many messages were shown.

    rclpy has to be initialised.
    """
    node = ViewerNode(rerun, topics)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    end = None if seconds is None else time.monotonic() + seconds
    try:
        while executor.context.ok() and (end is None or time.monotonic() < end):
            executor.spin_once(timeout_sec=0.1)
    finally:
        node.destroy_node()
    return node.messages
