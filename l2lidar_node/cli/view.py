"""Looks at live topics: in a window, in the browser, or into a file for later."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from l2lidar_node.cli.console import say
from l2lidar_node.cli.device import DeviceError


def view(
    web: Annotated[
        bool, typer.Option("--web", help="Serve it to a browser on this machine.")
    ] = False,
    save: Annotated[
        Path | None, typer.Option(help="Write an .rrd file instead of showing.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="End after so long; else Ctrl-C ends it.")
    ] = None,
    namespace: Annotated[
        str, typer.Option(help="Namespace of the topics, for example /front.")
    ] = "",
) -> None:
    """Look at clouds raw and deskewed, path, map, IMU and health, in rerun. Needs ROS 2."""
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions

        from l2lidar_node.ros import topics, viewer
    except ImportError as error:
        raise DeviceError(
            f"viewing topics needs ROS 2 ({error}): source it, or run `make setup`"
        ) from None
    try:
        sdk = viewer.open_viewer(web, save)
    except viewer.ViewerError as error:
        raise DeviceError(str(error)) from None
    names = {
        "raw": topics.POINTS,
        "deskewed": topics.POINTS_DESKEWED,
        "map": topics.LOCAL_MAP,
        "imu": topics.IMU,
        "odometry": topics.ODOMETRY,
    }
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        shown = viewer.view(
            sdk, {role: namespace.rstrip("/") + name for role, name in names.items()}, seconds
        )
    except KeyboardInterrupt:
        return
    finally:
        rclpy.try_shutdown()
    say(f"{shown} messages shown" + (f", written to {save}" if save else ""))
    if not shown:
        raise DeviceError("no message came: is the driver running, in the same ROS_DOMAIN_ID?")
