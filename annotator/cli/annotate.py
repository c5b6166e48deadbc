"""`annotator annotate`"""

from __future__ import annotations

from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import Root, open_named
from annotator.project import BoxRotation
from annotator.rcv.config import RcvConfig, Strategy
from annotator.workflows.annotate import AnnotateSummary, annotate
from annotator.workflows.detectors import active_detectors

SHOWN_FAILURES = 10


def run(
    project: str,
    /,
    *,
    recordings: tuple[str, ...] = (),
    axes: Strategy = RcvConfig.model_fields["strategy"].default,
    rotation: BoxRotation | None = None,
    coarse: bool = False,
    limit: int | None = None,
    root: Root = None,
) -> int:
    """Propose oriented 3D boxes for every frame that these detectors and settings have not done yet.

    A frame that fails is stored with its reason and tried again next time; the exit code is 1 if there was one.

    Args:
        project: the project's name.
        recordings: names of the recordings to do; default: all.
        axes: how the projection axes are found.
        rotation: upright, free, or (auto) upright where a recording knows gravity; default: the project's setting.
        coarse: propose the last box of an object that the recursion loses after its first step.
        limit: at most so many frames.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    with open_named(project, root) as opened:
        detectors = active_detectors(opened)
        config = RcvConfig(strategy=axes, box_kind=detectors.box_kind, coarse_box=coarse)
        chosen = [opened.recordings.find(name).id for name in recordings] or None
        with counted("annotate") as progress:
            done = annotate(
                opened, detectors, config, recordings=chosen, rotation=rotation, limit=limit, progress=progress
            )
    for line in told(done):
        print_line(line)
    return 1 if done.failed else 0


def told(done: AnnotateSummary) -> list[str]:
    """The summary in lines."""
    rate = f", {done.seconds / done.done:.2f} s a frame" if done.done else ""
    lines = [
        f"{done.done} frames done, {done.proposals} proposals ({done.without} frames without), "
        f"{done.skipped} skipped, {len(done.failed)} failed; {done.seconds:.1f} s{rate}"
    ]
    lines += [f"  failed {key}: {reason}" for key, reason in done.failed[:SHOWN_FAILURES]]
    if len(done.failed) > SHOWN_FAILURES:
        lines.append(f"  and {len(done.failed) - SHOWN_FAILURES} more")
    return lines
