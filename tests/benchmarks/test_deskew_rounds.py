"""Real scans of a fast-turning sensor come out near their reference."""

from __future__ import annotations

import pytest

from benchmarks import deskew_rounds


@pytest.mark.skipif(not deskew_rounds.FOLDER.exists(), reason="the recordings are not here")
def test_newer_college() -> None:
    ((name, before, after, bound),) = deskew_rounds.newer_college((1,))
    assert before > 10 * bound, name
    assert after < bound, name
