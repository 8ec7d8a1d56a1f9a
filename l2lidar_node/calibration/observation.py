"""Placements of a still sensor: returns, gyro and block from raw packets, rocking of the mount.

A housing that rocks with the head has a constant tilt (t_A, t_B) in the head frame, and moves the
points exactly as alpha = t_A and beta = t_B do. The cloud cannot tell them apart; the gyro can:
turned into the head frame it reads W (-t_B, t_A) for a head that turns at W.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.calibration.model import ALPHA, BETA, NAMES, RETURN, ROCK_COS, ROCK_SIN, Block
from l2lidar_node.protocol import wire
from l2lidar_node.types import F64

GYRO: Final = np.dtype(
    [
        ("theta", "<f8"),  # [rad] head angle with theta_angle_bias, unwrapped
        ("rate", "<f8", (3,)),  # [rad/s]
        ("force", "<f8", (3,)),  # [m/s^2]
    ]
)
"""One IMU sample at a known head angle, in the order of measurement."""

_NEAREST_M: Final = 0.35  # nearer ranges of an L2 are ambiguous
_FARTHEST_M: Final = 60.0
_MOST_RETURNS: Final = 150_000  # of a place: four seconds; more only cost time
_GAP_S: Final = 0.05  # of the device's clock, between packets whose angles are joined
_WIDE_RAD: Final = -0.05  # first slot of a wide field of view
_TURN: Final = 2.0 * np.pi


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Measurements of a unit at one placement.

    Attributes
    ----------
    name : str
    power_up : int
        Places of the same number were measured without switching the unit off in between.
    block : Block
    returns : ndarray, dtype RETURN
    gyro : ndarray, dtype GYRO
        Empty without IMU packets.
    packets : int
        3D packets.
    turns : float
        Turns of the head.
    head_rate : float
        [rad/s].
    blocks : int
        Different calibration blocks among the packets.
    is_wide : bool
        Whether the field of view is 192 degrees.
    flat : int
        2D packets.
    rejected : int
        Damaged or impossible packets.
    dirt : float
        Mean dirt index [%].
    temperature : float
        Of the detector, mean [degC].
    sha256 : str
        Of all payloads.
    """

    name: str
    power_up: int
    block: Block
    returns: NDArray[np.void]
    gyro: NDArray[np.void]
    packets: int
    turns: float
    head_rate: float
    blocks: int
    is_wide: bool
    flat: int
    rejected: int
    dirt: float
    temperature: float
    sha256: str


class _Timed(NamedTuple):
    """A payload with its arrival index and its device stamp [s]."""

    order: int
    stamp_s: float
    payload: bytes


@dataclass(slots=True)
class Gathering:
    """Collects the packets of a placement.

    Attributes
    ----------
    name : str
    power_up : int
    """

    name: str = "place"
    power_up: int = 0
    _points: list[_Timed] = field(default_factory=list)
    _imu: list[_Timed] = field(default_factory=list)
    _flat: int = 0
    _rejected: int = 0

    def points(self, stamp_s: float, payload: bytes) -> None:
        """Add a checked payload of a 3D packet with its device stamp [s]."""
        self._points.append(_Timed(len(self._points) + len(self._imu), stamp_s, payload))

    def imu(self, stamp_s: float, payload: bytes) -> None:
        """Add a checked payload of an IMU packet with its device stamp [s]."""
        self._imu.append(_Timed(len(self._points) + len(self._imu), stamp_s, payload))

    def flat(self) -> None:
        """Count a 2D packet."""
        self._flat += 1

    def rejected(self) -> None:
        """Count a packet that cannot be used."""
        self._rejected += 1

    def place(self) -> Place:
        """Return the gathered placement.

        Raises
        ------
        ValueError
            If there is not a single 3D packet.
        """
        if not self._points:
            raise ValueError(
                "no 3D packets"
                + (f", {self._flat} 2D packets: set the unit to 3D" if self._flat else "")
            )
        digest = hashlib.sha256()
        for item in (*self._points, *self._imu):
            digest.update(item.payload)
        raw = np.frombuffer(
            b"".join(item.payload for item in self._points), wire.POINTS_3D_PAYLOAD
        )
        words = raw["calibration"].tobytes()
        size = wire.CALIBRATION.itemsize
        blocks = {words[i : i + size] for i in range(0, len(words), size)}
        block = Block(max(blocks, key=words.count))
        raw = raw[(np.frombuffer(words, f"S{size}") == block.octets) if len(blocks) > 1 else ...]
        angles = _head_angles(raw, block)
        state = raw["state"]
        period_s = float(np.median(state["com_rotation_period"])) * 1e-6
        return Place(
            self.name,
            self.power_up,
            block,
            _returns(raw, block),
            self._gyro(block),
            len(raw),
            float(angles[-1] - angles[0]) / _TURN,
            _TURN / period_s if period_s > 0 else 0.0,
            len(blocks),
            bool(np.median(raw["angle_min"]) < _WIDE_RAD),
            self._flat,
            self._rejected,
            float(np.mean(state["dirty_index"])),
            float(np.mean(state["apd_temperature"])),
            digest.hexdigest(),
        )

    def _gyro(self, block: Block) -> NDArray[np.void]:
        """Return the IMU samples with the head angle at their instants.

        Both kinds of packets carry the same clock, so the angle is interpolated between the point
        packets around a sample, whatever that clock's rate is. Samples next to a step of the clock
        or a gap are left out.
        """
        if not self._imu or len(self._points) < 2:
            return np.empty(0, GYRO)
        raw = np.frombuffer(
            b"".join(item.payload for item in self._points), wire.POINTS_3D_PAYLOAD
        )
        at = np.array([item.stamp_s for item in self._points])
        order = np.array([item.order for item in self._points])
        angles = _head_angles(raw, block)
        samples = _records(self._imu, wire.IMU_PAYLOAD)
        stamps = np.array([item.stamp_s for item in self._imu])
        after = np.searchsorted(order, [item.order for item in self._imu])
        # An IMU packet overtakes the point packet that was measured around it.
        best = np.full(len(samples), np.nan)
        for shift in (-2, -1, 0, 1):
            left = np.clip(after + shift, 0, len(at) - 2)
            width = at[left + 1] - at[left]
            share = (stamps - at[left]) / np.where(width > 0, width, 1.0)
            fits = (share >= 0) & (share <= 1) & (width > 0) & (width < _GAP_S)
            angle = angles[left] + share * (angles[left + 1] - angles[left])
            best = np.where(fits & np.isnan(best), angle, best)
        known = np.isfinite(best)
        found = np.zeros(int(known.sum()), GYRO)
        found["theta"] = best[known]
        found["rate"] = samples["angular_velocity"][known]
        found["force"] = samples["linear_acceleration"][known]
        return found


def _records(items: list[_Timed], layout: np.dtype[np.void]) -> NDArray[np.void]:
    return np.frombuffer(b"".join(item.payload for item in items), layout)


def _head_angles(raw: NDArray[np.void], block: Block) -> F64:
    """Return the head angle at the first slot of every packet [rad], unwrapped."""
    angle = raw["com_horizontal_angle_start"].astype(np.float64)
    return np.asarray(np.unwrap(angle) + block.values["theta_angle_bias"])


def _returns(raw: NDArray[np.void], block: Block) -> NDArray[np.void]:
    every = max(1, -(-int(np.count_nonzero(raw["ranges"])) // _MOST_RETURNS))
    own = block.values
    numbers = np.arange(len(raw))[::every]
    raw = raw[::every]
    slots = np.arange(wire.POINTS_PER_3D_PACKET)
    distance = own["range_scale"] * (raw["ranges"] + own["range_bias"])
    near = np.maximum(raw["range_min"], _NEAREST_M)[:, None]
    far = np.minimum(raw["range_max"], _FARTHEST_M)[:, None]
    keep = (raw["ranges"] > 0) & (distance > near) & (distance < far)
    keep &= slots < raw["point_num"][:, None]
    packet, slot = np.nonzero(keep)
    found = np.zeros(len(packet), RETURN)
    found["packet"] = numbers[packet]
    found["theta"] = (
        raw["com_horizontal_angle_start"].astype(np.float64)[packet]
        + own["theta_angle_bias"]
        + raw["com_horizontal_angle_step"].astype(np.float64)[packet] * slot
    )
    found["alpha"] = (
        raw["angle_min"].astype(np.float64)[packet]
        + own["alpha_angle_bias"]
        + raw["angle_increment"].astype(np.float64)[packet] * slot
    )
    found["range"] = distance[packet, slot]
    found["intensity"] = raw["intensities"][packet, slot]
    return found


_HARMONICS: Final = (-2, -1, 0, 1, 2)
_PARTS: Final = 8  # of the recording, whose scatter tells the uncertainty
_FEWEST: Final = 400  # IMU samples
_STEADY: Final = 5.0  # standard deviations by which the rates of a still sensor may differ
_STEADY_RAD_S: Final = 0.02
_STEADY_TILT_RAD: Final = np.deg2rad(0.3)


@dataclass(frozen=True, slots=True)
class Precession:
    """Tilt of the housing in step with the head.

    Attributes
    ----------
    tilt_a, tilt_b : float
        In the head frame, constant: what alpha and beta would take for theirs [rad].
    rock_cos, rock_sin : float
        The part that turns against the head, see :data:`model.NAMES` [rad].
    sd : float
        Standard deviation of each [rad].
    is_at_rest : bool
        Whether rates and gravity stayed the same over the recording.
    """

    tilt_a: float
    tilt_b: float
    rock_cos: float
    rock_sin: float
    sd: float
    is_at_rest: bool

    @property
    def forward(self) -> float:
        """Size of the part that turns with the head [rad]."""
        return float(np.hypot(self.tilt_a, self.tilt_b))

    @property
    def backward(self) -> float:
        """Size of the part that turns against it [rad]."""
        return float(np.hypot(self.rock_cos, self.rock_sin))

    @property
    def correction(self) -> F64:
        """Contribution of the precession to the beam parameters, shape (8,)."""
        found = np.zeros(len(NAMES))
        found[[ALPHA, BETA, ROCK_COS, ROCK_SIN]] = (
            self.tilt_a, self.tilt_b, self.rock_cos, self.rock_sin,
        )  # fmt: skip
        return found


def demodulated(place: Place) -> Precession | None:
    """Return the precession of a place; None without enough IMU samples."""
    gyro = place.gyro
    if len(gyro) < _FEWEST or place.head_rate <= 0:
        return None
    whole = _lines(gyro, place.head_rate)
    parts = np.stack([_lines(part, place.head_rate) for part in np.array_split(gyro, _PARTS)])
    sd = float(np.sqrt(np.mean(parts.var(axis=0, ddof=1)) / _PARTS))
    tilt_a, tilt_b, rock_cos, rock_sin = whole.tolist()
    return Precession(tilt_a, tilt_b, rock_cos, rock_sin, sd, _is_at_rest(gyro))


def _lines(gyro: NDArray[np.void], head_rate: float) -> F64:
    """Return tilt_a, tilt_b, rock_cos, rock_sin of the lines at the head's frequency [rad]."""
    rate = gyro["rate"][:, 0] + 1j * gyro["rate"][:, 1]
    basis = np.exp(1j * np.outer(gyro["theta"], _HARMONICS))
    line = np.linalg.lstsq(basis, rate, rcond=None)[0]
    forward, backward = line[3] / head_rate, line[1] / head_rate
    return np.array([forward.imag, -forward.real, -backward.imag, backward.real])


def _is_at_rest(gyro: NDArray[np.void]) -> bool:
    parts = np.array_split(gyro, _PARTS)
    rates = np.stack([part["rate"].mean(axis=0) for part in parts])
    noise = np.stack([part["rate"].std(axis=0) for part in parts]) / np.sqrt(len(parts[0]))
    limit = np.maximum(_STEADY * np.median(noise, axis=0), _STEADY_RAD_S)
    if (np.abs(rates - np.median(rates, axis=0)) > limit).any():
        return False
    up = np.stack([part["force"].mean(axis=0) for part in parts])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    middle = np.median(up, axis=0)
    cosine = up @ (middle / np.linalg.norm(middle))
    return bool(np.arccos(np.clip(cosine, -1.0, 1.0)).max() < _STEADY_TILT_RAD)
