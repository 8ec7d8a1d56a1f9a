"""Checks of frames, transforms and QoS."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

from l2lidar_node.check.observation import Observation, Qos
from l2lidar_node.check.requirements import Consumer, Finding, Subscription, Use, not_judged, ok
from l2lidar_node.types import Level

_FRAMES: Final = "frames"
_QOS: Final = "qos"
_MIN_DEPTH: Final = {"cloud": 10, "imu": 200}


def check_frames(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    """Yield findings on frames and the transforms between them; there is at least one cloud."""
    clouds = tuple(dict.fromkeys(cloud.frame for cloud in seen.clouds))
    imus = seen.imu_frames if consumer.imu is not Use.IGNORED else ()
    faults = 0
    for topic, names, fix in (
        ("cloud", clouds, "set cloud_frame"),
        ("imu", imus, "set cloud_frame; the IMU frame is derived from it"),
    ):
        text = ""
        if len(names) > 1:
            text, check = (
                f"the frame of one topic changes: {', '.join(map(repr, names))}",
                "changes",
            )
        elif names and not names[0]:
            text, check = "the frame has no name", "empty"
        elif names and names[0].startswith("/"):
            text, check = f"frame '{names[0]}' begins with '/', which TF refuses", "slash"
        if text:
            faults += 1
            yield Finding(Level.ERROR, _FRAMES, f"frame-{check}", f"{topic}: {text}", fix)
    if faults:
        return
    yield ok(
        _FRAMES, "frames", f"clouds in '{clouds[0]}'" + (f", IMU in '{imus[0]}'" if imus else "")
    )
    if imus and consumer.tf is not Use.IGNORED:
        yield _check_mount(clouds[0], imus[0], seen, consumer)
    if consumer.moves_cloud_frame:
        yield _check_parent(clouds[0], seen, consumer)
    if consumer.tf is Use.NEEDED:
        yield _check_tree(clouds[0], imus[:1], seen, consumer)


def _check_mount(cloud: str, imu: str, seen: Observation, consumer: Consumer) -> Finding:
    if imu in _reachable(cloud, seen.transforms):
        return ok(_FRAMES, "tf-imu", "the mount of the IMU is known")
    return Finding(
        consumer.tf.level,
        _FRAMES,
        "tf-imu",
        f"no transform between '{cloud}' and '{imu}'; {consumer.title} takes it from TF "
        f"{'only' if consumer.tf is Use.NEEDED else 'or from its configuration'}",
        "set publish_tf: true, and record /tf_static",
    )


def _check_parent(cloud: str, seen: Observation, consumer: Consumer) -> Finding:
    """Return whether the consumer can publish a transform to the cloud frame."""
    parents = sorted({parent for parent, child in seen.transforms if child == cloud})
    if not parents:
        return ok(_FRAMES, "tf-parent", f"{consumer.title} can be the parent of '{cloud}' in TF")
    return Finding(
        Level.WARN,
        _FRAMES,
        "tf-parent",
        f"'{cloud}' has the parent '{parents[0]}' in TF; {consumer.title} as we configure it "
        "would add a second one, and TF allows only one",
        f"set '{parents[0]}' or its topmost frame as base frame in {consumer.title}'s own file",
    )


def _check_tree(
    cloud: str, own: tuple[str, ...], seen: Observation, consumer: Consumer
) -> Finding:
    others = _reachable(cloud, seen.transforms) - {
        cloud,
        *own,
        f"{cloud.removesuffix('_link')}_imu",
    }
    if others:
        return ok(_FRAMES, "tf", f"'{cloud}' is in one tree with {', '.join(sorted(others)[:4])}")
    return Finding(
        Level.WARN,
        _FRAMES,
        "tf",
        f"no transform from '{cloud}' to a frame of the robot; {consumer.title} needs one at the "
        "stamp of each cloud",
        "start the robot's description and odometry, record /tf and /tf_static",
    )


def _reachable(frame: str, transforms: Iterable[tuple[str, str]]) -> set[str]:
    reached = {frame}
    pending = set(transforms)
    while found := {pair for pair in pending if pair[0] in reached or pair[1] in reached}:
        pending -= found
        reached.update(name for pair in found for name in pair)
    return reached


def check_qos(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    """Yield findings on the QoS of publishers and of the consumer's subscriptions."""
    if seen.clouds:
        yield _check_offer("cloud", seen.cloud_qos, consumer.cloud_qos, consumer)
    if len(seen.imu) and consumer.imu is not Use.IGNORED:
        yield _check_offer("imu", seen.imu_qos, consumer.imu_qos, consumer)


def _check_offer(
    topic: str, offers: tuple[Qos, ...], asked: Subscription, consumer: Consumer
) -> Finding:
    known = {offer.reliability for offer in offers} - {"unknown"}
    if not known:
        return not_judged(_QOS, f"qos-{topic}", f"{topic}: the publisher's QoS is not known")
    fix = "set qos_reliability: reliable"
    if "best_effort" in known and asked.reliability != "best_effort":
        level = Level.ERROR if asked.reliability == "reliable" else Level.WARN
        why = {
            "reliable": "is reliable: nothing arrives",
            "default": "is the system's default, which some middlewares treat as reliable",
            "varies": "is reliable in some versions: nothing arrives there",
        }[asked.reliability]
        text = f"{topic}: published best effort; {consumer.title}'s subscription {why}"
        return Finding(level, _QOS, f"qos-{topic}", text, fix)
    depths = [offer.depth for offer in offers if offer.depth and offer.reliability == "reliable"]
    if depths and min(depths) < _MIN_DEPTH[topic]:
        text = (
            f"{topic}: published reliable with a queue of {min(depths)}, which overflows if the "
            f"consumer falls behind; {_MIN_DEPTH[topic]} is enough"
        )
        return Finding(Level.WARN, _QOS, f"qos-{topic}", text, "publish with a deeper queue")
    words = " and ".join(sorted(known)).replace("_", " ")
    ask = asked.reliability.replace("_", " ")
    return ok(_QOS, f"qos-{topic}", f"{topic}: published {words}, requested {ask}")
