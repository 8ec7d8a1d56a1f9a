"""A bench for node tests: programs in processes of their own, and a node that watches and asks."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import pytest
import rclpy
from rclpy.node import Node
from rclpy.signals import uninstall_signal_handlers

from l2lidar_node.demo.observer import Observer
from l2lidar_node.demo.processes import Program, Programs, assigned, free_udp_ports
from l2lidar_node.ros import driver_node

TIMEOUT_S = 120.0  # generous: only a failure waits that long
_ASK_AGAIN_S = 10.0


@dataclass
class Rig:
    """Programs, a watching node and the ports of one driver."""

    programs: Programs
    observer: Observer
    host_port: int
    lidar_port: int

    def emulator(self, *arguments: str) -> Program:
        """Start a virtual L2 that sends to this rig's driver."""
        ports = ["--host-port", str(self.host_port), "--lidar-port", str(self.lidar_port)]
        world = [] if "--world" in arguments else ["--world", "pattern"]
        return self.programs.start("l2lidar_node.emulator", [*ports, *world, *arguments])

    def driver(self, **parameters: Any) -> Program:
        """Start the driver node for this rig's virtual L2."""
        return self.programs.start("l2lidar_node.ros.driver_node", self.arguments(**parameters))

    def unhurried_driver(self, **parameters: Any) -> Program:
        """Start a driver node that waits for acknowledgments however long they take."""
        module = "tests.l2lidar_node.ros.unhurried_driver"
        return self.programs.start(module, self.arguments(**parameters))

    def arguments(self, **parameters: Any) -> list[str]:
        """Return the driver's command line."""
        values: dict[str, Any] = {
            "l2_ip": "127.0.0.1",
            "host_ip": "127.0.0.1",
            "l2_port": self.lidar_port,
            "host_port": self.host_port,
            "enable_IMU_publishing": True,
            "imu_adjust": False,
            "watchdog_timeout_ms": 600_000,  # the virtual L2 may take its time to start
            **parameters,
        }
        return assigned(values)

    def wait_for(self, condition: Callable[[], Any], what: str) -> None:
        """Spin until a condition holds; fail if a program ends or it takes too long."""
        deadline = time.monotonic() + TIMEOUT_S
        while not condition():
            rclpy.spin_once(self.observer, timeout_sec=0.05)
            self.programs.check()
            assert time.monotonic() < deadline, f"waited in vain for {what}"

    def call(self, kind: type, name: str, request: Any) -> Any:
        """Call a service of the driver and return its response.

        A server that has not heard of a client after 100 ms throws its answer away: it is asked
        again.
        """
        client = self.observer.create_client(kind, name)
        self.wait_for(client.service_is_ready, name)
        futures: list[Any] = []
        asked = -math.inf

        def is_answered() -> bool:
            nonlocal asked
            if time.monotonic() - asked > _ASK_AGAIN_S:
                futures.append(client.call_async(request))
                asked = time.monotonic()
            return any(future.done() for future in futures)

        self.wait_for(is_answered, f"an answer of {name}")
        self.observer.destroy_client(client)
        return next(future.result() for future in futures if future.done())


@contextmanager
def open_rig() -> Iterator[Rig]:
    """Make a rig and end everything it started."""
    rclpy.init()
    observer = Observer()
    try:
        with Programs() as programs:
            yield Rig(programs, observer, *free_udp_ports(2))
    finally:
        observer.destroy_node()
        rclpy.try_shutdown()


def refused(capfd: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """Run the driver's program in this process, which it has to leave at once.

    Returns its exit code and what it said on the standard error output.
    """
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        code = driver_node.main(["l2lidar_node", *arguments])
    finally:
        uninstall_signal_handlers()
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return code, capfd.readouterr().err


def publishers(node: Node, topic: str) -> list[Any]:
    """Return what is known about the publishers of a topic."""
    return list(node.get_publishers_info_by_topic(topic))
