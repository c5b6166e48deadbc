"""What setting up compiles is what proposing needs."""

from __future__ import annotations

import pkgutil
from importlib import import_module

from annotator.geometry import kernels as of_geometry
from annotator.rcv import kernels as of_rcv
from annotator.workflows.warm_up import warm_up


def test_all_compiled_functions_are_called() -> None:
    found = warm_up()
    assert [len(result.proposals) for result in found] == [1, 1]
    checked = []
    for package in (of_geometry, of_rcv):
        for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
            for name, value in vars(import_module(module.name)).items():
                # what numba has compiled knows the types that it was called with; the rest is called by these
                if hasattr(value, "signatures") and not name.startswith("_"):
                    assert value.signatures, f"{module.name}.{name}"
                    checked.append(name)
    assert {"draw_views", "refine", "intersection_volumes"} <= set(checked)
