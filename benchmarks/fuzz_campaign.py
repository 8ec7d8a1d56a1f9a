"""Feeds a target with random changes of good inputs and looks for errors, hangs and growth."""

from __future__ import annotations

import gc
import hashlib
import os
import time
import traceback
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from benchmarks.fuzz_mutator import mutations
from benchmarks.fuzz_targets import TARGETS
from tests.support.cpu import resident_mb

FINDINGS: Final = Path("out") / "fuzz" / "findings"
_CHUNK: Final = 64  # inputs between two looks at the clocks
_WARM_UP: Final = 0.1  # share of a campaign after which memory has to stay as it is


@dataclass(slots=True)
class Outcome:
    """What became of a campaign.

    Attributes
    ----------
    inputs : int
    octets : int
        Bytes in all inputs.
    seconds : float
    slowest_ms : float
        CPU time of the slowest 64 inputs in a row.
    growth_mb : float
        Memory gained after the first tenth.
    failures : dict
        How often something was raised that must not be, by where and what.
    """

    inputs: int = 0
    octets: int = 0
    seconds: float = 0.0
    slowest_ms: float = 0.0
    growth_mb: float = 0.0
    failures: dict[str, int] = field(default_factory=dict)


def campaign(name: str, inputs: int, seconds: float, seed: int) -> Outcome:
    """Run a target on so many inputs, or for so long if that is less.

    The first input of every kind of failure is kept in :data:`FINDINGS`.
    """
    target = TARGETS[name]
    warnings.simplefilter("error", RuntimeWarning)
    check, source = target.make(), mutations(target.seeds(), target.tokens, seed)
    outcome = Outcome()
    begin = time.monotonic()
    base_mb = 0.0
    while outcome.inputs < inputs:
        outcome.seconds = time.monotonic() - begin
        if outcome.seconds >= seconds:
            break
        is_warm = max(outcome.inputs / inputs, outcome.seconds / seconds) >= _WARM_UP
        if is_warm and not base_mb:
            gc.collect()
            base_mb = resident_mb(os.getpid())
        chunk = [next(source) for _ in range(min(_CHUNK, inputs - outcome.inputs))]
        started = time.thread_time_ns()
        for data in chunk:
            try:
                check(data)
            except Exception as error:  # whatever it is, it is a finding
                _note(outcome, name, data, error)
        spent_ms = (time.thread_time_ns() - started) / 1e6
        outcome.slowest_ms = max(outcome.slowest_ms, spent_ms)
        outcome.inputs += len(chunk)
        outcome.octets += sum(map(len, chunk))
    outcome.seconds = time.monotonic() - begin
    gc.collect()
    outcome.growth_mb = max(resident_mb(os.getpid()) - base_mb, 0.0) if base_mb else 0.0
    return outcome


def _note(outcome: Outcome, name: str, data: bytes, error: Exception) -> None:
    place = traceback.extract_tb(error.__traceback__)[-1]
    what = f"{type(error).__name__} at {Path(place.filename).name}:{place.lineno}"
    outcome.failures[what] = outcome.failures.get(what, 0) + 1
    if outcome.failures[what] == 1:
        FINDINGS.mkdir(parents=True, exist_ok=True)
        stem = FINDINGS / f"{name}-{hashlib.sha256(what.encode()).hexdigest()[:8]}"
        stem.with_suffix(".bin").write_bytes(data)
        stem.with_suffix(".txt").write_text("".join(traceback.format_exception(error)))
