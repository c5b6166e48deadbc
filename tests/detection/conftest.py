"""A small trained detector, shared by the tests of training and of detection."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from annotator.detection.config import TrainingConfig
from annotator.detection.dataset import TrainingSample, write_dataset
from annotator.detection.trained import TrainedModel, read_trained
from annotator.types import Box2D, BoxKind

COLORS = {"red": (230, 30, 30), "blue": (30, 30, 230)}


@dataclass(frozen=True)
class Scene:
    """An image of coloured rectangles on grey, and their boxes."""

    rgb: np.ndarray
    boxes: tuple[Box2D, ...]


def make_scene(seed: int, size: tuple[int, int] = (96, 96)) -> Scene:
    """One rectangle, red or blue, so that a detector with swapped colour channels fails."""
    rng = np.random.default_rng(seed)
    height, width = size
    rgb = np.full((height, width, 3), 114, np.uint8)
    label = ("red", "blue")[seed % 2]
    w, h = (rng.uniform(0.3, 0.6, 2) * min(size)).astype(int)
    x, y = int(rng.integers(0, width - w)), int(rng.integers(0, height - h))
    rgb[y : y + h, x : x + w] = COLORS[label]
    return Scene(rgb, (Box2D(label, x - 0.5, y - 0.5, x + w - 0.5, y + h - 0.5),))


@pytest.fixture(scope="session")
def scene() -> Callable[..., Scene]:
    return make_scene


@pytest.fixture(scope="session")
def tiny_dataset(made_once: Callable[..., Path]) -> Path:
    """Twelve training images and four validation images."""
    scenes = [make_scene(seed) for seed in range(16)]
    samples = [TrainingSample(s.rgb, s.boxes, f"{i // 2:06d}", "drawn") for i, s in enumerate(scenes)]

    def fill(folder: Path) -> None:
        write_dataset(folder / "set", samples, ["blue", "red"], {"000002", "000005"}.__contains__, kind=BoxKind.BOX)

    return made_once("tiny_dataset", fill) / "set"


@pytest.fixture(scope="session")
def quick_config() -> TrainingConfig:
    return TrainingConfig(
        pretrained="never", image_size_px=96, epochs=30, batch=6, measure_every=10, device="cpu", recipe={"lr0": 0.02}
    )


@pytest.fixture(scope="session")
def tiny_model(tiny_dataset: Path, quick_config: TrainingConfig, made_once: Callable[..., Path]) -> TrainedModel:
    from annotator.detection.training import train_detector

    def fill(folder: Path) -> None:
        train_detector(tiny_dataset, folder / "run", quick_config)

    return read_trained(made_once("tiny_model", fill) / "run")


@pytest.fixture
def own_weights(tiny_model: TrainedModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the small detector's weights, which has not been exported."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = tmp_path / "model" / "detector.safetensors"
    path.parent.mkdir()
    path.write_bytes(tiny_model.weights.read_bytes())
    return path
