"""The page about deskewing says what the code says."""

from __future__ import annotations

from pathlib import Path

from l2lidar_node.settings import settings_of
from l2lidar_proc.deskew.config import DeskewNodeConfig

ROOT = Path(__file__).parents[2]


def test_every_filter_and_picture_is_there() -> None:
    page = (ROOT / "docs" / "deskew.md").read_text()
    for name in next(
        s for s in settings_of(DeskewNodeConfig) if s.name == "filters_after"
    ).choices:
        assert f"`{name}`" in page
    assert (ROOT / "docs" / "deskew.png").exists()
