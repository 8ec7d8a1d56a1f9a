"""The rerun viewer on live topics."""

from __future__ import annotations

import importlib.util
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.l2lidar_node.ros.rig import TIMEOUT_S, Rig, open_rig

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(
        importlib.util.find_spec("rerun") is None, reason="the viewer needs rerun-sdk"
    ),
]


VIEW = [sys.executable, "-m", "l2lidar_node.cli.main", "view"]


@pytest.fixture
def rig() -> Iterator[Rig]:
    with open_rig() as rig:
        rig.driver(aggregateNframes=38)
        rig.emulator("--ready")
        rig.wait_for(lambda: rig.observer.clouds.stamps, "clouds")
        yield rig


def _view(*options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*VIEW, *options],
        capture_output=True, text=True, timeout=TIMEOUT_S, check=False,
    )  # fmt: skip


def test_what_is_published_is_written_for_the_viewer_whoever_ends_it(
    rig: Rig, tmp_path: Path
) -> None:
    path = tmp_path / "live.rrd"
    process = subprocess.Popen(
        [*VIEW, "--save", str(path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    # Two clouds are more than that: whatever time it takes to show them.
    rig.wait_for(lambda: path.exists() and path.stat().st_size > 200_000, "the file to grow")
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=TIMEOUT_S)
    assert (process.returncode, error) == (0, "")

    # And by itself, saying how much it showed.
    for seconds in (2, 20, 60):  # what a slow machine needs
        result = _view("--save", str(path), "--seconds", str(seconds))
        if result.returncode == 0:
            break
    assert result.returncode == 0, result.stderr
    assert int(result.stdout.split()[0]) > 0
    assert str(path) in result.stdout


def test_silence_is_said(tmp_path: Path) -> None:
    result = _view("--save", str(tmp_path / "none.rrd"), "--seconds", "1")
    assert result.returncode == 1
    assert "is the driver running" in result.stderr
