"""Runs the virtual L2: ``python -m l2lidar_node.emulator``."""

import sys

from l2lidar_node.emulator.cli import main
from l2lidar_node.programs import interruptible

if __name__ == "__main__":
    sys.exit(interruptible(main))
