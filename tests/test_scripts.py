"""scripts/setup on a made-up clone: quick the second time, and one clear line where something is missing."""

from __future__ import annotations

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
    shutil.copytree(ROOT / "scripts", root / "scripts")
    shutil.copy(ROOT / "pyproject.toml", root)
    return root


def fake_environment(root: Path, *, imports: str = "exit 0") -> Path:
    """A `.venv` whose Python notes what pip was asked for instead of doing it; `imports` is how open3d loads."""
    python = root / ".venv/bin/python"
    python.parent.mkdir(parents=True)
    python.write_text(
        "#!/bin/bash\n"
        f'if [[ "$*" == *"pip "* && "$*" == *install* ]]; then echo "$*" >>"{root}/pip.log"; exit 0; fi\n'
        f'if [[ "$*" == *"import open3d"* ]]; then {imports}; fi\n'
        f'exec "{sys.executable}" "$@"\n'
    )
    python.chmod(0o755)
    return root / "pip.log"


def setup(root: Path, *extras: str, cwd: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    script = os.path.relpath(root / "scripts/setup", cwd or Path.cwd())
    return subprocess.run(
        [script, *extras], cwd=cwd, env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )


def test_packages_are_installed_once_for_each_set_of_extras(clone: Path, tmp_path: Path) -> None:
    log = fake_environment(clone)
    assert setup(clone, "test", cwd=tmp_path).returncode == 0
    assert len(log.read_text().splitlines()) == 1
    assert log.read_text().endswith("install -q -e .[test]\n")
    for extras in (["test"], []):  # what is there already covers both
        result = setup(clone, *extras, cwd=tmp_path)
        assert (result.returncode, result.stderr) == (0, "")
    assert len(log.read_text().splitlines()) == 1
    assert setup(clone, "kinect", cwd=tmp_path).returncode == 0
    assert log.read_text().endswith("install -q -e .[kinect,test]\n")


def test_readers_of_others_have_an_environment_over_the_first(clone: Path) -> None:
    log = fake_environment(clone)
    wanted = clone / "tests/interop/requirements.txt"
    wanted.parent.mkdir(parents=True)
    wanted.write_text("one==1\n")
    for _ in range(2):
        result = setup(clone, "test", "interop")
        assert result.returncode == 0, result.stderr
        assert [line.split()[-1] for line in log.read_text().splitlines()] == [".[test]", str(wanted).split()[-1]]
    (site,) = (clone / ".venv-interop").rglob("annotator-packages.pth")
    assert Path(site.read_text().strip()).is_dir()
    wanted.write_text("one==2\n")
    assert setup(clone, "interop").returncode == 0
    assert len(log.read_text().splitlines()) == 3


def test_changed_metadata_is_installed_anew(clone: Path) -> None:
    log = fake_environment(clone)
    setup(clone)
    with (clone / "pyproject.toml").open("a") as file:
        file.write("# a new dependency\n")
    setup(clone)
    setup(clone)
    assert len(log.read_text().splitlines()) == 2


def test_a_failed_installation_is_tried_again(clone: Path) -> None:
    log = fake_environment(clone, imports="echo 'ImportError: libX.so' >&2; exit 1")
    for count in (1, 2):
        result = setup(clone)
        assert result.returncode == 1
        assert "open3d does not load: ImportError: libX.so" in result.stderr
        assert len(log.read_text().splitlines()) == count


def test_without_a_python_one_line_says_so(clone: Path) -> None:
    result = setup(clone, PYTHON="/bin/false")
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr == "setup: PYTHON=/bin/false is not a working Python >= 3.11\n"
    assert not (clone / ".venv").exists()


def test_an_environment_that_was_moved_is_made_anew(clone: Path) -> None:
    fake_environment(clone)
    assert setup(clone).returncode == 0
    moved = clone.rename(clone.with_name("elsewhere"))
    result = setup(moved, PYTHON="/bin/false")  # so that it ends where it would make the new one
    assert "does not work here any more" in result.stderr
    assert result.returncode == 1
    assert not (moved / ".venv").exists()


def programs(folder: Path, *names: str, **scripts: str) -> Path:
    """A folder for the PATH with only these programs of the machine, and made-up ones."""
    folder.mkdir()
    for name in names:
        found = shutil.which(name)
        assert found is not None, name
        (folder / name).symlink_to(found)
    for name, text in scripts.items():
        path = folder / name.replace("_", "-")
        path.write_text(f"#!/bin/bash\n{text}\n")
        path.chmod(0o755)
    return folder


NEEDED = ("bash", "env", "dirname", "uname", "sed", "tr", "sort", "paste", "mv", "rm", "tail")


def test_the_tests_get_a_browser_where_there_is_none(clone: Path, tmp_path: Path) -> None:
    fake_environment(clone)
    log = tmp_path / "apt.log"
    path = programs(tmp_path / "bin", *NEEDED, id="echo 0", apt_get=f'echo "$*" >>"{log}"')
    result = setup(clone, "test", PATH=str(path), ANNOTATOR_CHROMIUM="")
    assert result.returncode == 0, result.stderr
    assert log.read_text().splitlines()[-1] == "-qq install -y --no-install-recommends chromium"
    log.unlink()
    for extras, environment in [(["kinect"], {}), (["test"], {"ANNOTATOR_CHROMIUM": "/somewhere/chrome"})]:
        assert setup(clone, *extras, **{"PATH": str(path), "ANNOTATOR_CHROMIUM": "", **environment}).returncode == 0
    (path / "chromium").symlink_to("/bin/true")
    assert setup(clone, "test", PATH=str(path), ANNOTATOR_CHROMIUM="").returncode == 0
    assert not log.exists()


def test_without_a_browser_and_rights_one_line_says_what_to_install(clone: Path, tmp_path: Path) -> None:
    fake_environment(clone)
    path = programs(tmp_path / "bin", *NEEDED, id="echo 1000", apt_get="exit 1")
    result = setup(clone, "test", PATH=str(path), ANNOTATOR_CHROMIUM="")
    assert result.returncode == 1
    assert result.stderr.splitlines() == [
        "setup: the tests drive a browser and found none of chromium chromium-browser google-chrome; install it as "
        "root and call this again (Debian, Ubuntu: apt-get install chromium)"
    ]


def test_sudo_without_a_password_is_used(clone: Path, tmp_path: Path) -> None:
    fake_environment(clone)
    log = tmp_path / "apt.log"
    sudo = f'[[ "$1" == -n ]] || exit 1; shift; echo "sudo $*" >>"{log}"; exec "$@"'
    path = programs(tmp_path / "bin", *NEEDED, "true", id="echo 1000", sudo=sudo, apt_get=f'echo "$*" >>"{log}"')
    assert setup(clone, "test", PATH=str(path), ANNOTATOR_CHROMIUM="").returncode == 0
    said = log.read_text()
    assert "sudo env DEBIAN_FRONTEND=noninteractive apt-get -qq install -y" in said
    assert said.splitlines()[-1].endswith("chromium")
