"""`l2lidar check`: checks whether an odometry or mapping package can work with topics."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.console import Console
from rich.text import Text

from l2lidar_node.check.observation import (
    Observation,
    SourceError,
    Topics,
)
from l2lidar_node.check.report import as_data, judge, verdict
from l2lidar_node.check.requirements import CONSUMERS, Consumer, Finding, Use, worst
from l2lidar_node.cli.console import JsonOption, out, print_json
from l2lidar_node.command_line import UsageError
from l2lidar_node.recording.packet_bag import is_of_packets
from l2lidar_node.types import Level

if TYPE_CHECKING:
    from l2lidar_node.check.observation import Observation


_COLORS: Final = {Level.OK: "green", Level.WARN: "yellow", Level.ERROR: "red"}
_LISTEN_S: Final = 10.0
_TOPIC: Final = re.compile(r"[~/]?[A-Za-z_]\w*(/[A-Za-z_]\w*)*")


def _known(name: str) -> str:
    if name not in CONSUMERS:
        raise typer.BadParameter(f"'{name}' is not known, expected one of {', '.join(CONSUMERS)}")
    return name


def check(
    for_: Annotated[
        str,
        typer.Option(
            "--for",
            callback=_known,
            metavar="CONSUMER",
            help=f"Consumer of the topics: {', '.join(CONSUMERS)}.",
        ),
    ],
    source: Annotated[
        str,
        typer.Argument(
            metavar="[TOPIC|FILE]",
            help="A live topic of clouds; a rosbag2 folder or MCAP file; or a capture (pcap), as "
            "lio_input.launch.py would publish it. If omitted, the only live topic of clouds.",
        ),
    ] = "",
    cloud: Annotated[
        str, typer.Option(help="Topic of the clouds, if there are several.", metavar="TOPIC")
    ] = "",
    imu: Annotated[
        str, typer.Option(help="Topic of the IMU, if there are several.", metavar="TOPIC")
    ] = "",
    seconds: Annotated[
        float | None,
        typer.Option(
            min=0.1,
            help=f"Seconds to observe; by default {_LISTEN_S:g} for topics, and all of a "
            "recording.",
        ),
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Fail on warnings too.")] = False,
    json_: JsonOption = False,
) -> None:
    """Judge fields, times, rates, gaps, IMU, frames and QoS for one consumer, a line for each.

    The exit code is 0 if nothing is in error, 1 if something is (with --strict: or warned of),
    2 if there is nothing to judge.
    """
    consumer = CONSUMERS[for_]
    try:
        seen, topics = _observe(source, Topics(cloud, imu), consumer, seconds)
    except SourceError as error:
        raise UsageError(str(error)) from None
    findings = judge(seen, consumer)
    if json_:
        print_json(as_data(findings, consumer, source, topics))
    else:
        _print(findings, consumer)
    if worst(findings) >= (Level.WARN if strict else Level.ERROR):
        raise typer.Exit(1)


def _observe(
    source: str, asked: Topics, consumer: Consumer, seconds: float | None
) -> tuple[Observation, Topics]:
    needs_imu = consumer.imu is not Use.IGNORED
    path = Path(source)
    if source and (path.exists() or not _TOPIC.fullmatch(source)):
        from l2lidar_node.cli import recorded

        if is_of_packets(path):
            return recorded.observe_capture(path, consumer.name, seconds)
        return recorded.observe_bag(path, asked, needs_imu, seconds)
    try:
        from l2lidar_node.ros import topic_source
    except ImportError as error:
        what = f"{source} is not a file; topics" if source else "topics"
        raise SourceError(f"{what} need a sourced ROS 2 ({error})") from None
    if source and asked.cloud:
        raise SourceError(f"topic '{source}' and --cloud {asked.cloud} contradict each other")
    seconds = _LISTEN_S if seconds is None else seconds
    with Console(stderr=True).status(f"listening for {seconds:g} s"):
        return topic_source.observe(Topics(source or asked.cloud, asked.imu), needs_imu, seconds)


def _print(findings: list[Finding], consumer: Consumer) -> None:
    width = max(len(item.subject) for item in findings)
    for item in findings:
        line = Text(f"{item.level.name:5} ", style=_COLORS[item.level])
        line.append(f"{item.subject:{width}}  ", style="cyan")
        line.append(item.text, style="default")
        if item.fix:
            line.append(f"; {item.fix}", style="bold default")
        out.print(line, soft_wrap=True)
    out.print(
        Text(verdict(findings, consumer), style=f"bold {_COLORS[worst(findings)]}"),
        soft_wrap=True,
    )
