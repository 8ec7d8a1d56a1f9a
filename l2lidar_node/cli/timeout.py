"""Waiting on a machine that now and then gives this program no processor, or sleeps."""

from __future__ import annotations

import time
from typing import Final

_PAUSE_S: Final = 0.3  # nobody oversleeps by that much without one
_MOMENT_S: Final = 0.2  # in which what came during a pause is taken


def rest(seconds: float) -> None:
    """Sleep; where the machine paused meanwhile, a moment longer.

    Or what came during the pause would not have been taken yet, and looks as if it were missing.
    """
    while True:
        begun = time.monotonic()
        time.sleep(seconds)
        if time.monotonic() - begun < seconds + _PAUSE_S:
            return
        seconds = _MOMENT_S


class Patience:
    """Seconds to wait for something.

    While the machine pauses nothing is heard: that counts for twice what was asked at the most.

    Parameters
    ----------
    seconds : float
    """

    def __init__(self, seconds: float) -> None:
        self._left_s = seconds

    @property
    def is_over(self) -> bool:
        """Whether the time has passed."""
        return self._left_s <= 0.0

    def pause(self, seconds: float) -> None:
        """Rest, but not beyond the end."""
        asked = max(min(seconds, self._left_s), 0.0)
        begun = time.monotonic()
        rest(asked)
        self.count(max(time.monotonic() - begun, asked), asked)

    def count(self, passed: float, asked: float) -> None:
        """Take off what a wait took that was to take so long [s]."""
        self._left_s -= min(passed, 2.0 * asked)
