"""Writes what follows from the settings: config/l2lidar_node.yaml and the README's tables.

Run ``python -m tools.make_reference`` after a setting changed; ``--check`` tells if it is due.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from l2lidar_node.config import DriverConfig
from l2lidar_node.settings import Setting, markdown_table, settings_of

ROOT = Path(__file__).resolve().parents[1]
YAML = ROOT / "config" / "l2lidar_node.yaml"
README = ROOT / "README.md"

SHIPPED = {"enable_IMU_publishing": True}
"""Where the shipped file differs from the defaults: a newcomer wants to see the IMU."""

HEAD = """\
# Every parameter of the driver with its default, unless a comment says otherwise.
# This file is written by tools/make_reference.py; copy it and give yours as params_file.
/**:
  ros__parameters:
"""


def parameter_file() -> str:
    """Return the text of the driver's parameter file."""
    lines = [HEAD]
    for item in settings_of(DriverConfig):
        lines.append(f"    # {_meaning(item)}\n")
        value = SHIPPED.get(item.name, item.default)
        if item.name in SHIPPED:
            lines.append(f"    # (the default is {_scalar(item.default)})\n")
        lines.append(f"    {item.name}: {_scalar(value)}\n")
    return "".join(lines)


def _meaning(item: Setting) -> str:
    facts = [item.range_text or (item.unit and f"in {item.unit}"), "live" if item.live else ""]
    extra = "; ".join(fact for fact in facts if fact)
    return item.doc[0].upper() + item.doc[1:] + (f" ({extra})" if extra else "")


def _scalar(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)


def readme(text: str, tables: dict[str, type]) -> str:
    """Return the README with the tables between their markers made anew.

    Raises
    ------
    ValueError
        If a marker is missing.
    """
    for name, group in tables.items():
        begin, end = f"<!-- table: {name} -->\n", f"<!-- end: {name} -->"
        before, found, rest = text.partition(begin)
        _, closed, after = rest.partition(end)
        if not found or not closed:
            raise ValueError(f"README.md: the markers of table '{name}' are missing")
        text = before + begin + markdown_table(group) + "\n" + end + after
    return text


def outputs() -> dict[Path, str]:
    """Return the text of every file that follows from the settings."""
    return {
        YAML: parameter_file(),
        README: readme(README.read_text(), {"driver": DriverConfig}),
    }


def main() -> int:
    """Write the files, or with ``--check`` say which are out of date and return 1."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    check = parser.parse_args().check
    due = {path: text for path, text in outputs().items() if _read(path) != text}
    for path, text in due.items():
        print(f"{path.relative_to(ROOT)} {'is out of date' if check else 'written'}")
        if not check:
            path.write_text(text)
    return 1 if check and due else 0


def _read(path: Path) -> str:
    return path.read_text() if path.exists() else ""


if __name__ == "__main__":
    sys.exit(main())
