"""The gyro's line: what it measures in step with the spinning head.

The gyro of an L2 has lines at the head's frequency and its double, of 0.03 to 0.3 rad/s. They
integrate to 1 to 10 mrad. Clouds that are deskewed with them are distorted alike in every turn:
narrow views bend their map, and the gyro's bias comes out wrong. But the clouds show the head's
angle, so the line can be measured and removed.

It is measured in turns that are like those before them, at rest or in smooth motion. While a
carrier walks nothing is measured: a harmonic of its steps may be near the line.

Where a mount really rocks in step with the head, the clouds show the same as wrong beam angles,
which are estimated as well (:mod:`l2lidar_proc.odometry.intrinsics.lidar_intrinsics`). Without the
line it is left to them.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from l2lidar_node.types import F64, I64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion.imu_buffer import Samples

_HARMONICS: Final = np.array([1, 2])


class HeadAngle(NamedTuple):
    """Angle of the head over time.

    Attributes
    ----------
    stamp : HostNs
    angle : float
        Then [rad].
    rate : float
        [rad/s]
    """

    stamp: HostNs
    angle: float
    rate: float

    @property
    def turn_ns(self) -> int:
        """How long a turn takes [ns]."""
        return round(2e9 * np.pi / abs(self.rate))

    def at(self, stamps: I64) -> F64:
        """Return the angles (N,) at instants (N,) [ns]; nearby, as the rate varies."""
        return np.asarray(self.angle + self.rate * 1e-9 * (stamps - self.stamp))


class LineRates(NamedTuple):
    """What the gyro measures too much at an angle of the head.

    Attributes
    ----------
    head : HeadAngle
    amplitudes : ndarray, shape (4, 3)
        Of each cloud axis: cosine and sine of either harmonic [rad/s].
    """

    head: HeadAngle
    amplitudes: F64

    def at(self, stamps: I64) -> F64:
        """Return the rates (N, 3) at instants (N,) [ns], cloud axes [rad/s]; nearby only."""
        return np.asarray(_basis(self.head, stamps) @ self.amplitudes)


def _basis(head: HeadAngle, stamps: I64) -> F64:
    """Return cosine and sine of both harmonics, (N, 4), at instants (N,) [ns]."""
    phases = np.outer(head.at(stamps), _HARMONICS)
    return np.stack((np.cos(phases), np.sin(phases)), axis=2).reshape(-1, 4)


class _Turn(NamedTuple):
    end: int  # stamp of the last sample
    # of each axis, cosine and sine of either harmonic, the mean, and half of the change from the
    # first sample to the last [rad/s], shape (6, 3)
    fitted: F64
    sigmas: F64  # of these


class HeadLine:
    """The estimate of the line.

    Attributes
    ----------
    head : HeadAngle or None
        As known last; None before a cloud has shown it.
    """

    def __init__(self) -> None:
        self.head: HeadAngle | None = None
        self._alike: list[_Turn] = []  # first, second and latest turn of those that are alike
        self._turns = 0  # that count
        self._mean: F64 = np.zeros((4, 3))  # of cosine and sine of either harmonic [rad/s]
        self._variance: F64 = np.zeros((4, 3))  # of these in one turn

    def is_due(self, end: HostNs) -> bool:
        """Return whether a turn that ends at an instant hardly overlaps with the one before."""
        if self.head is None:
            return False
        least = (1.0 - tuning.HEAD_LINE_TURN) * self.head.turn_ns
        return not self._alike or abs(end - self._alike[-1].end) >= least

    def learn(self, samples: Samples) -> None:
        """Take the samples of one turn (N,), dtype IMU_SAMPLE, as measured in cloud axes."""
        turn = self._fitted(samples)
        if turn is None:
            return
        if not (self._follows(turn) and self._is_alike(turn)):
            self._alike = [turn]
            return
        self._alike = [*self._alike[:2], turn]
        if len(self._alike) < 3:
            return  # a motion that is nearly in step changes little from one turn to the next
        self._turns = min(self._turns + 1, tuning.HEAD_LINE_TURNS)
        self._mean = self._mean + (turn.fitted[:4] - self._mean) / self._turns
        self._variance = self._variance + (turn.sigmas[:4] ** 2 - self._variance) / self._turns

    def _fitted(self, samples: Samples) -> _Turn | None:
        """Return what fits the samples, None unless they are those of a whole turn."""
        if self.head is None or len(samples) < tuning.HEAD_LINE_SAMPLES:
            return None
        stamps, rates = samples["stamp"], samples["angular_velocity"]
        off = abs(int(stamps[-1] - stamps[0]) - self.head.turn_ns)
        if off > tuning.HEAD_LINE_TURN * self.head.turn_ns:
            return None
        count = len(stamps)
        trend = np.linspace(-1.0, 1.0, count)
        basis = np.column_stack((_basis(self.head, stamps), np.ones(count), trend))
        inverse = np.linalg.inv(basis.T @ basis)
        fitted = inverse @ basis.T @ rates
        left = np.square(rates - basis @ fitted).sum(axis=0) / (count - len(fitted))
        return _Turn(int(stamps[-1]), fitted, np.sqrt(np.outer(np.diag(inverse), left)))

    def _follows(self, turn: _Turn) -> bool:
        """Return whether a turn is the next."""
        assert self.head is not None
        if not self._alike:
            return False
        return 0 < turn.end - self._alike[-1].end < tuning.HEAD_LINE_NEXT * self.head.turn_ns

    def _is_alike(self, turn: _Turn) -> bool:
        """Return whether a turn has steady rates, the same as the first and the latest."""
        least = tuning.HEAD_LINE_LEAST
        if (np.abs(turn.fitted[5]) > tuning.HEAD_LINE_SIGMAS * (turn.sigmas[5] + least)).any():
            return False
        for other in (self._alike[0], self._alike[-1]):
            sigmas = np.sqrt(other.sigmas**2 + turn.sigmas**2) + least
            if (np.abs(turn.fitted - other.fitted) > tuning.HEAD_LINE_SIGMAS * sigmas).any():
                return False
        return True

    @property
    def amplitudes(self) -> F64:
        """Amplitudes as of :class:`LineRates`: as much of the means as is not chance.

        That is a Wiener filter.
        """
        if self._turns < tuning.HEAD_LINE_LEAST_TURNS:
            return np.zeros((4, 3))
        power, chance = (
            part.reshape(2, 2, 3).mean(axis=1)
            for part in (np.square(self._mean), self._variance / self._turns)
        )
        known = 1.0 - chance / np.maximum(power, 1e-18)
        return np.asarray(self._mean * np.repeat(np.maximum(known, 0.0), 2, axis=0))

    @property
    def rates(self) -> LineRates | None:
        """What is to be removed, None before it is known."""
        amplitudes = self.amplitudes
        if self.head is None or not amplitudes.any():
            return None
        return LineRates(self.head, amplitudes)

    def removed(self, samples: Samples) -> Samples:
        """Return samples (N,), dtype IMU_SAMPLE, in cloud axes, without the line."""
        rates = self.rates
        if rates is None or not len(samples):
            return samples
        if abs(samples["stamp"][-1] - rates.head.stamp) > tuning.HEAD_LINE_AGE_NS:
            return samples  # the head may be anywhere
        found = samples.copy()
        found["angular_velocity"] -= rates.at(samples["stamp"])
        return found
