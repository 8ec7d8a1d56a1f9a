"""The measuring commands for faults, hostile input and load, in short."""

from __future__ import annotations

import re
import signal
from pathlib import Path
from typing import Any

import pytest

from benchmarks import fault_world, faults, interrupts, load_scale
from benchmarks.fuzz import campaign
from l2lidar_node.emulator.physics import PhysicsConfig, RayCastError, RayCastWorker
from tests.support.fault_runs import SINGLE, FaultCase, random_case, run

# What the driver's own tests of faults do not go through with a truth for every point.
SHORT = [
    case
    for case in SINGLE
    if re.search(r"split.*2D|reboot twice|reboot, 2D|host clock [^+]|host clock \+1 h", case.name)
]
INPUTS = {
    "wire": 30_000,
    "driver": 2_000,
    "pcap": 1_000,
    "cloud": 3_000,
    "message": 1_000,
    "yaml": 200,
    "tum": 200,
}


@pytest.mark.parametrize("case", SHORT, ids=lambda case: case.name)
def test_nothing_wrong_is_published_and_nothing_good_lost(case: FaultCase) -> None:
    verdict = run(case, seed=2)
    assert faults.is_right(verdict), verdict
    assert verdict.used > 0.5 * (verdict.sent - verdict.destroyed)


@pytest.mark.parametrize("number", range(500, 504))
def test_random_combinations_of_faults(number: int) -> None:
    verdict = run(random_case(number, 8.0), number)
    assert faults.is_right(verdict), verdict
    assert verdict.used > 200


def test_a_wrong_stamp_a_wrong_point_and_a_loss_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    from l2lidar_node.driver.sweep import SweepAssembler
    from tests.support.clock_rig import RecordingClock

    good = FaultCase("none", {}, 4.0)
    observe, push = RecordingClock.observe, SweepAssembler.push
    with monkeypatch.context() as patch:
        patch.setattr(
            RecordingClock,
            "observe",
            lambda self, stream, seq, stamp, arrival, duration_ns=0: observe(
                self, stream, seq, stamp, arrival - 5_000_000, duration_ns
            ),
        )
        assert not faults.is_right(run(good, 1))
    with monkeypatch.context() as patch:
        patch.setattr(
            SweepAssembler,
            "push",
            lambda self, packet, start, missing=0: push(
                self,
                packet._replace(payload=packet.payload[:300] + b"\0" + packet.payload[301:]),
                start,
                missing,
            ),
        )
        assert not faults.is_right(run(good, 1))


@pytest.mark.parametrize("name", INPUTS)
def test_hostile_input_is_survived(name: str) -> None:
    if name in ("yaml", "message"):
        pytest.importorskip("rclpy")
    outcome = campaign(name, INPUTS[name], 20.0, seed=5)
    assert outcome.failures == {}
    assert outcome.inputs > 0


@pytest.mark.parametrize("case", [fault_world.stranger, fault_world.closed, fault_world.disk])
def test_the_world_outside(case: Any) -> None:
    finding = fault_world.run(case)
    assert finding.good, finding


def test_programs_interrupted_at_random_moments_end_well() -> None:
    pytest.importorskip("rclpy")
    programs = list(interrupts.commands(Path()))
    unclean = [
        f"{sent}: {complaint}\n{how.said}"
        for sent, how in interrupts.run(programs, rounds=1, seed=7)
        if (complaint := how.complaint(sent))
    ]
    assert "\n".join(unclean) == ""


@pytest.mark.parametrize(
    ("code", "said", "left", "words"),
    [
        (1, "", 0, "exit code 1"),
        (0, "Traceback ...\n", 0, "'Traceback'"),
        (-11, "", 0, "exit code -11"),
        (0, "", 1, "1 processes left behind"),
        (130, "", 0, ""),
        (-2, "interrupted", 0, ""),
    ],
)
def test_an_unclean_end_is_seen(code: int, said: str, left: int, words: str) -> None:
    sent = interrupts.Interruption("deskew_node", (signal.SIGINT,), 1.0)
    assert interrupts.End(code, 0.1, said, left).complaint(sent) == words


def test_a_mesh_that_crashes_its_reader_is_refused_with_a_sentence(tmp_path: Path) -> None:
    pytest.importorskip("open3d")
    path = tmp_path / "cut_off.ply"
    # A face of no corners: open3d's reader dies of it.
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
        "property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0\n1 0 0\n0 1 0 1 2\n3 0 1 3\n"
    )
    with pytest.raises((RayCastError, ValueError), match=r"cut_off\.ply"):
        RayCastWorker(PhysicsConfig(world=str(path)))


def test_every_packet_is_received_or_counted_as_dropped() -> None:
    got = load_scale.crowd(2, 1, 2.0, 1.0)
    assert got["unsaid"] == got["failures"] == 0
    assert got["received"] > 500


@pytest.mark.ros
def test_nodes_survive_hostile_neighbors() -> None:
    """A short run of ``make fuzz-nodes``: attacks over DDS on five processes, then good data."""
    pytest.importorskip("rclpy")
    pytest.importorskip("gtsam")
    from benchmarks.fuzz_nodes import fuzz

    outcome = fuzz(seconds=0.0, seed=7, attacks=200, least=1, begin_calm=False)
    assert outcome.ended == ""
    campaign = outcome.campaign
    assert campaign.stuck == []
    assert campaign.fuzzer.errors == []
    assert campaign.fuzzer.sent >= 200
    assert campaign.rounds == 1
