"""Fixtures for all tests, and run-time checks of every array shape in a signature."""

from __future__ import annotations

import fcntl
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings
from hypothesis.internal.conjecture import providers
from jaxtyping import install_import_hook

if TYPE_CHECKING:
    from annotator.workflows.detectors import Detectors

install_import_hook("annotator", "beartype.beartype")

# No test is timed: how long an example takes depends on what else the machine does. The suite tries the same examples
# on every run; `scripts/fuzz` looks for others, and what it finds becomes an `@example`.
COMMON = settings(deadline=None, database=None, print_blob=True, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("annotator", COMMON, derandomize=True)
settings.register_profile("fuzz", COMMON)
settings.load_profile("annotator")

ROOT = Path(__file__).resolve().parent.parent


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("fuzz", "what scripts/fuzz asks for")
    group.addoption("--fuzz-until", type=float, help="no test begins after this time, seconds since the epoch")
    group.addoption("--fuzz-examples", type=int, help="of each property test, in place of its own number")


def pytest_configure(config: pytest.Config) -> None:
    if settings().derandomize:
        # Hypothesis also draws numbers that it reads in the modules that are loaded: others in every process
        providers._get_local_constants = providers.Constants


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Files with slow tests first: side by side, the longest one shall not begin when all others are done."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
    if count := config.getoption("fuzz_examples"):
        for function in {getattr(item, "obj", None) for item in items}:
            if own := getattr(function, "_hypothesis_internal_use_settings", None):
                function._hypothesis_internal_use_settings = settings(own, max_examples=count)


def pytest_runtest_setup(item: pytest.Item) -> None:
    until = item.config.getoption("fuzz_until")
    if until is not None and time.time() > until:
        pytest.skip("the time for fuzzing is over")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real recordings and golden numbers; tests that need it carry the marker `shared`."""
    folder = Path(os.environ.get("ANNOTATOR_SHARED", ROOT.parent / "shared"))
    if not folder.is_dir():
        pytest.skip(f"no shared folder at {folder}; set ANNOTATOR_SHARED")
    return folder


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], object]], Path]:
    """`made_once(NAME, fill)`: a folder that the first of the side-by-side processes fills; not to be changed."""
    own = tmp_path_factory.getbasetemp()
    # the processes of one pytest-xdist have sibling folders; without it a sibling is another run's
    root = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own

    def make(name: str, fill: Callable[[Path], object]) -> Path:
        folder, filled = root / f"once_{name}", root / f"once_{name}.filled"
        with (root / f"once_{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not filled.exists():
                # a try that failed may have left a part
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                fill(folder)
                filled.touch()
        return folder

    return make


@pytest.fixture(scope="session")
def generated(made_once: Callable[[str, Callable[[Path], object]], Path]) -> Path:
    """Two small generated recordings, `people` (three of them) and `hands` (two), 5 frames each; not to be changed."""
    from annotator.synthetic import write_generated

    def fill(folder: Path) -> None:
        for preset in ("people", "hands"):
            write_generated(folder / preset, preset, 5, 0, 320, 240)

    return made_once("generated", fill)


@pytest.fixture
def own_copy(generated: Path, tmp_path: Path) -> Callable[[str], Path]:
    """A generated recording of the test's own, to be damaged as it likes: `own_copy("people")`."""

    def copy(name: str) -> Path:
        return Path(shutil.copytree(generated / name, tmp_path / name))

    return copy


@pytest.fixture(scope="session")
def knowing(generated: Path) -> Callable[..., Detectors]:
    """Detectors that know the truth of a generated recording: `knowing("people", kind=BoxKind.BOX)`."""
    from annotator.detection.perfect import PerfectDetector, Scene
    from annotator.recordings import open_recording
    from annotator.types import BoxKind
    from annotator.workflows.detectors import Detectors
    from annotator.workflows.recorded.reading import load_truth

    made: dict[tuple[str, BoxKind], PerfectDetector] = {}

    def perfect(name: str, kind: BoxKind = BoxKind.BOX) -> Detectors:
        if (name, kind) not in made:
            recording = open_recording(generated / name)
            frames = [recording.frame(index) for index in range(len(recording))]
            scenes = [Scene.of(frame, load_truth(recording, index, frame)) for index, frame in enumerate(frames)]
            made[name, kind] = PerfectDetector(scenes, kind, min_points=50)
        return Detectors(made[name, kind], made[name, kind], kind)

    return perfect
