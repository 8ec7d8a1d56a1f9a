"""The vectorized projection against the model written out slot by slot."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2lidar_node.driver.geometry import PointBatch, Projector, RangeCalibration, RangeLimits
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.types import POINT
from tests.support import build

WIDE = RangeLimits(-1e9, 1e9)


def project(
    payloads: Any,
    limits: Any = WIDE,
    override: Any = None,
    kind: Any = PacketType.POINTS_3D,
    start_s: Any = None,
    projector: Any = None,
    rotations: Any = None,
) -> PointBatch:
    if start_s is None:
        start_s = np.arange(len(payloads)) * 0.005
    return (projector or Projector(kind)).points(payloads, start_s, limits, override, rotations)


def xyz(points: Any) -> Any:
    return np.stack([points["x"], points["y"], points["z"]], axis=1).astype(np.float64)


def scalar_3d(payload: bytes) -> np.ndarray:
    """Return x, y, z, range of every valid slot by the model, in double."""
    p = np.frombuffer(payload, wire.POINTS_3D_PAYLOAD)[0]
    c = {name: float(p["calibration"][name]) for name in wire.CALIBRATION.names or ()}
    sin_b, cos_b = math.sin(c["beta_angle"]), math.cos(c["beta_angle"])
    sin_x, cos_x = math.sin(c["xi_angle"]), math.cos(c["xi_angle"])
    found = []
    for j in range(int(p["point_num"])):
        d = c["range_scale"] * (float(p["ranges"][j]) + c["range_bias"])
        if p["ranges"][j] < 1 or not float(p["range_min"]) <= d <= float(p["range_max"]):
            continue
        al = float(p["angle_min"]) + c["alpha_angle_bias"] + j * float(p["angle_increment"])
        th = float(p["com_horizontal_angle_start"]) + c["theta_angle_bias"]
        th += j * float(p["com_horizontal_angle_step"])
        a = (-cos_b * sin_x + sin_b * cos_x * math.sin(al)) * d + c["b_axis_dist"]
        b = math.cos(al) * cos_x * d
        z = (sin_b * sin_x + cos_b * cos_x * math.sin(al)) * d + c["a_axis_dist"]
        x, y = math.cos(th) * a - math.sin(th) * b, math.sin(th) * a + math.cos(th) * b
        found.append((x, y, z, d))
    return np.array(found).reshape(-1, 4)


def float32_3d(payload: bytes) -> np.ndarray:
    """Return the points as the vendor's client computes them: float32, angles by addition."""
    f = np.float32
    p = np.frombuffer(payload, wire.POINTS_3D_PAYLOAD)[0]
    c = p["calibration"]
    sin_b, cos_b, sin_x, cos_x = (
        f(g(c[name])) for name in ("beta_angle", "xi_angle") for g in (np.sin, np.cos)
    )
    alpha = f(p["angle_min"] + c["alpha_angle_bias"])
    theta = f(p["com_horizontal_angle_start"] + c["theta_angle_bias"])
    found = []
    for j in range(int(p["point_num"])):
        d = f(c["range_scale"] * (f(p["ranges"][j]) + c["range_bias"]))
        if p["ranges"][j] >= 1 and p["range_min"] <= d <= p["range_max"]:
            sin_a, cos_a, sin_t, cos_t = np.sin(alpha), np.cos(alpha), np.sin(theta), np.cos(theta)
            a = (-cos_b * sin_x + sin_b * cos_x * sin_a) * d + c["b_axis_dist"]
            b = cos_a * cos_x * d
            z = (sin_b * sin_x + cos_b * cos_x * sin_a) * d + c["a_axis_dist"]
            found.append((cos_t * a - sin_t * b, sin_t * a + cos_t * b, z))
        alpha = f(alpha + p["angle_increment"])
        theta = f(theta + p["com_horizontal_angle_step"])
    return np.array(found, np.float64)


def random_packet(rng: Any, far_m: float = 30.0, **fields: Any) -> bytes:
    """Return a packet of a made-up unit; ranges up to ``far_m``, some without return."""
    calibration = {
        "a_axis_dist": 0.0445,
        "b_axis_dist": rng.uniform(-0.01, 0.01),
        "theta_angle_bias": rng.uniform(-math.pi, math.pi),
        "alpha_angle_bias": rng.normal(0, 0.05),
        "beta_angle": rng.normal(0, 0.02),
        "xi_angle": rng.normal(0, 0.02),
        "range_bias": rng.uniform(-600, 0),
        "range_scale": rng.uniform(0.0009, 0.0011),
    }
    highest = far_m / calibration["range_scale"] - calibration["range_bias"]
    ranges = rng.integers(0, min(int(highest), 65535), 300)
    ranges[rng.random(300) < 0.1] = 0
    given = {
        "theta": rng.uniform(0, 2 * math.pi),
        "step": build.STEP_RAD * (1 + rng.normal(0, 0.02)),
        "ranges": ranges,
        "intensities": rng.integers(0, 256, 300),
        "calibration": calibration,
        "range_max": 60.0,
        "range_min": 0.0,
    }
    return build.points_3d(**(given | fields))


PRECISION = 2.5e-7  # of the distance


def compare(payloads: Any, tolerance: float = 1e-7, **arguments: Any) -> Any:
    batch = project(payloads, **arguments)
    expected = np.concatenate([scalar_3d(payload) for payload in payloads])
    assert len(batch.points) == len(expected)
    error = np.abs(xyz(batch.points) - expected[:, :3]).max(axis=1)
    assert (error - PRECISION * expected[:, 3]).max() < tolerance
    np.testing.assert_allclose(batch.points["range"], expected[:, 3], rtol=1e-7)
    return batch


def test_against_the_scalar_model_up_to_30_m() -> None:
    rng = np.random.default_rng(1)
    compare([random_packet(rng) for _ in range(40)])


def test_one_calibration_for_all_packets() -> None:
    """The common case: one run, one table, small differences of the step."""
    rng = np.random.default_rng(2)
    payloads = [random_packet(rng, calibration=build.UNIT_A) for _ in range(40)]
    compare(payloads)


@pytest.mark.parametrize("spread", [0.0, 0.01, 0.05, 0.08, 0.2, 3.0])
def test_however_much_the_step_varies(spread: float) -> None:
    rng = np.random.default_rng(3)
    steps = build.STEP_RAD * (1 + rng.uniform(-spread, spread, 30))
    payloads = [random_packet(rng, calibration=build.UNIT_B, step=step) for step in steps]
    compare(payloads)


def test_one_packet_with_another_step_among_many() -> None:
    rng = np.random.default_rng(4)
    payloads = [random_packet(rng, calibration=build.UNIT_A, step=2e-4) for _ in range(30)]
    payloads[7] = random_packet(rng, calibration=build.UNIT_A, step=-0.02)
    compare(payloads)


def test_calibrations_that_change_within_a_batch() -> None:
    rng = np.random.default_rng(5)
    units = [build.UNIT_A, build.UNIT_A, build.UNIT_B, build.UNIT_A, build.PLAIN, build.UNIT_B]
    compare([random_packet(rng, calibration=unit) for unit in units])


def test_more_packets_than_are_projected_at_once() -> None:
    rng = np.random.default_rng(11)
    payloads = [random_packet(rng, calibration=build.UNIT_A) for _ in range(150)]
    starts = 1.0 + np.arange(150) * 0.005
    batch = compare(payloads, start_s=starts)
    first = project(payloads[:1], start_s=starts)
    assert batch.first_s == first.first_s
    assert batch.counts.sum() == len(batch.points)
    since = np.repeat(starts, batch.counts) - batch.first_s
    within = batch.points["time"] - since
    assert within.min() > -1e-6
    assert within.max() < 300 * build.SLOT_NS * 1e-9


def test_every_packet_is_turned_by_its_rotation() -> None:
    """As exactly as it is placed without."""
    rng = np.random.default_rng(12)
    steps = [build.STEP_RAD, build.STEP_RAD * 1.2, -0.02] * 10
    payloads = [random_packet(rng, calibration=build.UNIT_A, step=step) for step in steps]
    turns = Rotation.random(30, rng)
    batch = project(payloads, rotations=turns.as_matrix())
    exact = [scalar_3d(payload)[:, :3] for payload in payloads]
    expected = np.concatenate([turn.apply(part) for turn, part in zip(turns, exact, strict=True)])
    error = np.abs(xyz(batch.points) - expected).max(axis=1)
    assert (error - PRECISION * batch.points["range"]).max() < 1e-7


@pytest.mark.parametrize("kind", [PacketType.POINTS_3D, PacketType.POINTS_2D])
def test_packets_whose_rotation_is_not_known_are_left_out(kind: Any) -> None:
    maker = build.points_3d if kind == PacketType.POINTS_3D else build.points_2d
    payloads = [maker(ranges=2000), maker(ranges=2500), maker(ranges=3000, count=100)]
    level, unknown = np.eye(3), np.full((3, 3), np.nan)
    batch = project(payloads, kind=kind, rotations=np.array([level, unknown, level]))
    expected = project([payloads[0], payloads[2]], kind=kind, start_s=np.array([0.0, 0.01]))
    np.testing.assert_array_equal(batch.points, expected.points)
    assert batch.left_out == batch.counts[0]
    assert batch.counts.tolist() == [expected.counts[0], 0, 100]


def test_limits_and_angles_that_change_within_a_batch() -> None:
    rng = np.random.default_rng(6)
    common: dict[str, Any] = {"calibration": build.UNIT_A}
    payloads = [
        random_packet(rng, **common),
        random_packet(rng, **common, range_max=7.0),
        random_packet(rng, **common, range_min=3.0),
        random_packet(rng, **common, angle_min=-0.105, angle_increment=0.64 * math.pi / 180),
        random_packet(rng, **common),
    ]
    compare(payloads)


@pytest.mark.parametrize(("farthest_angle", "bound"), [(4.0, 3.5e-4), (2 * math.pi, 8e-4)])
def test_against_the_vendors_float32_at_5_m(farthest_angle: Any, bound: float) -> None:
    """Its rounding grows with the head's angle, bias included: it doubles at 4 and 8 rad."""
    rng = np.random.default_rng(7)
    payloads = [
        random_packet(rng, 5.0, calibration=build.UNIT_A, theta=theta, step=build.STEP_RAD)
        for theta in np.linspace(0, farthest_angle, 10)
    ]
    expected = np.concatenate([float32_3d(payload) for payload in payloads])
    error = np.abs(xyz(project(payloads).points) - expected)
    assert error.max() < bound
    assert error.max() > 1e-6  # the client's rounding is there: it was not compared with itself


def test_a_point_by_hand() -> None:
    """A slot straight up, with nothing but the offsets: 3 m + a above, b ahead of the axis."""
    unit = build.PLAIN | {"a_axis_dist": 0.04, "b_axis_dist": 0.01}
    payload = build.points_3d(
        ranges=[3000, *[0] * 299], calibration=unit, angle_min=math.pi / 2, theta=0.0
    )
    (point,) = project([payload]).points
    assert (point["x"], point["y"], point["z"]) == pytest.approx((0.01, 0.0, 3.04), abs=1e-6)
    assert point["range"] == pytest.approx(3.0, abs=1e-6)
    assert point["intensity"] == 100
    assert point["time"] == 0


def test_the_first_slot_looks_to_the_left_of_the_heads_angle() -> None:
    """At the horizon (alpha 0) the beam lies along +90 degrees of theta; at alpha pi along -90."""
    payload = build.points_3d(
        ranges=2000, calibration=build.PLAIN, theta=0.5, step=0.0, angle_increment=math.pi / 299
    )
    points = project([payload]).points
    for point, heading in ((points[0], 0.5 + math.pi / 2), (points[-1], 0.5 - math.pi / 2)):
        expected = (2 * math.cos(heading), 2 * math.sin(heading), 0.0)
        assert (point["x"], point["y"], point["z"]) == pytest.approx(expected, abs=1e-5)


def test_the_wide_field_of_view_reaches_below_the_horizon() -> None:
    payload = build.points_3d(
        ranges=2000, calibration=build.PLAIN, angle_min=-0.105, angle_increment=0.01117
    )
    assert project([payload]).points["z"][0] == pytest.approx(-2 * math.sin(0.105), abs=1e-5)
    compare([payload])


def test_2d_packets_lie_in_one_plane() -> None:
    rng = np.random.default_rng(8)
    ranges = rng.integers(0, 30_000, 1800)
    payload = build.points_2d(ranges=ranges, intensities=np.arange(1800) % 256)
    points = project([payload, payload], kind=PacketType.POINTS_2D).points
    slots = np.flatnonzero(ranges > 0)
    distance = np.float32(0.000978).astype(float) * (ranges[slots] - 365.625)
    slots, distance = slots[distance >= 0.05], distance[distance >= 0.05]
    assert len(points) == 2 * len(slots)
    alpha = np.float32(0.032398).astype(float) + slots * float(np.float32(math.pi / 1800))
    assert (points["x"] == 0).all()
    first = points[: len(slots)]
    np.testing.assert_allclose(first["y"], np.cos(alpha) * distance, atol=2e-6)
    np.testing.assert_allclose(first["z"], np.sin(alpha) * distance + 0.0445, atol=2e-6)
    np.testing.assert_array_equal(first["intensity"], slots % 256)


@pytest.mark.parametrize("count", [0, 1, 150, 299])
def test_slots_beyond_the_count_are_left_out(count: int) -> None:
    full, short = build.points_3d(), build.points_3d(count=count)
    batch = project([full, short, full])
    assert batch.counts.tolist() == [300, count, 300]
    assert len(batch.points) == 600 + count


def test_slots_without_return_are_left_out_even_if_the_bias_makes_them_positive() -> None:
    unit = build.PLAIN | {"range_bias": 100.0}
    payload = build.points_3d(ranges=[0, 1, *[0] * 298], calibration=unit, range_min=0.0)
    (point,) = project([payload]).points
    assert point["range"] == pytest.approx(0.101)


def limited(raw: int, scale: float = 0.001, limits: RangeLimits = WIDE, **fields: Any) -> bool:
    unit = build.PLAIN | {"range_scale": scale}
    payload = build.points_3d(ranges=[raw, *[0] * 299], calibration=unit, **fields)
    return len(project([payload], limits).points) == 1


def test_limits_of_the_packet_are_inclusive() -> None:
    quarter = 1 / 1024  # exact in float32, so that the limit can be met exactly
    assert limited(1024, quarter, range_min=1.0)
    assert not limited(1023, quarter, range_min=1.0)
    assert limited(2048, quarter, range_max=2.0)
    assert not limited(2049, quarter, range_max=2.0)


def test_limits_of_the_user_are_inclusive() -> None:
    quarter = 1 / 1024
    assert limited(1024, quarter, RangeLimits(1.0, 2.0))
    assert limited(2048, quarter, RangeLimits(1.0, 2.0))
    assert not limited(1023, quarter, RangeLimits(1.0, 2.0))
    assert not limited(2049, quarter, RangeLimits(1.0, 2.0))


def test_rounding_of_the_scale_counts_as_in_the_vendors_client() -> None:
    """0.001 is a little more in float32, so 50000 counts are beyond 50 m."""
    assert not limited(50_000, range_max=50.0)
    assert limited(49_999, range_max=50.0)


def test_negative_ranges_are_left_out_by_default() -> None:
    payload = build.points_3d(ranges=[100, 365, 366, 3000, *[0] * 296], range_min=-1.0)
    points = Projector(PacketType.POINTS_3D).points([payload], np.zeros(1)).points
    assert (points["range"] >= 0).all()
    assert len(points) == 2


def test_the_override_replaces_scale_and_bias() -> None:
    payloads = [build.points_3d(ranges=2000), build.points_3d(calibration=build.UNIT_B)]
    batch = project(payloads, override=RangeCalibration(0.002, -500.0))
    assert batch.points["range"][0] == np.float32(3.0)
    assert batch.points["range"][-1] == np.float32(5.0)
    tweaked = build.UNIT_A | {"range_scale": 0.002, "range_bias": -500.0}
    same = project([build.points_3d(ranges=2000, calibration=tweaked)])
    np.testing.assert_allclose(xyz(batch.points[:300]), xyz(same.points), atol=1e-6)


def test_times_are_relative_to_the_first_kept_point() -> None:
    ranges = [0] * 3 + [3000] * 297
    payloads = [build.points_3d(ranges=ranges), build.points_3d(), build.points_3d(count=10)]
    batch = project(payloads, start_s=np.array([0.0, 0.005, 0.013]))
    slot = float(np.float32(build.SLOT_NS * 1e-9))
    assert batch.first_s == pytest.approx(3 * slot, abs=1e-12)
    assert batch.points["time"][0] == 0
    expected = np.concatenate(
        [np.arange(3, 300) * slot, 0.005 + np.arange(300) * slot, 0.013 + np.arange(10) * slot]
    )
    np.testing.assert_allclose(batch.points["time"], expected - 3 * slot, atol=1e-9)
    assert (np.diff(batch.points["time"]) > 0).all()


def test_a_batch_without_points() -> None:
    batch = project([build.points_3d(ranges=0), build.points_3d(count=0)])
    assert len(batch.points) == 0
    assert batch.points.dtype == POINT
    assert batch.first_s == 0
    assert batch.counts.tolist() == [0, 0]


def test_results_do_not_depend_on_what_was_computed_before() -> None:
    rng = np.random.default_rng(9)
    batches = [[random_packet(rng) for _ in range(n)] for n in (40, 3, 38, 1, 60, 38)]
    projector = Projector(PacketType.POINTS_3D)
    kept = [project(batch, projector=projector).points for batch in batches]
    copies = [points.copy() for points in kept]
    for batch, points, copy in zip(batches, kept, copies, strict=True):
        np.testing.assert_array_equal(points, copy)
        np.testing.assert_array_equal(points, project(batch).points)
    assert not np.array_equal(kept[2], kept[5])


def test_results_do_not_depend_on_the_batch_but_by_rounding() -> None:
    rng = np.random.default_rng(10)
    payloads = [random_packet(rng, calibration=build.UNIT_A) for _ in range(20)]
    together = xyz(project(payloads).points)
    alone = np.concatenate([xyz(project([payload]).points) for payload in payloads])
    np.testing.assert_allclose(together, alone, atol=5e-6)


def test_impossible_values_make_no_warning_and_no_infinity() -> None:
    payload = build.points_3d(
        ranges=65535, calibration=build.UNIT_A | {"range_scale": 1e6, "a_axis_dist": -1e6},
        range_max=1e6, theta=1e6, step=1e6, angle_increment=1e6,
    )  # fmt: skip
    with np.errstate(all="raise"):
        batch = Projector(PacketType.POINTS_3D).points([payload, build.points_3d()], np.zeros(2))
    for name in ("x", "y", "z"):
        assert np.isfinite(batch.points[name]).all()
