"""What services write stays in one folder, and a node survives its own errors."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

rclpy = pytest.importorskip("rclpy")

from rclpy.parameter import Parameter  # noqa: E402  after importorskip

from l2lidar_node.settings import SettingError, build  # noqa: E402
from l2lidar_proc.odometry.config import OdometryNodeConfig  # noqa: E402
from tests.l2lidar_proc.odometry.odometry_world import recording  # noqa: E402
from tests.l2lidar_proc.ros.test_odometry_node import OdometryBench  # noqa: E402
from tests.support.odometry_runs import sweeps  # noqa: E402

pytestmark = pytest.mark.ros


@pytest.fixture
def odometry(tmp_path: Path) -> Iterator[Any]:
    made = OdometryBench(f"data_dir:={tmp_path}/data")
    yield made
    made.close()


def works(bench: Any) -> None:
    """Give the node good data and wait for what it makes of them."""
    some = list(sweeps(recording("room", "walk"), "turn"))[:8]
    bench.poses.clear()
    bench.send(recording("room", "walk"), some)
    bench.until(lambda: len(bench.poses) == len(some))


@pytest.mark.parametrize(
    "name", ["", ".", "..", "/etc/x.ply", "../x.ply", "a/b.ply", ".x.ply", "x\n.ply", "x" * 200]
)
def test_a_file_parameter_takes_names_only(name: Any) -> None:
    for parameter in ("map_file", "trajectory_file"):
        with pytest.raises(SettingError, match="is not a file name, expected up to 100 letters"):
            build(OdometryNodeConfig, {parameter: name})


def test_an_error_that_nobody_foresaw_is_reported_and_survived(
    odometry: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline = odometry.node._pipeline
    real = pipeline.sweep
    monkeypatch.setattr(pipeline, "sweep", lambda sweep, now, backlog: 1 / 0)
    sweep = next(iter(sweeps(recording("room", "walk"), "turn")))
    odometry.send_cloud(sweep.points, sweep.start)
    told = "internal error, restarted: ZeroDivisionError"
    odometry.until(lambda: any(told in status.message for status in odometry.diagnostics))
    monkeypatch.setattr(pipeline, "sweep", real)
    works(odometry)


def test_services_write_into_the_data_folder_and_overwrite_nothing(
    odometry: Any, tmp_path: Path
) -> None:
    works(odometry)
    for name, files in (
        ("save_map", ["map.ply"]),
        ("save_trajectory", ["trajectory.tum", "trajectory.kitti"]),
    ):
        assert odometry.call(name).success
        for file in files:
            assert (tmp_path / "data" / file).stat().st_size > 100
            (tmp_path / "data" / file).write_text("mine")
        answer = odometry.call(name)
        assert not answer.success
        assert "exists: choose another name" in answer.message
        assert [(tmp_path / "data" / file).read_text() for file in files] == ["mine"] * len(files)
    outside = tmp_path / "outside"
    outside.write_text("mine")
    (tmp_path / "data" / "link.ply").symlink_to(outside)
    odometry.node.set_parameters([Parameter("map_file", value="link.ply")])
    assert not odometry.call("save_map").success
    assert outside.read_text() == "mine"


def test_a_folder_that_cannot_be_made_is_named(odometry: Any, tmp_path: Path) -> None:
    (tmp_path / "data").write_text("a file")
    works(odometry)
    for name in ("save_map", "save_trajectory"):
        answer = odometry.call(name)
        assert not answer.success
        assert "data" in answer.message
