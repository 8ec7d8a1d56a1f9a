"""Writes what the odometry bench finds into the documentation: a table and a plot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.results import Target, measured_on, verdicts

PAGE = Path("docs") / "odometry.md"
PLOT = Path("docs") / "odometry.png"
BEGIN, END = "<!-- measured -->", "<!-- end of measured -->"

Row = dict[str, Any]


def write(rows: list[Row], targets: list[Target]) -> None:
    """Replace the measured part of the page and draw the plot."""
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    body = "\n\n".join((_table(rows), verdicts(targets), measured_on()))
    PAGE.write_text(f"{before}{BEGIN}\n{body}\n{END}{after}", encoding="utf-8")
    _draw(rows)


def _names(rows: list[Row]) -> list[str]:
    return list(dict.fromkeys(row["method"] for row in rows))


def _table(rows: list[Row]) -> str:
    scenes = list(dict.fromkeys((row["scene"], row["sweeps"]) for row in rows))
    names = _names(rows)
    lines = [
        "| ATE, median / largest of the runs [mm] | " + " | ".join(names) + " |",
        "|---|" + "---|" * len(names),
    ]
    for scene, sweeps in scenes:
        cells = []
        for name in names:
            found = [
                row["ate_m"]
                for row in rows
                if (row["scene"], row["sweeps"], row["method"]) == (scene, sweeps, name)
            ]
            cells.append(f"{_mm(np.median(found))} / {_mm(max(found))}" if found else "")
        lines.append(f"| {scene}, {sweeps} | " + " | ".join(cells) + " |")
    speed, drift, count = [], [], []
    for name in names:
        mine = [row for row in rows if row["method"] == name]
        speed.append(f"{np.median([row['real_time_factor'] for row in mine]):.0f}")
        drift.append(_mm(np.nanmedian([row["rpe_m"] for row in mine])))
        count.append(str(len(mine)))
    lines.append("| RPE over 1 m, median [mm] | " + " | ".join(drift) + " |")
    lines.append("| recording / processor time, median | " + " | ".join(speed) + " |")
    lines.append("| runs | " + " | ".join(count) + " |")
    return "\n".join(lines)


def _mm(metres: float) -> str:
    if not np.isfinite(metres):
        return "lost"
    return f"{1e3 * metres:.1f}" if metres < 0.1 else f"{1e3 * metres:.0f}"


def _draw(rows: list[Row]) -> None:
    """Draw the ATE of every run by method, on a logarithmic scale."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = _names(rows)
    figure = Figure(figsize=(7.0, 3.2), layout="constrained", dpi=90)
    axes = figure.add_subplot(yscale="log", ylabel="ATE [mm]")
    source = np.random.default_rng(0)
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    for scene in scenes:
        x, y = [], []
        for row in rows:
            if row["scene"] == scene and np.isfinite(row["ate_m"]):
                x.append(names.index(row["method"]) + source.uniform(-0.2, 0.2))
                y.append(1e3 * row["ate_m"])
        axes.scatter(x, y, s=12, label=scene)
    axes.axhline(15.0, color="0.6", lw=0.8, ls="--")
    axes.set_xticks(range(len(names)), names, rotation=15)
    axes.legend(fontsize=8)
    FigureCanvasAgg(figure)
    figure.savefig(PLOT)
