"""The origin of pseudo-view images: `views.json` beside them, and the store's geometry of a view."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from annotator.files import TABLE_BYTES, read_file
from annotator.formats.json_file import write_text
from annotator.project import ViewBoxes, ViewGeometry
from annotator.types import Box2D, PseudoView
from annotator.types.errors import FormatError

SIDECAR = "views.json"


class ViewPlace(BaseModel):
    """The origin of a pseudo-view image.

    Attributes:
        file_name: of the image.
        recording, frame: its frame; None for an image from elsewhere, which is used for training only.
        step: of the recursion, from 0; None if unknown.
        geometry: the view's position and axes in space; None if unknown.
        labelled: True if it was reviewed: without boxes it then shows no object.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    file_name: str
    recording: str | None
    frame: str | None
    step: int | None
    geometry: ViewGeometry | None
    labelled: bool = False


_PLACES: TypeAdapter[tuple[ViewPlace, ...]] = TypeAdapter(tuple[ViewPlace, ...])


def write_places(pictures: Path, places: Sequence[ViewPlace]) -> None:
    """Writes `views.json` into a folder of images.

    Raises:
        FormatError: the file cannot be written.
    """
    write_text(pictures / SIDECAR, _PLACES.dump_json(tuple(places), indent=1).decode())


def read_places(pictures: Path) -> dict[str, ViewPlace]:
    """Reads `views.json` of a folder of images, by file name; empty if there is none.

    Raises:
        FormatError: `views.json` is damaged.
    """
    file = pictures / SIDECAR
    if not file.is_file():
        return {}
    try:
        return {place.file_name: place for place in _PLACES.validate_json(read_file(file, TABLE_BYTES))}
    except OSError as error:
        raise FormatError(file, f"cannot be read ({error.strerror})") from error
    except ValidationError as error:
        raise FormatError(file, f"is damaged: {error.errors()[0]['msg']}; write the views again") from error


def geometry_of(view: PseudoView, image_box: Box2D) -> ViewGeometry:
    """Returns the geometry of a pseudo-view for the store.

    Args:
        image_box: the box on the camera image whose frustum the view shows.
    """
    return ViewGeometry.of(view).model_copy(update={"image_box": image_box})


def spans_m(view: ViewBoxes) -> np.ndarray:
    """Returns the span of the first box on a stored view, view coordinates in metres, (2, 2): rows x, y; columns low,
    high."""
    assert view.geometry is not None  # callers pass only views with known geometry
    box, scale = view.boxes[0], view.geometry.metres_per_px
    edges = np.array([[box.x_min, box.x_max], [box.y_min, box.y_max]])
    return np.array(view.geometry.origin_m)[:, None] + edges * scale
