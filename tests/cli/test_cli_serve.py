"""`annotator serve`, `live` and the end of `demo`: output, errors and shutdown."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from shutil import rmtree
from typing import Any

import httpx
import pytest

from annotator.cli import demo as demo_command
from annotator.cli.main import main
from annotator.project import create_project, open_project
from annotator.recordings import open_recording
from annotator.types.errors import MissingExtraError
from annotator.web import live as live_run
from annotator.web import serve
from annotator.web.serve import Running
from annotator.workflows.live.pipeline import Pipeline
from annotator.workflows.live.recorder import Recorder

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    create_project(tmp_path / "projects", "room", ("person",)).close()
    return tmp_path / "projects"


@contextmanager
def serving(*words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Runs the program; yields it and the link that it prints."""
    command = [sys.executable, "-m", "annotator", "serve", "--port", "0", *words]
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)
    assert process.stdout is not None
    try:
        first = process.stdout.readline()
        link = re.search(r"http://\S+", first)
        assert link is not None, first + process.stdout.read()
        yield process, link.group()
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30)
        process.stdout.close()


def test_it_serves_the_page_until_an_interrupt(root: Path) -> None:
    with serving("room", "--projects", str(root), "--open") as (process, address), httpx.Client(timeout=240) as client:
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/\?token=[\w-]{43}&go=room%2Fannotate", address)
        bare = address.partition("?")[0]
        assert httpx.get(bare, timeout=240).status_code == 401
        assert "url=/#/room/annotate" in client.get(address).text
        answer = client.get(bare)
        assert answer.status_code == 200
        assert "<html" in answer.text
        assert process.stdout is not None
        assert "Ctrl-C" in process.stdout.readline()
        assert "open the link" in process.stdout.readline()
    assert process.returncode == 0


def test_a_port_that_is_none_is_refused(root: Path, capsys: Capture) -> None:
    assert main(["serve", "--port", "99999", "--projects", str(root)]) == 2
    assert "cannot listen on 127.0.0.1 port 99999" in capsys.readouterr().err


def test_a_window_needs_pywebview_and_a_display(root: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setitem(sys.modules, "webview", None)
    with pytest.raises(MissingExtraError, match="scripts/setup desktop"):
        serve.check_window()
    monkeypatch.setitem(sys.modules, "webview", object())
    assert main(["serve", "--window", "--projects", str(root)]) == 2
    assert "no display for a window" in capsys.readouterr().err


def test_the_demo_opens_its_project_by_a_private_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command line of a browser is visible to all users; so it gets a file that leads to the link."""
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or True)
    monkeypatch.setattr("annotator.web.serve.has_display", lambda: True)
    create_project(tmp_path, "demo", ("person",)).close()
    with demo_command._workbench(tmp_path), httpx.Client(timeout=20) as client:
        assert opened[0].startswith("file:///")
        page = Path(opened[0].removeprefix("file://"))
        assert page.stat().st_mode & 0o077 == 0
        link = re.search(r"url=(http://[^\"]+)", page.read_text())
        assert link is not None
        address = link.group(1).replace("&amp;", "&")
        assert "go=demo" in address
        assert httpx.get(address.partition("?")[0], timeout=20).status_code == 401
        client.get(address)
        assert client.get(address.partition("?")[0]).status_code == 200
    assert not page.exists()
    with pytest.raises(httpx.ConnectError):
        httpx.get(address, timeout=20)


@pytest.fixture
def live(tmp_path: Path, generated: Path, knowing: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """`live("--limit", 3)`: runs the command on the generated hands, with perfect detectors."""
    with create_project(tmp_path / "projects", "room", ("hand",)):
        pass
    monkeypatch.setattr(live_run, "active_detectors", lambda project, backend: knowing("hands"))

    def run(*words: object, source: str | Path = generated / "hands") -> int:
        port = () if "--port" in words else ("--port", 0)
        options = ["--projects", tmp_path / "projects", *port, *words]
        return main(["live", "room", str(source), *map(str, options)])

    return run


def test_frames_are_shown_recorded_and_added_to_the_project(
    live: Callable[..., int], tmp_path: Path, capsys: Capture
) -> None:
    assert live("--limit", 3, "--rate", 2, "--record", tmp_path / "seen") == 0
    said = capsys.readouterr()
    assert "live at http://127.0.0.1:" in said.out
    assert "3 shown" in said.out
    assert "3 frames, 6 proposals; in room as seen, ready for review" in said.out
    assert "storing the detections of 3 frames" in said.err
    assert len(open_recording(tmp_path / "seen")) == 3
    with open_project(tmp_path / "projects" / "room") as project:
        frames = project.frames.of([project.recordings.find("seen").id])
        assert [len(project.labels.of_frame(frame.id)) for frame in frames] == [2, 2, 2]


def test_ctrl_c_ends_it_cleanly_and_keeps_the_recorded_frames(
    live: Callable[..., int], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = threading.Event()

    class Interrupted(Running):
        def serve_until_stopped(self) -> None:
            assert shown.wait(60)
            self.socket.close()
            raise KeyboardInterrupt

    show = live_run.LivePage.show

    def showing(view: Any, detected: Any) -> None:
        show(view, detected)
        shown.set()

    monkeypatch.setattr(live_run, "Running", Interrupted)
    monkeypatch.setattr(live_run.LivePage, "show", showing)
    assert live("--loop", "--record", tmp_path / "seen") == 0
    assert "ready for review" in capsys.readouterr().out
    assert len(open_recording(tmp_path / "seen")) >= 1
    assert not {thread.name for thread in threading.enumerate()} & {"capture", "detect", "display", "record"}


@pytest.mark.parametrize("first", [signal.SIGTERM, None])
def test_sigterm_keeps_the_recorded_frames(
    live: Callable[..., int],
    tmp_path: Path,
    capsys: Capture,
    monkeypatch: pytest.MonkeyPatch,
    first: signal.Signals | None,
) -> None:
    """SIGTERM may come repeatedly: with each frame, while the program ends, and while it stores the frames."""
    show = live_run.LivePage.show

    def showing(view: Any, detected: Any) -> None:
        show(view, detected)
        if first is not None:
            signal.raise_signal(first)

    def after_sigterm(call: Callable[..., Any]) -> Callable[..., Any]:
        def killing(*args: Any, **settings: Any) -> Any:
            signal.raise_signal(signal.SIGTERM)
            return call(*args, **settings)

        return killing

    def killed(number: int, stack: object) -> None:
        raise AssertionError("SIGTERM would have ended the process")

    monkeypatch.setattr(live_run.LivePage, "show", showing)
    for place, name in ((Pipeline, "end"), (Recorder, "finish"), (live_run, "store")):
        monkeypatch.setattr(place, name, after_sigterm(getattr(place, name)))
    before = signal.signal(signal.SIGTERM, killed)
    try:
        words = ("--limit", 3, "--rate", 2) if first is None else ("--loop",)
        assert live(*words, "--record", tmp_path / "seen") == 0
        assert signal.getsignal(signal.SIGTERM) is killed
    finally:
        signal.signal(signal.SIGTERM, before)
    assert "ready for review" in capsys.readouterr().out


def test_the_path_of_a_recording_in_the_project_is_refused(
    live: Callable[..., int], tmp_path: Path, capsys: Capture
) -> None:
    """Even if its folder was deleted: its labels would be assigned to the new frames."""
    out = tmp_path / "seen"
    assert live("--limit", 1, "--record", out) == 0
    rmtree(out)
    assert live("--limit", 1, "--record", out) == 2
    assert "the project has a recording there already, seen" in " ".join(capsys.readouterr().err.split())
    assert not out.exists()
