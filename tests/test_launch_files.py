"""Every launch file compiles, names only what exists, and starts what it says it starts."""

import ast
import importlib.util
import re
from pathlib import Path

import pytest
import yaml

from l2lidar_node.clouds.fields import RINGS
from l2lidar_node.config import DriverConfig
from l2lidar_node.ros import topics
from l2lidar_node.ros.parameter_files import parameters_for
from l2lidar_node.settings import build

ROOT = Path(__file__).resolve().parent.parent
LAUNCH_FILES = sorted((ROOT / "launch").glob("*.py"))
PARTS = [
    ROOT / "l2lidar_node" / "ros" / "bringup.py",
    ROOT / "l2lidar_node" / "ros" / "launch_arguments.py",
    ROOT / "l2lidar_proc" / "ros" / "bringup.py",
]
CONSUMERS = ROOT / "config" / "consumers"
NETWORK = {"l2_ip", "l2_port", "host_ip", "host_port"}
DRIVER = NETWORK | {
    "namespace", "name", "params_file", "emulator", "emulator_options", "respawn", "log_level"
}  # fmt: skip
RVIZ = {"rviz", "rviz_config"}
# Arguments by launch file; what each starts is in STARTS.
ARGUMENTS = {
    "l2lidar": DRIVER | {"l2_name"},
    "l2lidar_with_rviz": DRIVER | RVIZ | {"l2_name"},
    "deskew_odometry": DRIVER | RVIZ | {"l2_name", "proc_params_file", "sweep_cut", "odometry"},
    "lio_input": DRIVER | RVIZ | {"l2_name", "consumer"},
    "replay": RVIZ
    | {"file", "rate", "loop", "deskew_odometry", "namespace", "name", "l2_name", "l2_ip"}
    | {"log_level", "params_file", "proc_params_file"},
    "l2_top_mount_example": DRIVER | RVIZ,
    "l2_forward_mount_example": DRIVER | RVIZ,
}
STARTS = {
    "l2lidar": ["l2lidar_node"],
    "l2lidar_with_rviz": ["l2lidar_node", "rviz2"],
    "deskew_odometry": ["l2lidar_node", "deskew_node", "odometry_node"],
    "lio_input": ["l2lidar_node"],
    "replay": ["l2lidar_node", "deskew_node", "odometry_node"],
    "l2_top_mount_example": ["robot_state_publisher", "l2lidar_node", "rviz2"],
    "l2_forward_mount_example": ["robot_state_publisher", "l2lidar_node", "rviz2"],
}
NEEDED = {"lio_input": {"consumer": "lio_sam"}, "replay": {"file": str(ROOT / "README.md")}}

# The folder launch/ of this repository looks like an empty package: ask for more of the real one.
try:
    HAS_LAUNCH = importlib.util.find_spec("launch.actions") is not None
except ModuleNotFoundError:
    HAS_LAUNCH = False
needs_launch = pytest.mark.skipif(not HAS_LAUNCH, reason="needs launch and launch_ros of a ROS 2")


def name_of(path):
    return path.name.removesuffix(".launch.py")


def strings(path):
    tree = ast.parse(path.read_text())
    return [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)
            and isinstance(node.value, str)]  # fmt: skip


def executables():
    return set(re.findall(r'"(\w+) = l2lidar_\w+\.[\w.]+:\w+"', (ROOT / "setup.py").read_text()))


def consumer_driver(name):
    return parameters_for(CONSUMERS / name / "driver.yaml", "l2lidar_node", "/l2lidar_node")


def test_launch_files_are_those_known():
    assert {name_of(path) for path in LAUNCH_FILES} == set(ARGUMENTS)


@pytest.mark.parametrize("path", LAUNCH_FILES + PARTS, ids=name_of)
def test_file_compiles(path):
    compile(path.read_text(), path.name, "exec")


@pytest.mark.parametrize("path", LAUNCH_FILES + PARTS, ids=name_of)
def test_every_shared_file_named_exists(path):
    for text in strings(path):
        if re.fullmatch(r"(config|rviz|urdf)/[\w/.]+", text):
            assert (ROOT / text).exists(), text
        elif text.endswith(".urdf"):
            assert (ROOT / "urdf" / "examples" / text).is_file(), text


def test_every_executable_started_is_installed():
    started = {
        node.args[0].value
        for path in LAUNCH_FILES + PARTS
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
        and getattr(node.func, "id", "") in {"_node", "companion", "ExecutableInPackage"}
        and isinstance(node.args[0], ast.Constant)
    }
    assert started == {"l2lidar_node", "l2lidar_emulator", "deskew_node", "odometry_node"}
    assert started <= executables()


@pytest.mark.parametrize(
    "name", sorted(path.name for path in CONSUMERS.iterdir() if path.is_dir())
)
def test_consumer_has_what_the_driver_takes_and_a_configuration(name):
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


def test_consumers_named_are_those_configured():
    (named,) = (
        ast.literal_eval(node.value)
        for node in ast.parse((ROOT / "launch" / "lio_input.launch.py").read_text()).body
        if isinstance(node, ast.Assign) and node.targets[0].id == "CONSUMERS"
    )
    assert set(named) == {path.name for path in CONSUMERS.iterdir() if path.is_dir()}


def test_reliable_imu_subscribers_get_a_reliable_publisher():
    for name in ("fast_lio", "point_lio"):
        assert consumer_driver(name)["qos_reliability"] == "reliable"


def test_extrinsic_has_each_projects_own_sign():
    imu_in_lidar = [-0.007698, -0.014655, 0.00667]
    lidar_in_imu = [-value for value in imu_in_lidar]

    def value(path, name):
        return parameters_for(CONSUMERS / path, "any", "/any")[name]

    assert value("lio_sam/params.yaml", "extrinsicTrans") == imu_in_lidar
    assert value("fast_lio/l2.yaml", "mapping.extrinsic_T") == lidar_in_imu
    assert value("point_lio/l2.yaml", "mapping.extrinsic_T") == lidar_in_imu
    glim = (CONSUMERS / "glim" / "config_sensors.json").read_text()
    sensors = yaml.safe_load(re.sub(r"//[^\n]*", "", glim))["sensors"]
    assert sensors["T_lidar_imu"] == [*imu_in_lidar, 0.0, 0.0, 0.0, 1.0]


def test_rings_of_the_consumers_are_those_of_the_driver():
    lio_sam = parameters_for(CONSUMERS / "lio_sam/params.yaml", "any", "/any")
    assert lio_sam["N_SCAN"] == RINGS
    for name in ("fast_lio", "point_lio"):  # which have memory for 128
        other = parameters_for(CONSUMERS / name / "l2.yaml", "any", "/any")
        assert other["preprocess.scan_line"] == min(RINGS, 128)


class Launched:
    """A launch file with its actions made, but nothing started."""

    def __init__(self, name, log_dir, **given):
        from launch import LaunchContext
        from launch.actions import DeclareLaunchArgument, OpaqueFunction

        from l2lidar_node.ros import launch_arguments

        path = ROOT / "launch" / f"{name}.launch.py"
        spec = importlib.util.spec_from_file_location(f"launched_{name}", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        self.log_dir = log_dir
        self.context = LaunchContext()
        self.context.launch_configurations.update(given)
        self.declared, self.actions = {}, []
        assert launch_arguments.share("config") == str(ROOT / "config")
        for entity in module.generate_launch_description().entities:
            if isinstance(entity, DeclareLaunchArgument):
                self.declared[entity.name] = entity
                entity.visit(self.context)
            else:  # one makes all: what fails then leaves nothing behind that was started
                assert isinstance(entity, OpaqueFunction)
                assert not self.actions
                self.actions = entity.visit(self.context)

    def text(self, substitutions):
        from launch.utilities import perform_substitutions

        return perform_substitutions(self.context, substitutions)

    @property
    def nodes(self):
        from launch_ros.actions import Node

        return {node.node_executable: node for node in self.actions if isinstance(node, Node)}

    def parameters(self, full_name):
        return parameters_for(self.log_dir / f"{full_name}.yaml", "any", "/any")


@pytest.fixture
def launched(tmp_path, monkeypatch):
    from launch.logging import launch_config

    from l2lidar_node.ros import launch_arguments

    monkeypatch.setattr(launch_arguments, "get_package_share_directory", lambda name: str(ROOT))
    monkeypatch.setattr(launch_config, "_log_dir", str(tmp_path))

    def run(name, **given):
        return Launched(name, tmp_path, **{**NEEDED.get(name, {}), **given})

    return run


@needs_launch
@pytest.mark.parametrize("name", ARGUMENTS)
def test_arguments_are_described_and_have_a_default(launched, name):
    declared = launched(name).declared
    assert set(declared) == ARGUMENTS[name]
    for argument in declared.values():
        assert argument.description
        assert argument.description != "no description given"
        assert (argument.default_value is None) == (argument.name in NEEDED.get(name, {}))


@needs_launch
@pytest.mark.parametrize("name", STARTS)
def test_starts_what_it_says(launched, name):
    assert list(launched(name).nodes) == STARTS[name]


@needs_launch
@pytest.mark.parametrize("name", STARTS)
def test_driver_gets_parameters_it_takes(launched, name):
    build(DriverConfig, launched(name).parameters("l2lidar_node"))


@needs_launch
@pytest.mark.parametrize("name", [name for name in STARTS if "emulator" in ARGUMENTS[name]])
def test_emulator_is_on_loopback_and_ends_the_launch(launched, name):
    from launch.actions import ExecuteProcess
    from launch_ros.actions import Node

    made = launched(name, emulator="true", l2_ip="10.0.0.1", host_port="7001")
    (process,) = (
        action
        for action in made.actions
        if isinstance(action, ExecuteProcess) and not isinstance(action, Node)
    )
    words = [made.text(part) for part in process.cmd[1:]]
    assert words == ["--lidar-port", "6101", "--host-port", "7001"]
    values = made.parameters("l2lidar_node")
    assert {key: values[key] for key in NETWORK} == {
        "l2_ip": "127.0.0.1", "l2_port": 6101, "host_ip": "127.0.0.1", "host_port": 7001
    }  # fmt: skip


@needs_launch
def test_emulator_options_are_split_as_a_shell_does(launched):
    made = launched("l2lidar", emulator="true", emulator_options="--scene 'my world.ply' --ready")
    (process,) = (action for action in made.actions if action not in made.nodes.values())
    assert [made.text(part) for part in process.cmd[-3:]] == ["--scene", "my world.ply", "--ready"]


@needs_launch
def test_network_arguments_go_over_the_parameter_file(launched, tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("l2lidar_node: {ros__parameters: {l2_ip: 10.1.1.1, host_ip: 10.1.1.2}}")
    made = launched("l2_top_mount_example", params_file=str(file), l2_ip="10.42.0.62")
    values = made.parameters("l2lidar_node")
    assert values == {"l2_ip": "10.42.0.62", "host_ip": "10.1.1.2"}


@needs_launch
def test_wrong_port_and_missing_file_are_refused(launched):
    with pytest.raises(ValueError, match="l2_port:=abc"):
        launched("l2lidar", l2_port="abc")
    with pytest.raises(ValueError, match=r"absent\.yaml"):
        launched("l2lidar", params_file="absent.yaml")
    with pytest.raises(ValueError, match=r"file:=absent\.pcap: there is no such file"):
        launched("replay", file="absent.pcap")
    with pytest.raises(ValueError, match="rate:=fast is not a number"):
        launched("replay", rate="fast")
    with pytest.raises(ValueError, match="rviz_config:=absent: there is no such file"):
        launched("l2lidar_with_rviz", rviz_config="absent")
    with pytest.raises(ValueError, match="l2_port and host_port are both 6101"):
        launched("l2lidar", emulator="true", host_port="6101")
    with pytest.raises(ValueError, match="emulator_options:='open: "):
        launched("l2lidar", emulator="true", emulator_options="'open")


@needs_launch
def test_what_the_driver_would_refuse_is_not_started_again_and_again(launched, tmp_path):
    with pytest.raises(ValueError, match="parameter 'l2_port': 99999 is out of range"):
        launched("l2lidar", l2_port="99999")
    file = tmp_path / "mine.yaml"
    file.write_text("l2lidar_node: {ros__parameters: {robot_x: 0.1, watchdog_action: nap}}")
    with pytest.raises(ValueError, match="parameter 'watchdog_action': 'nap' is not known"):
        launched("l2lidar", params_file=str(file))


@needs_launch
@pytest.mark.parametrize("name", ["deskew_odometry", "replay"])
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("deskew_node: {ros__parameters: {voxel_size: -1.0}}",
         "/a/deskew_node: parameter 'voxel_size': -1.0 is out of range"),
        ("odometry_node: {ros__parameters: {mode: magic}}",
         "/a/odometry_node: parameter 'mode': 'magic' is not known"),
        ("/**: {ros__parameters: {imu_xyz: 3}}",
         "/a/deskew_node: parameter 'imu_xyz': 3 is of type int, expected list"),
    ],
)  # fmt: skip
def test_what_a_companion_would_refuse_is_not_started(launched, tmp_path, name, text, message):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match=re.escape(message)):
        launched(name, proc_params_file=str(file), namespace="a")


@needs_launch
def test_a_node_that_is_not_to_be_started_again_ends_the_launch():
    from launch import LaunchContext
    from launch.events.process import ProcessExited

    from l2lidar_node.ros.bringup import _ended

    def ended(is_respawned, code):
        event = ProcessExited(
            action=None, name="deskew_node-2", cmd=[], cwd=None, env=None, pid=1, returncode=code
        )
        _ended(is_respawned, event, LaunchContext())

    for code in (0, 1, -9):
        ended(True, code)
    ended(False, 0)
    for is_respawned, code in ((True, 2), (False, 2), (False, 1), (False, -11)):
        with pytest.raises(RuntimeError, match=f"deskew_node-2 ended with exit code {code}"):
            ended(is_respawned, code)


@needs_launch
def test_a_virtual_l2_that_fails_fails_the_launch():
    from launch import LaunchContext
    from launch.actions import Shutdown
    from launch.events.process import ProcessExited

    from l2lidar_node.ros.bringup import _emulated

    def ended(code):
        event = ProcessExited(
            action=None, name="", cmd=[], cwd=None, env=None, pid=1, returncode=code
        )
        return _emulated(event, LaunchContext())

    assert isinstance(ended(0), Shutdown)
    assert isinstance(ended(-2), Shutdown)
    with pytest.raises(RuntimeError, match="exit code 2"):
        ended(2)


@needs_launch
def test_two_sensors_share_no_name(launched, tmp_path):
    for namespace in ("front", "rear/deep"):
        made = launched("l2lidar", namespace=namespace, l2_name=f"{namespace[:4]}_l2")
        node = made.nodes["l2lidar_node"]
        node._perform_substitutions(made.context)
        assert node.node_name == f"/{namespace}/l2lidar_node"
        assert node.expanded_remapping_rules == [
            (topic, topic.removeprefix("/")) for topic in topics.DRIVER_TOPICS
        ]
        values = made.parameters(f"{namespace.replace('/', '.')}.l2lidar_node")
        assert values["l2_name"] == f"{namespace[:4]}_l2"


@needs_launch
def test_deskew_gets_points_of_the_sensors_own_frame_with_an_imu(launched):
    made = launched("deskew_odometry")
    values = made.parameters("l2lidar_node")
    assert values["imu_adjust"] is False
    assert values["enable_IMU_publishing"] is True
    assert values["sweep_cut"] == "turn"
    assert launched("deskew_odometry", sweep_cut="half_turn").parameters("l2lidar_node")[
        "sweep_cut"
    ] == "half_turn"  # fmt: skip
    assert "odometry_node" not in launched("deskew_odometry", odometry="false").nodes


@needs_launch
@pytest.mark.parametrize(
    "consumer", sorted(path.name for path in CONSUMERS.iterdir() if path.is_dir())
)
def test_consumer_goes_over_the_parameter_file(launched, consumer):
    values = launched("lio_input", consumer=consumer).parameters("l2lidar_node")
    assert consumer_driver(consumer).items() <= values.items()


@needs_launch
def test_replay_is_told_to_the_driver_and_its_time_to_the_others(launched):
    made = launched("replay", rate="2", rviz="true")
    values = made.parameters("l2lidar_node")
    assert (values["replay_file"], values["replay_rate"]) == (NEEDED["replay"]["file"], 2.0)
    assert values["replay_loop"] is False
    assert values["imu_adjust"] is False
    assert "use_sim_time" not in values, "the driver makes that time"
    assert made.parameters("deskew_node")["use_sim_time"] is True
    assert made.parameters("odometry_node")["use_sim_time"] is True
    made = launched("replay", deskew_odometry="false", loop="true")
    assert list(made.nodes) == ["l2lidar_node"]
    assert made.parameters("l2lidar_node")["imu_adjust"] is True
    assert made.parameters("l2lidar_node")["replay_loop"] is True


@needs_launch
def test_odometry_is_not_taken_back_to_the_start_of_a_recording(launched):
    with pytest.raises(ValueError, match="deskew_odometry:=false"):
        launched("replay", loop="true")


@needs_launch
def test_only_a_driver_of_a_real_sensor_is_started_again(launched):
    def respawns(name, **given):
        made = launched(name, **given)
        node = made.nodes["l2lidar_node"]
        return perform_typed_substitution(made.context, node._ExecuteLocal__respawn, bool)

    from launch.utilities.type_utils import perform_typed_substitution

    assert respawns("l2lidar")
    assert not respawns("l2lidar", respawn="false")
    assert not respawns("replay")


@needs_launch
def test_unknown_consumer_is_refused(launched):
    with pytest.raises(RuntimeError, match="Valid options"):
        launched("lio_input", consumer="orb_slam")


@needs_launch
@pytest.mark.parametrize("name", [name for name in STARTS if "rviz" in ARGUMENTS[name]])
def test_rviz_only_where_asked_for_and_with_a_layout(launched, name):
    assert "rviz2" not in launched(name, rviz="false").nodes
    made = launched(name, rviz="true", namespace="front")
    node = made.nodes["rviz2"]
    words = [made.text(part) for part in node.cmd[1:5]]
    assert words[:1] == ["-d"]
    assert Path(words[1]).is_file()
    node._perform_substitutions(made.context)
    assert ("/points", "points") in node.expanded_remapping_rules


@needs_launch
def test_rviz_follows_the_name_of_the_sensor(launched):
    made = launched("l2lidar_with_rviz", l2_name="rear")
    words = [made.text(part) for part in made.nodes["rviz2"].cmd[1:5]]
    assert words[2:] == ["-f", "rear_link"]
