"""The `l2lidar` command line: its verbs, its messages and its exit codes."""

from __future__ import annotations

import os
import sys
from typing import Final

import typer

from l2lidar_node.cli import get, set
from l2lidar_node.cli.check import check
from l2lidar_node.cli.device import DeviceError
from l2lidar_node.cli.discover import discover
from l2lidar_node.cli.odometry import odometry
from l2lidar_node.cli.record import convert, record
from l2lidar_node.cli.replay import replay
from l2lidar_node.cli.set import UsageError
from l2lidar_node.cli.standby import reset, start, stop
from l2lidar_node.cli.status import info, monitor
from l2lidar_node.cli.sync_check import sync_check
from l2lidar_node.cli.view import view
from l2lidar_node.programs import interruptible
from l2lidar_node.settings import SettingError
from l2lidar_node.transport.udp import TransportError

_UNIT: Final = "The unit"
_DATA: Final = "Its data"


def app() -> typer.Typer:
    """Return the command line."""
    made = typer.Typer(
        help="Work with a Unitree L2 without ROS: find it, look at it, set it, record it.",
        epilog="Exit codes: 0 done; 1 the unit, the network or a file stands in the way; 2 usage; "
        "130 interrupted.",
        add_completion=False,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    for verb in (discover, info, monitor, start, stop, reset):
        made.command(rich_help_panel=_UNIT)(verb)
    made.add_typer(get.app, name="get", rich_help_panel=_UNIT)
    made.add_typer(set.app, name="set", rich_help_panel=_UNIT)
    made.command("sync-check", rich_help_panel=_UNIT)(sync_check)
    for verb in (record, replay, convert, check, odometry, view):
        made.command(rich_help_panel=_DATA)(verb)
    made.command(
        rich_help_panel=_DATA,
        add_help_option=False,
        context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    )(demo)
    return made


def demo(context: typer.Context) -> None:
    """Show everything with a virtual L2; all options go to the demo."""
    sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, "-m", "l2lidar_node.demo", *context.args])


def main() -> int:
    """Run the command line; return the exit code."""
    try:
        app()(prog_name="l2lidar")
    except (UsageError, SettingError) as error:
        return _failed(str(error), 2)
    except (DeviceError, TransportError) as error:
        return _failed(getattr(error, "strerror", None) or str(error), 1)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    return 0


def _failed(message: str, code: int) -> int:
    print(f"l2lidar: {message}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(interruptible(main))
