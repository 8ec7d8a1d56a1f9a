"""Declares every setting of the companion, once: name, default, unit, range and meaning."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from l2lidar_node.clouds.layouts import LAYOUTS
from l2lidar_node.settings import TOPIC, SettingError, setting
from l2lidar_proc import rotations
from l2lidar_proc.rotations import F64

AS_INPUT = "as_input"
"""Choice of a layout: whatever the input has."""

FILTERS = (
    "range",
    "vertical",
    "azimuth",
    "keep_boxes",
    "remove_boxes",
    "intensity",
    "isolated",
    "voxel",
    "statistical",
    "radius",
)
"""Names of the filters."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionConfig:
    """What is known about the sensor's motion and how far it is trusted."""

    imu_xyz: tuple[float, ...] = setting(
        (-0.007698, -0.014655, 0.00667), "place of the IMU in the cloud frame", unit="m"
    )
    imu_rpy: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), "roll, pitch, yaw of the IMU in the cloud frame", unit="deg"
    )
    max_gyro_bias: float = setting(
        0.1, "largest mean rate at rest to take for bias", unit="rad/s", lo=0.001, hi=1.0
    )
    use_accelerometer: bool = setting(
        True, "let the accelerometer carry the velocity through a sweep", live=True
    )
    velocity_max_age_ms: int = setting(
        500, "older velocities are not used", unit="ms", lo=10, hi=5000, live=True
    )
    still_speed: float = setting(
        0.05, "a velocity below this does not contradict an IMU at rest", unit="m/s", lo=0.0,
        hi=1.0, live=True,
    )  # fmt: skip
    hold_ms: int = setting(
        20, "how long the last known rate goes on where IMU samples end", unit="ms", lo=0, hi=500,
        live=True,
    )  # fmt: skip
    max_gap_ms: int = setting(
        20, "a longer stretch without IMU samples is reported", unit="ms", lo=5, hi=1000, live=True
    )

    def __post_init__(self) -> None:
        """Check what a single setting cannot."""
        for name in ("imu_xyz", "imu_rpy"):
            value = getattr(self, name)
            if len(value) != 3:
                raise SettingError(f"parameter '{name}': {value!r} has not three numbers")

    @property
    def T_cloud_imu(self) -> F64:
        """IMU coordinates to cloud coordinates, shape (4, 4)."""
        roll, pitch, yaw = np.deg2rad(self.imu_rpy)
        q = rotations.exp((0.0, 0.0, yaw))
        for turn in ((0.0, pitch, 0.0), (roll, 0.0, 0.0)):
            q = rotations.multiply(q, rotations.exp(turn))
        return rotations.transform(q, self.imu_xyz)


@dataclass(frozen=True, slots=True, kw_only=True)
class DeskewConfig:
    """How a sweep is put together."""

    reference: str = setting(
        "start", "instant whose frame the points are moved to; it becomes the stamp",
        choices=("start", "middle", "end"), live=True,
    )  # fmt: skip
    keep_time: bool = setting(
        False, "keep the times of the points, counted from the stamp; some consumers would deskew "
        "again", live=True,
    )  # fmt: skip
    imu_wait_ms: int = setting(
        50, "longest wait for IMU samples up to the end of a sweep", unit="ms", lo=0, hi=1000,
        live=True,
    )  # fmt: skip
    time_unit: str = setting(
        "auto", "unit of the points' times; auto takes it from type and spread",
        choices=("auto", "s", "ms", "us", "ns"), live=True,
    )  # fmt: skip
    organised: bool = setting(
        False, "packets x 300 slots, NaN where nothing came back, in place of a list", live=True
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterConfig:
    """Which points are left out. Angles and boxes are in the cloud frame."""

    filters_before: tuple[str, ...] = setting(
        ("range",), "filters on the points as measured, in this order", choices=FILTERS, live=True
    )
    filters_after: tuple[str, ...] = setting(
        (), "filters on the deskewed points, in this order", choices=FILTERS, live=True
    )
    range_min: float = setting(
        0.0, "filter range: nearest", unit="m", lo=0.0, hi=1000.0, live=True
    )
    range_max: float = setting(
        1000.0, "filter range: farthest", unit="m", lo=0.0, hi=1000.0, live=True
    )
    vertical_min: float = setting(
        -90.0, "filter vertical: lowest elevation", unit="deg", lo=-90.0, hi=90.0, live=True
    )
    vertical_max: float = setting(
        90.0, "filter vertical: highest elevation", unit="deg", lo=-90.0, hi=90.0, live=True
    )
    azimuth_min: float = setting(
        -180.0, "filter azimuth: where the window begins; x ahead, counter-clockwise",
        unit="deg", lo=-360.0, hi=360.0, live=True,
    )  # fmt: skip
    azimuth_max: float = setting(
        180.0, "filter azimuth: where the window ends; below the beginning it goes across 180 deg",
        unit="deg", lo=-360.0, hi=360.0, live=True,
    )  # fmt: skip
    keep_boxes: tuple[float, ...] = setting(
        (), "filter keep_boxes: x y z of one corner and of the opposite, box after box",
        unit="m", live=True,
    )  # fmt: skip
    remove_boxes: tuple[float, ...] = setting(
        (), "filter remove_boxes: likewise, such as the robot's own body", unit="m", live=True
    )
    intensity_min: float = setting(0.0, "filter intensity: least", lo=0.0, hi=65535.0, live=True)
    intensity_max: float = setting(
        65535.0, "filter intensity: most", lo=0.0, hi=65535.0, live=True
    )
    isolated_slots: int = setting(
        3, "filter isolated: neighbours are at most so many slots away, in the same packet", lo=1,
        hi=50, live=True,
    )  # fmt: skip
    isolated_neighbours: int = setting(
        1, "filter isolated: how many neighbours a point needs", lo=1, hi=20, live=True
    )
    isolated_distance: float = setting(
        0.08, "filter isolated: how far a neighbour may be", unit="m", lo=0.0, hi=10.0, live=True
    )
    isolated_ratio: float = setting(
        0.05, "filter isolated: and this times the range in addition", lo=0.0, hi=1.0, live=True
    )
    isolated_intensity: float = setting(
        65535.0, "filter isolated: brighter points stay in any case", lo=0.0, hi=65535.0, live=True
    )
    voxel_size: float = setting(
        0.1, "filter voxel: edge of the cubes of which one point is kept", unit="m",
        lo=0.001, hi=100.0, live=True,
    )  # fmt: skip
    statistical_neighbours: int = setting(
        16, "filter statistical: neighbours to average the distance to", lo=1, hi=200, live=True
    )
    statistical_ratio: float = setting(
        2.0, "filter statistical: standard deviations above the mean to be left out", lo=0.01,
        hi=100.0, live=True,
    )  # fmt: skip
    radius: float = setting(
        0.3, "filter radius: where neighbours are counted", unit="m", lo=0.001, hi=100.0, live=True
    )
    radius_neighbours: int = setting(
        3, "filter radius: how many there must be", lo=1, hi=1000, live=True
    )

    def __post_init__(self) -> None:
        """Check what a single setting cannot."""
        for low, high in (
            ("range_min", "range_max"),
            ("vertical_min", "vertical_max"),
            ("intensity_min", "intensity_max"),
        ):
            if getattr(self, low) > getattr(self, high):
                raise SettingError(f"parameter '{low}': {getattr(self, low)} is above {high}")
        for name in ("keep_boxes", "remove_boxes"):
            if len(getattr(self, name)) % 6:
                raise SettingError(f"parameter '{name}': a box is six numbers, x y z x y z")


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcConfig:
    """Everything the deskew can be told."""

    motion: MotionConfig = field(default_factory=MotionConfig)
    deskew: DeskewConfig = field(default_factory=DeskewConfig)
    filters: FilterConfig = field(default_factory=FilterConfig)


@dataclass(frozen=True, slots=True, kw_only=True)
class DeskewTopics:
    """Where a deskew node listens and speaks."""

    cloud_topic: str = setting("/points", "clouds with one time per point", form=TOPIC)
    imu_topic: str = setting("/imu/data", "IMU samples", form=TOPIC)
    velocity_topic: str = setting(
        "odometry", "velocity of the sensor or of what carries it", form=TOPIC
    )
    velocity_type: str = setting(
        "odometry", "what comes on velocity_topic: nav_msgs/Odometry, geometry_msgs/TwistStamped",
        choices=("odometry", "twist", "none"),
    )  # fmt: skip
    output_topic: str = setting("points_deskewed", "deskewed clouds", form=TOPIC)
    qos_reliability: str = setting(
        "reliable", "reliability of the output", choices=("best_effort", "reliable")
    )
    point_layout: str = setting(
        AS_INPUT,
        "fields of the output, without the time field once points are deskewed",
        choices=(AS_INPUT, *LAYOUTS),
    )
    input_reliability: str = setting(
        "best_effort",
        "reliability asked of clouds and IMU samples; reliable hears reliable publishers only",
        choices=("best_effort", "reliable"),
    )
    use_tf: bool = setting(
        True, "take the mounts from /tf_static where it has them; else imu_xyz and imu_rpy hold"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class DeskewNodeConfig:
    """Everything the deskew node can be told."""

    topics: DeskewTopics = field(default_factory=DeskewTopics)
    proc: ProcConfig = field(default_factory=ProcConfig)
