"""The whole driver against good frames with impossible contents, on a clock that jumps."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from l2lidar_node.clouds import LAYOUTS
from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.driver import Driver
from l2lidar_node.driver.health import judge, metadata, observe
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.settings import build as configure
from l2lidar_node.types import HostNs, ImuSample, Sweep
from tests.support import build

FLOATS = [0.0, -0.0, 1e-45, 1e-6, 1e-3, 1.0, -1.0, 1e3, 9.9e5, 1.1e6, 3e38, math.nan, -math.inf]
STEPS_NS = [0, 1_000, 2_000_000, 4_000_000, 4_000_000, 4_000_000]
YEAR_NS = 365 * 86_400 * 10**9
JUMPS_NS = [300_000_000, 10_000_000_000, -5_000_000_000, 60 * YEAR_NS, -60 * YEAR_NS]


class Link:
    """The counts of a transport."""

    foreign = kernel_drops = send_errors = 0
    stranger = ""


def twisted(payload: bytes, layout: np.dtype, rng: random.Random) -> bytes:
    """Return a payload with a few fields set to something extreme."""
    block = np.frombuffer(bytearray(payload), layout)

    def twist(part: np.ndarray) -> None:
        for name in part.dtype.names or ():
            kind = part.dtype[name].base
            if kind.names:
                twist(part[name])
            elif rng.random() < 0.03 and kind.kind == "f":
                part[name] = rng.choice(FLOATS)
            elif rng.random() < 0.01 and kind.kind == "u":
                most = int(np.iinfo(kind).max)
                part[name] = min(most, rng.choice([0, 1, 299, 301, most, rng.randrange(most)]))

    twist(block)
    return block.tobytes()


def frames(rng: random.Random) -> list[Callable[[int, int], bytes]]:
    """Return what may come: makers of bytes from a number and a device stamp."""

    def points_3d(number: int, stamp: int) -> bytes:
        payload = build.points_3d(number % 1025, stamp, theta=number * 0.127 % math.tau)
        return build.frame(PacketType.POINTS_3D, twisted(payload, wire.POINTS_3D_PAYLOAD, rng))

    def points_2d(number: int, stamp: int) -> bytes:
        payload = build.points_2d(number % 1025, stamp)
        return build.frame(PacketType.POINTS_2D, twisted(payload, wire.POINTS_2D_PAYLOAD, rng))

    def imu(number: int, stamp: int) -> bytes:
        payload = build.imu(number % 1025, stamp)
        return build.frame(PacketType.IMU, twisted(payload, wire.IMU_PAYLOAD, rng))

    def answer(number: int, stamp: int) -> bytes:
        kind = rng.choice([PacketType.ACK, PacketType.VERSION, PacketType.PARAMETERS])
        return build.frame(kind, rng.randbytes(wire.PAYLOADS[kind].itemsize))

    def noise(number: int, stamp: int) -> bytes:
        return rng.randbytes(rng.randrange(200))

    return [*[points_3d] * 9, points_2d, *[imu] * 8, answer, noise]


def check(event: object) -> None:
    if isinstance(event, Sweep):
        for name in event.points.dtype.names or ():
            assert np.isfinite(event.points[name]).all()
        assert event.points["time"][0] == 0
        assert (np.diff(event.points["time"]) >= 0).all()
        for layout in LAYOUTS.values():
            layout.convert(event.points, event.start)
    elif isinstance(event, ImuSample):
        numbers = event.orientation_wxyz + event.angular_velocity + event.linear_acceleration
        assert all(map(math.isfinite, numbers))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("seed", range(12))
def test_nothing_raises_warns_or_comes_out_infinite(seed: Any) -> None:
    rng = random.Random(seed)
    values = {
        "publish_unlocked": rng.random() < 0.7,
        "imu_adjust": rng.random() < 0.5,
        "frame3d": seed % 4 > 0,
        "sweep_cut": rng.choice(["packets", "turn", "half_turn", "duration"]),
        "aggregateNframes": rng.choice([0, 5, 38]),
        "UseSystemTimeTS": seed % 5 == 0,
        "enable_latency_measure": True,
        "reorder_window": rng.choice([0, 8, 200]),
        "EnableCalRangeOVR": rng.random() < 0.3,
    }
    driver = Driver(configure(DriverConfig, values))
    now = HostNs(build.EPOCH_NS)
    period = observe(driver, Link(), now)
    makers = frames(rng)
    for number in range(600):
        step = rng.choice(JUMPS_NS if rng.random() < 0.01 else STEPS_NS)
        now = HostNs(max(now + step, 1))
        stamp = max(0, (now - build.EPOCH_NS) // 2 + 50_000_000_000)
        events = driver.receive(rng.choice(makers)(number, stamp), now)
        if number % 5 == 0:
            events += driver.tick(now)
            driver.outbox()
        if number % 50 == 0:
            before, period = period, observe(driver, Link(), now)
            judge(driver, before, period)
            metadata(driver)
        if number % 97 == 0:
            events += driver.stop_rotation(now)[1]
            driver.start_rotation(now)
        for event in [*events, *(driver.reset_device(now) if number % 211 == 210 else [])]:
            check(event)
    for event in driver.flush():
        check(event)
    assert driver.counters.rejected.total() > 20
    assert driver.counters.points > 0 or driver.counters.unlocked.total() > 0
