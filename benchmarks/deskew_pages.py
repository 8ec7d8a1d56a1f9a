"""Puts what the deskew bench found into the documentation: tables and a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.results import Target, machine, replaced, table, verdicts
from l2lidar_node.types import F64

PAGE: Final = Path("docs") / "deskew.md"
PICTURE: Final = Path("docs") / "deskew.png"


def write(
    rows: Sequence[dict[str, Any]],
    targets: Sequence[Target],
    costs: dict[str, float],
    real: Sequence[tuple[str, float, float, float]],
    clouds: dict[str, F64],
) -> None:
    """Replace tables and picture.

    Parameters
    ----------
    rows : sequence of dict
        RMS and p95 of each scenario: error of every method [mm].
    targets : sequence of Target
    costs : dict of float
        [ms] by what was timed.
    real : sequence
        Name, error before and after, bound [mm] of real scans.
    clouds : dict of ndarray, shape (N, 3)
        One sweep as different methods leave it, and the truth.
    """
    text = PAGE.read_text(encoding="utf-8")
    text = replaced(text, "errors", _errors(rows))
    text = replaced(text, "targets", verdicts(targets))
    text = replaced(text, "costs", _costs(costs))
    text = replaced(text, "real", _real(real))
    PAGE.write_text(text, encoding="utf-8")
    _draw(clouds)


def write_units(rows: Sequence[dict[str, Any]]) -> None:
    """Replace the table of how thick walls are [mm], by unit and method."""
    methods = [name for name, value in rows[0].items() if isinstance(value, float)]
    walls = table(
        ["walls [mm]", *methods],
        ([row["scenario"], *(f"{row[name]:.1f}" for name in methods)] for row in rows),
    )
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replaced(text, "units", walls), encoding="utf-8")


def _errors(rows: Sequence[dict[str, Any]]) -> str:
    methods = [name for name in rows[0] if name not in ("scenario", "figure")]
    far = {row["scenario"]: row for row in rows if row["figure"] == "p95"}
    lines = []
    for row in rows:
        if row["figure"] == "RMS":
            pairs = (f"{row[m]:.1f} / {far[row['scenario']][m]:.1f}" for m in methods)
            lines.append([row["scenario"], *pairs])
    return table(["RMS / p95 [mm]", *methods], lines)


def _costs(costs: dict[str, float]) -> str:
    rows = [[name, f"{value:.2f}"] for name, value in costs.items() if name != "points"]
    times = table([f"{costs['points']:.0f} points on one core", "ms"], rows)
    return f"{times}\n\nMeasured on one core of an {machine()['processor']}, the best of 100."


def _real(real: Sequence[tuple[str, float, float, float]]) -> str:
    rows = [[n, f"{a:.0f}", f"{b:.1f}", f"{c:.0f}"] for n, a, b, c in real]
    return table(["median error [mm]", "raw", "ours", "constant rate and velocity"], rows)


def _draw(clouds: dict[str, F64]) -> None:
    shown = {"as measured": "none", "gyro only": "gyro only", "with odometry": "odometry"}
    figure = Figure(figsize=(11, 4.2), dpi=85, layout="constrained")
    FigureCanvasAgg(figure)
    truth = clouds["truth"]
    inside = (truth[:, 2] > -0.3) & (truth[:, 2] < 1.6)
    for place, (title, method) in enumerate(shown.items(), start=1):
        plan = figure.add_subplot(1, 3, place)
        error = 1e3 * np.linalg.norm(clouds[method] - truth, axis=1)[inside]
        x, y, _ = clouds[method][inside].T
        plan.scatter(truth[inside, 0], truth[inside, 1], s=3.0, c="0.75", linewidths=0)
        dots = plan.scatter(x, y, s=3.0, c=error, cmap="turbo", vmin=0, vmax=400, linewidths=0)
        plan.set_aspect("equal")
        plan.set_title(f"{title}: RMS {np.sqrt((error**2).mean()):.1f} mm", fontsize=10)
        plan.tick_params(labelsize=7)
    figure.colorbar(dots, ax=figure.axes, label="error [mm]", shrink=0.8)
    figure.savefig(PICTURE)
