"""Any two connected frames are related, whichever way the transforms were told."""

from __future__ import annotations

from typing import Any

import numpy as np

from l2lidar_node import rotations
from l2lidar_node.frames import FrameTree
from l2lidar_node.types import F64


def found(tree: FrameTree, to: str, source: str) -> F64:
    """Return a transform that has to be there."""
    transform = tree.find(to, source)
    assert transform is not None
    return transform


def pose(turn: Any, place: Any) -> Any:
    return rotations.transform(rotations.exp(turn), place)


def test_chains_go_up_and_down() -> None:
    tree = FrameTree()
    T_base_mast, T_mast_lidar = pose((0, 0, 1.0), (1, 0, 0)), pose((0.5, 0, 0), (0, 0, 2))
    T_base_wheel = pose((0, 0.1, 0), (0, 3, 0))
    tree.add("mast", "lidar", T_mast_lidar)
    tree.add("base", "mast", T_base_mast)
    tree.add("base", "wheel", T_base_wheel)
    tree.add("elsewhere", "other", np.eye(4))
    np.testing.assert_allclose(found(tree, "base", "lidar"), T_base_mast @ T_mast_lidar)
    expected = np.linalg.inv(T_base_wheel) @ T_base_mast @ T_mast_lidar
    np.testing.assert_allclose(found(tree, "wheel", "lidar"), expected, atol=1e-12)
    np.testing.assert_allclose(found(tree, "lidar", "wheel"), np.linalg.inv(expected), atol=1e-12)
    assert tree.find("base", "other") is None
    assert tree.find("nowhere", "base") is None
    np.testing.assert_array_equal(found(tree, "x", "x"), np.eye(4))


def test_a_newer_transform_replaces_the_older() -> None:
    tree = FrameTree()
    tree.add("a", "b", pose((0, 0, 0), (1, 0, 0)))
    tree.add("a", "b", pose((0, 0, 0), (2, 0, 0)))
    assert found(tree, "a", "b")[0, 3] == 2
    assert found(tree, "b", "a")[0, 3] == -2


def test_a_frame_has_one_parent_the_newest() -> None:
    tree = FrameTree()
    tree.add("a", "b", pose((0, 0, 0), (1, 0, 0)))
    tree.add("c", "b", pose((0, 0, 0), (2, 0, 0)))
    assert tree.find("a", "b") is None
    assert found(tree, "c", "b")[0, 3] == 2


def test_a_frame_takes_no_second_parent_and_none_from_below_it() -> None:
    tree = FrameTree()
    tree.add("base", "mast", np.eye(4))
    tree.add("mast", "lidar", np.eye(4))
    assert tree.obstacle("odom", "lidar") == "'mast' is already the parent of 'lidar'"
    assert tree.obstacle("/odom", "/mast") == "'base' is already the parent of 'mast'"
    assert tree.obstacle("lidar", "base") == "'base' is already above 'lidar'"
    for parent, child in (("odom", "base"), ("lidar", "odom"), ("mast", "lidar")):
        assert tree.obstacle(parent, child) == ""


def test_mounts_in_a_circle_and_long_chains_have_an_end() -> None:
    tree = FrameTree()
    for child, parent in ("ab", "bc", "ca"):
        tree.add(parent, child, np.eye(4))
    assert tree.find("a", "x") is None
    np.testing.assert_array_equal(found(tree, "a", "c"), np.eye(4))
    for number in range(5000):
        tree.add(f"{number + 1}", f"{number}", np.eye(4))
    assert tree.find("5000", "0") is None
    assert tree.find("999", "0") is not None  # 1000 frames
    assert tree.find("1000", "0") is None


def test_the_root_is_the_topmost_frame() -> None:
    tree = FrameTree()
    T_base_mast, T_mast_lidar = pose((0, 0, 1.0), (1, 0, 0)), pose((0.5, 0, 0), (0, 0, 2))
    tree.add("mast", "lidar", T_mast_lidar)
    tree.add("base", "mast", T_base_mast)
    name, T_root_lidar = tree.root("/lidar")
    assert name == "base"
    np.testing.assert_allclose(T_root_lidar, T_base_mast @ T_mast_lidar)
    assert tree.root("base")[0] == "base"
    np.testing.assert_array_equal(tree.root("base")[1], np.eye(4))
