"""Fits the boxes that have filled a gap to the points of their frames, one after the other."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import same_box
from annotator.project import Project, StoredFrame
from annotator.project.changes import NewLabel
from annotator.types import Label, OrientedBox, ReviewState
from annotator.types.errors import FrameError, NotFoundError, StaleRevisionError
from annotator.workflows.tracks.follow_objects import FollowedTrack, StoppedAt
from annotator.workflows.tracks.follow_run import TRIES, Following
from annotator.workflows.tracks.operations import Done
from annotator.workflows.tracks.propose_boxes import Surroundings, changed_box, write
from annotator.workflows.workbench.drawing_steps import frame_config
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.loaded_detectors import ReadyDetector
from annotator.workflows.workbench.refit import refit

# 3D IoU of the fitted with the given box below which the fit is rejected: it has found another object, or a part.
MIN_IOU = 0.4

FitBox = Callable[[StoredFrame, Label], OrientedBox]
"""The box of a label, fitted to the points of its frame.

Its own box if the fit is rejected, or if the detector measures another kind of box.
"""


def box_fitter(
    project: Project, open_frame: Callable[[StoredFrame], OpenFrame], detector: ReadyDetector | None
) -> FitBox:
    """Returns a function that fits boxes.

    Args:
        open_frame: returns a frame; its errors are passed on.
        detector: for pseudo-views; without one the sides move to the points inside.
    """

    def fit(frame: StoredFrame, label: Label) -> OrientedBox:
        opened = open_frame(frame)
        config = frame_config(project, opened.frame, detector, label.box_kind)
        if detector is not None and config.box_kind is not label.box_kind:
            return label.box
        fitted = refit(opened, label.box, label.label, config, detector).box or label.box
        return fitted if iou_3d(fitted, label.box) >= MIN_IOU else label.box

    return fit


class RefitRun:
    """Boxes that `Fill` has proposed, while they are fitted, as a part of its action. A run like those that follow.

    A box that somebody has changed, reviewed or removed meanwhile stays as it is; so do those left after a stop.
    """

    def __init__(self, project: Project, done: Done, author: str, fit: FitBox) -> None:
        """
        Args:
            done: what `Fill` has done.
        """
        self._project, self._author, self._fit, self.action = project, author, fit, done.action
        self._boxes = [(id, each) for id, events in done.changes for each in events if isinstance(each, NewLabel)]
        self._done = self._fitted = 0
        self._stops: list[StoppedAt] = []

    @property
    def state(self) -> Following:
        """The state between two boxes."""
        first = self._boxes[0][1]
        track = FollowedTrack(
            first.uid, first.track_id, first.label, self._fitted, doubtful=0, stops=tuple(self._stops), is_open=False
        )
        return Following(self._done, len(self._boxes), (track,), None)

    def run(
        self,
        progress: Callable[[Following], object] = lambda _: None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> Following:
        """Fits the boxes, and stores each at once; `progress` is called after each."""
        for frame_id, box in self._boxes:
            if stopped():
                break
            frame = self._project.frames.get(frame_id)
            try:
                self._store(frame, box)
            except FrameError as error:
                self._stops.append(StoppedAt(frame.id, frame.key, str(error)))
            self._done += 1
            progress(self.state)
        return self.state

    def _store(self, frame: StoredFrame, box: NewLabel) -> None:
        fitted: OrientedBox | None = None
        for _ in range(TRIES):
            with suppress(StaleRevisionError):
                try:
                    stored = self._project.labels.get(box.uid)
                except NotFoundError:
                    return
                if stored.label.state is not ReviewState.PROPOSED or not same_box(stored.label.box, box.box):
                    return
                fitted = self._fit(frame, stored.label) if fitted is None else fitted
                if same_box(fitted, stored.label.box):
                    return
                there = Surroundings(self._project, [(frame, fitted, stored.label.track_id)])
                if there.is_finalised(frame, stored) or not (events := changed_box(there, frame, stored, box=fitted)):
                    return
                write(self._project, [(frame, events)], self._author, action=self.action)
                self._fitted += 1
                return
            frame = self._project.frames.get(frame.id)
