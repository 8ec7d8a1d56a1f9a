"""Feeds everything that reads input from outside with hostile input, and counts it.

``make fuzz`` prints the table and writes ``out/bench/fuzz.json``. First random changes of good
inputs, fast and many; then, where atheris can be installed, inputs guided by coverage.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import importlib.util
import multiprocessing
import os
import re
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from benchmarks.fuzz_inputs import mutations
from benchmarks.fuzz_targets import TARGETS
from benchmarks.results import Target, at_least, at_most, publish
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


_CORPUS: Final = Path("out") / "fuzz" / "corpus"
_INPUTS: Final = 10_000_000  # that many are promised; a fast machine takes two minutes
_MAX_GROWTH_MB: Final = 10.0
_MAX_CHUNK_MS: Final = 1_000.0  # 64 inputs; a hang is longer by far


def in_own_process(name: str, inputs: int, seconds: float, seed: int) -> Outcome:
    """Run a campaign where a crash of the interpreter is a finding as well."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=1, mp_context=context) as pool:
        try:
            return pool.submit(campaign, name, inputs, seconds, seed).result()
        except BrokenProcessPool:
            return Outcome(failures={"the process died": 1})


_HANG_S: Final = 300  # by the clock on the wall: a busy machine may not run it for a minute


def guided(name: str, seconds: float) -> tuple[int, int, list[str]]:
    """Return inputs, branches reached and failures of a run under atheris."""
    corpus = _CORPUS / name
    corpus.mkdir(parents=True, exist_ok=True)
    for number, data in enumerate(TARGETS[name].seeds()):
        (corpus / f"seed_{number}").write_bytes(data)
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.fuzz_guided", name, f"-max_total_time={seconds:.0f}",
         "-max_len=8192", f"-timeout={_HANG_S}", "-rss_limit_mb=4096", "-verbosity=1",
         "-print_final_stats=1", f"-artifact_prefix={_CORPUS.parent}/{name}-", str(corpus)],
        capture_output=True, text=True, errors="replace", check=False,
    )  # fmt: skip
    said = done.stdout + done.stderr
    inputs = re.findall(r"number_of_executed_units:\s*(\d+)", said)
    reached = re.findall(r"cov: (\d+)", said)
    failures = [] if done.returncode == 0 else [_last_word(said)]
    return int(inputs[-1]) if inputs else 0, int(reached[-1]) if reached else 0, failures


def _last_word(said: str) -> str:
    marked = [line.strip() for line in said.splitlines() if "Error" in line or "ERROR" in line]
    return marked[0][:120] if marked else said[-200:]


def has_atheris() -> bool:
    """Tell whether atheris can be used, after trying to install it."""
    if importlib.util.find_spec("atheris") is None:
        subprocess.run(
            [sys.executable, "-m", "pip", "install", "--quiet", "atheris"],
            capture_output=True, check=False,
        )  # fmt: skip
        importlib.invalidate_caches()
    return importlib.util.find_spec("atheris") is not None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the campaigns; return 1 if there was any finding."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=_INPUTS, help="for the wire parser")
    parser.add_argument("--seconds", type=float, default=3600.0, help="at most, per target")
    parser.add_argument("--guided-seconds", type=float, default=20.0, help="per target; 0: none")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--targets", nargs="+", choices=TARGETS, default=list(TARGETS))
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    targets: list[Target] = []
    # The promise is a number, so a slow machine takes longer: the time is no more than a stop.
    for name in options.targets:
        wanted = max(options.inputs * TARGETS[name].per_million // 1_000_000, 50)
        found = in_own_process(name, wanted, options.seconds, options.seed)
        rows.append(_row(name, "random", found, str(found.octets // 1_000_000) + " MB"))
        targets += _targets(name, found)
        if name == "wire":
            targets.append(at_least("wire: inputs", found.inputs, _INPUTS))
    if options.guided_seconds > 0 and not has_atheris():
        print("atheris cannot be installed for this Python: no coverage-guided run")
        options.guided_seconds = 0
    for name in options.targets if options.guided_seconds > 0 else ():
        inputs, reached, failures = guided(name, options.guided_seconds)
        outcome = Outcome(inputs, 0, options.guided_seconds, failures=dict.fromkeys(failures, 1))
        rows.append(_row(name, "guided", outcome, f"{reached} branches"))
        targets.append(at_most(f"{name}, guided: findings", len(failures), 0))
    publish("fuzz", "Hostile input", rows, targets)
    return int(any(row["findings"] for row in rows))


def _row(name: str, kind: str, outcome: Outcome, remark: str) -> dict[str, Any]:
    return {
        "target": name,
        "kind": kind,
        "inputs": outcome.inputs,
        "seconds": round(outcome.seconds, 1),
        "slowest 64 [ms CPU]": round(outcome.slowest_ms, 1),
        "growth [MB]": round(outcome.growth_mb, 1),
        "findings": "; ".join(f"{count} x {what}" for what, count in outcome.failures.items()),
        "remark": remark,
    }


def _targets(name: str, outcome: Outcome) -> list[Target]:
    return [
        at_most(f"{name}: findings", len(outcome.failures), 0),
        at_most(f"{name}: slowest 64 inputs [ms CPU]", outcome.slowest_ms, _MAX_CHUNK_MS),
        at_most(f"{name}: growth [MB]", outcome.growth_mb, _MAX_GROWTH_MB),
    ]


if __name__ == "__main__":
    sys.exit(main())
