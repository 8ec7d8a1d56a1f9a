"""The parts of the load measurement that could be wrong without being noticed."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import load_chain, load_scale
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.framing import Frame, Framer
from l2lidar_node.protocol.packets import ImuPacket, PointPacket, decode
from l2lidar_node.protocol.wire import PacketType
from tests.support import build


def test_the_latency_of_a_cloud_counts_from_its_own_last_packet() -> None:
    rng = np.random.default_rng(1)
    period = round(wire.MIRROR_PERIOD_S * 1e9)
    begun = build.EPOCH_NS + np.arange(400) * period
    sent = begun + period // 2 + 150_000 + rng.integers(0, 300_000, 400)
    sent[100:110] += 20_000_000  # the sender was held up
    first = np.array([5, 43, 81, 300, 380])
    stamps = begun[first] + rng.integers(-300_000, 2_300_000, 5)  # the first slots have no return
    took = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    arrivals = sent[np.minimum(first + 37, 399)] + np.round(took * 1e6).astype(np.int64)
    found = load_chain._node_latencies_ms(np.stack([stamps, arrivals], axis=1), sent)
    np.testing.assert_allclose(found, took[:4], atol=1e-6)  # the last cloud is not complete


@pytest.mark.parametrize("rate", [1.0, 50.0])
@pytest.mark.parametrize("kind", [PacketType.POINTS_3D, PacketType.IMU])
def test_the_sender_sends_what_a_faster_unit_would(kind: PacketType, rate: float) -> None:
    framer = Framer()
    sent = list(load_scale._packets(kind, rate, 10.0 / rate))
    packets = [
        decode(item) for _, data in sent for item in framer.feed(data) if isinstance(item, Frame)
    ]
    assert len(packets) == len(sent) > 2000
    measured = [packet for packet in packets if isinstance(packet, PointPacket | ImuPacket)]
    assert [packet.seq for packet in measured] == [number % 1025 for number in range(len(sent))]
    passed = (measured[-1].stamp - measured[0].stamp) * build.RATIO
    assert passed == pytest.approx(sent[-1][0] - sent[0][0], rel=1e-6)


def test_what_the_driver_cannot_take_is_dropped_by_the_kernel_and_counted() -> None:
    """A buffer of four datagrams does not hold what 200 units send while the driver works."""
    got = load_scale.crowd(1, 1, 200.0, 0.5, buffer=4096)
    assert got["unsaid"] == got["failures"] == 0
    assert got["kernel_drops"] > 0
    (complaint,) = got["complaints"]
    assert f"{got['kernel_drops']} datagrams dropped by the kernel" in complaint
