"""Result of a calibration from still placements."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from l2lidar_node.calibration.model import Block
from l2lidar_node.calibration.observation import Precession
from l2lidar_node.calibration.planes import Planes
from l2lidar_node.calibration.solver import Scene
from l2lidar_node.types import F64


class Verdict(Enum):
    """Whether a parameter is corrected, and why not."""

    CORRECTED = "corrected"
    UNCHANGED = "as reported"
    SHOWN = "shown, not stored"
    UNKNOWN = "not known"


@dataclass(frozen=True, slots=True)
class Estimate:
    """One parameter of the result.

    Attributes
    ----------
    value, sd : float
        [rad], [m]; NaN where it is not known.
    verdict : Verdict
    reason : str
        Empty if there is nothing to report.
    """

    value: float
    sd: float
    verdict: Verdict
    reason: str = ""


class Refusal(NamedTuple):
    """Reason why nothing is written, and what to do."""

    reason: str
    advice: str


@dataclass(frozen=True, slots=True)
class Quality:
    """How well the two halves of the fan agree, in meters.

    Attributes
    ----------
    thickness : float
        Median over the planes of the standard deviation of their points.
    rms : float
        Of all points.
    gap, gap_p90 : float
        Median and 90th percentile of the distance of the halves on a plane.
    """

    thickness: float
    rms: float
    gap: float
    gap_p90: float


@dataclass(frozen=True, slots=True)
class PlaceReport:
    """Result from one placement alone.

    Attributes
    ----------
    name : str
    power_up : int
    turns : float
    planes : int
    xi, beta, alpha : float
        [rad]
    precession : Precession or None
        None without IMU data.
    """

    name: str
    power_up: int
    turns: float
    planes: int
    xi: float
    beta: float
    alpha: float
    precession: Precession | None


@dataclass(frozen=True, slots=True, eq=False)
class StillResult:
    """Result of a calibration from still placements.

    Attributes
    ----------
    block : Block
        As the unit reports it.
    estimates : dict of Estimate
        By parameter: xi, beta, alpha, b, bias.
    side, side_sd : float
        xi - 0.7 beta [rad], which data fix best.
    weakest : str
        The combination that is known worst, in words.
    before, after : Quality
        On the same planes.
    places : tuple of PlaceReport
    planes, directions : int
    refusals : tuple of Refusal
        Why nothing may be written; empty if it may.
    notes : tuple of str
    correction : ndarray, shape (8,)
        What was estimated, written or not, alpha as the mean of all places.
    scene : Scene
    surfaces : Planes
    """

    block: Block
    estimates: dict[str, Estimate]
    side: float
    side_sd: float
    weakest: str
    before: Quality
    after: Quality
    places: tuple[PlaceReport, ...]
    planes: int
    directions: int
    refusals: tuple[Refusal, ...]
    notes: tuple[str, ...]
    correction: F64
    scene: Scene
    surfaces: Planes

    @property
    def stored(self) -> dict[str, float]:
        """Corrections stored in a file, by parameter."""
        return {
            name: item.value
            for name, item in self.estimates.items()
            if item.verdict is Verdict.CORRECTED
        }
