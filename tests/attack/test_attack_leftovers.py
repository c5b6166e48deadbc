"""`kill -9` of a process that replaces a folder again and again: the next one finds it whole, and nothing beside it."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from annotator.files import new_folder

FILES = 30
REPLACE = """
import sys
from pathlib import Path
from annotator.files import new_folder
number = 0
while True:
    number += 1
    with new_folder(Path(sys.argv[1]), lambda _: True) as part:
        for name in range(30):
            (part / str(name)).write_text(f"{sys.argv[2]} {number}")
    print(number, flush=True)
"""


def test_a_killed_replacement_leaves_a_whole_folder(tmp_path: Path, chance: random.Random, times: int) -> None:
    out = tmp_path / "dataset"
    for kill in range(times):
        with subprocess.Popen(
            [sys.executable, "-c", REPLACE, str(out), str(kill)], stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            first = process.stdout.readline()
            # the gap between the two renames is short: aim at it from many moments
            time.sleep(chance.uniform(0.0, 0.05))
            process.send_signal(signal.SIGKILL)
            acknowledged = [first, *process.stdout.readlines()]
        # looking at the place puts it right
        with pytest.raises(ZeroDivisionError), new_folder(out, lambda _: True):
            raise ZeroDivisionError
        contents = {path.read_text() for path in out.iterdir()}
        assert len(contents) == 1
        assert len(list(out.iterdir())) == FILES
        run, number = contents.pop().split()
        assert int(run) == kill
        assert int(number) >= int(acknowledged[-1]), "what was finished stays"
        assert [path.name for path in tmp_path.iterdir()] == ["dataset"]
