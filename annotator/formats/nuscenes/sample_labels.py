"""Reads the boxes of some samples, in the global frame."""

from __future__ import annotations

from collections.abc import Iterator, Set
from pathlib import Path
from typing import TypeVar

from annotator.formats.nuscenes.model import Category, Instance, SampleAnnotation
from annotator.formats.nuscenes.read import NuScenesBox, track_of
from annotator.formats.nuscenes.shapes import box_from
from annotator.nuscenes_tables import Record, TableError, read_rows
from annotator.types.errors import FormatError

ANNOTATIONS = "sample_annotation.json"

Row = TypeVar("Row", bound=Record)


def read_sample_boxes(tables: Path, samples: Set[str]) -> dict[str, tuple[NuScenesBox, ...]]:
    """Returns the boxes of samples, by the sample's token.

    Args:
        tables: the folder of the tables.

    Raises:
        FormatError: a table is missing or damaged, or refers to missing rows.
    """
    annotations = list(_rows(tables / ANNOTATIONS, SampleAnnotation, "sample_token", samples))
    wanted = {row.instance_token for _, row in annotations}
    instances = {row.token: (number, row) for number, row in _rows(tables / "instance.json", Instance, "token", wanted)}
    classes = {row.token: row.name for _, row in _rows(tables / "category.json", Category)}
    boxes: dict[str, list[NuScenesBox]] = {sample: [] for sample in samples}
    for index, row in annotations:
        if row.instance_token not in instances:
            problem = f"row {index}: refers to the token {row.instance_token}, which is not in instance.json"
            raise FormatError(tables / ANNOTATIONS, problem)
        number, instance = instances[row.instance_token]
        if instance.category_token not in classes:
            problem = f"row {number}: refers to the token {instance.category_token}, which is not in category.json"
            raise FormatError(tables / "instance.json", problem)
        try:
            box = box_from(row.translation, row.rotation, row.size)
        except ValueError as error:
            raise FormatError(tables / ANNOTATIONS, f"row {index}: {error}") from error
        label = classes[instance.category_token]
        boxes[row.sample_token].append(NuScenesBox(label, box, track_of(instance, number)))
    return {sample: tuple(found) for sample, found in boxes.items()}


def _rows(
    path: Path, model: type[Row], field: str = "token", wanted: Set[str] | None = None
) -> Iterator[tuple[int, Row]]:
    try:
        yield from read_rows(path, model, field, wanted)
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    except TableError as error:
        raise FormatError(path, str(error)) from error
