"""Measures how true the driver's stamps are, against the virtual L2's own packet log.

``make bench-clock`` prints the table and writes ``out/bench/clock.json``; ``--docs`` writes
``docs/results/clock.md`` too. Then come the shapes of load of ``tests/support/clock_loads.py``,
in ``out/bench/clock-loads.json``. The same packets also go through upstream's rule and through
stamping with the time of arrival. Every row is kept in ``out/bench/*.jsonl`` as soon as it is
there: ``--resume`` goes on where a run was cut.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from benchmarks.results import (
    FOLDER,
    KeptRows,
    Target,
    at_least,
    at_most,
    measured_on,
    publish,
    table,
    verdicts,
)
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.settings import Value
from tests.support.clock_loads import SHAPES, Load, load_errors
from tests.support.clock_rig import EPOCH_NS, Case, run

RATIOS: Final = (1.0, 1.95, 1.99866, 2.0)
SYNCS: Final = ("off", "once", "periodic")
_AFTER_S: Final = 8.0  # that a run goes on after its load
_PATH_NS: Final = 150_000  # what the virtual unit needs to send a packet
_SLEWS: Final = ((10.0, 30.0, 500.0), (40.0, 50.0, -500.0))
_SLEWED_LOADS: Final[dict[str, tuple[Load, ...]]] = {
    "none": (),
    "20 ms batches from 4 s": (Load(start=4, stop=60, batch_ms=20.0),),
    "100 ms batches from 4 s": (Load(start=4, stop=60, batch_ms=100.0),),
}
_UPSTREAM_RATIO: Final = 2  # timeScaleNum / timeScaleDenom as shipped
_EVEN: Final = "queue filling from the start"  # to a clock that is no load but another ratio
_MS: Final = 1e6
_DRIFT: Final = {"clock_wave_ppm": 50.0, "clock_wave_s": 300.0}
_JITTERS: Final[dict[str, dict[str, Value]]] = {
    "none": {},
    "0.5 ms": {"jitter": "uniform", "jitter_ms": 0.5},
    "20 ms tail": {"jitter": "heavy", "jitter_ms": 20.0},
}
_FAULTS: Final[dict[str, dict[str, Value]]] = {
    "bursts 100 ms": {"burst_ms": 100.0, "burst_every_s": 1.0},
    "loss 5 %": {"loss": 0.05, "command_loss": 0.05},
    "reordering 2 %": {"reorder": 0.02, "reorder_ms": 10.0},
    "reboot": {"reboot_at": (30.0,)},
    "coalescing": {"coalesce": 0.2, "split": 0.1},
}
_EVERYTHING: Final[dict[str, Value]] = {
    **_JITTERS["20 ms tail"],
    **_FAULTS["bursts 100 ms"],
    **_FAULTS["loss 5 %"],
    **_FAULTS["reordering 2 %"],
    **_FAULTS["reboot"],
}
_AHEAD: Final = os.cpu_count() or 1  # runs handed to the processes at a time
_KEY: Final = ("seed",)  # tells every run from the others

Row = dict[str, Any]
W = TypeVar("W")


@dataclass(frozen=True, slots=True)
class Task:
    """A named case."""

    drift: str
    jitter: str
    fault: str
    case: Case


def rows() -> list[Task]:
    """Return the benchmark: every ratio, sync mode and jitter with drift, then the faults."""
    out = [
        Task("yes", name, "", Case(ratio=ratio, sync=sync, crystal=_DRIFT, faults=faults))
        for ratio in RATIOS
        for sync in SYNCS
        for name, faults in _JITTERS.items()
    ]
    out += [
        Task("no", name, "", Case(ratio=1.99866, sync=sync, faults=faults))
        for sync in SYNCS
        for name, faults in _JITTERS.items()
    ]
    out += [
        Task("yes", "none", name, Case(ratio=ratio, sync=sync, crystal=_DRIFT, faults=faults))
        for name, faults in _FAULTS.items()
        for ratio in (1.0, 1.99866)
        for sync in SYNCS
    ]
    out += [
        Task(
            "yes",
            "20 ms tail",
            "everything",
            Case(ratio=ratio, sync=sync, crystal=_DRIFT, faults=_EVERYTHING),
        )
        for ratio in RATIOS
        for sync in SYNCS
    ]
    out += [
        Task(
            "yes",
            "0.5 ms",
            "IMU off",
            Case(ratio=1.99866, sync=sync, crystal=_DRIFT, faults=_JITTERS["0.5 ms"], imu=False),
        )
        for sync in SYNCS
    ]
    out += [
        Task(
            "yes",
            name,
            "NTP slew 500 ppm",
            Case(ratio=1.99866, sync="once", crystal=_DRIFT, loads=loads, slews=_SLEWS),
        )
        for name, loads in _SLEWED_LOADS.items()
    ]
    return out


def measure(row: Task, seed: int) -> Row:
    """Return the figures of one row."""
    notes, _ = run(row.case, seed)
    used = notes[notes["published"] != 0]
    ours = _errors(used, used["published"], [np.ones(len(used), bool)])
    is_imu = used["type"] == PacketType.IMU
    streams = [is_imu, ~is_imu]
    elapsed = used["stamp"] - used["sync"]
    upstream = _errors(used, elapsed * _UPSTREAM_RATIO + used["sync"], streams)
    arrival = _errors(used, used["arrival"], streams)
    spacing = _spacing(used[is_imu])
    return {
        "ratio": row.case.ratio,
        "drift": row.drift,
        "sync": row.case.sync,
        "jitter": row.jitter,
        "fault": row.fault,
        "mean_ms": _round(float(np.mean(np.abs(ours)))),
        "p99_ms": _round(_p99(ours)),
        "max_ms": _round(float(np.max(np.abs(ours)))),
        "constant_ms": _round(float(np.median(used["published"] - used["truth"])) / _MS),
        "imu_spacing_p99_us": _round(spacing[0]),
        "imu_spacing_max_us": _round(spacing[1]),
        "backward": _backward(used),
        "future": int(np.sum(used["published"] > used["arrival"])),
        "lock_s": _round(_lock_s(notes)),
        "seed": seed,
        "upstream_p99_ms": _round(_p99(upstream)),
        "upstream_max_ms": _round(float(np.max(np.abs(upstream)))),
        "arrival_p99_ms": _round(_p99(arrival)),
        "arrival_max_ms": _round(float(np.max(np.abs(arrival)))),
    }


def measure_load(name: str, seed: int) -> Row:
    """Return how far stamps are off under one shape of load and after it."""
    loads = SHAPES[name]
    seconds = max(load.stop for load in loads) + _AFTER_S
    case = Case(
        ratio=1.99866, sync="once", crystal=_DRIFT, loads=loads, boot_scale=0.0, seconds=seconds
    )
    notes, clock = run(case, seed)
    found = load_errors(notes, loads, EPOCH_NS, _PATH_NS)
    used = notes[notes["published"] != 0]
    return {
        "load": name,
        "least_delay_ms": _round(found.least_ms),
        "during_max_ms": _round(found.during_ms),
        "unsaid_ms": _round(found.unsaid_ms),
        "after_p99_ms": _round(found.after_p99_ms),
        "after_max_ms": _round(found.after_max_ms),
        "backward": _backward(used),
        "future": int(np.sum(used["published"] > used["arrival"])),
        "held": clock.status().held,
        "events": len(clock.reported) - 1,
        "seed": seed,
    }


def load_targets(results: list[Row]) -> list[Target]:
    """Return what was asked for under load."""
    excess = max(item["during_max_ms"] - item["least_delay_ms"] for item in results)
    told = [item for item in results if item["load"] != _EVEN]
    return [
        at_most("p99 from 1 s after the end of a load (ms)", _most(results, "after_p99_ms"), 1.0),
        at_most("largest error from then on (ms)", _most(results, "after_max_ms"), 3.0),
        at_most("error during a load beyond the path's own change (ms)", excess, 3.0),
        at_most("error beyond the stated uncertainty (ms)", _most(told, "unsaid_ms"), 3.0),
        at_most("backward steps under load", sum(item["backward"] for item in results), 0),
        at_most("stamps after arrival under load", sum(item["future"] for item in results), 0),
    ]


def targets(results: list[Row]) -> list[Target]:
    """Return what was asked for."""
    asked = [item for item in results if item["fault"] != "IMU off"]
    disturbed = [item for item in asked if _is_disturbed(item)]
    synced = [item for item in asked if item["sync"] != "off"]
    return [
        at_most("p99 of the error in every row (ms)", _most(results, "p99_ms"), 0.5),
        at_most("largest error in every row (ms)", _most(results, "max_ms"), 2.0),
        at_most("backward steps, all rows", sum(item["backward"] for item in results), 0),
        at_most("stamps after arrival, all rows", sum(item["future"] for item in results), 0),
        at_most("data until locked (s)", _most(results, "lock_s"), 2.0),
        at_most("p99 of the IMU spacing error (us)", _most(results, "imu_spacing_p99_us"), 10.0),
        at_least(
            "p99 of arrival stamping over ours, IMU on, rows with jitter or bursts",
            _least_gain(disturbed, "arrival_p99_ms"),
            20.0,
        ),
        at_least(
            "p99 of upstream's rule over ours, IMU on, rows with jitter, bursts or sync",
            _least_gain(disturbed + synced, "upstream_p99_ms"),
            20.0,
        ),
    ]


def _errors(
    notes: NDArray[np.void], stamps: NDArray[np.int64], groups: Iterable[NDArray[np.bool_]]
) -> NDArray[np.float64]:
    """Return stamp minus truth [ms], the median of each group set aside."""
    errors = (stamps - notes["truth"]).astype(np.float64)
    for group in groups:
        if group.any():
            errors[group] -= np.median(errors[group])
    return np.asarray(errors / _MS)


def _spacing(imu: NDArray[np.void]) -> tuple[float, float]:
    """Return p99 and maximum of the error of the time between IMU samples [us]."""
    if len(imu) < 2:
        return 0.0, 0.0
    truth = np.diff(imu["truth"])
    off = np.abs(np.diff(imu["published"]) - truth)[truth < 1e9] * 1e-3
    return float(np.percentile(off, 99)), float(off.max())


def _backward(used: NDArray[np.void]) -> int:
    return sum(
        int(np.sum(np.diff(used["published"][used["type"] == kind]) <= 0))
        for kind in np.unique(used["type"])
    )


def _lock_s(notes: NDArray[np.void]) -> float:
    """Return the longest time from a boot's first packet to its first stamp [s]."""
    times = []
    for boot in np.unique(notes["boot"]):
        mine = notes[notes["boot"] == boot]
        stamped = mine[mine["published"] != 0]
        times.append(
            (stamped["arrival"][0] - mine["arrival"][0]) * 1e-9 if len(stamped) else np.inf
        )
    return float(max(times))


def _p99(errors: NDArray[np.float64]) -> float:
    return float(np.percentile(np.abs(errors), 99))


def _most(results: list[Row], key: str) -> float:
    return max(float(item[key]) for item in results)


def _least_gain(results: list[Row], key: str) -> float:
    return min(float(item[key]) / max(float(item["p99_ms"]), 1e-6) for item in results)


def _is_disturbed(item: Row) -> bool:
    return item["jitter"] != "none" or "burst" in item["fault"]


def _round(value: float) -> float:
    return float(f"{value:.4g}")


def carry_out(
    work: Callable[[W, int], Row],
    todo: Iterable[tuple[W, int]],
    kept: KeptRows,
    pool: ProcessPoolExecutor,
    until: float,
) -> int:
    """Measure and keep one row after the other; return how many were left out for lack of time."""
    waiting = list(todo)[::-1]
    running: set[Future[Row]] = set()
    while running or (waiting and time.monotonic() < until):
        while waiting and time.monotonic() < until and len(running) < _AHEAD:
            running.add(pool.submit(work, *waiting.pop()))
        done, running = wait(running, return_when=FIRST_COMPLETED)
        for future in done:
            kept.append(future.result())
    return len(waiting)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; return 0 when every target is met."""
    if not sys.stdout.isatty():
        os.environ.setdefault("COLUMNS", "240")
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1, help="seed of everything random")
    parser.add_argument("--docs", action="store_true", help=f"write {PAGE}")
    parser.add_argument("--jobs", type=int, help="processes, as many as cores if left out")
    parser.add_argument("--loads", type=int, default=3, help="seeds of every shape of load")
    parser.add_argument("--minutes", type=float, default=1e6, help="begin no run after that")
    parser.add_argument("--resume", action="store_true", help="keep the rows that there are")
    given = parser.parse_args(arguments)
    kept = KeptRows(FOLDER / "clock.jsonl", _KEY)
    kept_loads = KeptRows(FOLDER / "clock-loads.jsonl", _KEY)
    if not given.resume:
        kept.clear()
        kept_loads.clear()
    seeded = [(row, 1000 * given.seed + number) for number, row in enumerate(rows())]
    loads = [
        (name, 1000 * given.seed + 500 + 10 * number + more)
        for more in range(given.loads)
        for number, name in enumerate(SHAPES)
    ]
    done = {row["seed"] for row in kept.read()} | {row["seed"] for row in kept_loads.read()}
    until = time.monotonic() + 60.0 * given.minutes
    with ProcessPoolExecutor(given.jobs) as pool:
        todo = [(row, seed) for row, seed in seeded if seed not in done]
        left = carry_out(measure, todo, kept, pool, until)
        shapes = [(name, seed) for name, seed in loads if seed not in done]
        left += carry_out(measure_load, shapes, kept_loads, pool, until)
    if left:
        print(f"{left} runs were left out; go on with --resume", file=sys.stderr)
        return 1
    results = _asked(kept, [seed for _, seed in seeded])
    loaded = _asked(kept_loads, [seed for _, seed in loads])
    found, found_under_load = targets(results), load_targets(loaded)
    publish(
        "clock", "Error of every published stamp, constant path delay set aside", results, found
    )
    publish("clock-loads", "Error of stamps under load and after it", loaded, found_under_load)
    if given.docs:
        write(results, found, loaded, found_under_load)
    return 0 if all(target.met for target in found + found_under_load) else 1


def _asked(kept: KeptRows, seeds: Sequence[int]) -> list[Row]:
    """Return the rows of these seeds, in their order."""
    by_seed = {row["seed"]: row for row in kept.read()}
    return [by_seed[seed] for seed in seeds]


PAGE: Final = Path("docs") / "results" / "clock.md"
_HEAD: Final = """# Error of the stamps

Written by `make bench-clock BENCH_ARGS="--docs"`; [clock](../clock.md) explains the estimator.
The driver runs against the virtual L2 in simulated time, and every published stamp is compared
with the emulator's time of measurement.
"""
_ROWS: Final = """## Ratios, sync modes and faults

One minute per row. Errors are in ms, after subtracting the constant path delay (one median for
both streams; for the other two methods one median per stream). `upstream` is
`t' = (t - last_sync) * 2 + last_sync` with the value of the last sync *sent*; `arrival` uses the
arrival time as the stamp. Drift: 50 ppm over 300 s. `everything`: 20 ms tail, bursts, loss,
reordering and a reboot at once.
"""
_LOADS: Final = """## Under load and after it

A load delays all packets. `path` is what it adds to the path's least delay: the largest value,
over the load, of the least delay in half a second. If a load has lasted since the start, a clock
that sees only arrivals cannot know this delay. `during` is the largest error until the load ends.
`unsaid` is the largest excess of an error over the uncertainty in the status plus the least delay
seen so far. `after` is the error from one second after the end of the load. The constant delay of
the unloaded path is subtracted. Values are the largest of all seeds, in ms; `held` counts packets
without a stamp, over all seeds. To a clock, a queue that fills evenly from the start looks like
another ratio, and stamps follow it. Nothing can detect this, so the target excludes it.
`tests/support/clock_loads.py` defines the shapes.
"""


def write(rows: list[Row], found: list[Target], loaded: list[Row], under: list[Target]) -> Path:
    """Write the page; return its path.

    Parameters
    ----------
    rows, found
        Every row without load, and the targets of them all.
    loaded, under
        Every run under load, and the targets of them all.
    """
    parts = [
        _HEAD,
        _ROWS,
        _table(rows),
        verdicts(found),
        _LOADS,
        _load_table(loaded),
        verdicts(under),
        measured_on(),
    ]
    PAGE.parent.mkdir(parents=True, exist_ok=True)
    PAGE.write_text("\n\n".join(part.strip("\n") for part in parts) + "\n", encoding="utf-8")
    return PAGE


def _table(rows: list[Row]) -> str:
    heads = [
        "ratio", "drift", "sync", "jitter", "fault", "mean", "p99", "max",
        "IMU spacing p99 / max [us]", "lock [s]", "upstream p99 / max", "arrival p99 / max",
    ]  # fmt: skip
    cells = [
        [
            f"{row['ratio']:g}",
            row["drift"],
            row["sync"],
            row["jitter"],
            row["fault"],
            f"{row['mean_ms']:.4f}",
            f"**{row['p99_ms']:.4f}**",
            f"{row['max_ms']:.4f}",
            f"{row['imu_spacing_p99_us']:.2f} / {row['imu_spacing_max_us']:.1f}",
            f"{row['lock_s']:.2f}",
            f"{row['upstream_p99_ms']:.4g} / {row['upstream_max_ms']:.4g}",
            f"{row['arrival_p99_ms']:.4g} / {row['arrival_max_ms']:.4g}",
        ]
        for row in rows
    ]
    return table(heads, cells)


def _load_table(loaded: list[Row]) -> str:
    cells = []
    for name in dict.fromkeys(row["load"] for row in loaded):
        mine = [row for row in loaded if row["load"] == name]
        most = {key: max(row[key] for row in mine) for key in (
            "least_delay_ms", "during_max_ms", "unsaid_ms", "after_p99_ms", "after_max_ms"
        )}  # fmt: skip
        figures = [f"{value:.3f}" for value in most.values()]
        cells.append([name, str(len(mine)), *figures, str(sum(row["held"] for row in mine))])
    heads = ["load", "seeds", "path", "during", "unsaid", "after, p99", "after, max", "held"]
    return table(heads, cells)


if __name__ == "__main__":
    sys.exit(main())
