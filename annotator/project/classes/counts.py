"""How many boxes have a class, and how often values of attributes occur."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Select, Table, func, select

from annotator.project.classes.attributes import Attribute, AttributeOf, value_text
from annotator.project.database.schema import ALL_LABELS, BOTH_LABELS, frames, stills
from annotator.project.database.store import driver_of
from annotator.project.recordings import KEPT
from annotator.project.rows import Terms, values_of
from annotator.types.errors import ProjectError
from annotator.types.label import AttributeValue
from annotator.types.messages import amount

_Stored = tuple[str | None, Mapping[str, AttributeValue], int]
"""Class (None: of frames), values and how often they occur together."""


@dataclass(frozen=True)
class ClassCounts:
    """Numbers of boxes of a class.

    Attributes:
        said: what sources say of objects, apart from the boxes that are shown.
    """

    labels: int = 0
    boxes_2d: int = 0
    said: int = 0


def class_counts(connection: Connection, *, removed: bool = False) -> dict[str, ClassCounts]:
    """Numbers of boxes by class name; with `removed`, also of recordings that were removed."""
    driver, names, shown = driver_of(connection), Terms(connection).names, "" if removed else "shown_"
    in_3d, in_2d, said = Counter[str](), Counter[str](), Counter[str]()
    is_shown = "behind IS NULL" + ("" if removed else " AND hidden = 0")
    for number, count in driver.execute(f"SELECT class_id, count(*) FROM labels WHERE {is_shown} GROUP BY class_id"):
        in_3d[names[number]] += count
    of_stills = "stills" if removed else "shown_stills"
    for number, count in driver.execute(f"SELECT class_id, count(*) FROM {of_stills} GROUP BY class_id"):
        in_3d[names[number]] += count
    for table in ("image_labels", "view_labels"):
        of_boxes = f"{shown}{table} AS of, json_each(of.boxes) AS box"
        for number, count in driver.execute(f"SELECT box.value ->> '$.label', count(*) FROM {of_boxes} GROUP BY 1"):
            in_2d[names[int(number)]] += count
    is_counted = "behind IS NOT NULL" + ("" if removed else " AND hidden = 0")
    for number, count in driver.execute(f"SELECT class_id, count(*) FROM labels WHERE {is_counted} GROUP BY class_id"):
        said[names[number]] += count
    return {name: ClassCounts(in_3d[name], in_2d[name], said[name]) for name in sorted({*in_3d, *in_2d, *said})}


def value_counts(connection: Connection) -> dict[str, dict[str, int]]:
    """How often each stored value occurs, by attribute: of labels that are not rejected, and of frames."""
    return _by_name(_counted(_stored(connection)))


def counts_with_defaults(
    connection: Connection, attributes: Sequence[Attribute]
) -> tuple[dict[str, dict[str, int]], dict[str, int]]:
    """As `value_counts`, with an entry of each attribute; and the numbers of labels and frames that lack a value of it.

    The default of a frames' attribute counts for all frames that the latest scans found and that have no value,
    labelled or not, since labels are counted before their review, too. Exports write it for those that they contain.
    """
    stored = list(_stored(connection))
    counts, without = _counted(stored), dict[str, int]()
    of_frames = select(frames.c.attributes, func.count()).where(frames.c.position.is_not(None))
    in_all = [row for each in BOTH_LABELS for row in connection.execute(_of_classes(each)).all()]
    present = [
        (values_of(each), number) for each, number in connection.execute(of_frames.group_by(frames.c.attributes))
    ]
    for each in attributes:
        name, found = each.name, counts[each.name]
        if each.of is AttributeOf.FRAME:
            lacking = sum(number for values, number in present if name not in values)
            if each.default is not None and lacking:
                found[value_text(each.default)] += lacking
                lacking = 0
        else:
            lacking = sum(number for label, number in in_all if each.is_of(label))
            lacking -= sum(n for label, values, n in stored if label and each.is_of(label) and name in values)
        without[name] = lacking
    return _by_name(counts), without


def _of_classes(table: Table) -> Select[Any]:
    return select(table.c.label, func.count()).where(table.c.state != "rejected").group_by(table.c.label)


def require_fitting(connection: Connection, classes: Sequence[str], attributes: Sequence[Attribute]) -> None:
    """Refuses a change from these classes and attributes, which has been made, if boxes or values do not fit it."""
    now = Terms(connection)
    gone = set(classes) - set(now.classes)
    if used := sorted(gone & class_counts(connection, removed=True).keys()) if gone else []:
        raise ProjectError(
            f"{', '.join(map(repr, used))} cannot be removed while boxes use it; give them another class (--into on "
            "the command line), or remove them, too (--with-boxes); recordings that were removed may have some"
        )
    if now.attributes == tuple(attributes):
        return
    stored = list(_stored(connection, everywhere=True))
    for attribute in {each.name: each for each in (*attributes, *now.attributes)}.values():
        if any(attribute.has_same_values(each) for each in attributes) and attribute in now.attributes:
            continue
        wrong = list(_misfits(stored, attribute, attribute not in now.attributes))
        if wrong:
            number, example = sum(number for number, _ in wrong), wrong[0][1]
            raise ProjectError(
                f"{amount(number, 'stored value')} of {attribute.name} would not fit, such as {example}; first change "
                "what does not fit, or have it removed (--drop)"
            )


def _counted(stored: Iterable[_Stored]) -> dict[str, Counter[str]]:
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for _, values, number in stored:
        for name, value in values.items():
            counts[name][value_text(value)] += number
    return counts


def _by_name(counts: Mapping[str, Counter[str]]) -> dict[str, dict[str, int]]:
    return {name: dict(counts[name].most_common()) for name in sorted(counts)}


def _misfits(stored: Iterable[_Stored], attribute: Attribute, is_gone: bool) -> Iterator[tuple[int, str]]:
    for label, values, number in stored:
        if attribute.name not in values or (label is None) != (attribute.of is AttributeOf.FRAME):
            continue
        value = values[attribute.name]
        if is_gone:
            yield number, repr(value)
        elif label is not None and not attribute.is_of(label):
            yield number, f"{value!r} of a {label}"
        elif not attribute.fits(value):
            yield number, repr(value)


def _stored(connection: Connection, everywhere: bool = False) -> Iterator[_Stored]:
    """With `everywhere`, also of rejected labels, of removed recordings, and of boxes behind others."""
    names = Terms(connection).names
    for table in (ALL_LABELS, stills) if everywhere else BOTH_LABELS:
        columns = (table.c.class_id, table.c.attributes)
        query = select(*columns, func.count()).where(table.c.attributes != "{}").group_by(*columns)
        if not everywhere:
            query = query.where(table.c.state != "rejected")
        for class_id, content, number in connection.execute(query):
            yield names[class_id], values_of(content), number
    of_frames = select(frames.c.attributes).where(frames.c.attributes.is_not(None))
    for row in connection.execute(of_frames if everywhere else of_frames.where(KEPT)):
        yield None, values_of(row.attributes), 1
