"""Runs tests in a process in which one module is mutated; see :mod:`benchmarks.mutants`."""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import resource
import sys
from collections.abc import Sequence
from pathlib import Path
from types import CodeType, ModuleType
from typing import Final

import pytest

from benchmarks.mutants import ROOT, mutated

_MAX_BYTES: Final = 6 << 30
_OPTIONS: Final = ("-q", "-x", "--no-header", "-p", "no:cacheprovider", "-m", "not ros")


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads one module from its mutated syntax tree."""

    def __init__(self, module: str, path: Path, number: int) -> None:
        super().__init__(module, str(ROOT / path))
        self._mutant = path, number

    def get_code(self, fullname: str) -> CodeType:
        """Return the mutant's code; nothing is read from or written to a cache."""
        del fullname
        return compile(mutated(*self._mutant), str(self.path), "exec")


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


def main() -> int:
    """Run pytest with the mutant that the command line names; ``-`` for none."""
    module, path, number, *tests = sys.argv[1:]
    # A mutant may ask for memory without end.
    resource.setrlimit(resource.RLIMIT_AS, (_MAX_BYTES, _MAX_BYTES))
    if module != "-":
        if module in sys.modules:
            raise RuntimeError(f"{module} is imported already, so it cannot be mutated")
        sys.meta_path.insert(0, _Finder(_Loader(module, Path(path), int(number))))
    return int(pytest.main([*_OPTIONS, *tests]))


if __name__ == "__main__":
    sys.exit(main())
