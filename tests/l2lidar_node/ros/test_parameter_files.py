from pathlib import Path
from typing import Any

import pytest

from l2lidar_node.ros.parameter_files import parameters_by_node, parameters_for, settings_for
from l2lidar_node.settings import SettingError
from l2lidar_proc.odometry.config import OdometryTopics

FILE = """
/**:
  ros__parameters:
    l2_port: 1
    host_port: 1
    l2_name: "1"
l2lidar_node:
  ros__parameters:
    host_port: 2
/front/l2lidar_node:
  ros__parameters:
    host_port: 3
rear:
  lidar:
    ros__parameters:
      host_port: 4
      nested: {deep: {value: 1.5}, list: [1.0, 2.0]}
/*/other:
  ros__parameters:
    host_port: 5
"""


@pytest.fixture
def path(tmp_path: Path) -> Any:
    file = tmp_path / "parameters.yaml"
    file.write_text(FILE)
    return file


@pytest.mark.parametrize(
    ("full_name", "host_port"),
    [
        ("/l2lidar_node", 2),
        ("/renamed", 2),  # ROS itself would drop the section of the stock name
        ("/rear/l2lidar_node", 2),
        ("/front/l2lidar_node", 3),
        ("/rear/lidar", 4),
        ("/any/other", 5),
        ("/any/deeper/other", 2),
    ],
)
def test_later_section_that_applies_wins(path: Any, full_name: str, host_port: int) -> None:
    values = parameters_for(path, "l2lidar_node", full_name)
    assert values["host_port"] == host_port
    assert values["l2_port"] == 1
    assert values["l2_name"] == "1"


def test_section_of_another_node_does_not_apply(path: Any) -> None:
    assert parameters_for(path, "deskew_node", "/deskew_node")["host_port"] == 1


def test_nested_names_are_joined_by_dots(path: Any) -> None:
    values = parameters_for(path, "l2lidar_node", "/rear/lidar")
    assert values["nested.deep.value"] == 1.5
    assert values["nested.list"] == [1.0, 2.0]


def test_wildcard_of_any_depth(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text("/**/lidar: {ros__parameters: {l2_port: 7}}")
    for full_name in ("/lidar", "/a/lidar", "/a/b/lidar"):
        assert parameters_for(file, "l2lidar_node", full_name) == {"l2_port": 7}
    assert parameters_for(file, "l2lidar_node", "/a/lidar/b") == {}


@pytest.mark.parametrize("text", ["", "# nothing\n", "l2lidar_node:\n  ros__parameters:\n"])
def test_nothing_said_is_nothing_set(tmp_path: Path, text: str) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(text)
    assert parameters_for(file, "l2lidar_node", "/l2lidar_node") == {}


@pytest.mark.parametrize(
    "text",
    [
        "[1, 2]", "l2_port: 6101", "a: {b: [}", "l2lidar_node: {ros__parameters: 5}",
        "a: 2001-99-99", "a: !!int ", "a: " + "[" * 2000, "a: \xff",
    ],
)  # fmt: skip
def test_other_content_is_refused_with_the_files_name(tmp_path: Path, text: Any) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=r"mine\.yaml"):
        parameters_for(file, "l2lidar_node", "/l2lidar_node")


def test_missing_file_is_refused_with_its_name(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"absent\.yaml.*No such file"):
        parameters_for(tmp_path / "absent.yaml", "l2lidar_node", "/l2lidar_node")


def test_numbers_are_read_as_ros_reads_them(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text("/**: {ros__parameters: {a: 2e-07, b: 4.9e-9, c: -1E3, d: '2e-07', e: 0.5}}")
    values = parameters_for(file, "any", "/any")
    assert values == {"a": 2e-7, "b": 4.9e-9, "c": -1000.0, "d": "2e-07", "e": 0.5}


def test_sections_are_told_apart_by_their_headings(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(
        "/**: {ros__parameters: {a: 1}}\nfront: {lidar: {ros__parameters: {b: {c: 2}}}}"
    )
    assert parameters_by_node(file) == {"/**": {"a": 1}, "/front/lidar": {"b.c": 2}}


def test_a_file_for_a_node_serves_without_ros(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text("odometry_node: {ros__parameters: {use_sim_time: true, map_period_s: 5}}")
    assert settings_for(file, "odometry_node", OdometryTopics).map_period_s == 5.0
    assert settings_for(None, "odometry_node", OdometryTopics).map_period_s == 2.0
    file.write_text("odometry_node: {ros__parameters: {map_perod_s: 5.0}}")
    with pytest.raises(SettingError, match="did you mean 'map_period_s'"):
        settings_for(file, "odometry_node", OdometryTopics)
