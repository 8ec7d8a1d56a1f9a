"""Models the sensor's outline as a triangle mesh and writes it as a binary STL file.

The shape follows the published outline of the Unitree L2: a base of 75 mm x 75 mm, a height of
65 mm, four mounting holes on a circle of 51 mm, 22.5 degrees off the cable's axis, a dome that
turns, a cable that leaves at -X. Everything else (radii, groove, hole depth, and to which side the
holes are turned, which the outline does not say) is chosen to look right.

Run as ``python scripts/make_mesh.py [FILE]``. The same bytes come out on every machine:
only NumPy is used, and every coordinate is rounded to a micrometre.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

Vertices = NDArray[np.float64]
"""Shape (N, 3) [m], sensor frame: origin at the middle of the mounting face, z up, cable at -x."""
Triangles = NDArray[np.float64]
"""Shape (T, 3, 3) [m]: corners of each triangle, counter-clockwise seen from outside."""

BASE_M: Final = 0.075
HEIGHT_M: Final = 0.065
HOLE_CIRCLE_M: Final = 0.051
HOLE_TURN_RAD: Final = np.deg2rad(22.5)
HOLE_RADIUS_M: Final = 0.0016
HOLE_DEPTH_M: Final = 0.006

_SIDES: Final = 96
"""Vertices around the outline; a multiple of 16, so that quarters begin between the holes."""
_CORNER_M: Final = 0.010
_DOME_RADIUS_M: Final = 0.031
_CABLE_RADIUS_M: Final = 0.0035
_CABLE_HEIGHT_M: Final = 0.012
_CABLE_LENGTH_M: Final = 0.010

_STL_TRIANGLE: Final = np.dtype(
    [("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attributes", "<u2")]
)


def l2_mesh() -> Triangles:
    """Return the sensor as closed surfaces: the housing with its dome, and the cable's sleeve.

    Returns
    -------
    ndarray, shape (T, 3, 3), dtype float64
        [m] sensor frame; every edge belongs to exactly two triangles.
    """
    rings = _housing_rings()
    parts = [_bottom(rings[0]), *(_band(low, high) for low, high in pairwise(rings))]
    parts.append(_fan(rings[-1], np.array([0.0, 0.0, HEIGHT_M])))
    parts.append(_cable())
    mesh: Triangles = np.concatenate(parts).round(6)
    return mesh


def stl_bytes(triangles: Triangles) -> bytes:
    """Return a mesh as the content of a binary STL file.

    Parameters
    ----------
    triangles : ndarray, shape (T, 3, 3), dtype float64
        [m] corners, counter-clockwise seen from outside.
    """
    edges = triangles[:, 1:] - triangles[:, :1]
    normals = np.cross(edges[:, 0], edges[:, 1])
    records = np.zeros(len(triangles), _STL_TRIANGLE)
    # Rounded, so that the last bit of a square root cannot differ between machines.
    records["normal"] = np.round(normals / np.linalg.norm(normals, axis=1, keepdims=True), 5) + 0.0
    records["corners"] = triangles + 0.0  # adding zero turns -0 into 0
    header = b"Unitree L2 outline, meters, z up, cable at -x".ljust(80)
    return header + np.array([len(records)], "<u4").tobytes() + records.tobytes()


def _housing_rings() -> list[Vertices]:
    """Return the housing's horizontal cross-sections from the mounting face to below the apex."""
    half = BASE_M / 2
    rings = [
        _rounded_square(half - 0.001, _CORNER_M, 0.0),
        _rounded_square(half, _CORNER_M, 0.001),
        _rounded_square(half, _CORNER_M, 0.024),
        _rounded_square(half - 0.002, _CORNER_M, 0.027),
        _rounded_square(_DOME_RADIUS_M - 0.001, _DOME_RADIUS_M - 0.001, 0.028),
        # The groove between what stands still and what turns.
        _rounded_square(_DOME_RADIUS_M - 0.001, _DOME_RADIUS_M - 0.001, 0.0295),
        _rounded_square(_DOME_RADIUS_M, _DOME_RADIUS_M, 0.0295),
    ]
    shoulder, steps = 0.048, 8
    rise = HEIGHT_M - shoulder
    for angle in np.arange(steps) / steps * np.pi / 2:
        radius = _DOME_RADIUS_M * np.cos(angle)
        rings.append(_rounded_square(radius, radius, shoulder + rise * np.sin(angle)))
    return rings


def _rounded_square(half: float, corner: float, z: float) -> Vertices:
    """Return a square's outline with round corners, one vertex per direction from the middle."""
    angles = np.arange(_SIDES) * (2 * np.pi / _SIDES)
    direction = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    reach = half / np.abs(direction).max(axis=1)
    # Where the ray leaves through a corner it meets the corner's circle: |t d - c| = corner.
    center = np.sign(np.round(direction, 9)) * (half - corner)
    along = (direction * center).sum(axis=1)
    inside = along**2 - (center**2).sum(axis=1) + corner**2
    in_corner = (np.abs(direction) * reach[:, None] > half - corner).all(axis=1) & (inside >= 0)
    reach = np.where(in_corner, along + np.sqrt(np.maximum(inside, 0.0)), reach)
    return np.column_stack([direction * reach[:, None], np.full(_SIDES, z)])


def _band(low: Vertices, high: Vertices) -> Triangles:
    """Return the surface between two rings of equally many vertices, facing away from the axis."""
    low_next, high_next = np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)
    return np.concatenate(
        [np.stack([low, low_next, high_next], axis=1), np.stack([low, high_next, high], axis=1)]
    )


def _fan(ring: Vertices, apex: NDArray[np.float64]) -> Triangles:
    """Return the cone from a ring to a point, facing the side from which the ring runs left."""
    return np.stack([ring, np.roll(ring, -1, axis=0), np.broadcast_to(apex, ring.shape)], axis=1)


def _bottom(outline: Vertices) -> Triangles:
    """Return the mounting face with its four blind holes, seen from below.

    Each quarter of the face is a convex sector around one hole. A hole has one vertex in the
    direction of each vertex of its sector, which makes the face between them one band.
    """
    parts: list[Triangles] = []
    quarter = _SIDES // 4
    first = round(float((HOLE_TURN_RAD - np.pi / 4) / (2 * np.pi) * _SIDES))
    for index in range(4):
        angle = HOLE_TURN_RAD + index * np.pi / 2
        middle = np.array([np.cos(angle), np.sin(angle), 0.0]) * (HOLE_CIRCLE_M / 2)
        start = first + index * quarter
        arc = outline[np.arange(start, start + quarter + 1) % _SIDES]
        sector = np.concatenate([np.zeros((1, 3)), arc])
        away = sector - middle
        rim = middle + away / np.linalg.norm(away, axis=1, keepdims=True) * HOLE_RADIUS_M
        floor = rim + np.array([0.0, 0.0, HOLE_DEPTH_M])
        parts.append(_band(sector, rim)[:, ::-1])
        parts.append(_band(rim, floor)[:, ::-1])
        parts.append(_fan(floor, middle + np.array([0.0, 0.0, HOLE_DEPTH_M]))[:, ::-1])
    return np.concatenate(parts)


def _cable() -> Triangles:
    """Return the sleeve through which the cable leaves, a closed cylinder along -x."""
    angles = np.arange(24) * (2 * np.pi / 24)
    y, z = _CABLE_RADIUS_M * np.sin(angles), _CABLE_HEIGHT_M + _CABLE_RADIUS_M * np.cos(angles)
    inner_x = -(BASE_M / 2 - 0.003)
    outer_x = inner_x - _CABLE_LENGTH_M
    inner = np.column_stack([np.full_like(y, inner_x), y, z])
    outer = np.column_stack([np.full_like(y, outer_x), y, z])
    ends = (np.array([x, 0.0, _CABLE_HEIGHT_M]) for x in (inner_x, outer_x))
    inner_end, outer_end = ends
    sleeve = _band(inner, outer)
    return np.concatenate([sleeve, _fan(outer, outer_end), _fan(inner, inner_end)[:, ::-1]])


def main(arguments: Sequence[str]) -> None:
    """Write the mesh to the file named, by default the package's own."""
    default = Path(__file__).resolve().parent.parent / "meshes" / "l2_lidar.stl"
    path = Path(arguments[0]) if arguments else default
    content = stl_bytes(l2_mesh())
    path.write_bytes(content)
    print(f"{path}: {len(content)} bytes")


if __name__ == "__main__":
    main(sys.argv[1:])
