"""Files that somebody sent: pickles, XML entities, code in YAML, deep JSON; names with code in them, on pages, too."""

from __future__ import annotations

import io
import json
import os
import pickle
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
import pytest
from attacks import MOST_GROWTH_MB, memory_mb
from browser_page import label_truth, sign_in, until
from live_server import running

from annotator.cli.main import main
from annotator.formats.kitti_tracklets import read_tracklets
from annotator.project import create_project
from annotator.recordings import open_recording
from annotator.types.errors import AnnotatorError
from annotator.web.security import ServerSettings
from annotator.workflows.add_recordings import register_recording
from benchmarks.served import chromium

if TYPE_CHECKING:
    from live_server import Live
    from playwright.sync_api import Browser, Page


LAUGHS = "".join(f'<!ENTITY l{n} "{"".join([f"&l{n - 1};"] * 10)}">' for n in range(1, 12))
CHAIN = "".join(f"<!ENTITY l{n + 1} '&l{n};'>" for n in range(400_000))
XML = {
    "entities": f'<?xml version="1.0"?><!DOCTYPE l [<!ENTITY l0 "lol">{LAUGHS}]><b>&l11;</b>',
    "quadratic": '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "' + "a" * 100_000 + '">]><b>'
    + "&a;" * 100_000 + "</b>",
    "outside": '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY x SYSTEM "file:///etc/passwd">]><b>&x;</b>',
    "chain": f"<!DOCTYPE l [<!ENTITY l0 'x'>{CHAIN}]><b>&l400000;</b>",
    "deep": "<a>" * 100_000,
    "attributes": "<a " + " ".join(f'a{n}="1"' for n in range(100_000)) + "/>",
}  # fmt: skip


class Code:
    """Its pickle creates a file when it is read."""

    def __init__(self, trace: Path) -> None:
        self._trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self._trace),)


@pytest.mark.parametrize("text", XML.values(), ids=XML)
def test_xml_entities_are_not_expanded(tmp_path: Path, text: str) -> None:
    file = tmp_path / "tracklet_labels.xml"
    file.write_text(text)
    before = memory_mb()
    with pytest.raises(AnnotatorError) as error:
        read_tracklets(file)
    assert "root:" not in str(error.value) and len(str(error.value)) < 2000
    assert memory_mb() - before < MOST_GROWTH_MB


def _object_array(trace: Path) -> bytes:
    content = io.BytesIO()
    np.save(content, np.array([[Code(trace), 0, 0]], dtype=object), allow_pickle=True)
    return content.getvalue()


def _hostile_arrays(trace: Path) -> dict[str, bytes]:
    code = pickle.dumps(Code(trace))
    good = io.BytesIO()
    np.save(good, np.zeros((4, 3)))
    header = good.getvalue()
    return {
        "objects": _object_array(trace),
        "a bare pickle": code,
        "code in the header": header.replace(b"(4, 3)", b"__import__('os').mkdir('x')"),
        "a huge shape": header.replace(b"(4, 3)", b"(99999999999, 3)"),
    }


@pytest.mark.parametrize("kind", ["npy", "npz"])
def test_arrays_are_never_unpickled(tmp_path: Path, kind: str) -> None:
    trace = tmp_path / "trace"
    for name, content in _hostile_arrays(trace).items():
        folder = tmp_path / name
        folder.mkdir()
        for number in range(2):
            file = folder / f"{number:06}.{kind}"
            if kind == "npy":
                file.write_bytes(content)
                continue
            with zipfile.ZipFile(file, "w") as archive:
                archive.writestr("xyz.npy", content)
        before = memory_mb()
        with pytest.raises(AnnotatorError):
            open_recording(folder).frame(0)
        assert memory_mb() - before < MOST_GROWTH_MB, name
        assert not trace.exists() and not Path("x").exists(), name
    # the array would have run code where it is unpickled
    np.load(io.BytesIO(_object_array(trace)), allow_pickle=True)
    assert trace.is_dir()


NAMES = (
    "<img src=x onerror=alert(1)>",
    "; touch hacked",
    "-rf",
    "\x1b[31mred\x1b]0;title\x07",
    "a\nb",
    "=cmd|'calc'!A0",
    "‮gpj.exe",
    "..",
    "é" * 100,
    "'; DROP TABLE labels; --",
)


def test_recordings_with_hostile_names_are_added_exported_and_leave_nothing_outside(
    generated: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    projects, outside = tmp_path / "projects", tmp_path / "cwd"
    outside.mkdir()
    assert main(["new", "room", "--classes", "person", "--projects", str(projects)]) == 0
    for number, name in enumerate(NAMES):
        if name == "..":
            continue
        folder = tmp_path / f"in{number}" / name
        folder.parent.mkdir()
        folder.symlink_to(generated / "people")
        # as an absolute path, which cannot be an option
        code = main(["add", "room", str(folder), "--projects", str(projects)])
        said = capfd.readouterr()
        assert code in (0, 2), (name, said)
        assert "\x1b]" not in said.out + said.err, "a title is set on the terminal"
    for kind in ("rcv", "kitti", "coco", "yolo", "openlabel", "labelcloud", "nuscenes"):
        out = tmp_path / "out" / kind
        code = main(["export", "room", str(out), "--format", kind, "--projects", str(projects)])
        said = capfd.readouterr()
        assert code in (0, 2), (kind, said)
        assert "internal" not in said.err and "Traceback" not in said.err, said.err
        assert "\x1b]" not in said.out + said.err
    made = {path.relative_to(tmp_path).parts[0] for path in tmp_path.iterdir()}
    assert made <= {"projects", "out", "cwd", *(f"in{number}" for number in range(len(NAMES)))}
    assert not list(tmp_path.rglob("hacked*")) and not Path("hacked").exists()


# An attribute that runs without a click, and a harmless element that is counted where the policy stops the script.
MARK = "<img src=x onerror=hacked=1><b class=hacked>"
CLASSES = ("person", "<b class=hacked>")
HERE = quote(MARK, safe="")
PLACES = (
    "/#/",
    "/#/room/label/1",
    "/#/room/review/1",
    "/#/room/train",
    "/#/room/export",
    "/#/room/statistics",
    "/#/room/checks",
    "/#/room/alignment/1",
    "/#/broken/label",
    f"/#/{HERE}",
    f"/#/room/{HERE}",
    f"/#/room/label/{HERE}",
    f"/#/room/review/1?uid={HERE}",
    f"/#/{MARK}/label",
    "/#/room/review/999",
    f"/?go={HERE}",
    f"/{HERE}",
    f"/api/projects/{HERE}",
)
STARTED = "document.readyState === 'complete'"
TRACES = "[typeof hacked, document.querySelectorAll('.hacked, img[src=x], [onerror]').length].join()"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One headless Chromium."""
    with chromium() as found:
        yield found


@pytest.fixture
def marked(generated: Path, tmp_path: Path) -> Iterator[Live]:
    """A server on whose pages the markup is in every name that others can choose."""
    folder = tmp_path / MARK.replace("/", "")
    shutil.copytree(generated / "people", folder)
    projects = tmp_path / "projects"
    with create_project(projects, "room", CLASSES) as project:
        register_recording(project, open_recording(folder))
        label_truth(project, generated / "people", 3)
    (projects / "broken").mkdir()
    (projects / "broken/project.json").write_text(json.dumps({MARK: MARK}))
    with running(ServerSettings(projects, (folder, tmp_path), port=0)) as live:
        # jobs whose messages and authors have the markup
        live.client.post("/api/session", json={"operator": MARK})
        for body in ({"kind": "export", "format": "kitti", "classes": [CLASSES[1]]}, {"kind": "propose"}):
            live.client.post("/api/projects/room/jobs", json=body)
        live.client.post("/api/projects/room/undo", json={})
        yield live


def test_names_are_text_on_every_page(browser: Browser, marked: Live) -> None:
    page = browser.new_context(base_url=marked.url).new_page()
    for cookie in marked.client.cookies.jar:
        page.context.add_cookies([{"name": cookie.name, "value": cookie.value or "", "url": marked.url}])
    sign_in(page, marked.url, MARK)
    page.route("**/api/workbench", lambda route: route.abort())
    violations: list[str] = []
    page.on("console", lambda message: violations.append(message.text) if "Content Security" in message.text else None)
    page.on("dialog", lambda dialog: violations.append(f"a dialog: {dialog.message}"))
    shown = ""
    for place in PLACES:
        page.goto("about:blank")
        page.goto(place)
        until(page, STARTED)
        page.wait_for_load_state("networkidle")
        shown += page.inner_text("body")
        assert _traces(page) == "undefined,0", place
        for key in ("?", "Tab", "l", "Escape"):
            page.keyboard.press(key)
        assert _traces(page) == "undefined,0", place
    # otherwise the names are not on the pages, and nothing was tested
    assert shown.count(MARK[:20]) > 5, shown
    assert CLASSES[1] in shown
    assert violations == [], violations
    page.context.close()


def _traces(page: Page) -> str:
    found: str = page.evaluate(TRACES)
    return found
