"""Every level of the diagnostics, provoked by the fault of the virtual L2 that it is for."""

from __future__ import annotations

import re
from typing import Any

import pytest

from l2lidar_node.driver.driver import Driver
from l2lidar_node.driver.health import Period, judge, observe
from l2lidar_node.emulator.config import PowerConfig
from l2lidar_node.protocol.wire import WorkMode
from l2lidar_node.recording.recording import NoTransport
from l2lidar_node.types import Check, HostNs, Level
from tests.l2lidar_node.driver.virtual_host import live_run

OK, WARN, ERROR = Level.OK, Level.WARN, Level.ERROR
PLAIN = {"imu_adjust": False}


def judged(begin: float = 2.5, end: float = 3.5, **run: Any) -> dict[str, Check]:
    """Return how a driver judges a stretch of a run."""
    periods: list[Period] = []
    found: list[Check] = []

    def look(driver: Driver, now: HostNs) -> None:
        periods.append(observe(driver, NoTransport(), now))
        if len(periods) == 2:
            found.extend(judge(driver, *periods))
        driver.gravity.take()

    calls = [(begin, look), (end, look), *run.pop("calls", ())]
    run.setdefault("settings", PLAIN)
    live_run(end + 0.1, calls=sorted(calls, key=lambda call: call[0]), **run)
    return {check.name: check for check in found}


def test_without_a_fault_everything_is_ok() -> None:
    checks = judged()
    assert {name: check.level for name, check in checks.items()} == dict.fromkeys(
        ("device", "link", "clock", "points", "hardware", "imu"), OK
    )


@pytest.mark.parametrize(
    ("faults", "found"),
    [
        (
            {"loss": 0.01, "foreign_sync_at": (2.8,)},
            {"link": (WARN, "packets lost"), "clock": (WARN, "another host")},
        ),
        (
            {"loss": 0.5},
            {"link": (ERROR, "packets lost in"), "device": (WARN, "below its nominal rate")},
        ),
        ({"bad_crc": 0.02}, {"link": (WARN, "lost|damaged")}),
        ({"hostile_count": 0.02}, {"link": (WARN, "lost|impossible")}),
        ({"nan": 0.02}, {"link": (WARN, "lost|impossible")}),
        (
            {"garbage": 0.1, "silence_at": (4.0,), "silence_s": 5.0},
            {"link": (WARN, "damaged"), "device": (WARN, "below its nominal rate")},
        ),
        ({"silence_at": (2.0,), "silence_s": 5.0}, {"device": (ERROR, "fallen silent")}),
        ({"reboot_at": (2.6,)}, {"clock": (WARN, "the device restarted")}),
    ],
    ids=str,
)
def test_a_fault_is_named(faults: Any, found: dict[str, tuple[Level, str]]) -> None:
    checks = judged(end=4.5, faults=faults)
    for name, (level, message) in found.items():
        assert checks[name].level is level
        assert re.search(message, checks[name].message)


def test_packets_that_stay_late_are_told() -> None:
    check = judged(6.0, 7.0, late=[(4.0, 9.0, 1.5)])["clock"]
    assert check.level is WARN
    assert check.message == "locked; packets arrive 1.5 s late; the stamps are corrected for that"
    assert judged(6.0, 7.0, late=[(4.0, 4.5, 0.2)])["clock"].message == "locked"


@pytest.mark.parametrize("begin", [2.5, 6.0])
def test_a_clock_that_was_set_back_withholds_everything(begin: float) -> None:
    check = judged(begin, begin + 1.0, host_steps=((2.0, -3600.0),))["clock"]
    assert check.level is ERROR
    assert re.fullmatch(
        r"(4[5-9]\d) of \1 packets not published: their stamps would be before earlier ones; if a "
        "clock was set back, restart the node",
        check.message,
    )


def test_a_clock_that_was_set_back_a_little_is_an_event() -> None:
    check = judged(1.9, 2.9, host_steps=((2.0, -0.2),))["clock"]
    assert (check.level, check.message) == (WARN, "locked; this host's clock was stepped")


# The latter looks in the same turn of the session's loop in which the clock has been set.
@pytest.mark.parametrize("end", [3.0, 2.0])
@pytest.mark.parametrize("step", [-3600.0, -0.6, 0.8, 3600.0])
def test_rates_are_right_where_the_clock_was_set(step: float, end: float) -> None:
    checks = judged(end - 1.0, end, host_steps=((2.0 if end == 2.0 else 2.5, step),))
    assert checks["device"].message == "streaming"
    assert checks["link"].message == "no loss"
    assert float(checks["device"].values["datagrams [1/s]"]) == pytest.approx(466, rel=0.02)


def test_a_clock_that_locked_late_in_a_period_withholds_nothing() -> None:
    check = judged(0.05, 0.5)["clock"]
    assert (check.level, check.message) == (OK, "locked")


def test_spinning_up_counts_down() -> None:
    checks = judged(9.0, 10.0, power=PowerConfig())
    assert checks["device"].level is WARN
    assert checks["device"].message == "spinning up, points in about 15 s"
    assert checks["clock"].level is OK


def test_a_clock_that_has_not_locked_yet() -> None:
    faults = {"jitter": "heavy", "jitter_ms": 50.0}
    assert judged(0.1, 0.3, faults=faults)["clock"].level is WARN


def test_a_unit_told_to_stop_is_as_asked() -> None:
    calls = [(1.0, lambda driver, now: driver.stop_rotation(now))]
    check = judged(calls=calls)["device"]
    assert (check.level, check.message) == (OK, "in standby as asked")


def test_a_covered_sensor() -> None:
    assert judged(empty=True)["points"].level is WARN


@pytest.mark.parametrize(
    ("mode", "level", "message"),
    [
        (WorkMode.IMU_OFF, WARN, "no IMU"),
        (WorkMode.MODE_2D, ERROR, "2D"),
        (WorkMode.WAIT_FOR_START, ERROR, "no data from"),
    ],
)
def test_work_modes_that_do_not_fit(mode: Any, level: Any, message: str) -> None:
    check = judged(mode=mode)["device"]
    assert check.level is level
    assert message in check.message


def test_gravity_alignment_without_imu() -> None:
    checks = judged(mode=WorkMode.IMU_OFF, settings={"imu_adjust": True})
    assert checks["points"].level is WARN
