"""Writes what the hard benchmark finds into a page of results."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.results import Target, measured_on, verdicts

PAGE: Final = Path("docs") / "results" / "odometry_hard.md"
_OURS: Final = "ours"
_HEAD: Final = """# Hard runs of the odometry

Written by `make bench-odometry-hard BENCH_ARGS="--page"`; [odometry](../odometry.md) explains the
estimator, `benchmarks/hard_scenarios.py` what is in each scene. A run has *failed* when its last
pose is more than 1 % of the way and more than 0.3 m off; it was *silent* when a pose without any
status was off by more than 3 sigma and 0.1 m. NEES is the share of poses (position and attitude,
6) and of velocities (3) whose normalized squared error is within the bound that 95 % should keep.
ATE is after an SE(3) alignment; ends and NEES are relative to the first pose. A unit called
*imperfect* has beam angles 0.4 degrees off, ranges 0.2 % off, an IMU turned by 0.5 degrees and
2 ms late, vibration, lost packets and gaps in its IMU samples.
"""

Row = dict[str, Any]


def write(rows: list[Row], targets: list[Target]) -> Path:
    """Write the page; return its path."""
    parts = [
        _HEAD,
        _setting(rows),
        _accuracy(rows),
        _consistency(rows),
        "## Targets",
        verdicts(targets),
        _failures(rows),
        measured_on(),
    ]
    PAGE.parent.mkdir(parents=True, exist_ok=True)
    PAGE.write_text("\n\n".join(part.strip("\n") for part in parts) + "\n", encoding="utf-8")
    return PAGE


def _setting(rows: list[Row]) -> str:
    ours = [row for row in rows if row["method"] == _OURS]
    lengths = sorted({row["seconds"] for row in ours})
    spans = " and ".join(f"{length:g} s" for length in lengths)
    return (
        f"{len(ours)} runs of {spans}, {sum(row['way_m'] for row in ours):.0f} m in all; the "
        "others on as many of the same recordings as their column says."
    )


def _accuracy(rows: list[Row]) -> str:
    names = list(dict.fromkeys(row["method"] for row in rows))
    lines = [
        "## Accuracy",
        "",
        "Median ATE [mm], and how many of the runs failed.",
        "",
        "| Scene | " + " | ".join(names) + " |",
        "|---|" + "---|" * len(names),
    ]
    for family in _families(rows):
        cells = [_cell([r for r in rows if (r["family"], r["method"]) == (family, n)])
                 for n in names]  # fmt: skip
        lines.append(f"| {family} | " + " | ".join(cells) + " |")
    totals, speeds = [], []
    for name in names:
        mine = [row for row in rows if row["method"] == name]
        totals.append(f"{sum(row['failed'] for row in mine)} of {len(mine)} failed")
        speeds.append(f"{np.median([row['real_time_factor'] for row in mine]):.0f}")
    lines.append("| **all** | " + " | ".join(totals) + " |")
    lines.append("| recording / processor time, median | " + " | ".join(speeds) + " |")
    return "\n".join(lines)


def _cell(found: list[Row]) -> str:
    if not found:
        return ""
    ate = float(np.median([row["ate_m"] for row in found]))
    words = "gave up" if not np.isfinite(ate) else f"{1e3 * ate:.0f}"
    failed = sum(bool(row["failed"]) for row in found)
    return f"{words}, {failed} of {len(found)}" if failed else words


def _consistency(rows: list[Row]) -> str:
    lines = [
        "## What ours says of itself",
        "",
        "| Scene | end off, median / largest [m] | lost | silent | largest error / sigma "
        "without a status | NEES pose | NEES velocity |",
        "|---|---|---|---|---|---|---|",
    ]
    for family in _families(rows):
        found = [r for r in rows if r["family"] == family and r["method"] == _OURS]
        if not found:
            continue
        ends = [row["end_m"] for row in found]
        shares = [100.0 * float(np.mean([row[key] for row in found]))
                  for key in ("nees_pose", "nees_velocity")]  # fmt: skip
        lines.append(
            f"| {family} | {np.median(ends):.3f} / {max(ends):.3f}"
            f" | {sum(bool(row['lost']) for row in found)}"
            f" | {sum(bool(row['silent']) for row in found)}"
            f" | {max(row['sigmas'] for row in found):.1f}"
            f" | {shares[0]:.0f} % | {shares[1]:.0f} % |"
        )
    return "\n".join(lines)


def _failures(rows: list[Row]) -> str:
    found = [r for r in rows if r["method"] == _OURS and (r["failed"] or r["lost"] or r["silent"])]
    if not found:
        return "## Runs that failed\n\nNone."
    found.sort(key=lambda row: (-row["failed"], -row["end_share"]))
    lines = [
        "## Runs that failed",
        "",
        "Ours, the worst first; with what it said in order.",
        "",
        "| Scene, seed | way [m] | end off [m] | largest [m] | silent poses | status |",
        "|---|---|---|---|---|---|",
    ]
    for row in found:
        lines.append(
            f"| {row['family']}, {row['seed']} | {row['way_m']:.0f} | {row['end_m']:.2f}"
            f" | {row['max_m']:.2f} | {row['silent']} | {row['status']} |"
        )
    return "\n".join(lines)


def _families(rows: list[Row]) -> list[str]:
    return list(dict.fromkeys(row["family"] for row in rows))
