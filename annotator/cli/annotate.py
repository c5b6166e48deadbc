"""`annotator annotate`"""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from pydantic import JsonValue

from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import Root, open_named
from annotator.detection.config import Backend
from annotator.project import BoxRotation
from annotator.rcv.config import Strategy
from annotator.workflows.annotate import annotate_with, require_limit
from annotator.workflows.batch_book import AnnotateSummary
from annotator.workflows.engines.choose import EngineName, make_engine
from annotator.workflows.engines.sources import trained_detectors
from annotator.workflows.engines.storage import CACHE_MB, Storage, parse_elsewhere
from annotator.workflows.rcv_settings import editable, rcv_config

SHOWN_FAILURES = 10


def run(
    project: str,
    /,
    *,
    recordings: tuple[str, ...] = (),
    axes: Strategy | None = None,
    rotation: BoxRotation | None = None,
    coarse: bool = False,
    config: Path | None = None,
    show_config: bool = False,
    limit: int | None = None,
    from_reviewed: bool = False,
    engine: EngineName = EngineName.AUTO,
    workers: int | None = None,
    threads: int | None = None,
    backend: Backend = "auto",
    address: str | None = None,
    elsewhere: tuple[str, ...] = (),
    cache_mb: int = CACHE_MB,
    root: Root = None,
) -> int:
    """Propose oriented 3D boxes for every frame that these detectors and settings have not done yet.

    A frame that fails is stored with its reason and tried again next time; the exit code is 1 if there was one.

    Every threshold of the recursion is a setting: options here win over --config, that over settings.rcv in the
    project's project.json (which training and simulated drawing follow, too), that over the defaults.

    Args:
        project: the project's name.
        recordings: names of the recordings to do; default: all.
        axes: how the projection axes are found; default: the settings'.
        rotation: upright, free, or (auto) upright where a recording knows gravity; default: the project's setting.
        coarse: propose the last box of an object that the recursion loses after its first step.
        config: JSON file with any of the recursion's settings.
        show_config: print all settings as they would be used, with units in their names, and do nothing; what is
            printed can be edited and given to --config.
        limit: at most so many frames.
        from_reviewed: start from the reviewed boxes of the frame before, where there are any; a setting of its own,
            with which all frames are done anew.
        engine: inline works in this process, local in worker processes, ray on a cluster (docs/cluster.md), all with
            the same results; auto takes local where there are several cores and enough frames.
        workers: of the engine; default: one a GPU, or else one a core.
        threads: of the processor for each worker; default: its share of the cores, with ray one.
        backend: what runs the detectors; auto takes the fastest that gives what torch does, fastest also half
            precision on processors that have it.
        address: of a Ray cluster, HOST:PORT or auto; default: one on this machine, for as long as this takes.
        elsewhere: FOLDER=PLACE where workers find the recordings below FOLDER, a path or a storage's URL, such as
            /data=s3://bucket/data.
        cache_mb: so much of recordings in a storage a worker keeps on its disk, megabytes.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    with open_named(project, root) as opened:
        options: dict[str, JsonValue] = {} if axes is None else {"strategy": axes.value}
        settings = rcv_config(opened, config, options | ({"coarse_box": True} if coarse else {}))
        if show_config:
            print_line(editable(settings))
            return 0
        require_limit(limit)
        source = trained_detectors(opened, backend)
        settings = settings.model_copy(update={"box_kind": source.box_kind})
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
            ) as made,
            counted("annotate") as progress,
        ):
            done = annotate_with(
                opened,
                made,
                settings,
                recordings=chosen,
                rotation=rotation,
                limit=limit,
                from_reviewed=from_reviewed,
                progress=progress,
            )
    for line in told(done):
        print_line(line)
    return 1 if done.failures else 0


def told(done: AnnotateSummary) -> list[str]:
    """The summary in lines."""
    rate = f", {done.seconds / done.done:.2f} s a frame" if done.done else ""
    named = ", ".join(dict.fromkeys(filter(None, done.backends)))
    backends = f"; detectors on {named}" if named else ""
    lines = [
        f"{done.done} frames done, {done.proposals} proposals ({done.without} frames without), "
        f"{done.skipped} skipped, {done.failures} failed; {done.seconds:.1f} s{rate}{backends}"
    ]
    lines += [f"  failed {key}: {reason}" for key, reason in done.failed[:SHOWN_FAILURES]]
    if done.failures > SHOWN_FAILURES:
        lines.append(f"  and {done.failures - SHOWN_FAILURES} more")
    return lines
