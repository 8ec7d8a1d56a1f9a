"""A recording goes in, the same recording with deskewed clouds comes out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from l2lidar_node import rotations
from l2lidar_node.settings import build
from l2lidar_node.types import POINT, STANDARD_GRAVITY, HostNs
from l2lidar_proc.deskew.config import DeskewNodeConfig
from l2lidar_proc.recording import bag
from l2lidar_proc.recording.bag import RecordingError
from l2lidar_proc.verbs.deskew import Topics, _Deskewer, deskew_recording
from tests.l2lidar_proc.motion.analytic import Motion, at, rms, seen, xyz
from tests.support.deskew_scenarios import Scenario, record

WALK = Motion(turn=1.0, nod=0.1, speed=1.0)
TYPES = get_typestore(Stores.ROS2_JAZZY)
T = TYPES.types
LENGTH = 0.23
STARTS = [1.0, 1.5, 2.0, 2.5, 3.0]


def header(seconds: float, frame: str) -> Any:
    sec, nanosec = divmod(at(seconds), 10**9)
    return T["std_msgs/msg/Header"](T["builtin_interfaces/msg/Time"](sec, nanosec), frame)


def vector(values: Any) -> Any:
    return T["geometry_msgs/msg/Vector3"](*(float(v) for v in values))


def imu(sample: Any, frame: str = "imu") -> Any:
    seconds = (int(sample["stamp"]) - at(0)) * 1e-9
    q = T["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    none = np.zeros(9)
    rate, force = vector(sample["angular_velocity"]), vector(sample["linear_acceleration"])
    return T[bag.IMU](header(seconds, frame), q, none, rate, none, force, none)


def odometry(seconds: float) -> Any:
    velocity = WALK.velocity(np.array([seconds]))[0]
    pose = T["geometry_msgs/msg/PoseWithCovariance"](
        T["geometry_msgs/msg/Pose"](
            T["geometry_msgs/msg/Point"](0.0, 0.0, 0.0),
            T["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
        ),
        np.zeros(36),
    )
    twist = T["geometry_msgs/msg/TwistWithCovariance"](
        T["geometry_msgs/msg/Twist"](vector(velocity), vector((0, 0, 0))), np.zeros(36)
    )
    return T[bag.ODOMETRY](header(seconds, "odom"), "lidar", pose, twist)


def points_at(start: float) -> Any:
    return seen(WALK, start, start + LENGTH, start, count=2000)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "walk"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {
            "/scan_points": bag.CLOUD, "/imu/data": bag.IMU, "/odometry": bag.ODOMETRY,
            "/chatter": "std_msgs/msg/String",
        }  # fmt: skip
        lines = {t: writer.add_connection(t, kind, typestore=TYPES) for t, kind in topics.items()}

        def write(topic: str, when: float, message: Any) -> None:
            data = TYPES.serialize_cdr(message, topics[topic])
            writer.write(lines[topic], at(when), data)

        events = [(t, "/odometry", odometry(t - 0.05)) for t in np.arange(0.2, 3.4, 0.25)]
        for sample in WALK.imu(0, 3.4):
            events.append(((int(sample["stamp"]) - at(0)) * 1e-9, "/imu/data", imu(sample)))
        events.append((0.5, "/chatter", T["std_msgs/msg/String"]("hello")))
        for when, topic, message in sorted(events, key=lambda event: event[0]):
            write(topic, when, message)
    # clouds by the writer under test, which needs a bag of its own
    source = path.parent / "walk_with_clouds"
    with bag.open_bag(path) as reader, bag.BagFile(source) as copy:
        ends = [start + LENGTH for start in STARTS]
        for connection, recorded, data in bag.messages(reader):
            while ends and recorded > at(ends[0]):
                end = ends.pop(0)
                start = STARTS[len(STARTS) - len(ends) - 1]
                copy.cloud("/scan_points", at(end), points_at(start)[0], at(start), "lidar")
            copy.copy(connection, recorded, bytes(data))
    return source


def read(path: Path) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    with bag.open_bag(path) as reader:
        for connection, _, data in bag.messages(reader):
            message = reader.deserialize(data, connection.msgtype)
            found.setdefault(connection.topic, []).append(message)
    return found


@pytest.mark.parametrize("name", ["out", "out.mcap"])
def test_clouds_are_deskewed_and_the_rest_is_kept(
    recording: Path, tmp_path: Path, name: str
) -> None:
    target = tmp_path / name
    run = deskew_recording(recording, target, DeskewNodeConfig())
    assert (run.counts.sweeps, run.counts.deskewed) == (5, 5)
    assert len(run.report) == 1, "nothing was refused, nothing damaged"
    assert target.is_file() == name.endswith(".mcap")
    before, after = read(recording), read(target)
    for topic, messages in before.items():
        assert len(after[topic]) == len(messages)
    assert after["/chatter"][0].data == "hello"
    for message, start in zip(after["/points_deskewed"], STARTS, strict=True):
        assert bag.stamp_of(message) == at(start)
        assert message.header.frame_id == "lidar"
        points = bag.points_of(message)
        assert "time" not in (points.dtype.names or ())
        raw, truth = points_at(start)
        assert rms(xyz(points) - truth) < rms(xyz(raw) - truth) / 5


def changed(recording: Path, path: Path, kind: str, change: Callable[[Any], None]) -> Path:
    """Return a copy of a recording with all messages of a type changed."""
    with bag.open_bag(recording) as reader, bag.BagFile(path) as writer:
        for connection, recorded, data in bag.messages(reader):
            raw = bytes(data)
            if connection.msgtype == kind:
                message = reader.deserialize(data, kind)
                change(message)
                raw = bytes(TYPES.serialize_cdr(message, kind))
            writer.copy(connection, recorded, raw)
    return path


def test_damaged_messages_are_kept_but_not_used(recording: Path, tmp_path: Path) -> None:
    source, target = tmp_path / "damaged", tmp_path / "out"
    damaged = {bag.CLOUD: 2, bag.IMU: 20, bag.ODOMETRY: 3}  # which of its kind
    with bag.open_bag(recording) as reader, bag.BagFile(source) as writer:
        before = Counter[str]()
        for connection, recorded, data in bag.messages(reader):
            raw = bytes(data)
            if damaged.get(connection.msgtype) == before[connection.msgtype]:
                raw = b"\0\1\0\0damaged"
            before[connection.msgtype] += 1
            writer.copy(connection, recorded, raw)
    run = deskew_recording(source, target, DeskewNodeConfig())
    assert (run.counts.sweeps, run.counts.deskewed) == (4, 4)
    assert run.damaged == {"/scan_points": 1, "/imu/data": 1, "/odometry": 1}
    assert "1 damaged messages on '/imu/data' were not used" in run.report
    with bag.open_bag(target) as reader:
        kept = [bytes(data) for *_, data in bag.messages(reader)]
    assert kept.count(b"\0\1\0\0damaged") == 3


def test_an_accelerometer_in_g_gives_the_same_clouds(recording: Path, tmp_path: Path) -> None:
    def to_g(message: Any) -> None:
        force = message.linear_acceleration
        for axis in "xyz":
            setattr(force, axis, getattr(force, axis) / STANDARD_GRAVITY)

    source = changed(recording, tmp_path / "in_g", bag.IMU, to_g)
    clouds = []
    for name, bag_path in (("a", recording), ("b", source)):
        deskew_recording(bag_path, tmp_path / name, DeskewNodeConfig())
        clouds.append([bag.points_of(m) for m in read(tmp_path / name)["/points_deskewed"]])
    for expected, points in zip(*clouds, strict=True):
        np.testing.assert_allclose(xyz(points), xyz(expected), atol=1e-4)


def test_velocities_that_admit_to_be_wrong_do_little_harm(recording: Path, tmp_path: Path) -> None:
    count = 0

    def off(message: Any) -> None:
        nonlocal count
        count += 1
        is_right = count % 2 == 0  # the latest one before each cloud is wrong
        message.twist.twist.linear.y += 0.0 if is_right else 2.0
        variance = 0.01**2 if is_right else 4.0
        message.twist.covariance = (variance * np.eye(6)).ravel()

    source = changed(recording, tmp_path / "source", bag.ODOMETRY, off)
    deskew_recording(source, tmp_path / "target", DeskewNodeConfig())
    clouds = read(tmp_path / "target")["/points_deskewed"]
    for message, start in list(zip(clouds, STARTS, strict=True))[1:]:
        raw, truth = points_at(start)
        assert rms(xyz(bag.points_of(message)) - truth) < rms(xyz(raw) - truth) / 50


def test_the_covariance_of_a_velocity_is_turned_into_cloud_axes(tmp_path: Path) -> None:
    with bag.BagFile(tmp_path / "out") as writer:
        deskewer = _Deskewer(DeskewNodeConfig(), Topics("/points", "/imu", "/wheels"), writer)
        turn = rotations.transform([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], (0.0, 0.0, 0.0))
        deskewer._frames.add("lidar", "body", turn)
        deskewer._cloud_frame = "lidar"
        message = odometry(0.5)
        message.child_frame_id = "body"
        message.twist.covariance[[0, 7, 14]] = 1.0, 4.0, 9.0
        deskewer.take("/wheels", bag.ODOMETRY, message, at(0.5))
        (waiting,) = deskewer.pipeline.tracker.filter._pending
    np.testing.assert_allclose(waiting.covariance, np.diag([4.0, 1.0, 9.0]), atol=1e-4)


def test_a_twist_has_no_covariance() -> None:
    twist = T["geometry_msgs/msg/Twist"](vector((1, 2, 3)), vector((4, 5, 6)))
    found = bag.twist_of(T[bag.TWIST](header(0.0, "body"), twist))
    assert found == ("body", (1.0, 2.0, 3.0), (4.0, 5.0, 6.0), None)


def test_the_sign_is_the_one_that_the_odometry_on_the_way_finds(tmp_path: Path) -> None:
    with bag.BagFile(tmp_path / "out") as writer:
        deskewer = _Deskewer(DeskewNodeConfig(), Topics("/points", "/imu", ""), writer)
        samples = Motion().imu(0, 0.1)
        samples["linear_acceleration"] /= -STANDARD_GRAVITY
        for number, sample in enumerate(samples):
            if number == 20:
                deskewer._odometry.convention.reversed = True
            deskewer.take("/imu", bag.IMU, imu(sample), at(0.1))
    kept = deskewer.pipeline.tracker.buffer.samples["linear_acceleration"]
    assert len(kept) == len(samples)
    np.testing.assert_allclose(kept[:, 2], STANDARD_GRAVITY, rtol=1e-3)


def test_the_command_line(run: Any, recording: Path, tmp_path: Path) -> None:
    parameters = tmp_path / "p.yaml"
    parameters.write_text(
        "deskew_node:\n  ros__parameters:\n    range_max: 6.0\n    organised: true\n"
    )
    target = tmp_path / "out"
    done = run("deskew", str(recording), str(target), "--params-file", str(parameters))
    assert (done.code, done.err) == (0, "")
    assert "5 clouds: 5 deskewed" in done.out
    cloud = read(target)["/points_deskewed"][0]
    assert cloud.width == 300
    assert not cloud.is_dense


def test_the_command_line_refuses_what_is_in_the_way(
    run: Any, recording: Path, tmp_path: Path
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "file").touch()
    for source, target, code, words in (
        (recording, tmp_path / "out", 2, "exists"),
        (tmp_path / "nothing", tmp_path / "x", 1, "nothing: no such file"),
        (recording, tmp_path / "file/x.mcap", 1, "Not a directory"),
        (recording, tmp_path / "x.bag", 2, "ends in '.bag'"),
    ):
        done = run("deskew", str(source), str(target))
        assert done.code == code
        assert words in done.err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("deskew_node: {ros__parameters: {cloud_topic: a b}}", "'cloud_topic': 'a b' is not a"),
        ("hello", "expected a node's name"),
        ("deskew_node: {ros__parameters: {range_mxa: 6.0}}", "range_max"),
        ("{", "parameter file"),
    ],
)
def test_a_wrong_parameter_file_is_explained(
    run: Any, recording: Path, tmp_path: Path, text: str, words: str
) -> None:
    parameters = tmp_path / "p.yaml"
    parameters.write_text(text)
    done = run("deskew", str(recording), str(tmp_path / "y"), "--params-file", str(parameters))
    assert done.code == 2
    assert words in done.err
    done = run("deskew", str(recording), str(tmp_path / "y"), "--params-file", str(tmp_path))
    assert done.code == 2
    assert f"parameter file '{tmp_path}': Is a directory" in done.err


def test_without_the_needed_topics_it_says_what_there_is(recording: Path, tmp_path: Path) -> None:
    source = tmp_path / "only"
    with bag.open_bag(recording) as reader, bag.BagFile(source) as writer:
        for connection, recorded, data in bag.messages(reader):
            if connection.msgtype != bag.IMU:
                writer.copy(connection, recorded, data)
    with pytest.raises(RecordingError, match="imu_topic"):
        deskew_recording(source, tmp_path / "x", DeskewNodeConfig())


def test_clouds_without_plain_times_are_passed_on_without_them(
    recording: Path, tmp_path: Path
) -> None:
    source = tmp_path / "odd"
    points = np.zeros(5, dtype=POINT)
    with bag.open_bag(recording) as reader, bag.BagFile(source) as writer:
        for connection, recorded, data in bag.messages(reader):
            if connection.msgtype != bag.CLOUD:
                writer.copy(connection, recorded, data)
        writer.cloud("/points", at(3.5), points, at(3.3), "lidar")
    run = deskew_recording(source, tmp_path / "x", build(DeskewNodeConfig, {}))
    assert run.counts.sweeps == 0
    assert run.refused == {"all 5 times are equal": 1}
    (cloud,) = read(tmp_path / "x")["/points_deskewed"]
    assert "time" not in [item.name for item in cloud.fields]


def test_without_a_velocity_our_odometry_finds_it(tmp_path: Path) -> None:
    walk = record(Scenario("walk", "walk", 1.0, world="box", seconds=6.0))
    shift = at(0) - int(walk.samples["stamp"][0])
    path = tmp_path / "imu"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        line = writer.add_connection("/imu/data", bag.IMU, typestore=TYPES)
        for sample in walk.samples.copy():
            sample["stamp"] += shift
            data = TYPES.serialize_cdr(imu(sample), bag.IMU)
            writer.write(line, int(sample["stamp"]), data)
    source, target = tmp_path / "source", tmp_path / "target"
    with bag.open_bag(path) as reader, bag.BagFile(source) as copy:
        waiting = [item.sweep for item in walk.sweeps]
        for connection, recorded, raw in bag.messages(reader):
            while waiting and recorded > waiting[0].end + shift:
                sweep = waiting.pop(0)
                start = sweep.start + shift
                copy.cloud("/points", recorded, sweep.points, HostNs(start), "lidar")
            copy.copy(connection, recorded, bytes(raw))
    deskew_recording(source, target, DeskewNodeConfig())
    clouds = {bag.stamp_of(message): message for message in read(target)["/points_deskewed"]}
    late = [item for item in walk.sweeps[-6:] if item.sweep.start + shift in clouds]
    assert len(late) >= 5
    for item in late:
        points = bag.points_of(clouds[HostNs(item.sweep.start + shift)])
        assert rms(xyz(points) - item.at_start) < 0.001
        assert rms(xyz(item.sweep.points) - item.at_start) > 0.1
