"""Unitree's own client as a referee: packets of points per CPU second from a socket to clouds.

Its library is closed and not part of this project. ``make bench-load BENCH_ARGS="--vendor-sdk
DIR"`` uses a checkout of https://github.com/unitreerobotics/unilidar_sdk2, and needs ``g++``.
"""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from benchmarks.results import FOLDER

_SOURCE: Final = Path(__file__).with_suffix(".cpp")
_SDK: Final = "unitree_lidar_sdk"


def build(checkout: Path) -> Path:
    """Build the client; return its path.

    Parameters
    ----------
    checkout : Path
        Checkout of ``unilidar_sdk2``.

    Raises
    ------
    FileNotFoundError
        If there is no library for this processor.
    subprocess.CalledProcessError
        If it cannot be built.
    """
    sdk = checkout / _SDK
    library = sdk / "lib" / platform.machine() / "libunilidar_sdk2.a"
    if not library.is_file():
        raise FileNotFoundError(f"--vendor-sdk {checkout}: {library} is missing")
    FOLDER.mkdir(parents=True, exist_ok=True)
    program = (FOLDER / "vendor_client").absolute()
    options = ["-O3", "-std=c++17", "-I", str(sdk / "include")]
    sources = [str(_SOURCE), str(library), "-lpthread"]
    subprocess.run(["g++", *options, *sources, "-o", str(program)], check=True)
    return program


class VendorClient:
    """Runs the client on loopback.

    Parameters
    ----------
    program : Path
        See :func:`build`.
    host_port, lidar_port : int
        Where it listens, and the port from which the packets have to come.
    packets : int
        Packets of a cloud.

    Raises
    ------
    RuntimeError
        If it does not start.
    """

    def __init__(self, program: Path, host_port: int, lidar_port: int, packets: int) -> None:
        self.points = 0
        self._process = subprocess.Popen(
            [program, str(host_port), str(lidar_port), str(packets)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        while self._line() != "ready":
            pass  # the library writes lines of its own

    def take(self, datagrams: Sequence[bytes]) -> float:
        """Have it take the packets that have been sent to it; return its CPU time [s]."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{len(datagrams)}\n")
        self._process.stdin.flush()
        while not (line := self._line())[:1].isdecimal():
            pass
        seconds, points = line.split()
        self.points = int(points)
        return float(seconds)

    def _line(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the vendor's client ended with {self._process.wait()}")
        return line.strip()

    def close(self) -> None:
        """End it."""
        self._process.terminate()
        self._process.wait()
