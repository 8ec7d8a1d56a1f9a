"""A driver without ROS in a process of its own, which writes down what it made of every packet.

``python -m benchmarks.fault_host OUT [name=value ...]`` runs until it is interrupted, then writes
``OUT.npy`` (see :data:`NOTE`) and ``OUT.json``. Until then ``OUT.now`` says how far it is.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Final

import numpy as np
import yaml

from l2lidar_node.clock import ClockEvent
from l2lidar_node.config import DriverConfig
from l2lidar_node.driver.driver import Driver, Event, Silence
from l2lidar_node.files import write_whole
from l2lidar_node.recording.recording import Recorder
from l2lidar_node.settings import build
from l2lidar_node.transport.session import Session
from l2lidar_node.transport.udp import TransportError, UdpTransport
from l2lidar_node.types import ImuSample, Sweep
from tests.support.clock_rig import RecordingClock

NOTE: Final = np.dtype(
    [("type", "<u2"), ("seq", "<u4"), ("stamp", "<i8"), ("arrival", "<i8"), ("published", "<i8")]
)
"""One packet that came to the clock, in order: published 0 where it got no stamp."""


def main() -> int:
    """Run until SIGINT; return 1 where the socket cannot be had."""
    out = Path(sys.argv[1])
    values = dict(part.split("=", 1) for part in sys.argv[2:])
    config = build(DriverConfig, {name: yaml.safe_load(text) for name, text in values.items()})
    said: list[str] = []
    recorder = None
    if config.files.record_file:
        recorder = Recorder(Path(config.files.record_file), config.network, said.append)
    try:
        transport = UdpTransport(config.network)
    except TransportError as error:
        print(error.strerror, flush=True)
        return 1
    driver = Driver(config)
    clock = driver._clock = RecordingClock(config.clock)
    last = {ImuSample: 0, Sweep: 0}
    backwards = 0
    slowest_s = 0.0

    def handle(event: Event) -> None:
        nonlocal backwards, slowest_s
        if isinstance(event, ImuSample | Sweep):
            stamp = event.stamp if isinstance(event, ImuSample) else event.start
            backwards += stamp <= last[type(event)]
            last[type(event)] = stamp
        if isinstance(event, Sweep):
            slowest_s = max(slowest_s, (time.time_ns() - event.end) / 1e9)
        elif isinstance(event, ClockEvent):
            said.append(event.text)
        elif isinstance(event, Silence):
            said.append("silence")

    session = Session(driver, transport, handle, recorder)
    stopping = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: stopping.set())
    session.start()
    print("listening", flush=True)
    while not stopping.wait(0.2) and not session.failure:
        now = {"foreign": transport.foreign, "samples": driver.counters.samples, "said": said}
        write_whole(out.with_suffix(".now"), json.dumps(now).encode())
    session.stop()
    notes = [(kind, seq, stamp, at, answer) for kind, seq, stamp, at, _, _, answer in clock.notes]
    np.save(out.with_suffix(".npy"), np.array(notes, NOTE))
    facts = {
        "failure": repr(session.failure) if session.failure else "",
        "backwards": backwards,
        "foreign": transport.foreign,
        "kernel_drops": transport.kernel_drops,
        "slowest_s": slowest_s,
        "sweeps": driver.counters.sweeps,
        "lost": sum(counts.lost for counts in driver.counters.sequence.values()),
        "late": sum(counts.late for counts in driver.counters.sequence.values()),
        "said": said,
        "recorded_octets": recorder.octets if recorder else 0,
    }
    out.with_suffix(".json").write_text(json.dumps(facts))
    return 0


if __name__ == "__main__":
    sys.exit(main())
