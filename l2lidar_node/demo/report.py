"""Report of the demo: topics, accuracy, pictures."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any, Final, NamedTuple
from xml.etree import ElementTree

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from l2lidar_node.config import FrameConfig
from l2lidar_node.demo.observer import Observer
from l2lidar_node.emulator.truth import Results
from l2lidar_node.files import shared_file, whole
from l2lidar_node.protocol.wire import PacketType
from l2lidar_node.types import F64

BASE_FRAME: Final = "base_link"
_BIN_M: Final = 0.05


def mount(example: str) -> F64:
    """Return the pose of the cloud frame in ``base_link`` on an example robot, (4, 4).

    Parameters
    ----------
    example : str
        ``top`` or ``forward``.

    Raises
    ------
    OSError
        If there is no such robot.
    """
    name = f"urdf/examples/l2_{example}_mount_example.urdf"
    path = shared_file(name)
    if path is None:
        raise FileNotFoundError(errno.ENOENT, "no such file in the package's share folder", name)
    robot = ElementTree.parse(path).getroot()
    joints = {_attribute(joint, "child", "link"): joint for joint in robot.iter("joint")}
    pose, link = np.eye(4), FrameConfig().cloud
    while link != BASE_FRAME:
        step = np.eye(4)
        rpy = [float(value) for value in _attribute(joints[link], "origin", "rpy").split()]
        step[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
        step[:3, 3] = [float(value) for value in _attribute(joints[link], "origin", "xyz").split()]
        pose, link = step @ pose, _attribute(joints[link], "parent", "link")
    return pose


def _attribute(joint: ElementTree.Element, tag: str, name: str) -> str:
    found = joint.find(tag)
    return "" if found is None else found.get(name, "")


def moved(points: NDArray[np.void], T_base_cloud: F64) -> NDArray[np.void]:
    """Return points (N,) with x, y, z in the base frame instead of the cloud frame [m]."""
    out = points.copy()
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float64)
    for axis, column in zip("xyz", (xyz @ T_base_cloud[:3, :3].T).T, strict=True):
        out[axis] = column + T_base_cloud["xyz".index(axis), 3]
    return out


def floor_and_ceiling(points: NDArray[np.void]) -> tuple[float, float]:
    """Return the heights at which the lower and the upper half have most points (N,) [m]."""
    z = points["z"].astype(np.float64)
    middle = 0.5 * (float(np.percentile(z, 1)) + float(np.percentile(z, 99)))
    return _densest(z[z < middle]), _densest(z[z >= middle])


def _densest(values: F64) -> float:
    if not len(values):
        return float("nan")
    bins = np.floor(values / _BIN_M).astype(np.int64)
    found, counts = np.unique(bins, return_counts=True)
    return float(np.median(values[bins == found[counts.argmax()]]))


def as_message(T_base_cloud: F64) -> Any:
    """Return the mount as a message for ``/tf_static``."""
    from geometry_msgs.msg import TransformStamped
    from tf2_msgs.msg import TFMessage

    item = TransformStamped(child_frame_id=FrameConfig().cloud)
    item.header.frame_id = BASE_FRAME
    place, turn = item.transform.translation, item.transform.rotation
    place.x, place.y, place.z = T_base_cloud[:3, 3].tolist()
    turn.x, turn.y, turn.z, turn.w = Rotation.from_matrix(T_base_cloud[:3, :3]).as_quat().tolist()
    return TFMessage(transforms=[item])


_WALLS_M: Final = 1.5


def save_cloud(points: NDArray[np.void], path: Path, title: str) -> None:
    """Write a picture of a cloud: in perspective, and from above.

    Parameters
    ----------
    points : ndarray, shape (N,), dtype with x, y, z, range
        Cloud frame [m].
    path : Path
        PNG file; missing folders are made.
    title : str
    """
    figure = _figure(path)
    figure.suptitle(title)
    color: dict[str, Any] = {"c": points["range"], "cmap": "turbo", "vmin": 0.0, "linewidths": 0}
    color["vmax"] = float(np.percentile(points["range"], 99))
    space = figure.add_subplot(1, 2, 1, projection="3d")
    space.scatter(points["x"], points["y"], points["z"], s=1.5, **color)
    space.set_aspect("equal")
    space.view_init(elev=38, azim=-60)
    space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    plan = figure.add_subplot(1, 2, 2)
    dots = plan.scatter(points["x"], points["y"], s=1.5, **color)
    plan.set_aspect("equal")
    plan.set(xlabel="x [m]", ylabel="y [m]", title="from above")
    figure.colorbar(dots, ax=plan, label="range [m]")
    with whole(path) as part:
        figure.savefig(part)


def save_comparison(raw: NDArray[np.void], deskewed: NDArray[np.void], path: Path) -> None:
    """Write a picture of one sweep from above, as measured and deskewed.

    Parameters
    ----------
    raw, deskewed : ndarray, shape (N,), dtype with x, y, z
        Cloud frame [m].
    path : Path
        PNG file; missing folders are made.
    """
    figure = _figure(path, height=6.5)
    for column, (title, points) in enumerate((("as measured", raw), ("deskewed", deskewed))):
        plan = figure.add_subplot(1, 2, column + 1)
        points = points[points["z"] < _WALLS_M]  # a ceiling would hide the walls
        height: dict[str, Any] = {
            "c": points["z"],
            "cmap": "viridis",
            "vmin": 0.0,
            "vmax": _WALLS_M,
        }
        plan.scatter(points["x"], points["y"], s=1.5, linewidths=0, **height)
        plan.set_aspect("equal")
        plan.set(xlabel="x [m]", ylabel="y [m]", title=title)
    with whole(path) as part:
        figure.savefig(part)


def save_track(
    estimated: NDArray[np.float64], true: NDArray[np.float64], path: Path, title: str
) -> None:
    """Write a picture of an estimated track over the true one, from above and over time.

    Parameters
    ----------
    estimated, true : ndarray, shape (N, 3)
        In the world [m].
    path : Path
        PNG file; missing folders are made.
    title : str
    """
    figure = _figure(path)
    figure.suptitle(title)
    plan = figure.add_subplot(1, 2, 1)
    plan.plot(true[:, 0], true[:, 1], color="0.6", linewidth=4, label="truth")
    plan.plot(estimated[:, 0], estimated[:, 1], "tab:red", linewidth=1.2, label="odometry")
    plan.set_aspect("equal")
    plan.set(xlabel="x [m]", ylabel="y [m]")
    plan.legend()
    errors = figure.add_subplot(1, 2, 2)
    errors.plot(1e3 * np.linalg.norm(estimated - true, axis=1), "tab:red")
    errors.set(xlabel="sweep", ylabel="distance from the truth [mm]", ylim=(0, None))
    with whole(path) as part:
        figure.savefig(part)


def _figure(path: Path, height: float = 6.0) -> Figure:
    """Return an empty figure, the folder of whose file is there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(13, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


class TrackError(NamedTuple):
    """How far an estimated track is from the true one.

    Attributes
    ----------
    ate_m : float
        Root mean square of the distances after the best rigid alignment [m].
    worst_m : float
        Largest of them [m].
    length_m : float
        Length of the true track between the first and the last estimate [m].
    estimated, true : ndarray, shape (N, 3)
        Both tracks in the world [m], the estimated one aligned.
    """

    ate_m: float
    worst_m: float
    length_m: float
    estimated: F64
    true: F64


def track_error(truth: Results, stamps: list[int], positions: F64) -> TrackError:
    """Return the error of estimated positions.

    Parameters
    ----------
    truth : Results
    stamps : list of int
        Instants of the estimates [ns].
    positions : ndarray, shape (N, 3)
        In any frame that is fixed to the world [m]; N at least 3.
    """
    poses = truth.trajectory()
    origin = int(stamps[0])
    instants = np.array([stamp - origin for stamp in stamps], np.float64)
    known = (poses["stamp"] - origin).astype(np.float64)
    true = np.stack(
        [np.interp(instants, known, poses["position"][:, axis]) for axis in range(3)], axis=1
    )
    middle, true_middle = positions.mean(axis=0), true.mean(axis=0)
    turn, _ = Rotation.align_vectors(true - true_middle, positions - middle)
    aligned = turn.apply(positions - middle) + true_middle
    error = np.linalg.norm(aligned - true, axis=1)
    length = float(np.linalg.norm(np.diff(true, axis=0), axis=1).sum())
    return TrackError(float(np.sqrt(np.mean(error**2))), float(error.max()), length, aligned, true)


def stamp_errors_ms(truth: Results, packet_type: PacketType, stamps: list[int]) -> F64:
    """Return how far stamps are from the nearest true instant of a packet of a type [ms].

    Packets are 4 ms and more apart, so the nearest is the right one for any error below 2 ms.
    """
    starts = np.sort(truth.packets["start_ns"][truth.packets["type"] == packet_type])
    wanted = np.array(stamps, np.int64)
    after = np.clip(np.searchsorted(starts, wanted), 1, len(starts) - 1)
    errors = np.stack([wanted - starts[after - 1], wanted - starts[after]])
    nearest = np.abs(errors).argmin(axis=0)
    return np.asarray(errors[nearest, np.arange(len(wanted))] / 1e6)


_SPACING_MS: Final = {"/points": 229.8, "/imu/data": 4.0}  # a cloud per turn of the head
_TOLERANCE: Final = 0.02
# An error of the calibration makes an odometry drift in proportion to the way: a typical unit does
# by 0.1 to 0.25 % (docs/mapping.md); calibrated it does by a tenth.
_MAX_ATE_SHARE: Final = 0.003
_LEAST_LIMIT_M: Final = 0.05  # over less than 17 m of way
_SENSOR_HEIGHT_M: Final = 1.0  # of the built-in motions above the floor
_HEIGHT_TOLERANCE_M: Final = 0.25  # a walk heaves and pitches
_MIN_POSES: Final = 10


def report(
    console: Console,
    observer: Observer,
    folder: Path,
    with_odometry: bool,
    mount: F64 | None = None,
) -> list[str]:
    """Print the report, write pictures, and return problems.

    Parameters
    ----------
    console : Console
    observer : Observer
    folder : Path
        Of the pictures; its subfolder ``truth`` is what the virtual L2 wrote.
    with_odometry : bool
        Whether deskew and odometry took part.
    mount : ndarray, shape (4, 4), optional
        Pose of the cloud frame in the base frame of a robot; the cloud is then shown there.
    """
    console.print(_topics(observer, with_odometry))
    troubles = _troubles(observer)
    truth = Results(folder / "truth")
    if observer.points:
        console.print(
            f"{np.mean(observer.points):.0f} points per cloud, fields "
            f"{', '.join(observer.fields)}; /tf_static: "
            f"{', '.join(f'{parent} -> {child}' for parent, child in observer.transforms)}"
        )
    if len(observer.imu.stamps) > 1:
        spacing = observer.imu.intervals_ms
        errors = stamp_errors_ms(truth, PacketType.IMU, observer.imu.stamps)
        console.print(
            f"IMU stamps {spacing.mean():.4f} ms apart (standard deviation {spacing.std():.4f}), "
            f"off the truth by {np.median(errors):.3f} ms, p99 {np.percentile(errors, 99):.3f} ms"
        )
    console.print(f"lost packets: {_lost(observer)}")
    if observer.cloud is not None:
        if mount is None:
            save_cloud(observer.cloud, folder / "cloud.png", "one cloud, as measured")
        else:
            troubles += _in_base(console, observer.cloud, mount, folder)
    if with_odometry:
        troubles += _odometry(console, observer, truth, folder)
    console.print(f"pictures: {', '.join(str(path) for path in sorted(folder.glob('*.png')))}")
    return troubles


def _in_base(console: Console, cloud: NDArray[np.void], mount: F64, folder: Path) -> list[str]:
    """Show a cloud as RViz does with the fixed frame base_link; return problems."""
    shown = moved(cloud, mount)
    floor, ceiling = floor_and_ceiling(shown)
    text = f"in {BASE_FRAME} the floor is at z = {floor:.2f} m, the ceiling at {ceiling:.2f} m"
    console.print(text)
    save_cloud(shown, folder / "cloud.png", text)
    expected = float(mount[2, 3]) - _SENSOR_HEIGHT_M
    if abs(floor - expected) > _HEIGHT_TOLERANCE_M:
        return [f"the floor is at z = {floor:.2f} m in {BASE_FRAME}, not {expected:.2f} m"]
    return []


def _topics(observer: Observer, with_odometry: bool) -> Table:
    table = Table("topic", "rate [1/s]", "frame", "stamps", "age p50 / p99 [ms]")
    records = {"/points": observer.clouds, "/imu/data": observer.imu}
    if with_odometry:
        records |= {"/points_deskewed": observer.deskewed, "/odometry": observer.odometry}
    for name, record in records.items():
        ages = np.percentile(record.ages_s, [50, 99]) * 1e3 if record.ages_s else [np.nan, np.nan]
        steps = record.backward_steps
        table.add_row(
            name,
            f"{record.rate_hz:.2f}",
            record.frame,
            "ascending" if not steps else f"{steps} steps back",
            f"{ages[0]:.1f} / {ages[1]:.1f}",
        )
    return table


def _odometry(console: Console, observer: Observer, truth: Results, folder: Path) -> list[str]:
    """Evaluate the track and draw it; return problems."""
    if len(observer.positions) < _MIN_POSES:
        return [f"/odometry: {len(observer.positions)} poses, expected {_MIN_POSES} and more"]
    positions = np.array(observer.positions)
    track = track_error(truth, observer.odometry.stamps, positions)
    text = (
        f"odometry: {1e3 * track.ate_m:.1f} mm RMS off the truth "
        f"(at most {1e3 * track.worst_m:.1f} mm) over {track.length_m:.1f} m"
    )
    console.print(text)
    counts = observer.checks.get("odometry", {})
    if skipped := int(counts.get("skipped [sweeps]", 0)):
        console.print(
            f"odometry: {skipped} of {counts['sweeps']} sweeps were skipped: clouds "
            "arrived faster than this machine aligns them"
        )
    save_track(track.estimated, track.true, folder / "track.png", text)
    moved = [(raw, deskewed) for raw, deskewed in observer.pairs.values() if raw is not None
             and deskewed is not None]  # fmt: skip
    if moved:
        save_comparison(*moved[len(moved) // 2], folder / "deskew.png")
    if not observer.deskewed.stamps:
        return ["/points_deskewed: nothing received"]
    limit = max(_LEAST_LIMIT_M, _MAX_ATE_SHARE * track.length_m)
    if track.ate_m > limit:
        return [f"odometry is off by {track.ate_m:.3f} m, expected less than {limit:.3f} m"]
    return []


def _troubles(observer: Observer) -> list[str]:
    troubles = []
    for name, record in (("/points", observer.clouds), ("/imu/data", observer.imu)):
        if not record.stamps:
            troubles.append(f"{name}: nothing received")
            continue
        if record.backward_steps:
            troubles.append(f"{name}: stamps step back")
        # By stamp, not by arrival: where the machine pauses for a second, so do the messages.
        spacing = float(np.median(record.intervals_ms)) if len(record.stamps) > 1 else np.nan
        if not abs(spacing - _SPACING_MS[name]) < _TOLERANCE * _SPACING_MS[name]:
            troubles.append(
                f"{name}: stamps are {spacing:.2f} ms apart, expected {_SPACING_MS[name]}"
            )
    if not observer.diagnostics:
        return [*troubles, "/diagnostics: nothing received"]
    lost = _lost(observer)
    if lost != "0":
        troubles.append(f"packets lost: {lost}")
    return troubles


def _lost(observer: Observer) -> str:
    """Return how many packets were lost, and whether the driver did not get to them."""
    link = observer.checks.get("link", {})
    lost = sum(int(link.get(f"{stream} lost", 0)) for stream in ("points", "imu"))
    if 0 < lost <= int(link.get("kernel drops", 0)):
        return f"{lost}, dropped by the kernel while the driver waited for a processor"
    return str(lost)
