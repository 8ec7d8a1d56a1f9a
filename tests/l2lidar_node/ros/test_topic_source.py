"""`l2lidar check` on live topics of the driver and a virtual L2."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from tests.l2lidar_node.ros.rig import TIMEOUT_S, Rig, open_rig

pytestmark = pytest.mark.ros

CONSUMERS = ("lio_sam", "fast_lio", "nav2")


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    """A driver that streams as LIO-SAM wants it, but for the leveling."""
    with open_rig() as rig:
        rig.driver(point_layout="velodyne", ring_count=75, sweep_cut="turn", imu_adjust=True)
        rig.emulator("--boot-scale", "0.02")
        rig.wait_for(lambda: len(rig.observer.clouds.stamps) > 3, "clouds")
        yield rig


@pytest.fixture(scope="module")
def ended(rig: Rig) -> dict[str, tuple[int, str, str]]:
    """Exit code and words of checks, one of them wrong, all at the same time."""
    running = {
        consumer: check("/points", "--for", consumer, "--seconds", "2", "--json")
        for consumer in CONSUMERS
    }
    running["nothing"] = check("/nothing", "--for", "lio_sam")
    said = {name: process.communicate(timeout=TIMEOUT_S) for name, process in running.items()}
    return {name: (process.returncode, *said[name]) for name, process in running.items()}


@pytest.fixture(scope="module")
def results(ended: dict[str, tuple[int, str, str]]) -> dict[str, dict[str, Any]]:
    """JSON of a check for each consumer; the exit code is 1 where something is wrong."""
    found = {}
    for consumer in CONSUMERS:
        code, said, error = ended[consumer]
        assert code in (0, 1), error
        data = json.loads(said)
        assert code == any(item["level"] == "ERROR" for item in data["findings"])
        found[consumer] = data
    return found


def check(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "l2lidar_node.cli.main", "check", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def errors(data: dict[str, Any]) -> set[str]:
    """Return what is wrong, apart from what a busy machine loses on its way here.

    The check hears best-effort messages: on a machine too slow for them, gaps are the truth.
    """
    failed = {item["check"] for item in data["findings"] if item["level"] == "ERROR"}
    return failed - {"gaps"}


def test_the_publishers_parameter_and_qos_are_asked_for(
    results: dict[str, dict[str, Any]],
) -> None:
    data = results["fast_lio"]
    assert data["topics"] == {"cloud": "/points", "imu": "/imu/data"}
    assert errors(data) == {"levelled", "qos-imu"}
    (said,) = [item["text"] for item in data["findings"] if item["check"] == "levelled"]
    assert "imu_adjust is true" in said


def test_only_the_gravity_alignment_is_wrong_for_lio_sam(
    results: dict[str, dict[str, Any]],
) -> None:
    data = results["lio_sam"]
    assert errors(data) == {"levelled"}
    judged = {item["check"]: item["text"] for item in data["findings"]}
    assert judged["tf-imu"] == "the mount of the IMU is known"
    assert judged["fields"].endswith("read with sensor: velodyne")


def test_levelled_clouds_are_right_for_nav2(
    results: dict[str, dict[str, Any]],
) -> None:
    assert errors(results["nav2"]) == set()


def test_a_topic_that_is_not_there_is_a_usage_error(
    ended: dict[str, tuple[int, str, str]],
) -> None:
    code, _, error = ended["nothing"]
    assert code == 2
    assert (
        "there is no topic '/nothing'; topics of type sensor_msgs/msg/PointCloud2 are: " in error
    )
    assert "/points" in error
    assert "Traceback" not in error
