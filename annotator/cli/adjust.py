"""`annotator up`, `annotator calibrate`, `annotator poses`: what a project sets over the files of a recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from annotator.cli.options import AsJson, Clear, RecordingName
from annotator.cli.output import counted, facts, print_result
from annotator.project import Basis, Project
from annotator.types import NO_CORRECTION
from annotator.types.bases import Strict
from annotator.types.errors import ConfigError, GeometryError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.adjusting import RecordingUp, correct_calibration, estimate_recording_up
from annotator.workflows.recorded.poses import ProjectPoses, estimate_poses, poses_of

UP_AUTHOR = "annotator up"
ORIGINS = {"files": "from the recording's files", "project": "set in the project"}


class UpReport(Strict):
    """The up direction of a recording's first frame; certainty and reason of an estimate that was just made."""

    recording: str
    up: tuple[float, float, float] | None
    source: Literal["unknown", "files", "project"]
    certainty: float | None
    reason: str | None


def run_up(
    project: Project,
    recording: RecordingName,
    direction: Annotated[tuple[float, ...], tyro.conf.arg(metavar="X Y Z")] = (),
    /,
    *,
    estimate: bool = False,
    clear: Clear = False,
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
    stored, found = project.recordings.find(recording), None
    if estimate:
        found = estimate_recording_up(project, stored.id)
        if found.up is None:
            raise GeometryError(
                f"{recording}: {found.reason}; the up direction was not changed; give it as three numbers, or set "
                "the level on the page"
            )
        direction = found.up
    if direction or clear:
        project.adjustments.set_up(stored.id, direction or None, UP_AUTHOR)
    report = _report(project, stored.id, found)
    print_result(report, facts(_up_rows(report)), as_json)


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


def _up_rows(report: UpReport) -> Iterator[tuple[str, object]]:
    yield "recording", report.recording
    if report.up is None:
        yield "up", "not known; --estimate looks for a floor, tables, the ground and walls"
        return
    x, y, z = report.up
    yield "up", f"{x:.4f} {y:.4f} {z:.4f} (camera frame), " + ORIGINS[report.source]
    yield "camera", f"rolled by {np.degrees(np.arctan2(x, -y)):.1f}, pitched by {np.degrees(np.arcsin(z)):.1f} degrees"
    if report.certainty is not None:
        yield "certainty", f"{report.certainty:.2f}: {report.reason}"


CALIBRATE_AUTHOR = "annotator calibrate"
Vector = tuple[float, float, float]


class CalibrationReport(Strict):
    """The correction of a recording: degrees, metres, seconds; and the number of labels that moved with its clouds."""

    recording: str
    turn_deg: Vector
    shift_m: Vector
    time_offset_s: float
    moved_labels: int


def run_calibrate(
    project: Project,
    recording: RecordingName,
    /,
    *,
    turn: Vector | None = None,
    shift: Vector | None = None,
    time_offset: float | None = None,
    clear: Clear = False,
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
    turn_rad = None if turn is None else tuple(np.radians(turn).tolist())
    given: dict[str, Any] = {"turn_rad": turn_rad, "shift_m": shift, "time_offset_s": time_offset}
    given = {name: value for name, value in given.items() if value is not None}
    if clear and given:
        raise ConfigError("give either --clear, or --turn, --shift and --time-offset")
    stored, moved = project.recordings.find(recording), 0
    try:
        new = NO_CORRECTION if clear else replace(stored.correction, **given)
    except ValueError as error:
        raise ConfigError(f"{error}; give smaller numbers") from error
    if new != stored.correction:
        # refused if the page has corrected it meanwhile: what was not given would be undone
        moved = correct_calibration(project, stored.id, new, CALIBRATE_AUTHOR, Basis(stored.adjusted))
    x, y, z = np.degrees(new.turn_rad).tolist()
    report = CalibrationReport(
        recording=stored.name,
        turn_deg=(x, y, z),
        shift_m=new.shift_m,
        time_offset_s=new.time_offset_s,
        moved_labels=moved,
    )
    rows: list[tuple[str, object]] = [
        ("recording", report.recording),
        ("turn", " ".join(f"{x:g}" for x in report.turn_deg) + " degrees"),
        ("shift", " ".join(f"{x:g}" for x in report.shift_m) + " m"),
        ("time offset", f"{report.time_offset_s:g} s"),
    ]
    if moved:
        rows.append(("labels", f"{moved} stay where they are in the clouds; train the detectors anew"))
    print_result(report, facts(rows), as_json)


POSES_AUTHOR = "annotator poses"


def run_poses(
    project: Project,
    recording: RecordingName,
    /,
    *,
    estimate: bool = False,
    replace: bool = False,
    clear: Clear = False,
    as_json: AsJson = False,
) -> None:
    """Show where the camera of a recording was, or estimate it, so that objects can stand still in the world.

    An estimate registers each frame with those before it: colours and depths, or scans. Most of the scene must stand
    still. Frames of which this is not certain get no pose, and are named. Errors add up along the way: a place that is
    seen again corrects nothing (no loop closure).

    Args:
        estimate: estimate the poses, in one undoable step; a stopped run changes nothing.
        replace: with --estimate, in the place of poses that the recording has.
    """
    if (replace and not estimate) or (estimate and clear):
        raise ConfigError("give --estimate, with or without --replace, or --clear; neither of them shows the poses")
    stored = project.recordings.find(recording)
    if estimate:
        with counted("estimate") as progress:
            estimate_poses(project, stored.id, POSES_AUTHOR, replace=replace, progress=progress)
    if clear:
        project.estimates.keep(stored.id, (), POSES_AUTHOR)
    report = poses_of(project, stored.id)
    print_result(report, facts(_poses_rows(report)), as_json)


def _poses_rows(report: ProjectPoses) -> Iterator[tuple[str, object]]:
    yield "recording", report.recording
    if (poses := report.poses) is None:
        yield "poses", "none; --estimate finds them by what the frames show"
        return
    yield "poses", poses.words()
    if (sure := report.certainty) is not None:
        yield (
            "certainty",
            f"overlap {sure.overlap[0]:.2f}, least {sure.overlap[1]:.2f}; residual {sure.rmse:.4f}; grip "
            f"{sure.grip[0]:.2f}, least {sure.grip[1]:.2f}; no loop closure",
        )
    yield from (("poses", problem) for problem in (*poses.gaps, *poses.jumps, *report.warnings))
