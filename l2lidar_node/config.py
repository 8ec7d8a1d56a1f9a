"""Settings of the driver, each declared once: name, default, unit, range and meaning.

Settings that upstream has keep its names and defaults, so its YAML file works unchanged.
"""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass, field
from typing import Final

from l2lidar_node.clouds import LAYOUTS, RINGS
from l2lidar_node.protocol import wire
from l2lidar_node.settings import FRAME, TOPIC, SettingError, setting

MIN_CLOCK_RATIO: Final = 0.5
MAX_CLOCK_RATIO: Final = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkConfig:
    """Addresses of the device and of this host."""

    l2_ip: str = setting(
        wire.LIDAR_IP, "IPv4 address of the L2; datagrams from other senders are dropped"
    )
    l2_port: int = setting(wire.LIDAR_PORT, "UDP port of the L2", lo=1, hi=65535)
    host_ip: str = setting(
        wire.HOST_IP, "IPv4 address of this host to listen on; 0.0.0.0 listens on all"
    )
    host_port: int = setting(wire.HOST_PORT, "UDP port to listen on", lo=1, hi=65535)
    serial_port: str = setting(
        "", "serial device of the L2, used instead of the network, for example /dev/ttyACM0"
    )
    receive_buffer_bytes: int = setting(
        4_194_304,
        "size of the socket receive buffer to request from the kernel",
        unit="B",
        lo=4096,
        hi=1 << 30,
    )
    receive_interval_ms: int = setting(
        4,
        "longest time that an IMU sample waits in the socket, so that several datagrams are read "
        "at once; the kernel stamps arrivals, so this costs only latency; 0 reads each datagram "
        "as it arrives",
        unit="ms",
        lo=0,
        hi=100,
    )

    @property
    def where(self) -> str:
        """The L2's serial device, or its address where none is set."""
        return self.serial_port or self.l2_ip

    def __post_init__(self) -> None:
        """Check the addresses."""
        for name in ("l2_ip", "host_ip"):
            value = getattr(self, name)
            try:
                ipaddress.IPv4Address(value)
            except ipaddress.AddressValueError as error:
                raise SettingError(
                    f"parameter '{name}': {value!r} is not an IPv4 address ({error}), "
                    "expected four numbers such as 192.168.1.62"
                ) from None


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockConfig:
    """Conversion of device stamps to host stamps."""

    enable_l2_time_correction: bool = setting(True, "correct the scale of device stamps")
    enable_l2_host_sync: bool = setting(
        True, "set the clock of the device from the clock of the host"
    )
    l2_sync_rate_ms: int = setting(
        50, "interval between host syncs, with l2_sync_mode periodic", unit="ms", lo=10, hi=600_000
    )
    time_scale_num: int = setting(
        2, "numerator of the initial clock ratio", name="timeScaleNum", lo=1, hi=10**9
    )
    time_scale_denom: int = setting(
        1,
        "denominator of the initial clock ratio",
        name="timeScaleDenom",
        lo=1,
        hi=10**9,
    )
    use_system_time: bool = setting(
        False,
        "stamp with the arrival time instead of the device time",
        name="UseSystemTimeTS",
        live=True,
    )
    enable_latency_measure: bool = setting(
        False, "measure the round trip once a second and subtract half of it from every stamp"
    )
    l2_sync_mode: str = setting(
        "once",
        "with enable_l2_host_sync: sync the device once, or every l2_sync_rate_ms",
        choices=("once", "periodic"),
    )
    publish_unlocked: bool = setting(
        False, "publish with arrival times until the clock has locked, instead of nothing"
    )

    def __post_init__(self) -> None:
        """Check the first guess."""
        guess = self.time_scale_num / self.time_scale_denom
        if not MIN_CLOCK_RATIO <= guess <= MAX_CLOCK_RATIO:
            raise SettingError(
                f"parameter 'timeScaleNum': {self.time_scale_num} is out of range, expected "
                f"{MIN_CLOCK_RATIO:g} to {MAX_CLOCK_RATIO:g} times timeScaleDenom "
                f"({self.time_scale_denom})"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepConfig:
    """Conversion of packets to clouds."""

    frame3d: bool = setting(True, "publish 3D packets; false publishes 2D packets")
    packets: int = setting(
        38,
        "packets per cloud with sweep_cut packets; 0 publishes every packet",
        name="aggregateNframes",
        lo=0,
        hi=4000,
        live=True,
    )
    cut: str = setting(
        "packets",
        "what ends a cloud: a number of packets, a full or half turn of the head (fragments are "
        "dropped), or a duration; 2D packets carry no head angle and are cut by duration",
        name="sweep_cut",
        choices=("packets", "turn", "half_turn", "duration"),
        live=True,
    )
    duration_ms: int = setting(
        230,
        "length of a cloud with sweep_cut duration",
        name="sweep_duration_ms",
        unit="ms",
        lo=5,
        hi=20_000,
        live=True,
    )
    override_range_calibration: bool = setting(
        False,
        "use calRangeScale and calRangeBias instead of the values the unit reports",
        name="EnableCalRangeOVR",
        live=True,
    )
    range_scale: float = setting(
        0.000978,
        "range scale to use with EnableCalRangeOVR",
        name="calRangeScale",
        unit="m/count",
        lo=0.00025,
        hi=0.002,
        live=True,
    )
    range_bias: float = setting(
        -365.625,
        "range bias to use with EnableCalRangeOVR",
        name="calRangeBias",
        unit="counts",
        lo=-1000.0,
        hi=0.0,
        live=True,
    )
    override_angle_calibration: bool = setting(
        False,
        "use calAlphaAngleBias, calBetaAngle, calXiAngle, calThetaAngleBias and calBAxisDist "
        "instead of the values the unit reports; they win over calibration_file",
        name="EnableCalAngleOVR",
        live=True,
    )
    alpha_angle_bias: float = setting(
        0.032398,
        "mirror angle of the first slot, with EnableCalAngleOVR",
        name="calAlphaAngleBias",
        unit="rad",
        lo=-0.2,
        hi=0.2,
        live=True,
    )
    beta_angle: float = setting(
        0.003818,
        "tilt of the mirror's axis, with EnableCalAngleOVR",
        name="calBetaAngle",
        unit="rad",
        lo=-0.2,
        hi=0.2,
        live=True,
    )
    xi_angle: float = setting(
        0.002945,
        "angle of the beam off the mirror's plane, with EnableCalAngleOVR",
        name="calXiAngle",
        unit="rad",
        lo=-0.2,
        hi=0.2,
        live=True,
    )
    theta_angle_bias: float = setting(
        2.0769,
        "head angle of the zero mark, with EnableCalAngleOVR",
        name="calThetaAngleBias",
        unit="rad",
        lo=-6.3,
        hi=6.3,
        live=True,
    )
    b_axis_dist: float = setting(
        0.006586,
        "distance between the axes of head and mirror, with EnableCalAngleOVR",
        name="calBAxisDist",
        unit="m",
        lo=-0.05,
        hi=0.05,
        live=True,
    )
    range_min: float = setting(
        0.0, "shortest range that is published", unit="m", lo=0.0, hi=100.0, live=True
    )
    range_max: float = setting(
        100.0, "longest range that is published", unit="m", lo=0.0, hi=100.0, live=True
    )
    reorder_window: int = setting(
        8, "packets held back while an earlier one is missing", unit="packets", lo=0, hi=256
    )

    def __post_init__(self) -> None:
        """Check the two limits against each other."""
        if self.range_min >= self.range_max:
            raise SettingError(
                f"parameter 'range_min': {self.range_min} is out of range, "
                f"expected less than range_max ({self.range_max})"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuConfig:
    """The IMU topic, and the use of the onboard orientation."""

    enable_publishing: bool = setting(False, "publish IMU data", name="enable_IMU_publishing")
    publish_every: int = setting(
        1,
        "publish only every n-th IMU sample, for consumers that cannot handle 250 a second; "
        "deskew and odometry need all",
        name="imu_publish_every",
        lo=1,
        hi=250,
        live=True,
    )
    adjust: bool = setting(
        True,
        "rotate points into a level frame with the onboard orientation",
        name="imu_adjust",
        live=True,
    )
    roll_pitch_only: bool = setting(
        True, "use roll and pitch only for imu_adjust", name="imuRollPitchOnly", live=True
    )
    accel_x_covar: float = setting(
        0.01, "variance of the acceleration along x", unit="(m/s^2)^2", lo=0.0, hi=1e6
    )
    accel_y_covar: float = setting(
        0.01, "variance of the acceleration along y", unit="(m/s^2)^2", lo=0.0, hi=1e6
    )
    accel_z_covar: float = setting(
        0.01, "variance of the acceleration along z", unit="(m/s^2)^2", lo=0.0, hi=1e6
    )
    gyro_x_covar: float = setting(
        2.5e-5, "variance of the angular rate about x", unit="(rad/s)^2", lo=0.0, hi=1e6
    )
    gyro_y_covar: float = setting(
        2.5e-5, "variance of the angular rate about y", unit="(rad/s)^2", lo=0.0, hi=1e6
    )
    gyro_z_covar: float = setting(
        2e-7, "variance of the angular rate about z", unit="(rad/s)^2", lo=0.0, hi=1e6
    )
    roll_covar: float = setting(4.9e-9, "variance of roll", unit="rad^2", lo=0.0, hi=1e6)
    pitch_covar: float = setting(4.9e-9, "variance of pitch", unit="rad^2", lo=0.0, hi=1e6)
    yaw_covar: float = setting(10.0, "variance of yaw", unit="rad^2", lo=0.0, hi=1e6)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameConfig:
    """Frame names and the one transform the driver owns."""

    l2_name: str = setting("l2lidar", "prefix of the default frame names", form=FRAME)
    cloud_frame: str = setting("", "frame of the clouds; empty means <l2_name>_link", form=FRAME)
    publish_tf: bool = setting(True, "publish the static transform from cloud to IMU frame")

    @property
    def cloud(self) -> str:
        """Name of the cloud frame."""
        return self.cloud_frame or f"{self.l2_name}_link"

    @property
    def imu(self) -> str:
        """Name of the IMU frame: the cloud frame's, ``_link`` replaced by ``_imu``."""
        return f"{self.cloud.removesuffix('_link')}_imu"


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicConfig:
    """Names and QoS of the topics."""

    point_cloud_topic_id: str = setting("/points", "topic for point clouds", form=TOPIC)
    imu_topic_id: str = setting("/imu/data", "topic for IMU samples", form=TOPIC)
    publish_packets: bool = setting(
        False,
        "publish the raw packets of the L2, for bags that replay bit for bit",
    )
    packet_topic_id: str = setting(
        "~/packets", "topic for raw packets, with publish_packets", form=TOPIC
    )
    compressed_clouds: str = setting(
        "none",
        "also publish clouds on <point_cloud_topic_id>/zstd for point_cloud_transport, while "
        "there is a subscriber: all fields, or x, y, z in steps of 1 mm and intensity",
        choices=("none", "lossless", "millimeter"),
    )
    zstd_level: int = setting(1, "compression level of compressed_clouds", lo=1, hi=19)
    qos_reliability: str = setting(
        "best_effort",
        "QoS reliability of clouds and IMU samples; every subscriber can receive reliable",
        choices=("best_effort", "reliable"),
    )
    point_layout: str = setting("native", "fields of a published point", choices=tuple(LAYOUTS))
    ring_count: int = setting(
        RINGS,
        "rings from the horizon to the zenith, in layouts with rings; LIO-SAM's N_SCAN",
        lo=16,
        hi=RINGS,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchdogConfig:
    """Reaction to a silent device."""

    timeout_ms: int = setting(
        35_000,
        "longest silence of the device before watchdog_action",
        name="watchdog_timeout_ms",
        unit="ms",
        lo=100,
        hi=3_600_000,
    )
    action: str = setting(
        "shutdown",
        "on a silent device: shut the node down, or report it and wait",
        name="watchdog_action",
        choices=("shutdown", "wait"),
    )
    standby_on_powerup_enabled: bool = setting(
        False, "start the watchdog with the first packet; for a device that powers up in standby"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FileConfig:
    """Captures to write and to read, and the calibration of the unit."""

    record_file: str = setting("", "capture file to write; a number is added if the file exists")
    replay_file: str = setting(
        "", "capture, or bag with raw packets, to replay instead of listening to an L2"
    )
    calibration_file: str = setting(
        "",
        "calibration of the unit, written by l2lidar calibrate; applies only to packets whose "
        "reported calibration block equals that in the file",
    )
    replay_rate: float = setting(
        1.0,
        "replay speed; 0 is as fast as possible; pauses of more than a minute last a minute",
        lo=0.0,
        hi=1000.0,
    )
    replay_loop: bool = setting(False, "start over at the end, with stamps that continue")
    replay_clock: bool = setting(
        True, "publish the recorded time on /clock during a replay, for use_sim_time"
    )

    def __post_init__(self) -> None:
        """Check that a replay is not recorded."""
        if self.record_file and self.replay_file:
            raise SettingError(
                f"parameter 'record_file': {self.record_file!r} cannot be combined with "
                "replay_file; set only one of them"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class LifecycleConfig:
    """Who configures and activates a node."""

    autostart: bool = setting(
        True,
        "configure and activate the node when it starts; false waits for a lifecycle manager, or "
        "for ros2 lifecycle set",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class DriverConfig:
    """All settings of the driver."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    clock: ClockConfig = field(default_factory=ClockConfig)
    sweep: SweepConfig = field(default_factory=SweepConfig)
    imu: ImuConfig = field(default_factory=ImuConfig)
    frames: FrameConfig = field(default_factory=FrameConfig)
    topics: TopicConfig = field(default_factory=TopicConfig)
    watchdog: WatchdogConfig = field(default_factory=WatchdogConfig)
    files: FileConfig = field(default_factory=FileConfig)
    lifecycle: LifecycleConfig = field(default_factory=LifecycleConfig)

    def __post_init__(self) -> None:
        """Check settings of several groups against each other."""
        if self.topics.publish_packets and self.files.replay_file:
            raise SettingError(
                "parameter 'publish_packets': true cannot be combined with replay_file "
                f"({self.files.replay_file!r}), which has no device; set only one of them"
            )
        self._check_length()

    def _check_length(self) -> None:
        """Check that the times of a sweep's points fit into the point layout."""
        longest = LAYOUTS[self.topics.point_layout].longest_ns
        sweep = self.sweep
        if longest is None or (sweep.frame3d and sweep.cut in ("turn", "half_turn")):
            return
        period = round((wire.MIRROR_PERIOD_S if sweep.frame3d else wire.PERIOD_2D_S) * 1e9)
        name, value, most = "aggregateNframes", sweep.packets, longest // period
        if sweep.cut != "packets":  # the last packet begins within the duration
            name, value = "sweep_duration_ms", sweep.duration_ms
            most = (longest - period) // 1_000_000
        if value > most:
            layout = self.topics.point_layout
            raise SettingError(
                f"parameter '{name}': {value} is out of range, expected at most {most} with "
                f"point_layout {layout}, whose times end at {longest / 1e9:.2f} s"
            )
