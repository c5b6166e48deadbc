"""The base detector: a view detector that measures the object of a crop, whatever its class.

It takes the place of a project's own view detector until that is trained. docs/base_detector.md describes its training;
`scripts/train_base.py --install` puts another one into the package.
"""

from __future__ import annotations

from pathlib import Path

from annotator.types.errors import DetectionError

FOLDER = Path(__file__).parent / "base"
NAME = "base detector"
TITLE = f"{NAME}, not trained on this project's classes"


def base_weights() -> Path:
    """The weights file of the base detector; `read_trained` of its folder gives its facts.

    Raises:
        DetectionError: this installation has none.
    """
    weights = FOLDER / "detector.safetensors"
    if not weights.is_file():
        raise DetectionError(f"{weights}: the base detector is missing; install annotator again")
    return weights


def has_base() -> bool:
    """True if this installation has the base detector."""
    return (FOLDER / "detector.safetensors").is_file()
