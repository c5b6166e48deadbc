"""How right the forecast of the hours left is: simulated projects, of which the true rest of the work is known.

python -m benchmarks.forecast [--projects 200] [--json]

The frames of a project are neighbours in scenes of more or fewer objects. People take turns; each has a pace, and each
turn is a better or a worse one. The seconds per box fall with the boxes that are done: in half of the projects
steadily, in the others by the power law of practice. Some of the frames that are left have proposals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import tyro

from annotator.project import Effort
from annotator.project.progress.action_log import FROM_NOTHING, Action
from annotator.project.progress.forecast import COVERED, Forecast, forecast
from annotator.project.progress.frames_left import Frames
from annotator.project.progress.reviewed import ReviewedBox
from annotator.types.errors import ConfigError
from benchmarks.report import Table, finish, guarded

SHARES_DONE = (0.1, 0.25, 0.5, 0.75, 0.9)
FRAMES = (100, 3000)
SCENE_FRAMES, SHIFT_FRAMES = 40, 60


@dataclass
class Arguments:
    """Compare forecasts at several moments of simulated projects with the work that was then left."""

    projects: int = 200
    """Number of simulated projects."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


def run(args: Arguments) -> dict[str, dict[str, float]]:
    """For each share of the frames that are done: median relative error and its sign, and the intervals' coverage.

    Raises:
        ConfigError: a number out of its range.
    """
    if args.projects < 1:
        raise ConfigError(f"--projects must be 1 or more, not {args.projects}")
    found: dict[float, list[tuple[float, bool, float]]] = {share: [] for share in SHARES_DONE}
    for seed in range(args.projects):
        project = _project(np.random.default_rng(seed))
        for share, results in found.items():
            done = round(share * len(project.boxes))
            hours = _forecast(project, done).hours_left
            if hours is not None and hours.expected:
                left = float(project.seconds[done:].sum()) / 3600
                width = hours.high / hours.low
                results.append((np.log(hours.expected / left), hours.low <= left <= hours.high, width))
    return {
        f"{share:.0%} done": {
            "median_error": float(np.expm1(np.median(np.abs([error for error, _, _ in results])))),
            "median_bias": float(np.expm1(np.median([error for error, _, _ in results]))),
            "covered": float(np.mean([inside for _, inside, _ in results])),
            "median_high_to_low": float(np.median([width for _, _, width in results])),
        }
        for share, results in found.items()
    }


@dataclass(frozen=True, eq=False)
class _Project:
    """Boxes and seconds at work of each frame, in the order of the work, and whether it had proposals."""

    boxes: np.ndarray
    seconds: np.ndarray
    proposed: np.ndarray


def _project(random: np.random.Generator) -> _Project:
    count = round(np.exp(random.uniform(*np.log(FRAMES))))
    scenes = random.gamma(3.0, 1.0, -(-count // SCENE_FRAMES)).repeat(SCENE_FRAMES)[:count]
    boxes = random.poisson(scenes)
    people = np.exp(random.normal(0.0, 0.35, random.integers(1, 5)))
    shifts = -(-count // SHIFT_FRAMES)
    pace = people[random.integers(len(people), size=shifts)] * np.exp(random.normal(0.0, 0.15, shifts))
    steady = random.uniform(0.4, 1.0) ** np.linspace(0.0, 1.0, count)
    practice = (boxes.cumsum() + 20.0) ** -random.uniform(0.0, 0.4)
    learning = steady if random.random() < 0.5 else practice
    of_boxes = [random.lognormal(1.8, 0.7, number).sum() for number in boxes]
    seconds = (np.array(of_boxes) + 2.0) * pace.repeat(SHIFT_FRAMES)[:count] * learning
    return _Project(boxes, seconds, random.random(count) < random.uniform(0.0, 1.0))


def _forecast(project: _Project, done: int) -> Forecast:
    actions, spent, reviewed = [], [], []
    for frame in range(done):
        number = int(project.boxes[frame])
        for _ in range(max(number, 1)):
            action = Action("ann", frame, Effort(1, 0.0), None, frames={frame: None})
            actions.append(action)
            spent.append(float(project.seconds[frame]) / max(number, 1))
        is_proposed = bool(project.proposed[frame])
        reviewed += [ReviewedBox(frame, "car", 9.0, False, is_proposed, FROM_NOTHING, None, None, None)] * number
    left = range(done, len(project.boxes))
    waiting = {n: int(project.boxes[n]) for n in left if project.proposed[n] and project.boxes[n]}
    bare = frozenset(n for n in left if not project.proposed[n])
    frames = Frames(frozenset(range(done)), bare, waiting, 0)
    return forecast(frames, actions, spent, reviewed, ())


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__)
    result = run(args)
    table = Table("frames", "median error", "median bias", f"within the interval ({COVERED:.0%} meant)", "high / low")
    for name, row in result.items():
        table.add(name, *row.values())
    finish(result, args.json, table)


if __name__ == "__main__":
    guarded(main)
