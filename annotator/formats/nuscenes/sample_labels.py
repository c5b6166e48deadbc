"""Reads the boxes of some samples, in the global frame."""

from __future__ import annotations

from collections.abc import Set
from pathlib import Path
from typing import TypeVar

import numpy as np

from annotator.formats.nuscenes.model import Attribute, Category, Instance, SampleAnnotation, Visibility
from annotator.formats.nuscenes.read import ANNOTATIONS, NuScenesBox, require_w_first, track_of, values_of
from annotator.formats.nuscenes.shapes import box_from
from annotator.formats.units import Lengths
from annotator.nuscenes_tables import Record, TableError, find_rows, read_rows
from annotator.types.errors import FormatError

Row = TypeVar("Row", bound=Record)


def read_sample_boxes(tables: Path, samples: Set[str]) -> dict[str, tuple[NuScenesBox, ...]]:
    """Returns the boxes of samples, by the sample's token.

    Args:
        tables: the folder of the tables.

    Raises:
        FormatError: a table is missing or damaged, or refers to missing rows.
        UnitError: the sizes are not in metres, or the quaternions have w last.
    """
    annotations = _rows(tables / ANNOTATIONS, SampleAnnotation, samples)
    # all of them, because a track is the row's number
    instances = {row.token: (number, row) for number, row in enumerate(_rows(tables / "instance.json", Instance))}
    Lengths(np.array(row.size) for row in annotations).require(tables / ANNOTATIONS)
    require_w_first(tables, annotations, {token: row for token, (_, row) in instances.items()})
    classes = {row.token: row.name for row in _rows(tables / "category.json", Category)}
    names = {row.token: row.name for row in _rows_if_any(tables / "attribute.json", Attribute)}
    levels = {row.token: row.level for row in _rows_if_any(tables / "visibility.json", Visibility)}
    boxes: dict[str, list[NuScenesBox]] = {sample: [] for sample in samples}
    for row in annotations:
        if row.instance_token not in instances:
            problem = f"row {row.token}: refers to the token {row.instance_token}, which is not in instance.json"
            raise FormatError(tables / ANNOTATIONS, problem)
        number, instance = instances[row.instance_token]
        if instance.category_token not in classes:
            problem = f"row {number}: refers to the token {instance.category_token}, which is not in category.json"
            raise FormatError(tables / "instance.json", problem)
        try:
            box = box_from(row.translation, row.rotation, row.size)
        except ValueError as error:
            raise FormatError(tables / ANNOTATIONS, f"row {row.token}: {error}") from error
        label = classes[instance.category_token]
        values = values_of(row, instance, names, levels)
        boxes[row.sample_token].append(NuScenesBox(label, box, track_of(instance, number), values))
    return {sample: tuple(found) for sample, found in boxes.items()}


def _rows_if_any(path: Path, model: type[Row]) -> list[Row]:
    return _rows(path, model) if path.is_file() else []


def _rows(path: Path, model: type[Row], samples: Set[str] | None = None) -> list[Row]:
    """Returns the rows of a table; with `samples`, those of these samples."""
    try:
        return list(read_rows(path, model) if samples is None else find_rows(path, model, "sample_token", samples))
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    except TableError as error:
        raise FormatError(path, str(error)) from error
