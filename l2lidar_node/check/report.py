"""Words the result of a check for people and for programs."""

from __future__ import annotations

from typing import Any

from l2lidar_node.check.findings import Finding, Level, worst
from l2lidar_node.check.requirements import Consumer
from l2lidar_node.check.topics import Topics


def verdict(findings: list[Finding], consumer: Consumer) -> str:
    """Return the last line: whether the consumer can work with the topics."""
    errors = sum(item.level is Level.ERROR for item in findings)
    warnings = sum(item.level is Level.WARN for item in findings)
    skipped = sum(item.text.startswith("not judged") for item in findings)
    counts = f"{_number(errors, 'error')}, {_number(warnings, 'warning')}, {len(findings)} checks"
    if skipped:
        counts += f", {skipped} of them not judged"
    state = {
        Level.OK: "ready for",
        Level.WARN: "ready, with warnings, for",
        Level.ERROR: "not ready for",
    }[worst(findings)]
    return f"{state} {consumer.title}: {counts}"


def as_data(
    findings: list[Finding], consumer: Consumer, source: str, topics: Topics
) -> dict[str, Any]:
    """Return the result as values for JSON."""
    return {
        "consumer": consumer.name,
        "source": source,
        "topics": topics._asdict(),
        "level": worst(findings).name,
        "verdict": verdict(findings, consumer),
        "findings": [{**item._asdict(), "level": item.level.name} for item in findings],
    }


def _number(count: int, noun: str) -> str:
    return f"{count or 'no'} {noun}{'' if count == 1 else 's'}"
