"""`l2lidar slam` and `l2lidar export`: builds a map of a recording, and exports maps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer
from rich.progress import Progress as Bar

from l2lidar_node.command_line import CommandError, UsageError
from l2lidar_node.files import write_whole
from l2lidar_node.recording.capture import CaptureError
from l2lidar_node.recording.packet_bag import is_of_packets
from l2lidar_node.ros.parameter_files import settings_for
from l2lidar_proc.odometry.config import OdometryNodeConfig
from l2lidar_proc.odometry.estimate import BaseFrame, OdometryEstimate
from l2lidar_proc.recording.bag import RecordingError
from l2lidar_proc.recording.outputs import tum
from l2lidar_proc.slam import atlas, export
from l2lidar_proc.slam.atlas import AtlasError
from l2lidar_proc.slam.config import SlamNodeConfig
from l2lidar_proc.slam.nodes import OdometrySweep
from l2lidar_proc.slam.pose_graph import GtsamMissingError
from l2lidar_proc.slam.slam import Slam
from l2lidar_proc.verbs.recorded import run_capture
from l2lidar_proc.verbs.recorded_bag import run_bag

_MAP: Final = "map"
_EXPORTS: Final = ("tum", "kitti", "g2o", "ply")
_FILES: Final = (  # of an earlier run, or of `l2lidar odometry`
    f"{_MAP}/{atlas.MANIFEST}",
    "odometry.tum",
    "map.png",
    "trajectory.tum",
    "trajectory.kitti",
    "graph.g2o",
    "map.ply",
)
_FORMATS: Final = tuple(export.FORMATS)


def slam(
    source: Annotated[
        Path,
        typer.Argument(help="rosbag2 folder, MCAP file, or capture (pcap).", exists=True),
    ],
    folder: Annotated[
        Path, typer.Argument(help="Folder for the map, trajectories, pose graph and picture.")
    ] = Path("out/slam"),
    params_file: Annotated[
        Path | None,
        typer.Option(help="Parameter file, as for odometry_node and slam_node.", exists=True),
    ] = None,
    l2_ip: Annotated[
        str, typer.Option(help="Unit whose packets to use, if there are several.")
    ] = "",
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", help="Replace the results of an earlier run in the folder."),
    ] = False,
) -> None:
    """Build a map of a recording with loops closed, as odometry_node and slam_node do live.

    The folder gets the map itself (map/, for slam_node and `l2lidar export`), the corrected
    trajectory (TUM and KITTI) and that of the odometry alone, the pose graph (g2o), the points
    (PLY) and a picture with the loops drawn.
    """
    taken = [folder / name for name in _FILES if (folder / name).exists()]
    if taken and not overwrite:
        raise UsageError(
            f"{taken[0]} exists from an earlier run; choose another folder or add --overwrite"
        )
    try:
        atlas.check_place(folder / _MAP)
        odometry_config = settings_for(params_file, "odometry_node", OdometryNodeConfig)
        config = settings_for(params_file, "slam_node", SlamNodeConfig)
        mapping = Slam(config.slam)
    except ValueError as error:
        raise UsageError(str(error)) from None
    except GtsamMissingError as error:
        raise CommandError(str(error)) from None

    def take(estimate: OdometryEstimate, base: BaseFrame) -> None:
        mapping.add(OdometrySweep.of(estimate, base))

    folder.mkdir(parents=True, exist_ok=True)  # or a long run would end with nowhere to write
    try:
        with Bar() as bar:
            task = bar.add_task("slam", total=1.0)

            def progress(share: float) -> None:
                bar.update(task, completed=share)

            if is_of_packets(source):
                run = run_capture(source, odometry_config, progress, l2_ip, take)
            else:
                run = run_bag(source, odometry_config, progress, take)
            progress(1.0)
    except RecordingError as error:
        raise CommandError(str(error)) from None
    except CaptureError as error:
        raise CommandError(f"{source}: {error}") from None
    if not len(run.poses):
        raise CommandError(
            f"{source}: no trajectory was found; check for clouds with times, and IMU samples"
        )
    mapping.finish()
    built = mapping.map()
    try:
        atlas.AtlasWriter(folder / _MAP).save(built)
    except AtlasError as error:
        raise CommandError(str(error)) from None
    files = [folder / "odometry.tum", folder / "map.png"]
    write_whole(files[0], tum(run.poses))
    export.draw(built, files[1])
    for kind in _EXPORTS:
        files += export.write(built, kind, folder)
    for line in run.report:
        print(line)
    print(f"{len(built.nodes)} submaps, {len(mapping.loops)} loops between them")
    for reason, count in mapping.counts.most_common():
        print(f"{count} candidates rejected: {reason}")
    print(*(f"wrote {path}" for path in [folder / _MAP, *files]), sep="\n")


def export_map(
    run: Annotated[
        Path,
        typer.Argument(
            help="Folder that `l2lidar slam` wrote, or a saved map.", exists=True, file_okay=False
        ),
    ],
    to: Annotated[str, typer.Option(help=f"One of: {', '.join(_FORMATS)}.")],
    folder: Annotated[
        Path | None, typer.Option(help="Folder to write to; by default beside the map.")
    ] = None,
) -> None:
    """Write a map in the format of another program.

    g2o: the pose graph. tum, kitti: the corrected trajectory. interactive_slam: hdl_graph_slam's
    dump. qn: scans and poses as FAST-LIO-SAM-QN saves them. nav2: an occupancy map. ply, pcd: the
    points.
    """
    if to not in export.FORMATS:
        raise UsageError(f"--to {to!r} is not known; expected one of {', '.join(_FORMATS)}")
    map_folder = run if (run / atlas.MANIFEST).exists() else run / _MAP
    try:
        built, warnings = atlas.load(map_folder)
        files = export.write(built, to, folder or map_folder.parent / to)
    except ValueError as error:
        raise CommandError(str(error)) from None
    for warning in warnings:
        print(f"warning: {warning}")
    shown = files if len(files) < 6 else [*files[:2], files[-1]]
    print(*(f"wrote {path}" for path in shown), sep="\n")
    if len(files) > len(shown):
        print(f"and {len(files) - len(shown)} more")
