"""Measures what a slow network needs: sizes of clouds, and what arrives over a bad link.

``make bench-wifi``. The sizes are of a virtual L2's turns. For the link, driver and listener are
in two network namespaces with a link between them that loses and delays, which takes root and
iproute2; without them this part is left out, and says so.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
import zstandard
from numpy.typing import NDArray

from l2lidar_node.demo.processes import assigned
from l2lidar_node.ros.compressed_cloud import on_grid
from l2lidar_node.types import POINT, Sweep
from tests.support.odometry_runs import record, sweeps

PAGE: Final = Path("docs") / "results" / "wifi.md"
_NAMES: Final = ("l2lidar_robot", "l2lidar_desk")
_ADDRESSES: Final = ("10.217.3.1", "10.217.3.2")
_TOPICS: Final = {
    "cloud": "/points",
    "zstd": "/points/zstd",
    "packets": "/l2lidar_node/packets",
}
_PROFILE: Final = Path("config") / "fastdds_wifi.xml"
_CASES: Final = (
    ("cloud", "none", "best_effort", False),
    ("cloud", "none", "reliable", False),
    ("cloud", "none", "reliable", True),
    ("zstd", "lossless", "best_effort", False),
    ("zstd", "lossless", "reliable", False),
    ("zstd", "lossless", "reliable", True),
    ("zstd", "millimeter", "best_effort", False),
    ("zstd", "millimeter", "best_effort", True),
    ("zstd", "millimeter", "reliable", False),
    ("zstd", "millimeter", "reliable", True),
    ("packets", "none", "best_effort", False),
    ("packets", "none", "reliable", False),
    ("packets", "none", "reliable", True),
)
"""Topic, compressed_clouds, reliability, and whether both ends use the profile."""
_DEVICES: Final = ("l2robot", "l2desk")
_RATE: Final = 20e6  # [bit/s]
_LOSS: Final = 0.02
_DELAY_S: Final = 0.03
_TURNS_S: Final = 6.0


def sizes(turns: list[Sweep]) -> list[tuple[str, float, float]]:
    """Return what is sent, its bytes per turn, and the time to make it [ms], medians."""
    ways: tuple[tuple[str, Callable[[NDArray[np.void]], bytes]], ...] = (
        ("cloud as it is", lambda points: points.tobytes()),
        ("zstd, lossless", lambda points: _zstd(points.tobytes())),
        ("zstd, millimeter", lambda points: _zstd(on_grid(points).tobytes())),
        ("int16 mm, deltas, zstd (no plugin reads it)", _deltas),
    )
    found = []
    for name, way in ways:
        lengths, times = [], []
        for turn in turns:
            begin = time.perf_counter()
            lengths.append(len(way(turn.points)))
            times.append(1e3 * (time.perf_counter() - begin))
        found.append((name, float(np.median(lengths)), float(np.median(times))))
    packets = float(np.median([turn.packets for turn in turns])) * 1044.0
    found.append(("raw packets of the sensor", packets, 0.0))
    return found


def _zstd(data: bytes) -> bytes:
    return bytes(zstandard.ZstdCompressor(level=1).compress(data))


def _deltas(points: NDArray[np.void]) -> bytes:
    """Return the smallest that a format of one's own could send: columns of differences."""
    columns = BytesIO()
    for axis in "xyz":
        whole = np.round(points[axis] * 1000.0).astype(np.int32)
        columns.write(np.diff(whole, prepend=0).astype("<i2").tobytes())
    columns.write(points["intensity"].astype(np.uint8).tobytes())
    return _zstd(columns.getvalue())


def _run(*words: str) -> None:
    subprocess.run(words, check=True, capture_output=True)


@contextmanager
def bad_link() -> Iterator[None]:
    """Make two network namespaces and a link between them; see :mod:`benchmarks.wifi_link`.

    Raises
    ------
    OSError
        If it cannot be made; the message says what is missing.
    """
    if os.geteuid() != 0 or not shutil.which("ip") or not Path("/dev/net/tun").exists():
        raise OSError("the link takes root, ip (iproute2) and /dev/net/tun; run as root")
    ends = [word for pair in zip(_NAMES, _DEVICES, strict=True) for word in pair]
    with ExitStack() as undo:
        try:
            for name in _NAMES:
                _run("ip", "netns", "add", name)
                undo.callback(subprocess.run, ("ip", "netns", "del", name), check=False)
            link = subprocess.Popen(
                [sys.executable, "-m", "benchmarks.wifi_link", "link",
                 str(_RATE), str(_LOSS), str(_DELAY_S), *ends],
                stdout=subprocess.PIPE, text=True,
            )  # fmt: skip
            undo.callback(link.wait)
            undo.callback(link.terminate)
            assert link.stdout is not None
            if link.stdout.readline().strip() != "ready":
                raise OSError("the link could not be made; its own words are above")
            for name, end, address in zip(_NAMES, _DEVICES, _ADDRESSES, strict=True):
                inside = ("ip", "netns", "exec", name)
                _run(*inside, "ip", "link", "set", "lo", "up")
                _run(*inside, "ip", "address", "add", f"{address}/24", "dev", end)
                _run(*inside, "ip", "link", "set", end, "up", "multicast", "on", "mtu", "1500",
                     "txqueuelen", "2000")  # fmt: skip
                _run(*inside, "ip", "route", "add", "224.0.0.0/4", "dev", end)
        except subprocess.CalledProcessError as error:
            words = " ".join(error.cmd)
            said = error.stderr.decode().strip()
            raise OSError(f"the link cannot be made: {words}: {said}") from None
        yield


@contextmanager
def middleware(is_profiled: bool) -> Iterator[dict[str, str]]:
    """Yield an environment in which Fast DDS uses the network: shared memory knows no namespaces.

    Parameters
    ----------
    is_profiled : bool
        Whether with the profile that is made for such a link.
    """
    plain = {**os.environ, "ROS_DOMAIN_ID": "71"}
    if not is_profiled:
        yield {**plain, "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
        return
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        shared = "<transport_id>shared_memory</transport_id>"
        head, participant, rest = _PROFILE.read_text().partition("<participant ")
        file.write(head + participant + rest.replace(shared, "", 1))
        file.flush()
        names = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
        yield {**plain, **dict.fromkeys(names, file.name)}


def arrived(
    kind: str, compressed: str, reliability: str, environment: dict[str, str], seconds: float
) -> dict[str, Any]:
    """Return what comes to the desk of one topic; see :mod:`benchmarks.wifi_link`.

    ``published`` is what a listener on the robot gets in the same time: a busy machine makes less.
    """
    inside = ("ip", "netns", "exec")
    values = {
        "l2_ip": "127.0.0.1",
        "host_ip": "127.0.0.1",
        "imu_adjust": False,
        "sweep_cut": "turn",
        "compressed_clouds": compressed,
        "qos_reliability": reliability,
        "publish_packets": kind == "packets",
    }
    robot = [
        [*inside, _NAMES[0], sys.executable, "-m", module, *arguments]
        for module, arguments in (
            ("l2lidar_node.emulator", ["--ready", "--world", "room"]),
            ("l2lidar_node.ros.driver_node", assigned(values)),
        )
    ]
    watches = [
        [*inside, name, sys.executable, "-m", "benchmarks.wifi_link", "watch",
         _TOPICS[kind], kind, reliability]
        for name in _NAMES
    ]  # fmt: skip
    with ExitStack() as undo:
        running = []
        for words in robot:
            said = undo.enter_context(tempfile.TemporaryFile("w+"))
            process = subprocess.Popen(
                words, env=environment, stdout=subprocess.DEVNULL, stderr=said
            )
            running.append((process, said))
            undo.callback(process.wait)
            undo.callback(process.kill)  # what was measured is at the other end
        beside = subprocess.Popen(
            [*watches[0], "0"], env=environment, stdout=subprocess.PIPE, text=True
        )
        undo.callback(beside.kill)
        found = subprocess.run(
            [*watches[1], str(seconds)],
            env=environment,
            capture_output=True,
            text=True,
            timeout=seconds + 180.0,
            check=True,
        )
        for process, said in running:
            if process.poll() is not None:
                said.seek(0)
                raise OSError(f"a program on the robot ended: {said.read().strip()}")
        beside.terminate()
        said_beside, _ = beside.communicate(timeout=60.0)
    measured: dict[str, Any] = json.loads(found.stdout.splitlines()[-1])
    begun = measured["begun_s"]
    measured["published"] = sum(
        begun < arrival <= begun + measured["seconds"]
        for arrival in json.loads(said_beside.splitlines()[-1])["arrivals_s"]
    )
    return measured


def link_rows(seconds: float, turn_s: float) -> Iterator[tuple[str, ...]]:
    """Yield a row for each case: the cells of the table."""
    for kind, compressed, reliability, is_profiled in _CASES:
        with middleware(is_profiled) as environment:
            found = arrived(kind, compressed, reliability, environment, seconds)
        share = min(found["messages"] / max(found["published"], 1), 1.0)
        # the stamp of a cloud is its first point's
        late = np.array(found["ages_s"]) - turn_s
        age = f"{np.median(late):.2f} / {np.percentile(late, 95):.2f}" if len(late) else ""
        yield (
            _TOPICS[kind],
            compressed if kind == "zstd" else "",
            reliability,
            _PROFILE.name if is_profiled else "",
            f"{found['published'] / found['seconds']:.1f}",
            f"{100.0 * share:.0f} %",
            age if kind != "packets" else "",
            f"{8e-6 * found['bytes'] / found['seconds']:.1f}",
        )


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Return a Markdown table."""
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main() -> int:
    """Measure, print, and write the page if asked to; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="for each case")
    parser.add_argument("--sizes-only", action="store_true", help="leave the link out")
    parser.add_argument("--page", action="store_true", help=f"write {PAGE}")
    given = parser.parse_args()
    turns = list(sweeps(record("furnished_office", "walk", 1, _TURNS_S), "turn"))
    turns = [turn for turn in turns if turn.points.dtype == POINT][1:-1]
    measured = sizes(turns)
    whole = measured[0][1]
    text = table(
        ("A full turn as", "kB", "of the cloud", "ms to make"),
        [
            (name, f"{size / 1e3:.0f}", f"{100 * size / whole:.0f} %", f"{ms:.1f}" if ms else "")
            for name, size, ms in measured
        ],
    )
    print(text)
    turn_s = float(np.median(np.diff([turn.start for turn in turns]))) * 1e-9
    try:
        if given.sizes_only:
            raise OSError("left out of this run (--sizes-only)")
        with bad_link():
            link = table(
                (
                    "topic",
                    "compressed_clouds",
                    "reliability",
                    "profile",
                    "published [1/s]",
                    "arrived",
                    "late, median / p95 [s]",
                    "Mbit/s",
                ),
                list(link_rows(given.seconds, turn_s)),
            )
    except OSError as error:
        link = f"Not measured: {error}"
    print(link)
    if given.page:
        PAGE.write_text(_PAGE.format(sizes=text, link=link, seconds=given.seconds))
        print(PAGE)
    return 0


_PAGE: Final = """# Over a slow network

Written by `make bench-wifi BENCH_ARGS=--page` (as root). [On a robot](../robot.md) says what to
do about it.

## Sizes

Medians over full turns of a virtual L2 carried through a furnished office; zstd at level 1, on
one core of a PC.

{sizes}

## What arrives

Driver and listener under Fast DDS in two network namespaces, with 20 Mbit/s, 2 % loss and 30 ms
each way between them (`benchmarks/wifi_link.py`), {seconds:.0f} s for each line after the
first message, or after 40 s without one. *Published* is what a second listener gets on the robot
in the same time, and *arrived* the share of it that gets to the desk. *Late* counts from the last
point of a cloud.

{link}
"""

if __name__ == "__main__":
    sys.exit(main())
