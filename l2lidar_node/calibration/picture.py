"""Pictures of a calibration: walls before and after, turns of gyro and clouds."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.calibration import planes as flat, solver
from l2lidar_node.calibration.model import BIAS, STRETCH
from l2lidar_node.calibration.result import Quality, StillResult
from l2lidar_node.files import whole
from l2lidar_node.types import F64

_COLORS: Final = ("tab:blue", "tab:orange")
_MOST: Final = 20_000  # points that are drawn
_EDGE_MM: Final = 120.0
_SLICE_M: Final = 0.25  # half thickness of the slice seen from above
_FARTHEST_M: Final = 12.0


def save(result: StillResult, path: Path) -> None:
    """Write the picture of a result as PNG or whatever the suffix says.

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
    after[:, [BIAS, STRETCH]] = 0.0
    clouds = [solver.points(scene, correction) for correction in (np.zeros_like(after), after)]
    group, edge = _wall(result, clouds[1])
    figure = Figure(figsize=(12, 10), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes: Any = figure.subplots(2, 2)
    for column, (title, quality, cloud) in enumerate(
        (("as reported", result.before, clouds[0]), ("calibrated", result.after, clouds[1]))
    ):
        _draw_edge(axes[0, column], cloud, scene.is_far_half, edge)
        axes[0, column].set_title(f"{title}: {_words(quality)}")
        _draw_plan(axes[1, column], cloud, scene.is_far_half, scene.group == group)
    name = result.places[group].name
    figure.suptitle(f"a wall seen from its edge, and a slice of '{name}' from above")
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
    figure.suptitle("turns of the gyro against those of the clouds")
    with whole(path) as part:
        figure.savefig(part)


class _Edge:
    """A large surface and the points near it."""

    def __init__(self, center: F64, normal: F64, u: F64, near: NDArray[np.int64]) -> None:
        self.center, self.normal, self.u, self.near = center, normal, u, near


def _wall(result: StillResult, cloud: F64) -> tuple[int, _Edge]:
    """Return the place and the surface that show the halves best: big, and seen by both."""
    scene = result.scene
    found = flat.large(cloud, scene.is_far_half, scene.group)
    if not len(found.first):
        found = result.surfaces
    far = np.add.reduceat(scene.is_far_half[found.member].astype(np.float64), found.first)
    both = np.minimum(far, found.counts - far)
    index = int(np.argmax(both))
    group = int(scene.group[found.member[found.first[index]]])
    center, normal = found.center[index], found.normal[index]
    here = np.flatnonzero(scene.group == group)
    offset = cloud[here] - center
    is_near = (np.abs(offset @ normal) < 0.15) & (np.linalg.norm(offset, axis=1) < 3.0)
    return group, _Edge(center, normal, found.v[index], here[is_near])


def _draw_edge(axes: Any, cloud: F64, far: NDArray[np.bool_], edge: _Edge) -> None:
    near = _some(edge.near)
    offset = cloud[near] - edge.center
    for half, color in enumerate(_COLORS):
        mine = far[near] == bool(half)
        axes.plot(
            offset[mine] @ edge.u, 1e3 * (offset[mine] @ edge.normal), ".", ms=1.5, color=color
        )
    axes.set(xlabel="along the wall [m]", ylabel="off the wall [mm]", ylim=(-_EDGE_MM, _EDGE_MM))
    axes.grid(visible=True, alpha=0.3)


def _draw_plan(axes: Any, cloud: F64, far: NDArray[np.bool_], is_here: NDArray[np.bool_]) -> None:
    middle = np.median(cloud[is_here, 2])
    distance = np.linalg.norm(cloud[:, :2], axis=1)
    chosen = is_here & (np.abs(cloud[:, 2] - middle) < _SLICE_M) & (distance < _FARTHEST_M)
    index = _some(np.flatnonzero(chosen))
    for half, color in enumerate(_COLORS):
        mine = index[far[index] == bool(half)]
        axes.plot(
            cloud[mine, 0], cloud[mine, 1], ".", ms=1.0, color=color,
            label="alpha above 90 degrees" if half else "alpha below 90 degrees",
        )  # fmt: skip
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.legend(loc="center", markerscale=8)


def _some(index: NDArray[np.int64]) -> NDArray[np.int64]:
    return index[:: max(1, len(index) // _MOST)]


def _words(quality: Quality) -> str:
    return (
        f"{1e3 * quality.thickness:.1f} mm thick, halves {1e3 * quality.gap:.1f} mm apart (median)"
    )
