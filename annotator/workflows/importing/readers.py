"""Reads 3D boxes in each format as a `LabelSet`, for imports, checks and the labels beside recordings.

A new format needs a row in `annotator.formats.table`, and an entry in `READERS`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from annotator.formats.argoverse import ANNOTATIONS, read_argoverse
from annotator.formats.box_files import boxes_file, read_boxes, read_upright_boxes
from annotator.formats.frame_names import LabelledFrame
from annotator.formats.kitti_folders import read_kitti, read_kitti_tracks
from annotator.formats.labelcloud import read_labelcloud
from annotator.formats.nuscenes import is_seen, read_nuscenes, read_results
from annotator.formats.openlabel import read_openlabel
from annotator.formats.rcv import labelled_frames
from annotator.formats.reading import AngleUnit, Lengths, OnFault, raise_fault
from annotator.formats.sunrgbd import read_extracted_folder, read_meta
from annotator.formats.sustechpoints import read_sustechpoints
from annotator.formats.table import FORMATS, BoxFormat
from annotator.project import Project
from annotator.recordings.argoverse import ArgoverseLog
from annotator.recordings.look_around import LookAround
from annotator.recordings.nuscenes import NuScenes
from annotator.recordings.sunrgbd import read_extracted_calibration
from annotator.types import Frame, Truth
from annotator.types.errors import ConfigError, FormatError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing.label_set import LabelSet, transformed, uncollected


def _sunrgbd(path: Path) -> dict[str, LabelledFrame]:
    """SUN RGB-D: a folder in VoteNet's layout (upright boxes), or the data set's table (tilted boxes)."""
    if path.suffix == ".mat":
        return read_meta(path)
    return read_extracted_folder(path, lambda file: read_extracted_calibration(file).T_camera_upright)


@dataclass(eq=False)
class _SampleBoxes(LabelSet):
    """Boxes around a vehicle, of which each camera's frame gets those that its image shows.

    `labelled` are by their sample, in the frame of the recordings' own labels.

    Attributes:
        places: the sample of each of a project's frames, by "RECORDING/KEY"; see `in_project`.
    """

    places: Mapping[str, str] = field(default_factory=dict)
    # the places of the boxes that are in an image, by sample
    _seen: defaultdict[str, set[int]] = field(default_factory=lambda: defaultdict(set), init=False)

    @property
    def frames(self) -> Sequence[str]:
        found = set(self.places.values())
        return (*self.places, *(sample for sample in self.labelled if sample not in found))

    def _placed(self, places: Mapping[str, str | None], what: str, of: str) -> LabelSet:
        """Returns the boxes by the project's frames, by "RECORDING/KEY" with their sample."""
        found = {name: sample for name, sample in places.items() if sample is not None and sample in self.labelled}
        if not found:
            problem = f"the project has none of its {what} ({len(self.labelled)}); add {of} to the project first"
            raise FormatError(self.path, problem)
        return replace(self, places=found)

    def unseen(self) -> int:
        return sum(len(self.labelled[sample].truths) - len(seen) for sample, seen in self._seen.items())

    def _frame(self, name: str) -> LabelledFrame:
        return self.labelled[self.places.get(name, name)]

    def _in_camera(self, name: str, truths: Sequence[Truth], read: Callable[[], Frame]) -> list[Truth]:
        frame = read()
        K, size = frame.camera.matrix, (frame.camera.width_px, frame.camera.height_px)
        moved = transformed(truths, frame.T_camera_label)
        seen = [place for place, truth in enumerate(moved) if is_seen(truth.box, K, *size)]
        self._seen[self.places.get(name, name)].update(seen)
        return [moved[place] for place in seen]


class NuScenesResults(_SampleBoxes):
    """The boxes of a detector or tracker, in the global frame, by the token of their sample."""

    def in_project(self, project: Project) -> LabelSet:
        """Returns the boxes by the project's frames: those of each camera of the samples' recordings."""
        source, places = FrameSource(project), dict[str, str | None]()
        for stored in project.recordings.all():
            if stored.format in (NuScenes.format, LookAround.format):
                recording = source.recording(stored.id)
                base = recording.base if isinstance(recording, LookAround) else recording
                if isinstance(base, NuScenes):
                    places |= {f"{stored.name}/{key}": base.sample(key) for key in base.keys}
        return self._placed(places, "samples", "their scenes")


class ArgoverseLabels(_SampleBoxes):
    """The annotations of an Argoverse 2 log, in the ego frame, by the time of their sweep."""

    def in_project(self, project: Project) -> LabelSet:
        """Returns the boxes by the project's frames: those of each camera of the log."""
        formats = (ArgoverseLog.format, LookAround.format)
        names = {stored.id: stored.name for stored in project.recordings.all() if stored.format in formats}
        frames = project.frames.of(tuple(names))
        return self._placed(
            {f"{names[each.recording_id]}/{each.key}": each.key for each in frames}, "sweeps", "their log"
        )


def _nuscenes(path: Path, on_fault: OnFault) -> LabelSet:
    """A file of results, or a folder of tables."""
    if not path.is_file():
        return LabelSet(path, read_nuscenes(path, on_fault))
    return NuScenesResults(path, {sample: LabelledFrame(truths) for sample, truths in read_results(path)})


def _argoverse(path: Path) -> ArgoverseLabels:
    """`annotations.feather`, or that of a log."""
    boxes = read_argoverse(path / ANNOTATIONS if path.is_dir() else path)
    return ArgoverseLabels(path, {str(time_ns): LabelledFrame(truths) for time_ns, truths in boxes.items()})


def _boxes(path: Path) -> dict[str, LabelledFrame]:
    """A `boxes.json` file, or that of a folder."""
    return {key: LabelledFrame(truths) for key, truths in read_boxes(boxes_file(path)).items()}


Reader = Callable[[Path, AngleUnit | None, OnFault], Mapping[str, LabelledFrame] | LabelSet]

READERS: dict[BoxFormat, Reader] = {
    BoxFormat.RCV: lambda path, angles, on_fault: labelled_frames(path),
    BoxFormat.KITTI: lambda path, angles, on_fault: read_kitti(path, angles),
    BoxFormat.KITTI_TRACKING: lambda path, angles, on_fault: read_kitti_tracks(path, angles),
    BoxFormat.SUNRGBD: lambda path, angles, on_fault: _sunrgbd(path),
    BoxFormat.OPENLABEL: lambda path, angles, on_fault: read_openlabel(path, angles),
    BoxFormat.LABELCLOUD: lambda path, angles, on_fault: read_labelcloud(path, on_fault, angles),
    BoxFormat.NUSCENES: lambda path, angles, on_fault: _nuscenes(path, on_fault),
    BoxFormat.SUSTECHPOINTS: lambda path, angles, on_fault: read_sustechpoints(path, angles),
    BoxFormat.BOXES: lambda path, angles, on_fault: _boxes(path),
    BoxFormat.ARGOVERSE2: lambda path, angles, on_fault: _argoverse(path),
    BoxFormat.BOX_CSV: lambda path, angles, on_fault: read_upright_boxes(path, angles),
}


@uncollected()
def placed_boxes(
    format: BoxFormat, path: Path, angles: AngleUnit | None = None, on_fault: OnFault = raise_fault
) -> LabelSet:
    """Reads all labels at `path`; the sizes of the boxes are not judged.

    Args:
        angles: their unit; None: as the format says.
        on_fault: takes faults of single boxes, which are skipped then; most readers raise at the first one.
    """
    read = READERS[format](path, angles, on_fault)
    return read if isinstance(read, LabelSet) else LabelSet(path, read)


def read_labels(format: BoxFormat, path: Path, angles: AngleUnit | None = None) -> LabelSet:
    """Reads and checks all labels at `path`.

    Args:
        angles: unit of the angles, if it is not what the format says, or if the labels do not show it.
    """
    if angles is not None and not FORMATS[format].angles:
        with_angles = ", ".join(name for name, each in FORMATS.items() if each.angles)
        raise ConfigError(f"{format} has no angles; leave out --angles (it is for {with_angles})")
    dataset = placed_boxes(format, path, angles)
    Lengths(dataset.sizes_m).require(path)
    return dataset
