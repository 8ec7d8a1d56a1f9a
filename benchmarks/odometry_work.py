"""Measures what the odometry of a checkout needs for sweeps that it is given, without ROS.

``python odometry_work.py FILE``, run in the root of any checkout since the first odometry: for
each line on standard input it registers so many sweeps of the file and answers with a line, the
CPU time that took [s]. Whoever asks two of them in turn compares them whatever else the machine
does. It imports nothing of its own checkout.
"""

from __future__ import annotations

import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

_MODULES = (  # today's, and those of the first half of November 2026
    ("l2lidar_proc.odometry.odometry", "l2lidar_proc.odometry.config"),
    ("l2lidar_proc.odometry", "l2lidar_proc.odometry_config"),
)


def odometry(T_cloud_imu: Any) -> Any:
    """Return the odometry of the checkout in the working directory."""
    for name, config in _MODULES:
        try:
            made = import_module(name).Odometry
            return made(import_module(config).OdometryConfig(), T_cloud_imu)
        except (ImportError, AttributeError):
            continue
    raise SystemExit(f"{Path.cwd()} has no odometry that this program knows")


def main() -> int:
    """Answer until standard input ends."""
    sys.path.insert(0, str(Path.cwd()))
    with np.load(sys.argv[1]) as file:
        points, edges, spans, packets, imu, mount = (
            file[name] for name in ("points", "edges", "spans", "packets", "imu", "T_cloud_imu")
        )
    made = odometry(mount)
    sweep_type = import_module("l2lidar_node.types").Sweep
    done = first = 0
    print("ready", flush=True)
    for line in sys.stdin:
        begin = time.process_time()
        upto = min(done + int(line), len(spans))
        for number in range(done, upto):
            start, end = (int(item) for item in spans[number])
            some = points[edges[number] : edges[number + 1]]
            last = int(np.searchsorted(imu["stamp"], end)) + 1
            made.imu(imu[first:last])
            made.register(sweep_type(start, end, some, int(packets[number]), 0))
            first = last
        done = upto
        print(time.process_time() - begin, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
