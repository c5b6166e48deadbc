"""`annotator demo`"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from tempfile import mkdtemp

from rich.progress import TaskID

from annotator.cli.generate import Preset
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
    seed: int = 0,
    image_pictures: int = DemoPlan.image_pictures,
    view_pictures: int = DemoPlan.view_pictures,
    serve: bool = True,
) -> None:
    """Run the whole loop on a generated recording: draw boxes, train, propose, score, write the dataset.

    At a terminal it ends with the workbench, open for the review of the proposals.

    Args:
        out: a new folder for all of it; default: one below ./out.
        preset: people in a room, or hands.
        frames: of the recording; every second one is labelled.
        seed: another number, another room.
        image_pictures: how many pictures the image detector is shown in training, repeats counted.
        view_pictures: the same of the pseudo-view detector.
        serve: leave the workbench out at the end.
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

        def tell(stage: str, done: float, total: float) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total, note="")
            bar.update(tasks[stage], completed=done, total=total)

        result = run_demo(root, plan, tell)
    for line in _told(root, result):
        print_line(line)
    if serve and _somebody_watches():
        _review(root)


def _somebody_watches() -> bool:
    """True at a terminal; continuous integration may have one too, but nobody sits there."""
    return sys.stdin is not None and sys.stdin.isatty() and not os.environ.get("CI")


def _review(root: Path) -> None:
    """The workbench on a free port, with the demo's proposals."""
    from annotator.cli.serve import first_page
    from annotator.web.serve import serve
    from annotator.web.settings import ServerSettings

    print_line("")
    serve(ServerSettings(root.resolve(), (root,), port=0), first_page(PROJECT, root), open_browser=True, window=False)


def _require_counts(least: int, **given: int) -> None:
    """Refuses a number that would end the demo after minutes.

    Raises:
        ConfigError: one is too small.
    """
    for name, number in given.items():
        if number < least:
            raise ConfigError(f"--{name.replace('_', '-')} must be {least} or more, not {number}")


def _new_folder() -> Path:
    parent = Path("out")
    parent.mkdir(exist_ok=True)
    return Path(mkdtemp(prefix="demo-", dir=parent))


def _told(root: Path, result: DemoResult) -> list[str]:
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
            f"({s.objects} objects in {s.frames} frames that nobody labelled)"
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
