"""Runs kiss-slam over the scans of a walk; a program of its own, in kiss-slam's own Python.

``python slam_referee.py SCANS ODOMETRY STYLE OUT``: SCANS is a file of
``tests.support.mapping_runs``, ODOMETRY one with the array ``poses`` (N, 4, 4), or "own" for
kiss-slam's, STYLE one of :data:`STYLES`. OUT gets the arrays ``poses`` (N, 4, 4), ``loops``
(L, 2): the scans at which the two local maps of a loop begin, ``constraints`` (L, 4, 4):
first to second, and ``seconds`` of processor time. Nothing of this project is imported here.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

STYLES = ("as it comes", "for rooms")


def settings(style: str) -> Any:
    """Return kiss-slam's settings: its own, or finer ones for walls that are 30 m away at most."""
    from kiss_slam.config import load_config

    config = load_config(None)
    config.odometry.preprocessing.deskew = False  # equal times end it
    if style == "for rooms":
        config.odometry.preprocessing.max_range = 30.0
        config.odometry.mapping.voxel_size = 0.3
        config.local_mapper.voxel_size = 0.1
        config.local_mapper.splitting_distance = 10.0
        config.loop_closer.detector.density_map_resolution = 0.2
    return config


def give(slam: Any, poses: Any) -> None:
    """Have it follow poses (N, 4, 4), one for each scan, instead of its own odometry."""
    odometry, steps = slam.odometry, np.linalg.inv(poses[:-1]) @ poses[1:]
    coming = iter([np.eye(4), *steps])

    def register_frame(frame: Any, timestamps: Any) -> Any:
        del timestamps
        odometry.last_pose = odometry.last_pose @ next(coming)
        near = frame[np.linalg.norm(frame, axis=1) < slam.config.odometry.preprocessing.max_range]
        odometry.local_map.update(near, odometry.last_pose)
        return near, near

    odometry.register_frame = register_frame


def main(scans: str, odometry: str, style: str, out: str) -> None:
    """Run over a file of scans and write what was found."""
    from kiss_slam.slam import KissSLAM

    with np.load(scans) as stored:
        clouds = np.split(stored["points"].astype(np.float64), stored["ends"][:-1])
    slam = KissSLAM(settings(style))
    if odometry != "own":
        with np.load(odometry) as stored:
            give(slam, stored["poses"])
    begins: dict[int, int] = {0: 0}
    loops: list[tuple[int, int]] = []
    constraints: list[Any] = []
    compute = slam.closer.compute

    def kept(*arguments: Any) -> Any:
        found = compute(*arguments)
        if found[0]:
            loops.append((begins[found[1]], begins[found[2]]))
            constraints.append(found[3])
        return found

    slam.closer.compute = kept
    began = time.process_time()
    for number, cloud in enumerate(clouds):
        slam.process_scan(cloud, np.zeros(len(cloud)))
        begins.setdefault(slam.local_map_graph.last_id, number)
    slam.generate_new_node()
    slam.local_map_graph.erase_last_local_map()
    poses, _ = slam.fine_grained_optimization()
    seconds = time.process_time() - began
    np.savez(
        Path(out),
        poses=np.array(poses),
        loops=np.array(loops, np.int64).reshape(-1, 2),
        constraints=np.array(constraints).reshape(-1, 4, 4),
        seconds=seconds,
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
