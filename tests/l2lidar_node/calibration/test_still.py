"""Calibration from still places: simulated units whose truth is known, and a real one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from l2lidar_node.calibration import still
from l2lidar_node.calibration.observation import GYRO, Gathering, Place, demodulated
from l2lidar_node.calibration.result import Verdict
from l2lidar_node.calibration.still import CalibrationError, calibrate
from l2lidar_node.cli.virtual_places import still_places
from l2lidar_node.emulator.unit.inertial import ImuNoise
from l2lidar_node.emulator.unit.units import UNITS, UnitErrors

DEG = np.pi / 180
ERRORS = UnitErrors(
    xi=0.4 * DEG, beta=-0.3 * DEG, alpha=0.3 * DEG, range_bias=0.05,
    precession=(0.1 * DEG, -0.05 * DEG), precession_back=(0.06 * DEG, 0.02 * DEG),
)  # fmt: skip
POSES = ("upright", "tilted", "on its side")


def places(errors: UnitErrors = ERRORS, **more: Any) -> Any:
    unit = replace(UNITS["a"], name="made", errors=errors)
    return still_places(unit, **{"seconds": 2.5, "poses": POSES, **more})


def thinned(places: list[Place]) -> list[Place]:
    """Return places with a third of their returns: as good for most tests, and faster by that."""
    return [replace(place, returns=place.returns[::3]) for place in places]


@pytest.fixture(scope="module")
def recovered() -> Any:
    made = places(seconds=2.0)
    return calibrate(
        [replace(place, returns=place.returns[::2]) for place in made], keep_alpha=True
    )


def test_injected_errors_are_recovered(recovered: Any) -> None:
    found = recovered.estimates
    assert not recovered.refusals
    for name in ("xi", "beta"):
        assert abs(found[name].value - getattr(ERRORS, name)) < 0.02 * DEG
    assert abs(found["alpha"].value - ERRORS.alpha) < 0.01 * DEG
    assert abs(found["b"].value) < 0.5e-3
    assert abs(found["bias"].value - 0.05) < 0.008
    for name, truth in (("xi", ERRORS.xi), ("beta", ERRORS.beta), ("alpha", ERRORS.alpha)):
        assert abs(found[name].value - truth) < 3 * found[name].sd
        assert found[name].verdict is Verdict.CORRECTED
    assert found["bias"].verdict is Verdict.CORRECTED


def test_the_halves_come_together(recovered: Any) -> None:
    assert recovered.before.gap > 5e-3
    assert recovered.after.gap < 2e-3
    assert recovered.after.thickness < 0.9 * recovered.before.thickness
    assert "together" in recovered.weakest


def test_rocking_of_the_mount_is_taken_out(recovered: Any) -> None:
    for report in recovered.places:
        assert report.precession.tilt_a == pytest.approx(ERRORS.precession[0], abs=0.02 * DEG)
        assert report.precession.tilt_b == pytest.approx(ERRORS.precession[1], abs=0.02 * DEG)
        assert report.precession.rock_cos == pytest.approx(
            ERRORS.precession_back[0], abs=0.02 * DEG
        )
        assert report.precession.rock_sin == pytest.approx(
            ERRORS.precession_back[1], abs=0.02 * DEG
        )
    assert sum("subtracted" in note for note in recovered.notes) == len(POSES)


def test_a_perfect_unit_is_left_alone() -> None:
    result = calibrate(thinned(places(UnitErrors(), poses=POSES[:2])))
    assert not result.refusals
    assert result.stored == {}
    found = result.estimates
    assert abs(found["xi"].value) < 0.03 * DEG
    assert abs(found["alpha"].value) < 0.01 * DEG
    assert abs(result.side) < 0.02 * DEG


def test_one_turn_is_refused() -> None:
    result = calibrate(thinned(places(seconds=0.25, poses=POSES)))
    assert any("turns of the head" in item.reason for item in result.refusals)


def test_a_scene_without_surfaces_is_refused() -> None:
    (place,) = places(poses=("upright",), seconds=2.0)
    random = np.random.default_rng(0)
    cloudy = place.returns.copy()
    cloudy["range"] = random.uniform(1.0, 6.0, len(cloudy))
    with pytest.raises(CalibrationError, match="flat surfaces"):
        calibrate([replace(place, returns=cloudy)])


@pytest.mark.parametrize("kept", [0, 50])
def test_a_place_where_nothing_flat_is_seen_by_both_halves_is_named(kept: int) -> None:
    good, covered = thinned(places(poses=("upright", "tilted"), seconds=2.2))
    covered = replace(covered, name="covered", returns=covered.returns[:kept])
    with pytest.raises(CalibrationError) as caught:
        calibrate([good, covered])
    assert str(caught.value).startswith("covered: no flat surface is seen by both halves")


def test_a_corridor_does_not_tell_everything() -> None:
    result = calibrate(thinned(places(world="corridor", poses=("upright",))))
    assert result.refusals or result.estimates["bias"].verdict is Verdict.UNKNOWN


def test_a_sensor_that_turned_is_refused() -> None:
    first, second = thinned(places(poses=("upright", "tilted"), seconds=2.2))
    half = len(first.gyro) // 2
    rate = first.gyro.copy()
    rate["rate"][half:] += (0.0, 0.0, 0.2)
    moved = replace(first, gyro=rate)
    assert not demodulated(moved).is_at_rest
    assert demodulated(second).is_at_rest
    assert any("moved" in item.reason for item in calibrate([moved]).refusals)


def test_a_strong_rocking_is_refused() -> None:
    strong = replace(ERRORS, precession=(0.6 * DEG, 0.0))
    result = calibrate(thinned(places(strong, poses=("tilted",))))
    assert any("rocks" in item.reason for item in result.refusals)


def test_without_an_imu_the_result_is_for_this_mount() -> None:
    made = [replace(place, gyro=np.empty(0, GYRO)) for place in thinned(places(poses=("tilted",)))]
    result = calibrate(made)
    assert any("this mount only" in note for note in result.notes)
    assert result.places[0].precession is None


def test_alpha_that_differs_between_power_ups_is_shown_not_stored() -> None:
    low, high = (
        thinned(places(replace(ERRORS, alpha=value * DEG), poses=("tilted",)))[0]
        for value in (0.1, 0.35)
    )
    result = calibrate([low, replace(high, power_up=1)])
    alpha = result.estimates["alpha"]
    assert alpha.verdict is Verdict.SHOWN
    assert "not repeatable: it differs by 0.2" in alpha.reason
    assert "alpha" not in result.stored


def test_a_gyro_line_that_is_not_a_motion_is_refused() -> None:
    noisy = ImuNoise(gyro_line=0.2)
    result = calibrate(thinned(places(UnitErrors(), poses=("tilted",), imu=noisy)))
    assert any("cannot be trusted" in item.reason for item in result.refusals)


def test_packets_of_a_wide_view_and_of_two_blocks_are_named() -> None:
    (place,) = places(poses=("upright",), seconds=2.0)
    other = replace(place, is_wide=True, blocks=2, dirt=9.0)
    reasons = " ".join(item.reason for item in still.problems(other))
    for word in ("wide", "2 different calibration blocks", "dirt"):
        assert word in reasons


def test_a_place_without_points_is_an_error() -> None:
    gathering = Gathering()
    gathering.flat()
    with pytest.raises(ValueError, match="set the unit to 3D"):
        gathering.place()


def test_a_cloud_that_moved_is_refused_without_an_imu() -> None:
    (place,) = thinned(places(poses=("tilted",)))
    returns = place.returns.copy()
    returns["theta"][len(returns) // 2 :] += 2 * DEG
    result = calibrate([replace(place, returns=returns, gyro=np.empty(0, GYRO))])
    assert any("moved" in item.reason for item in result.refusals)
