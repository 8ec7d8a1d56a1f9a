"""A real scene through the whole path from datagram to point.

The recordings are not part of the project: where they are absent the tests are left out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.driver import Driver
from l2lidar_node.settings import build as configure
from l2lidar_node.types import HostNs, Sweep
from tests.support import build

pytestmark = pytest.mark.skipif(not build.REAL_L2.is_dir(), reason=f"no data in {build.REAL_L2}")


@pytest.fixture(scope="module", params=[1, 2])
def capture(request: pytest.FixtureRequest) -> build.RealCapture:
    return build.real_capture(request.param)


def xyz(points: Any) -> np.ndarray:
    return np.stack([points[name] for name in "xyz"], axis=1)


def check(found: np.ndarray, recorded: np.ndarray) -> None:
    """Compare with what the vendor's client made of the same packets, in its float32."""
    assert len(found) == len(recorded)
    error = np.linalg.norm(found - recorded, axis=1)
    assert np.median(error) < 1e-4
    assert error.max() < 2.5e-3


def test_points_come_back_where_they_were_recorded(capture: build.RealCapture) -> None:
    found = build.sweeps(capture.datagrams())
    kept = np.isfinite(capture.points[..., 0])
    check(np.concatenate([xyz(sweep.points) for sweep in found]), capture.points[kept])


def test_sweeps_by_turn_follow_the_real_heads_wobble(capture: build.RealCapture) -> None:
    found = build.sweeps(capture.datagrams(), {"sweep_cut": "turn"})
    assert {sweep.packets for sweep in found[1:-1]} <= {48, 49, 50, 51}
    assert all((np.diff(sweep.points["time"]) > 0).all() for sweep in found)


def test_points_come_out_of_the_driver(capture: build.RealCapture) -> None:
    values = {"enable_l2_host_sync": False, "imu_adjust": False, "publish_unlocked": True}
    driver = Driver(configure(DriverConfig, values))
    events = []
    for arrival, data in capture.datagrams():
        events += driver.receive(data, HostNs(arrival))
    events += driver.flush()
    found = [event for event in events if isinstance(event, Sweep)]
    assert driver.counters.frames == {102: len(capture.payloads)}
    assert driver.counters.faults.total() == driver.counters.rejected.total() == 0
    kept = np.isfinite(capture.points[..., 0])
    check(np.concatenate([xyz(sweep.points) for sweep in found]), capture.points[kept])


def test_the_first_packets_can_be_had_alone() -> None:
    few = build.real_capture(1, packets=50)
    assert len(few.payloads) == len(few.points) == 50
