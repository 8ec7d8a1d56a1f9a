"""Measures where the CPU time of the running chain goes, and compares it with another commit's.

``make bench-cost`` runs a virtual L2, the driver, and deskew and odometry in one process at the
real rate, and tells the CPU time of each process and thread. With ``--against DIR``, a checkout of
an older commit, the chains run in turn and the ratios stand beside their targets. Times also stand
in units of a fixed reference load, measured in the same run: those do not change with the speed of
the day's machine.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks import chain, cost_rounds, results
from benchmarks.chain import CLOUDS, DESKEWED, ODOMETRY
from benchmarks.cost_rounds import NOW, THEN_NODES, Chain, Round
from benchmarks.results import Target, at_most, markdown, publish, replaced, verdicts
from l2lidar_node.demo.processes import isolate_ros
from l2lidar_node.ros.program import make_room

PAGE: Final = Path("docs") / "results" / "cost.md"
ROBOT_PAGE: Final = Path("docs") / "robot.md"
_FULL_RATE: Final = 4.0  # sweeps a second of 4.2 to 4.4: below, the machine did not keep up
_OUTPUT: Final = {"driver_node": CLOUDS, "deskew_node": DESKEWED}  # others: the odometry
_STARTS: Final = 3
_SLOWER: Final = 2.5  # times, a Cortex-A76 at 2.4 GHz than the PC of docs/robot.md
Row = dict[str, Any]


Rounds = dict[str, list[Round]]
"""Rounds of chains, by the chain's name."""


def run_rounds(chains: Sequence[Chain], count: int, seconds: float, unit: list[str]) -> Rounds:
    """Return the rounds of each chain, taken in turn; each pair begins with the other one."""
    rounds: Rounds = {which.name: [] for which in chains}
    for number in range(count):
        for which in chains[:: -1 if number % 2 else 1]:
            found = cost_rounds.run(which, seconds, unit)
            print(_told(which, found), file=sys.stderr, flush=True)
            if found.rates[ODOMETRY] > 0.0:
                rounds[which.name].append(found)
    return rounds


def per_sweep_ms(found: Round, *processes: str) -> float:
    """Return the CPU time of some processes, or of all, for each sweep that they got through.

    A machine too busy to keep up gets through fewer sweeps, not through cheaper ones.
    """
    return sum(
        found.total_ms(name) / found.rates[_OUTPUT.get(name, ODOMETRY)]
        for name in processes or found.threads_ms
    )


def _told(which: Chain, found: Round) -> str:
    shares = ", ".join(f"{name} {found.total_ms(name):.0f}" for name in found.threads_ms)
    latency = np.percentile(found.latencies_ms, (50, 99)) if len(found.latencies_ms) else (0, 0)
    return (
        f"{which.name}: {shares} ms/s; /odometry {found.rates[ODOMETRY]:.2f} Hz, latency p50 "
        f"{latency[0]:.0f}, p99 {latency[1]:.0f} ms; {100 * found.stolen:.1f} % stolen"
    )


def process_rows(rounds: Rounds) -> list[Row]:
    """Return CPU time of each process of each chain, median and spread of the rounds."""
    rows = []
    for name, some in rounds.items():
        for process in [*some[0].threads_ms, ""] if some else []:
            values = [one.total_ms(*([process] if process else [])) for one in some]
            rows.append(
                {
                    "chain": name,
                    "process": process or "all",
                    "ms of CPU in a second": f"{statistics.median(values):.0f}",
                    "rounds": f"{min(values):.0f} to {max(values):.0f}",
                    "ms of CPU per sweep": f"{_median_per_sweep(some, process):.1f}",
                }
            )
    return rows


def _median_per_sweep(some: list[Round], process: str) -> float:
    names = [process] if process else []
    return statistics.median(per_sweep_ms(one, *names) for one in some)


def thread_rows(some: list[Round], rate: float) -> list[Row]:
    """Return the CPU time of each group of threads of a chain, median of the rounds."""
    rows = []
    for process in some[0].threads_ms:
        names = sorted({name for one in some for name in one.threads_ms[process]})
        medians = {
            name: statistics.median(one.threads_ms[process].get(name, 0.0) for one in some)
            for name in names
        }
        medians["all"] = statistics.median(one.total_ms(process) for one in some)
        for name, ms in sorted(medians.items(), key=lambda item: (item[0] == "all", -item[1])):
            if ms >= 0.5:
                rows.append(
                    {
                        "process": process,
                        "thread": name,
                        "ms of CPU in a second": f"{ms:.0f}",
                        "in reference packets": f"{ms * 1e-3 * rate:.0f}",
                    }
                )
    return rows


def compared(
    what: str, now: Sequence[float], then: Sequence[float], bound: float
) -> tuple[Row, Target]:
    """Return the ratio of medians, its spread over neighboring rounds, and whether it is met."""
    ratio = statistics.median(now) / statistics.median(then)
    pairs = [a / b for a, b in zip(now, then, strict=False)]
    row = {
        "now, in then": what,
        "then": f"{statistics.median(then):.4g}",
        "now": f"{statistics.median(now):.4g}",
        "ratio": f"{ratio:.2f}",
        "pairs": f"{min(pairs):.2f} to {max(pairs):.2f}",
        "at most": f"{bound:g}",
        "": "met" if ratio <= bound else "**not met**",
    }
    return row, at_most(what, ratio, bound)


def comparisons(rounds: Rounds, work: NDArray[np.float64]) -> tuple[list[Row], list[Target]]:
    """Return the ratios to the older chain, and their targets."""
    then, now = rounds["then"], rounds["now"]
    driver, companion = "driver_node", "companion_node"

    def shares(some: list[Round], *names: str) -> list[float]:
        return [per_sweep_ms(one, *names) for one in some]

    def p99(some: list[Round]) -> list[float]:
        return [
            float(np.percentile(one.latencies_ms, 99))
            for one in some
            if one.rates[ODOMETRY] >= _FULL_RATE
        ]

    found = [
        compared("driver [ms of CPU per sweep]", shares(now, driver), shares(then, driver), 0.6),
        compared(
            "driver + companion, in driver + deskew + odometry [ms of CPU per sweep]",
            shares(now, driver, companion), shares(then), 0.4,
        ),
        compared(
            "odometry by itself, without ROS [ms a sweep]",
            work[:, 1].tolist(), work[:, 0].tolist(), 0.7,
        ),
    ]  # fmt: skip
    if p99(now) and p99(then):
        found.append(
            compared("/odometry after the end of its sweep, p99 [ms]", p99(now), p99(then), 1.0)
        )
    return [row for row, _ in found], [target for _, target in found]


def starts(folder: Path) -> tuple[list[Row], list[Target]]:
    """Return how long the command line and the nodes take to begin."""
    nodes = (
        ("driver_node", chain.DRIVER, "/points"),
        ("deskew_node", chain.DESKEW_NODE, "/points_deskewed"),
        ("odometry_node", chain.ODOMETRY_NODE, "/odometry"),
        ("companion_node", chain.COMPANION, "/odometry"),
    )
    asked: list[tuple[str, Callable[[], tuple[float, float]]]] = [
        ("l2lidar --help", lambda: cost_rounds.help_s(folder)),
        *((name, _starter(module, topic, folder)) for name, module, topic in nodes),
    ]
    rows, targets = [], []
    for name, ask in asked:
        found = [ask() for _ in range(_STARTS)]
        wall, cpu = (statistics.median(column) for column in zip(*found, strict=True))
        rows.append({"start": name, "s": f"{wall:.2f}", "CPU s of it": f"{cpu:.2f}"})
        targets.append(at_most(f"start of {name} [s]", wall, 1.0))
    return rows, targets


def _starter(module: str, topic: str, folder: Path) -> Callable[[], tuple[float, float]]:
    return lambda: cost_rounds.start_s(module, topic, folder)


def main() -> int:
    """Measure, print, and write the pages if asked to; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--against", type=Path, help="checkout of the commit to compare with")
    parser.add_argument("--rounds", type=int, default=4, help="of each chain")
    parser.add_argument("--seconds", type=float, default=20.0, help="of a round")
    parser.add_argument("--world", default="room", help="what the sensor sees")
    parser.add_argument("--motion", default="walk", help="how it moves")
    parser.add_argument("--page", action="store_true", help=f"write {PAGE} and {ROBOT_PAGE}")
    given = parser.parse_args()
    if given.against is not None and not (given.against / "l2lidar_proc").is_dir():
        parser.error(f"--against {given.against}: is no checkout of this project")
    isolate_ros()
    make_room()  # Fast DDS reads its profile once in a process: the watches here want it as well
    unit = ["--ready", "--world", given.world, "--motion", given.motion]
    chains = [NOW]
    if given.against is not None:
        chains.insert(0, Chain("then", given.against.resolve(), THEN_NODES))
    rounds = run_rounds(chains, given.rounds, given.seconds, unit)
    if not all(rounds.values()):
        print(
            "a chain gave no odometry in any round: nothing to compare; end what else runs on "
            "this machine",
            file=sys.stderr,
        )
        return 1
    rate = results.packets_per_cpu_s()
    blocks = {
        "processes": process_rows(rounds),
        "threads": thread_rows(rounds["now"], rate),
    }
    blocks["starts"], targets = starts(cost_rounds.ROOT)
    if given.against is not None:
        work = cost_rounds.odometry_ms(
            [which.folder for which in chains], 30.0, given.world, given.motion
        )
        blocks["ratios"], more = comparisons(rounds, work)
        targets = more + targets
    for rows in blocks.values():
        print(f"\n{markdown(rows)}")
    publish("cost", "Where the CPU time goes", [], targets)
    if given.page:
        _write(blocks, targets, rounds, given, rate)
    return 0


def _write(
    blocks: dict[str, list[Row]],
    targets: list[Target],
    rounds: Rounds,
    given: argparse.Namespace,
    rate: float,
) -> None:
    """Write the generated blocks of the pages."""
    every = [one for some in rounds.values() for one in some]
    conditions = (
        f"World `{given.world}`, motion `{given.motion}`, {len(rounds['now'])} rounds of "
        f"{given.seconds:.0f} s of each chain after a warm-up; Python "
        f"{platform.python_version()}, {os.cpu_count()} cores, of which others on the same host "
        f"took {100 * max(one.stolen for one in every):.0f} % at most; the odometry kept up with "
        f"the sensor in {sum(one.rates[ODOMETRY] >= _FULL_RATE for one in every)} of {len(every)} "
        f"rounds; a CPU second takes {rate:.0f} reference packets."
    )
    if given.against is not None:
        commit = subprocess.run(
            ["git", "log", "-1", "--format=%h of %cs"],
            cwd=given.against, capture_output=True, text=True, check=True,
        ).stdout.strip()  # fmt: skip
        conditions += f" Then is commit {commit}."
    text = PAGE.read_text()
    for name, content in {
        "conditions": conditions,
        **{name: markdown(rows) for name, rows in blocks.items()},
        "targets": verdicts(targets),
    }.items():
        text = replaced(text, name, content)
    PAGE.write_text(text)
    ROBOT_PAGE.write_text(replaced(ROBOT_PAGE.read_text(), "cost", markdown(robot_rows(rounds))))
    print(PAGE, ROBOT_PAGE)


def robot_rows(rounds: Rounds) -> list[Row]:
    """Return what is told of this chain's processes to somebody who plans a robot."""
    rows = []
    some = rounds["now"]
    for process in some[0].threads_ms:
        shares = [one.total_ms(process) / 10.0 for one in some]
        low, high = min(shares), max(shares)
        rows.append(
            {
                "Program": process,
                "measured on a PC": f"{low:.0f} to {high:.0f} %",
                "expected on a Raspberry Pi 5 or Jetson Orin Nano": (
                    f"{_SLOWER * low:.0f} to {_SLOWER * high:.0f} %"
                ),
            }
        )
    return rows


if __name__ == "__main__":
    sys.exit(main())
