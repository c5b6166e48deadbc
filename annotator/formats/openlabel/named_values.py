"""Values of attributes as OpenLABEL's named booleans, numbers and texts."""

from __future__ import annotations

from collections.abc import Mapping

from annotator.formats.openlabel.model import Attributes, Boolean, Num, Text
from annotator.formats.openlabel.said_text import SAID_BY
from annotator.types.label import AttributeValue

# Names that annotator itself gives to data of a cuboid; attributes of these names get a prefix.
RESERVED = frozenset(
    {
        "score",
        "track_id",
        "expected_iou_loss",
        "state",
        "source",
        "author",
        "suggested_by",
        "suggestion",
        "box_kind",
        SAID_BY,
    }
)
PREFIX = "attribute:"
# Name and type of the context that has the attributes of frames.
FRAME_CONTEXT = "frame"


def key_of(name: str) -> str:
    """Returns the name of an attribute in a document."""
    return PREFIX + name if name in RESERVED else name


def attributes_of(values: Mapping[str, AttributeValue]) -> Attributes:
    """Returns values by their kind."""
    named = values.items()
    numbers = [(name, value) for name, value in named if isinstance(value, int | float) and not isinstance(value, bool)]
    return Attributes(
        boolean=tuple(Boolean(name=name, val=value) for name, value in named if isinstance(value, bool)) or None,
        num=tuple(Num(name=name, val=value) for name, value in numbers) or None,
        text=tuple(Text(name=name, val=value) for name, value in named if isinstance(value, str)) or None,
    )


def values_of(attributes: Attributes | None) -> dict[str, AttributeValue]:
    """Returns the values of attributes, without annotator's own data."""
    if attributes is None:
        return {}
    every: tuple[Boolean | Num | Text, ...] = (
        *(attributes.boolean or ()),
        *(attributes.num or ()),
        *(attributes.text or ()),
    )
    named = {each.name: each.val for each in every if each.name and each.name not in RESERVED}
    return {name.removeprefix(PREFIX): value for name, value in named.items()}
