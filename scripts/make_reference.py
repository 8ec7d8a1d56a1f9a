"""Writes what follows from the settings: the parameter files of config/, and docs/parameters.md.

Run ``make pages`` or ``python -m scripts.make_reference`` after a setting changed; ``--check``
tells if it is due.
"""

from __future__ import annotations

import argparse
import sys
import textwrap
from pathlib import Path

from l2lidar_node.config import DriverConfig
from l2lidar_node.settings import Setting, markdown_table, settings_of
from l2lidar_proc.deskew.config import DeskewNodeConfig
from l2lidar_proc.odometry.config import OdometryNodeConfig
from l2lidar_proc.slam.config import SlamNodeConfig

ROOT = Path(__file__).resolve().parents[1]
FILES: dict[str, dict[str, type]] = {
    "l2lidar_node.yaml": {"/**": DriverConfig},
    "l2lidar_proc.yaml": {
        "deskew_node": DeskewNodeConfig,
        "odometry_node": OdometryNodeConfig,
    },
    "l2lidar_slam.yaml": {"slam_node": SlamNodeConfig},
}
"""Parameter files: the settings of each node they are for."""

SHIPPED = {"enable_IMU_publishing": True}
"""Where a shipped file differs from the defaults: a newcomer wants to see the IMU."""

HEAD = """\
# Every parameter with its default, unless a comment says otherwise.
# This file is written by scripts/make_reference.py; copy it and give yours to the launch file.
"""

PAGE_HEAD = """# Parameters

Parameters marked as live can be set while the node runs. A wrong value is refused with a reason,
at start and live, all or nothing. Upstream's YAML file works as it is.
`ros2 param describe /l2lidar_node NAME` says the same.

The files to start from are `config/l2lidar_node.yaml` and `config/l2lidar_proc.yaml`;
`config/consumers/` has the driver's parameters for LIO-SAM, FAST-LIO and others.
"""


def parameter_file(nodes: dict[str, type]) -> str:
    """Return the text of a parameter file from the settings of each node it is for."""
    lines = [HEAD]
    for node, group in nodes.items():
        lines.append(f"{node}:\n  ros__parameters:\n")
        for item in settings_of(group):
            words = textwrap.wrap(_meaning(item), 93)
            lines += [f"    # {line}\n" for line in words]
            value = SHIPPED.get(item.name, item.default)
            if item.name in SHIPPED:
                lines.append(f"    # (the default is {_scalar(item.default)})\n")
            lines.append(f"    {item.name}: {_scalar(value)}\n")
    return "".join(lines)


def parameter_page() -> str:
    """Return the page of all parameters of all nodes."""
    nodes = {"l2lidar_node" if node == "/**" else node: group
             for file in FILES.values() for node, group in file.items()}  # fmt: skip
    parts = [PAGE_HEAD]
    parts += [f"## {name}\n\n{markdown_table(group)}\n" for name, group in nodes.items()]
    return "\n".join(parts)


def _meaning(item: Setting) -> str:
    facts = [item.range_text or (item.unit and f"in {item.unit}"), "live" if item.live else ""]
    extra = "; ".join(fact for fact in facts if fact)
    return item.doc[0].upper() + item.doc[1:] + (f" ({extra})" if extra else "")


def _scalar(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(_scalar(item) for item in value) + "]"
    if isinstance(value, float):
        mantissa, exponent, power = repr(value).partition("e")
        return mantissa + ("" if "." in mantissa else ".0") + exponent + power  # as YAML wants it
    return f'"{value}"' if isinstance(value, str) else str(value)


def outputs() -> dict[Path, str]:
    """Return the text of every file that follows from the settings."""
    files = {ROOT / "config" / name: parameter_file(nodes) for name, nodes in FILES.items()}
    return {**files, ROOT / "docs" / "parameters.md": parameter_page()}


def main() -> int:
    """Write the files, or with ``--check`` say which are out of date and return 1."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    check = parser.parse_args().check
    due = {path: text for path, text in outputs().items() if _read(path) != text}
    for path, text in due.items():
        print(f"{path.relative_to(ROOT)} {'is out of date' if check else 'written'}")
        if not check:
            path.write_text(text)
    return 1 if check and due else 0


def _read(path: Path) -> str:
    return path.read_text() if path.exists() else ""


if __name__ == "__main__":
    sys.exit(main())
