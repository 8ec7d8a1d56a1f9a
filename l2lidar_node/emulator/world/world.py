"""Answers what a ray meets: triangles with a reflectivity, cast by open3d's RaycastingScene."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

HIT: Final = np.dtype(
    [("distance", "<f8"), ("incidence", "<f8"), ("reflectivity", "<f4"), ("normal", "<f8", (3,))]
)
"""What one ray met: distance [m], inf = nothing; cosine of incidence; reflectivity 0..1; normal of
the surface, on either side of it."""

DEFAULT_REFLECTIVITY: Final = 0.5

_MISSED = 0xFFFF_FFFF  # open3d's primitive number of a ray that met nothing


class World:
    """A static world of triangles.

    Parameters
    ----------
    triangles : ndarray, shape (T, 3, 3)
        Corners [m], world frame, z up. Triangles without area are left out. Both sides reflect.
    reflectivity : ndarray, shape (T,), or float
        Diffuse reflectivity of each triangle, 0..1.
    threads : int
        Threads for casting rays.

    Attributes
    ----------
    triangles : ndarray, shape (T, 3, 3)
        The triangles with an area, float64, read-only.
    reflectivity : ndarray, shape (T,), float32
        Read-only.

    Raises
    ------
    ValueError
        If no triangle with an area is left, or a corner is not finite.
    """

    def __init__(
        self,
        triangles: NDArray[np.float64],
        reflectivity: NDArray[np.float64] | float = DEFAULT_REFLECTIVITY,
        *,
        threads: int = 1,
    ) -> None:
        triangles = np.asarray(triangles, np.float64)
        if triangles.ndim != 3 or triangles.shape[1:] != (3, 3):
            raise ValueError(f"triangles: expected shape (T, 3, 3), got {triangles.shape}")
        if not np.isfinite(triangles).all():
            raise ValueError("triangles: a corner is not finite")
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        length = np.linalg.norm(normals, axis=1)
        solid = length > 1e-12
        if not solid.any():
            raise ValueError("triangles: all have zero area")
        self.triangles = triangles[solid]
        self.reflectivity = np.broadcast_to(np.asarray(reflectivity, np.float32), len(triangles))[
            solid
        ]
        self._normals = normals[solid] / length[solid, None]
        self._offsets = np.einsum("ti,ti->t", self._normals, self.triangles[:, 0])
        corners = self.triangles.reshape(-1, 3)
        self._middle = (corners.min(axis=0) + corners.max(axis=0)) / 2.0  # float32 is finest there
        self._threads = threads
        self._scene = self._build()
        for array in (self.triangles, self.reflectivity):
            array.flags.writeable = False

    @classmethod
    def load(cls, path: str | Path, *, threads: int = 1) -> World:
        """Return the world of a mesh file in any format open3d reads (PLY, STL, OBJ, OFF, glTF).

        Vertex colours, where present, become reflectivity (mean of the channels, at least 0.05).

        Raises
        ------
        ValueError
            Naming the file, if it cannot be read or has no triangle with an area.
        """
        triangles, reflectivity = _read_mesh(Path(path))
        try:
            return cls(triangles, reflectivity, threads=threads)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def cast(
        self,
        origins: NDArray[np.float64],
        directions: NDArray[np.float64],
        times: NDArray[np.float64] | None = None,
    ) -> NDArray[np.void]:
        """Return what rays meet first.

        open3d finds the triangle in float32; the distance is then computed from that triangle's
        plane in float64, so hits lie on their plane to 1e-12 m.

        Parameters
        ----------
        origins, directions : ndarray, shape (N, 3)
            World frame; directions are unit vectors.
        times : ndarray, shape (N,), optional
            Instant of each ray [s]; nothing moves here, see :class:`moving.MovingWorld`.

        Returns
        -------
        ndarray, shape (N,), dtype HIT
        """
        triangles, rough = self._trace(origins, directions)
        hits = np.zeros(len(rough), HIT)
        hits["distance"] = rough
        met = np.flatnonzero(triangles != _MISSED)
        triangles = triangles[met]
        normal = self._normals[triangles]
        towards = np.einsum("ni,ni->n", normal, directions[met])
        height = self._offsets[triangles] - np.einsum("ni,ni->n", normal, origins[met])
        with np.errstate(divide="ignore", invalid="ignore"):
            exact = height / towards
        # a ray within a triangle's plane has no exact crossing
        sound = np.abs(exact - rough[met]) < 1e-3 * (1.0 + rough[met])
        hits["distance"][met[sound]] = exact[sound]
        hits["incidence"][met] = np.abs(towards)
        hits["reflectivity"][met] = self.reflectivity[triangles]
        hits["normal"][met] = normal
        return hits

    def distances(
        self,
        origins: NDArray[np.float64],
        directions: NDArray[np.float64],
        times: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float32]:
        """Return only how far rays go, in float32 (some 1e-6 m), shape (N,); see :meth:`cast`."""
        return self._trace(origins, directions)[1]

    def clearance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance [m] of points (N, 3) to the nearest surface, shape (N,)."""
        import open3d as o3d

        query = o3d.core.Tensor.from_numpy((points - self._middle).astype(np.float32))
        distance = self._scene.compute_distance(query, nthreads=self._threads).numpy()
        return np.asarray(distance, np.float64)

    def _trace(
        self, origins: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.uint32], NDArray[np.float32]]:
        """Return number of the triangle met and distance of every ray."""
        import open3d as o3d

        rays = np.empty((len(origins), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origins - self._middle, directions
        answer = self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=self._threads)
        return answer["primitive_ids"].numpy(), answer["t_hit"].numpy()

    def _build(self) -> Any:
        """Return open3d's scene; it has no type stubs."""
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene(nthreads=self._threads)
        vertices = (self.triangles.reshape(-1, 3) - self._middle).astype(np.float32)
        indices = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
        scene.add_triangles(
            o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(indices)
        )
        return scene


def _read_mesh(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64] | float]:
    """Return triangles and reflectivity of a mesh file."""
    import open3d as o3d

    if not path.is_file():
        raise ValueError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        try:
            mesh = o3d.io.read_triangle_mesh(path)
        except RuntimeError as error:
            raise ValueError(f"{path}: cannot be read as a mesh: {error}") from None
    vertices, indices = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    if len(indices) == 0:
        raise ValueError(
            f"{path}: holds no triangles (not a mesh open3d can read, or only points)"
        )
    if indices.min() < 0 or indices.max() >= len(vertices):
        raise ValueError(f"{path}: a face refers to a missing vertex")
    colours = np.asarray(mesh.vertex_colors)
    if len(colours) != len(vertices):
        return vertices[indices], DEFAULT_REFLECTIVITY
    return vertices[indices], np.maximum(colours[indices].mean(axis=(1, 2)), 0.05)
