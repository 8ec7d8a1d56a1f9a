"""How the driver node starts and ends: exit codes, messages, the watchdog."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool

from l2lidar_node.demo.processes import assigned, free_udp_ports
from l2lidar_node.ros.conversions import from_cloud
from tests.l2lidar_node.ros.rig import TIMEOUT_S, Rig, open_rig, refused
from tests.support.build import PERIOD_NS, REAL_L2, frames_3d, points_3d, real_capture

pytestmark = pytest.mark.ros

LOOPBACK = {"l2_ip": "127.0.0.1", "host_ip": "127.0.0.1"}


@pytest.fixture
def rig() -> Iterator[Rig]:
    """An empty rig."""
    with open_rig() as rig:
        yield rig


def _run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "l2lidar_node.ros.driver_node", *arguments],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("l2_ip:=lidar", ("l2_ip", "lidar", "IPv4")),
        ("host_port:=70000", ("host_port", "70000", "65535")),
        ("frame3d:=3", ("frame3d", "3", "bool")),
        ("sweep_cut:=circle", ("sweep_cut", "circle", "half_turn")),
        ("calRangeScale:=.nan", ("calRangeScale", "finite")),
        ("cloud_frame:=/abs", ("cloud_frame", "/abs")),
        ("point_cloud_topic_id:=/a//b", ("point_cloud_topic_id", "/a//b")),
        ("use_sim_time:=maybe", ("use_sim_time", "maybe", "BOOL")),
    ],
)
def test_a_wrong_parameter_ends_the_start_with_one_message(
    assignment: str, words: tuple[str, ...], capfd: pytest.CaptureFixture[str]
) -> None:
    code, said = refused(capfd, "--ros-args", "-p", assignment)
    assert code == 2
    for word in words:
        assert word in said


def test_help_is_given() -> None:
    result = _run("--help")
    assert (result.returncode, result.stderr) == (0, "")
    assert "usage: l2lidar_node" in result.stdout


def test_a_missing_or_broken_parameter_file_is_named(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    missing = _run("--params-file", str(tmp_path / "nowhere.yaml"))
    assert missing.returncode == 2
    assert "nowhere.yaml" in missing.stderr
    assert "Traceback" not in missing.stderr
    broken = tmp_path / "broken.yaml"
    broken.write_text("l2lidar_node: [1, 2\n")
    code, said = refused(capfd, "--ros-args", "--params-file", str(broken))
    assert code == 2
    assert "broken.yaml" in said
    code, said = refused(capfd, "--ros-args", "--help")
    assert (code, "--help" in said) == (2, True)


def test_a_port_in_use_and_a_foreign_address_are_explained(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        busy = _run(*assigned({**LOOPBACK, "host_port": port}))
    assert busy.returncode == 1
    assert f"host_port {port} is in use" in busy.stderr
    assert "Traceback" not in busy.stderr
    code, said = refused(capfd, *assigned({**LOOPBACK, "host_ip": "203.0.113.9"}))
    assert code == 1
    assert "203.0.113.9" in said
    assert "not an address of this machine" in said


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly(number: signal.Signals) -> None:
    (port,) = free_udp_ports(1)
    process = subprocess.Popen(
        [sys.executable, "-m", "l2lidar_node.ros.driver_node",
         *assigned({**LOOPBACK, "host_port": port})],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    for line in process.stdout:
        if "listening" in line:
            break
    process.send_signal(number)
    said, _ = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, said
    assert "Traceback" not in said


def test_the_watchdog_ends_a_driver_without_device() -> None:
    (port,) = free_udp_ports(1)
    values = {**LOOPBACK, "host_port": port, "watchdog_timeout_ms": 300}
    result = _run(*assigned(values))
    assert result.returncode == 1
    assert "no data from the L2 at 127.0.0.1" in result.stdout + result.stderr
    assert "Traceback" not in result.stderr


def test_the_watchdog_names_a_serial_line_without_device() -> None:
    end, other = os.openpty()
    name = os.ttyname(other)
    result = _run(*assigned({"serial_port": name, "watchdog_timeout_ms": 300}))
    os.close(end)
    os.close(other)
    assert result.returncode == 1
    assert f"no data from the L2 at {name}" in result.stdout + result.stderr


def test_a_driver_told_to_wait_takes_up_a_device_that_comes_late(rig: Rig) -> None:
    rig.driver(watchdog_timeout_ms=300, watchdog_action="wait")
    rig.wait_for(
        lambda: (
            rig.observer.diagnostics
            and rig.observer.diagnostics[-1]["device"]["state"] == "waiting"
        ),
        "the driver",
    )
    response = rig.call(SetBool, "/l2lidar_node/enable", SetBool.Request(data=True))
    assert not response.success
    assert "did not acknowledge" in response.message
    rig.emulator("--ready")
    rig.wait_for(lambda: rig.observer.clouds.stamps, "clouds")


UPSTREAM = """\
l2lidar_node:
  ros__parameters:
    l2_ip: "127.0.0.1"
    l2_port: {lidar_port}
    host_ip: "127.0.0.1"
    host_port: {host_port}
    frame3d: true
    imu_adjust: true
    imuRollPitchOnly: true
    enable_l2_time_correction: true
    enable_l2_host_sync: true
    l2_sync_rate_ms: 50
    timeScaleNum: 2
    timeScaleDenom: 1
    UseSystemTimeTS: false
    enable_latency_measure: false
    l2_name: "front"
    cloud_frame: ""
    publish_tf: true
    enable_IMU_publishing: true
    accel_x_covar: 0.01
    accel_y_covar: 0.02
    accel_z_covar: 0.03
    gyro_x_covar: 0.000025
    gyro_y_covar: 0.000025
    gyro_z_covar: 0.0000002
    roll_covar: 4.9e-9
    pitch_covar: 4.9e-9
    yaw_covar: 10
    aggregateNframes: 38
    EnableCalRangeOVR: false
    calRangeScale: 0.000978
    calRangeBias: -365.625
    watchdog_timeout_ms: 35000
    point_cloud_topic_id: "/points"
    imu_topic_id: "/imu/data"
    standby_on_powerup_enabled: false
"""


def test_an_upstream_parameter_file_works_unchanged(rig: Rig, tmp_path: Path) -> None:
    path = tmp_path / "l2lidar_node.yaml"
    path.write_text(UPSTREAM.format(host_port=rig.host_port, lidar_port=rig.lidar_port))
    driver = rig.programs.start("l2lidar_node.ros.driver_node", ["--params-file", str(path)])
    rig.emulator("--ready")
    rig.wait_for(lambda: len(rig.observer.clouds.stamps) > 2 and rig.observer.imu.stamps, "data")
    assert rig.observer.clouds.frame == "front_link"
    assert rig.observer.imu.frame == "front_imu"
    code, said = driver.stop()
    assert code == 0
    assert "not known" not in said


@pytest.mark.skipif(not REAL_L2.exists(), reason="the recordings are not here")
def test_a_real_recording_comes_out_at_its_recorded_points(rig: Rig) -> None:
    capture = real_capture(1)
    probes: list[np.ndarray] = []
    clouds: list[np.ndarray] = []

    def keep(message: PointCloud2) -> None:
        (probes if message.width == 1 else clouds).append(from_cloud(message).copy())

    rig.observer.create_subscription(PointCloud2, "/points", keep, QoSProfile(depth=500))
    # The device's own stamps. The packets come faster than they were measured: stamps of arrival
    # would run ahead of it until the driver refuses them.
    rig.driver(
        enable_l2_time_correction=False, enable_l2_host_sync=False, publish_unlocked=True,
        aggregateNframes=0, qos_reliability="reliable",
    )  # fmt: skip
    rig.wait_for(lambda: rig.observer.diagnostics, "the driver")
    driver = ("127.0.0.1", rig.host_port)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        device.bind(("127.0.0.1", rig.lidar_port))

        # What is published before the driver has heard of the subscription never comes.
        payloads = (points_3d(500 + k, k * PERIOD_NS, ranges=[3000], count=1) for k in range(500))
        knocks = iter(frames_3d(payloads))
        knocked = 0.0

        def is_heard() -> bool:
            nonlocal knocked
            if time.monotonic() - knocked > TIMEOUT_S / 500:
                device.sendto(next(knocks), driver)
                knocked = time.monotonic()
            return bool(probes)

        rig.wait_for(is_heard, "a cloud of one point")
        datagrams = capture.datagrams()
        few = 20  # fewer than the driver keeps for a subscriber that is held up
        for at in range(0, len(datagrams), few):
            for datagram in datagrams[at : at + few]:
                device.sendto(datagram.data, driver)
            wanted = min(at + few, len(datagrams))
            rig.wait_for(lambda wanted=wanted: len(clouds) >= wanted, f"cloud {wanted}")
    points = np.concatenate(clouds)
    xyz = np.stack([points["x"], points["y"], points["z"]], axis=1)
    recorded = capture.points[np.isfinite(capture.points[..., 0])]
    assert len(xyz) == len(recorded)
    error = np.linalg.norm(xyz - recorded, axis=1)
    assert np.median(error) < 1e-4
    assert error.max() < 2.5e-3


def test_a_driver_whose_receiving_thread_fails_ends_and_says_why(rig: Rig) -> None:
    code = (
        "import sys; from l2lidar_node.driver.driver import Driver\n"
        "from l2lidar_node.ros import driver_node\n"
        "def fail(self, *arguments): raise RuntimeError('no idea')\n"
        "Driver.tick = fail\n"
        "sys.exit(driver_node.main([sys.argv[0], *sys.argv[1:]]))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, *rig.arguments()],
        capture_output=True, text=True, timeout=TIMEOUT_S, check=False,
    )  # fmt: skip
    assert result.returncode == 1
    assert "receive thread failed: RuntimeError('no idea')" in result.stderr
