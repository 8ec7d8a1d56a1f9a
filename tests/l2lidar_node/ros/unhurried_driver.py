"""The driver node, waiting for a device's acknowledgment as long as a test does.

A virtual L2 that is not given the processor for a second acknowledges nothing in time.
"""

from __future__ import annotations

import sys

from l2lidar_node.driver import device

device.REPEAT_NS = 20_000_000_000  # before the node takes its timeout from it

from l2lidar_node.ros import driver_node  # noqa: E402

if __name__ == "__main__":
    sys.exit(driver_node.main())
