"""The warm-up of scripts/setup compiles all functions that proposing needs."""

from __future__ import annotations

import json
import subprocess
import sys

from annotator.rcv.starts import is_warm
from annotator.workflows.warm_up import warm_up

# In a process of its own, because other tests call compiled functions, too. Functions called from Python have
# signatures; private ones are called only by these.
COMPILED = """
import json
from importlib import import_module
from annotator.workflows.doctor.packages import KERNELS
from annotator.workflows.warm_up import warm_up

warm_up()
compiled = {}
for module in KERNELS:
    for name, value in vars(import_module(module)).items():
        if hasattr(value, "signatures") and not name.startswith("_"):
            compiled[name] = [str(getattr(types[0], "dtype", "")) for types in value.signatures]
print(json.dumps(compiled))
"""


def test_all_compiled_functions_are_called() -> None:
    ran = subprocess.run([sys.executable, "-c", COMPILED], capture_output=True, text=True, check=True)
    compiled = json.loads(ran.stdout)
    assert [name for name, called in compiled.items() if not called] == []
    assert {"draw_views", "refine", "intersection_volumes", "point_evidence", "outlines"} <= compiled.keys()
    # float32 for clouds, float64 for corners
    assert set(compiled["points_in_box"]) == {"float32", "float64"}


def test_objects_are_found_in_all_ways() -> None:
    found = [[is_warm(proposal) for proposal in result.proposals] for result in warm_up()]
    by_classes, class_agnostic = found[:4], found[4:]
    assert by_classes == [[False], [True]] * 2
    assert class_agnostic == [[False]] * 4
