"""A program in a terminal of its own, and somebody who types there."""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from types import TracebackType

LIMIT_S = 60.0


class Terminal:
    """A Python module in a pseudo terminal, for as long as a ``with`` statement lasts.

    Parameters
    ----------
    module : str
    arguments : str
    """

    def __init__(self, module: str, *arguments: str) -> None:
        self._ours, theirs = pty.openpty()
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
            env={**os.environ, "TERM": "xterm", "COLUMNS": "200"},
        )
        os.close(theirs)
        self._unread = ""
        self.said = ""

    def __enter__(self) -> Terminal:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        os.close(self._ours)

    def wait_for(self, text: str) -> None:
        """Read until a text has come."""
        deadline = time.monotonic() + LIMIT_S
        while text not in self._unread:
            assert time.monotonic() < deadline, f"'{text}' did not come, only:\n{self.said}"
            assert self._read(1.0), f"'{text}' did not come before the end:\n{self.said}"
        self._unread = self._unread.partition(text)[2]

    def type(self, text: str) -> None:
        """Type."""
        os.write(self._ours, text.encode())

    def interrupt(self) -> None:
        """Do what the terminal does when Ctrl-C is typed."""
        self._process.send_signal(signal.SIGINT)

    def exit_code(self) -> int:
        """Read to the end; return the exit code."""
        deadline = time.monotonic() + LIMIT_S
        while self._read(1.0):
            assert time.monotonic() < deadline, f"it did not end:\n{self.said}"
        return self._process.wait(LIMIT_S)

    def _read(self, seconds: float) -> bool:
        """Read what there is; return False at the end."""
        if not select.select([self._ours], [], [], seconds)[0]:
            return self._process.poll() is None
        try:
            data = os.read(self._ours, 65536).decode(errors="replace")
        except OSError:  # the other end is closed
            return False
        text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", data)
        self.said += text
        self._unread += text
        return bool(data)
