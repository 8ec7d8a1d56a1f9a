"""The bags that we write, read by other people's own programs as they come from PyPI."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import QosDurability
from rosbags.typesys import Stores, get_typestore

from l2lidar_node.config import DriverConfig
from l2lidar_node.recording.bag import BagFile, BagWriter, open_bag
from l2lidar_node.settings import build
from l2lidar_node.types import HostNs, ImuSample, Sweep
from tests.l2lidar_proc.odometry.odometry_world import recording
from tests.support.odometry_runs import sweeps, truth

PROGRAMS = Path(sys.executable).parent
SWEEPS = 12
ODOMETRY = "nav_msgs/msg/Odometry"


def run(*words: str | Path, cwd: Path) -> str:
    """Run a program of this environment; return what it says."""
    environment = {**os.environ, "HOME": str(cwd), "OMP_NUM_THREADS": "1", "COLUMNS": "200"}
    done = subprocess.run(
        [str(PROGRAMS / words[0]), *map(str, words[1:])],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def _known_at(event: Sweep | ImuSample) -> int:
    return event.end if isinstance(event, Sweep) else event.stamp


@pytest.fixture(scope="module", params=["run", "run.mcap"])
def bag(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return a bag of clouds and samples: a folder, or a single file."""
    path = tmp_path_factory.mktemp("bags") / request.param
    world = recording("room", "walk")
    events: list[Any] = [*list(sweeps(world, "turn"))[:SWEEPS]]
    events += [
        ImuSample(
            HostNs(int(item["stamp"])),
            *(
                tuple(item[name].tolist())
                for name in ("orientation_wxyz", "angular_velocity", "linear_acceleration")
            ),
        )
        for item in world.imu
    ]
    with BagWriter(path, build(DriverConfig, {"sweep_cut": "turn"})) as writer:
        for event in sorted(events, key=_known_at):
            writer.add(event)
    return path


def test_kiss_icp_reads_every_cloud(bag: Any, tmp_path: Path) -> None:
    # its own reader of single files fails on every MCAP, its reader of bags takes files as well
    chosen = ("--topic", "/points") if bag.suffix else ()  # else it guesses
    run("kiss_icp_pipeline", "--dataloader", "rosbag", *chosen, bag, cwd=tmp_path)
    (poses,) = tmp_path.glob("results/*-*/*_poses_tum.txt")
    found = np.loadtxt(poses)
    assert len(found) == SWEEPS
    starts = [sweep.start * 1e-9 for sweep in list(sweeps(recording("room", "walk"), "turn"))]
    np.testing.assert_allclose(found[:, 0], starts[:SWEEPS], atol=1e-3)


def test_kiss_icp_gets_the_points_and_their_times(bag: Any) -> None:
    from kiss_icp.datasets.rosbag import RosbagDataset

    clouds = RosbagDataset(bag, "/points")
    for sweep in list(sweeps(recording("room", "walk"), "turn"))[:3]:
        points, times = clouds[0]
        expected = np.stack([sweep.points[axis] for axis in "xyz"], axis=1)
        np.testing.assert_array_equal(points, expected)
        np.testing.assert_array_equal(times, sweep.points["time"])


def test_a_copy_keeps_message_and_qos(bag: Path, tmp_path: Path) -> None:
    with open_bag(bag) as source, BagFile(tmp_path / "copy.mcap", store=source.typestore) as copy:
        for connection, now, data in source.messages():
            copy.copy(connection, now, data)
    with open_bag(bag) as source, open_bag(tmp_path / "copy.mcap") as copied:
        offered = {item.topic: item.ext.offered_qos_profiles for item in source.connections}
        assert offered == {
            item.topic: item.ext.offered_qos_profiles for item in copied.connections
        }
        (latched,) = offered["/tf_static"]
        assert latched.durability is QosDurability.TRANSIENT_LOCAL
        for (at, now, data), (its, then, other) in zip(
            source.messages(), copied.messages(), strict=True
        ):
            assert (at.topic, at.msgtype, now, data) == (its.topic, its.msgtype, then, other)


@pytest.mark.parametrize("name", ["run", "run.mcap"])
def test_evo_reads_odometry_out_of_a_bag(name: str, tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    world = recording("room", "walk")
    stamps = np.arange(2_500_000_000, 5_500_000_000, 200_000_000) + int(world.imu["stamp"][0])
    positions, quaternions = truth(world, stamps)
    with BagFile(tmp_path / name) as file:
        file.connect("/odometry", ODOMETRY, 10, reliable=True, latched=False)
        for stamp, xyz, (w, x, y, z) in zip(
            stamps.tolist(), positions.tolist(), quaternions.tolist(), strict=True
        ):
            time = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
            zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
            pose = types["geometry_msgs/msg/Pose"](
                position=types["geometry_msgs/msg/Point"](*xyz),
                orientation=types["geometry_msgs/msg/Quaternion"](x, y, z, w),
            )
            message = types[ODOMETRY](
                header=types["std_msgs/msg/Header"](stamp=time, frame_id="odom"),
                child_frame_id="l2lidar_link",
                pose=types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
                twist=types["geometry_msgs/msg/TwistWithCovariance"](
                    types["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36)
                ),
            )
            file.write("/odometry", stamp, store.serialize_cdr(message, ODOMETRY))
    kind = "mcap" if name.endswith(".mcap") else "bag2"
    run("evo_traj", kind, name, "/odometry", "--save_as_tum", cwd=tmp_path)
    (written,) = tmp_path.glob("*.tum")
    found = np.loadtxt(written)
    np.testing.assert_allclose(found[:, 1:4], positions, atol=1e-6)
