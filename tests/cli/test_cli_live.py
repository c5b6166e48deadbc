"""`annotator live`: showing and recording, errors, and the end of the program."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from shutil import rmtree
from typing import Any

import pytest

from annotator.cli.main import main
from annotator.project import create_project, open_project
from annotator.recordings import open_recording
from annotator.web import live as live_run
from annotator.web.serve import Running
from annotator.workflows.live.pipeline import Pipeline
from annotator.workflows.live.recorder import Recorder

Capture = pytest.CaptureFixture[str]


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


def test_unusable_arguments_are_errors(
    live: Callable[..., int], capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyk4a", None)
    monkeypatch.setattr("annotator.recordings.kinect.device.find_spec", lambda name: None)
    refused: list[tuple[tuple[object, ...], dict[str, str], str]] = [
        (("--rate", 0), {}, "cannot play at 0 frames per second; give more than 0"),
        (("--host", "0.0.0.0", "--no-token"), {}, "it needs a token"),
        (("--record", "."), {}, "exists already"),
        ((), {"source": "kinect"}, "an Azure Kinect needs pyk4a, which is not installed"),
        (("--loop",), {"source": "kinect:0"}, "a device has its own rate"),
    ]
    for words, source, said in refused:
        assert live(*words, **source) == 2
        assert said in " ".join(capsys.readouterr().err.split())
