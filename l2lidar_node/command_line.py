"""Common parts of the command lines: verbs, errors, typer settings.

It imports typer only when a verb is run, so that anybody may import it.
"""

from __future__ import annotations

import functools
import inspect
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import entry_points
from types import UnionType
from typing import Annotated, Any, Final, NamedTuple, Union, get_args, get_origin

from l2lidar_node.programs import INTERRUPTED

GROUP: Final = "l2lidar.verbs"
"""Entry point group by which other packages add verbs to the ``l2lidar`` command."""

UNIT: Final = "The unit"
DATA: Final = "Its data"

_UNWRAPPED: Final = re.compile(r"(?<![-\n])\n(?![-\n])")  # ends of lines within a paragraph


class CommandError(RuntimeError):
    """A command cannot be carried out; the message says why."""

    exit_code = 1


class UsageError(CommandError, ValueError):
    """A wrong argument; the message names it, its value and what would be right."""

    exit_code = 2


class Verb(NamedTuple):
    """A verb of the ``l2lidar`` command, imported when it is run.

    Attributes
    ----------
    name : str
    target : str
        ``module:name`` of a function for typer, or of a :class:`typer.Typer` with verbs of its
        own.
    panel : str
        Heading under which the help lists it: :data:`UNIT` or :data:`DATA`.
    help : str
        One sentence for the list of verbs.
    """

    name: str
    target: str
    panel: str
    help: str

    def load(self) -> Any:
        """Import the verb and return its command, of typer's own class."""
        import typer

        module, _, attribute = self.target.partition(":")
        found = getattr(import_module(module), attribute)
        if isinstance(found, typer.Typer):
            for item in found.registered_commands:
                if item.callback is not None:
                    item.callback = for_typer(item.callback)
            return typer.main.get_command(found)
        single = typer.Typer(add_completion=False, rich_markup_mode="rich")
        single.command(self.name, context_settings={"help_option_names": ["-h", "--help"]})(
            for_typer(found)
        )
        return typer.main.get_command(single)


def registered_verbs() -> list[Verb]:
    """Return the verbs that installed packages register; those that cannot be loaded are named."""
    found = []
    for entry in entry_points(group=GROUP):
        try:
            found.append(Verb(*entry.load()))
        except (ImportError, AttributeError, TypeError) as error:
            print(f"l2lidar: verb '{entry.name}' ({entry.value}): {error}", file=sys.stderr)
    return found


@contextmanager
def interruption_exits() -> Iterator[None]:
    """Turn Ctrl-C into exit code 130; Ubuntu 24.04's click prints "Aborted" and exits with 1."""
    try:
        yield
    except KeyboardInterrupt:
        import typer

        raise typer.Exit(INTERRUPTED) from None


def for_typer(command: Callable[..., Any]) -> Callable[..., Any]:
    """Return a command as any typer from 0.9 on, which Ubuntu 24.04 has, can run it.

    The lines of a paragraph of its help are joined, so that they fit any terminal.
    ``X | None`` is spelt ``Optional[X]``: typer knows the former from 0.12.4 on. For Ctrl-C see
    :func:`interruption_exits`.
    """
    signature = inspect.signature(command, eval_str=True)
    parameters = [
        item.replace(annotation=_optional(item.annotation))
        for item in signature.parameters.values()
    ]

    @functools.wraps(command)
    def run(*args: Any, **named: Any) -> Any:
        with interruption_exits():
            return command(*args, **named)

    run.__doc__ = _UNWRAPPED.sub(" ", inspect.getdoc(command) or "")
    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]  # typer reads it
    run.__annotations__ = {item.name: item.annotation for item in parameters}
    return run


_MARKER: Final = "spelt for typer"


def _optional(annotation: Any) -> Any:
    if get_origin(annotation) is Annotated:
        inner, *options = get_args(annotation)
        # Without the marker typing's cache gives back the alias of X | None: it holds both equal.
        return Annotated[(_optional(inner), *options, _MARKER)]
    if isinstance(annotation, UnionType):
        return Union[get_args(annotation)]  # noqa: UP007 - which is the point
    return annotation
