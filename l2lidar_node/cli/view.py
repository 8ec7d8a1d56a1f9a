"""`l2lidar view`: shows live topics or a recording in a window, the browser, or a file."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from l2lidar_node import viewing
from l2lidar_node.cli.console import say
from l2lidar_node.command_line import CommandError, UsageError
from l2lidar_node.config import DriverConfig
from l2lidar_node.recording import bag
from l2lidar_node.recording.capture import CaptureError
from l2lidar_node.recording.packet_bag import is_of_packets, open_packets
from l2lidar_node.recording.recording import Recording, measurements
from l2lidar_node.settings import build
from l2lidar_node.types import Sweep
from l2lidar_node.viewing import Viewer

_ODOMETRY: Final = "nav_msgs/msg/Odometry"
_DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"


def view(
    file: Annotated[
        Path | None,
        typer.Argument(
            help="Bag or capture (pcap) to show instead of live topics; needs no ROS.",
            exists=True,
            show_default=False,
        ),
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Serve it to a browser on this machine.")
    ] = False,
    save: Annotated[
        Path | None, typer.Option(help="Write a new .rrd file instead of showing.")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            min=0.1, help="Seconds to show after the first message; until Ctrl-C if omitted."
        ),
    ] = None,
    namespace: Annotated[
        str, typer.Option(help="Namespace of the topics, for example /front.")
    ] = "",
) -> None:
    """Show raw and deskewed clouds, path, map, IMU and health in rerun.

    With the odometry's topics also at its standard deviations, the directions that it cannot see,
    and the map as it grows. Live topics need ROS 2; a recording does not.
    """
    if save is None:
        _open_and_show(file, namespace, seconds, None, web=web)
        return
    if web:
        raise UsageError("--web and --save exclude each other")
    if save.suffix != ".rrd":
        raise UsageError(f"'{save}' ends in '{save.suffix}'; expected FILE.rrd")
    if save.is_dir():
        raise UsageError(f"'{save}' is a folder; expected FILE.rrd")
    if os.path.lexists(save):
        raise UsageError(f"'{save}' exists already; choose another name or remove it")
    save.parent.mkdir(parents=True, exist_ok=True)
    try:
        _open_and_show(file, namespace, seconds, save, web=False)
    except CommandError:
        save.unlink(missing_ok=True)  # made by this run, and shows nothing
        raise
    say(f"written to {save}")


def _open_and_show(
    file: Path | None, namespace: str, seconds: float | None, save: Path | None, *, web: bool
) -> None:
    try:
        sdk = viewing.open_viewer(web, save)
    except viewing.ViewerError as error:
        raise CommandError(str(error)) from None
    try:
        _show(sdk, file, namespace, seconds, web)
    except KeyboardInterrupt:
        return
    finally:
        sdk.disconnect()  # with all that is still to be written


def _show(
    sdk: Any,
    file: Path | None,
    namespace: str,
    seconds: float | None,
    web: bool,
) -> None:
    if file is None:
        shown = _live(sdk, namespace, seconds)
    else:
        shown = _recorded(sdk, file, namespace, seconds)
    say(f"{shown} messages shown")
    if not shown and file is None:
        raise CommandError(
            "no message arrived; check that the driver runs in the same ROS_DOMAIN_ID"
        )
    if not shown:
        raise CommandError(f"{file} has no topic to show: no clouds, IMU, odometry or diagnostics")
    if web:
        _serve(seconds)


def _live(sdk: Any, namespace: str, seconds: float | None) -> int:
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions

        from l2lidar_node.ros import topics
        from l2lidar_node.ros.topic_source import view as show_topics
    except ImportError as error:
        raise CommandError(
            f"viewing topics needs ROS 2 ({error}): source it, or name a recording"
        ) from None
    names = {
        "raw": topics.POINTS,
        "deskewed": topics.POINTS_DESKEWED,
        "map": topics.LOCAL_MAP,
        "imu": topics.IMU,
        "odometry": topics.ODOMETRY,
    }
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        return show_topics(
            sdk, {role: namespace.rstrip("/") + name for role, name in names.items()}, seconds
        )
    finally:
        rclpy.try_shutdown()


def _recorded(sdk: Any, file: Path, namespace: str, seconds: float | None) -> int:
    viewer = Viewer(sdk)
    try:
        if is_of_packets(file):
            _show_capture(viewer, file, seconds)
        else:
            _show_bag(viewer, file, namespace.rstrip("/"), seconds)
    except CaptureError as error:
        raise CommandError(f"{file}: {error}") from None
    if viewer.refused:
        say(f"[yellow]{viewer.refused} clouds could not be read")
    return viewer.messages


def _show_capture(viewer: Viewer, file: Path, seconds: float | None) -> None:
    config = build(DriverConfig, {"imu_adjust": False, "sweep_cut": "turn"})
    messages = bag.Messages(config)
    with open_packets(file) as stream:
        recording = Recording(stream)
        for now, event in measurements(recording, config):
            if seconds is not None and now > recording.start + seconds * 1e9:
                return
            if isinstance(event, Sweep):
                viewer.cloud(messages.cloud(event), "raw")
            else:
                viewer.imu(messages.imu(event))


def _show_bag(viewer: Viewer, file: Path, namespace: str, seconds: float | None) -> None:
    roles = {
        f"{namespace}/points": "raw",
        f"{namespace}/points_deskewed": "deskewed",
        f"{namespace}/local_map": "map",
    }
    start = None
    for topic, kind, now, message in _messages(file):
        start = now if start is None else start
        if seconds is not None and now > start + seconds * 1e9:
            return
        if kind == _DIAGNOSTICS:
            viewer.diagnostics(message)
        elif not topic.startswith(namespace):
            continue
        elif kind == bag.CLOUD and topic in roles:
            viewer.cloud(message, roles[topic])
        elif kind == bag.IMU:
            viewer.imu(message)
        elif kind == _ODOMETRY:
            viewer.odometry(message)


def _messages(file: Path) -> Iterator[tuple[str, str, int, Any]]:
    """Yield topic, type, instant of recording and message of all that can be shown."""
    kinds = (bag.CLOUD, bag.IMU, _ODOMETRY, _DIAGNOSTICS)
    try:
        with bag.open_bag(file) as reader:
            for connection, now, data in bag.messages(reader):
                if connection.msgtype in kinds:
                    message = reader.deserialize(data, connection.msgtype)
                    yield connection.topic, connection.msgtype, now, message
    except Exception as error:
        # Of a damaged file, any byte may lead anywhere in its readers.
        raise CommandError(str(bag.unreadable(file, error))) from None


def _serve(seconds: float | None) -> None:
    """Keep the page of a recording until Ctrl-C, or for some seconds."""
    say("Ctrl-C ends it")
    try:
        threading.Event().wait(seconds)
    except KeyboardInterrupt:
        return
