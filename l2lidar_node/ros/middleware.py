"""Gives Fast DDS room for more than one cloud, where nobody has configured it otherwise.

Fast DDS hands messages to subscribers on the same host through 512 kB of shared memory. A cloud
takes 365 kB of it until every subscriber has read it: if one is held up for an instant, the next
cloud and all IMU samples meanwhile find no room and are lost, however deep the queues are.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

PROFILE: Final = Path(__file__).with_name("fastdds.xml")
_FILES: Final = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
_TRANSPORTS: Final = "FASTDDS_BUILTIN_TRANSPORTS"


def make_room() -> None:
    """Have Fast DDS use :data:`PROFILE`; must come before rclpy is initialised.

    Where a profile or transports are named in the environment, or a file that Fast DDS looks for
    lies in the working directory, those count.
    """
    is_configured = Path("DEFAULT_FASTRTPS_PROFILES.xml").exists()
    if is_configured or any(os.environ.get(name) for name in (*_FILES, _TRANSPORTS)):
        return
    for name in _FILES:  # one is the older versions', Jazzy's among them
        os.environ[name] = str(PROFILE)
