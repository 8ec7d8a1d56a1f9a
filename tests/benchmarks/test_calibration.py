"""The calibration bench: what it keeps, and what its rows say about the targets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import bench_calibration, calibration_units
from benchmarks.bench_calibration import Case, Kept
from benchmarks.results import at_most
from l2lidar_node.calibration.file import CalibrationFile, ImuCalibration, load
from l2lidar_node.calibration.result import Verdict
from l2lidar_node.calibration.still import calibrate


def row(case: str, seed: int, **values: object) -> dict[str, object]:
    measured = dict.fromkeys(("xi", "beta", "alpha", "b", "bias"), 0.001)
    deviations = {f"{name} sd": 0.01 for name in measured}
    thickness = {"thick before": 20.0, "thick after": 10.0}
    return {
        **bench_calibration._empty(case, seed),
        **measured,
        **deviations,
        **thickness,
        **values,
    }


def test_a_case_that_was_cut_off_is_measured_again(tmp_path: Path) -> None:
    kept = Kept(tmp_path / "bench" / "rows.jsonl")
    assert kept.read() == {}
    kept.append(Case("perfect", 3), [row("perfect", 3), at_most("off", 2.0, 1.0)])
    with (tmp_path / "bench" / "rows.jsonl").open("a") as file:
        file.write('{"case": ["perfect", 4], "rows": [')
    kept.append(Case("real"), [])
    found = kept.read()
    assert list(found) == [Case("perfect", 3), Case("real", 0)]
    first, target = found[Case("perfect", 3)]
    assert isinstance(first, dict)
    assert first["seed"] == 3
    assert target == at_most("off", 2.0, 1.0)
    kept.clear()
    assert kept.read() == {}


def test_one_unit_that_is_off_shows_in_the_targets() -> None:
    rows = [row("perfect", 0), row("perfect", 1, b=0.9, corrected="b")]
    rows += [row("population", 0), row("population", 1, xi=0.05, refused="moved")]
    targets = {
        item.name: item
        for item in (
            *bench_calibration.perfect_targets(rows),
            *bench_calibration.population_targets(rows),
        )
    }
    missed = {name for name, item in targets.items() if not item.met}
    assert missed == {
        "of 2 perfect units get a correction",
        "perfect units, worst |b|, mm",
        "units whose xi is within 3 stated deviations",
        "units of the population that are refused",
    }
    assert list(bench_calibration.perfect_targets([])) == []


def test_the_page_has_a_line_for_every_case(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench_calibration, "PAGE", tmp_path / "page.md")
    rows = [row("perfect", 0, bias=""), row("imu", 1, corrected="rotation x +0.01 deg")]
    text = bench_calibration.write(rows, [at_most("worst |xi|", 2.0, 1.0)]).read_text()
    assert "| perfect | 0 | +0.001 +- 0.010 |" in text
    assert "not known" in text
    assert "- imu, seed 1: rotation x +0.01 deg" in text
    assert "| worst \\|xi\\| | 2 | 1 | **not met** |" in text


def test_the_odometry_of_units_is_judged_and_shown_by_its_medians(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "odometry.md"
    page.write_text("before\n<!-- units: generated -->\nold\n<!-- /units -->\nafter\n")
    monkeypatch.setattr(bench_calibration, "ODOMETRY", page)
    methods = bench_calibration.METHODS
    rows = [
        row("odometry: yard, walk", seed, **dict(zip(methods, values, strict=True)))
        for seed, values in enumerate([(1.0, 8.0, 1.4), (1.2, 9.0, 2.0), (2.0, 7.0, 1.7)])
    ]
    (target,) = bench_calibration.odometry_targets(rows)
    assert target.value == pytest.approx(1.7 / 1.2)
    assert target.met
    bench_calibration.write_odometry(rows, methods)
    line = "| yard, walk | 1.2 / 2.0 | 8.0 / 9.0 | 1.7 / 2.0 | 3 |"
    assert page.read_text().splitlines()[2:] == [
        "| ATE, median / largest [mm] | " + " | ".join(methods) + " | runs |",
        "|---|---|---|---|---|",
        line,
        "<!-- /units -->",
        "after",
    ]
    bench_calibration.write_odometry([], methods)
    assert line in page.read_text()


def test_a_calibrated_recording_is_that_of_an_imu_as_drawn(tmp_path: Path) -> None:
    path = tmp_path / "unit.yaml"
    imu = ImuCalibration((0.0, 0.0, 0.2), 0.002)
    CalibrationFile(bytes(32), {}, {}, imu).save(path)
    plain = calibration_units.recorded("box", "spin", 0, 1.0, "perfect", None)
    turned = calibration_units.recorded("box", "spin", 0, 1.0, "perfect", load(path))
    assert (plain.imu["stamp"] - turned.imu["stamp"] == 2_000_000).all()
    x, y = plain.imu["linear_acceleration"][:, 0], plain.imu["linear_acceleration"][:, 1]
    expected = np.cos(0.2) * x - np.sin(0.2) * y
    np.testing.assert_allclose(turned.imu["linear_acceleration"][:, 0], expected, atol=1e-6)


@pytest.mark.skipif(
    not calibration_units.REAL_FOLDER.exists(), reason="the recordings are not here"
)
def test_real_captures() -> None:
    degree = np.pi / 180
    both = [
        calibration_units.place(calibration_units.REAL_FOLDER / f"{name}.npy", number)
        for number, name in enumerate(calibration_units.CAPTURES)
    ]
    result = calibrate([replace(place, returns=place.returns[::3]) for place in both])
    for report in result.places:
        assert 0.34 < (report.xi - 0.7 * report.beta) / degree < 0.42
    first, second = result.places
    assert abs(first.xi - second.xi) < 0.06 * degree
    assert abs(first.beta - second.beta) < 0.06 * degree
    assert result.estimates["alpha"].verdict is Verdict.SHOWN
    assert "not repeatable" in result.estimates["alpha"].reason
    assert result.estimates["bias"].verdict is Verdict.UNKNOWN
    assert result.after.thickness < 0.018 < result.before.thickness
