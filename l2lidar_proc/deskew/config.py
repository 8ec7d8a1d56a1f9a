"""Settings of deskew, filters, laser scan and deskew node."""

from __future__ import annotations

from dataclasses import dataclass, field

from l2lidar_node.clouds import LAYOUTS, RINGS
from l2lidar_node.config import LifecycleConfig
from l2lidar_node.settings import FRAME, TOPIC, SettingError, setting
from l2lidar_proc.motion.config import MotionConfig

AS_INPUT = "as_input"
"""Choice of a layout: that of the input."""

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
class DeskewConfig:
    """How a sweep is assembled."""

    reference: str = setting(
        "start",
        "instant the points are deskewed to; it becomes the stamp",
        choices=("start", "middle", "end"),
        live=True,
    )
    keep_time: bool = setting(
        False,
        "keep per-point times, relative to the stamp; a consumer that finds them may "
        "deskew the cloud a second time",
        live=True,
    )
    imu_wait_ms: int = setting(
        50,
        "longest wait for IMU samples that cover the end of a sweep",
        unit="ms",
        lo=0,
        hi=1000,
        live=True,
    )
    time_unit: str = setting(
        "auto",
        "unit of the per-point times; auto infers it from type and range",
        choices=("auto", "s", "ms", "us", "ns"),
        live=True,
    )
    organised: bool = setting(
        False, "organized cloud of packets x 300 slots, NaN where there is no return", live=True
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterConfig:
    """Which points are removed. Angles and boxes are in the cloud frame."""

    filters_before: tuple[str, ...] = setting(
        ("range",),
        "filters applied to the measured points, in this order",
        choices=FILTERS,
        live=True,
    )
    filters_after: tuple[str, ...] = setting(
        (), "filters applied to the deskewed points, in this order", choices=FILTERS, live=True
    )
    range_min: float = setting(
        0.0, "filter range: shortest range to keep", unit="m", lo=0.0, hi=1000.0, live=True
    )
    range_max: float = setting(
        1000.0, "filter range: longest range to keep", unit="m", lo=0.0, hi=1000.0, live=True
    )
    vertical_min: float = setting(
        -90.0, "filter vertical: lowest elevation", unit="deg", lo=-90.0, hi=90.0, live=True
    )
    vertical_max: float = setting(
        90.0, "filter vertical: highest elevation", unit="deg", lo=-90.0, hi=90.0, live=True
    )
    azimuth_min: float = setting(
        -180.0,
        "filter azimuth: start of the window, counterclockwise from +x",
        unit="deg",
        lo=-360.0,
        hi=360.0,
        live=True,
    )
    azimuth_max: float = setting(
        180.0,
        "filter azimuth: end of the window; less than the start wraps across 180 deg",
        unit="deg",
        lo=-360.0,
        hi=360.0,
        live=True,
    )
    keep_boxes: tuple[float, ...] = setting(
        (),
        "filter keep_boxes: x y z of two opposite corners per box",
        unit="m",
        live=True,
    )
    remove_boxes: tuple[float, ...] = setting(
        (),
        "filter remove_boxes: x y z of two opposite corners per box, e.g. the robot's body",
        unit="m",
        live=True,
    )
    intensity_min: float = setting(
        0.0, "filter intensity: lowest to keep", lo=0.0, hi=65535.0, live=True
    )
    intensity_max: float = setting(
        65535.0, "filter intensity: highest to keep", lo=0.0, hi=65535.0, live=True
    )
    isolated_slots: int = setting(
        3,
        "filter isolated: search window for neighbors, slots of the same packet",
        lo=1,
        hi=50,
        live=True,
    )
    isolated_neighbours: int = setting(
        1, "filter isolated: neighbors a point needs", lo=1, hi=20, live=True
    )
    isolated_distance: float = setting(
        0.08,
        "filter isolated: largest distance of a neighbor",
        unit="m",
        lo=0.0,
        hi=10.0,
        live=True,
    )
    isolated_ratio: float = setting(
        0.05,
        "filter isolated: fraction of the range added to that distance",
        lo=0.0,
        hi=1.0,
        live=True,
    )
    isolated_intensity: float = setting(
        65535.0,
        "filter isolated: points brighter than this are always kept",
        lo=0.0,
        hi=65535.0,
        live=True,
    )
    voxel_size: float = setting(
        0.1,
        "filter voxel: voxel size; one point per voxel is kept",
        unit="m",
        lo=0.001,
        hi=100.0,
        live=True,
    )
    statistical_neighbours: int = setting(
        16, "filter statistical: neighbors in the mean distance", lo=1, hi=200, live=True
    )
    statistical_ratio: float = setting(
        2.0,
        "filter statistical: standard deviations above the mean that remove a point",
        lo=0.01,
        hi=100.0,
        live=True,
    )
    radius: float = setting(
        0.3,
        "filter radius: radius in which neighbors are counted",
        unit="m",
        lo=0.001,
        hi=100.0,
        live=True,
    )
    radius_neighbours: int = setting(
        3, "filter radius: neighbors a point needs", lo=1, hi=1000, live=True
    )

    def __post_init__(self) -> None:
        """Check settings against each other."""
        for low, high in (
            ("range_min", "range_max"),
            ("vertical_min", "vertical_max"),
            ("intensity_min", "intensity_max"),
        ):
            if getattr(self, low) > getattr(self, high):
                raise SettingError(
                    f"parameter '{low}': {getattr(self, low)} is out of range, expected at most "
                    f"{high} ({getattr(self, high)})"
                )
        for name in ("keep_boxes", "remove_boxes"):
            if len(getattr(self, name)) % 6:
                raise SettingError(
                    f"parameter '{name}': {len(getattr(self, name))} numbers are not valid, "
                    "expected six per box: x y z x y z"
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcConfig:
    """All settings of the deskew."""

    motion: MotionConfig = field(default_factory=MotionConfig)
    deskew: DeskewConfig = field(default_factory=DeskewConfig)
    filters: FilterConfig = field(default_factory=FilterConfig)


@dataclass(frozen=True, slots=True, kw_only=True)
class DeskewTopics:
    """Topics of a deskew node."""

    cloud_topic: str = setting("/points", "input clouds with per-point times", form=TOPIC)
    imu_topic: str = setting("/imu/data", "IMU samples", form=TOPIC)
    velocity_topic: str = setting(
        "odometry", "velocity of the sensor or of its carrier", form=TOPIC
    )
    velocity_type: str = setting(
        "odometry",
        "message type of velocity_topic: nav_msgs/Odometry or geometry_msgs/TwistStamped",
        choices=("odometry", "twist", "none"),
    )
    output_topic: str = setting("points_deskewed", "deskewed clouds", form=TOPIC)
    qos_reliability: str = setting(
        "reliable", "QoS reliability of the output", choices=("best_effort", "reliable")
    )
    point_layout: str = setting(
        AS_INPUT,
        "fields of the output; the time field is dropped once points are deskewed",
        choices=(AS_INPUT, *LAYOUTS),
    )
    ring_count: int = setting(
        RINGS,
        "rings from the horizon to the zenith, in layouts with rings; LIO-SAM's N_SCAN",
        lo=16,
        hi=RINGS,
    )
    input_reliability: str = setting(
        "best_effort",
        "QoS reliability requested for clouds and IMU; reliable matches reliable publishers only",
        choices=("best_effort", "reliable"),
    )
    use_tf: bool = setting(True, "take mounts from /tf_static; fall back to imu_xyz and imu_rpy")


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanConfig:
    """A level slice of the deskewed clouds as a LaserScan."""

    publish: str = setting(
        "subscribed",
        "when to publish scans: while there is a subscriber, always, or never",
        name="publish_scan",
        choices=("subscribed", "always", "never"),
    )
    topic: str = setting("scan", "LaserScan of the deskewed clouds", name="scan_topic", form=TOPIC)
    frame: str = setting(
        "",
        "frame of the scan with its z axis up, such as base_link; /tf_static must connect it to "
        "the cloud frame; empty means <l2_name>_level: at the sensor, level with gravity, "
        "published on /tf",
        name="scan_frame",
        form=FRAME,
    )
    height_min: float = setting(
        -0.1,
        "lowest point of the slice above the origin of the scan's frame",
        name="scan_height_min",
        unit="m",
        lo=-100.0,
        hi=100.0,
        live=True,
    )
    height_max: float = setting(
        0.1,
        "highest point of the slice above the origin of the scan's frame",
        name="scan_height_max",
        unit="m",
        lo=-100.0,
        hi=100.0,
        live=True,
    )
    angle_increment: float = setting(
        0.0174533,
        "angle between two ranges of the scan; rounded so that it divides a full turn",
        name="scan_angle_increment",
        unit="rad",
        lo=0.001,
        hi=0.5,
        live=True,
    )
    range_min: float = setting(
        0.1, "shortest range of the scan", name="scan_range_min", unit="m", lo=0.0, hi=100.0,
        live=True,
    )  # fmt: skip
    range_max: float = setting(
        30.0, "longest range of the scan", name="scan_range_max", unit="m", lo=0.0, hi=100.0,
        live=True,
    )  # fmt: skip
    sweeps: int = setting(
        4,
        "sweeps in a scan: one sweep covers about every fourth degree, earlier ones fill gaps",
        name="scan_sweeps",
        lo=1,
        hi=40,
        live=True,
    )

    def __post_init__(self) -> None:
        """Check limits against each other."""
        for low, high in (("height_min", "height_max"), ("range_min", "range_max")):
            if getattr(self, low) >= getattr(self, high):
                raise SettingError(
                    f"parameter 'scan_{low}': {getattr(self, low)} is out of range, expected less "
                    f"than scan_{high} ({getattr(self, high)})"
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class DeskewNodeConfig:
    """All settings of the deskew node."""

    topics: DeskewTopics = field(default_factory=DeskewTopics)
    scan: ScanConfig = field(default_factory=ScanConfig)
    proc: ProcConfig = field(default_factory=ProcConfig)
    lifecycle: LifecycleConfig = field(default_factory=LifecycleConfig)
