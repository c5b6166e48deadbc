"""The generated people with their true boxes, and what an operator and a pass do with them."""

from __future__ import annotations

from typing import Any

from moving import ANN

from annotator.project import NewLabel, Project, StoredFrame, WriteContext
from annotator.types import Box2D, Label, OrientedBox, Proposal, Quality, Source, Truth
from annotator.workflows.tracks.follow_run import Following, FollowRun, follow_from_frame, follow_recording
from annotator.workflows.workbench.loaded_detectors import ReadyDetector


class Room:
    """The generated people, their true boxes, and a view detector that knows these."""

    def __init__(self, project: Project, truths: list[list[Truth]], view: ReadyDetector) -> None:
        self.project, self.truths, self.view = project, truths, view

    @property
    def frames(self) -> list[StoredFrame]:
        return list(self.project.frames.of())

    def context(self, index: int, author: str = ANN) -> WriteContext:
        return WriteContext(self.frames[index].revision, author)

    def accept(self, index: int, people: int = 3, *, tracked: bool = True) -> list[str]:
        """Accepts the true boxes of the first people in a frame; returns their labels."""
        new = [
            NewLabel(truth.label, truth.box, track_id=truth.track_id if tracked else None)
            for truth in self.truths[index][:people]
        ]
        return list(self.project.labels.create(self.frames[index].id, new, self.context(index)).uids)

    def accept_box(self, index: int, box: OrientedBox, track_id: int | None = 3, **more: Any) -> str:
        """Accepts a box in a frame; returns its label."""
        new = NewLabel("person", box, track_id=track_id, **more)
        return self.project.labels.create(self.frames[index].id, [new], self.context(index)).uids[0]

    def propose(self, index: int, *boxes: OrientedBox) -> list[Any]:
        """What a pass proposes in a frame; returns the labels."""
        on_image, quality = Box2D("person", 0.0, 0.0, 9.0, 9.0), Quality(0.1, 0.9, 0.01)
        found = [Proposal("person", 0.8, box, on_image, (), quality) for box in boxes]
        context = WriteContext(self.frames[index].revision, "rcv", Source.AUTO)
        return list(self.project.proposals.replace(self.frames[index].id, found, context).uids)

    def labels(self, index: int) -> list[Label]:
        return list(self.project.labels.of_frame(self.frames[index].id))

    @property
    def counts(self) -> list[int]:
        return [len(self.labels(index)) for index in range(5)]

    def box(self, index: int, person: int = 0) -> OrientedBox:
        return self.truths[index][person].box

    def truth(self, index: int, label: Label) -> Truth:
        return next(truth for truth in self.truths[index] if truth.track_id == label.track_id)

    def run(self, index: int = 0, uid: str | None = None, *, forward: bool = True) -> FollowRun:
        frame = self.frames[index]
        return follow_from_frame(self.project, frame.id, frame.revision, self.view, ANN, uid=uid, forward=forward)

    @property
    def recording(self) -> int:
        return self.project.recordings.all()[0].id

    def all(self, view: ReadyDetector | None, **options: Any) -> Following:
        return follow_recording(self.project, self.recording, view, ANN, **options)
