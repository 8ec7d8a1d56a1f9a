"""Names what is fed with hostile input, with good inputs to begin from and what has to hold."""

from __future__ import annotations

import atexit
import io
import math
import os
import struct
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks import fuzz_inputs as clouds
from benchmarks.fuzz_inputs import sealed
from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.framing import Frame, Framer
from l2lidar_node.protocol.packets import decode
from l2lidar_node.recording.capture import (
    CaptureError,
    CaptureReader,
    CaptureWriter,
    Endpoint,
    UdpDatagram,
)
from l2lidar_node.recording.recording import Recording
from l2lidar_node.ros.parameter_files import parameters_for
from l2lidar_node.settings import build
from l2lidar_node.types import HostNs, ImuSample, Sweep

Check = Callable[[bytes], None]
"""Takes one input; raises whatever the code under test must not."""

_EPOCH_NS: Final = 1_700_000_000 * 10**9
_STEP_NS: Final = 3_000_000


@dataclass(frozen=True, slots=True)
class FuzzTarget:
    """A reader of input from outside.

    Attributes
    ----------
    name : str
    make : callable
        Returns a new :data:`Check`; what it keeps from input to input is meant to be kept.
    seeds : callable
        Returns good inputs.
    tokens : tuple of bytes
        Pieces that mean something in the format.
    per_million : int
        Inputs of a campaign for every million of the wire parser's, after what they cost.
    """

    name: str
    make: Callable[[], Check]
    seeds: Callable[[], list[bytes]]
    tokens: tuple[bytes, ...]
    per_million: int


def _frames() -> list[bytes]:
    """Return a good frame of every type, the short ones more than once: most packets are IMU."""
    rng = np.random.default_rng(1)
    frames = []
    for kind, layout in wire.PAYLOADS.items():
        block = np.zeros(1, layout)
        if kind in (wire.PacketType.POINTS_3D, wire.PacketType.POINTS_2D):
            _fill(block, rng)
        if kind == wire.PacketType.IMU:
            block["quaternion_wxyz"] = (1.0, 0.0, 0.0, 0.0)
        frames.append(wire.encode_frame(int(kind), block.tobytes()))
    short = [frame for frame in frames if len(frame) < 200]
    return frames + 4 * short


def _fill(block: np.ndarray[tuple[int, ...], np.dtype[np.void]], rng: np.random.Generator) -> None:
    block["point_num"] = block["ranges"].shape[1]
    block["ranges"] = rng.integers(0, 9000, block["ranges"].shape)
    block["time_increment"] = 7.7e-6 if block["ranges"].shape[1] == 300 else 5.4e-6
    block["calibration"]["range_scale"] = 0.001
    block["scan_period"] = 0.004639
    block["range_max"] = 50.0


def _wire() -> Check:
    framer = Framer()
    count = 0

    def check(data: bytes) -> None:
        nonlocal count
        count += 1
        if count & 1:
            data = sealed(data)
        before = framer.pending
        octets = 0
        for item in framer.feed(data):
            if isinstance(item, Frame):
                decode(item)
                octets += len(item.payload) + wire.OVERHEAD
            else:
                octets += item.skipped
        assert framer.pending < wire.MAX_FRAME, "held back more than a frame"
        assert before + len(data) == octets + framer.pending, "bytes are not accounted for"

    return check


def _driver() -> Check:
    driver = Driver(build(DriverConfig, {"publish_unlocked": True, "sweep_cut": "turn"}))
    now = _EPOCH_NS

    count = 0

    def check(data: bytes) -> None:
        nonlocal now, count
        now += _STEP_NS
        count += 1
        if count & 3:
            data = _in_sequence(data, count, (now - _EPOCH_NS) // 2)
        events = driver.receive(sealed(data), HostNs(now)) + driver.tick(HostNs(now))
        driver.outbox()
        for event in events:
            _is_sound(event)

    return check


def _in_sequence(data: bytes, number: int, stamp: int) -> bytes:
    """Return a frame with the number and stamp that are due, so that the driver goes on."""
    at = wire.HEADER.size
    if len(data) < at + 16:
        return data
    info = struct.pack("<I", number % 1025) + data[at + 4 : at + 8]
    return data[:at] + info + struct.pack("<II", *divmod(stamp, 10**9)) + data[at + 16 :]


def _is_sound(event: Event) -> None:
    if isinstance(event, Sweep):
        for name in event.points.dtype.names or ():
            assert np.isfinite(event.points[name]).all(), f"{name} is not finite"
        assert (np.diff(event.points["time"]) >= 0).all(), "times of points fall"
    elif isinstance(event, ImuSample):
        values = event.orientation_wxyz + event.angular_velocity + event.linear_acceleration
        assert all(map(math.isfinite, values)), "a sample is not finite"


def _captures() -> list[bytes]:
    ends = Endpoint("192.168.1.62", 6101), Endpoint("192.168.1.2", 6201)
    stream = io.BytesIO()
    writer = CaptureWriter(stream)
    for number, frame in enumerate(_frames()[:8]):
        writer.write(UdpDatagram(HostNs(_EPOCH_NS + number), *ends, frame[:1400]))
    classic = stream.getvalue()
    packet = classic[40:400] + b"\0" * (-360 % 4)
    blocks = [
        (0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)),
        (1, struct.pack("<HHI2H4s2Hq2H", 1, 0, 0, 9, 1, b"\x09\0\0\0", 14, 8, 5, 0, 0)),
        (6, struct.pack("<5I", 0, 0, 1, len(packet), len(packet)) + packet),
        (3, struct.pack("<I", len(packet)) + packet),
    ]
    new = b"".join(
        struct.pack("<2I", kind, len(body) + 12) + body + struct.pack("<I", len(body) + 12)
        for kind, body in blocks
    )
    return [classic[:600], classic, new]


def _pcap() -> Check:
    def check(data: bytes) -> None:
        try:
            for _ in CaptureReader(io.BytesIO(data)):
                pass
            for _ in Recording(io.BytesIO(data)):
                pass
        except CaptureError:
            pass

    return check


_YAML: Final = (
    b"l2lidar_node:\n  ros__parameters:\n    l2_ip: '127.0.0.1'\n    host_port: 6201\n"
    b"    yaw_covar: 10\n    a: {b: [1, 2.5e-7, true]}\n",
    b"/**:\n  ros__parameters: {sweep_cut: turn}\n/front/*:\n  x: &a {ros__parameters: {y: 1}}\n",
)


def _parameters() -> Check:
    from l2lidar_node.ros.program import ros_arguments

    path = scratch("yaml")

    def read(data: bytes) -> None:
        path.write_bytes(data)
        ros_arguments(["node", "--params-file", str(path)])

    def read_section(data: bytes) -> None:
        path.write_bytes(data)
        parameters_for(path, "l2lidar_node", "/n")

    def check(data: bytes) -> None:
        _refuses_by_name(path, read, data)
        _refuses_by_name(path, read_section, data)

    return check


def _refuses_by_name(path: Path, read: Check, data: bytes) -> None:
    """Read a file's content; what is refused has to be refused with the file's name."""
    try:
        read(data)
    except ValueError as error:
        if str(path) not in str(error):
            raise AssertionError(f"the message does not name the file: {error}") from error


_TUM: Final = (
    b"# stamp x y z qx qy qz qw\n1.5 0 0 0 0 0 0 1\n1700000000.123456789 1e-3 2 3 0 0 0.6 0.8\n",
    b"0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n2 1 1 0 0.5 0.5 0.5 0.5\n3 0 1 0 0 0 1 0\n",
)


def _trajectory() -> Check:
    from l2lidar_node.emulator.motion.motion import from_tum

    path = scratch("tum")

    def read(data: bytes) -> None:
        path.write_bytes(data)
        from_tum(path).poses(np.array([0.0, 0.5]))

    return lambda data: _refuses_by_name(path, read, data)


_PLY: Final = (
    b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    b"0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 3\n"
)
_OFF: Final = b"OFF\n4 2 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 3\n"
_OBJ: Final = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n"
_STL: Final = bytes(80) + struct.pack("<I12fH", 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)


def _meshes() -> list[bytes]:
    return [bytes([kind]) + data for kind, data in enumerate((_PLY, _OFF, _OBJ, _STL))]


def _mesh() -> Check:
    import open3d  # noqa: F401  # once, not in every child

    from l2lidar_node.emulator.world.world import World

    paths = [scratch(kind) for kind in ("ply", "off", "obj", "stl")]

    def check(data: bytes) -> None:
        path = paths[data[0] % 4] if data else paths[0]

        def read(content: bytes) -> None:
            path.write_bytes(content)
            World.load(path)

        _contained(lambda: _refuses_by_name(path, read, data[1:]))

    return check


def _contained(work: Callable[[], None]) -> None:
    """Work in a child process, as the emulator does: there open3d's readers may crash."""
    child = os.fork()
    if child == 0:
        try:
            work()
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert not os.WIFEXITED(status) or os.WEXITSTATUS(status) == 0, "not refused by name"


def scratch(suffix: str) -> Path:
    """Return a file of this process; a process that dies leaves its last input in it."""
    memory = Path("/dev/shm")
    folder = memory if os.access(memory, os.W_OK) else Path(tempfile.gettempdir())
    path = folder / f"l2lidar_fuzz_{os.getpid()}.{suffix}"
    atexit.register(path.unlink, missing_ok=True)
    return path


_WORDS: Final = (wire.MAGIC, wire.TAIL_END, wire.HEADER.pack(wire.MAGIC, 102, 1044))
TARGETS: Final = {
    target.name: target
    for target in (
        FuzzTarget("wire", _wire, _frames, _WORDS, 1_000_000),
        FuzzTarget("driver", _driver, _frames, _WORDS, 50_000),
        FuzzTarget("pcap", _pcap, _captures, (b"\x0a\x0d\x0d\x0a", b"\x08\x00\x45\x00"), 20_000),
        FuzzTarget("cloud", clouds.fields, clouds.plain, (), 50_000),
        FuzzTarget("message", clouds.message, clouds.timed, (b"t", b"\x07", b"\x08"), 20_000),
        FuzzTarget(
            "yaml", _parameters, lambda: list(_YAML),
            (b"ros__parameters:", b"*a", b"&a ", b"[[[[", b"{", b"!!int ", b"<<: ", b"2001-99-99",
             b"0x", b"\xff", b"'", b"- ", b"? "), 1_000,
        ),
        FuzzTarget(
            "tum", _trajectory, lambda: list(_TUM), (b"1e400", b"nan", b"-", b"\xff"), 1_000
        ),
        FuzzTarget("mesh", _mesh, _meshes, (b"nan", b"99999999999", b"-1", b"vertex 0"), 100),
    )
}  # fmt: skip
"""Everything that is fuzzed, by name."""
