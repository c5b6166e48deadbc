"""The formats whose boxes lie around a vehicle, and belong to the images of several cameras."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from annotator.formats.argoverse import ANNOTATIONS, read_argoverse
from annotator.formats.attributes import Values
from annotator.formats.nuscenes import is_seen, read_results
from annotator.formats.packed_truths import PackedTruths
from annotator.project import Project
from annotator.recordings.argoverse import ArgoverseLog
from annotator.recordings.look_around import LookAround
from annotator.recordings.nuscenes import NuScenes
from annotator.types import Frame, Truth
from annotator.types.errors import FormatError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing.label_set import LeftOut, ScoreRange
from annotator.workflows.importing.readers.placed_boxes import lost_scores, transformed, with_confidences


@dataclass(frozen=True)
class _SampleBoxes:
    """Boxes around a vehicle, of which each camera's frame gets those that its image shows.

    Attributes:
        samples: objects by their sample, in the frame of the recordings' own labels.
        places: the sample of each of a project's frames, by "RECORDING/KEY"; see `FoundInProject`.
    """

    path: Path
    samples: PackedTruths
    places: Mapping[str, str] = field(default_factory=dict)
    # the places of the boxes that are in an image, by sample
    _seen: defaultdict[str, set[int]] = field(default_factory=lambda: defaultdict(set), init=False)

    @property
    def frames(self) -> Sequence[str]:
        found = set(self.places.values())
        return (*self.places, *(sample for sample in self.samples if sample not in found))

    @cached_property
    def scores(self) -> ScoreRange | None:
        return ScoreRange.of(self.samples.scores)

    @property
    def sizes_m(self) -> Iterable[Float64[np.ndarray, "3"]]:
        return self.samples.sizes_m

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        return with_confidences(self.suggested(name, lambda: frame), self.scores)

    def values_of_boxes(self, name: str) -> Sequence[Values]:
        return [each.attributes for each in self.samples[self.places.get(name, name)]]

    def classes(self, name: str) -> list[str]:
        return [each.label for each in self.samples[self.places.get(name, name)]]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        frame = read()
        K, size = frame.camera.matrix, (frame.camera.width_px, frame.camera.height_px)
        sample = self.places.get(name, name)
        truths = transformed(self.samples[sample], frame.T_camera_label)
        seen = [place for place, truth in enumerate(truths) if is_seen(truth.box, K, *size)]
        self._seen[sample].update(seen)
        return [truths[place] for place in seen]

    def unseen(self) -> int:
        return sum(len(self.samples[sample]) - len(seen) for sample, seen in self._seen.items())

    def left_out_of(self, name: str) -> LeftOut:
        return LeftOut(scores=lost_scores(self.samples[self.places.get(name, name)], self.scores))


class NuScenesResults(_SampleBoxes):
    """The boxes of a detector or tracker, in the global frame, by the token of their sample."""

    def in_project(self, project: Project) -> NuScenesResults:
        """Returns the boxes by the project's frames: those of each camera of the samples' recordings."""
        source, places = FrameSource(project), dict[str, str]()
        for stored in project.recordings.all():
            if stored.format not in (NuScenes.format, LookAround.format):
                continue
            recording = source.recording(stored.id)
            base = recording.base if isinstance(recording, LookAround) else recording
            if isinstance(base, NuScenes):
                samples = {key: base.sample(key) for key in base.keys}
                found = {f"{stored.name}/{key}": each for key, each in samples.items() if each is not None}
                places |= {name: each for name, each in found.items() if each in self.samples}
        if not places:
            problem = (
                f"the project has none of its samples ({len(self.samples)}); add their scenes to the project first"
            )
            raise FormatError(self.path, problem)
        return replace(self, places=places)


def nuscenes_results(path: Path) -> NuScenesResults:
    """Reads a file of results of nuScenes' detection or tracking task. Raises FormatError as `read_results`."""
    return NuScenesResults(path, PackedTruths(read_results(path)))


class ArgoverseLabels(_SampleBoxes):
    """The annotations of an Argoverse 2 log, in the ego frame, by the time of their sweep."""

    def in_project(self, project: Project) -> ArgoverseLabels:
        """Returns the boxes by the project's frames: those of each camera of the log."""
        names = {
            stored.id: stored.name
            for stored in project.recordings.all()
            if stored.format in (ArgoverseLog.format, LookAround.format)
        }
        frames = project.frames.of(tuple(names))
        places = {f"{names[each.recording_id]}/{each.key}": each.key for each in frames if each.key in self.samples}
        if not places:
            problem = f"the project has none of its sweeps ({len(self.samples)}); add their log to the project first"
            raise FormatError(self.path, problem)
        return replace(self, places=places)


def argoverse_labels(path: Path) -> ArgoverseLabels:
    """Reads `annotations.feather`, or that of a log. Raises as `read_argoverse`."""
    file = path / ANNOTATIONS if path.is_dir() else path
    sweeps = (
        (str(time_ns), [Truth(each.label, each.box, each.track) for each in boxes])
        for time_ns, boxes in read_argoverse(file).items()
    )
    return ArgoverseLabels(path, PackedTruths(sweeps))
