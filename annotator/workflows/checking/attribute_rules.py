"""Rules about values of attributes: of boxes, and of frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from annotator.project.classes.attributes import Attribute, AttributeOf, value_text
from annotator.types import Label
from annotator.types.label import AttributeValue


def odd_values(labels: Sequence[Label], attributes: Sequence[Attribute]) -> Iterator[tuple[int, str]]:
    """Yields the index of a label and a message for values that are missing, do not fit, or have no attribute."""
    for number, label in enumerate(labels):
        of_label = {each.name: each for each in attributes if each.is_of(label.label)}
        for each in of_label.values():
            if each.required and each.name not in label.attributes:
                yield number, _missing(each, label.label)
        for name, value in label.attributes.items():
            if name not in of_label:
                yield number, _unknown(name, value, f"this {label.label}", label.label)
            elif not of_label[name].fits(value):
                yield number, f"{name} is {value_text(value)}; it must be {of_label[name].values_text()}"


def odd_frame_values(
    values: Mapping[str, AttributeValue], attributes: Sequence[Attribute], is_complete: bool
) -> Iterator[str]:
    """Yields messages about the values of a frame.

    Args:
        is_complete: whether required values must be there; a default is enough.
    """
    of_frames = {each.name: each for each in attributes if each.of is AttributeOf.FRAME}
    for each in of_frames.values() if is_complete else ():
        if each.required and each.default is None and each.name not in values:
            yield _missing(each, "frame")
    for name, value in values.items():
        if name not in of_frames:
            yield _unknown(name, value, "this frame", "frames")
        elif not of_frames[name].fits(value):
            yield f"{name} of this frame is {value_text(value)}; it must be {of_frames[name].values_text()}"


def _missing(attribute: Attribute, what: str) -> str:
    return f"this {what} has no value of {attribute.name}, which is required"


def _unknown(name: str, value: AttributeValue, this: str, owners: str) -> str:
    return f"{this} has the value {name} = {value_text(value)}, but the project has no attribute {name} for {owners}"
