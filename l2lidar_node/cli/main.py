"""The `l2lidar` command line: its verbs, its messages and its exit codes."""

from __future__ import annotations

import sys
from typing import Annotated, Any, Final

import typer
from typer.core import TyperCommand, TyperGroup

from l2lidar_node import __version__
from l2lidar_node.command_line import (
    DATA,
    UNIT,
    CommandError,
    Verb,
    for_typer,
    interruption_exits,
    registered_verbs,
)
from l2lidar_node.programs import interruptible
from l2lidar_node.settings import SettingError

_CLI: Final = "l2lidar_node.cli"
VERBS: Final = (
    Verb(
        "discover",
        f"{_CLI}.discover:discover",
        UNIT,
        "Find units: listen on all interfaces, and query the usual address.",
    ),
    Verb(
        "info",
        f"{_CLI}.status:info",
        UNIT,
        "Show what the unit is, or what a recording contains: versions, calibration, rates, "
        "losses.",
    ),
    Verb(
        "monitor",
        f"{_CLI}.status:monitor",
        UNIT,
        "Monitor the unit live: the checks of /diagnostics, one per line.",
    ),
    Verb(
        "start",
        f"{_CLI}.commands:start",
        UNIT,
        "Leave standby: the head turns, points arrive after 12 to 45 s.",
    ),
    Verb(
        "stop",
        f"{_CLI}.commands:stop",
        UNIT,
        "Enter standby: the motors stop, and points and IMU with them.",
    ),
    Verb(
        "reset",
        f"{_CLI}.commands:reset",
        UNIT,
        "Reboot the unit: stored settings take effect, points are back in about 25 s.",
    ),
    Verb("get", f"{_CLI}.commands:get_app", UNIT, "Show what is set in the unit."),
    Verb(
        "set",
        f"{_CLI}.commands:set_app",
        UNIT,
        "Change what the unit stores in its flash memory: shown first, confirmed, verified.",
    ),
    Verb(
        "sync-check",
        f"{_CLI}.status:sync_check",
        UNIT,
        "Compare the unit's clock with this host's; does not change the clock.",
    ),
    Verb(
        "calibrate",
        f"{_CLI}.calibrate:app",
        UNIT,
        "Estimate the unit's calibration errors, and write a calibration file.",
    ),
    Verb(
        "record",
        f"{_CLI}.record:record",
        DATA,
        "Record a unit: every packet as a capture, or clouds and IMU as a bag.",
    ),
    Verb(
        "replay",
        f"{_CLI}.record:replay",
        DATA,
        "Send the datagrams of a capture to a driver, at the pace they were captured.",
    ),
    Verb(
        "convert",
        f"{_CLI}.record:convert",
        DATA,
        "Convert a capture to a ROS 2 bag, with the driver's stamps.",
    ),
    Verb(
        "check",
        f"{_CLI}.check:check",
        DATA,
        "Check whether an odometry or mapping package can work with topics or a recording.",
    ),
    Verb(
        "view",
        f"{_CLI}.view:view",
        DATA,
        "Show raw and deskewed clouds, path, map, IMU and health in rerun.",
    ),
    Verb("demo", "l2lidar_node.demo.__main__:demo", DATA, "Show everything with a virtual L2."),
)


class _Verbs(TyperGroup):
    """The list of verbs; only the one that runs is imported."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._known = {verb.name: verb for verb in [*VERBS, *registered_verbs()]}
        # In the help, the verbs of one panel stand together.
        for verb in sorted(self._known.values(), key=lambda verb: verb.panel != UNIT):
            self.commands[verb.name] = TyperCommand(
                verb.name, help=verb.help, rich_help_panel=verb.panel
            )

    def make_context(self, *arguments: Any, **options: Any) -> Any:
        """Parse the arguments."""
        with interruption_exits():
            return super().make_context(*arguments, **options)

    def invoke(self, context: Any) -> Any:
        """Run the verb."""
        with interruption_exits():
            return super().invoke(context)

    def resolve_command(self, context: Any, arguments: list[str]) -> Any:
        """Return the verb itself, imported now."""
        name, command, rest = super().resolve_command(context, arguments)
        if command is not None and command.name in self._known:
            try:
                command = self._known[command.name].load()
            except ModuleNotFoundError as error:
                raise CommandError(
                    f"'{name}' needs the Python package '{error.name}', which is not installed; "
                    "docs/install.md says how to add it"
                ) from None
        return name, command, rest


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(f"l2lidar {__version__}")
        raise typer.Exit


def app() -> typer.Typer:
    """Return the command line."""
    made = typer.Typer(
        cls=_Verbs,
        help="Work with a Unitree L2 without ROS: find, inspect, configure and record it.",
        epilog="Exit codes: 0 success; 1 a problem with the unit, the network or a file; 2 usage; "
        "130 interrupted.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
        context_settings={"help_option_names": ["-h", "--help"]},
    )

    @made.callback()
    @for_typer
    def l2lidar(
        version: Annotated[
            bool,
            typer.Option(
                "--version", help="Show the version and exit.", callback=_show_version,
                is_eager=True,
            ),
        ] = False,
    ) -> None:  # fmt: skip
        del version

    return made


def main() -> int:
    """Run the command line; return the exit code."""
    try:
        app()(prog_name="l2lidar")
    except CommandError as error:
        return _failed(str(error), error.exit_code)
    except SettingError as error:
        return _failed(str(error), 2)
    except OSError as error:
        words = error.strerror or str(error)
        return _failed(f"{error.filename}: {words}" if error.filename else words, 1)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    return 0


def _failed(message: str, code: int) -> int:
    print(f"l2lidar: {message}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(interruptible(main))
