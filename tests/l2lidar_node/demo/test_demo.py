"""The demo, as a newcomer runs it."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader

from l2lidar_node.demo.__main__ import main
from l2lidar_node.demo.machine import INCONCLUSIVE

pytestmark = pytest.mark.ros

COMMAND = [sys.executable, "-m", "l2lidar_node.demo"]
TIMEOUT_S = 300  # generous: only a failure waits that long


DROPPED = r"\d+, dropped by the kernel"
PACE = re.compile(rf" ms apart, expected |/odometry: \d poses, expected |packets lost: {DROPPED}")


def run(*options: str) -> tuple[str, bool]:
    """Run the demo, in which nothing may be wrong; return what it says.

    But for the pace: where the machine is too slow, most clouds do not come through, packets wait
    until the kernel has no room for more, or the demo says that nobody can tell. Return as well
    whether it kept up.
    """
    done = subprocess.run(
        [*COMMAND, *options],
        capture_output=True, text=True, timeout=TIMEOUT_S, check=False,
        env={**os.environ, "COLUMNS": "1000"},
    )  # fmt: skip
    said, _, after = done.stdout.partition("pictures: ")
    assert after, done.stdout + done.stderr
    if done.returncode == INCONCLUSIVE:
        assert "THIS MACHINE DID NOT KEEP UP" in after
        return said, False
    wrong = [line for line in after.splitlines()[1:] if "machine was busy" not in line]
    assert [line for line in wrong if not PACE.search(line)] == [], done.stdout
    assert (done.returncode, done.stderr) == (int(bool(wrong)), "")
    return said, not wrong


def test_a_driver_whose_sensor_looks_ahead_shows_an_upright_world(tmp_path: Path) -> None:
    bag = tmp_path / "run.mcap"
    said, _ = run(
        "--forward", "--driver-only", "--duration", "4", "--folder", str(tmp_path),
        "--record", str(bag),
    )  # fmt: skip
    assert re.search(rf"lost packets: (0$|{DROPPED})", said, re.MULTILINE)
    assert "in base_link the floor is at z = -0." in said
    assert (tmp_path / "cloud.png").stat().st_size > 20_000
    with AnyReader([bag]) as reader:
        (recorded,) = re.findall(r"(\d+) messages recorded", said)
        assert reader.message_count == int(recorded)
        for topic in ("/points", "/imu/data", "/diagnostics"):
            assert reader.topics[topic].msgcount
        clouds = [connection for connection in reader.connections if connection.topic == "/points"]
        _, _, data = next(reader.messages(connections=clouds))
        cloud: Any = reader.deserialize(data, clouds[0].msgtype)
        assert cloud.header.frame_id == "l2lidar_link"
        mounts = [item for item in reader.connections if item.topic == "/tf_static"]
        transforms = {
            transform.child_frame_id: transform.header.frame_id
            for connection, _, data in reader.messages(connections=mounts)
            for transform in reader.deserialize(data, connection.msgtype).transforms  # type: ignore[attr-defined]
        }
        assert transforms["l2lidar_imu"] == "l2lidar_link"


def test_the_whole_chain_is_judged_against_the_truth(tmp_path: Path) -> None:
    said, keeps_pace = run("--duration", "6", "--folder", str(tmp_path))
    assert re.search(rf"lost packets: (0$|{DROPPED})", said, re.MULTILINE)
    assert ("mm RMS off the truth" in said) or not keeps_pace
    for name in ("cloud.png", "deskew.png", "track.png") if keeps_pace else ("cloud.png",):
        assert (tmp_path / name).stat().st_size > 20_000


def test_an_interrupt_ends_it_and_everything_it_started(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [*COMMAND, "--driver-only", "--duration", "300", "--folder", str(tmp_path)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    said = ""
    while "packets/s" not in said:
        line = process.stdout.readline()
        assert line, said
        said += line
    process.send_signal(signal.SIGINT)
    said += process.stdout.read()
    process.wait(TIMEOUT_S)
    assert process.returncode == 130, said
    assert "Traceback" not in said
    assert not [line for line in _command_lines() if str(tmp_path) in line]


def _command_lines() -> list[str]:
    lines = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            lines.append(path.read_text(errors="replace"))
    return lines


def test_a_wrong_option_is_explained(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["demo", "--duration", "1"])
    with pytest.raises(SystemExit) as leaving:
        main()
    assert leaving.value.code == 2
    said = capfd.readouterr().err
    assert "--duration" in said
    # Words of typer, which change with its version; all name the bound.
    assert re.search(r"\b3(\.0)?\b", said)


def test_a_map_without_odometry_is_refused(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["demo", "--slam", "--driver-only"])
    assert main() == 2
    assert "--slam needs the odometry" in capfd.readouterr().err
