"""What several tests of the odometry look at."""

from __future__ import annotations

import numpy as np
import pytest

from l2lidar_node.types import Sweep
from tests.support.passing_sweeps import SPEED, posts, seen_from


@pytest.fixture(scope="session")
def passing() -> list[Sweep]:
    """Return sweeps among posts on a ground."""
    return seen_from(np.random.default_rng(1), posts, SPEED)
