"""The tables of nuScenes that describe its sensors, and the rows of a table, read one by one.

A table is a JSON list of flat records. Those of the whole data set take a gigabyte, of which a scene needs little, so
rows are found by their text and only those that are wanted are parsed. Source: nuScenes schema
(`docs/schema_nuscenes.md` of the nuscenes-devkit): metres, quaternions w x y z, times in microseconds.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
from pydantic import AfterValidator, Field, ValidationError
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.files import open_file
from annotator.types.bases import FileRecord
from annotator.types.checks import in_time
from annotator.types.messages import first_problem

# Larger numbers are not physical, and their products overflow.
LARGEST = 1e9
# A record without records in it; braces within texts do not count.
RECORD = re.compile(rb'\{[^{}"]*+(?:"(?:[^"\\]|\\.)*+"[^{}"]*+)*+\}')
# Bytes after the last record that are looked at.
LONGEST_END = 4096
BETWEEN = re.compile(rb"[\s,]*+\Z")
START = re.compile(rb"(?:\xef\xbb\xbf)?\s*+\[")

Token = Annotated[str, Field(min_length=1)]
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Position = tuple[Number, Number, Number]
Turn = tuple[Number, Number, Number, Number]
Time = Annotated[int, AfterValidator(partial(in_time, unit="us", unit_ns=1000))]


class TableError(ValueError):
    """A table that is damaged; the message does not name its file."""


class Record(FileRecord):
    """A row of a table."""

    token: Token


class Sensor(Record):
    """A sensor of the vehicle."""

    channel: str
    modality: str


class CalibratedSensor(Record):
    """The pose of a sensor on the vehicle: `rotation` and `translation` map its coordinates to the ego frame."""

    sensor_token: Token
    translation: Position
    rotation: Turn
    camera_intrinsic: tuple[Position, Position, Position] | tuple[()] = ()


class EgoPose(Record):
    """The pose of the vehicle: `rotation` and `translation` map the ego frame to the global frame."""

    timestamp: Time = 0
    rotation: Turn
    translation: Position


class Scene(Record):
    """A sequence of samples."""

    name: Annotated[str, Field(min_length=1)]


class Sample(Record):
    """An annotated moment."""

    timestamp: Time
    scene_token: Token


class SampleData(Record):
    """The data of one sensor; `filename` is relative to the dataset's root."""

    sample_token: Token
    ego_pose_token: Token
    calibrated_sensor_token: Token
    timestamp: Time = 0
    is_key_frame: bool
    height: int = 0
    width: int = 0
    filename: str


Row = TypeVar("Row", bound=Record)


def pose(translation: Position, rotation: Turn) -> RigidTransform:
    """Returns a pose.

    Raises:
        TableError: the rotation is not a unit quaternion.
    """
    if not 0.5 < np.linalg.norm(rotation) < 2.0:
        raise TableError(f"rotation: {list(rotation)} is not a unit quaternion")
    return RigidTransform.from_components(np.array(translation), Rotation.from_quat(rotation, scalar_first=True))


def read_rows(path: Path, model: type[Row]) -> Iterator[Row]:
    """Yields the rows of a table in the order of the file.

    Raises:
        TableError: not a list of flat records, or a row that does not follow the schema.
        OSError: the file cannot be read.
    """
    with _mapped(path) as text:
        at, number = START.match(text).end(), 0  # type: ignore[union-attr]  # checked by `_mapped`
        while (match := RECORD.search(text, at)) is not None and BETWEEN.match(text[at : match.start()]) is not None:
            yield _parsed(model, match[0], f"row {number}")
            at, number = match.end(), number + 1
        if text[at : at + LONGEST_END].strip() != b"]":
            raise TableError(f"is damaged or cut off after row {number}")


def find_rows(path: Path, model: type[Row], field: str, wanted: Collection[str]) -> Iterator[Row]:
    """Yields the rows of a table whose text `field` is one of `wanted`; the others are not parsed.

    Raises:
        TableError, OSError: as `read_rows`; damage in other rows is not noticed.
    """
    value = re.compile(rb'"%s"\s*+:\s*+"([^"\\]*+)"' % field.encode())
    keys = {each.encode() for each in wanted}
    with _mapped(path) as text:
        for match in value.finditer(text):
            if match[1] not in keys:
                continue
            start = text.rfind(b"{", 0, match.start())
            record = RECORD.match(text, start) if start >= 0 else None
            if record is None or record.end() < match.end():
                raise TableError(f"is damaged at byte {match.start()}")
            yield _parsed(model, record[0], f"the row at byte {start}")


@contextmanager
def _mapped(path: Path) -> Iterator[mmap.mmap]:
    """Maps a table, which is not loaded, and checks that it is a list that ends."""
    with open_file(path) as file:
        if path.stat().st_size == 0:
            raise TableError("the file is empty")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
            if START.match(text) is None:
                raise TableError("is not a list of records")
            if not text[max(len(text) - LONGEST_END, 0) :].rstrip().endswith(b"]"):
                raise TableError("is cut off: its list does not end")
            yield text


def _parsed(model: type[Row], record: bytes, where: str) -> Row:
    try:
        return model.model_validate_json(record)
    except ValidationError as error:
        raise TableError(f"{where}: {first_problem(error)}") from error
