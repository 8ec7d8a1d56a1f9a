"""Opens what a driver is told to listen to: a network address or a serial device."""

from __future__ import annotations

from l2lidar_node.config import NetworkConfig
from l2lidar_node.transport.serial import SerialTransport
from l2lidar_node.transport.udp import UdpTransport
from l2lidar_node.types import Transport


def opened(network: NetworkConfig) -> Transport:
    """Return the transport that the settings name.

    Raises
    ------
    TransportError
        If it cannot be opened; the message says what to do.
    """
    if network.serial_port:
        return SerialTransport(network.serial_port)
    return UdpTransport(network)


def described(network: NetworkConfig) -> str:
    """Return in words where the L2 is expected."""
    if network.serial_port:
        return f"listening on {network.serial_port}"
    return (
        f"listening on {network.host_ip}:{network.host_port} "
        f"for the L2 at {network.l2_ip}:{network.l2_port}"
    )
