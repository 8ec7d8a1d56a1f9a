"""Whose calibration the points are made with: the unit's, a file's, or that of parameters."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from l2lidar_node.calibration.file import CalibrationFile
from l2lidar_node.config import DriverConfig
from l2lidar_node.driver import health
from l2lidar_node.driver.geometry import Projector
from l2lidar_node.driver.health import metadata
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.recording.recording import NoTransport
from l2lidar_node.settings import SettingError, change
from l2lidar_node.types import Check, HostNs, Level, Sweep
from tests.l2lidar_node.driver.test_driver import Run
from tests.support import build

BLOCK = np.array(
    tuple(build.UNIT_A[name] for name in wire.CALIBRATION.names or ()), wire.CALIBRATION
).tobytes()
CORRECTION = {"xi_angle": 0.004, "alpha_angle_bias": -0.002, "range_bias": 0.02}
TRUE = build.UNIT_A | {
    "xi_angle": build.UNIT_A["xi_angle"] + 0.004,
    "alpha_angle_bias": build.UNIT_A["alpha_angle_bias"] - 0.002,
    "range_bias": build.UNIT_A["range_bias"] + 0.02 / 0.000978,
}
PLAIN = {"publish_unlocked": True, "aggregateNframes": 1, "imu_adjust": False}


@pytest.fixture
def file(tmp_path: Path) -> str:
    path = tmp_path / "unit.yaml"
    CalibrationFile(BLOCK, CORRECTION).save(path)
    return str(path)


def heard(run: Run, calibration: dict[str, float] = build.UNIT_A) -> NDArray[np.void]:
    """Return the points of one packet."""
    run.events.clear()
    run.now += build.PERIOD_NS
    number = (run.now - build.EPOCH_NS) // build.PERIOD_NS
    stamp = build.to_device_ns(run.now)
    run.hear(PacketType.POINTS_3D, build.points_3d(number, stamp, calibration=calibration))
    (sweep,) = run.of(Sweep)
    assert isinstance(sweep, Sweep)
    return sweep.points


def projected(calibration: dict[str, float]) -> NDArray[np.void]:
    payload = build.points_3d(calibration=calibration)
    return Projector(PacketType.POINTS_3D).points([payload], np.zeros(1)).points


def same(one: NDArray[np.void], other: NDArray[np.void]) -> bool:
    return all(np.allclose(one[axis], other[axis], atol=2e-6) for axis in ("x", "y", "z", "range"))


def test_a_file_corrects_its_unit_and_no_other(file: str) -> None:
    run = Run(**PLAIN, calibration_file=file)
    assert same(heard(run), projected(TRUE))
    other = build.UNIT_A | {"beta_angle": build.UNIT_A["beta_angle"] + 1e-9}
    assert not same(heard(run, build.UNIT_B), projected(TRUE))
    assert same(heard(run, build.UNIT_B), projected(build.UNIT_B))
    assert np.float32(other["beta_angle"]) != np.float32(build.UNIT_A["beta_angle"])
    assert heard(run, other).tobytes() == heard(Run(**PLAIN), other).tobytes()


def test_without_a_file_nothing_changes() -> None:
    assert heard(Run(**PLAIN)).tobytes() == projected(build.UNIT_A).tobytes()


def test_parameters_win_over_the_file_live(file: str) -> None:
    run = Run(**PLAIN, calibration_file=file)
    heard(run)
    values = {
        "EnableCalAngleOVR": True,
        "calAlphaAngleBias": 0.01,
        "calBetaAngle": -0.02,
        "calXiAngle": 0.03,
        "calThetaAngleBias": 1.5,
        "calBAxisDist": 0.007,
    }
    run.driver.configure(change(run.driver.config, values))
    wanted = TRUE | {
        "alpha_angle_bias": 0.01, "beta_angle": -0.02, "xi_angle": 0.03,
        "theta_angle_bias": 1.5, "b_axis_dist": 0.007,
    }  # fmt: skip
    assert same(heard(run), projected(wanted))
    ranges = {"EnableCalRangeOVR": True, "calRangeScale": 0.001, "calRangeBias": -300.0}
    run.driver.configure(change(run.driver.config, ranges))
    both = wanted | {"range_scale": 0.001, "range_bias": -300.0}
    assert same(heard(run), projected(both))
    run.driver.configure(change(run.driver.config, {"EnableCalAngleOVR": False}))
    assert same(heard(run), projected(TRUE | {"range_scale": 0.001, "range_bias": -300.0}))
    run.driver.configure(change(run.driver.config, {"EnableCalRangeOVR": False}))
    assert same(heard(run), projected(TRUE))


def test_angles_replaced_without_a_file_go_for_every_unit() -> None:
    run = Run(**PLAIN, EnableCalAngleOVR=True, calXiAngle=0.05)
    config = DriverConfig().sweep
    wanted = build.UNIT_B | {
        "alpha_angle_bias": config.alpha_angle_bias, "beta_angle": config.beta_angle,
        "xi_angle": 0.05, "theta_angle_bias": config.theta_angle_bias,
        "b_axis_dist": config.b_axis_dist,
    }  # fmt: skip
    assert same(heard(run, build.UNIT_B), projected(wanted))


def test_metadata_say_what_is_reported_what_is_used_and_from_where(file: str) -> None:
    run = Run(**PLAIN, calibration_file=file, EnableCalRangeOVR=True)
    assert metadata(run.driver).calibration_matches is None
    heard(run)
    facts = metadata(run.driver)
    assert facts.calibration["xi_angle"] == pytest.approx(build.UNIT_A["xi_angle"], rel=1e-6)
    assert facts.calibration_used["xi_angle"] == pytest.approx(TRUE["xi_angle"], rel=1e-6)
    assert facts.calibration_used["range_bias"] == DriverConfig().sweep.range_bias
    assert facts.calibration_source == {
        **dict.fromkeys(wire.CALIBRATION.names or (), "unit"),
        "xi_angle": file,
        "alpha_angle_bias": file,
        "range_bias": "parameter",
        "range_scale": "parameter",
    }
    assert (facts.calibration_file, facts.calibration_matches) == (file, True)
    heard(run, build.UNIT_B)
    assert metadata(run.driver).calibration_matches is False
    assert metadata(run.driver).calibration_source["xi_angle"] == "unit"


def checked(run: Run) -> Check | None:
    before = health.observe(run.driver, NoTransport(), HostNs(run.now))
    found = health.judge(run.driver, before, dataclasses.replace(before, now=HostNs(run.now + 1)))
    return next((check for check in found if check.name == "calibration"), None)


def test_diagnostics_warn_of_a_file_for_another_unit(file: str) -> None:
    run = Run(**PLAIN, calibration_file=file)
    heard(run)
    check = checked(run)
    assert check is not None
    assert check.level is Level.OK
    assert file in check.message
    assert "reported 0.002945" in check.values["xi_angle [rad]"]
    heard(run, build.UNIT_B)
    check = checked(run)
    assert check is not None
    assert check.level is Level.ERROR
    assert "another unit" in check.message
    plain = Run(**PLAIN)
    heard(plain)
    assert checked(plain) is None


def test_a_file_that_cannot_be_used_is_an_error_of_its_parameter(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"parameter 'calibration_file': .*none\.yaml: No such"):
        Run(calibration_file=str(tmp_path / "none.yaml"))
