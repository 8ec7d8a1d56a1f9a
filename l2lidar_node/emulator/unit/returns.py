"""Returns of rays: range noise, drop-outs, mixed pixels, intensity, limits.

Sizes are as measured on real recordings of the L2, see the constants.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.rng import Stream, generator
from l2lidar_node.emulator.unit.units import UnitErrors
from l2lidar_node.emulator.world.world import World
from l2lidar_node.settings import setting

# 1-sigma range noise sqrt(NEAR^2 + (FAR * D^1.25)^2): 11-14 mm to 10 m, 17 mm at 12.5, 26 mm at 20
NOISE_NEAR_M: Final = 0.0105
NOISE_FAR: Final = 0.00056

# drop-outs that no weak signal explains, per packet of 300 slots
RUNS_PER_SLOT: Final = 1.7 / 300
SINGLES_PER_SLOT: Final = 1.2 / 300
RUN_LONGEST: Final = 9  # run lengths 1..9, even spread: median 5

# reflectivity * incidence / D^2 that is found half of the time: 0.9 at 42 m, 0.1 at 14 m
WEAKEST_SIGNAL: Final = 0.0005
PULSE_M: Final = (
    0.4  # depth steps below this blend, larger ones give the nearer surface or the farther
)

_SLOT_DRAWS = 6

# rain and dust: a beam that meets a particle comes back from it as from a dark surface, and only
# from nearby (Goodin et al. 2019, "Predicting the influence of rain on lidar": most false returns
# come from the first ten meters)
_PARTICLE_REFLECTIVITY: Final = 0.3
_PARTICLE_FARTHEST_M: Final = 12.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeNoise:
    """Imperfections of ranges; 0 switches an effect off."""

    range_noise: float = setting(1.0, "factor on the measured range noise", lo=0.0, hi=100.0)
    dropout: float = setting(1.0, "factor on the measured rate of drop-outs", lo=0.0, hi=20.0)
    weak_signal: bool = setting(
        True, "whether dark, slanted and distant surfaces may give no return"
    )
    divergence_mrad: float = setting(
        4.0, "full width of the beam; 0 = no mixed pixels at edges", unit="mrad", lo=0.0, hi=50.0
    )
    head_wobble: float = setting(1.0, "factor on the measured wobble of the head", lo=0.0, hi=20.0)
    particles: float = setting(
        0.0,
        "drops or grains of dust that a beam meets per meter; heavy rain 0.02, dense dust 0.2",
        unit="1/m",
        lo=0.0,
        hi=10.0,
    )

    @classmethod
    def clean(cls) -> RangeNoise:
        """Return settings with every effect off: ranges are exact up to the raw count's step."""
        return cls(
            range_noise=0.0, dropout=0.0, weak_signal=False, divergence_mrad=0.0, head_wobble=0.0
        )


def noise_sigma(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the standard deviation [m] of a range [m], as measured on a real unit."""
    return np.sqrt(NOISE_NEAR_M**2 + (NOISE_FAR * distance**1.25) ** 2)


def particle_distances(
    uniform: NDArray[np.float32] | NDArray[np.float64], particles: float
) -> NDArray[np.float64]:
    """Return how far beams go until they meet a particle [m], inf beyond the 12 m that matter.

    Parameters
    ----------
    uniform : ndarray, any shape
        Random numbers, 0 to 1.
    particles : float
        Particles that a beam meets per meter, on average.
    """
    free = -np.log1p(-np.asarray(uniform, np.float64)) / particles
    return np.where(free < _PARTICLE_FARTHEST_M, free, np.inf)


def fill(
    packets: NDArray[np.void],
    rays: NDArray[np.void],
    world: World,
    noise: RangeNoise,
    seed: int,
    first: int,
    errors: UnitErrors | None = None,
) -> None:
    """Cast rays and fill in the packets' ranges and intensities and the rays' distances.

    Parameters
    ----------
    packets : ndarray, shape (P,)
        Point packets whose calibration and range limits are filled in.
    rays : ndarray, shape (P, N), dtype scanner.RAY
        ``time``, ``origin`` and ``direction`` are filled in.
    world : World
    noise : RangeNoise
    seed : int
    first : int
        Number of the first packet.
    errors : UnitErrors, optional
        Of the range finder; those of the block are in the packets' calibration already.
    """
    count, slots = rays.shape
    draws = _Draws(seed, first, count, slots)
    flat = rays.reshape(-1)
    hits = world.cast(flat["origin"], flat["direction"], flat["time"]).reshape(count, slots)
    rays["distance"] = hits["distance"]
    seen = hits["distance"].copy()
    if noise.divergence_mrad > 0:
        _mix(seen, rays, world, noise.divergence_mrad * 1e-3, draws)
    strength = hits["reflectivity"] * hits["incidence"]
    if noise.particles > 0:
        grain = particle_distances(draws.uniform[5], noise.particles)
        strength = np.where(grain < seen, _PARTICLE_REFLECTIVITY, strength)
        seen = np.minimum(seen, grain)
    back = np.isfinite(seen)
    distance = np.where(back, seen, 1.0)
    signal = strength / np.maximum(distance, 0.1) ** 2
    if noise.weak_signal:
        back &= signal > WEAKEST_SIGNAL * np.exp(0.3 * draws.normal[1])
    if noise.dropout > 0:
        back &= ~_dropped(draws, noise.dropout)
    distance = distance + noise.range_noise * noise_sigma(distance) * draws.normal[0]
    if errors is not None and not errors.are_none:
        distance = distance + errors.range_response(
            distance, hits["incidence"], hits["reflectivity"]
        )
    back &= (distance >= packets["range_min"][:, None]) & (
        distance <= packets["range_max"][:, None]
    )
    scale = packets["calibration"]["range_scale"].astype(np.float64)[:, None]
    bias = packets["calibration"]["range_bias"].astype(np.float64)[:, None]
    raw = np.clip(np.rint(distance / scale - bias), 0, 0xFFFF)
    raw = np.where(back, raw, 0).astype(np.uint16)
    packets["ranges"] = raw
    rays["measured"] = np.where(raw > 0, scale * (raw + bias), 0.0)
    bright = 210.0 * np.sqrt(strength) / (1.0 + (distance / 25.0) ** 2)
    bright = np.clip(np.rint(bright * (1.0 + 0.04 * draws.normal[1])), 1, 255)
    packets["intensities"] = np.where(raw > 0, bright, 0)


class _Draws:
    """The random numbers of consecutive packets; arrays of shape (K, P, N)."""

    def __init__(self, seed: int, first: int, count: int, slots: int) -> None:
        self.normal = np.empty((2, count, slots), np.float32)
        self.uniform = np.empty((_SLOT_DRAWS, count, slots), np.float32)
        for k in range(count):
            source = generator(seed, Stream.RANGE, first + k)
            self.normal[:, k] = source.standard_normal((2, slots), dtype=np.float32)
            self.uniform[:, k] = source.random((_SLOT_DRAWS, slots), dtype=np.float32)


def _mix(
    seen: NDArray[np.float64], rays: NDArray[np.void], world: World, width: float, draws: _Draws
) -> None:
    """Let a second ray within each beam pull the range where it meets another depth."""
    direction = rays["direction"]
    helper = np.where(np.abs(direction[..., 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    side = np.cross(direction, helper)
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    up = np.cross(side, direction)
    radius = (width / 2.0) * np.sqrt(draws.uniform[0])[..., None]
    angle = (2.0 * np.pi * draws.uniform[1])[..., None]
    other = direction + radius * (np.cos(angle) * side + np.sin(angle) * up)
    other /= np.sqrt(1.0 + radius**2)
    flat = rays.reshape(-1)
    beside = world.distances(flat["origin"], other.reshape(-1, 3), flat["time"])
    beside = beside.reshape(seen.shape).astype(np.float64)
    share = draws.uniform[2] * 0.5  # of the beam that meets the other surface
    with np.errstate(invalid="ignore"):  # inf - inf: nothing is there
        step = beside - seen
    blends = np.abs(step) < PULSE_M
    seen[blends] += share[blends] * step[blends]
    swaps = ~blends & (share > 0.35) & np.isfinite(beside)
    seen[swaps] = beside[swaps]


def _dropped(draws: _Draws, rate: float) -> NDArray[np.bool_]:
    """Return which slots are lost to runs and single drop-outs, shape (P, N)."""
    starts = draws.uniform[3] < rate * RUNS_PER_SLOT
    lost = draws.uniform[4] < rate * SINGLES_PER_SLOT
    # what is left of the number that began the run is its length
    length = 1 + np.floor(draws.uniform[3] / (rate * RUNS_PER_SLOT) * RUN_LONGEST).astype(np.int64)
    for offset in range(RUN_LONGEST):
        reach = starts & (length > offset)
        lost[:, offset:] |= reach[:, : reach.shape[1] - offset]
    return np.asarray(lost)
