"""What the driver's node opens it closes: where it cannot start, and at the end."""

from __future__ import annotations

import os
import pty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

rclpy = pytest.importorskip("rclpy")

from l2lidar_node.config import DriverConfig  # noqa: E402  after importorskip
from l2lidar_node.demo.processes import free_udp_ports  # noqa: E402
from l2lidar_node.ros.driver_node import open_loop  # noqa: E402
from l2lidar_node.ros.program import StartError  # noqa: E402
from l2lidar_node.settings import SettingError, build  # noqa: E402
from tests.l2lidar_node.driver.virtual_host import live_run  # noqa: E402

pytestmark = pytest.mark.ros


@pytest.fixture(scope="module")
def node() -> Iterator[Any]:
    rclpy.init()
    made = rclpy.create_node("opener")
    yield made
    made.destroy_node()
    rclpy.shutdown()


def settings(**values: Any) -> DriverConfig:
    (port,) = free_udp_ports(1)
    given = {"l2_ip": "127.0.0.1", "host_ip": "127.0.0.1", "host_port": port, **values}
    return build(DriverConfig, given)


def opened(node: Any, config: DriverConfig) -> Any:
    return open_loop(node, config, lambda event: None)


def is_open(path: Path) -> bool:
    """Tell whether this process holds a file open."""
    links = Path("/proc/self/fd").iterdir()
    return str(path) in [os.readlink(link) for link in links if link.is_symlink()]


def test_a_start_that_fails_leaves_no_capture_behind(node: Any, tmp_path: Path) -> None:
    config = settings(host_ip="192.0.2.7", record_file=str(tmp_path / "r.pcap"))
    with pytest.raises(StartError, match="not an address of this machine"):
        opened(node, config)
    assert list(tmp_path.iterdir()) == []


def test_after_a_bad_calibration_file_the_port_is_free(node: Any, tmp_path: Path) -> None:
    bad = tmp_path / "unit.yaml"
    bad.write_text("nonsense")
    config = settings(calibration_file=str(bad), record_file=str(tmp_path / "r.pcap"))
    # Held, as a node holds the problem: what its traceback refers to is not collected.
    problems = []
    for _ in range(2):
        with pytest.raises(SettingError, match="parameter 'calibration_file'") as caught:
            opened(node, config)
        problems.append(caught.value)
    assert list(tmp_path.iterdir()) == [bad]


@pytest.mark.parametrize("line", ["network", "serial"])
def test_after_a_capture_that_cannot_be_made_the_line_is_free(
    node: Any, tmp_path: Path, line: str
) -> None:
    host, device = pty.openpty()
    serial = os.ttyname(device)
    os.close(device)
    config = settings(
        record_file="/proc/no/r.pcap", serial_port=serial if line == "serial" else ""
    )
    problems = []
    for _ in range(2):
        with pytest.raises(StartError, match="cannot record to /proc/no/") as caught:
            opened(node, config)
        problems.append(caught.value)
    os.close(host)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    path = tmp_path / "run.pcap"
    path.write_bytes(live_run(1.0)[2].stream.getvalue())
    return path


def test_a_replay_closes_its_file_at_the_end(node: Any, capture: Path) -> None:
    config = settings(replay_file=str(capture), replay_rate=0.0, replay_loop=True)
    loop = opened(node, config)
    assert is_open(capture)
    loop.start()
    loop.stop()
    assert not is_open(capture)
    never_started = opened(node, config)
    assert is_open(capture)
    never_started.stop()
    assert not is_open(capture)


@pytest.mark.parametrize("wrong", ["capture", "calibration"])
def test_a_replay_that_cannot_start_leaves_no_file_open(
    node: Any, capture: Path, tmp_path: Path, wrong: str
) -> None:
    bad = tmp_path / "unit.yaml"
    bad.write_text("nonsense")
    if wrong == "capture":
        capture.write_text("nonsense")
    config = settings(
        replay_file=str(capture), calibration_file=str(bad) if wrong == "calibration" else ""
    )
    with pytest.raises((StartError, SettingError)) as caught:
        opened(node, config)
    assert not is_open(capture)
    assert str(capture if wrong == "capture" else bad) in str(caught.value)
