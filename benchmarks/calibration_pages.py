"""Writes what the calibration benchmark finds into a page of results."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from benchmarks.results import Target, measured_on, replaced, verdicts

PAGE: Final = Path("docs") / "results" / "calibration.md"
ODOMETRY: Final = Path("docs") / "odometry.md"
_HEAD: Final = """# Calibration of units

Written by `make bench-calibration BENCH_ARGS="--page"`; [calibration](../calibration.md) says what
the parameters are. Of virtual units the tables hold what is left of an error, estimate minus
truth; of real ones what was found. The figure after +- is the stated deviation. Thickness is the
median over flat patches, gap the distance of the two halves of a turn on them.
"""

Row = dict[str, Any]


def write(rows: list[Row], targets: list[Target]) -> Path:
    """Write the page; return its path."""
    parts = [
        _HEAD,
        "## Targets",
        verdicts(targets),
        "## Beams",
        table(rows),
        *_words(rows, "imu", "IMU: what is left, and its deviation"),
        "[Odometry](../odometry.md#units-that-are-not-perfect) and "
        "[deskew](../deskew.md#what-it-achieves) have what calibration is worth to them.",
        measured_on(),
    ]
    PAGE.parent.mkdir(parents=True, exist_ok=True)
    PAGE.write_text("\n\n".join(part.strip("\n") for part in parts) + "\n", encoding="utf-8")
    return PAGE


def write_odometry(rows: Iterable[Row], methods: Sequence[str]) -> None:
    """Replace the table of units in the page of the odometry.

    Parameters
    ----------
    rows : iterable of dict
        ATE [mm] of each run by method.
    methods : sequence of str
    """
    runs: dict[str, list[Row]] = {}
    for row in rows:
        if row["case"].startswith("odometry: "):
            runs.setdefault(row["case"].removeprefix("odometry: "), []).append(row)
    if not runs:
        return
    lines = [f"| ATE, median / largest [mm] | {' | '.join(methods)} | runs |"]
    lines.append("|---|" + "---|" * (len(methods) + 1))
    for name, mine in runs.items():
        cells = [
            f"{statistics.median(row[key] for row in mine):.1f} / "
            f"{max(row[key] for row in mine):.1f}"
            for key in methods
        ]
        lines.append(f"| {name} | {' | '.join(cells)} | {len(mine)} |")
    text = ODOMETRY.read_text(encoding="utf-8")
    ODOMETRY.write_text(replaced(text, "units", "\n".join(lines)), encoding="utf-8")


def _words(rows: Iterable[Row], kind: str, title: str) -> list[str]:
    """Return a section of what is told in words."""
    lines = [
        f"- {row['case']}, seed {row['seed']}: {row['refused'] or row['corrected']}"
        for row in rows
        if row["case"].startswith(kind)
    ]
    return [f"## {title}", "\n".join(lines)] if lines else []


def table(rows: Iterable[Row]) -> str:
    """Return the table of what was found about beams."""
    lines = [
        "| Case | Seed | xi [deg] | beta [deg] | alpha [deg] | b [mm] | bias [mm] | "
        "Thickness [mm] | Gap [mm] | Corrected, or why not |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        if row["case"].startswith(("imu", "odometry")):
            continue
        figures = [_figure(row, name) for name in ("xi", "beta", "alpha", "b", "bias")]
        cells = [
            row["case"],
            str(row["seed"]),
            *figures,
            _pair(row, "thick"),
            _pair(row, "gap"),
            f"refused: {row['refused']}" if row["refused"] else row["corrected"] or "nothing",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _figure(row: Row, name: str) -> str:
    if row[name] == "":
        return "not known"
    digits = 3 if name in ("xi", "beta", "alpha") else 2 if name == "b" else 1
    return f"{row[name]:+.{digits}f} +- {row[f'{name} sd']:.{digits}f}"


def _pair(row: Row, name: str) -> str:
    if row[f"{name} before"] == "":
        return ""
    return f"{row[f'{name} before']:.1f} to {row[f'{name} after']:.1f}"
