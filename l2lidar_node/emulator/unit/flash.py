"""What the unit remembers without power: addresses, work mode and parameters."""

from __future__ import annotations

import ipaddress
import json
from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

import numpy as np

from l2lidar_node.emulator.config import AddressConfig, IdentityConfig
from l2lidar_node.protocol import wire
from l2lidar_node.settings import SettingError


class Network(NamedTuple):
    """Addresses in dotted order, as command 108 carries them."""

    lidar_ip: str
    user_ip: str
    gateway: str
    subnet_mask: str
    lidar_port: int
    user_port: int


@dataclass(frozen=True, slots=True)
class Flash:
    """Stored settings; those that need a restart come into force at the next boot.

    Attributes
    ----------
    network : Network
    mac : str
        Hardware address, colon separated.
    work_mode : int
        Bits of :class:`wire.WorkMode`.
    auto_standby : int
        Value of the last auto-standby command; without effect.
    parameters : str
        Hexadecimal :data:`wire.PARAMETERS_PAYLOAD`, empty for the factory's; its work mode is
        ignored.
    """

    network: Network
    mac: str
    work_mode: int = 0
    auto_standby: int = 0
    parameters: str = ""

    @classmethod
    def factory(cls, addresses: AddressConfig, identity: IdentityConfig) -> Flash:
        """Return the settings of a new unit.

        Raises
        ------
        SettingError
            If an address is not one; the message names the setting.
        """
        for name, value in (("lidar_ip", addresses.lidar_ip), ("host", addresses.host)):
            try:
                ipaddress.IPv4Address(value)
            except ValueError:
                raise SettingError(
                    f"parameter '{name}': {value!r} is not an IPv4 address; "
                    "expected one such as 192.168.1.62"
                ) from None
        gateway = addresses.lidar_ip.rsplit(".", 1)[0] + ".1"
        network = Network(
            addresses.lidar_ip,
            addresses.host,
            gateway,
            "255.255.255.0",
            addresses.lidar_port,
            addresses.host_port,
        )
        return cls(network, mac_text(mac_bytes(identity.mac)), identity.work_mode)

    def to_json(self) -> str:
        """Return a text that :meth:`from_json` reads."""
        facts = asdict(self)
        facts["network"] = self.network._asdict()
        return json.dumps(facts, indent=2) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Flash:
        """Return the settings a text states.

        Raises
        ------
        ValueError
            If the text is not one made by :meth:`to_json`.
        """
        try:
            facts = json.loads(text)
            network = Network(**facts.pop("network"))
            flash = cls(network=network, **facts)
            network_payload(network)
            mac_bytes(flash.mac)
            parameters_payload(flash)
            np.array([flash.work_mode, flash.auto_standby], dtype=np.uint32)
        except (TypeError, KeyError, AttributeError, OverflowError, ValueError) as error:
            raise ValueError(f"no stored settings of a virtual L2: {error}") from None
        return flash

    def with_network(self, payload: bytes) -> Flash:
        """Return the settings with a network payload stored."""
        row = np.frombuffer(payload, wire.NETWORK_PAYLOAD)[0]
        lidar_ip, user_ip, gateway, mask = (
            str(ipaddress.IPv4Address(row[name].tobytes()))
            for name in ("lidar_ip", "user_ip", "gateway", "subnet_mask")
        )
        ports = int(row["lidar_port"]), int(row["user_port"])
        return replace(self, network=Network(lidar_ip, user_ip, gateway, mask, *ports))


def network_payload(network: Network) -> bytes:
    """Return the payload of command 108 for these addresses."""
    addresses = b"".join(ipaddress.IPv4Address(text).packed for text in network[:4])
    ports = np.array([network.lidar_port, network.user_port], dtype="<u2")
    return addresses + ports.tobytes()


def mac_bytes(text: str) -> bytes:
    """Return the six bytes of a hardware address.

    Raises
    ------
    SettingError
        If the text is not six hexadecimal pairs.
    """
    try:
        raw = bytes.fromhex(text.replace(":", "").replace("-", ""))
    except ValueError:
        raw = b""
    if len(raw) != 6:
        raise SettingError(
            f"parameter 'mac': {text!r} is not a MAC address; "
            "expected one such as 4c:32:01:00:00:62"
        )
    return raw


def mac_text(raw: bytes) -> str:
    """Return six bytes as a colon separated hardware address."""
    return ":".join(f"{byte:02x}" for byte in raw)


def parameters_payload(flash: Flash) -> bytes:
    """Return the payload of packet 2001: stored parameters and the stored work mode."""
    row = np.zeros(1, wire.PARAMETERS_PAYLOAD)
    if flash.parameters:
        row = np.frombuffer(bytes.fromhex(flash.parameters), wire.PARAMETERS_PAYLOAD).copy()
    else:
        row["range_max"] = RANGE_MAX_M
        row["range_min"] = RANGE_MIN_M
        for name in (
            "calibration_3d",
            "calibration_3d_wide",
            "calibration_2d",
            "calibration_2d_wide",
        ):
            row[name] = CALIBRATION
    row["work_mode"] = flash.work_mode
    return row.tobytes()


RANGE_MIN_M = 0.05
RANGE_MAX_M = 50.0
CALIBRATION = (0.0445, 0.006586, 2.0769, 0.032398, 0.003818, 0.002945, -365.625, 0.000978)
"""Calibration block of a published unit, in the order of :data:`wire.CALIBRATION`."""
