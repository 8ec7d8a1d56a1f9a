"""What the rows of the back end's benchmark say: targets, a table to print, and a page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.special import betaincinv

from benchmarks.results import Target, at_least, at_most, markdown, measured_on, verdicts

Row = dict[str, Any]

PAGE: Final = Path("docs") / "results" / "slam.md"
PLACED: Final = (0.5, 0.05)  # [deg, m] a kidnapped start is found this well
_HEAD: Final = """# The SLAM back end

Written by `make bench-slam BENCH_ARGS="--resume --page"`; [maps](../mapping.md) explains the
back end. All of it is simulation: true poses with random drift (its rate is the root mean square
error over 20 m of travel), and 4000 of the 15000 rays of each turn, one turn every 0.4 m. No real
loop of an L2 has been measured.

A loop is *wrong* if it is more than 0.3 m or 3 degrees from the truth, in the directions it
constrains. ATE is the root mean square distance from the truth after the best rigid alignment. A
submap that returns to a place (3 m) is *tied* if the path to it through the graph is below 20 m.
Rates have their 95 % bound beside them (Clopper and Pearson; with no failure in N runs about
3/N)."""
_STARTS: Final = """\
At a random place of a saved map, in either direction, 20 m at 0.5 % of drift. Found: announced,
then off by at most 5 cm and 0.5 degrees (medians of the poses that follow). `ring` has identical
doors and is symmetric, so the place cannot be found, and no wrong place may be announced.
`outside` starts in another world."""
_KISS: Final = """\
With its own KISS-ICP or the drifting odometry that ours gets; with its default settings or finer
ones for rooms (local maps of 10 m, images of 0.2 m). It uses neither IMU nor gravity. Its loops
count as wrong beyond 1 m or 10 degrees."""


def upper_bound(failures: int, runs: int) -> float:
    """Return the 95 % upper bound (Clopper and Pearson) of a rate."""
    return 1.0 if failures >= runs else float(betaincinv(failures + 1, runs - failures, 0.95))


def lower_bound(successes: int, runs: int) -> float:
    """Return the 95 % lower bound of a rate."""
    return 1.0 - upper_bound(runs - successes, runs)


def is_found(row: Row) -> bool:
    """Return whether a kidnapped start was found, and well enough."""
    return bool(row["announced"] and row["error_m"] <= PLACED[1] and row["error_deg"] <= PLACED[0])


def targets(rows: list[Row]) -> Iterator[Target]:
    """Yield the targets that these rows can tell about."""
    mapping = [row for row in rows if row["kind"] == "mapping"]
    hour = [row for row in rows if row["kind"] == "hour"]
    street = [r for r in mapping if r["scene"] == "street" and r["drift_percent"] == 0.5]
    if street:
        ratio = max(row["ate_m"] / row["odometry_ate_m"] for row in street)
        yield at_most("street, 0.5 %: largest ATE over that of odometry alone", ratio, 0.25)
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
        solves = [r["solve_s"] for r in (*mapping, *hour) if "solve_s" in r]
        if solves:
            yield at_most("optimization of the whole graph, CPU s", max(solves), 0.5)
        yield at_most("longest step, CPU s", max(r["longest_s"] for r in mapping), 5.0)
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
        cores = max(row["cores"] for row in starts)
        yield at_most("cores while searching and tracking, largest", cores, 0.3)
    if len(hour) > 2:
        cores = max(row["cores"] for row in hour)
        yield at_most("cores of the long run, largest of a lap", cores, 0.3)
        peak = hour[-1]["rss_mb"] / hour[1]["rss_mb"]
        yield at_most("its peak memory over that of the second lap", peak, 1.25)
        grown = (hour[-1]["megabytes"] - hour[1]["megabytes"]) / (
            (hour[-1]["way_m"] - hour[1]["way_m"]) / 1000.0
        )
        yield at_most("growth in known ground, MB per km", grown, 3.0)


def mapping_table(rows: list[Row]) -> list[Row]:
    """Return one row for each scene and drift."""
    table: list[Row] = []
    mapping = [row for row in rows if row["kind"] == "mapping"]
    for scene, percent in sorted({(r["scene"], r["drift_percent"]) for r in mapping}):
        some = [r for r in mapping if (r["scene"], r["drift_percent"]) == (scene, percent)]
        table.append(
            {
                "Scene, drift": f"{scene}, {percent} %"
                + (" (aliased)" if some[0]["aliased"] else ""),
                "runs": len(some),
                "way [m]": round(some[0]["way_m"]),
                "odometry alone [mm]": _mm(np.median([r["odometry_ate_m"] for r in some])),
                "map, median [mm]": _mm(np.median([r["ate_m"] for r in some])),
                "worst [mm]": _mm(max(r["ate_m"] for r in some)),
                "revisits tied": f"{_total(some, 'tied')}/{_total(some, 'revisits')}",
                "loops": _total(some, "loops"),
                "wrong": _total(some, "wrong_loops"),
                "cores at 1 m/s": f"{np.median([r['cores'] for r in some]):.3f}",
            }
        )
    return table


def start_table(rows: list[Row]) -> list[Row]:
    """Return one row for each map in which something starts at an unknown place."""
    table: list[Row] = []
    starts = [row for row in rows if row["kind"] == "kidnapped"]
    for scene in sorted({row["scene"] for row in starts}):
        some = [row for row in starts if row["scene"] == scene]
        said = [row for row in some if row["announced"]]
        good, wrong = sum(map(is_found, some)), _total(some, "wrong")
        table.append(
            {
                "Map": scene,
                "starts": len(some),
                "announced": len(said),
                "found": good,
                "at least (95 %)": f"{lower_bound(good, len(some)):.0%}",
                "after [m], median": f"{np.median([r['found_after_m'] for r in said]):.1f}"
                if said
                else "-",
                "off [mm], median": _mm(np.median([r["error_m"] for r in said])) if said else "-",
                "worst [mm]": _mm(max(r["error_m"] for r in said)) if said else "-",
                "wrong": wrong,
                "at most (95 %)": f"{upper_bound(wrong, len(some)):.0%}",
                "cores at 1 m/s": f"{np.median([r['cores'] for r in some]):.2f}",
            }
        )
    return table


def lap_table(rows: list[Row]) -> list[Row]:
    """Return some of the laps of the long run."""
    laps = [row for row in rows if row["kind"] == "hour"]
    chosen = {0, 1, len(laps) // 4, len(laps) // 2, len(laps) - 1} & set(range(len(laps)))
    return [
        {
            "Lap": row["lap"],
            "way [m]": f"{row['way_m']:.0f}",
            "submaps": row["submaps"],
            "map [MB]": f"{row['megabytes']:.2f}",
            "peak memory, process [MB]": f"{row['rss_mb']:.0f}",
            "cores at 1 m/s": f"{row['cores']:.3f}",
        }
        for row in (laps[number] for number in sorted(chosen))
    ]


def kiss_table(rows: list[Row]) -> list[Row]:
    """Return one row for each run of kiss-slam, beside ours of the same walk."""
    table: list[Row] = []
    for row in rows:
        if row["kind"] != "kiss-slam":
            continue
        same = (row["scene"], row["seed"], 0.5)
        ours = [
            _mm(r["ate_m"])
            for r in rows
            if r["kind"] == "mapping" and (r["scene"], r["seed"], r["drift_percent"]) == same
        ]
        failed = row["failed"]
        table.append(
            {
                "kiss-slam": f"{row['odometry']} odometry, {row['style']}: {row['scene']}",
                "odometry given [mm]": _mm(row["alone_m"]) if row["odometry"] == "ours" else "-",
                "ATE [mm]": failed or _mm(row["ate_m"]),
                "loops": "-" if failed else row["loops"],
                "wrong": "-" if failed else row["wrong_loops"],
                "cores at 1 m/s": "-" if failed else f"{row['cores']:.3f}",
                "ours on the same [mm]": ours[0] if ours else "-",
            }
        )
    return table


def counted(missing: Iterable[Row]) -> str:
    """Return in words how many runs of each kind and scene are missing."""
    kinds = Counter((key["kind"], key.get("scene", "")) for key in missing)
    return ", ".join(
        f"{count} x {kind} {scene}".rstrip() for (kind, scene), count in kinds.items()
    )


def write(rows: list[Row], met: list[Target], missing: list[Row]) -> Path:
    """Write the page; return its path."""
    laps = sum(row["kind"] == "hour" for row in rows)
    parts = [
        _HEAD,
        f"## Targets\n\n{verdicts(met)}",
        _section("Mapping", "", mapping_table(rows)),
        _refused(rows),
        _section("Kidnapped starts", _STARTS, start_table(rows)),
        _section(
            "Round after round",
            f"{laps} laps of the furnished office, 0.2 % of drift.",
            lap_table(rows),
        ),
        _section("kiss-slam on the same scans", _KISS, kiss_table(rows)),
    ]
    if missing:
        parts.append(f"## Not run\n\nOf the full plan these runs are missing: {counted(missing)}.")
    parts.append(measured_on())
    PAGE.parent.mkdir(parents=True, exist_ok=True)
    PAGE.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")
    return PAGE


def _section(title: str, text: str, table: list[Row]) -> str:
    """Return a section with a table; empty if that has no rows."""
    if not table:
        return ""
    return "\n\n".join(part for part in (f"## {title}", text, markdown(table)) if part)


def _refused(rows: list[Row]) -> str:
    counts: Counter[str] = Counter()
    for row in rows:
        counts.update(row.get("refused", {}))
    reasons = ", ".join(f"{reason} {count}" for reason, count in counts.most_common())
    return f"Rejected candidates, by reason: {reasons}." if reasons else ""


def _total(rows: list[Row], name: str) -> int:
    return sum(int(row[name]) for row in rows)


def _mm(meters: Any) -> str:
    return f"{1e3 * float(meters):.1f}"
