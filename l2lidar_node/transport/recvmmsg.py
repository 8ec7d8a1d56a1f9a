"""Reads many datagrams in one system call, recvmmsg(2), with the kernel's arrival times.

Python's socket module takes one datagram in a call and raises when there is no more. A driver
that looks at its socket hundreds of times a second spends more on that than on the datagrams.
"""

from __future__ import annotations

import ctypes
import socket
import struct
import time
from typing import Final

from l2lidar_node.types import Datagram, new_tuple

SO_TIMESTAMPNS: Final = 35
"""Has the kernel note arrivals (asm-generic/socket.h); Python's socket module lacks it."""

MOST: Final = 64
"""Datagrams that one call takes at most."""

_WAIT_FOR_ONE: Final = 0x10000  # MSG_WAITFORONE: blocks for the first datagram alone
_LARGEST: Final = 65_536
# struct mmsghdr: name, its size, vectors, their number, control, its size, flags; octets received.
_HEADER: Final = struct.Struct("@PIPNPNi0PI0P")
_FILLED: Final = struct.Struct(f"@{struct.calcsize('@PIPNP0N')}xNi0PI0P")  # from control's size on
_VECTOR: Final = struct.Struct("@PN")
# struct sockaddr_in, of which the address counts, then a control message: its header and a struct
# timespec.
_ORIGIN: Final = struct.Struct("@4x4s8x16xll")
_NAME_SIZE: Final = 16
_CONTROL_SIZE: Final = _ORIGIN.size - _NAME_SIZE
# No power of two: the beginnings of all datagrams would share a few lines of the cache.
_STRIDE: Final = _LARGEST + 1_088

_recvmmsg = ctypes.CDLL(None).recvmmsg
_recvmmsg.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)


class DatagramReader:
    """Reads one sender's datagrams from a UDP socket.

    Parameters
    ----------
    link : socket
        Blocking, IPv4, with :data:`SO_TIMESTAMPNS` set. Its ``SO_RCVTIMEO`` bounds the wait.
    sender : str
        IPv4 address of the one sender to hear.

    Attributes
    ----------
    datagrams : list of Datagram
        Datagrams of the sender, in order; the reader replaces the list.
    strangers : list of bytes
        Packed addresses of the senders of all else, which is dropped; likewise.
    """

    def __init__(self, link: socket.socket, sender: str) -> None:
        self.datagrams: list[Datagram] = []
        self.strangers: list[bytes] = []
        self._link = link
        self._sender = socket.inet_aton(sender)
        self._payloads = bytearray(MOST * _STRIDE)  # what no datagram needs is never touched
        self._origins = bytearray(MOST * _ORIGIN.size)
        vectors = bytearray(MOST * _VECTOR.size)
        headers = bytearray(MOST * _HEADER.size)
        payloads, origins, at = map(_address, (self._payloads, self._origins, vectors))
        for number in range(MOST):
            vector = number * _VECTOR.size
            _VECTOR.pack_into(vectors, vector, payloads + number * _STRIDE, _LARGEST)
            name = origins + number * _ORIGIN.size
            _HEADER.pack_into(
                headers, number * _HEADER.size,
                name, _NAME_SIZE, at + vector, 1, name + _NAME_SIZE, _CONTROL_SIZE, 0, 0,
            )  # fmt: skip
        self._vectors = vectors
        self._headers = headers
        self._fresh = bytes(headers)  # the kernel writes sizes into what it is given
        self._at = _address(headers)
        whole = memoryview(self._payloads)
        self._slots = [whole[at : at + _LARGEST] for at in range(0, len(whole), _STRIDE)]

    def read(self, *, wait: bool = True) -> int:
        """Add what has arrived to :attr:`datagrams`; return how many were taken.

        Waits for the first one as long as ``SO_RCVTIMEO`` says, unless told not to. None are taken
        as well when all there was is an ICMP error of an earlier send.
        """
        flags = _WAIT_FOR_ONE if wait else socket.MSG_DONTWAIT
        count: int = _recvmmsg(self._link.fileno(), self._at, MOST, flags, None)
        if count <= 0:
            return 0
        used = count * _HEADER.size
        taken = zip(
            _FILLED.iter_unpack(self._headers[:used]),
            _ORIGIN.iter_unpack(self._origins[: count * _ORIGIN.size]),
            self._slots,
            strict=False,
        )
        for (told, _, size), (address, seconds, nanoseconds), slot in taken:
            if address != self._sender:
                self.strangers.append(address)
                continue
            arrival = seconds * 1_000_000_000 + nanoseconds if told else time.time_ns()
            self.datagrams.append(new_tuple(Datagram, (bytes(slot[:size]), arrival)))
        self._headers[:used] = self._fresh[:used]
        return count


def _address(memory: bytearray) -> int:
    return ctypes.addressof(ctypes.c_char.from_buffer(memory))
