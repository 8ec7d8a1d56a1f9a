"""Counts everything that can go right or wrong between the socket and a sweep."""

from __future__ import annotations

import dataclasses
from collections import Counter
from dataclasses import dataclass, field

from l2lidar_node.driver.reorder import SequenceCounts
from l2lidar_node.types import Stream


@dataclass(slots=True)
class Counters:
    """Everything that was counted since the start.

    Attributes
    ----------
    datagrams, octets : int
        What came from the device.
    frames : Counter
        Good frames by packet type; 0 stands for every type that is not known.
    faults : Counter
        Damaged frames by kind, see :class:`l2lidar_node.protocol.framing.Fault`.
    skipped_octets : int
        Bytes that belonged to no good frame.
    rejected : Counter
        Good frames with impossible content, by ``<packet type>.<reason>``.
    sequence : dict
        Counts of :class:`SequenceCounts` by stream.
    unlocked : Counter
        Packets not used because the clock could not tell their time yet, by stream.
    ignored_points : int
        Packets of the dimension (2D or 3D) that was not asked for.
    sweeps, empty_sweeps, samples : int
        What was made; an empty sweep has no valid point and is not published.
    fragments, fragment_packets : int
        Parts of a turn or half turn that were not made into a sweep, and their packets.
    points : int
        Points in all sweeps.
    slots : int
        Slots measured in all sweeps, with a return or without.
    stray_acks : int
        ACKs that belong to no command that waits for one.
    unlevelled : int
        Points left out because ``imu_adjust`` had no orientation for them.
    """

    datagrams: int = 0
    octets: int = 0
    frames: Counter[int] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    skipped_octets: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    sequence: dict[Stream, SequenceCounts] = field(default_factory=dict)
    unlocked: Counter[Stream] = field(default_factory=Counter)
    ignored_points: int = 0
    sweeps: int = 0
    empty_sweeps: int = 0
    fragments: int = 0
    fragment_packets: int = 0
    samples: int = 0
    points: int = 0
    slots: int = 0
    stray_acks: int = 0
    unlevelled: int = 0

    def snapshot(self) -> Counters:
        """Return a copy that does not change any more."""
        return dataclasses.replace(
            self,
            frames=Counter(self.frames),
            faults=Counter(self.faults),
            rejected=Counter(self.rejected),
            unlocked=Counter(self.unlocked),
            sequence={key: dataclasses.replace(value) for key, value in self.sequence.items()},
        )
