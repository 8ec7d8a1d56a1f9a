"""Settings, each declared once: default, unit, range, meaning.

A group of settings is a frozen dataclass whose fields are made by :func:`setting`. The ROS
declaration, the check of a YAML file, the README table and the error messages all follow from the
same metadata.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, TypeVar, get_type_hints

_KEY = "l2lidar.setting"

Scalar = bool | int | float | str
Value = Scalar | tuple[Scalar, ...]
Kind = type[Any]
G = TypeVar("G")


class SettingError(ValueError):
    """An invalid value of a setting; the message says which, and what would be right."""


class Form(NamedTuple):
    """Required form of a text: a pattern, and the words of the error message."""

    pattern: re.Pattern[str]
    name: str
    expected: str


TOPIC: Final = Form(
    re.compile(r"(~/|/)?[A-Za-z_{][\w{}]*(/[A-Za-z_{][\w{}]*)*", re.ASCII),
    "a topic name",
    "names such as /front/points, each of letters, digits and '_', beginning with no digit",
)
"""ROS says what is wrong with a name, but not which parameter holds it."""

FRAME: Final = Form(
    re.compile(r"(?!/)[\w/.~-]*"),
    "a frame name",
    "letters, digits, '_', '-', '.' and '/', not starting with '/'",
)

FILE_NAME: Final = Form(
    re.compile(r"\w[\w.-]{0,99}", re.ASCII),
    "a file name",
    "up to 100 letters, digits, '_', '-' and '.', the first a letter, digit or '_', no folder",
)
"""For files inside one folder: anybody in the ROS domain can set such a parameter."""

FOLDER: Final = Form(re.compile(r".*\S.*", re.DOTALL), "a folder", "its path")


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting.

    Attributes
    ----------
    name : str
        Name a user types (ROS parameter, YAML key).
    field : str
        Name of the dataclass field.
    type : type
        One of bool, int, float, str or tuple (then ``item`` says of what).
    default : Value
    doc : str
        What it does, one sentence.
    unit : str
        Empty for a number without one.
    lo, hi : float or None
        Inclusive bounds.
    choices : tuple of str
        Allowed strings; empty for any.
    live : bool
        Whether a running node takes a new value.
    item : type or None
        Type of the elements of a tuple.
    form : Form or None
        Of a string; None for any.
    """

    name: str
    field: str
    type: Kind
    default: Value
    doc: str
    unit: str = ""
    lo: float | None = None
    hi: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = False
    item: Kind | None = None
    form: Form | None = None

    @property
    def range_text(self) -> str:
        """The permitted values in words, empty when anything of the type will do."""
        if self.choices:
            return ", ".join(f"'{choice}'" for choice in self.choices)
        if self.lo is None and self.hi is None:
            return ""
        unit = f" {self.unit}" if self.unit else ""
        return f"{_number(self.lo)} to {_number(self.hi)}{unit}"

    @property
    def range_or_unit(self) -> str:
        """The permitted values in words, or the unit where anything of the type will do."""
        return self.range_text or (f"in {self.unit}" if self.unit else "")

    def check(self, value: object) -> Value:
        """Return the value in this setting's own type.

        Raises
        ------
        SettingError
            If the type is wrong, a number is not finite or out of range, or a string is not a
            choice or has not its form.
        """
        if self.item is None:
            return self._check_scalar(value, self.type)
        if isinstance(value, str | bytes) or not isinstance(value, Iterable):
            raise self._error(value, f"is of type {_type_name(value)}, expected list")
        return tuple(self._check_scalar(element, self.item) for element in value)

    def _check_scalar(self, value: object, kind: Kind) -> Scalar:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not isinstance(value, kind) and not (is_number and kind is float):
            raise self._error(value, f"is of type {_type_name(value)}, expected {kind.__name__}")
        if isinstance(value, bool) and kind is not bool:
            raise self._error(value, f"is of type bool, expected {kind.__name__}")
        if isinstance(value, int | float) and is_number:
            if isinstance(value, float) and not math.isfinite(value):
                raise self._error(value, "is not a finite number")
            below = self.lo is not None and value < self.lo
            above = self.hi is not None and value > self.hi
            if below or above:
                raise self._error(value, f"is out of range, expected {self.range_text}")
        if self.choices and value not in self.choices:
            raise self._error(value, f"is not known, expected one of {self.range_text}")
        if self.form and not self.form.pattern.fullmatch(str(value)):
            raise self._error(value, f"is not {self.form.name}, expected {self.form.expected}")
        checked: Scalar = kind(value)
        return checked

    def _error(self, value: object, text: str) -> SettingError:
        return SettingError(f"parameter '{self.name}': {value!r} {text}")


def _type_name(value: object) -> str:
    return type(value).__name__


def _number(value: float | None) -> str:
    return "unbounded" if value is None else f"{value:g}" if value < 1e6 else str(int(value))


def setting(
    default: Value,
    doc: str,
    *,
    name: str = "",
    unit: str = "",
    lo: float | None = None,
    hi: float | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
    form: Form | None = None,
) -> Any:
    """Return a dataclass field that carries everything about one setting.

    ``name`` is only needed where users know the setting under a name that is not the field's.
    See :class:`Setting` for the other arguments.
    """
    metadata = {
        "doc": doc,
        "name": name,
        "unit": unit,
        "lo": lo,
        "hi": hi,
        "choices": choices,
        "live": live,
        "form": form,
    }
    return field(default=default, metadata={_KEY: metadata})


def settings_of(group: type) -> Iterator[Setting]:
    """Yield every setting of a group in the order of declaration.

    A field that is itself a group (a dataclass of settings) contributes its own settings in place.
    """
    hints = get_type_hints(group)
    for item in dataclasses.fields(group):
        if _KEY not in item.metadata:
            yield from settings_of(hints[item.name])
            continue
        facts = dict(item.metadata[_KEY])
        facts["name"] = facts["name"] or item.name
        declared = hints[item.name]
        arguments = getattr(declared, "__args__", None)
        yield Setting(
            field=item.name,
            type=tuple if arguments else declared,
            item=arguments[0] if arguments else None,
            default=item.default,  # type: ignore[arg-type]  # setting() only takes a Value
            **facts,
        )


def build(group: type[G], values: Mapping[str, object]) -> G:
    """Return a group made from user-facing names, every value checked.

    Parameters
    ----------
    group : type
        A frozen dataclass of settings, possibly nested.
    values : mapping
        Value by user-facing name; names left out keep their default.

    Raises
    ------
    SettingError
        For a name that no setting has, or a value that its setting cannot take.
    """
    known = {item.name for item in settings_of(group)}
    for name in values:
        if name not in known:
            raise SettingError(f"parameter '{name}' is not known{_suggestion(name, known)}")
    return _build(group, values)


def _build(group: type[G], values: Mapping[str, object]) -> G:
    hints = get_type_hints(group)
    own = {item.name: item for item in settings_of(group)}
    arguments: dict[str, object] = {}
    for item in dataclasses.fields(group):  # type: ignore[arg-type]  # a group is a dataclass
        if _KEY not in item.metadata:
            arguments[item.name] = _build(hints[item.name], values)
            continue
        name = item.metadata[_KEY]["name"] or item.name
        if name in values:
            arguments[item.name] = own[name].check(values[name])
    return group(**arguments)


def values_of(group: object) -> dict[str, Value]:
    """Return the current value of every setting of a group by user-facing name."""
    values: dict[str, Value] = {}
    for item in dataclasses.fields(group):  # type: ignore[arg-type]  # a group is a dataclass
        value = getattr(group, item.name)
        if _KEY in item.metadata:
            values[item.metadata[_KEY]["name"] or item.name] = value
        else:
            values.update(values_of(value))
    return values


def change(group: G, values: Mapping[str, object]) -> G:
    """Return a group with some values replaced; nothing changes unless all of them are right.

    Raises
    ------
    SettingError
        As :func:`build`.
    """
    return build(type(group), {**values_of(group), **values})


def markdown_table(group: type) -> str:
    """Return the README's table of a group's settings: name, type, default, range, meaning."""
    rows = [
        "| Parameter | Type | Default | Range | Live | Description |",
        "|---|---|---|---|---|---|",
    ]
    for item in settings_of(group):
        kind = f"list of {item.item.__name__}" if item.item else item.type.__name__
        rows.append(
            f"| `{item.name}` | {kind} | `{_literal(item.default)}` | {item.range_or_unit} "
            f"| {'yes' if item.live else ''} | {item.doc} |"
        )
    return "\n".join(rows)


def _literal(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(_literal(item) for item in value) + "]"
    return f'"{value}"' if isinstance(value, str) else str(value)


def _suggestion(name: str, known: set[str]) -> str:
    import difflib

    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean '{close[0]}'?" if close else ""
