"""`annotator evaluate`"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from annotator.cli.options import AsJson, Projects, RecordingNames, ids_of, open_named
from annotator.cli.output import print_line, print_lines
from annotator.evaluation.report import Report
from annotator.types.errors import ConfigError
from annotator.types.messages import amount
from annotator.workflows import evaluate

# Width of tables where the output is not a terminal, so that nothing is cut.
WIDTH = 160


def run(
    detections: Path | None = None,
    truth: Path | None = None,
    /,
    *,
    protocol: evaluate.Protocol,
    project: str | None = None,
    measured: evaluate.Measured = evaluate.Measured.LABELS,
    against: evaluate.Against = evaluate.Against.TRUTH,
    recordings: RecordingNames = (),
    frame_list: Path | None = None,
    relaxed: bool = False,
    curves: Path | None = None,
    as_json: AsJson = False,
    projects: Projects = None,
) -> None:
    """Score the boxes of files or of a project against ground truth, by a benchmark's protocol.

    Args:
        detections: boxes to score: kitti = folder (or zip) of result files; sunrgbd = CSV of boxes; oriented = rcv
            dataset.
        truth: ground truth in the same format; kitti = folder `label_2`, or a dataset with it.
        protocol: kitti = 2D, bird's-eye view and 3D AP, and AOS, as in the devkit; sunrgbd = mAP as in VoteNet;
            oriented = AP with the exact 3D IoU of freely rotated boxes, mean IoU, pose errors.
        project: name of a project to score, instead of files.
        measured: labels = the project's current boxes; proposals = the boxes of the last run of `annotator annotate`.
        against: truth = the boxes that come with the recordings; reviewed = accepted and edited labels, in fully
            reviewed frames.
        frame_list: text file with the names of the frames to evaluate, one per line (kitti: like ImageSets/val.txt;
            sunrgbd: names of the images; oriented and projects: RECORDING/KEY); default: all.
        relaxed: with kitti: the looser overlap thresholds that are often reported beside the official ones.
        curves: folder for the precision-recall curves, as PNG files.
    """
    if relaxed and protocol is not evaluate.Protocol.KITTI:
        raise ConfigError("--relaxed is for the kitti protocol; the other protocols always report several thresholds")
    options = evaluate.Options(None if frame_list is None else evaluate.read_frame_names(frame_list), relaxed)
    if project is None:
        if measured is not evaluate.Measured.LABELS or against is not evaluate.Against.TRUTH or recordings:
            raise ConfigError("--measured, --against and --recordings need --project")
        if detections is None or truth is None:
            raise ConfigError("give DETECTIONS and TRUTH, or --project; see annotator help evaluate")
        report = evaluate.evaluate_files(detections, truth, protocol, options)
    else:
        if detections is not None:
            raise ConfigError("give either files or --project, not both")
        with open_named(project, projects) as opened:
            ids = ids_of(opened, recordings)
            report = evaluate.evaluate_project(
                opened, protocol, replace(options, measured=measured, against=against, recordings=ids)
            )
    # print first: the numbers may have taken minutes, and writing the curves may fail
    _show(report, as_json)
    if curves is not None:
        from annotator.evaluation.report import draw_curves

        files = draw_curves(report.diagrams, curves)
        if not as_json:
            print_line(f"{curves}: {amount(len(files), 'image')}")


def _show(report: Report, as_json: bool) -> None:
    if as_json:
        print_line(report.content.model_dump_json())
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(*report.columns)
    for row in report.rows:
        table.add_row(*map(_cell, row))
    console = Console()
    (console if console.is_terminal else Console(width=WIDTH)).print(table)
    print_lines(f"note: {note}" for note in report.notes)


def _cell(value: str | int | float | None) -> str:
    if isinstance(value, float):
        return f"{value:.3f}" if value == value else ""  # NaN: nothing was measured
    return "" if value is None else str(value)
