"""The driver's settings against upstream's README, name by name, written down by hand."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from l2lidar_node.config import DriverConfig, FrameConfig, NetworkConfig, SweepConfig
from l2lidar_node.settings import SettingError, build, change, settings_of, values_of

# Name: (type, default, live), as in the table of upstream's README.
UPSTREAM = {
    "l2_ip": (str, "192.168.1.62", False),
    "l2_port": (int, 6101, False),
    "host_ip": (str, "192.168.1.2", False),
    "host_port": (int, 6201, False),
    "frame3d": (bool, True, False),
    "imu_adjust": (bool, True, True),
    "imuRollPitchOnly": (bool, True, True),
    "enable_l2_time_correction": (bool, True, False),
    "enable_l2_host_sync": (bool, True, False),
    "l2_sync_rate_ms": (int, 50, False),
    "timeScaleNum": (int, 2, False),
    "timeScaleDenom": (int, 1, False),
    "UseSystemTimeTS": (bool, False, True),
    "enable_latency_measure": (bool, False, False),
    "l2_name": (str, "l2lidar", False),
    "cloud_frame": (str, "", False),
    "publish_tf": (bool, True, False),
    "enable_IMU_publishing": (bool, False, False),
    "accel_x_covar": (float, 0.01, False),
    "accel_y_covar": (float, 0.01, False),
    "accel_z_covar": (float, 0.01, False),
    "gyro_x_covar": (float, 0.000025, False),
    "gyro_y_covar": (float, 0.000025, False),
    "gyro_z_covar": (float, 0.0000002, False),
    "roll_covar": (float, 4.9e-9, False),
    "pitch_covar": (float, 4.9e-9, False),
    "yaw_covar": (float, 10.0, False),
    "aggregateNframes": (int, 38, True),
    "EnableCalRangeOVR": (bool, False, True),
    "calRangeScale": (float, 0.000978, True),
    "calRangeBias": (float, -365.625, True),
    "watchdog_timeout_ms": (int, 35000, False),
    "point_cloud_topic_id": (str, "/points", False),
    "imu_topic_id": (str, "/imu/data", False),
    "standby_on_powerup_enabled": (bool, False, False),
}
SETTINGS = {item.name: item for item in settings_of(DriverConfig)}
UPSTREAMS_MANNER = {
    "EnableCalAngleOVR",
    "calAlphaAngleBias",
    "calBetaAngle",
    "calXiAngle",
    "calThetaAngleBias",
    "calBAxisDist",
}
"""Settings of ours that stand beside upstream's EnableCalRangeOVR, named as it is."""


@pytest.mark.parametrize("name", UPSTREAM)
def test_a_setting_of_upstream(name: Any) -> None:
    item = SETTINGS[name]
    assert (item.type, item.default, item.live) == UPSTREAM[name]


def test_upstreams_whole_file_is_taken() -> None:
    values = {name: default for name, (_, default, _) in UPSTREAM.items()}
    assert build(DriverConfig, values) == DriverConfig()


@pytest.mark.parametrize("name", sorted(set(SETTINGS) - set(UPSTREAM) - UPSTREAMS_MANNER))
def test_a_setting_of_ours_is_in_snake_case(name: Any) -> None:
    assert name == name.lower()
    assert name.isidentifier()


def test_names_are_unique_and_described() -> None:
    items = list(settings_of(DriverConfig))
    assert len(items) == len(SETTINGS)
    for item in items:
        assert item.doc
        assert item.type is bool or item.type is str or item.range_text, item.name


def test_every_default_is_in_its_range() -> None:
    for item in SETTINGS.values():
        assert item.check(item.default) == item.default


@pytest.mark.parametrize(
    ("name", "lo", "hi"),
    [
        ("aggregateNframes", 0, 4000),
        ("calRangeScale", 0.00025, 0.002),
        ("calRangeBias", -1000.0, 0.0),
        ("l2_port", 1, 65535),
        ("host_port", 1, 65535),
    ],
)
def test_ranges_are_upstreams_and_inclusive(name: str, lo: float, hi: float) -> None:
    for value in (lo, hi):
        assert values_of(build(DriverConfig, {name: value}))[name] == value
    for value in (lo - 0.001 if isinstance(lo, float) else lo - 1, hi + 1):
        with pytest.raises(SettingError, match=f"parameter '{name}': .* out of range, expected "):
            build(DriverConfig, {name: value})


@pytest.mark.parametrize(
    ("name", "value", "expectation"),
    [
        ("l2_ip", "192.168.1", "is not an IPv4 address .*, expected four numbers"),
        ("l2_ip", "lidar.local", "is not an IPv4 address"),
        ("l2_ip", "192.168.001.062", "is not an IPv4 address"),
        ("host_ip", "::1", "is not an IPv4 address"),
        ("host_ip", "", "is not an IPv4 address"),
        ("l2_port", "6101", "is of type str, expected int"),
        ("l2_sync_rate_ms", 0, "is out of range, expected 10 to 600000 ms"),
        ("l2_sync_mode", "never", "is not known, expected one of 'once', 'periodic'"),
        ("timeScaleNum", 0, "is out of range"),
        ("timeScaleNum", 7, r"is out of range, expected 0.5 to 3 times timeScaleDenom \(1\)"),
        ("sweep_cut", "turns", "is not known, expected one of 'packets', 'turn', 'half_turn'"),
        ("sweep_duration_ms", 4, "is out of range, expected 5 to 20000 ms"),
        ("range_min", 100.0, r"is out of range, expected less than range_max \(100.0\)"),
        ("imu_adjust", 1, "is of type int, expected bool"),
        ("gyro_x_covar", -1e-9, "is out of range"),
        ("l2_name", "/front", "is not a frame name"),
        ("cloud_frame", "my lidar", "is not a frame name, expected letters"),
        ("point_cloud_topic_id", "", "is not a topic name, expected names such as /front/points"),
        ("point_cloud_topic_id", "/a//b", "is not a topic name"),
        ("point_cloud_topic_id", "points/", "is not a topic name"),
        ("imu_topic_id", "/imu/1data", "is not a topic name"),
        ("imu_topic_id", "imu data", "is not a topic name"),
        ("qos_reliability", "best", "is not known, expected one of 'best_effort', 'reliable'"),
        ("point_layout", "xyz", "is not known, expected one of 'native'"),
        ("watchdog_timeout_ms", 99, "is out of range, expected 100 to 3600000 ms"),
        ("watchdog_action", "restart", "is not known, expected one of 'shutdown', 'wait'"),
    ],
)  # fmt: skip
def test_a_bad_value_is_refused(name: str, value: Any, expectation: str) -> None:
    with pytest.raises(SettingError, match=f"^parameter '{name}': .*{expectation}"):
        build(DriverConfig, {name: value})


@pytest.mark.parametrize(("num", "denom"), [(2, 1), (1998, 1000), (1, 1), (1, 2), (3, 1)])
def test_first_guesses_of_the_clock_ratio(num: int, denom: int) -> None:
    config = build(DriverConfig, {"timeScaleNum": num, "timeScaleDenom": denom})
    assert (config.clock.time_scale_num, config.clock.time_scale_denom) == (num, denom)


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ("aggregate_n_frames", "aggregateNframes"),
        ("UseSystemTimeStamp", "UseSystemTimeTS"),
        ("enable_imu_publishing", "enable_IMU_publishing"),
        ("calRangebias", "calRangeBias"),
        ("watchdog_timeout", "watchdog_timeout_ms"),
    ],
)
def test_a_typing_error_gets_a_suggestion(wrong: str, right: str) -> None:
    with pytest.raises(SettingError, match=f"'{wrong}' is not known; did you mean '{right}'?"):
        build(DriverConfig, {wrong: 1})


def test_several_live_changes_are_made_together_or_not_at_all() -> None:
    config = DriverConfig()
    changed = change(config, {"aggregateNframes": 10, "calRangeBias": -525.5, "imu_adjust": False})
    assert changed.sweep.packets == 10
    assert changed.sweep.range_bias == -525.5
    assert changed.imu.adjust is False
    with pytest.raises(SettingError, match="calRangeScale"):
        change(config, {"aggregateNframes": 10, "calRangeScale": 1.0})
    assert config == DriverConfig()


@pytest.mark.parametrize(
    ("l2_name", "cloud_frame", "cloud", "imu"),
    [
        ("l2lidar", "", "l2lidar_link", "l2lidar_imu"),
        ("l2lidar", "front_lidar_link", "front_lidar_link", "front_lidar_imu"),
        ("l2", "bot1/lidar/l2lidar_link", "bot1/lidar/l2lidar_link", "bot1/lidar/l2lidar_imu"),
        ("l2lidar", "my_lidar", "my_lidar", "my_lidar_imu"),
        ("rear", "", "rear_link", "rear_imu"),
        ("blink", "", "blink_link", "blink_imu"),
        ("rear", "roof_link", "roof_link", "roof_imu"),
        ("l2lidar", "link_link_x", "link_link_x", "link_link_x_imu"),
    ],
)  # fmt: skip
def test_frame_names_follow_upstreams_table(
    l2_name: str, cloud_frame: str, cloud: str, imu: str
) -> None:
    frames = FrameConfig(l2_name=l2_name, cloud_frame=cloud_frame)
    assert (frames.cloud, frames.imu) == (cloud, imu)


def test_groups_check_themselves_however_they_are_made() -> None:
    with pytest.raises(SettingError, match="'host_ip'"):
        NetworkConfig(host_ip="somewhere")
    with pytest.raises(SettingError, match="'range_min'"):
        SweepConfig(range_min=5.0, range_max=1.0)


@pytest.mark.parametrize("layout", ["ouster_legacy", "autoware"])
@pytest.mark.parametrize(
    ("name", "most", "more"),
    [
        ("aggregateNframes", 925, {}),
        ("aggregateNframes", 214, {"frame3d": False}),
        ("sweep_duration_ms", 4290, {"sweep_cut": "duration"}),
        ("sweep_duration_ms", 4274, {"sweep_cut": "duration", "frame3d": False}),
        ("sweep_duration_ms", 4274, {"sweep_cut": "half_turn", "frame3d": False}),
    ],
)
def test_sweeps_fit_into_the_times_of_their_layout(
    layout: str, name: str, most: int, more: dict[str, Any]
) -> None:
    config = build(DriverConfig, {"point_layout": layout, name: most, **more})
    with pytest.raises(SettingError) as caught:
        change(config, {name: most + 1})  # as a live change does
    for word in (f"parameter '{name}'", str(most + 1), f"at most {most}", layout):
        assert word in str(caught.value)
    change(config, {name: most + 1, "point_layout": "velodyne"})


def test_only_the_limit_of_the_cut_in_use_counts() -> None:
    long = {"aggregateNframes": 4000, "sweep_duration_ms": 20_000, "point_layout": "autoware"}
    config = build(DriverConfig, {**long, "sweep_cut": "half_turn"})
    for cut, name in (("packets", "aggregateNframes"), ("duration", "sweep_duration_ms")):
        with pytest.raises(SettingError, match=name):
            change(config, {"sweep_cut": cut})


def test_a_choice_means_itself_in_a_parameter_file() -> None:
    """YAML takes off, on, yes, no and null for other things, also after ``-p NAME:=``."""
    choices = [word for found in settings_of(DriverConfig) for word in found.choices]
    assert choices
    assert [yaml.safe_load(word) for word in choices] == choices
