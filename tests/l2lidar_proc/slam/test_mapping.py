"""Admission, the pose graph, and whole maps of walks with drift."""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

import numpy as np
import pytest

from l2lidar_node.emulator.world.mapping_scenes import office_ring
from l2lidar_node.types import F64, HostNs
from l2lidar_proc.slam import se3
from l2lidar_proc.slam.config import LoopConfig, SlamConfig
from l2lidar_proc.slam.loops import Admission, Graph, Loop
from l2lidar_proc.slam.nodes import (
    CovarianceGrowth,
    Health,
    Keyframe,
    OdometrySweep,
    SlamState,
)
from l2lidar_proc.slam.pose_graph import (
    CUT,
    EDGE,
    LOOP,
    ODOMETRY,
    GtsamMissingError,
    deviations,
    optimized,
)
from l2lidar_proc.slam.slam import Slam
from l2lidar_proc.slam.verification import Fit, Match
from tests.l2lidar_proc.conftest import STEP
from tests.support.mapping_runs import MappingRun, ate, drifting, scan, walk

TIGHT = np.diag(np.repeat((1e-3**2, 0.01**2), 3))
FIT = Fit(0.9, 0.99, 0.0)


def ring(count: int, radius: float) -> F64:
    """Return poses around a circle, one lap."""
    angle = np.arange(count) / count * 2.0 * np.pi
    return np.stack(
        [
            se3.planar(radius * np.cos(a), radius * np.sin(a), a + np.pi / 2.0)
            for a in angle.tolist()
        ]
    )


def chain(poses: F64, covariance: F64) -> Any:
    """Return the odometry's edges between poses."""
    edges = np.zeros(len(poses) - 1, EDGE)
    edges["first"], edges["second"] = np.arange(len(poses) - 1), np.arange(1, len(poses))
    edges["pose"] = se3.inverse(poses[:-1]) @ poses[1:]
    edges["covariance"], edges["way"] = covariance, 5.0
    return edges


def loop_of(poses: F64, query: int, target: int, off: tuple[float, ...] = (0.0,) * 6) -> Loop:
    """Return a verified pair, right but for an error."""
    pose = se3.inverse(poses[target]) @ poses[query] @ se3.exp(off)
    return Loop(query, target, Match(pose, TIGHT, FIT, 0.1, True), 5.0 * query)


def test_a_loop_alone_waits_and_three_that_agree_enter_together() -> None:
    poses = np.concatenate((ring(40, 30.0), ring(40, 30.0)[:10]))
    admission = Admission(LoopConfig())

    admission.judge(None, loop_of(poses, 40, 0))
    admission.judge(None, loop_of(poses, 40, 1))
    admission.judge(None, loop_of(poses, 41, 1))
    assert admission.batch(poses) == []
    admission.judge(None, loop_of(poses, 42, 2))

    assert {loop.query for loop in admission.batch(poses)} == {40, 41, 42}


def test_loops_that_do_not_agree_never_enter() -> None:
    poses = np.concatenate((ring(40, 30.0), ring(40, 30.0)[:10]))
    admission = Admission(LoopConfig())
    for number in range(8):  # each 3 m from where the others say
        off = (0.0, 0.0, 0.0, 3.0 * number, 0.0, 0.0)
        admission.judge(None, loop_of(poses, 40 + number, number, off))

    assert admission.batch(poses) == []


def test_a_barred_pair_is_not_looked_at_again() -> None:
    poses = ring(40, 30.0)
    admission = Admission(LoopConfig())
    lie = loop_of(poses, 39, 0)
    admission.judge(None, lie)
    admission.bar([lie])

    assert not admission.is_open(39, 0)
    assert admission.waiting == 0
    assert admission.rejected["optimization"] == 1


def test_the_odometry_bars_a_place_three_meters_above_within_a_kilometer() -> None:
    poses = ring(80, 64.0)  # 400 m around
    edges = chain(poses, np.diag(np.repeat((5e-4**2, 0.025**2), 3)))
    relation = Graph(poses, edges, 79, SlamConfig()).relation(0)

    assert relation.way == pytest.approx(395.0)
    assert relation.admits(np.array([0.0, 0.0, 0.01, 2.0, 1.0, 0.3]))
    assert not relation.admits(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 3.0]))
    assert not relation.admits(np.array([0.0, 0.0, 0.0, 15.0, 0.0, 0.0]))


def test_ways_lead_through_loops_and_never_through_cuts() -> None:
    poses = ring(40, 30.0)
    edges = chain(poses, TIGHT)
    loop = np.zeros(1, EDGE)
    loop["first"], loop["second"], loop["kind"] = 0, 39, LOOP
    loop["pose"], loop["covariance"] = se3.inverse(poses[0]) @ poses[39], TIGHT
    short = Graph(poses, np.concatenate((edges, loop)), 39, SlamConfig())
    edges["kind"][20] = CUT
    apart = Graph(poses, edges, 39, SlamConfig())

    assert short.ways[1] < 6.0
    assert np.isinf(apart.ways[:21]).all()
    assert np.isfinite(apart.ways[21:]).all()


def test_the_graph_takes_a_ring_s_drift_out_and_shows_a_lie() -> None:
    pytest.importorskip("gtsam")
    truth = ring(60, 40.0)
    steps = se3.inverse(truth[:-1]) @ truth[1:]
    noise = np.random.default_rng(2).normal(0.0, (0, 0, 2e-3, 0.03, 0.03, 0.02), (59, 6))
    drift = [truth[0]]
    for step, off in zip(steps, se3.exp(noise), strict=True):
        drift.append(drift[-1] @ step @ off)
    poses = np.stack(drift)
    edges = chain(poses, np.diag(np.repeat((2e-3**2, 0.03**2), 3)))
    loops = np.zeros(3, EDGE)
    for row, query in zip(loops, (57, 58, 59), strict=True):
        row["first"], row["second"], row["kind"] = query - 57, query, LOOP
        row["pose"] = se3.inverse(truth[query - 57]) @ truth[query]
        row["covariance"] = TIGHT
    edges = np.concatenate((edges, loops))

    solved = optimized(poses, edges, np.zeros(1, np.int64))
    lie = edges.copy()
    lie["pose"][-1] = lie["pose"][-1] @ se3.exp((0.0, 0.0, 0.0, 5.0, 0.0, 0.0))
    bent = optimized(poses, lie, np.zeros(1, np.int64))

    assert ate(solved, truth) < 0.5 * ate(poses, truth)
    assert deviations(solved, edges).max() < 3.0
    assert deviations(bent, lie).max() > 3.0


def test_a_lap_and_a_third_closes_right_loops_and_mends_the_drift(
    office: MappingRun, mapped: Slam
) -> None:
    odometry = drifting(office.truth, 0.5, 1, STEP)
    corrected = mapped.map().trajectory()["pose"]

    assert len(mapped.loops) >= 3
    assert ate(corrected, office.truth) < 0.5 * ate(odometry, office.truth)
    true = [se3.leveled(office.true_pose(node.stamp)) for node in mapped.nodes]
    for edge in mapped.edges[mapped.edges["kind"] == LOOP]:
        expected = se3.inverse(true[edge["first"]]) @ true[edge["second"]]
        turn, way = se3.magnitude(se3.error(expected, edge["pose"]))
        assert way < 0.05
        assert np.degrees(turn) < 0.5


def test_ground_that_was_seen_before_takes_no_memory(mapped: Slam) -> None:
    assert all(node.submap is not None for node in mapped.nodes[:12])
    assert all(node.submap is None for node in mapped.nodes[-5:])


def test_the_largest_part_of_a_map_leaves_out_what_a_cut_divides(mapped: Slam) -> None:
    built = mapped.map()
    edges = built.edges[built.edges["kind"] != LOOP]
    edges["kind"][4] = CUT
    parts = dataclasses.replace(built, edges=edges).largest_part()

    assert built.largest_part().all()
    assert not parts[:5].any()
    assert parts[5:].all()


def test_without_gtsam_there_are_keyframes_but_no_loops(
    office: MappingRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(GtsamMissingError, match="docs/install"):
        Slam(SlamConfig())
    keyframes: list[Keyframe] = []
    slam = Slam(SlamConfig(loop=LoopConfig(loops=False)), on_keyframe=keyframes.append)
    for sweep in list(office.sweeps(drifting(office.truth, 0.5, 1, STEP)))[:40]:
        slam.add(sweep)
    slam.finish()

    assert [item.number for item in keyframes] == list(range(len(slam.nodes)))
    assert keyframes[0].covariance is None
    for item in keyframes[1:]:
        assert item.covariance is not None
        assert np.linalg.eigvalsh(item.covariance)[0] > 0.0


def test_without_drift_the_map_is_as_good_as_the_odometry(office: MappingRun) -> None:
    pytest.importorskip("gtsam")
    slam = Slam(SlamConfig())
    for sweep in office.sweeps(drifting(office.truth, 0.0, 0, STEP)):
        slam.add(sweep)
    slam.finish()

    assert ate(slam.map().trajectory()["pose"], office.truth) < 0.015


def test_degenerate_and_predicted_sweeps_close_nothing(office: MappingRun) -> None:
    pytest.importorskip("gtsam")
    slam = Slam(SlamConfig())
    for health in (Health.DEGENERATE, Health.PREDICTED):
        for sweep in office.sweeps(drifting(office.truth, 0.5, 1, STEP), health):
            slam.add(sweep)
    slam.finish()

    assert slam.loops == []
    assert not any(node.usable for node in slam.nodes)


def test_a_skipped_sweep_adds_nothing_and_spoils_nothing(office: MappingRun) -> None:
    slam, whole = Slam(SlamConfig()), Slam(SlamConfig())
    for number, sweep in enumerate(office.sweeps(drifting(office.truth, 0.0, 0, STEP))):
        health = Health.GOOD if number % 2 else Health.SKIPPED
        slam.add(dataclasses.replace(sweep, health=health))
        whole.add(sweep)
        if len(slam.nodes) == 3:
            break
    assert all(node.is_comparable for node in slam.nodes)
    for node, other in zip(slam.nodes, whole.nodes, strict=True):
        assert node.submap is not None
        assert other.submap is not None
        assert len(node.sweeps) == len(other.sweeps)
        assert len(node.submap) < len(other.submap)


def test_after_a_cut_the_place_is_lost_until_the_map_knows_it_again(office: MappingRun) -> None:
    pytest.importorskip("gtsam")
    slam = Slam(SlamConfig())
    lap = round(len(office.truth) / 1.35)
    odometry = drifting(office.truth, 0.0, 0, STEP)
    jump = se3.planar(20.0, -7.0, 2.0)
    states = []
    for number, sweep in enumerate(office.sweeps(odometry)):
        if number >= lap - 10:  # carried away unseen: the odometry goes on from elsewhere
            health = Health.CUT if number == lap - 10 else Health.GOOD
            sweep = dataclasses.replace(sweep, T_odom_body=jump @ sweep.T_odom_body, health=health)
        slam.add(sweep)
        states.append(slam.state)
    slam.finish()

    assert states[lap - 11] is SlamState.LOCALIZED
    assert SlamState.LOST in states
    kinds = slam.edges["kind"]
    assert (kinds == CUT).sum() == 1
    assert (kinds == ODOMETRY).sum() == len(slam.nodes) - 2
    if slam.state is SlamState.LOCALIZED:  # found again: it has to be right
        assert ate(slam.map().trajectory()["pose"], office.truth) < 0.1


def test_a_ring_of_identical_doors_never_gets_a_wrong_loop() -> None:
    pytest.importorskip("gtsam")
    scene = office_ring()
    run = scan(scene, walk(scene, 1.3, step=STEP), step=STEP, rays=3000)
    slam = Slam(SlamConfig())
    for sweep in run.sweeps(drifting(run.truth, 1.0, 3, STEP)):
        slam.add(sweep)
    slam.finish()

    true = [se3.leveled(run.true_pose(node.stamp)) for node in slam.nodes]
    for edge in slam.edges[slam.edges["kind"] == LOOP]:
        expected = se3.inverse(true[edge["first"]]) @ true[edge["second"]]
        assert se3.magnitude(se3.error(expected, edge["pose"]))[1] < 0.3


def drive(count: int, step: float, **changes: Any) -> list[OdometrySweep]:
    """Return sweeps straight ahead, each so many meters farther; no loops can be found."""
    points = np.random.default_rng(0).uniform(-10.0, 10.0, (50, 3))
    sweep = OdometrySweep(HostNs(0), np.eye(4), points, Health.GOOD, np.zeros((6, 6)))
    return [
        dataclasses.replace(
            sweep, stamp=HostNs(number), T_odom_body=se3.planar(step * number, 0.0, 0.0), **changes
        )
        for number in range(count)
    ]


def chained(sweeps: list[OdometrySweep]) -> Slam:
    """Return the graph of some sweeps, without loops."""
    slam = Slam(SlamConfig(loop=LoopConfig(loops=False)))
    for sweep in sweeps:
        slam.add(sweep)
    slam.finish()
    return slam


@pytest.mark.parametrize("covariance", [9999.0, 0.25])
def test_a_cut_says_nothing_of_the_motion_after_it(covariance: float) -> None:
    sweeps = drive(200, 0.25)
    sweeps[80] = dataclasses.replace(
        sweeps[80], health=Health.CUT, covariance=covariance * np.eye(6)
    )
    slam = chained(sweeps)

    (cut,) = np.flatnonzero(slam.edges["kind"] == CUT)
    np.testing.assert_allclose(
        slam.edges["covariance"][cut + 1], slam.edges["covariance"][0], rtol=1e-6
    )
    assert not slam.nodes[slam.edges["second"][cut]].usable


def test_while_the_place_is_lost_its_covariance_says_so() -> None:
    sweeps = drive(200, 0.25)
    sweeps[8] = dataclasses.replace(sweeps[8], health=Health.CUT)
    slam = Slam(SlamConfig(loop=LoopConfig(loops=False)))
    for sweep in sweeps:
        slam.add(sweep)
        if slam.state is SlamState.LOST:
            assert np.sqrt(np.linalg.eigvalsh(slam.covariance)[0]) > 1.0
    slam.finish()

    assert slam.state is SlamState.LOST


def test_a_loaded_map_with_an_early_cut_is_extended_where_most_of_it_is(
    office: MappingRun, mapped: Slam
) -> None:
    built = mapped.map()
    edges = built.edges[built.edges["kind"] != LOOP]
    edges["kind"][1] = CUT
    slam = Slam(SlamConfig(), dataclasses.replace(built, edges=edges))
    run = office.part(40, 130)  # the first submaps are not passed
    for sweep in run.sweeps(drifting(run.truth, 0.5, 5, STEP)):
        slam.add(sweep)
    slam.finish()

    assert slam.state is SlamState.LOCALIZED
    assert np.isfinite(slam.covariance).all()
    assert np.sqrt(slam.covariance[3, 3]) < 1.0
    assert slam.T_map_odom is not None


def test_an_edge_counts_what_the_covariance_grows_by_not_what_it_was_before() -> None:
    late = drive(100, 0.25, covariance=0.25 * np.eye(6))
    late[50] = dataclasses.replace(late[50], health=Health.DEGENERATE)
    growing = drive(100, 0.25, covariance=0.25 * np.eye(6))
    for number in range(44, 56):  # within the third submap
        covariance = (0.25 + 0.01 * (number - 43)) * np.eye(6)
        growing[number] = dataclasses.replace(
            growing[number], health=Health.PREDICTED, covariance=covariance
        )
    plain, same, more = chained(drive(100, 0.25)), chained(late), chained(growing)

    np.testing.assert_allclose(same.edges["covariance"], plain.edges["covariance"], atol=1e-12)
    added = more.edges["covariance"] - plain.edges["covariance"]
    np.testing.assert_allclose(added[2], 0.12 * np.eye(6), atol=1e-12)
    assert np.abs(added[[0, 1, 3]]).max() < 1e-12


@pytest.mark.parametrize("step", [0.25, 4.0])
def test_the_way_between_two_submaps_counts(step: float) -> None:
    keyframes: list[Keyframe] = []
    config = SlamConfig(loop=LoopConfig(loops=False))
    slam = Slam(config, on_keyframe=keyframes.append)
    for sweep in drive(60, step):
        slam.add(sweep)
    slam.finish()

    for node in slam.nodes:
        assert node.way == pytest.approx(node.T_odom_node[0, 3])
    np.testing.assert_allclose(slam.edges["way"], slam.edges["pose"][:, 0, 3])
    sigma = np.hypot(0.002, 0.01 * config.drift.drift_percent * slam.edges["way"])
    np.testing.assert_allclose(np.sqrt(slam.edges["covariance"][:, 3, 3]), sigma)
    told = [item.covariance for item in keyframes[1:]]
    np.testing.assert_array_equal(told, slam.edges["covariance"])


def test_a_bad_sweep_that_begins_a_submap_counts_for_the_edge_to_it() -> None:
    sweeps = drive(100, 0.25)
    first = 42  # each submap holds 20 steps and the one that leads to the next
    plain = chained(drive(100, 0.25))
    assert plain.nodes[2].stamp == first
    sweeps[first] = dataclasses.replace(
        sweeps[first], health=Health.PREDICTED, covariance=0.1 * np.eye(6)
    )
    added = chained(sweeps).edges["covariance"] - plain.edges["covariance"]

    np.testing.assert_allclose(added[1], 0.1 * np.eye(6), atol=1e-12)
    assert np.abs(added[[0, 2]]).max() < 1e-12


def test_the_jump_of_a_cut_is_no_way() -> None:
    sweeps = drive(100, 0.25)
    away = se3.planar(0.0, 300.0, 0.0)
    for number in range(50, 100):
        jumped = away @ sweeps[number].T_odom_body
        health = Health.CUT if number == 50 else Health.GOOD
        sweeps[number] = dataclasses.replace(sweeps[number], T_odom_body=jumped, health=health)
    slam = chained(sweeps)

    assert slam.nodes[-1].way < 25.0


def test_after_a_cut_the_covariance_grows_from_that_of_the_next_sweep() -> None:
    growth = CovarianceGrowth()
    bad = ((Health.CUT, 9999.0), (Health.DEGENERATE, 0.25), (Health.DEGENERATE, 0.3))
    grown = [
        growth.add(dataclasses.replace(sweep, health=health, covariance=variance * np.eye(6)))
        for sweep, (health, variance) in zip(drive(3, 0.25), bad, strict=True)
    ]

    np.testing.assert_allclose(grown[:2], np.zeros((2, 6, 6)))
    np.testing.assert_allclose(grown[2], 0.05 * np.eye(6), atol=1e-12)
