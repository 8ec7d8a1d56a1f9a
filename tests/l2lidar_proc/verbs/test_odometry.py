"""The odometry over a recording: a bag in, trajectory, map and plot out, readable by evo."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from l2lidar_node.types import Sweep
from l2lidar_proc.motion.imu_buffer import replay
from l2lidar_proc.odometry.config import OdometryNodeConfig
from l2lidar_proc.recording import bag
from l2lidar_proc.recording.bag import RecordingError
from l2lidar_proc.verbs.recorded import run_events
from l2lidar_proc.verbs.recorded_bag import run_bag
from tests.l2lidar_proc.odometry.odometry_world import recording
from tests.support.odometry_runs import sweeps, truth

FRAME = "l2lidar_link"


def write_bag(path: Path, count: int) -> list[Sweep]:
    """Write the first sweeps of a recording with their IMU samples; return the sweeps."""
    run = recording("room", "walk")
    some = list(sweeps(run, "turn"))[:count]
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    with bag.BagFile(path) as writer:
        writer.connect("/imu/data", bag.IMU, 1000, reliable=False, latched=False)
        for sweep, samples in replay(some, run.imu):
            for sample in samples:
                seconds, rest = divmod(int(sample["stamp"]), 10**9)
                time = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
                vector = types["geometry_msgs/msg/Vector3"]
                w, x, y, z = sample["orientation_wxyz"].tolist()
                message = types[bag.IMU](
                    header=types["std_msgs/msg/Header"](stamp=time, frame_id="l2lidar_imu"),
                    orientation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
                    orientation_covariance=np.zeros(9),
                    angular_velocity=vector(*sample["angular_velocity"].tolist()),
                    angular_velocity_covariance=np.zeros(9),
                    linear_acceleration=vector(*sample["linear_acceleration"].tolist()),
                    linear_acceleration_covariance=np.zeros(9),
                )
                data = store.serialize_cdr(message, bag.IMU)
                writer.write("/imu/data", int(sample["stamp"]), data)
            writer.cloud("/points", sweep.end, sweep.points, sweep.start, FRAME)
    return some


def test_bag_in_trajectory_map_and_plot_out(run: Any, tmp_path: Path) -> None:
    from evo.core.metrics import APE
    from evo.core.trajectory import PoseTrajectory3D
    from evo.tools import file_interface

    some = write_bag(tmp_path / "run.mcap", 14)
    done = run("odometry", str(tmp_path / "run.mcap"), str(tmp_path / "out"))
    assert (done.code, done.err) == (0, "")
    assert "14 poses from 14 sweeps" in done.out
    found = file_interface.read_tum_trajectory_file(tmp_path / "out" / "trajectory.tum")
    assert found.num_poses == 14
    stamps = np.array([(one.start + one.end) // 2 for one in some])
    true, turns = truth(recording("room", "walk"), stamps)
    np.testing.assert_allclose(found.timestamps, stamps * 1e-9, atol=1e-6)
    reference = PoseTrajectory3D(true, turns, found.timestamps)
    found.align(reference)
    ape = APE()
    ape.process_data((reference, found))
    assert ape.get_all_statistics()["rmse"] < 0.01
    way = np.linalg.norm(np.diff(found.positions_xyz[[0, -1]], axis=0))
    assert way == pytest.approx(np.linalg.norm(true[-1] - true[0]), abs=0.02)
    assert file_interface.read_kitti_poses_file(tmp_path / "out" / "trajectory.kitti").num_poses
    assert (tmp_path / "out" / "map.ply").stat().st_size > 10_000
    assert (tmp_path / "out" / "trajectory.png").stat().st_size > 1000


def test_events_give_what_the_bag_gives(tmp_path: Path) -> None:
    some = write_bag(tmp_path / "run.mcap", 8)
    from_bag = run_bag(tmp_path / "run.mcap", OdometryNodeConfig())
    run = recording("room", "walk")
    events: list[Any] = [(sweep.end, sweep) for sweep in some]
    events += [(int(row["stamp"][0]), row) for row in run.imu[:600].reshape(-1, 1)]
    direct = run_events(iter(sorted(events, key=lambda event: event[0])), OdometryNodeConfig())
    assert len(direct.poses) == len(from_bag.poses) == 8
    np.testing.assert_allclose(direct.poses["pose"][-1], from_bag.poses["pose"][-1], atol=2e-3)


def test_what_is_not_a_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="nothing: no such file"):
        run_bag(tmp_path / "nothing", OdometryNodeConfig())
    with pytest.raises(RecordingError, match=r"not a rosbag2 folder: it has no metadata\.yaml"):
        run_bag(tmp_path, OdometryNodeConfig())
    (tmp_path / "words.mcap").write_text("words")
    with pytest.raises(RecordingError, match=r"words\.mcap: cannot be read as a recording: "):
        run_bag(tmp_path / "words.mcap", OdometryNodeConfig())
