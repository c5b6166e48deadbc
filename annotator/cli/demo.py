"""`annotator demo`"""

from __future__ import annotations

import os
import sys
import threading
from contextlib import AbstractContextManager, ExitStack, suppress
from pathlib import Path
from tempfile import mkdtemp
from typing import Literal

from rich.progress import Progress as Bar
from rich.progress import TaskID

from annotator.cli.options import Seed
from annotator.cli.output import counted, print_line, print_lines, progress_bar
from annotator.demo import PROJECT, FirstDragResult, Plan, Progress, TrainedResult, run_first_drag, run_trained
from annotator.detection.pretrained import has_base
from annotator.synthetic import write_generated
from annotator.types.errors import ConfigError
from annotator.types.messages import amount

# Without and with training: it needs frames to learn from, and others to be scored on.
FRAMES = {False: 24, True: 48}


Preset = Literal["people", "hands", "objects"]
"""The scene that is generated."""


def generate(
    out: Path,
    /,
    *,
    preset: Preset | Literal["tour", "drive"] = "people",
    frames: int = 30,
    seed: Seed = 0,
    width: int = 640,
    height: int = 480,
    drift: float = 0.0,
) -> None:
    """Generate a synthetic recording, of an RGB-D camera or of a LiDAR, with exact ground truth in separate files.

    Args:
        out: new folder for the recording.
        preset: scene to generate: people who walk, turn and gesture in a room, hands in front of the camera, or objects
            of many shapes on a table or on the floor; a tour of a room with twelve objects and three people, by a
            camera with poses; or a drive of a LiDAR with poses, past twenty parked and six moving cars, and walkers.
        frames: number of frames to generate, ten per second.
        width: width of the images, pixels.
        height: height of the images, pixels.
        drift: by which the poses of a tour or drive are wrong, share of the way, such as 0.01.
    """
    with counted("ray-casting") as progress:
        write_generated(out, preset, frames, seed, width, height, progress, drift)
    print_line(f"{out}: {amount(frames, 'frame')} of {preset}")


def demo(
    out: Path | None = None,
    /,
    *,
    preset: Preset = "people",
    frames: int | None = None,
    seed: Seed = 0,
    train: bool = False,
    no_serve: bool = False,
) -> None:
    """Label a generated recording with one 2D box per object; or, with --train, train detectors first.

    Without --train, a simulated operator draws one 2D box around each object. The base detector turns them into 3D
    boxes, which are followed through the recording, reviewed and exported. With --train, the operator draws five 2D
    boxes per object in every second frame, and two detectors learn from them, which takes minutes. An installation
    without the base detector always trains.

    At a terminal, the workbench opens: with the first 3D boxes, or with --train at the end.

    Args:
        out: new folder for everything; default: a folder in ./out.
        preset: scene to generate: people who walk, turn and gesture in a room, hands in front of the camera, or objects
            of many shapes on a table or on the floor.
        frames: number of frames to generate; default: 24, or 48 with --train.
        train: train an image detector and a pseudo-view detector.
        no_serve: do not open the workbench.
    """
    # before the work starts, which would fail after minutes
    if frames is not None and frames < 2:
        raise ConfigError(f"--frames must be 2 or more, not {frames}")
    if seed < 0:
        raise ConfigError(f"--seed must be 0 or more, not {seed}")
    root = out if out is not None else _new_folder()
    if not train and not has_base():
        print_line(
            "this installation has no base detector, so the demo trains two detectors first, which takes minutes"
        )
        train = True
    opens = not no_serve and _is_interactive()
    plan = Plan(preset, frames or FRAMES[train], seed)
    (_with_training if train else _without_training)(root, plan, opens=opens)


def _without_training(root: Path, plan: Plan, *, opens: bool) -> None:
    is_open = False
    with ExitStack() as workbench:

        def show() -> None:
            nonlocal is_open
            if opens:
                workbench.enter_context(_workbench(root))
                is_open = True

        with progress_bar() as bar:
            result = run_first_drag(root, plan, _shown_on(bar), show)
        print_lines(_summary_without_training(root, result))
        if is_open:
            _wait_for_interrupt()


def _with_training(root: Path, plan: Plan, *, opens: bool) -> None:
    with progress_bar() as bar:
        result = run_trained(root, plan, _shown_on(bar))
    print_lines(_summary_with_training(root, result))
    if opens:
        with _workbench(root):
            _wait_for_interrupt()


def _wait_for_interrupt() -> None:
    print_line("stop the workbench with Ctrl-C")
    with suppress(KeyboardInterrupt):
        threading.Event().wait()


def _workbench(root: Path) -> AbstractContextManager[None]:
    """The workbench on a free port, with the demo's project."""
    from annotator.cli.serve import first_page
    from annotator.web.security import ServerSettings, with_token
    from annotator.web.serve import serving

    return serving(with_token(ServerSettings(root.resolve(), (root,), port=0)), first_page(PROJECT, root))


def _shown_on(bar: Bar) -> Progress:
    tasks: dict[str, TaskID] = {}

    def progress(stage: str, done: float, total: float) -> None:
        if stage not in tasks:
            tasks[stage] = bar.add_task(stage, total=total, note="")
        bar.update(tasks[stage], completed=done, total=total)

    return progress


def _is_interactive() -> bool:
    """True at a terminal, except in continuous integration, which may have a terminal too."""
    return sys.stdin is not None and sys.stdin.isatty() and not os.environ.get("CI")


def _new_folder() -> Path:
    parent = Path("out")
    parent.mkdir(exist_ok=True)
    return Path(mkdtemp(prefix="demo-", dir=parent))


def _summary_without_training(root: Path, result: FirstDragResult) -> list[str]:
    done = result.reviewed
    return [
        "",
        f"drawn      {amount(done.drawn, '2D box')}",
        f"reviewed   {amount(done.boxes, 'oriented 3D box')}: {done.accepted} accepted as proposed, "
        f"{done.adjusted} adjusted, {done.placed} placed by hand; {amount(done.rejected, 'proposal')} rejected",
        f"scored     mean IoU of the proposals before the review: {result.mean_iou:.2f}",
        *_ending(root, result),
    ]


def _summary_with_training(root: Path, result: TrainedResult) -> list[str]:
    drawn, done = result.drawn, result.annotated
    return [
        "",
        f"drawn      {amount(drawn.boxes, '2D box')} on {amount(drawn.frames, 'frame')}",
        *(
            f"trained    {t.role} detector, {t.seconds:.0f} s, mAP50 {t.result.metrics.map50:.2f}"
            for t in result.trained
        ),
        f"proposed   {amount(done.proposals, 'oriented 3D box')} in {amount(done.done, 'frame')}, {done.seconds:.0f} s",
        *(
            f"scored     {label}: mean IoU {s['mean_iou']:.2f}, AP25 {s['AP']['0.25']:.2f}, AP50 {s['AP']['0.5']:.2f} "
            f"({amount(s['objects'], 'object')} in the frames without labels)"
            for label, s in result.scores.content.model_dump()["classes"].items()
        ),
        *_ending(root, result),
    ]


def _ending(root: Path, result: FirstDragResult | TrainedResult) -> list[str]:
    return [
        f"written    {amount(result.dataset.objects, 'box')} in {amount(result.dataset.frames, 'frame')}",
        f"took       {sum(result.seconds.values()):.0f} s: "
        + ", ".join(f"{name} {seconds:.0f}" for name, seconds in result.seconds.items()),
        "",
        f"recording  {root / 'recording'}",
        f"project    {root / 'demo'} (annotator serve demo --projects {root})",
        f"dataset    {next(root.glob('3D_*'))}",
    ]
