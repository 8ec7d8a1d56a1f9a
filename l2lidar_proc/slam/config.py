"""Settings of the SLAM back end."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from l2lidar_node.config import LifecycleConfig
from l2lidar_node.files import DATA_DIR
from l2lidar_node.settings import FOLDER, FRAME, TOPIC, SettingError, setting


@dataclass(frozen=True, slots=True, kw_only=True)
class SubmapConfig:
    """How sweeps are joined to submaps."""

    submap_length_m: float = setting(
        5.0, "distance traveled after which a submap is closed", unit="m", lo=1.0, hi=50.0
    )
    map_voxel_m: float = setting(
        0.1, "voxel size of a submap; one point per voxel is kept", unit="m", lo=0.02, hi=1.0
    )
    map_range_m: float = setting(
        30.0, "largest range of points that enter the map", unit="m", lo=2.0, hi=60.0
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftConfig:
    """Assumed drift of the odometry between submaps."""

    drift_percent: float = setting(
        0.5,
        "standard deviation of an edge's translation, relative to its length",
        unit="%",
        lo=0.01,
        hi=10.0,
    )
    turn_drift_deg: float = setting(
        0.05,
        "standard deviation of an edge's rotation, per 10 m of its length",
        unit="deg",
        lo=0.001,
        hi=5.0,
    )
    systematic_percent: float = setting(
        1.0,
        "horizontal drift that may add up over the whole distance since a place",
        unit="%",
        lo=0.0,
        hi=10.0,
    )
    systematic_height_percent: float = setting(
        0.3, "vertical drift that may add up over that distance", unit="%", lo=0.0, hi=10.0
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopConfig:
    """When to search for a loop, and when to accept it."""

    loops: bool = setting(True, "close loops; false needs no gtsam")
    loop_min_way_m: float = setting(
        20.0, "distance traveled before a place is searched for again", unit="m", lo=5.0, hi=1000.0
    )
    min_overlap: float = setting(
        0.4,
        "fraction of each submap that must lie in the space that the other one observed",
        lo=0.1,
        hi=1.0,
    )
    min_agreement: float = setting(
        0.85,
        "fraction of the overlap that must lie on surfaces of the other submap",
        lo=0.3,
        hi=1.0,
    )
    max_free_space: float = setting(
        0.04,
        "fraction of the overlap that may lie in space that the other submap saw as free",
        lo=0.0,
        hi=0.5,
    )
    max_second_best: float = setting(
        0.5,
        "largest ambiguity: points that contradict the best pose, divided by those that "
        "contradict the second best",
        lo=0.05,
        hi=1.0,
    )
    loop_votes: int = setting(
        3, "submaps whose loops must agree with each other before any is accepted", lo=2, hi=20
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalizationConfig:
    """How the pose in a saved map is found and tracked."""

    relocalize: str = setting(
        "auto",
        "search for the pose: auto, whenever it is unknown; service, on ~/relocalize; never, only "
        "around an initial pose",
        choices=("auto", "service", "never"),
    )
    query_step_m: float = setting(
        2.0, "distance traveled between two matches with the map", unit="m", lo=0.5, hi=20.0
    )
    max_jump_m: float = setting(
        1.0, "a larger correction needs two matches that agree", unit="m", lo=0.05, hi=100.0
    )
    dead_reckoning_m: float = setting(
        20.0,
        "distance without a match after which the state is DEAD_RECKONING, and an initial pose is "
        "given up where the place may be searched for",
        unit="m",
        lo=2.0,
        hi=1000.0,
    )
    lost_sigma_m: float = setting(
        2.0, "position uncertainty above which the state is LOST", unit="m", lo=0.1, hi=100.0
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SlamConfig:
    """All settings of the back end."""

    mode: str = setting(
        "mapping",
        "mapping: the map grows; localization: the saved map stays as it is",
        choices=("mapping", "localization"),
    )
    submaps: SubmapConfig = field(default_factory=SubmapConfig)
    drift: DriftConfig = field(default_factory=DriftConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    localization: LocalizationConfig = field(default_factory=LocalizationConfig)


@dataclass(frozen=True, slots=True, kw_only=True)
class SlamTopics:
    """Topics, frames and files of slam_node."""

    odometry_topic: str = setting("odometry", "pose of the body for each sweep", form=TOPIC)
    cloud_topic: str = setting(
        "deskewed_points", "deskewed clouds in the body frame, stamped as the odometry", form=TOPIC
    )
    odometry_status_topic: str = setting(
        "odometry_status", "status of each sweep from odometry_node", form=TOPIC
    )
    initial_pose_topic: str = setting(
        "/initialpose", "pose estimate in the map, as RViz sends it", form=TOPIC
    )
    pose_topic: str = setting("pose", "pose of the body in map_frame", form=TOPIC)
    map_topic: str = setting("map_points", "points of the whole map in map_frame", form=TOPIC)
    path_topic: str = setting("map_path", "corrected path in map_frame", form=TOPIC)
    graph_topic: str = setting("graph", "submaps and loops as markers", form=TOPIC)
    status_topic: str = setting("slam_status", "state of the back end", form=TOPIC)
    keyframe_topic: str = setting(
        "keyframes",
        "pose of each finished submap in the odometry frame, with the covariance of the motion "
        "since the one before; for other back ends",
        form=TOPIC,
    )
    keyframe_points_topic: str = setting(
        "keyframe_points", "points of that submap, same stamp and frame", form=TOPIC
    )
    map_frame: str = setting("map", "frame of the map", form=FRAME)
    publish_tf: bool = setting(True, "publish the transform from odom to map_frame")
    tf_rate: float = setting(
        30.0, "rate of the transform and of the pose", unit="Hz", lo=1.0, hi=100.0
    )
    transform_tolerance: float = setting(
        0.5,
        "how far ahead of the newest odometry the transform is stamped; corrections take effect "
        "later by this time (AMCL's default is 1 s)",
        unit="s",
        lo=0.0,
        hi=2.0,
    )
    blend_s: float = setting(
        0.0,
        "time over which the transform follows a correction; 0 applies it at once",
        unit="s",
        lo=0.0,
        hi=30.0,
        live=True,
    )
    map_period_s: float = setting(
        5.0, "period of map and path; 0 turns them off", unit="s", lo=0.0, hi=3600.0
    )
    data_dir: str = setting(
        DATA_DIR,
        "folder of saved maps; nothing is written outside it",
        form=FOLDER,
    )
    map_name: str = setting("map", "folder of the map within data_dir", live=True)
    load_map: bool = setting(False, "start with the saved map")
    autosave_s: float = setting(
        60.0,
        "time between saves of a growing map, the last one when the node ends; 0 turns them off",
        unit="s",
        lo=0.0,
        hi=86400.0,
    )
    initial_pose: tuple[float, ...] = setting(
        (), "x, y [m] and yaw [deg] in the saved map at the start; empty if unknown"
    )

    def __post_init__(self) -> None:
        """Check the initial pose and the name of the map."""
        if len(self.initial_pose) not in (0, 3):
            raise SettingError(
                f"parameter 'initial_pose': {list(self.initial_pose)} has "
                f"{len(self.initial_pose)} numbers, expected x, y, yaw or none"
            )
        check_map_name(self.map_name)


@dataclass(frozen=True, slots=True, kw_only=True)
class SlamNodeConfig:
    """All settings of slam_node."""

    topics: SlamTopics = field(default_factory=SlamTopics)
    slam: SlamConfig = field(default_factory=SlamConfig)
    lifecycle: LifecycleConfig = field(default_factory=LifecycleConfig)


def check_map_name(name: str) -> str:
    """Return the name of a map's folder.

    Raises
    ------
    SettingError
        If it is not a plain name: a map is never written outside data_dir.
    """
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}", name):
        raise SettingError(
            f"parameter 'map_name': {name!r} is not the name of a folder, expected at most 64 "
            "letters, digits, '_', '-' and '.', not starting with '.' or '-'"
        )
    return name
