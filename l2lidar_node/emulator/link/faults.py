"""Faults of the link: damaged, lost, late and reordered datagrams."""

from __future__ import annotations

import heapq
import zlib
from collections.abc import Callable, Sequence
from typing import Final, Protocol

import numpy as np

from l2lidar_node.emulator.config import FaultConfig
from l2lidar_node.emulator.truth import JUNK, Datagram, Fault, PacketLog, Piece
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import PacketType

Damage = Callable[[bytes, np.random.Generator], bytes | None]
"""Frame and randomness in, damaged frame out; None where this damage is not possible."""

HOSTILE_SIZES: Final = (12, 24, 10001, 0xFFFF_FFFF)
_VITAL: Final = {
    PacketType.POINTS_3D: (
        "com_horizontal_angle_start",
        "com_horizontal_angle_step",
        "range_min",
        "range_max",
        "angle_min",
        "angle_increment",
        "time_increment",
    ),
    PacketType.POINTS_2D: (
        "range_min",
        "range_max",
        "angle_min",
        "angle_increment",
        "time_increment",
    ),
    PacketType.IMU: ("quaternion_wxyz", "angular_velocity", "linear_acceleration"),
}
"""Floats without which a measurement is worth nothing; for points also the calibration block."""


def flip_bit(frame: bytes, random: np.random.Generator) -> bytes:
    """Flip one bit of the payload."""
    damaged = bytearray(frame)
    at = int(random.integers(wire.HEADER.size, len(frame) - wire.TAIL.size))
    damaged[at] ^= 1 << int(random.integers(8))
    return bytes(damaged)


def truncate(frame: bytes, random: np.random.Generator) -> bytes:
    """Cut off the end, at least CRC and tail: tails are alike, others might complete it."""
    return frame[: int(random.integers(1, len(frame) - wire.TAIL.size + 1))]


def hostile_size(frame: bytes, random: np.random.Generator) -> bytes:
    """Replace the size field by one of :data:`HOSTILE_SIZES`."""
    size = HOSTILE_SIZES[int(random.integers(len(HOSTILE_SIZES)))]
    return frame[:8] + size.to_bytes(4, "little") + frame[12:]


def hostile_count(frame: bytes, random: np.random.Generator) -> bytes | None:
    """Claim one point more than there is room for, or 2^32-1 points; points only."""
    packet_type = _type(frame)
    if packet_type not in (PacketType.POINTS_3D, PacketType.POINTS_2D):
        return None
    payload = np.frombuffer(_payload(frame), wire.PAYLOADS[packet_type]).copy()
    room = payload.dtype["ranges"].shape[0]
    payload["point_num"] = (room + 1, 0xFFFF_FFFF)[int(random.integers(2))]
    return _sealed(frame, payload.tobytes())


def not_a_number(frame: bytes, random: np.random.Generator) -> bytes | None:
    """Make one float of a measurement NaN or infinite; points and IMU only."""
    packet_type = _type(frame)
    if packet_type not in _VITAL:
        return None
    payload = np.frombuffer(_payload(frame), wire.PAYLOADS[packet_type]).copy()
    names = list(_VITAL[PacketType(packet_type)])
    block = payload
    if packet_type != PacketType.IMU:
        names += list(wire.CALIBRATION.names or ())
    name = names[int(random.integers(len(names)))]
    if name not in (payload.dtype.names or ()):
        block = payload["calibration"]
    column = block[name].reshape(-1)
    column[int(random.integers(len(column)))] = (np.nan, np.inf, -np.inf)[int(random.integers(3))]
    return _sealed(frame, payload.tobytes())


DAMAGES: Final[dict[Fault, Damage]] = {
    Fault.BAD_CRC: flip_bit,
    Fault.TRUNCATE: truncate,
    Fault.HOSTILE_SIZE: hostile_size,
    Fault.HOSTILE_COUNT: hostile_count,
    Fault.NAN: not_a_number,
}
"""Damage by fault, in the order in which they are applied."""


def junk(random: np.random.Generator) -> bytes:
    """Return bytes that are no packet, at times ending in the beginning of one."""
    noise = random.bytes(int(random.integers(1, 200)))
    endings = (
        b"",
        wire.MAGIC[:1],
        wire.MAGIC,
        wire.HEADER.pack(wire.MAGIC, PacketType.POINTS_3D, wire.FRAME_SIZES[PacketType.POINTS_3D]),
    )
    return noise.replace(wire.MAGIC[:1], b"\x00") + endings[int(random.integers(len(endings)))]


def _type(frame: bytes) -> int:
    return int.from_bytes(frame[4:8], "little")


def _payload(frame: bytes) -> bytes:
    return frame[wire.HEADER.size : -wire.TAIL.size]


def _sealed(frame: bytes, payload: bytes) -> bytes:
    """Return a frame with another payload and the CRC that belongs to it."""
    crc = zlib.crc32(payload).to_bytes(4, "little")
    return frame[: wire.HEADER.size] + payload + crc + frame[len(frame) - wire.TAIL.size + 4 :]


_MS: Final = 1_000_000
_S: Final = 1_000_000_000
_LONGEST_WAIT_NS: Final = (
    10 * _MS
)  # a packet waits no longer for company than the next two would take
_HEAVY_MEDIAN: Final = 9.0  # (u^-1/2 - 1) / 9 is 1 at the 99th percentile
_HEAVY_LIMIT: Final = 5.0  # largest delay in units of that percentile


class Stage(Protocol):
    """A processing stage for datagrams."""

    def __call__(self, datagrams: Sequence[Datagram], now_ns: int) -> list[Datagram]:
        """Return the datagrams processed until ``now_ns``; none gets earlier."""
        ...


class Dice:
    """Decides when a random fault strikes; independent of every other fault, reproducible by seed.

    Parameters
    ----------
    fault : Fault
    rate : float
        Probability per datagram.
    config : FaultConfig
        States from when until when.
    origin_ns : int
        True instant from which those times count.
    seed : int
    packet_log : PacketLog
        Where strikes are logged.
    """

    def __init__(
        self,
        fault: Fault,
        rate: float,
        config: FaultConfig,
        origin_ns: int,
        seed: int,
        packet_log: PacketLog,
    ) -> None:
        name = zlib.crc32((fault.name or "").encode())
        self._chance = np.random.default_rng([seed, name, 0])
        self.random = np.random.default_rng([seed, name, 1])
        self._fault = fault
        self._rate = rate
        self._from_ns = origin_ns + round(config.fault_from_s * _S)
        self._until_ns = origin_ns + round(config.fault_until_s * _S)
        self._packet_log = packet_log

    def is_on(self, time_ns: int) -> bool:
        """Whether random faults may happen at a true instant."""
        return self._from_ns <= time_ns < self._until_ns

    def strikes(self, datagram: Datagram) -> bool:
        """Throw for one datagram."""
        return float(self._chance.random()) < self._rate and self.is_on(datagram.time_ns)

    def note(self, datagram: Datagram) -> None:
        """Log that the fault struck a datagram."""
        self._packet_log.note(datagram.time_ns, self._fault, datagram)


def damage(dice: Dice, do: Damage) -> Stage:
    """Return a stage that damages single packets."""

    def stage(datagrams: Sequence[Datagram], now_ns: int) -> list[Datagram]:
        return [hit(item) if dice.strikes(item) else item for item in datagrams]

    def hit(datagram: Datagram) -> Datagram:
        (piece,) = datagram.pieces
        data = do(datagram.data, dice.random) if piece.intact else None
        if data is None:
            return datagram
        dice.note(datagram)
        broken = Piece(piece.row, 0, len(data), len(data), intact=False)
        return Datagram(datagram.time_ns, data, (broken,))

    return stage


def garbage(dice: Dice) -> Stage:
    """Return a stage that puts a datagram of junk before some packets."""

    def stage(datagrams: Sequence[Datagram], now_ns: int) -> list[Datagram]:
        out: list[Datagram] = []
        for datagram in datagrams:
            if dice.strikes(datagram):
                data = junk(dice.random)
                piece = Piece(JUNK, 0, len(data), len(data), intact=False)
                out.append(Datagram(datagram.time_ns, data, (piece,)))
                dice.note(out[-1])
            out.append(datagram)
        return out

    return stage


class Coalesce:
    """Stage that lets a packet wait for the next and share its datagram, up to 1472 bytes."""

    def __init__(self, dice: Dice) -> None:
        self._dice = dice
        self._held: Datagram | None = None

    def __call__(self, datagrams: Sequence[Datagram], now_ns: int) -> list[Datagram]:
        """Return joined datagrams; see :class:`Stage`."""
        out: list[Datagram] = []
        for datagram in datagrams:
            out += self._join(datagram)
        if self._held is not None and now_ns - self._held.time_ns > _LONGEST_WAIT_NS:
            out.append(self._held._replace(time_ns=now_ns))
            self._held = None
        return out

    def _join(self, datagram: Datagram) -> list[Datagram]:
        out: list[Datagram] = []
        if self._held is not None:
            if len(self._held.data) + len(datagram.data) <= wire.MAX_DATAGRAM:
                datagram = self._held.join(datagram)
                self._dice.note(datagram)
            else:
                out.append(self._held._replace(time_ns=datagram.time_ns))
            self._held = None
        if self._dice.strikes(datagram):
            self._held = datagram
        else:
            out.append(datagram)
        return out


def split(dice: Dice) -> Stage:
    """Return a stage that cuts datagrams in two at a random byte."""

    def stage(datagrams: Sequence[Datagram], now_ns: int) -> list[Datagram]:
        out: list[Datagram] = []
        for datagram in datagrams:
            if len(datagram.data) > 1 and dice.strikes(datagram):
                dice.note(datagram)
                out += datagram.cut(int(dice.random.integers(1, len(datagram.data))))
            else:
                out.append(datagram)
        return out

    return stage


def fragment(datagrams: Sequence[Datagram], now_ns: int) -> list[Datagram]:
    """Split packets too long for one datagram, as the unit itself does; not a fault."""
    return [part for datagram in datagrams for part in datagram.fragments()]


def lose(dice: Dice) -> Stage:
    """Return a stage that swallows datagrams."""

    def stage(datagrams: Sequence[Datagram], now_ns: int) -> list[Datagram]:
        lost = [dice.strikes(item) for item in datagrams]
        for datagram, is_lost in zip(datagrams, lost, strict=True):
            if is_lost:
                dice.note(datagram)
        return [item for item, is_lost in zip(datagrams, lost, strict=True) if not is_lost]

    return stage


def duplicate(dice: Dice) -> Stage:
    """Return a stage that delivers datagrams twice."""

    def stage(datagrams: Sequence[Datagram], now_ns: int) -> list[Datagram]:
        out: list[Datagram] = []
        for datagram in datagrams:
            out.append(datagram)
            if dice.strikes(datagram):
                dice.note(datagram)
                out.append(datagram)
        return out

    return stage


def delay(dice: Dice, width_ns: int, heavy: bool) -> Stage:
    """Return a stage that delays datagrams by random times and keeps their order, as a queue."""
    last_ns = 0

    def stage(datagrams: Sequence[Datagram], now_ns: int) -> list[Datagram]:
        nonlocal last_ns
        out: list[Datagram] = []
        for datagram in datagrams:
            u = 1.0 - float(dice.random.random())
            share = min((u**-0.5 - 1.0) / _HEAVY_MEDIAN, _HEAVY_LIMIT) if heavy else u
            late_ns = round(share * width_ns) if dice.is_on(datagram.time_ns) else 0
            last_ns = max(last_ns, datagram.time_ns + late_ns)
            out.append(datagram._replace(time_ns=last_ns))
        return out

    return stage


def burst(dice: Dice, origin_ns: int, every_ns: int, width_ns: int) -> Stage:
    """Return a stage that withholds datagrams for a while in every period, then lets them go."""

    def stage(datagrams: Sequence[Datagram], now_ns: int) -> list[Datagram]:
        out: list[Datagram] = []
        for datagram in datagrams:
            phase_ns = (datagram.time_ns - origin_ns) % every_ns
            wait_ns = width_ns - phase_ns
            if wait_ns > 0 and dice.is_on(datagram.time_ns):
                dice.note(datagram)
                datagram = datagram._replace(time_ns=datagram.time_ns + wait_ns)
            out.append(datagram)
        return out

    return stage


def overtake(dice: Dice, late_ns: int) -> Stage:
    """Return a stage that delays some datagrams so that later ones arrive before them."""

    def stage(datagrams: Sequence[Datagram], now_ns: int) -> list[Datagram]:
        out: list[Datagram] = []
        for datagram in datagrams:
            if dice.strikes(datagram):
                dice.note(datagram)
                datagram = datagram._replace(time_ns=datagram.time_ns + late_ns)
            out.append(datagram)
        return out

    return stage


def silence(packet_log: PacketLog, is_silent: Callable[[int], bool]) -> Stage:
    """Return a stage that swallows everything while the cable is pulled."""

    def stage(datagrams: Sequence[Datagram], now_ns: int) -> list[Datagram]:
        out: list[Datagram] = []
        for datagram in datagrams:
            if is_silent(datagram.time_ns):
                packet_log.note(datagram.time_ns, Fault.SILENCE, datagram)
            else:
                out.append(datagram)
        return out

    return stage


def stages(config: FaultConfig, origin_ns: int, seed: int, packet_log: PacketLog) -> list[Stage]:
    """Return the stages that a configuration asks for, in the order in which datagrams pass them.

    Damage comes before joining and cutting, loss after it, and whatever changes times last.
    """

    def dice(fault: Fault, rate: float = 1.0) -> Dice:
        return Dice(fault, rate, config, origin_ns, seed, packet_log)

    out: list[Stage] = []
    rates = {
        Fault.BAD_CRC: config.bad_crc,
        Fault.TRUNCATE: config.truncate,
        Fault.HOSTILE_SIZE: config.hostile_size,
        Fault.HOSTILE_COUNT: config.hostile_count,
        Fault.NAN: config.nan,
    }
    out += [damage(dice(fault, rates[fault]), do) for fault, do in DAMAGES.items() if rates[fault]]
    if config.garbage:
        out.append(garbage(dice(Fault.GARBAGE, config.garbage)))
    if config.coalesce:
        out.append(Coalesce(dice(Fault.COALESCE, config.coalesce)))
    if config.split:
        out.append(split(dice(Fault.SPLIT, config.split)))
    out.append(fragment)
    if config.loss:
        out.append(lose(dice(Fault.LOSS, config.loss)))
    if config.silence_at:
        out.append(silence(packet_log, lambda time_ns: is_silent(config, time_ns - origin_ns)))
    if config.duplicate:
        out.append(duplicate(dice(Fault.DUPLICATE, config.duplicate)))
    if config.jitter != "none":
        heavy = config.jitter == "heavy"
        out.append(delay(dice(Fault.JITTER), round(config.jitter_ms * _MS), heavy))
    if config.burst_ms:
        every_ns, width_ns = round(config.burst_every_s * _S), round(config.burst_ms * _MS)
        out.append(burst(dice(Fault.BURST), origin_ns, every_ns, width_ns))
    if config.reorder:
        out.append(overtake(dice(Fault.REORDER, config.reorder), round(config.reorder_ms * _MS)))
    return out


def is_silent(config: FaultConfig, since_power_on_ns: int) -> bool:
    """Whether the cable is pulled at a time after power-on."""
    t_s = since_power_on_ns / _S
    return any(at <= t_s < at + config.silence_s for at in config.silence_at)


class Path:
    """Passes datagrams through the stages and holds those that are not due.

    Parameters
    ----------
    stages : sequence of Stage
        Passed in this order.
    packet_log : PacketLog
        Learns what reaches the host.
    """

    def __init__(self, stages: Sequence[Stage], packet_log: PacketLog) -> None:
        self._stages = stages
        self._packet_log = packet_log
        self._waiting: list[tuple[int, int, Datagram]] = []
        self._count = 0

    @property
    def next_ns(self) -> int | None:
        """True instant at which the next datagram arrives; None when none is on its way."""
        return self._waiting[0][0] if self._waiting else None

    def send(self, datagrams: Sequence[Datagram], now_ns: int) -> None:
        """Put datagrams on their way, one whole packet each, in order of time.

        Call it also with none as time goes by: a stage may hold something back.
        """
        for stage in self._stages:
            datagrams = stage(datagrams, now_ns)
        for datagram in datagrams:
            heapq.heappush(self._waiting, (datagram.time_ns, self._count, datagram))
            self._count += 1

    def arrivals(self, now_ns: int) -> list[Datagram]:
        """Return the new datagrams that arrive until a true time, in time order."""
        out: list[Datagram] = []
        while self._waiting and self._waiting[0][0] <= now_ns:
            out.append(heapq.heappop(self._waiting)[2])
        self._packet_log.arrived(out)
        return out
