"""Runs tests in processes in which one module is mutated; see :mod:`benchmarks.mutants`.

Starting pytest and importing what the tests import takes longer than most tests. So one process
collects all tests once and is forked for every mutant, which replaces the code of one function in
place. What is outside of functions (constants, default values) has effects while it is imported:
these mutants, and the known faults, are tried in processes that import everything anew. They are
forked from one that has imported the libraries, but nothing of this repository that could be
mutated.
"""

from __future__ import annotations

import contextlib
import gc
import importlib.abc
import importlib.machinery
import math
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby, pairwise
from pathlib import Path
from types import CodeType, FrameType, FunctionType, ModuleType
from typing import Any, Final

import hypothesis.extra.numpy
import numpy
import pytest
import scipy.interpolate
import scipy.linalg
import scipy.optimize
import scipy.spatial

from benchmarks.mutants import FILES, FOLDERS, ROOT, SLOWEST_S, Mutant, mutated
from benchmarks.results import KeptRows

PRELOADED: Final = (
    numpy, scipy.interpolate, scipy.linalg, scipy.optimize, scipy.spatial, hypothesis.extra.numpy,
)  # fmt: skip
Todo = tuple[dict[str, Any], Mutant, list[str], float]
"""A row to complete, the mutant, its tests, and how long they take without it [CPU s]."""

_MAX_BYTES: Final = 6 << 30
_OPTIONS: Final = ("-q", "--no-header", "-s", "-p", "no:cacheprovider")
_PURE: Final = ("-m", "not ros")
_PASSED, _FAILED, _NONE_LEFT, _ERROR = 0, 1, 5, 70  # exit codes, the last one not of pytest
_HANGING: Final = 5.0  # times longer than without a mutant, and
_HANGING_S: Final = 20.0  # longer [CPU s]
_WALL: Final = 20.0  # times that by the clock on the wall: other programs run as well
_LOOK_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class Work:
    """Something that runs in a process of its own.

    Attributes
    ----------
    run : callable
        Returns the exit code.
    ended : callable
        Is told the exit code, below 0 if a signal ended it.
    cpu_s : float
        After which it is ended.
    """

    run: Callable[[], int]
    ended: Callable[[int], None]
    cpu_s: float = math.inf


def carry_out(works: Iterable[Work], jobs: int) -> None:
    """Run works in processes forked from this one, ``jobs`` at a time."""
    waiting = iter(works)
    running: dict[int, tuple[Work, float]] = {}
    while True:
        while len(running) < jobs and (work := next(waiting, None)) is not None:
            running[_forked(work)] = work, time.monotonic() + _WALL * work.cpu_s
        if not running:
            return
        for pid, (work, deadline) in list(running.items()):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if not ended and time.monotonic() > deadline:
                os.kill(pid, signal.SIGKILL)
                ended, status = os.waitpid(pid, 0)
            if ended:
                del running[pid]
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(pid, signal.SIGKILL)  # what its tests have started
                work.ended(os.waitstatus_to_exitcode(status))
        time.sleep(_LOOK_S)


def _forked(work: Work) -> int:
    """Start a process; return its number."""
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child:
        with contextlib.suppress(OSError):
            os.setpgid(child, child)
        return child
    code = _ERROR
    try:
        os.setpgid(0, 0)
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, 1)
        if math.isfinite(work.cpu_s):  # else its errors are of interest
            os.dup2(sink, 2)
            signal.signal(signal.SIGXCPU, signal.SIG_DFL)
            limit = math.ceil(work.cpu_s)
            resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 1))
        code = work.run()
    finally:
        os._exit(code)


class _Plan:
    """A plugin of pytest that collects the tests and does something else than to run them all.

    Parameters
    ----------
    work : callable
        Given the tests by their names.
    """

    def __init__(self, work: Callable[[dict[str, pytest.Item]], None]) -> None:
        self._work = work

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection(self) -> None:
        """Have hypothesis give the same answer twice, and not look for a simpler example."""
        hypothesis.settings.register_profile(
            "mutants", parent=hypothesis.settings.get_profile("gate"), derandomize=True,
            database=None, phases=(hypothesis.Phase.explicit, hypothesis.Phase.generate),
        )  # fmt: skip
        hypothesis.settings.load_profile("mutants")

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Do the work in place of running the tests."""
        if session.testsfailed:
            raise session.Interrupted("some tests cannot be imported")
        self._work({item.nodeid: item for item in session.items})
        return True


class _FirstFailure:
    """A plugin that ends the process at the first test that fails."""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """End at a failure."""
        if report.failed:
            os._exit(_FAILED)


def _collected(tests: Sequence[str], work: Callable[[dict[str, pytest.Item]], None]) -> None:
    """Collect tests in a process of its own and do something with them there.

    Raises
    ------
    RuntimeError
        If some cannot be collected or the work did not end well.
    """
    codes: list[int] = []

    def run() -> int:
        return int(pytest.main([*_OPTIONS, *_PURE, *tests], plugins=[_Plan(work)]))

    carry_out([Work(run, codes.append)], 1)
    if codes != [_PASSED]:
        raise RuntimeError(f"collecting the tests ended with {codes[0]}")


def _run(items: Sequence[pytest.Item]) -> None:
    """Run tests as pytest does, those of a file with its fixtures."""
    for item, following in pairwise([*items, None]):
        if item is not None:
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)


# ---- which test calls what


class _Slow(BaseException):
    """A test takes so long that it is left to the gate."""


class _CallRecorder:
    """A plugin that notes which functions each test calls, and how long it takes."""

    def __init__(self, kept: KeptRows) -> None:
        self._kept = kept
        self._paths: dict[str, str | None] = {}
        self.failed: list[str] = []
        self._is_slow = False

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Watch one test with its fixtures."""
        called: set[tuple[str, str]] = set()

        def trace(frame: FrameType, event: str, argument: object) -> None:
            del event, argument
            path = self._path(frame.f_code.co_filename)
            if path is not None:
                called.add((path, frame.f_code.co_qualname.partition(".<locals>")[0]))

        begun = time.process_time()
        sys.settrace(trace)
        try:
            return (yield)
        finally:
            sys.settrace(None)
            functions: dict[str, list[str]] = {}
            for path, name in sorted(called):
                functions.setdefault(path, []).append(name)
            seconds = SLOWEST_S if self._is_slow else time.process_time() - begun
            row = {"test": item.nodeid, "seconds": round(seconds, 3), "functions": functions}
            self._kept.append(row)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self) -> Iterator[None]:
        """Cut a test off that takes long."""
        self._is_slow = False
        signal.signal(signal.SIGVTALRM, self._cut_off)
        signal.setitimer(signal.ITIMER_VIRTUAL, SLOWEST_S)
        try:
            return (yield)
        except _Slow:
            pytest.skip("takes long")
        finally:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)

    def _cut_off(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self._is_slow = True
        raise _Slow

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note what fails."""
        if report.failed and not self._is_slow:
            self.failed.append(report.nodeid)

    def _path(self, name: str) -> str | None:
        """Return a file's path below the repository if it may be mutated."""
        if name not in self._paths:
            path = name.removeprefix(f"{ROOT}/")
            counts = path in FILES or path.rpartition("/")[0] in FOLDERS
            self._paths[name] = path if counts else None
        return self._paths[name]


def find_calls(tests: Sequence[str], kept: KeptRows, jobs: int) -> set[str]:
    """Run every test once and keep which functions each calls; those that are kept do not run.

    Returns
    -------
    set of str
        Names of all tests that there are.

    Raises
    ------
    RuntimeError
        If one fails.
    """
    known = {row["test"] for row in kept.read()}
    names = kept.path.with_suffix(".names")
    names.parent.mkdir(parents=True, exist_ok=True)

    def work(found: dict[str, pytest.Item]) -> None:
        names.write_text("\n".join(found))
        items = [item for name, item in found.items() if name not in known]
        codes: list[int] = []
        files = [list(group) for _, group in groupby(items, key=lambda item: item.path)]
        works = (Work(partial(_recorded, some, kept), codes.append) for some in files)
        carry_out(works, jobs)
        if any(codes):
            raise RuntimeError("tests fail without a mutant")

    _collected(tests, work)
    return set(names.read_text().splitlines())


def _recorded(items: Sequence[pytest.Item], kept: KeptRows) -> int:
    recorder = _CallRecorder(kept)
    items[0].config.pluginmanager.register(recorder)
    _run(items)
    for name in recorder.failed:
        print(f"fails without a mutant: {name}", file=sys.stderr)
    return _FAILED if recorder.failed else _PASSED


# ---- mutants


def judge(todo: Sequence[Todo], kept: KeptRows, jobs: int, until: float) -> None:
    """Try mutants and keep what was found; begin none after ``until`` of the monotonic clock."""

    def ended(row: dict[str, Any], code: int) -> None:
        if code in (_ERROR, _NONE_LEFT):
            raise RuntimeError(f"a trial went wrong: {row}")
        kept.append({**row, "killed": code != _PASSED})

    def works(some: Iterable[Todo], trial: Callable[[Mutant, list[str]], int]) -> Iterator[Work]:
        for row, mutant, tests, expected in some:
            if time.monotonic() > until:
                return
            limit = _HANGING * expected + _HANGING_S
            yield Work(partial(trial, mutant, tests), partial(ended, row), limit)

    for row, _, tests, _ in todo:
        if not tests:
            ended(row, _PASSED)
    tested = [item for item in todo if item[2]]
    inside = [item for item in tested if item[1].function]
    carry_out(works([item for item in tested if not item[1].function], _imported), jobs)
    if not inside:
        return

    def work(found: dict[str, pytest.Item]) -> None:
        def replaced(mutant: Mutant, tests: list[str]) -> int:
            return _replaced(mutant, [found[name] for name in tests])

        carry_out(works(inside, replaced), jobs)

    _collected(sorted({name.partition("::")[0] for item in inside for name in item[2]}), work)


def _replaced(mutant: Mutant, items: Sequence[pytest.Item]) -> int:
    """Run tests with a mutant in place of the function that has been imported."""
    _bound_memory()
    path = str(ROOT / mutant.path)
    function = mutant.function
    changed = {
        code.co_firstlineno: code
        for code in _functions(compile(mutated(mutant.path, mutant.number), path, "exec"))
        if code.co_qualname == function
    }
    found = [
        item
        for item in gc.get_objects()
        if isinstance(item, FunctionType)
        and item.__code__.co_filename == path
        and item.__code__.co_qualname == function
    ]
    if not found:
        raise RuntimeError(f"{mutant.path} has no {function}")
    for item in found:
        item.__code__ = changed[item.__code__.co_firstlineno]
    items[0].config.pluginmanager.register(_FirstFailure())
    _run(items)
    return _PASSED


def _functions(code: CodeType) -> Iterator[CodeType]:
    """Yield the code of all functions in some code."""
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant
            yield from _functions(constant)


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads one module from its mutated syntax tree."""

    def __init__(self, mutant: Mutant) -> None:
        super().__init__(mutant.module, str(ROOT / mutant.path))
        self._mutant = mutant

    def get_code(self, fullname: str) -> CodeType:
        """Return the mutant's code; nothing is read from or written to a cache."""
        del fullname
        return compile(mutated(self._mutant.path, self._mutant.number), str(self.path), "exec")


class _Finder(importlib.abc.MetaPathFinder):
    """Finds the mutant before the module itself is found."""

    def __init__(self, loader: _Loader) -> None:
        self._loader = loader

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return where the mutant comes from; None for every other module."""
        del path, target
        if fullname != self._loader.name:
            return None
        return importlib.machinery.ModuleSpec(fullname, self._loader, origin=self._loader.path)


def _imported(mutant: Mutant, tests: Sequence[str]) -> int:
    """Import a mutant and run tests."""
    _bound_memory()
    if mutant.module in sys.modules:
        raise RuntimeError(f"{mutant.module} is imported already, so it cannot be mutated")
    sys.meta_path.insert(0, _Finder(_Loader(mutant)))
    options = _OPTIONS if mutant.number < 0 else (*_OPTIONS, *_PURE)
    return int(pytest.main(["-x", *options, *tests]))


def _bound_memory() -> None:
    """End the process when a mutant asks for memory without end."""
    resource.setrlimit(resource.RLIMIT_AS, (_MAX_BYTES, _MAX_BYTES))


assert not any(Mutant(Path(name), 0, "", "").module in sys.modules for name in FILES)
