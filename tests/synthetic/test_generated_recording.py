"""Generated recordings on disk: they can be opened, their truth is exact, and equal seeds give equal bytes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from annotator.formats.boxes_json import read_boxes
from annotator.formats.reading import read_mask
from annotator.geometry.oriented_box import contains
from annotator.recordings import open_recording
from annotator.synthetic import write_generated
from annotator.types.errors import AnnotatorError

PRESETS = ("people", "hands", "objects")
FRAMES = 3
SIZE = {"width": 192, "height": 144}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="session")
def generated(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One small recording of each preset."""
    root = tmp_path_factory.mktemp("generated")
    for preset in PRESETS:
        write_generated(root / preset, preset, FRAMES, seed=5, **SIZE)
    return {preset: root / preset for preset in PRESETS}


@pytest.mark.parametrize("preset", PRESETS)
def test_a_generated_recording_is_an_rgbd_folder_with_gravity(generated: dict[str, Path], preset: str):
    recording = open_recording(generated[preset])
    assert (recording.format, len(recording), recording.is_sequence) == ("rgbd_folder", FRAMES, True)
    frame = recording.frame(FRAMES - 1)
    assert frame.rgb.shape == (144, 192, 3)
    assert frame.up is not None
    assert frame.up @ [0, -1, 0] > (0.2 if preset == "objects" else 0.9)  # the camera is almost upright, or looks down
    made = json.loads((generated[preset] / "generated.json").read_text())
    assert made == {"version": 3, "preset": preset, "seed": 5, "frames": FRAMES, "period_s": 0.1}


@pytest.mark.parametrize("preset", PRESETS)
def test_the_truth_is_in_a_separate_folder_and_fits_the_measured_points(generated: dict[str, Path], preset: str):
    folder = generated[preset]
    assert not (folder / "boxes.json").exists()
    assert not (folder / "mask").exists()
    recording, boxes = open_recording(folder), read_boxes(folder / "truth" / "boxes.json")
    assert tuple(boxes) == recording.keys
    for i, key in enumerate(recording.keys):
        frame, mask = recording.frame(i), read_mask(folder / "truth" / "mask" / f"{key}.png")
        assert boxes[key]
        assert set(np.unique(mask)) == set(range(len(boxes[key]) + 1))
        assert len({truth.track_id for truth in boxes[key]}) == len(boxes[key])
        numbers = mask.ravel()[frame.cloud.pixel_index]
        for number, truth in enumerate(boxes[key], start=1):
            assert truth.label == {"people": "person", "hands": "hand", "objects": "object"}[preset]
            points = frame.cloud.xyz_m[numbers == number]
            assert len(points) > 20
            # all except noise at the far side of the people
            assert contains(truth.box, points, 0.03).mean() > 0.98
            if preset == "objects":  # they may touch, and are hollow
                continue
            # few other points are in the box: arms end at the wrist, and people keep a distance
            assert contains(truth.box, points).sum() > 0.5 * contains(truth.box, frame.cloud.xyz_m).sum()


def test_equal_seeds_give_equal_bytes_and_other_seeds_do_not(generated: dict[str, Path], tmp_path: Path):
    write_generated(tmp_path / "again", "people", FRAMES, seed=5, **SIZE)
    assert contents(tmp_path / "again") == contents(generated["people"])
    write_generated(tmp_path / "other", "people", 1, seed=4, **SIZE)
    one, other = (contents(folder)["color/000000.jpg"] for folder in (tmp_path / "again", tmp_path / "other"))
    assert one != other


def test_an_interrupted_recording_leaves_nothing(tmp_path: Path):
    def interrupt(done: int, frames: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_generated(tmp_path / "r", "hands", 5, 0, 32, 24, report=interrupt)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"preset": "cats"}, "unknown preset 'cats'; choose one of people, hands, objects"),
        ({"frames": 0}, "frames must be at least 1"),
        ({"seed": -1}, "the seed must be 0 or more"),
        ({"path": "n" * 250}, r"cannot be created \(File name too long"),
    ],
)
def test_invalid_arguments_are_refused(tmp_path: Path, change: dict[str, object], complaint: str):
    arguments: dict[str, object] = {"path": "new", "preset": "hands", "frames": 1, "seed": 0} | change
    arguments["path"] = tmp_path / str(arguments["path"])
    with pytest.raises(AnnotatorError, match=complaint):
        write_generated(**arguments)
    assert list(tmp_path.iterdir()) == []
