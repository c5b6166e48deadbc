"""The scripts in a temporary clone with a fake environment."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

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
