"""`annotator generate`"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.recordings.generated import write_generated


class Preset(StrEnum):
    """What moves in the generated room."""

    PEOPLE = "people"
    HANDS = "hands"


def run(
    out: Path,
    /,
    *,
    preset: Preset = Preset.PEOPLE,
    frames: int = 30,
    seed: int = 0,
    width: int = 640,
    height: int = 480,
) -> None:
    """Make a recording of a generated room as a depth camera would see it, with its exact truth kept apart.

    Args:
        out: the new folder.
        preset: people who walk, turn and gesture in a furnished room, or hands in front of the camera.
        frames: how many, ten a second.
        seed: another number, another room and other people.
        width: of the images, pixels.
        height: of the images, pixels.
    """
    with counted("ray-casting") as progress:
        write_generated(out, preset.value, frames, seed, width, height, progress)
    print_line(f"{out}: {frames} frames of {preset}")
