"""The common form of what the measuring commands find: a table to read and a file to compare.

The speed of a machine swings from day to day, and with what else runs on it, by half. A figure in
units of a fixed load (:func:`relative`), both measured in alternation, hardly does.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import sys
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from l2lidar_node.protocol import wire

FOLDER = Path("out") / "bench"


@dataclass(frozen=True, slots=True)
class Target:
    """A figure with a bound.

    Attributes
    ----------
    name : str
    value : float
    bound : float
    met : bool
    """

    name: str
    value: float
    bound: float
    met: bool


def at_least(name: str, value: float, bound: float) -> Target:
    """Return a target that is met from ``bound`` upwards."""
    return Target(name, value, bound, value >= bound)


def at_most(name: str, value: float, bound: float) -> Target:
    """Return a target that is met up to ``bound``."""
    return Target(name, value, bound, value <= bound)


def replaced(text: str, name: str, content: str) -> str:
    """Return a page with the generated block of a name replaced.

    Raises
    ------
    ValueError
        If the page has no such block.
    """
    begin, end = f"<!-- {name}: generated -->\n", f"<!-- /{name} -->"
    before, found, rest = text.partition(begin)
    _, closed, after = rest.partition(end)
    if not (found and closed):
        raise ValueError(f"the marks of block '{name}' are missing")
    return f"{before}{begin}{content}\n{end}{after}"


@dataclass(frozen=True, slots=True)
class KeptRows:
    """The rows found so far, one a line of a file; several processes may append.

    Attributes
    ----------
    path : Path
    key : tuple of str
        What tells one run from another.
    """

    path: Path
    key: tuple[str, ...]

    def clear(self) -> None:
        """Forget all rows."""
        self.path.unlink(missing_ok=True)

    def append(self, row: dict[str, Any]) -> None:
        """Keep a row, and print it on standard error."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a", encoding="utf-8") as file:
            # the line before may have been cut off
            file.write("\n" + json.dumps(row, default=float) + "\n")
        print(self.describe(row), file=sys.stderr, flush=True)

    def describe(self, row: dict[str, Any]) -> str:
        """Return what is printed of a row."""
        return ", ".join(f"{name} {_text(value)}" for name, value in row.items())

    def read(self) -> list[dict[str, Any]]:
        """Return the rows, the last of each run; a line that was cut off does not count."""
        return list({self.key_of(row): row for row in self._rows()}.values())

    def key_of(self, row: Mapping[str, Any]) -> tuple[Any, ...]:
        """Return what tells a row from those of other runs."""
        return tuple(row[name] for name in self.key)

    def _rows(self) -> Iterator[dict[str, Any]]:
        if not self.path.exists():
            return
        for line in self.path.read_text(encoding="utf-8").splitlines():
            try:
                yield json.loads(line)
            except ValueError:
                continue


def markdown(rows: list[dict[str, Any]]) -> str:
    """Return rows with the same keys, at least one, as a table in Markdown."""
    return table(rows[0], (row.values() for row in rows))


def table(heading: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a table in Markdown; in the text of cells a bar is escaped."""
    heads = list(heading)
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(
        "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"
        for cells in lines
    )


def verdicts(targets: Iterable[Target]) -> str:
    """Return a table in Markdown with one row for each target."""
    return markdown(
        [
            {
                "Target": target.name,
                "measured": f"{target.value:.4g}",
                "bound": f"{target.bound:.4g}",
                "": "met" if target.met else "**not met**",
            }
            for target in targets
        ]
    )


def measured_on() -> str:
    """Return a sentence about this machine, for the end of a page."""
    facts = machine()
    return f"Measured on {facts['processor']}, {facts['cores']} cores, Python {facts['python']}."


def show(title: str, rows: list[dict[str, Any]]) -> None:
    """Print rows with the same keys as a table; nothing where there are none."""
    if not rows:
        return
    shown = Table(*rows[0], title=title)
    for row in rows:
        shown.add_row(*(_text(value) for value in row.values()))
    # A file has no width: rich would squeeze every column into 80 letters.
    Console(width=None if sys.stdout.isatty() else 200).print(shown)


def publish(name: str, title: str, rows: list[dict[str, Any]], targets: Iterable[Target]) -> Path:
    """Print rows and targets and write ``out/bench/NAME.json``; return its path.

    Parameters
    ----------
    name : str
        Of the measurement.
    title : str
        One line above the table.
    rows : list of dict
        All with the same keys.
    targets : iterable of Target
    """
    targets = list(targets)
    console = Console()
    show(title, rows)
    for target in targets:
        mark = "[green]met" if target.met else "[red]not met"
        console.print(
            f"{mark}[/] {target.name}: {_text(target.value)} (bound {_text(target.bound)})"
        )
    path = keep(name, rows, targets)
    console.print(f"written to {path}")
    return path


def keep(name: str, rows: list[dict[str, Any]], targets: Iterable[Target]) -> Path:
    """Write ``out/bench/NAME.json`` alone; return its path."""
    path = FOLDER / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"machine": machine(), "rows": rows, "targets": [asdict(item) for item in targets]}
    part = path.with_suffix(".part")
    part.write_text(json.dumps(content, indent=1, default=float) + "\n")
    part.replace(path)
    return path


def machine() -> Mapping[str, object]:
    """Return what kind of machine this is."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}",
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


_PACKET: Final = (bytes(range(256)) * 5)[: wire.FRAME_SIZES[wire.PacketType.POINTS_3D]]
_LAYOUT: Final = np.dtype(np.uint8)
_ROUND: Final = 20_000


class Relative(NamedTuple):
    """A rate of packets, and the reference load's beside it.

    Attributes
    ----------
    rate : float
        Median [packets per CPU s].
    ratio : float
        Median of the ratios to the reference load's rate that was measured next to each.
    low, high : float
        The smallest and the largest of these.
    """

    rate: float
    ratio: float
    low: float
    high: float


def packets_per_cpu_s(packets: int = _ROUND) -> float:
    """Return how many packets per CPU second this load takes: their CRC-32 and a view."""
    begin = time.process_time()
    for _ in range(packets):
        zlib.crc32(_PACKET)
        np.frombuffer(_PACKET, _LAYOUT)
    return packets / (time.process_time() - begin)


def checksums_per_cpu_s(packets: int = 5 * _ROUND) -> float:
    """Return how many CRC-32 of a packet of points zlib makes in a CPU second."""
    begin = time.process_time()
    for _ in range(packets):
        zlib.crc32(_PACKET)
    return packets / (time.process_time() - begin)


def relative(
    measure: Callable[[], float],
    rounds: int,
    reference: Callable[[], float] = packets_per_cpu_s,
) -> Relative:
    """Measure a rate [packets per CPU s] some times, the reference load before and after each."""
    rates, ratios = [], []
    before = reference()
    for _ in range(rounds):
        rate = measure()
        after = reference()
        rates.append(rate)
        ratios.append(2.0 * rate / (before + after))
        before = after
    return Relative(statistics.median(rates), statistics.median(ratios), min(ratios), max(ratios))
