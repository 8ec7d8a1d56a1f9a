"""Recordings that are wrong in one respect, and the checks that have to say so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.recfunctions import append_fields, drop_fields

from l2lidar_node import rotations
from l2lidar_node.types import Level
from tests.l2lidar_node.check import recordings
from tests.l2lidar_node.check.recordings import Recording

ERROR, WARN = Level.ERROR, Level.WARN
NS = 1_000_000_000


@dataclass(frozen=True)
class Defect:
    """A change to a good recording, and what has to be found.

    ``also`` are findings that follow from it as well; nothing else may be found.
    """

    name: str
    consumer: str
    change: Callable[[Recording], None]
    level: Level
    found: str
    also: tuple[str, ...] = ()


DEFECTS: list[Defect] = []


def defect(
    consumers: str, level: Level, found: str, *also: str
) -> Callable[[Callable[[Recording], None]], Callable[[Recording], None]]:
    """Register a change for some consumers."""

    def register(change: Callable[[Recording], None]) -> Callable[[Recording], None]:
        name = change.__name__.strip("_")
        for consumer in consumers.split():
            DEFECTS.append(Defect(name, consumer, change, level, found, also))
        return change

    return register


def damaged(item: Defect) -> Recording:
    """Return a good recording with the defect."""
    recording = recordings.copied(recordings.good(item.consumer))
    item.change(recording)
    return recording


TIMED = "lio_sam fast_lio point_lio rko_lio glim kiss_icp genz_icp dlio rtabmap"
IMU = "lio_sam fast_lio point_lio rko_lio glim dlio rtabmap autoware"


# Fields


@defect("lio_sam fast_lio point_lio", ERROR, "cloud.field-missing")
def ring_missing(made: Recording) -> None:
    made.points(lambda points: drop_fields(points, "ring"))


@defect("lio_sam fast_lio point_lio", ERROR, "cloud.field-type")
def ring_of_one_byte(made: Recording) -> None:
    made.points(lambda points: _retyped(points, "ring", "u1"))


@defect("lio_sam fast_lio dlio", ERROR, "cloud.field-type")
def intensity_of_one_byte(made: Recording) -> None:
    made.points(lambda points: _retyped(points, "intensity", "u1"))


@defect("lio_sam fast_lio point_lio", ERROR, "cloud.field-type", "times.time-missing")
def time_of_eight_bytes(made: Recording) -> None:
    made.points(lambda points: _retyped(points, "time", "f8"))


@defect("kiss_icp nav2 rko_lio", ERROR, "cloud.field-type", "cloud.levelled")
def double_positions(made: Recording) -> None:
    made.points(lambda points: _retyped(points, "x", "f8"))


@defect("autoware", ERROR, "cloud.layout")
def other_bytes(made: Recording) -> None:
    def padded(points: np.ndarray) -> np.ndarray:
        return append_fields(points, "more", np.zeros(len(points), "f4"), usemask=False)

    made.points(padded)


@defect("kiss_icp", ERROR, "cloud.layout")
def positions_apart(made: Recording) -> None:
    def reordered(points: np.ndarray) -> np.ndarray:
        return points[["x", "intensity", "y", "z", "range", "time"]]

    made.points(lambda points: _packed(reordered(points)))


@defect("lio_sam kiss_icp", ERROR, "cloud.format-changes")
def second_publisher(made: Recording) -> None:
    other = made.clouds[4]
    points = drop_fields(recordings.points_of(other), "intensity")
    made.clouds[4] = recordings.cloud(points, recordings.stamp_of(other))


# Memory


@defect("rtabmap", ERROR, "cloud.row-step")
@defect("lio_sam kiss_icp nav2", WARN, "cloud.row-step")
def no_row_step(made: Recording) -> None:
    for message in made.clouds:
        message.row_step = 0


@defect("lio_sam kiss_icp nav2 glim", ERROR, "cloud.malformed")
def too_little_data(made: Recording) -> None:
    made.clouds[3].data = made.clouds[3].data[:1000]


@defect("kiss_icp", ERROR, "cloud.malformed", "cloud.field-type", "times.time-missing")
def unknown_datatype(made: Recording) -> None:
    for message in made.clouds:
        message.fields[5].datatype = 11
        message.fields[3].datatype = 11


@defect("nav2", ERROR, "cloud.byte-order")
def big_endian(made: Recording) -> None:
    made.points(lambda points: points.astype(points.dtype.newbyteorder(">")))
    for message in made.clouds:
        message.is_bigendian = True


# Points


@defect("lio_sam rko_lio kiss_icp nav2", ERROR, "cloud.dense-lie")
def nan_in_a_dense_cloud(made: Recording) -> None:
    made.points(_some_nan)


@defect("lio_sam", ERROR, "cloud.not-dense")
def not_dense(made: Recording) -> None:
    made.points(_some_nan)
    for message in made.clouds:
        message.is_dense = False


@defect("rko_lio kiss_icp nav2", WARN, "cloud.nonfinite")
def nan_and_says_so(made: Recording) -> None:
    not_dense(made)


@defect("kiss_icp", ERROR, "cloud.points-few")
@defect("lio_sam glim nav2 genz_icp", WARN, "cloud.points-few")
def one_point(made: Recording) -> None:
    message = made.clouds[3]
    points = recordings.points_of(message)[:1]
    made.clouds[3] = recordings.cloud(points, recordings.stamp_of(message))


@defect("kiss_icp nav2", ERROR, "cloud.points-few", "times.time-missing")
def no_points_at_all(made: Recording) -> None:
    made.points(lambda points: points[:0])


@defect("lio_sam nav2", WARN, "cloud.points-origin")
def zeros_for_no_return(made: Recording) -> None:
    def zeroed(points: np.ndarray) -> None:
        for axis in "xyz":
            points[axis][::20] = 0

    made.points(zeroed)


@defect("lio_sam", ERROR, "cloud.first")
@defect("fast_lio point_lio rko_lio glim dlio", WARN, "cloud.first")
def first_cloud_is_a_fragment(made: Recording) -> None:
    points, stamp = recordings.points_of(made.clouds[0]), recordings.stamp_of(made.clouds[0])
    made.clouds[0] = recordings.cloud(points[: len(points) // 5].copy(), stamp)


@defect("lio_sam", ERROR, "cloud.ring-constant")
def vendors_ring(made: Recording) -> None:
    made.points(lambda points: points["ring"].fill(1))


@defect("lio_sam", ERROR, "cloud.ring-range")
def too_many_rings(made: Recording) -> None:
    made.points(lambda points: _set(points, "ring", points["ring"] + 10))


@defect("lio_sam", WARN, "cloud.ring-from-1")
def rings_from_1(made: Recording) -> None:
    made.points(lambda points: _set(points, "ring", np.clip(points["ring"], 1, 149)))


@defect("lio_sam", ERROR, "cloud.ring-cells")
def few_rings(made: Recording) -> None:
    made.points(lambda points: _set(points, "ring", points["ring"] // 10))


@defect("lio_sam", WARN, "cloud.ring-cells")
def fewer_rings(made: Recording) -> None:
    made.points(lambda points: _set(points, "ring", points["ring"] // 2))


@defect("lio_sam fast_lio rko_lio glim dlio", ERROR, "cloud.levelled")
@defect("kiss_icp genz_icp", WARN, "cloud.levelled")
def levelled(made: Recording) -> None:
    at, q, _ = recordings.orientations()
    for index, message in enumerate(made.clouds):
        points = recordings.points_of(message).copy()
        stamp = recordings.stamp_of(message)
        now = np.searchsorted(at, (stamp - recordings.stamp_of(made.imu[0])) / NS)
        xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(float)
        turned = rotations.rotate(np.repeat(q[now : now + 1], len(xyz), axis=0), xyz)
        for column, axis in enumerate("xyz"):
            points[axis] = turned[:, column]
        made.clouds[index] = recordings.cloud(points, stamp)


@defect("lio_sam", ERROR, "cloud.levelled")
def says_that_it_levels(made: Recording) -> None:
    made.is_leveled = True


# Times


@defect("lio_sam fast_lio point_lio rko_lio", ERROR, "times.time-missing")
@defect("autoware", ERROR, "times.time-missing", "cloud.layout")
@defect("glim kiss_icp genz_icp dlio rtabmap", WARN, "times.time-missing")
def deskewed_without_times(made: Recording) -> None:
    made.points(lambda points: drop_fields(points, ["time", "time_stamp"]))


@defect("kiss_icp genz_icp dlio rtabmap", ERROR, "times.time-several")
@defect("lio_sam rko_lio", WARN, "times.time-several")
def two_times(made: Recording) -> None:
    def doubled(points: np.ndarray) -> np.ndarray:
        nanoseconds = np.round(points["time"].astype(float) * 1e9).astype("u4")
        return append_fields(points, "t", nanoseconds, usemask=False)

    made.points(doubled)


@defect(TIMED, ERROR, "times.time-constant")
def constant_times(made: Recording) -> None:
    made.points(lambda points: points["time"].fill(0))


@defect(TIMED, ERROR, "times.time-invalid")
def time_nan(made: Recording) -> None:
    def spoilt(points: np.ndarray) -> None:
        points["time"][5] = np.nan

    made.points(spoilt)


@defect("rko_lio", ERROR, "times.time-origin")
@defect("lio_sam fast_lio glim dlio", WARN, "times.time-origin")
def first_packets_filtered(made: Recording) -> None:
    made.points(lambda points: points[points["time"] > 0.0046])


@defect("lio_sam fast_lio dlio rtabmap", ERROR, "times.sweep-long")
def milliseconds(made: Recording) -> None:
    made.points(lambda points: _scale(points, 1e3))


@defect("glim", ERROR, "times.sweep-long", "times.time-origin", "cloud.clock-ahead")
@defect("rko_lio", ERROR, "times.sweep-long", "cloud.clock-ahead", "imu.offset", "imu.uncovered")
def sweeps_of_seconds(made: Recording) -> None:
    made.points(lambda points: _scale(points, 6))


@defect(
    "lio_sam fast_lio point_lio rko_lio glim dlio rtabmap", ERROR, "times.time-half", "imu.offset"
)
def times_at_half_speed(made: Recording) -> None:
    made.points(lambda points: _scale(points, 0.5))


@defect("lio_sam", ERROR, "times.time-spread", "cloud.clock-ahead", "imu.offset")
def times_too_fast(made: Recording) -> None:
    made.points(lambda points: _scale(points, 1.6))


@defect("lio_sam glim", WARN, "times.time-spread", "imu.offset")
def cut_window(made: Recording) -> None:
    made.points(lambda points: points[points["time"] < 0.15])


@defect("lio_sam fast_lio rtabmap glim", ERROR, "times.time-order")
def latest_first(made: Recording) -> None:
    made.points(lambda points: points[::-1].copy())


@defect("glim", ERROR, "times.time-order")
@defect("lio_sam", WARN, "times.time-order")
def not_ascending(made: Recording) -> None:
    def swapped(points: np.ndarray) -> None:
        points[100:200] = points[100:200][::-1].copy()

    made.points(swapped)


@defect("lio_sam rko_lio kiss_icp", WARN, "times.sweep-short")
def half_turns(made: Recording) -> None:
    clouds, arrivals = [], []
    for message, arrival in zip(made.clouds, made.cloud_arrivals, strict=True):
        points, stamp = recordings.points_of(message), recordings.stamp_of(message)
        late = points["time"] > 0.116
        second = points[late].copy()
        begin = second["time"][0]
        second["time"] -= begin
        begin_ns = round(float(begin) * NS)
        clouds += [
            recordings.cloud(points[~late], stamp),
            recordings.cloud(second, stamp + begin_ns),
        ]
        arrivals += [stamp + begin_ns + 3_000_000, arrival]
    made.clouds, made.cloud_arrivals = clouds, arrivals


# Stamps


@defect("lio_sam kiss_icp", ERROR, "cloud.stamps-backward", "cloud.gaps", "cloud.clock-pace")
@defect("nav2", WARN, "cloud.stamps-backward", "cloud.gaps", "cloud.clock-pace")
def cloud_from_the_past(made: Recording) -> None:
    message = made.clouds[5]
    message.header = recordings.header(recordings.stamp_of(made.clouds[3]) - 1000, "l2lidar_link")


@defect("rko_lio kiss_icp", ERROR, "cloud.stamps-equal", "cloud.gaps")
def cloud_twice(made: Recording) -> None:
    message = made.clouds[5]
    message.header = recordings.header(recordings.stamp_of(made.clouds[4]), "l2lidar_link")


@defect("lio_sam kiss_icp nav2", WARN, "cloud.gaps")
def lost_cloud(made: Recording) -> None:
    del made.clouds[5], made.cloud_arrivals[5]


@defect("lio_sam", ERROR, "cloud.gaps")
def lost_clouds(made: Recording) -> None:
    del made.clouds[4:8], made.cloud_arrivals[4:8]


@defect("kiss_icp", WARN, "cloud.jitter")
def stamped_on_arrival(made: Recording) -> None:
    for index, message in enumerate(made.clouds):
        late = (0, 60_000_000)[index % 2]
        message.header = recordings.header(recordings.stamp_of(message) + late, "l2lidar_link")
    made.cloud_arrivals = [arrival + 60_000_000 for arrival in made.cloud_arrivals]


@defect("kiss_icp nav2", WARN, "cloud.few")
def two_clouds(made: Recording) -> None:
    del made.clouds[2:], made.cloud_arrivals[2:]


@defect("nav2", ERROR, "cloud.clock-half")
@defect("lio_sam rko_lio", ERROR, "cloud.clock-half", "imu.clock-half", "times.time-spread",
        "imu.gyro-unit", "cloud.stamps-backward", "imu.offset", "imu.uncovered")  # fmt: skip
def stamps_at_half_speed(made: Recording) -> None:
    begin = recordings.stamp_of(made.clouds[0])
    for message in (*made.clouds, *made.imu):
        stamp = begin + (recordings.stamp_of(message) - begin) // 2
        message.header = recordings.header(stamp, message.header.frame_id)


@defect("kiss_icp", WARN, "cloud.clock-pace")
def replayed_slowly(made: Recording) -> None:
    begin = made.cloud_arrivals[0]
    made.cloud_arrivals = [begin + 3 * (arrival - begin) for arrival in made.cloud_arrivals]


@defect("lio_sam", WARN, "cloud.clock-ahead", "imu.offset")
def stamped_at_the_end(made: Recording) -> None:
    made.cloud_arrivals = [arrival - 225_000_000 for arrival in made.cloud_arrivals]


@defect("kiss_icp nav2", WARN, "cloud.clock-behind")
def replayed_a_day_later(made: Recording) -> None:
    made.cloud_arrivals = [arrival + 86_400 * NS for arrival in made.cloud_arrivals]


@defect(f"{TIMED} nav2 autoware", ERROR, "cloud.cloud-missing")
def no_clouds(made: Recording) -> None:
    made.clouds, made.cloud_arrivals = [], []


# IMU


@defect("lio_sam fast_lio point_lio rko_lio glim dlio autoware", ERROR, "imu.imu-missing")
@defect("rtabmap", WARN, "imu.imu-missing")
def no_imu(made: Recording) -> None:
    made.imu, made.imu_arrivals = [], []


@defect("lio_sam", ERROR, "imu.rate")
def slow_imu(made: Recording) -> None:
    made.imu, made.imu_arrivals = made.imu[::2], made.imu_arrivals[::2]


@defect("rko_lio", ERROR, "imu.rate")
def slower_imu(made: Recording) -> None:
    made.imu, made.imu_arrivals = made.imu[::4], made.imu_arrivals[::4]


@defect("lio_sam", WARN, "imu.gaps")
def imu_gap(made: Recording) -> None:
    del made.imu[300:310], made.imu_arrivals[300:310]


@defect("lio_sam", ERROR, "imu.uncovered", "imu.clock", "imu.few")
def imu_ends_early(made: Recording) -> None:
    del made.imu[300:], made.imu_arrivals[300:]


@defect("lio_sam", WARN, "imu.uncovered")
def imu_ends_a_little_early(made: Recording) -> None:
    end = recordings.stamp_of(made.clouds[-3])
    kept = [item for item in made.imu if recordings.stamp_of(item) < end + 100_000_000]
    made.imu, made.imu_arrivals = kept, made.imu_arrivals[: len(kept)]


@defect("lio_sam glim", ERROR, "imu.stamps-backward")
def imu_backward(made: Recording) -> None:
    made.imu[300], made.imu[301] = made.imu[301], made.imu[300]


@defect("lio_sam glim", ERROR, "imu.stamps-equal")
def imu_twice(made: Recording) -> None:
    made.imu.insert(300, made.imu[300])
    made.imu_arrivals.insert(300, made.imu_arrivals[300])


@defect("lio_sam", ERROR, "imu.clocks-apart")
def two_clocks(made: Recording) -> None:
    for message in made.imu:
        stamp = recordings.stamp_of(message) - 1000 * NS
        message.header = recordings.header(stamp, "l2lidar_imu")
    made.imu_arrivals = [arrival - 1000 * NS for arrival in made.imu_arrivals]


@defect("lio_sam rko_lio", WARN, "imu.offset")
def imu_stamped_late(made: Recording) -> None:
    for message in made.imu:
        stamp = recordings.stamp_of(message) - 100_000_000
        message.header = recordings.header(stamp, "l2lidar_imu")


@defect("lio_sam rko_lio", ERROR, "imu.acceleration")
@defect("fast_lio glim", WARN, "imu.acceleration")
def in_g(made: Recording) -> None:
    _scale_vector(made, "linear_acceleration", 1 / 9.81)


@defect("lio_sam rko_lio", ERROR, "imu.acceleration")
@defect("fast_lio glim", WARN, "imu.acceleration")
def switched_on_while_tilted(made: Recording) -> None:
    _scale_vector(made, "linear_acceleration", 20.1 / 9.81)


@defect("lio_sam", ERROR, "imu.acceleration")
def no_gravity(made: Recording) -> None:
    _scale_vector(made, "linear_acceleration", 0.01)


@defect("lio_sam", WARN, "imu.acceleration")
def odd_gravity(made: Recording) -> None:
    _scale_vector(made, "linear_acceleration", 1.3)


@defect("lio_sam rko_lio", ERROR, "imu.gyro-unit", "imu.gyro")
def degrees(made: Recording) -> None:
    _scale_vector(made, "angular_velocity", 57.29578)


@defect("lio_sam", WARN, "imu.gyro-unit")
def wrong_gyro_scale(made: Recording) -> None:
    _scale_vector(made, "angular_velocity", 3.0)


@defect("rko_lio", ERROR, "imu.gyro", "imu.gyro-unit")
def impossible_rate(made: Recording) -> None:
    made.imu[100].angular_velocity.y = 1000.0


@defect("rko_lio", WARN, "imu.gyro", "imu.gyro-unit")
def dead_gyro(made: Recording) -> None:
    _scale_vector(made, "angular_velocity", 0.0)


@defect("lio_sam rko_lio", ERROR, "imu.values")
def imu_nan(made: Recording) -> None:
    made.imu[100].angular_velocity.y = float("nan")


@defect("lio_sam", ERROR, "imu.orientation-gravity")
@defect("rko_lio rtabmap", WARN, "imu.orientation-gravity")
def wxyz_for_xyzw(made: Recording) -> None:
    for message in made.imu:
        q = message.orientation
        q.x, q.y, q.z, q.w = q.w, q.x, q.y, q.z


@defect("lio_sam", ERROR, "imu.orientation-gravity")
def inverse_orientation(made: Recording) -> None:
    for message in made.imu:
        q = message.orientation
        q.x, q.y, q.z = -q.x, -q.y, -q.z


@defect("lio_sam", ERROR, "imu.orientation-gravity", "imu.gyro-unit")
def other_orientation(made: Recording) -> None:
    for message in made.imu:
        q = message.orientation
        q.x, q.y, q.z, q.w = 0.5, 0.5, 0.5, 0.5


@defect("lio_sam", ERROR, "imu.orientation-norm")
@defect("rtabmap", WARN, "imu.orientation-norm")
def no_orientation(made: Recording) -> None:
    for message in made.imu:
        q = message.orientation
        q.x = q.y = q.z = q.w = 0.0


@defect("lio_sam rtabmap", WARN, "imu.orientation-norm")
def long_orientation(made: Recording) -> None:
    for message in made.imu:
        q = message.orientation
        q.x, q.y, q.z, q.w = 1.5 * q.x, 1.5 * q.y, 1.5 * q.z, 1.5 * q.w


@defect("lio_sam rtabmap", WARN, "imu.covariance-zero")
def no_covariance(made: Recording) -> None:
    for message in made.imu:
        message.angular_velocity_covariance = np.zeros(9)


@defect("rtabmap", WARN, "imu.covariance-invalid")
def negative_covariance(made: Recording) -> None:
    for message in made.imu:
        message.linear_acceleration_covariance = np.full(9, -0.5)


# Frames and QoS


@defect("lio_sam nav2", ERROR, "frames.frame-empty")
def no_frame(made: Recording) -> None:
    for message in made.clouds:
        message.header.frame_id = ""


@defect("lio_sam", ERROR, "frames.frame-slash")
def slash(made: Recording) -> None:
    for message in made.imu:
        message.header.frame_id = "/l2lidar_imu"


@defect("kiss_icp", ERROR, "frames.frame-changes")
def frame_changes(made: Recording) -> None:
    made.clouds[3].header.frame_id = "os_lidar"


@defect("rko_lio lio_sam", WARN, "frames.tf-imu")
@defect("rtabmap autoware", ERROR, "frames.tf-imu", "frames.tf")
def no_tf(made: Recording) -> None:
    made.transforms = []


@defect("nav2 rtabmap", WARN, "frames.tf")
def only_the_drivers_tf(made: Recording) -> None:
    made.transforms = [("l2lidar_link", "l2lidar_imu")]


@defect("rko_lio glim", WARN, "frames.tf-parent")
def cloud_frame_has_a_parent(made: Recording) -> None:
    made.transforms = [("base_link", "l2lidar_link"), ("l2lidar_link", "l2lidar_imu")]


@defect("fast_lio autoware", ERROR, "qos.qos-imu")
@defect("point_lio", WARN, "qos.qos-imu")
def imu_best_effort(made: Recording) -> None:
    made.imu_reliability = "best_effort"


@defect("genz_icp dlio", ERROR, "qos.qos-cloud")
@defect("rtabmap", WARN, "qos.qos-cloud", "qos.qos-imu")
def best_effort(made: Recording) -> None:
    made.reliability = "best_effort"


@defect("lio_sam", WARN, "qos.qos-cloud", "qos.qos-imu")
def short_queue(made: Recording) -> None:
    made.reliability, made.depth = "reliable", 1


def _retyped(points: np.ndarray, name: str, code: str) -> np.ndarray:
    kinds = [
        (field, f"<{code}" if field == name else points.dtype[field])
        for field in points.dtype.names
    ]
    changed = np.zeros(len(points), kinds)
    for field in points.dtype.names:
        changed[field] = points[field]
    return changed


def _packed(points: np.ndarray) -> np.ndarray:
    packed = np.zeros(len(points), [(name, points.dtype[name]) for name in points.dtype.names])
    for name in points.dtype.names:
        packed[name] = points[name]
    return packed


def _some_nan(points: np.ndarray) -> None:
    points["x"][::50] = np.nan


def _set(points: np.ndarray, name: str, values: Any) -> None:
    points[name] = values


def _scale(points: np.ndarray, factor: float) -> None:
    points["time"] *= np.float32(factor)


def _scale_vector(made: Recording, name: str, factor: float) -> None:
    for message in made.imu:
        vector = getattr(message, name)
        vector.x, vector.y, vector.z = factor * vector.x, factor * vector.y, factor * vector.z
