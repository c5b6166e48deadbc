"""`annotator annotate`"""

from __future__ import annotations

from pathlib import Path

from pydantic import JsonValue

from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import Root, open_named
from annotator.project import BoxRotation
from annotator.rcv.config import Strategy
from annotator.workflows.annotate import AnnotateSummary, annotate
from annotator.workflows.detectors import active_detectors
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
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    with open_named(project, root) as opened:
        options: dict[str, JsonValue] = {} if axes is None else {"strategy": axes.value}
        settings = rcv_config(opened, config, options | ({"coarse_box": True} if coarse else {}))
        if show_config:
            print_line(editable(settings))
            return 0
        detectors = active_detectors(opened)
        settings = settings.model_copy(update={"box_kind": detectors.box_kind})
        chosen = [opened.recordings.find(name).id for name in recordings] or None
        with counted("annotate") as progress:
            done = annotate(
                opened, detectors, settings, recordings=chosen, rotation=rotation, limit=limit, progress=progress
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
