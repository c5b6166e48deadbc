"""Labels out of a project, as a dataset in the `rcv` format."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from annotator import __version__
from annotator.formats.rcv import RcvDetector, RcvInfo, RcvItem, RcvOptions, export_rcv
from annotator.formats.rcv.model import RcvManifest
from annotator.project.models import Role
from annotator.project.project import Project
from annotator.types import Label, ReviewState
from annotator.types.errors import ConfigError
from annotator.workflows.frames import FrameSource

# A rejected box is no label; everything else leaves with its state written beside it.
DEFAULT_STATES = (ReviewState.PROPOSED, ReviewState.ACCEPTED, ReviewState.EDITED)


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
            yield RcvItem(name, source.read(stored), labels.get(stored.id, ()))
            if progress is not None:
                progress(number, len(frames))

    info = RcvInfo(
        classes=project.config.classes,
        detectors=_detectors(project),
        generator=f"annotator {__version__}",
        options=options or RcvOptions(),
    )
    return export_rcv(out, items(), info, overwrite=overwrite)


def _labels(project: Project, choose: ExportFilter) -> dict[int, Sequence[Label]]:
    chosen: dict[int, list[Label]] = defaultdict(list)
    found = project.labels.select(states=choose.states, recordings=choose.recordings, classes=choose.classes)
    for stored in found:
        chosen[stored.frame_id].append(stored.label)
    return dict(chosen)


def _detectors(project: Project) -> tuple[RcvDetector, ...]:
    active = [(role, project.models.active(role)) for role in Role]
    return tuple(
        RcvDetector(role=role.value, name=model.path.parent.name, fingerprint=model.fingerprint)
        for role, model in active
        if model is not None
    )
