"""Ends every program at random moments with signals, and judges how it went.

``python -m benchmarks.interrupts`` prints what was unclean; ``make soak`` ends with the same.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from benchmarks import chain
from l2lidar_node.demo.processes import Programs, assigned, free_udp_ports, isolate_ros

GRACE_S: Final = 60.0
_LATEST_S: Final = 5.0
_LEFT_S: Final = 20.0
_FIRST: Final = (
    "l2lidar_node/__init__.py", "l2lidar_node/programs.py", "l2lidar_proc/__init__.py",
    "__editable___l2lidar_node_0_1_0_finder.py",
)  # fmt: skip
_NOTHING_HEARD: Final = ("l2lidar monitor", "l2lidar record", "l2lidar discover")  # exit code 1
_UNCLEAN_WORDS: Final = (
    "Traceback", "Exception ignored", "Fatal", "terminate called", "core dumped", "rcl_shutdown",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Interruption:
    """What a program was sent.

    Attributes
    ----------
    program : str
    signals : tuple of signal.Signals
        One after the other.
    delay_s : float
        From the program's start to the first.
    gap_s : float
        Between two of them.
    to_group : bool
        As a terminal does: to the program and all that it started.
    """

    program: str
    signals: tuple[signal.Signals, ...]
    delay_s: float
    gap_s: float = 0.1
    to_group: bool = False


@dataclass(frozen=True, slots=True)
class End:
    """How a program ended.

    Attributes
    ----------
    code : int
        Exit code; the negative number of a signal that ended it.
    took_s : float
        From the first signal on.
    said : str
        Everything it wrote.
    left : int
        Processes of its that are still there.
    """

    code: int
    took_s: float
    said: str
    left: int

    @property
    def is_pythons(self) -> bool:
        """Whether Python was still beginning and had not come to the first lines of ours."""
        files = re.findall(r'File "([^"]+)"', self.said)
        return bool(files) and not any(
            "l2lidar_" in name and not name.endswith(_FIRST) for name in files
        )

    def complaint(self, sent: Interruption) -> str:
        """Return what is wrong with this end, nothing if it is clean."""
        if self.is_pythons:
            return ""
        wrong = []
        allowed = {0, *(number for item in sent.signals for number in (-item, 128 + item))}
        if sent.program in _NOTHING_HEARD:
            allowed.add(1)
        if self.code not in allowed:
            wrong.append(f"exit code {self.code}")
        wrong += [f"'{word}'" for word in _UNCLEAN_WORDS if word in self.said]
        if self.left:
            wrong.append(f"{self.left} processes left behind")
        return ", ".join(wrong)


def commands(folder: Path) -> dict[str, list[str]]:
    """Return every program with arguments that let it go on for long, by name."""
    host_port, lidar_port = free_udp_ports(2)
    ends = ["--lidar-port", str(lidar_port), "--host-port", str(host_port)]
    network = ["--l2-ip", "127.0.0.1", "--l2-port", str(lidar_port), "--host-ip", "127.0.0.1"]
    network += ["--host-port", str(host_port)]
    values = {
        "l2_ip": "127.0.0.1", "l2_port": lidar_port, "host_ip": "127.0.0.1",
        "host_port": host_port, "enable_IMU_publishing": "true", "watchdog_action": "wait",
    }  # fmt: skip
    name = f"{host_port}"
    modules = {
        "driver_node": ["l2lidar_node.ros.driver_node", *assigned(values)],
        "deskew_node": ["l2lidar_proc.ros.deskew_node"],
        "odometry_node": ["l2lidar_proc.ros.odometry_node"],
        "companion_node": ["l2lidar_proc.ros.companion_node"],
        "emulator": ["l2lidar_node.emulator", "--ready", *ends],
        "demo": ["l2lidar_node.demo", "--duration", "60", "--folder", str(folder / name)],
        "l2lidar monitor": ["l2lidar_node.cli.main", "monitor", *network],
        "l2lidar record": [
            "l2lidar_node.cli.main",
            "record",
            str(folder / f"{name}.pcap"),
            *network,
        ],
        "l2lidar discover": ["l2lidar_node.cli.main", "discover"],
    }
    return {name: [sys.executable, "-m", *command] for name, command in modules.items()}


def end(command: Sequence[str], sent: Interruption) -> End:
    """Start a program, send it the signals and wait for its end."""
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
        text=True, errors="replace", start_new_session=True,
    )  # fmt: skip
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(sent.delay_s)
    begun = time.monotonic()
    for number in sent.signals:
        if process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                (os.killpg if sent.to_group else os.kill)(process.pid, number)
            time.sleep(sent.gap_s if len(sent.signals) > 1 else 0.0)
    try:
        said, _ = process.communicate(timeout=GRACE_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        said, _ = process.communicate()
        return End(process.returncode, GRACE_S, said, 0)
    took = time.monotonic() - begun
    return End(process.returncode, took, said, _left(process.pid))


def _left(group: int) -> int:
    """Return whether a process group still lives long after its leader's end, and end it."""
    until = time.monotonic() + _LEFT_S
    while time.monotonic() < until:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return 0
        time.sleep(0.05)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)
    return 1


def interruptions(programs: Sequence[str], rounds: int, seed: int) -> Iterator[Interruption]:
    """Yield random interruptions of every program, half of them in its first second."""
    rng = random.Random(seed)
    for _ in range(rounds):
        for program in programs:
            latest = rng.choice((1.0, _LATEST_S))
            yield Interruption(
                program,
                rng.choice(
                    (
                        (signal.SIGINT,),
                        (signal.SIGTERM,),
                        (signal.SIGINT, signal.SIGINT),
                        (signal.SIGINT, signal.SIGINT, signal.SIGTERM),
                        (signal.SIGINT,) * 30,
                    )
                ),
                rng.uniform(0.0, latest),
                rng.choice((0.0, 0.01, 0.03, 0.1)),
                rng.random() < 0.5,
            )


def run(
    programs: Sequence[str], rounds: int, seed: int, at_once: int = 2, *, is_fed: bool = False
) -> list[tuple[Interruption, End]]:
    """Interrupt programs at random moments; return what was sent with what became of it.

    With ``is_fed`` they get the clouds and samples of a chain that goes on all the time.
    """
    isolate_ros()
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's background: it is inherited
        signal.signal(signal.SIGINT, signal.default_int_handler)
    with ExitStack() as stack:
        scratch = stack.enter_context(tempfile.TemporaryDirectory())
        pool = stack.enter_context(ThreadPoolExecutor(at_once))
        if is_fed:
            programs_fed = stack.enter_context(Programs())
            chain.start(programs_fed, ["--ready", "--world", "room"], nodes=[chain.DRIVER])
        work = list(interruptions(programs, rounds, seed))
        ends = pool.map(lambda sent: end(commands(Path(scratch))[sent.program], sent), work)
        return list(zip(work, list(ends), strict=True))


def main(arguments: Sequence[str] | None = None) -> int:
    """Interrupt everything; return 1 if an end was unclean."""
    parser = argparse.ArgumentParser(description=__doc__)
    names = list(commands(Path()))
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fed", action="store_true", help="while clouds and samples come")
    parser.add_argument("--at-once", type=int, default=3)
    parser.add_argument("--programs", nargs="+", choices=names, default=names)
    options = parser.parse_args(arguments)
    ends = run(options.programs, options.rounds, options.seed, options.at_once, is_fed=options.fed)
    bad = 0
    for sent, how in ends:
        complaint = how.complaint(sent)
        if complaint:
            bad += 1
            print(f"== {sent}: {complaint}\n{how.said[-1500:]}")
    for name in options.programs:
        mine = [(sent, how) for sent, how in ends if sent.program == name]
        codes: Mapping[int, int] = {
            code: sum(how.code == code for _, how in mine) for code in {h.code for _, h in mine}
        }
        slowest = max(how.took_s for _, how in mine)
        early = sum(how.is_pythons for _, how in mine)
        print(
            f"{name}: {len(mine)} ends, codes {codes}, slowest {slowest:.1f} s, "
            f"{early} before the first line"
        )
    print(f"{bad} of {len(ends)} unclean")
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
