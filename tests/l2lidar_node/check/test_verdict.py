"""Good recordings pass for every consumer, and each single defect is found by its name."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import l2lidar_node.check
from l2lidar_node.check.report import judge
from l2lidar_node.check.requirements import CONSUMERS, Finding, worst
from l2lidar_node.config import DriverConfig
from l2lidar_node.settings import build, settings_of
from l2lidar_node.types import Level
from l2lidar_proc.deskew.config import DeskewNodeConfig
from tests.l2lidar_node.check.defects import DEFECTS, Defect, damaged
from tests.l2lidar_node.check.recordings import cloud, copied, good, points_of, stamp_of


def bad(findings: list[Finding]) -> dict[str, Level]:
    return {f"{item.subject}.{item.check}": item.level for item in findings if item.level}


@cache
def judged(item: Defect) -> list[Finding]:
    return judge(damaged(item).observe(), CONSUMERS[item.consumer])


@pytest.mark.parametrize("consumer", CONSUMERS)
def test_what_the_driver_publishes_for_a_consumer_is_right(consumer: str) -> None:
    findings = judge(good(consumer).observe(), CONSUMERS[consumer])
    assert bad(findings) == {}
    assert len(findings) >= 10
    assert not [item for item in findings if item.text.startswith("not judged")]


def test_a_first_sweep_that_is_a_part_of_one_is_no_defect() -> None:
    made = copied(good("lio_sam"))
    points, stamp = points_of(made.clouds[0]), stamp_of(made.clouds[0])
    rest = points[points["time"] > 0.1].copy()
    late = rest["time"][0]
    rest["time"] -= late
    made.clouds[0] = cloud(rest, stamp + round(float(late) * 1e9))
    assert bad(judge(made.observe(), CONSUMERS["lio_sam"])) == {}


@pytest.mark.parametrize("item", DEFECTS, ids=lambda item: f"{item.name}-{item.consumer}")
def test_a_defect_is_found_by_name_and_nothing_else(item: Defect) -> None:
    found = bad(judged(item))
    assert found.get(item.found) == item.level, found
    assert set(found) <= {item.found, *item.also}


def test_every_finding_there_can_be_has_a_defect_that_leads_to_it() -> None:
    folder = Path(l2lidar_node.check.__file__).parent
    checks = set()
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Finding":
                name = node.args[2]
                if isinstance(name, ast.Constant):
                    checks.add(str(name.value))
    assert len(checks) > 40
    assert checks - {item.found.partition(".")[2] for item in DEFECTS} == set()


def test_what_is_advised_are_parameters_and_values_that_there_are() -> None:
    known = {item.name: group for group in (DriverConfig, DeskewNodeConfig)
             for item in settings_of(group)}  # fmt: skip
    advice = set()
    for item in DEFECTS:
        for finding in judged(item):
            if finding.level:
                assert finding.fix
                assert "\n" not in finding.line
                advice |= set(re.findall(r"\b(\w{4,}): (\w+)", finding.fix))
    assert len(advice) > 8
    for name, value in advice - {("use_sim_time", "true")}:
        if name != "N_SCAN":
            parsed = {"true": True, "false": False}.get(value, value)
            parsed = int(value) if value.isdigit() else parsed
            build(known[name], {name: parsed})


def test_the_worst_level_decides() -> None:
    made = [Finding(level, "cloud", "x", "y") for level in (Level.OK, Level.WARN)]
    assert worst([]) is Level.OK
    assert worst(made) is Level.WARN
