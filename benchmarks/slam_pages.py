"""What the rows of the back end's benchmark say: targets, a table to print, and a page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.stats import beta

from benchmarks.results import Target, at_least, at_most, machine

Row = dict[str, Any]

PAGE: Final = Path("docs") / "results" / "slam.md"
PLACED: Final = (0.5, 0.05)  # [deg, m] a kidnapped start is found this well
_HEAD: Final = """# The SLAM back end

Written by `make bench-slam BENCH_ARGS="--resume --page"`; [maps](../mapping.md) explains the
back end. All of it is simulation: true poses with a drift that is drawn (its rate is the error
over 20 m of way, root mean square), and 4000 of the 15000 rays of each turn, one turn every
0.4 m. No real loop of an L2 has been measured.

A loop is *wrong* when it is more than 0.3 m or 3 degrees from the truth, in the directions it
claims to know. ATE is the root mean square distance from the truth after the best rigid alignment.
A submap that comes back to a place (3 m) is *tied* when the way to it through the graph is below
20 m. Rates have their 95 % bound beside them (Clopper and Pearson; with no failure in N runs that
is about 3/N)."""


def upper_bound(failures: int, runs: int) -> float:
    """Return the 95 % upper bound (Clopper and Pearson) of a rate."""
    return 1.0 if failures >= runs else float(beta.ppf(0.95, failures + 1, runs - failures))


def lower_bound(successes: int, runs: int) -> float:
    """Return the 95 % lower bound of a rate."""
    return 1.0 - upper_bound(runs - successes, runs)


def is_found(row: Row) -> bool:
    """Return whether a kidnapped start was found, and well enough."""
    return bool(row["announced"] and row["error_m"] <= PLACED[1] and row["error_deg"] <= PLACED[0])


def targets(rows: list[Row]) -> Iterator[Target]:
    """Yield the targets that these rows can tell about."""
    mapping = [row for row in rows if row["kind"] == "mapping"]
    street = [r for r in mapping if r["scene"] == "street" and r["drift_percent"] == 0.5]
    if street:
        ratio = max(row["ate_m"] / row["odometry_ate_m"] for row in street)
        yield at_most("street, 0.5 %: largest ATE by that of odometry alone", ratio, 0.25)
        yield at_most("street, 0.5 %: largest ATE, m", max(r["ate_m"] for r in street), 0.15)
        tied = sum(r["tied"] for r in street) / max(sum(r["revisits"] for r in street), 1)
        yield at_least("street, 0.5 %: revisits tied", tied, 0.8)
    small = [row for row in mapping if row["drift_percent"] == 0.1]
    if small:
        worse = max(row["ate_m"] - row["odometry_ate_m"] for row in small)
        yield at_most("0.1 %: worst loss against odometry alone, m", worse, 0.005)
    aliased = [row for row in mapping if row["aliased"]]
    if aliased:
        lied = sum(row["wrong_loops"] > 0 for row in aliased)
        yield at_most(f"aliased runs with a wrong loop, of {len(aliased)}", float(lied), 0.0)
        bound = upper_bound(lied, len(aliased))
        yield at_most("their rate, 95 % upper bound", bound, 0.03)
        worse = max(row["ate_m"] - row["odometry_ate_m"] for row in aliased)
        yield at_most("aliased: worst loss against odometry alone, m", worse, 0.01)
    if mapping:
        wrong = float(sum(row["wrong_loops"] for row in mapping))
        loops = sum(row["loops"] for row in mapping)
        yield at_most(f"wrong loops of {loops}, all scenes", wrong, 0.0)
        yield at_most("cores, largest of any walk", max(r["cores"] for r in mapping), 0.3)
        yield at_most("longest step, s of processor", max(r["longest_s"] for r in mapping), 5.0)
        yield at_most("map, MB per km, largest", max(r["mb_per_km"] for r in mapping), 60.0)
    starts = [r for r in rows if r["kind"] == "kidnapped"]
    inside = [r for r in starts if r["scene"] in ("street", "office")]
    if inside:
        good = sum(map(is_found, inside))
        yield at_least(f"kidnapped starts found, of {len(inside)}", good / len(inside), 0.9)
        yield at_least("their rate, 95 % lower bound", lower_bound(good, len(inside)), 0.8)
    if starts:
        wrong = float(sum(bool(row["wrong"]) for row in starts))
        yield at_most(f"wrong announcements, of {len(starts)} starts", wrong, 0.0)
        bound = upper_bound(int(wrong), len(starts))
        yield at_most("their rate, 95 % upper bound", bound, 0.03)
    hour = [row for row in rows if row["kind"] == "hour"]
    if len(hour) > 2:
        grown = (hour[-1]["megabytes"] - hour[1]["megabytes"]) / (
            (hour[-1]["way_m"] - hour[1]["way_m"]) / 1000.0
        )
        yield at_most("growth in known ground, MB per km", grown, 3.0)


def summary(rows: list[Row]) -> list[Row]:
    """Return one row for each scene and drift, each kind of start, and what others found."""
    table: list[Row] = []
    mapping = [row for row in rows if row["kind"] == "mapping"]
    for scene, percent in sorted({(r["scene"], r["drift_percent"]) for r in mapping}):
        some = [r for r in mapping if (r["scene"], r["drift_percent"]) == (scene, percent)]
        table.append(
            {
                "what": f"{scene}, {percent} %" + (" (aliased)" if some[0]["aliased"] else ""),
                "runs": len(some),
                "way_m": round(some[0]["way_m"]),
                "alone_mm": _mm(np.median([r["odometry_ate_m"] for r in some])),
                "median_mm": _mm(np.median([r["ate_m"] for r in some])),
                "worst_mm": _mm(max(r["ate_m"] for r in some)),
                "found": f"{sum(r['tied'] for r in some)}/{sum(r['revisits'] for r in some)}",
                "loops": sum(r["loops"] for r in some),
                "wrong": sum(r["wrong_loops"] for r in some),
                "cores": round(float(np.median([r["cores"] for r in some])), 3),
            }
        )
    starts = [row for row in rows if row["kind"] == "kidnapped"]
    for scene in sorted({r["scene"] for r in starts}):
        some = [r for r in starts if r["scene"] == scene]
        found = [r for r in some if r["announced"]]
        table.append(
            {
                "what": f"kidnapped: {scene}",
                "runs": len(some),
                "way_m": "-",
                "alone_mm": "-",
                "median_mm": _mm(np.median([r["error_m"] for r in found])) if found else "-",
                "worst_mm": _mm(max(r["error_m"] for r in found)) if found else "-",
                "found": f"{len(found)}/{len(some)}",
                "loops": "-",
                "wrong": sum(bool(r["wrong"]) for r in some),
                "cores": round(float(np.median([r["cores"] for r in some])), 3),
            }
        )
    for row in rows:
        if row["kind"] == "kiss-slam":
            table.append(_kiss(row))
    return table


def _kiss(row: Row) -> Row:
    found = not row["failed"]
    return {
        "what": f"kiss-slam, {row['odometry']} odometry, {row['style']}: {row['scene']}",
        "runs": 1,
        "way_m": "-",
        "alone_mm": _mm(row["alone_m"]) if row["odometry"] == "ours" else "-",
        "median_mm": _mm(row["ate_m"]) if found else row["failed"],
        "worst_mm": "-",
        "found": "-",
        "loops": row["loops"] if found else "-",
        "wrong": row["wrong_loops"] if found else "-",
        "cores": round(row["cores"], 3) if found else "-",
    }


def counted(missing: Iterable[Row]) -> str:
    """Return in words how many runs of each kind and scene are missing."""
    kinds = Counter((key["kind"], key.get("scene", "")) for key in missing)
    return ", ".join(
        f"{count} x {kind} {scene}".rstrip() for (kind, scene), count in kinds.items()
    )


def write(rows: list[Row], met: list[Target], missing: list[Row]) -> Path:
    """Write the page; return its path."""
    facts = machine()
    parts = [_HEAD, _targets(met), _mapping(rows), _kidnapped(rows), _hour(rows), _others(rows)]
    if missing:
        parts.append(f"## Not run\n\nOf the full plan these runs are missing: {counted(missing)}.")
    parts.append(
        f"Measured on {facts['processor']}, {facts['cores']} cores, Python {facts['python']}."
    )
    PAGE.parent.mkdir(parents=True, exist_ok=True)
    PAGE.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")
    return PAGE


def _targets(met: list[Target]) -> str:
    lines = ["## Targets", "", "| | measured | bound | |", "|---|---|---|---|"]
    for target in met:
        verdict = "met" if target.met else "**not met**"
        lines.append(f"| {target.name} | {target.value:.4g} | {target.bound:.4g} | {verdict} |")
    return "\n".join(lines)


def _mapping(rows: list[Row]) -> str:
    some = [row for row in rows if row["kind"] == "mapping"]
    if not some:
        return ""
    refused: Counter[str] = Counter()
    for row in some:
        refused.update(row["refused"])
    reasons = ", ".join(f"{reason} {count}" for reason, count in refused.most_common())
    lines = [
        "## Mapping",
        "",
        "| Scene, drift | runs | way [m] | odometry alone [mm] | map, median [mm] | worst [mm] "
        "| revisits tied | loops | wrong | cores at 1 m/s |",
        "|---" * 10 + "|",
    ]
    lines += [_line(row) for row in summary(some)]
    return "\n".join([*lines, "", f"Candidates that were refused, by reason: {reasons}."])


def _kidnapped(rows: list[Row]) -> str:
    starts = [row for row in rows if row["kind"] == "kidnapped"]
    if not starts:
        return ""
    lines = [
        "## Kidnapped starts",
        "",
        "At a random place of a saved map, either way round, 20 m at 0.5 % of drift. Found: "
        "announced, then off by 5 cm and 0.5 degrees at most (medians of what follows). "
        "`ring` has identical doors and is symmetric: there is nothing to find, and nothing may "
        "be announced that is not so. `outside` starts in another world.",
        "",
        "| Map | starts | announced | found | at least (95 %) | after [m], median | off [mm], "
        "median | worst [mm] | wrong | at most (95 %) |",
        "|---" * 10 + "|",
    ]
    for scene in sorted({row["scene"] for row in starts}):
        some = [row for row in starts if row["scene"] == scene]
        said = [row for row in some if row["announced"]]
        good, wrong = sum(map(is_found, some)), sum(bool(row["wrong"]) for row in some)
        after = f"{np.median([r['found_after_m'] for r in said]):.1f}" if said else "-"
        off = _mm(np.median([r["error_m"] for r in said])) if said else "-"
        worst = _mm(max(r["error_m"] for r in said)) if said else "-"
        lines.append(
            f"| {scene} | {len(some)} | {len(said)} | {good} | {lower_bound(good, len(some)):.0%} "
            f"| {after} | {off} | {worst} | {wrong} | {upper_bound(wrong, len(some)):.0%} |"
        )
    return "\n".join(lines)


def _hour(rows: list[Row]) -> str:
    hour = [row for row in rows if row["kind"] == "hour"]
    if not hour:
        return ""
    lines = [
        "## Round after round",
        "",
        f"{len(hour)} laps of the furnished office, 0.2 % of drift.",
        "",
        "| Lap | way [m] | submaps | map [MB] | peak memory, process [MB] | cores at 1 m/s |",
        "|---" * 6 + "|",
    ]
    chosen = sorted({0, 1, len(hour) // 4, len(hour) // 2, len(hour) - 1} & set(range(len(hour))))
    for row in (hour[number] for number in chosen):
        lines.append(
            f"| {row['lap']} | {row['way_m']:.0f} | {row['submaps']} | {row['megabytes']:.2f} "
            f"| {row['rss_mb']:.0f} | {row['cores']:.3f} |"
        )
    return "\n".join(lines)


def _others(rows: list[Row]) -> str:
    some = [row for row in rows if row["kind"] == "kiss-slam"]
    if not some:
        return ""
    lines = [
        "## kiss-slam on the same scans",
        "",
        "With its own KISS-ICP, and with the drifting odometry that ours is given; with its own "
        "settings, and with finer ones for rooms (local maps of 10 m, images of 0.2 m). It knows "
        "neither IMU nor gravity. Its loops count as wrong beyond 1 m or 10 degrees.",
        "",
        "| kiss-slam | odometry given [mm] | ATE [mm] | loops | wrong | cores at 1 m/s "
        "| ours on the same [mm] |",
        "|---" * 7 + "|",
    ]
    for row in some:
        ours = [
            r["ate_m"]
            for r in rows
            if r["kind"] == "mapping"
            and (r["scene"], r["seed"], r["drift_percent"]) == (row["scene"], row["seed"], 0.5)
        ]
        cells = _kiss(row)
        name = str(cells["what"]).removeprefix("kiss-slam, ")
        lines.append(
            f"| {name} | {cells['alone_mm']} | {cells['median_mm']} | {cells['loops']} "
            f"| {cells['wrong']} | {cells['cores']} | {_mm(ours[0]) if ours else '-'} |"
        )
    return "\n".join(lines)


def _line(row: Row) -> str:
    return "| " + " | ".join(str(value) for value in row.values()) + " |"


def _mm(meters: Any) -> str:
    return f"{1e3 * float(meters):.1f}"
