"""Prints to people and to programs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any, Final

import typer
from rich.console import Console
from rich.table import Table

from l2lidar_node.driver.health import Check, Level

out: Final = Console(highlight=False)
_COLOURS: Final = {Level.OK: "green", Level.WARN: "yellow", Level.ERROR: "red", Level.STALE: "dim"}


def say(text: str) -> None:
    """Print a sentence, not cut into lines: names of files in it can be copied."""
    out.print(text, soft_wrap=True)


def print_json(value: object) -> None:
    """Print a value as indented JSON."""
    typer.echo(json.dumps(value, indent=2))


def facts(title: str, values: Mapping[str, object]) -> Table:
    """Return a table of names and values under a title."""
    table = Table(box=None, pad_edge=False)
    table.add_column(title, style="cyan", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in values.items():
        table.add_row(name, str(value))
    return table


def judgement(checks: Iterable[Check]) -> Table:
    """Return a table of checks: one row each, its figures below its sentence."""
    table = Table(box=None, pad_edge=False)
    for heading in ("", "level", "message", "figures"):
        table.add_column(heading, overflow="fold")
    for check in checks:
        colour = _COLOURS[check.level]
        figures = "  ".join(f"{name} [bold]{value}[/]" for name, value in _plain(check.values))
        table.add_row(check.name, f"[{colour}]{check.level.name}[/]", check.message, figures)
    return table


def as_data(checks: Iterable[Check]) -> dict[str, Any]:
    """Return checks as values for JSON."""
    return {
        check.name: {"level": check.level.name, "message": check.message, **check.values}
        for check in checks
    }


def change(before: Mapping[str, object], after: Mapping[str, object]) -> Table:
    """Return a table of what was and what will be, the differences marked."""
    table = Table(box=None, pad_edge=False)
    for heading in ("", "before", "after"):
        table.add_column(heading)
    for name, value in after.items():
        old = before.get(name, "not known")
        text = str(value)
        table.add_row(name, str(old), text if text == str(old) else f"[bold yellow]{text}[/]")
    return table


def _plain(values: Mapping[str, str]) -> Iterable[tuple[str, str]]:
    return ((name.replace("[", "\\["), value) for name, value in values.items())
