"""`l2lidar odometry`: the sensor's way through a bag or a capture, with a map and a plot."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
import typer
from rich.progress import Progress

from l2lidar_node.cli.console import out, say
from l2lidar_node.cli.device import DeviceError
from l2lidar_node.cli.set import UsageError
from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.driver import Driver, Event
from l2lidar_node.recording.pcap import CaptureError, is_capture
from l2lidar_node.recording.recording import Recording
from l2lidar_node.recording.replay import feed
from l2lidar_node.settings import build
from l2lidar_node.types import IMU_SAMPLE, ImuSample, Sweep

if TYPE_CHECKING:
    from l2lidar_proc.verbs.odometry import OdometryRun

_CAPTURE: Final = {"imu_adjust": False, "sweep_cut": "turn"}
_CAPTURES: Final = (".pcap", ".pcapng", ".cap")
_STEP: Final = 1000  # entries between two looks at the progress


def odometry(
    source: Annotated[
        Path,
        typer.Argument(help="rosbag2 folder, MCAP file, or capture (pcap).", exists=True),
    ],
    folder: Annotated[
        Path, typer.Argument(help="Folder for trajectory (TUM and KITTI), map and plot.")
    ] = Path("out/odometry"),
    params_file: Annotated[
        Path | None, typer.Option(help="Parameter file, as for odometry_node.", exists=True)
    ] = None,
    l2_ip: Annotated[
        str, typer.Option(help="Whose packets, if a capture holds those of several units.")
    ] = "",
) -> None:
    """Estimate the way of the sensor through a recording, as odometry_node does live.

    The trajectory in TUM format is what evo reads. Of a capture, sweeps of a full turn are used.
    """
    from l2lidar_node.ros.parameter_files import settings_for
    from l2lidar_proc.config import OdometryNodeConfig
    from l2lidar_proc.recording.bag import RecordingError
    from l2lidar_proc.verbs import odometry

    try:
        config = settings_for(params_file, "odometry_node", OdometryNodeConfig)
    except ValueError as error:
        raise UsageError(str(error)) from None
    try:
        folder.mkdir(parents=True, exist_ok=True)  # or a long run would end with nowhere to write
        with Progress(console=out) as bar:
            task = bar.add_task("odometry", total=1.0)

            def progress(share: float) -> None:
                bar.update(task, completed=share)

            if _is_capture(source):
                with source.open("rb") as stream:
                    recording = Recording(stream, l2_ip)
                    taken = _events(recording, source.stat().st_size, progress)
                    run = odometry.run_events(taken, config)
            else:
                run = odometry.run_bag(source, config, progress)
            progress(1.0)
        files = odometry.write(run, folder)
    except RecordingError as error:
        raise DeviceError(str(error)) from None
    except CaptureError as error:
        raise DeviceError(f"{source}: {error}") from None
    except OSError as error:
        raise DeviceError(f"{error.filename or source}: {error.strerror}") from None
    _say(run, files)


def _is_capture(path: Path) -> bool:
    """Tell whether a file is a capture, or is called one: then what it lacks is said."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return is_capture(stream.read(4)) or path.suffix in _CAPTURES


def _events(recording: Recording, size: int, progress: Any) -> Iterator[tuple[int, Any]]:
    """Yield what the driver hands out, each with the time at which it could."""
    driver = Driver(build(DriverConfig, _CAPTURE))
    now = int(recording.start)
    for number, entry in enumerate(recording):
        now = int(entry.time)
        yield from _taken(now, feed(driver, entry))
        if number % _STEP == 0:
            progress(recording.position / size)
    yield from _taken(now, driver.flush())


def _taken(now: int, events: list[Event]) -> Iterator[tuple[int, Any]]:
    for event in events:
        if isinstance(event, Sweep):
            yield now, event
        elif isinstance(event, ImuSample):
            yield now, np.array([tuple(event)], IMU_SAMPLE)


def _say(run: OdometryRun, files: list[Path]) -> None:
    for line in [*run.report, *(f"wrote {path}" for path in files)]:
        say(line)
    if not len(run.poses):
        raise DeviceError("no way was found: are there clouds with times, and IMU samples?")
