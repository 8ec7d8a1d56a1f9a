"""The mesh, the example robots and the macro, and the frames they make with the driver."""

import runpy
from pathlib import Path
from typing import Any
from xml.dom.minidom import Document
from xml.etree import ElementTree

import numpy as np
import pytest

from l2lidar_node.config import FrameConfig
from l2lidar_node.protocol import wire

ROOT = Path(__file__).resolve().parent.parent
MESH = ROOT / "meshes" / "l2_lidar.stl"
EXAMPLES = {
    name: ROOT / "urdf" / "examples" / f"l2_{name}_mount_example.urdf"
    for name in ("top", "forward")
}
# Where the sensor's axes point in base_link, and where its mounting face is.
POSES = {
    "top": (np.eye(3), (0.0, 0.0, 0.3)),
    "forward": (np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]), (0.05, 0.0, 0.25)),
}
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")])


def triangles(path: Any) -> Any:
    content = path.read_bytes()
    (count,) = np.frombuffer(content, "<u4", 1, 80)
    records = np.frombuffer(content, STL_TRIANGLE, offset=84)
    assert len(records) == count
    return records


def joints(robot: Any) -> Any:
    """Return child -> parent of every joint; each link has at most one parent."""
    parents = {}
    for joint in robot.iter("joint"):
        child = joint.find("child").get("link")
        assert child not in parents, f"{child} has two parents"
        parents[child] = joint.find("parent").get("link")
    return parents


def roots(parents: Any) -> Any:
    """Return the frames without a parent; follows every frame up, so a cycle fails."""
    for frame in parents:
        seen = {frame}
        while (frame := parents.get(frame)) is not None:
            assert frame not in seen, f"cycle through {frame}"
            seen.add(frame)
    return set(parents.values()) - set(parents)


def test_mesh_is_what_its_script_makes(tmp_path: Path) -> None:
    script = runpy.run_path(str(ROOT / "scripts" / "make_mesh.py"))
    for name in ("first.stl", "second.stl"):
        script["main"]([str(tmp_path / name)])
        assert (tmp_path / name).read_bytes() == MESH.read_bytes()


def test_mesh_is_closed_and_faces_outwards() -> None:
    corners = triangles(MESH)["corners"].astype(float)
    edges = {}
    for triangle in corners:
        names = [tuple(corner) for corner in triangle]
        assert len(set(names)) == 3
        for edge in zip(names, names[1:] + names[:1], strict=True):
            assert edge not in edges, "two triangles on one side of an edge"
            edges[edge] = True
    assert all((end, start) in edges for start, end in edges)
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert 0.5 < volume / (0.075 * 0.075 * 0.065) < 0.9


def test_mesh_has_the_published_outline() -> None:
    assert MESH.stat().st_size < 300_000
    corners = triangles(MESH)["corners"].reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    np.testing.assert_allclose(low[1:], (-0.0375, 0.0), atol=1e-6)
    np.testing.assert_allclose(high, (0.0375, 0.0375, 0.065), atol=1e-6)
    assert -0.0475 < low[0] < -0.04, "the cable leaves at -x"
    below = corners[corners[:, 2] < 1e-6]
    radius = np.hypot(below[:, 0], below[:, 1])
    rim = below[(radius > 0.02) & (radius < 0.03)].astype(float)
    turned = np.degrees(np.arctan2(rim[:, 1], rim[:, 0]))
    for hole in (22.5, 112.5, -157.5, -67.5):
        mine = rim[np.abs((turned - hole + 180) % 360 - 180) < 20]
        middle = (mine.min(axis=0) + mine.max(axis=0))[:2] / 2
        expected = 0.0255 * np.array([np.cos(np.radians(hole)), np.sin(np.radians(hole))])
        np.testing.assert_allclose(middle, expected, atol=1e-4)


def test_examples_differ_in_one_origin_only() -> None:
    origins, rest = {}, {}
    for name, path in EXAMPLES.items():
        robot = ElementTree.parse(path).getroot()
        (joint,) = (j for j in robot.iter("joint") if j.get("name") == "top_to_l2")
        origins[name] = joint.find("origin").attrib
        joint.remove(joint.findall("origin")[0])
        rest[name] = ElementTree.tostring(robot)
    assert rest["top"] == rest["forward"]
    assert origins["top"]["rpy"] == "0 0 0"
    forward = [float(value) for value in origins["forward"]["rpy"].split()]
    np.testing.assert_allclose(forward, (np.pi, -np.pi / 2, 0))


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_and_driver_make_one_tree(name: Any) -> None:
    robot = ElementTree.parse(EXAMPLES[name]).getroot()
    parents = joints(robot)
    links = {link.get("name") for link in robot.iter("link")}
    assert links == set(parents) | {"base_link"}
    frames = FrameConfig()
    assert frames.imu not in links, "the driver publishes it"
    assert frames.cloud in links
    assert roots({**parents, frames.imu: frames.cloud}) == {"base_link"}


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_loads_and_puts_the_sensor_on_the_cube(name: Any) -> None:
    yourdfpy = pytest.importorskip("yourdfpy")
    robot = yourdfpy.URDF.load(
        str(EXAMPLES[name]),
        filename_handler=lambda fname: str(ROOT / fname.removeprefix("package://l2lidar_node/")),
    )
    assert robot.validate(), robot.errors
    assert robot.base_link == "base_link"
    T_base_cloud = robot.get_transform("l2lidar_link", "base_link")
    rotation, position = POSES[name]
    np.testing.assert_allclose(T_base_cloud[:3, :3], rotation, atol=1e-9)
    np.testing.assert_allclose(T_base_cloud[:3, 3], position, atol=1e-9)
    sizes = {
        link: robot.link_map[link].visuals[0].geometry.box.size
        for link in ("base_link", "top_link")
    }
    np.testing.assert_allclose(sizes["base_link"], 0.2)
    np.testing.assert_allclose(sizes["top_link"], 0.1)
    assert "l2_lidar.stl" in robot.scene.geometry


def expand(tmp_path: Path, call: Any) -> ElementTree.Element:
    """Return a robot that calls the macro, as plain URDF."""
    xacro = pytest.importorskip("xacro")
    path = tmp_path / "robot.urdf.xacro"
    path.write_text(
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'
        f'<xacro:include filename="{ROOT / "urdf" / "l2lidar.xacro"}"/>'
        f'<link name="mast"/>{call}</robot>'
    )
    document: Document = xacro.process_file(str(path))
    return ElementTree.fromstring(document.toxml())


def test_macro_makes_the_drivers_default_frame(tmp_path: Path) -> None:
    robot = expand(
        tmp_path, '<xacro:l2lidar parent="mast"><origin xyz="1 2 3" rpy="0 0 0"/></xacro:l2lidar>'
    )
    assert joints(robot) == {FrameConfig().cloud: "mast"}
    assert robot.find("joint/origin").get("xyz") == "1 2 3"
    mesh = robot.find(".//mesh").get("filename").removeprefix("package://l2lidar_node/")
    assert (ROOT / mesh) == MESH
    assert float(robot.findall(".//mass")[0].get("value", "nan")) == pytest.approx(0.23)


def test_macro_can_make_the_imu_frame_and_several_sensors(tmp_path: Path) -> None:
    robot = expand(
        tmp_path,
        "".join(
            f'<xacro:l2lidar parent="mast" name="{name}" prefix="bot1/" imu_frame="true">'
            '<origin xyz="0 0 0" rpy="0 0 0"/></xacro:l2lidar>'
            for name in ("front", "rear")
        ),
    )
    frames = [FrameConfig(cloud_frame=f"bot1/{name}_link") for name in ("front", "rear")]
    expected = {frame.cloud: "mast" for frame in frames}
    expected.update({frame.imu: frame.cloud for frame in frames})
    assert joints(robot) == expected
    for joint in robot.iter("joint"):
        if joint.get("name").endswith("_imu_joint"):
            xyz = [float(value) for value in joint.find("origin").get("xyz").split()]
            assert tuple(xyz) == wire.IMU_POSITION_M
    names = [element.get("name") for element in robot.iter("joint")]
    assert len(set(names)) == len(names) == 4
