"""A setting is declared once; checks, changes and the table follow from that."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

import pytest
from hypothesis import given, strategies as st

from l2lidar_node.settings import (
    SettingError,
    build,
    change,
    markdown_table,
    setting,
    settings_of,
    values_of,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Inner:
    rate_hz: float = setting(10.0, "how often", unit="Hz", lo=0.5, hi=100.0, live=True)
    mode: str = setting("fast", "how", choices=("fast", "slow"))
    low: int = setting(1, "lower end", lo=0)
    high: int = setting(5, "upper end", hi=1 << 30)

    def __post_init__(self) -> None:
        if self.low > self.high:
            raise SettingError(f"parameter 'low': {self.low} is above high ({self.high})")


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    inner: Inner = field(default_factory=Inner)
    is_on: bool = setting(True, "whether", name="isOn", live=True)
    name: str = setting("", "a name")
    frames: tuple[str, ...] = setting(("a", "b"), "some names")
    weights: tuple[float, ...] = setting((1.0,), "some numbers", lo=0.0, hi=2.0, unit="kg")


NAMES = ["rate_hz", "mode", "low", "high", "isOn", "name", "frames", "weights"]


def test_settings_come_in_order_of_declaration_nested_ones_in_place() -> None:
    assert [item.name for item in settings_of(Group)] == NAMES


def test_a_setting_carries_what_was_declared() -> None:
    rate, *_, is_on, _, frames, weights = settings_of(Group)
    assert (rate.name, rate.field, rate.type, rate.default) == ("rate_hz", "rate_hz", float, 10.0)
    assert (rate.lo, rate.hi, rate.unit, rate.live, rate.item) == (0.5, 100.0, "Hz", True, None)
    assert rate.range_text == "0.5 to 100 Hz"
    assert (is_on.name, is_on.field, is_on.type) == ("isOn", "is_on", bool)
    assert (frames.type, frames.item) == (tuple, str)
    assert (weights.type, weights.item) == (tuple, float)


def test_range_texts() -> None:
    texts = {item.name: item.range_text for item in settings_of(Group)}
    assert texts["mode"] == "'fast', 'slow'"
    assert texts["low"] == "0 to unbounded"
    assert texts["high"] == "unbounded to 1073741824"
    assert texts["name"] == ""


def test_where_anything_goes_the_unit_is_told() -> None:
    @dataclass(frozen=True)
    class Angles:
        tilt: float = setting(0.0, "x", unit="deg")
        bounded: float = setting(0.0, "x", lo=0.0, hi=1.0, unit="deg")
        name: str = setting("", "x")

    texts = [item.range_or_unit for item in settings_of(Angles)]
    assert texts == ["in deg", "0 to 1 deg", ""]


def test_defaults() -> None:
    assert build(Group, {}) == Group()


def test_values_of_both_levels() -> None:
    group = build(Group, {"rate_hz": 2, "isOn": False, "frames": ["x"], "weights": [1, 2.0]})
    assert group.inner.rate_hz == 2.0
    assert isinstance(group.inner.rate_hz, float)
    assert group.is_on is False
    assert group.frames == ("x",)
    assert group.weights == (1.0, 2.0)
    assert all(isinstance(weight, float) for weight in group.weights)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("rate_hz", "fast", "'fast' is of type str, expected float"),
        ("rate_hz", True, "True is of type bool, expected float"),
        ("rate_hz", None, "None is of type NoneType, expected float"),
        ("rate_hz", 0.4, "0.4 is out of range, expected 0.5 to 100 Hz"),
        ("rate_hz", 101, "101 is out of range, expected 0.5 to 100 Hz"),
        ("rate_hz", 10**400, "is out of range, expected 0.5 to 100 Hz"),
        ("rate_hz", math.nan, "nan is not a finite number"),
        ("rate_hz", -math.inf, "-inf is not a finite number"),
        ("mode", "Fast", "'Fast' is not known, expected one of 'fast', 'slow'"),
        ("mode", 1, "1 is of type int, expected str"),
        ("low", -1, "-1 is out of range, expected 0 to unbounded"),
        ("low", 1.0, "1.0 is of type float, expected int"),
        ("low", False, "False is of type bool, expected int"),
        ("isOn", 1, "1 is of type int, expected bool"),
        ("isOn", "true", "'true' is of type str, expected bool"),
        ("frames", "ab", "'ab' is of type str, expected list"),
        ("frames", 3, "3 is of type int, expected list"),
        ("frames", ["a", 3], "3 is of type int, expected str"),
        ("weights", [1.0, 3.0], "3.0 is out of range, expected 0 to 2 kg"),
        ("weights", [math.nan], "nan is not a finite number"),
    ],
)
def test_a_wrong_value_is_refused_with_name_value_and_expectation(
    name: str, value: Any, message: str
) -> None:
    with pytest.raises(SettingError) as caught:
        build(Group, {name: value})
    assert str(caught.value).startswith(f"parameter '{name}': ")
    assert str(caught.value).endswith(message)


@pytest.mark.parametrize("value", [0.5, 100, 100.0])
def test_bounds_are_inclusive(value: float) -> None:
    assert build(Group, {"rate_hz": value}).inner.rate_hz == value


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("rate_Hz", "parameter 'rate_Hz' is not known; did you mean 'rate_hz'?"),
        ("isON", "parameter 'isON' is not known; did you mean 'isOn'?"),
        ("is_on", "parameter 'is_on' is not known; did you mean 'isOn'?"),
        ("zzz", "parameter 'zzz' is not known"),
    ],
)
def test_a_typing_error_gets_a_suggestion(name: str, message: str) -> None:
    with pytest.raises(SettingError) as caught:
        build(Group, {name: 1})
    assert str(caught.value) == message


def test_a_setting_error_is_a_value_error() -> None:
    assert issubclass(SettingError, ValueError)


def test_a_change_keeps_the_rest_and_leaves_the_old_one_alone() -> None:
    before = build(Group, {"rate_hz": 2.0, "name": "n"})
    after = change(before, {"isOn": False, "low": 3})
    assert (after.inner.rate_hz, after.name, after.is_on, after.inner.low) == (2.0, "n", False, 3)
    assert before == build(Group, {"rate_hz": 2.0, "name": "n"})


def test_a_change_is_made_whole_or_not_at_all() -> None:
    before = Group()
    with pytest.raises(SettingError, match=r"'mode'"):
        change(before, {"rate_hz": 20.0, "mode": "nonsense", "name": "x"})
    assert before == Group()


def test_a_change_of_two_settings_that_only_fit_together() -> None:
    assert change(Group(), {"low": 7, "high": 9}).inner.low == 7
    with pytest.raises(SettingError, match=r"parameter 'low': 7 is above high \(5\)"):
        change(Group(), {"low": 7})


def test_values_can_be_built_from_again() -> None:
    group = build(Group, {"rate_hz": 3.5, "frames": ["q"], "isOn": False})
    assert list(values_of(group)) == NAMES
    assert build(Group, values_of(group)) == group


def test_a_group_cannot_be_written() -> None:
    group = Group()
    with pytest.raises(dataclasses.FrozenInstanceError):
        group.name = "x"
    with pytest.raises((AttributeError, TypeError)):
        object.__setattr__(group, "naem", "x")


def test_the_table() -> None:
    lines = markdown_table(Group).splitlines()
    assert lines[0] == "| Parameter | Type | Default | Range | Live | Description |"
    assert len(lines) == 2 + len(NAMES)
    assert "| `rate_hz` | float | `10.0` | 0.5 to 100 Hz | yes | how often |" in lines
    assert "| `isOn` | bool | `true` |  | yes | whether |" in lines
    assert "| `mode` | str | `\"fast\"` | 'fast', 'slow' |  | how |" in lines
    assert '| `frames` | list of str | `["a", "b"]` |  |  | some names |' in lines
    assert "| `weights` | list of float | `[1.0]` | 0 to 2 kg |  | some numbers |" in lines


JUNK = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(),
    st.binary(),
    st.lists(st.one_of(st.integers(), st.floats(), st.text())),
    st.dictionaries(st.text(), st.none()),
)


@given(st.sampled_from(NAMES), JUNK)
def test_any_value_is_taken_in_its_type_or_refused_by_name(name: Any, value: Any) -> None:
    message = ""
    try:
        group = build(Group, {name: value})
    except SettingError as error:
        message = str(error)
    if message:
        assert name in message
        return
    taken = values_of(group)[name]
    declared = {item.name: item for item in settings_of(Group)}[name]
    assert isinstance(taken, declared.type)
    assert taken == (tuple(value) if isinstance(taken, tuple) else value)
