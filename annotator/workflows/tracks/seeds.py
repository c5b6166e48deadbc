"""Where the objects of a frame were in the frame before it: what the recursion starts from."""

from __future__ import annotations

from annotator.project import REVIEWED, Project, StoredFrame
from annotator.project.overview import neighbours
from annotator.rcv.seeds import Seed
from annotator.types import Label


def seeds_of(project: Project, frame: StoredFrame) -> tuple[Seed, ...]:
    """The reviewed boxes of the frame before in the same recording, in the order of its labels.

    Returns:
        none where there is no frame before, nobody has reviewed it, or the frames do not follow each other in time.
    """
    return tuple(Seed(label.label, label.box) for label in reviewed_before(project, frame))


def reviewed_before(project: Project, frame: StoredFrame) -> tuple[Label, ...]:
    """The labels that `seeds_of` makes its seeds from, in the same order."""
    if not project.recordings.get(frame.recording_id).is_sequence:
        return ()
    before = neighbours(project, frame)[0]
    if before is None:
        return ()
    return tuple(label for label in project.labels.of_frame(before) if label.state in REVIEWED)
