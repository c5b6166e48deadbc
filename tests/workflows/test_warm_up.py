"""The warm-up of scripts/setup compiles all functions that proposing needs."""

from __future__ import annotations

import pkgutil
from importlib import import_module

from annotator.geometry import kernels as of_geometry
from annotator.geometry.kernels.points_in_box import points_in_box
from annotator.rcv import kernels as of_rcv
from annotator.rcv.warm_start import is_warm
from annotator.workflows.warm_up import warm_up


def test_all_compiled_functions_are_called() -> None:
    found = warm_up()
    assert [[is_warm(proposal) for proposal in result.proposals] for result in found] == [[False], [True]] * 2
    checked = []
    for package in (of_geometry, of_rcv):
        for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
            for name, value in vars(import_module(module.name)).items():
                # functions called from Python have signatures; private ones are called only by these
                if hasattr(value, "signatures") and not name.startswith("_"):
                    assert value.signatures, f"{module.name}.{name}"
                    checked.append(name)
    assert {"draw_views", "refine", "intersection_volumes"} <= set(checked)
    # float32 for clouds, float64 for corners
    assert {str(types[0].dtype) for types in points_in_box.signatures} == {"float32", "float64"}
