"""States of the back end."""

from __future__ import annotations

from enum import Enum


class SlamState(Enum):
    """Whether the place in the map is known; the value is for people."""

    SEARCHING = "the place in the map is not known: it is searched for"
    TENTATIVE = "a place fits: waiting for further looks to agree"
    LOCALIZED = "the place in the map is known"
    DEAD_RECKONING = "nothing has confirmed the place lately: it is carried on by the odometry"
    LOST = "the place in the map is lost: the last one known is held"
