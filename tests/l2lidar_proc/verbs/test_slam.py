"""A map of a recording by the command line: everything it writes, and the exports of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gtsam")

from l2lidar_proc.slam import atlas
from tests.l2lidar_proc.verbs.test_odometry import write_bag

FILES = ("trajectory.tum", "trajectory.kitti", "map.ply", "graph.g2o", "odometry.tum", "map.png")


def test_a_recording_becomes_a_map_and_the_map_other_peoples_files(
    run: Any, tmp_path: Path
) -> None:
    write_bag(tmp_path / "run.mcap", 14)
    out = tmp_path / "out"

    done = run("slam", str(tmp_path / "run.mcap"), str(out))
    again = run("slam", str(tmp_path / "run.mcap"), str(out))
    exported = run("export", str(out), "--to", "g2o", "--folder", str(tmp_path / "g2o"))
    unknown = run("export", str(out), "--to", "dxf")

    assert (done.code, done.err) == (0, "")
    assert "14 poses from 14 sweeps" in done.out
    built, warnings = atlas.load(out / "map")
    assert warnings == []
    assert sum(len(node.sweeps) for node in built.nodes) == 14
    assert {path.name for path in out.iterdir()} == {"map", *FILES}
    for name in FILES:
        assert (out / name).stat().st_size > 0
    assert len((out / "trajectory.tum").read_text().splitlines()) == 14
    assert again.code == 2
    assert "--overwrite" in again.err
    assert exported.code == 0
    assert "VERTEX_SE3:QUAT 0" in (tmp_path / "g2o" / "graph.g2o").read_text()
    assert unknown.code == 2
    assert "'dxf' is not known; expected one of g2o" in unknown.err


@pytest.mark.parametrize("name", FILES)
def test_files_of_an_earlier_run_are_not_overwritten_unasked(
    run: Any, tmp_path: Path, name: str
) -> None:
    """Those of `l2lidar odometry` have the same names in part."""
    write_bag(tmp_path / "run.mcap", 14)
    out = tmp_path / "out"
    out.mkdir()
    (out / name).write_text("of an earlier run")

    refused = run("slam", str(tmp_path / "run.mcap"), str(out))
    assert refused.code == 2
    assert str(out / name) in refused.err.replace("\n", "")
    assert "--overwrite" in refused.err
    assert [path.name for path in out.iterdir()] == [name]
    assert (out / name).read_text() == "of an earlier run"


def test_with_overwrite_they_are(run: Any, tmp_path: Path) -> None:
    write_bag(tmp_path / "run.mcap", 14)
    out = tmp_path / "out"
    for path in (out / "trajectory.tum", out / "map.ply"):
        path.parent.mkdir(exist_ok=True)
        path.write_text("of an earlier run")

    for _ in range(2):
        done = run("slam", str(tmp_path / "run.mcap"), str(out), "--overwrite")
        assert (done.code, done.err) == (0, "")
        assert len((out / "trajectory.tum").read_text().splitlines()) == 14


@pytest.mark.parametrize("options", [(), ("--overwrite",)])
@pytest.mark.parametrize("is_file", [False, True])
def test_a_map_folder_with_something_else_is_refused_before_the_run(
    run: Any, tmp_path: Path, options: tuple[str, ...], is_file: bool
) -> None:
    write_bag(tmp_path / "run.mcap", 14)
    foreign = tmp_path / "out" / "map"
    foreign.parent.mkdir()
    if is_file:
        foreign.write_text("a city map")
    else:
        foreign.mkdir()
        (foreign / "city.osm").write_text("a city map")

    done = run("slam", str(tmp_path / "run.mcap"), str(tmp_path / "out"), *options)

    assert done.code == 2
    assert str(foreign) in done.err.replace("\n", "")
    assert "poses from" not in done.out
    assert [path.name for path in foreign.parent.iterdir()] == ["map"]


def test_what_is_not_a_map_is_not_exported(run: Any, tmp_path: Path) -> None:
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / atlas.MANIFEST).write_text(json.dumps({"map": {}}))

    done = run("export", str(tmp_path), "--to", "tum")

    assert done.code == 1
    assert "is not the manifest of a saved map" in done.err
