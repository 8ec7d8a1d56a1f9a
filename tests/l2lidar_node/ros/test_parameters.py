"""Settings as ROS parameters, from files as ROS reads them."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter

from l2lidar_node.ros.parameters import ParameterSet
from l2lidar_node.settings import SettingError, setting


@dataclass(frozen=True, slots=True, kw_only=True)
class Lists:
    names: tuple[str, ...] = setting(("a", "b"), "names", live=True)
    sizes: tuple[float, ...] = setting((1.0,), "sizes", live=True)


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Any]:
    made = []

    def start(text: Any) -> Any:
        file = tmp_path / "parameters.yaml"
        file.write_text(text)
        context = rclpy.Context()
        rclpy.init(args=["--ros-args", "--params-file", str(file)], context=context)
        node = Node("lists", context=context)
        made.append((context, node))
        changes: list[Any] = []
        return node, ParameterSet(node, Lists, changes.append), changes

    yield start
    for context, node in made:
        node.destroy_node()
        rclpy.shutdown(context=context)


def test_empty_list_in_a_file_is_an_empty_list(started: Any) -> None:
    node, parameters, _ = started("lists: {ros__parameters: {names: [], sizes: []}}")
    assert parameters.value == Lists(names=(), sizes=())
    assert node.get_parameter("names").type_ != Parameter.Type.NOT_SET


def test_list_that_is_not_named_keeps_its_default(started: Any) -> None:
    _, parameters, _ = started("lists: {ros__parameters: {sizes: [2.0, 3.0]}}")
    assert parameters.value == Lists(sizes=(2.0, 3.0))


def test_empty_list_can_be_filled_live(started: Any) -> None:
    node, parameters, changes = started("lists: {ros__parameters: {names: []}}")
    (result,) = node.set_parameters([Parameter("names", value=["c"])])
    assert result.successful, result.reason
    assert parameters.value.names == ("c",)
    assert changes == [parameters.value]


def test_qos_overrides_are_refused_rather_than_ignored(started: Any) -> None:
    words = "qos_overrides./points.publisher.reliability': QoS overrides are not supported"
    with pytest.raises(SettingError, match=re.escape(words)):
        started(
            "lists: {ros__parameters: {qos_overrides: {/points: {publisher: {reliability: "
            "reliable}}}}}"
        )
