"""Gives the driver node what it listens to: a live session, recorded or not, or a playback."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import rclpy
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.recording.pcap import CaptureError
from l2lidar_node.recording.playback import Playback
from l2lidar_node.recording.recorder import Recorder, free_name
from l2lidar_node.recording.recording import Recording
from l2lidar_node.ros.conversions import to_time
from l2lidar_node.ros.program import StartError
from l2lidar_node.transport import source
from l2lidar_node.transport.loop import Loop
from l2lidar_node.transport.session import Session
from l2lidar_node.transport.udp import TransportError
from l2lidar_node.types import HostNs

_CLOCK_DEPTH = 10


def open_loop(node: Node, config: DriverConfig, on_event: Callable[[Event], None]) -> Loop:
    """Return the loop that the settings ask for, not started yet; says in the log what it is.

    Raises
    ------
    StartError
        If a socket, device or file cannot be opened; the message says what to do.
    """
    if config.files.replay_file:
        return _playback(node, config, on_event)
    recorder = None
    if config.files.record_file:
        path = free_name(Path(config.files.record_file).expanduser())
        try:
            recorder = Recorder(path, config.network, node.get_logger().error)
        except OSError as error:
            raise StartError(f"cannot record to {path}: {error.strerror}") from None
        node.get_logger().info(f"recording to {path}")
    try:
        transport = source.opened(config.network)
    except TransportError as error:
        raise StartError(str(error.strerror)) from None
    node.get_logger().info(source.described(config.network))
    return Session(Driver(config), transport, on_event, recorder)


def _playback(node: Node, config: DriverConfig, on_event: Callable[[Event], None]) -> Playback:
    path = Path(config.files.replay_file).expanduser()
    try:
        recording = Recording(path.open("rb"), config.network.l2_ip)
    except OSError as error:
        raise StartError(f"cannot replay {path}: {error.strerror}") from None
    except CaptureError as error:
        raise StartError(f"cannot replay {path}: {error}") from None
    logger = node.get_logger()
    rate = config.files.replay_rate
    logger.info(
        f"replaying what the L2 at {recording.device} sent, from {path}, "
        + (f"{rate:g} times as fast" if rate else "as fast as possible")
    )
    clock = node.create_publisher(Clock, "/clock", _CLOCK_DEPTH)

    def on_time(now: HostNs) -> None:
        if config.files.replay_clock and node.context.ok():
            clock.publish(Clock(clock=to_time(now)))

    def on_lap(shift_ns: int | None) -> None:
        cut = ", which is cut off" if recording.is_cut_off else ""
        if playback.damage:
            logger.error(f"{path} cannot be read any further: {playback.damage}")
        if shift_ns is not None:
            seconds = shift_ns / 1e9
            logger.info(
                f"again from the beginning of {path}{cut}; stamps are {seconds:.3f} s later"
            )
        else:
            logger.info(f"end of {path}{cut}")
            rclpy.try_shutdown(context=node.context)

    playback = Playback(recording, config, on_event, on_time, on_lap)
    return playback
