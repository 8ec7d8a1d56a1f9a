"""`l2lidar check` on recordings, good, wrong and damaged: output, JSON and exit code."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from l2lidar_node.check.observation import CLOUD, IMU, SourceError, Topics, choose
from l2lidar_node.check.requirements import CONSUMERS
from l2lidar_node.cli import main
from tests.l2lidar_node.check.recordings import Recording, copied, good

Said = tuple[int, str, str]


@pytest.fixture
def check(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Return exit code, output and errors of the command."""

    def run(*arguments: object) -> Said:
        monkeypatch.setattr("sys.argv", ["l2lidar", "check", *map(str, arguments)])
        code = main.main()
        said = capsys.readouterr()
        assert "Traceback" not in said.err + said.out
        return code, said.out, said.err

    return run


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return good("lio_sam").write(tmp_path_factory.mktemp("bags") / "good")


def small() -> Recording:
    """A short recording, for tests that damage files."""
    made = copied(good("rko_lio"))
    made.clouds, made.cloud_arrivals = made.clouds[:2], made.cloud_arrivals[:2]
    return made


def test_a_good_recording_is_ready(check: Any, bag: Path) -> None:
    code, said, _ = check(bag, "--for", "lio_sam", "--strict")
    lines = said.splitlines()
    assert code == 0
    assert len(lines) > 20
    assert all(line.startswith("OK ") for line in lines[:-1])
    assert lines[-1].startswith("ready for LIO-SAM: no errors, no warnings")


def test_a_finding_is_one_line_with_what_to_do(check: Any, bag: Path) -> None:
    code, said, _ = check(bag, "--for", "fast_lio")
    (line,) = [line for line in said.splitlines() if line.startswith("ERROR")]
    assert code == 1
    assert line.endswith("nothing arrives; set qos_reliability: reliable")
    assert said.splitlines()[-1].startswith("not ready for FAST-LIO2: 1 error,")


def test_json_says_the_same(check: Any, bag: Path) -> None:
    code, said, _ = check(bag, "--for", "fast_lio", "--json")
    data = json.loads(said)
    assert code == 1
    assert data["topics"] == {"cloud": "/points", "imu": "/imu/data"}
    (found,) = [item for item in data["findings"] if item["level"] == "ERROR"]
    assert (found["subject"], found["check"]) == ("qos", "qos-imu")
    assert found["fix"] == "set qos_reliability: reliable"


@pytest.mark.parametrize("storage", StoragePlugin)
def test_both_storages_and_the_bare_file_are_read(
    check: Any, storage: Any, tmp_path: Path
) -> None:
    folder = good("kiss_icp").write(tmp_path / "bag", storage)
    assert check(folder, "--for", "kiss_icp", "--strict")[0] == 0
    if storage is StoragePlugin.MCAP:
        (file,) = folder.glob("*.mcap")
        assert check(file, "--for", "kiss_icp", "--strict")[0] == 0


@pytest.mark.parametrize("consumer", CONSUMERS)
def test_every_consumer_is_known(check: Any, consumer: Any, tmp_path: Path) -> None:
    assert check(small().write(tmp_path / "bag"), "--for", consumer)[0] in (0, 1)


def test_warnings_fail_only_if_they_are_to(check: Any, tmp_path: Path) -> None:
    made = copied(good("lio_sam"))
    made.transforms = []
    path = made.write(tmp_path / "bag")
    code, said, _ = check(path, "--for", "lio_sam")
    assert (code, said.count("WARN ")) == (0, 1)
    assert said.splitlines()[-1].startswith("ready, with warnings, for LIO-SAM")
    assert check(path, "--for", "lio_sam", "--strict")[0] == 1


def test_only_so_many_seconds_are_read(check: Any, bag: Path) -> None:
    code, said, _ = check(bag, "--for", "lio_sam", "--seconds", "1.1", "--json")
    assert code == 0
    (clouds,) = re.findall(r"samples cover \d+ of (\d+) clouds", said)
    assert 3 <= int(clouds) <= 5  # of 4.4 a second


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--cloud", "/nowhere"), "there is no topic '/nowhere'"),
        (("--cloud", "/imu/data"), "is of type sensor_msgs/msg/Imu"),
        (("--imu", "/points"), "is of type sensor_msgs/msg/PointCloud2"),
    ],
)
def test_a_wrong_topic_is_a_usage_error(check: Any, bag: Path, arguments: Any, said: str) -> None:
    code, _, error = check(bag, "--for", "lio_sam", *arguments)
    assert code == 2
    assert said in error


def test_a_recording_without_clouds_says_what_it_has(check: Any, tmp_path: Path) -> None:
    made = small()
    made.clouds, made.cloud_arrivals = [], []
    made.cloud_arrivals = [0]
    code, _, error = check(made.write(tmp_path / "bag"), "--for", "lio_sam")
    assert code == 2
    assert "/imu/data" in error


def test_an_unknown_consumer_is_a_usage_error(check: Any, bag: Path) -> None:
    code, _, error = check(bag, "--for", "loam")
    assert code == 2
    assert "lio_sam" in error


def _no_file(folder: Path) -> Path:
    return folder / "missing.mcap"


def _empty_folder(folder: Path) -> Path:
    (folder / "empty").mkdir()
    return folder / "empty"


def _empty_file(folder: Path) -> Path:
    (folder / "empty.mcap").write_bytes(b"")
    return folder / "empty.mcap"


def _other_file(folder: Path) -> Path:
    (folder / "other.mcap").write_bytes(bytes(range(256)) * 40)
    return folder / "other.mcap"


def _bad_metadata(folder: Path) -> Path:
    path = small().write(folder / "bag")
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: [1, {", encoding="utf-8")
    return path


def _other_metadata(folder: Path) -> Path:
    path = small().write(folder / "bag")
    (path / "metadata.yaml").write_text("some: thing", encoding="utf-8")
    return path


def _no_data(folder: Path) -> Path:
    path = small().write(folder / "bag")
    next(path.glob("*.mcap")).unlink()
    return path


def _bad_database(folder: Path) -> Path:
    path = small().write(folder / "bag", StoragePlugin.SQLITE3)
    (file,) = path.glob("*.db3")
    data = bytearray(file.read_bytes())
    data[100:4000] = b"\xa5" * 3900
    file.write_bytes(data)
    return path


@pytest.mark.parametrize(
    "make",
    [_no_file, _empty_folder, _empty_file, _other_file, _bad_metadata, _other_metadata, _no_data,
     _bad_database],
)  # fmt: skip
def test_what_is_no_recording_is_a_usage_error_with_one_line(
    check: Any, make: Any, tmp_path: Path
) -> None:
    path = make(tmp_path)
    code, said, error = check(path, "--for", "lio_sam")
    assert (code, said) == (2, "")
    assert error.startswith("l2lidar: ")
    assert str(path) in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.9, 0.999])
def test_a_recording_that_was_cut_off_is_refused_or_judged(
    check: Any, share: float, tmp_path: Path
) -> None:
    (file,) = small().write(tmp_path / "bag").glob("*.mcap")
    data = file.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: round(len(data) * share)])
    assert check(cut, "--for", "rko_lio")[0] in (0, 1, 2)


@pytest.mark.parametrize("seed", range(8))
def test_a_recording_with_wrong_bytes_is_refused_or_judged(
    check: Any, seed: Any, tmp_path: Path
) -> None:
    draw = np.random.default_rng(seed)
    (file,) = small().write(tmp_path / "bag").glob("*.mcap")
    data = np.frombuffer(file.read_bytes(), np.uint8).copy()
    places = draw.integers(0, len(data), 200)
    data[places] = draw.integers(0, 256, 200)
    file.write_bytes(data.tobytes())
    assert check(file, "--for", "rko_lio")[0] in (0, 1, 2)


@pytest.mark.parametrize("source", [("/points",), ()])
def test_without_ros_a_topic_is_a_usage_error(
    check: Any, monkeypatch: pytest.MonkeyPatch, source: Any
) -> None:
    monkeypatch.setitem(sys.modules, "l2lidar_node.ros.topic_source", None)
    monkeypatch.delattr("l2lidar_node.ros.topic_source", raising=False)
    code, _, error = check(*source, "--for", "lio_sam")
    assert code == 2
    assert "need a sourced ROS 2" in error


def test_several_topics_have_to_be_told_apart() -> None:
    kinds = {"/points": CLOUD, "/points_deskewed": CLOUD, "/imu/data": IMU, "/camera/imu": IMU}
    with pytest.raises(SourceError, match="--cloud: /points, /points_deskewed"):
        choose(kinds, Topics(), needs_imu=True)
    with pytest.raises(SourceError, match="--imu: /camera/imu, /imu/data"):
        choose(kinds, Topics(cloud="/points"), needs_imu=True)
    assert choose(kinds, Topics(cloud="/points"), needs_imu=False) == ("/points", "")
    assert choose(kinds, Topics("/points", "/imu/data"), needs_imu=True) == (
        "/points",
        "/imu/data",
    )
