"""Checks in a running odometry whether the gyro turns as the clouds do.

It only tells. The rotation of the IMU and the lateness of its stamps stay what they are set to: an
odometry that follows its own errors hides them.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from l2lidar_node import rotations
from l2lidar_node.types import F64, IMU_SAMPLE
from l2lidar_proc.motion import gyro_alignment as gyro
from l2lidar_proc.motion.gyro_alignment import GyroModel
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.odometry.estimate import CUTS, OdometryEstimate

_PART_NS: Final = 5_000_000_000
_FEWEST_PARTS: Final = 5
_MOST_PARTS: Final = 60  # five minutes: what is looked back on
_FEWEST_TURNS: Final = 10  # between poses, in a part that counts
_MOST_POSES: Final = 1000  # in a part, whatever their stamps are
_MOST_SAMPLES: Final = 20_000
_LEAST_EXCITATION: Final = 0.2  # [rad^2/s] in a part: less is standing, which tells nothing

# A degree costs 2 mm on a walk of 20 m, and shows in a deskewed sweep; less is not worth a word.
_WORTH_SAYING: Final = np.deg2rad(1.0)
_WORTH_SAYING_S: Final = 4e-3
_KNOWN: Final = np.deg2rad(0.25)
_KNOWN_S: Final = 1e-3
_SIGNIFICANT: Final = 4.0  # standard deviations

# A misalignment of 2 mrad is what data sheets allow; without that a robot that only turns about
# one axis could not tell a rotation about the others from it.
_PRIOR_SD: Final = np.array([*[np.deg2rad(20.0)] * 3, *[0.02] * 3, *[0.002] * 3, *[0.2] * 3, 0.05])


class ExtrinsicCheck:
    """Compares poses with the gyro, part by part of the way.

    Parameters
    ----------
    rotation : ndarray, shape (3, 3)
        IMU axes to cloud axes, as they are used.

    Attributes
    ----------
    finding : str
        What looks wrong, for people; empty while nothing does.
    """

    def __init__(self, rotation: F64) -> None:
        self._model = GyroModel(rotation, np.zeros(3), np.zeros(3), np.zeros(3), 0.0)
        self._parts: list[tuple[F64, F64]] = []
        self._change: F64 | None = None
        self._sd = np.full(gyro.PARAMETERS, np.inf)
        self.finding = ""
        self._begin()

    def _begin(self) -> None:
        self._stamps: list[int] = []
        self._turns: list[F64] = []
        self._samples: list[Samples] = []
        self._count = 0

    @property
    def values(self) -> dict[str, str]:
        """Figures for a diagnostic status; empty while nothing is known."""
        found: dict[str, str] = {}
        if self._change is None:
            return found
        if (self._sd[gyro.ROTATION] < _KNOWN).any():
            found["extrinsic rotation off, x y z [deg]"] = " ".join(
                f"{np.degrees(value):+.2f}" if sd < _KNOWN else "?"
                for value, sd in zip(
                    self._change[gyro.ROTATION], self._sd[gyro.ROTATION], strict=True
                )
            )
        if self._sd[gyro.OFFSET] < _KNOWN_S:
            found["IMU time offset off [ms]"] = f"{1e3 * self._change[gyro.OFFSET]:+.2f}"
        return found

    def imu(self, samples: Samples) -> None:
        """Take samples (N,) as the odometry uses them."""
        if not len(samples) or self._count > _MOST_SAMPLES:
            return
        self._samples.append(samples)
        self._count += len(samples)

    def pose(self, estimate: OdometryEstimate) -> None:
        """Take an estimate; one that was not aligned with the map tells nothing."""
        if CUTS & set(estimate.status):
            self._begin()
            return
        if not estimate.is_aligned:
            return
        if self._stamps and estimate.stamp <= self._stamps[-1]:
            self._begin()
        self._stamps.append(int(estimate.stamp))
        self._turns.append(rotations.from_matrix(estimate.T_map_lidar[:3, :3]))
        if self._stamps[-1] - self._stamps[0] >= _PART_NS or len(self._stamps) > _MOST_POSES:
            self._end_part()

    def _end_part(self) -> None:
        """Add a part, and judge all of them."""
        stamps = np.array(self._stamps, dtype=np.int64)
        turns = np.stack(self._turns)
        samples = np.concatenate(self._samples) if self._samples else np.empty(0, IMU_SAMPLE)
        last_stamp, last_turn = self._stamps[-1], self._turns[-1]
        later = samples[samples["stamp"] > last_stamp - _PART_NS // 100]
        self._begin()
        self._stamps.append(last_stamp)
        self._turns.append(last_turn)
        self.imu(later)
        samples = samples[np.argsort(samples["stamp"], kind="stable")]
        rates = samples["angular_velocity"].astype(np.float64)
        if not np.isfinite(rates).all():
            return
        if gyro.excitation(samples["stamp"], rates).max(initial=0.0) < _LEAST_EXCITATION:
            return
        found = gyro.turns_between(stamps, turns, samples, self._model)
        if len(found.residual) >= _FEWEST_TURNS:
            self._parts = [*self._parts[1 - _MOST_PARTS :], gyro.information(found)]
            self._judge()

    def _judge(self) -> None:
        """Say what the parts together say, if they agree on it."""
        count = len(self._parts)
        if count < _FEWEST_PARTS:
            return
        prior = np.diag(_PRIOR_SD**-2.0)
        normal = np.sum([part[0] for part in self._parts], axis=0) + prior
        right = np.sum([part[1] for part in self._parts], axis=0)
        change = np.asarray(np.linalg.solve(normal, right), np.float64)
        without = np.stack([np.linalg.solve(normal - a, right - b) for a, b in self._parts])
        away = without - without.mean(axis=0)
        jackknife = (away**2).sum(axis=0) * (count - 1) / count
        self._change = change
        self._sd = np.sqrt(np.maximum(jackknife, np.diag(np.linalg.inv(normal))))
        self.finding = "; ".join(text for text in (self._rotation(), self._offset()) if text)

    def _rotation(self) -> str:
        """Return what is to be said of the rotation."""
        assert self._change is not None
        vector, sd = self._change[gyro.ROTATION], self._sd[gyro.ROTATION]
        clear = (sd < _KNOWN) & (np.abs(vector) > _SIGNIFICANT * sd)
        size = float(np.linalg.norm(np.where(clear, vector, 0.0)))
        if size < _WORTH_SAYING:
            return ""
        axes = ", ".join(
            f"{np.degrees(value):+.1f} about {axis}"
            for value, axis, known in zip(vector, "xyz", clear, strict=True)
            if known
        )
        return f"extrinsic rotation looks {np.degrees(size):.1f} degrees off ({axes})"

    def _offset(self) -> str:
        """Return what is to be said of the time offset."""
        assert self._change is not None
        value, sd = float(self._change[gyro.OFFSET]), float(self._sd[gyro.OFFSET])
        if sd > _KNOWN_S or abs(value) < max(_WORTH_SAYING_S, _SIGNIFICANT * sd):
            return ""
        return f"stamps of IMU samples look {1e3 * abs(value):.1f} ms too " + (
            "late" if value > 0 else "early"
        )
