"""Settings of the SLAM back end."""

from __future__ import annotations

from dataclasses import dataclass, field

from l2lidar_node.settings import setting


@dataclass(frozen=True, slots=True, kw_only=True)
class SubmapConfig:
    """How the odometry's sweeps become submaps."""

    submap_length_m: float = setting(
        5.0, "way after which a submap is closed", unit="m", lo=1.0, hi=50.0
    )
    map_voxel_m: float = setting(
        0.1, "edge of the cubes of which a submap keeps one point each", unit="m", lo=0.02, hi=1.0
    )
    map_range_m: float = setting(
        30.0, "farther points do not enter the map", unit="m", lo=2.0, hi=60.0
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftConfig:
    """What the odometry is trusted with between submaps."""

    drift_percent: float = setting(
        0.5, "standard deviation of an edge, part of its way", unit="%", lo=0.01, hi=10.0
    )
    turn_drift_deg: float = setting(
        0.05, "standard deviation of an edge's rotation, per 10 m of way", unit="deg", lo=0.001, hi=5.0
    )
    systematic_percent: float = setting(
        1.0, "drift in plan that may add up over the whole way since a place", unit="%", lo=0.0, hi=10.0
    )
    systematic_height_percent: float = setting(
        0.3, "drift in height that may add up likewise", unit="%", lo=0.0, hi=10.0
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopConfig:
    """When a loop is looked for, and what it needs to be accepted."""

    loops: bool = setting(True, "whether loops are closed", live=True)
    loop_min_way_m: float = setting(
        20.0, "way since a place before it is looked for again", unit="m", lo=5.0, hi=1000.0
    )
    min_overlap: float = setting(
        0.4, "part of each submap that must lie in the space the other one saw", lo=0.1, hi=1.0
    )
    min_agreement: float = setting(
        0.85, "part of that which must lie on surfaces of the other one", lo=0.3, hi=1.0
    )
    max_free_space: float = setting(
        0.04, "part of it that may lie where the other one saw through", lo=0.0, hi=0.5
    )
    max_second_best: float = setting(
        0.5,
        "how much like the best place the second best may be: what contradicts the best, by what "
        "contradicts the other",
        lo=0.05,
        hi=1.0,
    )
    loop_votes: int = setting(
        3, "submaps whose loops must agree with each other before one is accepted", lo=2, hi=20
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalizationConfig:
    """How a place in a saved map is found and kept."""

    relocalize: str = setting(
        "auto",
        "auto: the place is searched for whenever it is unknown; service: on ~/relocalize; off: only "
        "from an initial pose",
        choices=("auto", "service", "off"),
    )
    query_step_m: float = setting(
        2.0, "way between two looks at the map", unit="m", lo=0.5, hi=20.0
    )
    max_jump_m: float = setting(
        1.0, "a larger correction needs two looks that agree", unit="m", lo=0.05, hi=100.0
    )
    dead_reckoning_m: float = setting(
        20.0, "way without a look that fits before DEAD_RECKONING is said", unit="m", lo=2.0, hi=1000.0
    )
    lost_sigma_m: float = setting(
        2.0, "uncertainty of the place at which LOST is said", unit="m", lo=0.1, hi=100.0
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SlamConfig:
    """Everything the back end can be told."""

    mode: str = setting(
        "mapping",
        "mapping: the map grows; localization: it stays as it was saved",
        choices=("mapping", "localization"),
    )
    submaps: SubmapConfig = field(default_factory=SubmapConfig)
    drift: DriftConfig = field(default_factory=DriftConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    localization: LocalizationConfig = field(default_factory=LocalizationConfig)
