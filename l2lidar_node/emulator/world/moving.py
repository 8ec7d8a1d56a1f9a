"""A world in which things move, glass lets beams through and mirrors send them elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.emulator.world.world import World
from l2lidar_node.types import F64

Poses = Callable[[F64], tuple[F64, F64]]
"""Positions (N, 3) [m] and quaternions w, x, y, z (N, 4), body to world, at instants (N,) [s]."""

_GLASS_RETURNS: Final = 0.985  # cosine of incidence: within 10 degrees of the normal glass shines
_GLASS_REFLECTIVITY: Final = 0.25
_GLASS_PASSES: Final = 0.8  # share of the signal after two passes through a pane
_MIRROR_KEEPS: Final = 0.85
_CULL_KNOTS: Final = 17


@dataclass(frozen=True, slots=True, eq=False)
class Mover:
    """A rigid body on its way through the world.

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
        """Return what rays meet first, shape (N,), dtype HIT; see :meth:`World.cast`.

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
        """Return what rays meet among static things and moving bodies."""
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
        centre = np.stack([np.interp(when, span, knots[:, axis]) for axis in range(3)], axis=1)
    else:
        centre = np.repeat(knots[:1], len(when), axis=0)
    to = centre - origins
    along = np.maximum(np.einsum("ni,ni->n", to, directions), 0.0)
    missed = np.linalg.norm(to - along[:, None] * directions, axis=1)
    # straight pieces: a body turning back within 1/16 of a batch is still inside this margin
    return np.asarray(missed < mover.radius + 0.05)
