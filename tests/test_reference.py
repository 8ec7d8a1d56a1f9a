"""What is written down follows from the settings and is up to date."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from l2lidar_node.settings import build
from scripts.make_reference import FILES, ROOT, outputs


@pytest.mark.parametrize("path", outputs(), ids=lambda path: path.name)
def test_a_file_that_follows_from_the_settings_is_up_to_date(path: Any) -> None:
    assert path.read_text() == outputs()[path], "run `python -m scripts.make_reference`"


@pytest.mark.parametrize("name", FILES)
def test_a_shipped_parameter_file_holds_known_and_valid_values(name: Any) -> None:
    content = yaml.safe_load((ROOT / "config" / name).read_text())
    assert set(content) == set(FILES[name])
    for node, group in FILES[name].items():
        build(group, content[node]["ros__parameters"])
