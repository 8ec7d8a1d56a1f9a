"""The calibration of a virtual unit as its owner makes it: still places, a tape, turning it."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.results import FOLDER
from l2lidar_node import rotations
from l2lidar_node.calibration import report
from l2lidar_node.calibration.file import CalibrationFile, load
from l2lidar_node.calibration.scale import by_tape
from l2lidar_node.calibration.still import calibrate
from l2lidar_node.cli.virtual_places import slide, still_places
from l2lidar_node.types import Sweep
from l2lidar_proc.motion.config import ImuConfig
from l2lidar_proc.motion.imu_extrinsics import ImuExtrinsics
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
