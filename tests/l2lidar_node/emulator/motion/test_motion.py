"""Motions: derivatives against differences, rests and holds, mounts, files, and room to move."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

from l2lidar_node import rotations
from l2lidar_node.emulator import truth
from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.motion.motion import (
    MOUNTS,
    Motion,
    PoseSpline,
    from_tum,
    mount_quaternion,
    rpy_quaternions,
)
from l2lidar_node.emulator.world import scenes
from l2lidar_node.emulator.world.world import World
from l2lidar_node.recording import tum
from l2lidar_node.types import STANDARD_GRAVITY

ROOM = scenes.make("room")


def rotation(quaternions_wxyz: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.roll(quaternions_wxyz, -1, axis=-1))


def lap_of(motion: Motion) -> float:
    """Return a time by which the motion has been everywhere."""
    return motion.rest_s + motion.ramp_s + motion.lap_s


def loop_file(folder: Path, count: int = 200) -> Path:
    t = np.linspace(0.0, 10.0, count)
    positions = np.stack([np.cos(0.4 * t), np.sin(0.5 * t), 1.0 + 0.1 * np.sin(t)], axis=1)
    rpy = np.stack([0.2 * np.sin(t), 0.1 * np.cos(2 * t), 0.8 * t], axis=1)
    stamps = 1_700_000_000_123_456_789 + np.round(t * 1e9).astype(np.int64)
    path = folder / "loop.tum"
    path.write_text(tum.render(tum.pose_array(stamps, positions, rpy_quaternions(rpy))))
    return path


@pytest.mark.parametrize("name", trajectories.MOTIONS)
@pytest.mark.parametrize("mount", ["upright", "forward"])
def test_derivatives_agree_with_differences(name: str, mount: str) -> None:
    motion = trajectories.make(name, ROOM, mount=mount, rest_s=0.5)
    t = np.linspace(0.2, 6.0, 300)
    h = 1e-4
    here = motion.kinematics(t)
    (p0, q0), (p1, q1) = motion.poses(t - h), motion.poses(t + h)
    before, after = motion.kinematics(t - h), motion.kinematics(t + h)

    scale = max(1.0, float(np.abs(here.acceleration).max()))
    np.testing.assert_allclose(here.velocity, (p1 - p0) / (2 * h), atol=2e-5 * scale)
    np.testing.assert_allclose(
        here.acceleration, (after.velocity - before.velocity) / (2 * h), atol=2e-3 * scale
    )
    turned = (rotation(q0).inv() * rotation(q1)).as_rotvec() / (2 * h)
    np.testing.assert_allclose(here.angular_velocity, turned, atol=2e-4)
    np.testing.assert_allclose(
        here.angular_acceleration,
        (after.angular_velocity - before.angular_velocity) / (2 * h),
        atol=2e-3 * max(1.0, float(np.abs(here.angular_acceleration).max())),
    )


@pytest.mark.parametrize("name", trajectories.MOTIONS)
def test_a_motion_begins_with_a_rest_and_speeds_up_smoothly(name: str) -> None:
    motion = trajectories.make(name, ROOM, rest_s=2.0)
    positions, quaternions = motion.poses(np.array([-3.0, 0.0, 1.0, 2.0]))
    np.testing.assert_array_equal(positions, np.tile(positions[0], (4, 1)))
    np.testing.assert_array_equal(quaternions, np.tile(quaternions[0], (4, 1)))
    starting = motion.kinematics(np.arange(1.9, 3.6, 0.001))
    moving = motion.kinematics(np.arange(4.0, 20.0, 0.001))
    for field in ("velocity", "acceleration", "angular_velocity", "angular_acceleration"):
        jump, usual = (
            np.abs(np.diff(getattr(k, field), axis=0)).max() for k in (starting, moving)
        )
        assert jump <= 1.5 * usual + 0.01, field


@pytest.mark.parametrize("name", ["spin", "walk", "trot", "drone"])
def test_a_lap_closes_without_a_seam(name: str) -> None:
    motion = trajectories.make(name, ROOM)
    begin = motion.rest_s + motion.ramp_s / 2 + motion.lap_s
    around = motion.kinematics(begin + np.linspace(-2e-3, 2e-3, 41))

    for values in (around.velocity, around.acceleration, around.angular_velocity):
        steps = np.abs(np.diff(values, axis=0)).max(axis=1)
        assert steps[19:21].max() <= 3 * np.median(steps) + 1e-9


@pytest.mark.parametrize(
    ("name", "speed"), [("walk", 0.35), ("walk", 1.2), ("trot", 0.8), ("drone", 2.0)]
)
def test_the_asked_speed_is_kept(name: str, speed: float) -> None:
    motion = trajectories.make(name, ROOM, speed=speed)
    moving = motion.kinematics(np.arange(4.0, lap_of(motion), 0.01))

    assert np.linalg.norm(moving.velocity, axis=1).mean() == pytest.approx(speed, rel=0.08)


def test_spin_turns_at_its_rate_about_a_near_axis() -> None:
    motion = trajectories.make("spin", ROOM, speed=3.0)
    moving = motion.kinematics(np.arange(4.0, 8.0, 0.01))

    np.testing.assert_allclose(moving.angular_velocity, np.tile([0, 0, 3.0], (400, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(moving.velocity, axis=1), 0.12, atol=1e-6)


@pytest.mark.parametrize("scene_name", list(scenes.SCENES))
def test_no_motion_collides_with_a_scene(scene_name: str) -> None:
    pytest.importorskip("open3d")
    scene = scenes.make(scene_name)
    world = World(scene.triangles)
    for name in trajectories.MOTIONS:
        for seed in (0, 1):
            motion = trajectories.make(name, scene, seed=seed)
            positions, _ = motion.poses(np.arange(0.0, lap_of(motion), 0.1))
            assert world.clearance(positions).min() > 0.2, (name, seed)


def test_another_seed_is_another_walk() -> None:
    t = np.array([10.0])

    assert not np.allclose(
        trajectories.make("walk", ROOM, seed=1).poses(t)[0],
        trajectories.make("walk", ROOM, seed=2).poses(t)[0],
    )


@pytest.mark.parametrize(
    ("name", "speed", "message"), [("crawl", 0.0, "crawl.*walk"), ("walk", -1.0, "out of range")]
)
def test_bad_requests_are_refused(name: str, speed: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        trajectories.make(name, ROOM, speed=speed)


@pytest.mark.parametrize(
    ("mount", "up"),
    [
        ("upright", (0, 0, 1)),
        ("forward", (1, 0, 0)),
        ("upside_down", (0, 0, -1)),
        ("tilted", (-0.5, 0, np.sqrt(0.75))),
        ((0.0, np.pi / 2, 0.0), (-1, 0, 0)),
        ((np.pi / 2, 0.0, 0.0), (0, 1, 0)),
    ],
)
def test_a_mount_turns_gravity_in_the_cloud_frame(
    mount: str | tuple[float, float, float], up: tuple[float, float, float]
) -> None:
    motion = trajectories.make("still", ROOM, mount=mount)

    force = motion.kinematics(np.zeros(1)).specific_force()[0]

    np.testing.assert_allclose(force, STANDARD_GRAVITY * np.array(up), atol=1e-9)


def test_the_forward_mount_looks_ahead() -> None:
    matrix = rotations.matrices(np.array([mount_quaternion("forward")]))[0]

    np.testing.assert_allclose(matrix @ [0, 0, 1], [1, 0, 0], atol=1e-12)


def test_a_mount_changes_the_orientation_but_not_the_place() -> None:
    t = np.arange(3.0, 9.0, 0.1)
    plain, mounted = (
        trajectories.make("walk", ROOM),
        trajectories.make("walk", ROOM, mount=(0.3, -0.4, 1.1)),
    )

    np.testing.assert_allclose(plain.poses(t)[0], mounted.poses(t)[0], atol=1e-12)
    expected = rotation(plain.poses(t)[1]) * Rotation.from_euler("ZYX", [1.1, -0.4, 0.3])
    difference = (expected.inv() * rotation(mounted.poses(t)[1])).magnitude()
    assert difference.max() < 1e-9


def test_an_unknown_mount_is_refused() -> None:
    with pytest.raises(ValueError, match=r"'sideways'.*upside_down"):
        mount_quaternion("sideways")
    assert set(MOUNTS) == {"upright", "forward", "tilted", "upside_down"}


def test_quaternion_products_and_matrices_agree_with_scipy() -> None:
    rng = np.random.default_rng(3)
    p, q = rotation(rng.normal(size=(20, 4))), rotation(rng.normal(size=(20, 4)))
    product = rotations.multiply(
        np.roll(p.as_quat(), 1, axis=-1), np.roll(q.as_quat(), 1, axis=-1)
    )

    np.testing.assert_allclose(rotations.matrices(product), (p * q).as_matrix(), atol=1e-12)


def test_a_file_is_followed_from_the_end_of_the_rest(tmp_path: Path) -> None:
    path = loop_file(tmp_path)
    poses = tum.load(path)
    seconds = (poses["stamp"] - poses["stamp"][0]) * 1e-9

    positions, quaternions = from_tum(path, rest_s=0.0).poses(seconds)

    np.testing.assert_allclose(positions, poses["position"], atol=1e-9)
    same = np.abs(np.sum(quaternions * poses["quaternion_wxyz"], axis=1))
    np.testing.assert_allclose(same, 1.0, atol=1e-12)


def test_between_the_lines_of_a_file_the_motion_is_smooth(tmp_path: Path) -> None:
    motion = from_tum(loop_file(tmp_path), rest_s=0.0)
    t = np.linspace(1.0, 9.0, 1000)

    moving = motion.kinematics(t)

    expected = np.stack(
        [-0.16 * np.cos(0.4 * t), -0.25 * np.sin(0.5 * t), -0.1 * np.sin(t)], axis=1
    )
    np.testing.assert_allclose(moving.acceleration, expected, atol=2e-3)


def test_a_file_ends_in_a_smooth_hold(tmp_path: Path) -> None:
    path = loop_file(tmp_path)
    motion = from_tum(path, rest_s=1.0)
    last = tum.load(path)[-1]
    end = motion.duration_s

    assert end == pytest.approx(1.0 + 10.0 + motion.ramp_s)
    held = motion.kinematics(np.array([end, end + 5.0]))
    np.testing.assert_allclose(held.position, np.tile(last["position"], (2, 1)), atol=1e-9)
    np.testing.assert_allclose(held.velocity, 0.0, atol=1e-12)
    slowing = motion.kinematics(np.arange(end - 2.0, end + 0.5, 0.001))
    assert np.abs(np.diff(slowing.acceleration, axis=0)).max() < 0.01


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "0 poses"),
        ("# nothing\n\n", "0 poses"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n", "3 poses"),
        ("0 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", "line 2.*not later"),
        ("1 0 0 0 0 0 0 1\n0.5 0 0 0 0 0 0 1\n", "line 2.*not later"),
        ("0 0 0 0 0 0 1\n", "line 1.*found 7"),
        ("0 0 0 zero 0 0 0 1\n", "line 1.*not a number"),
        ("0 0 0 nan 0 0 0 1\n", "line 1.*not finite"),
        ("0 0 0 0 0 0 0 0\n", "line 1.*norm"),
        ("1e300 0 0 0 0 0 0 1\n", "line 1.*not a number"),
        ("inf 0 0 0 0 0 0 1\n", "line 1.*not a number"),
    ],
)
def test_a_bad_file_is_named_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.tum"
    path.write_text(text)

    with pytest.raises(ValueError, match=rf"bad\.tum.*{message}"):
        from_tum(path)


def test_a_file_that_is_no_text_is_named(tmp_path: Path) -> None:
    path = tmp_path / "bad.tum"
    path.write_bytes(b"\xff\xfe\x00\x80" * 20)

    for wrong in (path, tmp_path / "gone.tum", tmp_path):
        with pytest.raises(ValueError, match=str(wrong)):
            from_tum(wrong)


@given(
    st.lists(
        st.tuples(
            st.integers(-(10**18), 2 * 10**18),
            st.tuples(*[st.floats(-1e4, 1e4)] * 3),
            st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
        ),
        max_size=8,
        unique_by=lambda row: row[0],
    )
)
def test_what_is_written_is_read_back(rows: list[tuple[int, tuple[float], tuple[float]]]) -> None:
    rows.sort()
    stamps = np.array([row[0] for row in rows], np.int64)
    positions = np.array([row[1] for row in rows], float).reshape(-1, 3)
    quaternions = np.array([row[2] for row in rows], float).reshape(-1, 4)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    poses = tum.pose_array(stamps, positions, quaternions)

    read = tum.parse(tum.render(poses))

    np.testing.assert_array_equal(read["stamp"], stamps)
    np.testing.assert_allclose(read["position"], positions, atol=1e-9)
    np.testing.assert_allclose(read["quaternion_wxyz"], quaternions, atol=3e-9)


@given(st.text(alphabet="0123456789.+-eE #naif\t\n", max_size=200))
def test_any_text_is_parsed_or_refused(text: str) -> None:
    try:
        poses = tum.parse(text)
    except tum.TrajectoryError:
        return
    assert (np.diff(poses["stamp"]) > 0).all()
    assert np.isfinite(poses["position"]).all()


def test_the_true_trajectory_is_written_in_host_time(tmp_path: Path) -> None:
    motion = trajectories.make("trot", ROOM)
    t = np.arange(0.0, 6.0, 0.01)
    origin = 1_750_000_000_000_000_001
    path = tmp_path / "truth.tum"

    truth.write_tum(path, motion, t, origin)

    read = tum.load(path)
    np.testing.assert_array_equal(read["stamp"], origin + np.round(t * 1e9).astype(np.int64))
    positions, quaternions = motion.poses(t)
    np.testing.assert_allclose(read["position"], positions, atol=1e-9)
    np.testing.assert_allclose(read["quaternion_wxyz"], quaternions, atol=3e-9)


def test_a_periodic_curve_of_one_turn_stays_smooth() -> None:
    t = np.linspace(0.0, 2.0, 41)
    yaw = np.pi * t  # the quaternion's sign flips after one turn
    curve = PoseSpline(
        t,
        np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)]),
        rpy_quaternions(np.column_stack([0 * yaw, 0 * yaw, yaw])),
        periodic=True,
        degree=5,
    )

    rates = curve.derivatives(np.linspace(-3.0, 9.0, 500)).angular_velocity

    np.testing.assert_allclose(rates[:, 2], np.pi, atol=1e-4)


@pytest.mark.parametrize("degree", [3, 5])
def test_rates_are_exact_even_where_knots_are_far_apart(degree: int) -> None:
    rng = np.random.default_rng(2)
    knots = np.arange(12.0)
    turns = [Rotation.identity()]
    for step in rng.normal(0.0, 0.7, (11, 3)):  # 70 degrees from knot to knot
        turns.append(turns[-1] * Rotation.from_rotvec(step))
    quaternions = np.roll(Rotation.concatenate(turns).as_quat(), 1, axis=-1)
    curve = PoseSpline(knots, rng.normal(size=(12, 3)), quaternions, degree=degree)
    u, h = np.linspace(0.3, 10.7, 200), 1e-5

    here = curve.derivatives(u)

    before, after = curve.derivatives(u - h), curve.derivatives(u + h)
    turned = rotation(before.quaternion_wxyz).inv() * rotation(after.quaternion_wxyz)
    np.testing.assert_allclose(here.angular_velocity, turned.as_rotvec() / (2 * h), atol=1e-6)
    change = (after.angular_velocity - before.angular_velocity) / (2 * h)
    np.testing.assert_allclose(here.angular_acceleration, change, atol=1e-5)
    met = curve.poses(knots)[1]
    np.testing.assert_allclose(np.abs(np.sum(met * quaternions, axis=1)), 1.0, atol=1e-12)
