"""The device line through syncs and silences: two even streams whose true places are known."""

from __future__ import annotations

from l2lidar_node.clock.device_clock_model import DeviceClockModel, Step
from l2lidar_node.types import DeviceNs, HostNs, Stream

MS = 1_000_000
US = 1_000
IMU_NS = 4 * MS
POINTS_NS = 4_600 * US
EPOCH = 1_700_000_000_000 * MS
DELAY = 300 * US


class Device:
    """A device whose clock agrees with the host's rate, and the model that follows it."""

    def __init__(self) -> None:
        self.model = DeviceClockModel(1.0)
        self.offset = 0  # of the device's clock

    def sync(self, offset: int, true: int) -> None:
        """Set the device's clock by so much, at a time."""
        self.offset = offset
        self.model.synced(HostNs(true + offset), HostNs(EPOCH + true))

    def packet(self, stream: Stream, number: int, late: int = 0, slip: int = 0) -> int | None:
        """Send a packet; return its place on the line, less its true time."""
        period = IMU_NS if stream is Stream.IMU else POINTS_NS
        begin = 0 if stream is Stream.IMU else 1_500 * US
        true = number * period + begin + slip
        stamp, arrival = DeviceNs(true + self.offset), HostNs(EPOCH + true + DELAY + late)
        place = self.model.place(stream, number, stamp, arrival)
        return None if place is None else place - true

    def run(self, imu: range, points: range) -> set[int | None]:
        """Send packets of both streams in the order of their times; return what came of them."""
        numbers = [(n * IMU_NS, Stream.IMU, n) for n in imu]
        numbers += [(n * POINTS_NS + 1_500 * US, Stream.POINTS, n) for n in points]
        return {self.packet(stream, n) for _, stream, n in sorted(numbers)}


def test_both_streams_of_an_even_device_are_on_the_line_at_their_times() -> None:
    device = Device()
    assert device.run(range(60), range(52)) == {None, 0}
    assert device.run(range(60, 100), range(52, 86)) == {0}
    assert not device.model.steps
    assert device.model.epochs == device.model.restarts == 0


def test_a_mirror_that_slips_while_the_clock_is_set_stays_on_the_line() -> None:
    """The points come first and their slip is taken for a part of the step; then the IMU comes."""
    device = Device()
    device.run(range(50), range(44))
    device.sync(50_000 * MS, 44 * POINTS_NS + 1_400 * US)
    assert device.run(range(51, 100), range(44, 87)) == {0}
    device.sync(90_000 * MS, 87 * POINTS_NS + 1_400 * US)
    slip = 400 * US
    assert device.packet(Stream.POINTS, 87, slip=slip) == -slip  # where it was expected
    assert not device.model.is_firm
    assert device.packet(Stream.IMU, 101) == 0
    for number in range(88, 120):
        assert device.packet(Stream.POINTS, number, slip=slip) == 0
        assert device.model.is_firm
        assert device.packet(Stream.IMU, 101 + round((number - 87) * 1.15)) == 0
    assert not device.model.steps
    assert (device.model.epochs, device.model.restarts) == (2, 0)


def test_a_stream_that_fits_nowhere_ends_the_line_only_when_the_other_is_silent() -> None:
    device = Device()
    device.run(range(100), range(0))
    device.offset = -3_000 * MS  # no path makes its packets 3 s late
    for number in range(87, 87 + 217):  # for a second after the last packet of the IMU
        assert device.packet(Stream.POINTS, number) is None
        assert not device.model.steps
    for number in range(304, 304 + 9):
        assert device.packet(Stream.POINTS, number) is None
    ((step, size),) = device.model.steps
    assert step is Step.LOST
    assert -3_000 * MS < size < -1_000 * MS
    assert device.model.restarts == 1
    places = {device.packet(Stream.POINTS, number) for number in range(313, 340)}
    assert places == {None, device.offset}  # the only stream begins the new line
