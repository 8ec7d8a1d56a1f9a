import io
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from l2lidar_node.clock import ClockEvent, ClockEventKind
from l2lidar_node.recording.recording import Recording, Slewed, Stepped, Waited, events, shifted
from l2lidar_node.types import ImuSample, Sweep
from tests.l2lidar_node.driver.virtual_host import EPOCH_NS, VirtualClock, essence, live_run

ROUGH = {
    "loss": 0.01,
    "duplicate": 0.01,
    "reorder": 0.03,
    "reorder_ms": 70.0,
    "split": 0.05,
    "coalesce": 0.1,
    "bad_crc": 0.01,
    "truncate": 0.005,
    "garbage": 0.01,
    "jitter": "heavy",
    "jitter_ms": 5.0,
}
SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "periodic": {"l2_sync_mode": "periodic", "enable_latency_measure": True},
    "half turns": {"sweep_cut": "half_turn", "imu_adjust": False},
    "device stamps": {"enable_l2_time_correction": False},
    "arrival stamps": {"UseSystemTimeTS": True, "imu_adjust": False},
    "unlocked": {"publish_unlocked": True, "aggregateNframes": 0},
}
FAULTS: dict[str, dict[str, Any]] = {
    "none": {},
    "rough": ROUGH,
    "silences": {**ROUGH, "silence_at": (1.5, 2.5), "silence_s": 0.25},
    "reboot": {"reorder": 0.02, "reboot_at": (2.0,), "foreign_sync_at": (3.5,)},
    "bursts": {"burst_ms": 230.0, "burst_every_s": 0.7, "reorder": 0.02},
}


@pytest.mark.parametrize(
    ("settings", "faults"),
    [
        *((name, "rough") for name in SETTINGS),
        *(("periodic", name) for name in FAULTS if name not in ("none", "rough")),
    ],
)
def test_replay_is_the_live_run_bit_for_bit(settings: Any, faults: Any) -> None:
    seconds = 4.0 if faults in ("silences", "reboot") else 2.5
    config, live, tap = live_run(seconds, settings=SETTINGS[settings], faults=FAULTS[faults])
    replayed = list(events(Recording(tap.stream), config))
    assert any(isinstance(event, Sweep) for event in live)
    assert essence(replayed) == essence(live)


def test_a_busy_host_makes_no_difference() -> None:
    config, live, tap = live_run(
        4.0,
        settings=SETTINGS["periodic"],
        faults=FAULTS["silences"],
        busy=0.02,
    )
    assert essence(list(events(Recording(tap.stream), config))) == essence(live)


def test_commands_of_the_live_run_cut_the_same_sweeps() -> None:
    calls = [
        (1.2, lambda driver, now: driver.stop_rotation(now)),
        (1.9, lambda driver, now: driver.start_rotation(now)),
        (3.3, lambda driver, now: driver.reset_device(now)),
    ]
    config, live, tap = live_run(
        5.0, calls=calls, faults={"command_loss": 0.5, "reorder": 0.02}, seed=3
    )
    assert essence(list(events(Recording(tap.stream), config))) == essence(live)


def test_giving_up_is_recorded_only_where_it_matters() -> None:
    _, _, smooth = live_run(2.0)
    assert not [item for item in Recording(smooth.stream) if isinstance(item, Waited)]
    _, _, pulled = live_run(4.0, faults={"silence_at": (2.0,), "silence_s": 1.0})
    assert len([item for item in Recording(pulled.stream) if isinstance(item, Waited)]) == 1


def test_other_settings_decode_the_same_recording_otherwise() -> None:
    config, live, tap = live_run(3.0, settings={"imu_adjust": False})
    replayed = list(events(Recording(tap.stream), config))
    assert essence(replayed) == essence(live)
    other = live_run(0.1, settings={"imu_adjust": False, "sweep_cut": "turn"})[0]
    turns = [event for event in events(Recording(tap.stream), other) if isinstance(event, Sweep)]
    assert turns[1].packets in (49, 50)


def test_a_file_that_was_cut_off_gives_what_it_holds() -> None:
    config, live, tap = live_run(3.0)
    data = tap.stream.getvalue()
    recording = Recording(io.BytesIO(data[: len(data) * 2 // 3 + 7]))
    replayed = essence(list(events(recording, config)))
    assert recording.is_cut_off
    assert len(replayed) > 100
    whole = [item for item in essence(live) if isinstance(item, ImuSample)]
    part = [item for item in replayed if isinstance(item, ImuSample)]
    assert part == whole[: len(part)]


def test_shifted_events_move_in_time_and_in_nothing_else() -> None:
    _, live, _ = live_run(2.0)
    later = [shifted(event, 1_000) for event in live]
    for before, after in zip(live, later, strict=True):
        if isinstance(before, Sweep):
            assert (after.start, after.end) == (before.start + 1_000, before.end + 1_000)
            assert after.points is before.points
        elif isinstance(before, ImuSample):
            assert after.stamp == before.stamp + 1_000
            assert isinstance(after, tuple)
            assert isinstance(before, tuple)
            assert after[1:] == before[1:]
        else:
            assert after is before


# The last one is as far as from today to 1970, where a host without a battery starts.
@pytest.mark.parametrize("step", [-1.0, 0.05, 3600.0, -1.6e9])
def test_a_clock_that_is_set_is_noticed_at_once_and_replayed(step: float) -> None:
    config, live, tap = live_run(4.0, host_steps=((2.0, step),), settings={"imu_adjust": False})

    entries = [entry for entry in Recording(tap.stream) if isinstance(entry, Stepped)]
    assert [entry.by_ns for entry in entries] == [0, round(step * 1e9)]
    assert 0 <= entries[1].time - (EPOCH_NS + 2_000_000_000 + round(step * 1e9)) < 15_000_000
    texts = [event.text for event in live if isinstance(event, ClockEvent)]
    assert [text for text in texts if "stepped" in text] == [
        f"host clock stepped by {step:+.3f} s"
        + (f", stamps are held for {-step:.3f} s" if step < 0 else "")
    ]
    assert essence(list(events(Recording(tap.stream), config))) == essence(live)


def test_slewing_of_the_host_clock_is_told_when_it_changes_and_replayed() -> None:
    slews = [(3.0, 5.0, 500.0)]
    config, live, tap = live_run(7.0, host_slews=slews, settings={"imu_adjust": False})

    told = [entry for entry in Recording(tap.stream) if isinstance(entry, Slewed)]
    assert 5 <= len(told) < 30  # at the start, at its beginning and end; not while it goes on
    assert told[-1].by_ns == pytest.approx(1_000_000, abs=5_000)
    clock = VirtualClock((), slews)
    for entry in told:
        since = entry.time - clock.slewed(entry.time)
        assert entry.by_ns == pytest.approx(clock.slewed(since), abs=1_000)
    assert essence(list(events(Recording(tap.stream), config))) == essence(live)
    stamps = np.array([event.stamp for event in live if isinstance(event, ImuSample)])
    at = (stamps - EPOCH_NS) * 1e-9
    rate = np.diff(stamps) / 4e6 - 1.0
    assert np.abs(rate[at[1:] < 2.9]).max() < 5e-6
    assert np.median(rate[(at[1:] > 4.0) & (at[1:] < 4.9)]) == pytest.approx(500e-6, abs=20e-6)


@pytest.mark.parametrize("late", [1.0, 5.0])
def test_packets_that_stay_late_are_stamped_as_measured(late: float) -> None:
    seconds = 5.5 + late
    config, live, tap = live_run(seconds, late=[(2.0, 4.0, late)], settings={"imu_adjust": False})

    stamps = [event.stamp for event in live if isinstance(event, ImuSample)]
    assert stamps[0] < EPOCH_NS + 2_000_000_000
    assert stamps[-1] > EPOCH_NS + round((seconds - 0.1) * 1e9)
    assert all(3_990_000 < after - before < 4_010_000 for before, after in pairwise(stamps))
    kinds = [event.kind for event in live if isinstance(event, ClockEvent)]
    assert kinds == [ClockEventKind.LOCKED]
    assert essence(list(events(Recording(tap.stream), config))) == essence(live)
