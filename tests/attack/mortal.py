"""Command lines that are killed: one process loads the package and forks a child for each, so that they begin at once.

A command kills itself just before or after one of its calls that may write: the moment hangs on no clock.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
# Modules with these commands' work, also what they import inside functions.
LOADED = ("train", "annotate", "export", "import_boxes", "stats", "add", "project")
LIBRARIES = ("torch", "ultralytics.models.yolo.detect", "openvino", "cv2", "matplotlib.pyplot", "av")
# Names of the built-in calls that write to a disk, or may.
WRITING = {"open", "write", "writelines", "flush", "fsync", "close", "truncate", "write_record", "write_end_of_file"}
WRITING |= {"rename", "replace", "link", "mkdir", "rmdir", "remove", "unlink"}
WRITING |= {"execute", "executemany", "executescript", "commit"}


@dataclass(frozen=True)
class End:
    """How a command ended: its exit code (-9 if killed), its moments in which it could be killed, and its output."""

    code: int
    moments: int
    said: str

    @property
    def was_killed(self) -> bool:
        return self.code == -9


class Mortal:
    """Runs `annotator` commands, and kills them (`kill -9`). The detectors are perfect ones of a recording."""

    def __init__(self, recording: Path, log: Path) -> None:
        command = [sys.executable, __file__, str(recording)]
        path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
        # one thread in each library: a process with threads must not fork
        single = {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "YOLO_OFFLINE": "1"}
        self._log = log
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, **single}
        )
        assert self._answer() == "ready"

    def run(self, *words: str | Path, kill_at: int | None = None, file_limit: int | None = None) -> End:
        """Runs a command line without `annotator`; kills it at one of its moments, or limits its files (bytes)."""
        order = {"words": [str(word) for word in words], "kill_at": kill_at, "log": str(self._log), "limit": file_limit}
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()
        code, moments = self._answer()
        return End(code, moments, self._log.read_text(errors="replace"))

    def close(self) -> None:
        """Ends the process."""
        assert self._process.stdin is not None
        with self._process:
            self._process.stdin.close()

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line, "the process that runs the commands has died"
        return json.loads(line)


def main() -> None:
    """Loads the package, then runs the commands that arrive on the standard input."""
    _load(Path(sys.argv[1]))
    _say("ready")
    for line in sys.stdin:
        order = json.loads(line)
        told, tell = os.pipe()
        pid = os.fork()
        if pid == 0:
            _be_command(order, tell)
        os.close(tell)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        _say((code, int(os.read(told, 20) or 0)))
        os.close(told)


def _load(recording: Path) -> None:
    from annotator.detection.perfect import PerfectDetector, Scene
    from annotator.detection.ultralytics_api import api
    from annotator.recordings import open_recording
    from annotator.types import BoxKind
    from annotator.workflows.detectors import Detectors
    from annotator.workflows.recorded.reading import load_truth

    api()  # imported by its own name, ultralytics would write to the standard output on a new machine
    for name in LIBRARIES:
        import_module(name)
    commands = {name: import_module(f"annotator.cli.{name}") for name in LOADED}
    opened = open_recording(recording)
    frames = [opened.frame(index) for index in range(len(opened))]
    scenes = [Scene.of(frame, load_truth(opened, index, frame)) for index, frame in enumerate(frames)]
    knows = PerfectDetector(scenes, BoxKind.BOX, min_points=50)
    source = Detectors(knows, knows, BoxKind.BOX)
    commands["annotate"].trained_detectors = lambda *_: source  # type: ignore[attr-defined]


def _be_command(order: dict[str, Any], tell: int) -> None:
    from annotator.cli.main import main as annotator

    code, moments = 1, 0

    def watch(_: object, event: str, called: Any) -> None:
        nonlocal moments
        if event in ("c_call", "c_return") and getattr(called, "__name__", "") in WRITING:
            moments += 1
            if moments == order["kill_at"]:
                os.kill(os.getpid(), 9)

    try:
        if order["limit"] is not None:
            import resource
            import signal

            # writing beyond the limit then fails with an error, as on a full disk
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (order["limit"], order["limit"]))
        log = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        null = os.open(os.devnull, os.O_RDONLY)
        for target, file in ((0, null), (1, log), (2, log)):
            os.dup2(file, target)
        sys.setprofile(watch)
        code = annotator(order["words"])
        sys.setprofile(None)
        sys.stdout.flush()
        os.write(tell, b"%d" % moments)
    finally:
        # without the handlers of the process that was forked
        os._exit(code)


def _say(answer: object) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
