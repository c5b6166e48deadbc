"""Pseudo-views as pictures in a folder, to be labelled with any 2D tool and imported again as COCO.

An operator's procedure in two rounds: the first step's views come from the boxes on the camera images, the second
step's from the boxes drawn on the first's. `views.json` beside the pictures says where each lies in space, so that the
import knows what a box on it means.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from annotator.files import new_folder
from annotator.formats.coco import CocoImage, write_coco
from annotator.formats.json_file import write_text
from annotator.project import Project, StoredFrame, ViewBoxes, ViewGeometry
from annotator.rcv.config import RcvConfig
from annotator.rcv.normals import frame_with_normals
from annotator.rcv.operator import first_views, next_views
from annotator.types import Box2D, Frame, PseudoView
from annotator.types.errors import ConfigError, FormatError, FrameError
from annotator.workflows.frames import FrameSource, orientation_for
from annotator.workflows.view_pairs import front_and_side, views_by_object

SIDECAR, COCO = "views.json", "coco.json"


class ViewPlace(BaseModel):
    """Where a picture of a pseudo-view comes from.

    Attributes:
        file_name: of the picture.
        recording, frame: its frame; None for a picture from elsewhere, which is only there to learn from.
        step, geometry: of the recursion, from 0, and in space; None where they are not known.
        labelled: somebody has looked at it, so that no box means that it shows nothing.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    file_name: str
    recording: str | None
    frame: str | None
    step: int | None
    geometry: ViewGeometry | None
    labelled: bool = False


_PLACES: TypeAdapter[tuple[ViewPlace, ...]] = TypeAdapter(tuple[ViewPlace, ...])


@dataclass(frozen=True)
class WrittenViews:
    """How many pictures were written, and the labelled frames that could not be read, as `key: reason`."""

    pictures: int
    unreadable: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Drawn:
    stored: StoredFrame
    number: int
    step: int
    image_box: Box2D
    views: tuple[PseudoView, PseudoView]


def write_views(project: Project, out: Path, step: int, config: RcvConfig) -> WrittenViews:
    """Writes the pseudo-views of one step of every object that is ready for it; complete, or not at all.

    Args:
        out: a new folder: PNG pictures, `views.json`, and `coco.json` with the pictures but no boxes yet.
        step: 1 (from the boxes on camera images) or 2 (from those on the first step's views).

    Raises:
        ConfigError: the folder is there already, there is no such step, or no object is ready.
        FormatError: the folder cannot be written.
    """
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise ConfigError(f"{out}: is there already; choose a new folder for the pictures")
    if step not in (1, 2):
        raise ConfigError(f"there is no step {step} to label; the steps are 1 and 2")
    frames = _Frames(project, config)
    images: list[CocoImage] = []
    places: list[ViewPlace] = []
    with new_folder(out, lambda _: False) as folder:
        for drawn in _first(frames) if step == 1 else _second(frames):
            for side, view in zip(("front", "side"), drawn.views, strict=True):
                place = _place(frames, drawn, side, view)
                _write_picture(folder / place.file_name, view)
                images.append(CocoImage(place.file_name, view.rgb.shape[1], view.rgb.shape[0], ()))
                places.append(place)
        if not images:
            needed = "boxes on camera images" if step == 1 else "boxes on both views of the first step"
            unreadable = "".join(f"\n  unreadable: {line}" for line in frames.unreadable)
            raise ConfigError(f"project {project.config.name} has no object with {needed} yet{unreadable}")
        write_places(folder, places)
        write_coco(folder / COCO, images, project.config.classes)
    return WrittenViews(len(images), tuple(frames.unreadable))


def _place(frames: _Frames, drawn: _Drawn, side: str, view: PseudoView) -> ViewPlace:
    recording = frames.source.stored(drawn.stored.recording_id).name
    stem = re.sub(r"[^\w.-]+", "_", f"{recording}_{drawn.stored.key}_{drawn.number:02d}_step{drawn.step}_{side}")
    return ViewPlace(
        file_name=f"{stem}.png",
        recording=recording,
        frame=drawn.stored.key,
        step=drawn.step - 1,
        geometry=geometry_of(view, drawn.image_box),
    )


def _write_picture(path: Path, view: PseudoView) -> None:
    _, data = cv2.imencode(".png", np.ascontiguousarray(view.rgb[:, :, ::-1]))
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise FormatError(path, f"cannot be written ({error.strerror}); nothing was left behind") from error


def write_places(pictures: Path, places: Sequence[ViewPlace]) -> None:
    """Writes `views.json` into a folder of pictures.

    Raises:
        FormatError: the file cannot be written.
    """
    write_text(pictures / SIDECAR, _PLACES.dump_json(tuple(places), indent=1).decode())


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
    return ViewGeometry.of(view).model_copy(update={"image_box": image_box})


class _Frames:
    """Reads labelled frames; remembers those that cannot be read, so that the others still get their pictures."""

    def __init__(self, project: Project, config: RcvConfig) -> None:
        self.project, self.config = project, config
        self.source = FrameSource(project)
        self.unreadable: list[str] = []

    def read(self, frame_id: int) -> tuple[StoredFrame, Frame, RcvConfig] | None:
        """A frame, with the settings for its views."""
        stored = self.project.frames.get(frame_id)
        try:
            frame = self.source.read(stored)
        except FrameError as error:
            self.unreadable.append(f"{stored.key}: {error}")
            return None
        orientation = orientation_for(self.project.config.settings.rotation, frame)
        return stored, frame, self.config.model_copy(update={"orientation": orientation})


def _first(frames: _Frames) -> Iterator[_Drawn]:
    for boxes in frames.project.boxes.on_images():
        read = frames.read(boxes.frame_id) if boxes.boxes else None
        if read is None:
            continue
        stored, frame, settings = read
        for number, box in enumerate(boxes.boxes):
            views = first_views(frame, box, settings)
            if views is not None:
                yield _Drawn(stored, number, 1, box, views)


def _second(frames: _Frames) -> Iterator[_Drawn]:
    by_frame: dict[int, list[tuple[Box2D, tuple[ViewBoxes, ViewBoxes]]]] = defaultdict(list)
    for (frame_id, image_box), steps in views_by_object(frames.project.boxes.on_views()).items():
        pair = front_and_side(steps[0])
        if pair is not None:
            by_frame[frame_id].append((image_box, pair))
    for frame_id, objects in by_frame.items():
        read = frames.read(frame_id)
        if read is None:
            continue
        stored, frame, settings = read
        frame = frame_with_normals(frame, [image_box for image_box, _ in objects], settings)
        for number, (image_box, pair) in enumerate(objects):
            spans = [(np.array(v.geometry.axes), spans_m(v)) for v in pair if v.geometry is not None]
            following = next_views(frame, image_box, spans, settings)
            if following is not None:
                yield _Drawn(stored, number, 2, image_box, following)


def spans_m(view: ViewBoxes) -> np.ndarray:
    """(2, 2) view coordinates, metres, that the first box on a stored view spans: rows x and y, columns low, high."""
    assert view.geometry is not None  # only views whose place is known are asked
    box, scale = view.boxes[0], view.geometry.metres_per_px
    edges = np.array([[box.x_min, box.x_max], [box.y_min, box.y_max]])
    return np.array(view.geometry.origin_m)[:, None] + edges * scale
