"""Words and files of a result: what the command line prints and the calibration file holds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from l2lidar_node import __version__
from l2lidar_node.calibration.file import CalibrationFile
from l2lidar_node.calibration.model import NAMES
from l2lidar_node.calibration.observation import Place
from l2lidar_node.calibration.result import Quality, StillResult, Verdict
from l2lidar_node.calibration.still import DEG
from l2lidar_node.types import F64

ENTRIES: Final = {
    "xi": "xi_angle",
    "beta": "beta_angle",
    "alpha": "alpha_angle_bias",
    "b": "b_axis_dist",
    "bias": "range_bias",
}
"""Entries of the block by parameter."""

BEAMS: Final = tuple(ENTRIES.values())
"""Entries that still places tell."""

UNITS: Final = {
    "xi": ("deg", 1.0 / DEG),
    "beta": ("deg", 1.0 / DEG),
    "alpha": ("deg", 1.0 / DEG),
    "b": ("mm", 1e3),
    "bias": ("mm", 1e3),
}
"""Unit for people and factor by parameter."""


def calibration_of(
    result: StillResult, places: Sequence[Place], date: str, firmware: str = ""
) -> CalibrationFile:
    """Return the calibration file of a result.

    Parameters
    ----------
    result : StillResult
    places : sequence of Place
    date : str
    firmware : str
        Empty where the recordings do not say.
    """
    known = {
        name: item
        for name, item in result.estimates.items()
        if item.verdict is not Verdict.UNKNOWN
    }
    has_imu = all(place.whirl is not None for place in result.places)
    about: dict[str, Any] = {
        "tool": f"l2lidar {__version__}",
        "date": date,
        "firmware": firmware,
        "mode": "3D, standard field of view",
        "valid": "for this unit" if has_imu else "for this mount only: there was no IMU data",
        "parameters": {
            name: {
                "correction": round(item.value * UNITS[name][1], 4),
                "sd": round(item.sd * UNITS[name][1], 4),
                "unit": UNITS[name][0],
                "verdict": item.verdict.value,
                **({"reason": item.reason} if item.reason else {}),
            }
            for name, item in known.items()
        },
        "xi_minus_0.7_beta_deg": [
            round(result.side / DEG, 4), round(result.side_sd / DEG, 4)
        ],
        "weakest": result.weakest,
        "before_mm": quality_mm(result.before),
        "after_mm": quality_mm(result.after),
        "planes": result.planes,
        "places": [
            {
                "name": place.name,
                "power_up": place.power_up,
                "turns": round(place.turns, 1),
                "temperature_degC": round(place.temperature, 1),
                "sha256": place.sha256,
            }
            for place in places
        ],
        "notes": list(result.notes),
    }  # fmt: skip
    stored = result.stored
    return CalibrationFile(
        result.block.octets,
        {ENTRIES[name]: value for name, value in stored.items()},
        {ENTRIES[name]: result.estimates[name].sd for name in stored},
        None,
        about,
    )


def beams_of(file: CalibrationFile | None) -> F64:
    """Return what a file corrects of the beams, shape (8,), in the order of model.NAMES.

    The range scale is no part of it; nothing is corrected without a file.
    """
    known = {} if file is None else file.correction
    return np.array([known.get(ENTRIES.get(name, ""), 0.0) for name in NAMES])


def quality_mm(quality: Quality) -> dict[str, float]:
    """Return thickness and gaps [mm] by name."""
    return {
        "thickness_median": round(1e3 * quality.thickness, 2),
        "rms": round(1e3 * quality.rms, 2),
        "gap_median": round(1e3 * quality.gap, 2),
        "gap_p90": round(1e3 * quality.gap_p90, 2),
    }


def joined(new: CalibrationFile, old: CalibrationFile | None) -> CalibrationFile:
    """Return a new result with what an older file of the same unit has beside it.

    Beams, scale and IMU are estimated on their own: each replaces its own part of the file.
    """
    if old is None or not old.matches(new.block):
        return new
    is_beams = any(name != "range_scale" for name in new.correction)
    mine = BEAMS if is_beams else tuple(new.correction)
    kept = {name: value for name, value in old.correction.items() if name not in mine}
    return CalibrationFile(
        new.block,
        {**kept, **new.correction},
        {**{name: old.sd[name] for name in kept if name in old.sd}, **new.sd},
        new.imu or old.imu,
        {**old.about, **new.about},
    )
