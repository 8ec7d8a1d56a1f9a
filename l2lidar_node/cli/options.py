"""Makes command line options of settings, so that a setting is declared once."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any, Final

import typer

from l2lidar_node.config import NetworkConfig
from l2lidar_node.settings import Setting, build, settings_of

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
