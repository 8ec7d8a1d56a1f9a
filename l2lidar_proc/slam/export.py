"""Exports maps for other programs: g2o, TUM, KITTI, interactive_slam, QN, nav2, PLY, PCD."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.files import whole, write_whole
from l2lidar_node.types import F64
from l2lidar_proc.recording import outputs
from l2lidar_proc.recording.outputs import STAMPED_POSE, StampedPoses
from l2lidar_proc.slam.nodes import Map
from l2lidar_proc.slam.pose_graph import CUT, LOOP
from l2lidar_proc.slam.se3 import inverse, transformed

_OCCUPIED, _FREE, _UNKNOWN = 0, 254, 205  # gray values of nav2's map_server
_BAND_M: Final = (-0.4, 0.8)  # heights about the sensor that an occupancy map shows
_RAYS: Final = 3000  # of each submap that free cells
_LARGEST_IMAGE: Final = 60_000_000  # cells


def write(built: Map, kind: str, target: Path) -> list[Path]:
    """Write a map in a format of :data:`FORMATS`; return the files.

    Parameters
    ----------
    built : Map
    kind : str
    target : Path
        Folder to write to; made if it is not there.

    Raises
    ------
    ValueError
        If the map does not have what the format needs.
    OSError
        If something cannot be written.
    """
    target.mkdir(parents=True, exist_ok=True)
    return FORMATS[kind](built, target)


def g2o(built: Map) -> str:
    """Return the pose graph as the text of a g2o file.

    Information is in g2o's order and units: translation, then the vector part of the quaternion,
    which is half the rotation vector. Cuts are left out: they say nothing.
    """
    lines = []
    for number, pose in enumerate(built.poses):
        lines.append(f"VERTEX_SE3:QUAT {number} {_numbers(pose)}")
    lines.append("FIX 0")
    order = [3, 4, 5, 0, 1, 2]
    scale = np.repeat((1.0, 2.0), 3)
    upper = np.triu_indices(6)
    for edge in built.edges[built.edges["kind"] != CUT]:
        information = np.linalg.inv(edge["covariance"])[np.ix_(order, order)]
        information = information * scale[:, None] * scale
        weights = " ".join(f"{value:.9g}" for value in information[upper].tolist())
        ends = f"{edge['first']} {edge['second']}"
        lines.append(f"EDGE_SE3:QUAT {ends} {_numbers(edge['pose'])} {weights}")
    return "\n".join(lines) + "\n"


def occupancy(built: Map, cell: float = 0.05) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """Return an occupancy image as nav2 reads it, and the place of its lower left corner.

    Parameters
    ----------
    built : Map
    cell : float
        Edge of a pixel [m].

    Returns
    -------
    image : ndarray, shape (H, W), uint8
        Rows from the top: 0 occupied, 254 seen through, 205 unknown, at the sensor's height.
    origin : tuple of float
        x, y [m], map frame.

    Raises
    ------
    ValueError
        If the map is empty, or too large for the cells.
    """
    occupied: list[F64] = []
    rays: list[tuple[F64, F64]] = []
    for node, pose in zip(built.nodes, built.poses, strict=True):
        if node.submap is None:
            continue
        points, views = node.submap.xyz, node.submap.views.astype(np.float64)
        origins = views[node.submap.points["view"]]
        height = points[:, 2] - origins[:, 2]
        band = (height > _BAND_M[0]) & (height < _BAND_M[1])
        points, origins = points[band], origins[band]
        occupied.append(transformed(pose, points)[:, :2])
        some = slice(None, None, max(len(points) // _RAYS, 1))
        ends = transformed(pose, points[some])[:, :2]
        rays.append((transformed(pose, origins[some])[:, :2], ends))
    if not occupied or not sum(map(len, occupied)):
        raise ValueError("the map has no points at the sensor's height")
    walls = np.concatenate(occupied)
    first = np.floor(walls.min(axis=0) / cell)
    low = first * cell
    size = np.ceil((walls.max(axis=0) - low) / cell).astype(int) + 1
    if int(size[0]) * int(size[1]) > _LARGEST_IMAGE:
        raise ValueError(
            f"the map needs {size[0]} x {size[1]} cells of {cell} m; use a larger cell"
        )
    image = np.full((int(size[1]), int(size[0])), _UNKNOWN, np.uint8)

    def mark(places: F64, value: int) -> None:
        index = (np.floor(places / cell) - first).astype(int)
        index = index[((index >= 0) & (index < size)).all(axis=1)]
        image[index[:, 1], index[:, 0]] = value

    for starts, ends in rays:
        mark(_passed(starts, ends, cell), _FREE)
    mark(walls, _OCCUPIED)
    return image[::-1], (float(low[0]), float(low[1]))


def _passed(starts: F64, ends: F64, cell: float) -> F64:
    """Return places (M, 2) that rays (N, 2) pass, a cell apart, but for the last two."""
    way = ends - starts
    length = np.linalg.norm(way, axis=1)
    steps = np.maximum((length - 2.0 * cell) / cell, 0.0).astype(np.int64)
    ray = np.repeat(np.arange(len(ends)), steps)
    along = (np.arange(len(ray)) - np.repeat(np.cumsum(steps) - steps, steps)) * cell
    passed = starts[ray] + way[ray] * (along / np.maximum(length[ray], 1e-9))[:, None]
    return np.asarray(passed)


def _write_g2o(built: Map, target: Path) -> list[Path]:
    return [_text(target / "graph.g2o", g2o(built))]


def _write_tum(built: Map, target: Path) -> list[Path]:
    return [_text(target / "trajectory.tum", outputs.tum(built.trajectory()))]


def _write_kitti(built: Map, target: Path) -> list[Path]:
    return [_text(target / "trajectory.kitti", outputs.kitti(built.trajectory()))]


def _write_ply(built: Map, target: Path) -> list[Path]:
    return [_cloud(target / "map.ply", built.points())]


def _write_pcd(built: Map, target: Path) -> list[Path]:
    return [_cloud(target / "map.pcd", built.points())]


def _write_nav2(built: Map, target: Path) -> list[Path]:
    cell = 0.05
    image, origin = occupancy(built, cell)
    path = target / "map.pgm"
    head = f"P5\n{image.shape[1]} {image.shape[0]}\n255\n".encode()
    write_whole(path, head + image.tobytes())
    description = (
        f"image: {path.name}\nmode: trinary\nresolution: {cell}\n"
        f"origin: [{origin[0]:.3f}, {origin[1]:.3f}, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.25\n"
    )
    return [path, _text(target / "map.yaml", description)]


def _write_interactive_slam(built: Map, target: Path) -> list[Path]:
    """Write hdl_graph_slam's dump, which interactive_slam opens."""
    files = [_text(target / "graph.g2o", g2o(built))]
    special = "anchor_node -1\nanchor_edge -1\nfloor_node -1\n"
    files.append(_text(target / "special_nodes.csv", special))
    for number, (node, pose) in enumerate(zip(built.nodes, built.poses, strict=True)):
        folder = target / f"{number:06d}"
        folder.mkdir(exist_ok=True)
        seconds, rest = divmod(int(node.stamp), 1_000_000_000)
        text = (
            f"stamp {seconds} {rest}\nestimate\n{_rows(pose)}\nodom\n{_rows(node.T_odom_node)}\n"
            f"accum_distance {node.way:.6f}\nid {number}\n"
        )
        files.append(_text(folder / "data", text))
        files.append(_cloud(folder / "cloud.pcd", _points(built, number)))
    return files


def _write_qn(built: Map, target: Path) -> list[Path]:
    """Write what FAST-LIO-SAM-QN saves: a scan for each keyframe, and their poses."""
    scans = target / "scans"
    scans.mkdir(exist_ok=True)
    files = [
        _cloud(scans / f"{number:06d}.pcd", _points(built, number))
        for number in range(len(built.nodes))
    ]
    poses = _node_poses(built)
    files.append(_text(target / "poses_kitti.txt", outputs.kitti(poses)))
    files.append(_text(target / "poses_tum.txt", outputs.tum(poses)))
    return files


FORMATS: Final[dict[str, Callable[[Map, Path], list[Path]]]] = {
    "g2o": _write_g2o,
    "tum": _write_tum,
    "kitti": _write_kitti,
    "interactive_slam": _write_interactive_slam,
    "qn": _write_qn,
    "nav2": _write_nav2,
    "ply": _write_ply,
    "pcd": _write_pcd,
}
"""Writers by name."""


def draw(built: Map, path: Path, title: str = "") -> None:
    """Draw the map from above with the way and the loops."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 9), layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=title)
    points = built.points()
    shown = points[:: max(len(points) // 200_000, 1)]
    axes.scatter(shown[:, 0], shown[:, 1], s=0.3, c="0.6", linewidths=0, rasterized=True)
    way = built.trajectory()["pose"]
    axes.plot(way[:, 0, 3], way[:, 1, 3], lw=1.2, label=f"way, {len(built.nodes)} submaps")
    loops = built.edges[built.edges["kind"] == LOOP]
    places = built.poses[:, :2, 3]
    lines = np.stack((places[loops["first"]], places[loops["second"]]), axis=1)
    axes.add_collection(
        LineCollection(list(lines), colors="tab:red", lw=1.5, label=f"{len(loops)} loops")
    )
    axes.legend(loc="upper right")
    FigureCanvasAgg(figure)
    with whole(path) as part:
        figure.savefig(part, dpi=120)


def _node_poses(built: Map) -> StampedPoses:
    rows = np.empty(len(built.nodes), STAMPED_POSE)
    rows["stamp"] = [node.stamp for node in built.nodes]
    rows["pose"] = built.poses
    return rows


def _points(built: Map, number: int) -> F64:
    """Return the points (N, 3) of a node, or those of the nearest one that has any, its frame."""
    submap = built.nodes[number].submap
    if submap is not None:
        return submap.xyz
    distance = np.linalg.norm(built.poses[:, :3, 3] - built.poses[number, :3, 3], axis=1)
    distance[[node.submap is None for node in built.nodes]] = np.inf
    nearest = int(np.argmin(distance))
    other = built.nodes[nearest].submap
    if other is None:
        return np.zeros((0, 3))
    return transformed(inverse(built.poses[number]) @ built.poses[nearest], other.xyz)


def _numbers(pose: F64) -> str:
    """Return x y z qx qy qz qw."""
    w, x, y, z = rotations.from_matrix(pose[:3, :3]).tolist()
    return " ".join(f"{value:.9f}" for value in (*pose[:3, 3].tolist(), x, y, z, w))


def _rows(pose: F64) -> str:
    return "\n".join(" ".join(f"{value:.9f}" for value in row) for row in pose.tolist())


def _text(path: Path, content: str) -> Path:
    write_whole(path, content)
    return path


def _cloud(path: Path, points: F64) -> Path:
    outputs.save(path, points)
    return path
