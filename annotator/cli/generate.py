"""`annotator generate`"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

from annotator.cli.options import Seed
from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.synthetic import write_generated
from annotator.types.messages import amount


class Preset(StrEnum):
    """The scene that is generated."""

    PEOPLE = "people"
    HANDS = "hands"
    OBJECTS = "objects"


def run(
    out: Path,
    /,
    *,
    preset: Preset = Preset.PEOPLE,
    frames: int = 30,
    seed: Seed = 0,
    width: int = 640,
    height: int = 480,
) -> None:
    """Generate a synthetic RGB-D recording of a room, with exact ground truth in separate files.

    Args:
        out: new folder for the recording.
        preset: scene to generate: people who walk, turn and gesture in a room, hands in front of the camera, or objects
            of many shapes on a table or on the floor.
        frames: number of frames to generate, ten per second.
        width: width of the images, pixels.
        height: height of the images, pixels.
    """
    with counted("ray-casting") as progress:
        write_generated(out, preset.value, frames, seed, width, height, progress)
    print_line(f"{out}: {amount(frames, 'frame')} of {preset}")
