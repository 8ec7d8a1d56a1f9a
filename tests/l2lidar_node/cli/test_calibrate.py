"""`l2lidar calibrate`, from captures and from virtual units."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from l2lidar_node.calibration.file import CalibrationFile, load
from l2lidar_node.emulator.physics import PhysicsConfig, assemble
from l2lidar_node.emulator.unit.stream import PatternScanner
from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import PacketType, WorkMode
from l2lidar_node.recording.capture import Endpoint
from l2lidar_node.recording.recording import Received, Recording, RecordingWriter
from l2lidar_node.types import HostNs
from tests.l2lidar_node.cli.conftest import Run, Unit
from tests.support.terminal import Terminal

START_NS = 1_700_000_000_000_000_000


def capture(path: Path, rpy: tuple[float, ...], seconds: float = 2.2, seed: int = 0) -> Path:
    """Write what a typical unit sends at a still place; one beam in six returns something."""
    physics = assemble(PhysicsConfig(motion="still", mount_rpy_deg=rpy, unit="typical", seed=seed))
    packets, starts = physics.scanner.packets(430, round(seconds / 0.004639))
    for gone in range(1, 6):  # the estimate takes as long as there are points
        packets["ranges"][:, gone::6] = 0
    samples, times = physics.inertial.samples(500, round(seconds * 250))
    items = [(t, PacketType.POINTS_3D, packets[i]) for i, t in enumerate(starts.tolist())]
    items += [(t, PacketType.IMU, samples[i]) for i, t in enumerate(times.tolist())]
    with path.open("wb") as stream:
        writer = RecordingWriter(
            stream, Endpoint("127.0.0.1", wire.LIDAR_PORT), Endpoint("127.0.0.1", wire.HOST_PORT)
        )
        for t, kind, record in sorted(items, key=lambda item: item[0]):
            stamp = round(t / 1.99866 * 1e9)
            record["info"]["sec"], record["info"]["nsec"] = divmod(stamp, 10**9)
            frame = wire.encode_frame(kind, record.tobytes())
            writer.received(frame, HostNs(START_NS + round(t * 1e9) + 3_000_000))
    return path


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("captures")
    poses = {"flat": (0.0, 0.0, 0.0), "tilted": (0.0, 30.0, 40.0), "side": (90.0, 0.0, 100.0)}
    return [
        capture(folder / f"{name}.pcap", rpy, seed=seed)
        for seed, (name, rpy) in enumerate(poses.items())
    ]


def test_captures_of_a_unit_become_its_calibration_file(
    run: Run, captures: list[Path], tmp_path: Path
) -> None:
    output, picture = tmp_path / "unit.yaml", tmp_path / "unit.png"
    paths = [str(path) for path in captures]
    done = run(
        "calibrate", "still", *paths, "-o", str(output), "--picture", str(picture), "--json"
    )
    assert done.code == 0
    told = json.loads(done.out)
    assert told["refusals"] == []
    assert told["estimates"]["alpha"]["verdict"] == "shown, not stored"
    made = load(output)
    assert np.rad2deg(made.correction["xi_angle"]) == pytest.approx(0.19, abs=0.03)
    assert np.rad2deg(made.correction["beta_angle"]) == pytest.approx(-0.28, abs=0.04)
    assert "alpha_angle_bias" not in made.correction
    assert [place["name"] for place in made.about["places"]] == ["flat", "tilted", "side"]
    assert picture.stat().st_size > 50_000


def test_too_short_a_capture_is_refused_with_what_to_do(run: Run, tmp_path: Path) -> None:
    shorter = capture(tmp_path / "shorter.pcap", (0.0, 0.0, 0.0), 0.02)
    done = run("calibrate", "still", str(shorter))
    assert "0.1 turns of the head, at least 8 are needed; record 10 s" in done.err
    short = capture(tmp_path / "short.pcap", (0.0, 0.0, 0.0), 0.3)
    output = tmp_path / "unit.yaml"
    done = run("calibrate", "still", str(short), "-o", str(output))
    assert done.code == 1
    assert "record 10 s at each placement" in done.out
    assert "nothing written" in done.err
    assert not output.exists()


def test_a_capture_without_an_l2_is_named(run: Run, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.pcap"
    wrong.write_bytes(b"nothing of the kind")
    done = run("calibrate", "still", str(wrong))
    assert done.code == 1
    assert str(wrong) in done.err


def test_a_file_of_another_unit_is_not_overwritten(
    run: Run, captures: list[Path], tmp_path: Path
) -> None:
    output = tmp_path / "unit.yaml"
    output.write_text("format: 7\n")
    done = run("calibrate", "scale", "--length", "1", str(captures[0]))
    assert done.code == 2
    assert "expected two" in done.err
    done = run("calibrate", "still", str(captures[1]), "-o", str(output))
    assert done.code == 1
    assert "format is 7" in done.err
    assert output.read_text() == "format: 7\n"
    other = CalibrationFile(bytes(32), {"xi_angle": 0.001})
    other.save(tmp_path / "other.yaml")
    done = run("calibrate", "still", str(captures[1]), "-o", str(tmp_path / "other.yaml"))
    assert done.code == 1
    assert "belongs to another unit" in done.err
    assert "estimating" not in done.out  # nobody waits for what is not written


def test_a_virtual_unit_must_be_known(run: Run) -> None:
    done = run("calibrate", "still", "--emulator", "good")
    assert done.code == 2
    assert "expected perfect, typical, poor" in done.err
    assert not done.out


def test_what_cannot_be_written_is_said_before_anybody_measures(run: Run, tmp_path: Path) -> None:
    (tmp_path / "folder.yaml").mkdir()
    (tmp_path / "file").touch()
    for option, name, code, words in (
        ("-o", "unit.txt", 2, "ends in '.txt'; expected FILE.yaml"),
        ("-o", "folder.yaml", 2, "is a folder; expected FILE.yaml"),
        ("--picture", "unit", 2, "ends in ''; expected FILE.png"),
        ("-o", "file/unit.yaml", 1, "file: File exists"),
    ):
        for verb in (["still"], ["imu"], ["scale", "--length", "3"]):
            if option == "--picture" and verb[0] == "scale":
                continue
            done = run("calibrate", *verb, option, str(tmp_path / name))
            assert (done.code, done.out) == (code, "")
            assert words in done.err


def test_the_scale_of_a_virtual_unit_is_written(run: Run, tmp_path: Path) -> None:
    output = tmp_path / "unit.yaml"
    done = run(
        "calibrate", "scale", "--length", "3", "--emulator", "typical", "--seconds", "2",
        "-o", str(output),
    )  # fmt: skip
    assert done.code == 0
    assert "of 3.0000 m" in done.out
    assert output.exists() == ("give it to the driver" in done.out)


def test_live_places_are_recorded_and_kept(
    run: Run, make_unit: Callable[..., Unit], tmp_path: Path
) -> None:
    """The unit sees nothing: its place is measured, kept, and refused."""
    unit = make_unit(scanner=PatternScanner(empty=True))
    done = run(
        "calibrate", "still", "--places", "1", "--seconds", "1", "--keep", str(tmp_path),
        "--yes", *unit.options,
    )  # fmt: skip
    assert done.code == 1
    assert "turns of the head, at least 8 are needed" in done.err
    size = wire.FRAME_SIZES[PacketType.POINTS_3D]
    with (tmp_path / "place_1.pcap").open("rb") as stream:
        received = [entry for entry in Recording(stream) if isinstance(entry, Received)]
    packets = sum(len(entry.data) == size for entry in received)
    assert packets * wire.MIRROR_PERIOD_S >= 1.0  # whatever held it up meanwhile


def test_the_guide_is_led_through_at_a_terminal(
    make_unit: Callable[..., Unit], tmp_path: Path
) -> None:
    """A place that cannot be used is told at once, wrong answers are asked again."""
    unit = make_unit(scanner=PatternScanner(wide=True))
    with Terminal(
        "l2lidar_node.cli.main", "calibrate", "still", "--places", "1", "--seconds", "1",
        "--keep", str(tmp_path), *unit.options,
    ) as terminal:  # fmt: skip
        terminal.wait_for("looking for the L2")
        terminal.wait_for("Before you begin")
        terminal.wait_for("Place 1 of 1: upright")
        terminal.wait_for("Press Enter")
        terminal.type("\n")
        terminal.wait_for("wide field of view, which has its own block")
        terminal.wait_for("Repeat this placement?")
        terminal.type("perhaps\n")
        terminal.wait_for("'perhaps' is not an answer")
        terminal.wait_for("[Y/n]")
        terminal.type("\n")
        terminal.wait_for("Press Enter")
        terminal.interrupt()
        assert terminal.exit_code() == 130
    assert [path.name for path in tmp_path.iterdir()] == ["place_1.pcap"]


def test_turning_is_shown_in_bars_and_can_be_given_up(unit: Unit, tmp_path: Path) -> None:
    output = tmp_path / "unit.yaml"
    with Terminal(
        "l2lidar_node.cli.main", "calibrate", "imu", "-o", str(output), *unit.options
    ) as terminal:
        terminal.wait_for("calibrate the beams first")
        terminal.wait_for("Press Enter")
        terminal.type("\n")
        for text in ("still", "roll about x", "pitch about y", "yaw about z", "time"):
            terminal.wait_for(text)
        terminal.interrupt()
        assert terminal.exit_code() == 130
        assert "Traceback" not in terminal.said
    assert not output.exists()


def test_a_unit_whose_imu_is_off_is_told_before_anybody_turns_it(
    run: Run,
    make_unit: Callable[..., Unit],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("l2lidar_node.cli.calibrate_imu._FIRST_SAMPLE_S", 0.5)
    unit = make_unit(mode=int(WorkMode.IMU_OFF))
    output = tmp_path / "unit.yaml"
    done = run("calibrate", "imu", "-o", str(output), *unit.options, answer="y")
    assert done.code == 1
    assert "no IMU samples from the L2; switch its IMU on" in done.err
    assert not output.exists()


def test_nobody_at_the_terminal_is_said(run: Run, unit: Unit, tmp_path: Path) -> None:
    done = run("calibrate", "scale", "--length", "3", *unit.options)
    assert done.code == 1
    assert "no answer from a terminal" in done.err
    (tmp_path / "place_1.pcap").write_bytes(b"precious")
    done = run("calibrate", "still", "--keep", str(tmp_path), *unit.options)
    assert done.code == 2
    assert "place_1.pcap exists already" in done.err


def test_the_imu_verb_refuses_what_it_cannot_use(
    run: Run, captures: list[Path], tmp_path: Path
) -> None:
    done = run("calibrate", "imu", str(captures[0]), "--emulator", "typical")
    assert done.code == 2
    assert "omit the capture" in done.err
    done = run("calibrate", "imu", "--emulator", "good")
    assert done.code == 2
    assert "expected perfect, typical, poor" in done.err
    output = tmp_path / "other.yaml"
    CalibrationFile(bytes(32), {"xi_angle": 0.001}).save(output)
    done = run("calibrate", "imu", str(captures[0]), "-o", str(output))
    assert done.code == 1
    assert "belongs to another unit" in done.err
    done = run("calibrate", "imu", str(captures[0]))
    assert done.code == 1
    assert "record for 30 s" in done.err
