"""Makes command line options of settings, so that both are written once."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Final, TypeVar

import typer

from l2lidar_node.settings import Setting, SettingError, Value, build, settings_of

G = TypeVar("G")

_NUMBERS: Final = {int: "whole number", float: "number"}
_METAVARS: Final = {int: "N", float: "X", str: "TEXT", bool: None}

Panels = Mapping[str, Sequence[Setting]]
"""Settings by the heading under which the help shows them."""


def with_options(command: Callable[..., None], panels: Panels) -> Callable[..., None]:
    """Return a command that also takes an option per setting.

    Parameters
    ----------
    command : callable
        Takes its own annotated parameters and ``settings``, a dict from the name of a setting to
        the value that was given; settings that were not are not in it.
    panels : mapping

    Returns
    -------
    callable
        For :meth:`typer.Typer.command`.
    """
    parameters = [
        item.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for item in inspect.signature(command, eval_str=True).parameters.values()
        if item.name != "settings"
    ]
    made = {f"setting_{item.name}": item for items in panels.values() for item in items}
    parameters += [
        inspect.Parameter(
            f"setting_{item.name}",
            inspect.Parameter.KEYWORD_ONLY,
            default=None,
            annotation=_option(item, panel),
        )
        for panel, items in panels.items()
        for item in items
    ]

    def run(**arguments: Any) -> None:
        texts = {name: arguments.pop(name) for name in made}
        settings = {
            item.name: _value(item, texts[name])
            for name, item in made.items()
            if texts[name] is not None
        }
        command(**arguments, settings=settings)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # typer reads it
    run.__annotations__ = {item.name: item.annotation for item in parameters}
    run.__doc__ = command.__doc__
    return run


def group(kind: type[G], given: Mapping[str, Value]) -> G:
    """Return a group of settings made from those of the given values that belong to it."""
    own = {item.name for item in settings_of(kind)}
    return build(kind, {name: value for name, value in given.items() if name in own})


def flag(item: Setting) -> str:
    """Return the option of a setting."""
    return f"--{item.name.replace('_', '-')}"


def _value(item: Setting, given: bool | str) -> Value:
    try:
        if isinstance(given, bool):
            return item.check(given)
        if item.item is None:
            return item.check(item.type(given))
        parts = [part for part in given.split(",") if part.strip()]
        return item.check([item.item(part) for part in parts])
    except SettingError as error:
        text = str(error).removeprefix(f"parameter '{item.name}': ")
    except ValueError:
        kind = "list of numbers such as 1.5,4" if item.item else _NUMBERS[item.type]
        text = f"{given!r} is no {kind}"
        if item.range_text:
            text += f", expected {item.range_text}"
    raise typer.BadParameter(text, param_hint=f"'{flag(item)}'")


def _option(item: Setting, panel: str) -> Any:
    # Numbers come as text: what is wrong with one is said in one place, by the setting.
    kind: Any = bool if item.type is bool else str
    names = [f"{flag(item)}/--no-{flag(item)[2:]}"] if kind is bool else [flag(item)]
    metavar = "|".join(item.choices) or ("A,B,..." if item.item else _METAVARS[item.type])
    facts = [f"{item.doc[0].upper()}{item.doc[1:]}."]
    if item.unit and not item.range_text.endswith(item.unit):
        facts.append(f"In {item.unit}.")
    if item.range_text and not item.choices:
        facts.append(f"{item.range_text[0].upper()}{item.range_text[1:]}.")
    facts.append(f"Default: {_text(item.default)}")
    return Annotated[
        kind | None,
        typer.Option(
            *names,
            help=" ".join(facts),
            rich_help_panel=panel,
            show_default=False,
            metavar=metavar,
        ),
    ]


def _text(value: Value) -> str:
    if isinstance(value, tuple):
        return ",".join(_text(item) for item in value) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value) if value != "" else "none"
