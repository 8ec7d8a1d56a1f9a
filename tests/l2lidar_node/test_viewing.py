"""The viewer on recordings, without ROS, and the window it opens."""

from __future__ import annotations

import importlib.util
import itertools
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from l2lidar_node import viewing
from l2lidar_node.config import DriverConfig
from l2lidar_node.recording.bag import BagFile, Messages
from l2lidar_node.settings import build
from l2lidar_node.types import POINT, HostNs, Sweep
from l2lidar_node.viewing import Viewer
from tests.l2lidar_node.cli.conftest import Run, run

__all__ = ["run"]

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("rerun") is None, reason="the viewer needs rerun-sdk"
)

START = 1_700_000_000_000_000_000
STEP = 200_000_000
STORE = get_typestore(Stores.ROS2_JAZZY)
T: Any = STORE.types


class Shown:
    """Stands beside rerun: keeps what it is given, by entity, and hands it on."""

    def __init__(self, sdk: Any) -> None:
        self._sdk = sdk
        self.logged: dict[str, list[Any]] = {}

    def log(self, entity: str, value: Any, **options: Any) -> None:
        self.logged.setdefault(entity, []).append(value)
        self._sdk.log(entity, value, **options)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sdk, name)


@pytest.fixture
def shown(tmp_path: Path) -> Iterator[Shown]:
    sdk = viewing.open_viewer(web=False, save=tmp_path / "shown.rrd")
    yield Shown(sdk)
    sdk.disconnect()


def header(stamp: int) -> Any:
    time = T["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
    return T["std_msgs/msg/Header"](time, "odom")


def odometry(stamp: int, x: float, sigma: tuple[float, float, float]) -> Any:
    covariance = np.diag([*np.square(sigma), 1e-4, 1e-4, 4e-4]).ravel()
    point = T["geometry_msgs/msg/Point"](x, 0.0, 0.0)
    turn = T["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    pose = T["geometry_msgs/msg/PoseWithCovariance"](
        T["geometry_msgs/msg/Pose"](point, turn), covariance
    )
    none = T["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    twist = T["geometry_msgs/msg/TwistWithCovariance"](
        T["geometry_msgs/msg/Twist"](none, none), np.zeros(36)
    )
    return T["nav_msgs/msg/Odometry"](header(stamp), "l2lidar_link", pose, twist)


def diagnostics(stamp: int, level: int, message: str, share: str) -> Any:
    value = T["diagnostic_msgs/msg/KeyValue"]("degeneracy ratio [%]", share)
    status = T["diagnostic_msgs/msg/DiagnosticStatus"](
        level, "odometry_node: odometry", message, "L2", [value]
    )
    return T["diagnostic_msgs/msg/DiagnosticArray"](header(stamp), [status])


def wall(stamp: int) -> Any:
    """A cloud of a wall 2 m ahead, one point for every 0.2 m of it."""
    points = np.zeros(100, POINT)
    points["x"] = 2.05
    points["y"], points["z"] = (
        grid.ravel() for grid in np.meshgrid(np.arange(10) * 0.2, np.arange(10) * 0.2)
    )
    sweep = Sweep(HostNs(stamp), HostNs(stamp + STEP), points, 38, 0)
    return Messages(build(DriverConfig, {})).cloud(sweep)


def values(logged: Any) -> list[float]:
    return [float(item) for item in logged.scalars.as_arrow_array().to_pylist()]


def test_the_map_grows_by_what_is_new(shown: Shown) -> None:
    viewer = Viewer(shown)
    for number, x in enumerate((0.0, 0.0, 1.0)):
        stamp = START + number * STEP
        viewer.odometry(odometry(stamp, x, (0.01, 0.01, 0.01)))
        viewer.cloud(wall(stamp), "deskewed")
    # The same wall from the same place adds nothing; from a meter on, it is another one.
    sizes = [values(item)[0] for item in shown.logged["map/points"]]
    assert sizes == [100, 100, 200]


def test_a_cloud_without_a_pose_does_not_enter_the_map(shown: Shown) -> None:
    viewer = Viewer(shown)
    viewer.cloud(wall(START), "deskewed")
    viewer.odometry(odometry(START, 0.0, (0.01, 0.01, 0.01)))
    viewer.cloud(wall(START + 10 * STEP), "deskewed")
    assert "map/points" not in shown.logged
    assert viewer.messages == 3


def test_uncertainty_and_the_directions_not_seen_are_shown(shown: Shown) -> None:
    viewer = Viewer(shown)
    viewer.odometry(odometry(START, 0.0, (0.01, 0.02, 0.01)))
    viewer.odometry(odometry(START + STEP, 0.0, (0.01, 0.5, 0.01)))
    assert values(shown.logged["sigma/position"][1]) == pytest.approx([0.01, 0.5, 0.01])
    assert values(shown.logged["sigma/attitude"][0]) == pytest.approx(
        np.degrees([0.01, 0.01, 0.02]).tolist()
    )
    first, second = (
        item.vectors.as_arrow_array().to_pylist() for item in shown.logged["world/degenerate"]
    )
    assert first == []
    assert np.abs(second) == pytest.approx(np.array([[0, 1, 0], [0, 1, 0]]))  # along y, both ways


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_an_uncertainty_that_is_not_finite_is_left_out(shown: Shown, wrong: float) -> None:
    viewer = Viewer(shown)
    message = odometry(START, 0.0, (0.01, 0.02, 0.01))
    message.pose.covariance[1] = wrong
    viewer.odometry(message)
    assert "sigma/position" not in shown.logged
    viewer.odometry(odometry(START + STEP, 0.0, (0.01, 0.02, 0.01)))
    assert len(shown.logged["world/sensor"]) == 2
    assert len(shown.logged["sigma/position"]) == 1


def test_a_long_path_is_logged_in_strips(shown: Shown) -> None:
    viewer = Viewer(shown)
    poses = 1000
    for number in range(poses):
        viewer.odometry(odometry(START + number * STEP, float(number), (0.01, 0.01, 0.01)))
    last: dict[str, list[float]] = {}
    logged = 0
    for entity, items in shown.logged.items():
        if entity.startswith("world/path"):
            for item in items:
                (strip,) = item.strips.as_arrow_array().to_pylist()
                logged += len(strip)
                last[entity] = [point[0] for point in strip]
    # What the viewer shows, the last of each entity, is the whole path, strips tied to each other.
    strips = sorted(last.values())
    assert all(before[-1] == after[0] for before, after in itertools.pairwise(strips))
    assert sorted({x for strip in strips for x in strip}) == list(range(poses))
    assert max(map(len, strips)) <= 101
    assert logged < 60 * poses


def test_a_status_is_logged_when_it_changes(shown: Shown) -> None:
    viewer = Viewer(shown)
    for number, (level, text) in enumerate([(0, "good"), (0, "good"), (1, "degenerate")]):
        viewer.diagnostics(diagnostics(START + number * STEP, level, text, "12.5"))
    assert len(shown.logged["health"]) == 2
    assert len(shown.logged["status"]) == 3
    assert values(shown.logged["odometry/degeneracy_ratio"][0]) == [12.5]
    levels = [values(item)[0] for item in shown.logged["levels/odometry_node__odometry"]]
    assert levels == [0, 0, 1]


def test_a_cloud_that_cannot_be_read_is_counted(shown: Shown) -> None:
    viewer = Viewer(shown)
    cloud = wall(START)
    viewer.cloud(SimpleNamespace(**{**vars(cloud), "width": 1000}), "raw")
    viewer.cloud(SimpleNamespace(**{**vars(cloud), "fields": []}), "raw")
    pairs = [SimpleNamespace(name=name, offset=0, datatype=7, count=2) for name in "xyz"]
    viewer.cloud(SimpleNamespace(**{**vars(cloud), "fields": pairs}), "raw")
    assert viewer.refused == 3
    assert viewing.ROLES["raw"] not in shown.logged


def test_a_bag_is_shown_without_ros(run: Run, tmp_path: Path) -> None:
    with BagFile(tmp_path / "run.mcap") as file:
        messages = {
            "/points_deskewed": wall(START),
            "/odometry": odometry(START, 0.0, (0.01, 0.01, 0.01)),
            "/diagnostics": diagnostics(START, 0, "good", "50"),
        }
        for topic, message in messages.items():
            file.connect(topic, message.__msgtype__, 10, reliable=True, latched=False)
            data = STORE.serialize_cdr(message, message.__msgtype__)
            file.write(topic, START, data)
    outcome = run("view", str(tmp_path / "run.mcap"), "--save", str(tmp_path / "run.rrd"))
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out.startswith("3 messages shown")
    assert (tmp_path / "run.rrd").stat().st_size > 1000


def test_what_is_no_recording_is_refused(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"nothing")
    outcome = run("view", str(tmp_path / "a.mcap"), "--save", str(tmp_path / "a.rrd"))
    assert outcome.code == 1
    assert "a.mcap: cannot be read as a recording" in outcome.err
    assert [item.name for item in tmp_path.iterdir()] == ["a.mcap"]
    outcome = run("view", str(tmp_path / "a.mcap"), "--save", str(tmp_path / "a.txt"))
    assert outcome.code == 2
    assert "ends in '.txt'; expected FILE.rrd" in outcome.err
    outcome = run("view", str(tmp_path / "a.mcap"), "--save", str(tmp_path / "a.rrd"), "--web")
    assert outcome.code == 2


@pytest.mark.parametrize("is_viewer_there", [True, False], ids=["rerun", "no rerun"])
def test_a_file_that_exists_stays(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_viewer_there: bool
) -> None:
    if not is_viewer_there:
        monkeypatch.setitem(sys.modules, "rerun", None)
    (tmp_path / "a.mcap").write_bytes(b"nothing")
    save = tmp_path / "a.rrd"
    save.write_bytes(b"another run")
    outcome = run("view", str(tmp_path / "a.mcap"), "--save", str(save))
    assert save.read_bytes() == b"another run"
    assert outcome.code == 2
    assert f"'{save}' exists already" in outcome.err


def test_a_link_that_leads_nowhere_stays(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"nothing")
    save = tmp_path / "a.rrd"
    save.symlink_to(tmp_path / "none.rrd")
    outcome = run("view", str(tmp_path / "a.mcap"), "--save", str(save))
    assert save.is_symlink()
    assert outcome.code == 2


def test_without_a_display_it_says_what_else_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(viewing.ViewerError, match="try --web or --save"):
        viewing.open_viewer(web=False, save=None)


def test_the_window_is_found_where_the_environment_is_not_activated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import rerun

    found: list[str | None] = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setenv("PATH", os.defpath)
    monkeypatch.setattr(rerun, "spawn", lambda **_: found.append(shutil.which("rerun")))
    viewing.open_viewer(web=False, save=None)
    assert found == [str(Path(sys.executable).parent / "rerun")]
