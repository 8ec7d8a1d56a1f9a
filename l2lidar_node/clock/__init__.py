"""Maps device stamps to host stamps.

The device's clock runs at an unknown rate near half speed, is stepped by every sync and restarts
at 0 with the device. :class:`DeviceClock` takes every packet's stamp, sequence number and arrival
and returns the host instant of the stamp. ``docs/clock.md`` explains how, and how well.
"""

from l2lidar_node.clock.device_clock import (
    UNCERTAIN_NS,
    ClockEvent,
    ClockEventKind,
    ClockStatus,
    DeviceClock,
)

__all__ = ["UNCERTAIN_NS", "ClockEvent", "ClockEventKind", "ClockStatus", "DeviceClock"]
