"""Output for people and programs, and options that several verbs share."""

from __future__ import annotations

import functools
import inspect
import json
import math
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from rich.console import Console
from rich.table import Table

from l2lidar_node.config import NetworkConfig
from l2lidar_node.settings import Setting, build, settings_of

if TYPE_CHECKING:
    from l2lidar_node.types import Check

out: Final = Console(highlight=False)
_COLORS: Final = {"OK": "green", "WARN": "yellow", "ERROR": "red", "STALE": "dim"}


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
        color = _COLORS[check.level.name]
        figures = "  ".join(f"{name} [bold]{value}[/]" for name, value in _plain(check.values))
        table.add_row(check.name, f"[{color}]{check.level.name}[/]", check.message, figures)
    return table


def as_data(checks: Iterable[Check]) -> dict[str, Any]:
    """Return checks as values for JSON: figures that are numbers are numbers in it."""
    return {
        check.name: {
            "level": check.level.name,
            "message": check.message,
            **{name: _number(text) for name, text in check.values.items()},
        }
        for check in checks
    }


def change(before: Mapping[str, object], after: Mapping[str, object]) -> Table:
    """Return a table of old and new values, with the differences marked."""
    table = Table(box=None, pad_edge=False)
    for heading in ("", "before", "after"):
        table.add_column(heading)
    for name, value in after.items():
        old = before.get(name, "not known")
        text = str(value)
        table.add_row(name, str(old), text if text == str(old) else f"[bold yellow]{text}[/]")
    return table


def _number(text: str) -> int | float | str:
    try:
        return int(text)
    except ValueError:
        pass
    try:
        number = float(text)
    except ValueError:
        return text
    return number if math.isfinite(number) else text  # JSON knows no other numbers


def _plain(values: Mapping[str, str]) -> Iterable[tuple[str, str]]:
    return ((name.replace("[", "\\["), value) for name, value in values.items())


_ANYWHERE: Final = {"host_ip": "0.0.0.0"}  # by hand one does not want to know its own address
_PANEL: Final = "Connection"

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]
YesOption = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")]


def with_network(command: Callable[..., Any]) -> Callable[..., Any]:
    """Return a command whose parameter ``network`` is replaced by an option per network setting.

    A wrong value ends the command as a wrong option does, with exit code 2.
    """
    items = list(settings_of(NetworkConfig))
    own = inspect.signature(command, eval_str=True)
    kept = [
        item.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for item in own.parameters.values()
        if item.name != "network"
    ]
    added = [
        inspect.Parameter(
            item.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=_ANYWHERE.get(item.name, item.default),
            annotation=_option(item),
        )
        for item in items
    ]

    @functools.wraps(command)
    def run(**arguments: Any) -> Any:
        values = {item.name: arguments.pop(item.name) for item in items}
        return command(**arguments, network=build(NetworkConfig, values))

    run.__signature__ = inspect.Signature(kept + added)  # type: ignore[attr-defined]  # for typer
    run.__annotations__ = {item.name: item.annotation for item in kept + added}
    return run


def _option(item: Setting) -> Any:
    bounds: dict[str, Any] = {"min": item.lo, "max": item.hi} if item.lo is not None else {}
    text = f"{item.doc[0].upper()}{item.doc[1:]}."
    flag = f"--{item.name.replace('_', '-')}"
    return Annotated[item.type, typer.Option(flag, help=text, rich_help_panel=_PANEL, **bounds)]
