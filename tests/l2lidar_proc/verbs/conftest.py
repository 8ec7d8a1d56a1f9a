"""The verbs are run as the command line runs them."""

from tests.l2lidar_node.cli.conftest import run

__all__ = ["run"]
