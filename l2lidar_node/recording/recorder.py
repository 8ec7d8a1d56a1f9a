"""Writes what a session receives and sends into a capture file, and never stops the session."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Final

from l2lidar_node.config import NetworkConfig
from l2lidar_node.protocol import wire
from l2lidar_node.recording.capture import Endpoint
from l2lidar_node.recording.recording import RecordingWriter
from l2lidar_node.types import HostNs

_BUFFER: Final = 1 << 20
_FLUSH_NS: Final = 1_000_000_000  # so much at most is lost when the process is killed


class Recorder:
    """A session's tap that writes a pcap file as it goes.

    Parameters
    ----------
    path : Path
        Must not exist yet; missing folders are made.
    network : NetworkConfig
        Addresses that the capture names.
    on_error : callable
        Called once, with a sentence, when the file cannot be written any further.

    Attributes
    ----------
    octets : int
        Size of the file so far.

    Raises
    ------
    OSError
        If the file cannot be made; :class:`FileExistsError` if there is one.
    """

    def __init__(
        self, path: Path, network: NetworkConfig, on_error: Callable[[str], None]
    ) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.octets = 0
        self._on_error = on_error
        self._file = path.open("xb", buffering=_BUFFER)
        self._is_open = True
        self._flushed = HostNs(0)
        device, host = endpoints(network)
        self._writer = RecordingWriter(self._file, device, host)
        self._file.flush()

    def received(self, data: bytes, arrival: HostNs) -> None:
        """Write bytes that came from the device."""
        self._write(lambda: self._writer.received(data, arrival), arrival)

    def sent(self, frame: bytes, at: HostNs) -> None:
        """Write a frame that goes to the device."""
        self._write(lambda: self._writer.sent(frame, at), at)

    def waited(self, until: HostNs) -> None:
        """Write that the driver gave up waiting."""
        self._write(lambda: self._writer.waited(until), until)

    def stepped(self, by_ns: int, at: HostNs) -> None:
        """Write that the driver was told that the host's clock was set."""
        self._write(lambda: self._writer.stepped(by_ns, at), at)

    def close(self) -> None:
        """Write what is left and close the file; may be called more than once."""
        if self._is_open:
            self._is_open = False
            try:
                self._file.close()
            except OSError as error:
                self._fail(error)

    def _write(self, write: Callable[[], None], now: HostNs) -> None:
        if not self._is_open:
            return
        try:
            write()
            self.octets = self._file.tell()
            if not 0 <= now - self._flushed < _FLUSH_NS:
                self._flushed = now
                self._file.flush()
        except OSError as error:
            self._is_open = False
            # Closing tries to write the rest once more.
            with contextlib.suppress(OSError):
                self._file.close()
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        self._on_error(f"recording to {self.path} ended: {error.strerror}")


def free_name(path: Path) -> Path:
    """Return the path, or if there is such a file the first free one with ``-1``, ``-2`` added."""
    number = 0
    free = path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return free


def endpoints(network: NetworkConfig) -> tuple[Endpoint, Endpoint]:
    """Return the device's end and this host's as they look on the network."""
    device = Endpoint(network.l2_ip, network.l2_port)
    host_ip = network.host_ip
    if host_ip == "0.0.0.0":
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect(device)
                host_ip = probe.getsockname()[0]
            except OSError:
                host_ip = wire.HOST_IP
    return device, Endpoint(host_ip, network.host_port)
