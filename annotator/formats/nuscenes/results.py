"""nuScenes' results of detectors and trackers: boxes with scores, by the tokens of their samples.

    {"meta": {...}, "results": {"SAMPLE": [{"translation": [x, y, z], "size": [width, length, height],
        "rotation": [w, x, y, z], "detection_name": "car", "detection_score": 0.8, "attribute_name": "vehicle.moving"},
        ...], ...}}

Global frame, metres. Trackers write `tracking_name`, `tracking_score` and `tracking_id`. Other keys, such as
`velocity`, are ignored. Sources: "Results format" in the devkit's `eval/detection/README.md` and
`eval/tracking/README.md`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from pydantic import AliasChoices, BaseModel, ConfigDict, Field, ValidationError

from annotator.formats.attributes import from_dotted
from annotator.formats.json_file import BoundedPositive
from annotator.formats.json_stream import read_pairs
from annotator.formats.nuscenes.model import Quaternion, Vector3
from annotator.formats.nuscenes.shapes import box_from
from annotator.geometry.transforms import Quaternions
from annotator.types import Truth
from annotator.types.errors import FormatError
from annotator.types.messages import first_problem

RESULTS = "results"


class ResultBox(BaseModel):
    """A box of a detector or tracker."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    translation: Vector3
    size: tuple[BoundedPositive, BoundedPositive, BoundedPositive]
    rotation: Quaternion
    label: Annotated[str, Field(min_length=1, validation_alias=AliasChoices("detection_name", "tracking_name"))]
    score: Annotated[
        float, Field(allow_inf_nan=False, validation_alias=AliasChoices("detection_score", "tracking_score"))
    ]
    attribute_name: str = ""
    tracking_id: str | int | None = None


def read_results(path: Path) -> Iterator[tuple[str, list[Truth]]]:
    """Yields the objects of each sample, in the global frame; tracks are numbered in the order of the file.

    Raises:
        FormatError: the file cannot be read or is no such JSON, or a box is invalid; names the sample.
        UnitError: after the last sample: the quaternions have w last.
    """
    tracks: dict[str | int, int] = {}
    quaternions = Quaternions()
    for sample, boxes in read_pairs(path, RESULTS):
        if not isinstance(boxes, list):
            raise FormatError(path, f"results.{sample}: must be a list of boxes")
        yield (
            sample,
            [_truth(path, f"results.{sample}.{n}", each, tracks, quaternions) for n, each in enumerate(boxes)],
        )
    quaternions.require(path)


def _truth(path: Path, where: str, value: object, tracks: dict[str | int, int], quaternions: Quaternions) -> Truth:
    try:
        row = ResultBox.model_validate(value)
        box = box_from(row.translation, row.rotation, row.size)
        quaternions.add(row.rotation)
    except ValidationError as error:
        raise FormatError(path, first_problem(error, where)) from error
    except ValueError as error:
        raise FormatError(path, f"{where}: {error}") from error
    track = None if row.tracking_id is None else tracks.setdefault(row.tracking_id, len(tracks))
    attributes = from_dotted([row.attribute_name] if row.attribute_name else [])
    return Truth(row.label, box, track, row.score, attributes=attributes)
