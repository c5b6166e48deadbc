"""`annotator simulate`, `views`, `annotate`, `lift`: 2D boxes, and the 3D boxes proposed from them."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Annotated

from pydantic import JsonValue
from tyro.conf import arg

from annotator.cli.options import BackendOption, BoxKindOption, Limit, RecordingName, RecordingNames, Rotation, ids_of
from annotator.cli.output import counted, print_line, print_lines
from annotator.detection.config import Backend
from annotator.project import BoxRotation, Project
from annotator.rcv.config import Strategy
from annotator.types import BoxKind
from annotator.types.errors import ConfigError
from annotator.types.messages import amount
from annotator.workflows.detectors import Detectors, load_detector, stand_in, trained_detectors
from annotator.workflows.importing import FlatFormat
from annotator.workflows.importing.placing import class_names
from annotator.workflows.proposing import lift as lifting
from annotator.workflows.proposing.annotate import AnnotateSummary, annotate, annotate_with, require_limit
from annotator.workflows.proposing.engines import EngineName, make_engine
from annotator.workflows.proposing.tasks import CACHE_MB, Storage, parse_elsewhere
from annotator.workflows.settings import editable, rcv_config
from annotator.workflows.simulate import simulate_recording
from annotator.workflows.views import COCO, write_views
from annotator.workflows.workbench.drawing_steps import to_draw_on
from annotator.workflows.workbench.loaded_detectors import require_view

SHOWN_FAILURES = 10


def run_annotate(
    project: Project,
    /,
    *,
    recordings: RecordingNames = (),
    axes: Strategy | None = None,
    rotation: Annotated[
        Rotation[BoxRotation | None], arg(help_behavior_hint="(default: the project's setting)")
    ] = None,
    config: Path | None = None,
    show_config: bool = False,
    limit: Limit = None,
    from_reviewed: bool = False,
    engine: EngineName = EngineName.AUTO,
    workers: int | None = None,
    threads: int | None = None,
    backend: BackendOption[Backend] = "auto",
    address: str | None = None,
    elsewhere: tuple[str, ...] = (),
    cache_mb: int = CACHE_MB,
) -> int:
    """Propose oriented 3D boxes for every frame not yet processed with the current detectors and settings.

    If a frame fails, the reason is stored and the next call tries the frame again; the exit code is then 1.

    Options override the file of --config, the file overrides settings.rcv in the project's project.json (which training
    and simulated drawing also use), and project.json overrides the defaults.

    Args:
        axes: method that finds the projection axes; default: the project's setting.
        config: JSON file with some or all settings of the recursion.
        show_config: print all settings that would be used and exit; the output can be edited and passed to --config.
        from_reviewed: start from the reviewed boxes of the previous frame, if any; frames processed without this option
            are processed again.
        engine: inline = this process, local = worker processes, ray = a cluster (docs/cluster.md), auto = local if
            there are several cores and enough frames, else inline; the results are the same.
        workers: number of workers; default: one per GPU, or one per core without a GPU.
        threads: CPU threads of each worker; default: an equal share of the cores; with ray: 1.
        address: address of a Ray cluster, HOST:PORT or auto; default: a temporary one on this machine.
        elsewhere: FOLDER=PLACE, such as /data=s3://bucket/data: workers read the recordings in FOLDER from PLACE, a
            path or a storage URL.
        cache_mb: disk cache of each worker for recordings in object storage, megabytes.
    """
    options: dict[str, JsonValue] = {} if axes is None else {"strategy": axes.value}
    settings = rcv_config(project, config, options)
    if show_config:
        print_line(editable(settings))
        return 0
    require_limit(limit)
    source = trained_detectors(project, backend)
    named = stand_in(project)
    chosen = ids_of(project, recordings)
    present = project.frames.count_present(chosen)
    with (
        closing(
            make_engine(
                engine,
                source,
                frames=present if limit is None else min(present, limit),
                workers=workers,
                threads=threads,
                address=address,
                storage=Storage(parse_elsewhere(elsewhere), cache_mb),
            )
        ) as running,
        counted("annotate") as progress,
    ):
        done = annotate_with(
            project,
            running,
            settings,
            recordings=chosen,
            rotation=rotation,
            limit=limit,
            from_reviewed=from_reviewed,
            progress=progress,
        )
    if named is not None:
        print_line(f"view detector: {named}")
    print_lines(summary_lines(done))
    return 1 if done.failures else 0


def summary_lines(done: AnnotateSummary) -> list[str]:
    rate = f", {done.seconds / done.done:.2f} s per frame" if done.done else ""
    named = ", ".join(dict.fromkeys(filter(None, done.backends)))
    backends = f"; detectors on {named}" if named else ""
    proposals = f"{amount(done.proposals, 'proposal')} ({amount(done.without, 'frame')} without)"
    lines = [
        *done.learned,
        f"{amount(done.done, 'frame')} done, {proposals}, "
        f"{done.skipped} skipped, {done.failures} failed; {done.seconds:.1f} s{rate}{backends}",
    ]
    if done.still:
        lines.append(f"{amount(done.still, 'proposal')} of objects that stand still, each for all frames that see it")
    lines += [f"  failed {key}: {reason}" for key, reason in done.failed[:SHOWN_FAILURES]]
    if done.failures > SHOWN_FAILURES:
        lines.append(f"  and {done.failures - SHOWN_FAILURES} more")
    return lines


WEIGHTS_SIZE_PX = 640


def run_lift(
    project: Project,
    /,
    *,
    boxes: Path | None = None,
    format: FlatFormat = FlatFormat.COCO,
    recording: str | None = None,
    detector: Path | None = None,
    classes: str | None = None,
    detector_size: int = WEIGHTS_SIZE_PX,
    box_kind: BoxKindOption[BoxKind] = BoxKind.SILHOUETTE,
    backend: BackendOption[Backend] = "auto",
) -> int:
    """Propose oriented 3D boxes for 2D boxes on the camera images; nothing has to be trained.

    The 2D boxes are those drawn in the project, those of a file, or those of a 2D detector. The project's own
    pseudo-view detector measures the objects. A project without one uses the base detector, which needs no training, if
    this installation has it. With --detector, --recording selects the frames on which the detector runs. Boxes that
    were drawn in the project know their --box-kind.

    Args:
        boxes: COCO file or YOLO folder with boxes on camera images named like the project's frames.
        format: format of --boxes.
        recording: name of the recording that the boxes belong to, if several have frames of the same name.
        detector: weights of a 2D detector (a published ultralytics model, or the file of a training).
        classes: the project's classes of the file's or detector's classes, such as car=Car,van=Car; others keep their
            names.
        detector_size: input size of --detector, longer side, pixels.
    """
    if boxes is not None and detector is not None:
        raise ConfigError("--boxes and --detector exclude each other; give one")
    names = {} if classes is None else class_names(classes, project)
    view, config = require_view(project), rcv_config(project)
    if detector is not None:
        weights = load_detector(detector, backend, detector_size)
        loaded, origin = (
            lifting.RenamedDetector(weights, project.config.classes, names),
            f"the detector {detector.name}",
        )
        lifting.require_known(view, loaded.labels)
        chosen = ids_of(project, () if recording is None else (recording,))
        pair = Detectors(loaded, view, view.box_kind, view.class_agnostic, box_kind, view.trained)
        with counted("lift") as progress:
            done = annotate(project, pair, config, recordings=chosen, progress=progress)
    else:
        if boxes is None:
            given = lifting.drawn_boxes(project)
        else:
            given = lifting.boxes_of_file(project, boxes, format, recording, names, box_kind)
        with counted("lift") as progress:
            done = lifting.lift(project, given, view, config, progress)
        origin = given.origin
        print_lines(given.left_out.sentences())
    print_line(f"3D boxes from {origin}, measured by: {view.title}")
    print_lines(summary_lines(done))
    return 1 if done.failures else 0


def run_simulate(
    project: Project,
    recording: RecordingName,
    /,
    *,
    box_kind: BoxKindOption[BoxKind] = BoxKind.SILHOUETTE,
    every: int = 1,
) -> None:
    """Draw 2D boxes from a recording's ground truth, five per object, as an operator would.

    For silhouettes in a project with one class, masks (mask/) are enough; boxes.json is not needed.

    Args:
        every: label every Nth frame, starting with the first.
    """
    with counted("drawing") as progress:
        stored = project.recordings.find(recording)
        drawn = simulate_recording(project, stored.id, box_kind, rcv_config(project), every, progress)
    print_line(
        f"{amount(drawn.frames, 'frame')}, {amount(drawn.objects, 'object')}, {amount(drawn.boxes, '2D box')} drawn"
    )
    print_line(f"next: annotator train {project.path.name}")


def run_views(project: Project, out: Path, /, *, step: int = 1) -> None:
    """Write pseudo-views as PNG files, to be labelled in any 2D tool that reads and writes COCO.

    Step 1 needs boxes on camera images, step 2 needs boxes on both views of step 1.

    Args:
        out: new folder for the images, `coco.json` (the images without boxes) and `views.json` (their poses).
        step: step of the recursion, 1 or 2.
    """
    written = write_views(project, out, step, to_draw_on(project, rcv_config(project)))
    print_line(f"{amount(written.pictures, 'pseudo-view')} in {out}")
    print_lines(f"skipped: frame {line}" for line in written.unreadable)
    print_line(f"next: draw boxes, then annotator import {project.path.name} {out / COCO} --pictures {out}")
