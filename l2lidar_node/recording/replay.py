"""Feeds a recording to a driver, which then hands out what the live one did, bit for bit."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.recording.recording import Entry, Received, Recording, Sent, Stepped
from l2lidar_node.types import HostNs, ImuSample, Sweep


def feed(driver: Driver, entry: Entry) -> list[Event]:
    """Return what an entry of a recording makes a driver hand out."""
    if isinstance(entry, Received):
        return driver.receive(entry.data, entry.time)
    if isinstance(entry, Sent):
        return driver.sent(entry.command, entry.time)
    if isinstance(entry, Stepped):
        return driver.host_stepped(entry.by_ns, entry.time)
    return driver.settle(entry.time)


def events(recording: Recording, config: DriverConfig) -> Iterator[Event]:
    """Yield everything a driver hands out for a recording, in order.

    Parameters
    ----------
    recording : Recording
    config : DriverConfig
        The settings of the live run give what it gave; others decode the same data otherwise.
    """
    driver = Driver(config)
    for entry in recording:
        yield from feed(driver, entry)
    yield from driver.flush()


def shifted(event: Event, by_ns: int) -> Event:
    """Return an event as if it had happened that much later."""
    if isinstance(event, Sweep):
        return dataclasses.replace(
            event, start=HostNs(event.start + by_ns), end=HostNs(event.end + by_ns)
        )
    if isinstance(event, ImuSample):
        return event._replace(stamp=HostNs(event.stamp + by_ns))
    return event
