"""The calibration file: written, read back, and refused where it cannot be right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as some

from l2lidar_node.calibration import file
from l2lidar_node.calibration.file import (
    CalibrationFile,
    CalibrationFileError,
    ImuCalibration,
    load,
)
from l2lidar_node.protocol import wire
from tests.support import build

BLOCK = np.array(
    tuple(build.UNIT_A[name] for name in wire.CALIBRATION.names or ()), wire.CALIBRATION
).tobytes()
FILE = CalibrationFile(
    BLOCK,
    {"xi_angle": 0.0033, "beta_angle": -0.0049, "range_bias": 0.015, "range_scale": 0.001},
    {"xi_angle": 3e-4},
    ImuCalibration(
        (0.01, -0.02, 0.0), 0.0015, (1e-3, 0.0, 0.0), (0.002, 0.0, 0.0), sd={"time": 1e-4}
    ),
    {"weakest": "xi and beta together", "captures": ["a.pcap"]},
)

BEYOND = "1" + 400 * "0"  # the range of a float
ENDLESS = "0x" + 5000 * "f"  # Python reads it, but does not write it in decimal digits


def test_a_file_comes_back_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "unit.yaml"
    FILE.save(path)
    found = load(path)
    assert found == CalibrationFile(
        FILE.block, FILE.correction, FILE.sd, FILE.imu, FILE.about, str(path)
    )
    assert BLOCK.hex() in path.read_text()


def test_a_block_is_corrected_to_the_bit_or_not_at_all() -> None:
    values = np.frombuffer(FILE.corrected(BLOCK), wire.CALIBRATION, 1)[0]
    assert values["xi_angle"] == np.float32(np.float32(0.002945) + 0.0033)
    assert values["theta_angle_bias"] == np.float32(2.0769)
    raw = np.array([1000.0, 20_000.0])
    own = 0.000978 * (raw - 365.625)
    used = values["range_scale"] * (raw + values["range_bias"])
    np.testing.assert_allclose(used, 1.001 * own + 0.015, atol=1e-5)
    for bit in range(0, 256, 7):
        other = bytearray(BLOCK)
        other[bit // 8] ^= 1 << bit % 8
        assert FILE.corrected(bytes(other)) == bytes(other)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("format: 1", "format: 2"), "format is 2, expected 1"),
        ((BLOCK.hex(), "beef"), "expected 64 hexadecimal digits"),
        (("xi_angle: 0.0033", "xi_angle: 0.33"), "correction.xi_angle is 0.33, expected -0.03"),
        (("xi_angle: 0.0033", "xi_angle: .nan"), "correction.xi_angle is nan, expected a number"),
        (("xi_angle: 0.0033", "zeta: 0.0033"), "correction.zeta is not known"),
        (("time_offset: 0.0015", "time_offset: 3"), "imu.time_offset is 3"),
        (("- 0.01\n", "- x\n"), "imu.rotation_rpy is 'x'"),
        (("reported:", "reported: 3\nother:"), "reported is not a mapping"),
        (("format: 1", "{"), "not YAML"),
        (("xi_angle: 0.0033", f"xi_angle: {BEYOND}"), "correction.xi_angle is 1000"),
        (("time: 0.0001", f"time: -{BEYOND}"), "imu.sd.time is -1000"),
        (("- 0.01\n", f"- {BEYOND}\n"), "imu.rotation_rpy is 1000"),
        (("format: 1", f"format: {ENDLESS}"), "an integer of more than 4300 digits"),
        (("xi_angle: 0.0033", f"xi_angle: {ENDLESS}"), "an integer of more than 4300 digits"),
        (("xi_angle: 0.0033", f"? {ENDLESS}\n  : 0.0033"), "an integer of more than 4300 digits"),
        (("format: 1", f"format: 1{':00' * 200}.0"), "not YAML"),
        (("format: 1", "format: !!int ''"), "not YAML"),
        (("format: 1", "format: !!bool maybe"), "not YAML"),
    ],
)
def test_what_is_wrong_with_a_file_is_named(
    tmp_path: Path, change: tuple[str, str], words: str
) -> None:
    path = tmp_path / "unit.yaml"
    text = FILE.text()
    assert change[0] in text
    path.write_text(text.replace(*change, 1))
    with pytest.raises(CalibrationFileError) as caught:
        load(path)
    assert words in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_file_that_is_not_there_or_endless_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(CalibrationFileError, match="No such file"):
        load(tmp_path / "none.yaml")
    long = tmp_path / "long.yaml"
    long.write_bytes(b"#" * (file._LARGEST_FILE + 1))
    with pytest.raises(CalibrationFileError, match="too large"):
        load(long)


@given(some.binary(max_size=200) | some.text(max_size=200).map(str.encode))
def test_no_content_does_more_than_be_refused(content: bytes) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "unit.yaml"
        path.write_bytes(content)
        with pytest.raises(CalibrationFileError):
            load(path)
