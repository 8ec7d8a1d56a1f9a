"""`l2lidar odometry`: estimates the trajectory of a recording with the node's code."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer
from rich.progress import Progress as Bar

from l2lidar_node.command_line import CommandError, UsageError
from l2lidar_node.files import whole, write_whole
from l2lidar_node.recording.capture import CaptureError
from l2lidar_node.recording.packet_bag import is_of_packets
from l2lidar_node.ros.parameter_files import settings_for
from l2lidar_proc.odometry.config import OdometryNodeConfig
from l2lidar_proc.recording import outputs
from l2lidar_proc.recording.bag import RecordingError
from l2lidar_proc.recording.outputs import kitti, tum
from l2lidar_proc.verbs.recorded import OdometryRun, run_capture
from l2lidar_proc.verbs.recorded_bag import run_bag

_FILES: Final = ("trajectory.tum", "trajectory.kitti", "map.ply", "trajectory.png")


def write(run: OdometryRun, folder: Path) -> list[Path]:
    """Write trajectory, map and plot of a run into a folder; return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in _FILES]
    write_whole(paths[0], tum(run.poses))
    write_whole(paths[1], kitti(run.poses))
    if len(run.map_points):
        outputs.save(paths[2], run.map_points)
    _plot(run, paths[3])
    return [path for path in paths if path.exists()]


def _plot(run: OdometryRun, path: Path) -> None:
    """Draw the way from above over the map."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 8), layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    if len(run.map_points):
        shown = run.map_points[:: max(len(run.map_points) // 20_000, 1)]
        axes.scatter(shown[:, 0], shown[:, 1], s=0.5, c="0.7", linewidths=0)
    axes.plot(run.poses["pose"][:, 0, 3], run.poses["pose"][:, 1, 3], lw=1.5)
    FigureCanvasAgg(figure)
    with whole(path) as part:
        figure.savefig(part)


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
        str, typer.Option(help="Unit whose packets to use, if there are several.")
    ] = "",
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", help="Replace the results of an earlier run in the folder."),
    ] = False,
) -> None:
    """Estimate the trajectory of the sensor through a recording, as odometry_node does live.

    The trajectory in TUM format is what evo reads. The poses are those of the cloud frame, or of
    the base frame where one is set. A capture is cut into sweeps of a full turn.
    """
    taken = [folder / name for name in _FILES if (folder / name).exists()]
    if taken and not overwrite:
        raise UsageError(
            f"{taken[0]} exists from an earlier run; choose another folder or add --overwrite"
        )
    try:
        config = settings_for(params_file, "odometry_node", OdometryNodeConfig)
    except ValueError as error:
        raise UsageError(str(error)) from None
    try:
        folder.mkdir(parents=True, exist_ok=True)  # or a long run would end with nowhere to write
        with Bar() as bar:
            task = bar.add_task("odometry", total=1.0)

            def progress(share: float) -> None:
                bar.update(task, completed=share)

            if is_of_packets(source):
                run = run_capture(source, config, progress, l2_ip)
            else:
                run = run_bag(source, config, progress)
            progress(1.0)
        files = write(run, folder)
    except RecordingError as error:
        raise CommandError(str(error)) from None
    except CaptureError as error:
        raise CommandError(f"{source}: {error}") from None
    except OSError as error:
        raise CommandError(f"{error.filename or source}: {error.strerror}") from None
    for line in [*run.report, *(f"wrote {path}" for path in files)]:
        typer.echo(line)
    if not len(run.poses):
        raise CommandError("no pose was found; check for clouds with times, and IMU samples")
