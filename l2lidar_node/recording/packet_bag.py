"""Raw packets in bags: messages that contain small captures, read as one capture.

The driver's packet topic carries ``std_msgs/UInt8MultiArray``. The data of each message are a
whole pcap file of a twentieth of a second, written by the same code as a capture on disk: so what
is recorded of the topic holds everything that a capture holds, and opens in Wireshark.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Final

import numpy as np

from l2lidar_node.recording.capture import CaptureError, Endpoint, is_capture, is_capture_file
from l2lidar_node.recording.recording import Entry, RecordingWriter, written
from l2lidar_node.types import HostNs

PACKETS: Final = "std_msgs/msg/UInt8MultiArray"
PACKET_TOPIC: Final = "/l2lidar_node/packets"
HEADER_SIZE: Final = 24  # of a pcap file, before its first packet
_LONGEST_NS: Final = 50_000_000
_LARGEST: Final = 60_000  # [B]; one datagram of UDP


class PacketBatch:
    """Collects what a session's tap receives into small captures.

    Parameters
    ----------
    device, host : Endpoint
    """

    def __init__(self, device: Endpoint, host: Endpoint) -> None:
        self._ends = device, host
        self._begun: HostNs | None = None
        self._start()

    def _start(self) -> None:
        self._stream = io.BytesIO()
        self._writer = RecordingWriter(self._stream, *self._ends)
        self._begun = None

    def add(self, kind: str, *arguments: Any) -> None:
        """Append an entry.

        Parameters
        ----------
        kind : str
            Name of the writer's method: received, sent, waited, stepped, slewed.
        arguments
            Its arguments; the last one is the instant.

        Raises
        ------
        OSError
            If the instant is one that no capture can hold.
        """
        getattr(self._writer, kind)(*arguments)
        if self._begun is None:
            self._begun = HostNs(arguments[-1])

    def is_due(self, now: HostNs) -> bool:
        """Tell whether the batch should be published."""
        if self._begun is None:
            return False
        return not 0 <= now - self._begun < _LONGEST_NS or self._stream.tell() > _LARGEST

    def take(self) -> bytes:
        """Return the capture collected so far and begin the next; empty if there is nothing."""
        if self._begun is None:
            return b""
        data = self._stream.getvalue()
        self._start()
        return data


class PacketBag(io.RawIOBase):
    """The packets in a bag as the stream of one capture file.

    Those of all packet topics, in the order of the bag: several sensors are told apart as in any
    capture, by their addresses.

    Parameters
    ----------
    path : Path
        rosbag2 folder or MCAP file.

    Raises
    ------
    CaptureError
        If the bag cannot be read or holds no packets; while reading as well.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        from l2lidar_node.recording import bag  # rosbags is only needed here

        self._path = path
        self._why_unreadable = bag.why_unreadable
        self._is_open = False
        try:
            self._reader = bag.open_bag(path)
            self._reader.open()
            self._is_open = True
            self._topics = [c for c in self._reader.connections if c.msgtype == PACKETS]
        except Exception as error:  # of a damaged file, any byte may lead anywhere
            self.close()
            raise CaptureError(bag.why_unreadable(path, error)) from None
        self._chunks = self._captures()
        self._rest = b""
        self._at = 0
        if not self._fill():
            self.close()
            raise CaptureError(
                "no packets of an L2 in this bag: record the driver's packet topic, with "
                "publish_packets set to true"
            )

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True: one can go back to the beginning."""
        return True

    def tell(self) -> int:
        """Return how much has been read [B]."""
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go back to the beginning.

        Raises
        ------
        io.UnsupportedOperation
            For any other place.
        """
        if offset or whence != io.SEEK_SET:
            raise io.UnsupportedOperation("a bag can only be read from its beginning")
        self._chunks, self._rest, self._at = self._captures(), b"", 0
        return 0

    def read(self, size: int | None = -1) -> bytes:
        """Return the next ``size`` bytes, fewer at the end."""
        wanted = float("inf") if size is None or size < 0 else size
        parts = []
        while wanted > 0 and (self._rest or self._fill()):
            part = self._rest if wanted >= len(self._rest) else self._rest[: int(wanted)]
            self._rest = self._rest[len(part) :]
            wanted -= len(part)
            parts.append(part)
        found = b"".join(parts)
        self._at += len(found)
        return found

    def close(self) -> None:
        """Close the bag."""
        if self._is_open:
            self._is_open = False
            self._reader.close()
        super().close()

    def _fill(self) -> bool:
        self._rest = next(self._chunks, b"")
        return bool(self._rest)

    def _captures(self) -> Iterator[bytes]:
        """Yield a capture in pieces: one header, then packets."""
        is_first = True
        try:
            for connection, _, raw in self._reader.messages(self._topics) if self._topics else ():
                message: Any = self._reader.deserialize(raw, connection.msgtype)
                data = message.data.tobytes()
                if len(data) > HEADER_SIZE and is_capture(data[:4]):
                    yield data if is_first else data[HEADER_SIZE:]
                    is_first = False
        except Exception as error:
            raise CaptureError(self._why_unreadable(self._path, error)) from None


class PacketBagWriter:
    """A bag of raw packets, as the driver's packet topic; use it in a ``with``.

    Parameters
    ----------
    path : Path
    device, host : Endpoint
    topic : str

    Attributes
    ----------
    entries, messages : int
        What has been written.
    """

    def __init__(
        self, path: Path, device: Endpoint, host: Endpoint, topic: str = PACKET_TOPIC
    ) -> None:
        self.entries = self.messages = 0
        from l2lidar_node.recording.bag import BagFile  # rosbags is only needed here

        self._file = BagFile(path)
        self._topic = topic
        self._batch = PacketBatch(device, host)
        self._last = HostNs(0)

    def __enter__(self) -> PacketBagWriter:
        """Make the file."""
        self._file.__enter__()
        self._file.connect(self._topic, PACKETS, 100, reliable=True, latched=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Write the rest and finish the file."""
        if kind is None:
            self._write()
        self._file.__exit__(kind, error, trace)

    def add(self, entry: Entry) -> None:
        """Write an entry of a recording."""
        if self._batch.is_due(entry.time):
            self._write()
        kind, arguments = written(entry)
        self._batch.add(kind, *arguments)
        self._last = max(self._last, entry.time)  # a bag is read in the order of its times
        self.entries += 1

    def _write(self) -> None:
        data = self._batch.take()
        if not data:
            return
        types: Any = self._file.store.types
        layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
        message = types[PACKETS](layout=layout, data=np.frombuffer(data, np.uint8))
        self._file.write(self._topic, self._last, self._file.store.serialize_cdr(message, PACKETS))
        self.messages += 1


def open_packets(path: Path) -> BinaryIO:
    """Return the stream of a capture, or of the packets in a bag, as one capture.

    Raises
    ------
    OSError
        If the file cannot be opened.
    CaptureError
        If it is neither.
    """
    if path.is_dir() or (path.exists() and _is_bag(path)):
        return PacketBag(path)  # type: ignore[return-value]  # a stream, but for its class
    return path.open("rb")


def is_of_packets(path: Path) -> bool:
    """Tell whether a file is a capture, or a bag with raw packets and no clouds."""
    if is_capture_file(path) or not (path.is_dir() or _is_bag(path)):
        return is_capture_file(path)
    from l2lidar_node.recording import bag  # rosbags is only needed here

    try:
        with bag.open_bag(path) as reader:
            kinds = {connection.msgtype for connection in reader.connections}
    except Exception:  # of a damaged file; whoever reads it will say so
        return False
    return PACKETS in kinds and bag.CLOUD not in kinds


def _is_bag(path: Path) -> bool:
    return path.suffix in (".mcap", ".db3") and not is_capture_file(path)
