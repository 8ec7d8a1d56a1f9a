"""Runs the chain of this checkout, or of another, for some seconds and measures what it needs."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import rclpy
from numpy.typing import NDArray

from benchmarks import chain
from benchmarks.chain import CLOUDS, DESKEWED, ODOMETRY, TopicWatch
from l2lidar_node.demo.processes import Programs, assigned, free_udp_ports
from l2lidar_node.protocol import wire
from l2lidar_node.types import F64
from tests.support import odometry_runs
from tests.support.cpu import process_cpu_s

ROOT: Final = Path(__file__).parents[1]
_WARM_UP_S: Final = 8.0
_TICK_S: Final = 1.0 / os.sysconf("SC_CLK_TCK")
_SWEEPS_AT_ONCE: Final = 5  # of the odometry, before the other's turn
_START_TIMEOUT_S: Final = 60.0
_LOOK_S: Final = 0.005


@dataclass(frozen=True, slots=True)
class Chain:
    """The nodes of a checkout that turn packets into poses.

    Attributes
    ----------
    name : str
    folder : Path
        Of the checkout.
    nodes : tuple of str
        Modules, one process each.
    """

    name: str
    folder: Path
    nodes: tuple[str, ...]


THEN_NODES: Final = (chain.DRIVER, chain.DESKEW_NODE, chain.ODOMETRY_NODE)
NOW: Final = Chain("now", ROOT, (chain.DRIVER, chain.COMPANION))


@dataclass(frozen=True, slots=True)
class Round:
    """What a chain needed in one run.

    Attributes
    ----------
    threads_ms : dict
        By process, and in it by group of threads: CPU time [ms] per second.
    latencies_ms : ndarray, shape (N,)
        From the end of each sweep, as its stamp tells, to its ``/odometry`` at a subscriber.
    rates : dict
        Messages a second, by topic.
    stolen : float
        Share of the machine's processor time that other machines on the same host took.
    """

    threads_ms: dict[str, dict[str, float]]
    latencies_ms: NDArray[np.float64]
    rates: dict[str, float]
    stolen: float

    def total_ms(self, *processes: str) -> float:
        """Return the CPU time of some processes, or of all [ms] per second."""
        return sum(sum(self.threads_ms[name].values()) for name in processes or self.threads_ms)


def run(which: Chain, seconds: float, unit: list[str]) -> Round:
    """Run a chain for so long after a warm-up; ROS must not be initialized yet.

    Parameters
    ----------
    which : Chain
    seconds : float
    unit : list of str
        Options of the virtual L2.
    """
    rclpy.init()
    watch = TopicWatch([CLOUDS, DESKEWED, ODOMETRY])
    try:
        with Programs() as programs:
            running = chain.start(
                programs, unit, {"sweep_cut": "turn"}, which.nodes, folder=which.folder
            )
            names = [module.rpartition(".")[2] for module in which.nodes]
            watch.until(lambda: len(watch.seen(ODOMETRY)) > 0, programs, "no odometry")
            watch.watch(_WARM_UP_S)
            watch.forget()
            before = {name: thread_times(running[name].pid) for name in names}
            begun, machine = time.monotonic(), _machine_times()
            watch.watch(seconds)
            lasted = time.monotonic() - begun
            after = {name: thread_times(running[name].pid) for name in names}
            spent = _machine_times() - machine
            programs.check()
    finally:
        watch.destroy_node()
        rclpy.try_shutdown()
    seen = watch.seen(ODOMETRY)
    return Round(
        {
            name: {
                thread: 1e3 * (total - before[name].get(thread, 0.0)) / lasted
                for thread, total in after[name].items()
            }
            for name in names
        },
        (seen[:, 1] - seen[:, 0]) / 1e6,
        {topic: len(watch.seen(topic)) / lasted for topic in (CLOUDS, DESKEWED, ODOMETRY)},
        float(spent[7] / spent.sum()),
    )


def _machine_times() -> NDArray[np.float64]:
    """Return the processor's times since boot: user, nice, system, idle, ..., steal at 7."""
    line = Path("/proc/stat").read_text().partition("\n")[0]
    return np.array([float(field) for field in line.split()[1:9]])


def thread_times(pid: int) -> dict[str, float]:
    """Return CPU seconds of a process by thread or group of threads."""
    found: dict[str, float] = defaultdict(float)
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            text = (task / "stat").read_text()
        except OSError:  # it has ended meanwhile
            continue
        name = text[text.index("(") + 1 : text.rindex(")")]
        fields = text[text.rindex(")") + 2 :].split()
        if int(task.name) == pid:
            name = "executor (main thread)"
        elif name.startswith("python") or name == "pt_main_thread":
            name = "other threads of Python"
        elif name.startswith("dds."):
            name = "Fast DDS"
        found[name] += _TICK_S * (int(fields[11]) + int(fields[12]))
    return found


def start_s(module: str, topic: str, folder: Path) -> tuple[float, float]:
    """Return the time from a node's start until others see its publisher of a topic.

    Others are nodes of this package that are starting as well, which announce themselves often:
    the caller has had :func:`~l2lidar_node.ros.program.make_room` before anything of rclpy. A
    program with Fast DDS as it comes does so every 3 s, and until then a newcomer may not know it.

    Returns
    -------
    tuple of float
        Time, and the CPU time that the node has used by then [s]: how long it takes by itself on
        an idle machine.
    """
    rclpy.init()
    node = rclpy.create_node("start_watch")
    arguments = []
    if module == chain.DRIVER:
        host_port, lidar_port = free_udp_ports(2)
        arguments = assigned(
            {
                "l2_ip": "127.0.0.1", "l2_port": lidar_port,
                "host_ip": "127.0.0.1", "host_port": host_port,
            }
        )  # fmt: skip
    try:
        with Programs() as programs:
            begin = time.monotonic()
            started = programs.start(module, arguments, folder)
            while not node.count_publishers(topic):
                programs.check()
                if time.monotonic() - begin > _START_TIMEOUT_S:
                    raise TimeoutError(f"{module} does not publish {topic}")
                time.sleep(_LOOK_S)
            return time.monotonic() - begin, process_cpu_s(started.pid)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def help_s(folder: Path) -> tuple[float, float]:
    """Return what ``l2lidar --help`` takes, and the CPU time of it [s]."""
    begin, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, "-m", "l2lidar_node.cli.main", "--help"],
        cwd=folder, stdout=subprocess.DEVNULL, check=True,
    )  # fmt: skip
    lasted, after = time.monotonic() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    return lasted, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def odometry_ms(folders: list[Path], seconds: float, scene: str, motion: str) -> F64:
    """Return the CPU time of the odometries of checkouts for one recording, without ROS.

    They take the same few sweeps in turn, so that each meets the same machine.

    Returns
    -------
    ndarray, shape (N, len(folders))
        CPU time per sweep [ms], of groups of sweeps; those of the first seconds are left out.
    """
    recorded = odometry_runs.record(scene, motion, 1, seconds)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        path = Path(folder) / "sweeps.npz"
        count = _write(recorded, path)
        workers = [stack.enter_context(_Worker(where, path)) for where in folders]
        found = []
        for number in range(count // _SWEEPS_AT_ONCE):
            order = workers[:: -1 if number % 2 else 1]
            took = {worker: worker.register(_SWEEPS_AT_ONCE) for worker in order}
            found.append([1e3 * took[worker] / _SWEEPS_AT_ONCE for worker in workers])
    return np.array(found[4:])


def _write(recorded: odometry_runs.Run, path: Path) -> int:
    """Write the sweeps of a recording for :mod:`benchmarks.odometry_work`; return their number."""
    some = list(odometry_runs.sweeps(recorded, "turn"))
    T_cloud_imu = np.eye(4)
    T_cloud_imu[:3, 3] = wire.IMU_POSITION_M
    np.savez(
        path,
        points=np.concatenate([sweep.points for sweep in some]),
        edges=np.cumsum([0, *(len(sweep.points) for sweep in some)]),
        spans=np.array([(sweep.start, sweep.end) for sweep in some], np.int64),
        packets=np.array([sweep.packets for sweep in some]),
        imu=recorded.imu,
        T_cloud_imu=T_cloud_imu,
    )
    return len(some)


class _Worker:
    """A process of :mod:`benchmarks.odometry_work` in a checkout."""

    def __init__(self, folder: Path, sweeps: Path) -> None:
        script = Path(__file__).with_name("odometry_work.py")
        self._process = subprocess.Popen(
            [sys.executable, str(script), str(sweeps)],
            cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        self._answer()

    def __enter__(self) -> _Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def register(self, sweeps: int) -> float:
        """Return the CPU time that the next sweeps take [s]."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{sweeps}\n")
        self._process.stdin.flush()
        return float(self._answer())

    def _answer(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the odometry's process ended with {self._process.wait()}")
        return line
