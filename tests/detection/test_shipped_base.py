"""The base detector's files in the package."""

from __future__ import annotations

import hashlib
from pathlib import Path

import annotator
from annotator.detection.trained import read_trained
from annotator.rcv.config import AGNOSTIC_LABELS
from annotator.workflows.training.base_detector import MANIFEST_FILE, BaseManifest

# tests replace `base_detector.FOLDER`
FOLDER = Path(annotator.__file__).parent / "detection" / "base"
MOST_BYTES = 8_000_000


def test_the_package_has_the_weights_that_its_manifest_describes() -> None:
    manifest = BaseManifest.model_validate_json((FOLDER / MANIFEST_FILE).read_bytes())
    trained = read_trained(FOLDER)
    content = trained.weights.read_bytes()
    assert hashlib.sha256(content).hexdigest() == manifest.weights_sha256
    assert len(content) < MOST_BYTES
    assert trained.classes == tuple(AGNOSTIC_LABELS.values())
    assert trained.image_size_px == manifest.image_size_px
    assert set(trained.edge_errors) == set(trained.classes)
