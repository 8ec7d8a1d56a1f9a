"""Every setting of the companion, declared once: name, default, unit, range and meaning."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.clouds.layouts import LAYOUTS
from l2lidar_node.settings import FRAME, TOPIC, SettingError, setting
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


@dataclass(frozen=True, slots=True, kw_only=True)
class InertialConfig:
    """How far the IMU is trusted between sweeps."""

    gyro_noise: float = setting(
        0.1,
        "noise of a gyro axis per sample at 250 Hz, lines included; more is taken where seen",
        unit="rad/s",
        lo=1e-4,
        hi=10.0,
    )
    accel_noise: float = setting(
        0.15,
        "noise of an accelerometer axis per sample at 250 Hz; more is taken where more is seen",
        unit="m/s^2",
        lo=1e-3,
        hi=100.0,
    )
    gyro_bias_walk: float = setting(
        1e-4, "how fast the gyro's bias may wander", unit="rad/s/sqrt(s)", lo=0.0, hi=1.0
    )
    accel_bias_walk: float = setting(
        1e-3, "how fast the accelerometer's bias may wander", unit="m/s^2/sqrt(s)", lo=0.0, hi=10.0
    )
    imu_gap_ms: float = setting(
        50.0,
        "a longer stretch without IMU sample is bridged by steady motion",
        unit="ms",
        lo=5.0,
        hi=1000.0,
    )
    use_accelerometer: bool = setting(
        True,
        "whether the accelerometer is used; off, velocity and gravity come from the clouds alone",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceConfig:
    """The map of small flat surfaces that sweeps are aligned with."""

    surface_sizes: tuple[float, ...] = setting(
        (0.15, 0.3, 0.6, 1.5),
        "edges of the cells of each level of the map, fine to coarse",
        unit="m",
        lo=0.05,
        hi=10.0,
    )
    surface_thickness: float = setting(
        0.03,
        "a cell whose points scatter more than this about a plane is not used",
        unit="m",
        lo=0.005,
        hi=0.5,
    )
    surface_points: int = setting(8, "points that a cell needs before it is used", lo=4, hi=100)
    surface_capacity: int = setting(400, "points after which a cell is final", lo=10, hi=100_000)
    point_noise: float = setting(
        0.05,
        "how far a point may be from its surface, what neighbours share included",
        unit="m",
        lo=0.002,
        hi=1.0,
        live=True,
    )
    outlier_scale: float = setting(
        0.05,
        "distance at which a point loses three quarters of its weight",
        unit="m",
        lo=0.005,
        hi=5.0,
        live=True,
    )
    source_voxel: float = setting(
        0.2, "one point per cube of this size is aligned", unit="m", lo=0.02, hi=5.0, live=True
    )
    source_points: int = setting(
        3000, "largest number of points to align", lo=100, hi=100_000, live=True
    )
    iterations: int = setting(
        5, "largest number of steps of the alignment", lo=1, hi=50, live=True
    )

    def __post_init__(self) -> None:
        """Check the levels of the map."""
        sizes = self.surface_sizes
        if not sizes or any(fine >= coarse for fine, coarse in pairwise(sizes)):
            raise SettingError(
                f"parameter 'surface_sizes': {list(sizes)} cannot be it, expected at least one "
                "edge, each larger than the one before"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class KissConfig:
    """KISS-ICP's own settings: for its registration, its map, and the `plain` mode."""

    kiss_voxel_size: float = setting(
        0.5, "voxel size of KISS-ICP's local map", unit="m", lo=0.05, hi=10.0
    )
    kiss_max_points_per_voxel: int = setting(
        20, "points kept in a voxel of KISS-ICP's map", lo=1, hi=1000
    )
    kiss_initial_threshold: float = setting(
        1.0, "KISS-ICP's first guess of how wrong the prediction is", unit="m", lo=0.01, hi=20.0
    )
    kiss_min_motion: float = setting(
        0.1,
        "deviations below this do not sharpen KISS-ICP's threshold",
        unit="m",
        lo=0.001,
        hi=5.0,
    )
    kiss_iterations: int = setting(100, "largest number of iterations of KISS-ICP", lo=1, hi=1000)
    kiss_convergence: float = setting(1e-4, "step at which KISS-ICP is done", lo=1e-8, hi=0.1)
    threads: int = setting(1, "threads of KISS-ICP; 0 = all cores", lo=0, hi=64)


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryConfig:
    """Everything that can be said to the odometry."""

    mode: str = setting(
        "inertial",
        "inertial: IMU, KISS-ICP's parts and surfaces; plain: KissICP.register_frame as it is",
        choices=("inertial", "plain"),
    )
    reference: str = setting(
        "middle", "instant of a sweep whose pose is estimated", choices=("start", "middle", "end")
    )
    min_range: float = setting(
        0.4,
        "nearer points are left out: the carrier's own parts",
        unit="m",
        lo=0.0,
        hi=100.0,
        live=True,
    )
    max_range: float = setting(
        100.0,
        "farther points are left out, and the map is forgotten beyond",
        unit="m",
        lo=1.0,
        hi=1000.0,
    )
    min_points: int = setting(
        30, "a sweep with fewer points to align is not aligned but predicted", lo=10, hi=100_000
    )
    inertial: InertialConfig = field(default_factory=InertialConfig)
    surfaces: SurfaceConfig = field(default_factory=SurfaceConfig)
    kiss: KissConfig = field(default_factory=KissConfig)

    def __post_init__(self) -> None:
        """Check the two ranges against each other."""
        if self.min_range >= self.max_range:
            raise SettingError(
                f"parameter 'min_range': {self.min_range} is out of range, "
                f"expected less than max_range ({self.max_range})"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryTopics:
    """Where an odometry node listens and speaks, and which frames it names."""

    cloud_topic: str = setting(
        "/points", "clouds with one time per point, not deskewed", form=TOPIC
    )
    imu_topic: str = setting("/imu/data", "IMU samples", form=TOPIC)
    odometry_topic: str = setting(
        "odometry", "pose and twist of base_frame, once per sweep", form=TOPIC
    )
    fast_odometry_topic: str = setting(
        "odometry_imu", "pose and twist carried on by the IMU, see imu_rate", form=TOPIC
    )
    path_topic: str = setting("path", "where base_frame has been", form=TOPIC)
    map_topic: str = setting("local_map", "local map in odom_frame", form=TOPIC)
    registered_topic: str = setting(
        "registered_points", "deskewed cloud in odom_frame", form=TOPIC
    )
    qos_reliability: str = setting(
        "reliable", "reliability of what is published", choices=("best_effort", "reliable")
    )
    odom_frame: str = setting("odom", "frame in which poses are given", form=FRAME)
    base_frame: str = setting(
        "",
        "frame whose pose is given, tied to the cloud frame by /tf_static; empty = cloud frame",
        form=FRAME,
    )
    publish_tf: bool = setting(True, "publish the transform between odom_frame and base_frame")
    invert_tf: bool = setting(
        False, "make base_frame the parent of odom_frame, for a base_frame that has a parent"
    )
    use_tf: bool = setting(
        True, "take the mounts from /tf_static where it has them; else imu_xyz holds"
    )
    imu_xyz: tuple[float, ...] = setting(
        (-0.007698, -0.014655, 0.00667), "place of the IMU in the cloud frame", unit="m"
    )
    imu_wait_ms: int = setting(
        50, "longest wait for IMU samples up to the end of a sweep", unit="ms", lo=0, hi=1000
    )
    imu_rate: float = setting(
        0.0, "rate of the odometry carried on by the IMU, 0 = none", unit="Hz", lo=0.0, hi=250.0
    )
    map_period_s: float = setting(
        2.0, "time between local maps, 0 = none", unit="s", lo=0.0, hi=3600.0, live=True
    )
    path_length: int = setting(
        2000,
        "poses that path keeps, 5 cm or 5 degrees apart; the oldest go first",
        lo=1,
        hi=100_000,
        live=True,
    )
    map_file: str = setting("map.ply", "what ~/save_map writes; .ply or .pcd", live=True)
    trajectory_file: str = setting(
        "trajectory.tum",
        "what ~/save_trajectory writes as TUM, and beside it as KITTI",
        live=True,
    )

    def __post_init__(self) -> None:
        """Check what a single setting cannot."""
        if len(self.imu_xyz) != 3:
            raise SettingError(f"parameter 'imu_xyz': {self.imu_xyz!r} has not three numbers")
        if self.odom_frame in ("", self.base_frame):
            raise SettingError(
                f"parameter 'odom_frame': {self.odom_frame!r} cannot be it, expected a frame name "
                "other than base_frame's"
            )
        if not self.map_file.endswith((".ply", ".pcd")):
            raise SettingError(f"parameter 'map_file': '{self.map_file}' is not a .ply or .pcd")

    @property
    def T_cloud_imu(self) -> NDArray[np.float64]:
        """IMU coordinates to cloud coordinates where TF does not say, shape (4, 4)."""
        pose = np.eye(4)
        pose[:3, 3] = self.imu_xyz
        return pose


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryNodeConfig:
    """Everything the odometry node can be told."""

    topics: OdometryTopics = field(default_factory=OdometryTopics)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
