"""The hard runs: what is seen, by which sensor, on which way, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from l2lidar_node.emulator.motion import trajectories
from l2lidar_node.emulator.motion.motion import MOUNTS, Motion
from l2lidar_node.emulator.unit.inertial import ImuNoise
from l2lidar_node.emulator.unit.scanner import View, carrier
from l2lidar_node.emulator.world import buildings, scenes
from l2lidar_node.emulator.world.scene import Scene
from l2lidar_node.emulator.world.world import Mover, MovingWorld, World, crowd
from l2lidar_node.types import F64

SCENES: Final[dict[str, Callable[[int], Scene]]] = {
    "flat": buildings.flat,
    "office_corridor": buildings.office_corridor,
    "hall": buildings.hall,
    "stairwell": buildings.stairwell,
    "atrium": buildings.atrium,
    "wood": scenes.wood,
    "trunks": scenes.trunks,
    "room": lambda seed: scenes.make("room"),
    "yard": lambda seed: scenes.make("yard"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """One hard run; everything random about it follows from the seed.

    Attributes
    ----------
    family : str
        Runs of a family differ in their seed alone.
    seed : int
    seconds : float
    scene : str
        One of :data:`SCENES`.
    motion : str
        A style of :data:`trajectories.STYLES`, or one of :data:`trajectories.MOTIONS`.
    sensor : str
        ``l2``, or one of :data:`other_sensors.SENSORS`.
    speed : float
        [m/s]; 0 = the motion's own.
    mount : str
    sector_deg : float
        What the carrier leaves of the view in azimuth; 360 = all.
    cone_deg : float
        Opening angle of a cone about the sensor's axis; 360 = all.
    carrier : str
        One of :data:`scanner.CARRIERS`, or empty.
    people : int
    particles : float
        Rain or dust, see ``RangeNoise.particles``.
    covers : int
        How often something covers the sensor for 2 to 4 s.
    hits : int
        Blows per 10 s.
    rest_s : float
        Rest at the beginning [s].
    imperfect : bool
        Whether the unit has every fault of :class:`Imperfections`.
    drawn_unit : bool
        Whether the unit is one of the virtual L2's population, which the seed draws, instead of
        one with the beam angles, ranges and IMU of :class:`Imperfections`.
    """

    family: str = ""
    seed: int = 0
    seconds: float = 60.0
    scene: str
    motion: str
    sensor: str = "l2"
    speed: float = 0.0
    mount: str = "upright"
    sector_deg: float = 360.0
    cone_deg: float = 360.0
    carrier: str = ""
    people: int = 0
    particles: float = 0.0
    covers: int = 0
    hits: int = 0
    rest_s: float = 2.0
    imperfect: bool = False
    drawn_unit: bool = False


@dataclass(frozen=True, slots=True)
class Imperfections:
    """What a unit's own figures do not say; sizes as in the field, signs from the seed.

    Attributes
    ----------
    beam_rad : float
        Error of both beam angles.
    range_scale : float
        Relative error of ranges.
    extrinsic_rad : float
        How far the IMU is turned from where it is taken to be.
    imu_late_s : float
        IMU stamps come from that much later than the measurement.
    shake_force, shake_rate : float
        Amplitude of each of three lines in accelerometer [m/s^2] and gyro [rad/s].
    packets_lost : float
        Share of packets lost.
    imu_gaps : int
        Gaps of 20 to 60 ms in the IMU samples, per minute.
    """

    beam_rad: float = float(np.deg2rad(0.4))
    range_scale: float = 0.002
    extrinsic_rad: float = float(np.deg2rad(0.5))
    imu_late_s: float = 0.002
    shake_force: float = 0.6
    shake_rate: float = 0.03
    packets_lost: float = 0.01
    imu_gaps: int = 5


FAMILIES: Final[dict[str, Scenario]] = {
    # narrow views
    "camera, looking into rooms": Scenario(scene="flat", motion="look", sensor="depth_camera"),
    "camera, stairs": Scenario(scene="stairwell", motion="climb", sensor="depth_camera"),
    "camera, room": Scenario(scene="room", motion="walk", speed=0.4, sensor="depth_camera"),
    "corridor, 120 degrees, imperfect": Scenario(
        scene="office_corridor", motion="drive", sector_deg=120.0, imperfect=True
    ),
    "corridor, 80 degrees": Scenario(scene="office_corridor", motion="drive", sector_deg=80.0),
    "flat, cone of 70 degrees": Scenario(
        scene="flat", motion="look", mount="forward", cone_deg=70.0
    ),
    "yard on a quadruped": Scenario(
        scene="yard", motion="trot", sector_deg=200.0, carrier="quadruped", imperfect=True
    ),
    "hall behind a backpack": Scenario(
        scene="hall", motion="walk", speed=1.2, carrier="backpack", mount="tilted", imperfect=True
    ),
    # scenes that hardly fix the pose
    "corridor, imperfect": Scenario(scene="office_corridor", motion="drive", imperfect=True),
    "bare trunks": Scenario(scene="trunks", motion="walk"),
    "bare trunks, imperfect": Scenario(scene="trunks", motion="drone", imperfect=True),
    "stairs": Scenario(scene="stairwell", motion="climb", imperfect=True),
    "lift in an atrium": Scenario(scene="atrium", motion="look", speed=0.8),
    # every imperfection at once
    "room, imperfect": Scenario(scene="room", motion="walk", imperfect=True, people=2),
    "hall, imperfect": Scenario(scene="hall", motion="walk", speed=1.2, imperfect=True, people=4),
    "wood, imperfect": Scenario(scene="wood", motion="walk", speed=1.2, imperfect=True),
    # what is in the way, and what happens
    "crowd in a hall": Scenario(scene="hall", motion="walk", mount="forward", people=24),
    "flat with glass and mirror": Scenario(scene="flat", motion="look", imperfect=True),
    "wood in rain": Scenario(
        scene="wood", motion="walk", speed=1.2, particles=0.01, imperfect=True
    ),
    "yard in dust": Scenario(scene="yard", motion="trot", particles=0.05),
    "covered, room": Scenario(scene="room", motion="walk", covers=2),
    "hits, hall": Scenario(scene="hall", motion="trot", hits=4, imperfect=True),
    "in motion from the first sweep": Scenario(
        scene="yard", motion="walk", speed=1.2, rest_s=0.0, imperfect=True
    ),
    # units of the population: alpha, range bias and head wave are off as well
    "room, drawn unit": Scenario(
        scene="room", motion="walk", imperfect=True, drawn_unit=True, people=2
    ),
    "corridor, drawn unit": Scenario(
        scene="office_corridor", motion="drive", imperfect=True, drawn_unit=True
    ),
    "hall, drawn unit": Scenario(
        scene="hall", motion="walk", speed=1.2, imperfect=True, drawn_unit=True, people=4
    ),
    "wood, drawn unit": Scenario(
        scene="wood", motion="walk", speed=1.2, imperfect=True, drawn_unit=True
    ),
    "flat, drawn unit": Scenario(scene="flat", motion="look", imperfect=True, drawn_unit=True),
    # and what such a unit sees of natural ground, where it is not upright
    "wood ahead of a drone, drawn unit": Scenario(
        scene="wood", motion="drone", mount="forward", imperfect=True, drawn_unit=True
    ),
    "yard below a drone, drawn unit": Scenario(
        scene="yard", motion="drone", mount="upside_down", imperfect=True, drawn_unit=True
    ),
    # other sensors
    "spinning lidar, corridor": Scenario(
        scene="office_corridor", motion="drive", sensor="spinning_16"
    ),
    "rosette lidar, flat": Scenario(scene="flat", motion="look", sensor="rosette"),
    # people who walk beside a carrier, between walls that hardly fix its place
    "people in a corridor": Scenario(
        scene="office_corridor", motion="drive", people=12, imperfect=True
    ),
    "people in a corridor, 120 degrees": Scenario(
        scene="office_corridor", motion="drive", people=8, sector_deg=120.0, imperfect=True
    ),
}
"""Scenarios by the name of their family; seed and length are set by :func:`scenario`."""

SHORT: Final = (
    "camera, looking into rooms",
    "camera, room",
    "corridor, 120 degrees, imperfect",
    "corridor, 80 degrees",
    "corridor, imperfect",
    "bare trunks",
    "stairs",
    "lift in an atrium",
    "room, imperfect",
    "hall, imperfect",
    "wood, imperfect",
    "crowd in a hall",
    "wood in rain",
    "covered, room",
    "hits, hall",
    "room, drawn unit",
    "rosette lidar, flat",
)
"""Families of the short version."""


MIXED: Final = "mixed"
"""Name of the family whose runs differ in everything, as :func:`mixed` draws it."""

STARTS: Final = "starts"
"""Name of the family whose runs begin in motion, as :func:`starts` draws it."""

NARROW_STARTS: Final = "narrow starts"
"""Name of the family whose runs begin in motion with a narrow view or another sensor."""

_NARROW: Final = (
    FAMILIES["camera, looking into rooms"],
    FAMILIES["camera, stairs"],
    FAMILIES["camera, room"],
    FAMILIES["rosette lidar, flat"],
    FAMILIES["spinning lidar, corridor"],
    FAMILIES["flat, cone of 70 degrees"],
    FAMILIES["corridor, 120 degrees, imperfect"],
    FAMILIES["corridor, 80 degrees"],
    Scenario(scene="flat", motion="look", sector_deg=120.0, imperfect=True, drawn_unit=True),
    Scenario(scene="hall", motion="walk", speed=1.2, sector_deg=120.0, imperfect=True),
    Scenario(scene="wood", motion="walk", speed=1.2, sector_deg=120.0, imperfect=True),
    Scenario(scene="yard", motion="drone", sector_deg=120.0, imperfect=True),
    Scenario(
        scene="office_corridor", motion="walk", mount="forward", sector_deg=140.0, imperfect=True
    ),
)

_PLACES: Final = (
    ("flat", "look"),
    ("office_corridor", "drive"),
    ("hall", "walk"),
    ("hall", "trot"),
    ("hall", "drone"),
    ("room", "walk"),
    ("room", "trot"),
    ("room", "drone"),
    ("yard", "walk"),
    ("yard", "trot"),
    ("yard", "drone"),
    ("wood", "walk"),
    ("wood", "trot"),
    ("atrium", "look"),
    ("stairwell", "climb"),
    ("wood", "drone"),
    ("room", "shake"),
    ("hall", "spin"),
)


def mixed(seed: int, seconds: float) -> Scenario:
    """Return a run in which what the families show one by one comes together as it happens.

    What nobody thought of when the families were made: a hit in the moment in which something
    covers the sensor, in a gap of the IMU's samples.

    Parameters
    ----------
    seed : int
        Draws the conditions as well as what follows from them.
    seconds : float
        Length of the run [s].
    """
    random = np.random.default_rng((seed, 77))
    scene, motion = _PLACES[random.integers(len(_PLACES))]

    def drawn(values: Sequence[Any], chances: Sequence[float]) -> Any:
        return values[random.choice(len(values), p=chances)]

    return Scenario(
        family=MIXED,
        seed=seed,
        seconds=seconds,
        scene=scene,
        motion=motion,
        mount=drawn(("upright", "forward", "tilted"), (0.6, 0.2, 0.2)),
        sector_deg=drawn((360.0, 200.0, 140.0), (0.6, 0.25, 0.15)),
        people=drawn((0, 4, 12), (0.6, 0.2, 0.2)),
        particles=drawn((0.0, 0.02), (0.8, 0.2)),
        covers=drawn((0, 1, 2), (0.7, 0.2, 0.1)),
        hits=drawn((0, 2, 4), (0.5, 0.25, 0.25)),
        rest_s=drawn((2.0, 0.0), (0.75, 0.25)),
        imperfect=drawn((True, False), (0.7, 0.3)),
    )


def starts(seed: int, seconds: float) -> Scenario:
    """Return a mixed run that is in motion from the first sweep on, and nothing more happens.

    Parameters
    ----------
    seed : int
    seconds : float
        Length of the run [s]; 12 show whether it has begun well.
    """
    drawn = mixed(seed, seconds)
    return replace(drawn, family=STARTS, rest_s=0.0, covers=0, hits=0)


def narrow_starts(seed: int, seconds: float) -> Scenario:
    """Return a run of a narrow view or of another sensor that is in motion from the first sweep.

    Parameters
    ----------
    seed : int
        Takes one of the scenarios after the other, and draws everything else.
    seconds : float
        Length of the run [s].
    """
    drawn = _NARROW[seed % len(_NARROW)]
    return replace(drawn, family=NARROW_STARTS, seed=seed, seconds=seconds, rest_s=0.0)


DRAWN: Final[dict[str, Callable[[int, float], Scenario]]] = {
    MIXED: mixed,
    STARTS: starts,
    NARROW_STARTS: narrow_starts,
}
"""Families whose seed draws the scenario itself, with what draws it from seed and length [s]."""


def scenario(family: str, seed: int, seconds: float) -> Scenario:
    """Return one run of a family.

    Raises
    ------
    KeyError
        For a family that is not known.
    """
    if family in DRAWN:
        return DRAWN[family](seed, seconds)
    return replace(FAMILIES[family], family=family, seed=seed, seconds=seconds)


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """What a scenario measures in.

    Attributes
    ----------
    world : MovingWorld
    motion : Motion
        Of the sensor's frame.
    view : View
    imu : ImuNoise
    covered : list of (float, float)
        When nothing comes back [s].
    """

    world: MovingWorld
    motion: Motion
    view: View
    imu: ImuNoise
    covered: list[tuple[float, float]]


def prepare(given: Scenario) -> Setting:
    """Return world, motion and circumstances of a scenario."""
    rng = np.random.default_rng((given.seed, 20))
    scene = SCENES[given.scene](given.seed)
    motion = _motion(given, scene)
    movers: list[Mover] = []
    if given.carrier:
        movers.append(Mover.of(World(carrier(given.carrier), 0.4), motion.poses))
    if given.scene == "atrium":
        movers.append(Mover.of(World(buildings.platform(), 0.5), _lift(motion, given)))
    movers += crowd(motion, scene.ground, given.people, given.seconds, given.seed)
    world = MovingWorld(
        World(scene.triangles, scene.reflectivity),
        movers,
        World(scene.glass) if len(scene.glass) else None,
        World(scene.mirrors) if len(scene.mirrors) else None,
    )
    view = View(
        sector=np.deg2rad(given.sector_deg),
        towards=float(rng.normal(0.0, 0.2)) if given.sector_deg < 360.0 else 0.0,
        cone=np.deg2rad(given.cone_deg),
    )
    covered = []
    for k in range(given.covers):
        at = given.seconds * (k + 1.0) / (given.covers + 1.0) + rng.uniform(-2.0, 2.0)
        covered.append((float(at), float(at + rng.uniform(2.0, 4.0))))
    noise = ImuNoise(
        gyro_bias=tuple(rng.normal(0.0, 0.015, 3).tolist()),
        accel_bias=tuple(rng.normal(0.0, 0.08, 3).tolist()),
    )
    if given.sensor != "l2":  # nothing turns beside the IMU
        noise = replace(noise, gyro_line=0.0, gyro_noise=0.006, accel_noise=0.03)
    return Setting(world, motion, view, noise, covered)


def _motion(given: Scenario, scene: Scene) -> Motion:
    if given.motion in trajectories.STYLES:
        style = trajectories.STYLES[given.motion]
        if given.speed:
            style = replace(style, speed=given.speed)
        motion = trajectories.tour(
            scene,
            style,
            seconds=given.seconds,
            mount=given.mount,
            rest_s=given.rest_s,
            seed=given.seed,
        )
    else:
        motion = trajectories.make(
            given.motion,
            scene,
            speed=given.speed,
            rest_s=given.rest_s,
            mount=MOUNTS[given.mount],
            seed=given.seed,
        )
    if given.hits:
        rng = np.random.default_rng((given.seed, 21))
        count = max(round(given.hits * given.seconds / 10.0), 1)
        instants = np.sort(rng.uniform(3.0, given.seconds - 0.5, count)).tolist()
        motion = trajectories.hit(motion, given.seconds + 1.0, instants, given.seed)
    return motion


def _lift(motion: Motion, given: Scenario) -> Callable[[F64], tuple[F64, F64]]:
    """Return where the atrium's platform is: under the sensor as long as that is above it."""
    t = np.arange(0.0, given.seconds + 1.0, 0.02)
    places = motion.poses(t)[0]
    height = trajectories.STYLES[given.motion].height
    on = np.linalg.norm(places[:, :2] - buildings.LIFT_AT, axis=1) < 0.3
    rise = np.where(on, places[:, 2] - height, np.nan)
    riding = np.flatnonzero(on & (rise > 0.1) & (rise < buildings.LIFT_RISE_M - 0.1))
    z = np.zeros(len(t))
    if len(riding):  # steps and tremor are the person's, not the platform's
        width = 25
        smooth = np.convolve(np.pad(places[:, 2], width, mode="edge"),
                             np.ones(2 * width + 1) / (2 * width + 1), "valid")  # fmt: skip
        z = np.clip(smooth - height, 0.0, buildings.LIFT_RISE_M)
        z[: riding[0] - 50] = 0.0
        z[riding[-1] + 50 :] = buildings.LIFT_RISE_M

    def poses(when: F64) -> tuple[F64, F64]:
        up = np.interp(when, t, z)
        middle = np.broadcast_to(buildings.LIFT_AT, (len(up), 2))
        still = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (len(up), 4))
        return np.column_stack([middle, up]), still

    return poses
