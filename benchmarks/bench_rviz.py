"""Asks whether RViz could show every message of its layouts at the moment it arrives.

RViz 14 transforms a cloud to the fixed frame as soon as it has it, and drops it, with the status
"Error", where the transform for its stamp is not there yet. The same question is asked here of
every display of the layouts, with tf2's rule: every moving joint on the way needs one transform
before and one after the stamp. Messages count from the first one that could be shown; until then
nothing is known of the frame.
"""

from __future__ import annotations

import sys
from bisect import bisect_left
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Final

import numpy as np
import rclpy
import typer
import yaml
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from tf2_msgs.msg import TFMessage

from benchmarks import chain
from benchmarks.chain import CLOUDS, TopicWatch
from benchmarks.results import at_least, publish
from l2lidar_node.demo import report
from l2lidar_node.demo.processes import Programs, isolate_ros
from l2lidar_proc.ros.subscriptions import NeverExecuted, waiting

LAYOUTS: Final = Path(__file__).resolve().parent.parent / "rviz"
_CACHE_NS: Final = 10 * 10**9  # what tf2's buffer keeps
_QUEUE: Final = 1000  # of the listener, 20 s of transforms
_PACKAGES: Final = {
    "PointCloud2": "sensor_msgs",
    "LaserScan": "sensor_msgs",
    "Path": "nav_msgs",
    "Odometry": "nav_msgs",
}
"""Displays of messages with one header, which RViz transforms at its stamp."""


@dataclass(frozen=True, slots=True)
class Display:
    """One display that shows a topic.

    Attributes
    ----------
    layout, name, topic, kind : str
    fixed_frame : str
        Of its layout.
    depth : int
        Of its subscription.
    is_reliable : bool
        Asked of the publisher.
    """

    layout: str
    name: str
    topic: str
    kind: str
    fixed_frame: str
    depth: int
    is_reliable: bool


def displays(folder: Path = LAYOUTS) -> Iterator[Display]:
    """Yield the displays of all layouts, also those that are off at the start."""
    for path in sorted(folder.glob("*.rviz")):
        manager = yaml.safe_load(path.read_text(encoding="utf-8"))["Visualization Manager"]
        for item in _flat(manager["Displays"]):
            kind = item["Class"].rpartition("/")[2]
            if kind in _PACKAGES:
                topic = item["Topic"]
                yield Display(
                    path.name, item["Name"], topic["Value"], kind,
                    manager["Global Options"]["Fixed Frame"], topic["Depth"],
                    topic["Reliability Policy"] == "Reliable",
                )  # fmt: skip


def _flat(items: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    for item in items:
        yield item
        yield from _flat(item.get("Displays", []))


class TransformTimes:
    """When each joint of the tree is known: the times of tf2's buffer without its poses."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}
        self._stamps: dict[str, deque[int]] = {}  # ascending; none for a static joint

    def take(self, message: Any, *, is_static: bool) -> None:
        """Take the transforms of a TFMessage."""
        for item in message.transforms:
            child = item.child_frame_id
            self._parents[child] = item.header.frame_id
            if is_static:
                self._stamps.pop(child, None)
                continue
            stamps = self._stamps.setdefault(child, deque())
            stamp = _nanoseconds(item.header.stamp)
            if not stamps or stamp > stamps[-1]:  # tf2 ignores what is repeated
                stamps.append(stamp)
            while stamps[0] < stamps[-1] - _CACHE_NS:
                stamps.popleft()

    def problem(self, target: str, source: str, stamp: int) -> str:
        """Return why tf2 could not transform from source to target; empty if it could."""
        if target == source:
            return ""
        up, down = self._chain(source), self._chain(target)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            return f"'{source}' and '{target}' are not connected"
        for child in [*up[: up.index(common)], *down[: down.index(common)]]:
            stamps = self._stamps.get(child)
            if stamps is None:
                continue
            at = bisect_left(stamps, stamp)
            if at == len(stamps):
                return f"'{child}' is {(stamp - stamps[-1]) / 1e6:.0f} ms behind"
            if at == 0 and stamps[0] != stamp:
                return f"'{child}' begins {(stamps[0] - stamp) / 1e6:.0f} ms later"
        return ""

    def _chain(self, frame: str) -> list[str]:
        found = [frame]
        while found[-1] in self._parents and self._parents[found[-1]] not in found:
            found.append(self._parents[found[-1]])
        return found


@dataclass(slots=True)
class Outcome:
    """What became of the messages of a display.

    Attributes
    ----------
    shown, dropped, before : int
        Messages that could be transformed on arrival, that could not, and those before the first
        that could.
    ages_ms : list of float
        From each stamp to the arrival.
    reasons : dict
        Messages by reason.
    """

    shown: int = 0
    dropped: int = 0
    before: int = 0
    ages_ms: list[float] = field(default_factory=list)
    reasons: dict[str, int] = field(default_factory=lambda: defaultdict(int))

    def note(self, problem: str, age_ms: float) -> None:
        """Count one message."""
        if not problem:
            self.shown += 1
        elif not self.shown:
            self.before += 1
        else:
            self.dropped += 1
            self.reasons[problem] += 1
        self.ages_ms.append(age_ms)


class LayoutWatch(Node):  # type: ignore[misc]  # rclpy is used as if it had no types
    """Subscribes as the displays of the layouts do, and to transforms as RViz's listener does.

    Parameters
    ----------
    asked : iterable of Display
        Displays of the same topic share a subscription with the larger depth.
    """

    def __init__(self, asked: list[Display]) -> None:
        super().__init__("layout_watch")
        self.outcomes: dict[Display, Outcome] = {display: Outcome() for display in asked}
        self._times = TransformTimes()
        # RViz's listener has a thread of its own: a transform that has come is known to a cloud.
        self._moving = self._listener("/tf", QoSProfile(depth=_QUEUE))
        self._static = self._listener(
            "/tf_static", QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        )
        by_topic: dict[str, list[Display]] = defaultdict(list)
        for display in asked:
            by_topic[display.topic].append(display)
        for topic, group in by_topic.items():
            reliable = all(display.is_reliable for display in group)
            self.create_subscription(
                getattr(import_module(f"{_PACKAGES[group[0].kind]}.msg"), group[0].kind),
                topic,
                self._judge(group),
                QoSProfile(
                    depth=max(display.depth for display in group),
                    reliability=ReliabilityPolicy.RELIABLE
                    if reliable
                    else ReliabilityPolicy.BEST_EFFORT,
                ),
            )
        mount = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._mount = self.create_publisher(TFMessage, "/tf_static", mount)

    def put_on_robot(self) -> None:
        """Publish the mount of the example robot, as robot_state_publisher does."""
        self._mount.publish(report.as_message(report.mount("top")))

    def _listener(self, topic: str, qos: QoSProfile) -> Any:
        return self.create_subscription(
            TFMessage, topic, lambda message: None, qos, callback_group=NeverExecuted()
        )

    def _judge(self, group: list[Display]) -> Callable[[Any], None]:
        def judge(message: Any) -> None:
            for subscription, is_static in ((self._static, True), (self._moving, False)):
                for transforms in waiting(subscription, _QUEUE):
                    self._times.take(transforms, is_static=is_static)
            stamp, frame = _nanoseconds(message.header.stamp), message.header.frame_id
            age_ms = (self.get_clock().now().nanoseconds - stamp) / 1e6
            for display in group:
                problem = self._times.problem(display.fixed_frame, frame, stamp)
                self.outcomes[display].note(problem, age_ms)

        return judge


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _rows(outcomes: Mapping[Display, Outcome]) -> Iterator[dict[str, Any]]:
    for display, outcome in outcomes.items():
        if outcome.ages_ms:
            worst = max(outcome.reasons, key=outcome.reasons.__getitem__, default="")
            yield {
                "layout": display.layout, "display": display.name, "topic": display.topic,
                "in frame": display.fixed_frame, "before the first": outcome.before,
                "shown": outcome.shown, "dropped": outcome.dropped,
                "age at arrival, median [ms]": round(float(np.median(outcome.ages_ms)), 1),
                "age, max [ms]": round(max(outcome.ages_ms), 1),
                "most frequent reason": worst,
            }  # fmt: skip


def main(
    seconds: Annotated[float, typer.Option(min=3.0, help="How long to watch.")] = 60.0,
    world: Annotated[str, typer.Option(help="Scene of the virtual L2.")] = "room",
    motion: Annotated[str, typer.Option(help="Of the virtual L2.")] = "walk",
) -> None:
    """Run the chain at the real rate and judge every message as RViz's layouts would."""
    isolate_ros()
    rclpy.init()
    nodes = [chain.DRIVER, chain.COMPANION]
    if find_spec("gtsam"):
        nodes.append(chain.SLAM)
    # LIO-SAM's own nodes are not here.
    asked = [display for display in displays() if not display.topic.startswith("/lio_sam/")]
    watch = LayoutWatch(asked)
    start = TopicWatch([CLOUDS], name="start")
    try:
        with TemporaryDirectory() as folder, Programs() as programs:
            watch.put_on_robot()
            unit = ["--ready", "--world", world, "--motion", motion]
            chain.start(programs, unit, None, nodes, report.BASE_FRAME, folder)
            start.until(lambda: len(start.seen(CLOUDS)) > 0, programs, "no clouds came")
            start.spin_with(watch)
            start.watch(seconds)
            programs.check()
    finally:
        rclpy.try_shutdown()
    rows = list(_rows(watch.outcomes))
    shown = sum(row["shown"] for row in rows)
    dropped = sum(row["dropped"] for row in rows)
    share = 100.0 * shown / (shown + dropped) if shown else 0.0
    targets = [
        at_least("messages that RViz shows on arrival [%]", share, 100.0),
        at_least("displays with messages", len(rows), sum(1 for d in asked if _comes(d, nodes))),
    ]
    publish("rviz", f"RViz's layouts, {seconds:.0f} s in '{world}'", rows, targets)
    sys.exit(0 if all(target.met for target in targets) else 1)


def _comes(display: Display, nodes: list[str]) -> bool:
    """Return whether a display's topic is published while a sensor moves."""
    return chain.SLAM in nodes or display.layout != "map.rviz"


if __name__ == "__main__":
    typer.run(main)
