"""Feeds everything that reads input from outside with hostile input, and counts it.

``make fuzz`` prints the table and writes ``out/bench/fuzz.json``. First random changes of good
inputs, fast and many; then, where atheris can be installed, inputs guided by coverage.
"""

from __future__ import annotations

import argparse
import importlib.util
import multiprocessing
import re
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, Final

from benchmarks.fuzz_campaign import Outcome, campaign
from benchmarks.fuzz_targets import TARGETS
from benchmarks.results import Target, at_least, at_most, publish

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


def guided(name: str, seconds: float) -> tuple[int, int, list[str]]:
    """Return inputs, branches reached and failures of a run under atheris."""
    corpus = _CORPUS / name
    corpus.mkdir(parents=True, exist_ok=True)
    for number, data in enumerate(TARGETS[name].seeds()):
        (corpus / f"seed_{number}").write_bytes(data)
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.fuzz_guided", name, f"-max_total_time={seconds:.0f}",
         "-max_len=8192", "-timeout=10", "-rss_limit_mb=4096", "-verbosity=1",
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
