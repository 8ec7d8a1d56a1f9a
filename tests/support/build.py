"""Assembles packets, datagrams and captures from plain values: no test needs a sensor.

``python -m tests.support.build`` writes the digests of ``tests/l2lidar_node/data`` anew.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from l2lidar_node import settings
from l2lidar_node.config import NetworkConfig, SweepConfig
from l2lidar_node.driver.sweep import SweepAssembler
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.framing import Frame, Framer
from l2lidar_node.protocol.packets import PointPacket, decode
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.recording.recording import RecordingWriter, endpoints
from l2lidar_node.types import HostNs, Sweep

NS = 1_000_000_000
EPOCH_NS = 1_700_000_000 * NS  # where captures begin on the host's time line
RATIO = 1.99866  # true time passed per device time
PERIOD_NS = 4_639_000  # from one 3D packet to the next
IMU_PERIOD_NS = 4_000_000
SLOT_NS = 7_731.667  # scan period / 600
STEP_RAD = 2.114e-4  # head advance per slot
TURN_PACKETS = 49.53  # 3D packets per head turn
MODULUS = wire.SEQ_MODULUS

UNIT_A = {
    "a_axis_dist": 0.0445,
    "b_axis_dist": 0.006586,
    "theta_angle_bias": 2.0769,
    "alpha_angle_bias": 0.032398,
    "beta_angle": 0.003818,
    "xi_angle": 0.002945,
    "range_bias": -365.625,
    "range_scale": 0.000978,
}
UNIT_B = UNIT_A | {"alpha_angle_bias": 0.0395972, "beta_angle": 0.015708, "xi_angle": 0.00545415}
PLAIN = dict.fromkeys(UNIT_A, 0.0) | {"range_scale": 0.001}

STATE = {
    "sys_rotation_period": 4639,
    "com_rotation_period": 229769,
    "dirty_index": 0.0,
    "packet_lost_up": 0.0,
    "packet_lost_down": 0.0,
    "apd_temperature": 43.7,
    "apd_voltage": 154.16,
    "laser_voltage": 51.38,
    "imu_temperature": 60.8,
}

SHARED_DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
REAL_L2 = SHARED_DATA / "unitree_l2_static"
DIGESTS = Path(__file__).parents[1] / "l2lidar_node" / "data"


class Datagram(NamedTuple):
    """Bytes as they come from the device, and when."""

    arrival_ns: int
    data: bytes


def frame(packet_type: int, payload: bytes) -> bytes:
    """Return a good frame."""
    return wire.encode_frame(packet_type, payload)


def frames_3d(payloads: Iterable[bytes]) -> list[bytes]:
    return [frame(PacketType.POINTS_3D, payload) for payload in payloads]


def points_3d(
    seq: int = 0,
    stamp_ns: int = 0,
    *,
    theta: float = 0.0,
    step: float = STEP_RAD,
    ranges: ArrayLike = 3000,
    intensities: ArrayLike = 100,
    count: int = wire.POINTS_PER_3D_PACKET,
    calibration: Mapping[str, float] = UNIT_A,
    state: Mapping[str, float] = STATE,
    **fields: float,
) -> bytes:
    """Return the payload of a 3D packet; ``fields`` are further names of the layout."""
    return _points(
        wire.POINTS_3D_PAYLOAD, seq, stamp_ns, ranges, intensities, count, calibration, state,
        {
            "com_horizontal_angle_start": theta,
            "com_horizontal_angle_step": step,
            "angle_increment": np.pi / 300,
            "time_increment": SLOT_NS * 1e-9,
            **fields,
        },
    )  # fmt: skip


def points_2d(
    seq: int = 0,
    stamp_ns: int = 0,
    *,
    ranges: ArrayLike = 3000,
    intensities: ArrayLike = 100,
    count: int = wire.POINTS_PER_2D_PACKET,
    calibration: Mapping[str, float] = UNIT_A,
    state: Mapping[str, float] = STATE,
    **fields: float,
) -> bytes:
    """Return the payload of a 2D packet."""
    return _points(
        wire.POINTS_2D_PAYLOAD, seq, stamp_ns, ranges, intensities, count, calibration, state,
        {"angle_increment": np.pi / 1800, "time_increment": 5.4e-6, **fields},
    )  # fmt: skip


def _points(
    layout: np.dtype[np.void],
    seq: int,
    stamp_ns: int,
    ranges: ArrayLike,
    intensities: ArrayLike,
    count: int,
    calibration: Mapping[str, float],
    state: Mapping[str, float],
    fields: Mapping[str, float],
) -> bytes:
    block = np.zeros(1, layout)
    item: Any = block[0]
    item["info"] = (seq, layout.itemsize, *divmod(stamp_ns, NS))
    for group, values in (("state", state), ("calibration", calibration)):
        for name, value in values.items():
            item[group][name] = value
    common = {"scan_period": 0.004639, "range_min": 0.05, "range_max": 50.0}
    for name, value in (common | dict(fields)).items():
        item[name] = value
    item["point_num"] = count
    item["ranges"] = ranges
    item["intensities"] = intensities
    return block.tobytes()


def imu(
    seq: int = 0,
    stamp_ns: int = 0,
    *,
    quaternion_wxyz: Sequence[float] = (wire.QUATERNION_NORM, 0.0, 0.0, 0.0),
    rate: Sequence[float] = (0.0, 0.0, 0.0),
    acceleration: Sequence[float] = (0.0, 0.0, 9.81),
) -> bytes:
    """Return the payload of an IMU packet."""
    block = np.zeros(1, wire.IMU_PAYLOAD)
    info = (seq, wire.IMU_PAYLOAD.itemsize, *divmod(stamp_ns, NS))
    block[0] = (info, quaternion_wxyz, rate, acceleration)
    return block.tobytes()


def version(
    hardware: Sequence[int] = (2, 2, 1, 1),
    firmware: Sequence[int] = (2, 8, 11, 1),
    name: bytes = b"YS-L2",
    date: bytes = b"250715",
) -> bytes:
    """Return the payload of a version packet."""
    block = np.zeros(1, wire.VERSION_PAYLOAD)
    block[0] = (hardware, firmware, name, date, b"")
    return block.tobytes()


def ack(packet_type: int, command: int = 0, value: int = 0, status: int = 1) -> bytes:
    """Return the payload of an ACK."""
    return np.array([(packet_type, command, value, status)], wire.ACK_PAYLOAD).tobytes()


def parameters(work_mode: int = 0, range_min: float = 0.05, range_max: float = 50.0) -> bytes:
    """Return the payload of a parameter block."""
    block = np.zeros(1, wire.PARAMETERS_PAYLOAD)
    block["work_mode"], block["range_min"], block["range_max"] = work_mode, range_min, range_max
    return block.tobytes()


def to_device_ns(true_ns: int) -> int:
    """Return what the device's clock shows so long after it was switched on."""
    return round(true_ns / RATIO)


def capture(
    duration_s: float = 1.0,
    *,
    uptime_s: float = 100.0,
    latency_ns: int = 200_000,
    calibration: Mapping[str, float] = UNIT_A,
    imu_fields: Mapping[str, Sequence[float]] | None = None,
) -> list[Datagram]:
    """Return what a device in a round room sends: 3D and IMU packets, one to a datagram, in order.

    The device has been on for ``uptime_s`` at the first datagram, its clock has never been set.
    Ranges vary with angle and slot, every eleventh slot has no return. Without random numbers: it
    is the same on every machine.
    """
    power_on_ns = EPOCH_NS - round(uptime_s * NS)
    slots = np.arange(wire.POINTS_PER_3D_PACKET)
    sent: list[Datagram] = []
    for number in range(round(duration_s * NS / PERIOD_NS)):
        at = EPOCH_NS + number * PERIOD_NS
        theta = (2 * np.pi * number / TURN_PACKETS) % (2 * np.pi)
        ranges = 3365 + 1500 * np.sin(3 * theta + slots / 40) + (31 * number + 17 * slots) % 49
        ranges[slots % 11 == 5] = 0
        payload = points_3d(
            number % MODULUS,
            to_device_ns(at - power_on_ns),
            theta=theta,
            step=STEP_RAD * (1 + 0.01 * np.sin(theta)),
            ranges=np.round(ranges),
            intensities=(7 * number + 13 * slots) % 256,
            calibration=calibration,
        )
        left = at + round(300 * SLOT_NS) + latency_ns
        sent.append(Datagram(left, frame(PacketType.POINTS_3D, payload)))
    for number in range(round(duration_s * NS / IMU_PERIOD_NS)):
        at = EPOCH_NS + number * IMU_PERIOD_NS
        stamp = to_device_ns(at - power_on_ns)
        payload = imu(number % MODULUS, stamp, **(imu_fields or {}))
        sent.append(Datagram(at + latency_ns, frame(PacketType.IMU, payload)))
    return sorted(sent)


def cut(stream: bytes, sizes: Iterable[int]) -> Iterator[bytes]:
    """Yield the pieces of a byte stream, of the given sizes and then the rest."""
    at = 0
    for size in sizes:
        yield stream[at : at + size]
        at += size
    yield stream[at:]


class RealCapture(NamedTuple):
    """A recording of a real L2: its packets encoded anew, and the points they were recorded as.

    ``points`` has shape (packets, 300, 3), NaN where there was no return.
    """

    payloads: list[bytes]
    points: NDArray[np.float32]

    def datagrams(self) -> list[Datagram]:
        """Return the packets one to a datagram, at their true pace."""
        return [
            Datagram(EPOCH_NS + index * PERIOD_NS, data)
            for index, data in enumerate(frames_3d(self.payloads))
        ]


def write_capture(path: Path, datagrams: Sequence[Datagram], later_ns: int = 0) -> None:
    """Write datagrams as a capture, all of them so much later than they say."""
    with path.open("wb") as stream:
        writer = RecordingWriter(stream, *endpoints(NetworkConfig()))
        for item in datagrams:
            writer.received(item.data, HostNs(item.arrival_ns + later_ns))


def real_capture(number: int, packets: int | None = None) -> RealCapture:
    """Return a static capture of :data:`REAL_L2`, whole or its first packets.

    The recorded ranges are whole counts of the unit but for rounding: they become raw counts
    again, with the scale and the bias the unit had. The recorded angles include the biases; the
    packets carry the alpha bias as recorded, and the theta bias all units have.
    """
    facts = np.load(REAL_L2 / f"capture_{number:03}_packets.npz")
    recorded = np.load(REAL_L2 / f"capture_{number:03}.npy")
    ranges = facts["range_m"][:packets]
    kept = np.isfinite(ranges)
    points = np.full((*ranges.shape, 3), np.nan, np.float32)
    points[kept] = recorded[_matching(facts["range_m"], recorded, facts)][: np.count_nonzero(kept)]
    scale = float(facts["range_lsb_mm"]) / 1e3
    bias = float(facts["range_phase"]) - 365.0
    theta_bias = UNIT_A["theta_angle_bias"]
    calibration = {
        "a_axis_dist": float(facts["a_axis_dist"]),
        "b_axis_dist": float(facts["b_axis_dist"]),
        "theta_angle_bias": theta_bias,
        "alpha_angle_bias": np.radians(float(facts["alpha0_deg"])),
        "beta_angle": np.radians(float(facts["beta_deg"])),
        "xi_angle": np.radians(float(facts["xi_deg"])),
        "range_bias": bias,
        "range_scale": scale,
    }
    raw = np.where(kept, np.round(np.nan_to_num(ranges) / scale - bias), 0)
    payloads = [
        points_3d(
            index % MODULUS,
            to_device_ns(100 * NS + index * PERIOD_NS),
            theta=(np.radians(float(facts["theta_start_deg"][index])) - theta_bias) % (2 * np.pi),
            step=np.radians(float(facts["theta_step_deg"][index])),
            ranges=raw[index],
            calibration=calibration,
            angle_increment=np.radians(float(facts["alpha_step_deg"])),
        )
        for index in range(len(ranges))
    ]
    return RealCapture(payloads, points)


def _matching(
    ranges: NDArray[np.float32], recorded: NDArray[np.float32], facts: Mapping[str, Any]
) -> NDArray[np.bool_]:
    """Return which recorded points have a range: a few may belong to no whole packet.

    The distance from the optical center tells, since the axes are known.
    """
    expected = ranges[np.isfinite(ranges)]
    matching = np.ones(len(recorded), np.bool_)
    height = recorded[:, 2] - float(facts["a_axis_dist"])
    distance = np.hypot(np.hypot(recorded[:, 0], recorded[:, 1]), height)
    while (surplus := np.count_nonzero(matching) - len(expected)) > 0:
        wrong = np.abs(distance[matching][: len(expected)] - expected) > 0.02
        first = int(np.argmax(wrong)) if wrong.any() else len(expected) + surplus - 1
        matching[np.flatnonzero(matching)[first]] = False
    return matching


def sweeps(
    datagrams: Iterable[Datagram], values: Mapping[str, object] | None = None
) -> list[Sweep]:
    """Return the sweeps of 3D packets whose true starts are known: no clock, no leveling."""
    framer, assembler = Framer(), SweepAssembler(settings.build(SweepConfig, values or {}))
    made: list[Sweep] = []
    start = EPOCH_NS
    for datagram in datagrams:
        for item in framer.feed(datagram.data):
            assert isinstance(item, Frame)
            packet = decode(item)
            if isinstance(packet, PointPacket):
                made += assembler.push(packet, HostNs(start))
                start += PERIOD_NS
    last = assembler.flush()
    return made if last is None else [*made, last]


def digest(points: NDArray[np.void]) -> dict[str, str | int]:
    """Return two hashes of every field: of its values rounded, and of its bits.

    Lengths are rounded to 10 um, times to 10 ns, intensities are whole. Points are computed with
    64 bits and have 32, so that the bits are the same on other machines, too, but for one value in
    a hundred million.
    """
    unit = {"time": 1e-8, "intensity": 1.0}
    result: dict[str, str | int] = {"points": len(points)}
    for name in points.dtype.names or ():
        rounded = np.round(points[name].astype(np.float64) / unit.get(name, 1e-5)).astype("<i8")
        result[name] = hashlib.sha256(rounded.tobytes()).hexdigest()[:16]
        result[f"{name}: bits"] = hashlib.sha256(points[name].tobytes()).hexdigest()[:16]
    return result


def differences(
    before: Sequence[Mapping[str, str | int]], after: Sequence[Mapping[str, str | int]]
) -> list[str]:
    """Return what differs between the digests of sweeps, by number and name of the field."""
    found = [] if len(before) == len(after) else [f"{len(before)} sweeps are {len(after)} now"]
    for number, (old, new) in enumerate(zip(before, after, strict=False)):
        found += [f"sweep {number}: {name}" for name in old if old[name] != new.get(name)]
    return found


DIGESTED: dict[str, tuple[Mapping[str, float], Mapping[str, object]]] = {
    "unit_a_by_packets": (UNIT_A, {}),
    "unit_b_by_turn": (UNIT_B, {"sweep_cut": "turn"}),
    "unit_a_by_half_turn": (UNIT_A, {"sweep_cut": "half_turn"}),
    "unit_a_with_own_range_calibration": (
        UNIT_A,
        {"EnableCalRangeOVR": True, "calRangeScale": 0.000989, "calRangeBias": -525.5},
    ),
}
"""What :data:`DIGESTS` has a file for: the calibration and the settings, by name."""


def digests(name: str) -> list[dict[str, str | int]]:
    """Return the digest of every sweep of a second of :func:`capture`."""
    calibration, values = DIGESTED[name]
    return [digest(item.points) for item in sweeps(capture(calibration=calibration), values)]


def write_digests() -> None:
    """Write the digests anew, after a change that is meant to change points."""
    for name in DIGESTED:
        text = json.dumps(digests(name), indent=1)
        (DIGESTS / f"{name}.digest.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    write_digests()
