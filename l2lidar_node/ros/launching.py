"""Helpers of the launch files: parameters from arguments, file checks, required nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any, Final

import yaml
from launch.actions import Shutdown
from launch.events.process import ProcessExited
from launch.launch_context import LaunchContext

from l2lidar_node.ros.topics import DRIVER_TOPICS, SHOWN_TOPICS

RESPAWN_DELAY_S: Final = 2.0
WRONG_USE: Final = 2
"""Exit code of a node that refuses its arguments or parameters."""

DRIVER_REMAPPINGS: Final = [(topic, topic.removeprefix("/")) for topic in DRIVER_TOPICS]
"""Take the topics that the driver names from the root into a node's namespace."""
RVIZ_REMAPPINGS: Final = [(topic, topic.removeprefix("/")) for topic in SHOWN_TOPICS]
"""Take the topics of the RViz layouts into RViz's namespace."""


def file_given(context: LaunchContext, argument: str) -> str:
    """Return the path that a launch argument gives.

    Raises
    ------
    FileNotFoundError
        If there is no such file. launch itself would only warn, and start the node without it.
    """
    given = context.launch_configurations[argument]
    path = Path(given).expanduser()
    if not path.is_file():
        raise FileNotFoundError(f"{argument}:={given}: no such file")
    return str(path)


def file_for(node: str, values: dict[str, Any]) -> str:
    """Return the path of a new parameter file for one node of a process, in any namespace.

    What launch is given as a dict goes to every node of a process, and what goes after ``-p`` as
    ``NODE:NAME:=VALUE`` to none in a namespace. The file stays, as those that launch writes do.

    Parameters
    ----------
    node : str
        Name without namespace.
    values : dict
        Parameters.
    """
    content = {f"/**/{node}": {"ros__parameters": values}}
    with NamedTemporaryFile("w", prefix="launch_params_", suffix=".yaml", delete=False) as file:
        yaml.safe_dump(content, file)
    return file.name


def parameters_given(
    context: LaunchContext, text: Iterable[str], typed: Iterable[str] = ()
) -> dict[str, Any]:
    """Return the parameters among the launch arguments that are not left empty.

    Parameters
    ----------
    context : LaunchContext
    text : iterable of str
        Names of arguments that are text whatever they look like.
    typed : iterable of str
        Names of those that are read as YAML: ``true`` is a bool, ``6201`` an int. What is of a
        wrong type, or out of range, the node refuses.
    """
    given = context.launch_configurations
    found: dict[str, Any] = {name: given[name] for name in text if given[name]}
    for name in typed:
        if given[name]:
            found[name] = yaml.safe_load(given[name])
    return found


def required(
    is_respawned: bool = False, ends_with_success: bool = True
) -> Callable[[ProcessExited, LaunchContext], Shutdown | None]:
    """Return the ``on_exit`` of a process that the launch requires.

    Parameters
    ----------
    is_respawned : bool
        Whether launch starts it again. Then the launch goes on, unless the process refused what
        it was given: it would do so again.
    ends_with_success : bool
        Whether the launch ends where the process ended with exit code 0.

    Returns
    -------
    callable
        Raises RuntimeError where the process failed, which ends the launch with an exit code
        that says so.
    """

    def on_exit(event: ProcessExited, context: LaunchContext) -> Shutdown | None:
        if context.is_shutdown:
            return None
        code = event.returncode
        if code == WRONG_USE or (code and not is_respawned):
            raise RuntimeError(f"{event.process_name} ended with exit code {code}")
        if is_respawned or not ends_with_success:
            return None
        return Shutdown(reason=f"{event.process_name} has ended")

    return on_exit
