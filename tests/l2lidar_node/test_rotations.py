"""Quaternion operations against scipy and against their own algebra."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2lidar_node import rotations

RNG = np.random.default_rng(4)
VECTORS = RNG.normal(size=(50, 3)) * RNG.uniform(0, 1.7, (50, 1))


def as_scipy(q: Any) -> Any:
    return Rotation.from_quat(np.roll(q, -1, axis=-1))


def test_exp_of_nothing_is_exactly_the_identity() -> None:
    assert rotations.exp(np.zeros(3)).tolist() == [1.0, 0.0, 0.0, 0.0]
    assert (rotations.matrices(rotations.exp(np.zeros((2, 3)))) == np.eye(3)).all()


def test_exp_and_log_agree_with_scipy_and_with_each_other() -> None:
    q = rotations.exp(VECTORS)
    np.testing.assert_allclose(
        as_scipy(q).as_rotvec(), Rotation.from_rotvec(VECTORS).as_rotvec(), atol=1e-12
    )
    np.testing.assert_allclose(
        rotations.log(q), Rotation.from_rotvec(VECTORS).as_rotvec(), atol=1e-12
    )
    np.testing.assert_allclose(rotations.log(-q), rotations.log(q), atol=1e-12)


def test_the_matrix_of_one_vector_is_that_of_many() -> None:
    for vector in (*VECTORS, *(1e-5 * VECTORS), *(1e-3 * VECTORS), np.zeros(3)):
        expected = rotations.matrices(rotations.exp(vector))
        np.testing.assert_allclose(rotations.matrix_exp(vector), expected, atol=1e-15)


def test_one_rotation_by_itself_is_to_the_bit_what_it_is_among_many() -> None:
    for scale in (0.0, 1e-14, 1e-5, 1.0):
        vectors = scale * VECTORS
        q = rotations.exp(vectors)
        turns, back = rotations.matrices(q), rotations.log(q)
        assert [rotations.exp(vector).tolist() for vector in vectors] == q.tolist()
        assert [rotations.matrices(one).tolist() for one in q] == turns.tolist()
        assert [rotations.log(-one).tolist() for one in q] == back.tolist()


def test_products_rotations_and_matrices_agree_with_scipy() -> None:
    a, b = rotations.exp(VECTORS), rotations.exp(VECTORS[::-1])
    v = RNG.normal(size=(50, 3))
    product = as_scipy(a) * as_scipy(b)
    np.testing.assert_allclose(
        as_scipy(rotations.multiply(a, b)).as_matrix(), product.as_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(rotations.rotate(a, v), as_scipy(a).apply(v), atol=1e-12)
    np.testing.assert_allclose(rotations.matrices(a), as_scipy(a).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(
        rotations.multiply(a, rotations.conjugate(a)), np.tile([1.0, 0, 0, 0], (50, 1)), atol=1e-12
    )
    np.testing.assert_allclose(rotations.cross(v, VECTORS), np.cross(v, VECTORS), atol=1e-12)


@pytest.mark.parametrize("length", [1, 2, 3, 7, 50])
def test_running_product_equals_the_loop(length: int) -> None:
    q = rotations.exp(VECTORS[:length])
    expected = [q[0]]
    for factor in q[1:]:
        expected.append(rotations.multiply(expected[-1], factor))
    np.testing.assert_allclose(rotations.cumulative(q), expected, atol=1e-12)


def test_quaternion_of_a_matrix_is_that_of_scipy_near_half_turns_too() -> None:
    axes = np.concatenate((np.eye(3), -np.eye(3), VECTORS))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    for angle in (0.0, 1e-9, 0.7, 2.0, np.pi - 1e-9, np.pi, 4.0):
        for rotation in Rotation.from_rotvec(angle * axes):
            found = rotations.from_matrix(rotation.as_matrix())
            assert found[0] >= 0.0
            assert abs(float(found @ np.roll(rotation.as_quat(), 1))) > 1.0 - 1e-14
            np.testing.assert_allclose(rotations.matrices(found), rotation.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("target", [(0, 0, 2), (1, 0, 0), (0, 0, -1), (0.3, -0.2, 0.9)])
def test_shortest_turn_between_directions(target: Any) -> None:
    q = rotations.between((0, 0, 5.0), target)
    np.testing.assert_allclose(
        rotations.rotate(q, (0.0, 0.0, 1.0)), np.array(target) / np.linalg.norm(target), atol=1e-12
    )
