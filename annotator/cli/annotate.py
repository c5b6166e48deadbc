"""`annotator annotate`"""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Annotated

from pydantic import JsonValue
from tyro.conf import arg

from annotator.cli.options import BackendOption, Limit, ProjectName, Projects, RecordingNames, Rotation
from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import open_named
from annotator.detection.config import Backend
from annotator.project import BoxRotation
from annotator.rcv.config import Strategy
from annotator.types.messages import amount
from annotator.workflows.detectors import stand_in
from annotator.workflows.proposing.annotate import annotate_with, require_limit
from annotator.workflows.proposing.batch_store import AnnotateSummary
from annotator.workflows.proposing.engines.choose import EngineName, make_engine
from annotator.workflows.proposing.engines.sources import trained_detectors
from annotator.workflows.proposing.engines.storage import CACHE_MB, Storage, parse_elsewhere
from annotator.workflows.settings import editable, rcv_config

SHOWN_FAILURES = 10


def run(
    project: ProjectName,
    /,
    *,
    recordings: RecordingNames = (),
    axes: Strategy | None = None,
    rotation: Annotated[
        Rotation[BoxRotation | None], arg(help_behavior_hint="(default: the project's setting)")
    ] = None,
    coarse: bool = False,
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
    projects: Projects = None,
) -> int:
    """Propose oriented 3D boxes for every frame not yet processed with the current detectors and settings.

    If a frame fails, the reason is stored and the next call tries the frame again; the exit code is then 1.

    Every threshold of the recursion is a setting. Options override the file of --config, the file overrides
    settings.rcv in the project's project.json (which training and simulated drawing also use), and project.json
    overrides the defaults.

    Args:
        axes: method that finds the projection axes; default: the project's setting.
        coarse: if the recursion loses an object after the first step, propose the object's last box.
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
    with open_named(project, projects) as opened:
        options: dict[str, JsonValue] = {} if axes is None else {"strategy": axes.value}
        settings = rcv_config(opened, config, options | ({"coarse_box": True} if coarse else {}))
        if show_config:
            print_line(editable(settings))
            return 0
        require_limit(limit)
        source = trained_detectors(opened, backend)
        named = stand_in(opened)
        chosen = [opened.recordings.find(name).id for name in recordings] or None
        present = opened.frames.count_present(chosen)
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
                opened,
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
    for line in summary_lines(done):
        print_line(line)
    return 1 if done.failures else 0


def summary_lines(done: AnnotateSummary) -> list[str]:
    """The summary as lines of text."""
    rate = f", {done.seconds / done.done:.2f} s per frame" if done.done else ""
    named = ", ".join(dict.fromkeys(filter(None, done.backends)))
    backends = f"; detectors on {named}" if named else ""
    proposals = f"{amount(done.proposals, 'proposal')} ({amount(done.without, 'frame')} without)"
    lines = [
        *done.learned,
        f"{amount(done.done, 'frame')} done, {proposals}, "
        f"{done.skipped} skipped, {done.failures} failed; {done.seconds:.1f} s{rate}{backends}",
    ]
    lines += [f"  failed {key}: {reason}" for key, reason in done.failed[:SHOWN_FAILURES]]
    if done.failures > SHOWN_FAILURES:
        lines.append(f"  and {done.failures - SHOWN_FAILURES} more")
    return lines
