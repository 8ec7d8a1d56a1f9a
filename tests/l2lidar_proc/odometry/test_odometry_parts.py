"""The parts of the odometry on their own: surfaces, sums of samples, files, KISS-ICP's guards."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from kiss_icp.voxelization import voxel_down_sample

from l2lidar_node import rotations
from l2lidar_node.settings import SettingError, build
from l2lidar_node.types import POINT, HostNs, Sweep
from l2lidar_proc.motion.filter import ERRORS, InertialState
from l2lidar_proc.odometry.base_frame import BaseFrame
from l2lidar_proc.odometry.config import OdometryConfig, OdometryNodeConfig
from l2lidar_proc.odometry.estimate import Status
from l2lidar_proc.odometry.kiss import PlainOdometry, thinned_indices
from l2lidar_proc.odometry.matcher import SweepMatcher
from l2lidar_proc.odometry.prediction import Predictor
from l2lidar_proc.odometry.surfel_map import SurfelMap
from l2lidar_proc.recording.outputs import Trajectory, kitti, levelled_start, tum
from tests.l2lidar_proc.motion.analytic import EPOCH, Motion, at
from tests.l2lidar_proc.odometry.odometry_world import recording
from tests.support.odometry_runs import sweeps

RNG_SEED = 4


def wall(x: float = 2.0) -> Any:
    """Return points on a wall across x, with 1 cm of noise."""
    rng = np.random.default_rng(RNG_SEED)
    points = rng.uniform((x, -1.0, 0.0), (x, 1.0, 2.0), (4000, 3))
    points[:, 0] += 0.01 * rng.standard_normal(len(points))
    return points


def test_a_wall_becomes_surfaces_and_gives_distances() -> None:
    surfaces = SurfelMap((0.25, 0.6))
    surfaces.add(wall(2.12))
    probe = np.array([[2.15, 0.1, 1.1], [2.09, -0.6, 0.4], [5.0, 5.0, 5.0]])
    found = surfaces.match(probe)
    order = np.argsort(found.index)
    assert found.index[order].tolist() == [0, 1]
    np.testing.assert_allclose(np.abs(found.normals[order]), [[1, 0, 0]] * 2, atol=0.05)
    signed = found.distances[order] * np.sign(found.normals[order, 0])
    np.testing.assert_allclose(signed, [0.03, -0.03], atol=0.006)
    assert (found.variances < 0.01**2).all()


def test_points_of_one_line_are_no_surface() -> None:
    surfaces = SurfelMap((0.25,))
    line = np.linspace(0.0, 0.24, 200)[:, None] * [0.6, 0.8, 0.0]
    surfaces.add(line + 0.002 * np.random.default_rng(RNG_SEED).standard_normal((200, 3)))
    assert not len(surfaces.match(line).index)


def test_a_full_cell_changes_no_more() -> None:
    surfaces = SurfelMap((4.0,), capacity=1000)
    surfaces.add(wall())
    before = surfaces.match(np.array([[2.0, 0.5, 0.5]])).distances
    surfaces.add(wall(2.3))
    np.testing.assert_array_equal(surfaces.match(np.array([[2.0, 0.5, 0.5]])).distances, before)


def test_far_cells_are_forgotten_and_the_rest_stays() -> None:
    surfaces = SurfelMap((0.25,))
    surfaces.add(wall(2.12))
    surfaces.add(wall(52.12))
    count = len(surfaces)
    surfaces.forget(np.zeros(3), 10.0)
    assert 0 < len(surfaces) < count
    assert len(surfaces.match(np.array([[2.12, 0.1, 1.1], [52.12, 0.1, 1.1]])).index) == 1
    surfaces.add(wall(52.12))
    assert len(surfaces) == count


def test_cells_out_of_sight_are_forgotten_and_full_ones_in_sight_stay() -> None:
    surfaces = SurfelMap((0.25,), capacity=10)
    places = np.array([[2.12, 0.1, 1.1], [5.12, 0.1, 1.1]])
    surfaces.add(np.concatenate((wall(2.12), wall(5.12))), 0)
    surfaces.add(wall(2.12), 7)  # full already: not fitted again, but seen
    surfaces.forget(np.zeros(3), 10.0, 7)
    assert surfaces.match(places).index.tolist() == [0]
    surfaces.forget(np.zeros(3), 10.0, 8)
    assert not len(surfaces)


def test_what_was_left_behind_a_long_way_ago_is_forgotten_however_near_it_is() -> None:
    """Around a block and back: the beginning of the lap has drifted away from the present."""
    matcher = SweepMatcher(OdometryConfig(), np.zeros(3))
    predictor = Predictor(OdometryConfig(), np.eye(4))
    predictor.imu(Motion().imu(0, 40))
    start = EPOCH
    state = InertialState(start, np.eye(3), *np.zeros((5, 3)))
    motion = predictor.over(state, np.eye(ERRORS) * 1e-4, (start, HostNs(EPOCH + 10**8)), start)

    def seen_from(place: float, x: float) -> None:
        """Extend the map with a wall across x, seen from a place on the x axis."""
        at = dataclasses.replace(state, position=np.array([place, 0.0, 0.0]))
        points = np.zeros(4000, [(axis, "<f4") for axis in "xyz"])
        points["x"], points["y"], points["z"] = (wall(x) - at.position).T
        matcher.extend(points, dataclasses.replace(motion, state=at), at)

    seen_from(0.0, 3.0)
    for place in np.arange(1.0, 14.0):  # there,
        seen_from(float(place), 13.0)
    for place in np.arange(12.0, -1.0, -1.0):  # and back
        seen_from(float(place), -4.0)
    probe = np.array([[3.0, 0.1, 1.1], [13.0, 0.1, 1.1]])
    assert matcher.surfaces.match(probe).index.tolist() == [0, 1]  # 26 m
    for place in np.arange(1.0, 8.0):
        seen_from(float(place), 13.0)
    assert matcher.surfaces.match(probe).index.tolist() == [1]


def test_noise_is_a_density_and_more_than_the_parameter_where_more_shows() -> None:
    """White noise of a standard deviation s in samples 4 ms apart has the density 2 s sqrt(ms)."""
    predictor = Predictor(OdometryConfig(), np.eye(4))
    settings = OdometryConfig().inertial
    samples = Motion().imu(0, 40)
    quiet = predictor._noise(samples)
    assert quiet.gyro == pytest.approx(settings.gyro_noise * np.sqrt(0.004))
    assert quiet.accel == pytest.approx(settings.accel_noise * np.sqrt(0.004))
    rng = np.random.default_rng(0)
    samples["angular_velocity"] += rng.normal(0.0, 0.3, (len(samples), 3))
    samples["linear_acceleration"] += rng.normal(0.0, 0.7, (len(samples), 3))
    loud = predictor._noise(samples)
    assert loud.gyro == pytest.approx(0.3 * np.sqrt(0.004), rel=0.05)
    assert loud.accel == pytest.approx(0.7 * np.sqrt(0.004), rel=0.05)


def test_trajectory_files_keep_nanoseconds() -> None:
    pose = np.eye(4)
    pose[:3, 3] = [1.0, -2.0, 0.5]
    trajectory = Trajectory()
    for index in range(300):
        trajectory.append(HostNs(1_700_000_000_123_456_789 + index), pose)
    text = tum(trajectory.poses[:1])
    assert text.split() == [
        "1700000000.123456789", "1.000000000", "-2.000000000", "0.500000000",
        "0.000000000", "0.000000000", "0.000000000", "1.000000000",
    ]  # fmt: skip
    rows = np.array(kitti(trajectory.poses).split(), dtype=float)
    np.testing.assert_array_equal(rows.reshape(-1, 3, 4), np.tile(pose[:3], (300, 1, 1)))
    assert tum(trajectory.poses[-1:]).startswith("1700000000.123457088 ")


def test_the_start_keeps_roll_and_pitch_only() -> None:
    pose = np.eye(4)
    pose[:3, :3] = rotations.matrices(
        rotations.multiply(rotations.exp((0.0, 0.0, 1.0)), rotations.exp((0.1, 0.0, 0.0)))
    )
    pose[:3, 3] = [3.0, 2.0, 1.0]
    begun = levelled_start(pose) @ pose
    np.testing.assert_allclose(begun[:3, 3], 0.0, atol=1e-12)
    np.testing.assert_allclose(
        begun[:3, :3], rotations.matrices(rotations.exp((0.1, 0.0, 0.0))), atol=1e-12
    )


def test_base_frame_moves_with_the_arm() -> None:
    T_lidar_base = np.eye(4)
    T_lidar_base[:3, 3] = [-1.0, 0.0, 0.0]
    base = BaseFrame(T_lidar_base)
    np.testing.assert_allclose(base.pose(np.eye(4)), np.eye(4), atol=1e-12)
    turned = np.eye(4)
    turned[:3, :3] = rotations.matrices(rotations.exp((0.0, 0.0, np.pi / 2)))
    np.testing.assert_allclose(base.pose(turned)[:3, 3], [1.0, -1.0, 0.0], atol=1e-12)


def test_thinning_keeps_one_point_per_voxel_and_says_which() -> None:
    points = wall()
    kept = thinned_indices(points, 0.5)
    assert len(set(kept.tolist())) == len(kept)
    cells = {tuple(cell) for cell in np.floor(points / 0.5).astype(int).tolist()}
    assert len(kept) == len(cells)


def test_thinning_keeps_the_points_that_kiss_icp_keeps() -> None:
    points = np.random.default_rng(RNG_SEED).uniform(-9.0, 9.0, (5000, 3))
    points = np.concatenate((points, points[::3] + 0.01))
    kept = points[thinned_indices(points, 0.4)]
    expected = np.asarray(voxel_down_sample(points, 0.4))
    assert {tuple(point) for point in kept.tolist()} == {tuple(p) for p in expected.tolist()}


def test_thinning_of_a_wall_at_one_x_names_every_point_it_keeps() -> None:
    rng = np.random.default_rng(RNG_SEED)
    points = rng.uniform((2.0, -3.0, 0.0), (2.0, 3.0, 3.0), (4000, 3))
    kept = thinned_indices(points, 0.2)
    cells = np.floor(points / 0.2).astype(int)
    assert len(kept) == len({tuple(cell) for cell in cells.tolist()})
    assert len({tuple(cell) for cell in cells[kept].tolist()}) == len(kept)


@pytest.mark.parametrize("count", [0, 1, 2, 11])
def test_plain_mode_survives_what_aborts_kiss_icp(count: int) -> None:
    """Without the guards the process ends here, and all tests with it."""
    run = recording("room", "still", 3.0)
    whole = next(iter(sweeps(run, "turn")))
    odometry = PlainOdometry(OdometryConfig(mode="plain"))
    odometry.register(whole)
    points = whole.points[:count].copy()
    points["time"] = 0.1
    later = Sweep(HostNs(whole.start + 10**9), HostNs(whole.end + 10**9), points, 0, 0)
    (estimate,) = odometry.register(later)
    assert (Status.SPARSE in estimate.status) == (count < 10)
    assert np.isfinite(estimate.T_map_lidar).all()


def test_plain_mode_leaves_out_points_with_their_times() -> None:
    points = np.zeros(100, POINT)
    points["x"], points["time"] = np.linspace(1, 5, 100), np.linspace(0, 0.2, 100)
    points["y"][::7] = np.nan
    odometry = PlainOdometry(OdometryConfig(mode="plain"))
    (estimate,) = odometry.register(Sweep(at(0), at(0.2), points, 0, 0))
    assert len(estimate.points) == np.isfinite(points["y"]).sum()


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"surface_sizes": ()}, "surface_sizes"),
        ({"surface_sizes": (1.0, 0.2)}, "surface_sizes"),
        ({"min_range": 5.0, "max_range": 1.0}, "min_range"),
        ({"base_frame": "/base link"}, "base_frame"),
        ({"odom_frame": ""}, "odom_frame"),
        ({"base_frame": "odom"}, "odom_frame"),
        ({"odometry_topic": "my odometry"}, "odometry_topic"),
    ],
)
def test_settings_that_cannot_work_are_refused_by_name(values: Any, name: str) -> None:
    with pytest.raises(SettingError, match=f"parameter '{name}': .*expected"):
        build(OdometryNodeConfig, values)


def test_settings_refuse_what_cannot_be() -> None:
    with pytest.raises(SettingError, match="map_file"):
        build(OdometryNodeConfig, {"map_file": "map.txt"})
    with pytest.raises(SettingError, match="did you mean 'base_frame'"):
        build(OdometryNodeConfig, {"base_fram": "x"})
    with pytest.raises(SettingError, match="imu_xyz"):
        build(OdometryNodeConfig, {"imu_xyz": (1.0,)})
