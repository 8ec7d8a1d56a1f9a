"""The odometry over bags that other sensors' drivers recorded: formats, units, missing parts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2lidar_proc.odometry.config import OdometryNodeConfig
from l2lidar_proc.recording import bag
from l2lidar_proc.verbs.recorded import OdometryRun
from l2lidar_proc.verbs.recorded_bag import run_bag
from tests.support.foreign_bags import (
    EPOCH,
    FORMATS,
    LIVOX,
    BagMaker,
    Measured,
    depth,
    images,
    measured,
    ouster,
    write_bag,
)
from tests.support.other_sensors import CLOUD_POINT

pytest.importorskip("open3d")

FRAME = "sensor"


def put_ouster(bag: BagMaker, stamp: int, cloud: np.ndarray) -> None:
    bag.cloud("/ouster/points", stamp, FRAME, ouster(cloud, stamp), stamp + 100_000_000)


def off(stamps: np.ndarray, places: np.ndarray, given: Measured) -> float:
    """Return the largest error of the way between any place (N, 3) and the first [m]."""
    true = given.truth(stamps)
    way = np.linalg.norm(places - places[0], axis=1)
    return float(np.abs(way - np.linalg.norm(true - true[0], axis=1)).max())


def off_by(found: OdometryRun, given: Measured) -> float:
    """Return the largest error of the way between any pose and the first [m]."""
    return off(found.poses["stamp"], found.poses["pose"][:, :3, 3], given)


@pytest.mark.parametrize("name", FORMATS)
def test_each_maker_s_time_field(name: str, tmp_path: Path) -> None:
    given = measured()
    late = 100_000_000 if name == "velodyne" else 0

    def put(bag: BagMaker, stamp: int, cloud: np.ndarray) -> None:
        points = FORMATS[name](cloud, stamp)
        bag.cloud("/points_raw", stamp + late, FRAME, points, stamp + 100_000_000)

    write_bag(tmp_path / "bag", given, put)
    found = run_bag(tmp_path / "bag", OdometryNodeConfig())
    assert found.refused == {}
    assert len(found.poses) == len(given.clouds)
    assert off_by(found, given) < 0.015  # 0.025 where the times are not used


def test_a_unit_that_is_not_plain_is_asked_for_and_can_be_set(run: Any, tmp_path: Path) -> None:
    given = measured()

    def put(bag: BagMaker, stamp: int, cloud: np.ndarray) -> None:
        points = ouster(cloud, stamp)
        points["t"] //= 1000
        bag.cloud("/points", stamp, FRAME, points, stamp + 100_000_000)

    write_bag(tmp_path / "bag", given, put)
    done = run("odometry", str(tmp_path / "bag"), str(tmp_path / "out"))
    assert done.code == 1
    assert "no obvious unit; set time_unit to s, ms, us or ns" in done.out
    settings = tmp_path / "params.yaml"
    settings.write_text("odometry_node: {ros__parameters: {time_unit: us}}")
    words = ("odometry", str(tmp_path / "bag"), str(tmp_path / "out"), "--overwrite")
    done = run(*words, "--params-file", str(settings))
    assert (done.code, done.err) == (0, "")
    assert f"{len(given.clouds)} poses" in done.out


def test_livox_s_own_messages(tmp_path: Path) -> None:
    given = measured()
    write_bag(
        tmp_path / "bag",
        given,
        lambda bag, stamp, cloud: bag.livox(
            "/livox/lidar", stamp, FRAME, cloud, stamp + 100_000_000
        ),
        imu=lambda force: force / 9.80665,
        imu_topic="/livox/imu",
        imu_frame=FRAME,
    )
    found = run_bag(tmp_path / "bag", OdometryNodeConfig())
    assert found.refused == {}
    assert len(found.poses) == len(given.clouds)
    assert off_by(found, given) < 0.025
    said = " ".join(found.report)
    assert "the accelerometer measures in g: multiplied by 9.80665" in said
    assert "IMU and clouds have the same frame 'sensor'" in said


def test_livox_bytes_are_read_as_a_general_reader_reads_them(tmp_path: Path) -> None:
    given = measured()
    write_bag(
        tmp_path / "bag",
        given,
        lambda bag, stamp, cloud: bag.livox("/livox/lidar", stamp, "frame", cloud, stamp),
        imu=None,
    )
    with bag.open_bag(tmp_path / "bag") as reader:
        _, _, data = next(bag.messages(reader))
        message: Any = reader.deserialize(data, LIVOX)
    frame, stamp, points = bag.livox_points(data)
    assert (frame, stamp) == ("frame", bag.stamp_of(message))
    assert points["offset_time"].tolist() == [point.offset_time for point in message.points]
    assert points["z"].tolist() == [point.z for point in message.points]
    assert points["line"].tolist() == [point.line for point in message.points]
    for cut in (0, 3, 20, 40, 60, len(data) - 1):
        with pytest.raises(ValueError, match="Livox message"):
            bag.livox_points(data[:cut])


def test_without_an_imu_it_runs_and_says_so(run: Any, tmp_path: Path) -> None:
    given = measured()
    write_bag(tmp_path / "bag", given, put_ouster, imu=None)
    done = run("odometry", str(tmp_path / "bag"), str(tmp_path / "out"))
    assert (done.code, done.err) == (0, "")
    assert "no IMU in the recording: the motion comes from the clouds alone" in done.out
    found = np.loadtxt(tmp_path / "out" / "trajectory.tum")
    assert len(found) > 0.9 * len(given.clouds)
    stamps = np.round(found[:, 0] * 1e9).astype(np.int64)
    assert off(stamps, found[:, 1:4], given) < 0.06


def test_an_imu_that_measures_an_orientation_only_is_not_used(tmp_path: Path) -> None:
    given = measured()
    with BagMaker(tmp_path / "bag") as maker:
        for stamp, cloud in given.clouds:
            put_ouster(maker, stamp, cloud)
        for stamp in given.stamps.tolist():
            maker.imu("/ouster/imu", stamp, "imu", np.zeros(3), np.zeros(3))
    found = run_bag(tmp_path / "bag", OdometryNodeConfig())
    assert "the IMU on '/ouster/imu' measures no angular velocity" in " ".join(found.report)
    assert off_by(found, given) < 0.06


def test_what_an_imu_without_a_transform_is_taken_for_is_said(tmp_path: Path) -> None:
    ouster_bag(tmp_path / "bag", measured(), lambda *_: None)
    said = " ".join(run_bag(tmp_path / "bag", OdometryNodeConfig()).report)
    assert f"no transform from 'imu' to '{FRAME}' in /tf_static" in said
    assert "its axes are those of the clouds; if they are not, set imu_rpy" in said


def test_an_imu_with_other_axes_and_no_transform(tmp_path: Path) -> None:
    """It has the frame of the clouds by name."""
    given = measured("small", 9.2)
    turn = Rotation.from_euler("z", 180, degrees=True).as_matrix()
    path = tmp_path / "bag"
    write_bag(
        path,
        given,
        put_ouster,
        imu=lambda force: force @ turn,
        gyro=lambda rate: rate @ turn,
        imu_frame=FRAME,
    )
    found = run_bag(path, OdometryNodeConfig())
    assert "imu_rpy [0, 0, 180] was found by comparing" in " ".join(found.report)
    assert len(found.poses) == len(given.clouds)
    assert off_by(found, given) < 0.025
    watched = run_bag(path, OdometryNodeConfig(), observer=lambda estimate, base: None)
    assert "but not used: set it in a parameter file" in " ".join(watched.report)


def test_too_short_to_tell_how_the_imu_lies_it_says_what_to_set(tmp_path: Path) -> None:
    given = measured("small", 5.2)
    turn = Rotation.from_euler("z", 180, degrees=True).as_matrix()
    path = tmp_path / "bag"
    write_bag(
        path, given, put_ouster, imu=lambda force: force @ turn, gyro=lambda rate: rate @ turn
    )
    said = " ".join(run_bag(path, OdometryNodeConfig()).report)
    assert "the gyro does not turn as the clouds do: set imu_rpy" in said
    assert "was found by comparing" not in said


def test_of_several_imus_that_beside_the_clouds_is_taken(tmp_path: Path) -> None:
    given = measured()

    def put(maker: BagMaker, stamp: int, cloud: np.ndarray) -> None:
        put_ouster(maker, stamp, cloud)
        maker.imu("/camera/imu", stamp, "camera", np.full(3, 2.0), np.zeros(3))

    write_bag(tmp_path / "bag", given, put, imu_topic="/ouster/imu")
    assert off_by(run_bag(tmp_path / "bag", OdometryNodeConfig()), given) < 0.025


def test_a_depth_camera_whose_clouds_have_no_times(tmp_path: Path) -> None:
    given = measured("depth_camera")
    some = images(given)
    write_bag(
        tmp_path / "bag",
        given,
        lambda bag, stamp, cloud: bag.cloud(
            "/camera/depth/points", stamp, FRAME, depth(cloud, stamp), stamp
        ),
        clouds=some,
        imu_topic="/camera/imu",
    )
    found = run_bag(tmp_path / "bag", OdometryNodeConfig())
    assert found.refused == {}
    assert len(found.poses) == len(some)
    assert f"{len(some)} clouds without a time per point" in " ".join(found.report)
    assert off_by(found, given) < 0.05


def test_a_gyro_that_measures_in_degrees(tmp_path: Path) -> None:
    """And whose accelerometer points the other way besides."""
    given = measured("small", 9.2)
    path = tmp_path / "bag"
    write_bag(path, given, put_ouster, imu=lambda force: -force, gyro=np.rad2deg)
    found = run_bag(path, OdometryNodeConfig())
    said = " ".join(found.report)
    assert "the gyro measures in degrees per second: multiplied by pi / 180" in said
    assert "has the opposite sign" in said
    assert len(found.poses) == len(given.clouds)
    assert off_by(found, given) < 0.025


def test_an_accelerometer_that_points_the_other_way(tmp_path: Path) -> None:
    given = measured("small", 5.2)
    write_bag(tmp_path / "bag", given, put_ouster, imu=lambda force: -force)
    found = run_bag(tmp_path / "bag", OdometryNodeConfig())
    assert "has the opposite sign" in " ".join(found.report)
    assert len(found.poses) == len(given.clouds)
    assert off_by(found, given) < 0.025
    # and up is up
    way = found.poses["pose"][:, 2, 3] - found.poses["pose"][0, 2, 3]
    true = given.truth(found.poses["stamp"])[:, 2]
    assert np.abs(way - (true - true[0])).max() < 0.06


def ouster_bag(path: Path, given: Measured, more: Callable[[BagMaker, int], None]) -> None:
    """Write an Ouster's bag, and whatever else with every cloud."""

    def put(maker: BagMaker, stamp: int, cloud: np.ndarray) -> None:
        put_ouster(maker, stamp, cloud)
        more(maker, stamp)

    write_bag(path, given, put, imu_topic="/ouster/imu")


def test_topics_without_messages_do_not_count(run: Any, tmp_path: Path) -> None:
    given = measured()

    def more(maker: BagMaker, stamp: int) -> None:
        maker.announce("/filtered/points", bag.CLOUD)
        maker.announce("/ouster/imu_filtered", bag.IMU)

    ouster_bag(tmp_path / "bag", given, more)
    assert len(run_bag(tmp_path / "bag", OdometryNodeConfig()).poses) == len(given.clouds)
    write_bag(tmp_path / "none", given, lambda maker, *_: more(maker, 0), imu_topic="/imu")
    done = run("odometry", str(tmp_path / "none"), str(tmp_path / "out"))
    assert done.code == 1
    assert "there are: none; topics with messages: /imu (sensor_msgs/msg/Imu)" in done.err


def test_which_of_two_sensors_has_to_be_said_and_how(run: Any, tmp_path: Path) -> None:
    def more(maker: BagMaker, stamp: int) -> None:
        maker.cloud("/other", stamp, FRAME, depth(np.zeros(2, CLOUD_POINT), stamp), stamp)

    ouster_bag(tmp_path / "bag", measured(), more)
    done = run("odometry", str(tmp_path / "bag"), str(tmp_path / "out"))
    assert done.code == 1
    assert "there are: /ouster/points, /other: choose with cloud_topic" in done.err
    assert "--params-file" in done.err


@pytest.mark.parametrize(
    ("clock", "words"),
    [
        (1_234 * 10**9, "1699998766.0 s behind those of '/points'"),
        (EPOCH + 37 * 10**9, "37.0 s ahead of those of '/points'"),
        (EPOCH + 2 * 10**9, "2.0 s ahead of those of '/points'"),
    ],
)
def test_an_imu_with_another_clock_is_said_not_to_belong(
    clock: int, words: str, tmp_path: Path
) -> None:
    given = measured()
    with BagMaker(tmp_path / "bag") as maker:
        for stamp, cloud in given.clouds[:8]:
            maker.cloud("/points", stamp, FRAME, ouster(cloud, stamp), stamp + 10**8)
        for k, stamp in enumerate(given.stamps[:200].tolist()):
            maker.imu("/imu", stamp - EPOCH + clock, "imu", given.rates[k], given.forces[k], stamp)
    found = run_bag(tmp_path / "bag", OdometryNodeConfig())
    assert len(found.poses) == 8
    (said,) = (line for line in found.report if "the stamps of '/imu' are" in line)
    assert words in said
    assert "record both with the stamps of one clock" in said


@pytest.mark.parametrize("stamp_s", [0, 1_700_000_000])
def test_stamps_that_stand_still_are_said_to(run: Any, stamp_s: int, tmp_path: Path) -> None:
    given = measured()
    with BagMaker(tmp_path / "bag") as maker:
        for stamp, cloud in given.clouds[:8]:
            put = ouster(cloud, stamp)
            maker.cloud("/points", stamp_s * 10**9, FRAME, put, stamp + 10**8)
        for k, stamp in enumerate(given.stamps[:200].tolist()):
            force = given.forces[k]
            maker.imu("/imu", stamp_s * 10**9, "imu", given.rates[k], force, stamp)
    done = run("odometry", str(tmp_path / "bag"), str(tmp_path / "out"))
    assert done.code == 1
    assert f"all 8 messages on '/points' have the stamp {stamp_s}.000 s: " in done.out + done.err
    assert f"all 200 messages on '/imu' have the stamp {stamp_s}.000 s: " in done.out + done.err
    assert "7 sweeps: not later than the previous sweep: ignored" in done.out + done.err
    assert "record both" not in done.out + done.err


def test_damaged_messages_are_left_out_and_counted(tmp_path: Path) -> None:
    given = measured()

    def more(maker: BagMaker, stamp: int) -> None:
        if stamp == given.clouds[3][0]:
            maker.raw("/ouster/points", b"\0\1\0\0damaged", stamp)
            maker.raw("/ouster/imu", b"\0\1\0\0damaged", stamp)

    ouster_bag(tmp_path / "bag", given, more)
    found = run_bag(tmp_path / "bag", OdometryNodeConfig())
    assert len(found.poses) == len(given.clouds)
    assert "1 damaged messages on '/ouster/points' were left out" in found.report
    assert "1 damaged messages on '/ouster/imu' were left out" in found.report


def test_a_folder_without_metadata_is_read_from_its_files(tmp_path: Path) -> None:
    given = measured()
    ouster_bag(tmp_path / "bag", given, lambda *_: None)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert len(run_bag(tmp_path / "bag", OdometryNodeConfig()).poses) == len(given.clouds)


@pytest.mark.parametrize("share", [0.3, 0.99])
@pytest.mark.parametrize("mode", ["FILE", "MESSAGE", "STORAGE"])
def test_a_compressed_bag_that_was_cut_off_names_the_file(
    run: Any, tmp_path: Path, mode: str, share: float
) -> None:
    with BagMaker(tmp_path / "bag", compression=mode) as maker:
        for stamp, cloud in measured().clouds[:3]:
            put_ouster(maker, stamp, cloud)
    (file,) = (path for path in (tmp_path / "bag").iterdir() if path.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[: round(share * file.stat().st_size)])
    done = run("odometry", str(tmp_path / "bag"), str(tmp_path / "out"))
    assert done.code == 1
    assert f"{tmp_path / 'bag'}: cannot be read as a recording: " in done.err
