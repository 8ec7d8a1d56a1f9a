"""Recording, replaying and converting, over real sockets and in processes that are interrupted."""

from __future__ import annotations

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
from collections import Counter
from dataclasses import replace
from decimal import Decimal
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import dpkt
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from l2lidar_node.calibration.file import CalibrationFile
from l2lidar_node.cli.record import _paced
from l2lidar_node.config import DriverConfig, NetworkConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.files import free_name
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import WorkMode
from l2lidar_node.recording.capture import Endpoint, is_capture
from l2lidar_node.recording.recording import (
    Received,
    Recorder,
    Recording,
    RecordingWriter,
    Sent,
    endpoints,
    events,
    feed,
)
from l2lidar_node.settings import build
from l2lidar_node.transport.session import Session
from l2lidar_node.transport.udp import UdpTransport
from l2lidar_node.types import HostNs, ImuSample, Sweep
from tests.l2lidar_node.cli.conftest import LIMIT_S, Run, Unit, free_port
from tests.l2lidar_node.driver.virtual_host import essence, live_run
from tests.support.build import SHARED_DATA

ROOT = Path(__file__).parents[3]


def live(unit: Unit, path: Path, sweeps: int, **settings: Any) -> tuple[DriverConfig, list[Event]]:
    """Run a driver on a unit, recorded, until there are so many sweeps.

    Returns its settings and what it handed out.
    """
    network = {
        "l2_ip": "127.0.0.1", "l2_port": unit.lidar_port,
        "host_ip": "127.0.0.1", "host_port": unit.host_port,
    }  # fmt: skip
    config = build(DriverConfig, {**network, **settings})
    found: list[Event] = []
    failures: list[str] = []
    enough = threading.Event()

    def keep(event: Event) -> None:
        found.append(event)
        is_enough = isinstance(event, Sweep) and (
            sum(isinstance(item, Sweep) for item in found) >= sweeps
        )
        if is_enough:
            enough.set()

    recorder = Recorder(path, config.network, failures.append)
    session = Session(Driver(config), UdpTransport(config.network), keep, recorder)
    session.start()
    if unit.flash.work_mode & WorkMode.WAIT_FOR_START:
        session.call(lambda driver, now: driver.start_rotation(now)).result()
    assert enough.wait(LIMIT_S)
    session.stop()
    assert not failures
    return config, found


@pytest.mark.parametrize(
    "settings",
    [
        {"enable_latency_measure": True, "sweep_cut": "turn"},
        {"l2_sync_mode": "periodic", "reorder_window": 3},
    ],
    ids=str,
)
def test_a_recorded_run_replays_bit_for_bit(unit: Unit, tmp_path: Path, settings: Any) -> None:
    config, found = live(unit, tmp_path / "run.pcap", 4, **settings)
    with (tmp_path / "run.pcap").open("rb") as stream:
        replayed = list(events(Recording(stream), config))
    assert sum(isinstance(event, Sweep) for event in found) >= 3
    assert essence(replayed) == essence(found)


class Sniffer:
    """Captures the loopback interface as tcpdump does, with the kernel's own times."""

    def __init__(self, path: Path, port: int) -> None:
        self._port = port
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(0x0003))
        self._socket.bind(("lo", 0))
        self._socket.setsockopt(socket.SOL_SOCKET, 35, 1)  # SO_TIMESTAMPNS
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 24)
        self._socket.settimeout(0.1)
        self._file = path.open("wb")
        self._writer = dpkt.pcap.Writer(self._file, nano=True)
        self._end: float | None = None
        self._thread = threading.Thread(target=self._capture)
        self._thread.start()

    def _capture(self) -> None:
        while True:
            try:
                data, ancillary, _, sender = self._socket.recvmsg(65536, 256)
            except TimeoutError:
                if self._end is not None:
                    return
                continue
            seconds, nanoseconds = struct.unpack("@ll", ancillary[0][2])
            if self._end is not None and seconds + nanoseconds / 1e9 > self._end:
                return
            if sender[2] == socket.PACKET_OUTGOING or data[12:14] != b"\x08\x00":
                continue
            ports = struct.unpack_from(">2H", data, 34)
            if self._port in ports:
                self._writer.writepkt(data, Decimal(seconds) + Decimal(nanoseconds) / 10**9)

    def stop(self) -> None:
        self._end = time.time()
        self._thread.join(LIMIT_S)
        self._file.close()
        self._socket.close()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may capture packets")
def test_a_tcpdump_of_a_run_replays(make_unit: Any, tmp_path: Path) -> None:
    unit = make_unit(int(WorkMode.WAIT_FOR_START))  # nothing is sent before all listen
    sniffer = Sniffer(tmp_path / "tcpdump.pcap", unit.host_port)
    config, _ = live(unit, tmp_path / "own.pcap", 4, sweep_cut="turn")
    sniffer.stop()
    with (tmp_path / "tcpdump.pcap").open("rb") as stream:
        replayed = list(events(Recording(stream), config))
    own, wire_tap = entries(tmp_path / "own.pcap"), entries(tmp_path / "tcpdump.pcap")
    # Packets may wait in the socket while a sync leaves. On the wire they come before it; only
    # the driver's own recording has its order, and replays as the run did (see above).
    driver = Driver(config)
    in_order = sorted(own, key=lambda entry: entry.time)
    given = [event for entry in in_order for event in feed(driver, entry)] + driver.flush()
    samples = [item for item in given if isinstance(item, ImuSample)]
    sweeps = [item for item in given if isinstance(item, Sweep)][:-1]  # the end cut the last one
    assert len(samples) > 60
    assert len(sweeps) >= 3
    again: list[Any] = [item for item in replayed if isinstance(item, ImuSample)][: len(samples)]
    again += [item for item in replayed if isinstance(item, Sweep)][: len(sweeps)]
    # A sync leaves a little later than the driver noted, and stamps may know of it.
    late = max(there - here for here, there in zip(sent(own), sent(wire_tap), strict=False))
    assert 0 <= late < LIMIT_S * 1e9
    expected = [*samples, *sweeps]
    for copy, original in zip(again, expected, strict=True):
        assert abs(stamp_of(copy) - stamp_of(original)) <= late
    assert essence(map(at_zero, again)) == essence(map(at_zero, expected))


def entries(path: Path) -> list[Any]:
    """Return what a capture holds."""
    with path.open("rb") as stream:
        return list(Recording(stream))


def sent(some: list[Any]) -> list[int]:
    """Return when commands were sent [ns]."""
    return [entry.time for entry in some if isinstance(entry, Sent)]


def stamp_of(item: Any) -> int:
    """Return the stamp of a sample or the start of a sweep [ns]."""
    return int(item.start if isinstance(item, Sweep) else item.stamp)


def at_zero(item: Any) -> Any:
    """Return a sample or a sweep without its times."""
    if isinstance(item, ImuSample):
        return item._replace(stamp=HostNs(0))
    points = item.points.copy()
    points["time"] = 0.0
    return replace(item, start=HostNs(0), end=HostNs(0), points=points)


def test_what_is_recorded_opens_elsewhere(unit: Unit, tmp_path: Path) -> None:
    live(unit, tmp_path / "run.pcap", 4)
    with (tmp_path / "run.pcap").open("rb") as stream:
        packets = [
            (int(stamp * 10**9), dpkt.ethernet.Ethernet(data).data)
            for stamp, data in dpkt.pcap.Reader(stream)
        ]
    ports = {packet.data.sport for _, packet in packets}
    assert ports == {unit.lidar_port, unit.host_port}
    assert all(abs(stamp - time.time_ns()) < 60e9 for stamp, _ in packets)
    commands = [
        bytes(packet.data.data) for _, packet in packets if packet.data.sport == unit.host_port
    ]
    assert any(wire.HEADER.unpack(data[:12])[1] == wire.PacketType.TIME_SYNC for data in commands)


def test_record_writes_a_capture_while_it_runs(run: Run, unit: Unit, tmp_path: Path) -> None:
    path = tmp_path / "new" / "run.pcap"
    outcome = run("record", str(path), *unit.options, "--duration", "1.2")
    assert (outcome.code, outcome.err) == (0, "")
    with path.open("rb") as stream:
        recording = Recording(stream)
        assert sum(isinstance(entry, Received) for entry in recording) > 0
        assert not recording.is_cut_off
    outcome = run("record", str(path), *unit.options)
    assert outcome.code == 2
    assert "exists already" in outcome.err


def test_record_without_a_unit_fails(run: Run, tmp_path: Path) -> None:
    outcome = run(
        "record", str(tmp_path / "a.pcap"), "--l2-ip", "127.0.0.1", "--l2-port", "9",
        "--host-port", str(free_port()), "--duration", "0.3",
    )  # fmt: skip
    assert outcome.code == 1
    assert "no data came" in outcome.err
    outcome = run(
        "record", str(tmp_path / "a.mcap"), "--l2-ip", "127.0.0.1", "--l2-port", "9",
        "--host-port", str(free_port()), "--duration", "0.3",
    )  # fmt: skip
    assert outcome.code == 1
    assert list(tmp_path.iterdir()) == []  # nothing that would be in the way of another try


@pytest.mark.parametrize("name", ["run.bag", "run.pcapng", "run.2024"])
def test_a_name_with_an_unknown_ending_is_refused(run: Run, tmp_path: Path, name: str) -> None:
    (tmp_path / "a.pcap").touch()
    for verb in (["record"], ["convert", str(tmp_path / "a.pcap")]):
        outcome = run(*verb, str(tmp_path / name))
        assert outcome.code == 2
        assert f"ends in '{Path(name).suffix}'" in outcome.err
        assert "FILE.mcap" in outcome.err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a full device")
def test_a_full_disk_ends_the_recording_and_not_the_driver(unit: Unit, tmp_path: Path) -> None:
    failures: list[str] = []
    network = NetworkConfig(l2_ip="127.0.0.1", l2_port=unit.lidar_port)
    recorder = Recorder(tmp_path / "a.pcap", network, failures.append)
    full = open("/dev/full", "wb", buffering=4096)  # noqa: SIM115 - the recorder closes it
    recorder._file.close()
    recorder._file = recorder._writer._capture._packets._stream = full
    for number in range(2000):
        recorder.received(bytes(100), HostNs(number))
    recorder.close()
    (failure,) = failures
    assert "No space left" in failure
    assert str(tmp_path / "a.pcap") in failure


def test_a_recording_that_cannot_be_begun_leaves_no_file(tmp_path: Path) -> None:
    """In a process of its own, whose files may not grow, as on a full disk."""
    path = tmp_path / "a.pcap"
    program = f"""
import resource
from pathlib import Path
from l2lidar_node.config import NetworkConfig
from l2lidar_node.recording.recording import Recorder
resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
Recorder(Path({str(path)!r}), NetworkConfig(), print)
"""
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "OSError: [Errno 27] File too large" in found.stderr
    assert not path.exists()


def test_a_name_that_is_taken_gets_a_number(tmp_path: Path) -> None:
    path = tmp_path / "a.pcap"
    assert free_name(path) == path
    path.touch()
    assert free_name(path).name == "a-1.pcap"
    (tmp_path / "a-1.pcap").touch()
    assert free_name(path).name == "a-2.pcap"


def test_the_capture_names_an_address_of_this_machine() -> None:
    network = NetworkConfig(l2_ip="127.0.0.1", host_ip="0.0.0.0", host_port=77)
    assert endpoints(network) == (("127.0.0.1", 6101), ("127.0.0.1", 77))


@pytest.mark.parametrize("name", ["bag.mcap", "bag"])
def test_convert_writes_what_the_driver_hands_out(run: Run, tmp_path: Path, name: str) -> None:
    file = tmp_path / "run.pcap"
    config, found, tap = live_run(2.0, settings={"imu_adjust": False, "sweep_cut": "turn"})
    file.write_bytes(tap.stream.getvalue())
    outcome = run("convert", str(file), str(tmp_path / name))
    assert (outcome.code, outcome.err) == (0, "")
    sweeps = [event for event in found if isinstance(event, Sweep)]
    samples = [event for event in found if isinstance(event, ImuSample)]
    assert f"{len(sweeps)} clouds, {len(samples)} IMU samples" in outcome.out
    clouds: list[Any] = []
    imus: list[Any] = []
    transforms: list[Any] = []
    with AnyReader([tmp_path / name]) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            {"/points": clouds, "/imu/data": imus, "/tf_static": transforms}[
                connection.topic
            ].append(message)
    assert [stamp(cloud) for cloud in clouds] == [sweep.start for sweep in sweeps]
    assert bytes(clouds[1].data) == sweeps[1].points.tobytes()
    assert [field.name for field in clouds[1].fields] == list(sweeps[1].points.dtype.names or ())
    assert clouds[1].header.frame_id == config.frames.cloud
    assert [stamp(imu) for imu in imus] == [sample.stamp for sample in samples]
    assert imus[5].orientation.w == samples[5].orientation_wxyz[0]
    assert np.diag(imus[5].orientation_covariance.reshape(3, 3))[2] == config.imu.yaw_covar
    (message,) = transforms
    (transform,) = message.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("l2lidar_link", "l2lidar_imu")
    assert transform.transform.translation.x == wire.IMU_POSITION_M[0]
    assert transform.transform.rotation.w == 1.0
    assert sorted(path.name for path in tmp_path.iterdir()) == [name, "run.pcap"]
    assert run("convert", str(file), str(tmp_path / name)).code == 2


def stamp(message: object) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec  # type: ignore[attr-defined]


def test_record_writes_bags(run: Run, unit: Unit, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    outcome = run("record", str(path), *unit.options, "--duration", "8")
    assert (outcome.code, outcome.err) == (0, "")
    with AnyReader([path]) as reader:
        counts = {name: topic.msgcount for name, topic in reader.topics.items()}
    # nothing before the clock is locked, which takes 2 s and more on a busy machine
    assert counts["/points"] >= 3
    assert counts["/imu/data"] > 100
    said = f"run.mcap: {counts['/points']} clouds, {counts['/imu/data']} IMU samples"
    assert said in outcome.out.replace("\n", "")


def test_odometry_of_a_capture(run: Run, tmp_path: Path) -> None:
    (tmp_path / "run.pcap").write_bytes(live_run(1.2)[2].stream.getvalue())
    outcome = run("odometry", str(tmp_path / "run.pcap"), str(tmp_path / "out"))
    assert (outcome.code, outcome.err) == (0, "")
    assert (tmp_path / "out" / "map.ply").exists()
    assert (tmp_path / "out" / "trajectory.png").stat().st_size > 1000
    poses = np.loadtxt(tmp_path / "out" / "trajectory.tum", ndmin=2)
    assert len(poses) >= 3
    assert abs(poses[:, 1:4]).max() < 0.2  # it has not moved
    again = run("odometry", str(tmp_path / "run.pcap"), str(tmp_path / "out"))
    assert again.code == 2
    assert "trajectory.tum exists" in again.err
    again = run("odometry", str(tmp_path / "run.pcap"), str(tmp_path / "out"), "--overwrite")
    assert (again.code, again.err) == (0, "")


def test_odometry_of_nothing_says_so(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"nothing")
    outcome = run("odometry", str(tmp_path / "a.mcap"), str(tmp_path / "out"))
    assert outcome.code == 1
    assert "a.mcap" in outcome.err
    assert outcome.err.count("a.mcap") == 1
    assert run("odometry", str(tmp_path / "no such")).code == 2
    (tmp_path / "a.pcap").write_bytes(b"")
    outcome = run("odometry", str(tmp_path / "a.pcap"), str(tmp_path / "out"))
    assert outcome.code == 1
    assert "a.pcap: not a capture file" in outcome.err
    outcome = run("odometry", str(tmp_path / "a.mcap"), str(tmp_path / "a.pcap" / "out"))
    assert outcome.code == 1
    assert "out: Not a directory" in outcome.err  # said before the recording is looked at
    (tmp_path / "a.yaml").write_text("odometry_node: {ros__parameters: {mode: best}}")
    outcome = run("odometry", str(tmp_path / "a.mcap"), "--params-file", str(tmp_path / "a.yaml"))
    assert outcome.code == 2
    assert "mode" in outcome.err


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"no capture at all", "not a capture file"), (b"", "not a capture file")],
)
def test_what_is_no_capture_is_refused(
    run: Run, tmp_path: Path, content: bytes, words: str
) -> None:
    path = tmp_path / "a.pcap"
    path.write_bytes(content)
    for verb in (["replay", str(path)], ["convert", str(path), str(tmp_path / "bag")]):
        outcome = run(*verb)
        assert outcome.code == 1
        assert words in outcome.err


@pytest.mark.skipif(not SHARED_DATA.exists(), reason="the recordings are not here")
def test_a_capture_of_another_sensor_is_refused(run: Run) -> None:
    (path,) = (SHARED_DATA / "ouster_os1").glob("*.pcap")
    outcome = run("replay", str(path))
    assert outcome.code == 1
    assert "has no L2 packets" in outcome.err


@pytest.mark.parametrize("text", ["here", "127.0.0.1", "127.0.0.1:0", "127.0.0.1:x"])
def test_replay_refuses_wrong_ends(run: Run, tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.pcap"
    path.touch()
    assert run("replay", str(path), "--to", text).code == 2


@pytest.fixture(scope="module")
def recorded() -> bytes:
    """What a driver records, made in virtual time."""
    return live_run(1.5)[2].stream.getvalue()


@pytest.fixture
def capture(recorded: bytes, tmp_path: Path) -> tuple[Path, list[Received]]:
    path = tmp_path / "run.pcap"
    path.write_bytes(recorded)
    with path.open("rb") as stream:
        return path, [entry for entry in Recording(stream) if isinstance(entry, Received)]


class Listener:
    """A socket that keeps what it gets."""

    def __init__(self) -> None:
        self.port = free_port()
        network = NetworkConfig(l2_ip="127.0.0.1", host_ip="127.0.0.1", host_port=self.port)
        self._transport = UdpTransport(network)
        self.data: list[bytes] = []
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self) -> None:
        while not self._stopping.is_set():
            self.data += [item.data for item in self._transport.receive(0.05)]

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join(LIMIT_S)
        self._take_the_rest()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as last:  # tells of drops before it
            last.sendto(b"end", ("127.0.0.1", self.port))
            while self.data[-1:] != [b"end"]:
                self._take_the_rest()
        self.data.pop()
        self._transport.close()

    def _take_the_rest(self) -> None:
        while rest := self._transport.receive(0.05):
            self.data += [item.data for item in rest]

    def has_heard(self, sent: list[Received]) -> bool:
        """Tell whether all came in its order, but for what the kernel had no room for."""
        rest = iter([entry.data for entry in sent])
        is_in_order = all(data in rest for data in self.data)
        return is_in_order and len(sent) == len(self.data) + self._transport.kernel_drops


def replayed(run: Run, path: Path, *options: str) -> tuple[Listener, str]:
    listener = Listener()
    outcome = run("replay", str(path), "--to", f"127.0.0.1:{listener.port}", *options)
    listener.stop()
    assert (outcome.code, outcome.err) == (0, "")
    return listener, outcome.out


def test_replay_sends_what_was_received(run: Run, capture: tuple[Path, list[Received]]) -> None:
    path, entries = capture
    begun = time.monotonic()
    listener, said = replayed(run, path, "--rate", "2")
    assert listener.has_heard(entries)
    lasted = (entries[-1].time - entries[0].time) / 1e9
    assert time.monotonic() - begun > lasted / 2
    assert f"{len(entries)} datagrams sent" in said


def test_replay_seeks_and_stops(run: Run, capture: tuple[Path, list[Received]]) -> None:
    path, entries = capture
    seconds = np.array([entry.time - entries[0].time for entry in entries]) / 1e9
    # Between two of its packets: a pause of this machine may be anywhere.
    start = f"{seconds[len(entries) // 4 :][:2].mean():.7f}"
    duration = f"{seconds[len(entries) // 2 :][:2].mean() - float(start):.7f}"
    listener, _ = replayed(run, path, "--rate", "3", "--start", start, "--duration", duration)
    within = (seconds >= float(start)) & (seconds <= float(start) + float(duration))
    assert 0.2 < within.mean() < 0.3
    assert listener.has_heard(
        [entry for entry, is_in in zip(entries, within, strict=True) if is_in]
    )


@pytest.mark.parametrize("step_s", [-3600.0, 60.0, 3600.0])
def test_replay_keeps_the_pace_where_the_clock_was_set(step_s: float) -> None:
    *_, tap = live_run(3.0, host_steps=((1.0, step_s),))
    recording = Recording(tap.stream)
    seconds = np.array([at for _, at in _paced(recording, 0.0, 0.0, None)])
    assert seconds[0] == 0.0
    assert (np.diff(seconds) >= 0.0).all()
    assert np.diff(seconds).max() < 0.5
    assert seconds[-1] == pytest.approx(3.0, abs=0.5)


def test_replay_from_beyond_the_end_says_so(
    run: Run, capture: tuple[Path, list[Received]]
) -> None:
    path, _ = capture
    outcome = run("replay", str(path), "--start", "1000", "--to", f"127.0.0.1:{free_port()}")
    assert outcome.code == 1
    assert "has no data from 1000 s on" in outcome.err


def started(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "l2lidar_node.cli.main", *arguments],
        cwd=ROOT,
        env={**os.environ, "COLUMNS": "200", "NO_COLOR": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_until(condition: Any, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + LIMIT_S
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_ctrl_c_ends_a_recording_well(unit: Unit, tmp_path: Path) -> None:
    path = tmp_path / "run.pcap"
    process = started("record", str(path), *unit.options)
    wait_until(lambda: path.exists() and path.stat().st_size > 100_000, process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, err) == (0, "")
    assert "MB" in out
    with path.open("rb") as stream:
        recording = Recording(stream)
        assert sum(1 for _ in recording) > 100
        assert not recording.is_cut_off


def test_a_killed_recording_is_there_but_for_its_end(unit: Unit, tmp_path: Path) -> None:
    path = tmp_path / "run.pcap"
    process = started("record", str(path), *unit.options)
    wait_until(lambda: path.exists() and path.stat().st_size > 300_000, process)
    process.kill()
    process.communicate()
    with path.open("rb") as stream:
        recording = Recording(stream)
        assert sum(isinstance(entry, Received) for entry in recording) > 300


def test_ctrl_c_ends_a_loop(run: Run, capture: tuple[Path, list[Received]]) -> None:
    path, entries = capture
    listener = Listener()
    process = started(
        "replay", str(path), "--to", f"127.0.0.1:{listener.port}", "--loop", "--rate", "3"
    )
    wait_until(lambda: len(listener.data) > 2 * len(entries), process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=LIMIT_S)
    listener.stop()
    assert (process.returncode, err) == (0, "")
    said = re.search(r"(\d+) datagrams sent", out)
    assert said is not None
    loops = list(islice(cycle(entries), int(said[1]) + 1))
    # The interrupt may come when one is sent and not counted yet.
    assert listener.has_heard(loops[:-1]) or listener.has_heard(loops)


def repeated(entries: list[Received], path: Path, times: int, first: int | None = None) -> None:
    """Write a capture of the entries several times over, each time later."""
    length = entries[-1].time - entries[0].time + 5_000_000
    shift = 0 if first is None else first - entries[0].time
    with path.open("wb") as stream:
        writer = RecordingWriter(stream, Endpoint("127.0.0.1", 1), Endpoint("127.0.0.1", 2))
        for lap in range(times):
            for entry in entries:
                writer.received(entry.data, HostNs(entry.time + shift + lap * length))


def test_an_interrupted_convert_leaves_nothing(
    capture: tuple[Path, list[Received]], tmp_path: Path
) -> None:
    path = tmp_path / "long.pcap"
    repeated(capture[1], path, 20)
    process = started("convert", str(path), str(tmp_path / "run.mcap"))
    bag = tmp_path / "run.unfinished" / "run" / "run.mcap"
    wait_until(lambda: bag.exists() and bag.stat().st_size > 100_000, process)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=LIMIT_S)
    assert process.returncode == 130
    assert sorted(item.name for item in tmp_path.iterdir()) == ["long.pcap", "run.pcap"]


def test_times_that_no_stamp_can_hold_are_explained(
    run: Run, capture: tuple[Path, list[Received]], tmp_path: Path
) -> None:
    path = tmp_path / "late.pcap"
    repeated(capture[1], path, 1, first=2**31 * 10**9 - 500_000_000)
    outcome = run("convert", str(path), str(tmp_path / "late.mcap"))
    assert outcome.code == 1
    assert "2038" in outcome.err
    assert not (tmp_path / "late.mcap").exists()
    listener, _ = replayed(run, path, "--rate", "0")
    assert listener.has_heard(capture[1])  # it carries no stamps


def test_bags_of_packets_and_captures_hold_the_same(
    run: Run, capture: tuple[Path, list[Received]], tmp_path: Path
) -> None:
    path, received = capture
    packets, again, clouds = (tmp_path / name for name in ("p.mcap", "again.pcap", "clouds"))
    outcome = run("convert", str(path), str(packets), "--packets")
    assert (outcome.code, outcome.err) == (0, "")
    with AnyReader([packets]) as reader:
        (connection,) = reader.connections
        assert (connection.topic, connection.msgtype) == (
            "/l2lidar_node/packets",
            "std_msgs/msg/UInt8MultiArray",
        )
        first = next(reader.messages())
        data = reader.deserialize(first[2], connection.msgtype).data.tobytes()  # type: ignore[attr-defined]
    assert is_capture(data)
    assert run("convert", str(packets), str(again)).code == 0
    with path.open("rb") as one, again.open("rb") as other:
        assert list(Recording(one)) == list(Recording(other))
    said = [run("convert", str(file), str(tmp_path / f"{clouds}{file.stem}"))
            for file in (path, packets)]  # fmt: skip
    assert [outcome.code for outcome in said] == [0, 0]
    assert said[0].out.partition(": ")[2] == said[1].out.partition(": ")[2]
    listener, _ = replayed(run, packets, "--rate", "0")
    assert listener.has_heard(received)
    outcome = run("replay", str(tmp_path / f"{clouds}run"))
    assert outcome.code == 1
    assert "no packets of an L2 in this bag" in outcome.err
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(packets.read_bytes()[: packets.stat().st_size // 2])
    outcome = run("replay", str(damaged))
    assert outcome.code == 1
    assert "damaged.mcap: cannot be read as a recording: its end is missing" in outcome.err


def test_info_describes_recordings(
    run: Run, capture: tuple[Path, list[Received]], tmp_path: Path
) -> None:
    path, entries = capture
    about = json.loads(run("info", str(path), "--json").out)
    assert about["kind"] == "capture"
    assert about["bytes"] == path.stat().st_size
    assert about["seconds"] == pytest.approx((entries[-1].time - entries[0].time) / 1e9, abs=1e-3)
    kinds = Counter(wire.HEADER.unpack(entry.data[:12])[1] for entry in entries)
    assert about["packets"]["points_3d"] == kinds[wire.PacketType.POINTS_3D]
    assert about["lost"] == {"points": 0, "imu": 0}
    assert about["full_turns"] >= 1
    assert about["unit"]["firmware"] == "2.8.11.1"
    assert about["unit"]["calibration"]["range_bias"] == -365.625
    assert run("convert", str(path), str(tmp_path / "run.mcap")).code == 0
    about = json.loads(run("info", str(tmp_path / "run.mcap"), "--json").out)
    (cloud,) = [topic for topic in about["topics"] if topic["name"] == "/points"]
    assert cloud["type"] == "sensor_msgs/msg/PointCloud2"
    assert cloud["messages"] >= 1
    assert cloud["qos"] == ["best_effort, 10"]
    said = run("info", str(path)).out
    assert "full turns" in said
    assert "MB" in said


def test_info_of_a_calibration_says_what_is_in_it(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "unit.yaml"
    CalibrationFile(bytes(32), {"beta_angle": 0.004}, about={"places": [{"name": "a"}]}).save(path)
    content = json.loads(run("info", str(path), "--json").out)["content"]
    assert content["correction"] == {"beta_angle": 0.004}
    said = run("info", str(path)).out
    assert re.search(r"^correction beta angle +0\.004 *$", said, re.M)
    assert re.search(r"^about places +a *$", said, re.M)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.pcap", b"", "not a capture file"),
        ("a.mcap", b"nothing", "cannot be read as a recording"),
        ("a.txt", b"nothing", "neither a capture, nor MCAP, nor a rosbag2 folder"),
        ("a.yaml", b"{", "a.yaml: not YAML (while parsing"),
        ("a.yaml", b"a: 1", "a.yaml: format is None, expected 1"),
        ("a.yaml", bytes([0xC3, 0x28]), "a.yaml: "),
        ("nothing", None, "no such file"),
    ],
)
def test_info_of_what_is_neither_says_so(
    run: Run, tmp_path: Path, name: str, content: Any, words: str
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    outcome = run("info", str(tmp_path / name))
    assert outcome.code == 1
    assert words in outcome.err
    assert outcome.err.count("\n") == 1


def test_check_judges_a_capture_as_the_consumer_would_get_it(
    run: Run, capture: tuple[Path, list[Received]], tmp_path: Path
) -> None:
    outcome = run("check", str(capture[0]), "--for", "lio_sam", "--json")
    found = json.loads(outcome.out)
    texts = [item["text"] for item in found["findings"]]
    assert any("read with sensor: velodyne" in text for text in texts)  # by its driver.yaml
    assert any("imu_adjust is false" in text for text in texts)
    outcome = run("check", str(capture[0]), "--for", "kiss_icp")
    assert "KISS-ICP" in outcome.out.splitlines()[-1]
    packets = tmp_path / "packets.mcap"
    assert run("convert", str(capture[0]), str(packets), "--packets").code == 0
    assert run("check", str(packets), "--for", "kiss_icp") == outcome
    outcome = run("convert", str(capture[0]), str(tmp_path / "a.mcap"), "--l2-ip", "192.0.2.9")
    assert outcome.code == 1
    assert "no packets of an L2 at 192.0.2.9, only 192.168.1.62" in outcome.err
