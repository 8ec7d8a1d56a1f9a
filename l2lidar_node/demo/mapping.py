"""Demo with SLAM: builds, saves and evaluates a map with loop closure, and localizes in it."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from rich.console import Console
from scipy.spatial.transform import Rotation
from std_srvs.srv import Trigger

from l2lidar_node.command_line import CommandError
from l2lidar_node.demo.observer import Observer, TopicRecord
from l2lidar_node.demo.processes import ProgramError, Programs, assigned
from l2lidar_node.demo.report import track_error
from l2lidar_node.emulator.truth import Results
from l2lidar_node.ros.conversions import from_time
from l2lidar_node.types import F64

WORLD: Final = "furnished_office"
"""A ring of corridors, 80 m once around."""

SPEED: Final = 1.0
"""[m/s]"""

MAPPING_S: Final = 110.0
"""A lap, and 30 m of the next one: a place counts again after 20 m, and three have to agree."""

_SILENCE_S: Final = 10.0  # without a message that is waited for
_ANSWER_S: Final = 20.0
_ASK_AGAIN_S: Final = 5.0
_SEARCH_S: Final = 40.0  # of the sensor's time
_TELL_S: Final = 5.0
_FOUND_S: Final = 4.0  # likewise, that the place is watched for after it was found
_MAP: Final = "map"
_MOST_LOSS_M: Final = 0.005  # that loops may cost; the targets of docs/mapping.md
_MAX_ATE_M: Final = 0.05  # of the map: loops take out the drift, whatever the way
_PLACED_M: Final = 0.05


class MappingRun:
    """Builds a map during the demo.

    Parameters
    ----------
    console : Console
    observer : Observer
    programs : Programs
        Gets slam_node as one of them.
    folder : Path
        Of the pictures; the map is saved in its subfolder ``map``.

    Raises
    ------
    CommandError
        If gtsam is missing.
    """

    def __init__(
        self, console: Console, observer: Observer, programs: Programs, folder: Path
    ) -> None:
        if importlib.util.find_spec("gtsam") is None:
            raise CommandError(
                "--slam needs the Python package gtsam; docs/install.md says how to add it"
            )
        self._console, self._observer = console, observer
        self._programs, self._folder = programs, folder
        self._state = ""
        self._stamps: list[int] = []
        self._places: list[tuple[float, float, float]] = []
        self._found_after_s: float | None = None
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        observer.create_subscription(DiagnosticStatus, "/slam_status", self._take_state, latched)
        observer.create_subscription(PoseWithCovarianceStamped, "/pose", self._take_pose, 50)
        self._slam = self._started("mapping")

    def watch(self, seconds: float, tell: Callable[[Console, Observer], None]) -> None:
        """Watch the map grow for so many seconds of the sensor's time.

        Raises
        ------
        ProgramError
            If a program fails, or the odometry stops.
        """
        stamps = self._observer.odometry.stamps
        said = 0.0

        def is_seen() -> bool:
            nonlocal said
            if time.monotonic() - said > _TELL_S:
                tell(self._console, self._observer)
                said = time.monotonic()
            return len(stamps) > 1 and stamps[-1] - stamps[0] >= seconds * 1e9

        self._watch_until(is_seen, "/odometry", self._observer.odometry)

    def save(self) -> None:
        """Have the map saved.

        Raises
        ------
        ProgramError
            If that does not work, and why.
        """
        self._console.print(f"slam_node/save: {self._asked('slam_node/save')}")

    def start_again(self) -> None:
        """Restart odometry and slam_node somewhere in the map, and watch until it localizes.

        Raises
        ------
        ProgramError
            If a program fails, or no clouds come any more.
        """
        self._programs.stop(self._slam)
        self._observer.follows = False
        self._asked("odometry_node/reset")
        self._state = ""
        self._stamps.clear()
        self._places.clear()
        self._slam = self._started("localization")
        self._console.print("the odometry has restarted; searching for the pose in the map ...")
        clouds = self._observer.clouds
        began = clouds.stamps[-1]
        self._watch_until(
            lambda: self._state == "LOCALIZED" or clouds.stamps[-1] - began > _SEARCH_S * 1e9,
            "/points",
            clouds,
        )
        found = clouds.stamps[-1]
        self._watch_until(
            lambda: self._state != "LOCALIZED" or clouds.stamps[-1] - found > _FOUND_S * 1e9,
            "/points",
            clouds,
        )
        if self._stamps:
            self._found_after_s = (self._stamps[0] - began) / 1e9

    def report(self) -> list[str]:
        """Print size and accuracy of the map, draw it, and return problems."""
        from l2lidar_proc.slam import atlas, export
        from l2lidar_proc.slam.pose_graph import LOOP

        truth = Results(self._folder / "truth")
        built, troubles = atlas.load(self._folder / _MAP)
        way = built.trajectory()
        alone = track_error(
            truth, self._observer.odometry.stamps, np.array(self._observer.positions)
        )
        positions = way["pose"][:, :3, 3]
        mapped = track_error(truth, [int(stamp) for stamp in way["stamp"]], positions)
        loops = int((built.edges["kind"] == LOOP).sum())
        picture = self._folder / "map.png"
        title = (
            f"{loops} loops over {mapped.length_m:.0f} m: {1e3 * mapped.ate_m:.1f} mm RMS "
            f"error, the odometry alone {1e3 * alone.ate_m:.1f} mm"
        )
        export.draw(built, picture, title)
        self._console.print(
            f"map: {len(built.nodes)} submaps, {len(built.points())} points, {title}\n"
            f"map: in {self._folder / _MAP}, drawn in {picture}"
        )
        if not loops and mapped.length_m > MAPPING_S * SPEED * 0.9:
            troubles.append("no loop was closed")
        if mapped.ate_m > alone.ate_m + _MOST_LOSS_M:
            troubles.append("the map is worse than the odometry alone")
        if mapped.ate_m > _MAX_ATE_M:
            troubles.append(f"the map is off by {mapped.ate_m:.3f} m, expected {_MAX_ATE_M} m")
        T_world_map = _alignment(positions, mapped.estimated)
        return [*troubles, *self._judge_place(truth, T_world_map)]

    # ---- steps

    def _started(self, mode: str) -> Any:
        values = {"data_dir": self._folder, "map_name": _MAP, "mode": mode, "autosave_s": 0.0}
        return self._programs.start("l2lidar_proc.ros.slam_node", assigned(values))

    def _asked(self, service: str) -> str:
        """Call a service and return its message."""
        client = self._observer.create_client(Trigger, service)
        deadline = time.monotonic() + _ANSWER_S
        future, asked = None, 0.0
        while future is None or not future.done():
            now = time.monotonic()
            if now > deadline:
                raise ProgramError(f"{service} did not answer within {_ANSWER_S:.0f} s")
            # An answer sent before the two have found each other entirely is lost: ask again.
            if client.service_is_ready() and now - asked > _ASK_AGAIN_S:
                future, asked = client.call_async(Trigger.Request()), now
            self._watch(0.1)
        answer = future.result()
        if not answer.success:
            raise ProgramError(f"{service}: {answer.message}")
        return str(answer.message)

    def _watch_until(self, is_done: Callable[[], bool], topic: str, record: TopicRecord) -> None:
        """Handle messages until a condition holds; messages of a topic must keep arriving."""
        began = time.monotonic()
        while not is_done():
            self._watch(0.2)
            latest = max([began, *record.arrivals[-1:]])
            if time.monotonic() - latest > _SILENCE_S:
                raise ProgramError(f"{topic}: no message for {_SILENCE_S:.0f} s")

    def _watch(self, seconds: float) -> None:
        self._observer.watch(time.monotonic() + seconds)
        self._programs.check()

    def _take_state(self, message: DiagnosticStatus) -> None:
        self._state = message.message

    def _take_pose(self, message: PoseWithCovarianceStamped) -> None:
        place = message.pose.pose.position
        self._stamps.append(from_time(message.header.stamp))
        self._places.append((place.x, place.y, place.z))

    def _judge_place(self, truth: Results, T_world_map: tuple[Rotation, F64]) -> list[str]:
        """Print the accuracy of the localization; return problems."""
        if self._found_after_s is None:
            return [f"no pose in the saved map was found within {_SEARCH_S:.0f} s"]
        turn, shift = T_world_map
        poses = truth.trajectory()
        origin = int(poses["stamp"][0])
        known = (poses["stamp"] - origin).astype(np.float64)
        instants = np.array([stamp - origin for stamp in self._stamps], np.float64)
        true = np.stack(
            [np.interp(instants, known, poses["position"][:, axis]) for axis in range(3)], axis=1
        )
        off = np.linalg.norm(turn.apply(np.array(self._places)) + shift - true, axis=1)
        self._console.print(
            f"localization: found after {self._found_after_s:.1f} s, "
            f"then {1e3 * np.median(off):.0f} mm "
            f"off the truth (at most {1e3 * off.max():.0f} mm, {len(off)} poses)"
        )
        if float(np.median(off)) > _PLACED_M:
            return [f"the pose in the map is off by {np.median(off):.3f} m"]
        return []


def _alignment(positions: F64, aligned: F64) -> tuple[Rotation, F64]:
    """Return the turn and the shift that were applied to positions (N, 3) [m]."""
    middle, there = positions.mean(axis=0), aligned.mean(axis=0)
    turn, _ = Rotation.align_vectors(aligned - there, positions - middle)
    return turn, there - turn.apply(middle)
