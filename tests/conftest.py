"""Keeps the ROS graph of a test run to itself: this machine only, a domain no other run has."""

import importlib.util
import os
import re
import signal
import sys
from collections.abc import Iterator

import hypothesis
import pytest

# Threads of OpenBLAS that wait for work spin, and the arrays of tests are small: beside other
# workers that is twice the CPU time for nothing. Before anything imports numpy.
for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(name, "1")

from l2lidar_node.demo.processes import isolate_ros  # noqa: E402  after the above
from l2lidar_node.emulator.physics import leave_out_dash  # noqa: E402
from tests.support.processes import end_all  # noqa: E402

leave_out_dash()

# Before anything imports rclpy. Each worker of pytest-xdist has a domain of its own.
for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DOMAIN_ID", "ROS_LOCALHOST_ONLY"):
    os.environ.pop(name, None)
isolate_ros()

# Where bytecode is forbidden, as containers often do, each of the hundreds of programs that tests
# start compiles all that it imports: a driver takes 2.8 s of CPU then instead of 0.8.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A shell has what runs in the background ignore interrupts, and so would all that tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The gate gives the same answer twice, and no slow or busy machine fails it; `make fuzz` explores.
hypothesis.settings.register_profile(
    "gate",
    deadline=None,
    derandomize=True,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("gate")

HAS_ROS = importlib.util.find_spec("rclpy") is not None
collect_ignore_glob = [] if HAS_ROS else ["l2lidar_node/ros/*", "l2lidar_proc/ros/*"]


# Files whose tests mostly wait: for programs, units, nodes.
WAITING = re.compile(
    r"/(ros|cli|demo|transport)/|/emulator/test_(cli|server)\.py"
    r"|/test_(launch_files|load|packaging|programs|reliability|setup)\.py"
)
LONGEST = re.compile(r"/test_(demo|launch_files|packaging|reliability|slam_node)\.py")


def spread(items: list[pytest.Item]) -> list[pytest.Item]:
    """Return tests with the files that wait spread among those that compute.

    Workers take file by file: so at any time some compute while others wait, and the run ends
    with short files.
    """
    files: dict[str, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.location[0], []).append(item)
    waiting = sorted(filter(WAITING.search, files), key=lambda name: not LONGEST.search(name))
    computing = [name for name in files if not WAITING.search(name)]
    placed = [
        (number / len(names), name)
        for names in (waiting, computing)
        for number, name in enumerate(names)
    ]
    return [item for _, name in sorted(placed) for item in files[name]]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files into order; leave out what is marked ``ros`` where there is no ROS 2."""
    items[:] = spread(items)
    if HAS_ROS:
        return
    skip = pytest.mark.skip(reason="needs rclpy: source a ROS 2 or run `make setup`")
    for item in items:
        if item.get_closest_marker("ros"):
            item.add_marker(skip)


@pytest.fixture(autouse=True)
def _no_process_is_left() -> Iterator[None]:
    """End the processes that a test leaves behind."""
    yield
    end_all()
