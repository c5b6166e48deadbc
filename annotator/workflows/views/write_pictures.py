"""Writes pseudo-views as images, to be labelled with any 2D tool and imported again as COCO.

This takes two rounds: the first step's views come from the boxes on camera images, the second step's views from the
boxes drawn on the first step's. `views.json` beside the images holds the geometry of each, which the import needs to
interpret the boxes.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from annotator.files import new_folder
from annotator.formats.coco import CocoImage, write_coco
from annotator.project import Project, StoredFrame, ViewBoxes
from annotator.rcv.axes import frame_with_normals
from annotator.rcv.config import RcvConfig
from annotator.rcv.known_objects import first_views, next_views
from annotator.types import Box2D, Frame, PseudoView
from annotator.types.errors import ConfigError, FormatError, FrameError
from annotator.workflows.frame_source import FrameSource, orientation_for
from annotator.workflows.views.pairs import front_and_side, views_by_object
from annotator.workflows.views.places import ViewPlace, geometry_of, spans_m, write_places

COCO = "coco.json"


@dataclass(frozen=True)
class WrittenViews:
    """Number of images written, and the labelled frames that could not be read, as `key: reason`."""

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
    """Writes the pseudo-views of one step for every object that has the boxes it needs. The folder is written whole or
    not at all.

    Args:
        out: a new folder for PNG images, `views.json`, and a `coco.json` that lists the images without boxes.
        step: 1 (from the boxes on camera images) or 2 (from those on the first step's views).

    Raises:
        ConfigError: the folder exists, there is no such step, or no object has the boxes it needs.
        FormatError: the folder cannot be written.
    """
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise ConfigError(f"{out}: exists already; choose a new folder for the images")
    if step not in (1, 2):
        raise ConfigError(f"there is no step {step}; choose 1 or 2")
    frames = _Frames(project, config)
    images: list[CocoImage] = []
    places: list[ViewPlace] = []
    with new_folder(out, lambda _: False) as folder:
        for drawn in _first(frames) if step == 1 else _second(frames):
            for side, view in zip(("front", "side"), drawn.views, strict=True):
                place = _place(frames, drawn, side, view)
                _write_image(folder / place.file_name, view)
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


def _write_image(path: Path, view: PseudoView) -> None:
    _, data = cv2.imencode(".png", np.ascontiguousarray(view.rgb[:, :, ::-1]))
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise FormatError(path, f"cannot be written ({error.strerror}); no files were kept") from error


class _Frames:
    """Reads labelled frames, and collects the errors of those that cannot be read."""

    def __init__(self, project: Project, config: RcvConfig) -> None:
        self.project, self.config = project, config
        self.source = FrameSource(project)
        self.unreadable: list[str] = []

    def read(self, frame_id: int) -> tuple[StoredFrame, Frame, RcvConfig] | None:
        """Returns a frame with the settings for its views; None if it cannot be read."""
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
