"""Zero-velocity test: holds the pose of a sensor at rest until IMU or clouds show motion.

The clouds of a sensor at rest do not agree to the last millimeter: errors of the head's angle and
of the unit's calibration are common to half a turn, and each turn samples other lines. An odometry
that follows every sweep wanders with them, and its map with it. So rest is a hypothesis with a
pose, the anchor. While it stands, sweeps are not deskewed, the map is extended at the anchor, and
the IMU measures its own biases. The registration of each sweep tests it: the deviation that the
latest ones share is compared with the change from one to the next. Noise averages out, slow motion
adds up.
"""

from __future__ import annotations

import dataclasses
from collections import deque

import numpy as np

from l2lidar_node import rotations
from l2lidar_node.types import F64
from l2lidar_proc import tuning
from l2lidar_proc.motion.filter import (
    ERRORS,
    GYRO_BIAS,
    POSE,
    POSITION,
    ROTATION,
    VELOCITY,
    InertialState,
)
from l2lidar_proc.motion.imu_buffer import Samples
from l2lidar_proc.motion.static import StaticReference, static_reference
from l2lidar_proc.odometry.registration.alignment import (
    Alignment,
    degeneracy_ratio,
    unobserved_directions,
)


def with_unnoticed_motion(covariance: F64) -> F64:
    """Return a covariance (18, 18) of a state at rest, with a motion that may just have begun.

    It is noticed a few hundredths of a second later.
    """
    turn, way, speed = tuning.STILL_UNNOTICED
    out = covariance.copy()
    for block, sigma in ((ROTATION, turn), (POSITION, way), (VELOCITY, speed)):
        out[block, block] += sigma**2 * np.eye(3)
    return out


class ZeroVelocityTest:
    """The hypothesis that the sensor is at rest, tested by IMU and registrations.

    Attributes
    ----------
    anchor : InertialState or None
        Where it stands; None while it moves.
    ended_suddenly : bool
        Whether the last one was given up for one or two turns of the head, which deviated from
        many that had agreed: the sensor was at rest until then.
    """

    def __init__(self) -> None:
        self.anchor: InertialState | None = None
        self.ended_suddenly = False
        self._turned = 0  # the instant of the last sweep of a turn
        # how well the first and the latest sweep at the anchor fixed the weakest direction, as a
        # share of all
        self._fixed: tuple[float, float] | None = None
        self.clear()

    def clear(self) -> None:
        """Forget everything: the sensor may move."""
        self._drift: F64 = np.zeros(6)
        self._test_ns = tuning.STILL_TEST_NS
        self._recent: deque[InertialState] = deque()
        self._reference: StaticReference | None = None
        self._release()

    @property
    def drifted(self) -> bool:
        """Whether the last anchor was given up since sweeps deviated from it."""
        return bool(self._drift.any())

    def has_drifted_within(self, turn: float, way: float, rotation: F64, middle: F64) -> bool:
        """Return whether the drift for which the anchor was given up is small.

        Parameters
        ----------
        turn : float
            As much as may be [rad].
        way : float
            As much as the sensor may have moved, or else what it sees [m]. One that sees to one
            side only turns about that.
        rotation : ndarray, shape (3, 3)
            From the sensor's axes to the map's, at rest.
        middle : ndarray, shape (3,)
            Of what it sees, its axes [m].
        """
        turned, moved = self._drift.reshape(2, 3)
        seen = moved + rotation @ rotations.cross(turned, middle)
        least = min(np.linalg.norm(moved), np.linalg.norm(seen))
        return self.drifted and bool(np.linalg.norm(turned) <= turn and least <= way)

    def try_anchor(self, state: InertialState, samples: Samples) -> bool:
        """Set the anchor at a state, if the IMU allows it; return whether it does.

        Parameters
        ----------
        state : InertialState
        samples : ndarray, shape (N,), dtype IMU_SAMPLE
            Of the last moments, cloud axes; may be empty.
        """
        self._release()
        self._reference = static_reference(samples, state.gyro_bias, tuning.STILL_BIAS_MARGIN)
        if self._reference is not None or not len(samples):
            self.anchor = dataclasses.replace(state, velocity=np.zeros(3))
            self._turned = state.stamp
        return self.anchor is not None

    def detect_rest(self, state: InertialState, covariance: F64, samples: Samples) -> bool:
        """Test the latest states for rest; if they are at rest, set the anchor and return True.

        Parameters
        ----------
        state : InertialState
        covariance : ndarray, shape (18, 18)
        samples : ndarray, shape (N,), dtype IMU_SAMPLE
            Of the last :data:`tuning.STILL_TEST_NS`.
        """
        recent = self._recent
        recent.append(state)
        since = state.stamp - self._test_ns
        while len(recent) > 1 and recent[1].stamp <= since:
            recent.popleft()
        strongest = np.linalg.eigvalsh(covariance[VELOCITY, VELOCITY])[-1]
        known = strongest < tuning.STILL_SPEED_SIGMA**2
        slow = np.linalg.norm(state.velocity) <= tuning.STILL_SPEED
        if recent[0].stamp > since or not known or not slow:
            return False
        way = np.array([state.boxminus(other)[POSE] for other in recent])
        if not (np.abs(way) < _both(*tuning.STILL_NEAR)).all():
            return False
        return self.try_anchor(state, samples)

    def test_imu(self, samples: Samples) -> bool:
        """Test the anchor by the IMU, drop it if samples show motion; return whether there is one.

        Parameters
        ----------
        samples : ndarray, shape (N,), dtype IMU_SAMPLE
            Of the sweep, a quarter of a second or more; may be empty.
        """
        if self.anchor is None:
            return False
        if not len(samples) or (self._reference is not None and self._reference.matches(samples)):
            return True
        self.clear()
        return False

    def test_registration(self, found: Alignment) -> bool:
        """Test the anchor by a sweep, drop it if that shows motion; return whether it stands.

        Parameters
        ----------
        found : Alignment
            Of a sweep as it was seen from the anchor, begun with :func:`free_pose`.
        """
        assert self.anchor is not None
        deviation = found.state.boxminus(self.anchor)[POSE]
        self.ended_suddenly = False
        if self._is_blurred(found):
            self._drift = deviation
            self._doubt()
            return False
        free = unobserved_directions(found.claimed)
        if free.size:
            # along a bare corridor rest looks like motion: there it is up to the IMU
            if self._reference is None:
                self.clear()
                return False
            deviation[3:] -= free @ (free.T @ deviation[3:])
        if (np.abs(deviation) > _both(*tuning.STILL_FAR)).any():
            self._drift = deviation
            self.ended_suddenly = len(self._deviations) >= tuning.STILL_OLDER
            self._doubt()
            return False
        # parts of a turn see, and err, each in their own way: only whole turns are compared
        self._turn.append(deviation)
        if found.state.stamp - self._turned < tuning.STILL_TURN_NS:
            return True
        self._turned = found.state.stamp
        self._deviations.append(np.mean(self._turn, axis=0))
        self._turn.clear()
        values = np.array(self._deviations)
        # in second differences steady motion does not show, and noise has six times its variance
        bends = np.diff(values, 2, axis=0)
        scatter = found.covariance[POSE, POSE] + bends.T @ bends / 6.0
        scatter = scatter / (1.0 + len(bends)) + np.diag(_both(*tuning.STILL_LEAST) ** 2)
        # whatever time it began to move: the mean of the latest against that of those before
        newer = np.arange(1, min(tuning.STILL_TESTED, len(values) - 1) + 1)
        total = np.cumsum(values[::-1], axis=0)
        older = len(values) - newer
        drifts = (
            total[newer - 1] / newer[:, None] - (total[-1] - total[newer - 1]) / older[:, None]
        )
        surprise = np.einsum("ni,ij,nj->n", drifts, np.linalg.inv(scatter), drifts)
        surprise /= 1.0 / newer + 1.0 / older
        worst = int(surprise.argmax())
        if surprise[worst] < tuning.STILL_DRIFT:
            return True
        self._drift = drifts[worst]
        # what moved from the start, however it sped up, stands out most with three turns or more
        self.ended_suddenly = bool(worst <= 1 and older[worst] >= tuning.STILL_OLDER)
        self._doubt()
        return False

    def _is_blurred(self, found: Alignment) -> bool:
        """Return whether what fixed a direction at first has become blurred, as by motion."""
        share = degeneracy_ratio(found.claimed)
        first, before = (share, share) if self._fixed is None else self._fixed
        self._fixed = first, share
        mean = 0.5 * (before + share)
        return first > tuning.STILL_FIXED and mean < tuning.STILL_BLURRED * first

    def resume(self, state: InertialState) -> None:
        """Take the hypothesis up again at a state; no earlier sweep is compared any more."""
        self._drift = np.zeros(6)
        self._release()
        self.anchor, self._turned = dataclasses.replace(state, velocity=np.zeros(3)), state.stamp

    def widened(self, covariance: F64) -> F64:
        """Return a covariance (18, 18) that allows for what went unnoticed before the release."""
        out = covariance.copy()
        out[POSE, POSE] += np.outer(self._drift, self._drift)
        turned, moved = self._drift[:3] @ self._drift[:3], self._drift[3:] @ self._drift[3:]
        out[VELOCITY, VELOCITY] += moved / tuning.STILL_DRIFT_S**2 * np.eye(3)
        out[GYRO_BIAS, GYRO_BIAS] += turned / tuning.STILL_DRIFT_S**2 * np.eye(3)
        return out

    def _doubt(self) -> None:
        self._test_ns = min(2 * self._test_ns, tuning.STILL_TEST_MAX_NS)
        self._recent.clear()
        self._release()

    def _release(self) -> None:
        self.anchor = None
        self._fixed = None
        self._turned = 0
        self._turn: list[F64] = []
        # the first sweep at the anchor made the map
        self._deviations: deque[F64] = deque([np.zeros(6)], maxlen=tuning.STILL_COMPARED)


def free_pose() -> F64:
    """Return the covariance (18, 18) of an anchor under test: nothing but its pose may differ."""
    covariance = 1e-12 * np.eye(ERRORS)
    covariance[POSE, POSE] = np.diag(_both(*tuning.STILL_REACH) ** 2)
    return covariance


def _both(turn: float, way: float) -> F64:
    return np.repeat((turn, way), 3)
