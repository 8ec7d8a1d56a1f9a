"""Settings of the odometry and its node."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

from l2lidar_node.config import LifecycleConfig
from l2lidar_node.files import DATA_DIR
from l2lidar_node.settings import FILE_NAME, FOLDER, FRAME, TOPIC, SettingError, setting
from l2lidar_proc.motion.config import ImuConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class InertialConfig:
    """Noise model of the IMU."""

    gyro_noise: float = setting(
        0.1,
        "gyro noise per axis and sample at 250 Hz, used for an L2 until a rest has shown that of "
        "the unit; raised when the data show more",
        unit="rad/s",
        lo=1e-4,
        hi=10.0,
    )
    accel_noise: float = setting(
        0.15,
        "accelerometer noise per axis and sample at 250 Hz; raised when the data show more",
        unit="m/s^2",
        lo=1e-3,
        hi=100.0,
    )
    gyro_bias_walk: float = setting(
        1e-4, "random walk of the gyro bias", unit="rad/s/sqrt(s)", lo=0.0, hi=1.0
    )
    accel_bias_walk: float = setting(
        1e-3, "random walk of the accelerometer bias", unit="m/s^2/sqrt(s)", lo=0.0, hi=10.0
    )
    imu_gap_ms: float = setting(
        50.0,
        "longer gaps between IMU samples are bridged by constant velocity",
        unit="ms",
        lo=5.0,
        hi=1000.0,
    )
    use_accelerometer: bool = setting(
        True,
        "use the accelerometer; without it velocity and gravity come from the clouds",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceConfig:
    """The map of small flat surfaces that sweeps are aligned with."""

    surface_sizes: tuple[float, ...] = setting(
        (0.15, 0.3, 0.6, 1.5),
        "voxel sizes of the map's levels, fine to coarse",
        unit="m",
        lo=0.05,
        hi=10.0,
    )
    surface_thickness: float = setting(
        0.03,
        "largest scatter of a voxel's points about their plane",
        unit="m",
        lo=0.005,
        hi=0.5,
    )
    surface_points: int = setting(8, "points a voxel needs before it is matched", lo=4, hi=100)
    surface_capacity: int = setting(
        400, "points after which a voxel is no longer updated", lo=10, hi=100_000
    )
    point_noise: float = setting(
        0.05,
        "noise of a point's distance to its plane, including error that neighbors share",
        unit="m",
        lo=0.002,
        hi=1.0,
        live=True,
    )
    outlier_scale: float = setting(
        0.05,
        "distance at which the robust kernel leaves a point a quarter of its weight",
        unit="m",
        lo=0.005,
        hi=5.0,
        live=True,
    )
    source_voxel: float = setting(
        0.2,
        "voxel size for downsampling a sweep before alignment",
        unit="m",
        lo=0.02,
        hi=5.0,
        live=True,
    )
    source_points: int = setting(
        3000, "maximum number of points to align", lo=100, hi=100_000, live=True
    )
    iterations: int = setting(
        5, "maximum number of Gauss-Newton iterations", lo=1, hi=50, live=True
    )

    def __post_init__(self) -> None:
        """Check the levels of the map."""
        sizes = self.surface_sizes
        if not sizes or any(fine >= coarse for fine, coarse in pairwise(sizes)):
            raise SettingError(
                f"parameter 'surface_sizes': {list(sizes)} is not valid; expected at least one "
                "edge, each larger than the one before"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class KissConfig:
    """KISS-ICP's own settings: for its registration, its map, and the `plain` mode."""

    kiss_voxel_size: float = setting(
        0.5, "voxel size of KISS-ICP's local map", unit="m", lo=0.05, hi=10.0
    )
    kiss_max_points_per_voxel: int = setting(
        20, "points per voxel of KISS-ICP's map", lo=1, hi=1000
    )
    kiss_initial_threshold: float = setting(
        1.0, "initial threshold of KISS-ICP", unit="m", lo=0.01, hi=20.0
    )
    kiss_min_motion: float = setting(
        0.1,
        "smallest deviation that updates KISS-ICP's threshold",
        unit="m",
        lo=0.001,
        hi=5.0,
    )
    kiss_iterations: int = setting(100, "maximum number of KISS-ICP iterations", lo=1, hi=1000)
    kiss_convergence: float = setting(1e-4, "convergence criterion of KISS-ICP", lo=1e-8, hi=0.1)
    threads: int = setting(1, "threads of KISS-ICP; 0 uses all cores", lo=0, hi=64)


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryConfig:
    """All settings of the odometry."""

    mode: str = setting(
        "inertial",
        "inertial: LiDAR-inertial odometry; plain: unmodified KISS-ICP",
        choices=("inertial", "plain"),
    )
    reference: str = setting(
        "middle", "instant of a sweep whose pose is estimated", choices=("start", "middle", "end")
    )
    min_range: float = setting(
        0.4,
        "nearer points are dropped, such as the carrier's own body",
        unit="m",
        lo=0.0,
        hi=100.0,
        live=True,
    )
    max_range: float = setting(
        100.0,
        "farther points are dropped; the map is pruned beyond this range",
        unit="m",
        lo=1.0,
        hi=1000.0,
    )
    min_points: int = setting(
        30, "a sweep with fewer points is predicted instead of aligned", lo=10, hi=100_000
    )
    correct_beams: bool = setting(
        True,
        "estimate the unit's errors of xi, beta, alpha and the ranges from the clouds, and "
        "correct these; a cloud without the pattern of an L2 is left as it is",
    )
    max_speed: float = setting(
        30.0,
        "largest speed of the carrier; a faster estimate is bounded and SUSPECT; 3 suits a "
        "handheld sensor",
        unit="m/s",
        lo=0.1,
        hi=1000.0,
        live=True,
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
class OdometryTopics(ImuConfig):
    """Topics and frames of an odometry node."""

    cloud_topic: str = setting(
        "/points", "input clouds with per-point times, not deskewed", form=TOPIC
    )
    imu_topic: str = setting("/imu/data", "IMU samples", form=TOPIC)
    time_unit: str = setting(
        "auto",
        "unit of the per-point times; auto infers it from type and range",
        choices=("auto", "s", "ms", "us", "ns"),
        live=True,
    )
    odometry_topic: str = setting(
        "odometry", "pose and twist of base_frame, once per sweep", form=TOPIC
    )
    fast_odometry_topic: str = setting(
        "odometry_imu", "pose and twist propagated by the IMU, see imu_rate", form=TOPIC
    )
    path_topic: str = setting("path", "trajectory of base_frame", form=TOPIC)
    map_topic: str = setting("local_map", "local map in odom_frame", form=TOPIC)
    registered_topic: str = setting(
        "registered_points", "deskewed cloud in odom_frame", form=TOPIC
    )
    deskewed_topic: str = setting(
        "deskewed_points", "deskewed cloud in base_frame, stamped as the odometry", form=TOPIC
    )
    status_topic: str = setting(
        "odometry_status", "status of each estimate, stamped as the odometry", form=TOPIC
    )
    covariance_when_lost: bool = setting(
        False,
        "put 9999 in all variances of an estimate that is LOST, RESTARTED or RETURNED: rtabmap "
        "then begins a new map",
        live=True,
    )
    qos_reliability: str = setting(
        "reliable", "QoS reliability of the published topics", choices=("best_effort", "reliable")
    )
    odom_frame: str = setting("odom", "frame of the poses", form=FRAME)
    base_frame: str = setting(
        "",
        "frame whose pose is published, connected to the cloud frame by /tf_static; empty means "
        "the cloud frame",
        form=FRAME,
    )
    publish_tf: bool = setting(True, "publish the transform between odom_frame and base_frame")
    invert_tf: bool = setting(
        False, "publish base_frame as the parent of odom_frame, for a base_frame that has a parent"
    )
    use_tf: bool = setting(True, "take mounts from /tf_static; fall back to imu_xyz and imu_rpy")
    imu_wait_ms: int = setting(
        50, "longest wait for IMU samples that cover the end of a sweep", unit="ms", lo=0, hi=1000
    )
    max_skipped: int = setting(
        3,
        "largest number of consecutive sweeps that are not aligned while two or more clouds wait; "
        "the IMU carries the pose; 0 aligns every sweep, even if the poses fall behind",
        lo=0,
        hi=10,
    )
    imu_rate: float = setting(
        50.0,
        "rate of IMU-propagated odometry and TF; 0 gives TF once per sweep",
        unit="Hz",
        lo=0.0,
        hi=250.0,
    )
    map_period_s: float = setting(
        2.0, "period of local maps; 0 turns them off", unit="s", lo=0.0, hi=3600.0, live=True
    )
    path_length: int = setting(
        2000,
        "poses kept in path, 5 cm or 5 degrees apart; the oldest are dropped",
        lo=1,
        hi=100_000,
        live=True,
    )

    def __post_init__(self) -> None:
        """Check the frames."""
        ImuConfig.__post_init__(self)  # slots leave no place for super()
        if self.odom_frame in ("", self.base_frame):
            raise SettingError(
                f"parameter 'odom_frame': {self.odom_frame!r} is not valid; expected a frame name "
                "other than base_frame's"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class DataConfig:
    """Files that services write, all in one folder."""

    data_dir: str = setting(
        DATA_DIR, "folder for the files of services; nothing is written outside it", form=FOLDER
    )
    overwrite: bool = setting(False, "let services replace files that exist")
    map_file: str = setting(
        "map.ply", "file that ~/save_map writes in data_dir, .ply or .pcd", form=FILE_NAME,
        live=True,
    )  # fmt: skip
    trajectory_file: str = setting(
        "trajectory.tum", "file that ~/save_trajectory writes in data_dir in TUM format, with "
        "KITTI beside it", form=FILE_NAME, live=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        """Check the suffixes, which select the formats."""
        if not self.map_file.endswith((".ply", ".pcd")):
            raise SettingError(
                f"parameter 'map_file': '{self.map_file}' is not valid; expected .ply or .pcd"
            )
        if self.trajectory_file.endswith(".kitti"):
            raise SettingError(
                f"parameter 'trajectory_file': '{self.trajectory_file}' is not valid; expected "
                "another suffix, since the KITTI file beside it has this one"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryNodeConfig:
    """All settings of the odometry node."""

    topics: OdometryTopics = field(default_factory=OdometryTopics)
    files: DataConfig = field(default_factory=DataConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    lifecycle: LifecycleConfig = field(default_factory=LifecycleConfig)
