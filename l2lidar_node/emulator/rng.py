"""Random numbers by packet, independent of which packets are requested together."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """Purpose of the numbers; each has its own stream, so switching one off changes no other."""

    HEAD = 1
    STATE = 2
    RANGE = 3
    RETURN = 4
    IMU = 5
    MOTION = 6
    UNIT = 7
    POWER_UP = 8


def generator(seed: int, stream: Stream, index: int) -> np.random.Generator:
    """Return the generator of one packet, sample block or other numbered thing.

    Counter-based (Philox): independent of every other index and made in microseconds.

    Parameters
    ----------
    seed : int
        Seed of the whole emulator, 0 to 2**64 - 1.
    stream : Stream
        What the numbers are for.
    index : int
        Number of the packet, 0 to 2**63 - 1.
    """
    key = np.array([seed, stream], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=[0, 0, 0, index]))
