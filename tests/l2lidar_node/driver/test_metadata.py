"""What is known about a device."""

from __future__ import annotations

import math

import pytest

from l2lidar_node.driver.health import metadata
from l2lidar_node.protocol.wire import PacketType, WorkMode
from tests.l2lidar_node.driver.test_driver import Run
from tests.support import build


def test_a_device_that_said_nothing_yet() -> None:
    facts = metadata(Run().driver)
    assert (facts.firmware, facts.name, facts.work_mode, facts.work_mode_names) == (
        "",
        "",
        None,
        [],
    )
    assert (facts.calibration, facts.slots, facts.angle_min_rad, facts.range_max_m) == (
        {}, None, None, None,
    )  # fmt: skip
    assert (facts.cloud_frame, facts.imu_frame) == ("l2lidar_link", "l2lidar_imu")
    assert facts.imu_position_m == (-0.007698, -0.014655, 0.00667)


@pytest.mark.parametrize("frame3d", [True, False])
def test_a_device_that_said_everything(frame3d: bool) -> None:
    run = Run(frame3d=frame3d, publish_unlocked=True, cloud_frame="front_link")
    mode = WorkMode.WIDE_FOV | (WorkMode(0) if frame3d else WorkMode.MODE_2D)
    run.hear(PacketType.VERSION, build.version())
    run.hear(PacketType.PARAMETERS, build.parameters(work_mode=int(mode)))
    if frame3d:
        run.hear(PacketType.POINTS_3D, build.points_3d(angle_min=-0.105))
    else:
        run.hear(PacketType.POINTS_2D, build.points_2d(angle_min=-0.105))
    facts = metadata(run.driver)
    assert (facts.hardware, facts.firmware) == ("2.2.1.1", "2.8.11.1")
    assert (facts.name, facts.date) == ("YS-L2", "250715")
    assert facts.work_mode == int(mode)
    assert facts.work_mode_names == ["WIDE_FOV", *([] if frame3d else ["MODE_2D"])]
    assert facts.calibration == {
        name: pytest.approx(value, rel=1e-6) for name, value in build.UNIT_A.items()
    }
    slots = 300 if frame3d else 1800
    assert facts.slots == slots
    assert facts.angle_min_rad == pytest.approx(-0.105)
    assert facts.angle_increment_rad == pytest.approx(math.pi / slots)
    assert (facts.range_min_m, facts.range_max_m) == (pytest.approx(0.05), 50.0)
    assert facts.imu_frame == "front_imu"


def test_unknown_bits_of_the_work_mode_have_no_name() -> None:
    run = Run()
    run.hear(PacketType.PARAMETERS, build.parameters(work_mode=0x100 | 8))
    assert metadata(run.driver).work_mode == 0x108
    assert metadata(run.driver).work_mode_names == ["SERIAL"]
