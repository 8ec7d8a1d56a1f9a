"""Draws clouds and tracks without a screen."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from l2lidar_node.files import whole

_WALLS_M: Final = 1.5


def save_cloud(points: NDArray[np.void], path: Path, title: str) -> None:
    """Write a picture of a cloud: in perspective, and from above.

    Parameters
    ----------
    points : ndarray, shape (N,), dtype with x, y, z, range
        Cloud frame [m].
    path : Path
        PNG file; missing folders are made.
    title : str
    """
    figure = _figure(path)
    figure.suptitle(title)
    colour: dict[str, Any] = {"c": points["range"], "cmap": "turbo", "vmin": 0.0, "linewidths": 0}
    colour["vmax"] = float(np.percentile(points["range"], 99))
    space = figure.add_subplot(1, 2, 1, projection="3d")
    space.scatter(points["x"], points["y"], points["z"], s=1.5, **colour)
    space.set_aspect("equal")
    space.view_init(elev=38, azim=-60)
    space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    plan = figure.add_subplot(1, 2, 2)
    dots = plan.scatter(points["x"], points["y"], s=1.5, **colour)
    plan.set_aspect("equal")
    plan.set(xlabel="x [m]", ylabel="y [m]", title="from above")
    figure.colorbar(dots, ax=plan, label="range [m]")
    with whole(path) as part:
        figure.savefig(part)


def save_comparison(raw: NDArray[np.void], deskewed: NDArray[np.void], path: Path) -> None:
    """Write a picture of one sweep from above, as measured and deskewed.

    Parameters
    ----------
    raw, deskewed : ndarray, shape (N,), dtype with x, y, z
        Cloud frame [m].
    path : Path
        PNG file; missing folders are made.
    """
    figure = _figure(path, height=6.5)
    for column, (title, points) in enumerate((("as measured", raw), ("deskewed", deskewed))):
        plan = figure.add_subplot(1, 2, column + 1)
        points = points[points["z"] < _WALLS_M]  # a ceiling would hide the walls
        height: dict[str, Any] = {
            "c": points["z"],
            "cmap": "viridis",
            "vmin": 0.0,
            "vmax": _WALLS_M,
        }
        plan.scatter(points["x"], points["y"], s=1.5, linewidths=0, **height)
        plan.set_aspect("equal")
        plan.set(xlabel="x [m]", ylabel="y [m]", title=title)
    with whole(path) as part:
        figure.savefig(part)


def save_track(
    estimated: NDArray[np.float64], true: NDArray[np.float64], path: Path, title: str
) -> None:
    """Write a picture of an estimated track over the true one, from above and over time.

    Parameters
    ----------
    estimated, true : ndarray, shape (N, 3)
        In the world [m].
    path : Path
        PNG file; missing folders are made.
    title : str
    """
    figure = _figure(path)
    figure.suptitle(title)
    plan = figure.add_subplot(1, 2, 1)
    plan.plot(true[:, 0], true[:, 1], color="0.6", linewidth=4, label="truth")
    plan.plot(estimated[:, 0], estimated[:, 1], "tab:red", linewidth=1.2, label="odometry")
    plan.set_aspect("equal")
    plan.set(xlabel="x [m]", ylabel="y [m]")
    plan.legend()
    errors = figure.add_subplot(1, 2, 2)
    errors.plot(1e3 * np.linalg.norm(estimated - true, axis=1), "tab:red")
    errors.set(xlabel="sweep", ylabel="distance from the truth [mm]", ylim=(0, None))
    with whole(path) as part:
        figure.savefig(part)


def _figure(path: Path, height: float = 6.0) -> Figure:
    """Return an empty figure, the folder of whose file is there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(13, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure
