"""Importing torch must not disturb the other threads of a server."""

from __future__ import annotations

import subprocess
import sys

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
