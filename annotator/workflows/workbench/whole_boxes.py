"""The whole boxes that are offered for an object whose silhouettes are drawn (`rcv.whole_box`)."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence

from annotator.project import BoxRotation, Project, StoredFrame, ViewBoxes
from annotator.rcv.recursion import held_direction
from annotator.rcv.whole_box import Offered, SeenObject, whole_boxes
from annotator.types import Box2D, BoxKind, Frame
from annotator.types.errors import FrameError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.training.samples import drawn_objects, taught_by_drags
from annotator.workflows.workbench.drawing_steps import frame_config
from annotator.workflows.workbench.loaded_detectors import ReadyDetector

# Frames whose drawn objects are kept; one object takes some 200 kB.
MOST_FRAMES = 300


class WholeBoxes:
    """Offers whole boxes for the drawn objects of a project; remembers what its frames show of them. Thread-safe."""

    def __init__(self, project: Project, read: Callable[[StoredFrame], Frame] | None = None) -> None:
        """
        Args:
            read: reads a frame of the project; None = with a `FrameSource`, for recordings that stay where they are.
        """
        self.project = project
        self._read_frame = read or FrameSource(project).read
        self._lock = threading.Lock()
        self._seen: OrderedDict[tuple[int, BoxRotation, int, tuple[int, ...]], list[SeenObject]] = OrderedDict()

    def of(self, frame: Frame, stored: StoredFrame, image_box: Box2D, detector: ReadyDetector | None) -> list[Offered]:
        """Returns the boxes that a drawn object may have, best first; none while its silhouettes are not all drawn.

        Args:
            frame, stored: its frame.
            image_box: drawn on the camera image.
            detector: for pseudo-views; used if it knows whole boxes.
        """
        views = [one for one in self._drawn(stored.id) if _image_box(one) == image_box]
        cut = taught_by_drags(frame, views[0]) if views else None
        seen = next((one for one in self._objects(stored, frame) if one.image_box == image_box), None)
        if cut is None or cut.points is None or seen is None:
            return []
        config = frame_config(self.project, frame, detector, BoxKind.BOX, BoxKind.SILHOUETTE)
        view = detector if config.box_kind is BoxKind.BOX else None
        cloud = frame.cloud.select(cut.points)
        before, after = self._others(stored, image_box.label)
        return whole_boxes(seen, cloud, before, after, view, config)

    def _others(self, stored: StoredFrame, label: str) -> tuple[Iterator[list[SeenObject]], Iterator[list[SeenObject]]]:
        """The drawn objects of a class in the frames before and after, the nearest first, read one by one."""
        labelled = self.project.boxes.frames_with_images()
        frames = [one for one in self.project.frames.of([stored.recording_id]) if one.index is not None]
        place = next((n for n, one in enumerate(frames) if one.id == stored.id), len(frames))
        before, after = frames[:place][::-1], frames[place + 1 :]
        both = [
            (
                found
                for one in side
                if one.id in labelled
                if (found := [seen for seen in self._objects(one) if seen.image_box.label == label])
            )
            for side in (before, after)
        ]
        return both[0], both[1]

    def _drawn(self, frame_id: int) -> list[tuple[ViewBoxes, ...]]:
        return drawn_objects(self.project.boxes.on_views_of(frame_id)).get(frame_id, [])

    def _objects(self, stored: StoredFrame, frame: Frame | None = None) -> list[SeenObject]:
        """The drawn objects of a frame; none if it cannot be read."""
        drawn = self._drawn(stored.id)
        rotation = self.project.config.settings.rotation
        # what is seen lies in the camera frame, which a correction of the calibration moves
        adjusted = self.project.adjustments.newest(stored.recording_id)
        key = stored.id, rotation, adjusted, tuple(view.event_id for views in drawn for view in views)
        if not drawn:
            return []
        # one frame at a time: reading takes 0.1 s, and recordings need not be thread-safe
        with self._lock:
            if key not in self._seen:
                try:
                    self._seen[key] = self._read(self._read_frame(stored) if frame is None else frame, drawn)
                except FrameError:
                    return []  # another frame; the operator sees the problem when it is opened
                while len(self._seen) > MOST_FRAMES:
                    self._seen.popitem(last=False)
            self._seen.move_to_end(key)
            return self._seen[key]

    def _read(self, frame: Frame, drawn: Sequence[tuple[ViewBoxes, ...]]) -> list[SeenObject]:
        up = held_direction(frame.up, frame_config(self.project, frame))
        objects = []
        for views in drawn:
            cut, image_box = taught_by_drags(frame, views), _image_box(views)
            if cut is not None and cut.points is not None and image_box is not None:
                objects.append(SeenObject.of(frame, cut.points, image_box, cut.box.rotation, up))
        return objects


def _image_box(views: Sequence[ViewBoxes]) -> Box2D | None:
    return None if views[0].geometry is None else views[0].geometry.image_box
