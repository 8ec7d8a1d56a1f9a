"""Writes the pages that follow from the code: ``docs/parameters.md``, all parameters of all nodes.

``make pages`` writes it; a test says when it is due.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

from l2lidar_node.config import DriverConfig
from l2lidar_node.settings import markdown_table
from l2lidar_proc.deskew.config import DeskewNodeConfig
from l2lidar_proc.odometry.config import OdometryNodeConfig
from l2lidar_proc.slam.config import SlamNodeConfig

PAGE: Final = Path(__file__).parents[1] / "docs" / "parameters.md"
_NODES: Final[dict[str, type]] = {
    "l2lidar_node": DriverConfig,
    "deskew_node": DeskewNodeConfig,
    "odometry_node": OdometryNodeConfig,
    "slam_node": SlamNodeConfig,
}
_HEAD: Final = """# Parameters

Parameters marked as live can be set while the node runs. A wrong value is refused with a reason,
at start and live, all or nothing. Upstream's YAML file works as it is.
`ros2 param describe /l2lidar_node NAME` says the same.

The files to start from are `config/l2lidar_node.yaml` and `config/l2lidar_proc.yaml`;
`config/consumers/` has the driver's parameters for LIO-SAM, FAST-LIO and others.
"""


def parameters() -> str:
    """Return the page of parameters."""
    parts = [_HEAD]
    parts += [f"## {name}\n\n{markdown_table(group)}\n" for name, group in _NODES.items()]
    return "\n".join(parts)


def main() -> int:
    """Write the page; return the exit code."""
    PAGE.write_text(parameters())
    print(PAGE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
