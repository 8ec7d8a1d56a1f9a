"""Report of a calibration: text, calibration file, pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import __version__
from l2lidar_node.calibration import planes as flat, solver
from l2lidar_node.calibration.file import CalibrationFile
from l2lidar_node.calibration.model import BIAS, NAMES, STRETCH, B
from l2lidar_node.calibration.observation import Place
from l2lidar_node.calibration.planes import Planes
from l2lidar_node.calibration.result import Quality, StillResult, Verdict
from l2lidar_node.calibration.solver import Scene
from l2lidar_node.calibration.still import DEG
from l2lidar_node.files import whole
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
    has_imu = all(place.precession is not None for place in result.places)
    about: dict[str, Any] = {
        "tool": f"l2lidar {__version__}",
        "date": date,
        "firmware": firmware,
        "mode": "3D, standard field of view",
        "valid": "for this unit" if has_imu else "valid for this mount only, because there was "
            "no IMU data",
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
    """Return a file's corrections of the beams, shape (8,), in the order of model.NAMES.

    The range scale is not part of it; nothing is corrected without a file.
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
    """Return a new result joined with the other sections of an older file of the same unit.

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


_COLORS: Final = ("tab:blue", "tab:orange")
_MOST: Final = 20_000  # points that are drawn
_EDGE_MM: Final = 80.0
_SLICE_M: Final = 0.25  # half thickness of the slice seen from above
_PLAN_M: Final = 3.0  # half width of what is seen from above
_BIN_M: Final = 0.1  # along a wall, for the median of each half
_BIN_POINTS: Final = 8
_HALVES: Final = ("alpha below 90 degrees", "alpha above 90 degrees")


def save(result: StillResult, path: Path) -> None:
    """Write the picture of a result in the format of the suffix.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scene = result.scene
    groups = len(scene.known)
    after = np.tile(result.correction, (groups, 1))
    for number, report in enumerate(result.places):
        after[number, :3] = report.xi, report.beta, report.alpha
    after[:, STRETCH] = 0.0
    for column, name in ((B, "b"), (BIAS, "bias")):
        after[:, column] = result.stored.get(name, 0.0)
    clouds = [solver.points(scene, correction) for correction in (np.zeros_like(after), after)]
    group, edge = _wall(result, clouds[1])
    figure = Figure(figsize=(11, 9), dpi=80, layout="constrained")
    FigureCanvasAgg(figure)
    axes: Any = figure.subplots(2, 2)
    for column, (title, quality, cloud) in enumerate(
        (("as reported", result.before, clouds[0]), ("calibrated", result.after, clouds[1]))
    ):
        _draw_edge(axes[0, column], cloud, scene.is_far_half, edge)
        axes[0, column].set_title(f"{title}: {_words(quality)}")
        _draw_plan(axes[1, column], cloud, scene.is_far_half, scene.group == group, edge)
    name = result.places[group].name
    figure.suptitle(f"a wall seen edge-on, and a slice of '{name}' from above")
    with whole(path) as part:
        figure.savefig(part)


def save_turns(before: tuple[F64, F64], after: tuple[F64, F64], path: Path) -> None:
    """Write a picture of how far a gyro turns otherwise than the clouds.

    Parameters
    ----------
    before, after : tuple of ndarray
        Instants (N,) [s] and rotation vectors (N, 3) from sweep to sweep [rad], under the drawing
        and calibrated.
    path : Path

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), dpi=80, layout="constrained")
    FigureCanvasAgg(figure)
    axes: Any = figure.subplots(3, 2, sharex=True, sharey=True)
    for column, (title, (seconds, turns)) in enumerate(
        (("as drawn", before), ("calibrated", after))
    ):
        degrees = np.rad2deg(turns)
        rms = float(np.sqrt(np.mean(np.sum(degrees**2, axis=1))))
        axes[0, column].set_title(f"{title}: {rms:.2f} degrees from sweep to sweep (rms)")
        for row, name in enumerate("xyz"):
            axes[row, column].plot(seconds, degrees[:, row], ".", ms=4)
            axes[row, column].grid(visible=True, alpha=0.3)
            axes[row, 0].set_ylabel(f"about {name} [deg]")
        axes[2, column].set_xlabel("time [s]")
    figure.suptitle("rotation by the gyro against rotation by the clouds")
    with whole(path) as part:
        figure.savefig(part)


class _Edge:
    """A large surface and the points near it."""

    def __init__(self, center: F64, normal: F64, u: F64, near: NDArray[np.int64]) -> None:
        self.center, self.normal, self.u, self.near = center, normal, u, near


def _wall(result: StillResult, cloud: F64) -> tuple[int, _Edge]:
    """Return the place and the surface that show the halves best: flat, big, and seen by both."""
    scene = result.scene
    large = flat.large(cloud, scene.is_far_half, scene.group)
    candidates = [found for found in (large, result.surfaces) if len(found.first)]
    found, index = max(
        ((found, int(np.argmax(_shown(found, cloud, scene)))) for found in candidates),
        key=lambda item: float(_shown(item[0], cloud, scene)[item[1]]),
    )
    mine = found.member[found.first[index] :][: int(found.counts[index])]
    group = int(scene.group[mine[0]])
    center, normal = found.center[index], found.normal[index]
    here = np.flatnonzero(scene.group == group)
    offset = cloud[here] - center
    reach = max(2.0 * float(np.quantile(np.linalg.norm(cloud[mine] - center, axis=1), 0.9)), 0.6)
    is_near = (np.abs(offset @ normal) < 0.15) & (np.linalg.norm(offset, axis=1) < reach)
    return group, _Edge(center, normal, found.v[index], here[is_near])


def _shown(found: Planes, cloud: F64, scene: Scene) -> F64:
    """Return how well surfaces show the two halves, shape (K,): many points, and thin."""
    far = np.add.reduceat(scene.is_far_half[found.member].astype(np.float64), found.first)
    both = np.minimum(far, found.counts - far)
    height = flat.refitted(found.at(), cloud[found.member]).heights(cloud[found.member])
    variance = np.add.reduceat(height**2, found.first) / found.counts
    return np.asarray(both / np.maximum(variance, 1e-6))


def _draw_edge(axes: Any, cloud: F64, far: NDArray[np.bool_], edge: _Edge) -> None:
    near = _some(edge.near)
    offset = cloud[near] - edge.center
    for half, color in enumerate(_COLORS):
        mine = far[near] == bool(half)
        along, off = offset[mine] @ edge.u, 1e3 * (offset[mine] @ edge.normal)
        axes.plot(along, off, ".", ms=1.5, alpha=0.4, color=color)
        bins = np.round(along / _BIN_M).astype(np.int64)
        steps = [step for step in np.unique(bins) if np.count_nonzero(bins == step) >= _BIN_POINTS]
        middle = [float(np.median(off[bins == step])) for step in steps]
        axes.plot(np.array(steps) * _BIN_M, middle, lw=2.5, color=color, label=_HALVES[half])
    axes.set(xlabel="along the wall [m]", ylabel="off the wall [mm]", ylim=(-_EDGE_MM, _EDGE_MM))
    axes.grid(visible=True, alpha=0.3)
    axes.legend(loc="upper right", title="median of the half with")


def _draw_plan(
    axes: Any, cloud: F64, far: NDArray[np.bool_], is_here: NDArray[np.bool_], edge: _Edge
) -> None:
    middle = np.median(cloud[is_here, 2])
    away = np.abs(cloud[:, :2] - edge.center[:2]).max(axis=1)
    chosen = is_here & (np.abs(cloud[:, 2] - middle) < _SLICE_M)
    if not (chosen & (away < _PLAN_M)).any():  # a ceiling: nothing of the slice is near it
        away = np.abs(cloud[:, :2]).max(axis=1)
    index = _some(np.flatnonzero(chosen & (away < _PLAN_M)))
    for half, color in enumerate(_COLORS):
        mine = index[far[index] == bool(half)]
        axes.plot(cloud[mine, 0], cloud[mine, 1], ".", ms=2.0, alpha=0.6, color=color)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.grid(visible=True, alpha=0.3)


def _some(index: NDArray[np.int64]) -> NDArray[np.int64]:
    return index[:: max(1, len(index) // _MOST)]


def _words(quality: Quality) -> str:
    return (
        f"{1e3 * quality.thickness:.1f} mm thick, halves {1e3 * quality.gap:.1f} mm apart (median)"
    )
