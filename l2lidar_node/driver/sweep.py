"""Sweep assembly: groups point packets by count, head angle or duration, with a size limit.

Each packet is placed by the calibration block to use: the unit's own, a file's, or parameters'.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.calibration.file import CalibrationFile, CalibrationFileError, load
from l2lidar_node.config import FileConfig, SweepConfig
from l2lidar_node.driver.geometry import Projector, RangeCalibration, RangeLimits
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.packets import NS, PointPacket
from l2lidar_node.settings import SettingError
from l2lidar_node.types import HostNs, Sweep, new_tuple

UNIT: Final = "unit"
PARAMETER: Final = "parameter"

_ANGLES: Final = {
    "alpha_angle_bias": "alpha_angle_bias",
    "beta_angle": "beta_angle",
    "xi_angle": "xi_angle",
    "theta_angle_bias": "theta_angle_bias",
    "b_axis_dist": "b_axis_dist",
}
"""Entries of a block by the field of the setting that replaces them."""
_RANGES: Final = {"range_scale": "range_scale", "range_bias": "range_bias"}
_REMEMBERED: Final = 16


def calibration_file(config: FileConfig) -> CalibrationFile | None:
    """Return the file that the settings name, None if they name none.

    Raises
    ------
    SettingError
        If it cannot be used.
    """
    if not config.calibration_file:
        return None
    try:
        return load(Path(config.calibration_file))
    except CalibrationFileError as error:
        raise SettingError(f"parameter 'calibration_file': {error}") from None


class BlockChoice:
    """Chooses between the calibration block that a unit reports and its correction.

    Parameters win over the file, the file over the unit. Recordings keep what the unit reports.

    Parameters
    ----------
    config : SweepConfig
        May be replaced while running through :meth:`configure`.
    file : CalibrationFile, optional
    """

    def __init__(self, config: SweepConfig, file: CalibrationFile | None = None) -> None:
        self.file = file
        self.configure(config)

    def configure(self, config: SweepConfig) -> None:
        """Use other parameters from now on."""
        self._config = config
        self._known: dict[bytes, bytes] = {}
        self._replaced = _ANGLES if config.override_angle_calibration else {}

    @property
    def is_needed(self) -> bool:
        """Whether any block might be replaced."""
        return self.file is not None or bool(self._replaced)

    def used(self, reported: bytes) -> bytes:
        """Return the 32 bytes to use for a packet that reports these.

        ``EnableCalRangeOVR`` is not in them: it acts on the ranges themselves.
        """
        found = self._known.get(reported)
        if found is None:
            found = reported if self.file is None else self.file.corrected(reported)
            if self._replaced:
                record = np.frombuffer(found, wire.CALIBRATION, 1).copy()
                for field, name in self._replaced.items():
                    record[name] = getattr(self._config, field)
                found = record.tobytes()
            if len(self._known) >= _REMEMBERED:
                self._known.clear()
            self._known[reported] = found
        return found

    def values(self, reported: bytes) -> dict[str, float]:
        """Return the values in use by name, including the range parameters."""
        record = np.frombuffer(self.used(reported), wire.CALIBRATION, 1)[0]
        values = {name: float(record[name]) for name in wire.CALIBRATION.names or ()}
        if self._config.override_range_calibration:
            values |= {name: getattr(self._config, field) for field, name in _RANGES.items()}
        return values

    def sources(self, reported: bytes) -> dict[str, str]:
        """Return where each entry that is used comes from: unit, a file's path, or parameter."""
        found = dict.fromkeys(wire.CALIBRATION.names or (), UNIT)
        if self.file is not None and self.file.matches(reported):
            found |= dict.fromkeys(self.file.correction, self.file.path)
        found |= dict.fromkeys(self._replaced.values(), PARAMETER)
        if self._config.override_range_calibration:
            found |= dict.fromkeys(_RANGES.values(), PARAMETER)
        return found


MAX_GAP_NS: Final = 200_000_000  # a stream that stalled this long starts a new sweep
MAX_PACKETS: Final = 4000
_UNEVEN: Final = 1.1  # one step of the head in another, at most: jitter of 1 %, and a wobble
_TURNS: Final = {"turn": 2 * math.pi, "half_turn": math.pi}  # [rad]
_BACKWARDS_RAD: Final = 1.9 * math.pi  # a head that stands still seems to advance by this or more

Level = Callable[[list[HostNs]], NDArray[np.float64]]


class _Placed(NamedTuple):
    """A packet and its position in the sweep."""

    packet: PointPacket
    given: HostNs  # its start as it was pushed
    start: HostNs  # not before the end of the packet before


class _Cut(Enum):
    """Whether a sweep ends before a packet, and why."""

    NONE = "none"
    BOUNDARY = "boundary"  # of the kind that was asked for
    BREAK = "break"  # a gap, a step of the clock, another kind of packet


# To look up a member of an Enum takes long.
_NONE, _BOUNDARY, _BREAK = _Cut.NONE, _Cut.BOUNDARY, _Cut.BREAK
_POINTS_3D: Final = wire.PacketType.POINTS_3D


class SweepAssembler:
    """Collects packets with host stamps and makes a sweep of them when it is complete.

    Parameters
    ----------
    config : SweepConfig
        How sweeps are cut; may be replaced while running through :meth:`configure`.
    level : callable, optional
        Returns a rotation for the start of every packet of a sweep, by which its points are turned
        into a leveled frame: shape (P, 3, 3), NaN for packets that cannot be.
    blocks : BlockChoice, optional
        Which calibration blocks to use; those that the unit reports if left out.

    Attributes
    ----------
    unleveled : int
        Points left out because their packet could not be leveled.
    fragments, fragment_packets : int
        Parts of a turn or half turn that were left out, and their packets: the first one after a
        start, a gap or a change of the cut, and the last one before a stop or a gap.
    """

    def __init__(
        self,
        config: SweepConfig,
        level: Level | None = None,
        blocks: BlockChoice | None = None,
    ) -> None:
        self.blocks = BlockChoice(config) if blocks is None else blocks
        self.unleveled = 0
        self.fragments = 0
        self.fragment_packets = 0
        self._begins_at_boundary = False
        self._follow(config)
        self._level = level
        self._packets: list[_Placed] = []
        self._missing = 0
        self._projectors = {
            int(kind): Projector(kind)
            for kind in (wire.PacketType.POINTS_3D, wire.PacketType.POINTS_2D)
        }

    def configure(self, config: SweepConfig, level: Level | None) -> None:
        """Use other settings from the next packet on."""
        if config.cut != self._config.cut:
            self._begins_at_boundary = False
        self._follow(config)
        self._level = level
        self.blocks.configure(config)

    def _follow(self, config: SweepConfig) -> None:
        self._config = config
        self._turn = _TURNS.get(config.cut, 0.0)
        self._most = max(config.packets, 1) if config.cut == "packets" else MAX_PACKETS

    @property
    def ends_at_pause(self) -> bool:
        """Whether the collected packets form a sweep if no more arrive.

        Part of a turn is not. It waits: packets that the network or a busy host held back go on
        where the ones before ended, and then the turn is whole. Their stamps tell.
        """
        return bool(self._packets) and not self._cuts_by_angle(self._packets[0].packet)

    @property
    def packets_left(self) -> int:
        """How many packets it takes to complete the sweep, at the least; 1 where that is open."""
        packets = self._packets
        if self._config.cut == "packets":
            return max(self._most - len(packets), 1)
        if len(packets) < 2:
            return 1
        before, last = packets[-2], packets[-1]
        if self._cuts_by_angle(last.packet):
            left = self._turn - last.packet.head_angle % self._turn
            step = (last.packet.head_angle - before.packet.head_angle) % (2 * math.pi)
        else:
            left = packets[0].given + self._config.duration_ms * 1_000_000 - last.given
            step = last.given - before.given
        return max(math.ceil(left / (_UNEVEN * step)), 1) if step > 0 else 1

    def push(self, packet: PointPacket, start: HostNs, missing: int = 0) -> list[Sweep]:
        """Add a packet and return the sweeps this completes: none, one or two.

        Parameters
        ----------
        packet : PointPacket
        start : HostNs
            Instant of its first slot.
        missing : int
            Packets the sequence numbers say are missing just before it.
        """
        sweeps: list[Sweep] = []
        placed = start
        cut = self._cut_before(packet, start) if self._packets else _BREAK
        if cut is not _NONE:
            if self._packets:
                sweeps += self._finish(cut)
            self._begins_at_boundary = cut is _BOUNDARY
        else:
            # A correction of the clock, or stamps of arrival in a burst, must not let a packet
            # begin before the previous one ended.
            last = self._packets[-1]
            placed = HostNs(max(start, last.start + last.packet.duration_ns))
            self._missing += missing
        self._packets.append(new_tuple(_Placed, (packet, start, placed)))
        if len(self._packets) >= self._most:
            sweeps += self._finish(_BREAK)
        return sweeps

    def flush(self) -> Sweep | None:
        """Return the packets collected so far as a sweep.

        None if that is nothing, or part of a turn or half turn.
        """
        if not self._packets:
            return None
        return next(iter(self._finish(_BREAK)), None)

    def _cuts_by_angle(self, packet: PointPacket) -> bool:
        """Whether the head's angle ends sweeps; 2D packets have none."""
        return self._turn > 0.0 and packet.packet_type == _POINTS_3D

    def _cut_before(self, packet: PointPacket, start: HostNs) -> _Cut:
        first, last = self._packets[0], self._packets[-1]
        if packet.packet_type != last.packet.packet_type:
            return _BREAK
        if start - last.given > MAX_GAP_NS or start < last.given:
            return _BREAK
        if self._config.cut == "packets":
            return _NONE
        if self._cuts_by_angle(packet):
            is_over = _passes(last.packet.head_angle, packet.head_angle, self._turn)
        else:
            is_over = start - first.given >= self._config.duration_ms * 1_000_000
        return _BOUNDARY if is_over else _NONE

    def _finish(self, end: _Cut) -> list[Sweep]:
        """Return the collected packets as one sweep; None if they are part of a turn.

        LIO-SAM takes its first cloud for a key frame and crashes on one that is too small.
        """
        packets, self._packets = self._packets, []
        missing, self._missing = self._missing, 0
        is_whole = self._begins_at_boundary and end is _Cut.BOUNDARY
        if self._cuts_by_angle(packets[0].packet) and not is_whole:
            self.fragments += 1
            self.fragment_packets += len(packets)
            return []
        starts = [placed.start for placed in packets]
        epoch = starts[0]
        config = self._config
        batch = self._projectors[packets[0].packet.packet_type].points(
            [placed.packet.payload for placed in packets],
            np.array([start - epoch for start in starts]) / NS,
            RangeLimits(config.range_min, config.range_max),
            RangeCalibration(config.range_scale, config.range_bias)
            if config.override_range_calibration
            else None,
            None if self._level is None else self._level(starts),
            self.blocks.used if self.blocks.is_needed else None,
        )
        self.unleveled += batch.left_out
        batch.points.flags.writeable = False
        last = packets[-1]
        sweep = Sweep(
            start=HostNs(epoch + round(batch.first_s * NS)),
            end=HostNs(last.start + last.packet.duration_ns),
            points=batch.points,
            packets=len(packets),
            missing=missing,
        )
        return [sweep]


def _passes(before: float, after: float, period: float) -> bool:
    """Tell whether the head, which turns forwards, passed a multiple of ``period`` [rad] since.

    However many packets were lost in between, up to most of a turn.
    """
    before, after = before % (2 * math.pi), after % (2 * math.pi)
    if (after - before) % (2 * math.pi) > _BACKWARDS_RAD:
        return False
    return after < before or after // period > before // period
