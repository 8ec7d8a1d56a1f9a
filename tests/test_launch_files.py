"""Every launch file compiles, names only what exists, and starts what it says it starts."""

import ast
import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from l2lidar_node.check.requirements import CONSUMERS as CHECKED
from l2lidar_node.clouds import LAYOUTS, RINGS, rings
from l2lidar_node.config import DriverConfig, FrameConfig
from l2lidar_node.ros import topics
from l2lidar_node.ros.parameter_files import parameters_by_node, parameters_for
from l2lidar_node.settings import build, settings_of
from l2lidar_proc.deskew.config import DeskewNodeConfig
from tests.l2lidar_proc.odometry.odometry_world import recording
from tests.support.odometry_runs import sweeps

ROOT = Path(__file__).resolve().parent.parent
LAUNCH_FILES = sorted((ROOT / "launch").glob("*.py"))
XML_FILES = sorted((ROOT / "launch").glob("*.xml"))
HELPERS = ROOT / "l2lidar_node" / "ros" / "launching.py"
CONSUMERS = ROOT / "config" / "consumers"
NETWORK = {"l2_ip", "l2_port", "host_ip", "host_port"}
DRIVER = NETWORK | {
    "namespace", "name", "l2_name", "params_file", "override_params_file", "serial_port",
    "imu_adjust", "enable_IMU_publishing", "sweep_cut", "point_layout", "qos_reliability",
    "record_file", "calibration_file", "emulator", "emulator_options", "respawn", "log_level",
}  # fmt: skip
RVIZ = {"namespace", "rviz_config", "fixed_frame", "use_sim_time"}
WITH_RVIZ = DRIVER | RVIZ | {"rviz"}
# Arguments by launch file; what each starts is in STARTS.
ARGUMENTS = {
    "l2lidar": DRIVER,
    "rviz": RVIZ,
    "l2lidar_with_rviz": WITH_RVIZ,
    "deskew_odometry": WITH_RVIZ
    | {"proc_params_file", "odometry", "odom_frame", "base_frame", "use_sim_time"},
    "slam": WITH_RVIZ
    | {"proc_params_file", "odometry", "odom_frame", "base_frame", "use_sim_time"}
    | {"slam_params_file", "mode", "load_map", "data_dir", "map_name"},
    "lio_input": WITH_RVIZ | {"consumer"},
    "replay": RVIZ
    | {"file", "rate", "loop", "deskew_odometry", "name", "l2_name", "l2_ip", "rviz"}
    | {"log_level", "params_file", "proc_params_file", "calibration_file"},
    "l2_top_mount_example": WITH_RVIZ,
    "l2_forward_mount_example": WITH_RVIZ,
    "multi": {"sensors_file", "deskew_odometry", "emulator"},
    "lio_sam": WITH_RVIZ
    | {"base_frame", "publish_base_tf", "lio_sam_params_file", "proc_params_file"}
    | {"deskew_params_file", "fastdds_profile"},
}
STARTS = {
    "l2lidar": ["l2lidar_node"],
    "rviz": ["rviz2"],
    "l2lidar_with_rviz": ["rviz2", "l2lidar_node"],
    "deskew_odometry": ["l2lidar_node", "companion_node"],
    "slam": ["l2lidar_node", "companion_node", "slam_node"],
    "lio_input": ["l2lidar_node"],
    "replay": ["l2lidar_node", "companion_node"],
    "l2_top_mount_example": ["robot_state_publisher", "rviz2", "l2lidar_node"],
    "l2_forward_mount_example": ["robot_state_publisher", "rviz2", "l2lidar_node"],
    "multi": ["l2lidar_node", "l2lidar_node"],
    "lio_sam": [
        "rviz2",
        "static_transform_publisher",
        "static_transform_publisher",
        "lio_sam_imuPreintegration",
        "lio_sam_imageProjection",
        "lio_sam_featureExtraction",
        "lio_sam_mapOptimization",
        "deskew_node",
        "l2lidar_node",
    ],
}
NEEDED = {"lio_input": {"consumer": "lio_sam"}, "replay": {"file": str(ROOT / "README.md")}}
OURS = {"l2lidar_node", "l2lidar_emulator", "deskew_node", "companion_node", "slam_node"}

# The folder launch/ of this repository looks like an empty package: ask for more of the real one.
try:
    HAS_LAUNCH = importlib.util.find_spec("launch.actions") is not None
except ModuleNotFoundError:
    HAS_LAUNCH = False
needs_launch = pytest.mark.skipif(not HAS_LAUNCH, reason="needs launch and launch_ros of a ROS 2")


def name_of(path: Any) -> Any:
    return path.name.removesuffix(".launch.py")


def strings(path: Any) -> Any:
    tree = ast.parse(path.read_text())
    return [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)
            and isinstance(node.value, str)]  # fmt: skip


def executables() -> Any:
    return set(re.findall(r'"(\w+) = l2lidar_\w+\.[\w.]+:\w+"', (ROOT / "setup.py").read_text()))


def consumer_driver(name: Any) -> Any:
    return parameters_for(CONSUMERS / name / "driver.yaml", "l2lidar_node", "/l2lidar_node")


def test_launch_files_are_those_known() -> None:
    assert {name_of(path) for path in LAUNCH_FILES} == set(ARGUMENTS)


@pytest.mark.parametrize("path", [*LAUNCH_FILES, HELPERS], ids=name_of)
def test_file_compiles(path: Any) -> None:
    compile(path.read_text(), path.name, "exec")


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=name_of)
def test_every_shared_file_named_exists(path: Any) -> None:
    for text in strings(path):
        if re.fullmatch(r"[\w.]+\.(launch\.py|rviz|urdf|yaml|xml)", text):
            assert list(ROOT.glob(f"launch/{text}")) or list(ROOT.glob(f"[cru]*/**/{text}")), text


def test_every_executable_started_is_installed() -> None:
    started = {
        text for path in LAUNCH_FILES for text in strings(path) if text in OURS
    }  # l2lidar_node is the package as well
    assert started == OURS
    assert started <= executables()


def test_driver_arguments_are_parameters_of_the_driver() -> None:
    known = {item.name for item in settings_of(DriverConfig)}
    (tree,) = (ast.parse(path.read_text()) for path in LAUNCH_FILES if name_of(path) == "l2lidar")
    passed = {
        ast.unparse(target): set(ast.literal_eval(node.value))
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
    }
    assert passed["TEXT"] | passed["TYPED"] <= known
    assert passed["LOOPBACK"] <= NETWORK
    assert {"serial_port", "record_file", "calibration_file"} <= passed["TEXT"]


@pytest.mark.parametrize("path", XML_FILES, ids=lambda path: path.name)
def test_xml_names_what_exists(path: Any) -> None:
    launch = ElementTree.parse(path).getroot()
    assert launch.tag == "launch"
    declared = {argument.get("name") for argument in launch.iter("arg")}
    text = path.read_text()
    assert set(re.findall(r"\$\(var (\w+)\)", text)) <= declared
    for shared in re.findall(r"\$\(find-pkg-share l2lidar_node\)/([\w/.]+)", text):
        assert (ROOT / shared).is_file(), shared
    for node in launch.iter("node"):
        assert node.get("pkg") == "l2lidar_node"
        assert node.get("exec") in executables()
        remapped = {item.get("from"): item.get("to") for item in node.iter("remap")}
        assert remapped == {topic: topic[1:] for topic in topics.DRIVER_TOPICS}


def test_example_of_several_sensors_is_what_drivers_take() -> None:
    path = ROOT / "config" / "multi.yaml"
    shared, *sensors = parameters_by_node(path)
    assert shared == "/**/l2lidar_node"
    assert sensors == ["/front/l2lidar_node", "/rear/l2lidar_node"]
    built = [build(DriverConfig, parameters_for(path, "any", name)) for name in sensors]
    assert len({config.network.host_port for config in built}) == len(built)
    assert len({config.frames.cloud for config in built}) == len(built)


@pytest.mark.parametrize(
    "name", sorted(path.name for path in CONSUMERS.iterdir() if path.is_dir())
)
def test_consumer_has_what_the_driver_takes_and_a_configuration(name: Any) -> None:
    config = build(DriverConfig, consumer_driver(name))
    assert config.imu.enable_publishing
    assert not config.imu.adjust, "a consumer that deskews wants the sensor's own frame"
    assert config.sweep.cut == "turn"
    others = [path for path in (CONSUMERS / name).iterdir() if path.name != "driver.yaml"]
    assert others
    for path in others:
        text = path.read_text()
        if path.suffix == ".json":
            # GLIM's reader takes comments, json does not.
            yaml.safe_load(re.sub(r"//[^\n]*", "", text))
        else:
            yaml.safe_load(text)


def test_consumers_named_are_those_configured() -> None:
    (named,) = (
        ast.literal_eval(node.value)
        for node in ast.parse((ROOT / "launch" / "lio_input.launch.py").read_text()).body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "CONSUMERS"
    )
    assert set(named) == {path.name for path in CONSUMERS.iterdir() if path.is_dir()}


def test_reliable_imu_subscribers_get_a_reliable_publisher() -> None:
    for name in ("fast_lio", "point_lio"):
        assert consumer_driver(name)["qos_reliability"] == "reliable"


def test_extrinsic_has_each_projects_own_sign() -> None:
    imu_in_lidar = [-0.007698, -0.014655, 0.00667]
    lidar_in_imu = [-value for value in imu_in_lidar]

    def value(path: Any, name: Any) -> Any:
        return parameters_for(CONSUMERS / path, "any", "/any")[name]

    assert value("lio_sam/params.yaml", "extrinsicTrans") == imu_in_lidar
    assert value("fast_lio/l2.yaml", "mapping.extrinsic_T") == lidar_in_imu
    assert value("point_lio/l2.yaml", "mapping.extrinsic_T") == lidar_in_imu
    glim = (CONSUMERS / "glim" / "config_sensors.json").read_text()
    sensors = yaml.safe_load(re.sub(r"//[^\n]*", "", glim))["sensors"]
    assert sensors["T_lidar_imu"] == [*imu_in_lidar, 0.0, 0.0, 0.0, 1.0]


def test_rings_of_the_consumers_are_those_of_the_driver() -> None:
    lio_sam = parameters_for(CONSUMERS / "lio_sam/params.yaml", "any", "/any")
    assert lio_sam["N_SCAN"] == CHECKED["lio_sam"].ring_count
    for name in ("driver", "deskew"):
        made = parameters_for(CONSUMERS / f"lio_sam/{name}.yaml", "any", "/any")
        assert made["ring_count"] == lio_sam["N_SCAN"]
        assert made["point_layout"] == "velodyne"
    for name in ("fast_lio", "point_lio"):  # which have memory for 128
        other = parameters_for(CONSUMERS / name / "l2.yaml", "any", "/any")
        assert other["preprocess.scan_line"] == min(RINGS, 128)


class Started:
    """A node as a launch file would start it."""

    def __init__(self, action: Any, context: Any) -> None:
        from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

        self.action = action
        self.given = dict(context.launch_configurations)
        action._perform_substitutions(context)
        self.name = action.node_name
        program = normalize_to_list_of_substitutions(action.node_executable)
        self.executable = perform_substitutions(context, program)
        self.remappings = action.expanded_remapping_rules
        self.files = [Path(path) for path, _ in action._Node__expanded_parameter_arguments or ()]
        self.words = [
            "".join(part.perform(context) for part in word)
            for word in action.cmd[1:]
            if not any(type(part).__name__ == "LocalSubstitution" for part in word)
        ]

    @property
    def parameters(self) -> Any:
        """What the node takes from its files, as ROS reads them."""
        return self.parameters_of(self.name)

    def parameters_of(self, name: Any) -> Any:
        """What the node with this full name in the process takes from its files."""
        values = {}
        for path in self.files:
            values.update(parameters_for(path, "no stock name", name))
        return values


class Launched:
    """A launch file with its actions made, but nothing started."""

    def __init__(self, path: Any, given: Any) -> None:
        from launch import LaunchContext, LaunchDescription  # type: ignore[attr-defined]  # our folder launch/ hides it
        from launch.actions import IncludeLaunchDescription
        from launch.launch_description_sources import AnyLaunchDescriptionSource

        self.context = LaunchContext()
        self.context._set_asyncio_loop(None)
        self.context.launch_configurations.update(given)
        self.declared: dict[str, Any] = {}
        self.nodes: list[Any] = []
        self.processes: list[Any] = []
        self.said: list[Any] = []
        source = AnyLaunchDescriptionSource(str(path))
        description = source.get_launch_description(self.context)
        assert isinstance(description, LaunchDescription)
        self.declared = {item.name: item for item in description.get_launch_arguments()}
        self._walk(IncludeLaunchDescription(source, launch_arguments=given.items()))

    def _walk(self, entity: Any) -> None:
        from launch.actions import ExecuteProcess, LogInfo
        from launch_ros.actions import Node

        condition = getattr(entity, "condition", None)
        if condition is not None and not condition.evaluate(self.context):
            return
        if isinstance(entity, Node):
            self.nodes.append(Started(entity, self.context))
        elif isinstance(entity, ExecuteProcess):
            self.processes.append(
                ["".join(part.perform(self.context) for part in word) for word in entity.cmd]
            )
        elif isinstance(entity, LogInfo):
            self.said.append("".join(part.perform(self.context) for part in entity.msg))
        else:
            for below in entity.visit(self.context) or ():
                self._walk(below)

    def node(self, executable: Any) -> Any:
        (found,) = (item for item in self.nodes if item.executable == executable)
        return found

    @property
    def executables(self) -> Any:
        return [item.executable for item in self.nodes]


@pytest.fixture
def launched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Read a launch file in a prefix that has this package and those that it starts."""
    index = tmp_path / "prefix" / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    others = {
        "rviz2": {"rviz2"},
        "robot_state_publisher": {"robot_state_publisher"},
        "tf2_ros": {"static_transform_publisher"},
        "lio_sam": {name for name in STARTS["lio_sam"] if name.startswith("lio_sam_")},
    }
    for package, programs in {"l2lidar_node": OURS, **others}.items():
        (index / package).touch()
        folder = tmp_path / "prefix" / "lib" / package
        folder.mkdir(parents=True)
        for program in programs:
            (folder / program).symlink_to(sys.executable)
    (tmp_path / "prefix" / "share" / "l2lidar_node").symlink_to(ROOT)
    known = os.environ.get("AMENT_PREFIX_PATH", "")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path / 'prefix'}:{known}")

    def run(name: Any, **given: Any) -> Any:
        path = ROOT / "launch" / (name if "." in name else f"{name}.launch.py")
        return Launched(path, {**NEEDED.get(name, {}), **given})

    return run


@needs_launch
@pytest.mark.parametrize("name", ARGUMENTS)
def test_arguments_are_described_and_have_a_default(launched: Any, name: Any) -> None:
    declared = launched(name).declared
    assert set(declared) == ARGUMENTS[name]
    for argument in declared.values():
        assert argument.description
        assert argument.description != "no description given"
        assert (argument.default_value is None) == (argument.name in NEEDED.get(name, {}))


@needs_launch
@pytest.mark.parametrize("name", STARTS)
def test_starts_what_it_says(launched: Any, name: Any) -> None:
    assert launched(name).executables == STARTS[name]


@needs_launch
@pytest.mark.parametrize("name", [name for name in STARTS if "l2lidar_node" in STARTS[name]])
def test_driver_gets_parameters_it_takes(launched: Any, name: Any) -> None:
    for node in launched(name).nodes:
        if node.executable == "l2lidar_node":
            build(DriverConfig, node.parameters)


@needs_launch
@pytest.mark.parametrize(
    "name", [name for name in STARTS if "emulator" in DRIVER & ARGUMENTS[name]]
)
def test_emulator_is_on_loopback_and_ready_at_once(launched: Any, name: Any) -> None:
    if name == "multi":
        return
    made = launched(name, emulator="true", l2_ip="10.0.0.1", host_port="7001")
    ((program, *words),) = made.processes
    assert Path(program).name == "l2lidar_emulator"
    mounted = ["--mount", "forward"] if name == "l2_forward_mount_example" else []
    assert words == ["--lidar-port", "6101", "--host-port", "7001", "--ready", *mounted]
    values = made.node("l2lidar_node").parameters
    assert {key: values[key] for key in NETWORK} == {
        "l2_ip": "127.0.0.1", "l2_port": 6101, "host_ip": "127.0.0.1", "host_port": 7001
    }  # fmt: skip
    assert not made.said


@needs_launch
def test_emulator_options_are_split_as_a_shell_does_and_spin_up_is_announced(
    launched: Any,
) -> None:
    made = launched("l2lidar", emulator="true", emulator_options="--world 'my world.ply'")
    assert made.processes[0][-2:] == ["--world", "my world.ply"]
    assert "points arrive after 25 s" in made.said[0]


@needs_launch
def test_arguments_go_over_the_parameter_file_and_what_is_empty_does_not(
    launched: Any, tmp_path: Path
) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("/l2lidar_node: {ros__parameters: {l2_ip: 10.1.1.1, host_ip: 10.1.1.2}}")
    made = launched("l2_top_mount_example", params_file=str(file), l2_ip="10.42.0.62")
    values = made.node("l2lidar_node").parameters
    assert values == {"l2_ip": "10.42.0.62", "host_ip": "10.1.1.2", "imu_adjust": False}
    made = launched(
        "l2lidar",
        params_file=str(file),
        serial_port="/dev/ttyACM0",
        point_layout="velodyne",
        qos_reliability="reliable",
        record_file="run.pcap",
    )
    assert made.node("l2lidar_node").parameters == {
        "l2_ip": "10.1.1.1", "host_ip": "10.1.1.2", "serial_port": "/dev/ttyACM0",
        "point_layout": "velodyne", "qos_reliability": "reliable", "record_file": "run.pcap",
    }  # fmt: skip


@needs_launch
def test_files_keyed_by_full_name_work_in_a_pushed_namespace(
    launched: Any, tmp_path: Path
) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("/robot/front/l2lidar_node: {ros__parameters: {l2_ip: 10.1.1.1}}")
    outer = tmp_path / "robot.launch.py"
    outer.write_text(
        "from launch import LaunchDescription\n"
        "from launch.actions import GroupAction, IncludeLaunchDescription\n"
        "from launch_ros.actions import PushRosNamespace\n"
        "def generate_launch_description():\n"
        "    return LaunchDescription([GroupAction([PushRosNamespace('robot'),\n"
        f"        IncludeLaunchDescription({str(ROOT / 'launch' / 'l2lidar.launch.py')!r},\n"
        "            launch_arguments={'namespace': 'front', 'host_port': '7001',\n"
        f"                'params_file': {str(file)!r}}}.items())])])\n"
    )
    node = Launched(outer, {}).node("l2lidar_node")
    assert node.name == "/robot/front/l2lidar_node"
    assert node.parameters == {"l2_ip": "10.1.1.1", "host_port": 7001}


@needs_launch
def test_missing_files_and_wrong_words_are_refused(launched: Any) -> None:
    with pytest.raises(FileNotFoundError, match=r"params_file:=absent\.yaml: there is no such"):
        launched("l2lidar", params_file="absent.yaml")
    with pytest.raises(FileNotFoundError, match="override_params_file:=absent"):
        launched("l2lidar", override_params_file="absent")
    with pytest.raises(FileNotFoundError, match=r"file:=absent\.pcap: no such file"):
        launched("replay", file="absent.pcap")
    with pytest.raises(RuntimeError, match="rate:=fast is not a number"):
        launched("replay", rate="fast")
    with pytest.raises(FileNotFoundError, match="rviz_config:=absent: no such file"):
        launched("l2lidar_with_rviz", rviz_config="absent")
    with pytest.raises(RuntimeError, match="Valid options"):
        launched("lio_input", consumer="orb_slam")
    with pytest.raises(RuntimeError, match="has no driver; expected sections"):
        launched("multi", sensors_file=str(ROOT / "config" / "l2lidar_node.yaml"))


@needs_launch
def test_a_required_node_that_fails_ends_the_launch() -> None:
    from launch import LaunchContext  # type: ignore[attr-defined]  # our folder launch/ hides it
    from launch.actions import Shutdown
    from launch.events.process import ProcessExited

    from l2lidar_node.ros.launching import required

    def ended(code: Any, *settings: Any) -> Any:
        event = ProcessExited(
            action=None, name="deskew_node-2", cmd=[], cwd=None, env=None, pid=1, returncode=code
        )
        return required(*settings)(event, LaunchContext())

    for code in (0, 1, -9):
        assert ended(code, True) is None
    assert isinstance(ended(0, False), Shutdown)
    assert ended(0, False, False) is None
    for settings, code in (((True,), 2), ((False,), 2), ((False,), 1), ((False, False), -11)):
        with pytest.raises(RuntimeError, match=f"deskew_node-2 ended with exit code {code}"):
            ended(code, *settings)


@needs_launch
def test_two_sensors_share_no_name(launched: Any) -> None:
    for namespace in ("front", "rear/deep"):
        made = launched("l2lidar", namespace=namespace, l2_name=f"{namespace[:4]}_l2")
        node = made.node("l2lidar_node")
        assert node.name == f"/{namespace}/l2lidar_node"
        assert node.remappings == [(name, name.removeprefix("/")) for name in topics.DRIVER_TOPICS]
        assert node.parameters["l2_name"] == f"{namespace[:4]}_l2"


@needs_launch
def test_one_file_starts_several_sensors(launched: Any) -> None:
    made = launched("multi")
    assert [node.name for node in made.nodes] == ["/front/l2lidar_node", "/rear/l2lidar_node"]
    configs = [build(DriverConfig, node.parameters) for node in made.nodes]
    assert [config.network.l2_ip for config in configs] == ["192.168.1.62", "192.168.1.63"]
    assert [config.network.host_port for config in configs] == [6201, 6202]
    assert [config.frames.cloud for config in configs] == ["front_link", "rear_link"]
    made = launched("multi", emulator="true", deskew_odometry="true")
    ports = [
        (config.network.l2_port, config.network.host_port)
        for config in (
            build(DriverConfig, node.parameters)
            for node in made.nodes
            if node.executable == "l2lidar_node"
        )
    ]
    assert len({port for pair in ports for port in pair}) == 4
    assert len(made.processes) == 2
    hosts = [node for node in made.nodes if node.executable == "companion_node"]
    for host, side in zip(hosts, ("front", "rear"), strict=True):
        assert host.parameters_of(f"/{side}/odometry_node")["odom_frame"] == f"{side}_odom"
        assert "odom_frame" not in host.parameters_of(f"/{side}/deskew_node")
        # what only the driver knows does not reach the others, which would warn of it
        for name in ("odometry_node", "deskew_node"):
            assert "enable_IMU_publishing" not in host.parameters_of(f"/{side}/{name}")


@needs_launch
def test_deskew_gets_points_of_the_sensors_own_frame_with_an_imu(launched: Any) -> None:
    values = launched("deskew_odometry").node("l2lidar_node").parameters
    assert values["imu_adjust"] is False
    assert values["enable_IMU_publishing"] is True
    assert values["sweep_cut"] == "turn"
    other = launched("deskew_odometry", sweep_cut="half_turn")
    assert other.node("l2lidar_node").parameters["sweep_cut"] == "half_turn"
    alone = launched("deskew_odometry", odometry="false").executables
    assert alone == ["l2lidar_node", "deskew_node"]
    framed = launched("deskew_odometry", base_frame="base_link").node("companion_node")
    assert framed.parameters_of("/odometry_node")["base_frame"] == "base_link"


@needs_launch
@pytest.mark.parametrize("name", [name for name in STARTS if "rviz2" in STARTS[name]][1:])
def test_rviz_gets_points_that_tf_can_turn(launched: Any, name: Any) -> None:
    """TF applies the mount; points that are level already would be turned twice."""
    assert launched(name).node("l2lidar_node").parameters["imu_adjust"] is False
    assert launched(name, imu_adjust="true").node("l2lidar_node").parameters["imu_adjust"] is True


@needs_launch
@pytest.mark.parametrize(
    "consumer", sorted(path.name for path in CONSUMERS.iterdir() if path.is_dir())
)
def test_consumer_goes_over_the_parameter_file(launched: Any, consumer: Any) -> None:
    values = launched("lio_input", consumer=consumer).node("l2lidar_node").parameters
    assert consumer_driver(consumer).items() <= values.items()


@needs_launch
def test_replay_is_told_to_the_driver_and_its_time_to_the_others(launched: Any) -> None:
    made = launched("replay", rate="2", rviz="true")
    values = made.node("l2lidar_node").parameters
    assert (values["replay_file"], values["replay_rate"]) == (NEEDED["replay"]["file"], 2.0)
    assert values["replay_loop"] is False
    assert values["imu_adjust"] is False
    assert "use_sim_time" not in values, "the driver makes that time"
    for name in ("companion_node", "rviz2"):
        assert made.node(name).parameters["use_sim_time"] is True
    made = launched("replay", deskew_odometry="false", loop="true")
    assert made.executables == ["l2lidar_node"]
    assert made.node("l2lidar_node").parameters["imu_adjust"] is True
    assert made.node("l2lidar_node").parameters["replay_loop"] is True
    with pytest.raises(RuntimeError, match="deskew_odometry:=false"):
        launched("replay", loop="true")


@needs_launch
@pytest.mark.parametrize("name", ["deskew_odometry", "slam", "replay", "lio_sam"])
def test_a_calibration_reaches_all_that_use_it(launched: Any, name: Any) -> None:
    plain, given = launched(name), launched(name, calibration_file="/home/me/front.yaml")
    for program in {"l2lidar_node", "deskew_node", "companion_node"} & set(given.executables):
        assert plain.node(program).parameters.get("calibration_file", "") == ""
        assert given.node(program).parameters["calibration_file"] == "/home/me/front.yaml"


@needs_launch
def test_only_a_driver_of_a_real_sensor_is_started_again(launched: Any) -> None:
    from launch.utilities.type_utils import perform_typed_substitution

    def respawns(name: Any, **given: Any) -> Any:
        made = launched(name, **given)
        node = made.node("l2lidar_node").action
        return perform_typed_substitution(made.context, node._ExecuteLocal__respawn, bool)

    assert respawns("l2lidar")
    assert not respawns("l2lidar", respawn="false")
    assert not respawns("replay")


@needs_launch
@pytest.mark.parametrize("name", [name for name in STARTS if "rviz" in ARGUMENTS[name]])
def test_rviz_only_where_asked_for_and_before_what_would_be_left_behind(
    launched: Any, name: Any
) -> None:
    assert "rviz2" not in launched(name, rviz="false").executables
    made = launched(name, rviz="true", namespace="front")
    node = made.node("rviz2")
    assert node.words[:1] == ["-d"]
    assert Path(node.words[1]).is_file()
    assert ("/points", "points") in node.remappings
    # launch leaves behind what it started in the same instant in which something is not there.
    last_of_others = max(made.executables.index(name) for name in set(made.executables) - OURS)
    assert last_of_others < min(
        made.executables.index(name) for name in OURS & set(made.executables)
    )


@needs_launch
def test_rviz_follows_the_name_of_the_sensor(launched: Any) -> None:
    words = launched("l2lidar_with_rviz", l2_name="rear").node("rviz2").words
    assert words[2:4] == ["-f", "rear_link"]
    assert "-f" not in launched("l2lidar_with_rviz").node("rviz2").words


def test_lio_sam_parts_agree_on_topics_frames_and_sizes() -> None:
    lio_sam = parameters_for(CONSUMERS / "lio_sam/params.yaml", "any", "/any")
    deskew = build(
        DeskewNodeConfig,
        parameters_for(CONSUMERS / "lio_sam/deskew.yaml", "deskew_node", "/deskew_node"),
    )
    assert lio_sam["pointCloudTopic"] == f"/{deskew.topics.output_topic}"
    assert lio_sam["lidarFrame"] == FrameConfig().cloud
    # Where both are the same LIO-SAM broadcasts transforms with an empty frame.
    assert lio_sam["baselinkFrame"] != lio_sam["lidarFrame"]
    assert "time" not in (LAYOUTS["velodyne"].without_time().dtype.names or ())
    assert deskew.proc.deskew.reference == "middle", "its poses belong to the cloud's stamp"
    # cloud_info holds two numbers of 4 bytes for each cell and each ring, and a PointXYZI of 32
    # for each point that has a cell. What stock Fast DDS's 512 kB do not hold is lost.
    rows, columns = lio_sam["N_SCAN"], lio_sam["Horizon_SCAN"]
    for scene in ("room", "yard"):
        for sweep in list(sweeps(recording(scene, "walk"), "turn"))[1:4]:
            row = rings(sweep.points, rows).astype(np.int64)
            azimuth = np.arctan2(sweep.points["y"], sweep.points["x"]) / (2 * np.pi) + 0.5
            kept = len(np.unique(row * columns + (azimuth * columns).astype(np.int64)))
            assert 8 * (rows * columns + rows) + 32 * kept < 480_000, scene
    profile = ElementTree.parse(ROOT / "config" / "fastdds_lio_sam.xml").getroot()
    (size,) = (item.text for item in profile.iter() if item.tag.endswith("segment_size"))
    assert int(size or "0") == 16 * 2**20


@needs_launch
def test_lio_sam_gets_deskewed_clouds_a_base_frame_and_shared_memory(
    launched: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"):
        monkeypatch.delenv(name, raising=False)
    made = launched("lio_sam", l2_name="front", base_frame="robot")
    for node in made.nodes:
        if node.executable.startswith("lio_sam_"):
            values = node.parameters
            assert (values["lidarFrame"], values["baselinkFrame"]) == ("front_link", "robot")
            assert values["pointCloudTopic"] == "/points_deskewed"
    profile = made.context.environment["FASTRTPS_DEFAULT_PROFILES_FILE"]
    assert Path(profile).name == "fastdds_lio_sam.xml"
    tied = [node for node in made.nodes if node.executable == "static_transform_publisher"]
    assert tied[1].words[:4] == ["--frame-id", "robot", "--child-frame-id", "front_link"]
    driver, deskew = made.node("l2lidar_node").parameters, made.node("deskew_node").parameters
    assert driver["imu_adjust"] is False
    assert driver["sweep_cut"] == "turn"
    assert build(DeskewNodeConfig, deskew).topics.ring_count == 75
    untied = launched("lio_sam", publish_base_tf="false", rviz="false").executables
    assert untied.count("static_transform_publisher") == 1
    assert "rviz2" not in untied
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "/mine.xml")
    own = launched("lio_sam").context.environment
    assert own["FASTRTPS_DEFAULT_PROFILES_FILE"] == "/mine.xml"


@needs_launch
def test_without_lio_sam_nothing_is_started(launched: Any, tmp_path: Path) -> None:
    (tmp_path / "prefix/share/ament_index/resource_index/packages/lio_sam").unlink()
    with pytest.raises(RuntimeError, match="package 'lio_sam' is not installed"):
        launched("lio_sam")


@needs_launch
def test_xml_starts_the_driver_with_the_same_parameters(launched: Any) -> None:
    node = launched("l2lidar.launch.xml", namespace="front").node("l2lidar_node")
    other = launched("l2lidar", namespace="front").node("l2lidar_node")
    assert (node.name, node.parameters) == (other.name, other.parameters)
    assert node.remappings == other.remappings


@needs_launch
@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (["l2_port:=99999"], 1, "parameter 'l2_port': 99999 is out of range"),
        (["emulator:=true", "emulator_options:=--nonsense"], 1, "No such option: --nonsense"),
        (["l2_ip:=127.0.0.1", "host_ip:=127.0.0.1"], 0, "listening on 127.0.0.1"),
    ],
    ids=["refused parameter", "emulator fails", "interrupted"],
)
def test_launch_ends_with_its_parts_and_leaves_none_behind(
    tmp_path: Path, words: Any, code: int, text: str
) -> None:
    """Run the real thing: what fails ends the launch with an exit code, and nothing lives on."""
    script = (
        "import sys\n"
        "from launch import LaunchDescription, LaunchService\n"
        "from launch.actions import IncludeLaunchDescription\n"
        "path, *given = sys.argv[1:]\n"
        "service = LaunchService(noninteractive=True)\n"  # so it hands the signal on itself
        "service.include_launch_description(LaunchDescription([IncludeLaunchDescription(path,\n"
        "    launch_arguments=[tuple(word.split(':=')) for word in given])]))\n"
        "sys.exit(service.run())\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(ROOT / "launch" / "l2lidar.launch.py"),
         "host_port:=47611", *words],
        env={**os.environ, "ROS_LOG_DIR": str(tmp_path), "ROS_LOCALHOST_ONLY": "1"},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip
    said = ""
    try:
        for line in process.stdout:
            said += line
            if not code and text in line:
                process.send_signal(signal.SIGINT)
        assert process.wait(60) == code, said
    finally:
        still = _session_of(process.pid)
        for pid in still:
            os.kill(pid, signal.SIGKILL)
    assert text in said
    assert not still, said


def _session_of(leader: Any) -> Any:
    """Return the processes of a session that still run, after at most ten seconds."""
    deadline = time.monotonic() + 10.0
    while True:
        found = [
            int(path.parent.name)
            for path in Path("/proc").glob("[0-9]*/stat")
            if _session(path) == leader
        ]
        if not found or time.monotonic() > deadline:
            return found
        time.sleep(0.1)


def _session(path: Any) -> Any:
    try:
        state, _, _, session = path.read_text().rpartition(")")[2].split()[:4]
    except OSError:
        return None  # it has ended meanwhile
    return None if state == "Z" else int(session)
