"""Viewer: clouds, IMU, odometry and health in rerun, live or from a recording; no ROS.

It takes messages as rclpy and as rosbags make them: both name the fields alike.
"""

from __future__ import annotations

import os
import sys
from collections import deque
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.clouds import points_of
from l2lidar_node.types import F64

_ODOMETRY: Final = "world"
_SENSOR: Final = f"{_ODOMETRY}/sensor"
_MAX_RANGE_M: Final = 10.0  # end of the color scale
_VOXEL_M: Final = 0.1  # edge of the cubes of which the grown map keeps one point
_MAX_VOXELS: Final = 2_000_000  # then the map grows no more: 200 MB
_POSES: Final = 100  # 2 s at 50 Hz, by which a cloud may be behind
_POSE_NS: Final = 100_000_000  # a cloud farther than that from any pose is not put into the map
_SIGMAS: Final = 3.0  # half axes of the ellipsoid
_DEGENERATE_RATIO: Final = 5.0  # of the largest to the smallest standard deviation of position
_ARROW_M: Final = 1.0
_STRIP: Final = 100  # line segments of the path that one entity holds
_PATH_COLOR: Final = (80, 170, 255)  # of all strips; rerun would give each another
_DISPLAYS: Final = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
_LEVELS: Final = ("OK", "WARN", "ERROR", "STALE")
_LOG_LEVELS: Final = ("INFO", "WARN", "ERROR", "ERROR")
ROLES: Final = {
    "raw": f"{_SENSOR}/raw",
    "deskewed": f"{_SENSOR}/deskewed",
    "map": f"{_ODOMETRY}/map",
}
"""Entities of the clouds by what they are."""


class ViewerError(RuntimeError):
    """The viewer is not available; the message says what to do."""


class Viewer:
    """Passes every message to rerun.

    Parameters
    ----------
    rerun : module
        The rerun SDK, initialized; see :func:`open_viewer`.

    Attributes
    ----------
    messages : int
        How many were shown.
    refused : int
        Clouds that cannot be read.
    """

    def __init__(self, rerun: Any) -> None:
        self.messages = 0
        self.refused = 0
        self._rerun = rerun
        self._strip: list[tuple[float, float, float]] = []  # the end of the path
        self._strips = 0
        self._poses: deque[tuple[int, F64]] = deque(maxlen=_POSES)
        self._map = _GrownMap()
        self._has_deskewed = False
        self._said: dict[str, tuple[int, str]] = {}
        rerun.log(_ODOMETRY, rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def cloud(self, message: Any, role: str) -> None:
        """Show a PointCloud2, one of :data:`ROLES`; deskewed ones make the map grow."""
        stamp = self._at(message)
        try:
            points = points_of(message)
            xyz = np.stack([points[name] for name in "xyz"], axis=1).astype(np.float64)
        except ValueError:  # fields that do not fit the data, or no x, y, z
            xyz = np.empty(0)
        if xyz.ndim != 2:  # or they are arrays
            self.refused += 1
            return
        xyz = xyz[np.isfinite(xyz).all(axis=1)]
        colors = range_colors(np.linalg.norm(xyz, axis=1))
        self._rerun.log(ROLES[role], self._rerun.Points3D(xyz, colors=colors, radii=0.012))
        self._has_deskewed |= role == "deskewed"
        if role == "deskewed" or (role == "raw" and not self._has_deskewed):
            self._grow(xyz, stamp)

    def imu(self, message: Any) -> None:
        """Show an Imu."""
        self._at(message)
        rate, force = message.angular_velocity, message.linear_acceleration
        scalars = self._rerun.Scalars
        self._rerun.log("imu/rate", scalars([rate.x, rate.y, rate.z]))
        self._rerun.log("imu/specific_force", scalars([force.x, force.y, force.z]))

    def odometry(self, message: Any) -> None:
        """Show an Odometry: pose, path, standard deviations, and directions that are not seen."""
        stamp = self._at(message)
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        position = (place.x, place.y, place.z)
        rerun = self._rerun
        # A matrix, since rerun's quaternions before 0.24 want NumPy 2.
        q = np.array([turn.w, turn.x, turn.y, turn.z])
        rotation = rotations.matrices(rotations.normalised(q)) if q.any() else np.eye(3)
        rerun.log(_SENSOR, rerun.Transform3D(translation=position, mat3x3=rotation))
        self._lengthen_path(position)
        T_odom_sensor = np.eye(4)
        T_odom_sensor[:3, :3] = rotation
        T_odom_sensor[:3, 3] = position
        self._poses.append((stamp, T_odom_sensor))
        covariance = np.asarray(message.pose.covariance, np.float64).reshape(6, 6)
        if np.isfinite(covariance).all():
            self._uncertainty(covariance, position)

    def diagnostics(self, message: Any) -> None:
        """Show a DiagnosticArray: each status, its changes, and its figures as curves."""
        self._at(message)
        rerun = self._rerun
        for status in message.status:
            level = status.level if isinstance(status.level, int) else status.level[0]
            level = min(int(level), len(_LEVELS) - 1)
            said = (level, str(status.message))
            if self._said.get(status.name) != said:
                self._said[status.name] = said
                text = f"{status.name}: {status.message}"
                rerun.log("health", rerun.TextLog(text, level=_LOG_LEVELS[level]))
            rerun.log(f"levels/{_entity(status.name)}", rerun.Scalars([float(level)]))
            if "odometry" in status.name:
                for item in status.values:
                    number = _number(item.value)
                    if number is not None:
                        rerun.log(f"odometry/{_entity(item.key)}", rerun.Scalars([number]))
        rows = [
            f"| {_LEVELS[level]} | {name} | {text} |" for name, (level, text) in self._said.items()
        ]
        table = "\n".join(["| | | |", "|---|---|---|", *rows])
        rerun.log("status", rerun.TextDocument(table, media_type="text/markdown"))

    def _at(self, message: Any) -> int:
        self.messages += 1
        stamp = int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)
        self._rerun.set_time("stamp", timestamp=np.datetime64(stamp, "ns"))
        return stamp

    def _lengthen_path(self, position: tuple[float, float, float]) -> None:
        """Log the last strip of the path: the whole one at every pose would fill the disk."""
        if len(self._strip) > _STRIP:
            self._strips += 1
            del self._strip[:-1]  # its end is where the next one begins
        self._strip.append(position)
        self._rerun.log(
            f"{_ODOMETRY}/path/{self._strips}",
            self._rerun.LineStrips3D([self._strip], colors=_PATH_COLOR),
        )

    def _grow(self, xyz: F64, stamp: int) -> None:
        if not self._poses:
            return
        when, T_odom_sensor = min(self._poses, key=lambda item: abs(item[0] - stamp))
        if abs(when - stamp) > _POSE_NS:
            return
        added = self._map.add(xyz @ T_odom_sensor[:3, :3].T + T_odom_sensor[:3, 3])
        if len(added):
            height = np.abs(added[:, 2]) * 3.0
            self._rerun.log(
                f"{_ODOMETRY}/grown/{self._map.clouds}",
                self._rerun.Points3D(added, colors=range_colors(height), radii=0.02),
            )
        self._rerun.log("map/points", self._rerun.Scalars([float(self._map.size)]))

    def _uncertainty(self, covariance: F64, position: tuple[float, float, float]) -> None:
        rerun = self._rerun
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        rerun.log("sigma/position", rerun.Scalars(sigma[:3]))
        rerun.log("sigma/attitude", rerun.Scalars(np.degrees(sigma[3:])))
        variances, axes = np.linalg.eigh(covariance[:3, :3])
        deviations = np.sqrt(np.maximum(variances, 0.0))
        axes = axes * np.sign(np.linalg.det(axes))  # a rotation, for the ellipsoid
        rerun.log(
            f"{_ODOMETRY}/sigma",
            rerun.Ellipsoids3D(
                centers=[position],
                half_sizes=[_SIGMAS * deviations],
                quaternions=np.roll(rotations.from_matrix(axes), -1)[None],  # x, y, z, w
            ),
        )
        unseen = deviations > _DEGENERATE_RATIO * deviations[0]
        arrows = axes.T[unseen] * _ARROW_M
        both = np.concatenate([arrows, -arrows])
        rerun.log(
            f"{_ODOMETRY}/degenerate",
            rerun.Arrows3D(
                vectors=both, origins=np.tile(position, (len(both), 1)), colors=[255, 60, 60]
            ),
        )


class _GrownMap:
    """One point per voxel of all clouds so far."""

    def __init__(self) -> None:
        self.clouds = 0
        self._known: set[bytes] = set()

    @property
    def size(self) -> int:
        """How many points it has."""
        return len(self._known)

    def add(self, points: F64) -> F64:
        """Return the points of cubes that are new, shape (N, 3)."""
        self.clouds += 1
        cubes = np.floor(points / _VOXEL_M).astype(np.int32)
        _, first = np.unique(cubes, axis=0, return_index=True)
        kept = []
        for index in first.tolist():
            key = cubes[index].tobytes()
            if key not in self._known and len(self._known) < _MAX_VOXELS:
                self._known.add(key)
                kept.append(index)
        return points[kept]


def open_viewer(web: bool, save: Path | None) -> Any:
    """Return the rerun SDK with a window, a browser page or a file to draw into.

    Raises
    ------
    ViewerError
        If rerun is not installed, or its window or the file cannot be opened.
    """
    try:
        import rerun
        import rerun.blueprint as blueprint
    except ImportError:
        raise ViewerError(
            "the viewer needs the Python package rerun-sdk; docs/install.md says how to add it "
            "without changing the system's NumPy"
        ) from None
    curves = blueprint.TimeSeriesView
    layout = blueprint.Blueprint(
        blueprint.Horizontal(
            blueprint.Vertical(
                blueprint.Spatial3DView(origin=_SENSOR, contents=[ROLES["raw"]], name="raw"),
                blueprint.Spatial3DView(
                    origin=_SENSOR, contents=[ROLES["deskewed"]], name="deskewed"
                ),
            ),
            blueprint.Vertical(
                blueprint.Spatial3DView(origin=_ODOMETRY, name="map and path"),
                blueprint.TextDocumentView(origin="status", name="status"),
                row_shares=[3, 1],
            ),
            blueprint.Tabs(
                blueprint.Vertical(
                    curves(origin="sigma/position", name="sigma of position [m]"),
                    curves(origin="sigma/attitude", name="sigma of attitude [deg]"),
                    curves(origin="map", name="points in the map"),
                    curves(origin="odometry", name="odometry's figures"),
                    name="odometry",
                ),
                blueprint.Vertical(
                    curves(origin="imu/rate", name="angular velocity [rad/s]"),
                    curves(origin="imu/specific_force", name="specific force [m/s^2]"),
                    name="IMU",
                ),
                blueprint.Vertical(
                    curves(origin="levels", name="levels: 0 OK, 1 WARN, 2 ERROR"),
                    blueprint.TextLogView(origin="health", name="what changed"),
                    name="health",
                ),
            ),
            column_shares=[2, 3, 2],
        )
    )
    rerun.init("l2lidar")
    if save is not None:
        try:
            rerun.save(save, default_blueprint=layout)
        except RuntimeError as error:
            raise ViewerError(str(error)) from None
    elif web:
        address = rerun.serve_grpc(default_blueprint=layout)
        rerun.serve_web_viewer(connect_to=address, open_browser=False)
    else:
        _open_window(rerun, layout)
    return rerun


def _open_window(rerun: Any, layout: Any) -> None:
    if sys.platform == "linux" and not any(map(os.environ.get, _DISPLAYS)):
        raise ViewerError("no display for a window; try --web or --save")
    # Its program stands beside Python's, in a virtual environment that need not be activated.
    folders = [str(Path(sys.executable).parent), os.environ.get("PATH", "")]
    os.environ["PATH"] = os.pathsep.join(folders)
    try:
        rerun.spawn(default_blueprint=layout)
    except RuntimeError as error:
        raise ViewerError(f"cannot open a window ({error}); try --web or --save") from None


def range_colors(distance: F64) -> NDArray[np.uint8]:
    """Return colors from red (near) over green to blue (far), shape (N, 3)."""
    share = np.clip(distance / _MAX_RANGE_M, 0.0, 1.0)[:, None]
    peaks = np.array([[0.1, 0.5, 0.9]])
    return np.asarray(255 * np.clip(1.4 - 2.8 * np.abs(share - peaks), 0.0, 1.0), np.uint8)


def _entity(name: str) -> str:
    """Return a name as a part of an entity's path."""
    return "".join(letter if letter.isalnum() else "_" for letter in name).strip("_")


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if np.isfinite(number) else None
