"""Proposes boxes with detectors that the caller provides."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Required, TypedDict, Unpack, overload

from annotator.api.frames import choice, require_on_image
from annotator.detection.perfect import on_region
from annotator.project.config import BoxRotation
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.types import Box2D, BoxKind, Detector, Frame, Image, PseudoView, Region
from annotator.types.errors import ArgumentError
from annotator.types.messages import amount
from annotator.workflows.detectors import Detectors
from annotator.workflows.live.detection import Detected, LiveDetection, Taken
from annotator.workflows.proposing.lift import propose_image_boxes
from annotator.workflows.settings import checked_config

ImageDetector = Detector | Callable[[Frame], Sequence[Box2D]]
"""A `Detector`, or a function from one frame (image in `.rgb`, depth in `.depth_m`) to its boxes."""
ViewDetector = Detector | Callable[[PseudoView], Sequence[Box2D]]
"""A `Detector`, or a function from one pseudo-view (image in `.rgb`, points in `.xyz_m`) to its boxes."""
# Minimum side of a box that is clipped to a region, pixels; thinner remainders are dropped.
LEAST_SIDE_PX = 1.0
Rotation = BoxRotation | str
"""upright; free; or auto: upright for frames with a known `up`, else free."""


class FunctionDetector:
    """A detector made from a function that takes one whole image (a frame or a pseudo-view)."""

    # the classes that a function detects are not known in advance
    labels: tuple[str, ...] = ()

    def __init__(self, function: Callable[[Any], Sequence[Box2D]]) -> None:
        self._function = function
        # its behaviour cannot be hashed
        self.fingerprint = f"{function.__module__}.{getattr(function, '__qualname__', type(function).__name__)}"

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        """The boxes of each image, best score first; for a `Region`, the boxes of the whole image clipped to it."""
        return [sorted(self._boxes(image), key=lambda box: -box.score) for image in images]

    def _boxes(self, image: Image) -> Sequence[Box2D]:
        if not isinstance(image, Region):
            return self._function(image)
        return on_region(image, self._function(image.of), LEAST_SIDE_PX)


def as_detector(given: Any) -> Detector:
    """Returns a detector unchanged, and makes one from a function."""
    if isinstance(given, type) or not (isinstance(given, Detector) or callable(given)):
        raise ArgumentError(
            f"{given!r} is not a detector; pass an object with labels, fingerprint and detect, or a function"
        )
    return given if isinstance(given, Detector) else FunctionDetector(given)


class Options(TypedDict, total=False):
    """The options of `propose`, for the types of its results."""

    view_detector: Required[ViewDetector]
    image_boxes: Sequence[Any] | None
    image_detector: ImageDetector | None
    rotation: Rotation
    box_kind: BoxKind | str | None
    settings: Mapping[str, Any] | None


@overload
def propose(frames: Frame, **options: Unpack[Options]) -> FrameProposals: ...


@overload
def propose(frames: Sequence[Frame], **options: Unpack[Options]) -> list[FrameProposals]: ...


def propose(
    frames: Frame | Sequence[Frame],
    *,
    view_detector: ViewDetector,
    image_boxes: Sequence[Any] | None = None,
    image_detector: ImageDetector | None = None,
    rotation: Rotation = BoxRotation.AUTO,
    box_kind: BoxKind | str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> FrameProposals | list[FrameProposals]:
    """Oriented 3D boxes from 2D boxes on the images (Recursive Cross-View).

    Several frames are processed together, in larger detector batches; a few frames per call are enough for this.

    Args:
        frames: one frame, or several.
        view_detector: detects objects on pseudo-views; its class names must be those of the image boxes.
        image_boxes: the boxes on the image of one frame, or one list per frame. Boxes with a score below the setting
            `min_image_score` (0.25) are ignored.
        image_detector: detects these boxes, if `image_boxes` is not given.
        rotation: auto, upright or free.
        box_kind: what the view detector's boxes measure: "silhouette" (the visible points) or "box" (the whole object,
            hidden parts included). None: the detector's attribute `box_kind`, or silhouette if it has none.
        settings: settings of the recursion that differ from the defaults, such as `{"max_steps": 3}`.

    Returns:
        the `proposals` of a frame, best first, and the objects `lost`; a list of these if `frames` is a list.

    Raises:
        ArgumentError: not exactly one of `image_boxes` and `image_detector` is given, a box lies outside the image,
            the number of lists is not the number of frames, or the rotation or box kind is unknown.
        ConfigError: an unknown setting, or a value out of its range.
    """
    several = [frames] if isinstance(frames, Frame) else list(frames)
    boxes = image_boxes_of(frames, image_boxes, image_detector)
    view = as_detector(view_detector)
    config = checked_config(settings or {}).for_detector(kind_of(view_detector, box_kind))
    proposals = (
        propose_image_boxes(several, boxes, view, config, choice("rotation", rotation, BoxRotation)) if several else []
    )
    return proposals[0] if isinstance(frames, Frame) else proposals


def watch(
    frames: Iterable[Frame],
    *,
    image_detector: ImageDetector,
    view_detector: ViewDetector,
    rotation: Rotation = BoxRotation.AUTO,
    box_kind: BoxKind | str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Iterator[Detected]:
    """Detects boxes in the frames of a live camera. Starting from the boxes of the previous frame makes it faster.

    Args:
        frames: any iterable, such as a generator. The next frame is requested when the caller asks for the next
            result; yield the newest frame then, so that no backlog builds up.
        image_detector: for many frames, a `Detector` gets only parts of the image, around the last detections; these
            objects have at least the attribute `.rgb`. A function always gets the whole frame.
        view_detector, rotation, box_kind, settings: as for `propose`.

    Raises:
        ArgumentError, ConfigError: as `propose`.
    """
    pair = Detectors(as_detector(image_detector), as_detector(view_detector), kind_of(view_detector, box_kind))
    return watch_with(frames, pair, checked_config(settings or {}), choice("rotation", rotation, BoxRotation))


def watch_with(
    frames: Iterable[Frame], detectors: Detectors, config: RcvConfig, rotation: BoxRotation
) -> Iterator[Detected]:
    """As `watch`, with checked detectors and settings."""
    detection = LiveDetection(detectors, config, rotation, warm_start=True)

    def run() -> Iterator[Detected]:
        begin = time.perf_counter()
        for frame in frames:
            taken_s = time.perf_counter()
            yield detection.detect(Taken(frame, taken_s, taken_s - begin))
            begin = time.perf_counter()

    return run()


def image_boxes_of(
    frames: Any, image_boxes: Sequence[Any] | None, image_detector: ImageDetector | None
) -> list[list[Box2D]]:
    """One list of boxes per frame, either given or detected."""
    several = [frames] if isinstance(frames, Frame) else list(frames)
    if not all(isinstance(frame, Frame) for frame in several):
        raise ArgumentError(
            "frames must be a Frame or a list of Frames; make them with frame_from_rgbd or open_recording"
        )
    if (image_boxes is None) == (image_detector is None):
        raise ArgumentError("give either image_boxes or image_detector")
    if image_detector is not None:
        return as_detector(image_detector).detect(several) if several else []
    assert image_boxes is not None
    if not isinstance(frames, Frame) and any(isinstance(boxes, Box2D) for boxes in image_boxes):
        raise ArgumentError("for several frames, pass one list of boxes per frame: image_boxes=[[...], [...]]")
    lists = [list(image_boxes)] if isinstance(frames, Frame) else list(map(list, image_boxes))
    if len(lists) != len(several):
        raise ArgumentError(
            f"image_boxes has {amount(len(lists), 'list')} for {amount(len(several), 'frame')}; pass one list per frame"
        )
    for frame, boxes in zip(several, lists, strict=True):
        require_on_image(boxes, frame.camera)
    return lists


def kind_of(detector: object, given: BoxKind | str | None, argument: str = "box_kind") -> BoxKind:
    """What a detector's boxes enclose: `given`, else its `box_kind`, else what is seen; on images, whole objects."""
    default = BoxKind.BOX if argument == "image_kind" else BoxKind.SILHOUETTE
    return choice(argument, getattr(detector, "box_kind", default) if given is None else given, BoxKind)
