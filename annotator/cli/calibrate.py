"""`annotator calibrate`"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from pydantic import BaseModel, ConfigDict

from annotator.cli.options import AsJson, Clear, ProjectName, Projects, RecordingName, open_named
from annotator.cli.output import print_facts, print_json
from annotator.project import Basis
from annotator.types import NO_CORRECTION
from annotator.types.errors import ConfigError
from annotator.workflows.recorded.calibration import correct_calibration

AUTHOR = "annotator calibrate"
Vector = tuple[float, float, float]


class CalibrationReport(BaseModel):
    """The correction of a recording: degrees, metres, seconds; and the number of labels that moved with its clouds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    recording: str
    turn_deg: Vector
    shift_m: Vector
    time_offset_s: float
    moved_labels: int


def run(
    project: ProjectName,
    recording: RecordingName,
    /,
    *,
    turn: Vector | None = None,
    shift: Vector | None = None,
    time_offset: float | None = None,
    clear: Clear = False,
    projects: Projects = None,
    as_json: AsJson = False,
) -> None:
    """Show or correct where the clouds of a recording lie relative to its images. Its files stay as they are.

    3D boxes stay where they are in the clouds. What is not given stays as it was corrected before.

    Args:
        turn: rotation of the clouds about the camera's x, y and z axes, degrees (one rotation vector).
        shift: translation of the clouds along the camera's axes, metres; after the rotation.
        time_offset: how much the clocks of the clouds are ahead of those of the images, seconds; each cloud is shown
            with the image that is then nearest in time.
    """
    given = turn is not None or shift is not None or time_offset is not None
    if clear and given:
        raise ConfigError("give either --clear, or --turn, --shift and --time-offset")
    with open_named(project, projects) as opened:
        stored = opened.recordings.find(recording)
        new, moved = NO_CORRECTION if clear else stored.correction, 0
        try:
            if turn is not None:
                x, y, z = np.radians(turn).tolist()
                new = replace(new, turn_rad=(x, y, z))
            new = replace(new, shift_m=new.shift_m if shift is None else shift)
            new = replace(new, time_offset_s=new.time_offset_s if time_offset is None else time_offset)
        except ValueError as error:
            raise ConfigError(f"{error}; give smaller numbers") from error
        if new != stored.correction:
            # refused if the page has corrected it meanwhile: what was not given would be undone
            moved = correct_calibration(opened, stored.id, new, AUTHOR, Basis(stored.adjusted))
    x, y, z = np.degrees(new.turn_rad).tolist()
    report = CalibrationReport(
        recording=stored.name,
        turn_deg=(x, y, z),
        shift_m=new.shift_m,
        time_offset_s=new.time_offset_s,
        moved_labels=moved,
    )
    if as_json:
        print_json(report)
    else:
        print_facts(_rows(report))


def _rows(report: CalibrationReport) -> Iterator[tuple[str, object]]:
    yield "recording", report.recording
    yield "turn", " ".join(f"{x:g}" for x in report.turn_deg) + " degrees"
    yield "shift", " ".join(f"{x:g}" for x in report.shift_m) + " m"
    yield "time offset", f"{report.time_offset_s:g} s"
    if report.moved_labels:
        yield "labels", f"{report.moved_labels} stay where they are in the clouds; train the detectors anew"
