"""Pseudo-views as pictures in a folder, to be labelled with any 2D tool and imported again as COCO.

An operator's procedure in two rounds: the first step's views come from the boxes on the camera images, the second
step's from the boxes drawn on the first's. `views.json` beside the pictures says where each lies in space, so that the
import knows what a box on it means.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from annotator.formats.coco import CocoImage, write_coco
from annotator.project import Project, StoredFrame, ViewBoxes, ViewGeometry
from annotator.rcv.config import RcvConfig
from annotator.rcv.operator import first_views, next_views
from annotator.types import Box2D, Frame, PseudoView
from annotator.types.errors import ConfigError, FormatError
from annotator.workflows.frames import FrameSource, orientation_for

SIDECAR, COCO = "views.json", "coco.json"


class ViewPlace(BaseModel):
    """Where a picture of a pseudo-view comes from."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    file_name: str
    recording: str
    frame: str
    step: int
    geometry: ViewGeometry


_PLACES: TypeAdapter[tuple[ViewPlace, ...]] = TypeAdapter(tuple[ViewPlace, ...])


@dataclass(frozen=True, eq=False)
class _Drawn:
    stored: StoredFrame
    number: int
    step: int
    image_box: Box2D
    views: tuple[PseudoView, PseudoView]


def write_views(project: Project, out: Path, step: int, config: RcvConfig) -> int:
    """Writes the pseudo-views of one step of every object that is ready for it; the number of pictures.

    Args:
        out: a new folder: PNG pictures, `views.json`, and `coco.json` with the pictures but no boxes yet.
        step: 1 (from the boxes on camera images) or 2 (from those on the first step's views).

    Raises:
        ConfigError: the folder is there already, or no object is ready.
    """
    if out.exists() and any(out.iterdir()):
        raise ConfigError(f"{out}: is not empty; choose a new folder for the pictures")
    if step not in (1, 2):
        raise ConfigError(f"there is no step {step} to label; the steps are 1 and 2")
    out.mkdir(parents=True, exist_ok=True)
    source, images, places = FrameSource(project), [], []
    for drawn in _first(project, source, config) if step == 1 else _second(project, source, config):
        name = source.stored(drawn.stored.recording_id).name
        for side, view in zip(("front", "side"), drawn.views, strict=True):
            file_name = f"{name}_{drawn.stored.key}_{drawn.number:02d}_step{step}_{side}.png"
            height_px, width_px = view.rgb.shape[:2]
            cv2.imwrite(str(out / file_name), view.rgb[:, :, ::-1])
            images.append(CocoImage(file_name, width_px, height_px, ()))
            geometry = geometry_of(view, drawn.image_box)
            places.append(
                ViewPlace(file_name=file_name, recording=name, frame=drawn.stored.key, step=step - 1, geometry=geometry)
            )
    if not images:
        needed = "boxes on camera images" if step == 1 else "boxes on both views of the first step"
        raise ConfigError(f"project {project.config.name} has no object with {needed} yet")
    (out / SIDECAR).write_bytes(_PLACES.dump_json(tuple(places), indent=1))
    write_coco(out / COCO, images, project.config.classes)
    return len(images)


def read_places(pictures: Path) -> dict[str, ViewPlace]:
    """By file name, where the pictures of a folder come from; empty without `views.json`.

    Raises:
        FormatError: a damaged `views.json`.
    """
    file = pictures / SIDECAR
    if not file.is_file():
        return {}
    try:
        return {place.file_name: place for place in _PLACES.validate_json(file.read_bytes())}
    except ValidationError as error:
        raise FormatError(file, f"is damaged: {error.errors()[0]['msg']}; write the views again") from error


def geometry_of(view: PseudoView, image_box: Box2D) -> ViewGeometry:
    """How a pseudo-view of a box's frustum lies in space, for the store."""
    return ViewGeometry.model_validate(
        {
            "axes": view.axes.tolist(),
            "metres_per_px": view.metres_per_px,
            "origin_m": view.origin_m.tolist(),
            "image_box": image_box,
        }
    )


def _first(project: Project, source: FrameSource, config: RcvConfig) -> Iterator[_Drawn]:
    for boxes in project.boxes.on_images():
        stored = project.frames.get(boxes.frame_id)
        frame = source.read(stored)
        settings = _settings(project, frame, config)
        for number, box in enumerate(boxes.boxes):
            views = first_views(frame, box, settings)
            if views is not None:
                yield _Drawn(stored, number, 1, box, views)


def _second(project: Project, source: FrameSource, config: RcvConfig) -> Iterator[_Drawn]:
    by_frame: dict[int, dict[Box2D, list[ViewBoxes]]] = defaultdict(lambda: defaultdict(list))
    for view in project.boxes.on_views():
        if view.frame_id is not None and view.step == 0 and view.geometry and view.geometry.image_box and view.boxes:
            by_frame[view.frame_id][view.geometry.image_box].append(view)
    for frame_id, objects in by_frame.items():
        stored = project.frames.get(frame_id)
        frame = source.read(stored)
        settings = _settings(project, frame, config)
        for number, (image_box, views) in enumerate(objects.items()):
            spans = [(np.array(v.geometry.axes), spans_m(v)) for v in views if v.geometry is not None]
            following = next_views(frame, image_box, spans, settings) if len(spans) == 2 else None
            if following is not None:
                yield _Drawn(stored, number, 2, image_box, following)


def spans_m(view: ViewBoxes) -> np.ndarray:
    """(2, 2) view coordinates, metres, that the first box on a stored view spans: rows x and y, columns low, high."""
    assert view.geometry is not None  # only views whose place is known are asked
    box, scale = view.boxes[0], view.geometry.metres_per_px
    edges = np.array([[box.x_min, box.x_max], [box.y_min, box.y_max]])
    return np.array(view.geometry.origin_m)[:, None] + edges * scale


def _settings(project: Project, frame: Frame, config: RcvConfig) -> RcvConfig:
    orientation = orientation_for(project.config.settings.rotation, frame)
    return config.model_copy(update={"orientation": orientation})
