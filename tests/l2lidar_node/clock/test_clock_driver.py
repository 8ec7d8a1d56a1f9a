"""The clock where it works: in the driver, against the virtual L2 and its own truth."""

from typing import Any

import numpy as np
import pytest

from l2lidar_node.clock import ClockEventKind
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.settings import Value
from tests.support.clock_rig import Case, run


@pytest.mark.parametrize("sync", ["off", "once", "periodic"])
def test_the_driver_stamps_packets_of_the_virtual_unit_truly(sync: str) -> None:
    faults: dict[str, Any] = {"jitter": "heavy", "jitter_ms": 20.0, "loss": 0.05, "reorder": 0.02}
    notes, clock = run(Case(ratio=1.99866, sync=sync, faults=faults, seconds=10.0), seed=5)
    stamped = notes[notes["published"] != 0]
    errors = (stamped["published"] - stamped["truth"]) * 1e-6

    assert clock.status().locked
    assert clock.status().epochs > 150 if sync == "periodic" else clock.status().epochs < 2
    assert np.abs(errors - np.median(errors)).max() < 0.25
    assert np.all(stamped["published"] + stamped["duration"] <= stamped["arrival"])
    for kind in (PacketType.IMU, PacketType.POINTS_3D):
        assert np.all(np.diff(stamped["published"][stamped["type"] == kind]) > 0)


def test_the_measured_round_trip_takes_the_path_delay_off() -> None:
    case = Case(ratio=1.99866, sync="once", latency=True, seconds=12.0)
    notes, clock = run(case, seed=5)
    late = notes[-1000:]

    assert clock.status().path_delay_ns > 100_000
    without = np.median(late["published"] - late["truth"]) + clock.status().path_delay_ns
    assert without == pytest.approx(150_000, abs=5_000)  # what the virtual unit needs to send


@pytest.mark.parametrize(
    ("rate", "age", "sync"),
    [(1.0, 1.5, "periodic"), (10.0, 1.0, "once"), (10.0, 4.1, "periodic"), (7.0, 9.0, "once")],
)
def test_stale_packets_are_refuted_by_the_current_ones(rate: float, age: float, sync: str) -> None:
    seconds = age + 7.0
    case = Case(ratio=1.99866, sync=sync, stale=(rate, age), boot_scale=0.0, seconds=seconds)
    notes, clock = run(case, seed=5)
    stamped = notes[notes["published"] != 0]
    errors = (stamped["published"] - stamped["truth"]) * 1e-6
    locked = notes[notes["arrival"] > notes["arrival"][0] + 2 * 10**9]

    assert [event.kind for event in clock.reported] == [ClockEventKind.LOCKED]
    assert np.abs(errors - np.median(errors)).max() < 0.25
    assert np.mean(locked["published"] != 0) > 0.999  # nothing current is lost
    assert len(locked) > (seconds - 2.0) * 460
    stale = sum(counts.stale + counts.duplicates for counts in clock.sequence.values())
    assert stale > 0.8 * rate * (seconds - age - 0.1)


@pytest.mark.parametrize(
    ("pause", "scale", "jitter"),
    [(0.3, 0.0, "heavy"), (0.7, 0.0, "none"), (1.1, 0.04, "heavy"), (2.0, 0.02, "none")],
)
def test_periodic_syncs_in_standby_leave_both_streams_in_the_right_epoch(
    pause: float, scale: float, jitter: str
) -> None:
    """Numbers do not count through standby, while syncs go on stepping the device's clock."""
    standbys = ((3.0, 3.0 + pause), (5.0 + pause, 5.0 + 2 * pause))
    faults: dict[str, Value] = {}
    if jitter == "heavy":
        faults = {"jitter": jitter, "jitter_ms": 20.0, "loss": 0.03}
    case = Case(
        ratio=1.99866, sync="periodic", standbys=standbys, boot_scale=scale, faults=faults,
        seconds=8.0 + 2 * pause,
    )  # fmt: skip
    notes, clock = run(case, seed=round(10 * pause))
    stamped = notes[notes["published"] != 0]
    errors = (stamped["published"] - stamped["truth"]) * 1e-6

    assert np.abs(errors - 0.15).max() < 0.25
    assert len(clock.reported) <= 5  # locked, and lost and locked again, twice
    for kind in (PacketType.IMU, PacketType.POINTS_3D):
        assert np.any(stamped["type"][-100:] == kind)
