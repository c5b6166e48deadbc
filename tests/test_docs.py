"""Documentation keeps its promises, commands and scripts run, and files and folders stay small."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import pytest

from annotator.cli.main import COMMANDS, main

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = (ROOT / "README.md", *sorted(DOCS.glob("**/*.md")))
SUFFIXES = (".jpg", ".png", ".svg", ".webp")
SHOWN = re.compile(r"!\[[^\]]+\]\(([^)]+)\)")
MOST_BYTES = {".jpg": 260_000, ".svg": 260_000, ".webp": 1_500_000}


def test_every_picture_is_shown_and_exists_and_is_small() -> None:
    shown = {
        (page.parent / name).resolve() for page in PAGES for name in SHOWN.findall(page.read_text(encoding="utf-8"))
    }
    stored = {path for path in DOCS.glob("**/*") if path.suffix in SUFFIXES}
    assert shown == stored
    large = [path.name for path in stored if path.stat().st_size > MOST_BYTES[path.suffix]]
    assert not large


def headings(page: Path) -> set[str]:
    """The anchors of a page: its headings in GitHub's form, and those that it names."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    found = [line.lstrip("#").strip() for line in text.splitlines() if line.startswith("#")]
    named = re.findall(r'<a (?:id|name)="([^"]+)"', text)
    return {re.sub(r"[^\w\- ]", "", name.lower()).replace(" ", "-") for name in found} | set(named)


def test_links_between_pages_lead_to_what_exists() -> None:
    dead = []
    for page in (*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", ROOT / "CHANGELOG.md"):
        for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
            name, _, anchor = link.partition("#")
            target = page.parent / name if name else page
            if "://" in link or target.suffix in SUFFIXES:
                continue
            if not target.exists() or (anchor and anchor not in headings(target)):
                dead.append(f"{page.name}: {link}")
    assert dead == []


def test_the_pages_stay_short() -> None:
    assert sum(page.stat().st_size for page in DOCS.glob("**/*.md")) <= 160_000
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert len(changes.splitlines()) < 120 and len(changes.encode()) <= 10_000


def test_every_test_that_is_named_exists() -> None:
    text = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    paths = set(re.findall(r"`((?:tests|scripts|benchmarks)/[\w./]+)", text))
    assert paths, "promises are kept by tests"
    assert [path for path in sorted(paths) if not (ROOT / path).exists()] == []
    files = {path.name: path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py")}
    assert set(re.findall(r"\btest_\w+\.py", text)) <= files.keys()
    known = set(re.findall(r"^def (test_\w+)", "\n".join(files.values()), re.MULTILINE))
    assert set(re.findall(r"(?<=::)test_\w+|(?<=`)test_\w+(?=`)", text)) <= known


def test_every_promise_names_a_test() -> None:
    text = (ROOT / "SECURITY.md").read_text(encoding="utf-8").partition("## Limits")[0]
    rows = [line for line in text.splitlines() if line.startswith("| ") and not line.startswith("| promised")]
    assert len(rows) > 20
    assert [row for row in rows if not re.search(r"\| `[^|]*(test|fuzz)[^|]* \|$", row)] == []


def test_extras_named_in_errors_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    code = "\n".join(path.read_text() for path in (ROOT / "annotator").rglob("*.py"))
    named = re.findall(r'MissingExtraError\("[^"]+", "(\w+)"\)|rcv-annotator\[(\w+)\]', code)
    assert len(named) >= 5
    assert {name for pair in named for name in pair if name} <= set(extras)


MOST_LINES = 600
MOST_ENTRIES = 25
CODE = ("annotator", "benchmarks", "tests")


def test_files_have_at_most_600_lines() -> None:
    paths = [path for name in CODE for path in (ROOT / name).rglob("*.py")]
    lines = {path.relative_to(ROOT).as_posix(): len(path.read_text("utf-8").splitlines()) for path in paths}
    assert {name: count for name, count in lines.items() if count > MOST_LINES} == {}


def test_folders_with_subfolders_have_at_most_25_entries() -> None:
    """A folder of many files without subfolders is a list, such as that of the commands."""
    large = {}
    for folder in [ROOT / "annotator", *(path for path in (ROOT / "annotator").rglob("*") if path.is_dir())]:
        entries = [path for path in folder.iterdir() if path.suffix == ".py" or any(path.glob("**/*.py"))]
        if len(entries) - 1 > MOST_ENTRIES and any(path.is_dir() for path in entries):
            large[folder.relative_to(ROOT).as_posix()] = len(entries)
    assert large == {}


def test_every_package_has_a_docstring() -> None:
    packages = (ROOT / "annotator").rglob("__init__.py")
    assert [path for path in packages if not path.read_text("utf-8").startswith('"""')] == []


def test_every_test_file_has_a_unique_name() -> None:
    """pytest imports test files by their name alone, so it cannot collect two of the same name."""
    names = Counter(path.name for path in (ROOT / "tests").rglob("test_*.py"))
    assert [name for name, count in names.items() if count > 1] == []


README, GUIDE = ROOT / "README.md", ROOT / "docs" / "guide.md"
PAGES_WITH_COMMANDS = pytest.mark.parametrize("page", (README, GUIDE), ids=lambda page: page.name)
# Blocks of these languages contain commands; in a `console` block, only lines with a prompt.
SHELL, CONSOLE = ("sh", "bash", "shell"), ("console",)
BLOCK = re.compile(r"^( *)```(\w+)[^\n]*\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
# The programs that the pages may call. `scripts/...` and `git` are allowed only with an entry in INSTEAD.
PROGRAMS = ("annotator", "python")


@dataclass(frozen=True)
class Instead:
    """The replacement for a command, or None if another test covers it."""

    command: str | None
    because: str


INSTEAD: dict[str, Instead] = {
    "scripts/test": Instead(None, "it runs this test"),
    "scripts/demo": Instead(None, "tests/demo tries the demo, this file the set-up"),
    "annotator serve --folder recordings --open": Instead(
        None, "it goes on until it is stopped; tests/cli/test_cli_serve.py starts and stops it"
    ),
    "annotator live hands recordings/hands --loop --record recordings/seen": Instead(
        "annotator live hands recordings/hands --limit 2 --record recordings/seen --port 0",
        "it goes on until it is stopped; tests/cli/test_cli_serve.py stops it",
    ),
    "annotator generate recordings/hands --preset hands --frames 24": Instead(
        "annotator generate recordings/hands --preset hands --frames 8", "seconds a frame, there and in what follows"
    ),
    "annotator train hands": Instead(
        "annotator train hands --epochs 1 --image-epochs 1 --size 64 --image-size 64 --views 24", "minutes of training"
    ),
    "annotator generate recordings/room --preset people --frames 24": Instead(
        "annotator generate recordings/room --preset people --frames 8", "seconds a frame"
    ),
    "annotator train room": Instead(
        "annotator train room --epochs 1 --image-epochs 1 --size 64 --image-size 64 --views 24", "minutes of training"
    ),
    # After such a short training there may be no proposals.
    "annotator export hands --format rcv out/3D_HAND": Instead(
        "annotator export hands --format rcv out/3D_HAND --empty-frames", "there may be no box to export"
    ),
}


def commands(text: str) -> list[str]:
    """The commands of all shell and console blocks, in order, without prompts and comments."""
    found = []
    for indent, language, body in BLOCK.findall(text):
        if language not in SHELL + CONSOLE:
            continue
        lines = [line.removeprefix(indent) for line in re.sub(r"\\\n\s*", "", body).splitlines()]
        if language in CONSOLE:
            lines = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
        stripped = (re.sub(r"(^|\s+)#.*", "", line).strip() for line in lines)
        found += [line for line in stripped if line]
    return found


def as_run(command: str, shared: Path) -> list[str] | None:
    """The words to run for a command of a page, or None to skip it."""
    if command in INSTEAD:
        instead = INSTEAD[command].command
        if instead is None:
            return None
        command = instead
    words = [re.sub(r"^\.\./shared\b", lambda _: str(shared), word) for word in shlex.split(command)]
    assert words[0] in PROGRAMS, f"{command!r}: teach tests/test_docs.py how to run it, or leave it out of the page"
    return words


def page_commands(page: Path) -> list[str]:
    return commands(page.read_text(encoding="utf-8"))


@PAGES_WITH_COMMANDS
def test_commands_exist(page: Path) -> None:
    found = page_commands(page)
    assert found, f"{page.name} shows no command"
    for command in found:
        words = as_run(command, Path("shared"))
        if words is not None and words[0] == "annotator":
            known = words[1] in COMMANDS or " ".join(words[1:3]) in COMMANDS
            assert words[1].startswith("-") or known, f"{command!r}: no such command"


def test_all_replacements_are_used() -> None:
    unused = set(INSTEAD) - {*page_commands(README), *page_commands(GUIDE)}
    assert not unused, f"no page has such commands any more: {unused}"


def test_the_readme_mentions_every_command() -> None:
    text = README.read_text(encoding="utf-8")
    lines = text.splitlines()

    def is_named(name: str) -> bool:
        group, _, member = name.partition(" ")  # the others of a group may be named without it: `add`
        return any(f"`annotator {group} " in line and f"`{member}`" in line for line in lines if member) or bool(
            re.search(rf"(`|^)annotator {name}\b", text, re.MULTILINE)
        )

    missing = [name for name in COMMANDS if not is_named(name)]
    assert not missing, f"README.md does not mention: {', '.join(missing)}"


def python_blocks(text: str) -> list[str]:
    """The Python blocks, in order."""
    return [body for indent, language, body in BLOCK.findall(text) if language == "python" and not indent]


@pytest.mark.slow
def test_the_readmes_python_gives_boxes(tmp_path: Path) -> None:
    """The recording is that of the README's first command, with fewer frames; its first frame is the same."""
    from annotator.synthetic import write_generated

    (code,) = python_blocks(README.read_text(encoding="utf-8"))
    assert len(code.splitlines()) <= 10
    assert "annotator generate recordings/hands --preset hands --frames 24" in page_commands(README)
    write_generated(tmp_path / "recordings/hands", "hands", 1, 0)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code]
    ran = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert len(re.findall(r"^hand \d\.\d+ \[", ran.stdout, re.MULTILINE)) == 2, ran.stdout


@pytest.mark.slow
@pytest.mark.shared
@pytest.mark.timeout(1800)
@PAGES_WITH_COMMANDS
def test_every_command_runs(
    page: Path, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Commands of `annotator` run in this process, where torch is loaded once; test_wheel.py runs the installed one.

    The guide's Python block reads what its commands have exported. That of the README is run by the test above.
    """
    for name in os.environ:
        if name.startswith("ANNOTATOR_"):
            monkeypatch.delenv(name)
    # `python -m benchmarks.NAME` needs the repository's root; files are written to the working folder
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.chdir(tmp_path)
    for command in page_commands(page):
        words = as_run(command, shared.resolve())
        if words is None:
            continue
        if words[0] == "annotator":
            assert main(words[1:]) == 0, f"{command}\n{capsys.readouterr().err}"
        else:
            ran = subprocess.run([sys.executable, *words[1:]], capture_output=True, text=True, check=False)
            assert ran.returncode == 0, f"{command}\n{ran.stdout}\n{ran.stderr}"
    if page == GUIDE:
        (block,) = python_blocks(page.read_text(encoding="utf-8"))
        ran = subprocess.run([sys.executable, "-c", block], capture_output=True, text=True, check=False)
        assert ran.returncode == 0, ran.stderr
        assert re.search(r"^\d{6} person \[", ran.stdout, re.MULTILINE), ran.stdout


pytestmark = pytest.mark.skipif(os.name != "posix", reason="the scripts are for bash")


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A repository in a path with spaces, with the scripts and the package's metadata."""
    root = tmp_path / "my work" / "annotator"
    shutil.copytree(ROOT / "scripts", root / "scripts", ignore=shutil.ignore_patterns("node_modules"))
    shutil.copy(ROOT / "pyproject.toml", root)
    return root


def fake_environment(root: Path, *, imports: str = "exit 0") -> Path:
    """A `.venv` whose Python logs the pip commands instead of running them; `imports` replaces the import of open3d."""
    python = root / ".venv/bin/python"
    python.parent.mkdir(parents=True)
    python.write_text(
        "#!/bin/bash\n"
        f'if [[ "$*" == *"pip "* && "$*" == *install* ]]; then echo "$*" >>"{root}/pip.log"; exit 0; fi\n'
        f'if [[ "$*" == *"import open3d"* ]]; then {imports}; fi\n'
        'if [[ "$*" == *warm_up ]]; then exit 0; fi\n'
        f'exec "{sys.executable}" "$@"\n'
    )
    python.chmod(0o755)
    fake_npm(root)
    return root / "pip.log"


def fake_npm(root: Path) -> None:
    """A fake Node.js beside the clone; its npm logs its arguments and creates `node_modules`."""
    folder = root.parent / "node"
    folder.mkdir(exist_ok=True)
    for name, text in [("node", "echo v20.0.0"), ("npm", f'echo "$*" >>"{root}/npm.log"; mkdir -p node_modules')]:
        (folder / name).write_text(f"#!/bin/bash\n{text}\n")
        (folder / name).chmod(0o755)


def setup(root: Path, *extras: str, cwd: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    script = os.path.relpath(root / "scripts/setup", cwd or Path.cwd())
    # the fake npm, unless a test sets the PATH
    path = os.pathsep.join([str(root.parent / "node"), os.environ["PATH"]])
    given = {**os.environ, "PATH": path, **environment}
    return subprocess.run([script, *extras], cwd=cwd, env=given, capture_output=True, text=True, check=False)


def test_packages_are_installed_once_for_each_set_of_extras(clone: Path, tmp_path: Path) -> None:
    log = fake_environment(clone)
    assert setup(clone, "test", cwd=tmp_path).returncode == 0
    assert len(log.read_text().splitlines()) == 1
    assert log.read_text().endswith("install -q -e .[test]\n")
    for extras in (["test"], []):  # the installed extras cover both
        result = setup(clone, *extras, cwd=tmp_path)
        assert (result.returncode, result.stderr) == (0, "")
    assert len(log.read_text().splitlines()) == 1
    assert setup(clone, "kinect", cwd=tmp_path).returncode == 0
    assert log.read_text().endswith("install -q -e .[kinect,test]\n")
    with (clone / "pyproject.toml").open("a") as file:
        file.write("# a new dependency\n")
    for _ in range(2):
        setup(clone)
    assert len(log.read_text().splitlines()) == 3


def test_a_failed_installation_is_repeated(clone: Path) -> None:
    log = fake_environment(clone, imports="echo 'ImportError: libX.so' >&2; exit 1")
    for count in (1, 2):
        result = setup(clone)
        assert result.returncode == 1
        assert "open3d does not load: ImportError: libX.so" in result.stderr
        assert len(log.read_text().splitlines()) == count


def test_a_missing_python_gives_a_one_line_error(clone: Path) -> None:
    result = setup(clone, PYTHON="/bin/false")
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr == "setup: PYTHON=/bin/false is not a working Python >= 3.11\n"
    assert not (clone / ".venv").exists()


def test_a_moved_environment_is_created_again(clone: Path) -> None:
    fake_environment(clone)
    assert setup(clone).returncode == 0
    moved = clone.rename(clone.with_name("elsewhere"))
    result = setup(moved, PYTHON="/bin/false")  # so that setup ends before it creates the new one
    assert ".venv no longer works" in result.stderr
    assert result.returncode == 1
    assert not (moved / ".venv").exists()


PROPERTY = """
from hypothesis import given, strategies as st

@given(st.integers(0, 10**9))
def test_small(number):
    assert number < 10**8

def test_no_property():
    raise AssertionError("only properties are run")
"""


def fuzz(root: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([root / "scripts/fuzz", *arguments], capture_output=True, text=True, check=False)


def test_fuzzing_prints_the_command_that_reproduces_a_failure(clone: Path) -> None:
    fake_environment(clone)
    (clone / "tests").mkdir()
    shutil.copy(ROOT / "tests/conftest.py", clone / "tests")
    (clone / "tests/test_property.py").write_text(PROPERTY)
    found = [fuzz(clone, "--seed", "7", "--rounds", "1", "--examples", "50") for _ in range(2)]
    for result in found:
        assert result.returncode == 1, result.stdout + result.stderr
        assert "fuzz: round 1, seed 7\n" in result.stdout
        assert "fuzz: FAILED; again: scripts/fuzz --seed 7 --rounds 1 --examples 50 TEST_THAT_FAILED" in result.stdout
        assert "only properties are run" not in result.stdout
    first, second = ([line for line in each.stdout.splitlines() if "reproduce_failure" in line] for each in found)
    assert first == second != []
    over = fuzz(clone, "--seed", "7", "--minutes", "0")
    assert (over.returncode, over.stdout.strip()) == (0, "fuzz: 0 rounds from seed 7 found nothing")


def test_the_lock_file_pins_every_package_and_names_no_registry() -> None:
    folder = ROOT / "scripts/javascript"
    text = (folder / "package-lock.json").read_text()
    assert "omit-lockfile-registry-resolved=true" in (folder / ".npmrc").read_text().splitlines()
    assert "registry" not in text and "resolved" not in text
    packages = json.loads(text)["packages"]
    wanted = json.loads((folder / "package.json").read_text())["devDependencies"]
    assert all(packages[f"node_modules/{name}"]["version"] == version for name, version in wanted.items())
    assert all("integrity" in package for name, package in packages.items() if name)
    # `npm ci` refuses a lock file that lacks a platform's package, on all platforms
    needed = [
        {**package.get("dependencies", {}), **package.get("optionalDependencies", {})} for package in packages.values()
    ]
    assert [name for names in needed for name in names if f"node_modules/{name}" not in packages] == []
