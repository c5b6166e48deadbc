"""The data of one frame, and of the classes, for the page; each is read in one transaction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from scipy.spatial.transform import RigidTransform
from sqlalchemy import ScalarSelect, bindparam, select

from annotator.project.boxes import ImageBoxes, ViewBoxes, read_image_boxes, read_view_boxes
from annotator.project.classes.attributes import Attribute, ClassStyle
from annotator.project.classes.counts import ClassCounts
from annotator.project.database.schema import frames, recordings
from annotator.project.frames import StoredFrame, frame_of
from annotator.project.labels import StoredLabel, read_stored
from annotator.project.project import Project
from annotator.project.rows import Terms, values_of
from annotator.types.bases import Strict
from annotator.types.errors import NotFoundError
from annotator.types.label import AttributeValue
from annotator.types.messages import amount


@dataclass(frozen=True, eq=False)
class FramePage:
    """All stored data of a frame at one moment.

    Attributes:
        frame: the frame; changes are based on its revision.
        cameras: the frames of its moment, its own included: the frame's id by that of its recording.
        labels: of its moment, in the order of their creation, rejected ones included.
        T_camera_cloud: of a moment with several cameras: from the frame of its cloud; None = they are the same.
    """

    frame: StoredFrame
    previous: int | None
    next: int | None
    recording_name: str
    cameras: Mapping[int, int]
    labels: tuple[StoredLabel, ...]
    image_boxes: ImageBoxes | None
    view_boxes: tuple[ViewBoxes, ...]
    attributes: Mapping[str, AttributeValue] = field(default_factory=dict)
    T_camera_cloud: RigidTransform | None = None

    @property
    def drawn(self) -> tuple[StoredLabel, ...]:
        """The labels that were drawn from a box on this image, not on that of another camera."""
        return tuple(each for each in self.labels if each.is_own and each.image_box is not None)


def read_page(project: Project, frame_id: int) -> FramePage:
    """Reads one frame."""
    with project.store.read() as connection:
        row = connection.execute(_HEAD, {"frame": frame_id}).first()
        if row is None:
            raise NotFoundError(f"the project has no frame with id {frame_id}")
        frame, name = frame_of(row), row.recording_name
        previous, following = row.previous, row.next
        cameras = {row[0]: row[1] for row in connection.execute(_CAMERAS, {"moment": frame.moment_id})}
        stored = read_stored(connection, frame_id)
        boxes, views = read_image_boxes(connection, frame_id), read_view_boxes(connection, frame_id)
        T_camera_cloud = Terms(connection).T_camera_cloud(frame_id) if len(cameras) > 1 else None
    values = values_of(row.attributes)
    return FramePage(frame, previous, following, name, cameras, stored, boxes, views, values, T_camera_cloud)


def neighbours(project: Project, frame: StoredFrame) -> tuple[int | None, int | None]:
    """Ids of the previous and next frame in the recording; both None for a frame without an index."""
    with project.store.read() as connection:
        row = connection.execute(_HEAD, {"frame": frame.id}).first()
    return (None, None) if row is None else (row.previous, row.next)


def _beside(is_before: bool) -> ScalarSelect[Any]:
    """Subquery for the id of the previous or next frame; NULL for a frame without an index."""
    other = frames.alias()
    place = other.c.position
    query = select(other.c.id).where(
        other.c.recording_id == frames.c.recording_id,
        place < frames.c.position if is_before else place > frames.c.position,
    )
    return query.order_by(place.desc() if is_before else place).limit(1).correlate(frames).scalar_subquery()


# Built once, since building this frequent query takes longer than running it.
_HEAD = (
    select(
        frames,
        recordings.c.name.label("recording_name"),
        _beside(is_before=True).label("previous"),
        _beside(is_before=False).label("next"),
    )
    .join(recordings, recordings.c.id == frames.c.recording_id)
    .where(frames.c.id == bindparam("frame"), recordings.c.removed_ns.is_(None))
)
_CAMERAS = (
    select(frames.c.recording_id, frames.c.id)
    .where(frames.c.moment_id == bindparam("moment"), frames.c.position.is_not(None))
    .order_by(frames.c.recording_id)
)


# --- the classes ------------------------------------------------------------------------------------------------------


class ClassRow(Strict):
    """A class as JSON; the counts as in `ClassCounts`.

    Attributes:
        boxes: the counts in words.
    """

    name: str
    boxes: str
    labels: int
    boxes_2d: int
    said: int
    colour: str | None
    key: str | None
    still: bool | None


class ClassList(Strict):
    """The classes and attributes as JSON.

    Attributes:
        values: how many boxes and frames have a value, by attribute.
        words: what each attribute is, for people.
    """

    classes: tuple[ClassRow, ...]
    attributes: tuple[Attribute, ...]
    values: dict[str, int]
    words: dict[str, str]


def list_classes(project: Project) -> ClassList:
    """The classes and attributes of a project, with the numbers of their boxes and values."""
    config, counts, values = project.config, project.class_counts(), project.value_counts()
    return ClassList(
        classes=tuple(_row(name, counts, config.class_styles) for name in config.classes),
        attributes=config.attributes,
        values={name: sum(by_value.values()) for name, by_value in values.items()},
        words={attribute.name: attribute.words() for attribute in config.attributes},
    )


def _row(name: str, counts: Mapping[str, ClassCounts], styles: Mapping[str, ClassStyle]) -> ClassRow:
    count, style = counts.get(name, ClassCounts()), styles.get(name, ClassStyle())
    known = ((count.labels, "3D label"), (count.boxes_2d, "2D box"), (count.said, "further 3D box"))
    boxes = " and ".join(amount(number, noun) for number, noun in known if number) or "no boxes"
    return ClassRow(name=name, boxes=boxes, **vars(count), colour=style.colour, key=style.key, still=style.still)
