"""Expected errors of edges: the fit of the map, and its place in a trained model."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from annotator.detection.config import EdgeErrors
from annotator.detection.dataset import read_manifest
from annotator.detection.edge_errors import fit_edge_errors, with_edge_errors
from annotator.detection.trained import TrainedModel, read_trained
from annotator.workflows.detectors import load_detector
from tests.detection.test_backends import PlainImage


def errors_of(spread: np.ndarray, factor: float, exponent: float, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).laplace(0, factor * spread**exponent)


@pytest.mark.parametrize(("factor", "exponent"), [(0.3, 1.0), (0.1, 2.0), (1.5, 0.5)])
def test_the_fit_finds_the_law_behind_the_errors_despite_gross_ones(factor: float, exponent: float) -> None:
    spread = np.exp(np.random.default_rng(1).uniform(0, 2, 4000))
    errors = errors_of(spread, factor, exponent)
    errors[:20] = 300.0  # other objects
    fit = fit_edge_errors(spread, errors)
    assert isinstance(fit, EdgeErrors)
    for value in (1.5, 3.0, 6.0):
        assert fit.of(np.array([value])) == pytest.approx(factor * value**exponent, rel=0.2)
    assert (fit.edges, fit.gain > 0.02) == (4000, True)


def test_a_spread_that_tells_nothing_is_refused() -> None:
    rng = np.random.default_rng(0)
    spread, errors = rng.uniform(1, 4, 3000), rng.laplace(0, 1.0, 3000)
    assert isinstance(fit_edge_errors(spread, errors), str)
    # larger errors where the network claims to be certain
    assert isinstance(fit_edge_errors(spread, errors / spread), str)
    few = fit_edge_errors(spread[:50], errors[:50] * spread[:50])
    assert isinstance(few, str) and "50 edges" in few


@pytest.mark.slow
def test_a_training_stores_the_errors_and_the_detector_tells_them(
    tiny_model: TrainedModel, tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fit(spread_px: np.ndarray, error_px: np.ndarray) -> EdgeErrors:
        assert (spread_px > 0).all() and np.median(np.abs(error_px)) < 20
        return EdgeErrors(factor=1.0, exponent=1.0, least_px=0.01, most_px=90.0, edges=len(spread_px))

    # the set is too small for a fit of its own
    monkeypatch.setattr("annotator.detection.edge_errors.fit_edge_errors", fit)
    weights = tmp_path / "detector.safetensors"
    weights.write_bytes(tiny_model.weights.read_bytes())
    plain = tiny_model.model_copy(update={"weights": weights, "edge_errors": {}})
    plain.write(tmp_path)
    manifest = read_manifest(tiny_dataset)
    found = with_edge_errors(read_trained(tmp_path), tiny_dataset, manifest, "cpu")
    images = [entry for entry in manifest.entries if entry.split == "val"]
    assert set(found.edge_errors) == set(manifest.classes)
    for name, errors in found.edge_errors.items():
        assert 1 <= errors.edges <= 4 * sum(entry.boxes.count(name) for entry in images)
    picture = PlainImage(np.full((96, 96, 3), 40, np.uint8))
    assert all(box.edge_sigma_px is None for box in load_detector(weights, "torch").detect([picture])[0])
    found.write(tmp_path)
    assert read_trained(tmp_path).edge_errors == found.edge_errors
    bgr = cv2.imread(str(tiny_dataset / images[0].image))
    boxes = load_detector(weights, "torch").detect([PlainImage(np.ascontiguousarray(bgr[..., ::-1]))])[0]
    assert boxes and all(min(box.edge_sigma_px or (0.0,)) > 0 for box in boxes)
