"""Gathers what is known about a device: who it is, how it is calibrated and how it scans."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from l2lidar_node.driver.driver import Driver
from l2lidar_node.protocol import wire


@dataclass(frozen=True, slots=True)
class Metadata:
    """Facts about one device; None or empty where it has not said so yet.

    Attributes
    ----------
    hardware, firmware, name, date : str
    product : str
        What stands behind the date in the version packet; many units leave it empty.
    work_mode : int or None
        Bits of :class:`wire.WorkMode`.
    work_mode_names : list of str
    calibration : dict
        What the unit reports; names and units as in :data:`wire.CALIBRATION`.
    calibration_crc : str
        CRC-32 of the block that the unit reports, eight hexadecimal digits: no two units have the
        same.
    calibration_used : dict
        What its points are made with.
    calibration_source : dict
        Where each entry of that is from: ``unit``, ``parameter``, or the path of a file.
    calibration_file : str
        The file that the settings name; it is used only if ``calibration_matches``.
    calibration_matches : bool or None
        Whether the file was made for what the unit reports; None without a file or a packet.
    slots : int or None
        Slots in a packet.
    angle_min_rad, angle_increment_rad : float or None
        Of the slots along the arc.
    time_increment_s : float or None
        Between slots.
    range_min_m, range_max_m : float or None
    imu_position_m : tuple
        In the cloud frame.
    cloud_frame, imu_frame : str
    """

    hardware: str
    firmware: str
    name: str
    date: str
    product: str
    work_mode: int | None
    work_mode_names: list[str]
    calibration: dict[str, float]
    calibration_crc: str
    calibration_used: dict[str, float]
    calibration_source: dict[str, str]
    calibration_file: str
    calibration_matches: bool | None
    slots: int | None
    angle_min_rad: float | None
    angle_increment_rad: float | None
    time_increment_s: float | None
    range_min_m: float | None
    range_max_m: float | None
    imu_position_m: tuple[float, float, float]
    cloud_frame: str
    imu_frame: str


def metadata(driver: Driver) -> Metadata:
    """Return what a driver knows about its device."""
    version, parameters = driver.version, driver.parameters
    mode = None if parameters is None else parameters.work_mode
    packet = None
    if driver.last_points is not None:
        layout = wire.POINTS_3D_PAYLOAD if driver.config.sweep.frame3d else wire.POINTS_2D_PAYLOAD
        packet = np.frombuffer(driver.last_points, layout)[0]

    block = None if packet is None else packet["calibration"].tobytes()
    file = driver.blocks.file

    def told(name: str) -> float | None:
        return None if packet is None else float(packet[name])

    return Metadata(
        hardware=version.hardware if version else "",
        firmware=version.firmware if version else "",
        name=version.name if version else "",
        date=version.date if version else "",
        product=version.reserve if version else "",
        work_mode=mode,
        work_mode_names=[]
        if mode is None
        else [bit.name or "" for bit in wire.WorkMode if bit & mode],
        calibration={}
        if packet is None
        else {name: float(packet["calibration"][name]) for name in wire.CALIBRATION.names or ()},
        calibration_crc="" if block is None else f"{zlib.crc32(block):08x}",
        calibration_used={} if block is None else driver.blocks.values(block),
        calibration_source={} if block is None else driver.blocks.sources(block),
        calibration_file=driver.config.files.calibration_file,
        calibration_matches=None if file is None or block is None else file.matches(block),
        slots=None if packet is None else int(packet["point_num"]),
        angle_min_rad=told("angle_min"),
        angle_increment_rad=told("angle_increment"),
        time_increment_s=told("time_increment"),
        range_min_m=told("range_min"),
        range_max_m=told("range_max"),
        imu_position_m=wire.IMU_POSITION_M,
        cloud_frame=driver.config.frames.cloud,
        imu_frame=driver.config.frames.imu,
    )
