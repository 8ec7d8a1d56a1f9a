"""The rerun viewer on live topics."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from l2lidar_node.demo.processes import free_ros_domain
from tests.l2lidar_node.ros.rig import TIMEOUT_S, Rig, open_rig
from tests.support.processes import ended_with_the_test

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(
        importlib.util.find_spec("rerun") is None, reason="the viewer needs rerun-sdk"
    ),
]


@pytest.fixture
def rig() -> Iterator[Rig]:
    with open_rig() as rig:
        rig.driver(aggregateNframes=38)
        rig.emulator("--ready")
        rig.wait_for(lambda: rig.observer.clouds.stamps, "clouds")
        yield rig


def view(*options: str, **environment: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-m", "l2lidar_node.cli.main", "view", *options],
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    return ended_with_the_test(process)


def test_what_is_published_is_written_for_the_viewer_and_silence_is_said(
    rig: Rig, tmp_path: Path
) -> None:
    live, brief, none = (tmp_path / f"{name}.rrd" for name in ("live", "brief", "none"))
    interrupted = view("--save", str(live))
    ending = view("--save", str(brief), "--seconds", "1")
    silent = view("--save", str(none), "--seconds", "1", ROS_DOMAIN_ID=str(free_ros_domain()))

    # Two clouds are more than that: whatever time it takes to show them.
    rig.wait_for(lambda: live.exists() and live.stat().st_size > 200_000, "the file to grow")
    interrupted.send_signal(signal.SIGINT)
    _, error = interrupted.communicate(timeout=TIMEOUT_S)
    assert (interrupted.returncode, error) == (0, "")

    # By itself, saying how much it showed.
    said, error = ending.communicate(timeout=TIMEOUT_S)
    assert (ending.returncode, error) == (0, "")
    assert int(said.split()[0]) > 0
    assert str(brief) in said

    _, error = silent.communicate(timeout=TIMEOUT_S)
    assert silent.returncode == 1
    assert "check that the driver runs" in error
