"""Writes what the benchmark of the clock finds into a page of results."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from benchmarks.results import Target, measured_on, table, verdicts

PAGE: Final = Path("docs") / "results" / "clock.md"
_HEAD: Final = """# Error of the stamps

Written by `make bench-clock BENCH_ARGS="--docs"`; [clock](../clock.md) explains the estimator.
The driver runs against the virtual L2 in simulated time, and every published stamp is compared
with the time at which the emulator measured.
"""
_ROWS: Final = """## Ratios, sync modes and faults

One minute per row. Errors are in ms, after the constant path delay (one median for both streams)
is set aside; for the other two methods one median per stream is set aside. `upstream` is
`t' = (t - last_sync) * 2 + last_sync` with the value of the last sync *sent*; `arrival` stamps
with the time of arrival. Drift: 50 ppm over 300 s. `everything`: 20 ms tail, bursts, loss,
reordering and a reboot at once.
"""
_LOADS: Final = """## Under load and after it

A load delays all packets. `path` is what it adds to the least delay of the path: the largest, over
the load, of the least delay in half a second. A clock that sees arrivals alone cannot know it when
a load lasts since the start. `during` is the largest error until the load ends, `unsaid` by how
much an error was at most beyond the uncertainty in the status and the least delay seen so far,
`after` the errors from one second after its end. The constant delay of the unloaded path is set
aside. Largest values of all seeds, in ms; `held` counts packets that got no stamp, all seeds
together. A queue that fills evenly from the start is no load to a clock but another ratio, and
stamps go with it: nobody can say so, and the target leaves it out.
`tests/support/clock_loads.py` defines the shapes.
"""

Row = dict[str, Any]


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
