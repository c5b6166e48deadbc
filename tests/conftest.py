"""Fixtures for all tests, and run-time checks of every array shape in a signature."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

install_import_hook("annotator", "beartype.beartype")

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real recordings and golden numbers; tests that need it carry the marker `shared`."""
    folder = Path(os.environ.get("ANNOTATOR_SHARED", ROOT.parent / "shared"))
    if not folder.is_dir():
        pytest.skip(f"no shared folder at {folder}; set ANNOTATOR_SHARED")
    return folder


@pytest.fixture(scope="session")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two small generated recordings, `people` (three of them) and `hands` (two), 5 frames each; not to be changed."""
    from annotator.recordings.generated import write_generated

    folder = tmp_path_factory.mktemp("generated")
    for preset in ("people", "hands"):
        write_generated(folder / preset, preset, 5, 0, 320, 240)
    return folder


@pytest.fixture
def own_copy(generated: Path, tmp_path: Path) -> Callable[[str], Path]:
    """A generated recording of the test's own, to be damaged as it likes: `own_copy("people")`."""

    def copy(name: str) -> Path:
        return Path(shutil.copytree(generated / name, tmp_path / name))

    return copy
