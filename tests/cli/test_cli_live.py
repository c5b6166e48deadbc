"""`annotator live`: from a recording to the page and into the project; how it refuses, how it ends."""

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
from annotator.recordings.frame_writer import FrameWriter
from annotator.types.errors import RecordingError
from annotator.web.live import run as live_run
from annotator.web.live import serve as live_serve
from annotator.web.serve import Running
from annotator.workflows.live.pipeline import Pipeline
from annotator.workflows.live.recorder import Recorder

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def live(tmp_path: Path, generated: Path, knowing: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """`live("--frames", 3)`: the command on the generated hands, with detectors that know them."""
    with create_project(tmp_path / "projects", "room", ("hand",)):
        pass
    monkeypatch.setattr(live_run, "active_detectors", lambda project, backend: knowing("hands"))

    def run(*words: object, source: str | Path = generated / "hands") -> int:
        options = ["--root", tmp_path / "projects", "--port", 0, *words]
        return main(["live", "room", str(source), *map(str, options)])

    return run


def test_a_recording_is_shown_and_what_was_seen_is_in_the_project(
    live: Callable[..., int], tmp_path: Path, capsys: Capture
) -> None:
    assert live("--frames", 3, "--rate", 2, "--record", tmp_path / "seen") == 0
    said = capsys.readouterr()
    assert "live at http://127.0.0.1:" in said.out
    assert "3 shown" in said.out
    assert "3 frames, 6 proposals; in room as seen, ready for review" in said.out
    assert "storing what was found on the 3 frames" in said.err
    assert len(open_recording(tmp_path / "seen")) == 3
    with open_project(tmp_path / "projects" / "room") as project:
        frames = project.frames.of([project.recordings.find("seen").id])
        assert [len(project.frame_state(frame.id).labels) for frame in frames] == [2, 2, 2]


def test_ctrl_c_ends_it_cleanly_and_keeps_what_was_recorded(
    live: Callable[..., int], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = threading.Event()

    class Interrupted(Running):
        def serve_until_stopped(self) -> None:
            assert shown.wait(60)
            self.socket.close()
            raise KeyboardInterrupt

    show = live_run.LiveView.show

    def showing(view: Any, detected: Any) -> None:
        show(view, detected)
        shown.set()

    monkeypatch.setattr(live_serve, "Running", Interrupted)
    monkeypatch.setattr(live_run.LiveView, "show", showing)
    assert live("--loop", "--record", tmp_path / "seen") == 0
    assert "ready for review" in capsys.readouterr().out
    assert len(open_recording(tmp_path / "seen")) >= 1
    assert not {thread.name for thread in threading.enumerate()} & {"capture", "detect", "display", "record"}


@pytest.mark.parametrize("first", [signal.SIGTERM, signal.SIGINT, None])
def test_a_polite_kill_keeps_what_was_recorded(
    live: Callable[..., int],
    tmp_path: Path,
    capsys: Capture,
    monkeypatch: pytest.MonkeyPatch,
    first: signal.Signals | None,
) -> None:
    """However often it comes: with each frame, and again while it is ending, whatever it ends by, and storing."""
    show = live_run.LiveView.show
    interrupted = []

    def showing(view: Any, detected: Any) -> None:
        show(view, detected)
        if first is signal.SIGTERM or (first is signal.SIGINT and not interrupted):  # a second Ctrl-C means it
            interrupted.append(first)
            signal.raise_signal(first)

    def with_a_kill(call: Callable[..., Any]) -> Callable[..., Any]:
        def killing(*args: Any, **settings: Any) -> Any:
            signal.raise_signal(signal.SIGTERM)
            return call(*args, **settings)

        return killing

    def killed(number: int, stack: object) -> None:
        raise AssertionError("the process would be gone")

    monkeypatch.setattr(live_run.LiveView, "show", showing)
    for place, name in ((Pipeline, "end"), (Recorder, "finish"), (live_run, "store")):
        monkeypatch.setattr(place, name, with_a_kill(getattr(place, name)))
    before = signal.signal(signal.SIGTERM, killed)
    try:
        words = ("--frames", 3, "--rate", 2) if first is None else ("--loop",)
        assert live(*words, "--record", tmp_path / "seen") == 0
        assert signal.getsignal(signal.SIGTERM) is killed
    finally:
        signal.signal(signal.SIGTERM, before)
    assert "ready for review" in capsys.readouterr().out


def test_the_place_of_a_recording_that_the_project_knows_is_refused(
    live: Callable[..., int], tmp_path: Path, capsys: Capture
) -> None:
    """Also where its folder is gone: its labels would come to lie on what is seen now."""
    out = tmp_path / "seen"
    assert live("--frames", 1, "--record", out) == 0
    rmtree(out)
    assert live("--frames", 1, "--record", out) == 2
    assert "the project has a recording there already, seen" in " ".join(capsys.readouterr().err.split())
    assert not out.exists()


def test_frames_that_could_not_be_written_at_the_end_are_told(
    live: Callable[..., int], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the last frame was handed over, as where the disk gets full on those that still wait."""
    add, finish = FrameWriter.add, Recorder.finish
    over = threading.Event()

    def full(writer: FrameWriter, *frame: Any) -> str:
        if writer.frames:
            assert over.wait(60)
            raise RecordingError("no room for more")
        return add(writer, *frame)

    def finishing(recorder: Recorder) -> int:
        over.set()
        return finish(recorder)

    monkeypatch.setattr(FrameWriter, "add", full)
    monkeypatch.setattr(Recorder, "finish", finishing)
    assert live("--frames", 3, "--rate", 2, "--record", tmp_path / "seen") == 2
    assert "no room for more" in capsys.readouterr().err
    with open_project(tmp_path / "projects" / "room") as project:
        (frame,) = project.frames.of([project.recordings.find("seen").id])
        assert len(project.frame_state(frame.id).labels) == 2


def test_an_error_of_the_source_is_told_and_what_was_recorded_is_kept(
    live: Callable[..., int],
    tmp_path: Path,
    own_copy: Callable[[str], Path],
    capsys: Capture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(live_run, "MOST_TOLD", 2)
    folder = own_copy("hands")
    for path in sorted((folder / "depth").iterdir())[1:]:
        path.write_bytes(b"no picture")
    assert live("--record", tmp_path / "seen", "--rate", 20, source=folder) == 0
    said = capsys.readouterr()
    assert said.err.count("000001.png") == 1
    assert said.err.splitlines()[2:] == [
        "further ones are counted only",
        f"storing what was found on the 1 frames of {tmp_path / 'seen'}",
    ]
    assert "4 unreadable" in said.out
    assert "1 frames, 2 proposals" in said.out


@pytest.mark.parametrize(
    ("words", "source", "said"),
    [
        ((), "/no/such", "no such file or folder"),
        (("--rate", 0), None, "shows nothing; give more than 0"),
        (("--frames", 0), None, "0 frames show nothing"),
        (("--host", "0.0.0.0", "--token", "short"), None, "a token has 16"),
        (("--port", 99999), None, "cannot listen on 127.0.0.1 port 99999"),
        (("--record", "."), None, "exists already"),
        ((), "kinect", "an Azure Kinect needs pyk4a, which is not installed"),
        (("--loop",), "kinect:0", "a device has its own rate"),
    ],
)
def test_how_it_refuses(
    live: Callable[..., int],
    capsys: Capture,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[object, ...],
    source: str | None,
    said: str,
) -> None:
    monkeypatch.setitem(sys.modules, "pyk4a", None)
    monkeypatch.setattr("annotator.recordings.kinect_connection.find_spec", lambda name: None)
    assert live(*words, **({} if source is None else {"source": source})) == 2
    assert said in " ".join(capsys.readouterr().err.split())


def test_a_project_without_detectors_says_how_to_train_them(tmp_path: Path, generated: Path, capsys: Capture) -> None:
    with create_project(tmp_path, "room", ("hand",)):
        pass
    assert main(["live", "room", str(generated / "hands"), "--root", str(tmp_path)]) == 2
    assert "annotator train room" in capsys.readouterr().err
