"""Runs tests in a process in which one module is mutated; see :mod:`benchmarks.mutants`.

The processes are forked from one that has imported the libraries that tests need, which takes
longer than most tests, but nothing of this repository that could be mutated.
"""

from __future__ import annotations

import contextlib
import importlib.abc
import importlib.machinery
import math
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Final

import hypothesis.extra.numpy
import numpy
import pytest
import scipy.interpolate
import scipy.linalg
import scipy.optimize
import scipy.spatial

from benchmarks.mutants import FILES, FOLDERS, ROOT, Mutant, module_of, mutated
from benchmarks.results import KeptRows

PRELOADED: Final = (
    numpy, scipy.interpolate, scipy.linalg, scipy.optimize, scipy.spatial, hypothesis.extra.numpy,
)  # fmt: skip
_MAX_BYTES: Final = 6 << 30
_OPTIONS: Final = ("-q", "--no-header", "-p", "no:cacheprovider", "-m", "not ros")
_PASSED, _NONE_LEFT = 0, 5  # exit codes of pytest
_HANGING: Final = 5.0  # times longer than without a mutant, and
_HANGING_S: Final = 30.0  # longer [CPU s]
_WALL: Final = 20.0  # times that by the clock on the wall: other programs run as well


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


class _CallRecorder:
    """A plugin of pytest that notes which functions each test calls, and how long it takes.

    Tests that are noted already do not run again.
    """

    def __init__(self, kept: KeptRows) -> None:
        self._kept = kept
        self._known = {row["test"] for row in kept.read()}
        self._paths: dict[str, str | None] = {}

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Leave out what is known."""
        items[:] = [item for item in items if item.nodeid not in self._known]

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Watch one test with its fixtures."""
        called: set[tuple[str, int]] = set()

        def trace(frame: FrameType, event: str, argument: object) -> None:
            del event, argument
            path = self._path(frame.f_code.co_filename)
            if path is not None:
                called.add((path, frame.f_code.co_firstlineno))

        begun = time.process_time()
        sys.settrace(trace)
        try:
            return (yield)
        finally:
            sys.settrace(None)
            functions: dict[str, list[int]] = {}
            for path, line in sorted(called):
                functions.setdefault(path, []).append(line)
            seconds = time.process_time() - begun
            row = {"test": item.nodeid, "seconds": round(seconds, 3), "functions": functions}
            self._kept.append(row)

    def _path(self, name: str) -> str | None:
        """Return a file's path below the repository if it may be mutated."""
        if name not in self._paths:
            path = name.removeprefix(f"{ROOT}/")
            counts = path in FILES or path.rpartition("/")[0] in FOLDERS
            self._paths[name] = path if counts else None
        return self._paths[name]


def find_calls(tests: str, kept: KeptRows) -> None:
    """Run the tests of a folder or file once and keep which functions each calls.

    Raises
    ------
    RuntimeError
        If one fails.
    """

    def work() -> int:
        return int(pytest.main([*_OPTIONS, tests], plugins=[_CallRecorder(kept)]))

    if _forked(work, math.inf) not in (_PASSED, _NONE_LEFT):
        raise RuntimeError("tests fail without a mutant")


def is_killed(mutant: Mutant, tests: Sequence[str], expected_s: float) -> bool:
    """Return whether one of some tests fails, hangs or does not even start with a mutant.

    Parameters
    ----------
    mutant : Mutant
    tests : sequence of str
        As pytest names them.
    expected_s : float
        How long they take without a mutant [CPU s].
    """

    def work() -> int:
        # A mutant may ask for memory without end.
        resource.setrlimit(resource.RLIMIT_AS, (_MAX_BYTES, _MAX_BYTES))
        _check_is_fresh(mutant.module)
        sys.meta_path.insert(0, _Finder(_Loader(mutant)))
        return int(pytest.main(["-x", *_OPTIONS, *tests]))

    return _forked(work, _HANGING * expected_s + _HANGING_S) != _PASSED


def _check_is_fresh(module: str) -> None:
    if module in sys.modules:
        raise RuntimeError(f"{module} is imported already, so it cannot be mutated")


def _forked(work: Callable[[], int], cpu_s: float) -> int:
    """Return the exit code of something that runs in a process of its own, -1 if it was killed."""
    child = os.fork()
    if not child:
        code = 70
        with contextlib.suppress(BaseException):
            os.environ["CI"] = "1"  # hypothesis gives the same answer twice
            sink = os.open(os.devnull, os.O_WRONLY)
            os.dup2(sink, 1)
            if math.isfinite(cpu_s):
                os.dup2(sink, 2)
            if math.isfinite(cpu_s):
                signal.signal(signal.SIGXCPU, signal.SIG_DFL)
                resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(cpu_s), math.ceil(cpu_s) + 1))
            code = work()
        os._exit(code)
    deadline = time.monotonic() + _WALL * cpu_s
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return -1
        time.sleep(0.05)


assert not any(module_of(Path(name)) in sys.modules for name in FILES)
