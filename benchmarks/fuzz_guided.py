"""Runs one target under atheris, which is guided by the branches that inputs reach.

``python -m benchmarks.fuzz_guided TARGET [libFuzzer options] [corpus]``; a process of its own,
since the fuzzer ends it.
"""

from __future__ import annotations

import importlib
import sys
from typing import Any


def main() -> None:
    """Fuzz until the fuzzer's options say that it is enough."""
    atheris: Any = importlib.import_module("atheris")  # not there unless asked for
    packages = ["l2lidar_node", "l2lidar_proc"]
    with atheris.instrument_imports(include=packages, enable_loader_override=False):
        from benchmarks.fuzz_targets import TARGETS

        check: Any = TARGETS[sys.argv[1]].make()  # it may import what it checks
    atheris.Setup([sys.argv[0], *sys.argv[2:]], check)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
