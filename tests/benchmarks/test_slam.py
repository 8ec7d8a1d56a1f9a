"""The plan of the back end's benchmark, its bounds, and its page."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from benchmarks import bench_slam, slam_pages
from benchmarks.slam_pages import Row

PLAN = argparse.Namespace(
    seeds=3, aliased=8, starts=50, laps=45, scenes=list(bench_slam.WALKS)
)  # the defaults


def mapping(scene: str, seed: int, **other: object) -> Row:
    row: Row = {
        "kind": "mapping",
        "scene": scene,
        "aliased": bench_slam.WALKS[scene].aliased,
        "drift_percent": 0.5,
        "seed": seed,
        "way_m": 160.0,
        "odometry_ate_m": 0.08,
        "ate_m": 0.016,
        "loops": 13,
        "wrong_loops": 0,
        "revisits": 15,
        "tied": 14,
        "cores": 0.03,
        "longest_s": 0.7,
        "mb_per_km": 8.0,
        "refused": {"overlap": 2},
    }
    return {**row, **other}


def start(scene: str, seed: int, **other: object) -> Row:
    row: Row = {
        "kind": "kidnapped",
        "scene": scene,
        "seed": seed,
        "announced": True,
        "found_after_m": 8.0,
        "error_m": 0.02,
        "error_deg": 0.1,
        "wrong": False,
        "cores": 0.2,
    }
    return {**row, **other}


@pytest.mark.parametrize(
    ("failures", "runs", "bound"), [(0, 100, 0.02951), (1, 100, 0.04656), (0, 1, 0.95), (3, 3, 1)]
)
def test_the_bound_of_a_rate_is_that_of_clopper_and_pearson(
    failures: int, runs: int, bound: float
) -> None:
    assert slam_pages.upper_bound(failures, runs) == pytest.approx(bound, abs=1e-5)
    assert slam_pages.lower_bound(runs - failures, runs) == pytest.approx(1.0 - bound, abs=1e-5)


def test_the_plan_has_enough_runs_to_bound_lies_at_three_percent() -> None:
    tasks = list(bench_slam.tasks(PLAN))
    aliased = [
        key for key in tasks if key["kind"] == "mapping" and bench_slam.WALKS[key["scene"]].aliased
    ]

    assert slam_pages.upper_bound(0, len(aliased)) <= 0.03
    assert slam_pages.upper_bound(0, sum(key["kind"] == "kidnapped" for key in tasks)) <= 0.03
    assert len({tuple(sorted(key.items())) for key in tasks}) == len(tasks)
    # whenever it is cut, there is something of each kind
    assert {key["kind"] for key in tasks[: len(tasks) // 3]} == {key["kind"] for key in tasks}


def test_a_wrong_loop_or_announcement_misses_the_targets() -> None:
    good = [mapping("office_ring", n) for n in range(3)] + [start("office", n) for n in range(3)]
    lies = [
        mapping("storeys", 5, wrong_loops=1),
        start("ring", 5, wrong=True, error_m=4.0),
    ]

    def missed(rows: list[Row]) -> set[str]:
        return {target.name for target in slam_pages.targets(rows) if not target.met}

    added = missed([*good, *lies]) - missed(good)
    assert any("aliased runs with a wrong loop" in name for name in added)
    assert any("wrong loops of" in name for name in added)
    assert any("wrong announcements" in name for name in added)


def test_the_page_says_what_was_measured_and_what_was_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slam_pages, "PAGE", tmp_path / "slam.md")
    kiss: Row = {
        "kind": "kiss-slam",
        "scene": "office_ring",
        "seed": 0,
        "odometry": "ours",
        "style": "for rooms",
        "alone_m": 0.08,
        "failed": "",
        "ate_m": 0.08,
        "loops": 0,
        "wrong_loops": 0,
        "cores": 0.02,
    }
    broken = {**kiss, "odometry": "own", "failed": "SO3::exp failed!"}
    rows = [mapping("office_ring", 0), start("office", 0), start("street", 0, announced=False)]
    rows = [*rows, kiss, broken]
    missing = [
        {"kind": "mapping", "scene": "street", "drift_percent": 0.1, "seed": n} for n in (0, 1)
    ]
    text = slam_pages.write(rows, list(slam_pages.targets(rows)), missing).read_text()

    assert (
        "| office_ring, 0.5 % (aliased) | 1 | 160 | 80.0 | 16.0 | 16.0 | 14/15 | 13 | 0 |" in text
    )
    assert "| office | 1 | 1 | 1 |" in text
    assert "| street | 1 | 0 | 0 |" in text
    assert "SO3::exp failed!" in text
    assert "2 x mapping street" in text
    assert "**not met**" in text  # one run bounds nothing
