"""2D training boxes from known 3D boxes (RCV paper, Fig. 5), on camera images and on the first two steps' views.

Only the 2D boxes are stored, as imported boxes around the whole object (`BoxKind.BOX`). The frames stay without 3D
labels, so the detectors learn from 2D boxes alone, as in the paper.
"""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

from annotator.project import Project, StoredFrame, WriteContext
from annotator.project.changes import ImageBoxesSet, Payload, ViewBoxesRemoved, ViewBoxesSet
from annotator.project.overview import FramePage, read_page
from annotator.rcv.known_objects import KnownFrame, boxes_of_known
from annotator.types import BoxKind, Source
from annotator.types.errors import ConfigError, StaleRevisionError
from annotator.types.messages import amount
from annotator.workflows.frame_source import orientation_for
from annotator.workflows.importing.boxes_3d import Reader
from annotator.workflows.importing.label_set import LabelSet, truths_of
from annotator.workflows.importing.placing import NO_NAMES
from annotator.workflows.importing.report import Become, ImportReport, Note, by_class
from annotator.workflows.recorded.own_labels import RecordedLabels
from annotator.workflows.settings import rcv_config
from annotator.workflows.views import geometry_of

FrameName = tuple[str, str]
"""Recording and key."""


def share_of(names: Iterable[FrameName], fraction: float, seed: int) -> frozenset[FrameName]:
    """Chooses a random share of frames, the same share of each recording as far as whole frames allow.

    Frames are ranked within their recording by a hash of their name and the seed. Those with the lowest rank relative
    to the recording's length are chosen. So the frames of a smaller fraction are among those of a larger one with the
    same seed, and adding or removing a frame changes the choice little.

    Args:
        names: recording and key of each frame, in any order.
        fraction: above 0, at most 1; at least one frame is chosen if there is any.
    """
    if not 0 < fraction <= 1:
        raise ConfigError(f"cannot take a fraction of {fraction} of the frames; give more than 0, at most 1")
    recordings: dict[str, list[str]] = defaultdict(list)
    for recording, key in set(names):
        recordings[recording].append(key)
    ranked: list[tuple[float, str, FrameName]] = []
    for recording, keys in recordings.items():
        # a random offset per recording: else the first frames of all short recordings would come before all others
        start = int(_hash(seed, recording)[:8], 16) / 2**32
        hashed = sorted((_hash(seed, recording, key), key) for key in keys)
        ranked += [((rank + start) / len(keys), h, (recording, key)) for rank, (h, key) in enumerate(hashed)]
    count = max(1, round(fraction * len(ranked)))
    return frozenset(name for *_, name in sorted(ranked)[:count])


def _hash(seed: int, *names: str) -> str:
    return hashlib.sha256("\0".join([str(seed), *names]).encode()).hexdigest()


# A later import replaces only the boxes of this author.
AUTHOR = "import of 3D boxes"


@dataclass
class Report2d(ImportReport):
    """The report of 2D boxes made from 3D boxes; `frames`, `boxes` and `views` are those whose boxes are stored now.

    Attributes:
        labelled, chosen: labelled frames, and those chosen for the import.
        objects: objects with boxes on all four views, by class; those with the same image box share their first views.
        view_boxes: boxes on the views; a view has the boxes of all objects that it shows.
        in_all: frames of the project whose image boxes come from such imports, earlier ones included.
    """

    labelled: int = 0
    chosen: int = 0
    objects: Counter[str] = field(default_factory=Counter)
    view_boxes: int = 0
    in_all: int = 0

    def headline(self) -> str:
        views, boxes = amount(self.views, "pseudo-view"), amount(self.view_boxes, "box")
        return (
            f"{self.frames} of {amount(self.labelled, 'labelled frame')}: {by_class(self.boxes)} on camera images; "
            f"{by_class(self.objects)} on {views} with {boxes}; "
            f"{amount(self.in_all, 'frame')} in total with 2D boxes made from 3D boxes"
        )

    def count(self, known: KnownFrame, views: Sequence[ViewBoxesSet]) -> None:
        """Counts a frame whose boxes are stored."""
        self.frames += 1
        self.boxes.update(box.label for box in known.on_image)
        self.objects.update(item.image_box.label for item in known.objects)
        self.views += len(views)
        self.view_boxes += sum(len(view.boxes) for view in views)
        self.add_all(Note.WITHOUT_VIEWS, known.without_views)
        self.add_all(Note.OUTSIDE, known.outside)
        self.add_all(Note.HIDDEN, known.hidden)


def boxes_from_3d(
    project: Project,
    labels: LabelSet,
    *,
    recording: str | None = None,
    names: Mapping[str, str] = NO_NAMES,
    fraction: float = 1.0,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Report2d:
    """Turns known 3D boxes into 2D boxes of the project, frame by frame. Boxes of an earlier import are replaced.

    A frame is stored whole or not at all. Frames with drawn image boxes, finalised frames, views with boxes of another
    author, and frames chosen only by an earlier import are not changed.

    Args:
        fraction: share of the labelled frames, as for `share_of`.
        progress: called with (frames done, frames chosen).
    """
    report = Report2d(Become.FLAT, project.config.classes)
    reader = Reader(project, labels, recording, names, report)
    known = [(name, stored) for name, stored in reader.matched.matched if stored.index is not None]
    recordings = {each.id: each.name for each in project.recordings.all()}
    keys = {stored.id: (recordings[stored.recording_id], stored.key) for _, stored in known}
    share = share_of(keys.values(), fraction, seed)
    chosen = [(name, stored) for name, stored in known if keys[stored.id] in share]
    reader.matched = replace(reader.matched, matched=tuple(chosen))
    report.labelled, report.chosen = len(known), len(chosen)
    config, rotation = rcv_config(project), project.config.settings.rotation

    def convert(name: str, stored: StoredFrame) -> None:
        if _is_drawn(read_page(project, stored.id)):  # checked first, before the slow steps
            report.add(Note.DRAWN)
            return
        frame = reader.frames.read(stored)
        truths = truths_of(reader.dataset, name, frame)
        reader.count(truths)
        in_frame = config.model_copy(update={"orientation": orientation_for(rotation, frame)})
        drawn = boxes_of_known(frame, reader.known(truths), in_frame)
        result = _store(project, stored.id, drawn)
        if result is None:
            report.add(Note.DRAWN)
        else:
            views, others = result
            report.count(drawn, views)
            report.add(Note.OTHERS_VIEWS, others)
            report.add(Note.NOT_REVIEWED, reader.dataset.left_out_of(name).not_reviewed)

    reader.read_all(convert, progress)
    _require_boxes(project, report)
    report.in_all = sum(boxes.author == AUTHOR for boxes in project.boxes.on_images())
    own = labels.flat if isinstance(labels, RecordedLabels) else None
    report.add(Note.FLAT, sum(reader.dataset.left_out_of(name).flat for name, _ in known) if own is None else own)
    return report


def _is_drawn(page: FramePage) -> bool:
    return page.frame.finalised or (page.image_boxes is not None and page.image_boxes.author != AUTHOR)


def _store(project: Project, frame_id: int, known: KnownFrame) -> tuple[Sequence[ViewBoxesSet], int] | None:
    """Stores a frame's boxes; returns the views that have them now, and the number of views that keep boxes of another
    author; None if the frame has drawn boxes by now.
    """
    # two objects with the same image box share their first views, and so the boxes on them
    entries = {
        view: ViewBoxesSet(
            view=view,
            boxes=known_view.boxes,
            box_kind=BoxKind.BOX,
            step=known_view.step,
            geometry=geometry_of(known_view.view, item.image_box),
        )
        for item in known.objects
        for known_view in item.views
        for view in (project.views.store(known_view.view.rgb),)
    }
    while True:
        page = read_page(project, frame_id)
        if _is_drawn(page):
            return None
        present = {view.view_id: view for view in page.view_boxes}
        own = {view_id for view_id, view in present.items() if view.author == AUTHOR}
        new = {view_id: entry for view_id, entry in entries.items() if view_id in own or view_id not in present}
        payloads: list[Payload] = []
        if page.image_boxes is None or page.image_boxes.boxes != known.on_image:
            payloads.append(ImageBoxesSet(boxes=known.on_image, box_kind=BoxKind.BOX))
        for view_id, entry in new.items():
            view = present.get(view_id)
            if view is None or (view.boxes, view.step, view.geometry) != (entry.boxes, entry.step, entry.geometry):
                payloads.append(entry)
        # those of an earlier import
        payloads += [ViewBoxesRemoved(view=view_id) for view_id in present if view_id in own - new.keys()]
        if not payloads:
            return tuple(new.values()), len(entries) - len(new)
        # stale if the frame has changed since it was read, e.g. by an automatic pass: try again
        with suppress(StaleRevisionError):
            project.log.append(frame_id, payloads, WriteContext(page.frame.revision, AUTHOR, Source.IMPORTED))
            return tuple(new.values()), len(entries) - len(new)


def _require_boxes(project: Project, report: Report2d) -> None:
    if report.boxes or report[Note.DRAWN]:
        return
    others = report.of(Note.OTHER_CLASS)
    unreadable = "".join(f"\n  unreadable: {line}" for line in report.of(Note.UNREADABLE))
    raise ConfigError(
        f"{amount(report.chosen, 'frame')} without a box of {', '.join(project.config.classes)} (other classes there: "
        f"{', '.join(sorted(others)) or 'none'}); add these to the project with `annotator classes add`, or map them "
        f"to its own, as in --classes {min(others, default='Car')}={project.config.classes[0]}{unreadable}"
    )
