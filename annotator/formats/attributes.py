"""Values of attributes in formats that have fields or names for some of them."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from urllib.parse import unquote

from annotator.types.label import AttributeValue

Values = Mapping[str, AttributeValue]
NO_VALUES: Values = MappingProxyType({})

# Attributes that formats measure or have fields for; an operator's value wins.
TRUNCATION, OCCLUSION, VISIBILITY = "truncation", "occlusion", "visibility"


def held_by_kitti(values: Values) -> dict[str, float]:
    """The values that a row of KITTI can hold: a truncation in 0..1 and an occlusion of 0 to 3."""
    numbers = {
        name: value for name, value in values.items() if isinstance(value, int | float) and not isinstance(value, bool)
    }
    held = {}
    if 0 <= numbers.get(TRUNCATION, -1) <= 1:
        held[TRUNCATION] = float(numbers[TRUNCATION])
    if numbers.get(OCCLUSION, -1) in range(4):
        held[OCCLUSION] = float(numbers[OCCLUSION])
    return held


def of_kitti(truncated: float, occluded: int) -> dict[str, AttributeValue]:
    """The values of a row; negative ones mean that they are unknown."""
    values: dict[str, AttributeValue] = {TRUNCATION: float(truncated), OCCLUSION: occluded}
    return {name: value for name, value in values.items() if not (isinstance(value, int | float) and value < 0)}


def dotted(values: Values) -> tuple[str, ...]:
    """Values as names like nuScenes' attributes, `pose.sitting`."""
    return tuple(f"{name}.{str(value).lower() if isinstance(value, bool) else value}" for name, value in values.items())


def from_dotted(names: Iterable[str]) -> dict[str, AttributeValue]:
    """The values of such names; a name without a dot is the value true."""
    parts = (name.partition(".") for name in names)
    return {name.strip(): typed_value(value) if dot else True for name, dot, value in parts}


def typed_value(text: str) -> AttributeValue:
    """The number or boolean that `dotted` writes as this text, else the text: "0012" and "nan" stay texts."""
    try:
        value = json.loads(text)
    except ValueError:
        return text
    is_number = isinstance(value, int) or (isinstance(value, float) and math.isfinite(value))
    return value if is_number and json.dumps(value) == text else text


def joined(values: Values) -> str:
    """Values as one text, `pose.sitting,helmet.true`; commas within them are escaped as in URLs."""
    return ",".join(name.replace("%", "%25").replace(",", "%2C") for name in dotted(values))


def from_joined(text: str) -> dict[str, AttributeValue]:
    """The values of such a text, or of one that a person wrote: `door open, occluded`."""
    return from_dotted(unquote(part) if "." in part else part.strip() for part in text.split(",") if part.strip())
