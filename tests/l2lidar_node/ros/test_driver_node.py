"""The driver node as its users meet it: a process, a virtual L2 on UDP, another node on DDS."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator

import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, SetParameters, SetParametersAtomically
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

from l2lidar_node.config import DriverConfig
from l2lidar_node.demo.observer import TopicRecord
from l2lidar_node.driver.sweep import MAX_GAP_NS
from l2lidar_node.settings import settings_of
from tests.l2lidar_node.ros.rig import Rig, open_rig, publishers

pytestmark = pytest.mark.ros
PERIOD_S = 4.639e-3  # of 3D packets


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    """A driver that streams."""
    with open_rig() as rig:
        rig.unhurried_driver(aggregateNframes=38)
        rig.emulator("--boot-scale", "0.02")
        rig.wait_for(lambda: len(rig.observer.clouds.stamps) > 3, "clouds")
        yield rig


def test_topics_have_the_rates_fields_frames_and_stamps_that_users_rely_on(rig: Rig) -> None:
    clouds, imu = rig.observer.clouds, rig.observer.imu = TopicRecord(), TopicRecord()
    lengths: list[float] = []  # of every cloud [packets]

    def are_enough() -> bool:
        if len(lengths) < len(clouds.stamps):
            cloud = rig.observer.cloud
            assert cloud is not None
            assert len(lengths) == len(clouds.stamps) - 1
            assert cloud["time"][0] == 0.0
            assert (np.diff(cloud["time"]) >= 0).all()
            norms = np.sqrt(cloud["x"] ** 2 + cloud["y"] ** 2 + cloud["z"] ** 2)
            # the axis is 45 mm above the origin
            assert np.abs(norms - cloud["range"]).max() < 0.06
            lengths.append(math.ceil(cloud["time"][-1] / PERIOD_S))
        return len(lengths) >= 12

    rig.wait_for(are_enough, "twelve clouds")
    assert rig.observer.fields == ["x", "y", "z", "intensity", "range", "time"]
    assert (clouds.frame, imu.frame) == ("l2lidar_link", "l2lidar_imu")
    # Every cloud has 38 packets, unless it was handed out early because nothing came for 200 ms,
    # or is longer by what the kernel dropped while the driver was held up.
    packets = np.array(lengths)
    spans = packets * PERIOD_S
    is_short = packets < 38
    assert (~is_short | (np.array(clouds.ages_s) - spans > MAX_GAP_NS / 1e9)).all()
    # Each begins where the one before ended, but for clouds that a best-effort topic lost.
    steps = clouds.intervals_ms / 1e3
    gaps = (steps - spans[:-1]) / PERIOD_S
    assert (gaps > -0.5).all()
    np.testing.assert_allclose(gaps, np.round(gaps), atol=0.4)
    # Stamped at the first point, received after the last one.
    assert (np.array(clouds.ages_s) > spans - PERIOD_S).all()
    # An L2 sends pairs of samples 2.6 to 4.7 ms apart, 4 ms on average.
    assert imu.backward_steps == 0
    assert np.median(imu.intervals_ms) == pytest.approx(4.0, abs=0.05)
    # What is missing within and between clouds, the driver has counted.
    rig.observer.diagnostics.clear()
    rig.wait_for(lambda: rig.observer.diagnostics, "diagnostics")
    dropped = int(rig.observer.checks["link"]["points lost"])
    missing = np.maximum(packets - 38, 0).sum() + (np.round(gaps) % 38).sum()
    assert is_short.any() or missing <= dropped


def test_qos_is_upstreams(rig: Rig) -> None:
    for topic in ("/points", "/imu/data"):
        rig.wait_for(lambda topic=topic: publishers(rig.observer, topic), topic)
        (info,) = publishers(rig.observer, topic)
        assert info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT


def test_the_static_transform_reaches_a_late_subscriber(rig: Rig) -> None:
    received: list[TFMessage] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    subscription = rig.observer.create_subscription(
        TFMessage, "/tf_static", received.append, latched
    )
    rig.wait_for(lambda: received, "/tf_static")
    rig.observer.destroy_subscription(subscription)
    (transform,) = received[0].transforms
    assert transform.header.frame_id == "l2lidar_link"
    assert transform.child_frame_id == "l2lidar_imu"
    offset = transform.transform.translation
    assert (offset.x, offset.y, offset.z) == (-0.007698, -0.014655, 0.00667)
    assert transform.transform.rotation.w == 1.0


def test_diagnostics_and_metadata_tell_what_the_device_is_and_does(rig: Rig) -> None:
    names = {"device", "link", "clock", "points", "hardware", "imu"}

    def is_nominal(checks: dict[str, dict[str, str]]) -> bool:
        """In a second in which this machine slept, rates are off."""
        rate = float(checks["device"]["point packets [1/s]"])
        return rate == pytest.approx(215.6, rel=0.1) and not any(
            check["level"] != "0" for check in checks.values()
        )

    rig.observer.diagnostics.clear()
    seen = rig.observer.diagnostics
    rig.wait_for(lambda: seen and is_nominal(seen[-1]), "a second at the rate of the device")
    assert all(set(checks) == names for checks in seen)
    checks = rig.observer.diagnostics[-1]
    assert checks["device"]["message"] == "streaming"
    assert float(checks["clock"]["ratio"]) == pytest.approx(1.99866, abs=1e-3)
    about: list[String] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    subscription = rig.observer.create_subscription(
        String, "/l2lidar_node/metadata", about.append, latched
    )
    rig.wait_for(lambda: about, "metadata")
    rig.observer.destroy_subscription(subscription)
    facts = json.loads(about[-1].data)
    assert len(facts["calibration_crc"]) == 8
    assert facts["firmware"] == "2.8.11.1"
    assert facts["work_mode"] == 0
    assert facts["calibration"]["range_scale"] == pytest.approx(0.000978)


def test_every_parameter_is_described(rig: Rig) -> None:
    settings = list(settings_of(DriverConfig))
    request = DescribeParameters.Request(names=[item.name for item in settings])
    response = rig.call(DescribeParameters, "/l2lidar_node/describe_parameters", request)
    for item, descriptor in zip(settings, response.descriptors, strict=True):
        assert item.doc in descriptor.description
        ranges = list(descriptor.integer_range) + list(descriptor.floating_point_range)
        if item.lo is not None and item.hi is not None:
            (bounds,) = ranges
            assert (bounds.from_value, bounds.to_value) == (item.lo, item.hi)
        for choice in item.choices:
            assert choice in descriptor.additional_constraints


def _parameter(name: str, value: object) -> Parameter:
    message = ParameterValue()
    if isinstance(value, bool):
        message.type, message.bool_value = ParameterType.PARAMETER_BOOL, value
    elif isinstance(value, int):
        message.type, message.integer_value = ParameterType.PARAMETER_INTEGER, value
    elif isinstance(value, float):
        message.type, message.double_value = ParameterType.PARAMETER_DOUBLE, value
    else:
        message.type, message.string_value = ParameterType.PARAMETER_STRING, str(value)
    return Parameter(name=name, value=message)


def _set(rig: Rig, name: str, value: object) -> tuple[bool, str]:
    request = SetParameters.Request(parameters=[_parameter(name, value)])
    (result,) = rig.call(SetParameters, "/l2lidar_node/set_parameters", request).results
    return result.successful, result.reason


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("aggregateNframes", 4001, ("aggregateNframes",)),
        ("aggregateNframes", -1, ("aggregateNframes",)),
        ("calRangeScale", 0.1, ("calRangeScale",)),
        ("sweep_cut", "circle", ("sweep_cut", "circle", "half_turn")),
        ("calRangeBias", math.nan, ("calRangeBias",)),
        ("host_port", 6202, ("host_port", "read-only")),
        ("range_min", 100.0, ("range_min", "range_max")),
    ],
)
def test_a_wrong_live_value_is_refused_with_a_reason(
    rig: Rig, name: str, value: object, words: tuple[str, ...]
) -> None:
    successful, reason = _set(rig, name, value)
    assert not successful
    for word in words:
        assert word in reason


def test_live_parameters_act_on_the_stream(rig: Rig) -> None:
    assert _set(rig, "aggregateNframes", 10) == (True, "")
    rig.wait_for(
        lambda: rig.observer.cloud is not None and rig.observer.cloud["time"][-1] < 0.05,
        "short clouds",
    )
    assert _set(rig, "imu_publish_every", 5) == (True, "")
    rig.wait_for(
        lambda: np.median(rig.observer.imu.intervals_ms[-20:]) == pytest.approx(20.0, abs=0.1),
        "every fifth IMU sample",
    )
    assert _set(rig, "imu_publish_every", 1)[0]
    assert _set(rig, "EnableCalRangeOVR", True)[0]
    assert _set(rig, "calRangeScale", 0.0005)[0]
    # The pattern is within 3 to 6 m by the unit's own scale of 0.000978 m.
    before = 0.000978
    rig.wait_for(
        lambda: (
            rig.observer.cloud is not None
            and rig.observer.cloud["range"].max() < 6.5 * 0.0005 / before
        ),
        "ranges by the override",
    )
    assert _set(rig, "EnableCalRangeOVR", False)[0]
    assert _set(rig, "calRangeScale", 0.000978)[0]
    assert _set(rig, "aggregateNframes", 38)[0]


def test_an_atomic_change_with_one_wrong_value_changes_nothing(rig: Rig) -> None:
    request = SetParametersAtomically.Request(
        parameters=[_parameter("aggregateNframes", 5), _parameter("sweep_duration_ms", 1)]
    )
    name = "/l2lidar_node/set_parameters_atomically"
    result = rig.call(SetParametersAtomically, name, request).result
    assert not result.successful
    assert "sweep_duration_ms" in result.reason
    now = time.time_ns()

    def is_long() -> bool:
        cloud, stamps = rig.observer.cloud, rig.observer.clouds.stamps
        return cloud is not None and stamps[-1] > now and cloud["time"][-1] > 0.16

    rig.wait_for(is_long, "a cloud of 38 packets")


def test_enable_stops_and_starts_the_device(rig: Rig) -> None:
    assert rig.call(SetBool, "/l2lidar_node/enable", SetBool.Request(data=False)).success
    rig.wait_for(
        lambda: (
            rig.observer.diagnostics
            and rig.observer.diagnostics[-1]["device"]["state"] == "standby"
        ),
        "standby",
    )
    seen = len(rig.observer.clouds.stamps)
    assert rig.call(SetBool, "/l2lidar_node/enable", SetBool.Request(data=True)).success
    rig.wait_for(lambda: len(rig.observer.clouds.stamps) > seen + 2, "clouds after the start")
    assert rig.observer.clouds.backward_steps == 0


def _state(rig: Rig) -> str:
    response = rig.call(GetState, "/l2lidar_node/get_state", GetState.Request())
    return str(response.current_state.label)


def _change(rig: Rig, label: str) -> bool:
    request = ChangeState.Request(transition=Transition(label=label))
    return bool(rig.call(ChangeState, "/l2lidar_node/change_state", request).success)


def test_the_state_of_the_life_cycle_and_enable_agree(rig: Rig) -> None:
    assert rig.call(SetBool, "/l2lidar_node/enable", SetBool.Request(data=False)).success
    assert _state(rig) == "inactive"
    assert rig.call(SetBool, "/l2lidar_node/enable", SetBool.Request(data=True)).success
    assert _state(rig) == "active"
    assert _change(rig, "deactivate")
    rig.wait_for(
        lambda: rig.observer.checks.get("device", {}).get("state") == "standby", "standby"
    )
    assert _change(rig, "cleanup")
    rig.wait_for(lambda: not publishers(rig.observer, "/points"), "no publisher of clouds")
    assert _change(rig, "configure")
    rig.wait_for(lambda: publishers(rig.observer, "/points"), "a publisher of clouds")
    seen = len(rig.observer.clouds.stamps)
    assert _change(rig, "activate")
    rig.wait_for(lambda: len(rig.observer.clouds.stamps) > seen + 2, "clouds once it is active")


def test_reset_reboots_the_device_and_stamps_go_on(rig: Rig) -> None:
    response = rig.call(Trigger, "/l2lidar_node/reset", Trigger.Request())
    assert response.success
    # The count stays, where the state passes between two looks at a device that boots this fast.
    rig.wait_for(
        lambda: int(rig.observer.checks.get("clock", {}).get("reboot events", 0)) > 0,
        "the reboot",
    )
    seen = len(rig.observer.clouds.stamps)
    rig.wait_for(lambda: len(rig.observer.clouds.stamps) > seen + 2, "clouds after the reboot")
    assert rig.observer.clouds.backward_steps == 0
    assert rig.observer.imu.backward_steps == 0
