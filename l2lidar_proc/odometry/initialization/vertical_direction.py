"""The vertical of a built place, as its surfaces show it.

While a carrier accelerates, the accelerometer does not show the vertical: 1.2 m/s^2 tilt it by 7
degrees. What is built does: floors and ceilings are level, and walls upright, whatever their yaw
(an Atlanta world: Schindler and Dellaert 2004). The vertical is the direction that most surfaces
are parallel or perpendicular to. Where few are, as in a wood or on a slope, nothing is built.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from l2lidar_node.types import F64
from l2lidar_proc import tuning

_STARTS: Final = tuning.VERTICAL_STEP * np.array(
    [[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]
)


class Vertical(NamedTuple):
    """The vertical of a place, as far as it is built.

    Attributes
    ----------
    direction : ndarray, shape (3,)
        Unit vector.
    agreement : float
        Share of the surfaces that are level or upright, 0 to 1.
    """

    direction: F64
    agreement: float

    @property
    def is_certain(self) -> bool:
        """Whether so many surfaces agree that the place is built."""
        return self.agreement >= tuning.VERTICAL_AGREE

    @property
    def is_likely(self) -> bool:
        """Whether it is nearer than an accelerometer that contradicts it."""
        return self.agreement >= tuning.VERTICAL_LIKELY

    def is_beyond(self, sine: float, vertical: F64) -> bool:
        """Return whether its angle to another vertical (3,), a unit vector, has a larger sine."""
        return float(np.linalg.norm(np.cross(self.direction, vertical))) > sine


def vertical_direction(normals: F64, weights: F64, guess: F64) -> Vertical | None:
    """Return the vertical that most surfaces agree on; None where they leave a tilt open.

    Parameters
    ----------
    normals : ndarray, shape (N, 3)
        Unit normals of surfaces, of either sign.
    weights : ndarray, shape (N,)
        Of the surfaces, such as their areas.
    guess : ndarray, shape (3,)
        Unit vector that is nearer to the vertical than to any level direction.

    Returns
    -------
    Vertical or None
        Its direction is on the side of the guess.
    """
    if len(normals) < tuning.VERTICAL_SURFACES:
        return None
    tangents = _tangents(guess)
    fits = [_fitted(normals, weights, _unit(guess + step @ tangents)) for step in _STARTS]
    up = max(fits, key=lambda fit: float(weights @ _agreement(normals, fit)))
    agree = _agreement(normals, up)
    near = 1.0 / (1.0 + (tuning.VERTICAL_BOUND / tuning.VERTICAL_SCALE) ** 2)
    total = float(weights.sum())
    information, _ = _normal_equations(normals, weights, up)
    if float(np.linalg.eigvalsh(information)[0]) < tuning.VERTICAL_FIXED * total:
        return None
    return Vertical(up, float(weights[agree >= near].sum()) / total)


def _fitted(normals: F64, weights: F64, up: F64) -> F64:
    """Return the vertical (3,) near another one that surfaces fit best: Gauss-Newton steps."""
    for _ in range(tuning.VERTICAL_ROUNDS):
        information, gradient = _normal_equations(normals, weights, up)
        damped = information + 1e-9 * weights.sum() * np.eye(2)
        step = np.linalg.solve(damped, gradient)
        up = _unit(up + step @ _tangents(up))
        if np.abs(step).max() < tuning.VERTICAL_CONVERGED:
            break
    return up


def _normal_equations(normals: F64, weights: F64, up: F64) -> tuple[F64, F64]:
    """Return information (2, 2) and gradient (2,) of a tilt of the vertical about its tangents.

    Level surfaces have residuals along both tangents, upright ones along their own normal.
    Oblique ones, and those far off, hardly count (Cauchy).
    """
    tangents = _tangents(up)
    along, across = normals @ up, normals @ tangents.T
    counts = weights * _agreement(normals, up)
    level = np.abs(along) > np.sqrt(0.5)
    information = counts[level].sum() * np.eye(2)
    gradient = (counts[level] * np.sign(along[level])) @ across[level]
    upright = across[~level]
    information = information + (upright * counts[~level, None]).T @ upright
    gradient = gradient - (counts[~level] * along[~level]) @ upright
    return information, gradient


def _agreement(normals: F64, up: F64) -> F64:
    """Return how well each surface (N,) agrees with a vertical: 1 if it is level or upright."""
    along = np.abs(normals @ up)
    off = np.minimum(along, np.sqrt(np.maximum(1.0 - along * along, 0.0)))
    return np.asarray(1.0 / (1.0 + (off / tuning.VERTICAL_SCALE) ** 2))


def _tangents(up: F64) -> F64:
    """Return two unit vectors across another one, and across each other, as rows (2, 3)."""
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first /= np.linalg.norm(first)
    return np.stack((first, np.cross(up, first)))


def _unit(vector: F64) -> F64:
    return np.asarray(vector / np.linalg.norm(vector))
