"""The wheel, built and installed without network access: its commands in an empty folder, and the files of its page.
The sdist is built from the repository and the wheel from the sdist, so that files missing in either are detected. The
wheel's environment contains the dependencies of this one, but not the repository.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urljoin
from zipfile import ZipFile

import httpx
import pytest
from live_server import PATIENCE_S

from annotator import __version__

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="the environment's programs are in bin/"),
]

ROOT = Path(__file__).resolve().parents[2]
STEM = f"rcv_annotator-{__version__}"
# References to other files of the page in HTML, CSS and JavaScript.
NAMED = re.compile(
    r"""
    (?:src|href)="(/[^"#]+)" | url\(["']?([^"')$]+)["')] | ["'](/assets/[^"']+)["'] | ["'](\.{1,2}/[\w./-]+\.js)["']
    """,
    re.VERBOSE,
)


@dataclass(frozen=True)
class Installed:
    """An environment with the wheel, and the working folder of its commands."""

    programs: Path
    folder: Path

    def start(self, *words: str) -> subprocess.Popen[str]:
        known = {name: value for name, value in os.environ.items() if not name.startswith(("ANNOTATOR_", "PYTHON"))}
        return subprocess.Popen(
            [self.programs / words[0], *words[1:]],
            cwd=self.folder,
            env=known,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )

    def run(self, *words: str, code: int = 0) -> str:
        """Runs a program; returns its standard output, or standard error if a failure is expected."""
        with self.start(*words) as process:
            out, err = process.communicate(timeout=120)
        assert process.returncode == code, out + err
        return err if code else out


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist and the wheel built from it."""
    for module in ("build", "hatchling.build"):
        pytest.importorskip(module, reason="the build tools are not installed; run scripts/setup test")
    folder = tmp_path_factory.mktemp("archives")
    words = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    # not run in the repository, where a folder `build` would shadow the module
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def installed(archives: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The wheel in its own environment."""
    environment = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    python = environment / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", str(python)]
    wheel = archives / f"{STEM}-py3-none-any.whl"
    subprocess.run([*pip, "install", "--quiet", "--no-deps", "--no-index", "--no-compile", wheel], check=True)
    where = subprocess.run(
        [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
        check=True,
        capture_output=True,
        text=True,
    )
    # The .pth files in these folders are not read, including the one that points to the repository.
    folders = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    Path(where.stdout.strip(), "dependencies.pth").write_text("\n".join(folders) + "\n")
    return Installed(environment / "bin", tmp_path_factory.mktemp("empty"))


@pytest.fixture(scope="module")
def project(installed: Installed) -> str:
    """A project with a recording, created by the wheel's commands."""
    size = ["--width", "160", "--height", "120"]
    installed.run("annotator", "generate", "people", "--frames", "2", *size)
    installed.run("annotator", "new", "room", "--classes", "person")
    said = installed.run("annotator", "add", "room", "people")
    assert "added people: 2 frames (rgbd_folder)" in said
    return "room"


@pytest.fixture(scope="module")
def live(installed: Installed, project: str) -> Iterator[SimpleNamespace]:
    """Replaces the test server by the wheel's `annotator serve`."""
    process = installed.start("annotator", "serve", project, "--port", "0")
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        found = re.search(r"(http://[^/]+)/\S+", process.stdout.readline())
        assert found is not None, process.stderr.read()
        yield SimpleNamespace(url=found.group(1), link=found.group())
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0
        process.stdout.close()
        process.stderr.close()


def files_below(folder: Path) -> set[str]:
    """The relative paths of the files in a folder of the repository, without files ignored by git."""
    paths = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    generated = {"__pycache__", "node_modules", "server.d.ts"}
    exported = "detection/base/detector-"  # of the base detector, for the machine's backend
    return {path.as_posix() for path in paths if not generated & set(path.parts) and exported not in path.as_posix()}


def test_the_wheel_contains_exactly_the_package_and_the_page(archives: Path) -> None:
    with ZipFile(archives / f"{STEM}-py3-none-any.whl") as wheel:
        names = {name for name in wheel.namelist() if not name.startswith(f"{STEM}.dist-info/")}
    page = {name for name in files_below(ROOT / "web_assets") if not name.endswith((".md", ".json"))}
    package = {f"annotator/{name}" for name in files_below(ROOT / "annotator")}
    assert names == package | {f"annotator/web_assets/{name}" for name in page}


def test_the_sdist_contains_the_repository_without_generated_files(archives: Path) -> None:
    with tarfile.open(archives / f"{STEM}.tar.gz") as sdist:
        names = {Path(*Path(name).parts[1:]).as_posix() for name in sdist.getnames()}
    for folder in ("annotator", "web_assets", "tests", "scripts"):
        kept = {name for name in names if name.startswith(f"{folder}/")}
        assert kept == {f"{folder}/{name}" for name in files_below(ROOT / folder)}
    assert {"pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", "CONTRIBUTING.md"} <= names
    junk = {"node_modules", ".venv", "out", "runs", "__pycache__"}
    assert not [name for name in names if junk & set(Path(name).parts)]
    assert {name for name in names if name.startswith("projects/")} == {"projects/README.md"}


def test_the_installed_program_is_from_the_wheel(installed: Installed, project: str) -> None:
    file = installed.run("python", "-c", "import annotator; print(annotator.__file__)")
    assert installed.programs.parent in Path(file).parents
    assert installed.run("annotator", "--version") == f"annotator {__version__}\n"
    said = installed.run("annotator", "annotate", project, code=2)
    assert f"has no image detector yet; run `annotator train {project}`" in said


def test_the_page_and_all_files_that_it_references_are_served(live: SimpleNamespace) -> None:
    seen: set[str] = set()
    waiting = [f"{live.url}/"]
    with httpx.Client(timeout=60) as client:
        client.get(live.link)
        while waiting:
            url = waiting.pop()
            answer = client.get(url)
            assert answer.status_code == 200, url
            seen.add(url)
            # the vendor script is a bundle without references
            if "/vendor/" not in url:
                named = {urljoin(url, next(filter(None, found))) for found in NAMED.findall(answer.text)}
                waiting += named - seen - set(waiting)
    code = {name for name in files_below(ROOT / "web_assets") if name.endswith((".js", ".css"))}
    assert {f"{live.url}/assets/{name}" for name in code} <= seen, "some files are not referenced"
    assert f"{live.url}/assets/vendor/plotly.min.js" in seen
