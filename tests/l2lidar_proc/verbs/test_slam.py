"""A map of a recording by the command line: everything it writes, and the exports of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gtsam")

from l2lidar_proc.slam import atlas
from tests.l2lidar_proc.verbs.test_odometry import write_bag


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
    for name in ("odometry.tum", "trajectory.tum", "graph.g2o", "map.ply", "map.png"):
        assert (out / name).stat().st_size > 0
    assert len((out / "trajectory.tum").read_text().splitlines()) == 14
    assert again.code == 2
    assert "--overwrite" in again.err
    assert exported.code == 0
    assert "VERTEX_SE3:QUAT 0" in (tmp_path / "g2o" / "graph.g2o").read_text()
    assert unknown.code == 2
    assert "'dxf' is not known; expected one of g2o" in unknown.err


def test_what_is_not_a_map_is_not_exported(run: Any, tmp_path: Path) -> None:
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / atlas.MANIFEST).write_text(json.dumps({"map": {}}))

    done = run("export", str(tmp_path), "--to", "tum")

    assert done.code == 1
    assert "is not the manifest of a saved map" in done.err
