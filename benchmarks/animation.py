"""Draws README's animation: the map of a walk, from clouds as measured and from deskewed ones.

``make animation`` writes ``docs/demo.gif``. A virtual L2 is carried through a room; the recording
goes through ``l2lidar odometry`` and ``l2lidar deskew``. Both halves place every cloud at the same
pose, that of the odometry: what differs is the motion within a sweep alone.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from l2lidar_node.config import DriverConfig
from l2lidar_node.recording import bag
from l2lidar_node.settings import build
from l2lidar_node.types import F64, ImuSample, Sweep
from l2lidar_proc.deskew.config import DeskewNodeConfig
from l2lidar_proc.odometry.config import OdometryNodeConfig
from l2lidar_proc.recording.bag import points_of, stamp_of
from l2lidar_proc.verbs.deskew import deskew_recording
from l2lidar_proc.verbs.recorded_bag import run_bag
from tests.support.odometry_runs import Run, record, sweeps

PAGE: Final = Path("docs/demo.gif")
_SCENE, _MOTION, _SEED, _SECONDS = "room", "trot", 3, 15.0
_PIXELS: Final = 360  # edge of one half
_HEADING: Final = 26
_FRAME_MS: Final = 230  # a turn of the head, so that it plays as fast as it happened
_HOLD_MS: Final = 2500
_LAYER_M: Final = (-0.7, 0.9)  # height about the sensor; leaves floor and ceiling out
_COLORS: Final = 24


def main() -> int:
    """Record, process, draw; return the exit code."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "walk.mcap"), Path(folder, "deskewed.mcap")
        _write(record(_SCENE, _MOTION, _SEED, _SECONDS), source)
        poses = run_bag(source, OdometryNodeConfig()).poses
        deskew_recording(source, target, build(DeskewNodeConfig, {"reference": "middle"}))
        clouds = _clouds(target, "/points_deskewed")
        raw = list(_clouds(target, "/points").values())
    frames: list[tuple[F64, F64]] = []
    stamps = np.asarray(poses["stamp"])
    for stamp, deskewed in clouds.items():
        nearest = int(np.argmin(np.abs(stamps - stamp)))
        if abs(int(stamps[nearest]) - stamp) < 20_000_000:
            pose = np.asarray(poses["pose"][nearest])
            measured = raw[list(clouds).index(stamp)]
            frames.append((_layer(measured, pose), _layer(deskewed, pose)))
    images = _draw(frames)
    durations = [_FRAME_MS] * (len(images) - 1) + [_HOLD_MS]
    palette = images[-1].quantize(_COLORS, dither=Image.Dither.NONE)
    plain = [item.quantize(palette=palette, dither=Image.Dither.NONE) for item in images]
    plain[0].save(
        PAGE, save_all=True, append_images=plain[1:], duration=durations, loop=0, optimize=True
    )
    print(f"{PAGE}: {len(images)} frames, {PAGE.stat().st_size / 1e3:.0f} kB")
    return 0


def _write(run: Run, path: Path) -> None:
    """Write a recording as the driver's bag of it."""
    samples = [ImuSample(*row) for row in run.imu.tolist()]
    events: list[tuple[int, Sweep | ImuSample]] = [(item.stamp, item) for item in samples]
    events += [(item.end, item) for item in sweeps(run, "turn")]
    with bag.BagWriter(path, build(DriverConfig, {"imu_adjust": False})) as writer:
        for _, event in sorted(events, key=lambda item: item[0]):
            writer.add(event)


def _clouds(path: Path, topic: str) -> dict[int, F64]:
    """Return the clouds of a topic by stamp, each of shape (N, 3)."""
    found = {}
    with bag.open_bag(path) as reader:
        for connection, _, data in bag.messages(reader):
            if connection.topic == topic:
                message = reader.deserialize(data, connection.msgtype)
                points = points_of(message)
                found[int(stamp_of(message))] = np.stack([points[axis] for axis in "xyz"], axis=1)
    return found


def _layer(points: F64, pose: F64) -> F64:
    """Return the points of a cloud at the height of walls and furniture, seen from above."""
    placed = points @ pose[:3, :3].T + pose[:3, 3]
    height = placed[:, 2] - pose[2, 3]
    layer: F64 = placed[(height > _LAYER_M[0]) & (height < _LAYER_M[1]), :2]
    return layer


def _draw(frames: list[tuple[F64, F64]]) -> list[Image.Image]:
    """Return one picture per sweep: everything so far, and the sweep in another color."""
    everything = np.concatenate([deskewed for _, deskewed in frames])
    low, high = np.percentile(everything, [0.5, 99.5], axis=0)
    center, edge = (low + high) / 2, 1.08 * float((high - low).max())
    counts = [np.zeros((_PIXELS, _PIXELS)) for _ in range(2)]
    titles = ("as measured", "deskewed")
    images = []
    for pair in frames:
        image = Image.new("RGB", (2 * _PIXELS, _PIXELS + _HEADING), (16, 18, 24))
        for half, (points, count) in enumerate(zip(pair, counts, strict=True)):
            cells = ((points - center) / edge * _PIXELS + _PIXELS / 2).astype(int)
            cells = cells[((cells >= 0) & (cells < _PIXELS)).all(axis=1)]
            rows, columns = _PIXELS - 1 - cells[:, 1], cells[:, 0]
            np.add.at(count, (rows, columns), 1.0)
            share = np.clip(np.log1p(count) / np.log(30.0), 0.0, 1.0)[:, :, None]
            ink = (16, 18, 24) + share * (np.array([150, 200, 255]) - (16, 18, 24))
            ink[rows, columns] = (255, 170, 60)
            part = Image.fromarray(ink.astype(np.uint8))
            image.paste(part, (half * _PIXELS, _HEADING))
            ImageDraw.Draw(image).text(
                (half * _PIXELS + 10, 6), titles[half], (220, 225, 235), ImageFont.load_default(14)
            )
        images.append(image)
    return images


if __name__ == "__main__":
    sys.exit(main())
