"""Packets decoded by a scalar transcription of the protocol, and the measured statistics."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.motion.motion import Motion
from l2lidar_node.emulator.truth import into_cloud
from l2lidar_node.emulator.unit.returns import RangeNoise, noise_sigma
from l2lidar_node.emulator.unit.scanner import TWO_D_PERIOD_S, Scan, Scanner
from l2lidar_node.emulator.unit.units import UNITS
from l2lidar_node.emulator.world import scenes
from l2lidar_node.emulator.world.scene import box
from l2lidar_node.emulator.world.world import World
from l2lidar_node.protocol import wire

pytest.importorskip("open3d")

ROOM = scenes.make("room")
ROOM_WORLD = World(ROOM.triangles, ROOM.reflectivity)
CLEAN = RangeNoise.clean()
HALF_STEP_M = 0.000978 / 2


def still() -> Motion:
    return trajectories.make("still", scenes.make("box"), rest_s=0.0)


def scanner(motion: str = "walk", noise: RangeNoise = CLEAN, **more: Any) -> Scanner:
    return Scanner(ROOM_WORLD, trajectories.make(motion, ROOM), noise=noise, **more)


def decode_3d(packet: np.void, j: int) -> tuple[float, float, float]:
    """Protocol section 8, one point, in doubles."""
    c = packet["calibration"]
    d = float(c["range_scale"]) * (int(packet["ranges"][j]) + float(c["range_bias"]))
    alpha = (
        float(packet["angle_min"])
        + float(c["alpha_angle_bias"])
        + j * float(packet["angle_increment"])
    )
    theta = (
        float(packet["com_horizontal_angle_start"])
        + float(c["theta_angle_bias"])
        + j * float(packet["com_horizontal_angle_step"])
    )
    beta, xi = float(c["beta_angle"]), float(c["xi_angle"])
    a = (-math.cos(beta) * math.sin(xi) + math.sin(beta) * math.cos(xi) * math.sin(alpha)) * d
    a += float(c["b_axis_dist"])
    b = math.cos(alpha) * math.cos(xi) * d
    z = (math.sin(beta) * math.sin(xi) + math.cos(beta) * math.cos(xi) * math.sin(alpha)) * d
    return (
        math.cos(theta) * a - math.sin(theta) * b,
        math.sin(theta) * a + math.cos(theta) * b,
        z + float(c["a_axis_dist"]),
    )


@pytest.mark.parametrize("unit", list(UNITS))
@pytest.mark.parametrize(("motion", "wide_fov"), [("walk", False), ("drone", True)])
def test_decoded_packets_are_the_world_seen_from_the_moving_sensor(
    unit: str, motion: str, wide_fov: bool
) -> None:
    device = scanner(motion, unit=UNITS[unit])
    scan = device.scan(1000, 3, wide_fov=wide_fov)

    for p, packet in enumerate(scan.packets):
        for j in range(0, 300, 7):
            t = scan.times_s[p] + j * float(packet["time_increment"])
            expected = into_cloud(scan.hits[p, j], device.motion, t)
            found = np.array(decode_3d(packet, j))
            assert np.linalg.norm(found - expected) < HALF_STEP_M + 1e-9
            # across the beam there is no rounding at all
            axis = np.array(decode_3d(_with_range(packet, j, 60_000), j)) - found
            axis /= np.linalg.norm(axis)
            assert np.linalg.norm(np.cross(found - expected, axis)) < 1e-9


def _with_range(packet: np.void, j: int, raw: int) -> np.void:
    changed = packet.copy()
    changed["ranges"][j] = raw
    return changed


def test_hits_lie_on_the_walls_of_a_box() -> None:
    scene = scenes.make("box")
    motion = trajectories.make("trot", scene)
    scan = Scanner(World(scene.triangles), motion, noise=CLEAN).scan(900, 20)

    gap = np.abs(np.stack([np.abs(scan.hits[..., 0]) - 3.0, np.abs(scan.hits[..., 1]) - 2.5,
                           scan.hits[..., 2], scan.hits[..., 2] - 3.0])).min(axis=0)  # fmt: skip

    assert gap.max() < 1e-9


def test_measured_is_what_the_packet_decodes_to() -> None:
    scan = scanner(noise=RangeNoise()).scan(500, 4)
    c = scan.packets["calibration"][0]
    raw = scan.packets["ranges"].astype(float)

    expected = np.where(raw > 0, float(c["range_scale"]) * (raw + float(c["range_bias"])), 0.0)

    np.testing.assert_allclose(scan.rays["measured"], expected, atol=1e-12)
    np.testing.assert_array_equal(np.isnan(scan.measured_points[..., 0]), ~scan.returned)


def test_2d_packets_decode_in_the_y_z_plane() -> None:
    device = scanner("walk")
    scan = device.scan_2d(200, 2)

    assert scan.packets.dtype == wire.POINTS_2D_PAYLOAD
    for p, packet in enumerate(scan.packets):
        c = packet["calibration"]
        for j in range(0, 1800, 97):
            d = float(c["range_scale"]) * (int(packet["ranges"][j]) + float(c["range_bias"]))
            alpha = (
                float(packet["angle_min"])
                + float(c["alpha_angle_bias"])
                + j * float(packet["angle_increment"])
            )
            found = [0.0, math.cos(alpha) * d, math.sin(alpha) * d + float(c["a_axis_dist"])]
            t = scan.times_s[p] + j * float(packet["time_increment"])
            expected = into_cloud(scan.hits[p, j], device.motion, t)
            assert np.linalg.norm(found - expected) < HALF_STEP_M + 1e-9
    assert np.diff(scan.times_s)[0] == pytest.approx(TWO_D_PERIOD_S)
    assert (scan.packets["point_num"] == 1800).all()
    assert (scan.packets["info"]["payload_size"] == 5512).all()


def test_fields_are_those_of_a_real_unit() -> None:
    packets, times = scanner(noise=RangeNoise()).packets(100, 60)

    np.testing.assert_allclose(np.diff(times), 0.004639, rtol=1e-9)
    assert (packets["info"]["payload_size"] == 1020).all()
    assert (packets["point_num"] == 300).all()
    np.testing.assert_allclose(packets["scan_period"], 0.004639, rtol=1e-6)
    np.testing.assert_allclose(packets["time_increment"], 0.004639 / 600, rtol=1e-6)
    np.testing.assert_allclose(packets["angle_increment"], np.pi / 300, rtol=1e-6)
    np.testing.assert_array_equal(packets["angle_min"], 0)
    np.testing.assert_allclose(packets["com_horizontal_angle_step"], 2.114e-4, rtol=0.006)
    np.testing.assert_allclose(packets["range_min"], 0.05)
    np.testing.assert_allclose(packets["range_max"], 50.0)
    np.testing.assert_allclose(packets["calibration"]["range_bias"], -365.625)
    state = packets["state"]
    assert (state["sys_rotation_period"] == 4639).all()
    assert np.abs(state["com_rotation_period"] / 229769 - 1.0).max() < 0.0031
    assert 0 < state["com_rotation_period"].std() / 229769 < 0.002
    assert 30 < state["apd_temperature"].mean() < 50
    assert 150 < state["apd_voltage"].mean() < 158


@pytest.mark.parametrize(("unit", "per_turn"), [("a", 49.53), ("fast", 38.84)])
def test_the_head_turns_at_the_units_speed(unit: str, per_turn: float) -> None:
    packets, _ = scanner("still", RangeNoise(), unit=UNITS[unit]).packets(0, 600)
    start = packets["com_horizontal_angle_start"].astype(float)

    assert start.min() >= 0
    assert start.max() < 2 * np.pi
    advance = np.mod(np.diff(start), 2 * np.pi)
    assert 2 * np.pi / advance.mean() == pytest.approx(per_turn, rel=0.002)


def test_the_head_wobbles_as_measured() -> None:
    packets, _ = scanner("still", RangeNoise()).packets(0, 1500)
    start = packets["com_horizontal_angle_start"].astype(float)
    advance = np.rad2deg(np.mod(np.diff(start), 2 * np.pi))
    waves = np.column_stack([np.ones(1499), np.sin(start[:-1]), np.cos(start[:-1])])

    fit, *_ = np.linalg.lstsq(waves, advance, rcond=None)

    assert fit[0] == pytest.approx(7.27, abs=0.02)
    assert np.hypot(fit[1], fit[2]) == pytest.approx(0.20, abs=0.02)
    assert (advance - waves @ fit).std() == pytest.approx(0.087, abs=0.008)


def test_a_steady_head_has_no_wobble() -> None:
    packets, _ = scanner("still", CLEAN).packets(0, 200)
    advance = np.mod(np.diff(packets["com_horizontal_angle_start"].astype(float)), 2 * np.pi)

    np.testing.assert_allclose(advance, 2 * np.pi * 0.004639 / 0.229769, atol=1e-6)


@pytest.mark.parametrize("mode", ["scan", "scan_2d"])
def test_a_packet_depends_on_its_number_and_the_seed_alone(mode: str) -> None:
    noise = RangeNoise()
    whole = getattr(scanner(noise=noise, seed=5), mode)(70, 8)
    other = scanner(noise=noise, seed=5)
    parts = [getattr(other, mode)(first, count) for first, count in ((77, 1), (70, 1), (71, 6))]
    again = [parts[1], parts[2], parts[0]]

    assert whole.packets.tobytes() == b"".join(part.packets.tobytes() for part in again)
    np.testing.assert_array_equal(whole.rays, np.concatenate([part.rays for part in again]))
    np.testing.assert_array_equal(whole.times_s, np.concatenate([part.times_s for part in again]))
    assert (
        whole.packets.tobytes()
        != getattr(scanner(noise=noise, seed=6), mode)(70, 8).packets.tobytes()
    )


def test_clean_ranges_are_exact_but_for_the_raw_counts_step() -> None:
    scan = scanner("trot").scan(800, 50)

    assert scan.returned.all()
    error = scan.rays["measured"] - scan.rays["distance"]
    assert np.abs(error).max() <= HALF_STEP_M + 1e-6
    assert error.std() == pytest.approx(0.000978 / np.sqrt(12), rel=0.05)


@pytest.mark.parametrize(
    ("half_width", "low", "high", "sigma"),
    [(3.0, 2.0, 6.0, 0.0115), (12.5, 10.0, 15.0, 0.017), (19.0, 15.0, 25.0, 0.0265)],
)
def test_range_noise_is_as_measured(
    half_width: float, low: float, high: float, sigma: float
) -> None:
    world = World(box((-half_width,) * 3, (half_width,) * 3), 0.9)
    noise = RangeNoise(dropout=0.0, divergence_mrad=0.0, weak_signal=False)
    scan = Scanner(world, still(), noise=noise).scan(0, 150)
    chosen = scan.returned & (scan.rays["distance"] > low) & (scan.rays["distance"] < high)
    error = (scan.rays["measured"] - scan.rays["distance"])[chosen]

    assert chosen.sum() > 10_000
    assert abs(error.mean()) < 0.0008
    assert error.std() == pytest.approx(sigma, rel=0.12)
    normalised = error / noise_sigma(scan.rays["distance"][chosen])
    assert normalised.std() == pytest.approx(1.0, abs=0.03)


def test_range_noise_scales() -> None:
    noise = RangeNoise(dropout=0.0, divergence_mrad=0.0, weak_signal=False, range_noise=3.0)
    scan = scanner("still", noise).scan(0, 50)
    error = (scan.rays["measured"] - scan.rays["distance"]) / noise_sigma(scan.rays["distance"])

    assert error.std() == pytest.approx(3.0, rel=0.05)


def test_dropouts_indoors_are_as_measured() -> None:
    scan = scanner("walk", RangeNoise()).scan(1000, 400)
    lost = ~scan.returned
    assert 0.03 < lost.mean() < 0.06

    edges = np.diff(np.pad(lost.astype(int), ((0, 0), (1, 1))), axis=1)
    length = np.flatnonzero(edges.ravel() == -1) - np.flatnonzero(edges.ravel() == 1)
    runs = length[length > 1]
    assert 3 <= np.median(runs) <= 7
    assert 0.7 < (length == 1).sum() / 400 < 3.0


def test_dropouts_scale_and_switch_off() -> None:
    none, double = (
        (
            ~scanner("still", RangeNoise(dropout=rate, weak_signal=False)).scan(0, 200).returned
        ).mean()
        for rate in (0.0, 2.0)
    )

    assert none == 0
    assert double == pytest.approx(0.07, abs=0.012)


def test_switching_one_effect_leaves_the_others_draws_alone() -> None:
    full = scanner("still", RangeNoise()).scan(0, 20)
    kept = scanner("still", RangeNoise(dropout=0.0)).scan(0, 20)

    both = full.returned & kept.returned
    assert both.sum() > 5000
    np.testing.assert_array_equal(full.packets["ranges"][both], kept.packets["ranges"][both])


def test_dark_and_distant_surfaces_do_not_return() -> None:
    noise = RangeNoise(dropout=0.0, divergence_mrad=0.0)
    share = {}
    for reflectivity, half_width in ((0.9, 12.0), (0.1, 5.0), (0.1, 18.0), (0.9, 45.0)):
        world = World(box((-half_width,) * 3, (half_width,) * 3), reflectivity)
        share[reflectivity, half_width] = (
            Scanner(world, still(), noise=noise).scan(0, 30).returned.mean()
        )

    assert share[0.9, 12.0] > 0.99
    assert share[0.1, 5.0] > 0.97
    assert share[0.1, 18.0] < 0.05
    assert share[0.9, 45.0] < 0.2


def test_nothing_returns_from_the_sky() -> None:
    scene = scenes.make("yard")
    motion = trajectories.make("walk", scene)
    scan = Scanner(World(scene.triangles, scene.reflectivity), motion).scan(800, 50)

    sky = np.isinf(scan.rays["distance"])
    assert 0.3 < sky.mean() < 0.95
    assert scan.returned[sky].mean() < 0.05  # only where the beam's edge meets a leaf
    assert np.isnan(scan.hits[sky]).all()


def test_limits_of_range_are_kept() -> None:
    noise = RangeNoise(dropout=0.0, weak_signal=False)
    wide = Scanner(World(box((-55.0,) * 3, (55.0,) * 3)), still(), noise=noise).scan(0, 5)
    tight = Scanner(World(box((0.36, 0.26, 1.0), (0.44, 0.34, 1.09))), still(), noise=noise).scan(
        0, 5
    )

    assert not wide.returned.any()
    measured = tight.rays["measured"][tight.returned]
    assert (tight.rays["distance"] < 0.05).any()
    assert measured.size == 0 or measured.min() >= 0.05 - HALF_STEP_M


def test_mixed_pixels_lie_between_the_surfaces_of_a_depth_step() -> None:
    slats = [box((2.0, y, -1.0), (2.01, y + 0.06, 4.0)) for y in np.arange(-2.0, 2.0, 0.12)]
    room = box((-4.0, -4.0, -4.0), (2.25, 4.0, 4.0))
    noise = RangeNoise(range_noise=0.0, dropout=0.0, weak_signal=False, divergence_mrad=6.0)
    edges = Scanner(World(np.concatenate([*slats, room])), still(), noise=noise).scan(0, 200)
    plain = Scanner(World(room), still(), noise=noise).scan(0, 200)

    def is_off(scan: Scan) -> np.ndarray:
        return np.abs(scan.rays["measured"] - scan.rays["distance"]) > 0.04

    ahead = plain.hits[..., 0] > 2.2
    assert is_off(plain)[ahead].mean() < 0.001
    mixed = is_off(edges) & ahead & (np.abs(edges.hits[..., 1]) < 1.8) & (edges.hits[..., 2] < 3.5)
    assert 0.01 < mixed.sum() / ahead.sum() < 0.2
    x = edges.measured_points[mixed][:, 0]
    assert x.min() > 2.0 - 0.01
    assert x.max() < 2.25 + 0.01


def test_intensity_follows_reflectivity_and_distance() -> None:
    def mean_intensity(reflectivity: float, half_width: float) -> float:
        world = World(box((-half_width,) * 3, (half_width,) * 3), reflectivity)
        scan = Scanner(world, still(), noise=RangeNoise(weak_signal=False)).scan(0, 20)
        assert (scan.packets["intensities"][~scan.returned] == 0).all()
        return float(scan.packets["intensities"][scan.returned].mean())

    assert mean_intensity(0.8, 3.0) > 1.3 * mean_intensity(0.3, 3.0) > 0
    assert mean_intensity(0.8, 3.0) > 1.3 * mean_intensity(0.8, 20.0) > 0
    assert 90 < mean_intensity(0.6, 3.0) < 200


def test_the_sweep_of_a_turn_covers_the_hemisphere() -> None:
    scan = scanner("still").scan(0, 50)
    direction = scan.rays["direction"]
    azimuth = np.sort(np.arctan2(direction[..., 1], direction[..., 0]).ravel())

    assert direction[..., 2].min() > -0.04
    assert direction[..., 2].max() > 0.999
    assert np.diff(azimuth).max() < np.deg2rad(8.0)
    wide = scanner("still").scan(0, 50, wide_fov=True).rays["direction"]
    assert np.rad2deg(np.arcsin(wide[..., 2].min())) == pytest.approx(-7.2, abs=1.0)
