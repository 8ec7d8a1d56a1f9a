"""Time limits in which the pauses of this machine do not count."""

from __future__ import annotations

import time


class Patience:
    """Seconds to wait for something.

    A machine that sleeps, or gives this program no processor for a while, hears nothing meanwhile:
    so a pause counts for twice what was asked for at the most.

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
        """Sleep, but not beyond the end."""
        asked = max(min(seconds, self._left_s), 0.0)
        begun = time.monotonic()
        time.sleep(asked)
        self._left_s -= max(min(time.monotonic() - begun, 2.0 * asked), asked)
