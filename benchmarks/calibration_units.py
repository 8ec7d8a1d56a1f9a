"""Units to calibrate: a virtual one as its owner does it, and recordings of two real ones.

The recordings (Unitree L2, still, outdoors; BSD-3-Clause, github cueltschey/parkme-unilidar) are
clouds in the vendor's frame, kept outside this repository. What the unit sent is fitted to them:
one block that gives both clouds back, the head angle of each packet, and ranges.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.results import FOLDER
from l2lidar_node import rotations
from l2lidar_node.calibration import report
from l2lidar_node.calibration.file import CalibrationFile, load
from l2lidar_node.calibration.observation import Gathering, Place
from l2lidar_node.calibration.scale import by_tape
from l2lidar_node.calibration.still import calibrate
from l2lidar_node.cli.virtual_places import slide, still_places
from l2lidar_node.protocol import wire
from l2lidar_node.types import F64, Sweep
from l2lidar_proc.motion.config import ImuConfig
from l2lidar_proc.motion.imu_corrections import ImuExtrinsics
from l2lidar_proc.odometry import imu_calibration
from tests.support import odometry_runs
from tests.support.odometry_runs import Run

TYPICAL: Final = "typical"
_STILL_S: Final = 4.0
_TAPE_M: Final = 3.0
_TAPE_SD_M: Final = 4e-4  # what a steel tape of accuracy class I may be wrong by at 3 m
_TAPE_OFF_M: Final = 2e-4  # this one's error
_TURNING_S: Final = 32.0


def calibrated(unit: str = TYPICAL) -> CalibrationFile:
    """Return the calibration of a virtual unit; from ``out/bench`` if it was made before.

    Parameters
    ----------
    unit : str
        As the emulator names it.
    """
    path = _path(unit)
    if not path.exists():
        print(f"calibrating a virtual unit, '{unit}' ...", file=sys.stderr, flush=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        _made(unit).save(path)
    return load(path)


def forget(unit: str = TYPICAL) -> None:
    """Have the unit calibrated anew the next time it is needed."""
    _path(unit).unlink(missing_ok=True)


def _path(unit: str) -> Path:
    return FOLDER / f"unit_{unit}.yaml"


def _made(unit: str) -> CalibrationFile:
    places = still_places(unit, seconds=_STILL_S)
    beams = report.calibration_of(calibrate(places, keep_alpha=True), places, "")
    start, end = slide(unit, _TAPE_M, seconds=_STILL_S)
    scale = by_tape(
        start, end, _TAPE_M + _TAPE_OFF_M, _TAPE_SD_M, correction=report.beams_of(beams)
    )
    stretched = {"range_scale": scale.scale} if scale.is_significant else {}
    both = replace(beams, correction={**beams.correction, **stretched})
    run = odometry_runs.record("room", "shake", 7, _TURNING_S, unit=unit, calibration=both)
    sweeps: list[Sweep] = list(odometry_runs.sweeps(run, "turn"))
    found = imu_calibration.calibrate(sweeps, run.imu, beams_calibrated=True)
    return replace(both, imu=found.calibration())


def recorded(
    scene: str, motion: str, seed: int, seconds: float, unit: str, file: CalibrationFile | None
) -> Run:
    """Return a recording of a virtual unit, calibrated as driver and odometry are by a file.

    Parameters
    ----------
    scene, motion : str
    seed : int
    seconds : float
    unit : str
    file : CalibrationFile or None
        None: as the unit comes.
    """
    run = odometry_runs.record(scene, motion, seed, seconds, unit=unit, calibration=file)
    if file is None or file.imu is None:
        return run
    known = ImuExtrinsics.of(ImuConfig(calibration_file=file.path))
    imu = known.corrected(run.imu).copy()
    turn = rotations.from_rpy(file.imu.rotation_rpy)
    for name in ("angular_velocity", "linear_acceleration"):
        imu[name] = imu[name] @ turn.T  # as if the IMU were turned as it is drawn
    return replace(run, imu=np.asarray(imu))


REAL_FOLDER: Final = Path(__file__).resolve().parents[2] / "shared" / "data" / "unitree_l2_static"
CAPTURES: Final = ("capture_001", "capture_002")

# The block that fits both clouds, with the head's step as the packets report it: the mean advance
# from packet to packet over 600 slots.
BLOCK: Final = {
    "a_axis_dist": 0.0445,
    "b_axis_dist": 0.00659,
    "theta_angle_bias": 0.0,
    "alpha_angle_bias": float(np.deg2rad(1.075)),
    "beta_angle": float(np.deg2rad(-0.481)),
    "xi_angle": float(np.deg2rad(0.2442)),
    "range_bias": -372.339,
    "range_scale": 0.00098113,
}
_SLOT_RAD: Final = np.deg2rad(0.6)
_MIRROR_S: Final = 0.004639
_RATIO: Final = 1.99866
_SAME_M: Final = 0.02


def packets(path: Path) -> NDArray[np.void]:
    """Return the 3D packets of a recording, dtype wire.POINTS_3D_PAYLOAD.

    Parameters
    ----------
    path : Path
        The cloud, ``NAME.npy``; ``NAME_packets.npz`` lies beside it.
    """
    given = np.load(path.with_name(f"{path.stem}_packets.npz"))
    packet, slot = np.nonzero(np.isfinite(given["range_m"]))
    xyz = _matched(np.load(path).astype(np.float64), given, packet, slot)
    count = len(given["range_m"])
    step = np.deg2rad(np.diff(np.unwrap(given["theta_start_deg"], period=360)).mean()) / 600
    middle = np.deg2rad(given["theta_start_deg"] + 149.5 * given["theta_step_deg"])
    start, distance = _fitted(xyz, packet, slot, middle - 149.5 * step, step)
    made = np.zeros(count, wire.POINTS_3D_PAYLOAD)
    made["info"]["payload_size"] = made.dtype.itemsize
    for name, value in BLOCK.items():
        made["calibration"][name] = value
    made["state"]["sys_rotation_period"] = round(_MIRROR_S * 1e6)
    made["state"]["com_rotation_period"] = round(2 * np.pi / (600 * step) * _MIRROR_S * 1e6)
    made["com_horizontal_angle_start"] = np.mod(start, 2 * np.pi)
    made["com_horizontal_angle_step"] = step
    made["scan_period"] = _MIRROR_S
    made["range_min"], made["range_max"] = 0.05, 50.0
    made["angle_increment"] = _SLOT_RAD
    made["time_increment"] = _MIRROR_S / 600
    made["point_num"] = wire.POINTS_PER_3D_PACKET
    raw = np.rint(distance / BLOCK["range_scale"] - BLOCK["range_bias"])
    made["ranges"][packet, slot] = np.clip(raw, 1, 0xFFFF).astype(np.uint16)
    made["intensities"][packet, slot] = 100
    stamps = np.round(np.arange(count) * _MIRROR_S / _RATIO * 1e9).astype(np.int64)
    made["info"]["seq"] = np.arange(count) % 1025
    made["info"]["sec"], made["info"]["nsec"] = np.divmod(stamps, 1_000_000_000)
    return made


def place(path: Path, power_up: int) -> Place:
    """Return a recording as a still place."""
    gathering = Gathering(path.stem, power_up)
    made = packets(path)
    for index in range(len(made)):
        gathering.points(index * _MIRROR_S / _RATIO, made[index : index + 1].tobytes())
    return gathering.place()


def _rays(theta: F64, alpha: F64, block: dict[str, float]) -> tuple[F64, F64]:
    """Return A and B of a unit range without b, see ``driver.geometry``."""
    del theta
    sin_xi, cos_xi = np.sin(block["xi_angle"]), np.cos(block["xi_angle"])
    sin_beta, cos_beta = np.sin(block["beta_angle"]), np.cos(block["beta_angle"])
    along = -cos_beta * sin_xi + sin_beta * cos_xi * np.sin(alpha)
    return along, np.cos(alpha) * cos_xi


def _fitted(
    xyz: F64, packet: NDArray[np.int64], slot: NDArray[np.int64], start: F64, step: float
) -> tuple[F64, F64]:
    """Return the head angle of each packet [rad] and the range of each point [m]."""
    alpha = BLOCK["alpha_angle_bias"] + _SLOT_RAD * slot
    start = start.copy()
    along, across = _rays(start, alpha, BLOCK)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    for _ in range(4):
        theta = start[packet] + step * slot
        origin = np.stack((np.cos(theta), np.sin(theta)), axis=-1) * BLOCK["b_axis_dist"]
        distance = np.sqrt(
            ((xyz[:, :2] - origin) ** 2).sum(axis=1) + (xyz[:, 2] - BLOCK["a_axis_dist"]) ** 2
        )
        a, b = along * distance + BLOCK["b_axis_dist"], across * distance
        off = np.angle(np.exp(1j * (azimuth - np.arctan2(b, a) - theta)))
        weight = a**2 + b**2
        start += np.bincount(packet, off * weight, len(start)) / np.maximum(
            np.bincount(packet, weight, len(start)), 1e-9
        )
    return start, distance


def _matched(
    xyz: F64, given: dict[str, NDArray[np.float64]], packet: NDArray[np.int64],
    slot: NDArray[np.int64],
) -> F64:  # fmt: skip
    """Return the cloud without the point that the table of ranges does not have."""
    if len(xyz) == len(packet):
        return xyz
    block = {name: np.deg2rad(given[f"{name[:-6]}_deg"]) for name in ("xi_angle", "beta_angle")}
    theta = np.deg2rad(given["theta_start_deg"][packet] + slot * given["theta_step_deg"][packet])
    alpha = np.deg2rad(given["alpha0_deg"] + slot * given["alpha_step_deg"])
    along, across = _rays(theta, alpha, {name: float(v) for name, v in block.items()})
    distance = given["range_m"][packet, slot].astype(np.float64)
    a, b = along * distance + given["b_axis_dist"], across * distance
    found = np.stack(
        (np.cos(theta) * a - np.sin(theta) * b, np.sin(theta) * a + np.cos(theta) * b), axis=-1
    )
    for extra in range(len(xyz) - len(packet)):
        count = min(len(packet), len(xyz) - extra)
        off = np.linalg.norm(xyz[:count, :2] - found[:count], axis=1) > _SAME_M
        if not off.any():
            return xyz[: len(packet)]
        xyz = np.delete(xyz, int(np.argmax(off)), axis=0)
    return xyz
