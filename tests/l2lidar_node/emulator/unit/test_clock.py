from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import trapezoid

from l2lidar_node.emulator.config import CrystalConfig, DeviceConfig, FaultConfig, PowerConfig
from l2lidar_node.emulator.unit.firmware import UnitClock
from tests.l2lidar_node.emulator.rig import MS, READY, Bench, S, command, identity, read


@pytest.mark.parametrize("ratio", [0.5, 1.0, 1.95, 1.99866, 2.0, 3.0])
def test_the_clock_is_exact_for_a_month(ratio: float) -> None:
    origin = 1_800_000_000 * S
    clock = UnitClock(CrystalConfig(clock_ratio=ratio), origin)
    elapsed = np.array([0, 1, 999_999_999, S, 3600 * S, 86_400 * S, 30 * 86_400 * S])
    exact = [Fraction(int(item)) / Fraction(ratio) for item in elapsed]
    got = clock.stamps(origin + elapsed)
    assert [abs(int(a) - b) <= 2 for a, b in zip(got, exact, strict=True)] == [True] * len(exact)
    assert int(got[0]) == 0
    assert clock.at(origin + 999_999_999) == math.floor(999_999_999 / Fraction(ratio))


def test_ratio_one_without_drift_counts_true_nanoseconds() -> None:
    clock = UnitClock(CrystalConfig(clock_ratio=1.0), 5)
    instants = np.array([5, 6, 12_345_678_901_234], dtype=np.int64)
    assert clock.stamps(instants).tolist() == [0, 1, 12_345_678_901_229]


def test_drift_is_the_integral_of_the_rate() -> None:
    config = CrystalConfig(
        clock_ratio=2.0, clock_drift_ppm_per_h=7200.0, clock_wave_ppm=50.0, clock_wave_s=100.0
    )
    clock = UnitClock(config, 0)
    t = np.linspace(0.0, 130.0, 1_300_001)
    ppm = 7200.0 * t / 3600.0 + 50.0 * np.sin(2.0 * np.pi * t / 100.0)
    rate = (1.0 + ppm * 1e-6) / 2.0
    expected = trapezoid(rate, t)
    assert clock.at(130 * S) == pytest.approx(expected * S, abs=20)


@settings(max_examples=100, deadline=None)
@given(
    st.floats(0.5, 3.0),
    st.floats(-100.0, 100.0),
    st.floats(0.0, 1000.0),
    st.lists(st.integers(0, 10**13), min_size=2, max_size=50),
)
def test_it_never_runs_backwards_by_itself(
    ratio: Any, drift: Any, wave: Any, instants: Any
) -> None:
    clock = UnitClock(
        CrystalConfig(clock_ratio=ratio, clock_drift_ppm_per_h=drift, clock_wave_ppm=wave), 0
    )
    stamps = clock.stamps(np.sort(np.array(instants, dtype=np.int64)))
    assert (np.diff(stamps) >= 0).all()


def test_setting_the_clock_leaves_earlier_instants_alone() -> None:
    clock = UnitClock(CrystalConfig(clock_ratio=2.0), 0)
    clock.set(10 * S, 1000 * S)
    clock.set(11 * S, 2000 * S)
    instants = np.array([10 * S - 2, 10 * S, 10 * S + 2, 11 * S - 2, 11 * S, 12 * S])
    assert clock.stamps(instants).tolist() == [
        5 * S - 1, 1000 * S, 1000 * S + 1, 1000 * S + S // 2 - 1, 2000 * S, 2000 * S + S // 2,
    ]  # fmt: skip


def test_old_epochs_are_forgotten_and_recent_ones_kept() -> None:
    clock = UnitClock(CrystalConfig(clock_ratio=2.0), 0)
    for k in range(10_000):
        clock.set(k * 50 * MS, k * 1000 * S)
    last = 9_999 * 50 * MS
    assert len(clock._epochs) < 250
    assert clock.at(last - 25 * MS) == 9_998 * 1000 * S + 12_500_000


def test_stamps_on_the_wire_are_the_clock_at_the_true_instant() -> None:
    bench = Bench(
        DeviceConfig(
            power=READY,
            crystal=CrystalConfig(clock_ratio=1.99866, clock_wave_ppm=20.0, clock_wave_s=10.0),
        ),
        power_on_ns=1_700_000_000 * S + 123,
    )
    datagrams = bench.run(20.0)
    wire_stamps = {identity(read(data)[0]) for _, data in datagrams}
    clock = UnitClock(bench.device.config.crystal, 1_700_000_000 * S + 123)
    packets = bench.device.packet_log.packets
    expected = clock.stamps(packets["start_ns"])
    assert (packets["stamp_ns"] == expected).all()
    assert wire_stamps == {
        (int(row["type"]), int(row["seq"]), int(row["stamp_ns"])) for row in packets
    }


def test_points_and_imu_share_the_clock() -> None:
    bench = Bench()
    bench.run(30.0)
    packets = bench.device.packet_log.packets
    slopes = [
        np.polyfit(rows["start_ns"].astype(float), rows["stamp_ns"].astype(float), 1)[0]
        for rows in (packets[packets["type"] == 102], packets[packets["type"] == 104])
    ]
    assert slopes == pytest.approx([1 / 1.99866] * 2, rel=1e-9)


def test_a_sync_takes_effect_when_it_arrives_and_not_on_what_is_measured_already() -> None:
    bench = Bench()
    bench.run(9.998)
    value = 1_800_000_000 * S + 999_999_999
    bench.device.command(command(106, *divmod(value, S)), bench.now)
    bench.run(1.0)
    packets = bench.device.packet_log.packets
    measured = packets[packets["type"] != 101]
    before = measured["start_ns"] < 9.998 * S
    late = before & (measured["left_ns"] > 9.998 * S)
    assert late.any(), "a packet was on its way out when the sync came"
    assert (measured["stamp_ns"][before] < 6 * S).all()
    after = measured[~before]
    expected = value + np.floor((after["start_ns"] - 9_998 * MS) / 1.99866).astype(np.int64)
    assert np.abs(after["stamp_ns"] - expected).max() <= 1


def test_repeated_syncs_step_by_half_of_what_passed_between() -> None:
    bench = Bench(power_on_ns=1_800_000_000 * S)
    for _ in range(40):
        bench.run(0.05)
        bench.device.command(command(106, *divmod(bench.now, S)), bench.now)
    bench.run(0.05)
    packets = bench.device.packet_log.packets
    measured = packets[(packets["type"] == 104) & (packets["start_ns"] > 1_800_000_001 * S)]
    behind = measured["start_ns"] - measured["stamp_ns"]
    assert behind.min() >= 0
    assert behind.max() == pytest.approx(50 * MS * (1 - 1 / 1.99866), abs=2.1 * MS)


def test_the_clock_restarts_at_0_at_every_boot_and_drift_goes_on() -> None:
    faults = FaultConfig(reboot_at=(10.0, 20.0))
    crystal = CrystalConfig(clock_ratio=1.0, clock_drift_ppm_per_h=36_000.0)
    bench = Bench(DeviceConfig(power=PowerConfig(boot_scale=0.0), faults=faults, crystal=crystal))
    bench.run(21.0)
    packets = bench.device.packet_log.of_type(104)
    for boot in range(3):
        rows = packets[packets["boot"] == boot]
        assert rows["seq"][0] == 0
        t = (rows["start_ns"] - boot * 10 * S) / S
        begun = boot * 10.0
        ppm_s = 0.5 * 10.0 * ((begun + t) ** 2 - begun**2)
        assert rows["stamp_ns"] == pytest.approx((t + ppm_s * 1e-6) * S, abs=2)


def test_clock_step_and_foreign_sync() -> None:
    faults = FaultConfig(
        clock_step_at=(2.0,), clock_step_ms=-50.0, foreign_sync_at=(4.0,), foreign_sync_error_s=5.0
    )
    origin = 1_800_000_000 * S
    bench = Bench(DeviceConfig(power=READY, faults=faults), power_on_ns=origin)
    bench.run(5.0)
    rows = bench.device.packet_log.of_type(104)
    t = (rows["start_ns"] - origin) / S
    stepped = rows["stamp_ns"] - np.floor(t * S / 1.99866)
    assert np.abs(stepped[t < 2.0]).max() <= 1
    assert np.abs(stepped[(t >= 2.0) & (t < 4.0)] + 50 * MS).max() <= 1
    foreign = rows[t >= 4.0][0]
    assert foreign["stamp_ns"] == origin + 4 * S + 5 * S
    assert [event.fault.name for event in bench.device.packet_log.events] == [
        "CLOCK_STEP",
        "FOREIGN_SYNC",
    ]
