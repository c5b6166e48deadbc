"""Labels out of a project, as a dataset in the `rcv` format."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from annotator import __version__
from annotator.formats.rcv import RcvDetector, RcvInfo, RcvItem, RcvOptions, export_rcv
from annotator.formats.rcv.model import RcvManifest
from annotator.project.labels import StoredLabel
from annotator.project.project import Project
from annotator.types import ReviewState
from annotator.types.errors import ConfigError
from annotator.workflows.frames import FrameSource

# A rejected box is no label; everything else leaves with its state written beside it.
DEFAULT_STATES = (ReviewState.PROPOSED, ReviewState.ACCEPTED, ReviewState.EDITED)
UNREGISTERED = "unregistered"


@dataclass(frozen=True)
class ExportFilter:
    """Which labels leave.

    Attributes:
        states: in which review states.
        classes: None = all of the project's.
        recordings: ids; None = all.
        empty_frames: also frames without any such label, as far as they are still in their recordings.
    """

    states: tuple[ReviewState, ...] = DEFAULT_STATES
    classes: tuple[str, ...] | None = None
    recordings: tuple[int, ...] | None = None
    empty_frames: bool = False


def export_dataset(
    project: Project,
    out: Path,
    *,
    choose: ExportFilter | None = None,
    options: RcvOptions | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> RcvManifest:
    """Writes the chosen labels with their images and clouds to `out`; complete, or not at all.

    Args:
        progress: called with (frames written, frames to write).

    Raises:
        ConfigError: no label fits the filter.
        FormatError, RecordingError: as `export_rcv`, or a frame that can no longer be read.
    """
    choose = choose or ExportFilter()
    config = project.config
    if unknown := sorted(set(choose.classes or ()) - set(config.classes)):
        raise ConfigError(
            f"project {config.name} has no class {', '.join(unknown)}; it has {', '.join(config.classes)}"
        )
    labels = _labels(project, choose)
    every = project.frames.of(choose.recordings)
    frames = [f for f in every if f.id in labels or (choose.empty_frames and f.index is not None)]
    if not any(labels.values()) and not choose.empty_frames:
        raise ConfigError(
            f"project {project.config.name} has no labels in state {', '.join(choose.states)} to export; "
            "run `annotator annotate` first, or choose other states"
        )
    source = FrameSource(project)

    def items() -> Iterator[RcvItem]:
        for number, stored in enumerate(frames, 1):
            name = source.stored(stored.recording_id).name
            yield RcvItem(name, source.read(stored), [entry.label for entry in labels.get(stored.id, ())])
            if progress is not None:
                progress(number, len(frames))

    info = RcvInfo(
        classes=project.config.classes,
        detectors=_detectors(project, labels),
        generator=f"annotator {__version__}",
        options=options or RcvOptions(),
    )
    return export_rcv(out, items(), info, overwrite=overwrite)


def _labels(project: Project, choose: ExportFilter) -> dict[int, Sequence[StoredLabel]]:
    chosen: dict[int, list[StoredLabel]] = defaultdict(list)
    found = project.labels.select(states=choose.states, recordings=choose.recordings, classes=choose.classes)
    for stored in found:
        chosen[stored.frame_id].append(stored)
    return dict(chosen)


def _detectors(project: Project, labels: Mapping[int, Sequence[StoredLabel]]) -> tuple[RcvDetector, ...]:
    """The detectors that proposed these labels, whatever the project uses by now; in the order of their runs."""
    wanted = {entry.run_id for entries in labels.values() for entry in entries}
    names = {(model.role.value, model.fingerprint): model.path.parent.name for model in project.models.all()}
    found = dict.fromkeys(
        used
        for run in project.jobs.all()
        if run.id in wanted
        for used in (("image", run.image_detector), ("view", run.view_detector))
    )
    # a detector that was never trained here (it came with the run, as in the benchmarks) has no name but what it is
    return tuple(RcvDetector(role=r, name=names.get((r, f), UNREGISTERED), fingerprint=f) for r, f in found)
