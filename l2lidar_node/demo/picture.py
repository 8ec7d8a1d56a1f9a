"""Draws a cloud, coloured by range, without a screen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray


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
    path.parent.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(13, 6), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
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
    figure.savefig(path)
