"""What the world does to a driver: cables, addresses, suspended hosts, ports and disks, for real.

Every case runs a virtual L2 and a driver in processes of their own, joined by UDP sockets, in
real time, and is judged by what the unit wrote down about every packet.

The driver, without ROS, is this module: ``python -m benchmarks.fault_world OUT [name=value ...]``
runs until it is interrupted, then writes ``OUT.npy`` (see :data:`NOTE`) and ``OUT.json``. Until
then ``OUT.now`` says how far it is.
"""

from __future__ import annotations

import ctypes
import json
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray

from l2lidar_node.clock import ClockEvent
from l2lidar_node.config import DriverConfig
from l2lidar_node.demo.processes import free_udp_ports
from l2lidar_node.driver.driver import Driver, Event, Silence
from l2lidar_node.emulator.truth import Results
from l2lidar_node.files import write_whole
from l2lidar_node.recording.recording import Recorder
from l2lidar_node.settings import build
from l2lidar_node.transport.session import Session
from l2lidar_node.transport.udp import TransportError, UdpTransport
from l2lidar_node.types import ImuSample, Sweep
from tests.support.clock_rig import RecordingClock

NOTE: Final = np.dtype(
    [("type", "<u2"), ("seq", "<u4"), ("stamp", "<i8"), ("arrival", "<i8"), ("published", "<i8")]
)
"""One packet that came to the clock, in order: published 0 where it got no stamp."""


def main() -> int:
    """Run until SIGINT; return 1 where the socket cannot be had."""
    out = Path(sys.argv[1])
    values = dict(part.split("=", 1) for part in sys.argv[2:])
    config = build(DriverConfig, {name: yaml.safe_load(text) for name, text in values.items()})
    said: list[str] = []
    recorder = None
    if config.files.record_file:
        recorder = Recorder(Path(config.files.record_file), config.network, said.append)
    try:
        transport = UdpTransport(config.network)
    except TransportError as error:
        print(error.strerror, flush=True)
        return 1
    driver = Driver(config)
    clock = driver._clock = RecordingClock(config.clock)
    last = {ImuSample: 0, Sweep: 0}
    backwards = 0
    slowest_s = 0.0

    def handle(event: Event) -> None:
        nonlocal backwards, slowest_s
        if isinstance(event, ImuSample | Sweep):
            stamp = event.stamp if isinstance(event, ImuSample) else event.start
            backwards += stamp <= last[type(event)]
            last[type(event)] = stamp
        if isinstance(event, Sweep):
            slowest_s = max(slowest_s, (time.time_ns() - event.end) / 1e9)
        elif isinstance(event, ClockEvent):
            said.append(event.text)
        elif isinstance(event, Silence):
            said.append("silence")

    session = Session(driver, transport, handle, recorder)
    stopping = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: stopping.set())
    session.start()
    print("listening", flush=True)
    while not stopping.wait(0.2) and not session.failure:
        now = {"foreign": transport.foreign, "samples": driver.counters.samples, "said": said}
        write_whole(out.with_suffix(".now"), json.dumps(now).encode())
    session.stop()
    notes = [(kind, seq, stamp, at, answer) for kind, seq, stamp, at, _, _, answer in clock.notes]
    np.save(out.with_suffix(".npy"), np.array(notes, NOTE))
    facts = {
        "failure": repr(session.failure) if session.failure else "",
        "backwards": backwards,
        "foreign": transport.foreign,
        "kernel_drops": transport.kernel_drops,
        "slowest_s": slowest_s,
        "sweeps": driver.counters.sweeps,
        "lost": sum(counts.lost for counts in driver.counters.sequence.values()),
        "late": sum(counts.late for counts in driver.counters.sequence.values()),
        "said": said,
        "recorded_octets": recorder.octets if recorder else 0,
    }
    out.with_suffix(".json").write_text(json.dumps(facts))
    return 0


_DEADLINE_S: Final = 120.0
_PRIVILEGED_PORT: Final = 81
_FREE_PORTS: Final = Path("/proc/sys/net/ipv4/ip_unprivileged_port_start")
_PR_CAPBSET_DROP: Final = 24  # of Linux's sys/prctl.h
_CAP_NET_BIND_SERVICE: Final = 10  # of linux/capability.h
_UNIT: Final = ("--ready", "--world", "pattern")


@dataclass(slots=True)
class Finding:
    """What a case found.

    Attributes
    ----------
    name : str
    good : bool
        Whether everything was as it has to be.
    arrived, published : int
        Measurements that reached the host's network whole, and those published.
    unlocked : int
        Packets without a stamp because the clock was not locked.
    missing : int
        Whole packets after the first lock that the driver never handled and that neither the
        kernel dropped nor the case made foreign.
    worst_ms : float
        Largest error of a stamp.
    backwards : int
    recovery_s : float
        From the first good packet after the fault to the first published one.
    remark : str
    """

    name: str
    good: bool = False
    arrived: int = 0
    published: int = 0
    unlocked: int = 0
    missing: int = 0
    worst_ms: float = 0.0
    backwards: int = 0
    recovery_s: float = 0.0
    remark: str = ""


class World:
    """Ports, a folder, and programs that end with it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.host_port, self.lidar_port = free_udp_ports(2)
        self.packet_logs: list[Path] = []
        self.said: dict[int, str] = {}  # first line by process number
        self._running: list[subprocess.Popen[str]] = []

    def unit(self, *options: str) -> subprocess.Popen[str]:
        """Start a virtual L2 and wait until it sends."""
        truth = self.folder / f"truth_{len(self.packet_logs)}"
        self.packet_logs.append(truth)
        return self._start(
            "l2lidar_node.emulator", *_UNIT, "--truth", str(truth),
            "--host-port", str(self.host_port), "--lidar-port", str(self.lidar_port), *options,
        )  # fmt: skip

    def host(
        self, name: str = "host", limit: int = 0, powerless: bool = False, **values: object
    ) -> subprocess.Popen[str]:
        """Start a driver and wait until it listens.

        ``limit`` bounds the files it may write; a powerless one may not use ports below 1024.
        """
        settings = {
            "l2_ip": "127.0.0.1", "l2_port": self.lidar_port, "host_ip": "127.0.0.1",
            "host_port": self.host_port, "imu_adjust": "false", "watchdog_action": "wait",
            "watchdog_timeout_ms": 1000, **values,
        }  # fmt: skip
        arguments = [f"{key}={value}" for key, value in settings.items()]
        return self._start(
            "benchmarks.fault_world", str(self.folder / name), *arguments,
            limit=limit, powerless=powerless,
        )  # fmt: skip

    def _start(
        self, module: str, *arguments: str, limit: int = 0, powerless: bool = False
    ) -> subprocess.Popen[str]:
        def bound() -> None:
            if limit:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            if powerless:
                ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, _CAP_NET_BIND_SERVICE, 0, 0, 0)

        process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            preexec_fn=bound,
        )  # fmt: skip
        self._running.append(process)
        assert process.stdout is not None
        self.said[process.pid] = process.stdout.readline()
        return process

    def end(self, process: subprocess.Popen[str]) -> None:
        """Interrupt a program and wait for its end."""
        if process.poll() is None:
            process.send_signal(signal.SIGCONT)
            process.send_signal(signal.SIGINT)
        process.communicate(timeout=_DEADLINE_S)

    def until(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Wait until a running driver is so far, however slow the machine is; return how far."""
        path = self.folder / "host.now"
        deadline = time.monotonic() + _DEADLINE_S
        now: dict[str, Any] = {}
        while not (now and condition(now)):
            if time.monotonic() > deadline:
                raise TimeoutError(f"after {_DEADLINE_S:.0f} s the driver is only so far: {now}")
            time.sleep(0.05)
            now = json.loads(path.read_text()) if path.exists() else {}
        return now

    def close(self) -> None:
        """End everything."""
        for process in self._running:
            if process.poll() is None:
                process.kill()
                process.communicate()

    def facts(self, name: str = "host") -> dict[str, Any]:
        """Return what a driver that has ended wrote down."""
        facts: dict[str, Any] = json.loads((self.folder / f"{name}.json").read_text())
        return facts

    def judged(self, name: str, host: str = "host", *, since: float = 0.0) -> Finding:
        """Compare a driver's notes with the truth; recovery counts from ``since`` [s, wall]."""
        facts = self.facts(host)
        notes = np.load(self.folder / f"{host}.npy")
        packets = np.concatenate([Results(folder).packets for folder in self.packet_logs])
        packets = packets[np.isin(packets["type"], (102, 104))]
        packets = packets[np.argsort(packets["left_ns"], kind="stable")]
        rows = _rows(packets, notes)
        published = notes["published"] > 0
        error = notes["published"][published] - packets["start_ns"][rows[published]]
        handled = np.zeros(len(packets), bool)
        handled[rows] = True
        finding = Finding(name, published=int(published.sum()), backwards=facts["backwards"])
        finding.unlocked = int((~published).sum())
        finding.arrived = int((packets["copies"] > 0).sum())
        if published.any():
            finding.worst_ms = float(np.abs(error).max()) / 1e6
            first = packets["left_ns"][rows[published][0]]
            whole = (packets["copies"] > 0) & (packets["left_ns"] >= first)
            end = notes["arrival"][-1] - 100_000_000  # what came as it was stopped does not count
            missing = whole & ~handled & (packets["left_ns"] < end)
            finding.missing = max(int(missing.sum()) - facts["kernel_drops"], 0)
        after = notes["arrival"] > since * 1e9
        if since and (after & published).any():
            begin = notes["arrival"][after][0]
            finding.recovery_s = float(notes["arrival"][after & published][0] - begin) / 1e9
        if facts["kernel_drops"]:
            finding.remark = f"{facts['kernel_drops']} dropped by the kernel, counted"
        finding.good = (
            not facts["failure"]
            and finding.published > 100
            and finding.worst_ms < 2.0
            and finding.backwards == finding.missing == 0
        )
        return finding


def _rows(packets: NDArray[np.void], notes: NDArray[np.void]) -> NDArray[np.int64]:
    """Return the row of each note's packet: the last one so named that had left by then."""
    names: dict[tuple[int, int, int], list[int]] = {}
    for row, (kind, seq, stamp) in enumerate(packets[["type", "seq", "stamp_ns"]].tolist()):
        names.setdefault((kind, seq, stamp), []).append(row)
    left = packets["left_ns"]
    found = np.zeros(len(notes), np.int64)
    for at, (kind, seq, stamp, arrival, _) in enumerate(notes.tolist()):
        lives = names[kind, seq, stamp]
        found[at] = max((row for row in lives if left[row] <= arrival), default=lives[0])
    return found


def _pause(seconds: float) -> float:
    time.sleep(seconds)
    return time.time()


def power_cycle(world: World) -> Finding:
    """Cut the sensor's power and give it back: it comes back as if new."""
    host, unit = world.host(), world.unit()
    _pause(3.0)
    world.end(unit)
    since = _pause(2.0)
    world.unit()
    _pause(3.0)
    return _ended(world, host, "sensor unplugged 2 s, comes back as if new", since)


def cable(world: World) -> Finding:
    """Pull the network cable for a while; the sensor goes on."""
    host, _ = world.host(), world.unit("--silence-at", "3", "--silence-s", "3")
    _pause(4.5)
    since = time.time()
    _pause(4.0)
    return _ended(world, host, "cable out 3 s", since)


def reboot(world: World) -> Finding:
    """Let the sensor restart by itself."""
    host, _ = world.host(), world.unit("--reboot-at", "3")
    since = _pause(3.2)
    _pause(3.0)
    return _ended(world, host, "reboot", since)


def address(world: World) -> Finding:
    """Give the sensor another address, then its own again."""
    host, unit = world.host(), world.unit()
    _pause(2.5)
    world.end(unit)
    strange = world.unit("--lidar-ip", "127.0.0.2")
    _pause(2.0)
    world.end(strange)
    foreign_packet_log = world.packet_logs.pop()
    since = time.time()
    world.unit()
    _pause(3.0)
    finding = _ended(world, host, "address changes for 2 s", since)
    sent = len(Results(foreign_packet_log).packets)
    foreign = world.facts()["foreign"]
    finding.good &= 0 < foreign <= sent
    finding.remark = f"{foreign} datagrams of the other address counted, none used"
    return finding


def suspend(world: World) -> Finding:
    """Stop the driver for a while, as a suspended or overloaded host does."""
    host, _ = world.host(), world.unit()
    _pause(3.0)
    host.send_signal(signal.SIGSTOP)
    since = _pause(3.0)
    host.send_signal(signal.SIGCONT)
    _pause(3.0)
    return _ended(world, host, "driver suspended 3 s", since)


def crowd(world: World) -> Finding:
    """Start a second driver on the same port."""
    host, _ = world.host(), world.unit()
    _pause(1.5)
    second = world.host("second")
    refused = second.wait(_DEADLINE_S) == 1
    _pause(2.0)
    finding = _ended(world, host, "two drivers on one port")
    finding.good &= refused
    finding.remark = "the second is refused with exit code 1, the first goes on"
    return finding


def stranger(world: World) -> Finding:
    """Tell the driver a wrong address of the sensor."""
    host, _ = world.host(l2_ip="127.0.0.9"), world.unit()
    world.until(lambda now: now["foreign"] > 500 and "silence" in now["said"])
    world.end(host)
    facts = world.facts()
    finding = Finding("wrong l2_ip", published=facts["sweeps"], remark="nothing published")
    finding.good = facts["sweeps"] == 0 and facts["foreign"] > 500 and "silence" in facts["said"]
    finding.remark += f"; {facts['foreign']} foreign datagrams counted, silence reported"
    return finding


def closed(world: World) -> Finding:
    """Ask for a port that is not allowed and an address the host does not have."""
    attempts = [(world.host("nowhere", host_ip="203.0.113.9"), "not an address of this machine")]
    finding = Finding("no permission; address not of this host")
    finding.remark = "refused with exit code 1 and what to do"
    if _FREE_PORTS.exists() and int(_FREE_PORTS.read_text()) <= _PRIVILEGED_PORT:
        finding.remark += "; on this system every port is free to all"
    else:
        host = world.host("privileged", powerless=True, host_port=_PRIVILEGED_PORT)
        attempts.append((host, "no permission"))
    finding.good = all(
        host.wait(_DEADLINE_S) == 1 and words in world.said[host.pid] for host, words in attempts
    )
    return finding


def disk(world: World) -> Finding:
    """Fill the disk while recording."""
    path = world.folder / "flight.pcap"
    host, _ = world.host(limit=600_000, record_file=path), world.unit()
    full = world.until(lambda now: any("recording" in text for text in now["said"]))
    world.until(lambda now: now["samples"] > full["samples"] + 300)
    finding = _ended(world, host, "disk full while recording")
    said = [text for text in world.facts()["said"] if "recording" in text]
    finding.good &= len(said) == 1 and path.stat().st_size <= 600_000
    finding.remark = (said[0].partition(" ended")[2] or "no message") if said else "no message"
    finding.remark = f"recording ends{finding.remark}; the driver goes on"
    return finding


def _ended(world: World, host: subprocess.Popen[str], name: str, since: float = 0.0) -> Finding:
    """Stop the driver, then the units, and judge."""
    world.end(host)
    for process in world._running:
        if process is not host and process.poll() is None:
            world.end(process)
    return world.judged(name, since=since)


CASES: Final[Sequence[Callable[[World], Finding]]] = (
    power_cycle, cable, reboot, address, suspend, crowd, stranger, closed, disk,
)  # fmt: skip
"""Everything that can be done without ROS."""


def run(case: Callable[[World], Finding]) -> Finding:
    """Run a case in a folder of its own."""
    with TemporaryDirectory() as folder:
        world = World(Path(folder))
        try:
            return case(world)
        finally:
            world.close()


if __name__ == "__main__":
    sys.exit(main())
