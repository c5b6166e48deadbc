"""`annotator evaluate`"""

from __future__ import annotations

from pathlib import Path

from annotator.cli.output import AsJson, print_json, print_line
from annotator.cli.projects import Root, open_named
from annotator.evaluation.report import Report
from annotator.types.errors import ConfigError
from annotator.workflows.evaluate import Options, Protocol, evaluate_files, read_frame_names
from annotator.workflows.evaluate_project import Against, Choice, Measured, evaluate_project

# Where no terminal says how wide it is, nothing shall be cut.
WIDTH = 160


def run(
    detections: Path | None = None,
    truth: Path | None = None,
    /,
    *,
    protocol: Protocol,
    project: str | None = None,
    measured: Measured = Measured.LABELS,
    against: Against = Against.TRUTH,
    recordings: tuple[str, ...] = (),
    frames: Path | None = None,
    relaxed: bool = False,
    curves: Path | None = None,
    as_json: AsJson = False,
    root: Root = None,
) -> None:
    """Measure boxes against truth, by the rules of a benchmark: files, or what is in a project.

    Args:
        detections: kitti = a folder (or zip) of result files; sunrgbd = a CSV of boxes; oriented = an rcv dataset.
        truth: the same, of true boxes; kitti = `label_2`.
        protocol: kitti = AP on the image, in bird's-eye view and 3D, and AOS, as the devkit has them; sunrgbd = mAP
            as VoteNet has it; oriented = AP with exact 3D IoU of freely turned boxes, mean IoU, errors of the poses.
        project: measure a project's boxes, in place of files.
        measured: labels = its boxes as they are now; proposals = what the last automatic pass proposed.
        against: truth = the boxes that its recordings bring; reviewed = accepted and edited labels, in frames where
            nothing is left to review.
        recordings: names of the project's recordings; default: all.
        frames: file with the names of the frames to evaluate, one a line (kitti: as ImageSets/val.txt; sunrgbd: the
            images; oriented, and projects: RECORDING/KEY); default: all.
        relaxed: kitti: the looser overlaps that are often given beside the official ones.
        curves: folder for the precision-recall curves, as PNG.
        as_json: print one JSON object.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    if relaxed and protocol is not Protocol.KITTI:
        raise ConfigError("--relaxed belongs to the kitti protocol; the others have their thresholds side by side")
    options = Options(None if frames is None else read_frame_names(frames), relaxed)
    if project is None:
        if measured is not Measured.LABELS or against is not Against.TRUTH or recordings:
            raise ConfigError("--measured, --against and --recordings say what of a --project is compared")
        if detections is None or truth is None:
            raise ConfigError("name what was detected and the truth, or a project: annotator evaluate --help")
        report = evaluate_files(detections, truth, protocol, options)
    else:
        if detections is not None:
            raise ConfigError("--project takes the place of files; name one or the other")
        with open_named(project, root) as opened:
            ids = tuple(opened.recordings.find(name).id for name in recordings) or None
            report = evaluate_project(opened, protocol, Choice(measured, against, ids), options)
    # before the curves, whose folder may not be writable: the numbers may have taken minutes
    _show(report, as_json)
    if curves is not None:
        from annotator.evaluation.curves import draw_curves

        pictures = draw_curves(report.pictures, curves)
        if not as_json:
            print_line(f"{curves}: {len(pictures)} pictures")


def _show(report: Report, as_json: bool) -> None:
    if as_json:
        print_json(report.content)
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(*report.columns)
    for row in report.rows:
        table.add_row(*map(_cell, row))
    console = Console()
    (console if console.is_terminal else Console(width=WIDTH)).print(table)
    for note in report.notes:
        print_line(f"note: {note}")


def _cell(value: str | int | float | None) -> str:
    if isinstance(value, float):
        # nothing was measured: not a number
        return f"{value:.3f}" if value == value else ""
    return "" if value is None else str(value)
