"""`annotator demo`"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from tempfile import mkdtemp

from rich.progress import TaskID

from annotator.cli.generate import Preset
from annotator.cli.options import Seed
from annotator.cli.output import print_line
from annotator.cli.progress import progress_bar
from annotator.types.errors import ConfigError
from annotator.workflows.demo import PROJECT, DemoPlan, DemoResult, run_demo


def run(
    out: Path | None = None,
    /,
    *,
    preset: Preset = Preset.PEOPLE,
    frames: int = DemoPlan.frames,
    seed: Seed = 0,
    image_pictures: int = DemoPlan.image_pictures,
    view_pictures: int = DemoPlan.view_pictures,
    no_serve: bool = False,
) -> None:
    """Run the whole loop on a generated recording: draw boxes, train, propose, score, export.

    At a terminal, the workbench opens at the end, ready to review the proposals.

    Args:
        out: new folder for everything; default: a folder in ./out.
        preset: scene to generate: people who walk, turn and gesture in a room, hands in front of the camera, or objects
            of many shapes on a table or on the floor.
        frames: number of frames to generate; every second one is labelled.
        image_pictures: number of training images of the image detector, repeats included.
        view_pictures: number of training images of the pseudo-view detector, repeats included.
        no_serve: do not open the workbench at the end.
    """
    _require_counts(2, frames=frames)
    _require_counts(1, image_pictures=image_pictures, view_pictures=view_pictures)
    _require_counts(0, seed=seed)
    root = out if out is not None else _new_folder()
    plan = DemoPlan(
        preset=preset.value, frames=frames, seed=seed, image_pictures=image_pictures, view_pictures=view_pictures
    )
    with progress_bar() as bar:
        tasks: dict[str, TaskID] = {}

        def progress(stage: str, done: float, total: float) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total, note="")
            bar.update(tasks[stage], completed=done, total=total)

        result = run_demo(root, plan, progress)
    for line in _summary(root, result):
        print_line(line)
    if not no_serve and _is_interactive():
        _review(root)


def _is_interactive() -> bool:
    """True at a terminal, except in continuous integration, which may have a terminal too."""
    return sys.stdin is not None and sys.stdin.isatty() and not os.environ.get("CI")


def _review(root: Path) -> None:
    """Opens the workbench on a free port, with the demo's proposals."""
    from annotator.cli.serve import first_page
    from annotator.web.serve import serve
    from annotator.web.settings import ServerSettings

    print_line("")
    serve(ServerSettings(root.resolve(), (root,), port=0), first_page(PROJECT, root), open_browser=True, window=False)


def _require_counts(least: int, **options: int) -> None:
    """Checks numbers before the work starts; otherwise the demo would fail after minutes.

    Raises:
        ConfigError: a number is too small.
    """
    for name, number in options.items():
        if number < least:
            raise ConfigError(f"--{name.replace('_', '-')} must be {least} or more, not {number}")


def _new_folder() -> Path:
    parent = Path("out")
    parent.mkdir(exist_ok=True)
    return Path(mkdtemp(prefix="demo-", dir=parent))


def _summary(root: Path, result: DemoResult) -> list[str]:
    drawn, done = result.drawn, result.annotated
    return [
        "",
        f"drawn      {drawn.boxes} 2D boxes on {drawn.frames} frames",
        *(
            f"trained    {t.role} detector, {t.seconds:.0f} s, mAP50 {t.result.metrics.map50:.2f}"
            for t in result.trained
        ),
        f"proposed   {done.proposals} oriented 3D boxes in {done.done} frames, {done.seconds:.0f} s",
        *(
            f"scored     {s.label}: mean IoU {s.mean_iou:.2f}, AP25 {s.ap25:.2f}, AP50 {s.ap50:.2f} "
            f"({s.objects} objects in {s.frames} frames without labels)"
            for s in result.scores
        ),
        f"written    {result.dataset.objects} boxes in {result.dataset.frames} frames",
        f"took       {sum(result.seconds.values()):.0f} s: "
        + ", ".join(f"{name} {seconds:.0f}" for name, seconds in result.seconds.items()),
        "",
        f"recording  {root / 'recording'}",
        f"project    {root / 'demo'} (annotator serve demo --projects {root})",
        f"dataset    {next(root.glob('3D_*'))}",
    ]
