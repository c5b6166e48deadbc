"""Projects: their recordings, labels and detectors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, TypedDict, Unpack, overload

from annotator import project as store
from annotator.api.frames import choice, up_of
from annotator.api.labels import read_labels
from annotator.api.proposing import ImageDetector, Rotation, image_boxes_of, kind_of, watch_with
from annotator.evaluation.report import Report
from annotator.project import BoxRotation, ProjectSettings, StoredFrame, StoredRecording
from annotator.rcv.finish import FrameProposals
from annotator.recordings import parse_options
from annotator.types import BoxKind, Detector, DetectorKind, Frame, Label, ReviewState
from annotator.types.errors import ArgumentError
from annotator.workflows.add_recordings import ALL, add_recordings
from annotator.workflows.detectors import Detectors, Names, load_detector, required_model, trained_detectors
from annotator.workflows.evaluate import Measured, Options, Protocol, evaluate_project
from annotator.workflows.exporting import ExportFilter, ExportFormat, ExportReport, export_project
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing import ImportReport, import_labels
from annotator.workflows.live.detection import Detected
from annotator.workflows.proposing.annotate import AnnotateSummary, annotate_with
from annotator.workflows.proposing.engines import EngineName, make_engine
from annotator.workflows.proposing.lift import propose_image_boxes
from annotator.workflows.proposing.tasks import DetectorSource
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.settings import rcv_config


def open_project(path: str | Path) -> Project:
    """Opens the project in a folder. Close it after use, or open it in a `with` statement.

    Raises:
        ProjectError: the folder holds no project, or it cannot be read.
    """
    return Project(store.open_project(Path(path)))


def create_project(path: str | Path, classes: Sequence[str], rotation: Rotation = "auto") -> Project:
    """Creates a project in the folder `path`, which must not exist.

    Args:
        classes: the class names that boxes may have.
        rotation: which rotations boxes may have: auto, upright or free.

    Raises:
        ArgumentError: an unknown rotation.
        ConfigError: the name of the folder or of a class cannot be used.
        ProjectError: the folder exists already, or cannot be written.
    """
    place, settings = Path(path).absolute(), ProjectSettings(rotation=choice("rotation", rotation, BoxRotation))
    return Project(store.create_project(place.parent, place.name, classes, settings=settings))


class Given(TypedDict, total=False):
    """The options of `Project.detect`, for the types of its results."""

    image_boxes: Sequence[Any] | None
    image_detector: ImageDetector | None
    image_kind: BoxKind | str | None


class Project:
    """An open project, for use by one thread. The workbench and the commands may have it open at the same time.

    Attributes:
        stored: the project's store, which is not part of the public API.
    """

    def __init__(self, stored: store.Project) -> None:
        self.stored = stored
        self._source = FrameSource(stored)
        self._loaded: dict[DetectorKind, tuple[tuple[str, Names], Detector]] = {}

    @property
    def path(self) -> Path:
        """The project's folder."""
        return self.stored.path

    @property
    def name(self) -> str:
        """The project's name."""
        return self.stored.config.name

    @property
    def classes(self) -> tuple[str, ...]:
        """The class names that boxes may have."""
        return self.stored.config.classes

    @property
    def recordings(self) -> tuple[StoredRecording, ...]:
        """The recordings, in the order in which they were added."""
        return self.stored.recordings.all()

    def add(
        self,
        path: str | Path,
        *,
        name: str | None = None,
        up: Sequence[float] | None = None,
        labels: bool = True,
        **options: Any,
    ) -> StoredRecording:
        """Adds a recording, or adds the new frames of one that the project has already. Its files stay where they are.

        Args:
            name: name of the recording; None: the name of its folder.
            up: (3,) direction against gravity in the camera frame, for recordings without one.
            labels: import the 3D boxes that come with it.
            options: how it is read, as for `open_recording`.

        Raises:
            RecordingError: `path` holds no recording, or it cannot be read.
            ConfigError: a name or up direction that differs from the one stored in the project.
            ArgumentError: all scenes or cameras at once.
            FormatError: its labels are broken.
        """
        up_of(up)
        if several := [f"{name}={ALL!r}" for name in ("scene", "camera") if options.get(name) == ALL]:
            raise ArgumentError(f"{several[0]} names several recordings; add them one by one")
        (added,) = add_recordings(self.stored, [Path(path)], name=name, up=up, options=parse_options(**options))
        if labels:
            import_own_labels(self.stored, added.recording.id)
        return added.recording

    def frames(self, recording: str | None = None) -> tuple[StoredFrame, ...]:
        """The frames of all recordings, or of the one with this name, as entries that `read` and `labels` take.

        Raises:
            NotFoundError: no such recording.
        """
        return self.stored.frames.of(None if recording is None else [self.stored.recordings.find(recording).id])

    def read(self, frame: StoredFrame) -> Frame:
        """Reads a frame: image, cloud and camera.

        Raises:
            RecordingError, FrameError: it cannot be read.
        """
        return self._source.read(frame)

    def labels(self, frame: StoredFrame) -> tuple[Label, ...]:
        """The 3D boxes of a frame, including proposed and rejected ones (see `Label.state`)."""
        return self.stored.labels.of_frame(frame.id)

    @overload
    def detect(self, frames: Frame, **options: Unpack[Given]) -> FrameProposals: ...

    @overload
    def detect(self, frames: Sequence[Frame], **options: Unpack[Given]) -> list[FrameProposals]: ...

    def detect(
        self,
        frames: Frame | Sequence[Frame],
        *,
        image_boxes: Sequence[Any] | None = None,
        image_detector: ImageDetector | None = None,
        image_kind: BoxKind | str | None = None,
    ) -> FrameProposals | list[FrameProposals]:
        """Proposes oriented boxes with the project's detectors and settings, as `annotator annotate` does.

        Nothing is stored. The frames need not belong to the project.

        Args:
            image_boxes, image_detector: used instead of the project's image detector; as for `propose`.
            image_kind: what these boxes enclose: "box" (the whole object, hidden parts included) or "silhouette" (what
                is seen of it). None: the attribute `box_kind` of `image_detector`, or box if it has none.

        Raises:
            ArgumentError: as `propose`.
            DetectionError, FormatError: a detector has not been trained, or cannot be loaded.
            ConfigError: the project's settings are invalid.
        """
        several = [frames] if isinstance(frames, Frame) else list(frames)
        if image_boxes is None and image_detector is None:
            image_detector, own = self._own_image()
            image_kind = own if image_kind is None else image_kind
        boxes = image_boxes_of(frames, image_boxes, image_detector)
        pair = self._pair(None, kind_of(image_detector, image_kind, "image_kind"))
        config, rotation = pair.settings(rcv_config(self.stored)), self.stored.config.settings.rotation
        proposals = propose_image_boxes(several, boxes, pair.view, config, rotation) if several else []
        return proposals[0] if isinstance(frames, Frame) else proposals

    def watch(self, frames: Iterable[Frame]) -> Iterator[Detected]:
        """Detects boxes in live frames with the project's detectors and settings; see `annotator.watch`.

        Raises:
            DetectionError, FormatError, ConfigError: as `detect`.
        """
        return watch_with(
            frames, self._pair(*self._own_image()), rcv_config(self.stored), self.stored.config.settings.rotation
        )

    def annotate(
        self,
        *,
        image_detector: Detector | None = None,
        view_detector: Detector | None = None,
        box_kind: BoxKind | str | None = None,
        image_kind: BoxKind | str | None = None,
        engine: str = EngineName.INLINE,
        workers: int | None = None,
        address: str | None = None,
        limit: int | None = None,
    ) -> AnnotateSummary:
        """Proposes and stores boxes for every frame that was not annotated with these detectors and settings before.

        Args:
            image_detector, view_detector: None: the project's own. The `fingerprint` of any other detector must change
                whenever its results may change, since it determines which frames are done already.
            box_kind: what the boxes of `view_detector` measure; as for `propose`.
            image_kind: what the boxes of `image_detector` enclose; as for `detect`.
            engine: inline (this process), local (worker processes), ray, or auto. Your own detectors are pickled for
                the workers.
            workers, address: options of the engine, as for `annotator annotate`.
            limit: maximum number of frames.

        Returns:
            counts of the run, and the frames that failed, with the reasons.

        Raises:
            ArgumentError: an unknown engine, or a detector without a fingerprint.
            DetectionError, FormatError, ConfigError: as `detect`.
            WorkerError, MissingExtraError: the engine cannot be started, or its workers crash repeatedly.
        """
        chosen = choice("engine", engine, EngineName)
        source = self._detector_source(image_detector, view_detector, box_kind, image_kind)
        present = self.stored.frames.count_present(None)
        frames = present if limit is None else min(present, limit)
        made = make_engine(chosen, source, frames=frames, workers=workers, address=address)
        with closing(made):
            return annotate_with(self.stored, made, rcv_config(self.stored), limit=limit)

    def import_labels(self, path: str | Path, format: str) -> ImportReport:
        """Imports 3D labels for frames that have none; formats as for `read_labels`.

        Raises:
            ArgumentError, FormatError: as `read_labels`; or the project has none of the labelled frames.
        """
        return import_labels(self.stored, read_labels(path, format))

    def export(
        self,
        out: str | Path,
        format: str = ExportFormat.RCV,
        *,
        states: Sequence[ReviewState | str] | None = None,
        overwrite: bool = False,
    ) -> ExportReport:
        """Writes labels with their images and clouds to the folder `out`; it is written completely or not at all.

        Args:
            format: rcv, kitti, kitti-tracking, sunrgbd, coco, yolo, openlabel, labelcloud or nuscenes.
            states: review states of the labels to export: proposed, accepted, edited, rejected. None: accepted and
                edited; for formats that store the state (rcv, openlabel), also proposed.

        Raises:
            ArgumentError: an unknown format or state.
            ConfigError: no label has one of these states.
            FormatError: `out` exists already, or cannot be written.
            RecordingError: a frame cannot be read.
        """
        written = choice("format", format, ExportFormat)
        if unknown := set(states or ()) - set(ReviewState):
            raise ArgumentError(f"states must be from {', '.join(ReviewState)}, not {', '.join(unknown)}")
        choose = ExportFilter(states=tuple(map(ReviewState, states))) if states else None
        return export_project(self.stored, Path(out), written, choose=choose, overwrite=overwrite)

    def evaluate(self, protocol: str = Protocol.ORIENTED, measured: str = Measured.LABELS) -> Report:
        """Evaluates the project's labels or proposals against the boxes that come with its recordings.

        Args:
            protocol: kitti, sunrgbd or oriented.
            measured: labels (in their present state) or proposals (of the last automatic pass).

        Raises:
            ArgumentError: an unknown protocol, or an unknown `measured`.
            ConfigError: there is nothing to compare.
            RecordingError, FormatError: the truth cannot be read.
        """
        options = Options(measured=choice("measured", measured, Measured))
        return evaluate_project(self.stored, choice("protocol", protocol, Protocol), options)

    def close(self) -> None:
        """Closes the project."""
        self.stored.close()

    def __enter__(self) -> Project:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _pair(
        self, image: Detector | None, image_kind: BoxKind, view: Detector | None = None, box_kind: Any = None
    ) -> Detectors:
        """With the project's view detector unless one is given; without `image`, only that one may be called."""
        kinds: tuple[BoxKind, bool, BoxKind, bool]
        if view is None:
            model, view = required_model(self.stored, DetectorKind.VIEW), self._detector(DetectorKind.VIEW)
            kinds = model.box_kind, model.class_agnostic, image_kind, model.trained
        else:
            kinds = kind_of(view, box_kind), False, image_kind, False
        return Detectors(view if image is None else image, view, *kinds)

    def _own_image(self) -> tuple[Detector, BoxKind]:
        """The project's image detector, and what its boxes enclose."""
        return self._detector(DetectorKind.IMAGE), required_model(self.stored, DetectorKind.IMAGE).box_kind

    def _detector(self, kind: DetectorKind) -> Detector:
        """The project's active detector; loaded once, and reloaded after another one is activated."""
        model = required_model(self.stored, kind)
        known = (model.fingerprint, model.names)
        if kind not in self._loaded or self._loaded[kind][0] != known:
            self._loaded[kind] = (known, load_detector(model.path, names=model.names))
        return self._loaded[kind][1]

    def _detector_source(
        self, image: Any, view: Any, box_kind: BoxKind | str | None, image_kind: BoxKind | str | None = None
    ) -> DetectorSource:
        if image is None and image_kind is not None:
            raise ArgumentError("image_kind tells what the boxes of image_detector enclose; give image_detector, too")
        if image is None and view is None:
            return trained_detectors(self.stored)
        for detector in (image, view):
            if detector is not None and not isinstance(detector, Detector):
                raise ArgumentError(
                    f"{detector!r} is not a detector; pass an object with labels, fingerprint and detect"
                )
        image, kind = self._own_image() if image is None else (image, kind_of(image, image_kind, "image_kind"))
        return self._pair(image, kind, view, box_kind)
