"""How many boxes have a class, and whether stored values fit their attributes."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, func, select

from annotator.project.classes.applying import values_of
from annotator.project.classes.attributes import Attribute, AttributeOf, value_text
from annotator.project.schema import frame_attributes, labels
from annotator.types.amounts import amount
from annotator.types.errors import ProjectError
from annotator.types.label import AttributeValue

# the shown box is a source's, too
_SAID = """
    SELECT json_extract(said.value, '$.label') AS name, count(*) FROM labels, json_each(labels.said) AS said
    WHERE json_extract(said.value, '$.uid') != labels.uid OR name != labels.label GROUP BY name
"""


@dataclass(frozen=True)
class ClassCounts:
    """Numbers of boxes of a class.

    Attributes:
        labels: 3D labels.
        boxes_2d: 2D boxes on images and views.
        said: what sources say of objects, apart from the boxes that are shown.
    """

    labels: int = 0
    boxes_2d: int = 0
    said: int = 0


def class_counts(connection: Connection) -> dict[str, ClassCounts]:
    """Numbers of boxes by class name."""
    count = func.count().label("number")
    of_labels = connection.execute(select(labels.c.label, count).group_by(labels.c.label))
    in_3d: dict[str, int] = {row[0]: row[1] for row in of_labels}
    in_2d: Counter[str] = Counter()
    for table in ("image_labels", "view_labels"):
        of_boxes = f"{table}, json_each({table}.boxes) AS box"
        query = f"SELECT json_extract(box.value, '$.label'), count(*) FROM {of_boxes} GROUP BY 1"
        in_2d.update({row[0]: row[1] for row in connection.exec_driver_sql(query)})
    said = {row[0]: row[1] for row in connection.exec_driver_sql(_SAID)}
    names = sorted({*in_3d, *in_2d, *said})
    return {name: ClassCounts(in_3d.get(name, 0), in_2d[name], said.get(name, 0)) for name in names}


def value_counts(connection: Connection) -> dict[str, dict[str, int]]:
    """How often each value occurs, by attribute: of labels that are not rejected, and of frames."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for _, values, number in _stored(connection):
        for name, value in values.items():
            counts[name][value_text(value)] += number
    return {name: dict(counts[name].most_common()) for name in sorted(counts)}


def require_fitting(connection: Connection, before: Sequence[Attribute], after: Sequence[Attribute]) -> None:
    """Refuses a change of attributes that stored values do not fit.

    Raises:
        ProjectError: the message names an attribute, and how many of its values do not fit.
    """
    for attribute in after:
        if any(attribute.has_same_values(each) for each in before):
            continue
        wrong = list(_misfits(connection, attribute))
        if wrong:
            number, example = sum(number for number, _ in wrong), wrong[0][1]
            raise ProjectError(
                f"{amount(number, 'stored value')} of {attribute.name} would not fit, such as {example}; first change "
                "what does not fit, or have it removed (--drop)"
            )


def _misfits(connection: Connection, attribute: Attribute) -> Iterator[tuple[int, str]]:
    for label, values, number in _stored(connection, rejected=True):
        if attribute.name not in values or (label is None) != (attribute.of is AttributeOf.FRAME):
            continue
        value = values[attribute.name]
        if label is not None and not attribute.is_of(label):
            yield number, f"{value!r} of a {label}"
        elif not attribute.fits(value):
            yield number, repr(value)


def _stored(
    connection: Connection, rejected: bool = False
) -> Iterator[tuple[str | None, Mapping[str, AttributeValue], int]]:
    """Class (None: of frames), values and how often they occur together."""
    columns = (labels.c.label, labels.c.attributes)
    query = select(*columns, func.count()).where(labels.c.attributes != "{}").group_by(*columns)
    if not rejected:
        query = query.where(labels.c.state != "rejected")
    for label, content, number in connection.execute(query):
        yield label, values_of(content), number
    for row in connection.execute(select(frame_attributes.c.attributes)):
        yield None, values_of(row.attributes), 1
