"""Beams: the protocol's formula, and derivatives against differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from l2lidar_node.calibration.model import NAMES, RETURN, Block, angles, beams, derivatives
from l2lidar_node.driver.geometry import Projector
from l2lidar_node.protocol import wire
from tests.support.build import UNIT_B, points_3d

BLOCK = Block(
    np.array(tuple(UNIT_B[name] for name in wire.CALIBRATION.names), wire.CALIBRATION).tobytes()
)


def returns(seed: int = 0, count: int = 200) -> np.ndarray:
    random = np.random.default_rng(seed)
    made = np.zeros(count, RETURN)
    made["theta"] = random.uniform(0, 6.28, count)
    made["alpha"] = random.uniform(0, np.pi, count)
    made["range"] = random.uniform(0.5, 20, count)
    return made


def test_points_are_those_of_the_driver() -> None:
    payload = points_3d(theta=1.0, ranges=5000, calibration=UNIT_B)
    raw = np.frombuffer(payload, wire.POINTS_3D_PAYLOAD)[0]
    slots = np.arange(300)
    made = np.zeros(300, RETURN)
    made["theta"] = (
        1.0 + UNIT_B["theta_angle_bias"] + slots * float(raw["com_horizontal_angle_step"])
    )
    made["alpha"] = UNIT_B["alpha_angle_bias"] + slots * np.pi / 300
    made["range"] = UNIT_B["range_scale"] * (5000 + UNIT_B["range_bias"])
    ours = beams(made, BLOCK, np.zeros(len(NAMES))).points
    points = Projector(wire.PacketType.POINTS_3D).points([payload], np.zeros(1)).points
    theirs = np.stack([points[axis] for axis in "xyz"], axis=-1)
    np.testing.assert_allclose(ours, theirs, atol=2e-6)


@pytest.mark.parametrize("index", range(len(NAMES)), ids=NAMES)
def test_derivatives_are_those_of_the_points(index: Any) -> None:
    made = returns()
    random = np.random.default_rng(1)
    correction = random.normal(0, 3e-3, len(NAMES))
    normals = random.normal(size=(len(made), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    step = np.zeros(len(NAMES))
    step[index] = 1e-6
    ahead, back = (beams(made, BLOCK, correction + sign * step).points for sign in (1, -1))
    numeric = np.einsum("ni,ni->n", ahead - back, normals) / 2e-6
    distance = beams(made, BLOCK, correction).distance
    at = angles(made, BLOCK, correction)
    exact = derivatives(made, at, normals, distance)[:, index]
    np.testing.assert_allclose(exact, numeric, atol=1e-6, rtol=1e-6)


def test_groups_have_corrections_of_their_own() -> None:
    made = returns(3)
    rows = np.random.default_rng(4).normal(0, 3e-3, (2, len(NAMES)))
    group = np.arange(len(made)) % 2
    both = beams(made, BLOCK, rows, group).points
    for number, row in enumerate(rows):
        mine = group == number
        np.testing.assert_allclose(both[mine], beams(made[mine], BLOCK, row).points, atol=1e-12)


def test_a_mount_that_rocks_is_alpha_and_beta() -> None:
    """To first order, tilt x p in the head frame: nothing in a cloud tells them apart."""
    made = returns(2)
    tilt = np.array([2e-4, -1e-4])
    correction = np.zeros(len(NAMES))
    correction[[NAMES.index("alpha"), NAMES.index("beta")]] = tilt
    moved = beams(made, BLOCK, correction).points
    still = beams(made, BLOCK, np.zeros(len(NAMES)))
    cosine, sine = np.cos(made["theta"]), np.sin(made["theta"])
    axis = np.stack(
        (cosine * tilt[0] - sine * tilt[1], sine * tilt[0] + cosine * tilt[1], 0 * cosine), axis=-1
    )
    rocked = (
        still.origin + np.cross(axis, still.points - still.origin) + (still.points - still.origin)
    )
    # beta_angle is 0.9 degrees, so its product with the tilt is left
    np.testing.assert_allclose(moved, rocked, atol=2e-4)
