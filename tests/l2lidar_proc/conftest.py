"""One walk through an office for all tests of the back end: rendered and mapped once."""

from __future__ import annotations

import pytest

from l2lidar_node.emulator.world.mapping_scenes import furnished_office
from l2lidar_proc.slam.config import SlamConfig
from l2lidar_proc.slam.slam import Slam
from tests.support.mapping_runs import MappingRun, drifting, scan, walk

LAPS = 1.35
STEP = 0.5


@pytest.fixture(scope="session")
def office() -> MappingRun:
    """Return a lap and a third through the furnished office."""
    scene = furnished_office()
    return scan(scene, walk(scene, LAPS, step=STEP), step=STEP, rays=4000)


@pytest.fixture(scope="session")
def mapped(office: MappingRun) -> Slam:
    """Return the map of that walk with 0.5 % of drift."""
    pytest.importorskip("gtsam")
    slam = Slam(SlamConfig())
    for sweep in office.sweeps(drifting(office.truth, 0.5, 1, STEP)):
        slam.add(sweep)
    slam.finish()
    return slam
