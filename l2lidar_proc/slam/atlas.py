"""Saved maps: a folder that is consistent at every instant, with checksums.

``atlas.json`` names everything else and is replaced in one step, last. Other files carry their
checksum in their name and never change, so that saving again writes only what is new, and a
program killed while saving leaves the map that was there before.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import zipfile
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.files import free_name, write_whole
from l2lidar_node.types import HostNs
from l2lidar_proc.recording.outputs import STAMPED_POSE
from l2lidar_proc.slam.nodes import Map, Node
from l2lidar_proc.slam.pose_graph import EDGE
from l2lidar_proc.slam.submap import REACH_M, SUBMAP_POINT, Submap

MANIFEST: Final = "atlas.json"
VERSION: Final = 1

_NODE: Final = np.dtype(
    [
        ("stamp", "<i8"),
        ("T_odom_node", "<f8", (4, 4)),
        ("T_map_node", "<f8", (4, 4)),
        ("usable", "?"),
        ("way", "<f8"),
        ("sweeps", "<i8"),  # how many of the sweeps in the file are this node's
    ]
)
_OURS: Final = re.compile(r"(graph|submap)-[0-9a-f]{24}\.npz")
_PART: Final = re.compile(rf"\.part-({_OURS.pattern}|{re.escape(MANIFEST)})")
"""What a program killed while writing one of our files leaves."""
_RIGID: Final = 1e-6


class AtlasError(ValueError):
    """A folder that is not a map, or cannot be read or written; the message says why."""


class AtlasWriter:
    """Saves a growing map to a folder.

    Parameters
    ----------
    folder : Path
        New, empty, or a map already.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._names: dict[int, tuple[Submap, str]] = {}

    def save(self, built: Map) -> int:
        """Save a map; return the bytes of all its files.

        Raises
        ------
        AtlasError
            If the folder holds something else, or cannot be written.
        """
        try:
            check_place(self.folder)
            self.folder.mkdir(parents=True, exist_ok=True)
            return self._save(built)
        except OSError as error:
            raise _unsaved(self.folder, error) from None

    def _save(self, built: Map) -> int:
        submaps = [self._submap(number, node) for number, node in enumerate(built.nodes)]
        graph = self._written("graph", **_graph_of(built))
        body = {
            "format": "l2lidar atlas",
            "version": VERSION,
            "graph": graph,
            "submaps": submaps,
        }
        text = json.dumps({"sha256": _sha256(_canonical(body)), "map": body}, indent=1)
        write_whole(self.folder / MANIFEST, text + "\n")
        wanted = {graph, *(name for name in submaps if name)}
        total = (self.folder / MANIFEST).stat().st_size
        for path in self.folder.iterdir():
            if _OURS.fullmatch(path.name):
                if path.name in wanted:
                    total += path.stat().st_size
                else:
                    path.unlink(missing_ok=True)
            elif _PART.fullmatch(path.name):
                path.unlink(missing_ok=True)
        return total

    def _submap(self, number: int, node: Node) -> str | None:
        """Return the name of a submap's file, which is written unless it is there."""
        if node.submap is None:
            # what could not be read stays in the map: the next time it may be readable again
            is_kept = node.unread is not None and (self.folder / node.unread).exists()
            return node.unread if is_kept else None
        known = self._names.get(number)
        if known is None or known[0] is not node.submap or not (self.folder / known[1]).exists():
            name = self._written("submap", points=node.submap.points, views=node.submap.views)
            known = self._names[number] = node.submap, name
        return known[1]

    def _written(self, kind: str, **arrays: Any) -> str:
        stream = io.BytesIO()
        np.savez(stream, **arrays)
        content = stream.getvalue()
        name = f"{kind}-{_sha256(content)[:24]}.npz"
        if not (self.folder / name).exists():
            write_whole(self.folder / name, content)
        return name


def _is_of_a_map(name: str) -> bool:
    """Return whether a file is one of a map, or what a save that was killed has left of one."""
    return bool(_OURS.fullmatch(name) or _PART.fullmatch(name))


def check_place(folder: Path) -> None:
    """Check that a folder is new, empty, or a map already, so that a map can be saved to it.

    Raises
    ------
    AtlasError
        If it holds something else, is a file, or cannot be read.
    """
    try:
        names = {path.name for path in folder.iterdir()}
    except FileNotFoundError:
        return
    except OSError as error:
        raise _unsaved(folder, error) from None
    if MANIFEST in names:
        try:
            _body(folder / MANIFEST)
        except AtlasError as error:
            raise AtlasError(f"{error}; choose a new or empty folder") from None
    elif not all(map(_is_of_a_map, names)):
        raise AtlasError(
            f"{folder} contains files that are not a map; choose a new or empty folder"
        )


def _unsaved(folder: Path, error: OSError) -> AtlasError:
    reason = error.strerror or str(error)
    return AtlasError(f"{folder}: the map could not be saved: {reason}")


def set_aside(folder: Path) -> Path | None:
    """Give a saved map another name, ``-1`` added; return where it is now, None if there is none.

    Raises
    ------
    AtlasError
        If the folder cannot be renamed.
    """
    if not (folder / MANIFEST).exists():
        return None
    aside = free_name(folder)
    try:
        folder.rename(aside)
    except OSError as error:
        reason = error.strerror or str(error)
        raise AtlasError(f"{folder}: the map cannot be renamed to {aside}: {reason}") from None
    return aside


def load(folder: Path) -> tuple[Map, list[str]]:
    """Return a saved map, and a warning for each submap that had to be left out.

    Raises
    ------
    AtlasError
        If there is no map, or its graph is damaged.
    """
    body = _manifest(folder)
    arrays = _read(folder, body["graph"], ("nodes", "edges", "sweeps"))
    nodes, edges, sweeps = (arrays[name] for name in ("nodes", "edges", "sweeps"))
    _check(folder, nodes, edges, sweeps, body["submaps"])
    warnings: list[str] = []
    built: list[Node] = []
    ends = np.cumsum(nodes["sweeps"])
    for number, (row, name) in enumerate(zip(nodes, body["submaps"], strict=True)):
        submap = unread = None
        if name is not None:
            try:
                submap = _submap_of(folder, name)
            except AtlasError as error:
                unread = name
                kept = "; its file is kept" if (folder / name).exists() else ""
                warnings.append(f"submap {number} is skipped: {error}{kept}")
        built.append(
            Node(
                HostNs(int(row["stamp"])),
                row["T_odom_node"].copy(),
                submap,
                sweeps[ends[number] - row["sweeps"] : ends[number]].copy(),
                bool(row["usable"]),
                float(row["way"]),
                unread,
            )
        )
    if not any(node.submap is not None for node in built):
        raise AtlasError(f"{folder}: no readable submap")
    return Map(built, nodes["T_map_node"].copy(), edges), warnings


def _body(path: Path) -> tuple[dict[str, Any], Any]:
    """Return what a manifest says of its map, and the checksum that it gives for it."""
    try:
        read = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise AtlasError(
            f"{path.parent} is not a saved map: there is no {MANIFEST} in it"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise AtlasError(f"{path} cannot be read: {error}") from None
    body = read.get("map") if isinstance(read, dict) else None
    if not isinstance(body, dict) or body.get("format") != "l2lidar atlas":
        raise AtlasError(f"{path} is not the manifest of a saved map")
    return body, read.get("sha256")


def _manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    body, checksum = _body(path)
    if body.get("version") != VERSION:
        raise AtlasError(
            f"{path}: version {body.get('version')!r} is not known, expected {VERSION}"
        )
    if checksum != _sha256(_canonical(body)):
        raise AtlasError(f"{path} is damaged: its checksum is wrong")
    names = [body.get("graph"), *(body.get("submaps") or ["missing"])]
    for name in names[:1] + [name for name in names[1:] if name is not None]:
        if not isinstance(name, str) or not _OURS.fullmatch(name):
            raise AtlasError(f"{path}: {name!r} is not a file name of a map")
    return body


def _read(folder: Path, name: str, wanted: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    path = folder / name
    try:
        content = path.read_bytes()
        if _sha256(content)[:24] != path.stem.split("-")[1]:
            raise AtlasError(f"{path} is damaged: its checksum is wrong")
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            return {key: arrays[key] for key in wanted}
    except (OSError, ValueError, KeyError, MemoryError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, AtlasError):
            raise
        raise AtlasError(f"{path} cannot be read: {error}") from None


def _submap_of(folder: Path, name: str) -> Submap:
    arrays = _read(folder, name, ("points", "views"))
    points, views = arrays["points"], arrays["views"]
    sound = points.dtype == SUBMAP_POINT and points.ndim == 1 and len(points)
    sound = sound and views.ndim == 2 and views.shape[1] == 3
    sound = sound and bool((np.abs(views) <= REACH_M).all())
    if not sound or int(points["view"].max()) >= len(views):
        raise AtlasError(f"{folder / name} does not hold a submap")
    return Submap(points, views.astype(np.float32))


def _graph_of(built: Map) -> dict[str, NDArray[Any]]:
    nodes = np.zeros(len(built.nodes), _NODE)
    for row, node, pose in zip(nodes, built.nodes, built.poses, strict=True):
        row["stamp"], row["T_odom_node"], row["T_map_node"] = node.stamp, node.T_odom_node, pose
        row["usable"], row["way"], row["sweeps"] = node.usable, node.way, len(node.sweeps)
    sweeps = [node.sweeps for node in built.nodes] or [np.empty(0, STAMPED_POSE)]
    return {"nodes": nodes, "edges": built.edges, "sweeps": np.concatenate(sweeps)}


def _check(
    folder: Path,
    nodes: NDArray[np.void],
    edges: NDArray[np.void],
    sweeps: NDArray[np.void],
    names: list[Any],
) -> None:
    """Refuse a graph that nothing could be done with."""
    kinds = (nodes.dtype, edges.dtype, sweeps.dtype) == (_NODE, EDGE, STAMPED_POSE)
    if not kinds or nodes.ndim != 1 or not len(nodes) or len(names) != len(nodes):
        raise AtlasError(f"{folder}: the graph is not valid")
    ends = (edges["first"], edges["second"])
    counted = (nodes["sweeps"] >= 0).all() and int(nodes["sweeps"].sum()) == len(sweeps)
    inside = all(((end >= 0) & (end < len(nodes))).all() for end in ends)
    if not counted or not inside:
        raise AtlasError(f"{folder}: the graph refers to missing nodes")
    for poses in (nodes["T_map_node"], nodes["T_odom_node"], edges["pose"]):
        turn = poses[:, :3, :3]
        off = np.swapaxes(turn, 1, 2) @ turn - np.eye(3)
        if not np.isfinite(poses).all() or (np.abs(off) > _RIGID).any():
            raise AtlasError(f"{folder}: the graph contains an invalid pose")


def _canonical(body: dict[str, Any]) -> bytes:
    return json.dumps(body, sort_keys=True).encode()


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
