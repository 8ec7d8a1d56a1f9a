"""Any two connected frames are related, whichever way the transforms were told."""

from __future__ import annotations

import numpy as np

from l2lidar_proc import rotations
from l2lidar_proc.motion.frames import FrameTree


def pose(turn, place):
    return rotations.transform(rotations.exp(turn), place)


def test_chains_go_up_and_down():
    tree = FrameTree()
    T_base_mast, T_mast_lidar = pose((0, 0, 1.0), (1, 0, 0)), pose((0.5, 0, 0), (0, 0, 2))
    T_base_wheel = pose((0, 0.1, 0), (0, 3, 0))
    tree.add("mast", "lidar", T_mast_lidar)
    tree.add("base", "mast", T_base_mast)
    tree.add("base", "wheel", T_base_wheel)
    tree.add("elsewhere", "other", np.eye(4))
    np.testing.assert_allclose(tree.find("base", "lidar"), T_base_mast @ T_mast_lidar)
    expected = np.linalg.inv(T_base_wheel) @ T_base_mast @ T_mast_lidar
    np.testing.assert_allclose(tree.find("wheel", "lidar"), expected, atol=1e-12)
    np.testing.assert_allclose(tree.find("lidar", "wheel"), np.linalg.inv(expected), atol=1e-12)
    assert tree.find("base", "other") is None
    assert tree.find("nowhere", "base") is None
    np.testing.assert_array_equal(tree.find("x", "x"), np.eye(4))


def test_a_newer_transform_replaces_the_older():
    tree = FrameTree()
    tree.add("a", "b", pose((0, 0, 0), (1, 0, 0)))
    tree.add("a", "b", pose((0, 0, 0), (2, 0, 0)))
    assert tree.find("a", "b")[0, 3] == 2
    assert tree.find("b", "a")[0, 3] == -2


def test_a_frame_has_one_parent_the_newest():
    tree = FrameTree()
    tree.add("a", "b", pose((0, 0, 0), (1, 0, 0)))
    tree.add("c", "b", pose((0, 0, 0), (2, 0, 0)))
    assert tree.find("a", "b") is None
    assert tree.find("c", "b")[0, 3] == 2


def test_mounts_in_a_circle_and_long_chains_have_an_end():
    tree = FrameTree()
    for child, parent in ("ab", "bc", "ca"):
        tree.add(parent, child, np.eye(4))
    assert tree.find("a", "x") is None
    np.testing.assert_array_equal(tree.find("a", "c"), np.eye(4))
    for number in range(5000):
        tree.add(f"{number + 1}", f"{number}", np.eye(4))
    assert tree.find("5000", "0") is None
    assert tree.find("900", "0") is not None
