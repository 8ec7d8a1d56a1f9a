"""Takes what waits at a subscription ahead of the executor, which gives one message at a time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from rclpy.subscription import Subscription

# A node that is held up for some seconds catches up at once: better late than a hole in the map.
CLOUD_DEPTH: Final = 30
IMU_DEPTH: Final = 2000


def waiting(subscription: Subscription, limit: int) -> Iterator[Any]:
    """Yield the messages that wait, at most ``limit``.

    The executor takes one message of every topic in turn. A node that has fallen behind would
    so handle one IMU sample to a cloud, and every cloud before the samples that belong to it.
    """
    handle = subscription.handle
    with handle:
        for _ in range(limit):
            taken = handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                return
            yield taken[0]
