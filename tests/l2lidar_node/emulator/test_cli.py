"""The command line as a user starts it: processes, exit codes, what it says and what it writes."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from l2lidar_node.emulator.cli import main
from l2lidar_node.emulator.config import DeviceConfig
from l2lidar_node.emulator.physics import PhysicsConfig, RayCastWorker, assemble
from l2lidar_node.emulator.truth import Fault, Results
from l2lidar_node.emulator.unit.firmware import Flash
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import WorkMode
from l2lidar_node.recording import tum
from l2lidar_node.settings import build, settings_of
from tests.l2lidar_node.emulator.rig import command, read
from tests.support.processes import ended_with_the_test

LIMIT_S = 120.0
ROOT = Path(__file__).parents[3]
QUICK = ("--world", "pattern", "--ready", "--lidar-port", "0")

needs_rays = pytest.mark.skipif(find_spec("open3d") is None, reason="needs open3d")


@pytest.fixture
def host() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as item:
        item.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        item.bind(("127.0.0.1", 0))
        item.settimeout(LIMIT_S)
        yield item


def started(*options: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "COLUMNS": "200", "NO_COLOR": "1", "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "l2lidar_node.emulator", *options],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    return ended_with_the_test(process)


def run(*options: str) -> tuple[int, str, str]:
    process = started(*options)
    out, err = process.communicate(timeout=LIMIT_S)
    return process.returncode, out, err


Invoke = Callable[..., tuple[int, str, str]]


@pytest.fixture
def invoke(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Invoke:
    """Run the command line in this process, which spares a second of imports."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("NO_COLOR", "1")

    def run_here(*options: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["l2lidar_emulator", *options])
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        with pytest.raises(SystemExit) as leaving:
            main()
        for number, handler in handlers.items():
            signal.signal(number, handler)
        assert isinstance(leaving.value.code, int)
        return leaving.value.code, *capfd.readouterr()

    return run_here


def port_of(item: socket.socket) -> str:
    return str(item.getsockname()[1])


def dropped(item: socket.socket) -> int:
    """Return how many datagrams the kernel had no room for."""
    port = f":{item.getsockname()[1]:04X}"
    lines = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()]
    return sum(int(line[-1]) for line in lines[1:] if line[1].endswith(port))


def lidar_of(process: subprocess.Popen[str]) -> tuple[str, int]:
    """Read the greeting up to the line that says where the unit listens."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("udp "):
            ip, port = line.split()[1].split(":")
            return ip, int(port)
    raise AssertionError("the emulator said nothing")


def ask(host: socket.socket, lidar: tuple[str, int], data: bytes) -> int:
    """Send a command once the unit is on, until it was acknowledged; return how often.

    An answer that finds the socket full is lost.
    """
    host.recv(2000)
    for times in range(1, 20):
        host.sendto(data, lidar)
        for _ in range(1000):
            if any(frame.packet_type == wire.PacketType.ACK for frame in read(host.recv(2000))):
                return times
    raise AssertionError("no acknowledgement")


def test_a_bounded_run_says_what_it_is_and_what_it_did(host: socket.socket) -> None:
    code, out, err = run(
        *QUICK, "--host-port", port_of(host), "--duration", "4", "--speed", "20", "--loss", "0.1",
        "--clock-ratio", "2",
    )  # fmt: skip
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0] == "virtual YS-L2, firmware 2.8.11.1, work mode 0, clock 1/2: pattern"
    assert lines[1].startswith("udp 127.0.0.1:")
    assert lines[1].endswith(f"127.0.0.1:{port_of(host)}, IMU after 0 s, points after 0 s")
    assert lines[2] == "faults: loss 0.1"
    assert "POINTS_3D" in lines[3]
    assert "heard: nothing" in lines[3]
    assert lines[4].startswith("latency: p50 ")
    assert lines[5].startswith("faults that happened: ")
    assert read(host.recv(2000))[0].packet_type == wire.PacketType.IMU


@needs_rays
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_cleanly_when_told_to(host: socket.socket, number: Any) -> None:
    process = started(*QUICK, "--world", "box", "--host-port", port_of(host))
    times = ask(host, lidar_of(process), command(2000, 6, 1))
    os.killpg(process.pid, number)  # as a terminal or a supervisor does
    out, err = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, err) == (0, "")
    heard = re.search(r"heard: (\d+) COMMAND", out)
    assert heard is not None
    assert 1 <= int(heard[1]) <= times


def measuring(process: Any) -> Any:
    """Return the number of the measuring process, once there is one."""
    while True:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        for child in children:
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                return int(child)
        assert process.poll() is None


@needs_rays
@pytest.mark.parametrize("is_ready", [False, True])
def test_it_does_not_wait_for_a_measuring_process_that_is_held_up(
    host: socket.socket, is_ready: bool
) -> None:
    options = ["--world", "box", "--boot-scale", "10", "--lidar-port", "0"]
    process = started(*options, "--host-port", port_of(host))
    if is_ready:
        lidar_of(process)
    os.kill(measuring(process), signal.SIGSTOP)  # else while it imports what casts rays
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=LIMIT_S)
    assert err == ""
    assert out or not is_ready  # it greets once it is ready
    assert process.returncode == (0 if out else 130)


def half_a_block(path: Path) -> None:
    """Send the beginning of an answer of 1 MB, from within the measuring process."""
    answers = sys._getframe(1).f_locals["result_queue"]
    os.write(answers._writer.fileno(), struct.pack("!i", 1 << 20) + bytes(10))
    path.touch()
    signal.pause()


def half_sent(path: Path) -> tuple[RayCastWorker, Future[None]]:
    """Return a worker that has sent the beginning of an answer, and that answer."""
    worker = RayCastWorker(PhysicsConfig(world="box"))
    answer = worker._pool.submit(half_a_block, path)
    deadline = time.monotonic() + LIMIT_S
    while not path.exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return worker, answer


def close(worker: RayCastWorker) -> None:
    """Close a worker, which must not take forever."""
    closing = threading.Thread(target=worker.close, daemon=True)
    closing.start()
    closing.join(LIMIT_S)
    assert not closing.is_alive()


@needs_rays
def test_the_rest_of_a_block_that_was_cut_off_is_not_waited_for(tmp_path: Path) -> None:
    worker, _ = half_sent(tmp_path / "sent")
    close(worker)


@needs_rays
def test_a_measuring_process_that_is_killed_while_it_writes_is_noticed(tmp_path: Path) -> None:
    worker, answer = half_sent(tmp_path / "sent")
    for process in worker._pool._processes.values():
        process.kill()
    with pytest.raises(BrokenProcessPool):
        answer.result(LIMIT_S)
    close(worker)


@needs_rays
def test_a_killed_measuring_process_is_one_message(host: socket.socket) -> None:
    process = started(
        "--world", "box", "--ready", "--lidar-port", "0", "--host-port", port_of(host)
    )
    host.recv(2000)
    os.kill(measuring(process), signal.SIGKILL)
    _, err = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 1
    assert err == "l2lidar_emulator: the ray-cast process ended\n"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--loss", "2"], ["'--loss'", "2.0 is out of range", "0 to 1"]),
        (["--loss", "often"], ["'--loss'", "'often' is not a number", "0 to 1"]),
        (["--lidar-port", "x"], ["'--lidar-port'", "'x' is not a whole number"]),
        (["--jitter", "some"], ["'--jitter'", "'heavy'"]),
        (["--reboot-at", "1,x"], ["'--reboot-at'", "1,x", "such as"]),
        (["--reboot-at", "-1"], ["'--reboot-at'", "out of range"]),
        (["--speed", "fast"], ["'--speed'", "'fast'", "or max"]),
        (["--speed", "0"], ["'--speed'", "0.01 to 1000"]),
        (["--duration", "-1"], ["'--duration'"]),
        (["--ready", "--boot-scale", "1"], ["'--ready'", "'--boot-scale'"]),
        (["--truth-points"], ["'--truth-points'", "'--truth'"]),
        (["--lidar-ip", "l2"], ["lidar_ip", "'l2'", "192.168.1.62"]),
        (["--firmware", "2"], ["firmware", "four numbers"]),
        (["--product", 24 * "x"], ["'--product'", "1 to 23 ASCII characters"]),
        (["--product", "Müller"], ["'--product'", "1 to 23 ASCII characters"]),
        (["--firmware-date", "July"], ["'--firmware-date'", "six digits"]),
        pytest.param(["--world", "garden"], ["garden", "room"], marks=needs_rays),
        pytest.param(["--world", "no/mesh.ply"], ["no/mesh.ply"], marks=needs_rays),
        pytest.param(["--motion", "no/path.tum"], ["no/path.tum"], marks=needs_rays),
        (["--mount", "sideways"], ["'--mount'", "upside_down"]),
        (["--flash", "pyproject.toml"], ["pyproject.toml", "stored settings"]),
        (["--flash", "tests"], ["tests: Is a directory"]),
        (
            ["--flash", "no/folder/flash.json"],
            ["flash.json", "'no/folder' is not a writable folder"],
        ),
        pytest.param(["--world", "tests"], ["tests: not a file"], marks=needs_rays),
        (["--worlds", "room"], ["--worlds"]),
    ],
)
def test_a_wrong_option_is_named_with_what_would_be_right(
    options: Any, words: Any, invoke: Invoke
) -> None:
    code, out, err = invoke("--lidar-port", "0", *options)
    assert (code, out) == (2, ""), err
    text = " ".join(err.replace("│", " ").split())
    for word in words:
        assert word in text
    assert "Traceback" not in err


@pytest.mark.skipif(find_spec("open3d") is not None, reason="needs a machine without open3d")
def test_a_world_without_what_casts_rays_is_one_message() -> None:
    code, _, err = run("--lidar-port", "0")
    assert code == 1
    assert err.splitlines() == [
        "l2lidar_emulator: No module named 'open3d'; '--world pattern' needs no rays"
    ]


def test_a_port_in_use_is_one_message(host: socket.socket, invoke: Invoke) -> None:
    code, out, err = invoke("--world", "pattern", "--lidar-port", port_of(host))
    assert (code, out) == (1, "")
    assert err.splitlines() == [
        f"l2lidar_emulator: cannot listen on 127.0.0.1:{port_of(host)}: Address already in use"
    ]


def test_a_folder_that_cannot_be_written_is_one_message(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    code, out, err = run(*QUICK, "--duration", "9", "--truth", str(tmp_path / "file" / "truth"))
    assert (code, out) == (1, "")  # before it runs: afterwards the truth would be lost
    assert len(err.splitlines()) == 1
    assert "truth: Not a directory" in err


def test_help_shows_every_setting_once(invoke: Invoke) -> None:
    code, out, _ = invoke("--help")
    assert code == 0
    text = out.split()
    for kind in (DeviceConfig, PhysicsConfig):
        for item in settings_of(kind):
            option = f"--{item.name.replace('_', '-')}"
            assert text.count(option) + text.count(f"{option},") >= 1, option
    for heading in ("Network", "World and motion", "Clock", "Power", "Faults", "Run"):
        assert f"─ {heading} ─" in out


def test_what_the_unit_stores_outlives_it(
    host: socket.socket, tmp_path: Path, invoke: Invoke
) -> None:
    file = tmp_path / "flash.json"
    process = started(*QUICK, "--host-port", port_of(host), "--flash", str(file))
    ask(host, lidar_of(process), command(2002, int(WorkMode.IMU_OFF)))
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, err) == (0, "")
    assert Flash.from_json(file.read_text()).work_mode == WorkMode.IMU_OFF
    code, out, _ = invoke(*QUICK, "--flash", str(file), "--duration", "1", "--speed", "20")
    assert code == 0
    assert "work mode 4" in out
    assert "IMU," not in out.splitlines()[2]


def test_a_pseudo_terminal_is_named_and_carries_packets() -> None:
    process = started("--world", "none", "--ready", "--serial", "pty")
    assert process.stdout is not None
    process.stdout.readline()
    kind, path = process.stdout.readline().rstrip().split(",")[0].split()
    assert kind == "serial"
    line = os.open(path, os.O_RDWR | os.O_NOCTTY)
    stream = b""
    while {frame.packet_type for frame in read(stream)} != {102, 104}:
        stream += os.read(line, 65536)
    os.close(line)
    points = next(frame for frame in read(stream) if frame.packet_type == 102)
    row = np.frombuffer(points.payload, wire.POINTS_3D_PAYLOAD)
    assert not row["ranges"].any()
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0


@needs_rays
def test_the_truth_of_a_run(host: socket.socket, tmp_path: Path) -> None:
    """What arrives at the socket, the packet log, the trajectory and the exact points agree."""
    folder = tmp_path / "truth"
    process = started(
        "--world", "box", "--motion", "spin", "--rest-s", "0.2", "--ready", "--lidar-port", "0",
        "--host-port", port_of(host), "--duration", "2", "--split", "0.2", "--bad-crc", "0.1",
        "--truth", str(folder), "--truth-points", "--seed", "7", "--clock-ratio", "1.95",
    )  # fmt: skip
    stream = b""
    host.settimeout(0.1)  # read all along: by default the kernel keeps a quarter of this run
    is_over = False
    while not is_over:
        is_over = process.poll() is not None
        with contextlib.suppress(TimeoutError):
            while True:
                stream += host.recv(2000)
    out, err = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, err) == (0, ""), out
    got = [
        np.frombuffer(f.payload, wire.POINTS_3D_PAYLOAD)[0]
        for f in read(stream)
        if f.packet_type == 102
    ]

    results = Results(folder)
    assert results.run["settings"]["seed"] == 7
    late = results.run["latency_ms"]
    assert 0.0 < late["p50"] <= late["p99"] <= late["max"]
    assert json.loads((folder / "run.json").read_text())["settings"]["world"] == "box"
    packets = results.packets[results.packets["type"] == 102]
    whole = packets[packets["copies"] > 0]
    assert len(whole) < len(packets)
    numbers = {seq: number for number, seq in enumerate(whole["seq"].tolist())}
    arrived = [numbers[int(row["info"]["seq"])] for row in got]
    assert arrived == sorted(set(arrived))
    assert len(whole) - len(arrived) <= 2 * dropped(host)  # a piece may belong to two packets
    bad = {
        (event.packet_type, event.ordinal)
        for event in results.faults
        if event.fault is Fault.BAD_CRC
    }
    gone = results.packets[results.packets["copies"] == 0]
    assert {(int(row["type"]), int(row["ordinal"])) for row in gone} == bad

    since = packets["start_ns"] - results.run["power_on_ns"]
    assert np.abs(since - packets["index"] * 4_639_000).max() <= 1
    assert np.abs(packets["stamp_ns"] - since / 1.95).max() <= 1

    physics = assemble(
        build(PhysicsConfig, {"world": "box", "motion": "spin", "rest_s": 0.2, "seed": 7})
    )
    scan = physics.scanner.scan(0, 100)
    points = results.points(whole["index"][:60], WorkMode(0))
    hits = scan.hits[whole["index"][:60]]
    np.testing.assert_allclose(points["hit"], hits, atol=1e-5)
    sent = np.stack([row["ranges"] for row in got[:60]])
    assert (sent == scan.packets["ranges"][whole["index"][arrived[:60]]]).all()

    poses = results.trajectory()
    at = np.searchsorted(poses["stamp"], results.run["power_on_ns"] + 1_000_000_000)
    position, _ = physics.motion.poses(np.array([1.0]))
    np.testing.assert_allclose(poses["position"][at], position[0], atol=1e-6)
    assert poses["stamp"][-1] >= packets["left_ns"][-1]
    assert poses.dtype == tum.POSE


def test_asking_for_points_that_were_never_measured_says_so(
    tmp_path: Path, invoke: Invoke
) -> None:
    code, _, err = invoke(*QUICK, "--duration", "0.2", "--truth", str(tmp_path))
    assert code == 0, err
    with pytest.raises(KeyError, match="no points of packet 3"):
        Results(tmp_path).points(np.array([3]), WorkMode(0))
