"""Measures view detectors on the reviewed objects of held-out frames.

A fixed fifth of the frames, drawn by a hash of their recordings and keys (`detection.dataset`), never trains a
detector. Its reviewed 3D boxes decide what a training starts from, and which view detector the project uses afterwards.
A detector gets the objects' boxes on the image, slightly wrong, as an operator would draw them; the measure is the mean
exact 3D IoU of the boxes that it then finds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from annotator.detection.dataset import is_held_out
from annotator.detection.trained import read_trained
from annotator.files import write_atomic
from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import contains
from annotator.geometry.outline import box_on_image
from annotator.project import Project
from annotator.project.config import BoxRotation
from annotator.rcv.config import RcvConfig
from annotator.types import Box2D, BoxKind, Camera, Detector, Frame, Label, OrientedBox
from annotator.types.bases import Strict
from annotator.types.errors import FrameError
from annotator.workflows.detectors import UsedModel, load_detector
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.proposing.lift import propose_image_boxes
from annotator.workflows.settings import rcv_config
from annotator.workflows.training.samples import frame_group

DECISION_NAME = "held_out.json"
# With fewer objects, the measurement would be chance. More objects than the maximum would take too long.
MIN_OBJECTS, MOST_OBJECTS = 5, 40
FOUND_NONE = "it finds none of the reviewed objects on held-out frames"
# Objects with fewer points are not measured.
MIN_POINTS = 20
# Error of each edge of the boxes on the image, and the shortest side of a box that is used, pixels.
JITTER_PX, MIN_SIDE_PX = 2.0, 2.0


class Rival(Strict):
    """A detector that was compared: its name for people, and its mean IoU on the held-out objects."""

    name: str
    mean_iou: float


class Decision(Strict):
    """How held-out frames decided about a new detector; stored beside its weights.

    Attributes:
        objects, frames: number of reviewed objects measured, and of their frames.
        mean_iou: of the new detector; None with fewer than `MIN_OBJECTS` objects.
        outcome: which detector the project used from then on, and why, in words.
        reviewed: number of the project's reviewed boxes when the training began.
    """

    objects: int
    frames: int
    mean_iou: float | None
    compared: tuple[Rival, ...]
    started_from: str
    outcome: str
    reviewed: int | None = None

    def write(self, folder: Path) -> None:
        write_atomic(folder / DECISION_NAME, self.model_dump_json(indent=1).encode())


def measured_ious(decision: Decision) -> str:
    """The mean IoU of the new detector and of the others, for people."""
    figures = [] if decision.mean_iou is None else [f"this detector {decision.mean_iou:.2f}"]
    return ", ".join(figures + [f"{rival.name} {rival.mean_iou:.2f}" for rival in decision.compared])


_HeldOutFrame = tuple[Frame, list[Box2D], list[OrientedBox]]
"""A frame, the boxes on its image that its objects are measured from, and their true boxes."""

Found = tuple[Frame, list[OrientedBox | None], list[OrientedBox]]
"""A frame, the boxes that a detector finds, None where it finds none, and the true boxes."""


class HeldOut:
    """The reviewed objects on a project's held-out frames; frames that cannot be read are left out.

    Attributes:
        found: what the detector that was measured last finds on each frame.
    """

    def __init__(
        self,
        project: Project,
        labels: Mapping[int, Sequence[Label]],
        check_stop: Callable[[], None] = lambda: None,
        kind: BoxKind = BoxKind.BOX,
    ) -> None:
        """
        Args:
            labels: reviewed labels by frame id.
            check_stop: called before each frame is read or measured; may raise to end that.
            kind: what the labels' boxes enclose.
        """
        self._project, self._check_stop, self._kind = project, check_stop, kind
        self._frames: list[_HeldOutFrame] = []
        self.found: list[Found] = []
        source = FrameSource(project)
        held_out = [
            stored for stored in project.frames.of() if stored.id in labels and is_held_out(frame_group(stored))
        ]
        # an order that does not depend on time
        held_out.sort(key=lambda stored: (stored.id * 2654435761) % 2**32)
        self._held_out = frozenset(stored.id for stored in held_out)
        for stored in held_out:
            if self.objects >= MOST_OBJECTS:
                break
            check_stop()
            try:
                frame = source.read(stored)
            except FrameError:  # reported by the training, which reads it, too
                continue
            measured = _measured(frame, labels[stored.id], np.random.default_rng([0, stored.id]))
            if measured[2]:
                self._frames.append(measured)

    @property
    def objects(self) -> int:
        return sum(len(truths) for _, _, truths in self._frames)

    @property
    def frames(self) -> int:
        return len(self._frames)

    @property
    def decides(self) -> bool:
        """True if there are enough objects to decide between detectors."""
        return self.objects >= MIN_OBJECTS

    def mean_iou(self, model: UsedModel) -> float:
        """Mean 3D IoU of the boxes that a view detector finds from the objects' boxes on the image.

        A class-agnostic detector measures what the labels enclose, since it knows both kinds of boxes.
        """
        self.found = list(self._looked_for(model))
        pairs = ((box, truth) for _, boxes, truths in self.found for box, truth in zip(boxes, truths, strict=True))
        return float(np.mean([0.0 if box is None else iou_3d(box, truth) for box, truth in pairs]))

    def _looked_for(self, model: UsedModel) -> Iterator[Found]:
        detector = load_detector(model.path, names=model.names)
        view_px = read_trained(model.path.parent).image_size_px
        config = rcv_config(self._project, view_px=view_px, without_frames=self._held_out)
        kind = self._kind if model.class_agnostic else model.box_kind
        config = config.for_detector(kind, model.class_agnostic, trained=model.trained)
        rotation = self._project.config.settings.rotation
        for frame, image_boxes, truths in self._frames:
            self._check_stop()
            yield frame, lifted(frame, image_boxes, detector, config, rotation), truths


def held_out_groups(project: Project) -> frozenset[str]:
    """The groups of the training samples of all held-out frames."""
    return frozenset(group for stored in project.frames.of() if is_held_out(group := frame_group(stored)))


def lifted(
    frame: Frame, image_boxes: Sequence[Box2D], detector: Detector, config: RcvConfig, rotation: BoxRotation
) -> list[OrientedBox | None]:
    """The best 3D box that a view detector finds from each 2D box, or None."""
    (result,) = propose_image_boxes([frame], [image_boxes], detector, config, rotation)
    best: dict[int, OrientedBox] = {}
    for proposal in result.proposals:  # best first
        best.setdefault(id(proposal.image_box), proposal.box)
    return [best.get(id(box)) for box in image_boxes]


def inaccurate(camera: Camera, box: Box2D, errors_px: Float64[np.ndarray, "4"]) -> Box2D | None:
    """A box on the image with these errors of its edges, clipped to the image; None if too small."""
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    edges = np.clip(np.array(box.xyxy) + errors_px, -0.5, [right, bottom, right, bottom])
    x_min, y_min, x_max, y_max = edges.tolist()
    if min(x_max - x_min, y_max - y_min) < MIN_SIDE_PX:
        return None
    return Box2D(box.label, x_min, y_min, x_max, y_max)


def _measured(frame: Frame, labels: Sequence[Label], rng: np.random.Generator) -> _HeldOutFrame:
    boxes: list[Box2D] = []
    truths: list[OrientedBox] = []
    for label in labels:
        outline = box_on_image(frame.camera, label.box, label.label)
        errors_px = rng.normal(0, JITTER_PX, 4)
        box = None if outline is None else inaccurate(frame.camera, outline, errors_px)
        if box is not None and contains(label.box, frame.cloud.xyz_m).sum() >= MIN_POINTS:
            boxes.append(box)
            truths.append(label.box)
    return frame, boxes, truths
