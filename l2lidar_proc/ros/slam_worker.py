"""Worker thread of slam_node: everything except subscriptions and TF."""

from __future__ import annotations

import threading
import traceback
from collections import Counter
from collections.abc import Callable
from itertools import count
from pathlib import Path
from queue import Empty, PriorityQueue
from typing import Any, Final

import numpy as np

from l2lidar_node.types import F64
from l2lidar_proc.slam import atlas
from l2lidar_proc.slam.atlas import AtlasError, AtlasWriter
from l2lidar_proc.slam.config import SlamNodeConfig, check_map_name
from l2lidar_proc.slam.localization import Localizer
from l2lidar_proc.slam.nodes import Keyframe, Map, OdometrySweep, SlamState
from l2lidar_proc.slam.pose_graph import GtsamMissingError
from l2lidar_proc.slam.slam import Slam

Answer = tuple[bool, str]
"""Success of a request, and its message."""

_END_S: Final = 8.0  # for the last save; a launch kills what has not ended after 10 s
_DEPTH: Final = 400  # sweeps that may wait while a loop is verified: over a minute
_MOST_REQUESTS: Final = 50  # that may wait besides
_NOW, _IN_TURN = 0, 1  # a job that does not depend on those before it, one that does


class SlamWorker:
    """Mapping or localization behind a queue.

    What the node reads of it (:attr:`T_map_odom`, :attr:`state`, ...) is replaced in one step and
    never changed in place, so that no lock is needed.

    Parameters
    ----------
    config : SlamNodeConfig
    warn : callable
        Told what a person should know.
    on_keyframe : callable
        Told, in the thread, of each submap that is closed.

    Attributes
    ----------
    T_map_odom : ndarray, shape (4, 4), or None
    state : SlamState
    covariance : ndarray, shape (6, 6)
        Of the place in the map: turn, then translation, map axes.
    counts : Counter of str
        Candidates that were refused, by reason.
    submaps, loops, dropped, failures, saved_bytes : int
        ``failures`` are unexpected errors.

    Raises
    ------
    GtsamMissingError
    AtlasError
        If there is no map to begin with, and one is needed.
    """

    def __init__(
        self,
        config: SlamNodeConfig,
        warn: Callable[[str], None],
        on_keyframe: Callable[[Keyframe], None],
    ) -> None:
        self._config = config
        self._warn, self._on_keyframe = warn, on_keyframe
        self._is_localizing = config.slam.mode == "localization"
        self.map_name = config.topics.map_name
        self.dropped = self.failures = self.saved_bytes = 0
        self._given = False
        self._writer: AtlasWriter | None = None
        self._ours: set[Path] = set()  # maps that came from this node or went into it
        self._changed = False
        saved = None
        if config.topics.load_map or self._is_localizing:
            saved = self._load()
        self._map = saved
        self._engine: Slam | Localizer = self._made(saved)
        self._publish()
        self._jobs: PriorityQueue[tuple[int, int, Callable[[], None] | None]] = PriorityQueue()
        self._numbers = count()
        self._thread = threading.Thread(target=self._run, name="slam", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Number of sweeps and requests that wait."""
        return self._jobs.qsize()

    @property
    def folder(self) -> Path:
        """Folder of the map."""
        return Path(self._config.topics.data_dir).expanduser() / check_map_name(self.map_name)

    # ---- called by the node

    def sweep(self, sweep: OdometrySweep) -> None:
        """Take a sweep; if too many wait already, it is counted as dropped."""
        if self.waiting >= _DEPTH:
            self.dropped += 1
            return
        self._submit(_IN_TURN, lambda: self._add(sweep))

    def request(
        self, job: Callable[[], Answer], done: Callable[[Answer], None], *, at_once: bool = False
    ) -> None:
        """Have one of the methods below run in the thread, and its answer given to ``done``.

        Parameters
        ----------
        job, done : callable
        at_once : bool
            Before the sweeps that wait. A pose that is given has to wait for them, for instance.
        """
        if self.waiting >= _DEPTH + _MOST_REQUESTS:
            done((False, "too many requests are waiting; try again"))
            return
        rank = _NOW if at_once else _IN_TURN
        self._submit(rank, lambda: done(self._answered(job)))

    def show(self, show: Callable[[Map, list[tuple[int, int]]], None]) -> None:
        """Have the map and its loops shown, in the thread."""
        if self.waiting < _DEPTH:
            self._submit(_IN_TURN, lambda: show(*self._shown()))

    def close(self) -> None:
        """End the thread; waiting work is dropped.

        What the map has grown by since the last save is saved where autosaving is on. Where it
        is off, or not done in time, a warning says what is lost.
        """
        try:
            while True:
                self._jobs.get_nowait()
        except Empty:
            pass
        self._submit(_NOW, self._save_the_rest)
        self._submit(_NOW, None)
        self._thread.join(timeout=_END_S)
        if self._changed and self._thread.is_alive():
            self._warn(
                f"the map was not saved within {_END_S:g} s: what was added since the last save "
                "is lost"
            )

    # ---- run in the thread

    def save(self) -> Answer:
        """Save a growing map."""
        if not isinstance(self._engine, Slam):
            return False, "in localization mode the saved map stays as it is"
        built = self._engine.map()
        if not built.nodes:
            return False, "no map yet"
        try:
            folder = self.folder
            if self._writer is None or self._writer.folder != folder:
                self._keep_foreign(folder)
                self._writer = AtlasWriter(folder)
            self.saved_bytes = self._writer.save(built)
        except AtlasError as error:
            return False, str(error)
        self._changed = False
        return True, f"{len(built.nodes)} submaps, {self.saved_bytes} bytes in {folder.absolute()}"

    def autosave(self) -> Answer:
        """Save a map that has grown since; say so only if that fails."""
        if not self._changed or not isinstance(self._engine, Slam):
            return True, ""
        worked, text = self.save()
        if not worked:
            self._warn(f"autosave: {text}")
        return worked, text

    def _save_the_rest(self) -> None:
        if self._config.topics.autosave_s > 0.0:
            self._answered(self.autosave)
        elif self._changed and isinstance(self._engine, Slam):
            self._warn(
                "the map has grown since the last save and is not saved, since autosave_s is 0; "
                "call ~/save before the node ends"
            )

    def load(self) -> Answer:
        """Start over with the saved map."""
        try:
            saved = self._load()
        except AtlasError as error:
            return False, str(error)
        self._begin(saved)
        return True, f"{len(saved.nodes)} submaps of {self.folder.absolute()}"

    def reset(self) -> Answer:
        """Start over: with an empty map, or in localization mode with the loaded one."""
        if not self._is_localizing and self._map is not None:
            self._ours.discard(self.folder)  # what was loaded is not to be lost
        self._begin(self._map if self._is_localizing else None)
        return True, "begun anew"

    def set_localization(self, is_localizing: bool) -> Answer:
        """Keep the map as it is from now on, or let it grow; a place that is known stays known."""
        engine, known = self._engine, self.state is SlamState.LOCALIZED
        if is_localizing and isinstance(engine, Slam):
            worked, text = self.save()
            if not worked:
                return False, f"the map could not be saved: {text}"
            localizer = Localizer(self._config.slam, engine.map())
            if known and engine.T_map_odom is not None:
                localizer.take_over(engine.T_map_odom, engine.covariance)
            self._map, self._engine = engine.map(), localizer
        elif not is_localizing and isinstance(engine, Localizer):
            try:
                self._engine = self._mapping(self._map, engine.place)
            except GtsamMissingError as error:
                return False, str(error)
        self._is_localizing = is_localizing
        self._given = True
        self._publish()
        text = "localization: the map stays" if is_localizing else "mapping: the map grows"
        return True, text

    def relocalize(self) -> Answer:
        """Search for the place in the map."""
        if not isinstance(self._engine, Localizer):
            return False, "only in localization mode"
        self._engine.relocalize()
        self._publish()
        return True, "searching; move the sensor a few meters"

    def set_pose(self, x: float, y: float, yaw: float) -> Answer:
        """Take the place in the map from a person [m, m, rad]."""
        if not isinstance(self._engine, Localizer):
            return False, "an initial pose is used in localization mode only"
        if not self._engine.set_pose(x, y, yaw):
            return False, "the initial pose came before the first sweep; send it again"
        self._publish()
        return True, f"taken: {x:.2f} m, {y:.2f} m, {np.degrees(yaw):.0f} degrees"

    def _run(self) -> None:
        while (job := self._jobs.get()[2]) is not None:
            try:
                job()
            except Exception as error:  # unexpected: the node stays alive and reports it
                self._failed(error)

    def _submit(self, rank: int, job: Callable[[], None] | None) -> None:
        self._jobs.put((rank, next(self._numbers), job))

    def _answered(self, job: Callable[[], Answer]) -> Answer:
        try:
            return job()
        except Exception as error:
            self._failed(error)
            return False, f"internal error: {type(error).__name__}: {error}"

    def _failed(self, error: Exception) -> None:
        self.failures += 1
        self._warn(f"internal error: {error}\n{traceback.format_exc()}")

    def _add(self, sweep: OdometrySweep) -> None:
        self._changed |= self._engine.add(sweep)
        if not self._given and isinstance(self._engine, Localizer):
            self._given = True
            x, y, degrees = self._config.topics.initial_pose
            self._engine.set_pose(x, y, float(np.radians(degrees)))
        self._publish()

    def _keep_foreign(self, folder: Path) -> None:
        """Give another name to a map that this node neither loaded nor saved."""
        if folder not in self._ours and (aside := atlas.set_aside(folder)):
            self._warn(f"the previous map in {folder} is now {aside}")
        self._ours.add(folder)

    def _load(self) -> Map:
        saved, warnings = atlas.load(self.folder)
        self._ours.add(self.folder)
        for warning in warnings:
            self._warn(warning)
        return saved

    def _begin(self, saved: Map | None) -> None:
        self._map, self._engine = saved, self._made(saved)
        self._writer, self._changed = None, False
        self._publish()

    def _made(self, saved: Map | None) -> Slam | Localizer:
        self._given = not self._config.topics.initial_pose
        if self._is_localizing:
            assert saved is not None
            return Localizer(self._config.slam, saved)
        return self._mapping(saved, None)

    def _mapping(self, saved: Map | None, place: tuple[F64, F64] | None) -> Slam:
        return Slam(self._config.slam, saved, place=place, on_keyframe=self._on_keyframe)

    def _publish(self) -> None:
        engine = self._engine
        self.T_map_odom: F64 | None = engine.T_map_odom
        self.state: SlamState = engine.state
        self.covariance: F64 = engine.covariance
        self.counts: Counter[str] = engine.counts.copy()
        nodes = engine.nodes if isinstance(engine, Slam) else self._shown()[0].nodes
        self.submaps = len(nodes)
        self.loops = len(engine.loops) if isinstance(engine, Slam) else 0

    def _shown(self) -> tuple[Map, list[tuple[int, int]]]:
        if isinstance(self._engine, Slam):
            return self._engine.map(), list(self._engine.loops)
        assert self._map is not None
        return self._map, []


def values_of(worker: SlamWorker) -> dict[str, Any]:
    """Return the figures for diagnostics."""
    return {
        "submaps": worker.submaps,
        "loops": worker.loops,
        "waiting": worker.waiting,
        "dropped": worker.dropped,
        "internal errors": worker.failures,
        "saved bytes": worker.saved_bytes,
        **{f"refused: {reason}": count for reason, count in worker.counts.items()},
    }
