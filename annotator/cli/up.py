"""`annotator up`"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np
import tyro
from pydantic import BaseModel, ConfigDict

from annotator.cli.options import AsJson, Clear, ProjectName, Projects, RecordingName, open_named
from annotator.cli.output import print_facts, print_json
from annotator.project import Project
from annotator.types.errors import ConfigError, GeometryError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.up_direction import RecordingUp, estimate_recording_up

AUTHOR = "annotator up"
ORIGINS = {"files": "from the recording's files", "project": "set in the project"}


class UpReport(BaseModel):
    """The up direction of a recording's first frame; certainty and reason of an estimate that was just made."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    recording: str
    up: tuple[float, float, float] | None
    source: Literal["unknown", "files", "project"]
    certainty: float | None
    reason: str | None


def run(
    project: ProjectName,
    recording: RecordingName,
    direction: Annotated[tuple[float, ...], tyro.conf.arg(metavar="X Y Z")] = (),
    /,
    *,
    estimate: bool = False,
    clear: Clear = False,
    projects: Projects = None,
    as_json: AsJson = False,
) -> None:
    """Show or set which way is up in a recording, for upright boxes. Stored boxes do not change.

    Args:
        direction: against gravity in the camera frame (x right, y down, z forward), of any length; 0 -1 0 for a
            level camera.
        estimate: take it from floors, tables, the ground and walls, if they tell.
    """
    if (len(direction) > 0) + estimate + clear > 1 or len(direction) not in (0, 3):
        raise ConfigError("give three numbers X Y Z, --estimate or --clear; none of them shows the direction")
    with open_named(project, projects) as opened:
        stored, found = opened.recordings.find(recording), None
        if estimate:
            found = estimate_recording_up(opened, stored.id)
            if found.up is None:
                raise GeometryError(
                    f"{recording}: {found.reason}; the up direction was not changed; give it as three numbers, or set "
                    "the level on the page"
                )
            direction = found.up
        if direction or clear:
            opened.adjustments.set_up(stored.id, direction or None, AUTHOR)
        report = _report(opened, stored.id, found)
    if as_json:
        print_json(report)
    else:
        print_facts(_rows(report))


def _report(project: Project, recording_id: int, found: RecordingUp | None) -> UpReport:
    stored = project.recordings.get(recording_id)
    frame = next((frame for frame in project.frames.of([recording_id]) if frame.index is not None), None)
    up = None if frame is None else FrameSource(project).read(frame).up
    return UpReport(
        recording=stored.name,
        up=None if up is None else tuple(up.tolist()),
        source="unknown" if up is None else "files" if stored.up is None else "project",
        certainty=None if found is None else found.certainty,
        reason=None if found is None else found.reason,
    )


def _rows(report: UpReport) -> Iterator[tuple[str, object]]:
    yield "recording", report.recording
    if report.up is None:
        yield "up", "not known; --estimate looks for a floor, tables, the ground and walls"
        return
    x, y, z = report.up
    yield "up", f"{x:.4f} {y:.4f} {z:.4f} (camera frame), " + ORIGINS[report.source]
    yield "camera", f"rolled by {np.degrees(np.arctan2(x, -y)):.1f}, pitched by {np.degrees(np.arcsin(z)):.1f} degrees"
    if report.certainty is not None:
        yield "certainty", f"{report.certainty:.2f}: {report.reason}"
