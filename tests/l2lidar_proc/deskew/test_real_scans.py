"""Real scans of a fast-turning sensor come out near their reference."""

from __future__ import annotations

import pytest

from benchmarks import deskew_real


@pytest.mark.skipif(not deskew_real.FOLDER.exists(), reason="the recordings are not here")
def test_newer_college() -> None:
    ((name, before, after, bound),) = deskew_real.newer_college((1,))
    assert before > 10 * bound, name
    assert after < bound, name
