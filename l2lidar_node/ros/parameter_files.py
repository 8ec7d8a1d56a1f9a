"""Reads the parameters of one node from a ROS parameter file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from l2lidar_node.settings import build

G = TypeVar("G")


class _Loader(yaml.SafeLoader):
    """YAML as ROS reads it: 2e-07 is a number (for PyYAML only 2.0e-07 is)."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+"), list("-+0123456789")
)


def parameters_for(path: Path, stock_name: str, full_name: str) -> dict[str, Any]:
    """Return the parameters that a file gives to a node, by name with dots.

    ROS applies a section only to the full name it is headed with. A node with another name or in a
    namespace would lose the section of its stock name without a word; here that applies as well.

    Parameters
    ----------
    path : Path
        YAML file.
    stock_name : str
        Default name of the node.
    full_name : str
        Namespace and name it has now, for example ``/front/l2lidar_node``.

    Returns
    -------
    dict
        Of two sections that apply, the later one in the file wins.

    Raises
    ------
    ValueError
        If the file does not exist, or is not a mapping of node names to ``ros__parameters``.
    """
    values: dict[str, Any] = {}
    for heading, section in _sections(_content(path), "", path):
        if heading == f"/{stock_name}" or _pattern(heading).fullmatch(full_name):
            values.update(_flat(section))
    return values


def settings_for(path: Path | None, name: str, group: type[G]) -> G:
    """Return the settings that a parameter file gives to a node of that name, without ROS.

    Parameters
    ----------
    path : Path or None
        None leaves all at their defaults.
    name : str
    group : type
        Frozen dataclass of settings.

    Raises
    ------
    ValueError
        If the file cannot be read, or something in it is wrong.
    """
    values = {} if path is None else parameters_for(path, name, f"/{name}")
    values.pop("use_sim_time", None)  # a recording tells its time, with and without it
    return build(group, values)


def parameters_by_node(path: Path | str) -> dict[str, dict[str, Any]]:
    """Return the parameters of every section of a file by its heading, for example ``/front/l2``.

    Raises
    ------
    ValueError
        As :func:`parameters_for`.
    """
    return {
        heading: _flat(section)
        for heading, section in _sections(_content(Path(path)), "", Path(path))
    }


def _content(path: Path) -> object:
    try:
        return yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except OSError as error:
        raise ValueError(f"parameter file '{path}': {error.strerror}") from None
    except (yaml.YAMLError, ValueError, IndexError, RecursionError) as error:
        # The last three are PyYAML's on dates that are none, `!!int` alone, endless brackets.
        reason = " ".join(str(error).split())
        raise ValueError(f"parameter file '{path}': not YAML: {reason}") from None


def _sections(content: object, above: str, path: Path) -> Iterator[tuple[str, Mapping[str, Any]]]:
    if content is None:
        return
    if not isinstance(content, dict):
        raise ValueError(
            f"parameter file '{path}': expected a node's name, below it 'ros__parameters:', "
            "below it the parameters"
        )
    for name, below in content.items():
        if name == "ros__parameters":
            if not isinstance(below, dict | None):
                raise ValueError(f"parameter file '{path}': no parameters below {above}/{name}")
            yield above, below or {}
        else:
            yield from _sections(below, f"{above}/{str(name).strip('/')}", path)


def _pattern(heading: str) -> re.Pattern[str]:
    """Return a heading as an expression: ``*`` is one name, ``**`` any number of them."""
    parts = {"**": "(/[^/]+)*", "*": "/[^/]+"}
    return re.compile(
        "".join(parts.get(name, f"/{re.escape(name)}") for name in heading.split("/")[1:])
    )


def _flat(section: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, value in section.items():
        if isinstance(value, dict):
            values.update(_flat(value, f"{above}{name}."))
        else:
            values[f"{above}{name}"] = value
    return values
