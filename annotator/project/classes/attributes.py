"""The schema of attributes and the looks of classes."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from enum import StrEnum
from typing import Annotated, Any

from pydantic import AfterValidator, Field, model_serializer, model_validator

from annotator.types.bases import Strict
from annotator.types.label import MOST_TRACK, AttributeValue

MOST_TEXT = 1000
MOST_CHOICES = 200
# Integers that JSON, SQLite and JavaScript represent exactly.
MOST_INTEGER = MOST_TRACK
# Values that some formats have for every box, measured by their tools; exports measure them again.
MEASURED = frozenset({"truncation", "occlusion", "visibility"})
YES, NO = ("true", "yes", "1"), ("false", "no", "0")


def _text_like(pattern: str, what: str) -> AfterValidator:
    """Checks a text; pydantic's own message would show the pattern to the operator."""

    def check(text: str) -> str:
        if not re.fullmatch(pattern, text):
            raise ValueError(f"{text!r} is not {what}")
        return text

    return AfterValidator(check)


Colour = Annotated[str, _text_like(r"#[0-9a-fA-F]{6}", "a colour of six hexadecimal digits, such as #3366ff")]
Key = Annotated[str, _text_like(r"[0-9a-z]", "a key, one of 0 to 9 and a to z")]
AttributeName = Annotated[
    str,
    _text_like(
        r"[A-Za-z_][A-Za-z0-9_-]{0,63}", "a name of up to 64 letters, digits, _ and -, with a letter or _ first"
    ),
]
Choice = Annotated[str, Field(min_length=1, max_length=64)]
Limit = Annotated[float, Field(allow_inf_nan=False)]
Value = bool | int | Limit | str


class AttributeKind(StrEnum):
    """The values of an attribute: one of some texts, yes or no, a whole number, any number, or free text."""

    CHOICE = "choice"
    BOOLEAN = "boolean"
    INTEGER = "integer"
    NUMBER = "number"
    TEXT = "text"


class AttributeOf(StrEnum):
    """What has the attribute. TRACK: an object, whose boxes all have the same value. FRAME: the frame as a whole."""

    BOX = "box"
    TRACK = "track"
    FRAME = "frame"


class _Sparse(Strict):
    """A model that is written without fields that have their default."""

    @model_serializer(mode="wrap")
    def _without_defaults(self, handler: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        fields = type(self).model_fields
        return {name: value for name, value in handler(self).items() if getattr(self, name) != fields[name].default}


class ClassStyle(_Sparse):
    """How the page shows a class: its colour, such as `#3366ff`, and the key that selects it; None: as by default.
    `still`: its objects stand still, such as furniture and signs; None: nobody has said so."""

    colour: Colour | None = None
    key: Key | None = None
    still: bool | None = None


class Attribute(_Sparse):
    """One attribute.

    Attributes:
        choices: the values of a choice, in the page's order.
        minimum, maximum: limits of an integer or number, inclusive; None: no limit.
        classes: that have it; none: all. Not for attributes of frames.
        required: whether the checks report boxes (or frames) without a value.
        default: value of a new box; the page and exports also take it for frames without a value.
    """

    name: AttributeName
    kind: AttributeKind
    of: AttributeOf = AttributeOf.BOX
    choices: Annotated[tuple[Choice, ...], Field(max_length=MOST_CHOICES)] = ()
    minimum: Limit | None = None
    maximum: Limit | None = None
    classes: tuple[str, ...] = ()
    required: bool = False
    default: Value | None = None
    key: Key | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Attribute:
        if (self.kind is AttributeKind.CHOICE) != bool(self.choices):
            raise ValueError(f"attribute {self.name}: choices are for the kind choice, which needs at least one")
        if len(set(self.choices)) < len(self.choices):
            raise ValueError(f"attribute {self.name}: its choices must differ from each other")
        limited = self.minimum is not None or self.maximum is not None
        if limited and self.kind not in (AttributeKind.INTEGER, AttributeKind.NUMBER):
            raise ValueError(f"attribute {self.name}: minimum and maximum are for the kinds integer and number")
        if self.minimum is not None and self.maximum is not None and self.minimum > self.maximum:
            raise ValueError(f"attribute {self.name}: its minimum is greater than its maximum")
        if self.classes and self.of is AttributeOf.FRAME:
            raise ValueError(f"attribute {self.name}: an attribute of frames has no classes")
        if self.default is not None:
            self.checked(self.default)
        return self

    def is_of(self, label: str) -> bool:
        """Whether the boxes of a class have it."""
        return self.of is not AttributeOf.FRAME and (not self.classes or label in self.classes)

    def has_same_values(self, other: Attribute | None) -> bool:
        """Whether both differ at most in their keys, and in whether they are required."""
        return other is not None and self == other.model_copy(update={"key": self.key, "required": self.required})

    def checked(self, value: AttributeValue) -> AttributeValue:
        """The value as it is stored."""
        match self.kind:
            case AttributeKind.CHOICE if value in self.choices:
                return value
            case AttributeKind.BOOLEAN if isinstance(value, bool):
                return value
            case AttributeKind.INTEGER if isinstance(value, int) and not isinstance(value, bool):
                if abs(value) <= MOST_INTEGER and self._is_within(value):
                    return value
            case AttributeKind.NUMBER if isinstance(value, int | float) and not isinstance(value, bool):
                # false for nan, infinity, and whole numbers beyond every float
                if abs(value) <= sys.float_info.max and self._is_within(value):
                    return float(value)
            case AttributeKind.TEXT if isinstance(value, str) and len(value) <= MOST_TEXT:
                return value
        raise ValueError(f"{self.name} must be {self.values_text()}, not {json.dumps(value)[:80]}")

    def fits(self, value: AttributeValue) -> bool:
        """Whether it is a value of this attribute."""
        try:
            self.checked(value)
        except ValueError:
            return False
        return True

    def read(self, value: AttributeValue) -> AttributeValue:
        """The value of a command line or of a file that has fewer kinds of values: "2", 1.0 or "yes" are read, too."""
        text = str(value).strip().lower()
        if self.kind is AttributeKind.BOOLEAN and text in YES + NO:
            return text in YES
        if self.kind in (AttributeKind.TEXT, AttributeKind.CHOICE) and not isinstance(value, str):
            return self.checked(json.dumps(value))
        if self.kind in (AttributeKind.INTEGER, AttributeKind.NUMBER) and not isinstance(value, bool):
            try:
                number = float(text)
            except ValueError:
                return self.checked(value)
            is_whole = self.kind is AttributeKind.INTEGER and number.is_integer()
            return self.checked(int(number) if is_whole else number)
        return self.checked(value)

    def values_text(self) -> str:
        """Which values it takes, for people."""
        match self.kind:
            case AttributeKind.CHOICE:
                return f"one of {', '.join(self.choices)}"
            case AttributeKind.BOOLEAN:
                return "true or false"
            case AttributeKind.TEXT:
                return f"a text of at most {MOST_TEXT} characters"
        what = "a whole number" if self.kind is AttributeKind.INTEGER else "a number"
        least = "" if self.minimum is None else f" from {self.minimum:g}"
        return what + least + ("" if self.maximum is None else f" to {self.maximum:g}")

    def words(self) -> str:
        """What it is, for people, such as "a whole number from 0 to 3; of each track; required"."""
        of = "" if self.of is AttributeOf.BOX else f"of each {self.of}"
        has = f"of {', '.join(self.classes)}" if self.classes else ""
        default = "" if self.default is None else f"default {value_text(self.default)}"
        key = f"key {self.key}" if self.key else ""
        return "; ".join(filter(None, [self.values_text(), of, has, "required" if self.required else "", default, key]))

    def _is_within(self, value: int | float) -> bool:
        above = self.minimum is None or value >= self.minimum
        return above and (self.maximum is None or value <= self.maximum)


def fitting(attributes: Iterable[Attribute], values: Mapping[str, AttributeValue]) -> dict[str, AttributeValue]:
    """The values, which may be older than the schema, that still fit."""
    known = {each.name: each for each in attributes}
    return {name: value for name, value in values.items() if name in known and known[name].fits(value)}


def value_text(value: AttributeValue) -> str:
    """A value for people."""
    return str(value).lower() if isinstance(value, bool) else str(value)
