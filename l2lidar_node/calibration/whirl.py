"""Rocking of the mount in step with the head, from the gyro of a sensor at rest.

A housing that rocks with the head has a constant tilt (t_A, t_B) in the head frame, and moves the
points exactly as alpha = t_A and beta = t_B do. The cloud cannot tell them apart; the gyro can:
turned into the head frame it reads W (-t_B, t_A) for a head that turns at W.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.calibration.model import ALPHA, BETA, NAMES, ROCK_COS, ROCK_SIN
from l2lidar_node.calibration.observation import Place
from l2lidar_node.types import F64

_HARMONICS: Final = (-2, -1, 0, 1, 2)
_PARTS: Final = 8  # of the recording, whose scatter tells the uncertainty
_FEWEST: Final = 400  # IMU samples
_STEADY: Final = 5.0  # standard deviations by which the rates of a still sensor may differ
_STEADY_RAD_S: Final = 0.02
_STEADY_TILT_RAD: Final = np.deg2rad(0.3)


@dataclass(frozen=True, slots=True)
class Whirl:
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
        """What the whirl adds to the parameters of the beams, shape (8,)."""
        found = np.zeros(len(NAMES))
        found[[ALPHA, BETA, ROCK_COS, ROCK_SIN]] = (
            self.tilt_a, self.tilt_b, self.rock_cos, self.rock_sin,
        )  # fmt: skip
        return found


def demodulated(place: Place) -> Whirl | None:
    """Return the whirl of a place; None without enough IMU samples."""
    gyro = place.gyro
    if len(gyro) < _FEWEST or place.head_rate <= 0:
        return None
    whole = _lines(gyro, place.head_rate)
    parts = np.stack([_lines(part, place.head_rate) for part in np.array_split(gyro, _PARTS)])
    sd = float(np.sqrt(np.mean(parts.var(axis=0, ddof=1)) / _PARTS))
    tilt_a, tilt_b, rock_cos, rock_sin = whole.tolist()
    return Whirl(tilt_a, tilt_b, rock_cos, rock_sin, sd, _is_at_rest(gyro))


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
