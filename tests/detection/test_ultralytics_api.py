"""Loading ultralytics has no side effects: no network access, no files, no changed settings of the process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


SILENT = """
import json, os, socket, sys
asked = []
def refuse(*args, **kwargs):
    asked.append(str(args))
    raise OSError("no network in this test")
socket.getaddrinfo = socket.socket.connect = socket.create_connection = refuse
import cv2, numpy
before = dict(os.environ), str(numpy.get_printoptions()), cv2.getNumThreads()
from annotator.detection.ultralytics_api import api
parts = api()
after = dict(os.environ), str(numpy.get_printoptions()), cv2.getNumThreads()
changed = sorted(k for k in after[0] if before[0].get(k) != after[0][k])
print(json.dumps({
    "asked": asked, "changed": changed, "gone": sorted(set(before[0]) - set(after[0])), "same": before[1:] == after[1:],
    "threads": [parts.threads, parts.torch.get_num_threads()], "torchvision": "torchvision" in sys.modules,
}))
"""


def run(code: str, tmp_path: Path) -> tuple[str, Path]:
    work, home = tmp_path / "work", tmp_path / "home"
    work.mkdir()
    home.mkdir()
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("YOLO_", "OMP_", "XDG_", "ULTRALYTICS_"))}
    environment |= {"HOME": str(home), "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=work,
        env=environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert list(work.iterdir()) == []
    return done.stdout, home


def test_loading_has_no_side_effects_except_the_stated_variables_and_settings(tmp_path: Path) -> None:
    out, home = run(SILENT, tmp_path)
    state = json.loads(out)
    assert state["asked"] == []
    assert state["gone"] == []
    assert state["same"]
    assert state["changed"] == [
        "ULTRALYTICS_SAFE_LOAD",
        "YOLO_AUTOINSTALL",
        "YOLO_CONFIG_DIR",
        "YOLO_OFFLINE",
        "YOLO_VERBOSE",
    ]
    assert state["threads"][0] == state["threads"][1]
    assert not state["torchvision"]
    files = sorted(str(path.relative_to(home)) for path in home.rglob("*") if path.is_file())
    assert files == [".cache/annotator/Ultralytics/settings.json"]


# scipy gets its first array while another thread imports torch; scipy remembers what it found out earlier
PROGRAM = """
import sys, threading
from scipy.spatial.transform import Rotation
from annotator.detection.ultralytics_api import api

loading = threading.Thread(target=api)
loading.start()
while "torch" not in sys.modules:
    pass
Rotation.from_quat([0.0, 0.0, 0.0, 1.0])
print("incomplete" if not hasattr(sys.modules["torch"], "nn") else "complete")
loading.join()
torch = api().torch
assert torch.Tensor.__module__ == "torch" and isinstance(torch.zeros(1), torch.Tensor), torch.Tensor
"""


def test_rotations_work_while_another_thread_imports_torch() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "incomplete\n"
