"""Fixtures for all tests, and run-time checks of every array shape in a signature."""

from __future__ import annotations

import fcntl
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings
from hypothesis.internal.conjecture import providers
from jaxtyping import install_import_hook

if TYPE_CHECKING:
    from annotator.workflows.detectors import Detectors

ROOT = Path(__file__).resolve().parent.parent
# mypy checks what the other modules declare; wrapping all their functions would double the time of the suite
install_import_hook(
    [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in (ROOT / "annotator").rglob("*.py")
        if "import jaxtyping" in (text := path.read_text(encoding="utf-8")) or "from jaxtyping import" in text
    ],
    "beartype.beartype",
)

# Examples have no deadline, since their duration depends on the machine's load. The suite tries the same examples on
# every run, `scripts/test --all` ten times as many. `scripts/fuzz` tries others; add those that fail as `@example`.
EXAMPLES = 20
COMMON = settings(deadline=None, database=None, print_blob=True, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("annotator", COMMON, derandomize=True, max_examples=EXAMPLES)
settings.register_profile("all", COMMON, derandomize=True, max_examples=10 * EXAMPLES)
settings.register_profile("fuzz", COMMON)
settings.load_profile("annotator")

_ended: set[str] = set()


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("fuzz", "options of scripts/fuzz")
    group.addoption("--fuzz-until", type=float, help="start no test after this time (seconds since the epoch)")
    group.addoption("--fuzz-examples", type=int, help="number of examples of each property test")


def pytest_configure(config: pytest.Config) -> None:
    if settings().derandomize:
        # Hypothesis also draws constants found in the loaded modules, which differ between processes
        providers._get_local_constants = providers.Constants


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist
def pytest_handlecrashitem(crashitem: str, report: pytest.TestReport) -> None:
    """Lets a browser test try again if its process has ended, once; xdist starts its file again in a new process.

    Chromium stopped answering once, and kept the processors busy until the time of the whole run was over. Now the
    test's process ends after `timeout` (pyproject.toml), and its browser with it.
    """
    if crashitem.startswith("tests/web/browser/") and crashitem not in _ended:
        _ended.add(crashitem)
        report.outcome = "rerun"
        sys.stderr.write(f"\n{crashitem}: its process has ended; the file is started again in a new one\n")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Starts files with slow tests first, so that a parallel run does not end with the longest one."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
    count, profile = config.getoption("fuzz_examples"), settings()
    for function in {getattr(item, "obj", None) for item in items}:
        if not (own := getattr(function, "_hypothesis_internal_use_settings", None)):
            continue
        if count or profile.derandomize:
            # a test's own number is for scripts/fuzz, unless it is smaller, since its examples are dear
            examples = count or min(own.max_examples, EXAMPLES) * (profile.max_examples // EXAMPLES)
            function._hypothesis_internal_use_settings = settings(own, max_examples=examples)


def pytest_runtest_setup(item: pytest.Item) -> None:
    until = item.config.getoption("fuzz_until")
    if until is not None and time.time() > until:
        pytest.skip("the time for fuzzing is over")


@pytest.fixture(scope="session", autouse=True)
def _own_state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What annotator remembers about a user is not that of whoever runs the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        patch.delenv("ANNOTATOR_TOKEN", raising=False)
        yield


@pytest.fixture(scope="session", autouse=True)
def _without_base_detector(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """In the process of the tests, the package has no base detector. Jobs of a server and commands have it."""
    from annotator.detection import pretrained

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pretrained, "FOLDER", tmp_path_factory.mktemp("no_base"))
        yield


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Converted networks go into a cache of the tests, which parallel test processes and their commands share."""
    own = tmp_path_factory.getbasetemp()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str((own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "cache"))
        yield


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real recordings and golden numbers; tests that need it carry the marker `shared`."""
    folder = Path(os.environ.get("ANNOTATOR_SHARED", ROOT.parent / "shared"))
    if not folder.is_dir():
        pytest.skip(f"no shared folder at {folder}; set ANNOTATOR_SHARED")
    return folder


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], object]], Path]:
    """`made_once(NAME, fill)`: a folder that is filled once for all parallel test processes; do not change it."""
    own = tmp_path_factory.getbasetemp()
    # the workers of pytest-xdist have sibling folders; without xdist, siblings belong to other runs
    root = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own

    def make(name: str, fill: Callable[[Path], object]) -> Path:
        folder, filled = root / f"once_{name}", root / f"once_{name}.filled"
        with (root / f"once_{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not filled.exists():
                # a failed attempt may have left files
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                fill(folder)
                filled.touch()
        return folder

    return make


@pytest.fixture(scope="session")
def generated(made_once: Callable[[str, Callable[[Path], object]], Path]) -> Path:
    """Two small generated recordings, `people` (three of them) and `hands` (two), 5 frames each; do not change them."""
    from annotator.synthetic import write_generated

    def fill(folder: Path) -> None:
        for preset in ("people", "hands"):
            write_generated(folder / preset, preset, 5, 0, 320, 240)

    return made_once("generated", fill)


@pytest.fixture
def own_copy(generated: Path, tmp_path: Path) -> Callable[[str], Path]:
    """A copy of a generated recording that the test may change: `own_copy("people")`."""

    def copy(name: str) -> Path:
        return Path(shutil.copytree(generated / name, tmp_path / name))

    return copy


@pytest.fixture(scope="session")
def knowing(generated: Path) -> Callable[..., Detectors]:
    """Perfect detectors for a generated recording: `knowing("people", kind=BoxKind.BOX)`."""
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
