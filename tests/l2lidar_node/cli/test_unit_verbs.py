"""Each verb against a virtual unit: what it says, what it changes, what it refuses."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from l2lidar_node.cli.commands import parameter_fields, parse_work_mode, work_mode_text
from l2lidar_node.cli.device import Device
from l2lidar_node.config import NetworkConfig
from l2lidar_node.emulator.config import FaultConfig
from l2lidar_node.emulator.unit.firmware import parameters_payload
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import WorkMode
from tests.l2lidar_node.cli.conftest import LIMIT_S, Run, Unit, free_port

TimedBy = Callable[[Unit], None]
SILENT = ["--l2-ip", "127.0.0.1", "--l2-port", "9", "--host-port"]


def is_measuring(unit: Unit) -> bool:
    """Tell whether it sends, by its own time: it may be that it does not come to it."""
    begun, before = unit.device.now_ns, unit.device.sent.total()
    deadline = time.monotonic() + LIMIT_S
    while unit.device.now_ns < begun + 500_000_000:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return unit.device.sent.total() > before + 20


@pytest.fixture
def short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make nobody wait long for what does not come."""
    wait_for = Device.wait_for
    monkeypatch.setattr(
        Device,
        "wait_for",
        lambda self, question, timeout_s: wait_for(self, question, min(timeout_s, 0.2)),
    )


def test_info_tells_what_the_unit_is(run: Run, unit: Unit, timed_by: TimedBy) -> None:
    timed_by(unit)
    outcome = run("info", *unit.options, "--json")
    assert outcome.code == 0
    about = json.loads(outcome.out)
    assert (about["name"], about["firmware"], about["work_mode"]) == ("YS-L2", "2.8.11.1", 0)
    assert about["calibration"]["range_bias"] == -365.625
    device = about["health"]["device"]
    assert device["state"] == "streaming"
    assert isinstance(device["point packets [1/s]"], float)  # figures are numbers
    assert isinstance(about["health"]["link"]["points lost"], int)


def test_info_of_a_unit_in_standby_says_what_is_not_known(run: Run, make_unit: Any) -> None:
    unit = make_unit(mode=int(WorkMode.WAIT_FOR_START))
    outcome = run("info", *unit.options)
    assert outcome.code == 0
    assert "16 (wait_for_start)" in outcome.out
    assert "not known" in outcome.out
    assert "Calibration" not in outcome.out


@pytest.mark.parametrize(
    "verb",
    [
        ["info"],
        ["get", "network"],
        ["get", "work-mode"],
        ["set", "work-mode", "0", "--yes"],
        ["set", "mac", "02:00:00:00:00:01", "--yes"],
        ["sync-check", "--duration", "2"],
        ["start"],
        ["stop"],
    ],
    ids=" ".join,
)
def test_nobody_there_is_exit_code_1(run: Run, short_waits: None, verb: list[str]) -> None:
    outcome = run(*verb, *SILENT, str(free_port()))
    assert outcome.code == 1
    assert outcome.err.startswith("l2lidar: ")


def test_silence_is_explained(run: Run, short_waits: None) -> None:
    outcome = run("info", *SILENT, str(free_port()))
    assert "check that it is at 127.0.0.1" in outcome.err
    assert "this machine's addresses" in outcome.err


@pytest.mark.parametrize(
    "arguments",
    [
        ["nonsense"],
        ["info", "--l2-port", "0"],
        ["info", "--l2-ip", "not-an-address"],
        ["monitor", "--duration", "-1"],
        ["set", "mac"],
        ["sync-check", "--duration", "0"],
        ["replay", "no/such/file.pcap"],
        ["set", "work-mode", "banana"],
        ["discover", "--probe", "lidar", "--timeout", "0.1"],
    ],
    ids=" ".join,
)
def test_wrong_usage_is_exit_code_2(run: Run, arguments: list[str]) -> None:
    outcome = run(*arguments)
    assert outcome.code == 2
    assert outcome.err


def test_an_address_to_ask_that_is_none_is_named(run: Run) -> None:
    outcome = run("discover", "--probe", "lidar", "--timeout", "0.1")
    assert "'lidar' is not an IPv4 address" in " ".join(outcome.err.replace("│", " ").split())


@pytest.mark.parametrize(
    "verb",
    ["", "discover", "info", "monitor", "start", "stop", "reset", "get", "get network", "get mac",
     "get work-mode", "get parameters", "set", "set network", "set mac", "set work-mode",
     "set parameters", "sync-check", "record", "replay", "convert"],
)  # fmt: skip
def test_every_verb_has_help(run: Run, verb: str) -> None:
    outcome = run(*verb.split(), "--help")
    assert outcome.code == 0
    assert "Usage" in outcome.out


def test_a_port_in_use_is_explained(run: Run, unit: Unit) -> None:
    with Device(build_network(unit)):
        for verb in (["info", *unit.options], ["discover", "--host-port", str(unit.host_port)]):
            outcome = run(*verb)
            assert outcome.code == 1
            assert f"{unit.host_port}" in outcome.err
            assert "in use" in outcome.err


def build_network(unit: Unit) -> NetworkConfig:
    return NetworkConfig(
        l2_ip="127.0.0.1", l2_port=unit.lidar_port, host_ip="0.0.0.0", host_port=unit.host_port
    )


def test_monitor_prints_a_judgement_a_second(run: Run, unit: Unit, timed_by: TimedBy) -> None:
    timed_by(unit)
    outcome = run("monitor", *unit.options, "--duration", "2", "--json")
    lines = [json.loads(line) for line in outcome.out.splitlines()]
    assert outcome.code == 0
    assert len(lines) >= 2
    assert lines[-1]["device"]["state"] == "streaming"
    assert "streaming" in run("monitor", *unit.options, "--duration", "1").out


def test_monitor_ends_with_1_on_an_error(run: Run, make_unit: Any, timed_by: TimedBy) -> None:
    unit = make_unit(faults=FaultConfig(loss=0.3))
    timed_by(unit)
    outcome = run("monitor", *unit.options, "--duration", "2", "--json")
    assert outcome.code == 1
    assert json.loads(outcome.out.splitlines()[-1])["link"]["level"] == "ERROR"


def test_discover_finds_who_sends_and_who_answers(
    run: Run, make_unit: Any, timed_by: TimedBy
) -> None:
    sending = make_unit()
    timed_by(sending)
    arguments = ["--host-port", str(sending.host_port), "--l2-port", str(sending.lidar_port)]
    outcome = run("discover", *arguments, "--probe", "127.0.0.1", "--timeout", "1.2", "--json")
    assert outcome.code == 0
    (found,) = json.loads(outcome.out)["units"]
    assert (found["ip"], found["port"]) == ("127.0.0.1", sending.lidar_port)
    assert (found["name"], found["firmware"], found["work_mode"]) == ("YS-L2", "2.8.11.1", 0)
    assert found["imu_hz"] > 50
    standby = make_unit(mode=int(WorkMode.WAIT_FOR_START))
    timed_by(standby)
    arguments = ["--host-port", str(standby.host_port), "--l2-port", str(standby.lidar_port)]
    outcome = run("discover", *arguments, "--probe", "127.0.0.1", "--timeout", "1")
    assert outcome.code == 0
    assert "16" in outcome.out


def test_discover_without_a_unit_says_what_to_do(run: Run) -> None:
    outcome = run("discover", "--host-port", str(free_port()), "--timeout", "0.3")
    assert outcome.code == 1
    assert "192.168.1.2" in outcome.err
    assert "ip address add" in outcome.err


def test_stop_and_start_do_what_they_say(run: Run, unit: Unit) -> None:
    outcome = run("stop", *unit.options)
    assert (outcome.code, outcome.out) == (0, "stopped\n")
    assert not is_measuring(unit)
    assert "in standby" in run("stop", *unit.options).out
    outcome = run("start", *unit.options, "--wait", "10")
    assert (outcome.code, outcome.out) == (0, "started\n")
    assert is_measuring(unit)
    assert "running already" in run("start", *unit.options).out


def test_start_waits_in_vain_for_a_unit_that_does_not_wake(run: Run, make_unit: Any) -> None:
    unit = make_unit(mode=int(WorkMode.WAIT_FOR_START), wakes=False)
    outcome = run("start", *unit.options, "--wait", "0.5")
    assert outcome.code == 1
    assert "no points after 0.5 s" in outcome.err


@pytest.mark.parametrize(("verb", "runs"), [("start", False), ("stop", True)])
def test_interrupted_it_leaves_the_unit_as_it_was(
    run: Run, make_unit: Any, monkeypatch: pytest.MonkeyPatch, verb: str, runs: bool
) -> None:
    unit = make_unit(mode=0 if runs else int(WorkMode.WAIT_FOR_START))
    command = Device.command
    sent = []

    def interrupted(self: Any, start: Any) -> Any:
        answer = command(self, start)
        sent.append(answer.command)
        if len(sent) == 1:
            raise KeyboardInterrupt
        return answer

    monkeypatch.setattr(Device, "command", interrupted)
    outcome = run(verb, *unit.options, *(["--wait", "5"] if verb == "start" else []))
    assert outcome.code != 0
    assert "interrupted" in outcome.out
    assert len(sent) == 2
    assert is_measuring(unit) == runs


def test_reset_reboots_the_unit(run: Run, unit: Unit) -> None:
    outcome = run("reset", *unit.options, "--wait", "15")
    assert (outcome.code, outcome.err) == (0, "")
    assert "has restarted" in outcome.out
    assert unit.device._firmware.boots == 1
    assert run("reset", *unit.options).out == "reset sent\n"


def test_a_reset_that_does_not_arrive_is_noticed(run: Run, make_unit: Any) -> None:
    unit = make_unit(faults=FaultConfig(command_loss=1.0))
    outcome = run("reset", *unit.options, "--wait", "1")
    assert outcome.code == 1
    assert "the device did not restart within" in outcome.err


@pytest.mark.parametrize(
    ("text", "now", "expected"),
    [
        ("0", 5, 0),
        ("0x10", 0, 16),
        ("standard", 7, 0),
        ("wide_fov,imu_off", 8, 5),
        ("WIDE_FOV", 0, 1),
        ("+imu_off", 1, 5),
        ("+imu_off,-wide_fov", 1, 4),
        ("-serial", 8, 0),
    ],
)
def test_work_modes_as_people_write_them(text: str, now: int, expected: int) -> None:
    assert parse_work_mode(text, now) == expected


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("loud", "'loud' is not known.*wide_fov"),
        ("+imu_off,wide_fov", "all names need a sign"),
        ("-1", "expected 0 to 0x3fffff"),
        ("0x400000", "expected 0 to 0x3fffff"),
        ("", "not known"),
        ("+standard", "not known"),
    ],
)
def test_wrong_work_modes_are_refused(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse_work_mode(text, 0)


def test_unknown_bits_are_shown() -> None:
    assert work_mode_text(0x21) == "33 (wide_fov, unknown bits 0x20)"


def test_work_mode_is_shown_asked_for_stored_and_read_back(run: Run, unit: Unit) -> None:
    outcome = run("set", "work-mode", "imu_off", *unit.options, answer="y")
    assert outcome.code == 0
    assert "0 (standard)" in outcome.out
    assert "4 (imu_off)" in outcome.out
    assert "read back" in outcome.out
    assert "restart" not in outcome.out
    assert unit.flash.work_mode == 4
    assert json.loads(run("get", "work-mode", *unit.options, "--json").out) == {"work_mode": 4}
    assert run("get", "work-mode", *unit.options).out == "4 (imu_off)\n"
    outcome = run("set", "work-mode", "imu_off", *unit.options)
    assert "nothing to change" in outcome.out
    assert "restart" in run("set", "work-mode", "+mode_2d", *unit.options, "--yes").out
    assert unit.flash.work_mode == 6


def test_a_change_may_begin_with_a_minus(run: Run, make_unit: Any) -> None:
    unit = make_unit(mode=int(WorkMode.IMU_OFF))
    outcome = run("set", "work-mode", "-imu_off", *unit.options, "--yes")
    assert outcome.code == 0, outcome.err
    assert unit.flash.work_mode == 0


@pytest.mark.parametrize("answer", ["", "n", "no"])
def test_without_a_yes_nothing_is_stored(run: Run, unit: Unit, answer: str) -> None:
    before = unit.flash
    for verb in (
        ["work-mode", "imu_off"],
        ["mac", "02:00:00:00:00:01"],
        ["network", "--lidar-ip", "127.0.0.9"],
        ["parameters", "range_min=0.3"],
    ):
        outcome = run("set", *verb, *unit.options, answer=answer)
        assert outcome.code == 1
    assert unit.flash == before


def test_losing_ethernet_is_warned_of(run: Run, unit: Unit) -> None:
    outcome = run("set", "work-mode", "serial", *unit.options, answer="n")
    assert "Ethernet is off" in outcome.out
    assert unit.flash.work_mode == 0


@pytest.mark.parametrize("verb", [["work-mode", "wide_fov"], ["parameters", "range_min=0.3"]])
def test_an_interrupted_change_is_undone(
    run: Run, unit: Unit, monkeypatch: pytest.MonkeyPatch, verb: list[str]
) -> None:
    before = unit.flash
    read = Device.read_parameters
    calls = []

    def interrupted(self: Any) -> Any:
        calls.append(unit.flash)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return read(self)

    monkeypatch.setattr(Device, "read_parameters", interrupted)
    outcome = run("set", *verb, *unit.options, "--yes")
    assert outcome.code != 0
    assert "has its old value again" in outcome.out
    assert calls[1] != before  # the change had been made
    assert unit.flash.work_mode == before.work_mode
    assert parameters_payload(unit.flash) == parameters_payload(before)


def test_parameters_are_stored_and_read_back(run: Run, unit: Unit) -> None:
    outcome = run(
        "set", "parameters", "range_min=0.3", "calibration_3d.beta_angle=0.01", *unit.options,
        "--yes",
    )  # fmt: skip
    assert outcome.code == 0
    assert "experimental" in outcome.out
    stored = parameter_fields(parameters_payload(unit.flash))
    assert stored["range_min"] == pytest.approx(0.3)
    assert stored["calibration_3d.beta_angle"] == pytest.approx(0.01)
    assert stored["calibration_3d.xi_angle"] == pytest.approx(0.002945)
    said = json.loads(run("get", "parameters", *unit.options, "--json").out)
    assert said["range_min"] == stored["range_min"]
    assert "range_min" in run("get", "parameters", *unit.options).out


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("range_min", "NAME=VALUE"),
        ("range=1", "not known, expected one of range_min"),
        ("range_min=far", "not a finite number"),
        ("range_min=nan", "not a finite number"),
        ("range_max=1e39", "not a finite number"),
        ("range_min=60", "less than range_max"),
        ("work_mode=8", "not known"),
    ],
)
def test_wrong_parameters_are_refused(run: Run, unit: Unit, change: str, words: str) -> None:
    before = unit.flash
    outcome = run("set", "parameters", change, *unit.options, "--yes")
    assert outcome.code == 2
    assert words in outcome.err
    assert unit.flash == before


def test_network_is_stored_and_what_is_left_out_stays(run: Run, unit: Unit) -> None:
    outcome = run("set", "network", "--lidar-ip", "127.0.0.9", *unit.options, "--yes")
    assert outcome.code == 0
    assert "restart" in outcome.out
    assert unit.flash.network == (
        "127.0.0.9", "127.0.0.1", "127.0.0.1", "255.255.255.0", unit.lidar_port, unit.host_port,
    )  # fmt: skip
    used = json.loads(run("get", "network", *unit.options, "--json").out)
    assert used == {
        "lidar_ip": "127.0.0.1",
        "lidar_port": unit.lidar_port,
        "user_ip": "127.0.0.1",
        "user_port": unit.host_port,
    }


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["--lidar-ip", "l2"], "l2"),
        (["--lidar-ip", "224.0.0.1"], "is not a host address"),
        (["--user-ip", "10.0.0.1"], "not in the unit's subnet"),
        (["--lidar-ip", "127.0.0.255"], "broadcast address of subnet"),
        (["--lidar-port", "0"], "1 to 65535"),
        (["--gateway", "here"], "gateway"),
        (["--subnet-mask", "255.0.255.0"], "mask"),
    ],
)
def test_wrong_networks_are_refused(run: Run, unit: Unit, change: list[str], words: str) -> None:
    before = unit.flash
    outcome = run("set", "network", *change, *unit.options, "--yes")
    assert outcome.code == 2
    assert words in outcome.err
    assert unit.flash == before


def test_a_unit_that_sends_elsewhere_can_be_told_to_come_back(run: Run, make_unit: Any) -> None:
    unit = make_unit()
    elsewhere = ["--l2-ip", "127.0.0.1", "--l2-port", str(unit.lidar_port)]
    elsewhere += ["--host-port", str(free_port())]
    wanted = ["--lidar-ip", "127.0.0.8", "--lidar-port", "7000", "--user-ip", "127.0.0.1"]
    outcome = run("set", "network", *wanted, *elsewhere, "--blind", "--yes")
    assert outcome.code == 2
    assert "give --user-port" in outcome.err
    wanted += ["--user-port", "7001"]
    outcome = run("set", "network", *wanted, *elsewhere, "--yes")
    assert outcome.code == 1
    outcome = run("set", "network", *wanted, *elsewhere, "--blind", "--yes")
    assert outcome.code == 0
    assert "not known" in outcome.out
    deadline = time.monotonic() + LIMIT_S
    while unit.flash.network.lidar_ip != "127.0.0.8":
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert unit.flash.network.user_port == 7001


def test_ctrl_c_while_it_waits_for_points_puts_the_unit_back(make_unit: Any) -> None:
    unit = make_unit(
        int(WorkMode.WAIT_FOR_START), boot_scale=1.0, link_s=0.0, wake_imu_s=0.0,
        wake_points_s=120.0,
    )  # fmt: skip
    process = subprocess.Popen(
        [sys.executable, "-m", "l2lidar_node.cli.main", "start", *unit.options, "--wait", "60"],
        cwd=Path(__file__).parents[3],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    deadline = time.monotonic() + LIMIT_S
    while not unit.device.sent[wire.PacketType.IMU]:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=LIMIT_S)
    assert process.returncode != 0
    assert "interrupted: in standby" in said
    assert "Traceback" not in said
    assert not is_measuring(unit)


def test_two_ends_of_one_address_are_refused(run: Run, unit: Unit) -> None:
    outcome = run("set", "network", "--lidar-port", str(unit.host_port), *unit.options, "--yes")
    assert outcome.code == 2
    assert "both" in outcome.err


def test_mac_is_stored(run: Run, unit: Unit) -> None:
    outcome = run("set", "mac", "4C-32-01-00-00-63", *unit.options, "--yes")
    assert outcome.code == 0
    assert unit.flash.mac == "4c:32:01:00:00:63"


@pytest.mark.parametrize("text", ["4c:32:01:00:00", "4c:32:01:00:00:0g", "01:00:5e:00:00:01", "x"])
def test_wrong_macs_are_refused(run: Run, unit: Unit, text: str) -> None:
    before = unit.flash
    outcome = run("set", "mac", text, *unit.options, "--yes")
    assert outcome.code == 2
    assert unit.flash == before


def test_the_mac_of_the_loopback_interface_is_not_known(run: Run, unit: Unit) -> None:
    assert run("get", "mac", *unit.options).code == 1
    assert json.loads(run("get", "mac", *unit.options, "--json").out) == {"mac": None}


def test_a_unit_that_does_not_acknowledge_is_exit_code_1(run: Run, make_unit: Any) -> None:
    unit = make_unit(faults=FaultConfig(command_loss=1.0))
    outcome = run("set", "work-mode", "4", *unit.options, "--yes")
    assert outcome.code == 1
    assert unit.flash.work_mode == 0


def test_sync_check_measures_a_unit_without_imu(
    run: Run, make_unit: Any, timed_by: TimedBy
) -> None:
    unit = make_unit(mode=int(WorkMode.IMU_OFF))
    timed_by(unit)
    outcome = run("sync-check", *unit.options, "--duration", "2", "--json")
    assert outcome.code == 0, outcome.err
    assert list(json.loads(outcome.out)["streams"]) == ["points"]


def test_sync_check_measures_the_clock_and_leaves_it_alone(
    run: Run, unit: Unit, timed_by: TimedBy
) -> None:
    timed_by(unit)
    outcome = run("sync-check", *unit.options, "--duration", "2", "--json")
    assert outcome.code == 0
    found = json.loads(outcome.out)
    points = found["streams"]["points"]
    # As well as the arrivals allow.
    off = 1e-3 + points["jitter_max_us"] * 1e-6 * 215.6 / points["packets"]
    assert found["ratio"] == pytest.approx(1.99866, rel=off)
    assert points["rate_hz"] == pytest.approx(215.6, rel=0.01 + off)
    assert found["streams"]["imu"]["interval_std_us"] < 5
    assert unit.device.received[wire.PacketType.TIME_SYNC] == 0
