"""The parts of every launch: driver, virtual L2, companions, robot, RViz."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from launch.actions import ExecuteProcess, OpaqueFunction, Shutdown
from launch.events.process import ProcessExited
from launch.launch_context import LaunchContext
from launch.logging import launch_config
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import ExecutableInPackage

from l2lidar_node.config import DriverConfig
from l2lidar_node.protocol import wire
from l2lidar_node.ros.launch_arguments import ARGUMENTS, PACKAGE, share
from l2lidar_node.ros.parameter_files import parameter_file, parameters_for
from l2lidar_node.ros.topics import DRIVER_TOPICS, SHOWN_TOPICS
from l2lidar_node.settings import SettingError, build, settings_of

Given = Mapping[str, str]
"""Value of every launch argument, as text."""
Parameters = Mapping[str, bool | int | float | str]
"""Value by parameter name."""
Part = Callable[[LaunchContext], list[Any]]
"""Makes what one part of a launch starts."""

LOOPBACK: Final = "127.0.0.1"
RESPAWN_DELAY_S: Final = 2.0
_WRONG_USE: Final = 2  # exit code of a node that was given what it cannot take


def start(*parts: Part) -> OpaqueFunction:
    """Return what starts all parts, or none where one cannot be: all are made before."""
    return OpaqueFunction(
        function=lambda context: [action for part in parts for action in part(context)]
    )


def driver(
    needs: Callable[[Given], Parameters] = lambda given: {},
    files: Callable[[Given], Sequence[str]] = lambda given: (),
) -> Part:
    """Return the driver, with a virtual L2 beside it where one is asked for.

    Parameters
    ----------
    needs : callable
        From the arguments to the values this launch file needs, whatever the parameter file says.
    files : callable
        From the arguments to the parameter files that go over ``params_file``.
    """

    def actions(context: LaunchContext) -> list[Any]:
        given = _given(context)
        values = {**needs(given), **_addresses(given)}
        if given["l2_name"]:
            values["l2_name"] = given["l2_name"]
        node = _node(
            "l2lidar_node",
            given["name"],
            given,
            [given["params_file"], *files(given)],
            values,
            DriverConfig,
        )
        return [*_emulator(given, values), node]

    return actions


def for_deskew(sweep_cut: str = "turn") -> Parameters:
    """Return what deskew needs of the driver: the IMU, and points in the sensor's own frame."""
    return {"enable_IMU_publishing": True, "imu_adjust": False, "sweep_cut": sweep_cut}


def companion(
    executable: str, settings: type, wanted: str = "", values: Parameters | None = None
) -> Part:
    """Return a node that goes with the driver, named like its executable.

    Parameters
    ----------
    executable : str
    settings : type
        What it takes as parameters.
    wanted : str
        Argument that says whether to start it; empty for always.
    values : mapping, optional
        Parameters that hold whatever the parameter file says.
    """

    def actions(context: LaunchContext) -> list[Any]:
        given = _given(context)
        if wanted and given[wanted] != "true":
            return []
        files = [given["proc_params_file"]]
        return [_node(executable, executable, given, files, values or {}, settings)]

    return actions


def robot(urdf: str) -> Part:
    """Return a robot_state_publisher for a plain URDF file of ``urdf/examples``."""
    text = Path(share(f"urdf/examples/{urdf}")).read_text(encoding="utf-8")
    return lambda context: [
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            namespace=_given(context)["namespace"],
            parameters=[{"robot_description": ParameterValue(text, value_type=str)}],
            output="screen",
        )
    ]


def rviz(values: Parameters | None = None) -> Part:
    """Return RViz, started only where the argument ``rviz`` says so."""

    def actions(context: LaunchContext) -> list[Any]:
        given = _given(context)
        if given["rviz"] != "true":
            return []
        layout = given["rviz_config"]
        if not Path(layout).is_file():
            raise ValueError(f"rviz_config:={layout}: there is no such file")
        # The layout for the sensor alone is fixed to its frame, whose name follows l2_name.
        renamed = given["l2_name"] and Path(layout).name == "rvizl2lidar.rviz"
        frame = ["-f", f"{given['l2_name']}_link"] if renamed else []
        return [
            Node(
                package="rviz2",
                executable="rviz2",
                name="rviz2",
                namespace=given["namespace"],
                arguments=["-d", layout, *frame],
                parameters=[dict(values)] if values else None,
                remappings=_relative(SHOWN_TOPICS),
                output="screen",
            )
        ]

    return actions


def _node(
    executable: str,
    name: str,
    given: Given,
    files: Sequence[str],
    values: Parameters,
    settings: type,
) -> Node:
    """Return a node of ours; the parameters it starts with are kept beside the launch's log.

    Raises
    ------
    SettingError
        If a parameter cannot have its value.
    """
    full_name = "/".join(["", *filter(None, given["namespace"].split("/")), name])
    merged: dict[str, Any] = {}
    for path in files:
        merged.update(parameters_for(Path(path), executable, full_name))
    merged.update(values)
    known = {item.name for item in settings_of(settings)}
    try:
        build(settings, {item: value for item, value in merged.items() if item in known})
    except SettingError as error:
        raise SettingError(f"{full_name}: {error}") from None
    # A replay that ended would begin again.
    is_respawned = given["respawn"] == "true" and not merged.get("replay_file")
    kept = Path(launch_config.get_log_file_path(f"{full_name[1:].replace('/', '.')}.yaml"))
    kept.write_text(parameter_file(merged), encoding="utf-8")
    return Node(
        package=PACKAGE,
        executable=executable,
        name=name,
        namespace=given["namespace"],
        parameters=[str(kept)],
        remappings=_relative(DRIVER_TOPICS),
        ros_arguments=["--log-level", given["log_level"]],
        output="screen",
        on_exit=partial(_ended, is_respawned),
        respawn=is_respawned,
        respawn_delay=RESPAWN_DELAY_S,
    )


def _ended(is_respawned: bool, event: ProcessExited, context: LaunchContext) -> None:
    """Let a node be started again, unless it would only end again.

    Raises
    ------
    RuntimeError
        If what it was given is wrong, or it failed and is not started again: that ends the
        launch, with an exit code that says so.
    """
    is_final = event.returncode == _WRONG_USE or (event.returncode and not is_respawned)
    if is_final and not context.is_shutdown:
        raise RuntimeError(f"{event.process_name} ended with exit code {event.returncode}")


def _given(context: LaunchContext) -> Given:
    """Return every argument as text; one that a launch file does not have is at its default."""
    stock = {name: item.default or "" for name, item in ARGUMENTS.items()}
    return {**stock, **context.launch_configurations}


def _addresses(given: Given) -> dict[str, str | int]:
    """Return the network parameters that were given; with a virtual L2 all four, on this host."""
    values: dict[str, str | int] = {
        name: given[name] for name in ("l2_ip", "host_ip") if given[name]
    }
    for name in ("l2_port", "host_port"):
        if given[name]:
            if not given[name].isdecimal():
                raise ValueError(f"{name}:={given[name]} is not a port number")
            values[name] = int(given[name])
    if given["emulator"] == "true":
        stock = {"l2_port": wire.LIDAR_PORT, "host_port": wire.HOST_PORT}
        values = {**stock, **values, "l2_ip": LOOPBACK, "host_ip": LOOPBACK}
        if values["l2_port"] == values["host_port"]:
            raise ValueError(f"l2_port and host_port are both {values['l2_port']} on this host")
    return values


def _emulator(given: Given, values: Parameters) -> list[ExecuteProcess]:
    if given["emulator"] != "true":
        return []
    try:
        options = shlex.split(given["emulator_options"])
    except ValueError as error:
        raise ValueError(f"emulator_options:={given['emulator_options']}: {error}") from None
    command: list[Any] = [
        ExecutableInPackage("l2lidar_emulator", PACKAGE),
        *("--lidar-port", str(values["l2_port"])),
        *("--host-port", str(values["host_port"])),
        *options,
    ]
    return [
        ExecuteProcess(cmd=command, name="l2lidar_emulator", output="screen", on_exit=_emulated)
    ]


def _emulated(event: ProcessExited, context: LaunchContext) -> Shutdown:
    """Return what ends the launch with the virtual L2.

    Raises
    ------
    RuntimeError
        If it failed: that ends the launch as well, with an exit code that says so.
    """
    if event.returncode > 0 and not context.is_shutdown:
        raise RuntimeError(f"the virtual L2 ended with exit code {event.returncode}")
    return Shutdown(reason="the virtual L2 has ended")


def _relative(topics: Iterable[str]) -> list[tuple[str, str]]:
    """Return remappings that take topics named from the root into the node's namespace."""
    return [(topic, topic.removeprefix("/")) for topic in topics]
