"""Declares a group of settings as ROS parameters and follows their changes."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from l2lidar_node.settings import Setting, SettingError, build, change, settings_of

G = TypeVar("G")

_LEGACY = {
    "robot_id": "a URDF or a static_transform_publisher",
    "robot_x": "a URDF or a static_transform_publisher",
    "robot_y": "a URDF or a static_transform_publisher",
    "robot_z": "a URDF or a static_transform_publisher",
    "frame_id": "cloud_frame",
    "imu_frame_id": "cloud_frame, from which the IMU frame is derived",
    "disable_base_link_pub": "nothing; the driver never publishes base_link",
}
"""Parameters of upstream before 0.5 and what took their place."""


class ParameterSet(Generic[G]):
    """The settings of a node as ROS parameters.

    Parameters
    ----------
    node : Node
    group : type
        Frozen dataclass of settings, possibly nested.
    on_change : callable
        Called with the whole new group after a live change was accepted.

    Raises
    ------
    SettingError
        If an initial value is wrong; the message names parameter, value and range.
    """

    def __init__(self, node: Node, group: type[G], on_change: Callable[[G], None]) -> None:
        self._on_change = on_change
        self._settings = {item.name: item for item in settings_of(group)}
        values: dict[str, object] = {}
        for item in self._settings.values():
            try:
                values[item.name] = _value(node.declare_parameter(*_declaration(item)))
            except (InvalidParameterTypeException, InvalidParameterValueException):
                values[item.name] = _override(node, item.name)
            if values[item.name] is None and item.type is tuple:
                # ROS reads an empty list in a YAML file as a parameter that is not set.
                node.set_parameters([Parameter(item.name, value=[])])
                values[item.name] = ()
        self.value: G = build(group, values)
        _refuse_unknown(node, set(self._settings))
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def _mine(self, parameters: list[Parameter[Any]]) -> dict[str, object]:
        return {item.name: _value(item) for item in parameters if item.name in self._settings}

    def _check(self, parameters: list[Parameter[Any]]) -> SetParametersResult:
        changes = self._mine(parameters)
        for name in changes:
            if not self._settings[name].live:
                reason = f"parameter '{name}' is read when the node starts; set it there"
                return SetParametersResult(successful=False, reason=reason)
        try:
            change(self.value, changes)
        except SettingError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter[Any]]) -> None:
        changes = self._mine(parameters)
        if changes:
            self.value = change(self.value, changes)
            self._on_change(self.value)


def _value(parameter: Parameter[Any]) -> object:
    value = parameter.value
    return tuple(value) if hasattr(value, "__iter__") and not isinstance(value, str) else value


def _override(node: Node, name: str) -> object:
    """Return the initial value that rclpy refused, for our own message about it."""
    return _value(node._parameter_overrides[name])


def _declaration(item: Setting) -> tuple[str, Any, ParameterDescriptor]:
    unit = f" [{item.unit}]" if item.unit else ""
    descriptor = ParameterDescriptor(
        description=f"{item.doc}{unit}",
        additional_constraints=f"one of {item.range_text}" if item.choices else "",
        # An empty list cannot be set after the declaration if it is read-only.
        read_only=not item.live and item.type is not tuple,
        # A YAML file may say 100 for a float, and an empty list has no type of its own: the check
        # below takes both, rclpy alone would not.
        dynamic_typing=item.type in (float, tuple),
    )
    if item.lo is not None and item.hi is not None and item.item is None:
        if item.type is float:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(item.lo), to_value=float(item.hi))
            ]
        elif item.type is int:
            descriptor.integer_range = [
                IntegerRange(from_value=int(item.lo), to_value=int(item.hi), step=0)
            ]
    default = list(item.default) if isinstance(item.default, tuple) else item.default
    return item.name, default, descriptor


def _refuse_unknown(node: Node, known: set[str]) -> None:
    """Warn of parameters that are not known; refuse those that would not act as they say.

    Raises
    ------
    SettingError
    """
    for name in node._parameter_overrides:
        if name in known or node.has_parameter(name):
            continue
        if name.startswith("qos_overrides."):
            raise SettingError(
                f"parameter '{name}': QoS overrides are not supported; set qos_reliability "
                "(the depths fit the rates of this sensor)"
            )
        if name in _LEGACY:
            hint = f"it was replaced by {_LEGACY[name]}"
        else:
            close = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean '{close[0]}'?" if close else "it is ignored"
        node.get_logger().warning(f"parameter '{name}' is not known; {hint}")
