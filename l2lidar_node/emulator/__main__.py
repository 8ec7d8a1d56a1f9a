"""Runs the virtual L2: ``python -m l2lidar_node.emulator``."""

from l2lidar_node.emulator.cli import main

if __name__ == "__main__":
    main()
