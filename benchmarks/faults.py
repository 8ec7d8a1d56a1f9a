"""Makes everything go wrong that the virtual L2 and its surroundings can, and judges the driver.

``make faults`` prints the table and writes ``out/bench/faults.json``. First in simulated time:
every fault alone, then random combinations for as long as asked. Then in real time over sockets:
cables, addresses, suspended hosts, ports, disks and subscribers.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from typing import Any, Final

from benchmarks import fault_ros, fault_world
from benchmarks.fault_world import Finding
from benchmarks.results import Target, at_least, at_most, publish
from tests.support.fault_runs import SINGLE, FaultCase, Verdict, random_case, run

_COMBINATION_S: Final = 30.0
_MAX_ERROR_MS: Final = 2.0
_SUM: Final = ("sent", "destroyed", "used", "unlocked", "lost_good", "backwards", "wrong_sweeps")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run everything; return 1 if anything was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=0.1, help="of simulated combinations")
    parser.add_argument("--first", type=int, default=0, help="number of the first combination")
    parser.add_argument("--no-world", action="store_true", help="leave out what needs real time")
    parser.add_argument("--no-ros", action="store_true", help="leave out what needs ROS")
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    singles = [run(case, 1) for case in SINGLE]
    rows += [_simulated(case, verdict) for case, verdict in zip(SINGLE, singles, strict=True)]
    count = round(options.hours * 3600 / _COMBINATION_S)
    numbers = range(options.first, options.first + count)
    random = [_combination(random_case(number, _COMBINATION_S), number) for number in numbers]
    if random:
        rows.append(_simulated(FaultCase(f"{count} random combinations", {}), _sum(random)))
    findings: list[Finding] = []
    if not options.no_world:
        findings += [fault_world.run(case) for case in fault_world.CASES]
        if not options.no_ros:
            findings += fault_ros.run()
    rows += [_real(finding) for finding in findings]
    targets = _targets(singles + random, findings, options.hours)
    publish("faults", "Faults, judged by the truth", rows, targets)
    return int(not all(target.met for target in targets))


def _combination(case: FaultCase, number: int) -> Verdict:
    verdict = run(case, number)
    if not is_right(verdict):
        print(f"{case}: {verdict}", file=sys.stderr)
    return verdict


def is_right(verdict: Verdict) -> bool:
    """Tell whether nothing wrong was published and nothing good was lost."""
    return (
        verdict.worst_ms < _MAX_ERROR_MS
        and verdict.backwards == verdict.wrong_sweeps == 0
        and verdict.lost_good <= verdict.late
    )


def _sum(verdicts: Sequence[Verdict]) -> Verdict:
    total = Verdict(**{name: sum(getattr(one, name) for one in verdicts) for name in _SUM})
    for name in ("worst_ms", "lock_s", "gap_s"):
        setattr(total, name, max(getattr(one, name) for one in verdicts))
    total.late = sum(one.late for one in verdicts)
    return total


def _simulated(case: FaultCase, verdict: Verdict) -> dict[str, Any]:
    counted = ", ".join(f"{count} {name}" for name, count in verdict.counted.items() if count)
    return {
        "fault": case.name,
        "sent": verdict.sent,
        "destroyed": verdict.destroyed,
        "published": verdict.used,
        "without time": verdict.unlocked,
        "lost": verdict.lost_good,
        "wrong": verdict.wrong_sweeps + verdict.backwards,
        "worst stamp [ms]": round(verdict.worst_ms, 3),
        "first lock [s]": round(verdict.lock_s, 2),
        "recovery [s]": round(verdict.gap_s, 2),
        "remark": f"counted: {counted}" if counted else "",
    }


def _real(finding: Finding) -> dict[str, Any]:
    return {
        "fault": f"{finding.name} (real time)",
        "sent": finding.arrived,
        "destroyed": 0,
        "published": finding.published,
        "without time": finding.unlocked,
        "lost": finding.missing,
        "wrong": finding.backwards,
        "worst stamp [ms]": round(finding.worst_ms, 3),
        "first lock [s]": "",
        "recovery [s]": round(finding.recovery_s, 2),
        "remark": finding.remark if finding.good else f"NOT AS IT HAS TO BE; {finding.remark}",
    }


def _targets(
    verdicts: Sequence[Verdict], findings: Sequence[Finding], hours: float
) -> list[Target]:
    worst = max([one.worst_ms for one in verdicts] + [one.worst_ms for one in findings])
    backwards = sum(one.backwards for one in verdicts) + sum(one.backwards for one in findings)
    lost = sum(max(one.lost_good - one.late, 0) for one in verdicts)
    return [
        at_least("simulated combinations [h]", hours, 1.0),
        at_most("worst stamp after the lock [ms]", worst, _MAX_ERROR_MS),
        at_most("stamps that step backwards", backwards, 0),
        at_most("sweeps with wrong points", sum(one.wrong_sweeps for one in verdicts), 0),
        at_most("good packets lost, too late ones aside", lost, 0),
        at_most("good packets lost, real time", sum(one.missing for one in findings), 0),
        at_most("real-time cases not as they have to be", sum(not x.good for x in findings), 0),
    ]


if __name__ == "__main__":
    begin = time.monotonic()
    code = main()
    print(f"took {time.monotonic() - begin:.0f} s")
    sys.exit(code)
