"""Writers and what they leave where they are ended in the middle."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from l2lidar_node.emulator import truth
from l2lidar_node.emulator.motion.motion import from_tum
from l2lidar_node.emulator.truth import PacketLog
from l2lidar_node.files import whole, write_whole
from l2lidar_node.recording.bag import BagFile
from l2lidar_proc.recording import outputs
from l2lidar_proc.recording.outputs import Trajectory
from l2lidar_proc.verbs import odometry
from l2lidar_proc.verbs.recorded import OdometryRun

ROOT = Path(__file__).parents[2]
needs_open3d = pytest.mark.skipif(find_spec("open3d") is None, reason="needs open3d")
POINTS = np.random.default_rng(1).random((200, 3))


class PowerCutError(BaseException):
    """Ends a program at a certain place."""


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_whole(path, "one\n")
    write_whole(path, b"two\n")
    assert path.read_bytes() == b"two\n"
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fill_the_disk() -> None:
        with whole(path) as part:
            part.write_text("ne")
            raise OSError("full")

    with pytest.raises(OSError, match="full"):
        fill_the_disk()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(FileNotFoundError) as caught:
        write_whole(tmp_path / "nowhere" / "a.txt", "new")
    assert caught.value.filename == str(tmp_path / "nowhere" / "a.txt")


def test_the_name_to_write_to_tells_the_format(tmp_path: Path) -> None:
    with whole(tmp_path / "a.ply") as part:
        assert part.suffix == ".ply"
        assert part.parent == tmp_path
        part.touch()


def _way(folder: Path) -> None:
    run = OdometryRun(Trajectory().poses, POINTS, 0, Counter(), Counter())
    odometry.write(run, folder)


def _a_way(folder: Path) -> Path:
    path = folder.parent / "way.tum"
    path.write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n2 1 1 0 0 0 0 1\n3 0 1 0 0 0 0 1\n")
    return path


WRITERS = [
    pytest.param(lambda folder: outputs.save(folder / "m.ply", POINTS), marks=needs_open3d),
    pytest.param(lambda folder: outputs.save(folder / "m.pcd", POINTS), marks=needs_open3d),
    pytest.param(_way, marks=needs_open3d),
    lambda folder: truth.write_tum(
        folder / "t.tum", from_tum(_a_way(folder)), np.linspace(0.0, 1.0, 5)
    ),
    lambda folder: truth.write_packet_log(folder, PacketLog(), {}),
]


@pytest.mark.parametrize("write", WRITERS)
def test_a_writer_that_is_ended_in_the_middle_leaves_the_old_file(
    write: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is not put in its place at the end was not written to that place either."""
    write(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert before
    for path in before:
        path.write_bytes(b"old")

    def cut(*_: object) -> None:
        raise PowerCutError

    monkeypatch.setattr("l2lidar_node.files.os.replace", cut)
    with pytest.raises(PowerCutError):
        write(tmp_path)
    assert {path.read_bytes() for path in before} == {b"old"}


@needs_open3d
def test_a_map_is_whole_whenever_its_writer_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    code = (
        "import sys, numpy as np; from pathlib import Path\n"
        "from l2lidar_proc.recording import outputs\n"
        "points = np.random.default_rng(1).random((100_000, 3))\n"
        "while True: outputs.save(Path(sys.argv[1]), points); print('.', flush=True)"
    )
    sizes = set()
    for times in (1, 2, 3):
        with subprocess.Popen(
            [sys.executable, "-c", code, str(path)], cwd=ROOT, stdout=subprocess.PIPE
        ) as process:
            assert process.stdout is not None
            for _ in range(times):
                process.stdout.readline()
            process.send_signal(signal.SIGKILL)
        sizes.add(path.stat().st_size)
    assert len(sizes) == 1


@pytest.mark.parametrize("name", ["run.mcap", "run"])
def test_what_a_killed_recording_left_does_not_block_the_next(tmp_path: Path, name: str) -> None:
    (tmp_path / "run.unfinished").mkdir()
    with BagFile(tmp_path / name) as bag:
        bag.connect("/numbers", "std_msgs/msg/Header", 1, reliable=True, latched=False)
        bag.write("/numbers", 1, bytes(16))
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([name, "run.unfinished"])
    with AnyReader([tmp_path / name]) as reader:
        assert reader.message_count == 1


@pytest.mark.parametrize("name", ["run.mcap", "run"])
def test_a_bag_that_is_cut_off_does_not_get_its_name(tmp_path: Path, name: str) -> None:
    def cut_off(data: bytes, keep: bool) -> Path | None:
        bag = BagFile(tmp_path / name, keep_unfinished=keep)
        with suppress(PowerCutError), bag:
            bag.connect("/numbers", "std_msgs/msg/Header", 1, reliable=True, latched=False)
            if data:
                bag.write("/numbers", 1, data)
            raise PowerCutError
        return bag.unfinished

    assert cut_off(b"", keep=True) is None
    assert cut_off(bytes(16), keep=False) is None
    assert list(tmp_path.iterdir()) == []
    left = cut_off(bytes(16), keep=True)
    assert left is not None
    assert [path.name for path in tmp_path.iterdir()] == ["run.unfinished"]
    with AnyReader([left]) as reader:
        assert reader.message_count == 1
