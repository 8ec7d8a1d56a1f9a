"""Ray casting: static triangles, moving bodies, glass, mirrors and people."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.emulator.motion.motion import Motion
from l2lidar_node.emulator.world.scene import Ground, Triangles, box, cone, ellipsoid
from l2lidar_node.types import F64

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

        Vertex colors, where present, become reflectivity (mean of the channels, at least 0.05).

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
        """Return the first hits of rays.

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
    colors = np.asarray(mesh.vertex_colors)
    if len(colors) != len(vertices):
        return vertices[indices], DEFAULT_REFLECTIVITY
    return vertices[indices], np.maximum(colors[indices].mean(axis=(1, 2)), 0.05)


Poses = Callable[[F64], tuple[F64, F64]]
"""Positions (N, 3) [m] and quaternions w, x, y, z (N, 4), body to world, at instants (N,) [s]."""

_GLASS_RETURNS: Final = 0.985  # cosine of incidence: within 10 degrees of the normal glass shines
_GLASS_REFLECTIVITY: Final = 0.25
_GLASS_PASSES: Final = 0.8  # share of the signal after two passes through a pane
_MIRROR_KEEPS: Final = 0.85
_CULL_KNOTS: Final = 17


@dataclass(frozen=True, slots=True, eq=False)
class Mover:
    """A rigid body that moves through the world.

    Attributes
    ----------
    body : World
        Its surface in its own frame.
    poses : callable
        Where the body's frame is, see :data:`Poses`.
    radius : float
        No part of the body is farther than this from the frame's origin [m].
    """

    body: World
    poses: Poses
    radius: float

    @classmethod
    def of(cls, body: World, poses: Poses) -> Mover:
        """Return a body with the radius that its corners need."""
        corners = body.triangles.reshape(-1, 3)
        return cls(body, poses, float(np.linalg.norm(corners, axis=1).max()) + 1e-6)


class MovingWorld(World):
    """A static world, rigid bodies that move in it, panes of glass and mirrors.

    A beam that meets glass within 10 degrees of its normal comes back from the pane, any other
    goes through it. A mirror sends a beam on: what it then meets appears behind the mirror.

    Parameters
    ----------
    solid : World
        What neither moves nor shines.
    movers : sequence of Mover
    glass, mirrors : World, optional
    """

    def __init__(
        self,
        solid: World,
        movers: Sequence[Mover] = (),
        glass: World | None = None,
        mirrors: World | None = None,
    ) -> None:
        self.triangles = solid.triangles
        self.reflectivity = solid.reflectivity
        self.solid = solid
        self.movers = tuple(movers)
        self._glass = glass
        self._mirrors = mirrors

    def cast(self, origins: F64, directions: F64, times: F64 | None = None) -> NDArray[np.void]:
        """Return the first hits of rays, shape (N,), dtype HIT; see :meth:`World.cast`.

        Parameters
        ----------
        origins, directions : ndarray, shape (N, 3)
        times : ndarray, shape (N,), optional
            Instant of each ray [s]; without it all bodies are where they are at time 0.
        """
        when = np.zeros(len(origins)) if times is None else times
        hits = self._opaque(origins, directions, when)
        if self._mirrors is not None:
            self._reflect(hits, self._mirrors, origins, directions, when)
        if self._glass is not None:
            panes = self._glass.cast(origins, directions)
            met = panes["distance"] < hits["distance"]
            shine = met & (panes["incidence"] > _GLASS_RETURNS)
            hits["reflectivity"][met] *= _GLASS_PASSES
            hits[shine] = panes[shine]
            hits["reflectivity"][shine] = _GLASS_REFLECTIVITY
        return hits

    def distances(
        self, origins: F64, directions: F64, times: F64 | None = None
    ) -> NDArray[np.float32]:
        """Return only how far rays go, shape (N,), see :meth:`cast`."""
        return self.cast(origins, directions, times)["distance"].astype(np.float32)

    def clearance(self, points: F64) -> F64:
        """Return the distance [m] of points (N, 3) to the nearest surface that does not move."""
        return self.solid.clearance(points)

    def _reflect(
        self, hits: NDArray[np.void], mirrors: World, origins: F64, directions: F64, when: F64
    ) -> None:
        """Replace the hits of the beams that meet a mirror first."""
        met = mirrors.cast(origins, directions)
        sent = np.flatnonzero(met["distance"] < hits["distance"])
        if not len(sent):
            return
        there, ahead = met["distance"][sent, None], directions[sent]
        normal = met["normal"][sent]
        away = ahead - 2.0 * np.einsum("ni,ni->n", ahead, normal)[:, None] * normal
        # off the mirror by 0.1 mm, or the beam meets it again
        again = self._opaque(origins[sent] + there * ahead + 1e-4 * away, away, when[sent])
        again["distance"] += met["distance"][sent]
        again["reflectivity"] *= _MIRROR_KEEPS
        hits[sent] = again

    def _opaque(self, origins: F64, directions: F64, when: F64) -> NDArray[np.void]:
        """Return the hits of rays on static triangles and moving bodies."""
        hits = self.solid.cast(origins, directions)
        if not len(when):
            return hits
        span = np.linspace(when.min(), when.max(), _CULL_KNOTS)
        for mover in self.movers:
            near = np.flatnonzero(_passes(mover, span, origins, directions, when))
            if not len(near):
                continue
            position, quaternion = mover.poses(when[near])
            turn = rotations.matrices(quaternion)
            start = np.einsum("nji,nj->ni", turn, origins[near] - position)
            ahead = np.einsum("nji,nj->ni", turn, directions[near])
            met = mover.body.cast(start, ahead)
            first = met["distance"] < hits["distance"][near]
            met["normal"] = np.einsum("nij,nj->ni", turn, met["normal"])
            hits[near[first]] = met[first]
        return hits


def _passes(
    mover: Mover, span: F64, origins: F64, directions: F64, when: F64
) -> NDArray[np.bool_]:
    """Return which rays pass the sphere around a body, whose way is taken as straight pieces."""
    knots = mover.poses(span)[0]
    if span[-1] > span[0]:
        center = np.stack([np.interp(when, span, knots[:, axis]) for axis in range(3)], axis=1)
    else:
        center = np.repeat(knots[:1], len(when), axis=0)
    to = center - origins
    along = np.maximum(np.einsum("ni,ni->n", to, directions), 0.0)
    missed = np.linalg.norm(to - along[:, None] * directions, axis=1)
    # straight pieces: a body turning back within 1/16 of a batch is still inside this margin
    return np.asarray(missed < mover.radius + 0.05)


_KNOTS_PER_S: Final = 5.0
_NEAREST_M: Final = 0.75  # people keep this distance to the sensor
_CLOTHES: Final = (0.2, 0.6)  # reflectivity


def person(height: float = 1.75) -> Triangles:
    """Return a standing person, feet at z = 0, facing +x."""
    s = height / 1.75
    parts = [
        cone((0.06 * s, 0.1 * s, 0.0), 0.06 * s, 0.085 * s, 0.85 * s, 8),
        cone((-0.06 * s, -0.1 * s, 0.0), 0.06 * s, 0.085 * s, 0.85 * s, 8),
        ellipsoid((0.0, 0.0, 1.14 * s), (0.14 * s, 0.21 * s, 0.36 * s), 0.05, 12),
        ellipsoid((0.02 * s, 0.0, 1.62 * s), (0.1 * s, 0.085 * s, 0.13 * s), 0.0, 10),
        box((-0.08 * s, 0.22 * s, 0.75 * s), (0.06 * s, 0.3 * s, 1.4 * s)),
        box((-0.04 * s, -0.3 * s, 0.75 * s), (0.1 * s, -0.22 * s, 1.4 * s)),
    ]
    return np.concatenate(parts)


def crowd(
    motion: Motion, ground: Ground, count: int, seconds: float, seed: int = 0
) -> list[Mover]:
    """Return people around a sensor: two of three go with it, the others cross its way.

    Those who go along keep 0.8 to 2.5 m away and drift around the sensor; those who cross come
    from 12 m away, pass it at some 1 to 3 m and walk on, again and again.

    Parameters
    ----------
    motion : Motion
        The sensor's.
    ground : callable
        Height of the ground, see :class:`Scene`.
    count : int
        How many people.
    seconds : float
        Until when; afterwards they stand.
    seed : int
    """
    rng = np.random.default_rng((seed, 12))
    t = np.arange(0.0, seconds + 1.0, 1.0 / _KNOTS_PER_S)
    sensor = motion.poses(t)[0][:, :2]
    width = round(2.0 * _KNOTS_PER_S)  # people do not follow every sway of the sensor
    window = np.ones(2 * width + 1) / (2 * width + 1)
    padded = np.pad(sensor, ((width, width), (0, 0)), mode="edge")
    way = np.stack([np.convolve(padded[:, k], window, "valid") for k in range(2)], axis=1)
    movers = []
    for number in range(count):
        if number % 3 < 2:
            radius = rng.uniform(1.0, 2.4) + 0.3 * np.sin(rng.uniform(0.1, 0.4) * t)
            angle = rng.uniform(0.0, 2.0 * np.pi) + rng.uniform(-0.15, 0.15) * t
            angle = angle + 0.4 * np.sin(rng.uniform(0.1, 0.5) * t)
            place = way + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        else:
            place = _crossing(way, t, rng)
        place = _apart(place, sensor)
        body = World(person(float(rng.uniform(1.6, 1.9))), float(rng.uniform(*_CLOTHES)))
        movers.append(Mover.of(body, _on_foot(t, place, ground)))
    return movers


def _crossing(way: F64, t: F64, rng: np.random.Generator) -> F64:
    """Return the places of someone who walks across the sensor's way, there and back."""
    speed, half = rng.uniform(0.8, 1.5), 12.0
    traveled = np.abs(np.mod(rng.uniform(0.0, 4 * half) + speed * t, 4 * half) - 2 * half) - half
    side = rng.uniform(-3.0, 3.0) + np.sin(rng.uniform(0.05, 0.2) * t)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    ahead = np.array([np.cos(angle), np.sin(angle)])
    left = np.array([-ahead[1], ahead[0]])
    return np.asarray(way + traveled[:, None] * ahead + side[:, None] * left)


def _apart(place: F64, sensor: F64) -> F64:
    """Return places pushed away from the sensor to the nearest distance allowed."""
    to = place - sensor
    far = np.maximum(np.linalg.norm(to, axis=1, keepdims=True), 1e-3)
    return np.asarray(sensor + to * np.maximum(1.0, _NEAREST_M / far))


def _on_foot(t: F64, place: F64, ground: Ground) -> Poses:
    """Return the poses of someone who looks where he goes, between places at instants."""
    step = np.gradient(place, t, axis=0)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    z = ground(place[:, 0], place[:, 1])

    def poses(when: F64) -> tuple[F64, F64]:
        x, y, up, yaw = (
            np.interp(when, t, values) for values in (place[:, 0], place[:, 1], z, heading)
        )
        zero = np.zeros_like(yaw)
        quaternion = np.stack([np.cos(yaw / 2.0), zero, zero, np.sin(yaw / 2.0)], axis=1)
        return np.stack([x, y, up], axis=1), quaternion

    return poses
